"""Iterative reconstruction on the matched pair of projector and adjoint, for any trajectory.

SIRT, SART (ordered subsets), CGLS and EM (maximum likelihood for positive data). Each algorithm is
one function; all see geometry through `forward` and `back` only. Everything is held in memory. The
caller chooses the number of iterations. SIRT and SART weigh line integrals by variances that are
given, and then end once what is left is no more than that noise.

A `LinearSystem` is what every method has in hand: data, geometry and grid, and the matched pair of
operators on plain arrays. Where a CUDA device has room for all that a method holds, the same method
runs on a `DeviceProblem`, whose arrays are there from the first iteration to the last.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, singledispatch
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import GeometryError, LimitError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection import Grid, Volume, as_volume, back, forward, gpu, room_like
from flexdt.twin.projection.device_arrays import DeviceArray
from flexdt.twin.projection.linear_operator import dot as dot
from flexdt.twin.projection.operators import (
    as_cone_vec,
    check_projections,
    require_finite,
    require_line_integrals,
)
from flexdt.twin.projection.volume import DeviceVolume
from flexdt.twin.signatures import public

SMALLEST = 1e-6
"""Sums of weights below this part of the largest are not divided by."""
STACKS, VOLUMES = 4, 5
"""How many stacks of images, and volumes, a method holds at a time, at most."""


Found = TypeVar("Found")


@dataclass(frozen=True)
class Step:
    """What happened in one iteration.

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
        weights: (n, rows, cols) one over the variances of the line integrals; None: all alike.
    """

    measured: Float32Array
    geometry: ConeVec
    like: Volume
    weights: Float32Array | None = None

    @classmethod
    def of(
        cls,
        projections: npt.ArrayLike,
        cone_vec: ConeVec | npt.ArrayLike,
        like: Volume | Grid,
        iterations: int,
        variances: npt.ArrayLike | None = None,
    ) -> LinearSystem:
        """From checked arguments.

        Raises:
            GeometryError: no views, shapes that do not fit, or variances that are not above 0.
            LimitError: no iterations.
        """
        if iterations < 1:
            raise LimitError(
                f"iterations is {iterations!r}; allowed: a whole number from 1",
                {"asked": repr(iterations), "allowed": 1},
            )
        geometry = as_cone_vec(cone_vec)
        if not len(geometry):
            raise GeometryError("no views; allowed: one or more", {"asked": 0, "allowed": 1})
        require_line_integrals(projections)
        values = check_projections(projections, len(geometry))
        require_finite(values)
        geometry.of_shape((values.shape[1], values.shape[2]))
        weights = None
        if variances is not None:
            spread = np.asarray(variances, dtype=np.float32)
            if spread.shape != values.shape or not (np.isfinite(spread) & (spread > 0.0)).all():
                raise GeometryError(
                    f"variances of shape {spread.shape}, least {spread.min(initial=np.inf):g}; "
                    f"allowed: one above 0 for each line integral, {values.shape}",
                    {"asked": list(spread.shape), "allowed": list(values.shape)},
                )
            weights = 1.0 / spread
        return cls(values, geometry, as_volume(like), weights)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of the detector."""
        return self.measured.shape[1], self.measured.shape[2]

    def first(self, start: Volume | None) -> Float32Array:
        """Values to begin with: a copy of the first guess, or zeros."""
        if start is None:
            return np.zeros(self.like.shape, np.float32)
        if start.shape != self.like.shape or not np.allclose(
            [start.voxel_xyz, start.center_mm], [self.like.voxel_xyz, self.like.center_mm]
        ):
            raise GeometryError(
                f"the first guess is {start!r}; allowed: on the grid of {self.like!r}",
                {"asked": list(start.shape), "allowed": list(self.like.shape)},
            )
        return np.array(start.data, dtype=np.float32)

    def project(self, x: Float32Array, geometry: ConeVec | None = None) -> Float32Array:
        """Projections of voxels, for the whole scan or for `geometry`."""
        geometry = self.geometry if geometry is None else geometry
        return forward(replace(self.like, data=x), geometry, self.shape)

    def spread(self, y: Float32Array, geometry: ConeVec | None = None) -> Float32Array:
        """The adjoint, in memory that the next call overwrites."""
        geometry = self.geometry if geometry is None else geometry
        return back(y, geometry, self.like, self.room).data

    @cached_property
    def room(self) -> Float32Array:
        """Memory for the adjoint."""
        return room_like(self.like)

    def scales(self, views: slice | npt.NDArray[np.intp]) -> tuple[Float32Array, Float32Array]:
        """Factors of the residuals of some views, and of what they add to the voxels.

        Without weights inverse sums of the projector's rows and columns. With weights those, and
        one over the curvature of a paraboloid above the weighted squares, which no step overshoots
        (Erdogan and Fessler 1999). Zero where (nearly) nothing is.
        """
        geometry = self.geometry[views]
        rows = self.project(ones(self.first(None)), geometry)
        if self.weights is None:
            return inverse(rows), inverse(self.spread(ones(rows), geometry))
        weights = self.part(self.weights, views)
        return weights, inverse(self.spread(weights * rows, geometry))

    def part(self, images: Any, views: slice | npt.NDArray[np.intp]) -> Any:
        """Some views of images."""
        return images[views]

    def volume(self, x: Float32Array) -> Volume:
        """The voxels that were found, on their grid."""
        return replace(self.like, data=x)

    def tell(self, watch: Watch | None, i: int, of: int, rest: Float32Array) -> None:
        """Report iteration i (from 0) with the residual `rest`."""
        if watch is not None:
            watch(Step(i + 1, of, float(np.sqrt(dot(rest, rest) / rest.size))))


@dataclass(frozen=True, eq=False)
class DeviceProblem(LinearSystem):
    """The same on a CUDA device: every array is a `DeviceArray`.

    Attributes:
        returns: whether the volume goes back to the host, where the images came from.
    """

    returns: bool = True

    @classmethod
    def of_host(cls, problem: LinearSystem) -> DeviceProblem:
        """With the line integrals moved there, unless they are there."""
        there: Any = DeviceArray.of_images(problem.measured)
        weights: Any = problem.weights
        if weights is not None:
            weights = DeviceArray.of_images(weights)
        home = not gpu.is_there(problem.measured)
        return cls(there, problem.geometry, problem.like, weights, home)

    def first(self, start: Volume | None) -> Any:
        """See `LinearSystem`."""
        if start is None:
            return DeviceArray.of_volume(DeviceVolume.blank(self.like))
        return DeviceArray.of_voxels(replace(self.like, data=super().first(start)))

    def project(self, x: Any, geometry: ConeVec | None = None) -> Any:
        """See `LinearSystem`."""
        geometry = self.geometry if geometry is None else geometry
        return DeviceArray.of_images(forward(x.volume, geometry, self.shape))

    def spread(self, y: Any, geometry: ConeVec | None = None) -> Any:
        """See `LinearSystem`; in memory of its own."""
        geometry = self.geometry if geometry is None else geometry
        found: Any = back(y.images, geometry, self.like)
        return DeviceArray.of_volume(found)

    def part(self, images: Any, views: slice | npt.NDArray[np.intp]) -> Any:
        """See `LinearSystem`."""
        return images if isinstance(views, slice) else images.images_of(views)

    def volume(self, x: Any) -> Any:
        """See `LinearSystem`; a `DeviceVolume` where the images were on the device."""
        return x.volume.to("cpu") if self.returns else x.volume


def solved(problem: LinearSystem, method: Callable[[LinearSystem], Found]) -> Found:
    """By a method on the device, if images are there or it has room, or else on the processor."""
    if gpu.is_there(problem.measured):
        return method(DeviceProblem.of_host(problem))
    voxels = 4 * int(np.prod(problem.like.shape))
    need = STACKS * problem.measured.nbytes + VOLUMES * voxels
    if gpu.availability().present and gpu.has_room(need):
        with suppress(gpu.DeviceError):
            return method(DeviceProblem.of_host(problem))
    return method(problem)


def ones(like: Any) -> Any:
    """Ones of the form of an array, which may be on a device."""
    return like * np.float32(0) + np.float32(1)


def inverse(values: Float32Array) -> Float32Array:
    """One over sums of weights, zero where (nearly) nothing is."""
    found: Float32Array = ratio(ones(values), values)
    return found


@singledispatch
def ratio(a: Any, b: Any) -> Any:
    """a / b, zero where (nearly) nothing is in b."""
    return np.divide(a, b, out=np.zeros_like(b), where=b > SMALLEST * float(b.max()))


@ratio.register
def _(a: DeviceArray, b: DeviceArray) -> DeviceArray:
    return a.over(b, SMALLEST * b.max())


def far_apart(count: int) -> list[int]:
    """0 .. count-1 ordered so that neighbours in time are far apart (golden-section steps)."""
    return [int(i) for i in np.argsort((np.arange(count) * 0.6180339887498949) % 1.0)]


@public
def sirt(
    projections: npt.ArrayLike,
    cone_vec: ConeVec | npt.ArrayLike,
    like: Volume | Grid,
    *,
    iterations: int = 50,
    start: Volume | None = None,
    nonnegative: bool = False,
    variances: npt.ArrayLike | None = None,
    watch: Watch | None = None,
) -> Volume:
    """Simultaneous iterative reconstruction: x += C A' R (b - A x), R and C inverse row and
    column sums. The residual weighted with R never grows.

    With `variances`, weighted least squares: R holds one over them, C one over the curvature. It
    ends with the first iteration that finds no more than noise left: squares over variances that
    are 1 in the mean.

    Args:
        projections: (n, rows, cols) line integrals.
        cone_vec: ConeVec or (n, 12) [mm].
        like: the grid, or a volume on it, whose values are not used.
        iterations: how many; with `variances` at most.
        start: first guess on the same grid; zero by default.
        nonnegative: clip at zero after each iteration.
        variances: (n, rows, cols) of the line integrals; of N photons counted, about 1 / N.
        watch: called in every iteration.

    Returns:
        Volume [1/mm] on the grid of `like`.

    Raises:
        GeometryError: shapes that do not fit.
        LimitError: no iterations.

    Examples:
        >>> from flexdt.twin.projection import forward
        >>> turn = np.linspace(0, 2 * np.pi, 12, endpoint=False)
        >>> c, s, o = np.cos(turn), np.sin(turn), np.zeros(12)
        >>> source, detector = np.stack([s, -c, o], 1) * 600, np.stack([-s, c, o], 1) * 400
        >>> scan = ConeVec.from_vectors(source, detector, np.stack([c, s, o], 1), (0, 0, -1))
        >>> volume = Volume(np.full((4, 4, 4), 0.02, np.float32), 1.0)
        >>> found = sirt(forward(volume, scan, (8, 8)), scan, like=volume, iterations=100)
        >>> bool(abs(found.data - 0.02).max() < 0.002)
        True
    """
    problem = LinearSystem.of(projections, cone_vec, like, iterations, variances)
    return solved(
        problem,
        lambda p: _subset_steps(p, [slice(None)], 1.0, iterations, start, nonnegative, watch),
    )


def sart(
    projections: npt.ArrayLike,
    cone_vec: ConeVec | npt.ArrayLike,
    like: Volume | Grid,
    *,
    iterations: int = 5,
    subsets: int = 10,
    relaxation: float = 0.7,
    start: Volume | None = None,
    nonnegative: bool = False,
    variances: npt.ArrayLike | None = None,
    watch: Watch | None = None,
) -> Volume:
    """SIRT's step on one subset of views after another: faster at first, noisier in the end.

    Args:
        projections, cone_vec, like, start, nonnegative, variances, watch: as for `sirt`.
        iterations: passes through all views.
        subsets: number of subsets; each takes every k-th view, so it sees all directions.
        relaxation: part of each step that is taken.

    Example:
        >>> scan = ConeVec.circular(sod=600, sdd=1000, angles=12, shape=(8, 8), pixel=1)
        >>> volume = Volume(np.full((4, 4, 4), 0.02, np.float32), 1.0)
        >>> from flexdt.twin.projection import forward
        >>> found = sart(forward(volume, scan), scan, like=volume, iterations=20)
        >>> bool(abs(found.data - 0.02).max() < 0.002)
        True
    """
    problem = LinearSystem.of(projections, cone_vec, like, iterations, variances)
    count = min(subsets, len(problem.geometry))
    if count < 1 or not 0.0 < relaxation < 2.0:
        raise LimitError(
            f"{subsets} subsets, relaxation {relaxation:g}; allowed: at least 1, and between 0 "
            "and 2",
            {"asked": [subsets, relaxation]},
        )
    parts = [np.arange(k, len(problem.geometry), count) for k in far_apart(count)]
    return solved(
        problem,
        lambda p: _subset_steps(p, parts, relaxation, iterations, start, nonnegative, watch),
    )


def _subset_steps(
    problem: LinearSystem,
    parts: Sequence[slice | npt.NDArray[np.intp]],
    relaxation: float,
    iterations: int,
    start: Volume | None,
    nonnegative: bool,
    watch: Watch | None,
) -> Volume:
    """SIRT's step on the views of one part after another, for each iteration."""
    sums = [problem.scales(part) for part in parts]
    weighted = problem.weights is not None
    x = problem.first(start)
    for i in range(iterations):
        squares = noise = 0.0
        for part, (rows, columns) in zip(parts, sums, strict=True):
            geometry = problem.geometry[part]
            rest = problem.part(problem.measured, part) - problem.project(x, geometry)
            squares += 0.0 if watch is None else dot(rest, rest)
            scaled = rows * rest
            noise += dot(rest, scaled) if weighted else 0.0
            x = x + np.float32(relaxation) * columns * problem.spread(scaled, geometry)
            if nonnegative:
                np.maximum(x, 0.0, out=x)
        if watch is not None:
            watch(Step(i + 1, iterations, float(np.sqrt(squares / problem.measured.size))))
        if weighted and noise <= problem.measured.size:
            break
    return problem.volume(x)


@public
def cgls(
    projections: npt.ArrayLike,
    cone_vec: ConeVec | npt.ArrayLike,
    like: Volume | Grid,
    *,
    iterations: int = 15,
    start: Volume | None = None,
    watch: Watch | None = None,
) -> Volume:
    """Conjugate gradients for least squares: the residual falls at every iteration.

    Args: as for `sirt`.

    Examples:
        >>> from flexdt.twin.projection import forward
        >>> turn = np.linspace(0, 2 * np.pi, 12, endpoint=False)
        >>> c, s, o = np.cos(turn), np.sin(turn), np.zeros(12)
        >>> source, detector = np.stack([s, -c, o], 1) * 600, np.stack([-s, c, o], 1) * 400
        >>> scan = ConeVec.from_vectors(source, detector, np.stack([c, s, o], 1), (0, 0, -1))
        >>> volume = Volume(np.full((4, 4, 4), 0.02, np.float32), 1.0)
        >>> found = cgls(forward(volume, scan, (8, 8)), scan, like=volume, iterations=10)
        >>> bool(abs(found.data - 0.02).max() < 0.002)
        True
    """
    problem = LinearSystem.of(projections, cone_vec, like, iterations)
    return solved(problem, lambda p: _cgls(p, iterations, start, watch))


def _cgls(
    problem: LinearSystem, iterations: int, start: Volume | None, watch: Watch | None
) -> Volume:
    x = problem.first(start)
    rest = problem.measured - problem.project(x)
    gradient = problem.spread(rest)
    direction = gradient.copy(order="K")
    norm = dot(gradient, gradient)
    for i in range(iterations):
        problem.tell(watch, i, iterations, rest)
        if norm == 0.0:
            break
        image = problem.project(direction)
        size = np.float32(norm / dot(image, image))
        x = x + size * direction
        rest -= size * image
        gradient = problem.spread(rest)
        new = dot(gradient, gradient)
        direction = gradient + np.float32(new / norm) * direction
        norm = new
    return problem.volume(x)


def em(
    projections: npt.ArrayLike,
    cone_vec: ConeVec | npt.ArrayLike,
    like: Volume | Grid,
    *,
    iterations: int = 30,
    start: Volume | None = None,
    watch: Watch | None = None,
) -> Volume:
    """Expectation maximisation: x *= A'(b / A x) / A' 1, positive by construction.

    Negative line integrals (noise) count as zero.

    Args: as for `sirt`; a first guess must be positive wherever the object may be.

    Example:
        >>> scan = ConeVec.circular(sod=600, sdd=1000, angles=12, shape=(8, 8), pixel=1)
        >>> volume = Volume(np.full((4, 4, 4), 0.02, np.float32), 1.0)
        >>> from flexdt.twin.projection import forward
        >>> found = em(forward(volume, scan), scan, like=volume, iterations=100)
        >>> bool(abs(found.data - 0.02).max() < 0.002)
        True
    """
    problem = LinearSystem.of(projections, cone_vec, like, iterations)
    return solved(problem, lambda p: _em(p, iterations, start, watch))


def _em(
    problem: LinearSystem, iterations: int, start: Volume | None, watch: Watch | None
) -> Volume:
    measured = np.maximum(problem.measured, np.float32(0))
    whole = problem.spread(ones(measured)).copy(order="K")
    x = problem.first(start)
    if start is None:
        reach = float(problem.project(ones(x)).sum())
        x = ratio(whole, whole) * np.float32(measured.sum() / max(reach, 1e-30))
    for i in range(iterations):
        image = problem.project(x)
        problem.tell(watch, i, iterations, problem.measured - image)
        x = x * ratio(problem.spread(ratio(measured, image)), whole)
    return problem.volume(x)
