"""Projector and adjoint for PyTorch, differentiable in voxels, projections and geometry.

The projector is linear in the voxels, so its derivative is the adjoint, and the derivative of
the adjoint is the projector: any order of derivatives is right. With respect to the geometry
there is the first derivative, `geometry_gradient`, for projector and adjoint alike; that of the
adjoint is the same, because <w, A' y> = <A w, y>.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from flexdt.twin.errors import GeometryError, NotBuiltError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import gpu
from flexdt.twin.projection.operators import Shape2, back, forward, geometry_gradient
from flexdt.twin.projection.volume import DeviceVolume, Volume


@dataclass(frozen=True, eq=False)
class TorchOperator:
    """The projector as a function of tensors: call it, and call `T` for its transpose.

    Tensors are of any floating type, on the processor or on a CUDA device, where the results
    stay then and memory is shared in and out; only voxels whose z is not contiguous (as it is
    in what `T` gives) are brought into that order first, there, and the derivative by the
    geometry is computed on the processor. Arrays of other libraries come in by DLPack. The
    values are computed and returned as float32, gradients in the type of their tensor.

    Attributes:
        geometry: the scan, if the call gives no geometry.
        like: the grid; its values are not used.
        detector_shape: (rows, cols).
        transposed: whether this is the adjoint.
    """

    geometry: ConeVec
    like: Volume
    detector_shape: Shape2
    transposed: bool = False

    @property
    def T(self) -> TorchOperator:
        """The transpose."""
        return TorchOperator(
            self.geometry, self.like, self.detector_shape, not self.transposed
        )

    def __call__(self, values: Any, rows: Any = None) -> Any:
        """Project voxels, or spread projections if this is the adjoint; float32.

        Args:
            values: (nz, ny, nx) [1/mm] or (n, rows, cols), after batch dimensions.
            rows: geometry tensor (n, 12) [mm] of all; its derivative needs float64, as
                single precision rounds a meter to 0.06 um.

        Raises GeometryError: a shape does not fit; NotBuiltError: a device other than
        CUDA's, or a second derivative by geometry; DeviceError: the device failed.
        """
        values = _tensor(values)
        rows = _tensor(self.geometry.rows if rows is None else rows)
        if rows.ndim != 2 or rows.shape[1] != 12:
            raise GeometryError.of_shape("rows", rows.shape, ("n", 12))
        images = (len(rows), *self.detector_shape)
        if self.transposed:
            wanted = images
        else:
            wanted = self.like.shape
        if tuple(values.shape[-3:]) != wanted:
            raise GeometryError.of_shape("values", values.shape, ("...", *wanted))
        if self.transposed:
            function = _Spread
        else:
            function = _Project
        return function.apply(values, rows, self)


class _Project(torch.autograd.Function):
    """x, rows -> A(rows) x."""

    @staticmethod
    def forward(ctx: Any, x: Any, rows: Any, a: TorchOperator) -> Any:
        """Project volumes (..., nz, ny, nx) on their device, and store them for
        `backward`.

        Returns float32 (..., n, rows, cols).
        """
        ctx.save_for_backward(x, rows)
        ctx.a = a
        cone_vec = _cone_vec(rows)
        images = (len(rows), *a.detector_shape)
        return _each(
            lambda one: forward(_volume(one, a.like), cone_vec, images[1:]), x, images
        )

    @staticmethod
    def backward(ctx: Any, g: Any) -> Any:
        """Compute gradients with respect to the volumes and to the rows of cone_vec, None
        where none is needed, and None for the operator.
        """
        x, rows = ctx.saved_tensors
        if ctx.needs_input_grad[0]:
            by_x = _Spread.apply(g, rows, ctx.a).to(x.dtype)
        else:
            by_x = None
        if ctx.needs_input_grad[1]:
            by_rows = _ByRows.apply(x, g, rows, ctx.a)
        else:
            by_rows = None
        return by_x, by_rows, None


class _Spread(torch.autograd.Function):
    """y, rows -> A(rows)' y."""

    @staticmethod
    def forward(ctx: Any, y: Any, rows: Any, a: TorchOperator) -> Any:
        """Spread images (..., n, rows, cols) on their device, and store them for
        `backward`.

        Returns float32 (..., nz, ny, nx).
        """
        ctx.save_for_backward(y, rows)
        ctx.a = a
        cone_vec = _cone_vec(rows)
        return _each(
            lambda one: _voxels(back(_memory(one), cone_vec, a.like)), y, a.like.shape
        )

    @staticmethod
    def backward(ctx: Any, g: Any) -> Any:
        """Compute gradients with respect to the images and to the rows of cone_vec, None
        where none is needed, and None for the operator.
        """
        y, rows = ctx.saved_tensors
        if ctx.needs_input_grad[0]:
            by_y = _Project.apply(g, rows, ctx.a).to(y.dtype)
        else:
            by_y = None
        if ctx.needs_input_grad[1]:
            by_rows = _ByRows.apply(g, y, rows, ctx.a)
        else:
            by_rows = None
        return by_y, by_rows, None


class _ByRows(torch.autograd.Function):
    """x, y, rows -> derivative of <A(rows) x, y> with respect to rows, summed over the
    batch."""

    @staticmethod
    def forward(ctx: Any, x: Any, y: Any, rows: Any, a: TorchOperator) -> Any:
        """Compute the gradient of the images' inner product with `y` with respect to
        cone_vec, (n, 12), summed over the batch; on the processor, returned on the
        device of `rows`.
        """
        cone_vec = _cone_vec(rows)
        total = np.zeros((len(rows), 12))
        images = y.detach().cpu().reshape(-1, len(rows), *a.detector_shape)
        for one, weights in zip(
            x.detach().cpu().reshape(-1, *a.like.shape), images, strict=True
        ):
            total += geometry_gradient(
                a.like.like(one.numpy()), cone_vec, weights.numpy()
            )
        return torch.as_tensor(total, dtype=rows.dtype, device=rows.device)

    @staticmethod
    def backward(ctx: Any, g: Any) -> Any:
        """Refuse second derivatives with respect to the geometry.

        Raises NotBuiltError: always.
        """
        raise NotBuiltError(
            "second derivatives with respect to the geometry are not built; allowed: the first",
            {"asked": 2, "allowed": 1},
        )


def _tensor(values: Any) -> Any:
    """Convert an array of any library to a tensor that shares its memory; a read-only
    array is copied.

    Raises:
        NotBuiltError: it is on another device than the processor and a CUDA device that
            works.
    """
    if isinstance(values, np.ndarray):
        values = (
            values if values.flags.writeable else values.copy()
        )  # no tensor is read-only
    if isinstance(values, torch.Tensor):
        tensor = values
    else:
        tensor = torch.from_dlpack(values)
    usable = _is_there(tensor) and gpu.availability().present
    gpu.check_host(
        usable or tensor.device.type == "cpu", f"the tensor on {tensor.device}"
    )
    return tensor


def _is_there(tensor: Any) -> bool:
    return bool(tensor.device.type == "cuda")


def _cone_vec(rows: Any) -> ConeVec:
    return ConeVec(rows.detach().to(torch.float64).cpu().numpy())


def _memory(one: Any) -> Any:
    """View a tensor as numpy's or numba's array, which shares its memory."""
    if _is_there(one):
        return gpu.taken(one.contiguous())
    return one.numpy()


def _volume(one: Any, like: Volume) -> Volume | DeviceVolume:
    """Wrap voxels as a volume with the place and voxel size of `like`.

    Args:
        one: tensor (nz, ny, nx). On a device its memory is shared if z is contiguous, and
            copied if not.
        like: place and size.
    """
    if not _is_there(one):
        return like.like(one.numpy())
    columns = one.permute(1, 2, 0)
    if len(one) > 1 and columns.stride(2) != 1:
        columns = columns.contiguous()
    y, x, _ = columns.stride()
    ny, nx, nz = columns.shape
    flat = columns.as_strided(((ny - 1) * y + (nx - 1) * x + nz,), (1,))
    return DeviceVolume.sharing(like, gpu.taken(flat), (y, x))


def _voxels(volume: Volume | DeviceVolume) -> Any:
    """Return the voxels of a result of `back`, in C order if they are numpy's."""
    if isinstance(volume, DeviceVolume):
        return volume
    return np.array(volume.data, order="C")


def _each(
    function: Callable[[Any], Any], values: Any, shape: tuple[int, int, int]
) -> Any:
    """Apply a function to each member of a batch, on its device.

    Before and after, it waits for PyTorch's streams and for the kernels' own, which do
    not know each other.

    Args:
        function: of a three-dimensional float32 tensor (without a gradient); returns an
            array.
        values: tensor (..., a, b, c).
        shape: of the function's results.

    Returns:
        A float32 tensor (..., *shape) on the device of `values`; empty for an empty
        batch.
    """
    batch = values.shape[:-3]
    device = values.device
    members = values.detach().to(torch.float32).reshape(-1, *values.shape[-3:])
    if _is_there(values):
        with gpu.on(device.index or 0):
            torch.cuda.current_stream(device).synchronize()
            results = [
                torch.as_tensor(function(member), device=device) for member in members
            ]
            gpu.finish()
    else:
        results = [torch.from_numpy(function(member)) for member in members]
    if len(results) == 1:
        return results[0].reshape(*batch, *shape)
    if results:
        whole = torch.stack(results)
    else:
        whole = torch.zeros(0, device=device)
    return whole.reshape(*batch, *shape)
