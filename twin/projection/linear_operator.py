"""The projector of one scan and one grid as a linear operator, for algorithms written as
algebra.

`A @ x` is `forward`, `A.T @ y` is `back`, and one is the exact transpose of the other, as
least squares, proximal methods and automatic differentiation need. Arrays of other
libraries come in by DLPack, and go out as arrays of the same library. SciPy, PyTorch, ODL
and CIL get operators of their own kind; each of these libraries is imported by the method
that is named after it, and by nothing else.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, singledispatch
from importlib import import_module
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import GeometryError, LimitError, NotBuiltError, TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection import gpu
from flexdt.twin.projection.device_arrays import DeviceArray
from flexdt.twin.projection.linear import Model
from flexdt.twin.projection.operators import (
    Shape2,
    as_cone_vec,
    back,
    check_sampling,
    forward,
    geometry_change,
    geometry_gradient,
)
from flexdt.twin.projection.volume import DeviceVolume, Grid, Volume, as_volume, room_like
from flexdt.twin.rays_a_pixel import Rays
from flexdt.twin.signatures import public

if TYPE_CHECKING:
    from flexdt.twin.projection.for_torch import TorchOperator

HOST = 1
"""DLPack's number of the processor's memory."""
SMALLEST_TOLERANCE = 1e-5
"""Smallest relative tolerance of a norm: images and voxels are single precision."""


def on_host(function: Callable[[npt.NDArray[Any]], Float32Array]) -> Callable[[Any], Any]:
    """Wrap a function of a numpy array for arrays of any library.

    NumPy's arrays, and values without DLPack, give a NumPy array. The memory of any other
    array is shared by DLPack, and the result goes to `from_dlpack` of the array's own
    library.

    Raises:
        NotBuiltError: the array is in the memory of a device.
    """

    def wrapped(x: Any) -> Any:
        """Call the function with a NumPy array of `x`, and return its result in the library that
        `x` is from.

        Raises NotBuiltError: `x` is on a device."""
        if isinstance(x, np.ndarray) or not hasattr(x, "__dlpack__"):
            return function(np.asarray(x))
        gpu.check_host(x.__dlpack_device__()[0] == HOST, type(x).__name__)
        return _library(x).from_dlpack(function(np.from_dlpack(x)))

    return wrapped


def _library(x: Any) -> Any:
    """Return the module with the functions for an array, by the array API standard."""
    if hasattr(x, "__array_namespace__"):
        return x.__array_namespace__()
    return sys.modules[type(x).__module__.partition(".")[0]]


@public
@dataclass(frozen=True, eq=False)
class Operator:
    """The linear map from the voxels of a grid to the line integrals of a scan.

    Voxels and projections may be arrays of numpy, of PyTorch, or of any other library that
    hands out its memory by DLPack; the result is an array of the same library. The values are
    computed and returned as float32. Voxels that come out of numpy have z contiguous in memory,
    which the projector reads without a copy; use np.ascontiguousarray where C order matters.

    Attributes:
        geometry: the scan; an array (n, 12) [mm] is taken for one.
        like: the grid, a `Volume` (its values are not used) or a `Grid`.
        detector_shape: (rows, cols): those of the geometry, or else `shape`.
        model: "exact", voxels of one value each, or "linear", samples of something smooth
            (docs/operator.md has which one when). Gradients by the geometry are those of
            "exact" with one ray.
        rays: along each side of a pixel, of which the line integrals are averaged; "auto", two
            to the shadow of a voxel. "linear" averages over the pixel by itself.

    Raises:
        GeometryError: the geometry does not hold, or the shape of the detector is not known.
        LimitError: an unknown model, or rays that it does not have.

    Examples:
        >>> view = ConeVec.from_vectors((0, -500, 0), (0, 500, 0), (1, 0, 0), (0, 0, -1))
        >>> A = Operator(view, like=Volume(np.zeros((3, 4, 3)), 0.5), shape=(1, 1))
        >>> x = np.full((3, 4, 3), 0.02)
        >>> (A @ x).shape, round(float((A @ x)[0, 0, 0]), 4)
        ((1, 1, 1), 0.04)
        >>> round(float((A.T @ np.ones((1, 1, 1))).sum()), 4)  # the ray's length [mm]
        2.0
    """

    geometry: ConeVec
    like: Volume
    detector_shape: Shape2
    model: Model
    rays: Rays
    dtype: ClassVar = np.dtype(np.float32)

    def __init__(
        self,
        geometry: ConeVec | npt.ArrayLike,
        like: Volume | Grid,
        shape: Shape2 | None = None,
        *,
        model: Model = "exact",
        rays: Rays = 1,
    ) -> None:
        """Take the geometry, the volume's grid, the detector's shape (None: the geometry's),
        the model and the rays a pixel; see the class. Values of `like` are ignored.
        """
        scan = as_cone_vec(geometry)
        check_sampling(model, rays)
        object.__setattr__(self, "model", model)
        object.__setattr__(self, "rays", rays)
        object.__setattr__(self, "geometry", scan)
        object.__setattr__(self, "like", as_volume(like))
        object.__setattr__(self, "detector_shape", scan.of_shape(shape))

    def __repr__(self) -> str:
        """Format the shapes of the volume (z, y, x voxels) and of the images (views,
        rows, columns).
        """
        n, rows, cols = self.image_shape
        z, y, x = self.voxel_shape
        views = f"{n} views of {rows} x {cols} pixels (rows x columns)"
        return f"<Operator: {z} x {y} x {x} voxels to {views}>"

    @property
    def voxel_shape(self) -> tuple[int, int, int]:
        """Shape of the input, (nz, ny, nx)."""
        return self.like.shape

    @property
    def image_shape(self) -> tuple[int, int, int]:
        """Shape of the result, (n, rows, cols)."""
        return len(self.geometry), *self.detector_shape

    @property
    def T(self) -> Adjoint:
        """The transpose."""
        return Adjoint(self)

    def __matmul__(self, x: Any) -> Any:
        """Compute line integrals (n, rows, cols) of voxels (nz, ny, nx) [1/mm] or of a
        volume.

        Tensors are projected with gradients, and may be batches. Of other arrays the
        result is in their own library; of a `DeviceVolume` it stays on the device.

        Raises:
            GeometryError: a volume on another grid, or another shape.
            NotBuiltError: an array on a device that is neither tensor nor `DeviceVolume`.
        """
        if isinstance(x, (Volume, DeviceVolume)):
            if not _same_grid(x, self.like):
                given, wanted = (
                    f"{v.shape} voxels of {v.voxel_xyz} mm at {v.center_mm} mm"
                    for v in (x, self.like)
                )
                raise GeometryError.instead(
                    f"a volume of {given}",
                    list(x.shape),
                    f"the operator's grid, {wanted}",
                )
            return forward(x, self.geometry, self.detector_shape, **self._sampling)
        if _is_tensor(x):
            return self.torch()(x)
        return on_host(self._forward)(x)

    def _forward(self, x: npt.NDArray[Any]) -> Float32Array:
        _check(x.shape, self.voxel_shape, "voxels")
        volume = self.like.like(x)
        return forward(volume, self.geometry, self.detector_shape, **self._sampling)

    @property
    def _sampling(self) -> dict[str, Any]:
        """Model and rays, as arguments of `forward` and `back`."""
        return {"model": self.model, "rays": self.rays}

    def _back(self, y: npt.NDArray[Any]) -> Float32Array:
        """Apply the transpose to images of `image_shape`; returns voxels (nz, ny, nx).

        Raises GeometryError: another shape.
        """
        _check(y.shape, self.image_shape, "projections")
        room = room_like(self.like)
        back(y, self.geometry, self.like, room, **self._sampling)
        return room

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns, for `scipy.sparse.linalg.aslinearoperator`."""
        return math.prod(self.image_shape), math.prod(self.voxel_shape)

    def matvec(self, x: npt.NDArray[Any]) -> Float32Array:
        """Compute line integrals of voxels, flat both (C order).

        Example:
            >>> view = ConeVec.from_vectors((0, -500, 0), (0, 500, 0), (1, 0, 0), (0, 0, -1))
            >>> Operator(view, like=Grid((3, 4, 3), 0.5), shape=(1, 1)).matvec(np.ones(36))
            array([2.], dtype=float32)"""
        return self._forward(x.reshape(self.voxel_shape)).ravel()

    def rmatvec(self, y: npt.NDArray[Any]) -> Float32Array:
        """Apply the transpose to projections, flat both (C order).

        Example:
            >>> view = ConeVec.from_vectors((0, -500, 0), (0, 500, 0), (1, 0, 0), (0, 0, -1))
            >>> Operator(view, like=Grid((3, 4, 3), 0.5), shape=(1, 1)).rmatvec(np.ones(1)).shape
            (36,)"""
        return self._back(y.reshape(self.image_shape)).ravel()

    def norm(self, tolerance: float = 1e-3) -> float:
        """Compute the largest singular value [mm] by the power method.

        Lengths are never negative, so that the iteration from all ones leads to the
        largest one. It ends when an eigenvalue of A' A is certain to be within twice the
        tolerance of its estimate (by the residual); the estimate is never above the true
        value, except for rounding.

        Args:
            tolerance: relative, at least 1e-5.

        Raises:
            LimitError: the tolerance is below 1e-5, or 1 or more.

        Example:
            >>> view = ConeVec.from_vectors((0, -500, 0), (0, 500, 0), (1, 0, 0), (0, 0, -1))
            >>> A = Operator(view, like=Grid((3, 4, 3), 0.5), shape=(1, 1))
            >>> round(A.norm(), 2)  # one ray through four voxels of 0.5 mm: 0.5 sqrt(4)
            1.0
        """
        if not SMALLEST_TOLERANCE <= tolerance < 1.0:
            message = f"the tolerance is {tolerance:g}"
            raise LimitError.instead(message, tolerance, f"{SMALLEST_TOLERANCE:g} to 1")
        return norm_of(
            self._forward, self._back, np.ones(self.voxel_shape, np.float32), tolerance
        )

    def gradient(self, x: Volume | npt.ArrayLike, weights: npt.ArrayLike) -> FloatArray:
        """Compute the derivative of sum(weights * (A @ x)) by the geometry, (n, 12)
        [1/mm].

        See `flexdt.twin.projection.operators`.

        Example:
            >>> view = ConeVec.from_vectors((0, -500, 0), (0, 500, 0), (1, 0, 0), (0, 0, -1))
            >>> A = Operator(view, like=Grid((3, 4, 3), 0.5), shape=(1, 1))
            >>> A.gradient(np.ones((3, 4, 3)), np.ones((1, 1, 1))).shape
            (1, 12)"""
        return geometry_gradient(self._volume(x), self.geometry, weights)

    def change(self, x: Volume | npt.ArrayLike, change: npt.ArrayLike) -> Float32Array:
        """Compute the derivative of A @ x along a change (n, 12) of the geometry, (n,
        rows, cols).

        See `flexdt.twin.projection.geometry_change`.

        Example:
            >>> view = ConeVec.from_vectors((0, -500, 0), (0, 500, 0), (1, 0, 0), (0, 0, -1))
            >>> A = Operator(view, like=Grid((3, 4, 3), 0.5), shape=(1, 1))
            >>> A.change(np.ones((3, 4, 3)), np.ones((1, 12))).shape
            (1, 1, 1)"""
        return geometry_change(
            self._volume(x), self.geometry, change, self.detector_shape
        )

    def _volume(self, x: Volume | npt.ArrayLike) -> Volume:
        if isinstance(x, Volume):
            return x
        return self.like.like(np.asarray(x))

    def linear_operator(self) -> Any:
        """Return the map as a `scipy.sparse.linalg.LinearOperator` on flat vectors (C
        order).

        Example:
            >>> view = ConeVec.from_vectors((0, -500, 0), (0, 500, 0), (1, 0, 0), (0, 0, -1))
            >>> A = Operator(view, like=Grid((3, 4, 3), 0.5), shape=(1, 1))
            >>> A.linear_operator().shape
            (1, 36)"""
        from scipy.sparse.linalg import aslinearoperator

        return aslinearoperator(self)

    def torch(self) -> TorchOperator:
        """Return the map for PyTorch tensors, with gradients by voxels and geometry.

        Needs the extra `torch`. See `flexdt.twin.projection.for_torch.TorchOperator`.

        Raises:
            TwinError: PyTorch is not installed.
        """
        _require("torch", "pip install 'flexdt[torch]'")
        return self._torch

    @cached_property
    def _torch(self) -> TorchOperator:
        from flexdt.twin.projection.for_torch import TorchOperator

        if self._sampling != {"model": "exact", "rays": 1}:
            raise NotBuiltError(
                f"model {self.model!r} with rays {self.rays} for PyTorch; "
                "allowed: 'exact' with 1",
                {"asked": [self.model, str(self.rays)]},
            )
        return TorchOperator(self.geometry, self.like, self.detector_shape)

    def odl(self) -> Any:
        """Return the map as an `odl.Operator`, from functions in mm (z, y, x).

        Both spaces have the weight 1. Raises TwinError: ODL is not installed.
        """
        _require("odl", "pip install 'flexdt[odl]'")
        from flexdt.twin.projection.for_odl_and_cil import odl_operator

        return odl_operator(self._forward, self._back, self.like, self.image_shape)

    def cil(self) -> Any:
        """Return the map as a `LinearOperator` of CIL (tried with 26.0), for its algorithms;
        rays are this operator's. Raises TwinError: CIL is not installed."""
        _require("cil", "conda install -c ccpi cil")
        from flexdt.twin.projection.for_odl_and_cil import cil_operator

        return cil_operator(
            self._forward, self._back, self.like, self.geometry, self.image_shape
        )


def _require(package: str, how: str) -> None:
    """Check that a package can be imported.

    Raises:
        TwinError: it is not installed; `how` ends the message.
    """
    try:
        import_module(package)
    except ImportError as error:
        text = f"{package} is not installed ({error}): {how}"
        raise TwinError(text, {"missing": package}) from None


@dataclass(frozen=True, eq=False)
class Adjoint:
    """The transpose of an `Operator`.

    Attributes:
        T: the operator.
    """

    T: Operator

    def __repr__(self) -> str:
        return f"{self.T!r}.T"

    def __matmul__(self, y: Any) -> Any:
        """Apply the transpose to projections (n, rows, cols); returns voxels (nz, ny,
        nx).

        Arrays on CUDA give a `DeviceVolume`, tensors a tensor with gradients. Raises
        GeometryError: another shape.
        """
        if not _is_tensor(y) and gpu.is_there(y):
            _check(tuple(y.shape), self.T.image_shape, "projections")
            return back(y, self.T.geometry, self.T.like, **self.T._sampling)
        if _is_tensor(y):
            return self.T.torch().T(y)
        return on_host(self.T._back)(y)


def _is_tensor(x: object) -> bool:
    """Return whether x is a PyTorch tensor, without importing PyTorch."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(x, torch.Tensor)


def _check(got: tuple[int, ...], wanted: tuple[int, int, int], what: str) -> None:
    """Check a shape of `what`, as the message calls it.

    Raises GeometryError: `got` is not `wanted`.
    """
    if got != wanted:
        raise GeometryError.of_shape(
            what, got, wanted, " (flat vectors: linear_operator())"
        )


def _same_grid(a: Volume | DeviceVolume, b: Volume) -> bool:
    """Check whether two volumes have the same voxels at the same place, up to rounding."""
    return (
        a.shape == b.shape
        and np.allclose(a.voxel_xyz, b.voxel_xyz, rtol=1e-9)
        and np.allclose(a.center_mm, b.center_mm, rtol=1e-9, atol=1e-9)
    )


@singledispatch
def dot(a: Any, b: Any) -> float:
    """Compute the inner product of two arrays of one shape in double precision."""
    axes = [*range(a.ndim)]
    return float(np.einsum(a, axes, b, axes, [], dtype=np.float64))


dot.register(DeviceArray, DeviceArray.dot)


def norm_of(
    project: Callable[[Any], Any],
    spread: Callable[[Any], Any],
    ones: Any,
    tolerance: float,
) -> float:
    """Compute `Operator.norm` of a map and its transpose.

    Args:
        project, spread: the map and its transpose.
        ones: array of ones, of numpy or on a device, from which the iteration starts.
        tolerance: relative.

    Returns:
        The largest singular value [mm]; 0 where no ray meets the grid.
    """
    x = ones
    while True:
        x = x * np.float32(1.0 / np.sqrt(dot(x, x)))
        image = spread(project(x))
        square = dot(x, image)
        if square == 0.0:  # no ray meets the grid
            return 0.0
        rest = image - np.float32(square) * x
        if dot(rest, rest) <= (2 * tolerance * square) ** 2:
            return float(np.sqrt(square))
        x = image
