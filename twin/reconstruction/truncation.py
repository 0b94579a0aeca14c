"""What lies beyond the edges of a panel that is narrower than the object's shadow.

The ramp filter needs whole projections. Where the object goes on beyond the panel, a prism over
an ellipse or a rectangle is fitted to what all views saw of it, row band by row band, and rows are
continued by its path lengths. One shape for all views is what makes the continuations agree with
each other: a row on its own says little of how far its object reaches. Other things in the object
are deviations that count less and less (a Cauchy loss); an outline that neither shape resembles (a
triangle) is continued badly.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray

SAMPLES = 48
"""Views that the shape is fitted to, at most."""
BANDS = 8
"""Bands of rows with a shape of their own."""
COLUMNS = 48
"""Columns of each view that take part in the fit."""
NEIGHBOURS = 5
"""Views of which the middle one counts in telling truncation from noise."""
NOTICEABLE = 0.03
"""A line integral at an edge that counts as truncation, relative to the largest."""
EDGE = 5
"""Columns whose mean is the value at an edge."""
FADING = 0.5
"""Length of a row over which what no prism explains fades out, beyond an edge."""
WIDEST = 2.0
"""Rows are continued by at most so many times their length on either side."""
STARTS = (1.1, 1.5, 2.2)
"""Radii that the fit starts from, relative to the field of view's."""
TURNS = (0.0, 0.4, 0.8, 1.2)
"""Angles against the best ellipse that the fit of a rectangle starts from [rad]."""
DOUBTFUL = 0.03
"""Misfit above which an outline is unlike an ellipse or a rectangle."""
DOUBT = (
    "the object is wider than the panel, and its outline is unlike an ellipse or a rectangle: "
    "densities may be off by tens of per cent"
)
ROUGH = 0.01
"""Deviations from an ellipse, relative to large line integrals, beyond which they are taken for
other things in the object and count less and less."""


@dataclass(frozen=True, eq=False)
class Prism:
    """An upright prism that attenuates evenly, over an ellipse or a rectangle.

    Attributes:
        round: an ellipse; else a rectangle.
        centre: (x, y) [mm].
        half: half axes, or half sides [mm].
        angle: of the first of them, counter-clockwise from x [rad].
        attenuation: [1/mm].
    """

    round: bool
    centre: tuple[float, float]
    half: tuple[float, float]
    angle: float
    attenuation: float

    def integrals(self, source: FloatArray, rays: FloatArray) -> FloatArray:
        """Line integrals (...) in the plane, of `rays` (..., 2) from `source` (..., 2) [mm]."""
        c, s = np.cos(self.angle), np.sin(self.angle)
        to_own = np.array([[c, -s], [s, c]]) / np.array(self.half)
        start, along = (source - np.array(self.centre)) @ to_own, rays @ to_own
        if self.round:
            squared = (along * along).sum(axis=-1)
            middle = (start * along).sum(axis=-1)
            inside = middle * middle - squared * ((start * start).sum(axis=-1) - 1.0)
            part = 2.0 * np.sqrt(np.maximum(inside, 0.0)) / squared
        else:
            steep = np.where(np.abs(along) < 1e-12, 1e-12, along)
            nearer, farther = (-start - np.sign(steep)) / steep, (-start + np.sign(steep)) / steep
            part = np.maximum(farther.min(axis=-1) - nearer.max(axis=-1), 0.0)
        return np.asarray(self.attenuation * part * np.sqrt((rays * rays).sum(axis=-1)))

    def corners(self) -> FloatArray:
        """(k, 2) points around it [mm]."""
        turn = np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)
        unit = np.stack([np.cos(turn), np.sin(turn)], axis=1)
        if not self.round:
            unit = np.sign(unit) + 0.0
        c, s = np.cos(self.angle), np.sin(self.angle)
        return np.asarray(unit * self.half @ np.array([[c, s], [-s, c]]) + np.array(self.centre))


@dataclass(frozen=True, eq=False)
class Beyond:
    """An object that the panel cuts off: a prism for each band of rows.

    Attributes:
        rows: (b,) middle row of each band.
        prisms: one a band; None where the band's rows are whole.
        misfit: of the worst band: median deviation of what was seen from the prism, relative to
            large line integrals.
    """

    rows: FloatArray
    prisms: tuple[Prism | None, ...]
    misfit: float = 0.0

    @property
    def doubtful(self) -> bool:
        """Whether the outline is unlike the prism's, so that densities may be far off."""
        return self.misfit > DOUBTFUL

    def columns(self, cone_vec: ConeVec, cols: int) -> tuple[int, int]:
        """Columns before the first and after the last into which the object's shadow reaches."""
        before = after = FADING * cols
        middle_row = ConeVec(cone_vec.rows)  # without the shape of the panel
        for prism in filter(None, self.prisms):
            rim = prism.corners()
            points = np.column_stack([rim, np.zeros(len(rim))])
            at = middle_row.project_points(points, (1, cols))[..., 0]
            at = np.where(np.isfinite(at), at, WIDEST * cols)
            before, after = max(before, -float(at.min())), max(after, float(at.max()) - cols + 1)
        most = WIDEST * cols
        return int(min(before + 2.0, most)), int(min(after + 2.0, most))

    def fill(self, images: Float32Array, cone_vec: ConeVec, before: int, cols: int) -> None:
        """Continue rows beyond the panel's edges, in place.

        Args:
            images: (n, rows, before + cols + after) line integrals; those off the panel are set.
            cone_vec: of the panel itself, all its rows, (n).
            before: columns before the panel's first.
            cols: the panel's columns.
        """
        rows, wide = images.shape[1:]
        on = slice(before, before + cols)
        r = np.arange(rows, dtype=np.float64)
        cut = np.interp(r, self.rows, [p is not None for p in self.prisms])[:, None]
        source, across, up = _rays(cone_vec, rows, np.arange(wide) - before, cols)
        longer = np.sqrt(1.0 + up[:, :, None] ** 2 / (across**2).sum(axis=-1)[:, None])
        for i, image in enumerate(images):
            flat = [
                np.zeros(wide) if p is None else p.integrals(source[i], across[i])
                for p in self.prisms
            ]
            model = _between(r, self.rows, np.array(flat)) * longer[i]
            edge = min(EDGE, cols)
            first, last = image[:, on][:, :edge], image[:, on][:, -edge:]
            low = (first - model[:, on][:, :edge]).mean(axis=1, keepdims=True)
            high = (last - model[:, on][:, -edge:]).mean(axis=1, keepdims=True)
            # Where the prism is not what the panel saw, the difference fades out.
            fade = int(FADING * cols)
            image[:, :before] = model[:, :before] + low * cut * _fade(fade, before)[::-1]
            image[:, on.stop :] = model[:, on.stop :] + high * cut * _fade(fade, wide - on.stop)


def beyond(
    images: Iterable[Float32Array],
    cone_vec: ConeVec,
    shape: tuple[int, int],
    edges_that_count: tuple[bool, bool] = (True, True),
) -> Beyond | None:
    """The object beyond the panel, from some views of it; None where every row is whole.

    Args:
        images: (rows, cols) line integrals of views spread over the whole scan.
        cone_vec: of these views; upright panels.
        shape: (rows, cols).
        edges_that_count: whether nothing else says what lies beyond the first and the last column;
            beyond the near edge of a panel moved to one side the opposite views do.
    """
    rows, cols = shape
    edges = np.linspace(0, rows, min(BANDS, rows) + 1).round().astype(int)
    middles = 0.5 * (edges[:-1] + edges[1:] - 1.0)
    c = np.linspace(0, cols - 1, min(COLUMNS, cols)).round().astype(int)
    pairs = list(pairwise(edges.tolist()))
    seen = np.array([[image[a:b, c].mean(axis=0) for a, b in pairs] for image in images])
    source, rays, up = _rays(cone_vec, rows, c, cols, middles)
    seen /= np.sqrt(1.0 + up[:, :, None] ** 2 / (rays**2).sum(axis=-1)[:, None])
    bands = [_Band(source, rays, seen[:, k]) for k in range(len(pairs))]
    most = float(np.abs(seen).max())
    prisms: list[Prism | None] = [None] * len(bands)
    known, misfit = None, 0.0
    for k in np.argsort([-band.seen.sum() for band in bands]).tolist():
        if bands[k].cut_off(NOTICEABLE * most, edges_that_count):
            prisms[k] = known = bands[k].fitted(known)
            misfit = max(misfit, bands[k].misfit(known))
    return None if known is None else Beyond(middles, tuple(prisms), misfit)


@dataclass(frozen=True, eq=False)
class _Band:
    """What some views saw in a band of rows.

    Attributes:
        source: (n, 1, 2) [mm].
        rays: (n, k, 2) from the source to columns of the panel, in the plane [mm].
        seen: (n, k) line integrals in the plane, means over the band.
    """

    source: FloatArray
    rays: FloatArray
    seen: FloatArray

    def cut_off(self, noticeable: float, count: tuple[bool, bool]) -> bool:
        """Whether the object goes on beyond an edge in some neighbouring views; noise does not."""
        from scipy.ndimage import median_filter

        edges = median_filter(self.seen[:, [0, -1]], (min(NEIGHBOURS, len(self.seen)), 1))
        return bool((edges.max(axis=0) > noticeable)[list(count)].any())

    @property
    def top(self) -> float:
        """A large line integral."""
        return float(np.percentile(self.seen, 99.0))

    def misfit(self, prism: Prism) -> float:
        """Median deviation from a prism, relative to large line integrals."""
        wrong = np.abs(prism.integrals(self.source, self.rays) - self.seen)
        return float(np.median(wrong[self.seen > 0.1 * self.top]) / self.top)

    def fitted(self, near: Prism | None) -> Prism:
        """The prism that fits best; from `near` on, if a neighbour is known."""
        from scipy.optimize import least_squares

        ends = self.rays[:, [0, -1]]
        aside = self.source[..., 0] * ends[..., 1] - self.source[..., 1] * ends[..., 0]
        field = float(np.abs(aside / np.sqrt((ends**2).sum(axis=-1))).max())
        top = self.top
        limit = np.array([2.0, 2.0, 1.5, 1.5, np.inf, np.inf])

        def prism(round: bool, x: FloatArray) -> Prism:
            half = field * np.exp(x[2:4])
            centre, axes = (x[0] * field, x[1] * field), (float(half[0]), float(half[1]))
            return Prism(round, centre, axes, float(x[4]), float(np.exp(x[5])))

        def fit(round: bool, start: Sequence[float]) -> tuple[float, bool, FloatArray]:
            found = least_squares(
                lambda x: np.asarray(
                    prism(round, x).integrals(self.source, self.rays) - self.seen
                ).ravel(),
                np.clip(start, -limit, limit), loss="cauchy", f_scale=ROUGH * top, max_nfev=60,
                bounds=(-limit, limit),
            )  # fmt: skip
            return float(found.cost), round, np.asarray(found.x)

        if near is not None:
            half, place = np.log(np.array(near.half) / field), np.array(near.centre) / field
            start = [*place, *half, near.angle, np.log(near.attenuation)]
            return prism(near.round, fit(near.round, start)[2])
        found = [
            fit(True, [0, 0, np.log(r), np.log(r), 0.3, np.log(top / (2 * r * field))])
            for r in STARTS
        ]
        _, _, best = min(found, key=lambda f: f[0])
        for turn in TURNS:
            start = [*best[:2], *(best[2:4] - 0.12), best[4] + turn, best[5]]
            found.append(fit(False, start))
        _, round, best = min(found, key=lambda f: f[0])
        return prism(round, best)


def _rays(
    cone_vec: ConeVec,
    rows: int,
    columns: npt.NDArray[np.int_],
    cols: int,
    at_rows: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sources (n, 1, 2), rays to columns in the plane (n, k, 2), heights of rows (n, r) [mm]."""
    r = (np.arange(rows) if at_rows is None else at_rows) - (rows - 1) / 2.0
    c = columns - (cols - 1) / 2.0
    panel = cone_vec.detector - cone_vec.source
    across = panel[:, None, :2] + c[:, None] * cone_vec.u[:, None, :2]
    up = panel[:, 2, None] + r * cone_vec.v[:, 2, None]
    return cone_vec.source[:, None, :2], across, up


def _between(r: FloatArray, rows: FloatArray, values: FloatArray) -> FloatArray:
    """(k, m): `values` (b, m) at `rows` (b,), linearly in between."""
    at = np.interp(r, rows, np.arange(len(rows)))
    i = np.minimum(at.astype(int), max(len(rows) - 2, 0))
    part = (at - i)[:, None]
    return np.asarray(values[i] * (1 - part) + values[np.minimum(i + 1, len(rows) - 1)] * part)


def _fade(over: int, columns: int) -> FloatArray:
    """From 1 beside the panel to 0 after `over` columns, (columns,)."""
    part = (np.arange(columns) + 0.5) / max(over, 1)
    return np.asarray(0.5 + 0.5 * np.cos(np.pi * np.minimum(part, 1.0)))
