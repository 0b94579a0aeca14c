"""Projector and adjoint as an operator of CIL (Core Imaging Library).

CIL's geometries give shapes and voxel sizes to its algorithms; where source and panel are, the
projector knows by itself.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from cil.framework import AcquisitionGeometry, ImageGeometry
from cil.optimisation.operators import LinearOperator

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection.volume import Volume

_Map = Callable[[npt.NDArray[Any]], Float32Array]


def cil_operator(
    project: _Map,
    spread: _Map,
    like: Volume,
    geometry: ConeVec,
    image_shape: tuple[int, int, int],
) -> Any:
    """A `LinearOperator` from `ImageData` (vertical, horizontal_y, horizontal_x) to
    `AcquisitionData` (angle, vertical, horizontal).

    Args:
        project, spread: projector and transpose.
        like: the grid.
        geometry: the scan; the first view's distances stand in CIL's geometry.
        image_shape: (n, rows, cols).
    """
    nz, ny, nx = like.shape
    x, y, z = like.voxel_xyz
    voxels = ImageGeometry(
        voxel_num_x=nx, voxel_num_y=ny, voxel_num_z=nz,
        voxel_size_x=x, voxel_size_y=y, voxel_size_z=z,
    )  # fmt: skip
    n, rows, cols = image_shape
    source, whole = np.linalg.norm(geometry.source[0]), abs(geometry.source_detector_distance[0])
    pitches = [float(np.linalg.norm(step[0])) for step in (geometry.u, geometry.v)]
    images = AcquisitionGeometry.create_Cone3D(
        [0, -float(source), 0], [0, float(whole - source), 0]
    )
    images.set_panel([cols, rows], pitches)
    images.set_angles(list(range(n)))
    # CIL leaves out dimensions of one element.
    return _CilPair(
        voxels,
        images,
        lambda x: project(x.reshape(like.shape)),
        lambda y: spread(y.reshape(image_shape)),
    )


class _CilPair(LinearOperator):
    """A linear map with its transpose."""

    def __init__(self, domain: Any, range: Any, project: _Map, spread: _Map) -> None:
        super().__init__(domain_geometry=domain, range_geometry=range)
        self._project, self._spread = project, spread

    def direct(self, x: Any, out: Any = None) -> Any:
        """The projections of voxels."""
        return _filled(self._project, x, self.range_geometry(), out)

    def adjoint(self, x: Any, out: Any = None) -> Any:
        """The transpose of `direct`."""
        return _filled(self._spread, x, self.domain_geometry(), out)


def _filled(function: _Map, x: Any, geometry: Any, out: Any) -> Any:
    result = geometry.allocate(None) if out is None else out
    result.fill(function(x.as_array()).reshape(result.shape))
    return result
