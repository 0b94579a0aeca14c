"""Grids for reconstruction: the field of view of a scan, and the rows that a slab of it needs."""

from __future__ import annotations

import math

import numpy as np

from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import Grid, Volume
from flexdt.twin.reconstruction.rectify import is_upright, on_its_side, swapped, upright


def field_of_view(cone_vec: ConeVec, shape: tuple[int, int], voxel_mm: float | None = None) -> Grid:
    """The box about the object frame's z axis that all views together can fill.

    Args:
        cone_vec: the scan.
        shape: detector (rows, cols).
        voxel_mm: default: the pixel's size at the rotation axis, to 1 um.

    Raises:
        GeometryError: the axis is not in front of the source, or no voxel is so large.
    """
    if voxel_mm is not None and not 0.0 < voxel_mm < math.inf:
        raise GeometryError(
            f"voxels of {voxel_mm:g} mm; allowed: more than 0",
            {"asked": voxel_mm, "allowed": "> 0"},
        )
    if on_its_side(cone_vec):
        cone_vec, shape = swapped(cone_vec), (shape[1], shape[0])
    if not is_upright(cone_vec):
        cone_vec = upright(cone_vec)
    rows, cols = shape
    normal = cone_vec.normal
    to_axis = -(cone_vec.source * normal).sum(axis=1)
    scale = float((to_axis / cone_vec.source_detector_distance).min())
    if scale <= 0:
        raise GeometryError("the object's origin is not in front of the source in every view")
    pitch = float(np.linalg.norm(cone_vec.u[0]))
    if voxel_mm is None:
        voxel_mm = max(round(pitch * scale, 3), 1e-3)
    centre = cone_vec.project_points(np.zeros((1, 3)), shape)[:, 0]
    reach = float(np.abs(np.concatenate([centre[:, 0] + 0.5, cols - 0.5 - centre[:, 0]])).max())
    up = float((centre[:, 1] + 0.5).max()) * pitch * scale
    down = float((rows - 0.5 - centre[:, 1]).max()) * pitch * scale
    wide = max(1, math.ceil(2 * reach * pitch * scale / voxel_mm))
    high = max(1, math.ceil((up + down) / voxel_mm))
    return Grid((high, wide, wide), voxel_mm, (0.0, 0.0, (up - down) / 2))


def rows_needed(cone_vec: ConeVec, shape: tuple[int, int], like: Volume) -> tuple[int, int]:
    """Rows first <= r < last in which the volume's shadow lies in some view (a few to spare)."""
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    corners = np.array(like.center_mm) + signs * np.array(like.size_mm) / 2
    at = cone_vec.project_points(corners, shape)[..., 1]
    if not np.isfinite(at).all():
        return 0, shape[0]
    first = int(np.clip(np.floor(at.min()) - 2, 0, shape[0] - 2))
    last = int(np.clip(np.ceil(at.max()) + 3, first + 2, shape[0]))
    return first, last


def window(
    cone_vec: ConeVec, shape: tuple[int, int], rows: tuple[int, int], cols: tuple[int, int]
) -> ConeVec:
    """The geometry of rows and columns first <= i < last, which may lie off the panel."""
    down, right = ((sum(part) - size) / 2 for part, size in zip((rows, cols), shape, strict=True))
    centre = cone_vec.detector + down * cone_vec.v + right * cone_vec.u
    return ConeVec.from_vectors(cone_vec.source, centre, cone_vec.u, cone_vec.v)
