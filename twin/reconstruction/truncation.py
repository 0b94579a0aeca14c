"""What lies beyond the edges of a panel that is narrower than the object's shadow.

The ramp filter needs whole projections. Where the object goes on beyond the panel, a prism over
an ellipse or a rectangle, or between three planes where neither is like it, is fitted to what all
views saw of it, row band by row band, and rows are continued by its path lengths. One shape for all
views is what makes the continuations agree with each other: a row on its own says little of how far
its object reaches. Other things in the object are deviations that count less and less (a Cauchy
loss). Where most rays meet some, they are found together with the prism: as few as explain the
views, on a coarse grid over the field of view (`Things`). An outline that no shape resembles is
continued badly, and `Truncation.doubt` says so.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.reconstruction.rectify import is_upright, on_its_side, rectified, swapped, upright
from flexdt.twin.reconstruction.things_inside import Things
from flexdt.twin.reconstruction.trajectory import circle_of, columns_beyond, fan_angles, reach

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
SIGNIFICANT = 4.0
"""Standard deviations of noise beyond which a value at an edge counts as truncation."""
EDGE = 5
"""Columns that are called an edge, at most: their mean is the value there."""
NARROW = 1 / 32
"""Part of a row that is called an edge, at most."""
APART = 3
"""Columns between which a detector's noise is independent."""
FADING = 0.5
"""Length of a row over which what no prism explains fades out, beyond an edge."""
FARTHEST = 4.0
"""Times the way from source to panel: there rays end between planes that do not close."""
LOPSIDED = 0.95
"""Reach of a panel's near side over that of its far one, below which it is moved to one side."""
WIDEST = 2.0
"""Rows are continued by at most so many times their length on either side."""
STARTS = (1.1, 1.5, 2.2)
"""Radii that the fit starts from, relative to the field of view's."""
TURNS = (0.0, 0.4, 0.8, 1.2)
"""Angles against the best ellipse that the fit of a rectangle starts from [rad]."""
NEARBY = (
    (0.0, 0.0, 0.0), (0.2, 0.0, -0.1), (0.0, 0.2, -0.1), (0.0, 0.0, -0.1), (0.0, 0.0, -0.2),
    (0.0, 0.0, 0.1),
)  # fmt: skip
"""Logarithms of what half axes and attenuation are multiplied by where the last fit starts."""
FEW = 15.0
"""Per cent of the rays that at least meet nothing denser, or less dense, than the outline's own
material."""
UNDERSTOOD = 0.001
"""Misfit up to which an outline alone explains the views: what fits less well is looked at together
with other things in the object, as many outlines are nearly like one of three planes."""
DOUBTFUL = 0.03
"""Misfit above which an outline alone, without other things in the object, is not it."""
EVEN_THERE = 6.0
"""The lower quartile of the deviations counts as so many times itself: other things in the object
hide an outline from half of the rays, but not from three quarters of them."""
ROUGH = 0.01
"""Deviations from an ellipse, relative to large line integrals, beyond which they are taken for
other things in the object and count less and less."""
FINE = 0.003
"""The same in the last fit, which begins near: other things in the object then pull much less."""
TOGETHER = 12
"""Times that things and outline are found in turn, at most."""
SETTLED = 1e-3
"""Change of an outline's numbers at which that ends."""
MOSTLY = 0.5
"""Part of the field of view that may be other things before the outline's material is doubtful."""
NOTICED = 0.1
"""Attenuation of a thing, relative to the outline's, from which it counts in that."""
STRAINED = 3e-4
"""What it costs (`_Band.among`), for each ray and relative to large line integrals squared, before
the outline is doubtful: where no outline is right, many things are needed to mend it."""
EVEN = 0.01
"""Change of line integrals across a panel and from view to view, relative to large ones, below
which there is no outline: that of the largest cylinder that `LIMIT` allows is 0.025."""
LIMIT = np.array([2.0, 2.0, 1.5, 1.5, np.inf, np.inf])
"""Largest numbers of a prism in a fit, and, negative, their least; see `_prism`."""
HUGE = 50.0
"""Logarithm of an attenuation, or of its inverse, that no fit takes: what goes beyond counts as
this."""


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
            unit = np.sign(unit)
        c, s = np.cos(self.angle), np.sin(self.angle)
        return np.asarray(unit * self.half @ np.array([[c, s], [-s, c]]) + np.array(self.centre))


@dataclass(frozen=True, eq=False)
class ThreeSided:
    """An upright prism that attenuates evenly, between three planes.

    Attributes:
        turns: directions of the planes' outward normals, counter-clockwise from x (3,) [rad].
        distances: of the planes from the axis, along these (3,) [mm].
        attenuation: [1/mm].
    """

    turns: FloatArray
    distances: FloatArray
    attenuation: float

    def integrals(self, source: FloatArray, rays: FloatArray) -> FloatArray:
        """As `Prism.integrals`; a ray begins at its source."""
        normals = np.stack([np.cos(self.turns), np.sin(self.turns)])
        start, along = self.distances - source @ normals, rays @ normals
        steep = np.where(np.abs(along) < 1e-12, 1e-12, along)
        crossed = start / steep
        farther = np.where(steep > 0.0, crossed, np.inf).min(axis=-1)
        nearer = np.where(steep < 0.0, crossed, 0.0).max(axis=-1)
        part = np.clip(farther - nearer, 0.0, FARTHEST)
        return np.asarray(self.attenuation * part * np.sqrt((rays * rays).sum(axis=-1)))

    def corners(self) -> FloatArray:
        """(3, 2) corners [mm], far away where two planes hardly meet."""
        c, s = np.cos(self.turns), np.sin(self.turns)
        d, after = self.distances, [1, 2, 0]
        cross = c * s[after] - s * c[after]
        cross = np.where(np.abs(cross) < 1e-3, 1e-3, cross)
        x = (d * s[after] - s * d[after]) / cross
        y = (c * d[after] - d * c[after]) / cross
        return np.stack([x, y], axis=1)


Outline = Prism | ThreeSided


@dataclass(frozen=True, eq=False)
class Truncation:
    """An object that the panel cuts off: a prism for each band of rows.

    Attributes:
        rows: (b,) middle row of each band.
        prisms: one a band; None where the band's rows are whole.
        misfit: of the worst band, relative to what is tolerated; infinite where none is fitted,
            which is so for a helix and for images without an edge.
        one_sided: whether the object reaches beyond the near edge of a panel moved to one side,
            in less than a turn: opposite views do not say all of what is there.
        edgeless: whether none is fitted because nothing like an edge was seen.
    """

    rows: FloatArray
    prisms: tuple[Outline | None, ...]
    misfit: float = 0.0
    one_sided: bool = False
    edgeless: bool = False

    @property
    def beyond(self) -> bool:
        """Whether no prism stands for what a panel moved to one side misses."""
        return self.one_sided and (self.misfit > 1.0 or not any(self.prisms))

    @property
    def doubt(self) -> str | None:
        """What to tell the user where the outline is unlike the prism's; else None."""
        if self.misfit <= 1.0 and not self.one_sided:
            return None
        wide = "the object is wider than the panel"
        why = "its outline is unlike an ellipse, a rectangle or a triangle"
        if np.isinf(self.misfit):
            why = "a helix does not tell how far it goes on"
        if self.edgeless:
            why = "images without an edge do not tell how far it goes on"
        if self.one_sided:
            wide = "the object reaches beyond the near edge of a panel moved to one side"
            why = "less than a turn does not tell all of what is there"
        return f"{wide}, and {why}: densities may be off by tens of per cent"

    def columns(self, cone_vec: ConeVec, cols: int) -> tuple[int, int]:
        """Columns before the first and after the last into which the object's shadow reaches."""
        before = after = FADING * cols
        middle_row = ConeVec(cone_vec.rows)  # without the shape of the panel
        for prism in (one for one in self.prisms if one is not None):
            rim = prism.corners()
            points = np.column_stack([rim, np.zeros(len(rim))])
            at = middle_row.project_points(points, (1, cols))[..., 0]
            at = np.where(np.isfinite(at), at, WIDEST * cols)
            before, after = max(before, -float(at.min())), max(after, float(at.max()) - cols + 1)
        most = WIDEST * cols
        return int(min(before + 2.0, most)), int(min(after + 2.0, most))

    def continue_rows(
        self, images: Float32Array, cone_vec: ConeVec, first_row: int, panel: slice
    ) -> None:
        """Continue rows beyond the panel's edges, in place.

        Args:
            images: (n, rows, columns) line integrals; those off the panel are set.
            cone_vec: of these rows and columns, (n).
            first_row: of the panel, which is the images' first.
            panel: the columns that are the panel's.
        """
        rows, wide = images.shape[1:]
        cols = panel.stop - panel.start
        # How much each band counts in each row, linearly in between.
        share = np.column_stack(
            [
                np.interp(first_row + np.arange(rows), self.rows, one)
                for one in np.eye(len(self.rows))
            ]
        )
        cut_off = share @ np.array([[p is not None] for p in self.prisms], dtype=np.float64)
        source, across, up = _rays(cone_vec, _centred(rows), _centred(wide))
        longer = np.sqrt(1.0 + up[:, :, None] ** 2 / (across**2).sum(axis=-1)[:, None])
        edge, fade = _edge(cols), int(FADING * cols)
        left, right = slice(panel.start, panel.start + edge), slice(panel.stop - edge, panel.stop)
        for i, image in enumerate(images):
            flat = [
                np.zeros(wide) if p is None else p.integrals(source[i], across[i])
                for p in self.prisms
            ]
            model = share @ np.array(flat) * longer[i]
            # Where the prism is not what the panel saw, the difference fades out.
            low = (image[:, left] - model[:, left]).mean(axis=1, keepdims=True) * cut_off
            high = (image[:, right] - model[:, right]).mean(axis=1, keepdims=True) * cut_off
            image[:, : panel.start] = model[:, : panel.start] + low * _fade(fade, panel.start)[::-1]
            image[:, panel.stop :] = model[:, panel.stop :] + high * _fade(fade, wide - panel.stop)


def truncation_of(
    image: Callable[[int], npt.NDArray[np.generic]], cone_vec: ConeVec, shape: tuple[int, int]
) -> Truncation | None:
    """What of the object lies beyond the panel's edges, judged by some views of a scan.

    Args:
        image: gives the line integrals of a view, (rows, cols), by its number.
        cone_vec: of all views.
        shape: (rows, cols).

    Returns:
        For `fdk_parts`; None where the panel saw the whole object.
    """
    views = len(cone_vec)
    circle = circle_of(cone_vec)  # of all: fewer may seem to close a turn that is open
    chosen = np.unique(np.linspace(0, views - 1, min(views, SAMPLES)).round().astype(np.intp))
    images = [np.asarray(image(i), dtype=np.float32) for i in chosen.tolist()]
    cone_vec = cone_vec[chosen]
    if on_its_side(cone_vec):
        images, shape = [image.T for image in images], (shape[1], shape[0])
        cone_vec = swapped(cone_vec)
    panels = cone_vec if is_upright(cone_vec) else upright(cone_vec)
    if panels is not cone_vec:
        images = [
            rectified(image[None], cone_vec[i : i + 1], panels[i : i + 1])[0]
            for i, image in enumerate(images)
        ]
    # Beyond the near edge of a panel moved to one side the opposite views say what is there.
    if shape[1] < 2:
        return None
    before, after = columns_beyond(circle, panels, shape[1])
    # A helix sees other layers in the same rows at each turn, which no prism stands for.
    edges = np.array([before <= 1, after <= 1]) | (not circle.full)
    found = _fitted(images, panels, shape, edges, not circle.rise)
    fan = fan_angles(circle, panels, shape[1])
    near, far = sorted(reach(fan))
    if circle.full or near > LOPSIDED * far:
        return found
    if found is None and not _seen_beyond(images, np.abs(fan) > near):
        return None
    return replace(found or Truncation(np.zeros(1), (None,)), one_sided=True)


def _seen_beyond(images: Sequence[Float32Array], there: npt.NDArray[np.bool_]) -> bool:
    """Whether something that is no noise is seen in some columns of each view (n, cols)."""
    from scipy.ndimage import uniform_filter

    rows, cols = images[0].shape
    smooth = [uniform_filter(image, (-(-rows // BANDS), _edge(cols))) for image in images]
    least = NOTICEABLE * max(float(np.abs(image).max()) for image in smooth)
    apart = _edge(cols) + APART
    for image, columns in zip(smooth, there, strict=True):
        bend = image[:, 2 * apart :] - 2.0 * image[:, apart:-apart] + image[:, : -2 * apart]
        noise = float(np.median(np.abs(bend))) / 1.65 if bend.size else 0.0
        if columns.any() and image[:, columns].max() > max(least, 2.0 * SIGNIFICANT * noise):
            return True
    return False


def _fitted(
    images: Sequence[Float32Array],
    cone_vec: ConeVec,
    shape: tuple[int, int],
    edges_that_count: npt.NDArray[np.bool_],
    fit: bool,
) -> Truncation | None:
    """As `truncation_of`, of upright panels."""
    rows, cols = shape
    limits = np.linspace(0, rows, min(BANDS, rows) + 1).round().astype(int)
    pairs = list(pairwise(limits.tolist()))
    middles = 0.5 * (limits[:-1] + limits[1:] - 1.0)
    c = np.linspace(0, cols - 1, min(COLUMNS, cols)).round().astype(int)
    source, rays, up = _rays(cone_vec, _centred(rows)[0] + middles, _centred(cols)[c])
    flatter = 1.0 / np.sqrt(1.0 + up[:, :, None] ** 2 / (rays**2).sum(axis=-1)[:, None])
    bands = [
        _Band(
            source, rays, np.array([im[a:b, c].mean(axis=0) for im in images]) * flatter[:, k],
            np.array([_at_edges(im[a:b]) for im in images]),
        )
        for k, (a, b) in enumerate(pairs)
    ]  # fmt: skip
    most = max(float(np.abs(band.seen).max()) for band in bands)
    prisms: list[Outline | None] = [None] * len(bands)
    known: Outline | None = None
    misfit, edgeless = 0.0, False
    things = cache(lambda: Things.of(source, rays, bands[0].field))
    for k in np.argsort([-band.seen.sum() for band in bands]).tolist():
        if (bands[k].cut_off(NOTICEABLE * most) & edges_that_count).any():
            edgeless = edgeless or (fit and bands[k].even)
            if not fit or bands[k].even:
                misfit = np.inf
                continue
            prisms[k], off = bands[k].fitted(known, things)
            known, misfit = prisms[k], max(misfit, off)
    cut_off = known is not None or misfit > 0.0
    return Truncation(middles, tuple(prisms), misfit, edgeless=edgeless) if cut_off else None


def _at_edges(band: Float32Array) -> tuple[tuple[float, float], tuple[float, float]]:
    """Means beside the first and the last edge of a band of rows, and how much they bend there.

    A bend is the second difference of means that are apart; noise makes it, and the object hardly.
    """
    edge = _edge(band.shape[1])
    apart = max(edge, APART) if band.shape[1] >= 2 * max(edge, APART) + edge else 0
    at_first, at_last = (
        [float(side[:, k * apart : k * apart + edge].mean()) for k in range(3)]
        for side in (band, band[:, ::-1])
    )
    first, last = (abs(v[0] - 2.0 * v[1] + v[2]) for v in (at_first, at_last))
    return (at_first[0], at_last[0]), (first, last)


def _edge(cols: int) -> int:
    """Columns whose mean is the value at an edge."""
    return min(EDGE, max(1, int(cols * NARROW)))


@dataclass(frozen=True, eq=False)
class _Band:
    """What some views saw in a band of rows.

    Attributes:
        source: (n, 1, 2) [mm].
        rays: (n, k, 2) from the source to columns of the panel, in the plane [mm].
        seen: (n, k) line integrals in the plane, means over the band.
        edges: (n, 2, 2) value or bend (`_at_edges`), at the first and the last edge.
    """

    source: FloatArray
    rays: FloatArray
    seen: FloatArray
    edges: FloatArray

    def cut_off(self, noticeable: float) -> npt.NDArray[np.bool_]:
        """Whether the object goes on beyond the edges (2,) in some neighbouring views."""
        from scipy.ndimage import median_filter

        value = median_filter(self.edges[:, 0], (min(NEIGHBOURS, len(self.edges)), 1))
        # Of normal noise, a second difference's median is 1.65 standard deviations.
        deviation = np.median(self.edges[:, 1], axis=0) / 1.65
        return np.asarray((value > np.maximum(noticeable, SIGNIFICANT * deviation)).any(axis=0))

    @property
    def top(self) -> float:
        """A large line integral."""
        return float(np.percentile(self.seen, 99.0))

    @property
    def even(self) -> bool:
        """Whether columns and views differ less than those of any prism: black images, say."""
        changes = [float(np.ptp(self.seen.mean(axis=axis))) for axis in (0, 1)]
        return max(changes) < EVEN * self.top

    def excess(self, prism: Outline) -> FloatArray:
        """Logarithms (2,) of what was seen over the prism's integrals where that is little, and
        where it is much."""
        large = self.seen > 0.3 * self.top
        expected = prism.integrals(self.source, self.rays)[large]
        ratio = self.seen[large] / np.maximum(expected, 1e-3 * self.top)
        return np.log(np.clip(np.percentile(ratio, [FEW, 100.0 - FEW]), 0.5, 2.0))

    def misfit(self, prism: Outline) -> float:
        """Median deviation of what was seen from a prism, or `EVEN_THERE` times the lower quartile,
        relative to large line integrals."""
        wrong = np.abs(prism.integrals(self.source, self.rays) - self.seen)
        few, half = np.percentile(wrong[self.seen > 0.1 * self.top], [25.0, 50.0])
        return float(max(EVEN_THERE * few, half) / self.top)

    @property
    def field(self) -> float:
        """Radius of the field of view [mm]."""
        ends = self.rays[:, [0, -1]]
        aside = self.source[..., 0] * ends[..., 1] - self.source[..., 1] * ends[..., 0]
        return float(np.abs(aside / np.sqrt((ends**2).sum(axis=-1))).max())

    def fitted(self, near: Outline | None, things: Callable[[], Things]) -> tuple[Outline, float]:
        """The prism that fits best, from `near` on if a neighbour is known, and its misfit
        (see `Truncation`)."""
        if isinstance(near, ThreeSided):
            found = [self.three_sided([near])]
        else:
            found = self.round_or_square(near)
            if near is None and self.misfit(found[0]) > DOUBTFUL:
                other = self.three_sided(self.triangles())
                found.insert(0 if self.misfit(other) < 0.5 * self.misfit(found[0]) else 2, other)
        alone = self.misfit(found[0]) / DOUBTFUL
        if alone <= UNDERSTOOD / DOUBTFUL:
            return found[0], alone
        rays, pixels = things().lengths.shape
        if rays > 2 * pixels:
            among = [self.among(things(), outline) for outline in found]
            _, outline, misfit = min(among, key=lambda one: one[0])
            if misfit <= 1.0:
                return outline, misfit
            return found[0], max(alone, misfit)
        return found[0], alone

    def triangles(self) -> list[ThreeSided]:
        """Where the fit of a triangle starts."""
        return [
            ThreeSided(
                turn + np.array([0.0, 2.1, 4.2]), np.full(3, r * self.field),
                self.top / (2.0 * r * self.field),
            )
            for turn in (0.0, 0.5, 1.0, 1.5)
            for r in (0.7, 1.2)
        ]  # fmt: skip

    def among(self, things: Things, near: Outline) -> tuple[float, Outline, float]:
        """What it costs to explain the views by an outline and other things, from `near` on; the
        outline; and its misfit.

        Both are found in turn. The things are found for an outline that may still change, to first
        order, so that few turns are enough.
        """
        outline, numbers = _by_numbers(near, self.field)
        seen, x = self.seen.ravel(), numbers
        bounds = {"bounds": (-LIMIT, LIMIT)} if isinstance(near, Prism) else {}
        x = np.clip(x, -LIMIT, LIMIT) if bounds else x
        weight, there = things.weight(seen), np.zeros(things.lengths.shape[1])

        def integrals(x: FloatArray) -> FloatArray:
            return outline(x).integrals(self.source, self.rays).ravel()

        for _ in range(TOGETHER):
            now = integrals(x)
            slopes = np.stack([(integrals(x + d) - now) / 1e-4 for d in 1e-4 * np.eye(len(x))], 1)
            there = things.found(seen - now, slopes, weight, there)
            rest = replace(self, seen=self.seen - (things.lengths @ there).reshape(self.seen.shape))
            before, (_, x) = x, rest.fit(outline, x, 8, FINE, **bounds)
            if np.abs(x - before).max() < SETTLED:
                break
        left = seen - integrals(x) - things.lengths @ there
        cost = float(0.5 * (left @ left) + weight * np.abs(there).sum())
        filled = float((np.abs(there) > NOTICED * outline(x).attenuation).mean())
        strain = cost / (self.top**2 * seen.size)
        return cost, outline(x), max(filled / MOSTLY, strain / STRAINED)

    def fit(
        self,
        outline: Callable[[FloatArray], Outline],
        start: npt.ArrayLike,
        steps: int,
        rough: float = ROUGH,
        **more: Any,
    ) -> tuple[float, FloatArray]:
        """Cost and arguments of the `outline` that fits best; what deviates much counts less."""
        from scipy.optimize import least_squares

        found = least_squares(
            lambda x: (outline(x).integrals(self.source, self.rays) - self.seen).ravel(),
            start, loss="cauchy", f_scale=rough * self.top, max_nfev=steps, **more,
        )  # fmt: skip
        return float(found.cost), np.asarray(found.x)

    def three_sided(self, starts: Sequence[ThreeSided]) -> Outline:
        """The best of the fits from some starts: all in short, then the best one to its end."""
        prism, _ = _by_numbers(starts[0], self.field)
        begun = [_by_numbers(start, self.field)[1] for start in starts]
        short = [self.fit(prism, x, 12) for x in begun] if len(begun) > 1 else [(0.0, begun[0])]
        best = sorted(short, key=lambda f: f[0])[:2]
        return prism(min((self.fit(prism, x, 60) for _, x in best), key=lambda f: f[0])[1])

    def round_or_square(self, near: Prism | None) -> list[Outline]:
        """The ellipse and the rectangle that fit best, the better one first; only one of them
        from `near` on."""
        field, top = self.field, self.top

        def fit(
            round: bool, start: npt.ArrayLike, rough: float = ROUGH
        ) -> tuple[float, bool, FloatArray]:
            begin = np.clip(start, -LIMIT, LIMIT)
            shape = partial(_prism, round, field)
            cost, x = self.fit(shape, begin, 60, rough, bounds=(-LIMIT, LIMIT))
            return cost, round, x

        if near is not None:
            _, round, best = fit(near.round, _by_numbers(near, field)[1])
            return [_prism(round, field, fit(round, best, FINE)[2])]
        found = [
            fit(True, [0, 0, np.log(r), np.log(r), 0.3, np.log(top / (2 * r * field))])
            for r in STARTS
        ]
        _, _, best = min(found, key=lambda f: f[0])
        for turn in TURNS:
            start = [*best[:2], *(best[2:4] - 0.12), best[4] + turn, best[5]]
            found.append(fit(False, start))
        found.sort(key=lambda f: f[0])
        _, round, best = found[0]
        _, other, second = next(one for one in found if one[1] != round)
        # Dense things in an object may have made it denser, and shorter to make up for that.
        excess = self.excess(_prism(round, field, best))
        nearby = [*NEARBY, *((0.0, 0.0, more) for more in excess)]
        steps = [np.array([0.0, 0.0, a, b, 0.0, c]) for a, b, c in nearby]
        found = [fit(round, best + step, FINE) for step in steps]
        _, round, best = min(found, key=lambda f: f[0])
        return [_prism(round, field, best), _prism(other, field, second)]


def _prism(round: bool, field: float, x: FloatArray) -> Outline:
    """A prism of numbers (6,): centre and logarithms of half axes, in units of the field of view's
    radius, angle, logarithm of the attenuation."""
    half = field * np.exp(x[2:4])
    centre, axes = (x[0] * field, x[1] * field), (float(half[0]), float(half[1]))
    return Prism(round, centre, axes, float(x[4]), _attenuation(x[5]))


def _three_sided(field: float, x: FloatArray) -> Outline:
    """As `_prism`, of turns, distances, and logarithm of the attenuation (7,)."""
    return ThreeSided(x[:3], field * x[3:6], _attenuation(x[6]))


def _by_numbers(one: Outline, field: float) -> tuple[Callable[[FloatArray], Outline], FloatArray]:
    """How outlines like this one are made of numbers, and its own."""
    if isinstance(one, ThreeSided):
        turned = [*one.turns, *(one.distances / field), np.log(one.attenuation)]
        return partial(_three_sided, field), np.array(turned)
    half, place = np.log(np.array(one.half) / field), np.array(one.centre) / field
    numbers = np.array([*place, *half, one.angle, np.log(one.attenuation)])
    return partial(_prism, one.round, field), numbers


def _attenuation(logarithm: float) -> float:
    return float(np.exp(np.clip(logarithm, -HUGE, HUGE)))


def _centred(count: int) -> FloatArray:
    """Numbers of pixels, counted from the middle of a panel."""
    return np.arange(count, dtype=np.float64) - (count - 1) / 2.0


def _rays(
    cone_vec: ConeVec, rows: FloatArray, columns: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sources (n, 1, 2), rays to columns in the plane (n, k, 2), heights of rows (n, r) [mm].

    Args:
        cone_vec: (n) upright panels.
        rows, columns: (r,), (k,) counted from the panel's middle.
    """
    panel = cone_vec.detector - cone_vec.source
    across = panel[:, None, :2] + columns[:, None] * cone_vec.u[:, None, :2]
    up = panel[:, 2, None] + rows * cone_vec.v[:, 2, None]
    return cone_vec.source[:, None, :2], across, up


def _fade(over: int, columns: int) -> FloatArray:
    """From 1 beside the panel to 0 after `over` columns, (columns,)."""
    part = (np.arange(columns) + 0.5) / max(over, 1)
    return np.asarray(0.5 + 0.5 * np.cos(np.pi * np.minimum(part, 1.0)))
