"""Parts of a scan, reconstructed on some planes beside its volume.

Every view is added once more, on a few planes of the volume, to one of four sums: views of even
and odd number by angle, with the source before and behind the planes. Even beside odd views are
two half scans of the same object with noise, and streaks, of their own. Views from before and
from behind show an edge that the planes cross from opposite sides: where the geometry is right,
at the same place.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection.volume import Volume
from flexdt.twin.reconstruction.acquisition.coverage import first_and_steps
from flexdt.twin.reconstruction.acquisition.trajectory import Circle
from flexdt.twin.reconstruction.feldkamp.fdk_views import Views

PLANES: Final = 3
"""Planes along x and z on which parts of the scan are reconstructed."""
SPACING_SHARE: Final = 0.2
"""Distance of the planes, of the grid's side along y."""
MAX_SHARE: Final = 0.04
"""Largest share of a volume's voxels that the planes have, but one plane at least."""


@dataclass(frozen=True, eq=False)
class HalfScans:
    """A volume's planes, from parts of the scan.

    Attributes:
        even, odd: from every second view, (planes, nz, nx) [1/mm], half of the values.
        before, behind: from the views with the source on either side of the planes,
            nothing of an odd number's last; half of the values.
        y_mm: of the planes, from the axis.
        voxel_mm: (x, z).
        middle: layers in the plane of the source, (nz,) bool: rays climb by less than a
            voxel across the object.
    """

    even: Float32Array
    odd: Float32Array
    before: Float32Array
    behind: Float32Array
    y_mm: tuple[float, ...]
    voxel_mm: tuple[float, float]
    middle: npt.NDArray[np.bool_]

    @classmethod
    def stacked(cls, slabs: Sequence[HalfScans]) -> HalfScans:
        """Put the planes of slabs, from the lowest up, on each other."""

        def piled(values: Iterable[Float32Array]) -> Float32Array:
            return np.concatenate(list(values), axis=1)

        return replace(
            slabs[0],
            even=piled(slab.even for slab in slabs),
            odd=piled(slab.odd for slab in slabs),
            before=piled(slab.before for slab in slabs),
            behind=piled(slab.behind for slab in slabs),
            middle=np.concatenate([slab.middle for slab in slabs]),
        )


class HalfScanMeter:
    """Adds views to the sums of their parts.

    Args:
        like: the volume's grid.
        circle: of the views.
        signs: (n,) of all views: 1 for even ones, -1 for odd ones, 0 for none.

    Attributes:
        grid: of the planes.
        factors: of voxels that some views do not see, (planes, nx, nz).
    """

    def __init__(self, like: Volume, circle: Circle, signs: Float32Array) -> None:
        """Make room for the planes."""
        ny = like.shape[1]
        planes = max(1, min(PLANES, int(MAX_SHARE * ny)))
        x, y, z = like.voxel_xyz
        spacing = max(round(SPACING_SHARE * ny), 1) * y
        self.grid = Volume(
            np.zeros((like.shape[0], planes, like.shape[2]), np.float32),
            (x, spacing, z),
            like.center_mm,
        )
        shape = planes, like.shape[2], like.shape[0]
        self._sums = np.zeros((2, 2, *shape), np.float32)
        self._circle = circle
        self._signs = signs
        self._height = 0.0
        self._used = False
        self.factors = np.ones(shape, np.float32)

    def add(self, views: Views, columns: Float32Array, done: int) -> None:
        """Add the next views to the sums of their parts.

        Args:
            views: n views.
            columns: (n or more, cols, rows) filtered; not changed.
            done: number of views before them.
        """
        from flexdt.twin.reconstruction.kernels import fdk_kernels

        first, size = first_and_steps(self.grid)
        rows = views.sizes[3]
        self._height = float(views.table[0, 2])
        self._used = True
        for k in range(len(views.images)):
            sign = self._signs[done + k]
            if not sign:
                continue
            behind = int(views.table[k, 1] > self._circle.centre[1])
            one = slice(k, k + 1)
            total = self._sums[int(sign < 0.0), behind]
            fdk_kernels.backproject(
                columns[one],
                rows,
                views.shares[one],
                views.table[one],
                *first,
                *size,
                total,
                1,
            )

    def found(self) -> HalfScans | None:
        """Return the planes after all views; None without any, as on a device.

        They are multiplied by `factors`, (planes, nx, nz): of voxels that some views do
        not see; NaN where too few do.
        """
        if not self._used:
            return None
        sums = (self._sums * self.factors).transpose(0, 1, 2, 4, 3)
        x, y, z = self.grid.centers()
        reach = float(np.abs(x - self._circle.centre[0]).max())
        climb = np.abs(z - self._height) * reach / self._circle.radius
        dx, _, dz = self.grid.voxel_xyz
        return HalfScans(
            sums[0].sum(axis=0),
            sums[1].sum(axis=0),
            sums[:, 0].sum(axis=0),
            sums[:, 1].sum(axis=0),
            tuple((y - self._circle.centre[1]).tolist()),
            (dx, dz),
            climb < dz,
        )
