"""Images of a tilted panel as an upright one would have seen them.

A pinhole image on one plane determines the image on any other through the same source: a
homography. FDK filters along rows, which must be horizontal; this makes them so. It refuses to
change images whose panel stands upright already.
"""

from __future__ import annotations

import numpy as np

from flexdt.twin.conventions import Float32Array, FloatArray
from flexdt.twin.geometry import ConeVec

UPRIGHT = 1e-7
"""Largest slope of rows and columns of a panel that counts as upright."""


def is_upright(cone_vec: ConeVec) -> bool:
    """Whether all rows are horizontal and all columns point down."""
    slope_u = np.abs(cone_vec.u[:, 2]) / np.linalg.norm(cone_vec.u, axis=1)
    slope_v = np.linalg.norm(cone_vec.v[:, :2], axis=1) / np.linalg.norm(cone_vec.v, axis=1)
    return bool(
        slope_u.max() <= UPRIGHT and slope_v.max() <= UPRIGHT and (cone_vec.v[:, 2] < 0).all()
    )


def upright(cone_vec: ConeVec) -> ConeVec:
    """Upright panels with the same centres and pitches, facing the same way horizontally."""
    u = cone_vec.u * (1.0, 1.0, 0.0)
    u *= (np.linalg.norm(cone_vec.u, axis=1) / np.linalg.norm(u, axis=1))[:, None]
    v = np.zeros_like(u)
    v[:, 2] = -np.linalg.norm(cone_vec.v, axis=1)
    return ConeVec.from_vectors(cone_vec.source, cone_vec.detector, u, v)


def rectified(images: Float32Array, cone_vec: ConeVec, target: ConeVec) -> Float32Array:
    """Images resampled (bicubic) onto the panels of `target`, which has the same sources.

    Args:
        images: (n, rows, cols).
        cone_vec, target: n rows each.
    """
    from flexdt.twin.reconstruction import fdk_kernels

    shape = (images.shape[1], images.shape[2])
    pairs = zip(cone_vec.rows, target.rows, strict=True)
    maps = np.array([homography(old, new, shape) for old, new in pairs])
    out = np.empty(images.shape, np.float32)
    fdk_kernels.warp(np.ascontiguousarray(images, dtype=np.float32), maps, out)
    return out


def homography(old: FloatArray, new: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """(3, 3): homogeneous (column, row) on `new` to those on `old`, pixel centres integer."""
    rows, cols = shape

    def plane(row: FloatArray) -> FloatArray:
        first = row[3:6] - row[0:3] - (cols - 1) / 2 * row[6:9] - (rows - 1) / 2 * row[9:12]
        return np.column_stack([row[6:9], row[9:12], first])

    return np.asarray(np.linalg.solve(plane(old), plane(new)))
