"""Projection of closed triangle meshes: exact path lengths, no voxels.

A mesh is a value: vertices and outward-turning triangles. One that does not close is an error,
because its path lengths mean nothing.

`project_body` chooses the projection that suits solids, voxels or a mesh.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection.analytic import project_scene
from flexdt.twin.projection.analytic_solids import Scene
from flexdt.twin.projection.cpu import threads
from flexdt.twin.projection.operators import Shape2, as_cone_vec, check_out, forward
from flexdt.twin.projection.volume import Volume

IntArray = npt.NDArray[np.int64]

ASIDE = (1.37e-7, 0.73e-7)
"""Rays are aimed this much [columns, rows] beside the pixel's centre. Made objects have corners
exactly on pixel centres; there, rounding alone would decide which triangles a ray meets.
"""


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A closed surface of triangles, counter-clockwise seen from outside.

    Several separate or nested bodies may share one mesh; where bodies overlap, path counts once for
    each of them.

    Attributes:
        vertices: float64 (k, 3) [mm], object frame.
        faces: int64 (m, 3), indices of vertices. Triangles that touch must share vertices (merge
            equal ones first: STL repeats them).

    Raises:
        GeometryError: wrong shapes, indices out of range, or a surface that does not close; names
            the first open edge.
    """

    vertices: FloatArray
    faces: IntArray

    def __post_init__(self) -> None:
        vertices = np.array(self.vertices, dtype=np.float64)
        faces = np.array(self.faces, dtype=np.int64)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or not np.isfinite(vertices).all():
            raise GeometryError(
                f"mesh vertices have shape {vertices.shape}; allowed: finite (k, 3) in mm"
            )
        if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
            raise GeometryError(f"mesh faces have shape {faces.shape}; allowed: (m, 3), m > 0")
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
    """Path length [mm] through a mesh along every ray.

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
    from flexdt.twin.projection.kernels import mesh_kernels

    rays = geometry.rays(shape)
    rays[:, 3:6] += ASIDE[0] * geometry.u + ASIDE[1] * geometry.v
    basis = np.stack([geometry.u, geometry.v, rays[:, 3:6]], axis=2)
    mesh_kernels.project_triangles(
        mesh.vertices,
        mesh.faces,
        rays,
        np.ascontiguousarray(np.linalg.inv(basis)),
        threads(),
        result,
    )
    return result


def _check_closed(faces: IntArray, vertices: int) -> None:
    """Every edge must be run through as often one way as the other."""
    start = faces.ravel()
    end = faces[:, [1, 2, 0]].ravel()
    there, back = start * vertices + end, end * vertices + start
    values, counts = np.unique(np.concatenate([there, back]), return_counts=True)
    ways, along = np.unique(there, return_counts=True)
    runs = np.zeros(len(values), np.int64)
    runs[np.searchsorted(values, ways)] = along
    open_edges = values[2 * runs != counts]
    if len(open_edges):
        a, b = divmod(int(open_edges[0]), vertices)
        raise GeometryError(
            f"the mesh is not closed: edge ({a}, {b}) has no partner ({len(open_edges) // 2} such "
            "edges); merge equal vertices and fill holes first",
            {"edge": [a, b], "open_edges": len(open_edges) // 2},
        )


Body = Scene | Volume | TriangleMesh
"""Analytic solids, voxels, or a closed mesh."""


def project_body(body: Body, cone_vec: ConeVec | npt.ArrayLike, shape: Shape2) -> Float32Array:
    """Line integrals through solids or voxels, path lengths [mm] through a mesh.

    Args:
        body: what is projected.
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
