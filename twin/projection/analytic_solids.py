"""Analytic solids with exact chords, as frozen values: the parts of a phantom; and what the kernels
make of them.

Attenuation is additive: a scene's line integral is the sum over its solids of chord length times
`mu_per_mm`, so a bead inside a brick carries the difference (bead minus brick) and a hole carries
minus the surrounding. Coordinates are in the object's frame, mm. `analytic` computes the chords.

For the kernels a solid is an optional quadric and a list of slabs. A sphere, ellipsoid or cylinder
is |M (p - c)| <= 1; a box, the ends of a cylinder and a convex polyhedron are slabs
low <= n . p <= high. A ray meets their intersection in one interval. Shapes are encoded here, and
the pixels found that their shadows can reach.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import assert_never

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.conventions import FloatArray

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]
IDENTITY: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True)
class Sphere:
    """Ball of `radius` [mm] about `center` [mm]."""

    center: Vector
    radius: float


@dataclass(frozen=True)
class Box:
    """Cuboid of full `size` [mm] about `center`; rows of `axes` are its edge directions."""

    center: Vector
    size: Vector
    axes: Matrix = IDENTITY


@dataclass(frozen=True)
class Cylinder:
    """Finite circular cylinder: `center` [mm], unit `axis`, `radius` and full `height` [mm]."""

    center: Vector
    radius: float
    height: float
    axis: Vector = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Ellipsoid:
    """Ellipsoid with `semi_axes` [mm] about `center`; rows of `axes` are their directions."""

    center: Vector
    semi_axes: Vector
    axes: Matrix = IDENTITY


@dataclass(frozen=True)
class ConvexPolyhedron:
    """Intersection of half-spaces n . p <= d: `normals` (unit) and `offsets` [mm]."""

    normals: tuple[Vector, ...]
    offsets: tuple[float, ...]


Shape = Sphere | Box | Cylinder | Ellipsoid | ConvexPolyhedron


@dataclass(frozen=True)
class Solid:
    """A shape filled with `material`, whose attenuation adds `mu_per_mm` [1/mm] (may be < 0)."""

    shape: Shape
    material: str
    mu_per_mm: float


@dataclass(frozen=True)
class Scene:
    """Solids whose line integrals add up."""

    solids: tuple[Solid, ...]


IntArray = npt.NDArray[np.int64]
UNIT_TOLERANCE = 1e-6
"""How far directions may be from orthonormal."""


@dataclass(frozen=True, eq=False)
class Convex:
    """One shape: M and c of the quadric (M = 0 if none), slabs (k, 5) = n, low, high [mm], and
    what bounds it: the semi-axes of an ellipsoid (3, 3), or corner points (m, 3), or neither.
    """

    matrix: FloatArray
    center: FloatArray
    slabs: FloatArray
    semi_axes: FloatArray | None = None
    corners: FloatArray | None = None

    @property
    def curved(self) -> bool:
        """True when there is a quadric."""
        return bool(self.matrix.any())


@dataclass(frozen=True, eq=False)
class ConvexTable:
    """Several shapes as arrays: quadric (k, 13) = has one, M, c; slabs (m, 5), slab_range
    (k, 2).
    """

    shapes: tuple[Convex, ...]
    quadric: FloatArray
    slabs: FloatArray
    slab_range: IntArray


def encode(shapes: Sequence[Shape]) -> ConvexTable:
    """Shapes as tables for the kernel.

    Raises:
        GeometryError: a size is not positive, a direction not of unit length, or a polyhedron is
            unbounded or empty.
    """
    convex = tuple(as_convex(shape) for shape in shapes)
    quadric = np.zeros((len(convex), 13))
    ranges = np.zeros((len(convex), 2), np.int64)
    slabs: list[FloatArray] = [np.zeros((0, 5))]
    start = 0
    for i, one in enumerate(convex):
        quadric[i] = [float(one.curved), *one.matrix.ravel(), *one.center]
        ranges[i] = start, start + len(one.slabs)
        start += len(one.slabs)
        slabs.append(one.slabs)
    return ConvexTable(convex, quadric, np.concatenate(slabs), ranges)


def as_convex(shape: Shape) -> Convex:
    """One shape as quadric and slabs."""
    none = np.zeros((0, 5))
    match shape:
        case Sphere(center, radius):
            _positive(shape, radius)
            semi = radius * np.eye(3)
            return Convex(np.eye(3) / radius, np.array(center), none, semi_axes=semi)
        case Ellipsoid(center, sizes, axes):
            _positive(shape, *sizes)
            a = _orthonormal(shape, axes)
            scale = np.array(sizes)[:, None]
            return Convex(a / scale, np.array(center), none, semi_axes=a * scale)
        case Box(center, size, axes):
            _positive(shape, *size)
            a = _orthonormal(shape, axes)
            middle, half = np.array(center), np.array(size) / 2
            at = a @ middle
            slabs = np.column_stack([a, at - half, at + half])
            return Convex(np.zeros((3, 3)), middle, slabs, corners=_corners(middle, a, half))
        case Cylinder(center, radius, height, axis):
            _positive(shape, radius, height)
            k = _unit(shape, axis)
            side = np.eye(3)[int(np.argmin(np.abs(k)))]
            e1 = np.cross(k, side)
            e1 /= np.linalg.norm(e1)
            e2 = np.cross(k, e1)
            middle = np.array(center)
            at = float(k @ middle)
            matrix = np.stack([e1, e2, np.zeros(3)]) / radius
            slabs = np.array([[*k, at - height / 2, at + height / 2]])
            half = np.array([radius, radius, height / 2])
            return Convex(
                matrix, middle, slabs, corners=_corners(middle, np.stack([e1, e2, k]), half)
            )
        case ConvexPolyhedron(normals, offsets):
            corners = polyhedron_corners(shape)
            low = np.full(len(offsets), -np.inf)
            slabs = np.column_stack([[_unit(shape, n) for n in normals], low, offsets])
            return Convex(np.zeros((3, 3)), corners.mean(axis=0), slabs, corners=corners)
        case _:
            assert_never(shape)


def shadows(table: ConvexTable, rays: FloatArray, shape: tuple[int, int]) -> IntArray:
    """Pixels each solid can darken: (n, k, 4) = first row, last row + 1, first column, last + 1.

    Args:
        table: solids.
        rays: (n, 12) as of `ConeVec.rays`.
        shape: detector (rows, cols).
    """
    result = np.empty((len(rays), len(table.shapes), 4), np.int64)
    for i, one in enumerate(table.shapes):
        if one.semi_axes is None:
            assert one.corners is not None
            result[:, i] = corner_shadows(one.corners, rays, shape)
            continue
        source, first, u, v, normal = _frame(rays)
        row = _tangents(one, source, np.cross(first, u), np.cross(v, u), normal)
        column = _tangents(one, source, np.cross(first, v), np.cross(u, v), normal)
        result[:, i] = _pixels(row, column, shape)
    return result


def corner_shadows(corners: FloatArray, rays: FloatArray, shape: tuple[int, int]) -> IntArray:
    """Pixels that the convex hull of points can darken, (n, 4) as in `shadows`; all pixels when a
    point is not in front of the source.

    Args:
        corners: (m, 3) [mm].
        rays: (n, 12) as of `ConeVec.rays`.
        shape: detector (rows, cols).
    """
    row, column = _spans(corners, *_frame(rays))
    return _pixels(row, column, shape)


def _frame(rays: FloatArray) -> tuple[FloatArray, ...]:
    """Source, first pixel's centre from the source, u, v, and the normal away from the source."""
    source, first, u, v = (rays[:, i : i + 3] for i in (0, 3, 6, 9))
    normal = np.cross(u, v)
    normal *= np.where(np.einsum("ni,ni->n", first, normal) < 0, -1.0, 1.0)[:, None]
    return source, first, u, v, normal


def _pixels(
    row: tuple[FloatArray, FloatArray],
    column: tuple[FloatArray, FloatArray],
    shape: tuple[int, int],
) -> IntArray:
    """Real ranges of pixel coordinates as whole pixels, (n, 4)."""
    result = np.empty((len(row[0]), 4), np.int64)
    for at, span, count in ((0, row, shape[0]), (2, column, shape[1])):
        result[:, at] = np.clip(np.ceil(span[0] - 1e-6), 0, count)
        result[:, at + 1] = np.clip(np.floor(span[1] + 1e-6) + 1, 0, count)
    return result


def _tangents(
    one: Convex, source: FloatArray, plane: FloatArray, step: FloatArray, normal: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Pixel coordinates whose planes plane + coordinate * step touch an ellipsoid, (n,) each.

    A plane through the source with normal m touches when (m . p)^2 = |E m|^2, p the centre seen
    from the source: a quadratic in the coordinate.
    """
    assert one.semi_axes is not None
    p = one.center - source
    e = one.semi_axes.T
    a0, a1 = np.einsum("ni,ni->n", plane, p), np.einsum("ni,ni->n", step, p)
    e0, e1 = plane @ e, step @ e
    qa = a1 * a1 - np.einsum("ni,ni->n", e1, e1)
    qb = a0 * a1 - np.einsum("ni,ni->n", e0, e1)
    qc = a0 * a0 - np.einsum("ni,ni->n", e0, e0)
    ahead = np.einsum("ni,ni->n", normal, p) > np.linalg.norm(normal @ e, axis=1) * (1 + 1e-9)
    with np.errstate(all="ignore"):
        root = np.sqrt(np.maximum(qb * qb - qa * qc, 0.0))
        ends = np.sort(np.stack([(-qb - root) / qa, (-qb + root) / qa]), axis=0)
    good = ahead & np.isfinite(ends).all(axis=0) & (qa > 0)
    return np.where(good, ends[0], -np.inf), np.where(good, ends[1], np.inf)


def _spans(
    corners: FloatArray,
    source: FloatArray,
    first: FloatArray,
    u: FloatArray,
    v: FloatArray,
    normal: FloatArray,
) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
    """Extreme (rows, columns) of projected corner points, (n,) each; infinite when some corner is
    not in front of the source.
    """
    ray = corners[None] - source[:, None]
    depth = np.einsum("nki,ni->nk", ray, normal)
    good = (depth > 1e-9 * np.abs(depth).max(axis=1, keepdims=True)).all(axis=1)
    basis = np.stack([u, v, first], axis=2)
    spans = []
    with np.errstate(all="ignore"):
        weights = np.einsum("nij,nkj->nki", np.linalg.inv(basis), ray)
        for i in (1, 0):
            at = weights[:, :, i] / weights[:, :, 2]
            low, high = at.min(axis=1), at.max(axis=1)
            spans.append((np.where(good, low, -np.inf), np.where(good, high, np.inf)))
    return spans[0], spans[1]


def _corners(center: FloatArray, axes: FloatArray, half: FloatArray) -> FloatArray:
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    return np.asarray(center + (signs * half) @ axes)


def polyhedron_corners(shape: ConvexPolyhedron) -> FloatArray:
    """Corner points of an intersection of half-spaces, (m, 3) [mm].

    Raises:
        GeometryError: a normal is not of unit length, or the half-spaces enclose no bounded solid.
    """
    from scipy.optimize import linprog
    from scipy.spatial import HalfspaceIntersection, QhullError

    n = np.array([_unit(shape, normal) for normal in shape.normals]).reshape(-1, 3)
    d = np.array(shape.offsets, dtype=np.float64)
    if len(n) != len(d) or len(n) < 4:
        raise GeometryError(
            f"polyhedron with {len(n)} normals and {len(d)} offsets; allowed: the same number of "
            "both, at least 4"
        )
    # The centre of the largest inscribed ball is an interior point.
    limits = [(None, None)] * 3 + [(0.0, None)]
    ball = linprog([0, 0, 0, -1], np.column_stack([n, np.ones(len(n))]), d, bounds=limits)
    try:
        if ball.status == 0 and ball.x[3] > 0.0:
            with np.errstate(all="ignore"):  # an unbounded one has corners at infinity
                found = HalfspaceIntersection(np.column_stack([n, -d]), ball.x[:3])
            # Bounded exactly when the hull of the dual points holds the origin.
            if (found.dual_equations[:, 3] < -1e-12).all():
                return np.asarray(found.intersections)
    except QhullError:  # the dual points lie in a plane
        pass
    raise GeometryError("the half-spaces of a polyhedron enclose no bounded solid")


def _positive(shape: Shape, *sizes: float) -> None:
    if not all(math.isfinite(size) and size > 0 for size in sizes):
        raise GeometryError(f"{shape!r}: every size must be positive and finite [mm]")


def _unit(shape: Shape, direction: Vector) -> FloatArray:
    k = np.array(direction, dtype=np.float64)
    if k.shape != (3,) or abs(np.linalg.norm(k) - 1) > UNIT_TOLERANCE:
        raise GeometryError(f"{shape!r}: direction {direction!r} is not a unit vector")
    return np.asarray(k / np.linalg.norm(k))


def _orthonormal(shape: Shape, axes: Matrix) -> FloatArray:
    a = np.array(axes, dtype=np.float64)
    if a.shape != (3, 3) or np.abs(a @ a.T - np.eye(3)).max() > UNIT_TOLERANCE:
        raise GeometryError(f"{shape!r}: axes are not orthonormal rows")
    return a
