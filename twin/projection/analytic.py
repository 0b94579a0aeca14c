"""Projection without voxels: exact chords through analytic scenes and closed triangle meshes.

A solid costs only the pixels its shadow can reach. Results are line integrals, or path lengths
for each material. A mesh is a value: vertices and outward-turning triangles; one that does not
close is an error, because its path lengths mean nothing. `project_body` chooses the projection
that suits solids, voxels or a mesh.

`warm_up` compiles (or loads from the disk cache) the kernels that programs usually run; a
server compiles at a kernel's first use. So do the kernels of meshes, of FDK and of `back` into
given memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import GeometryError, shape_words
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.geometry.virtual_panel import run_through
from flexdt.twin.projection import cpu
from flexdt.twin.projection.analytic_solids import (
    Box,
    Cylinder,
    Scene,
    Solid,
    Sphere,
    as_convex,
    hull_points,
    shadows,
)
from flexdt.twin.projection.cpu import threads
from flexdt.twin.projection.operators import (
    Shape2,
    as_cone_vec,
    back,
    box_of,
    check_out,
    forward,
    layout_data,
    voxel_rays,
)
from flexdt.twin.projection.portions import equal_portions
from flexdt.twin.projection.volume import Volume, blank_layout, bring_over

LEVEL_VIEW = ConeVec.from_vectors((0, -10, 0), (0, 10, 0), (1, 0, 0), (0, 0, -1))
END_ON_VIEW = ConeVec.from_vectors((0, 0, -10), (0, 0, 10), (1, 0, 0), (0, 1, 0))
IntArray = npt.NDArray[np.int64]
RAY_OFFSET_PX = (1.37e-7, 0.73e-7)
"""Offset of each ray from its pixel's center [columns, rows]. Made objects have
corners exactly on pixel centers; there, rounding alone would decide which triangles a
ray meets."""


def project_scene(
    scene: Scene,
    cone_vec: ConeVec | npt.ArrayLike,
    shape: Shape2 | None = None,
    out: Float32Array | None = None,
) -> Float32Array:
    """Compute line integrals of a scene: sum over its solids of chord [mm] times mu
    [1/mm].

    Args:
        scene: solids, object frame.
        cone_vec: ConeVec or (n, 12) [mm].
        shape: detector (rows, cols); default: the geometry's own.
        out: float32 (n, rows, cols), C order, filled and returned if given.

    Returns:
        float32 (n, rows, cols), dimensionless.

    Raises:
        GeometryError: cone_vec, shape, out or a solid does not hold.

    Example:
        >>> from flexdt.twin.projection.analytic_solids import Solid, Sphere
        >>> ball = Scene((Solid(Sphere((0.0, 0.0, 0.0), 2.0), "water", 0.02),))
        >>> view = ConeVec.from_vectors((0, -500, 0), (0, 500, 0), (1, 0, 0), (0, 0, -1))
        >>> round(float(project_scene(ball, view, (1, 1))[0, 0, 0]), 4)  # 4 mm of 0.02 / mm
        0.08
    """
    geometry = as_cone_vec(cone_vec)
    shape = geometry.of_shape(shape)
    result = check_out(out, (len(geometry), *shape))
    weight = np.array([solid.mu_per_mm for solid in scene.solids], np.float64)
    _project(
        scene.solids,
        geometry,
        shape,
        weight,
        np.zeros(len(weight), np.int64),
        result[None],
    )
    return result


def project_materials(
    scene: Scene, cone_vec: ConeVec | npt.ArrayLike, shape: Shape2 | None = None
) -> dict[str, Float32Array]:
    """Compute the path length through each material of a scene.

    A solid of negative mu_per_mm removes its material, so a bead in a brick is three
    solids: the brick, a hole of the brick's material with minus its mu, and the bead with
    its own mu. (One bead carrying the difference of two materials gives the right line
    integral, but cannot be taken apart again.)

    Args:
        scene: solids, object frame.
        cone_vec: ConeVec or (n, 12) [mm].
        shape: detector (rows, cols); default: the geometry's own.

    Returns:
        For each material name, in order of first appearance, float32 (n, rows, cols)
            [mm].

    Raises:
        GeometryError: cone_vec, shape or a solid does not hold.

    Example:
        >>> from flexdt.twin.projection.analytic_solids import Solid, Sphere
        >>> ball = Scene((Solid(Sphere((0.0, 0.0, 0.0), 2.0), "water", 0.02),))
        >>> view = ConeVec.from_vectors((0, -500, 0), (0, 500, 0), (1, 0, 0), (0, 0, -1))
        >>> round(float(project_materials(ball, view, (1, 1))["water"][0, 0, 0]), 4)  # mm
        4.0
    """
    geometry = as_cone_vec(cone_vec)
    names = list(dict.fromkeys(solid.material for solid in scene.solids))
    shape = geometry.of_shape(shape)
    result = np.empty((len(names), len(geometry), *shape), np.float32)
    weight = np.array([-1.0 if solid.mu_per_mm < 0 else 1.0 for solid in scene.solids])
    channel = np.array([names.index(solid.material) for solid in scene.solids], np.int64)
    _project(scene.solids, geometry, shape, weight, channel, result)
    return dict(zip(names, result, strict=True))


def _project(
    solids: tuple[Solid, ...],
    geometry: ConeVec,
    shape: Shape2,
    weight: FloatArray,
    channel: npt.NDArray[np.int64],
    out: Float32Array,
) -> None:
    """Fill out (channels, n, rows, cols) with the solids' chords times their weights.

    Out is zero without solids. Work is divided into portions over all threads.

    Args:
        solids: the k solids, object frame.
        geometry: n views.
        shape: detector (rows, cols).
        weight: (k,) factor of each solid's chord.
        channel: (k,) index of the image stack to which each solid adds.
        out: float32, filled.
    """
    from flexdt.twin.projection.kernels import analytic_kernels

    if not solids or out.size == 0:
        out.fill(0)
        return
    shapes = [as_convex(solid.shape) for solid in solids]
    # Input of `analytic_kernels`: has a quadric, M, c; slabs, and which of them are a solid's.
    quadric = np.array(
        [[one.curved, *one.matrix.ravel(), *one.center] for one in shapes], float
    )
    ends = np.cumsum([0, *(len(one.slabs) for one in shapes)])
    rays = run_through(
        geometry, np.concatenate([hull_points(one) for one in shapes])
    ).rays(shape)
    slabs = np.concatenate([one.slabs for one in shapes])
    slab_range = np.column_stack([ends[:-1], ends[1:]])
    seen = shadows(shapes, rays, shape)
    band = analytic_kernels.BAND_ROWS
    jobs = len(rays) * -(-shape[0] // band)
    for first, last in equal_portions(
        jobs, CHORD_NS * band * shape[1] * len(shapes), threads()
    ):
        analytic_kernels.project_convex(
            quadric, slabs, slab_range, seen, rays, weight, channel, out, first, last
        )


CHORD_NS = 20.0
"""Estimated time of a solid at a pixel of its shadow [ns]."""
TRIANGLE_NS = 20.0
"""Estimated time of a triangle per band of rows, and of a small one per pixel [ns]."""


def warm_up() -> None:
    """Run `project_scene`, `forward` and `back` into new memory on tiny problems."""
    warm_up_forward()
    warm_up_back()


def warm_up_forward() -> None:
    """Run `project_scene` and `forward` on tiny problems, with rays in fans and alone, so
    that their kernels are compiled."""
    shapes = (
        Sphere((0, 0, 0), 1.0),
        Box((0, 0, 0), (1, 1, 1)),
        Cylinder((0, 0, 0), 1.0, 1.0),
    )
    project_scene(
        Scene(tuple(Solid(s, "water", 0.02) for s in shapes)), LEVEL_VIEW, (5, 6)
    )
    for volume in _tiny_volumes():
        forward(volume, END_ON_VIEW, (5, 6))
        layout = volume.layout  # so small a problem would not be walked in fans
        images = np.empty((1, 5, 6), np.float32)
        cpu.project(box_of(layout), voxel_rays(LEVEL_VIEW, layout, (5, 6)), images)


def warm_up_back() -> None:
    """Compile the kernels of `back` by tiny problems: rays in fans, single rays, and adding a
    volume that is stored in another order of axes."""
    images = np.ones((1, 5, 6), np.float32)
    for volume in _tiny_volumes():
        back(images, END_ON_VIEW, volume)
        target = blank_layout(volume)
        cpu.spread(box_of(target), voxel_rays(LEVEL_VIEW, target, (5, 6)), images)
        bring_over(
            layout_data(target),
            target.flat,
            target.stride_x,
            target.stride_y,
            adding=True,
        )


def _tiny_volumes() -> tuple[Volume, Volume]:
    """Make two volumes of a few voxels, in C order and with z contiguous."""
    data = np.ones((4, 3, 2), np.float32)
    turned = np.ascontiguousarray(data.transpose(1, 2, 0)).transpose(2, 0, 1)
    return Volume(data, 0.5), Volume(turned, 0.5)


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A closed surface of triangles, counter-clockwise seen from outside.

    Several separate or nested bodies may share one mesh; where bodies overlap, path counts once
    for each of them.

    Attributes:
        vertices: float64 (k, 3) [mm], object frame.
        faces: int64 (m, 3), indices of vertices. Triangles that touch must share vertices
            (merge equal ones first: STL repeats them).

    Raises:
        GeometryError: wrong shapes, indices out of range, or a surface that does not close;
            names the first open edge.
    """

    vertices: FloatArray
    faces: IntArray

    def __post_init__(self) -> None:
        """Check the mesh and store copies of its vertices, float64, and faces, int64,
        read-only.

        Raises:
            GeometryError: wrong shapes, a face with an unknown vertex, or a mesh that is
                not closed.
        """
        vertices = np.array(self.vertices, dtype=np.float64)
        faces = np.array(self.faces, dtype=np.int64)
        if (
            vertices.ndim != 2
            or vertices.shape[1] != 3
            or not np.isfinite(vertices).all()
        ):
            raise GeometryError(
                f"mesh vertices have shape {shape_words(vertices.shape)}; "
                "allowed: finite k x 3 in mm"
            )
        if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
            raise GeometryError(
                f"mesh faces have shape {shape_words(faces.shape)}; allowed: m x 3, m > 0"
            )
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise GeometryError(
                f"a mesh face names vertex {faces.max()}; allowed: 0 to {len(vertices) - 1}"
            )
        _check_closed(faces, len(vertices))
        vertices.setflags(write=False)
        faces.setflags(write=False)
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)

    @property
    def volume_mm3(self) -> float:
        """Enclosed volume [mm^3]; negative when the triangles turn inward."""
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def project_mesh(
    mesh: TriangleMesh,
    cone_vec: ConeVec | npt.ArrayLike,
    shape: Shape2 | None = None,
    out: Float32Array | None = None,
) -> Float32Array:
    """Compute the path length [mm] through a mesh along every ray.

    Rays are moved aside by a ten-millionth of a pixel, so that none runs along an edge.

    Args:
        mesh: the solid.
        cone_vec: ConeVec or (n, 12) [mm], object frame.
        shape: detector (rows, cols); default: the geometry's own.
        out: float32 (n, rows, cols), C order, filled and returned if given.

    Returns:
        float32 (n, rows, cols).

    Raises:
        GeometryError: cone_vec, shape or out do not fit.

    Example:
        >>> import trimesh
        >>> box = trimesh.creation.box((5.0, 6.0, 7.0))
        >>> mesh = TriangleMesh(box.vertices, box.faces)
        >>> view = ConeVec.from_vectors((0, -500, 0), (0, 500, 0), (1, 0, 0), (0, 0, -1))
        >>> round(float(project_mesh(mesh, view, (1, 1))[0, 0, 0]), 4)  # along y [mm]
        6.0
    """
    geometry = as_cone_vec(cone_vec)
    shape = geometry.of_shape(shape)
    result = check_out(out, (len(geometry), *shape))
    if result.size == 0:
        return result
    from flexdt.twin.projection.kernels import analytic_kernels

    ends = np.stack([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)], axis=1)
    geometry = run_through(geometry, np.array(list(product(*ends))))
    rays = geometry.rays(shape)
    rays[:, 3:6] += RAY_OFFSET_PX[0] * geometry.u + RAY_OFFSET_PX[1] * geometry.v
    basis = np.stack([geometry.u, geometry.v, rays[:, 3:6]], axis=2)
    inverses = np.ascontiguousarray(np.linalg.inv(basis))
    band = analytic_kernels.MESH_BAND_ROWS
    jobs = len(rays) * -(-shape[0] // band)
    job_ns = TRIANGLE_NS * (len(mesh.faces) + len(mesh.vertices) + band * shape[1])
    for first, last in equal_portions(jobs, job_ns, threads()):
        analytic_kernels.project_triangles(
            mesh.vertices, mesh.faces, rays, inverses, threads(), result, first, last
        )
    return result


def _check_closed(faces: IntArray, vertices: int) -> None:
    """Check that every edge is passed as often in one direction as in the other.

    A closed mesh may touch itself: an edge may have more than two faces.

    Args:
        faces: (m, 3) numbers of vertices.
        vertices: number of vertices.

    Raises:
        GeometryError: an edge has no partner; the message names one and counts them.
    """
    start = faces.ravel()
    end = faces[:, [1, 2, 0]].ravel()
    there = start * vertices + end
    back = end * vertices + start
    values, counts = np.unique(np.concatenate([there, back]), return_counts=True)
    ways, along = np.unique(there, return_counts=True)
    runs = np.zeros(len(values), np.int64)
    runs[np.searchsorted(values, ways)] = along
    open_edges = values[2 * runs != counts]
    if len(open_edges):
        a, b = divmod(int(open_edges[0]), vertices)
        raise GeometryError(
            f"the mesh is not closed: edge ({a}, {b}) has no partner "
            f"({len(open_edges) // 2} such "
            "edges); merge equal vertices and fill holes first",
            {"edge": [a, b], "open_edges": len(open_edges) // 2},
        )


Body = Scene | Volume | TriangleMesh
"""Analytic solids, voxels, or a closed mesh."""


def project_body(
    body: Body, cone_vec: ConeVec | npt.ArrayLike, shape: Shape2
) -> Float32Array:
    """Project solids or voxels to line integrals, a mesh to path lengths [mm].

    Args:
        body: solids, voxels or a mesh.
        cone_vec: ConeVec or (n, 12) [mm], in the body's frame.
        shape: detector (rows, cols).

    Returns:
        float32 (n, rows, cols).

    Example:
        >>> import numpy as np
        >>> view = ConeVec.from_vectors((0, -500, 0), (0, 500, 0), (1, 0, 0), (0, 0, -1))
        >>> cube = Volume(np.full((8, 8, 8), 0.02, np.float32), 1.0)
        >>> round(float(project_body(cube, view, (5, 5))[0, 2, 2]), 3)
        0.16
    """
    if isinstance(body, Scene):
        return project_scene(body, cone_vec, shape)
    if isinstance(body, Volume):
        return forward(body, cone_vec, shape)
    return project_mesh(body, cone_vec, shape)
