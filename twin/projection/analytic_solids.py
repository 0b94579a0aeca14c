"""Analytic solids with exact chords, as frozen values: the parts of a phantom; and the
arrays that the kernels make of them.

Attenuation is additive: a scene's line integral is the sum over its solids of chord length
times `mu_per_mm`, so a bead inside a brick carries the difference (bead minus brick) and a hole
carries minus the surrounding. Coordinates are in the object's frame, mm. `analytic` computes
the chords.

For the kernels a solid is an optional quadric and a list of slabs. A sphere, ellipsoid or
cylinder
is |M (p - c)| <= 1; a box, the ends of a cylinder and a convex polyhedron are slabs
low <= n . p <= high. A ray meets their intersection in one interval. Shapes are encoded here,
and the pixels found that their shadows can reach.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import assert_never

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.conventions import FloatArray

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]
IDENTITY: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
IntArray = npt.NDArray[np.int64]
KEPT_SHAPES = 4096
"""Shapes whose conversion is kept: a scene is often projected again."""
UNIT_TOLERANCE = 1e-6
"""Largest deviation of directions from orthonormal ones."""


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
    """A shape filled with `material`, whose attenuation adds `mu_per_mm` [1/mm] (may be <
    0)."""

    shape: Shape
    material: str
    mu_per_mm: float


@dataclass(frozen=True)
class Scene:
    """Solids whose line integrals add up."""

    solids: tuple[Solid, ...]


@dataclass(frozen=True, eq=False)
class Convex:
    """One shape: M and c of the quadric (M = 0 if none), slabs (k, 5) = n, low, high [mm],
        and
    what bounds it: the semi-axes of an ellipsoid (3, 3), or corner points (m, 3), or
        neither.
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


def as_convex(shape: Shape) -> Convex:
    """Convert one shape to its quadric and slabs, with corners or semi-axes [mm].

    A slab is a normal (3), low and high end along it. Raises GeometryError: a size, axes,
    or an open polyhedron.
    """
    try:
        return _kept_convex(shape)
    except TypeError:  # a list or an array among its values cannot be looked up
        return _convex(shape)


def _convex(shape: Shape) -> Convex:
    """Convert one shape, see `as_convex`."""
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
            middle = np.array(center)
            half = np.array(size) / 2
            at = a @ middle
            slabs = np.column_stack([a, at - half, at + half])
            return Convex(
                np.zeros((3, 3)), middle, slabs, corners=_corners(middle, a, half)
            )
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
                matrix,
                middle,
                slabs,
                corners=_corners(middle, np.stack([e1, e2, k]), half),
            )
        case ConvexPolyhedron(normals, offsets):
            corners = polyhedron_corners(shape)
            low = np.full(len(offsets), -np.inf)
            slabs = np.column_stack([[_unit(shape, n) for n in normals], low, offsets])
            return Convex(np.zeros((3, 3)), corners.mean(axis=0), slabs, corners=corners)
        case _:
            assert_never(shape)


@lru_cache(maxsize=KEPT_SHAPES)
def _kept_convex(shape: Shape) -> Convex:
    """Convert one shape, or return the result of an equal one."""
    one = _convex(shape)
    for array in vars(one).values():
        if array is not None:
            array.setflags(write=False)
    return one


def hull_points(one: Convex) -> FloatArray:
    """Compute points whose convex hull holds a solid, (k, 3) [mm]: its corners, or those
    of a round solid's box.
    """
    if one.corners is not None:
        return one.corners
    assert one.semi_axes is not None
    return _corners(one.center, np.eye(3), np.linalg.norm(one.semi_axes, axis=0))


def shadows(
    shapes: Sequence[Convex], rays: FloatArray, shape: tuple[int, int]
) -> IntArray:
    """Find the pixels that each solid can darken.

    The box around a solid's shadow, cut to the panel. A solid that is not wholly before the
    source can darken all pixels.

    `shapes`: the k solids; `rays`: (n, 12) as of `ConeVec.rays`; `shape`: detector (rows, cols).
    Returns int64 (n, k, 4) first row, last row + 1, first column, last column + 1; without a
    pixel the first is not below the last.
    """
    result = np.empty((len(rays), len(shapes), 4), np.int64)
    inverse = _inverses(rays)
    hulls = [(i, one.corners) for i, one in enumerate(shapes) if one.corners is not None]
    if hulls:
        which, corners = zip(*hulls, strict=True)
        ranges = _hull_ranges(corners, rays, inverse)
        result[:, list(which)] = _pixels(*ranges, shape)
    balls = [i for i, one in enumerate(shapes) if one.corners is None]
    if balls:
        ranges = _ellipsoid_ranges([shapes[i] for i in balls], rays, inverse)
        result[:, balls] = _pixels(*ranges, shape)
    return result


def corner_shadows(
    corners: FloatArray, rays: FloatArray, shape: tuple[int, int]
) -> IntArray:
    """Find the pixels that the convex hull of points (m, 3) can darken, as `shadows`."""
    return _pixels(*_hull_ranges([corners], rays, _inverses(rays)), shape)[:, 0]


Ranges = tuple[FloatArray, FloatArray, npt.NDArray[np.bool_]]
"""Least and largest column and row of k shadows in n views, (n, k, 2) each, and (n, k) the
solid is wholly in front of the source, so that they are known."""


def _hull_ranges(
    corners: Sequence[FloatArray], rays: FloatArray, inverse: FloatArray
) -> Ranges:
    """Compute the ranges of the shadows of convex hulls.

    Args:
        corners: (m, 3) points of each hull [mm].
        rays: (n, 12) as of `ConeVec.rays`.
        inverse: (n, 3, 3) of `_inverses`.
    """
    starts = np.cumsum([0, *(len(points) for points in corners[:-1])])
    points = np.concatenate(corners).T
    at = inverse @ (points - rays[:, :3, None])
    depth = at[:, 2]
    largest = np.maximum.reduceat(np.abs(depth), starts, axis=1)
    ahead = np.minimum.reduceat(depth, starts, axis=1) > 1e-9 * largest
    with np.errstate(all="ignore"):
        pixels = at[:, :2] / at[:, 2:]
    low = np.minimum.reduceat(pixels, starts, axis=2)
    high = np.maximum.reduceat(pixels, starts, axis=2)
    return low.transpose(0, 2, 1), high.transpose(0, 2, 1), ahead


def _ellipsoid_ranges(
    shapes: Sequence[Convex], rays: FloatArray, inverse: FloatArray
) -> Ranges:
    """Compute the ranges of the shadows of balls and ellipsoids.

    With the center q and semi-axes F in pixels and depths, a plane through the source
    with normal m touches an ellipsoid when (m . q)^2 = |F' m|^2. For the normals of columns
    and rows, (1, 0, -x) and (0, 1, -x), that is a quadratic in x.

    Args:
        shapes: with semi-axes.
        rays: (n, 12) as of `ConeVec.rays`.
        inverse: (n, 3, 3) of `_inverses`.
    """
    centers = np.array([one.center for one in shapes])
    semi_axes = np.array([one.semi_axes for one in shapes])
    q = (centers - rays[:, None, :3]) @ inverse.transpose(0, 2, 1)
    f = inverse[:, None] @ semi_axes.transpose(0, 2, 1)
    d = q[..., None] * q[..., None, :] - f @ f.transpose(0, 1, 3, 2)
    with np.errstate(all="ignore"):
        middle = d[..., :2, 2]
        square = d[..., 2:, 2]
        end = np.stack([d[..., 0, 0], d[..., 1, 1]], axis=-1)
        half = np.sqrt(np.maximum(middle * middle - end * square, 0.0))
        low = (middle - half) / square
        high = (middle + half) / square
    ahead = q[..., 2] > np.linalg.norm(f[..., 2, :], axis=-1) * (1 + 1e-9)
    return low, high, ahead


def _inverses(rays: FloatArray) -> FloatArray:
    """Compute matrices that map points seen from the source to (column, row, 1) times depth.
    Depth is in distances of the panel. Returns (n, 3, 3)."""
    basis = np.stack([rays[:, 6:9], rays[:, 9:12], rays[:, 3:6]], axis=2)
    return np.asarray(np.linalg.inv(basis))


def _pixels(
    low: FloatArray,
    high: FloatArray,
    ahead: npt.NDArray[np.bool_],
    shape: tuple[int, int],
) -> IntArray:
    """Convert ranges of columns and rows to whole pixels.

    `low`: (..., 2) least column and row. `high`: (..., 2) largest. `ahead`: (...) the range is
    known; otherwise all pixels are taken. `shape`: (rows, cols).
    Returns (..., 4) first row, row after the last, first column, column after the last.
    """
    known = ahead[..., None]
    size = np.array(shape[::-1], dtype=np.float64)
    first = np.where(known, np.ceil(low - 1e-6), 0.0)
    last = np.where(known, np.floor(high + 1e-6) + 1.0, size)
    out = np.empty((*ahead.shape, 4), dtype=np.int64)
    out[..., 2::-2] = np.minimum(np.maximum(first, 0.0), size)
    out[..., 3::-2] = np.minimum(np.maximum(last, 0.0), size)
    return out


def _corners(center: FloatArray, axes: FloatArray, half: FloatArray) -> FloatArray:
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    return np.asarray(center + (signs * half) @ axes)


def polyhedron_corners(shape: ConvexPolyhedron) -> FloatArray:
    """Compute the corner points of an intersection of half-spaces, (m, 3) [mm].

    Raises:
        GeometryError: a normal is not of unit length, fewer than four half-spaces,
            another number of offsets than of normals, or the half-spaces enclose no
            bounded solid.
    """
    from scipy.optimize import linprog
    from scipy.spatial import HalfspaceIntersection, QhullError

    n = np.array([_unit(shape, normal) for normal in shape.normals]).reshape(-1, 3)
    d = np.array(shape.offsets, dtype=np.float64)
    if len(n) != len(d) or len(n) < 4:
        raise GeometryError(
            f"polyhedron with {len(n)} normals and {len(d)} offsets; allowed: the same "
            "number of both, at least 4"
        )
    # The centre of the largest inscribed ball is an interior point.
    limits = [(None, None)] * 3 + [(0.0, None)]
    ball = linprog([0, 0, 0, -1], np.column_stack([n, np.ones(len(n))]), d, bounds=limits)
    try:
        if ball.status == 0 and ball.x[3] > 0.0:
            with np.errstate(all="ignore"):  # an unbounded one has corners at infinity
                solid = HalfspaceIntersection(np.column_stack([n, -d]), ball.x[:3])
            # Bounded exactly when the hull of the dual points holds the origin.
            if (solid.dual_equations[:, 3] < -1e-12).all():
                return np.asarray(solid.intersections)
    except QhullError:  # the dual points lie in a plane
        pass
    raise GeometryError("the half-spaces of a polyhedron enclose no bounded solid")


def _positive(shape: Shape, *sizes: float) -> None:
    if not all(math.isfinite(size) and size > 0 for size in sizes):
        raise GeometryError(f"{shape!r}: every size must be positive and finite [mm]")


def _unit(shape: Shape, direction: Vector) -> FloatArray:
    """Check that a direction of a shape is a unit vector, and return it normalized, (3,).

    Raises GeometryError: its length differs from 1 by more than `UNIT_TOLERANCE`.
    """
    k = np.array(direction, dtype=np.float64)
    if k.shape != (3,) or abs(np.linalg.norm(k) - 1) > UNIT_TOLERANCE:
        raise GeometryError(f"{shape!r}: direction {direction!r} is not a unit vector")
    return np.asarray(k / np.linalg.norm(k))


def _orthonormal(shape: Shape, axes: Matrix) -> FloatArray:
    """Check that the axes of a shape are orthonormal rows, and return them as an array (3, 3).

    Raises GeometryError: a dot product differs by more than `UNIT_TOLERANCE`.
    """
    a = np.array(axes, dtype=np.float64)
    if a.shape != (3, 3) or np.abs(a @ a.T - np.eye(3)).max() > UNIT_TOLERANCE:
        raise GeometryError(f"{shape!r}: axes are not orthonormal rows")
    return a
