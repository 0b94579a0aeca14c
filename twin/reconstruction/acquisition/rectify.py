"""Images of a tilted panel as an upright one would have recorded them.

A pinhole image on one plane determines the image on any other through the same source: a
homography. FDK filters along rows, which must be horizontal; this makes them so. A panel
that lies on its side has rows and columns swapped first, which costs nothing. Images of
an upright panel are returned as they are; a horizontal panel is an error.

Grids for reconstruction: the field of view of a scan, and the rows that a slab of it needs.
"""

from __future__ import annotations

import math

import numpy as np

from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection import Grid, Volume
from flexdt.twin.reconstruction.acquisition.trajectory import no_fdk

UPRIGHT = 1e-7
"""Largest slope of rows and columns of a panel that counts as upright."""
FINER = 1.3
"""Columns of an upright panel per column of the tilted one, in FDK: resampled twice,
before the filter and after it, edges would be blurred."""
SMALL_MM = 0.01
"""Voxel size below which sizes are not rounded to micrometers [mm]."""
FLAT = 1e-3
"""Least horizontal part of the normal of a panel that can be made upright."""


def leans(cone_vec: ConeVec) -> bool:
    """Return whether some view's rows are not horizontal or columns not vertical, by a
    slope of more than `UPRIGHT`; columns may point up or down.
    """
    slope_u = np.abs(cone_vec.u[:, 2]) / np.linalg.norm(cone_vec.u, axis=1)
    slope_v = np.linalg.norm(cone_vec.v[:, :2], axis=1) / np.linalg.norm(
        cone_vec.v, axis=1
    )
    return bool(max(slope_u.max(), slope_v.max()) > UPRIGHT)


def is_upright(cone_vec: ConeVec) -> bool:
    """Return whether rows are level, columns point down."""
    return columns_fall(cone_vec) and not leans(cone_vec)


def columns_fall(cone_vec: ConeVec) -> bool:
    """Return whether all columns point down."""
    return bool((cone_vec.v[:, 2] < 0).all())


def on_its_side(cone_vec: ConeVec) -> bool:
    """Return whether detector columns are nearer to the horizontal than rows, by the mean
    absolute slope over the views and a margin of `UPRIGHT`.
    """
    steep = np.abs(np.stack([cone_vec.u[:, 2], cone_vec.v[:, 2]]))
    steep /= np.linalg.norm([cone_vec.u, cone_vec.v], axis=2)
    rows, columns = steep.mean(axis=1)
    return bool(rows > columns + UPRIGHT)


def swapped(cone_vec: ConeVec) -> ConeVec:
    """Return the geometry of images whose rows and columns are swapped."""
    return ConeVec.from_vectors(
        cone_vec.source, cone_vec.detector, cone_vec.v, cone_vec.u
    )


def upright(cone_vec: ConeVec, finer: float = 1.0) -> ConeVec:
    """Compute upright panels (rows horizontal, columns down) with the same sources,
    centers and pitches; u points to the right as seen from the source.

    Args:
        cone_vec: n views.
        finer: columns per column of the original panel, with a narrower pitch.

    Raises:
        GeometryError: a panel is horizontal (the level part of its normal is at most
            `FLAT`).
    """
    away = cone_vec.normal * np.sign(cone_vec.source_detector_distance)[:, None]
    level = np.hypot(away[:, 0], away[:, 1])
    if level.min() <= FLAT:
        why = (
            "a panel lies flat: it has no rows across the rotation axis; "
            "FDK needs one that stands"
        )
        raise no_fdk(why, float(level.min()), f"> {FLAT:g}")
    # Down times the normal is to the right, whatever turn the panel had about its normal.
    u = np.column_stack([away[:, 1], -away[:, 0], np.zeros(len(away))])
    u *= (np.linalg.norm(cone_vec.u, axis=1) / level / finer)[:, None]
    v = np.zeros_like(u)
    v[:, 2] = -np.linalg.norm(cone_vec.v, axis=1)
    return ConeVec.from_vectors(cone_vec.source, cone_vec.detector, u, v)


def rectified(
    images: Float32Array, cone_vec: ConeVec, target: ConeVec, cols: int | None = None
) -> Float32Array:
    """Resample images (Lanczos) onto the panels of `target`, which has the same sources.

    Pixels beyond an image's edge repeat its last pixel.

    `images`: (n, rows, cols). `cone_vec` and `target`: n rows each. `cols`: of the target's
    panels; default: as many as in images.
    Returns new images (n, rows, cols).
    """
    from flexdt.twin.reconstruction.kernels import fdk_kernels

    shape = (images.shape[1], images.shape[2])
    new_shape = (shape[0], shape[1] if cols is None else cols)
    pairs = zip(cone_vec.rows, target.rows, strict=True)
    maps = np.array([homography(old, new, shape, new_shape) for old, new in pairs])
    out = np.empty((len(images), *new_shape), np.float32)
    weights = fdk_kernels.lanczos()
    fdk_kernels.warp(np.ascontiguousarray(images, dtype=np.float32), maps, weights, out)
    return out


def homography(
    old: FloatArray, new: FloatArray, shape: tuple[int, int], new_shape: tuple[int, int]
) -> FloatArray:
    """Compute the map of pixels between two panels of one source.

    Args:
        old: cone_vec row (12,) of the panel that was seen.
        new: that of the other one.
        shape: (rows, cols) of the old one.
        new_shape: (rows, cols) of the other.

    Returns:
        (3, 3), from homogeneous (column, row) on `new` to those on `old`, pixel centers at
        integers.
    """

    def plane(row: FloatArray, rows: int, cols: int) -> FloatArray:
        """Compute the matrix (3, 3) from pixels (column, row, 1) to rays: u, v, first
        pixel's ray.

        `row`: of cone_vec (12,).
        """
        first = (
            row[3:6] - row[0:3] - (cols - 1) / 2 * row[6:9] - (rows - 1) / 2 * row[9:12]
        )
        return np.column_stack([row[6:9], row[9:12], first])

    return np.asarray(np.linalg.solve(plane(old, *shape), plane(new, *new_shape)))


def field_of_view(
    cone_vec: ConeVec, shape: tuple[int, int], voxel_mm: float | None = None
) -> Grid:
    """Compute the largest box about the object frame's z axis that some view sees: as
    wide as the far edge of a shifted panel reaches, as high as the highest and lowest
    rows.

    Views on their side are swapped and tilted panels made upright first. Widths are those
    at the rotation axis, in the view of the largest magnification.

    Args:
        cone_vec: the scan.
        shape: detector (rows, cols).
        voxel_mm: default: the pixel's size at the rotation axis, to 1 um, or to three
            digits where it is below 10 um (`SMALL_MM`).

    Returns:
        Grid with whole voxels, at least one each way, centered on z = (up - down) / 2.

    Raises:
        GeometryError: the axis is not in front of the source in every view, a panel lies
            flat, or `voxel_mm` is not positive and finite.

    Example:
        >>> scan = ConeVec.circular(sod=600, sdd=1000, angles=12, shape=(8, 10), pixel=1)
        >>> field_of_view(scan, (8, 10)).shape
        (8, 11, 11)
    """
    if voxel_mm is not None and not 0.0 < voxel_mm < math.inf:
        raise GeometryError.instead(f"voxels of {voxel_mm:g} mm", voxel_mm, "more than 0")
    if on_its_side(cone_vec):
        cone_vec = swapped(cone_vec)
        shape = (shape[1], shape[0])
    if not is_upright(cone_vec):
        cone_vec = upright(cone_vec)
    rows, cols = shape
    normal = cone_vec.normal
    to_axis = -(cone_vec.source * normal).sum(axis=1)
    scale = float((to_axis / cone_vec.source_detector_distance).min())
    if scale <= 0:
        raise GeometryError(
            "the object's origin is not in front of the source in every view"
        )
    pitch = float(np.linalg.norm(cone_vec.u[0]))
    if voxel_mm is None:
        size = pitch * scale
        if size >= SMALL_MM:
            voxel_mm = round(size, 3)
        else:
            voxel_mm = float(f"{size:.3g}")
    centre = cone_vec.project_points(np.zeros((1, 3)), shape)[:, 0]
    reach = float(
        np.abs(np.concatenate([centre[:, 0] + 0.5, cols - 0.5 - centre[:, 0]])).max()
    )
    up = float((centre[:, 1] + 0.5).max()) * pitch * scale
    down = float((rows - 0.5 - centre[:, 1]).max()) * pitch * scale
    wide = max(1, math.ceil(2 * reach * pitch * scale / voxel_mm))
    high = max(1, round((up + down) / voxel_mm))
    return Grid((high, wide, wide), voxel_mm, (0.0, 0.0, (up - down) / 2))


def rows_needed(
    cone_vec: ConeVec, shape: tuple[int, int], like: Volume
) -> tuple[int, int]:
    """Find rows first <= r < last with the volume's shadow in some view, with 2 rows to spare at
    least.

    Both are limited to one row beyond the panel on either side, as pixels see beyond their
    centers: -1 to rows + 1. All rows if a corner of the volume has no finite image.
    `cone_vec`: n views; `shape`: detector (rows, cols); `like`: the volume.
    Returns (first, last), at least two rows.
    """
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    corners = np.array(like.center_mm) + signs * np.array(like.size_mm) / 2
    at = cone_vec.project_points(corners, shape)[..., 1]
    if not np.isfinite(at).all():
        return -1, shape[0] + 1
    first = int(np.clip(np.floor(at.min()) - 2, -1, shape[0] - 1))
    last = int(np.clip(np.ceil(at.max()) + 3, first + 2, shape[0] + 1))
    return first, last


def window(
    cone_vec: ConeVec,
    shape: tuple[int, int],
    rows: tuple[int, int],
    cols: tuple[int, int],
) -> ConeVec:
    """Compute the geometry of a part of the panel.

    `cone_vec`: n views. `shape`: (rows, cols) of the whole panel. `rows`: first row, and the one
    after the last; they may be off the panel. `cols`: first column, and the one after the last.
    """
    down, right = (
        (sum(part) - size) / 2 for part, size in zip((rows, cols), shape, strict=True)
    )
    centre = cone_vec.detector + down * cone_vec.v + right * cone_vec.u
    return ConeVec.from_vectors(cone_vec.source, centre, cone_vec.u, cone_vec.v)
