"""Pixels of voxel projections divided into n x n, and averaged over: a pixel is an area.

The rays of a pixel are a regular grid, so that the projector walks them in its fans as those of a
finer panel. With two rays within a voxel's shadow along each side none is missed.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection.volume import DeviceVolume, Volume
from flexdt.twin.rays_a_pixel import MAX_RAYS, Rays, check_rays

RAYS_A_VOXEL: Final = 2
"""Rays along each side of a voxel's shadow."""
FINE_BYTES: Final = 128 << 20
"""Size of the divided images that are held at a time [bytes], at least those of one view: of the
adjoint, which adds a volume for each such batch."""
FORWARD_BYTES: Final = 32 << 20
"""The same of the projection, whose room is used again: the system clears less memory."""


def finer(geometry: ConeVec, shape: tuple[int, int], n: int) -> ConeVec:
    """Divide each pixel into n x n, on the same panel."""
    rows = geometry.rows.copy()
    rows[:, 6:] /= n
    return ConeVec(rows, (shape[0] * n, shape[1] * n))


def voxel_rays_a_side(
    volume: Volume | DeviceVolume, geometry: ConeVec, rays: Rays = "auto"
) -> int:
    """Compute the rays along each side of a pixel: as many as are asked for, or so many that
    `RAYS_A_VOXEL` are within a voxel's shadow, at least as many, at most `MAX_RAYS`.

    The shadow is that of the smallest edge at the volume's center, in the view in which it
    is smallest.

    Raises:
        LimitError: another number of rays.
    """
    asked = check_rays(rays)
    if asked != "auto":
        return asked
    if not len(geometry):
        return RAYS_A_VOXEL
    normal = np.cross(geometry.u, geometry.v)
    panel = np.einsum("ni,ni->n", normal, geometry.detector - geometry.source)
    center = np.array(volume.center_mm) - geometry.source
    depth = np.einsum("ni,ni->n", normal, center)
    sides = np.linalg.norm([geometry.u, geometry.v], axis=2).max(axis=0)
    here = float((sides * np.abs(depth / panel)).max())
    wanted = math.ceil(RAYS_A_VOXEL * here / min(volume.voxel_xyz) - 1e-6)
    return min(max(wanted, RAYS_A_VOXEL), MAX_RAYS)


def batches(
    views: int, shape: tuple[int, int], n: int, most: int = FINE_BYTES
) -> list[slice]:
    """List ranges of views whose divided images fit into `most` bytes."""
    step = max(1, most // max(1, 4 * n * n * shape[0] * shape[1]))
    return [slice(at, min(at + step, views)) for at in range(0, views, step)]


def averaged(
    images: Float32Array, n: int, out: Float32Array | None = None
) -> npt.NDArray[np.float32]:
    """Average divided images (k, n rows, n cols) over the pixels, (k, rows, cols)."""
    from flexdt.twin.projection.kernels import within_kernels

    k, rows, cols = images.shape
    if out is None:
        out = np.empty((k, rows // n, cols // n), np.float32)
    within_kernels.average_parts(images, n, out)
    return out


def divided(images: Float32Array, n: int) -> Float32Array:
    """Apply the transpose of `averaged`."""
    share = images * np.float32(1.0 / n**2)
    return np.ascontiguousarray(share.repeat(n, axis=1).repeat(n, axis=2))
