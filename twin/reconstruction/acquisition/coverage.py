"""Coverage of voxels by the views of a scan: scaling, loss, and shares of the views.

A voxel near the upper or lower end of a circle's field of view is above or below the
panel in the views whose source is near. The other views still see lines of every
direction through it, so their sum is scaled. A voxel with too few data is NaN.

A voxel of a helix is seen from the same side once a turn, higher or lower on the panel.
Each such view counts by its row, most in the middle of the panel and least at its upper
and lower edge, and all together once: the aperture weights of weighted FDK (Stierstorfer
et al., Phys. Med. Biol. 49 (2004) 2209), for views a full turn apart, so that no rays are
resampled. Every voxel must be seen in every direction, which limits the rise in a turn.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection import Volume
from flexdt.twin.reconstruction.acquisition.trajectory import (
    TURN,
    Circle,
    circle_of,
    no_fdk,
    panel_reach,
)

MIN_SEEN_SHARE: Final = 0.4
"""Least share of the weight of all views that must see a voxel. At the panel's upper
and lower edge it is about half in a full turn."""
MIN_LINES_SHARE: Final = 0.97
"""Share of the directions in which a voxel must be seen where the panel cuts the
object off, less the arc of one view."""
MAX_VIEWS: Final = 360
"""Largest number of views by which coverage is judged, evenly over the circle."""


def normalise_coverage(
    data: Float32Array,
    like: Volume,
    circle: Circle,
    table: FloatArray,
    weights: FloatArray,
    rows: int,
    panel: tuple[int, int],
    *,
    cut_off: bool,
) -> None:
    """Scale voxels that are above or below the panel in some views, in place; voxels seen
    too little become NaN.

    A voxel needs `MIN_SEEN_SHARE` of the views' weight. With `cut_off` it also needs
    lines of `MIN_LINES_SHARE` of half a turn, less the widest arc of a view. Does nothing
    if all rows of the grid are on the panel and not `cut_off`. Of more than `MAX_VIEWS`
    views, one stands for some neighbors. See `fdk_kernels.normalise_coverage`.

    Args:
        data: the volume's, (ny, nx, nz), changed in place.
        like: its grid.
        circle: of the views.
        table: the kernel's table of the views, (n, 11).
        weights: of rays, (n, cols).
        rows: of the images.
        panel: first and last column of the panel, among the images' columns.
        cut_off: whether the panel cuts the object off, so that voxels which are not seen
            in lines of all directions become NaN.
    """
    from flexdt.twin.reconstruction.kernels import fdk_kernels

    first, size = first_and_steps(like)
    x, y, z = (np.array([places[0], places[-1]]) for places in like.centers())
    corner = np.hypot(x[:, None] - circle.centre[0], y - circle.centre[1]).max()
    depth = np.array([max(circle.radius - corner, 1e-9), circle.radius + corner])
    # The rows between which the grid's voxels lie: highest and lowest, nearest and farthest.
    high = ((z - table[:, 2, None]) * table[:, 9, None])[:, :, None] / depth
    row = table[:, 10, None, None] - high
    if not cut_off and row.min() >= 0.0 and row.max() <= rows - 1:
        return
    order = np.argsort(circle.angle, kind="stable")
    starts = np.arange(0, len(order), -(-len(order) // MAX_VIEWS))
    middle = order[(starts + np.append(starts[1:], len(order))) // 2]
    step = np.add.reduceat(circle.step[order], starts)
    fdk_kernels.normalise_coverage(
        np.ascontiguousarray(table[middle]),
        weights[middle] * step[:, None],
        rows,
        np.array(panel) + (-0.5, 0.5),
        circle.radius,
        *first,
        *size,
        MIN_SEEN_SHARE,
        (MIN_LINES_SHARE * np.pi - circle.step.max()) * cut_off,
        data,
    )


def first_and_steps(like: Volume) -> tuple[list[float], list[float]]:
    """Compute center of the first voxel and steps (x, y, z) [mm]."""
    return [float(places[0]) for places in like.centers()], list(like.voxel_xyz)


@dataclass(frozen=True)
class LostVoxels:
    """Voxels of FDK without a value, by every fourth voxel of a layer's sides.

    Attributes:
        layers: of the grid that were examined.
        lost_layers: without any value.
        voxels: examined in the other layers.
        lost_voxels: without a value among those.
    """

    layers: int = 0
    lost_layers: int = 0
    voxels: int = 0
    lost_voxels: int = 0

    @classmethod
    def of(cls, data: Float32Array) -> LostVoxels:
        """Count the voxels without a value (NaN) of a volume (nz, ny, nx), by every
        fourth one along y and x.

        Layers without any value count as lost layers; their voxels are not counted again.
        """
        # In the order of memory, where z is contiguous.
        lost = np.isnan(data.transpose(1, 2, 0)[::4, ::4])
        each = lost.shape[0] * lost.shape[1]
        counts = lost.sum(axis=(0, 1), dtype=np.int32)
        held = counts[counts < each]
        voxels = each * len(held)
        return cls(len(data), len(data) - len(held), voxels, int(held.sum()))

    def __add__(self, more: LostVoxels) -> LostVoxels:
        """Add the counts of further layers."""
        return LostVoxels(
            self.layers + more.layers,
            self.lost_layers + more.lost_layers,
            self.voxels + more.voxels,
            self.lost_voxels + more.lost_voxels,
        )

    def warnings(self) -> list[str]:
        """List warnings: of lost layers, if any, and of voxels not seen from all sides,
        if more than `LOST_SHARE` of those examined; both are NaN in the volume. Empty if
        all is well.
        """
        sentences = []
        if self.lost_layers:
            sentences.append(
                f"{self.lost_layers} of {self.layers} layers of the grid lie outside what "
                "the panel sees; their voxels are NaN"
            )
        if self.lost_voxels > LOST_SHARE * self.voxels:
            share = 100.0 * self.lost_voxels / self.voxels
            sentences.append(
                f"{share:.0f} % of the voxels are not seen from all sides and are NaN: "
                "more angles, a panel nearer to the middle, or a smaller grid"
            )
        return sentences


LOST_SHARE = 0.5
"""Share of lost voxels above which a warning is given; corners of a grid are lost in most
scans whose panel cuts the object off."""
DEPTHS = 64
"""Number of depths at which shares are tabulated."""
HELIX_TAPER_RAD = 0.2
"""Angle over which views count less towards the ends of the helix [rad]."""


def ends_not_seen_mm(cone_vec: ConeVec) -> float:
    """Compute the height [mm] at either end of a helix that FDK cannot fill; 0 without a
    helix.

    A layer needs the views of a turn and of the taper at both ends.
    """
    try:
        circle = circle_of(cone_vec)
    except GeometryError:
        return 0.0
    return abs(circle.rise) * (1.0 + 2.0 * HELIX_TAPER_RAD / TURN)


@dataclass(frozen=True, eq=False)
class Sharing:
    """Shares of the views of a helix in the voxels that they see.

    Attributes:
        circle: the helix.
        rows: of the panel.
        scale: (n,) distance from source to panel in pitches of rows.
        depth: (n, 2) least and largest of the grid's voxels, along the panel's normal [mm].
        whole: lowest and highest layer whose voxels are seen from every side [mm].
    """

    circle: Circle
    rows: int
    scale: FloatArray
    depth: FloatArray
    whole: tuple[float, float]

    @classmethod
    def of(
        cls, circle: Circle, cone_vec: ConeVec, shape: tuple[int, int], like: Volume
    ) -> Sharing:
        """Compute the shares of upright panels for a grid, and check that the helix rises
        slowly enough for every voxel to be seen from every side.

        The width that must be seen is the grid's, or the field of view's where that is
        narrower. The checked rise is independent of the grid's height; `whole` says which
        layers are complete.

        Args:
            circle: the sources' helix.
            cone_vec: n upright views.
            shape: the panel's (rows, cols).
            like: place and size of the grid.

        Raises:
            GeometryError: the helix rises by more a turn than panel and grid allow; names
                the largest rise.
        """
        rows, cols = shape
        away = cone_vec.normal * np.sign(cone_vec.source_detector_distance)[:, None]
        distance = np.abs(cone_vec.source_detector_distance)
        scale = distance / np.linalg.norm(cone_vec.v, axis=1)
        half = np.array(like.size_mm[:2]) / 2
        corner = np.hypot(*(np.abs(np.array(like.center_mm[:2]) - circle.centre) + half))
        seen = circle.radius * np.sin(max(panel_reach(circle, cone_vec, cols)))
        wide = min(float(corner), float(seen))
        axis = ((circle.centre - cone_vec.source[:, :2]) * away[:, :2]).sum(axis=1)
        # The voxels nearest to the source move farthest on the panel.
        most = float(((rows - 1) * (axis - wide) / scale).min())
        if circle.rise > most:
            raise no_fdk(
                f"the helix rises by {circle.rise:.4g} mm a turn; FDK needs every "
                f"voxel in every direction: at most {most:.4g} mm a turn for this panel "
                "and a grid as wide as this",
                circle.rise,
                most,
            )
        # Of a direction just missed at an end, the first view is a whole rise further on.
        lack = circle.rise - 0.5 * most
        panel = cone_vec.detector[:, 2] - cone_vec.source[:, 2]
        middle = cone_vec.source[:, 2] + panel * axis / distance
        whole = float(middle.min()) + lack, float(middle.max()) - lack
        return cls(
            circle, rows, scale, axis[:, None] + wide * np.array([-1.0, 1.0]), whole
        )

    def columns(self) -> FloatArray:
        """Compute the columns that a helix adds to the kernel's table of views, (n, 2):
        the first tabulated depth [mm], and tabulated depths a mm."""
        first, last = self.depth.T
        return np.column_stack([first, (DEPTHS - 1) / (last - first)])

    def table(self, views: slice, rows: tuple[int, int]) -> Float32Array:
        """Compute the weights of a view's rows at each depth, as a voxel is seen from
        several turns.

        A ray's share falls from the panel's middle row to its edges, and within
        `HELIX_TAPER_RAD` of the helix's ends; shares of a voxel's rays from all turns add
        up to 1.

        Args:
            views: a slice of the views, n of them.
            rows: first row, and the one after the last; rows off the panel repeat its
                edge.

        Returns:
            (n, DEPTHS, rows), between 0 and 1, at even depths from the least to the
            largest of the grid.
        """
        first, last = self.depth[views].T[..., None]
        depth = first + (last - first) * np.linspace(0.0, 1.0, DEPTHS)
        turn = (
            self.circle.rise * self.scale[views, None] / depth
        )  # rows that a voxel sinks
        span = float(self.circle.step.sum())
        since = (self.circle.angle + 0.5 * self.circle.step)[views]
        until = span - since
        inside = np.arange(*rows).clip(
            0, self.rows - 1
        )  # rows off the panel repeat its edge
        row = (inside - (self.rows - 1) / 2).astype(np.float32)
        most = int(min(span / (2 * np.pi), self.rows / np.abs(turn).min())) + 1
        own = total = np.zeros((len(since), DEPTHS, len(row)), np.float32)
        for k in range(-most, most + 1):
            end = np.minimum(since + 2 * np.pi * k, until - 2 * np.pi * k)
            if (end <= 0.0).all():
                continue
            off = np.abs(row + (k * turn)[..., None].astype(np.float32)) / np.float32(
                self.rows / 2
            )
            part = np.maximum(np.float32(1.0) - off, 0)
            part *= part * (3 - 2 * part)
            part *= np.clip(end / HELIX_TAPER_RAD, 0.0, 1.0)[:, None, None].astype(
                np.float32
            )
            total = total + part
            own = part if k == 0 else own
        return np.asarray(own / total)
