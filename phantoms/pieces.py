"""What a phantom may consist of besides analytic solids: a filled triangle mesh, a grid of voxels.

Frozen values in the object's frame [mm] with read-only arrays; the boxes around them and the size
of a phantom that is made of them.

Path lengths through a mesh count once for each of its bodies, and attenuations of several meshes
add up. Bodies of one mesh that overlap are therefore united before they are projected, and a mesh
of higher priority is cut out of those below it. Both are exact and made by the library manifold3d.

For the scene and for collisions a phantom is triangle meshes in the frame of its X-ray side: each
analytic solid becomes one closed convex mesh. A hole (negative attenuation in a body) is turned
inside out in the joined mesh, so that signed volumes add up; there are no boolean operations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Final, cast

import numpy as np
import numpy.typing as npt

from flexdt.phantoms.checked_reading import PACK, Lengths, Number, PhantomError, Place, Text, packed
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.projection import TriangleMesh
from flexdt.twin.projection import analytic_solids as analytic
from flexdt.twin.projection.analytic_solids import as_convex, polyhedron_corners
from flexdt.twin.values import ArrayValue

if TYPE_CHECKING:
    import manifold3d
    import trimesh

    from flexdt.phantoms.phantom import Phantom


@dataclass(frozen=True, eq=False)
class Surface(ArrayValue):
    """A closed triangle mesh filled with one material.

    Attributes:
        vertices: float64 (v, 3) [mm], object frame, read-only.
        faces: int32 (f, 3) indices, outward by the right-hand rule, read-only.
        material: name.
        mu_per_mm: attenuation inside [1/mm].
    """

    vertices: Annotated[FloatArray, packed("<f8"), PACK]
    faces: Annotated[npt.NDArray[np.int32], packed("<i4"), PACK]
    material: Text
    mu_per_mm: Number

    def __post_init__(self) -> None:
        vertices = np.array(self.vertices, dtype=np.float64).reshape(-1, 3)
        faces = np.array(self.faces, dtype=np.int32).reshape(-1, 3)
        if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
            raise PhantomError(f"a face names vertex {faces.max()} of {len(vertices)}")
        freeze(self, vertices=vertices, faces=faces)


@dataclass(frozen=True, eq=False)
class Voxels(ArrayValue):
    """Attenuation on a grid about `center_mm`.

    Attributes:
        data: float32 [z, y, x], attenuation [1/mm], read-only.
        voxel_mm: voxel edges along x, y, z [mm].
        center_mm: of the grid, object frame [mm].
        material: name; None where only the attenuation is known, or there are several.
        labels: uint8 [z, y, x], read-only: which of `materials` fills each voxel, counted from 1,
            0 for nothing; None unless there are several.
        materials: their names.
    """

    data: Annotated[npt.NDArray[np.float32], packed("<f4"), PACK]
    voxel_mm: Lengths
    center_mm: Place = (0.0, 0.0, 0.0)
    material: Text | None = None
    labels: Annotated[npt.NDArray[np.uint8], packed("|u1"), PACK] | None = None
    materials: tuple[Text, ...] = ()

    def __post_init__(self) -> None:
        data = np.array(self.data, dtype=np.float32)
        if data.ndim != 3 or data.size == 0:
            said, shape = f"voxels have shape {data.shape}", list(data.shape)
            raise PhantomError.instead(said, shape, "(z, y, x), none of them 0")
        if not np.isfinite(data).all():
            raise PhantomError("voxels hold values that are not finite")
        freeze(self, data=data)
        if self.labels is not None:
            labels = np.array(self.labels, dtype=np.uint8)
            if labels.shape != data.shape or int(labels.max()) > len(self.materials):
                raise PhantomError(
                    f"labels have shape {labels.shape} and end at {labels.max()}; allowed: shape "
                    f"{data.shape}, 0 to {len(self.materials)}"
                )
            freeze(self, labels=labels)


def freeze(target: object, **arrays: npt.NDArray[np.generic]) -> None:
    """Make `arrays` read-only and set them as fields of the frozen dataclass `target`."""
    for name, array in arrays.items():
        array.setflags(write=False)
        object.__setattr__(target, name, array)


def boxes(
    scene: analytic.Scene, surfaces: Sequence[Surface] = (), voxels: Voxels | None = None
) -> list[tuple[FloatArray, FloatArray]]:
    """Low and high corner of the box around each part, (3,) each [mm]."""
    found = [bounds(solid.shape) for solid in scene.solids]
    found += [(one.vertices.min(axis=0), one.vertices.max(axis=0)) for one in surfaces]
    if voxels is not None:
        half = np.array(voxels.voxel_mm) * voxels.data.shape[::-1] / 2.0
        found.append((np.array(voxels.center_mm) - half, np.array(voxels.center_mm) + half))
    return found


def size_about_origin(scene: analytic.Scene, surfaces: Sequence[Surface] = ()) -> analytic.Vector:
    """Full extent along x, y, z [mm] of the box about the origin that holds everything.

    Raises:
        PhantomError: there is nothing.
    """
    found = boxes(scene, surfaces)
    if not found:
        raise PhantomError("a phantom needs at least one solid or mesh")
    x, y, z = (2.0 * np.abs(np.array(found)).max(axis=(0, 1))).tolist()
    return (x, y, z)


def bounds(shape: analytic.Shape) -> tuple[FloatArray, FloatArray]:
    """Corners of the smallest axis-aligned box around the shape, (3,) each [mm].

    Raises:
        GeometryError: a shape that cannot be, such as an unbounded polyhedron.
    """
    one = as_convex(shape)
    if isinstance(
        shape, analytic.Cylinder
    ):  # the corners that `as_convex` gives are those of a prism
        axis = np.asarray(shape.axis)
        half = np.abs(axis) * shape.height / 2.0
        half = half + shape.radius * np.sqrt(np.maximum(1.0 - axis**2, 0.0))
    elif one.semi_axes is not None:
        half = np.linalg.norm(one.semi_axes, axis=0)
    else:
        assert one.corners is not None
        return one.corners.min(axis=0), one.corners.max(axis=0)
    return one.center - half, one.center + half


MOST_BODIES: Final = 2000
"""Above which boxes are not compared pair by pair."""


def united(mesh: TriangleMesh) -> TriangleMesh | None:
    """The mesh with its overlapping bodies made one; itself where the boxes around them are apart.

    Shells turned inwards are cavities of the body around them. None where the surface of a body
    meets itself, so that it has no inside.
    """
    bodies = _bodies(mesh)
    if not _boxes_meet([mesh.vertices[np.unique(mesh.faces[body])] for body in bodies]):
        return mesh
    try:
        made = _solid(mesh, bodies).to_mesh64()
    except PhantomError:
        return None
    return TriangleMesh(made.vert_properties[:, :3], made.tri_verts.astype(np.int64))


def cut(
    parts: Sequence[tuple[analytic.Scene, Sequence[Surface], float]],
) -> tuple[analytic.Scene, tuple[Surface, ...]]:
    """Solids and surfaces of which each has only what none of a higher priority takes.

    Args:
        parts: solids, surfaces and the priority of both.

    Raises:
        PhantomError: something round, a hole, or a mesh that meets itself would have to be cut.

    Example:
        >>> import trimesh
        >>> from flexdt.twin.projection.analytic_solids import Scene
        >>> big, small = (trimesh.creation.box((side,) * 3) for side in (4.0, 2.0))
        >>> _, (shell, _) = cut([(Scene(()), [Surface(big.vertices, big.faces, "pmma", 0.02)], 0),
        ...                      (Scene(()), [Surface(small.vertices, small.faces, "Fe", 0.5)], 1)])
        >>> round(TriangleMesh(shell.vertices, shell.faces).volume_mm3, 6)
        56.0
    """
    pieces: list[tuple[analytic.Solid | Surface, float]] = []
    for scene, surfaces, rank in parts:
        pieces += [(one, rank) for one in scene.solids]
        pieces += [(one, rank) for one in surfaces]
    boxes = [_box(one) for one, _ in pieces]
    left: list[analytic.Solid | Surface] = []
    for (one, rank), (low, high) in zip(pieces, boxes, strict=True):
        above = [
            other
            for (other, its), (bottom, top) in zip(pieces, boxes, strict=True)
            if its > rank and (low < top).all() and (bottom < high).all()
        ]
        rest = _outside(_filled(one), [_filled(other) for other in above]) if above else one
        left += [] if rest is None else [rest]
    return (
        analytic.Scene(tuple(one for one in left if isinstance(one, analytic.Solid))),
        tuple(one for one in left if isinstance(one, Surface)),
    )


def _box(one: analytic.Solid | Surface) -> tuple[FloatArray, FloatArray]:
    if isinstance(one, analytic.Solid):
        return bounds(one.shape)
    return one.vertices.min(axis=0), one.vertices.max(axis=0)


def _filled(one: analytic.Solid | Surface) -> Surface:
    """The piece as a mesh of exactly its form."""
    if isinstance(one, Surface):
        return one
    if not isinstance(one.shape, analytic.Box | analytic.ConvexPolyhedron) or one.mu_per_mm < 0.0:
        what = type(one.shape).__name__.lower() if one.mu_per_mm > 0.0 else "hole"
        raise PhantomError(
            f"a {what} of {one.material} overlaps something of another priority; allowed: meshes, "
            "boxes and convex solids. A round solid names what it replaces instead",
            {"asked": what, "allowed": ["mesh", "box", "convex"]},
        )
    mesh = solid_mesh(one)
    return Surface(mesh.vertices, mesh.faces, one.material, one.mu_per_mm)


def _outside(surface: Surface, others: Sequence[Surface]) -> Surface | None:
    """What of a filled mesh lies outside the others; None if nothing does."""
    import manifold3d

    solids = [
        _solid(mesh, _bodies(mesh))
        for mesh in (TriangleMesh(s.vertices, s.faces.astype(np.int64)) for s in (surface, *others))
    ]
    left = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Subtract)
    if left.is_empty():
        return None
    made = left.to_mesh64()
    return replace(
        surface, vertices=made.vert_properties[:, :3], faces=made.tri_verts.astype(np.int32)
    )


def _bodies(mesh: TriangleMesh) -> list[npt.NDArray[np.int64]]:
    """Indices of the faces of each connected surface."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    first, last = mesh.faces.ravel(), mesh.faces[:, [1, 2, 0]].ravel()
    size = len(mesh.vertices)
    edges = coo_array((np.ones(len(first), bool), (first, last)), shape=(size, size))
    _, part = connected_components(edges, directed=False)
    part = part[mesh.faces[:, 0]]
    order = np.argsort(part, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(part[order])) + 1)


def _boxes_meet(bodies: Sequence[npt.NDArray[np.float64]]) -> bool:
    """Whether the boxes around any two of the bodies overlap."""
    if len(bodies) > MOST_BODIES:
        return True
    low = np.array([corners.min(axis=0) for corners in bodies])
    high = np.array([corners.max(axis=0) for corners in bodies])
    meet = (low[:, None] < high[None]).all(axis=2)
    return bool((meet & meet.T & ~np.eye(len(bodies), dtype=bool)).any())


def _solid(mesh: TriangleMesh, bodies: Sequence[npt.NDArray[np.int64]]) -> manifold3d.Manifold:
    """The union of the bodies, each without the cavities in it.

    Raises:
        PhantomError: the surface of one meets itself.
    """
    import manifold3d

    corners = [mesh.vertices[mesh.faces[body]] for body in bodies]
    volumes = [float(np.linalg.det(three).sum()) for three in corners]
    boxes = [(three.min(axis=(0, 1)), three.max(axis=(0, 1))) for three in corners]
    shells = {i: [bodies[i]] for i, volume in enumerate(volumes) if volume > 0}
    for i, (low, high) in enumerate(boxes):
        around = [j for j in shells if (boxes[j][0] <= low).all() and (high <= boxes[j][1]).all()]
        if volumes[i] <= 0 and around:
            shells[min(around, key=volumes.__getitem__)].append(bodies[i])
    solids = []
    for faces in shells.values():
        used, triangles = np.unique(mesh.faces[np.concatenate(faces)], return_inverse=True)
        given = manifold3d.Mesh64(mesh.vertices[used], triangles.reshape(-1, 3).astype(np.uint64))
        solids.append(manifold3d.Manifold(given))
        if solids[-1].status() != manifold3d.Error.NoError:
            raise PhantomError(
                f"a mesh's surface meets itself ({solids[-1].status().name}); it cannot be united "
                "with or cut out of another"
            )
    return manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)


SPHERE_SUBDIVISIONS = 3
CYLINDER_SECTIONS = 48


@dataclass(frozen=True, eq=False)
class SurfacePart:
    """One closed mesh of a phantom.

    Attributes:
        mesh: outward triangles [mm, object frame], also for a hole.
        material: name.
        hole: whether it removes material instead of adding it.
    """

    mesh: trimesh.Trimesh
    material: str
    hole: bool


def parts_of(phantom: Phantom, *, around: bool = False) -> tuple[SurfacePart, ...]:
    """See `Phantom.parts`; voxels appear as the box around them.

    Args:
        phantom: its beads are never holes.
        around: round solids lie inside their meshes, not the other way round.
    """
    import trimesh

    voxels = phantom.voxels
    out = [
        SurfacePart(solid_mesh(s, around), s.material, hole=_is_hole(s, phantom.beads))
        for s in phantom.scene.solids
    ]
    for surface in phantom.surfaces:
        mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
        out.append(SurfacePart(mesh, surface.material, hole=False))
    if voxels is not None:
        box = trimesh.creation.box(
            extents=np.array(voxels.data.shape[::-1]) * np.asarray(voxels.voxel_mm)
        )
        box.apply_translation(voxels.center_mm)
        out.append(SurfacePart(box, "voxels", hole=False))
    return tuple(out)


def joined(parts: Sequence[SurfacePart]) -> trimesh.Trimesh:
    """All parts as one mesh, holes turned inside out.

    Raises:
        PhantomError: there is nothing to join.
    """
    import trimesh

    if not parts:
        raise PhantomError("a phantom without any solid has no mesh")
    meshes = [part.mesh.copy() for part in parts]
    for part, mesh in zip(parts, meshes, strict=True):
        if part.hole:
            mesh.invert()
    return cast("trimesh.Trimesh", trimesh.util.concatenate(meshes))


def _is_hole(solid: analytic.Solid, beads: FloatArray) -> bool:
    """A negative solid is a hole unless it is a bead that absorbs less than its body."""
    if solid.mu_per_mm >= 0.0:
        return False
    if isinstance(solid.shape, analytic.Sphere) and len(beads):
        return not bool((beads == np.asarray(solid.shape.center)).all(axis=1).any())
    return True


def solid_mesh(solid: analytic.Solid, around: bool = False) -> trimesh.Trimesh:
    """Closed outward mesh of one solid [mm]; a round shape's is inscribed, or lies around it."""
    mesh = _mesh(solid.shape)
    if around and isinstance(solid.shape, analytic.Sphere | analytic.Ellipsoid):
        mesh.vertices = solid.shape.center + (mesh.vertices - solid.shape.center) * _ball_around()
    elif around and isinstance(solid.shape, analytic.Cylinder):
        axis = np.asarray(solid.shape.axis)
        out = mesh.vertices - solid.shape.center
        along = np.outer(out @ axis, axis)
        across = (out - along) / np.cos(np.pi / CYLINDER_SECTIONS)
        mesh.vertices = solid.shape.center + along + across
    return mesh


@lru_cache
def _unit_ball() -> trimesh.Trimesh:
    """The polyhedron inscribed in a ball of radius 1; made once, as it takes milliseconds."""
    import trimesh

    ball: trimesh.Trimesh = trimesh.creation.icosphere(SPHERE_SUBDIVISIONS, radius=1.0)
    return ball


@lru_cache
def _ball_around() -> float:
    """Scale at which the inscribed polyhedron of a ball holds the ball."""
    ball = _unit_ball()
    corners = ball.vertices[ball.faces[:, 0]]
    return 1.0 / float(np.einsum("ij,ij->i", ball.face_normals, corners).min())


def _mesh(shape: analytic.Shape) -> trimesh.Trimesh:
    import trimesh

    mesh: trimesh.Trimesh
    match shape:
        case analytic.Sphere(center, radius):
            ball = _unit_ball()
            mesh = trimesh.Trimesh(ball.vertices * radius + center, ball.faces, process=False)
        case analytic.Ellipsoid(center, semi_axes, axes):
            mesh = _unit_ball().copy()
            mesh.apply_transform(_placed(np.asarray(axes).T * semi_axes, center))
        case analytic.Box(center, size, axes):
            mesh = trimesh.creation.box(size, _placed(np.asarray(axes).T, center))
        case analytic.Cylinder(center, radius, height, axis):
            half = np.asarray(axis) * height / 2.0
            ends = np.stack([center - half, center + half])
            mesh = trimesh.creation.cylinder(radius, sections=CYLINDER_SECTIONS, segment=ends)
        case analytic.ConvexPolyhedron():
            mesh = trimesh.convex.convex_hull(polyhedron_corners(shape))
    return mesh


def _placed(linear: FloatArray, center: tuple[float, float, float]) -> FloatArray:
    transform = np.eye(4)
    transform[:3, :3] = linear
    transform[:3, 3] = center
    return transform
