"""What can be projected, and the projection that suits it."""

from __future__ import annotations

import numpy.typing as npt

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection.analytic import project_scene
from flexdt.twin.projection.analytic_solids import Scene
from flexdt.twin.projection.mesh import TriangleMesh, project_mesh
from flexdt.twin.projection.operators import forward
from flexdt.twin.projection.volume import Volume

Body = Scene | Volume | TriangleMesh
"""Analytic solids, voxels, or a closed mesh."""


def project_body(
    body: Body, cone_vec: ConeVec | npt.ArrayLike, shape: tuple[int, int]
) -> Float32Array:
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
