"""The part of CIL's documented interface that an operator meets: geometries that allocate data,
data that are filled and read as arrays, and the base class of linear operators with its power
method. No wheel of CIL is to be had where these tests run.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any

import numpy as np
import pytest


class Data:
    def __init__(self, geometry: Any) -> None:
        self.geometry, self.shape = geometry, geometry.shape
        self._array = np.zeros(geometry.shape, np.float32)

    def fill(self, array: np.ndarray) -> None:
        if array.shape != self.shape:
            raise ValueError(f"cannot fill {self.shape} with {array.shape}")
        self._array[...] = array

    def as_array(self) -> np.ndarray:
        return self._array

    def dot(self, other: Data) -> float:
        return float(np.vdot(self._array, other._array))


class Geometry:
    shape: tuple[int, ...]

    def allocate(self, value: float | None = 0) -> Data:
        """Make data of this geometry, filled with a value; None leaves them as they are
        made.
        """
        data = Data(self)
        if value is not None:
            data._array[...] = value
        return data


class ImageGeometry(Geometry):
    def __init__(
        self, voxel_num_x: int, voxel_num_y: int, voxel_num_z: int, **sizes: float
    ):
        assert set(sizes) == {f"voxel_size_{a}" for a in "xyz"}
        self.sizes = sizes
        self.shape = (voxel_num_z, voxel_num_y, voxel_num_x)


class AcquisitionGeometry(Geometry):
    @classmethod
    def create_Cone3D(
        cls, source_position: Any, detector_position: Any
    ) -> AcquisitionGeometry:
        made = cls()
        made.source, made.detector = source_position, detector_position
        return made

    def set_panel(self, num_pixels: Any, pixel_size: Any) -> AcquisitionGeometry:
        self.panel, self.pixel = num_pixels, pixel_size
        return self

    def set_angles(self, angles: Any) -> AcquisitionGeometry:
        """CIL leaves out dimensions of one element."""
        sides = (len(angles), self.panel[1], self.panel[0])
        self.shape = tuple(n for n in sides if n > 1)
        return self


class LinearOperator:
    def __init__(self, domain_geometry: Any, range_geometry: Any) -> None:
        self._domain, self._range = domain_geometry, range_geometry

    def domain_geometry(self) -> Any:
        return self._domain

    def range_geometry(self) -> Any:
        return self._range

    def is_linear(self) -> bool:
        return True

    def norm(self) -> float:
        """CIL's power method, which uses `out`."""
        x, image = self._domain.allocate(1.0), self._range.allocate(None)
        size = 0.0
        for _ in range(20):
            x.fill(x.as_array() / np.linalg.norm(x.as_array()))
            self.direct(x, out=image)
            self.adjoint(image, out=x)
            size = float(np.sqrt(np.linalg.norm(x.as_array())))
        return size

    def direct(self, x: Data, out: Data | None = None) -> Data:
        raise NotImplementedError

    def adjoint(self, x: Data, out: Data | None = None) -> Data:
        raise NotImplementedError


def install(monkeypatch: pytest.MonkeyPatch) -> None:
    """Put this module's classes in the place of `cil.framework` and
    `cil.optimisation.operators`.

    The modules are put into `sys.modules`, until `monkeypatch` takes them out again.
    """
    for name, content in (
        ("cil", {}),
        ("cil.framework", {c.__name__: c for c in (ImageGeometry, AcquisitionGeometry)}),
        ("cil.optimisation", {}),
        ("cil.optimisation.operators", {"LinearOperator": LinearOperator}),
    ):
        module = ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
