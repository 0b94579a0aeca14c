"""Convex solids as values: shape of a collision body, and its support in any direction.

Two kinds are enough: the hull of points, and the upright cylinder. Each has a support
function (how far it reaches in a direction), which is all that a proof of separation
needs: for any direction n the gap between two supports is a lower bound of the distance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import shape_words
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.description import Vector3

IntArray = npt.NDArray[np.int32]

_CORNERS = np.array(
    [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float
)
_BOX_FACES = np.array(
    [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
        [1, 5, 7],
        [1, 7, 3],
    ],
    dtype=np.int32,
)
"""Outward triangles of a box over `_CORNERS`."""


class ConvexSolid(Protocol):
    """Interface of a convex solid, in the frame of the body that carries it."""

    def farthest(self, directions: FloatArray) -> FloatArray:
        """Return a point of the solid farthest along each direction, (..., 3) both."""

    def support(self, directions: FloatArray) -> FloatArray:
        """Compute the largest p . direction over the solid's points p, (...) [mm]."""
        return np.asarray((directions * self.farthest(directions)).sum(axis=-1))

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper corner of the axis-aligned box around it,
        (3,) each [mm]."""

    def radius_about(self, axis: FloatArray) -> float:
        """Compute the largest distance of any point from the line through the origin
        along `axis` [mm]."""

    def is_round(self, axis: FloatArray) -> bool:
        """Return whether turning about that line leaves the solid unchanged."""


@dataclass(frozen=True, eq=False)
class Polytope(ConvexSolid):
    """The convex hull of `vertices` (k, 3) [mm]; `faces` (m, 3) are its outward triangles."""

    vertices: FloatArray
    faces: IntArray

    def __post_init__(self) -> None:
        """Copy the vertices as read-only float64; raise ValueError unless they are finite
        and (k, 3).

        The faces are neither copied nor checked.
        """
        vertices = np.array(self.vertices, dtype=np.float64)
        if (
            vertices.ndim != 2
            or vertices.shape[1] != 3
            or not np.isfinite(vertices).all()
        ):
            raise ValueError(
                f"vertices have shape {shape_words(vertices.shape)}; allowed: k x 3, finite"
            )
        vertices.setflags(write=False)
        object.__setattr__(self, "vertices", vertices)

    def farthest(self, directions: FloatArray) -> FloatArray:
        """Find the vertex farthest along each of `directions` (..., 3): (..., 3) [mm]; of
        equals the first.
        """
        corner: FloatArray = self.vertices[
            np.argmax(directions @ self.vertices.T, axis=-1)
        ]
        return corner

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """See `ConvexSolid`."""
        return self.vertices.min(axis=0), self.vertices.max(axis=0)

    def radius_about(self, axis: FloatArray) -> float:
        """Compute the largest distance of a vertex from the line through the origin along
        `axis` [mm].
        """
        along = self.vertices @ axis
        squared = np.einsum("ij,ij->i", self.vertices, self.vertices) - along * along
        return math.sqrt(max(0.0, float(squared.max())))

    def is_round(self, axis: FloatArray) -> bool:
        """See `ConvexSolid`: never."""
        return False


@dataclass(frozen=True)
class UprightCylinder(ConvexSolid):
    """An upright cylinder, its axis along z: `center`, `radius` and full `height` [mm]."""

    center: Vector3
    radius: float
    height: float

    def farthest(self, directions: FloatArray) -> FloatArray:
        """Find the point farthest along each of `directions` (..., 3): (..., 3) [mm], on a rim.

        For a vertical direction it is the middle of the end face; a horizontal one gets a rim by
        the sign of its zero."""
        across = np.hypot(directions[..., 0], directions[..., 1])
        out = directions * (self.radius / np.where(across > 0.0, across, 1.0))[..., None]
        out[..., 2] = np.copysign(0.5 * self.height, directions[..., 2])
        return np.asarray(out + self.center)

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return the lowest and highest corner of the box around the cylinder, (3,) each [mm]."""
        half = np.array([self.radius, self.radius, 0.5 * self.height])
        return np.array(self.center) - half, np.array(self.center) + half

    def radius_about(self, axis: FloatArray) -> float:
        """Compute the largest distance from a line through the origin along `axis` (3,) [mm].

        Exact for an upright axis; else that of the bounding box, an upper bound.
        """
        if self._upright(axis):
            return self.radius + math.hypot(*self.center[:2])
        # The farthest point of the two rims' bounding squares: never too small.
        lower, upper = self.bounds()
        return box(upper - lower, 0.5 * (lower + upper)).radius_about(axis)

    def is_round(self, axis: FloatArray) -> bool:
        """See `ConvexSolid`: about its own axis."""
        return self._upright(axis) and self.center[0] == 0.0 and self.center[1] == 0.0

    def prism(self, sides: int = 48) -> Polytope:
        """Make a prism that contains the cylinder, with as many sides as `sides`, each
        touching it.

        Its edges are 0.2 % of the radius outside for 48 sides.
        """
        angle = 2.0 * math.pi * np.arange(sides) / sides
        rim = (
            self.radius
            / math.cos(math.pi / sides)
            * np.stack([np.cos(angle), np.sin(angle)])
        )
        ends = [
            np.vstack([rim, np.full(sides, s * self.height / 2)]).T for s in (-1.0, 1.0)
        ]
        return hull(np.concatenate(ends) + self.center)

    @staticmethod
    def _upright(axis: FloatArray) -> bool:
        """Return whether `axis` is vertical."""
        return bool(axis[0] == 0.0 and axis[1] == 0.0)


def box(size: npt.ArrayLike, center: npt.ArrayLike = (0.0, 0.0, 0.0)) -> Polytope:
    """Make the box with edges `size` (3,) about `center` (3,) [mm], along the frame's axes."""
    half = 0.5 * np.asarray(size, dtype=np.float64)
    return Polytope(_CORNERS * half + np.asarray(center, dtype=np.float64), _BOX_FACES)


def hull(points: npt.ArrayLike) -> Polytope:
    """Compute the convex hull of points, with faces turned outwards.

    Vertices inside are dropped. A flat or thin set is thickened by a micrometer in all
    directions, so that every hull is a solid.

    Args:
        points: (k, 3) [mm], finite.
    """
    from scipy.spatial import ConvexHull, QhullError

    p = np.asarray(points, dtype=np.float64)
    try:
        convex = ConvexHull(p)
    except QhullError:
        p = np.concatenate([p + 1e-3 * corner for corner in _CORNERS])
        convex = ConvexHull(p)
    corners = p[convex.simplices]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("ij,ij->i", normals, convex.equations[:, :3]) < 0
    simplices = convex.simplices.copy()
    simplices[inward] = simplices[inward][:, ::-1]
    used, faces = np.unique(simplices, return_inverse=True)
    return Polytope(p[used], faces.reshape(-1, 3).astype(np.int32))
