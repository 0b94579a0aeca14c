"""What lies behind the beads besides their own phantom: curved backgrounds and foreign objects.

Subtracting a plane fitted to the ring around a spot removes a straight gradient. A curved one (a
bad flat field, scatter) or an edge (something that is not in the model) shifts every centroid by
less than the eye can see and by more than the reported uncertainty allows. Both show in the ring,
averaged over blocks of pixels; pixels under the bead itself are not used.

A gradient has a second effect that no plane removes. Scattered light and a beam of several energies
make a bead fainter where more lies behind it, so the side of a spot behind which there is less
counts for more, and all centroids are off in the direction in which the body becomes thinner.
`fading` reads from the beads themselves how their contrast falls, and `evened` undoes it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import Float32Array, FloatArray

BLOCK: int = 5
"""Pixels along a block's side; noise averages out over them, edges do not."""
SHADOW = 0.3
"""Line integral of a bead above which a block is left out."""
BENT = 40.0
"""Chi-square that the seven bent terms must explain in the median window (white noise: 6.3)."""
LEAST_NOISE = 1e-3
"""Noise of line integrals that is assumed at least: no pixel counts a million photons."""
OUTLIER = 4.5
"""Contrasts that are off by so many times what half of them are (three standard deviations) are not
those of that bead."""
MEANS = 10
"""Rounds in which the means of frames and beads are taken off in turns; few are missing."""
FAR_OUT = 7.0
"""Standard deviations of a window's misfit above the median one from which it is disturbed."""


@dataclass(frozen=True, eq=False)
class Background:
    """What was found behind m windows.

    Attributes:
        misfit: (m,) mean square of what a smooth background leaves, by the median window's; 1 where
            it cannot be judged.
        disturbed: (m,) the misfit is further from the others' than noise makes it.
        bend: (m, side, side) what to subtract besides a plane, or None where it is straight.
        plane: (m, 3) line integral behind the middle of each window and its change by a pixel to
            the right and down.
    """

    misfit: FloatArray
    disturbed: npt.NDArray[np.bool_]
    bend: Float32Array | None
    plane: FloatArray


def survey(flat: Float32Array, alone: Float32Array) -> Background:
    """Judge windows (m, side, side) of line integrals, given the beads alone rendered there.

    Pixels outside the image are nan.
    """
    m, side = flat.shape[0], flat.shape[1]
    count = side // BLOCK
    edge = (side - count * BLOCK) // 2
    seen, beads = (_blocks(a, edge, count) for a in (flat, alone))
    off = seen - beads
    valid = np.isfinite(off) & (beads < SHADOW)
    off[~valid] = 0.0
    shapes = _shapes((np.arange(count) + 0.5) * BLOCK + edge - 0.5, side)
    enough = valid.sum(axis=1) >= 24
    straight, plane = _fitted(off, valid, shapes[:, :3], enough)
    curved, coefficients = _fitted(off, valid, shapes, enough)
    variance = pixel_noise(flat, edge, count * BLOCK) ** 2 / BLOCK**2
    gain = (straight - curved) / np.maximum(variance, 1e-12)
    bent = bool(enough.any()) and _bends(gain[enough], curved[enough], variance[enough], valid)
    free = valid.sum(axis=1) - (shapes.shape[1] if bent else 3)
    misfit = (curved if bent else straight) / np.maximum(free, 1) / np.maximum(variance, 1e-12)
    typical = max(float(np.median(misfit[enough])), 1.0) if enough.any() else 1.0
    ratio = np.where(enough, np.maximum(misfit / typical, 1.0), 1.0)
    limit = 1.0 + FAR_OUT * np.sqrt(2.0 / np.maximum(free, 1))
    bend: Float32Array | None = None
    if bent:
        fine = _shapes(np.arange(side, dtype=np.float64), side)
        coefficients[:, :3] = 0.0
        bend = (coefficients @ fine.T).astype(np.float32).reshape(m, side, side)
    plane = plane / np.array([1.0, side / 2, side / 2])
    return Background(ratio, enough & (ratio > limit), bend, plane)


def fading(contrast: FloatArray, behind: FloatArray, seen: npt.NDArray[np.bool_]) -> float:
    """How contrast changes with the line integral behind a bead, as a share of it.

    Each bead is compared with itself in other frames, and each frame's mean is taken off, so beads
    of several sizes and a beam that drifts say nothing. What noise may have made of it is taken off
    (James and Stein), so that of no slope nothing is left. Contrast C falls by at most as much as
    what lies behind grows, if a ball lets nothing but scattered light through; where scattered
    light is not even it grows with the line integral, by exp(C) - 1 times as much. What is beyond
    these is an error of the level, which is in the contrast as well.

    Args:
        contrast: of each bead in each frame, (n, k).
        behind: line integrals behind their middles, (n, k).
        seen: which of them are measured, (n, k).
    """
    logarithm = np.log(np.where(seen, contrast, 1.0))
    use = seen
    for _ in range(3):
        change, more = (_against_own_means(a, use) for a in (logarithm, behind))
        free = int(use.sum()) - int(use.any(axis=0).sum()) - int(use.any(axis=1).sum())
        power = float(np.square(more).sum())
        if free < 1 or power <= 0.0:
            return 0.0
        slope = float((change * more).sum()) / power
        left = np.abs(_against_own_means(logarithm - slope * behind, seen))
        use = seen & (left <= OUTLIER * float(np.median(left[seen])))
    variance = max(float(np.square(change).sum()) - slope**2 * power, 0.0) / free / power
    slope *= max(1.0 - variance / max(slope**2, 1e-30), 0.0)
    usual = float(np.median(contrast[use]))
    return min(max(slope, -1.0 / usual), math.expm1(usual) / usual)


def _against_own_means(values: FloatArray, seen: npt.NDArray[np.bool_]) -> FloatArray:
    """Values (n, k) less what their frame and their bead have in common, 0 where not seen."""
    out = np.where(seen, values, 0.0)
    for _ in range(MEANS):
        for axis in (0, 1):
            count = np.maximum(seen.sum(axis=axis, keepdims=True), 1)
            out = np.where(seen, out - out.sum(axis=axis, keepdims=True) / count, 0.0)
    return np.asarray(out)


def evened(
    flat: Float32Array, plane: FloatArray, body: Float32Array | None, slope: float
) -> Float32Array:
    """Windows (m, side, side) with each bead as it would be were there as much behind all of it as
    there is behind its middle.

    Args:
        flat: line integrals without the phantom's body.
        plane: as `Background` has it.
        body: line integrals of the body, or None.
        slope: of the contrast, as `fading` has it.
    """
    at = (np.arange(flat.shape[1]) - (flat.shape[1] - 1) / 2).astype(np.float32)
    value, right, down = plane.astype(np.float32).T[:, :, None, None]
    more = right * at + down * at[:, None]
    level = value + more
    if body is not None:
        middle = flat.shape[1] // 2
        more = more + body - body[:, middle, middle][:, None, None]
    return np.asarray(level + (flat - level) * np.exp(np.float32(-slope) * more))


def _bends(
    gain: FloatArray, curved: FloatArray, variance: FloatArray, valid: npt.NDArray[np.bool_]
) -> bool:
    """Whether bent terms explain much in the median window, and most of what there is to explain:
    edges are not explained by them."""
    free = float(np.median(valid.sum(axis=1)))
    left = float(np.median(curved / np.maximum(variance, 1e-12))) - free
    explained = float(np.median(gain))
    return explained > BENT and left < 0.3 * explained


def _blocks(windows: Float32Array, edge: int, count: int) -> FloatArray:
    """Means of blocks, (m, count^2)."""
    inner = windows[:, edge : edge + count * BLOCK, edge : edge + count * BLOCK]
    part = inner.reshape(len(windows), count, BLOCK, count * BLOCK).sum(axis=2)
    summed = part.reshape(len(windows), count, count, BLOCK).sum(axis=3)
    return np.asarray(summed.reshape(len(windows), -1), dtype=np.float64) / BLOCK**2


def _shapes(places: FloatArray, side: int) -> FloatArray:
    """Polynomials up to the third degree on a grid of places, (places^2, 10), planes first."""
    t = (places - (side - 1) / 2) / (side / 2)
    y, x = (a.ravel() for a in np.meshgrid(t, t, indexing="ij"))
    one = np.ones_like(x)
    return np.stack([one, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3], axis=1)


def _fitted(
    off: FloatArray, valid: npt.NDArray[np.bool_], shapes: FloatArray, enough: npt.NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray]:
    """Sum of squares that polynomials leave in each window, (m,), and their coefficients."""
    p = shapes.shape[1]
    weight = valid.astype(np.float64)
    gram = (weight @ (shapes[:, :, None] * shapes[:, None, :]).reshape(len(shapes), -1)).reshape(
        -1, p, p
    )
    gram += 1e-6 * np.eye(p)
    gram[~enough] = np.eye(p)
    right = off @ shapes
    coefficients = np.linalg.solve(gram, right[:, :, None])[:, :, 0]
    coefficients[~enough] = 0.0
    left = np.einsum("mi,mi->m", off, off) - np.einsum("mp,mp->m", coefficients, right)
    return np.asarray(np.maximum(left, 0.0)), np.asarray(coefficients, dtype=np.float64)


def pixel_noise(flat: Float32Array, edge: int, width: int) -> FloatArray:
    """Noise of each window's pixels from neighbours in a few rows at its top and bottom, (m,)."""
    rows = [edge, edge + 3, edge + 6, edge + width - 7, edge + width - 4, edge + width - 1]
    strips = flat[:, rows, edge : edge + width]
    steps = np.abs(np.diff(strips, axis=2)).reshape(len(flat), -1)
    good = np.isfinite(steps).all(axis=1)
    out = np.zeros(len(flat))
    if good.any():
        out[good] = np.median(steps[good], axis=1) / (0.6745 * math.sqrt(2.0))
        out[~good] = np.median(out[good])
    return np.asarray(np.maximum(out, LEAST_NOISE))
