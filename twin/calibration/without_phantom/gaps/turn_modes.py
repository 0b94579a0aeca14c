"""A gap between two tiles near the axis, by the angular modes of a whole turn.

Every structure that turns passes the columns near the axis as its distance from the axis
implies, in all views. Over a full turn the images' Fourier modes of the angle are
independent of each other, and their covariance between columns follows from the geometry
and from a spectrum of the object's structure (exponential: edges at random). What one
column shows is thus predicted by all others; the slope of the prediction turns the
remainder into the column's displacement. A gap displaces all columns beyond it alike. A
displacement that is smooth in the columns is nobody's: the axis, a yaw, beam hardening,
an object unlike the spectrum. Steps at the other borders are the null of one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.repeated_frames import ROBUST
from flexdt.twin.calibration.without_phantom.conjugate_rays import ConjugateRays
from flexdt.twin.calibration.without_phantom.gaps.gradient_step import (
    THIRD_DIFFERENCE_POWER,
    UNKNOWN_WIDTH_PX,
)
from flexdt.twin.calibration.without_phantom.turn import MEDIAN_OF_CHI_SQUARE
from flexdt.twin.geometry.conventions import FloatArray

ComplexArray = npt.NDArray[np.complex128]

LEAST_COLUMNS: Final = 24
MOST_COLUMNS: Final = 40
"""Columns on each side of the axis that are compared, at least and at most."""
SMOOTH_COLUMNS: Final = 4.4
"""Columns to a degree of the smooth displacement (Legendre)."""
MARGIN: Final = 4
"""Columns at both ends whose borders are not judged."""
LEAST_BORDERS: Final = 12
"""Borders that must show something, for a scatter."""
MODES_PER_COLUMN: Final = 3.3
"""Modes to a column's distance from the axis: a pixel attenuates those above pi."""
CORRELATION_COLUMNS: Final = 20.0
"""Length of the exponential covariance of the object, in columns at the axis."""
RADIUS_GROWTH: Final = 1.05
"""Ratio of neighboring radii beyond the columns that are compared."""
BOX: Final = np.array([0.5, 1.0, 1.0, 1.0, 0.5]) / 4.0
"""Shares of rays over a column's width, from one edge to the other."""
SCALES: Final = np.exp(np.arange(-24.0, 4.0, 0.5))
NOISES: Final = 2.0 ** np.arange(-2.0, 6.0, 0.5)
"""Variances of the object [1/column^2], and of noise over that of differences, that are
tried."""
LEAST_NOISE: Final = 1e-6
"""Least variance of noise, as a share of that of the views: images without any noise."""
NOISE_COLUMNS = 9
"""Columns over which the noise is averaged."""


class ModeSteps(NamedTuple):
    """Widths of gaps by the modes of a turn.

    Attributes:
        columns: first columns beyond the borders, (c,).
        width: of a gap at each, (c,) [px].
        sigma: standard deviation of each where there is no gap, by the modes and by what
            the other borders scatter, (c,) [px].
    """

    columns: npt.NDArray[np.intp]
    width: FloatArray
    sigma: FloatArray


class Columns(NamedTuple):
    """The geometry of a turn.

    Attributes:
        depth: of the panel behind the source [px].
        side: 1 where columns go to the right of the beam, seen from above; -1: to its left.
        cols: number of columns.
        views: number of views of a turn.
    """

    depth: float
    side: float
    cols: int
    views: int


class Displacements(NamedTuple):
    """Score and information of displacements of columns, (n,) and (n, n)."""

    score: FloatArray
    information: FloatArray


def mode_steps(rays: ConjugateRays, axis: float, reach: float) -> ModeSteps | None:
    """Estimate the width of a gap at each border near the axis.

    Args:
        rays: of a full turn, at even steps.
        axis: column of the axis, to a pixel or two.
        reach: distance from the axis up to which gaps are hidden [px]; LEAST_COLUMNS to
            MOST_COLUMNS are compared.

    Returns:
        Steps of all borders but those of MARGIN at the ends; None for too few columns or
        views.
    """
    half = min(max(reach + 2 * MARGIN, LEAST_COLUMNS), MOST_COLUMNS)
    low = max(math.ceil(axis - half), 0)
    columns = np.arange(low, min(math.floor(axis + half) + 1, rays.cols))
    modes = np.arange(1, min((rays.views - 1) // 2, int(MODES_PER_COLUMN * half)) + 1)
    if len(columns) < LEAST_COLUMNS or len(modes) < 2:
        return None
    band = rays.band
    seen = np.fft.fft(band[:, :, columns], axis=0)[modes] / rays.views
    third = np.square(np.diff(band, 3, axis=2))
    noise = np.median(third, axis=(0, 1)) / MEDIAN_OF_CHI_SQUARE / THIRD_DIFFERENCE_POWER
    noise = np.convolve(
        np.pad(noise, (2 + NOISE_COLUMNS // 2, 1 + NOISE_COLUMNS // 2), mode="edge"),
        np.full(NOISE_COLUMNS, 1.0 / NOISE_COLUMNS),
        mode="valid",
    )[columns]
    floor = max(LEAST_NOISE * float(band.var(axis=0).mean()), 1e-30)
    geometry = _in_columns(rays)
    covariance, slope = _covariances(geometry, columns - axis, modes)
    moved = _displacements(
        seen.transpose(0, 2, 1), covariance, slope, np.maximum(noise, floor) / rays.views
    )
    return _steps(moved, columns)


def _steps(moved: Displacements, columns: npt.NDArray[np.intp]) -> ModeSteps | None:
    """Fit a step at each border beside a smooth displacement, with the scatter of the
    steps that are left at all other borders.

    Args:
        moved: displacements of columns.
        columns: these columns, (n,).

    Returns:
        The steps; None where fewer than LEAST_BORDERS show any.
    """
    count = len(columns)
    degree = max(round(count / SMOOTH_COLUMNS), 3)
    smooth = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, count), degree)
    beyond = (np.arange(count) >= np.arange(MARGIN, count - MARGIN + 1)[:, None]) * 1.0
    # Steps free of what is smooth, in the metric of the information.
    told = smooth.T @ moved.information @ smooth
    try:
        to_smooth = np.linalg.solve(told, smooth.T @ moved.information)
    except np.linalg.LinAlgError:
        return None
    free = beyond - (beyond @ to_smooth.T) @ smooth.T
    shared = free @ moved.information @ free.T
    power = np.diag(shared)
    known = power > 1.0 / UNKNOWN_WIDTH_PX**2
    if known.sum() < LEAST_BORDERS:
        return None
    over = np.where(known, power, 1.0)
    score = free @ moved.score
    width = score / over
    # What is left at each border when the step at another one is closed.
    left = (score[:, None] - shared * width) / np.sqrt(over)[:, None]
    place = np.arange(len(width))
    apart = np.abs(np.subtract.outer(place, place))
    others = np.where((apart > 1) & known[:, None], np.abs(left), np.nan)
    wider = np.maximum(ROBUST * np.nanmedian(others, axis=0), 1.0)
    sigma = wider / np.sqrt(over)
    return ModeSteps(
        columns[MARGIN : count - MARGIN + 1],
        np.where(known, width, 0.0),
        np.where(known, sigma, UNKNOWN_WIDTH_PX),
    )


def _displacements(
    seen: ComplexArray, covariance: ComplexArray, slope: ComplexArray, noise: FloatArray
) -> Displacements:
    """Compute score and information of displacements of columns, at the likeliest
    variances of object and noise.

    Args:
        seen: modes of groups of rows, (modes, n, groups).
        covariance: of columns, of an object of variance 1, (modes, n, n).
        slope: its change with the first column's place, (modes, n, n).
        noise: variance of modes by noise, (n,).
    """
    root = np.sqrt(noise)
    variance, ways = np.linalg.eigh(covariance / np.outer(root, root))
    power = np.square(np.abs(ways.conj().transpose(0, 2, 1) @ (seen / root[:, None])))
    power = power.sum(axis=2)
    variance = variance.clip(0.0)
    groups = seen.shape[2]
    best = (-math.inf, 0.0, 1.0)
    for scale in SCALES.tolist():
        for times in NOISES.tolist():
            whole = scale * variance + times
            likely = -float((power / whole + groups * np.log(whole)).sum())
            best = max(best, (likely, scale, times))
    _, scale, times = best
    inverse = np.linalg.inv(scale * covariance + np.diag(times * noise))
    rest = inverse @ seen
    rising = scale * slope @ rest
    chance = np.einsum("mij,mji->i", scale * slope, inverse).real
    score = (rest.conj() * rising).real.sum(axis=(0, 2)) - groups * chance
    both = rising.conj() @ rising.transpose(0, 2, 1)
    return Displacements(2.0 * score, 2.0 * (both * inverse).real.sum(axis=0))


def _in_columns(rays: ConjugateRays) -> Columns:
    """Give the geometry of a turn in columns at the axis."""
    scan = rays.scan
    beam = scan.pose.detector[0] - scan.pose.source[0]
    u = scan.pose.u[0]
    side = float(np.sign(u[0] * beam[1] - u[1] * beam[0])) or 1.0
    return Columns(scan.sdd_mm / scan.pitch_mm, side, rays.cols, rays.views)


def _covariances(
    geometry: Columns, beside: FloatArray, modes: npt.NDArray[np.intp]
) -> tuple[ComplexArray, ComplexArray]:
    """Compute the covariance of columns in each mode of the turn, for an object of
    exponential covariance and variance 1, lengths in columns at the axis.

    Args:
        geometry: of the turn.
        beside: places of the columns from the axis, (n,) [px].
        modes: numbers, (m,); those that views alias to them are added.

    Returns:
        The covariance, and its change with the first column's place, (m, n, n) each.
    """
    edge = float(np.abs(beside).max())
    outer = max(geometry.cols / 2.0, edge + 2.0)
    more = math.ceil(math.log(outer / edge) / math.log(RADIUS_GROWTH)) + 1
    radius = np.concatenate(
        [np.arange(0.25, edge, 0.5), edge * RADIUS_GROWTH ** np.arange(more)]
    )
    most = int(1.15 * modes[-1]) + 1
    of_radius = _modes_of_covariance(radius, most)
    at = (beside[:, None] + np.linspace(-0.5, 0.5, len(BOX))).ravel()
    factors = []
    for mode, of_rays in enumerate(_integrals(geometry, at, radius, most)):
        of_edges = of_rays.reshape(len(beside), len(BOX), -1)
        own = np.einsum("k,ckr->cr", BOX, of_edges)
        spread = of_radius[:, :, mode] @ own.conj().T
        factors.append((own @ spread, (of_edges[:, -1] - of_edges[:, 0]) @ spread))
    shape = len(modes), len(beside), len(beside)
    covariance = np.zeros(shape, dtype=np.complex128)
    slope = np.zeros(shape, dtype=np.complex128)
    for i, mode in enumerate(modes.tolist()):
        for alias in (mode, mode - geometry.views, mode + geometry.views):
            if abs(alias) <= most:
                whole, change = factors[abs(alias)]
                covariance[i] += whole if alias >= 0 else whole.conj()
                slope[i] += change if alias >= 0 else change.conj()
    return covariance, slope


def _integrals(
    geometry: Columns, at: FloatArray, radius: FloatArray, most: int
) -> Iterator[ComplexArray]:
    """Yield the integrals along rays of the modes 0 to `most` of an object.

    Args:
        geometry: of the turn.
        at: where the rays meet the panel, from the axis, (k,) [px].
        radius: nodes between which modes are linear, (r,) [columns at the axis].
        most: the last mode.

    Yields:
        (k, r): shares of the nodes in each ray.
    """
    # In columns at the axis, source and axis are as far apart as source and panel in pixels.
    depth = geometry.depth
    fan = np.arctan2(geometry.side * at, depth)[:, None]
    along = np.concatenate([-radius[::-1], radius])
    x = (depth * np.cos(fan) + along) * np.sin(fan)
    y = (depth * np.cos(fan) + along) * np.cos(fan) - depth
    far = np.hypot(x, y).ravel()
    turn = np.exp(1j * np.arctan2(y, x)).ravel()
    inner = np.clip(np.searchsorted(radius, far) - 1, 0, len(radius) - 2)
    part = ((far - radius[inner]) / (radius[inner + 1] - radius[inner])).clip(0.0, 1.0)
    weight = np.tile(np.gradient(along), len(at)) * (far <= radius[-1])
    weights = np.concatenate([(1.0 - part) * weight, part * weight])
    ray = np.repeat(np.arange(len(at)), len(along))
    # In the order of the table's places, all shares of one are beside each other.
    place = np.tile(ray, 2) * len(radius) + np.concatenate([inner, inner + 1])
    order = np.argsort(place, kind="stable")
    first = np.flatnonzero(np.diff(place[order], prepend=-1))
    filled = place[order][first]
    turn = np.tile(turn, 2)[order]
    wave = weights[order].astype(np.complex128)
    table = np.zeros(len(at) * len(radius), dtype=np.complex128)
    for _ in range(most + 1):
        table[filled] = np.add.reduceat(wave, first)
        yield table.reshape(len(at), -1).copy()
        wave = wave * turn


def _modes_of_covariance(radius: FloatArray, most: int) -> FloatArray:
    """Compute the modes 0 to `most` of an exponential covariance between circles.

    `radius`: of the circles, (r,) [columns]; `most`: the last mode.
    Returns (r, r, most + 1) float32.
    """
    count = 2 ** math.ceil(math.log2(4 * most))
    cosine = np.cos(2.0 * math.pi * np.arange(count // 2 + 1) / count)
    squares = np.add.outer(np.square(radius), np.square(radius)).astype(np.float32)
    product = (2.0 * np.outer(radius, radius)).astype(np.float32)
    apart = squares[:, :, None] - product[:, :, None] * cosine.astype(np.float32)
    near = np.exp(-np.sqrt(np.maximum(apart, 0.0)) / np.float32(CORRELATION_COLUMNS))
    return np.asarray(np.fft.hfft(near, n=count, axis=2)[:, :, : most + 1] / count)
