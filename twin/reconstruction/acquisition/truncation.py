"""Estimate of the object beyond the edges of a panel that is narrower than its shadow.

The ramp filter needs complete projections. If the object continues beyond the panel, an
elliptic prism is fitted to the images, for each band of rows, and rows are continued by
its path lengths. One shape for all views makes the continuations agree with each other.
Other materials in the object deviate from the prism and count less and less in a robust
fit, which follows the quarter of the rays that fits best. Where even that quarter
deviates by more than noise does, the outline is no ellipse, or too much else is in it:
rows then fade out smoothly beyond the panel, and `bias_bound` has what that may change.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.reconstruction.acquisition.rectify import (
    is_upright,
    on_its_side,
    rectified,
    swapped,
    upright,
)
from flexdt.twin.reconstruction.acquisition.trajectory import (
    circle_of,
    columns_beyond,
    distinct_angles,
    fan_angles,
    mean_image,
    reach,
)

SAMPLES = 48
"""Largest number of views, and of bins of columns, that the prism is fitted to: 2304
rays for six numbers, in milliseconds. The outermost bin is the edge."""
BANDS = 8
"""Number of bands of rows with their own prism: few enough to average noise, and an
outline changes little within an eighth of the panel."""
MAX_PRISM_RADII = 4.0
"""Largest half axis of a prism over the radius of the field of view: wider ones look
alike there. Rows are then continued by at most twice their length on either side."""
SIGNIFICANT_SIGMAS = 4.0
"""Standard deviations of noise beyond which a value at an edge counts as truncation:
of thousands of bands, views and edges none is beyond by chance."""
ACCURACY = 0.01
"""Relative error of densities that is taken for none. The best quarter of the rays may
deviate from the prism by half of it: what deviated by less was right within 1 %, and outlines
that were up to 4 % off (an octagon of twice the field of view) deviate by 0.6 % and more. A
tenth of it at the edges is nothing."""

EDGE_BINS = 2
"""Bins of columns at either edge that have one value where no object is."""
MAX_SPREAD = 0.02
MAX_SLOPE = 0.003
"""Largest standard deviation of a view's edges over the contrast of the object, and largest
step between these bins over their values: a cylinder of four times the panel has just that
slope."""


@dataclass(frozen=True, eq=False)
class Prism:
    """An upright elliptic prism that attenuates evenly.

    Attributes:
        centre: (x, y) of its axis (2,) [mm].
        to_disc: lower triangular, takes the ellipse about its center to the unit disc (2, 2)
            [1/mm].
        attenuation: [1/mm].
    """

    centre: FloatArray
    to_disc: FloatArray
    attenuation: float

    @classmethod
    def of(cls, x: FloatArray, field: float) -> Prism:
        """Make a prism from a fit's numbers (6,), in units of `field` [mm]."""
        to_disc = np.array([[np.exp(x[2]), 0.0], [x[4], np.exp(x[3])]]) / field
        return cls(x[:2] * field, to_disc, float(np.exp(x[5])))

    def integrals(self, source: FloatArray, rays: FloatArray) -> FloatArray:
        """Compute line integrals of the prism in the plane of rotation along whole lines;
        0 for rays that miss it.

        Args:
            source: (..., 2) [mm].
            rays: (..., 2) directions from the source [mm]; their length does not matter.

        Returns:
            (...), attenuation times the chord, without a unit.
        """
        start = (source - self.centre) @ self.to_disc.T
        along = rays @ self.to_disc.T
        squared = (along * along).sum(axis=-1)
        middle = (start * along).sum(axis=-1)
        inside = middle * middle - squared * ((start * start).sum(axis=-1) - 1.0)
        length = (
            2.0
            * np.sqrt(np.maximum(inside, 0.0))
            / squared
            * np.hypot(*np.moveaxis(rays, -1, 0))
        )
        return np.asarray(self.attenuation * length)

    @property
    def numbers(self) -> FloatArray:
        """Numbers for the kernels, (6,): center, elements (0, 0), (1, 0), (1, 1),
        attenuation."""
        (first, _), (low, second) = self.to_disc
        return np.array([*self.centre, first, low, second, self.attenuation])

    def rim(self) -> FloatArray:
        """Compute 72 points, evenly spaced in angle of the unit disc, on the prism's
        outline, (72, 2) [mm].
        """
        turn = np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)
        disc = np.stack([np.cos(turn), np.sin(turn)])
        return np.asarray(np.linalg.solve(self.to_disc, disc).T + self.centre)


@dataclass(frozen=True, eq=False)
class Truncation:
    """An object that the panel cuts off.

    Attributes:
        rows: (b,) middle row of each band.
        prisms: one a band; None where rows are complete, or fade out.
        cut_off: (b,) whether the band's rows are continued.
        others: the best prisms that do not explain the images, where no prism does.
        fade: length over which rows fade out that no prism explains, over that of a row.
        beyond: whether the part missed by a panel moved to one side has no prism.
    """

    rows: FloatArray
    prisms: tuple[Prism | None, ...]
    cut_off: npt.NDArray[np.bool_]
    others: tuple[Prism | None, ...] = ()
    fade: float = 0.5
    beyond: bool = False

    @property
    def nothing(self) -> Truncation:
        """The same panel for an object that it sees completely."""
        none = np.zeros(1, dtype=bool)
        return replace(self, rows=np.zeros(1), prisms=(None,), cut_off=none, others=())

    @property
    def explained(self) -> bool:
        """True if each band whose rows are continued has a prism; also if none is
        continued.
        """
        return all(
            p is not None for p, cut in zip(self.prisms, self.cut_off, strict=True) if cut
        )

    @property
    def otherwise(self) -> Truncation:
        """The same with rows continued in another way, to see how much depends on it.

        That is without prisms, if they explained all rows; else by the best that do not
        (`others`), the rest fading out over twice the length.
        """
        if self.explained:
            return replace(self, prisms=(None,) * len(self.prisms))
        pairs = zip(self.prisms, self.others or self.prisms, strict=True)
        return replace(self.later, prisms=tuple(prism or other for prism, other in pairs))

    @property
    def later(self) -> Truncation:
        """The same where edge values that no prism explains fade out later."""
        return replace(self, fade=2.0 * self.fade)

    def columns(self, cone_vec: ConeVec, cols: int) -> tuple[int, int]:
        """Count the columns before the first and after the last that the object's shadow
        reaches.

        Half a panel at least, for rows that fade out; 2 more than the prisms' widest shadow in
        any view.

        `cone_vec`: upright views; `cols`: columns of the panel.
        Returns (before, after), at most twice the panel's columns each.
        """
        most = 2.0 * cols
        before = 0.5 * cols
        after = 0.5 * cols
        if len(self._rims):
            at = _columns_of(self._rims, cone_vec) + (cols - 1) / 2.0
            at = np.where(np.isfinite(at), at, most)
            before = max(before, -float(at.min()))
            after = max(after, float(at.max()) - cols + 1)
        return int(min(before + 2.0, most)), int(min(after + 2.0, most))

    @cached_property
    def _rims(self) -> FloatArray:
        """Outlines of all prisms, (k, 2) [mm]."""
        rims = [prism.rim() for prism in self.prisms if prism is not None]
        return np.concatenate([np.zeros((0, 2)), *rims])

    def continuation(
        self, cone_vec: ConeVec, first_row: int, shape: tuple[int, int], panel: slice
    ) -> Continuation:
        """Compute how the rows of some views go on beyond the panel's edges.

        Rows between two bands mix both, rows beyond the outermost use that one; a band
        without a prism has zeros. The rest fades out as a cosine over `fade` times the
        panel's columns.

        Args:
            cone_vec: of widened images, (n).
            first_row: of the panel, which is the images' first.
            shape: of the images (rows, columns).
            panel: the columns that are the panel's.
        """
        rows, wide = shape
        at = first_row + np.arange(rows, dtype=np.float64)
        band = np.clip(np.searchsorted(self.rows, at, "right") - 1, 0, len(self.rows) - 1)
        above = np.minimum(band + 1, len(self.rows) - 1)
        apart = self.rows[above] - self.rows[band]
        share = np.where(
            apart > 0.0, (at - self.rows[band]) / np.where(apart > 0.0, apart, 1.0), 0
        )
        cols = panel.stop - panel.start
        column = np.arange(wide)
        away = np.maximum(panel.start - column, column - panel.stop + 1) - 0.5
        part = np.minimum(away / max(self.fade * cols, 1.0), 1.0)
        source, rays, _ = _rays(cone_vec, np.zeros(0), np.arange(2.0) - (wide - 1) / 2.0)
        none = np.zeros(6)
        return Continuation(
            edge=_edge(cols),
            plane=np.hstack([source[:, 0], rays[:, 0], rays[:, 1] - rays[:, 0]]),
            prisms=np.array([none if p is None else p.numbers for p in self.prisms]),
            band=band,
            share=np.clip(share, 0.0, 1.0),
            cut=np.interp(at, self.rows, self.cut_off.astype(np.float64)),
            fade=0.5 + 0.5 * np.cos(np.pi * part),
        )


@dataclass(frozen=True, eq=False)
class Continuation:
    """How the rows of some views go on beyond the panel's edges; see
    `truncation_kernels.continue_rows`.

    Attributes:
        edge: columns at an edge whose mean is continued.
        plane: (n, 6) source, ray to the first column and step between columns, x and y
            [mm].
        prisms: (b, 6) numbers of each band's prism; zeros without one.
        band, share: (rows,) lower band of each row, and how much the next one counts.
        cut: (rows,) share of the prisms' residual at the edges that is continued.
        fade: (columns,) part of it that is left in each column.
    """

    edge: int
    plane: FloatArray
    prisms: FloatArray
    band: npt.NDArray[np.intp]
    share: FloatArray
    cut: FloatArray
    fade: FloatArray

    def of(self, which: slice | npt.NDArray[np.intp]) -> Continuation:
        """Select some of the views."""
        return replace(self, plane=self.plane[which])

    def within(self, columns: slice) -> Continuation:
        """Select some of the columns."""
        source, ray, step = np.split(self.plane, 3, axis=1)
        plane = np.hstack([source, ray + columns.start * step, step])
        return replace(self, plane=plane, fade=self.fade[columns].copy())

    @classmethod
    def empty(cls, views: int, rows: int, wide: int) -> Continuation:
        """Make a continuation with nothing beyond the edges: parts and edge are 0."""
        none = np.zeros(rows)
        return cls(
            0,
            np.zeros((views, 6)),
            np.zeros((1, 6)),
            none.astype(np.intp),
            none,
            none,
            np.zeros(wide),
        )


def truncation_of(
    image: Callable[[int], npt.NDArray[np.generic]],
    cone_vec: ConeVec,
    shape: tuple[int, int],
) -> Truncation | None:
    """Estimate the object beyond the panel's edges from up to `SAMPLES` views of a scan.

    Repeated angles are averaged, images on their side swapped and tilted panels
    rectified. Only the far edge of a panel moved to one side counts in a full turn. In a
    short scan, a shifted panel may hide an object beyond its near edge: if no prism
    explains it, `beyond` is set and no rows are continued.

    Args:
        image: gives the line integrals of a view, (rows, cols), by its number.
        cone_vec: of all views.
        shape: (rows, cols).

    Returns:
        For `fdk_parts`; None if the panel saw the complete object or has one column.

    Raises:
        GeometryError: FDK cannot use the trajectory.
    """
    circle = circle_of(cone_vec)  # of all: fewer may seem to close a turn that is open
    places, same = distinct_angles(circle)
    views = len(places)
    chosen = np.unique(
        np.linspace(0, views - 1, min(views, SAMPLES)).round().astype(np.intp)
    )
    images = [mean_image(image, np.flatnonzero(same == i)) for i in chosen]
    cone_vec = cone_vec[places[chosen]]
    if on_its_side(cone_vec):
        images = [image.T for image in images]
        shape = (shape[1], shape[0])
        cone_vec = swapped(cone_vec)
    if is_upright(cone_vec):
        panels = cone_vec
    else:
        panels = upright(cone_vec)
    if panels is not cone_vec:
        images = [
            rectified(image[None], cone_vec[i : i + 1], panels[i : i + 1])[0]
            for i, image in enumerate(images)
        ]
    if shape[1] < 2:
        return None
    # Beyond the near edge of a panel moved to one side the opposite views have the data.
    before, after = columns_beyond(circle, panels, shape[1])
    edges = np.array([before <= 1, after <= 1]) | (not circle.full)
    found = _fit_truncation(images, panels, shape, edges, helix=bool(circle.rise))
    fan = fan_angles(circle, panels, shape[1])
    near, far = sorted(reach(fan))
    if circle.full or far - near < (far + near) / SAMPLES:
        return found
    if found is None and not _seen_beyond(images, np.abs(fan) > near):
        return None
    found = found or Truncation(np.zeros(1), (None,), np.zeros(1, dtype=bool))
    known = [p is not None for p in found.prisms] >= found.cut_off
    beyond = not (found.cut_off.any() and bool(np.all(known)))
    return replace(found, beyond=beyond, cut_off=found.cut_off & (not beyond))


def _seen_beyond(images: Sequence[Float32Array], there: npt.NDArray[np.bool_]) -> bool:
    """Check whether some view shows more than noise in its marked columns.

    Images are smoothed by blocks of an eighth of the rows and an edge's columns; the
    limit is twice `SIGNIFICANT_SIGMAS` of noise estimated from the same image, and half
    of `ACCURACY` of the largest value.

    Args:
        images: n views (rows, cols).
        there: (n, cols) the columns to check; a view without any is skipped.
    """
    from scipy.ndimage import uniform_filter

    rows, cols = images[0].shape
    smooth = [uniform_filter(image, (-(-rows // BANDS), _edge(cols))) for image in images]
    least = 0.5 * ACCURACY * max(float(np.abs(image).max()) for image in smooth)
    apart = 2 * _edge(cols) + 2
    for image, columns in zip(smooth, there, strict=True):
        noise = _noise(image[:, ::apart])
        if columns.any() and image[:, columns].max() > max(
            least, 2.0 * SIGNIFICANT_SIGMAS * noise
        ):
            return True
    return False


def _fit_truncation(
    images: Sequence[Float32Array],
    cone_vec: ConeVec,
    shape: tuple[int, int],
    edges_that_count: npt.NDArray[np.bool_],
    helix: bool,
) -> Truncation | None:
    """Fit the object beyond the edges of upright panels; see `truncation_of`.

    Bands of rows are fitted from the strongest to the weakest, each starting from the
    last prism found. Bands that are not cut off at an edge that counts, those of a helix,
    and those whose means vary by less than `ACCURACY`, get no prism; the best prism that
    does not explain a band is kept among the others.

    Args:
        images: line integrals of some views.
        cone_vec: of these views.
        shape: (rows, cols).
        edges_that_count: (2,) left and right, at which an object may be cut off.
        helix: the scan is a helix.

    Returns:
        None if both edges show an open beam, or no band of rows is cut off at an edge
        that counts.
    """
    rows, cols = shape
    limits = np.linspace(0, rows, min(BANDS, rows) + 1).round().astype(int)
    bins = np.linspace(0, cols, min(SAMPLES, cols) + 1).round().astype(int)
    middles, columns = (0.5 * (at[:-1] + at[1:] - 1.0) for at in (limits, bins))
    source, rays, up = _rays(
        cone_vec, middles - (rows - 1) / 2.0, columns - (cols - 1) / 2.0
    )
    seen = np.array(
        [
            np.add.reduceat(np.add.reduceat(im, limits[:-1], 0), bins[:-1], 1)
            for im in images
        ]
    )
    seen /= np.diff(limits)[:, None] * np.diff(bins)
    seen /= np.sqrt(1.0 + up[:, :, None] ** 2 / (rays**2).sum(axis=-1)[:, None])
    seen = seen.astype(np.float64)
    if _open_beam(seen):
        return None
    prisms: list[Prism | None] = [None] * len(middles)
    others: list[Prism | None] = [None] * len(middles)
    cut_off = np.zeros(len(middles), dtype=bool)
    known = None
    # Bands above and below the object hold nothing that could be off.
    least = 0.1 * ACCURACY * float(np.abs(seen).mean())
    met = seen[seen > max(0.1 * float(seen.mean()), least)]
    usual = float(np.median(met)) if met.size else 0.0  # of the rays that meet the object
    for k in np.argsort(-seen.sum(axis=(0, 2))).tolist():
        band = seen[:, k]
        cut_off[k] = (_cut_off(band, least, usual) & edges_that_count).any()
        if not cut_off[k]:
            continue
        even = (
            max(float(np.ptp(band.mean(axis=axis))) for axis in (0, 1)) < ACCURACY * usual
        )
        if not helix and not even:
            prisms[k], others[k] = _fit(source, rays, band, usual, known)
            known = prisms[k] or known
    if not cut_off.any():
        return None
    return Truncation(middles, tuple(prisms), cut_off, tuple(others))


def _open_beam(seen: FloatArray) -> bool:
    """Return whether both edges show an open beam that differs from the flat field.

    It has one value in each view, in all rows (`MAX_SPREAD` of the contrast) and without
    a slope (`MAX_SLOPE`); an object's outline slopes. False for fewer than 8 bins, or if
    the object does not attenuate more than the edges.

    Args:
        seen: (views, bands, bins) line integrals.
    """
    if seen.shape[2] < 4 * EDGE_BINS:
        return False
    edges = np.concatenate([seen[..., :EDGE_BINS], seen[..., -EDGE_BINS:]], axis=2)
    edges = edges.reshape(len(seen), -1)
    usual = float(np.median(edges))
    contrast = float(np.percentile(seen, 90.0)) - usual
    inwards = seen[..., 1] - seen[..., 0] + seen[..., -2] - seen[..., -1]
    level = abs(float(inwards.mean())) < 2.0 * MAX_SLOPE * abs(usual)
    return (
        level
        and contrast > 0.0
        and float(edges.std(axis=1).max()) < MAX_SPREAD * contrast
    )


def _noise(lines: npt.NDArray[np.floating]) -> float:
    """Estimate the standard deviation of noise in lines that are otherwise smooth, from the
    median second difference along the last axis.

    `lines`: (..., k). Returns 0 for fewer than 3 values."""
    bend = lines[..., 2:] - 2.0 * lines[..., 1:-1] + lines[..., :-2]
    # Of normal noise, a second difference's median is 1.65 standard deviations.
    if bend.size:
        return float(np.median(np.abs(bend))) / 1.65
    return 0.0


def _cut_off(band: FloatArray, least: float, usual: float) -> npt.NDArray[np.bool_]:
    """Find the edges beyond which the object continues, in some neighboring views or all.

    The middle one of three views counts, and the mean of all, in which less noise hides it.
    Noise is that of every other bin near an edge, as detectors blur it over some columns, or
    that from view to view. Few views give a poor estimate, so that the largest counts, of both
    edges between bins: a view must exceed `SIGNIFICANT_SIGMAS` of it. The mean must exceed as
    much of its own noise, and pi / 2 times `ACCURACY` of `usual`.
    `band`: (n, bins) line integrals of a band of rows; `least`: line integral below which an
    edge never counts in single views; `usual`: line integral that is typical of the object.
    Returns (2,) bool: left, right.
    """
    from scipy.ndimage import median_filter

    ends = band[:, [0, -1]]
    between_bins = max(_noise(band[:, :5:2]), _noise(band[:, :-6:-2]))
    between_views = np.array([_noise(end) for end in ends.T])
    noise = SIGNIFICANT_SIGMAS * np.maximum(between_bins, between_views)
    some = median_filter(ends, (min(3, len(band)), 1)) > np.maximum(least, noise)
    # In the mean the flat's drift and noise show, too, and the logarithm of noise: what counts
    # is what would change densities by the accuracy. Two edges add a pi-th of their sum, at
    # most.
    mean = band.mean(axis=0)
    apart = between_views / np.sqrt(len(ends))
    apart = SIGNIFICANT_SIGMAS * np.hypot(apart, _noise(mean))
    every = mean[[0, -1]] > np.maximum(0.5 * np.pi * ACCURACY * usual, apart)
    return np.asarray(some.any(axis=0) | every)


def _fit(
    source: FloatArray,
    rays: FloatArray,
    seen: FloatArray,
    usual: float,
    near: Prism | None,
) -> tuple[Prism | None, Prism | None]:
    """Fit the prism that explains the values, or else the best one.

    Starts from the neighbor, or from circles of 1.1, 1.5 and 2.2 radii of the field of
    view; narrows the loss until the best quarter of rays decides. A prism explains the
    values if that quarter deviates by at most half of `ACCURACY`, besides noise. If the
    neighbour's start fails, the circles are tried.

    Args:
        source: (n, 1, 2) [mm].
        rays: (n, k, 2) from the source to columns of the panel, in the plane [mm].
        seen: (n, k) line integrals in the plane.
        usual: usual line integral of the object.
        near: prism of a neighboring band, or None.

    Returns:
        (prism, None) if it explains the values; (None, best one) if not; (None, None) if
        no ray meets the object.
    """
    from flexdt.twin.reconstruction.kernels.truncation_kernels import fit_prism

    hit = seen > 0.1 * ACCURACY * usual  # of dead columns a prism elsewhere is right
    if not hit.any():
        return None, None
    ends = rays[:, [0, -1]]
    aside = source[..., 0] * ends[..., 1] - source[..., 1] * ends[..., 0]
    field = float(np.abs(aside / np.sqrt((ends**2).sum(axis=-1))).max())
    limit = np.array(
        [
            MAX_PRISM_RADII / 2,
            MAX_PRISM_RADII / 2,
            np.log(MAX_PRISM_RADII),
            np.log(MAX_PRISM_RADII),
            MAX_PRISM_RADII / 2,
            3 * np.log(MAX_PRISM_RADII),
        ]
    )
    middle = np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.log(usual / field)])
    least = middle - limit
    most = middle + limit

    def rest(x: FloatArray) -> FloatArray:
        return np.asarray(Prism.of(x, field).integrals(source, rays) - seen)

    directions = rays / field
    lengths = np.hypot(rays[..., 0], rays[..., 1])
    begin = np.ascontiguousarray(source[:, 0] / field)

    def fit(start: npt.ArrayLike, scale: float) -> tuple[float, FloatArray]:
        """Fit a prism from a start; return its cost and its parameters."""
        x = np.array(start, np.float64)
        cost = fit_prism(begin, directions, lengths, seen, least, most, scale, x)
        return cost, x

    starts = [
        [0.0, 0.0, -np.log(r), -np.log(r), 0.0, np.log(usual / (1.5 * r * field))]
        for r in (1.1, 1.5, 2.2)
    ]
    if near is not None:
        size = np.log(field * np.diag(near.to_disc))
        starts = [
            [
                *near.centre / field,
                *size,
                field * near.to_disc[1, 0],
                np.log(near.attenuation),
            ]
        ]
    scale = 5.0 * ACCURACY * usual
    _, x = min((fit(start, scale) for start in starts), key=lambda one: one[0])
    # Narrower and narrower: what deviates by more than the best quarter does then hardly
    # counts.
    while (best := float(np.percentile(np.abs(rest(x)[hit]), 25.0))) < 0.8 * scale:
        scale = max(best, 0.1 * ACCURACY * usual)
        _, x = fit(x, scale)
        if scale > best:
            break
    by_noise = 0.319 * _noise(
        rest(x)
    )  # a quarter of normal noise is below so many deviations
    # Both are estimates; the ratio of their squares varies by 4.9 over the root of their
    # number.
    by_noise *= np.sqrt(1.0 + 0.5 * SIGNIFICANT_SIGMAS * 4.9 / np.sqrt(seen.size))
    if np.sqrt(max(best**2 - by_noise**2, 0.0)) <= 0.5 * ACCURACY * usual:
        return Prism.of(x, field), None
    if near is not None:
        return _fit(source, rays, seen, usual, None)
    return None, Prism.of(x, field)


def _edge(cols: int) -> int:
    return max(1, cols // SAMPLES)


def _columns_of(points: FloatArray, cone_vec: ConeVec) -> FloatArray:
    """Project points onto the rows of upright panels, whatever their height.

    Args:
        points: (k, 2) [mm].
        cone_vec: n upright panels.

    Returns:
        (n, k) columns from the panel's middle; not finite for points beside the source.
    """
    source = cone_vec.source[:, :2]
    panel = cone_vec.detector[:, :2] - source
    u = cone_vec.u[:, :2]
    normal = np.column_stack([-u[:, 1], u[:, 0]])
    depth, aside, panel_depth, panel_aside = (
        one[:, None]
        for one in (
            (source * normal).sum(axis=1),
            (source * u).sum(axis=1),
            (panel * normal).sum(axis=1),
            (panel * u).sum(axis=1),
        )
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = panel_depth / (normal @ points.T - depth)
        along = scale * (u @ points.T - aside) - panel_aside
    return np.asarray(along / (u * u).sum(axis=1)[:, None])


def _rays(
    cone_vec: ConeVec, rows: FloatArray, columns: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Compute rays of rows (r,) and columns (k,), counted from the middle, of upright
    panels.

    Returns sources (n, 1, 2), rays in the plane (n, k, 2), heights above the source (n,
    r) [mm].
    """
    panel = cone_vec.detector - cone_vec.source
    across = panel[:, None, :2] + columns[:, None] * cone_vec.u[:, None, :2]
    up = panel[:, 2, None] + rows * cone_vec.v[:, 2, None]
    return cone_vec.source[:, None, :2], across, up
