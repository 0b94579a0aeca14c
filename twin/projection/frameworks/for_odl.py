"""Projector and adjoint as an operator of ODL (Operator Discretization Library)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import odl

from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection.volume import Volume

_Map = Callable[[npt.NDArray[Any]], Float32Array]


def odl_operator(
    project: _Map, spread: _Map, like: Volume, image_shape: tuple[int, int, int]
) -> Any:
    """An `odl.Operator` from functions on a box in mm, axes (z, y, x), to arrays of projections.

    Args:
        project, spread: projector and transpose.
        like: the grid.
        image_shape: (n, rows, cols).
    """
    centre, size = np.array(like.center_mm[::-1]), np.array(like.size_mm[::-1])
    voxels = odl.uniform_discr(
        centre - size / 2, centre + size / 2, like.shape, dtype="float32", weighting=1.0
    )
    return _OdlPair(voxels, odl.rn(image_shape, dtype="float32"), project, spread)


class _OdlPair(odl.Operator):
    """A linear map with its transpose."""

    def __init__(self, domain: Any, range: Any, project: _Map, spread: _Map) -> None:
        super().__init__(domain, range, linear=True)
        self._project, self._spread = project, spread

    def _call(self, x: Any) -> Any:
        # ODL's elements want memory in C order.
        return self.range.element(np.ascontiguousarray(self._project(x.asarray())))

    @property
    def adjoint(self) -> Any:
        """The transpose."""
        return _OdlPair(self.range, self.domain, self._spread, self._project)
