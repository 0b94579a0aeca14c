"""A coarse copy of a scan, and a ladder of scans that leads to it from one without a flaw."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.dataset.normalise import binned_mean
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection import Volume, forward
from flexdt.twin.projection.volume import WARNING_BOUND
from flexdt.twin.reconstruction.acquisition.rectify import (
    field_of_view,
    on_its_side,
    swapped,
    upright,
    window,
)
from flexdt.twin.reconstruction.acquisition.trajectory import (
    Circle,
    circle_of,
    distinct_angles,
    panel_reach,
)
from flexdt.twin.reconstruction.acquisition.truncation import ACCURACY, Truncation
from flexdt.twin.reconstruction.feldkamp.backprojection import OnProcessor
from flexdt.twin.reconstruction.feldkamp.fdk import fdk_parts
from flexdt.twin.reconstruction.feldkamp.fdk_plan import plan_fdk
from flexdt.twin.reconstruction.white_noise import noise_of

NODES: Final = 40
"""Largest number of columns, rows and voxels along the longest side: bias changes
smoothly."""
FINE_NODES: Final = 80
"""The same of the copy on which explanations are tried that the first leaves undecided."""
MIN_AXIS_COLUMNS: Final = 4.0
"""Least columns on either side of the axis, if the panel has so many: a narrow overlap
stays one."""
VIEWS: Final = 180
"""Largest number of views: enough for the nodes and a panel moved aside."""
COMPARED_VIEWS: Final = 2.0
"""Views per column, about, of a scan whose images are compared with its volume."""
COMPARED_ROWS: Final = 16
"""Least rows of that scan, if the panel has so many."""
MAX_CLIMB: Final = 0.176
"""Tangent of rays through the object with the plane of the circle from which on the cone angle is
warned of unasked: 10 degrees, up to which FDK is taken as accurate (assumed)."""
PEAK_COLUMNS: Final = 2
"""Largest number of columns in which a view of a right scan has the scan's largest value."""
MAX_FLAT_VIEWS: Final = 0.05
"""Share of views in which it may have more: those along a flat face, by parallel rays
(assumed)."""
PARALLEL_SOURCE_RADII: Final = 50.0
"""Distance of the source for parallel rays, in radii of the scan."""


@dataclass(frozen=True)
class Clipped:
    """Line integrals that all end at the same largest value.

    Attributes:
        value: at which they are clipped.
        share: of the object's.
    """

    value: float
    share: float

    def __str__(self) -> str:
        """Say so as one sentence."""
        return (
            f"no accuracy is claimed: {min(100.0 * self.share, 99.0):.2g} % of the object's line "
            f"integrals are clipped at {self.value:.3g}, and no image shows what is behind"
        )


@dataclass(frozen=True, eq=False)
class Rung:
    """One scan of a ladder.

    Attributes:
        flaw: the flaw that the rung before does not have.
        cone_vec: its views.
        shape: (rows, cols).
        layers: (m,) layers that are seen each by itself, from their own heights; None for a scan
            of the whole.
    """

    flaw: str
    cone_vec: ConeVec
    shape: tuple[int, int]
    layers: npt.NDArray[np.intp] | None = None


@dataclass(frozen=True, eq=False)
class CoarseScan:
    """A scan of few views and pixels.

    Attributes:
        images: (n, rows, cols) line integrals.
        cone_vec: of these.
        circle: of all views of the scan.
        angles: (n,) along it [rad].
        truncation: object beyond the edges of these images.
        numbers: (n,) of these views among all of the scan.
        binned: rows and columns of the panel over which a pixel is the mean.
        nodes: largest number of voxels along the longest side.
        rest: rows and columns at the panel's end that fill no pixel and are left out
            [coarse pixels].
        clipped: line integrals of the scan that end at one value; None without any.
    """

    images: Float32Array
    cone_vec: ConeVec
    circle: Circle
    angles: FloatArray
    truncation: Truncation | None
    numbers: npt.NDArray[np.intp]
    binned: tuple[int, int]
    nodes: int = NODES
    rest: tuple[float, float] = (0.0, 0.0)
    clipped: Clipped | None = None

    @classmethod
    def of(
        cls,
        image: Callable[[int], npt.NDArray[np.generic]],
        cone_vec: ConeVec,
        shape: tuple[int, int],
        truncation: Truncation | None,
        nodes: int = NODES,
    ) -> CoarseScan:
        """Reduce a scan to `VIEWS` views, about `nodes` columns and rows.

        GeometryError: no circle or helix, or a flat panel.
        """
        copy = CoarseCopy(cone_vec, shape, nodes)
        for number in copy.wanted:
            copy.take(number, image(number))
        return copy.scan(truncation)

    def thinned(
        self,
        *,
        all_views: bool = False,
        least_rows: int = COMPARED_ROWS,
        across: int = 1,
    ) -> CoarseScan:
        """Take fewer views and rows: enough to compare images with the projections of a
        volume made from them.

        About `COMPARED_VIEWS` views a column are chosen of each turn, more where these
        would leave arcs out (`_every`), and rows and columns averaged; a rest of rows or
        columns is left out. A helix keeps its rows, which say how steep it may be.

        Args:
            all_views: keep every view.
            least_rows: that are left of a circle, if the panel has so many.
            across: columns over which a column of the result is the mean.
        """
        count, rows, cols = self.images.shape
        ends = rows + self.rest[0], cols + self.rest[1]
        if all_views:
            each = 1
        else:
            each = max(1, round(count / (COMPARED_VIEWS * cols * self.turns)))
        down = 1 if self.circle.rise else max(1, rows // least_rows)
        rows -= rows % down
        cols -= cols % across
        chosen = _every(self.cone_vec, each, self.circle)
        part = window(self.cone_vec[chosen], self.images.shape[1:], (0, rows), (0, cols))
        views = ConeVec.from_vectors(
            part.source, part.detector, part.u * across, part.v * down
        )
        truncation = self.truncation
        if truncation is not None:
            truncation = replace(truncation, rows=(truncation.rows + 0.5) / down - 0.5)
        return replace(
            self,
            images=np.ascontiguousarray(
                binned_mean(self.images[chosen, :rows, :cols], (down, across))
            ),
            cone_vec=views,
            angles=self.angles[chosen],
            truncation=truncation,
            numbers=self.numbers[chosen],
            binned=(self.binned[0] * down, self.binned[1] * across),
            rest=((ends[0] - rows) / down, (ends[1] - cols) / across),
        )

    @cached_property
    def halved(self) -> CoarseScan:
        """The same views of half as many rows, columns and nodes."""
        rows = max(self.images.shape[1] // 2, 1)
        half = self.thinned(all_views=True, least_rows=rows, across=2)
        return replace(half, nodes=self.nodes // 2)

    @property
    def complete(self) -> Truncation | None:
        """The truncation of an object that the panel sees completely; not None where rays
        that a shifted panel's near edge hides (`Truncation.beyond`) are weighed as in the
        scan."""
        if self.truncation is None or not self.truncation.beyond:
            return None
        return self.truncation.nothing

    @property
    def cut_off(self) -> bool:
        """True if the object continues beyond the panel's sides."""
        return self.truncation is not None and bool(self.truncation.cut_off.any())

    @property
    def turns(self) -> float:
        """Turns of a helix, at least 1; 1 for a circle."""
        if not self.circle.rise:
            return 1.0
        return max(1.0, float(np.ptp(self.circle.angle)) / (2.0 * np.pi))

    @property
    def share(self) -> FloatArray:
        """Share of the scan before each view, (n,), 0 to 1, by angle."""
        return np.asarray(self.numbers / max(float(self.numbers.max()), 1.0))

    @cached_property
    def seen_rows(self) -> npt.NDArray[np.bool_] | None:
        """Mark the rows of a helix whose rays stay among the layers that FDK gives values
        to, (n, rows) bool; None for a circle, and if the object ends within them.

        Beyond them no volume says what a longer object is like.
        """
        if not self.circle.rise:
            return None
        values = self.fdk(self.images, self.cone_vec, self.truncation)[:, ~self.rim]
        known = np.flatnonzero(np.isfinite(values).all(axis=1))
        if not len(known):
            return np.zeros(self.images.shape[:2], bool)
        sizes = np.abs(values[known]).mean(axis=1)
        if sizes[[0, -1]].max() <= ACCURACY * sizes.mean():
            return None
        z = self.grid.centers()[2][known]
        half = 0.5 * self.grid.voxel_xyz[2]
        views = self.level
        place = np.arange(self.images.shape[1] + 1) - 0.5 * self.images.shape[1]
        source = views.source[:, 2, None]
        fall = views.detector[:, 2, None] + place * views.v[:, 2, None] - source
        away = np.linalg.norm((views.detector - views.source)[:, :2], axis=1)[:, None]
        reach = max(self.ends)
        heights = np.array(
            [
                source + (self.circle.radius + side * reach) / away * fall
                for side in (-1.0, 1.0)
            ]
        )
        inside = (heights >= z.min() - half) & (heights <= z.max() + half)
        edges = inside.all(axis=0)
        return np.asarray(edges[:, :-1] & edges[:, 1:])

    @cached_property
    def noise(self) -> float:
        """Variance of white noise."""
        return noise_of(self.images)

    @cached_property
    def level(self) -> ConeVec:
        """Views with upright panels."""
        return upright(self.cone_vec)

    @cached_property
    def ends(self) -> tuple[float, float]:
        """Distances from the axis up to which all views see on the panel's two sides,
        (clockwise, other) [mm]; both positive for an axis on the panel.
        """
        circle = circle_of(self.cone_vec)
        low, high = panel_reach(circle, self.level, self.images.shape[2])
        return float(self.circle.radius * np.sin(low)), float(
            self.circle.radius * np.sin(high)
        )

    @cached_property
    def grid(self) -> Volume:
        """Grid of the field of view, zeros, about the rotation axis: at most `nodes`
        columns, in layers as high as rows.

        A helix, far higher than a panel, gets layers as high as its field of view over
        their number: at least the panel's rows, at most `nodes`.
        """
        x, y = self.circle.centre.tolist()
        scan = self.cone_vec
        away = np.array([x, y, 0.0])
        scan = ConeVec.from_vectors(
            scan.source - away, scan.detector - away, scan.u, scan.v
        )
        view = field_of_view(scan, self.images.shape[1:])
        pitches = np.linalg.norm([self.cone_vec.u[0], self.cone_vec.v[0]], axis=1)
        tall = view.voxel_mm * float(pitches[1] / pitches[0])
        layers = self.images.shape[1]
        height = view.shape[0] * view.voxel_mm
        if (
            self.circle.rise
        ):  # far more than a panel's height, in layers as few as its rows
            layers = min(max(layers, round(height / tall)), self.nodes)
            tall = height / layers
        wide = 2.0 * max(self.ends)
        across = round(wide / max(view.voxel_mm, wide / self.nodes))
        blank = np.zeros((layers, across, across), np.float32)
        return Volume(
            blank, (wide / across, wide / across, tall), (x, y, view.center_mm[2])
        )

    @cached_property
    def rim(self) -> npt.NDArray[np.bool_]:
        """Mark the voxel columns that are not seen in all views, and those within a voxel
        and a half of them, (ny, nx) bool.
        """
        x, y, _ = self.grid.centers()
        away = np.hypot(x - self.circle.centre[0], (y - self.circle.centre[1])[:, None])
        # A voxel and a half. Nodes are at just that distance; rounding shall not decide on
        # them.
        return np.asarray(away > max(self.ends) - 1.49 * self.grid.voxel_xyz[0])

    @cached_property
    def more(self) -> int:
        """Layers of the object above and below the grid, as far as views see, at most the
        rows of the images; 0 for one row, and if the mean of the first and last row is at
        most `ACCURACY` of the images'.
        """
        count = self.images.shape[1]
        # Means of rows first: noise is no object.
        ends = float(np.abs(self.images[:, [0, -1]].mean(axis=2)).mean())
        if count == 1 or ends <= ACCURACY * float(np.abs(self.images).mean()):
            return 0
        nearest = max(self.circle.radius - max(self.ends), 0.5 * self.circle.radius)
        return int(min(np.ceil(count * max(self.ends) / nearest), count))

    @cached_property
    def few(self) -> bool:
        """True if a circle's views leave directions out (gaps, or steps that differ by
        more than the median), or are fewer than pi / 2 times the columns; False for a
        helix.
        """
        step = self.circle.step
        apart = float(np.ptp(step)) > float(np.median(step))
        few = len(self.angles) < 0.5 * np.pi * self.images.shape[2]
        return not self.circle.rise and (apart or few)

    @property
    def sparse(self) -> bool:
        """True if views are `few`, or a circle is not full: then FDK weighs its two ends."""
        return self.few or not (self.circle.rise or self.circle.full)

    @property
    def aside(self) -> bool:
        """True if the axis is off the middle of the panel by more than half a column."""
        low, high = self.ends
        return bool(abs(high - low) > (low + high) / self.images.shape[2])

    @property
    def whole(self) -> bool:
        """False if a panel aside sees less than a turn, and never some rays."""
        return bool(self.circle.rise or self.circle.full or not self.aside)

    @property
    def at_sight(self) -> list[str]:
        """Causes of large errors that geometry and images show without a volume, of an object
        that is not `cut_off`: it goes on beyond the near side of a panel aside and less than a
        turn never shows it from the other side, rays through it climb by `MAX_CLIMB`, or the
        open beam beside it is `WARNING_BOUND` of the largest line integral.
        """
        found = []
        sizes = np.abs(self.images).mean(axis=(0, 2))
        rows = np.flatnonzero(sizes > ACCURACY * sizes.max())
        if len(rows) and not self.circle.rise:
            level = self.level
            ends = rows[[0, -1]] + [-0.5, 0.5] - 0.5 * (len(sizes) - 1)
            ray = (level.detector - level.source)[:, None] + ends[:, None] * level.v[
                :, None
            ]
            climb = np.abs(ray[..., 2]) / np.linalg.norm(ray[..., :2], axis=-1)
            found += ["cone"] * bool(climb.max() > MAX_CLIMB)
        low, high = self.ends
        near = np.abs(self.images[:, :, 0 if high < low else -1].mean(axis=1))
        if not self.whole and near.max() > ACCURACY * self.images.max():
            found.append("aside")
        beside = np.abs(self.images[:, :, [0, -1]].mean(axis=1)).min(axis=1)
        if float(beside.mean()) > WARNING_BOUND * float(self.images.max()):
            found.append("drift")
        return found

    @cached_property
    def volume(self) -> Float32Array:
        """The scan's own images, reconstructed by `fdk`; not to be changed.

        Raises:
            GeometryError: FDK cannot use the views.
        """
        return self.fdk(self.images, self.cone_vec, self.truncation)

    def fdk(
        self,
        images: Float32Array,
        cone_vec: ConeVec,
        truncation: Truncation | None = None,
    ) -> Float32Array:
        """Reconstruct the grid by FDK on the processor; voxels that only continued rows
        show stay.

        `images`: (n, rows, cols) line integrals, unchanged. Returns [1/mm], NaN unseen.
        Raises GeometryError: FDK cannot use the views.
        """
        shape = (images.shape[1], images.shape[2])
        volume = fdk_parts(
            lambda: [images.copy()],
            cone_vec,
            shape,
            self.grid,
            truncation=truncation,
            target=OnProcessor(self.grid),
            outside=True,
        )
        return volume.data

    def seen(self, thing: Float32Array, rung: Rung) -> Float32Array:
        """Project values (nz, ny, nx) in a rung's geometry and reconstruct them; 0
        unseen.

        A shifted panel's hidden part is weighed as in the scan, but not in parallel views
        without a flaw; rows are never continued.
        """
        if rung.layers is not None:
            return self._layer_by_layer(thing, rung, rung.layers)
        truncation = self.complete if rung.flaw else None
        images = self.projected(thing, rung.cone_vec, rung.shape)
        return np.nan_to_num(self.fdk(images, rung.cone_vec, truncation))

    def _layer_by_layer(
        self, thing: Float32Array, rung: Rung, wanted: npt.NDArray[np.intp]
    ) -> Float32Array:
        """Reconstruct each of some layers from a fan of one row in its own plane: as the cone
        does where nothing changes along the axis, whatever its pixels do to the layer.

        Others are zeros.
        """
        fan, count = rung.cone_vec, len(rung.cone_vec)
        up = self.grid.centers()[2][wanted] - fan.source[0, 2]
        rise = np.zeros((len(wanted) * count, 3))
        rise[:, 2] = np.repeat(up, count)
        source, panel, u, v = (
            np.tile(part, (len(wanted), 1))
            for part in (fan.source, fan.detector, fan.u, fan.v)
        )
        views = ConeVec.from_vectors(source + rise, panel + rise, u, v)
        rays = two_rays(self.grid.like(thing), views, rung.shape)
        centre = (*self.grid.center_mm[:2], float(fan.source[0, 2]))
        blank = np.zeros((1, *thing.shape[1:]), np.float32)
        like = Volume(blank, self.grid.voxel_mm, centre)
        plan = plan_fdk(fan, rung.shape, like, truncation=self.complete)
        seen = np.zeros_like(thing)
        for k, images in zip(wanted, np.split(rays, len(wanted)), strict=True):
            target = OnProcessor(like)
            target.add(plan.views_of(images, 0))
            plan.cover(target.volume(), like, outside=True)
            seen[k] = np.nan_to_num(target.volume()[:, :, 0])
        return seen

    def projected(
        self,
        thing: Float32Array,
        views: ConeVec,
        shape: tuple[int, int],
        *,
        fine: bool = True,
        beyond: bool = True,
    ) -> Float32Array:
        """Project values (nz, ny, nx) as views see them, (n, rows, cols).

        `fine` averages two rays a column: the steps of voxels would show as a flaw.
        `beyond` repeats the outermost layers above and below (`more`).
        """
        if self.more and beyond:
            thing = np.pad(thing, ((self.more, self.more), (0, 0), (0, 0)), "edge")
        volume = Volume(thing, self.grid.voxel_mm, self.grid.center_mm)
        if not fine:
            return forward(volume, views, shape)
        return two_rays(volume, views, shape)

    def parallel(
        self, flaw: str, ends: tuple[float, float], turn: FloatArray | None = None
    ) -> Rung:
        """Make parallel views of a panel that sees given distances from the axis, one
        voxel at least.

        The source is `PARALLEL_SOURCE_RADII` radii away; the axis falls on the grid's
        columns, and rows on its layers and those above and below.

        Args:
            flaw: of the rung.
            ends: distances on the panel's two sides [mm].
            turn: (n,) angles [rad]; None for `VIEWS` even ones around the circle.
        """
        if turn is None:
            turn = np.linspace(0.0, 2.0 * np.pi, VIEWS, endpoint=False)
        side, _, tall = self.grid.voxel_xyz
        # The axis falls on these coarser columns, too.
        ends = max(ends[0], side), max(ends[1], side)
        away = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(len(turn))])
        u = np.column_stack([-away[:, 1], away[:, 0], np.zeros(len(turn))])
        centre = np.append(self.circle.centre, self.grid.center_mm[2])
        far = PARALLEL_SOURCE_RADII * self.circle.radius * away
        # As far behind the object as the source is before it: twice as large.
        panel = centre - far + u * (ends[1] - ends[0])
        down = (0.0, 0.0, -2.0 * tall)
        views = ConeVec.from_vectors(centre + far, panel, 2.0 * side * u, [down] * len(u))
        cols = int(sum(ends) / side + 1e-6) + 2  # often an integer, except for rounding
        return Rung(flaw, views, (self.grid.shape[0] + 2 * self.more, cols))

    def ladder(self, layers: npt.NDArray[np.intp]) -> list[Rung]:
        """List scans of the same sampling, from one without a flaw to this one.

        Some layers are seen by themselves, from their own heights: by a panel that reaches as far
        on both sides, then by one that is "aside"; then in the "cone" and without the "rows"
        that the panel does not have, if the object goes on above or below. A helix has "rows"
        alone.

        Args:
            layers: (m,) that are to be seen by themselves; others are not compared.

        Returns:
            Rungs with their flaw's name, geometry and panel's shape; the first has no flaw.
            Without layers, none.
        """
        if not len(layers):
            return []
        rows, cols = self.images.shape[1:]
        rungs = []
        if not self.circle.rise and self.aside:
            low, high = self.ends
            more = round(abs(high - low) * cols / (low + high))
            part = (-more, cols) if high < low else (0, cols + more)
            wide = window(self._fan, (1, cols), (0, 1), part)
            rungs.append(Rung("", wide, (1, cols + more), layers))
        flaw = "aside" if rungs else ""
        rungs.append(Rung(flaw, self._fan, (1, cols), layers))
        if rows == 1:
            return rungs
        if self.more and not self.circle.rise:
            reached = (-self.more, rows + self.more)
            taller = window(self.level, (rows, cols), reached, (0, cols))
            rungs.append(Rung("cone", taller, (rows + 2 * self.more, cols)))
        last = "rows" if self.more else "cone"
        return [*rungs, Rung(last, self.level, (rows, cols))]

    @property
    def _fan(self) -> ConeVec:
        """One row in the plane of the sources, of a helix with all its turns on one."""
        source, panel = self.level.source.copy(), self.level.detector.copy()
        source[:, 2] = panel[:, 2] = self.grid.center_mm[2]
        return ConeVec.from_vectors(source, panel, self.level.u, self.level.v)


def two_rays(volume: Volume, views: ConeVec, shape: tuple[int, int]) -> Float32Array:
    """Project a volume by the mean of two rays a column: the steps of its voxels would show.

    Args:
        volume: to project.
        views: n of them.
        shape: (rows, cols).

    Returns:
        (n, rows, cols) line integrals.
    """
    finer = ConeVec.from_vectors(views.source, views.detector, 0.5 * views.u, views.v)
    rays = forward(volume, finer, (shape[0], 2 * shape[1]))
    return np.asarray(0.5 * (rays[:, :, ::2] + rays[:, :, 1::2]), np.float32)


class CoarseCopy:
    """The images of a coarse scan, taken as those of the scan pass by; see
    `CoarseScan.of`.

    Args:
        cone_vec: of all views.
        shape: (rows, cols).
        nodes: columns, rows and voxels along the longest side.

    Raises:
        GeometryError: neither a circle nor a helix, or a panel that lies flat.
    """

    def __init__(
        self, cone_vec: ConeVec, shape: tuple[int, int], nodes: int = NODES
    ) -> None:
        """Choose views, rows and columns, and make room for their means."""
        circle = circle_of(cone_vec)
        self._flip = on_its_side(cone_vec)
        if self._flip:
            cone_vec = swapped(cone_vec)
            shape = (shape[1], shape[0])
        at, same = distinct_angles(circle)
        chosen = _every(cone_vec[at], -(-len(at) // VIEWS), circle)
        low, high = panel_reach(circle, upright(cone_vec), shape[1])
        overlap = min(low, high) / (low + high) * shape[1]
        wide = -(-shape[1] // nodes)
        across = min(wide, max(1, int(overlap / MIN_AXIS_COLUMNS)))
        down = max(min(wide, shape[0] // 2), -(-shape[0] // nodes), 1)
        rows = shape[0] // down
        cols = shape[1] // across
        part = window(cone_vec[at[chosen]], shape, (0, rows * down), (0, cols * across))
        self._views = ConeVec.from_vectors(
            part.source, part.detector, part.u * across, part.v * down
        )
        self._circle = circle
        self._nodes = nodes
        self._numbers = at[chosen]
        self._binned = down, across
        self._rest = shape[0] / down - rows, shape[1] / across - cols
        slots = np.full(len(at), -1)
        slots[chosen] = np.arange(len(chosen))
        self._slots: npt.NDArray[np.intp] = slots[same]
        self._taken = np.zeros(len(same), bool)
        self._sums = np.zeros((len(chosen), rows, cols), np.float32)

    @property
    def wanted(self) -> list[int]:
        """Numbers of the views that are taken."""
        return np.flatnonzero(self._slots >= 0).tolist()

    def wants(self, number: int) -> bool:
        """Return whether a view is still to be taken."""
        return bool(self._slots[number] >= 0 and not self._taken[number])

    def take(self, number: int, image: npt.NDArray[np.generic]) -> None:
        """Add a view's image, averaged over pixels, unless it is not wanted or has been taken.

        Args:
            number: of the view among all.
            image: line integrals, (rows, cols); not changed.
        """
        if not self.wants(number):
            return
        slot = self._slots[number]
        self._taken[number] = True
        values = np.asarray(image, np.float32)
        self._sums[slot] += binned_mean(values.T if self._flip else values, self._binned)

    def scan(self, truncation: Truncation | None) -> CoarseScan:
        """Return the coarse scan once all wanted images have been taken.

        Args:
            truncation: of the scan; None if the object is not cut off.
        """
        wanted = self._slots >= 0
        assert self._taken[wanted].all()
        counts = np.bincount(self._slots[wanted], minlength=len(self._sums))
        images = np.asarray(self._sums / counts[:, None, None], np.float32)
        if self._circle.rise:
            # The outermost half rows count, too, in how steep a helix may be.
            images = np.pad(images, ((0, 0), (1, 1), (0, 0)), "edge")
        if truncation is not None:
            first = 1.0 if self._circle.rise else 0.0
            rows = (truncation.rows + 0.5) / self._binned[0] - 0.5 + first
            truncation = replace(truncation, rows=rows)
        return CoarseScan(
            images,
            self._views,
            self._circle,
            self._circle.angle[self._numbers],
            truncation,
            self._numbers,
            self._binned,
            self._nodes,
            self._rest,
        )


class Plateaus:
    """Looks for a largest line integral that whole areas of images have.

    Columns of a right scan that have its largest value are one or two in a view (a body of
    parallel rays), but for views along a flat face.
    """

    def __init__(self) -> None:
        """Begin without an image."""
        self._peaks: list[tuple[float, int, int, int]] = []

    def take(self, image: npt.NDArray[np.generic]) -> None:
        """Look at line integrals (rows, cols); an image of one value has no plateau."""
        peak = image.max()
        at = np.flatnonzero(image == peak)
        if len(at) == image.size:
            return
        columns = len(np.unique(at % image.shape[1]))
        thick = int((image > 0.5 * peak).sum()) if columns > PEAK_COLUMNS else 0
        self._peaks.append((float(peak), columns, len(at), thick))

    @property
    def clipped(self) -> Clipped | None:
        """What the images have in common; None if they have no plateau."""
        if not self._peaks:
            return None
        peak, columns, count, thick = np.array(self._peaks).T
        highest = float(peak.max())
        flat = (peak == highest) & (columns > PEAK_COLUMNS)
        if highest <= 0.0 or flat.sum() <= MAX_FLAT_VIEWS * len(flat):
            return None
        return Clipped(highest, float(count[flat].sum() / max(thick[flat].sum(), 1.0)))


class ScanCopies:
    """Copies of a scan of `NODES` and of `FINE_NODES`, from images that are seen once.

    Args:
        cone_vec: of all views.
        shape: (rows, cols).

    Raises:
        GeometryError: see `CoarseScan.of`.
    """

    def __init__(self, cone_vec: ConeVec, shape: tuple[int, int]) -> None:
        """Make room for both copies."""
        self._copies = {
            nodes: CoarseCopy(cone_vec, shape, nodes) for nodes in (NODES, FINE_NODES)
        }
        self._scans: dict[int, CoarseScan] = {}
        self._plateaus = Plateaus()
        self.truncation: Truncation | None = None

    @property
    def wanted(self) -> list[int]:
        """Numbers of the views that are taken; the same of both copies."""
        return self._copies[NODES].wanted

    def take(self, number: int, image: npt.NDArray[np.generic]) -> None:
        """Take a view's image; see `CoarseCopy.take`."""
        if self._copies[FINE_NODES].wants(number):
            self._plateaus.take(image)
        for copy in self._copies.values():
            copy.take(number, image)

    def passing(self, parts: Iterable[Float32Array]) -> Iterator[Float32Array]:
        """Yield all images in parts (k, rows, cols), unchanged, and take them on the
        way.
        """
        number = 0
        for part in parts:
            for image in part:
                self.take(number, image)
                number += 1
            yield part

    def __call__(self, nodes: int) -> CoarseScan:
        """Return the copy of `NODES` or `FINE_NODES`, with the `truncation`."""
        if nodes not in self._scans:
            scan = self._copies.pop(nodes).scan(self.truncation)
            self._scans[nodes] = replace(scan, clipped=self._plateaus.clipped)
        return self._scans[nodes]


def _every(cone_vec: ConeVec, each: int, circle: Circle) -> npt.NDArray[np.intp]:
    """Choose every `each`-th view, or closer: with gaps if and only if the scan has.

    With gaps FDK weighs rays otherwise: copies of right scans would not fit.
    """
    for step in range(each, 1, -1):
        chosen = np.arange(0, len(cone_vec), step)
        if circle_of(cone_vec[chosen]).full == circle.full:
            return chosen
    return np.arange(len(cone_vec))
