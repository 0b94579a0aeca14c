"""The problem of every iterative method: data, geometry, grid, and the pair of operators.

A `LinearSystem` works on plain arrays. A `RegionSystem` is one of two grids, a fine region and
coarse surroundings, whose voxels are one array. Where a CUDA device has room for all that a
method holds, the same method runs on a `DeviceProblem`, whose arrays are there from the first
iteration to the last.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, singledispatch
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import GeometryError, LimitError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.plausibility import Operation, examine, warn_of
from flexdt.twin.projection import Grid, Volume, as_volume, back, forward, gpu, room_like
from flexdt.twin.projection.device_arrays import DeviceArray
from flexdt.twin.projection.linear import Model, check_model
from flexdt.twin.projection.linear_operator import dot
from flexdt.twin.projection.operators import (
    as_cone_vec,
    check_projections,
    require_finite,
    require_line_integrals,
)
from flexdt.twin.projection.volume import DeviceVolume
from flexdt.twin.reconstruction.beam_hardening import Polychromatic

MIN_WEIGHT_SHARE = 1e-6
"""Least sum of weights that is divided by, as a share of the largest."""
MAX_VOXEL_RATIO = 100
"""Largest number of voxels about a region, in multiples of the requested number."""
STACKS = 4
VOLUMES = 5
"""Largest number of stacks of images, and of volumes, that a method holds at a time."""


Found = TypeVar("Found")
Some = slice | npt.NDArray[np.intp]
"""Indices of views."""
ALL = slice(None)


@dataclass(frozen=True)
class Step:
    """Report of one iteration.

    Attributes:
        iteration: from 1.
        of: iterations in all.
        residual: root mean square of measured minus projected line integrals, before this
            iteration's correction.
    """

    iteration: int
    of: int
    residual: float


Watch = Callable[[Step], None]


@dataclass(frozen=True, eq=False)
class LinearSystem:
    """Data, geometry and grid, with the pair of operators on plain arrays.

    Attributes:
        measured: (n, rows, cols) line integrals.
        geometry: n views.
        like: the grid.
        weights: (n, rows, cols) one over the variances of the line integrals; None: all
            alike.
        hardening: effect of the spectrum on line integrals through materials; None: no
            effect.
        model: of the projector.
    """

    measured: Float32Array
    geometry: ConeVec
    like: Volume
    weights: Float32Array | None = None
    hardening: Polychromatic | None = None
    model: Model = "exact"

    @classmethod
    def of(
        cls,
        projections: npt.ArrayLike,
        cone_vec: ConeVec | npt.ArrayLike,
        like: Volume | Grid,
        iterations: int,
        variances: npt.ArrayLike | None = None,
        hardening: Polychromatic | None = None,
        surroundings: Volume | Grid | None = None,
        model: Model = "exact",
    ) -> LinearSystem:
        """Check the arguments and make the system from them; warns of doubts about them.

        Args:
            projections: (n, rows, cols) line integrals, also on a device.
            cone_vec: n views.
            like: place and size of the volume.
            iterations: only checked.
            variances: (n, rows, cols) of the line integrals; weights are their inverses.
            hardening: expected line integrals of a polychromatic beam.
            surroundings: volume or grid around the region, whose voxels are unknowns,
                too.
            model: of the projector.

        Returns:
            A `RegionSystem` with surroundings.

        Raises:
            GeometryError: no views, shapes that do not fit, values that are not finite, a
                doubt that is a refusal, variances that are not above 0, surroundings
                within the region, these, hardening or the model "linear" with images on a
                device, or that model with surroundings.
            LimitError: no iterations, or an unknown model.
        """
        check_model(model)
        if iterations < 1:
            message = f"iterations is {iterations!r}"
            raise LimitError.instead(message, repr(iterations), "a whole number from 1")
        geometry = as_cone_vec(cone_vec)
        if not len(geometry):
            raise GeometryError(
                "no views; allowed: one or more", {"asked": 0, "allowed": 1}
            )
        require_line_integrals(projections)
        values = check_projections(projections, len(geometry))
        on_host = not gpu.is_there(values)
        require_finite(values)
        geometry.of_shape((values.shape[1], values.shape[2]))
        weights = None
        if variances is not None:
            spread = np.asarray(variances, dtype=np.float32)
            if (
                spread.shape != values.shape
                or not (np.isfinite(spread) & (spread > 0.0)).all()
            ):
                message = f"variances of shape {spread.shape}, least {spread.min(initial=np.inf):g}"
                wanted = f"one above 0 for each line integral, {values.shape}"
                raise GeometryError.instead(message, list(spread.shape), wanted)
            weights = 1.0 / spread
        system = cls(values, geometry, as_volume(like), weights, hardening, model)
        box = system.like.boxes[0]
        if on_host:
            given = np.asarray(projections)
        else:
            given = None
        found = examine(Operation.ITERATE, geometry, system.shape, images=given, grid=box)
        warn_of(found, GeometryError)
        others = hardening is not None or surroundings is not None or model != "exact"
        if gpu.is_there(values) and others:
            message = "images on a device, with hardening, surroundings or a model"
            raise GeometryError.instead(message, "device", "images of the host")
        if model != "exact" and surroundings is not None:
            message = f"model {model!r} with surroundings"
            raise GeometryError.instead(message, model, "'exact' with them")
        if surroundings is None:
            return system
        return RegionSystem.within(system, surroundings)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of the detector."""
        return self.measured.shape[1], self.measured.shape[2]

    def first(self, start: Volume | None) -> Float32Array:
        """Return start values (nz, ny, nx): a copy of the first guess, or zeros for None.

        Raises:
            GeometryError: the guess is on another grid.
        """
        if start is None:
            return np.zeros(self.like.shape, np.float32)
        if start.shape != self.like.shape or not np.allclose(
            [start.voxel_xyz, start.center_mm], [self.like.voxel_xyz, self.like.center_mm]
        ):
            message = f"the first guess is {start!r}"
            wanted = f"on the grid of {self.like!r}"
            raise GeometryError.instead(message, list(start.shape), wanted)
        return np.array(start.data, dtype=np.float32)

    def project(self, x: Float32Array, views: Some = ALL) -> Float32Array:
        """Projections of voxels, of some views."""
        volume = replace(self.like, data=x)
        return forward(volume, self.geometry[views], self.shape, model=self.model)

    def spread(self, y: Float32Array, views: Some = ALL) -> Float32Array:
        """Apply the adjoint, into memory that the next call overwrites."""
        geometry = self.geometry[views]
        return back(y, geometry, self.like, self.room, model=self.model).data

    def misfit(self, x: Any, views: Some) -> tuple[Any, Any]:
        """Compute measured less expected line integrals of some views.

        Args:
            x: voxels (nz, ny, nx).
            views: which ones.

        Returns the differences (n, rows, cols), and the factor by which a step must be scaled:
        line integrals at one energy over expected ones, of that shape; 1 without `hardening`.
        """
        measured = self.measured[views]
        if self.hardening is None:
            return measured - self.project(x, views), np.float32(1)
        paths = np.stack([self.project(one, views) for one in self.hardening.amounts(x)])
        rest = np.empty_like(measured)
        more = np.empty_like(measured)
        for view, image in enumerate(measured):
            expected, more[view] = self.hardening.line_integrals(paths[:, view])
            rest[view] = image - expected
        return rest, more

    @cached_property
    def room(self) -> Float32Array:
        """Memory for the adjoint."""
        return room_like(self.like)

    def scales(self, views: Some) -> tuple[Float32Array, Float32Array]:
        """Compute factors of residuals (n, rows, cols), and of their back-projection.

        Inverse sums of rows and columns; or the weights, and one over a curvature that no
        step overshoots (Erdogan and Fessler 1999).
        """
        rows = self.project(ones(self.first(None)), views)
        if self.weights is None:
            return inverse(rows), inverse(self.spread(ones(rows), views))
        weights = self.weights[views]
        return weights, inverse(self.spread(weights * rows, views))

    def volume(self, x: Float32Array) -> Volume:
        """Return the voxels on their grid."""
        return replace(self.like, data=x)

    def tell(self, watch: Watch | None, i: int, of: int, rest: Float32Array) -> None:
        """Report iteration i (from 0) of `of` to `watch`, with the root mean square of
        `rest`; does nothing without `watch`."""
        if watch is not None:
            watch(Step(i + 1, of, float(np.sqrt(dot(rest, rest) / rest.size))))


@dataclass(frozen=True, eq=False)
class DeviceProblem(LinearSystem):
    """A `LinearSystem` on a CUDA device: every array is a `DeviceArray`.

    Attributes:
        returns: whether the volume is copied back to the host, where the images came
            from.
    """

    returns: bool = True

    @classmethod
    def of_host(cls, problem: LinearSystem) -> DeviceProblem:
        """Copy a system to the device, without hardening; line integrals that are there
        stay, and the result then stays there too.

        Raises:
            gpu.DeviceError: the device fails.
        """
        there: Any = DeviceArray.of_images(problem.measured)
        weights: Any = problem.weights
        if weights is not None:
            weights = DeviceArray.of_images(weights)
        home = not gpu.is_there(problem.measured)
        return cls(there, problem.geometry, problem.like, weights, returns=home)

    def first(self, start: Volume | None) -> Any:
        """Return start values on the device: zeros, or a copy of the first guess; see
        `LinearSystem`.
        """
        if start is None:
            return DeviceArray.of_volume(DeviceVolume.blank(self.like))
        return DeviceArray.of_voxels(replace(self.like, data=super().first(start)))

    def project(self, x: Any, views: Some = ALL) -> Any:
        """Project voxels; see `LinearSystem`."""
        return DeviceArray.of_images(forward(x.volume, self.geometry[views], self.shape))

    def spread(self, y: Any, views: Some = ALL) -> Any:
        """Apply the adjoint, into new memory on the device; see `LinearSystem`."""
        found: Any = back(y.images, self.geometry[views], self.like)
        return DeviceArray.of_volume(found)

    def volume(self, x: Any) -> Any:
        """Return the voxels: on the host if the images came from there, else as a
        `DeviceVolume`.
        """
        if self.returns:
            return x.volume.to("cpu")
        return x.volume


@dataclass(frozen=True, eq=False)
class RegionSystem(LinearSystem):
    """A fine region in coarse surroundings, solved together: x holds the voxels of both, flat.

    The surroundings' grid is laid so that the region fills an integer number of its
    voxels, which are no unknowns: every point belongs to one voxel of one grid, and rays
    have their exact lengths.

    Attributes:
        outer: the surroundings' grid.
        outside: of its voxels (z, y, x), which are not in the region.
    """

    outer: Volume = field(kw_only=True)
    outside: npt.NDArray[np.bool_] = field(kw_only=True)

    @classmethod
    def within(cls, inner: LinearSystem, about: Volume | Grid) -> RegionSystem:
        """Make the system of a region with surroundings out to `about`.

        The surroundings' voxels are about as large as those of `about`, so that a whole
        number of them, one at least, fills the region along each axis; outermost ones may
        reach beyond `about`.

        Args:
            inner: system of the region.
            about: only its place, size and voxels count.

        Raises:
            GeometryError: `about` does not reach beyond the region on any side, or that
                takes more than `MAX_VOXEL_RATIO` times the voxels of both, as about a
                thin region.
        """
        wanted = as_volume(about)
        (low, high) = inner.like.boxes[0]
        parts = np.maximum(np.round((high - low) / wanted.voxel_xyz), 1.0)
        edge = (high - low) / parts
        beyond = np.stack([low - wanted.boxes[0, 0], wanted.boxes[0, 1] - high]) / edge
        below, above = np.ceil(np.maximum(beyond - 1e-6, 0.0))
        if not (below.any() or above.any()):
            message = f"surroundings {wanted!r} within the region {inner.like!r}"
            raise GeometryError.instead(
                message, list(wanted.shape), "a grid that reaches beyond it"
            )
        counts = below + parts + above
        most = MAX_VOXEL_RATIO * (math.prod(wanted.shape) + math.prod(inner.like.shape))
        if counts.prod() > most:
            message = (
                f"{counts.prod():.3g} voxels, none larger than the region {inner.like!r}"
            )
            less = f"{most}, by a larger region or nearer surroundings"
            raise GeometryError.instead(message, counts.tolist(), less)
        nx, ny, nz = (int(n) for n in counts)
        outside = np.ones((nz, ny, nx), dtype=np.bool_)
        cut = [slice(int(b), int(b + p)) for b, p in zip(below, parts, strict=True)]
        outside[tuple(reversed(cut))] = False
        x, y, z = (float(c) for c in (low + high + (above - below) * edge) / 2.0)
        zeros = np.broadcast_to(np.zeros((), np.float32), outside.shape)
        dx, dy, dz = (float(e) for e in edge)
        given = {name: getattr(inner, name) for name in inner.__dataclass_fields__}
        return cls(**given, outer=Volume(zeros, (dx, dy, dz), (x, y, z)), outside=outside)

    def grids(self, x: Float32Array) -> tuple[Float32Array, Float32Array]:
        """Split x into the voxels of region and surroundings, each (nz, ny, nx) with z
        contiguous; both are views of x.

        Args:
            x: flat, first the region's voxels.
        """
        (nz, ny, nx) = self.like.shape
        (mz, my, mx) = self.outer.shape
        fine, coarse = np.split(x, [nz * ny * nx])
        return (
            fine.reshape(ny, nx, nz).transpose(2, 0, 1),
            coarse.reshape(my, mx, mz).transpose(2, 0, 1),
        )

    def first(self, start: Volume | None) -> Float32Array:
        """Return start values of region (`start` or 0) and surroundings (0), flat.

        Raises GeometryError: another grid.
        """
        x = np.zeros(math.prod(self.like.shape) + self.outside.size, np.float32)
        if start is not None:
            self.grids(x)[0][...] = super().first(start)
        return x

    def project(self, x: Float32Array, views: Some = ALL) -> Float32Array:
        """Compute line integrals of region and surroundings together (n, rows, cols); see
        `LinearSystem`.

        Voxels of the surroundings that are in the region count as 0.
        """
        fine, coarse = self.grids(x)
        geometry = self.geometry[views]
        images = forward(replace(self.like, data=fine), geometry, self.shape)
        coarse = np.where(self.outside, coarse, np.float32(0))
        images += forward(replace(self.outer, data=coarse), geometry, self.shape)
        return images

    def spread(self, y: Float32Array, views: Some = ALL) -> Float32Array:
        """Apply the adjoint to region and surroundings; the result is one vector,
        overwritten by the next call; 0 in voxels of the surroundings that are in the
        region.
        """
        fine, coarse = self.grids(self.room)
        geometry = self.geometry[views]
        back(y, geometry, self.like, fine)
        back(y, geometry, self.outer, coarse)
        coarse *= self.outside
        return self.room

    @cached_property
    def room(self) -> Float32Array:
        """Memory for the adjoint."""
        return self.first(None)

    def volume(self, x: Float32Array) -> Volume:
        """Return the region's voxels."""
        return replace(self.like, data=self.grids(x)[0])


def solved(problem: LinearSystem, method: Callable[[LinearSystem], Found]) -> Found:
    """Run a method on the device, if images are there or it has room, else on the processor.

    If the device fails with images of the host, the method is run again on the processor. With
    hardening, surroundings or another model the method always runs on the processor, and only
    projections are made on a device.

    `problem`: of the host, but its images may be on a device; `method`: called with `problem` or
    its copy on the device.
    Returns the method's result.
    """
    here = problem.hardening is not None or problem.model != "exact"
    if here or isinstance(problem, RegionSystem):
        return method(problem)
    if gpu.is_there(problem.measured):
        return method(DeviceProblem.of_host(problem))
    voxels = 4 * int(np.prod(problem.like.shape))
    need = STACKS * problem.measured.nbytes + VOLUMES * voxels
    if gpu.availability().present and gpu.has_room(need):
        with suppress(gpu.DeviceError):
            return method(DeviceProblem.of_host(problem))
    return method(problem)


def ones(like: Any) -> Any:
    """Create ones of the shape of an array, which may be on a device."""
    return like * np.float32(0) + np.float32(1)


def inverse(values: Float32Array) -> Float32Array:
    """Compute 1 / sums of weights, 0 where they are nearly 0."""
    found: Float32Array = ratio(ones(values), values)
    return found


@singledispatch
def ratio(a: Any, b: Any) -> Any:
    """Compute a / b, zero where b is at most `MIN_WEIGHT_SHARE` of its largest value."""
    return np.divide(
        a, b, out=np.zeros_like(b), where=b > MIN_WEIGHT_SHARE * float(b.max())
    )


@ratio.register
def _(a: DeviceArray, b: DeviceArray) -> DeviceArray:
    return a.over(b, MIN_WEIGHT_SHARE * b.max())
