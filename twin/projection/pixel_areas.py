"""A pixel is an area: how many rays each needs, and line integrals along several rays of some.

One ray, to a pixel's center, has the mean over the pixel of a line integral that changes evenly
there. Where an edge of the object is in the way it has not, and n x n or n x (n + 1) rays come
nearer.
`rays_needed` finds these pixels from the shapes alone, by closed forms: no part that lies
between the rays is missed. `paths_within` projects them. Voxels have edges everywhere, so that
all the pixels they darken get rays, at least two to a voxel's shadow along each side.

What is averaged is the caller's: line integrals where these are asked for (a linear map), the
signal where photons are counted, because a panel adds up intensities.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.geometry.virtual_panel import run_through
from flexdt.twin.projection.analytic import (
    RAY_OFFSET_PX,
    Body,
    TriangleMesh,
    project_body,
)
from flexdt.twin.projection.analytic_solids import (
    Convex,
    Scene,
    as_convex,
    corner_shadows,
    hull_points,
    shadows,
)
from flexdt.twin.projection.finer_pixels import finer, voxel_rays_a_side
from flexdt.twin.projection.operators import Shape2, as_cone_vec, forward
from flexdt.twin.projection.volume import Volume
from flexdt.twin.rays_a_pixel import Rays

BATCH_PIXELS: Final = 1 << 21
"""Pixels of the views that are looked at together."""
KEPT_SCENES: Final = 8
"""Number of scenes whose shapes are kept encoded."""
TILE_PIXELS: Final = 32
"""Pixels along a side of a tile, whose rays are projected together."""
BAND_ROWS: Final = 32
"""Rows of a job."""
SHARE_OF_MAXIMUM: Final = 3e-3
"""Error of a pixel on an edge by "auto", as a part of the largest line integral (standard
deviation)."""
PLAIN_INTEGRAL: Final = 60.0
"""Line integral below which no signal leaves the range of single precision: others are taken from
the least of their pixel."""
FEWEST_NEEDED: Final = 1e-4
"""The same from which a pixel gets the number of rays that is asked for."""
MARKS: Final = 32
"""Number of marks, 0 included."""
RAYS: Final = np.array([(mark + 1) // 2 * (mark // 2 + 1) for mark in range(MARKS)])
"""Number of rays of each mark."""
IntArray = npt.NDArray[np.int64]
Marks = npt.NDArray[np.uint8]
Packed = npt.NDArray[np.uint32]


@dataclass(frozen=True)
class Need:
    """What a body's pixels need: so many rays that the error on an edge is small.

    Attributes:
        error: permitted on an edge, as a standard deviation: of line integrals, or of the
            signal as a part of the open beam's.
        counts: whether signals are averaged.
        rays: of each pixel that needs more than one; "auto" for as many as it needs.
    """

    error: float
    counts: bool = False
    rays: Rays = "auto"

    def given(self, marks: Marks) -> Marks:
        """Replace the marks of pixels that need several rays by the one asked for."""
        if self.rays == "auto":
            return marks
        return np.where(marks > 1, np.uint8(2 * self.rays - 1), np.uint8(1))


@dataclass(frozen=True, eq=False)
class Within:
    """Pixels with several rays.

    Attributes:
        pixels: (k,) flat places in images (n, rows, cols), growing.
        marks: uint8 (k,) of each, see `rays_of`.
    """

    pixels: IntArray
    marks: Marks

    @classmethod
    def of(cls, marks: Marks) -> Within:
        """Take the pixels of `marks` (n, rows, cols) that need more than one ray."""
        flat = marks.reshape(-1)
        pixels = np.flatnonzero(flat > 1)
        return cls(pixels, flat[pixels])

    @classmethod
    def joined(cls, several: Sequence[Within]) -> Within:
        """Take the pixels that any of several names, each with the most rays."""
        if len(several) == 1:
            return several[0]
        pixels = np.concatenate([np.zeros(0, np.int64), *(one.pixels for one in several)])
        marks = np.concatenate([np.zeros(0, np.uint8), *(one.marks for one in several)])
        order = np.argsort(pixels, kind="stable")
        pixels, first = np.unique(pixels[order], return_index=True)
        if not len(pixels):
            return cls(pixels, marks)
        return cls(pixels, np.maximum.reduceat(marks[order], first))

    @classmethod
    def unpacked(cls, values: Packed, views: int, pixels: int) -> Within:
        """Read what `packed` has made of views of `pixels` each.

        Raises:
            ValueError: it is of other views.
        """
        ends = values == 0
        places, marks = np.divmod(values[~ends].astype(np.int64), MARKS)
        places += np.cumsum(ends)[~ends] * pixels
        sound = np.count_nonzero(ends) == views and (not len(ends) or ends[-1])
        if not sound or (np.diff(places) <= 0).any() or (places >= views * pixels).any():
            raise ValueError(f"no marks of {views} views of {pixels} pixels")
        return cls(places, marks.astype(np.uint8))

    @cached_property
    def starts(self) -> IntArray:
        """Place of each pixel's first ray among all, (k + 1,); the last is their number."""
        return np.concatenate([np.zeros(1, np.int64), np.cumsum(rays_of(self.marks))])

    def of_range(self, first: int, last: int) -> tuple[Within, slice]:
        """Take the pixels from place `first` to before `last`, counted from `first`, and the
        range of their rays."""
        a, b = np.searchsorted(self.pixels, [first, last]).tolist()
        starts = self.starts
        part = Within(self.pixels[a:b] - first, self.marks[a:b])
        return part, slice(int(starts[a]), int(starts[b]))

    def means(self, values: npt.NDArray[np.floating]) -> FloatArray:
        """Average values (..., rays) over each pixel, float64 (..., k)."""
        if not len(self.pixels):
            return np.zeros((*values.shape[:-1], 0))
        sums = np.add.reduceat(values, self.starts[:-1], axis=-1, dtype=np.float64)
        return np.asarray(sums / rays_of(self.marks))

    def repeated(self, values: npt.NDArray[np.floating]) -> Float32Array:
        """Give each ray the value of its pixel, (k,) to float32 (rays,)."""
        return np.repeat(values, rays_of(self.marks)).astype(np.float32, copy=False)

    def mean_signals(self, values: Float32Array) -> FloatArray:
        """Compute the line integral of the mean signal of each pixel, -log of the mean of
        exp(-values): what a panel that counts photons shows. (rays,) to float64 (k,)."""
        if not len(self.pixels):
            return np.zeros(0)
        if values.min() > -PLAIN_INTEGRAL and values.max() < PLAIN_INTEGRAL:
            return np.asarray(-np.log(self.means(np.exp(-values))))
        least = np.minimum.reduceat(values, self.starts[:-1])
        beyond = values - self.repeated(least)
        return np.asarray(least - np.log(self.means(np.exp(-beyond))))


def rays_needed(
    body: Body,
    cone_vec: ConeVec | npt.ArrayLike,
    shape: Shape2,
    need: Need,
    weight: float = 1.0,
) -> Marks:
    """Find the rays that every pixel needs, as marks (n, rows, cols), see `rays_of`.

    `need`: permitted error; `weight`: attenuation of a unit of the body's projection: 1
    for solids and voxels, 1/mm for a mesh. 1: one ray has the mean.
    """
    geometry = as_cone_vec(cone_vec)
    marks = np.ones((len(geometry), *shape), np.uint8)
    if isinstance(body, Scene):
        _mark_scene(body, geometry, need, abs(weight), marks)
    elif isinstance(body, TriangleMesh):
        _mark_mesh(body, geometry, need, abs(weight), marks)
    else:
        _mark_voxels(body, geometry, marks)
    return need.given(marks)


def packed(marks: Marks) -> Packed:
    """Pack marks (n, rows, cols), of which few are more than 1: for each view, of each such
    pixel, `MARKS` times its place plus its mark, in their order, and a 0."""
    out = [np.zeros(0, np.uint32)]
    for view in map(np.ravel, marks):
        places = np.flatnonzero(view > 1)
        out += [(places * MARKS + view[places]).astype(np.uint32), np.zeros(1, np.uint32)]
    return np.concatenate(out)


def paths_within(
    body: Body, cone_vec: ConeVec | npt.ArrayLike, shape: Shape2, within: Within
) -> Float32Array:
    """Project a body along several rays of some pixels.

    Args:
        body: solids, a mesh or voxels.
        cone_vec: ConeVec or (n, 12) [mm], in the body's frame.
        shape: detector (rows, cols).
        within: the pixels of (n, rows, cols).

    Returns float32, the line integral (of a mesh the path length [mm]) of each ray, those of a
    pixel in a row.
    """
    geometry = as_cone_vec(cone_vec)
    out = np.zeros(int(within.starts[-1]), np.float32)
    if not len(within.pixels):
        return out
    if isinstance(body, Scene):
        _within_scene(body, geometry, shape, within, out)
    elif isinstance(body, TriangleMesh):
        _within_mesh(body, geometry, shape, within, out)
    else:
        _within_voxels(body, geometry, shape, within, out)
    return out


def area_means(
    parts: Sequence[tuple[Body, float]],
    cone_vec: ConeVec | npt.ArrayLike,
    shape: Shape2,
    rays: Rays,
    images: Float32Array | None = None,
) -> Float32Array:
    """Average line integrals over the pixels' areas.

    Args:
        parts: bodies and factors; their projections add up.
        cone_vec: ConeVec or (n, 12) [mm].
        shape: detector (rows, cols).
        rays: along each side of a pixel that an edge reaches; "auto": so many that the
            error there is `SHARE_OF_MAXIMUM` of the largest line integral.
        images: line integrals of the pixels' centers, changed in place; None to compute
            them.

    Returns:
        float32 (n, rows, cols).
    """
    geometry = as_cone_vec(cone_vec)
    if images is None:
        images = np.zeros((len(geometry), *shape), np.float32)
        for body, factor in parts:
            images += np.float32(factor) * project_body(body, geometry, shape)
    largest = float(np.abs(images).max(initial=0.0))
    if rays == 1 or largest == 0.0:
        return images
    share = SHARE_OF_MAXIMUM if rays == "auto" else FEWEST_NEEDED
    need = Need(share * largest, rays=rays)
    step = max(1, BATCH_PIXELS // max(1, math.prod(shape)))
    for begin in range(0, len(geometry), step):
        some = slice(begin, begin + step)
        within = needed(parts, geometry[some], shape, need)
        total = np.zeros(int(within.starts[-1]), np.float32)
        for body, factor in parts:
            total += np.float32(factor) * paths_within(
                body, geometry[some], shape, within
            )
        images[some].reshape(-1)[within.pixels] = within.means(total)
    return images


def needed(
    parts: Sequence[tuple[Body, float]], cone_vec: ConeVec, shape: Shape2, need: Need
) -> Within:
    """Find the pixels that need several rays for any of the bodies (with their weights, as of
    `rays_needed`)."""
    return Within.joined(
        [
            Within.of(rays_needed(body, cone_vec, shape, need, weight))
            for body, weight in parts
        ]
    )


@lru_cache(maxsize=KEPT_SCENES)
def _shapes(
    scene: Scene,
) -> tuple[list[Convex], FloatArray, FloatArray, IntArray, FloatArray]:
    """Encode solids for the kernels: shapes, quadrics, slabs, each solid's slabs, and the points
    about all of them."""
    shapes = [as_convex(solid.shape) for solid in scene.solids]
    quadric = np.array(
        [[one.curved, *one.matrix.ravel(), *one.center] for one in shapes], float
    )
    ends = np.cumsum([0, *(len(one.slabs) for one in shapes)])
    slabs = np.concatenate([one.slabs for one in shapes])
    hull = np.concatenate([hull_points(one) for one in shapes])
    return shapes, quadric, slabs, np.column_stack([ends[:-1], ends[1:]]), hull


def _wide_shadows(shapes: list[Convex], rays: FloatArray, shape: Shape2) -> IntArray:
    """Find the pixels of whose area some part is in a solid's shadow, as
    `analytic_solids.shadows`."""
    rows, cols = shape
    moved = rays.copy()  # a panel with one more pixel on every side
    moved[:, 3:6] -= rays[:, 6:9] + rays[:, 9:12]
    wide = shadows(shapes, moved, (rows + 2, cols + 2)) - 1
    empty = (wide[..., 1] <= wide[..., 0]) | (wide[..., 3] <= wide[..., 2])
    # A shadow between two rows or columns of centres has no pixel of its own.
    ends = wide + np.array([-1, 1, -1, 1])
    bounds = np.array([rows, rows, cols, cols])
    ends = np.minimum(np.maximum(ends, 0), bounds)
    away = empty & (
        (wide[..., 0] >= rows)
        | (wide[..., 1] <= -1)
        | (wide[..., 2] >= cols)
        | (wide[..., 3] <= -1)
    )
    ends[away] = 0
    return np.ascontiguousarray(ends)


def _mark_scene(
    scene: Scene, geometry: ConeVec, need: Need, weight: float, marks: Marks
) -> None:
    """Raise marks to the rays that a scene's solids need."""
    from flexdt.twin.projection.kernels import within_kernels

    if not scene.solids or not marks.size:
        return
    shape = (marks.shape[1], marks.shape[2])
    shapes, quadric, slabs, ranges, hull = _shapes(scene)
    rays = run_through(geometry, hull).rays(shape)
    weights = np.array([abs(solid.mu_per_mm) * weight for solid in scene.solids])
    within_kernels.mark_convex(
        quadric,
        slabs,
        ranges,
        _wide_shadows(shapes, rays, shape),
        rays,
        weights,
        all(solid.mu_per_mm >= 0.0 for solid in scene.solids),
        float(need.error),
        need.counts,
        marks,
    )


def _within_scene(
    scene: Scene, geometry: ConeVec, shape: Shape2, within: Within, out: Float32Array
) -> None:
    """Fill `out` with line integrals of solids, as `paths_within`."""
    from flexdt.twin.projection.kernels import within_kernels

    if not scene.solids:
        return
    shapes, quadric, slabs, ranges, hull = _shapes(scene)
    rays = run_through(geometry, hull).rays(shape)
    within_kernels.chords_within(
        quadric,
        slabs,
        ranges,
        _wide_shadows(shapes, rays, shape),
        rays,
        np.array([solid.mu_per_mm for solid in scene.solids], np.float64),
        within.pixels,
        within.marks,
        within.starts,
        shape,
        TILE_PIXELS,
        out,
    )


def _mesh_rays(
    mesh: TriangleMesh, geometry: ConeVec, shape: Shape2
) -> tuple[FloatArray, FloatArray]:
    """Compute rays behind a mesh, moved aside as `project_mesh` does, and the matrices to
    pixels."""
    ends = np.stack([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)], axis=1)
    geometry = run_through(geometry, np.array(list(product(*ends))))
    rays = geometry.rays(shape)
    rays[:, 3:6] += RAY_OFFSET_PX[0] * geometry.u + RAY_OFFSET_PX[1] * geometry.v
    basis = np.stack([geometry.u, geometry.v, rays[:, 3:6]], axis=2)
    return rays, np.ascontiguousarray(np.linalg.inv(basis))


def edges_of(faces: IntArray) -> IntArray:
    """List the edges of a closed mesh with the two faces at each, (e, 4): where more than
    two faces share an edge, pairs of them."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ends.sort(axis=1)
    owner = np.tile(np.arange(len(faces)), 3)
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    ends, owner = ends[order], owner[order]
    pair = np.flatnonzero((ends[1:] == ends[:-1]).all(axis=1))
    return np.column_stack([ends[pair], owner[pair], owner[pair + 1]]).astype(np.int64)


def _mark_mesh(
    mesh: TriangleMesh, geometry: ConeVec, need: Need, weight: float, marks: Marks
) -> None:
    """Raise marks to the rays that a mesh needs."""
    from flexdt.twin.projection.kernels import within_kernels

    if not marks.size or weight == 0.0:
        return
    rays, inverses = _mesh_rays(mesh, geometry, (marks.shape[1], marks.shape[2]))
    within_kernels.mark_mesh(
        mesh.vertices,
        mesh.faces,
        edges_of(mesh.faces),
        rays,
        inverses,
        float(weight),
        float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))),
        float(need.error),
        need.counts,
        marks,
    )


def _within_mesh(
    mesh: TriangleMesh,
    geometry: ConeVec,
    shape: Shape2,
    within: Within,
    out: Float32Array,
) -> None:
    """Fill `out` with path lengths through a mesh, as `paths_within`."""
    from flexdt.twin.projection.kernels import within_kernels

    rays, inverses = _mesh_rays(mesh, geometry, shape)
    marks = np.zeros((len(rays), *shape), np.uint8)
    starts = np.zeros((len(rays), *shape), np.int64)
    marks.reshape(-1)[within.pixels] = within.marks
    starts.reshape(-1)[within.pixels] = within.starts[:-1]
    sums = np.zeros(len(out))
    within_kernels.triangles_within(
        mesh.vertices, mesh.faces, rays, inverses, marks, starts, sums, BAND_ROWS
    )
    out[:] = sums


def _mark_voxels(volume: Volume, geometry: ConeVec, marks: Marks) -> None:
    """Set the marks in each view's rectangle around the shadow of the occupied box, and a pixel
    more, to `voxel_rays_a_side` rays a side (`rays_of`)."""
    occupied = volume.layout
    if occupied.empty or not marks.size:
        return
    shape = (marks.shape[1], marks.shape[2])
    side = voxel_rays_a_side(volume, geometry)
    low = np.array(occupied.low_mm)
    high = low + np.array(occupied.counts) * occupied.voxel_mm
    corners = np.array(list(product(*zip(low, high, strict=True))))
    rays = run_through(geometry, corners).rays(shape)
    for view, (r0, r1, c0, c1) in enumerate(corner_shadows(corners, rays, shape)):
        marks[view, max(r0 - 1, 0) : r1 + 1, max(c0 - 1, 0) : c1 + 1] = 2 * side - 1


def _within_voxels(
    volume: Volume, geometry: ConeVec, shape: Shape2, within: Within, out: Float32Array
) -> None:
    """Fill `out` with line integrals of voxels, as `paths_within`: each ray is that of the
    nearest of a voxel's, as exact lengths on a finer panel."""
    n = min(voxel_rays_a_side(volume, geometry), int(within.marks.max()) // 2 + 1)
    images = np.empty((1, shape[0] * n, shape[1] * n), np.float32)
    starts = within.starts
    edges = np.searchsorted(
        within.pixels, np.arange(len(geometry) + 1) * shape[0] * shape[1]
    )
    for view in range(len(geometry)):
        chosen = slice(edges[view], edges[view + 1])
        if chosen.start == chosen.stop:
            continue
        one = finer(geometry[view : view + 1], shape, n)
        forward(volume, one, out=images)
        r, c = np.divmod(within.pixels[chosen] - view * shape[0] * shape[1], shape[1])
        marks = within.marks[chosen]
        first = starts[:-1][chosen]
        for mark in np.unique(marks).tolist():
            some = marks == mark
            across, down = ray_offsets(mark)
            rows = n * r[some, None] + np.floor((down + 0.5) * n).astype(np.int64)
            cols = n * c[some, None] + np.floor((across + 0.5) * n).astype(np.int64)
            out[first[some, None] + np.arange(len(across))] = images[0][rows, cols]


def rays_of(marks: Marks) -> IntArray:
    """Compute the number of rays of marks: of 2 n - 1 there are n x n, of 2 n n x (n + 1)."""
    return RAYS[marks]


def ray_offsets(mark: int) -> tuple[FloatArray, FloatArray]:
    """Place a pixel's rays from its center, (columns, rows) of (rays,): no two in a row
    or column, so that edges along them get as many steps.
    """
    a, b = (mark + 1) // 2, mark // 2 + 1
    j, i = np.divmod(np.arange(a * b), a)
    return (i + (j + 0.5) / b) / a - 0.5, (j + (a - i - 0.5) / a) / b - 0.5
