"""Rows continued beyond the panel's edges, beside path lengths ray by ray in double
precision."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import least_squares

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.reconstruction import Truncation
from flexdt.twin.reconstruction.acquisition.trajectory import circle_of
from flexdt.twin.reconstruction.acquisition.truncation import Prism
from flexdt.twin.reconstruction.feldkamp.fdk_plan import weighing
from flexdt.twin.reconstruction.feldkamp.fdk_views import Views
from flexdt.twin.reconstruction.kernels.truncation_kernels import fit_prism

ROUNDING = 4 * float(np.finfo(np.float32).eps)
"""Of the largest value: a pixel is rounded once, and the panel's means are of float32
images."""


def drawn_prism(rng: np.random.Generator) -> Prism:
    """Of half axes of 15 to 40 mm about a place near the axis."""
    axes, lean = 1.0 / rng.uniform(15.0, 40.0, 2), rng.uniform(-0.01, 0.01)
    to_disc = np.array([[axes[0], 0.0], [lean, axes[1]]])
    return Prism(rng.uniform(-6.0, 6.0, 2), to_disc, float(rng.uniform(0.005, 0.02)))


def path(prism: Prism | None, source: FloatArray, pixel: FloatArray) -> float:
    """Attenuation along one ray: where it enters and leaves the elliptic cylinder."""
    if prism is None:
        return 0.0
    way = pixel - source
    matrix = prism.to_disc.T @ prism.to_disc
    start = source[:2] - prism.centre
    a, b = way[:2] @ matrix @ way[:2], start @ matrix @ way[:2]
    inside = b * b - a * (start @ matrix @ start - 1.0)
    if inside <= 0.0:
        return 0.0
    return float(prism.attenuation * 2.0 * math.sqrt(inside) / a * np.linalg.norm(way))


class Reference:
    """The continuation of one view's rows, pixel by pixel, from the text of `Truncation`."""

    def __init__(
        self, found: Truncation, row: FloatArray, size: tuple[int, int], before: int
    ):
        self.found, (self.cols, self.wide), self.before = found, size, before
        self.source, self.panel, self.u, self.v = row.reshape(4, 3)

    def bands(self, r: float) -> list[tuple[int, float]]:
        """Numbers of the bands that count in a row of the panel, and how much."""
        at = self.found.rows
        if len(at) == 1 or r <= at[0]:
            return [(0, 1.0)]
        if r >= at[-1]:
            return [(len(at) - 1, 1.0)]
        k = max(i for i in range(len(at)) if at[i] <= r)
        part = (r - at[k]) / (at[k + 1] - at[k])
        return [(k, 1.0 - part), (k + 1, part)]

    def model(self, r: float, c: float, middle_row: float) -> float:
        """What the prisms attenuate on the way to a pixel, c from the panel's first column."""
        pixel = (
            self.panel + (c - (self.cols - 1) / 2) * self.u + (r - middle_row) * self.v
        )
        prisms = self.found.prisms
        return sum(
            part * path(prisms[k], self.source, pixel) for k, part in self.bands(r)
        )

    def row(self, line: FloatArray, r: float, middle_row: float) -> FloatArray:
        """A widened row."""
        edge = max(1, self.cols // 48)
        cut = sum(part * bool(self.found.cut_off[k]) for k, part in self.bands(r))
        sides = (range(edge), range(self.cols - edge, self.cols))
        rest = [
            np.mean([line[c] - self.model(r, c, middle_row) for c in side])
            for side in sides
        ]
        out = np.empty(self.wide)
        for at in range(self.wide):
            c = at - self.before
            if 0 <= c < self.cols:
                out[at] = line[c]
                continue
            away = (-c if c < 0 else c - self.cols + 1) - 0.5
            part = min(away / max(self.found.fade * self.cols, 1.0), 1.0)
            fading = 0.5 + 0.5 * math.cos(math.pi * part)
            out[at] = self.model(r, c, middle_row) + rest[c > 0] * cut * fading
        return out


def drawn(
    seed: int,
) -> tuple[Truncation, ConeVec, Float32Array, tuple[int, int, int, int]]:
    """A truncation, two views, their images, and rows and columns that are asked for."""
    rng = np.random.default_rng([20261127, seed])
    rows, cols = int(rng.integers(1, 14)), int(rng.integers(2, 110))
    bands = int(rng.integers(1, min(rows, 4) + 1))
    cut_off = rng.random(bands) < 0.8
    prisms = tuple(
        drawn_prism(rng) if cut and rng.random() < 0.7 else None for cut in cut_off
    )
    middles = np.sort(rng.uniform(0.0, rows - 1.0, bands))
    found = Truncation(middles, prisms, cut_off, fade=float(rng.choice([0.5, 1.0])))
    scan = ConeVec.circular(
        sod=200.0, sdd=350.0, angles=rng.uniform(0.0, 360.0, 3), shape=(rows, cols),
        pixel=60.0 / cols, offset=(rng.uniform(-5.0, 5.0), rng.uniform(-5.0, 5.0)),
    )  # fmt: skip
    images = rng.uniform(0.0, 2.0, (3, rows, cols)).astype(np.float32)
    first, last = sorted(rng.choice(np.arange(-2, rows + 3), 2, replace=False).tolist())
    return found, scan, images, (first, last, *rng.integers(0, 2 * cols, 2).tolist())


def widened(
    found: Truncation,
    scan: ConeVec,
    images: Float32Array,
    asked: tuple[int, int, int, int],
) -> Float32Array:
    """As FDK widens these rows."""
    first, last, before, after = asked
    rows, cols = images.shape[1:]
    shape = (last - first, before + cols + after)
    down, right = (first + last - rows) / 2, (after - before) / 2
    centre = scan.detector + down * scan.v + right * scan.u
    level = ConeVec.from_vectors(scan.source, centre, scan.u, scan.v)
    panel = slice(before, before + cols)
    beyond = found.continuation(level, first, shape, panel)
    every, one = slice(0, len(images)), np.ones((len(images), shape[1]))
    factors, across, up = weighing(shape, level, circle_of(scan), every, one)
    none = np.zeros((len(images), 0, 0), np.float32)
    views = Views(
        images,
        first,
        before,
        beyond,
        factors,
        across,
        up,
        np.zeros(0, np.float32),
        panel,
        none,
        one,
        few=False,
    )
    out = np.full((len(images), *shape), np.nan, np.float32)
    views.widen(out)
    check_weighed(views, out)
    return out


def check_weighed(views: Views, plain: Float32Array) -> None:
    """Rows that are weighed while they are continued are these rows times their weights,
    and zeros follow them."""
    n, rows, wide = plain.shape
    weighed = np.full((n, rows, wide + 3), np.nan, np.float32)
    views.widen(weighed, weighed=True)
    length = np.sqrt(views.across[:, None] + views.up[:, :, None])
    wanted = plain * (views.factors[:, None] / length)
    most = np.abs(wanted).max(axis=2, keepdims=True)
    assert (np.abs(weighed[..., :wide] - wanted) <= ROUNDING * most).all()
    assert not weighed[..., wide:].any()


@pytest.mark.parametrize("seed", range(8))
def test_rows_go_on_as_path_lengths_say(seed: int) -> None:
    found, scan, images, asked = drawn(seed)
    out = widened(found, scan, images, asked)
    first, last, before, _ = asked
    rows, cols = images.shape[1:]
    for view in range(len(images)):
        reference = Reference(found, scan.rows[view], (cols, out.shape[2]), before)
        for r in range(first, last):
            line = images[view, min(max(r, 0), rows - 1)].astype(float)
            wanted = reference.row(line, r, (rows - 1) / 2)
            worst = np.abs(out[view, r - first] - wanted).max()
            assert worst <= ROUNDING * np.abs(wanted).max(), (seed, view, r)


def test_nothing_beyond_the_edges_is_zero() -> None:
    _, scan, images, asked = drawn(3)
    whole = Truncation(np.zeros(1), (None,), np.zeros(1, bool))
    out = widened(whole, scan, images, asked)
    cols, before = images.shape[2], asked[2]
    assert not out[:, :, :before].any()
    assert not out[:, :, before + cols :].any()
    assert np.array_equal(out[:, 3, before : before + cols], images[:, asked[0] + 3])


@pytest.mark.parametrize("seed", range(4))
def test_the_fit_costs_no_more_than_scipys(seed: int) -> None:
    """Of rays through a drawn prism with a ball in it and noise, from three first guesses."""
    rng = np.random.default_rng([7, seed])
    prism, field = drawn_prism(rng), 14.0
    turn = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    source = 200.0 * np.column_stack([np.cos(turn), np.sin(turn)])
    fan = np.linspace(-0.07, 0.07, 24)
    angle = turn[:, None] + np.pi + fan
    rays = 300.0 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    seen = prism.integrals(source[:, None], rays)
    ball = np.abs(np.sin(angle) * source[:, :1] - np.cos(angle) * source[:, 1:] - 3.0)
    seen = (
        seen
        + 0.05 * np.sqrt(np.maximum(16.0 - ball**2, 0.0))
        + rng.normal(0, 1e-3, ball.shape)
    )
    usual = float(np.median(seen))
    middle = np.array([0.0, 0.0, 0.0, 0.0, 0.0, math.log(usual / field)])
    limit = np.array([2.0, 2.0, math.log(4.0), math.log(4.0), 2.0, 3.0 * math.log(4.0)])
    low, high, scale = middle - limit, middle + limit, 0.05 * usual

    def rest(x: FloatArray) -> FloatArray:
        return (Prism.of(x, field).integrals(source[:, None], rays) - seen).ravel()

    ours, theirs = [], []
    for r in (1.1, 1.5, 2.2):
        start = np.array(
            [0, 0, -math.log(r), -math.log(r), 0, math.log(usual / (1.5 * r * field))]
        )
        found = least_squares(
            rest, start, bounds=(low, high), loss="cauchy", f_scale=scale, max_nfev=60
        )
        theirs.append(found.cost)
        x = start.copy()
        ours.append(
            fit_prism(
                source / field,
                rays / field,
                np.full(ball.shape, 300.0),
                seen,
                low,
                high,
                scale,
                x,
            )
        )
        assert ((low <= x) & (x <= high)).all()
        assert ours[-1] == pytest.approx(
            0.5 * scale**2 * np.log1p((rest(x) / scale) ** 2).sum()
        )
    assert min(ours) <= min(theirs) * (1.0 + 1e-6)
