"""Projector and adjoint for PyTorch, differentiable in voxels, projections and geometry.

The projector is linear in the voxels, so its derivative is the adjoint, and the derivative of the
adjoint is the projector: any order of derivatives is right. With respect to the geometry there is
the first derivative, `geometry_gradient`, for projector and adjoint alike; that of the adjoint is
the same, because <w, A' y> = <A w, y>.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from flexdt.twin.errors import GeometryError, NotBuiltError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection.arrays import check_host
from flexdt.twin.projection.geometry_gradient import geometry_gradient
from flexdt.twin.projection.operators import Shape2, back, forward
from flexdt.twin.projection.volume import Volume


@dataclass(frozen=True, eq=False)
class TorchOperator:
    """The projector as a function of tensors: call it, and call `T` for its transpose.

    Tensors are on the processor, of any floating type; arrays of other libraries come in by DLPack.
    The values are computed and returned as float32, gradients in the type of their tensor.

    Attributes:
        geometry: the scan, where none is given with the call.
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
        return TorchOperator(self.geometry, self.like, self.detector_shape, not self.transposed)

    def __call__(self, values: Any, rows: Any = None) -> Any:
        """Project voxels, or spread projections if this is the adjoint.

        Args:
            values: (nz, ny, nx) [1/mm] or projections (n, rows, cols), with any number of batch
                dimensions before them.
            rows: the geometry as a tensor (n, 12) [mm], for all of the batch; with
                `requires_grad` it gets the derivative. Take float64: single precision rounds
                distances of a metre to 0.06 um, which is felt in sums over many pixels.

        Returns:
            float32 tensor, batch dimensions as given.

        Raises:
            GeometryError: a shape does not fit.
            NotBuiltError: a tensor is on a device, or a second derivative with respect to the
                geometry is asked for.
        """
        values = _tensor(values)
        rows = _tensor(self.geometry.rows if rows is None else rows)
        if rows.ndim != 2 or rows.shape[1] != 12:
            raise GeometryError(
                f"rows of shape {tuple(rows.shape)}; allowed: (n, 12)",
                {"asked": list(rows.shape), "allowed": ["n", 12]},
            )
        images = (len(rows), *self.detector_shape)
        wanted = images if self.transposed else self.like.shape
        if tuple(values.shape[-3:]) != wanted:
            raise GeometryError(
                f"values of shape {tuple(values.shape)}; allowed: (..., {str(wanted)[1:]}",
                {"asked": list(values.shape), "allowed": list(wanted)},
            )
        function = _Spread if self.transposed else _Project
        return function.apply(values, rows, self)


class _Project(torch.autograd.Function):
    """x, rows -> A(rows) x."""

    @staticmethod
    def forward(ctx: Any, x: Any, rows: Any, a: TorchOperator) -> Any:
        ctx.save_for_backward(x, rows)
        ctx.a = a
        cone_vec = _cone_vec(rows)
        return _each(
            lambda one: forward(a.like.like(one), cone_vec, a.detector_shape),
            x,
            (len(rows), *a.detector_shape),
        )

    @staticmethod
    def backward(ctx: Any, g: Any) -> Any:
        x, rows = ctx.saved_tensors
        by_x = _Spread.apply(g, rows, ctx.a).to(x.dtype) if ctx.needs_input_grad[0] else None
        by_rows = _ByRows.apply(x, g, rows, ctx.a) if ctx.needs_input_grad[1] else None
        return by_x, by_rows, None


class _Spread(torch.autograd.Function):
    """y, rows -> A(rows)' y."""

    @staticmethod
    def forward(ctx: Any, y: Any, rows: Any, a: TorchOperator) -> Any:
        ctx.save_for_backward(y, rows)
        ctx.a = a
        cone_vec = _cone_vec(rows)
        return _each(
            lambda one: np.array(back(one, cone_vec, a.like).data, order="C"), y, a.like.shape
        )

    @staticmethod
    def backward(ctx: Any, g: Any) -> Any:
        y, rows = ctx.saved_tensors
        by_y = _Project.apply(g, rows, ctx.a).to(y.dtype) if ctx.needs_input_grad[0] else None
        by_rows = _ByRows.apply(g, y, rows, ctx.a) if ctx.needs_input_grad[1] else None
        return by_y, by_rows, None


class _ByRows(torch.autograd.Function):
    """x, y, rows -> derivative of <A(rows) x, y> with respect to rows, summed over the batch."""

    @staticmethod
    def forward(ctx: Any, x: Any, y: Any, rows: Any, a: TorchOperator) -> Any:
        cone_vec = _cone_vec(rows)
        total = np.zeros((len(rows), 12))
        images = y.detach().reshape(-1, len(rows), *a.detector_shape)
        for one, weights in zip(x.detach().reshape(-1, *a.like.shape), images, strict=True):
            total += geometry_gradient(a.like.like(one.numpy()), cone_vec, weights.numpy())
        return torch.as_tensor(total, dtype=rows.dtype)

    @staticmethod
    def backward(ctx: Any, g: Any) -> Any:
        raise NotBuiltError(
            "second derivatives with respect to the geometry are not built; allowed: the first",
            {"asked": 2, "allowed": 1},
        )


def _tensor(values: Any) -> Any:
    if isinstance(values, np.ndarray):
        values = values if values.flags.writeable else values.copy()  # no tensor is read-only
    tensor = values if isinstance(values, torch.Tensor) else torch.from_dlpack(values)
    check_host(tensor.device.type == "cpu", f"the tensor on {tensor.device}")
    return tensor


def _cone_vec(rows: Any) -> ConeVec:
    return ConeVec(rows.detach().to(torch.float64).numpy())


def _each(
    function: Callable[[Float32Array], Float32Array], values: Any, shape: tuple[int, int, int]
) -> Any:
    """A function of one array (three dimensions) for each member of a batch."""
    batch, one = values.shape[:-3], values.shape[-3:]
    members = values.detach().to(torch.float32).reshape(-1, *one)
    results = [torch.from_numpy(function(member.numpy())) for member in members]
    if len(results) == 1:
        return results[0].reshape(*batch, *shape)
    return torch.stack(results).reshape(*batch, *shape) if results else torch.zeros(*batch, *shape)
