"""Projector and adjoint as operators of ODL (Operator Discretization Library) and of CIL
(Core Imaging Library). Both libraries are imported only when one of their operators is
made.

CIL's geometries give shapes and voxel sizes to its algorithms; where source and panel
are, the projector knows by itself.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection.volume import Volume

_Map = Callable[[npt.NDArray[Any]], Float32Array]


def odl_operator(
    project: _Map, spread: _Map, like: Volume, image_shape: tuple[int, int, int]
) -> Any:
    """Wrap projector and transpose as an `odl.Operator`.

    It maps functions on a box in mm, axes (z, y, x), to arrays of projections.

    Args:
        project, spread: projector and transpose.
        like: the grid.
        image_shape: (n, rows, cols).

    Returns:
        An `odl.Operator` with its adjoint.
    """
    import odl

    class Pair(odl.Operator):
        """A linear map with its transpose."""

        def __init__(self, domain: Any, range: Any, project: _Map, spread: _Map) -> None:
            super().__init__(domain, range, linear=True)
            self._project = project
            self._spread = spread

        def _call(self, x: Any) -> Any:
            # ODL's elements want memory in C order.
            return self.range.element(np.ascontiguousarray(self._project(x.asarray())))

        @property
        def adjoint(self) -> Any:
            """The transpose."""
            return Pair(self.range, self.domain, self._spread, self._project)

    centre = np.array(like.center_mm[::-1])
    size = np.array(like.size_mm[::-1])
    voxels = odl.uniform_discr(
        centre - size / 2, centre + size / 2, like.shape, dtype="float32", weighting=1.0
    )
    return Pair(voxels, odl.rn(image_shape, dtype="float32"), project, spread)


def cil_operator(
    project: _Map,
    spread: _Map,
    like: Volume,
    geometry: ConeVec,
    image_shape: tuple[int, int, int],
) -> Any:
    """Make a `LinearOperator` from `ImageData` (vertical, horizontal_y, horizontal_x) to
    `AcquisitionData` (angle, vertical, horizontal).

    `out` is filled if given, else a new container is returned. Angles of CIL's geometry
    are the views' numbers, as a cone_vec has none.

    Args:
        project, spread: projector and transpose.
        like: the grid.
        geometry: the scan; the first view's distances are those of CIL's geometry.
        image_shape: (n, rows, cols).
    """
    from cil.framework import AcquisitionGeometry, ImageGeometry
    from cil.optimisation.operators import LinearOperator

    def fill_container(
        function: _Map, x: Any, shape: tuple[int, int, int], geometry: Any, out: Any
    ) -> Any:
        """Apply a function to the array of a CIL container, and put the result into `out`, or
        into a new container of `geometry`.
        """
        if out is None:
            result = geometry.allocate(None)
        else:
            result = out
        # CIL leaves out dimensions of one element.
        result.fill(function(x.as_array().reshape(shape)).reshape(result.shape))
        return result

    class Pair(LinearOperator):
        """A linear map with its transpose."""

        def direct(self, x: Any, out: Any = None) -> Any:
            """Project voxels."""
            return fill_container(project, x, like.shape, self.range_geometry(), out)

        def adjoint(self, x: Any, out: Any = None) -> Any:
            """Apply the transpose of `direct`."""
            return fill_container(spread, x, image_shape, self.domain_geometry(), out)

    nz, ny, nx = like.shape
    x, y, z = like.voxel_xyz
    voxels = ImageGeometry(
        voxel_num_x=nx,
        voxel_num_y=ny,
        voxel_num_z=nz,
        voxel_size_x=x,
        voxel_size_y=y,
        voxel_size_z=z,
    )
    n, rows, cols = image_shape
    source = np.linalg.norm(geometry.source[0])
    whole = abs(geometry.source_detector_distance[0])
    images = AcquisitionGeometry.create_Cone3D(
        [0, -float(source), 0], [0, float(whole - source), 0]
    )
    pitches = [float(np.linalg.norm(step[0])) for step in (geometry.u, geometry.v)]
    images.set_panel([cols, rows], pitches)
    images.set_angles(list(range(n)))
    return Pair(domain_geometry=voxels, range_geometry=images)
