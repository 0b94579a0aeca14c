"""Convex solids as values: what a collision body is made of, and its support in any direction.

Two kinds are enough: the hull of points, and the upright cylinder. Each has a support function (how
far it reaches in a direction), which is all that a proof of separation needs: for any direction n
the gap between two supports is a lower bound of the distance.

`outer_hull` is a convex body of few corners around many points, for parts whose meshes have
thousands. It is cut out of the points' box by planes on which the points' own hull lies, where it
stands out most first; so it contains the hull, a pose that is free with it is free, and flat faces
stay flat.

`convex_pieces` are a sample's mesh as convex pieces that contain it, because collision solids must
be convex. (A mesh inside a mesh has a distance to it and would count as free.) One hull contains
any mesh; where that wastes room, the mesh is cut in halves and each half gets a hull of its own, as
long as the hulls together shrink enough. The pieces always contain the solid, so a pose that is
free of them is free; they may stop a motion that passes through a hollow. Meshes are not repaired.

The distance of two solids comes with a certificate; this is the one module that wraps python-fcl.
fcl proposes the nearest points; the clearance that counts is then computed from the two solids'
supports along that direction, a lower bound of the true distance whatever fcl said. So an error of
the library can stop a motion too early but never call a touch free. fcl is imported when the first
pair is made. Its continuous collision (which misses contacts) is not used.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.description import MAX_POINTS, Vector3

IntArray = npt.NDArray[np.int32]

_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
_BOX_FACES = np.array(
    [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ],
    dtype=np.int32,
)  # fmt: skip
"""Outward triangles of a box over `_CORNERS`."""


class ConvexSolid(Protocol):
    """What the sweep asks of a convex solid, in the frame of the body that carries it."""

    def farthest(self, directions: FloatArray) -> FloatArray:
        """A point of the solid that lies farthest along each of directions, (..., 3) both."""

    def support(self, directions: FloatArray) -> FloatArray:
        """Largest p . direction over the solid's points p, (...) [mm, for unit directions]."""
        return np.asarray((directions * self.farthest(directions)).sum(axis=-1))

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper corner of the axis-aligned box around it, (3,) each [mm]."""

    def radius_about(self, axis: FloatArray) -> float:
        """Farthest distance of any point from the line through the origin along `axis` [mm]."""

    def is_round(self, axis: FloatArray) -> bool:
        """Whether turning about that line leaves it as it is."""


@dataclass(frozen=True, eq=False)
class Polytope(ConvexSolid):
    """The convex hull of `vertices` (k, 3) [mm]; `faces` (m, 3) are its outward triangles."""

    vertices: FloatArray
    faces: IntArray

    def __post_init__(self) -> None:
        vertices = np.array(self.vertices, dtype=np.float64)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or not np.isfinite(vertices).all():
            raise ValueError(f"vertices have shape {vertices.shape}; allowed: (k, 3), finite")
        vertices.setflags(write=False)
        object.__setattr__(self, "vertices", vertices)

    def farthest(self, directions: FloatArray) -> FloatArray:
        """See `ConvexSolid`."""
        corner: FloatArray = self.vertices[np.argmax(directions @ self.vertices.T, axis=-1)]
        return corner

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """See `ConvexSolid`."""
        return self.vertices.min(axis=0), self.vertices.max(axis=0)

    def radius_about(self, axis: FloatArray) -> float:
        """See `ConvexSolid`."""
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
        """See `ConvexSolid`."""
        across = np.hypot(directions[..., 0], directions[..., 1])
        out = directions * (self.radius / np.where(across > 0.0, across, 1.0))[..., None]
        out[..., 2] = np.copysign(0.5 * self.height, directions[..., 2])
        return np.asarray(out + self.center)

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """See `ConvexSolid`."""
        half = np.array([self.radius, self.radius, 0.5 * self.height])
        return np.array(self.center) - half, np.array(self.center) + half

    def radius_about(self, axis: FloatArray) -> float:
        """See `ConvexSolid`."""
        if self._upright(axis):
            return self.radius + math.hypot(*self.center[:2])
        # The farthest point of the two rims' bounding squares: never too small.
        lower, upper = self.bounds()
        return box(upper - lower, 0.5 * (lower + upper)).radius_about(axis)

    def is_round(self, axis: FloatArray) -> bool:
        """See `ConvexSolid`: about its own axis."""
        return self._upright(axis) and self.center[0] == 0.0 and self.center[1] == 0.0

    def prism(self, sides: int = 48) -> Polytope:
        """A prism around it; 48 sides stand out by 0.2 % of the radius at the edges."""
        angle = 2.0 * math.pi * np.arange(sides) / sides
        rim = self.radius / math.cos(math.pi / sides) * np.stack([np.cos(angle), np.sin(angle)])
        ends = [np.vstack([rim, np.full(sides, s * self.height / 2)]).T for s in (-1.0, 1.0)]
        return hull(np.concatenate(ends) + self.center)

    @staticmethod
    def _upright(axis: FloatArray) -> bool:
        return bool(axis[0] == 0.0 and axis[1] == 0.0)


def box(size: npt.ArrayLike, center: npt.ArrayLike = (0.0, 0.0, 0.0)) -> Polytope:
    """The box with edges `size` (3,) about `center` (3,) [mm], along the frame's axes."""
    half = 0.5 * np.asarray(size, dtype=np.float64)
    return Polytope(_CORNERS * half + np.asarray(center, dtype=np.float64), _BOX_FACES)


def hull(points: npt.ArrayLike) -> Polytope:
    """The convex hull of `points` (k, 3) [mm].

    Flat or thin point sets are thickened by a micrometre, outwards, so that every hull is a solid.
    """
    from scipy.spatial import ConvexHull, QhullError

    p = np.asarray(points, dtype=np.float64)
    try:
        found = ConvexHull(p)
    except QhullError:
        p = np.concatenate([p + 1e-3 * corner for corner in _CORNERS])
        found = ConvexHull(p)
    corners = p[found.simplices]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("ij,ij->i", normals, found.equations[:, :3]) < 0
    simplices = found.simplices.copy()
    simplices[inward] = simplices[inward][:, ::-1]
    used, faces = np.unique(simplices, return_inverse=True)
    return Polytope(p[used], faces.reshape(-1, 3).astype(np.int32))


MAX_PLANES: Final = 2000
"""Of the points' hull that are looked at; any of them are right."""
CLOSE_MM: Final = 0.01
"""What stands out less is not cut off."""
AT_ONCE: Final = 8
"""Planes that cut corners off at a time."""
LIFT: Final = 1e-9
"""By what part of its size the body is larger, so that rounding leaves no point outside."""


def outer_hull(points: npt.ArrayLike) -> Polytope:
    """A convex body that contains points and has at most `MAX_POINTS` corners.

    Args:
        points: (k, 3) [mm].

    Example:
        >>> ball = np.random.default_rng(1).normal(size=(3000, 3))
        >>> ball *= 50.0 / np.linalg.norm(ball, axis=1, keepdims=True)
        >>> around = outer_hull(ball)
        >>> len(around.vertices) <= 256, float(around.bounds()[1].max()) < 50.1
        (True, True)
    """
    exact = hull(points)
    if len(exact.vertices) <= MAX_POINTS:
        return exact
    planes = _planes(exact)
    low, high = exact.bounds()
    lift = LIFT * float((high - low).max())
    inside = exact.vertices.mean(axis=0)
    chosen = [np.concatenate([s * e, [-float((s * exact.vertices @ e).max()) - lift]])
              for e in np.eye(3) for s in (-1.0, 1.0)]  # fmt: skip
    corners = _corners(chosen, inside)
    while True:
        out = corners @ planes[:, :3].T + planes[:, 3]
        far, taken = out.max(axis=1), list[int]()
        while far.max() > CLOSE_MM and len(taken) < AT_ONCE:
            taken.append(int(np.argmax(out[np.argmax(far)])))
            far[out[:, taken[-1]] > 0.0] = 0.0  # what a plane cuts off needs no second one
        chosen += list(planes[taken] - [0.0, 0.0, 0.0, lift])
        cut = _corners(chosen, inside)
        if not taken or len(cut) > MAX_POINTS:
            return hull(corners)
        corners = cut


def _planes(solid: Polytope) -> FloatArray:
    """Outward planes (m, 4) of its largest faces: n . x + d <= 0 inside."""
    a, b, c = np.moveaxis(solid.vertices[solid.faces], 1, 0)
    normals = np.cross(b - a, c - a)
    areas = np.linalg.norm(normals, axis=1)
    normals = normals[areas > 0.0] / areas[areas > 0.0, None]
    heights = np.einsum("ij,ij->i", normals, a[areas > 0.0])
    _, first, same = np.unique(
        np.column_stack([normals, heights]).round(6), axis=0, return_index=True, return_inverse=True
    )
    large = np.argsort(np.bincount(same.ravel(), areas[areas > 0.0]))[-MAX_PLANES:]
    normals = normals[first[large]]
    reach = (normals @ solid.vertices.T).max(axis=1)  # a face's own height, but for rounding
    return np.column_stack([normals, -reach])


def _corners(planes: list[FloatArray], inside: FloatArray) -> FloatArray:
    from scipy.spatial import HalfspaceIntersection

    found = HalfspaceIntersection(np.array(planes), inside).intersections
    _, first = np.unique(found.round(6), axis=0, return_index=True)
    return np.asarray(found[first])


MAX_PIECES = 8
WORTHWHILE = 0.9
"""A cut must bring the volume of the hulls below this part of what it was."""
MAX_CUTTING_FACES = 50_000
"""Meshes with more faces get one hull, so that a large upload does not hold up the twin."""


class Mesh(Protocol):
    """A triangle mesh [mm, object frame]; trimesh's is one."""

    @property
    def vertices(self) -> npt.NDArray[np.float64]:
        """(n, 3) positions."""

    @property
    def faces(self) -> npt.NDArray[np.integer]:
        """(m, 3) indices of corners."""


def convex_pieces(
    mesh: Mesh,
    *,
    rotation: npt.ArrayLike | None = None,
    offset: npt.ArrayLike = (0.0, 0.0, 0.0),
    max_pieces: int = MAX_PIECES,
) -> tuple[Polytope, ...]:
    """Convex pieces that together contain the mesh's solid.

    Args:
        mesh: its surface [mm].
        rotation: (3, 3) turn of the sample on the stage, applied first.
        offset: (3,) shift on the stage [mm].
        max_pieces: at most so many.

    Raises:
        GeometryError: the mesh has no faces or is not finite.
    """
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    if len(mesh.faces) == 0 or not np.isfinite(vertices).all():
        what = f"a sample mesh needs faces and finite vertices; this has {len(mesh.faces)} faces"
        raise GeometryError(what, {"faces": len(mesh.faces), "vertices": len(vertices)})
    turn = np.eye(3) if rotation is None else np.asarray(rotation, dtype=np.float64)
    placed = vertices @ turn.T + np.asarray(offset, dtype=np.float64)
    triangles = placed[np.asarray(mesh.faces)]
    whole = _Piece(triangles)
    if len(triangles) > MAX_CUTTING_FACES:
        return (whole.hull,)
    pieces = [whole]
    finished: list[_Piece] = []
    while pieces and len(pieces) + len(finished) < max_pieces:
        pieces.sort(key=lambda p: p.volume)
        piece = pieces.pop()
        halves = _best_cut(piece)
        if halves is None:
            finished.append(piece)
        else:
            pieces += halves
    return tuple(p.hull for p in (*finished, *pieces))


class _Piece:
    """Triangles whose hull holds a part of the solid."""

    def __init__(self, triangles: FloatArray) -> None:
        self.triangles, self.hull = triangles, hull(triangles.reshape(-1, 3))
        corners = self.hull.vertices[self.hull.faces]
        self.volume = float(np.linalg.det(corners).sum()) / 6.0


def _best_cut(piece: _Piece) -> Sequence[_Piece] | None:
    """The halves of the best of a few cuts, or None when none is worthwhile."""
    points = piece.hull.vertices
    best, wanted = None, WORTHWHILE * piece.volume
    for axis in range(3):
        low, high = points[:, axis].min(), points[:, axis].max()
        for share in (0.25, 0.5, 0.75):
            at = low + share * (high - low)
            halves = [_clip(piece.triangles, axis, at, side) for side in (-1.0, 1.0)]
            if any(len(h) == 0 for h in halves):
                continue
            made = [_Piece(h) for h in halves]
            volume = sum(m.volume for m in made)
            if volume < wanted:
                best, wanted = made, volume
    return best


def _clip(triangles: FloatArray, axis: int, at: float, side: float) -> FloatArray:
    """The triangles on one side of a plane, and a convex cap over the cut that closes them."""
    height = side * (triangles[:, :, axis] - at)
    count = (height >= 0.0).sum(axis=1)
    one, two = count == 1, count == 2
    # The corner that is alone on its side comes first.
    alone = np.concatenate([_led_by(triangles[one], height[one], 1.0),
                            _led_by(triangles[two], height[two], -1.0)])  # fmt: skip
    lead, left, right = alone[:, 0], alone[:, 1], alone[:, 2]
    to_left, to_right = (_crossing(lead, end, axis, at) for end in (left, right))
    inner = np.arange(len(alone)) < one.sum()
    tips = np.stack([lead, to_left, to_right], axis=1)[inner]
    stumps = [
        np.stack([to_left, left, right], axis=1)[~inner],
        np.stack([to_left, right, to_right], axis=1)[~inner],
    ]
    cap = _cap(np.concatenate([to_left, to_right]), axis)
    return np.concatenate([triangles[count == 3], tips, *stumps, cap])


def _led_by(triangles: FloatArray, height: FloatArray, sign: float) -> FloatArray:
    """Triangles with their corners turned so that the first has the largest sign * height."""
    first = np.argmax(sign * height, axis=1)
    order = (first[:, None] + np.arange(3)) % 3
    return np.take_along_axis(triangles, order[:, :, None], axis=1)


def _crossing(start: FloatArray, end: FloatArray, axis: int, at: float) -> FloatArray:
    """Where the edges cross the plane, (n, 3)."""
    share = (at - start[:, axis]) / (end[:, axis] - start[:, axis])
    points = start + share[:, None] * (end - start)
    points[:, axis] = at
    return points


def _cap(points: FloatArray, axis: int) -> FloatArray:
    """Triangles over the convex hull of points of a plane across `axis`."""
    from scipy.spatial import ConvexHull, QhullError

    if len(points) < 3:
        return np.empty((0, 3, 3))
    try:
        ring = points[ConvexHull(np.delete(points, axis, axis=1)).vertices]
    except QhullError:  # on one line: any fan holds it
        ring = points
    first = np.broadcast_to(ring[0], ring[1:-1].shape)
    return np.stack([first, ring[1:-1], ring[2:]], axis=1)


Separation = tuple[float, FloatArray]
"""Certified clearance [mm], 0 when they touch or overlap, and the unit direction from b to a."""

_IDENTITY = np.eye(3)
_ORIGIN = np.zeros(3)
_NOWHERE: Separation = (0.0, np.array([0.0, 0.0, 1.0]))
DOUBT = 1e-5
"""A certificate this far below the distance [mm] is as good as exact."""
ROUNDS = 40
"""Most corners of the hull of all differences that the search for the nearest point takes up."""


def separation_of(
    a: ConvexSolid, b: ConvexSolid
) -> Callable[[FloatArray, FloatArray | None, FloatArray | None], Separation]:
    """A function that separates `a` from `b`.

    Returns:
        A function of the vector from b's origin to a's (3,) [mm] and of the orientations of a and
        b (3, 3), None for a body that never turns.
    """
    import fcl

    request = fcl.DistanceRequest(enable_nearest_points=True)
    shape_a, shift_a = _as_fcl(a)
    shape_b, shift_b = _as_fcl(b)
    still_b = fcl.CollisionObject(shape_b, fcl.Transform(_IDENTITY, shift_b))

    def separate(
        offset: FloatArray, turn_a: FloatArray | None, turn_b: FloatArray | None
    ) -> Separation:
        # Nothing is shared that changes: several threads may ask at once.
        ra, rb = (_IDENTITY if turn is None else turn for turn in (turn_a, turn_b))
        object_a = fcl.CollisionObject(shape_a, fcl.Transform(ra, offset + ra @ shift_a))
        object_b = still_b
        if turn_b is not None:
            object_b = fcl.CollisionObject(shape_b, fcl.Transform(rb, rb @ shift_b))
        result = fcl.DistanceResult()
        distance = fcl.distance(object_a, object_b, request, result)
        if not distance > 0.0:
            return _NOWHERE
        on_a, on_b = result.nearest_points
        apart = on_a - on_b
        length = math.sqrt(apart @ apart)
        if length == 0.0:
            return _NOWHERE
        normal = apart / length
        # The empty slab across the normal: no two points are nearer than it is wide.
        gap = float(normal @ offset - a.support(-normal @ ra) - b.support(normal @ rb))
        if gap < distance - DOUBT:
            gap, normal = _improved(a, b, (gap, normal), offset, ra, rb)
        return (gap, normal) if gap > 0.0 else _NOWHERE

    return separate


def _improved(
    a: ConvexSolid,
    b: ConvexSolid,
    found: Separation,
    offset: FloatArray,
    ra: FloatArray,
    rb: FloatArray,
) -> Separation:
    """The certificate across the nearest point of the hull of all differences (Gilbert's search).

    fcl is off by millimetres where two edges are parallel, as those of upright boxes are.
    """
    from scipy.optimize import nnls

    normal, corners = found[1], []
    for _ in range(ROUNDS):
        corners.append(offset + ra @ a.farthest(-normal @ ra) - rb @ b.farthest(normal @ rb))
        found = max(found, (float(normal @ corners[-1]), normal), key=lambda f: f[0])
        # The hull's point nearest to the origin: least squares with weights that add up to one.
        points = np.array(corners).T
        system = np.vstack([points, np.full(len(corners), 100.0)])
        try:
            weights, _ = nnls(system, [0.0, 0.0, 0.0, 100.0])
        except RuntimeError:  # not within its rounds: what was found so far is a certificate, too
            break
        nearest = points @ weights / weights.sum()
        length = math.sqrt(nearest @ nearest)
        if length - max(found[0], 0.0) < DOUBT:
            break
        normal = nearest / length
    return found


def _as_fcl(solid: ConvexSolid) -> tuple[Any, FloatArray]:
    """fcl's shape and where its own centre lies in the solid's frame."""
    import fcl

    match solid:
        case UprightCylinder(center, radius, height):
            return fcl.Cylinder(radius, height), np.array(center)
        case Polytope():
            counts = np.full((len(solid.faces), 1), 3, dtype=np.int32)
            faces = np.concatenate([counts, solid.faces], axis=1).ravel()
            return fcl.Convex(np.array(solid.vertices), len(solid.faces), faces), _ORIGIN
    raise TypeError(f"no collision shape for {type(solid).__name__}")
