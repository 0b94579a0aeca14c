"""A phantom as the coarse grid of material amounts in which scatter is simulated.

Solids and closed meshes are sampled as for any voxel phantom, ready voxels are averaged; each
keeps its mass, so that a bead smaller than a voxel still attenuates and scatters as much.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from flexdt.phantoms.channels import Body, Channel
from flexdt.phantoms.pieces import Surface
from flexdt.phantoms.voxelise import voxelise
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.physics.scatter import Object
from flexdt.twin.projection import Volume
from flexdt.twin.projection.analytic_solids import Scene, Vector

SUB_COLUMNS = 8
"""Samples of solids and meshes along x and y in each voxel; along z their ends are exact."""


def scatter_object(parts: Sequence[Channel], size_mm: Vector, voxels: int) -> Object:
    """The materials of a phantom on one grid about the origin.

    Args:
        parts: from `channels`.
        size_mm: the phantom's extent along x, y, z [mm].
        voxels: about so many cubes fill that box.

    Raises:
        PhantomError: a mesh that is not closed.

    Example:
        >>> from flexdt.phantoms import load_phantom
        >>> from flexdt.phantoms.channels import channels
        >>> lego = load_phantom("lego")
        >>> grid = scatter_object(channels(lego), lego.size_mm, 20_000)
        >>> [one.name for one in grid.substances]
        ['abs', 'steel']
    """
    least = max(size_mm) * 1e-3
    box = (max(size_mm[0], least), max(size_mm[1], least), max(size_mm[2], least))
    edge = (math.prod(box) / voxels) ** (1.0 / 3.0)
    empty = voxelise(Scene(()), (), box, edge, 1)
    amounts = [np.maximum(_amounts(part.body, empty, box), 0.0) for part in parts]
    data = np.stack(amounts, axis=-1) if amounts else np.zeros((*empty.data.shape, 0), np.float32)
    return Object(
        np.ascontiguousarray(data, dtype=np.float32),
        empty.voxel_xyz,
        empty.center_mm,
        tuple(part.material.substance for part in parts),
    )


def _amounts(body: Body, grid: Volume, box: Vector) -> Float32Array:
    edge = grid.voxel_xyz[0]
    if isinstance(body, Scene):
        return voxelise(body, (), box, edge, SUB_COLUMNS).data
    if not isinstance(body, Volume):
        surface = Surface(body.vertices, body.faces.astype(np.int32), "", 1.0)
        return voxelise(Scene(()), (surface,), box, edge, SUB_COLUMNS).data
    # The part of each coarse voxel that each fine one fills, axis by axis.
    x, y, z = (_overlaps(body, grid, axis) for axis in range(3))
    coarse = np.einsum("cz,zyx->cyx", z, body.data, optimize=True)
    coarse = np.einsum("cy,zyx->zcx", y, coarse, optimize=True)
    return np.asarray(np.einsum("cx,zyx->zyc", x, coarse, optimize=True), dtype=np.float32)


def _overlaps(fine: Volume, coarse: Volume, axis: int) -> FloatArray:
    """Length of each coarse voxel in each fine one over its own, (coarse, fine)."""

    def planes(volume: Volume) -> FloatArray:
        n, edge = volume.data.shape[2 - axis], volume.voxel_xyz[axis]
        return np.asarray((np.arange(n + 1) - n / 2.0) * edge + volume.center_mm[axis])

    a, b = planes(coarse), planes(fine)
    high = np.minimum(a[1:, None], b[None, 1:])
    low = np.maximum(a[:-1, None], b[None, :-1])
    return np.asarray(np.maximum(high - low, 0.0) / coarse.voxel_xyz[axis])
