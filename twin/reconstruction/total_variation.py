"""Reconstruction with total variation: for few views, noise, and objects of few materials.

The volume minimizes

    cost(x) = 1/2 sum((A x - b)^2) + strength * TV(x),    x >= 0,    x = 0 outside a mask,

by a monotone accelerated proximal gradient method (MFISTA: Beck and Teboulle 2009) with
restarts; total variation and constraints are handled together by the accelerated dual method of
the same authors, which begins where it ended in the iteration before. Passes through ordered
subsets of the views may go first; one that gains little is undone and the number of subsets
halved, so that the end is the minimum whatever the subsets were.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from flexdt.twin import long_work
from flexdt.twin.errors import GeometryError, LimitError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.long_work import Advance, Progress
from flexdt.twin.projection import Grid, Volume, gpu
from flexdt.twin.projection.device_arrays import DeviceArray
from flexdt.twin.projection.linear_operator import dot, norm_of
from flexdt.twin.projection.portions import layer_portions
from flexdt.twin.reconstruction.iterative import far_apart
from flexdt.twin.reconstruction.linear_system import (
    DeviceProblem,
    LinearSystem,
    Watch,
    ones,
    solved,
)
from flexdt.twin.signatures import public, with_arguments_of

WEIGHT = 1e-2
"""Default strength as a part of max(A' b); see docs/operator.md for how it was chosen."""
DUAL_STEPS = 10
"""Steps of the dual method in an iteration."""
MIN_PASS_GAIN = 0.05
"""Least share of the cost that a pass through subsets must gain; else their number is
halved."""
NORM_TOLERANCE = 1e-2
"""Relative tolerance of the operator's norm."""
STALLED_ITERATIONS = 3
"""Consecutive iterations of little gain after which it ends."""


@dataclass(frozen=True, eq=False)
class Minimised:
    """The outcome of a minimization.

    Attributes:
        volume: the best volume found [1/mm].
        costs: of the start and after each iteration; none is above the one before.
        converged: whether the stopping rule ended it, not the number of iterations.
        strength: the factor of the total variation in the cost [mm].
    """

    volume: Volume
    costs: tuple[float, ...]
    converged: bool
    strength: float

    @property
    def iterations(self) -> int:
        """Number of iterations."""
        return len(self.costs) - 1

    def __repr__(self) -> str:
        """Format whether it converged or stopped, the number of iterations, first and
        last cost.
        """
        if self.converged:
            end = "converged"
        else:
            end = "stopped"
        return (
            f"<Minimised: {end} after {self.iterations} iterations, cost "
            f"{self.costs[0]:.6g} to "
            f"{self.costs[-1]:.6g}>"
        )


def minimise_tv(
    projections: npt.ArrayLike,
    cone_vec: ConeVec | npt.ArrayLike,
    like: Volume | Grid,
    *,
    iterations: int = 100,
    weight: float = WEIGHT,
    tolerance: float = 1e-4,
    subsets: int = 1,
    start: Volume | None = None,
    nonnegative: bool = True,
    mask: npt.ArrayLike | None = None,
    watch: Watch | None = None,
    progress: Progress = None,
    errors: bool = False,
) -> Minimised:
    """Minimise the squared residual plus total variation.

    Args:
        projections: (n, rows, cols) line integrals.
        cone_vec: ConeVec or (n, 12) [mm].
        like: the grid, or a volume on it, whose values are not used.
        iterations: at most so many, passes through subsets among them.
        weight: strength of the total variation as a part of max(A' b), which makes it
            independent of the object's attenuation and of the number of views; 0 for
            none. More noise needs more.
        tolerance: it ends after three iterations in a row that each lower the cost by
            less than this part of it; 0 for never.
        subsets: ordered subsets of views in the first passes; 1 for none.
        start: first guess on the same grid; zero by default.
        nonnegative: no value is below zero.
        mask: (nz, ny, nx), where the object may be: all else is zero. Everywhere by
            default.
        watch: called in every iteration.
        progress: a bar after two seconds; False for none, or what takes the fraction
            done.
        errors: as for `sirt`; of the volume.

    Returns:
        Volume, costs and whether it converged.

    Raises:
        GeometryError: shapes that do not fit.
        LimitError: an argument out of its range.

    Examples:
        >>> from flexdt.twin.projection import forward
        >>> turn = np.linspace(0, 2 * np.pi, 6, endpoint=False)
        >>> c, s, o = np.cos(turn), np.sin(turn), np.zeros(6)
        >>> source, detector = np.stack([s, -c, o], 1) * 600, np.stack([-s, c, o], 1) * 400
        >>> scan = ConeVec.from_vectors(source, detector, np.stack([c, s, o], 1), (0, 0, -1))
        >>> volume = Volume(np.full((4, 4, 4), 0.02, np.float32), 1.0)
        >>> found = minimise_tv(forward(volume, scan, (8, 8)), scan, like=volume)
        >>> bool(abs(found.volume.data - 0.02).max() < 0.001), found.converged
        (True, True)
    """
    problem = LinearSystem.of(projections, cone_vec, like, iterations)
    for name, value, least in (
        ("weight", weight, 0.0),
        ("tolerance", tolerance, 0.0),
        ("subsets", subsets, 1),
    ):
        if not least <= value < math.inf:
            raise LimitError.instead(f"{name} {value:g}", value, f"{least:g} or more")
    regular = Regular.of(problem.like, nonnegative, mask)

    with long_work.during("minimizing total variation", progress) as advance:

        def minimise(problem: LinearSystem) -> Minimised:
            """Minimise a problem on the processor or on a device, with the regularizer
            copied to where the problem is (with new dual variables there).
            """
            there = isinstance(problem, DeviceProblem)
            regulariser = (
                DeviceRegular.of_host(regular, problem.like) if there else regular
            )
            return _minimise(
                problem,
                regulariser,
                iterations,
                weight,
                tolerance,
                subsets,
                start,
                watch,
                advance,
            )

        found = solved(problem, minimise)
    if not errors:
        return found
    from flexdt.twin.reconstruction.iterative_errors import checked

    given = {"weight": weight, "tolerance": tolerance, "subsets": subsets, "mask": mask}
    given |= {"iterations": iterations, "start": start, "nonnegative": nonnegative}
    volume = checked(found.volume, projections, cone_vec, tv, given)
    return replace(found, volume=volume)


@public
@with_arguments_of(minimise_tv)
def tv(*args: Any, **options: Any) -> Volume:
    """Reconstruct by least squares with total variation; the volume of `minimise_tv`.

    Examples:
        >>> scan = ConeVec.circular(sod=600, sdd=1000, angles=12, shape=(8, 8), pixel=1)
        >>> from flexdt.twin.projection import Operator
        >>> grid = Grid((4, 4, 4), 1.0)
        >>> images = Operator(scan, grid) @ np.full((4, 4, 4), 0.02)
        >>> found = tv(images, scan, grid, weight=1e-4)
        >>> bool(abs(found.data - 0.02).max() < 0.005)
        True
    """
    return minimise_tv(*args, **options).volume


def _minimise(
    problem: LinearSystem,
    regular: Regular,
    iterations: int,
    weight: float,
    tolerance: float,
    subsets: int,
    start: Volume | None,
    watch: Watch | None,
    advance: Advance,
) -> Minimised:
    """Minimise by passes through subsets of views, then by accelerated steps over all.

    The number of subsets is halved when a pass gains less than `MIN_PASS_GAIN` of the
    cost, and that pass is undone. Momentum that raises the cost is dropped; a step never
    does.

    Args:
        problem: images, geometry and grid.
        regular: total variation and bounds of the values.
        iterations: at most as many.
        weight: of total variation, relative to the largest back-projected value.
        tolerance: relative decrease of the cost below which iterations count as stalled;
            0: never stop early.
        subsets: number of parts in the first passes, at most one a view; 1 for none.
        start: first volume; zeros without.
        watch: called with each iteration's residual.
        advance: called with the share that is done.

    Returns:
        The volume, the costs, and whether the stopping rule ended it; at once, as
        converged, if no ray meets the grid.
    """
    scale = problem.spread(problem.measured)
    strength = weight * max(float(scale.max()), 0.0)
    objective = _Objective(problem, strength, regular)
    at = objective.at(objective.regular.allow(problem.first(start)))
    costs = [at.cost]
    norm = norm_of(
        problem.project, problem.spread, ones(problem.first(None)), NORM_TOLERANCE
    )
    if norm == 0.0:
        return Minimised(problem.volume(at.x), tuple(costs), True, strength)
    step = 1.0 / (1.02 * norm) ** 2  # the estimate of the norm is from below
    little = 0

    def tell(at: _At) -> bool:
        """Record an iteration's cost, report it and the progress; return whether costs
        have stalled.

        Stalled: `STALLED_ITERATIONS` in a row reduced it by at most `tolerance` of it;
        never with tolerance 0. Counts them in `little`.
        """
        nonlocal little
        problem.tell(watch, len(costs) - 1, iterations, at.rest)
        costs.append(at.cost)
        advance((len(costs) - 1) / iterations)
        if costs[-2] - at.cost <= tolerance * at.cost:
            little = little + 1
        else:
            little = 0
        return tolerance > 0 and little >= STALLED_ITERATIONS

    count = min(subsets, len(problem.geometry))
    while count > 1 and len(costs) <= iterations:
        tried = objective.at(objective.subset_pass(at.x, step, count))
        if tried.cost < (1 - MIN_PASS_GAIN) * at.cost:
            tell(tried)
            at = tried
        else:
            count //= 2
    little = 0
    done = False
    ahead = at
    t = 1.0
    last = at
    while not done and len(costs) <= iterations:
        tried = objective.at(objective.step(ahead, step))
        if tried.cost > at.cost and ahead is not at:
            # Momentum has led astray: once more from the best point, without it.
            ahead = at
            t = 1.0
            continue
        last = at
        at = tried if tried.cost <= at.cost else at
        done = tell(at)
        t, further = momentum(t)
        ahead = at.beyond(last, further)
    return Minimised(problem.volume(at.x), tuple(costs), done, strength)


def momentum(t: float) -> tuple[float, float]:
    """Compute the next t of accelerated steps, and the extrapolation."""
    new = (1 + math.sqrt(1 + 4 * t * t)) / 2
    return new, (t - 1) / new


@dataclass(frozen=True, eq=False)
class _At:
    """A volume with its residual A x - b; the cost is nan if unknown."""

    x: Float32Array
    rest: Float32Array
    cost: float = math.nan

    def beyond(self, last: _At, part: float) -> _At:
        """Extrapolate from `last` through this point, residuals too, without
        projecting.
        """
        if part == 0.0:
            return self
        factor = np.float32(part)
        return _At(
            self.x + factor * (self.x - last.x),
            self.rest + factor * (self.rest - last.rest),
        )


@dataclass(frozen=True, eq=False)
class _Objective:
    """The cost and its steps."""

    problem: LinearSystem
    strength: float
    regular: Regular

    def at(self, x: Float32Array) -> _At:
        """Make the point of a volume: its residual, and its cost, half the squared
        residual plus `strength` times the total variation.
        """
        rest = self.problem.project(x) - self.problem.measured
        cost = 0.5 * dot(rest, rest) + self.strength * self.regular.variation(x)
        return _At(x, rest, cost)

    def step(self, at: _At, step: float) -> Any:
        """Step down the squares' gradient; then the proximal map of the rest."""
        z = at.x - np.float32(step) * self.problem.spread(at.rest)
        return self.regular.proximal(z, step * self.strength)

    def subset_pass(self, x: Float32Array, step: float, count: int) -> Any:
        """Take a step for each subset of views, far apart in turn, and one proximal map at the
        end.

        `x`: volume, not changed. `step`: length of a step over all views. `count`: number of
        subsets; each takes every `count`-th view.
        Returns a new volume.
        """
        n = len(self.problem.geometry)
        x = x.copy()
        for k in far_apart(count):
            part = np.arange(k, n, count)
            rest = self.problem.project(x, part) - self.problem.measured[part]
            x -= np.float32(step * n / len(part)) * self.problem.spread(rest, part)
        return self.regular.proximal(x, count * step * self.strength)


@dataclass(frozen=True, eq=False)
class Regular:
    """Total variation and constraints, with the dual variables of the last proximal map."""

    scale: Float32Array
    lowest: np.float32
    allowed: Any
    dual: Any = field(repr=False)

    @classmethod
    def of(cls, like: Volume, nonnegative: bool, mask: npt.ArrayLike | None) -> Regular:
        """Create the regularizer of a grid, with all dual variables zero; differences are
        scaled by the smallest edge of a voxel over that along their axis.

        Args:
            like: the grid.
            nonnegative: values are not below 0.
            mask: (nz, ny, nx), 0 where values must be 0; None allows all.

        Raises:
            GeometryError: the mask has another shape than the grid.
        """
        if mask is None:
            allowed = np.ones(like.shape, np.uint8)
        else:
            allowed = np.ascontiguousarray(np.asarray(mask) != 0, dtype=np.uint8)
            if allowed.shape != like.shape:
                raise GeometryError.of_shape(
                    "the mask", allowed.shape, like.shape, ", the grid's"
                )
        edges = np.array(like.voxel_xyz[::-1])
        return cls(
            (edges.min() / edges).astype(np.float32),
            np.float32(0.0 if nonnegative else -math.inf),
            allowed,
            np.zeros((3, *like.shape), np.float32),
        )

    def allow(self, x: Any) -> Any:
        """Find the nearest allowed values to x."""
        return np.ascontiguousarray(
            np.maximum(x, self.lowest) * self.allowed, dtype=np.float32
        )

    def variation(self, x: Any) -> float:
        """Compute the total variation of voxels (nz, ny, nx): the sum of the lengths of their
        scaled differences.
        """
        from flexdt.twin.reconstruction.kernels import tv_kernels

        layers = np.empty(len(x))
        for first, last in layer_portions(x):
            tv_kernels.variation(x, self.scale, layers, first, last)
        return float(layers.sum())

    def proximal(self, z: Any, theta: float) -> Any:
        """Find the allowed x of least 1/2 sum((x - z)^2) + theta TV(x), approximately, by
        `DUAL_STEPS` accelerated dual steps from the last call's dual variables on.

        Args:
            z: voxels (nz, ny, nx), not changed.
            theta: weight of total variation; 0 only enforces the bounds.

        Returns:
            A new x; the dual variables are stored for the next call.
        """
        if theta == 0.0:
            return self.allow(z)
        if isinstance(z, np.ndarray):
            z = np.ascontiguousarray(z)
        x = z.copy()
        ahead = self.dual.copy()
        # The squared norm of the differences is at most 4 sum(scale^2).
        rate = np.float32(1.0 / (4.0 * theta * float((self.scale**2).sum())))
        t = 1.0
        for _ in range(DUAL_STEPS):
            self.primal_step(z, ahead, np.float32(theta), x)
            t, further = momentum(t)
            self.dual_step(x, ahead, rate, np.float32(further))
        self.primal_step(z, self.dual, np.float32(theta), x)
        return x

    def primal_step(self, z: Any, dual: Any, theta: np.float32, x: Any) -> None:
        """Fill x (nz, ny, nx) from the dual variables (3, nz, ny, nx), by layers.

        `theta`: the weight of total variation.
        """
        from flexdt.twin.reconstruction.kernels import tv_kernels

        for first, last in layer_portions(x):
            tv_kernels.primal_step(
                z, dual, theta, self.scale, self.lowest, self.allowed, x, first, last
            )

    def dual_step(
        self, x: Any, ahead: Any, rate: np.float32, further: np.float32
    ) -> None:
        """Update `self.dual` and `ahead` (3, nz, ny, nx) in place, by portions of layers; see
        `tv_kernels.dual_step`. `further`: its momentum."""
        from flexdt.twin.reconstruction.kernels import tv_kernels

        for first, last in layer_portions(x):
            tv_kernels.dual_step(
                x, ahead, self.dual, rate, further, self.scale, first, last
            )


@dataclass(frozen=True, eq=False)
class DeviceRegular(Regular):
    """A `Regular` on a CUDA device: every array but `scale` is a `DeviceArray`."""

    @classmethod
    def of_host(cls, regular: Regular, like: Volume) -> DeviceRegular:
        """Create the same regularizer on the device, with all dual variables zero.

        `regular`: of the host; `like`: grid of the volume.
        Raises gpu.DeviceError: the device fails."""
        allowed = DeviceArray.of_voxels(like.like(regular.allowed.astype(np.float32)))
        dual = gpu.demand(lambda: gpu.zeros(3 * allowed.flat.size))
        flat = DeviceArray.of_images(dual.reshape(1, 1, dual.size))
        return cls(regular.scale, regular.lowest, allowed, flat)

    def allow(self, x: Any) -> Any:
        """Find the nearest allowed values to x; see `Regular`."""
        return np.maximum(x, self.lowest) * self.allowed

    def variation(self, x: Any) -> float:
        """Compute the total variation of x; see `Regular`."""
        found = x.copy()
        self._run("lengths", x.flat, *self._form, found.flat)
        return float(found.sum())

    def primal_step(self, z: Any, dual: Any, theta: np.float32, x: Any) -> None:
        """Compute x from the dual variables; see `Regular`."""
        last = (self.lowest, self.allowed.flat, x.flat)
        self._run("primal_step", z.flat, dual.flat, theta, *self._form, *last)

    def dual_step(
        self, x: Any, ahead: Any, rate: np.float32, further: np.float32
    ) -> None:
        """Update `dual` and `ahead` in place on the device, without waiting; see
        `Regular`.
        """
        self._run(
            "dual_step", x.flat, ahead.flat, self.dual.flat, rate, further, *self._form
        )

    @property
    def _form(self) -> tuple[Any, ...]:
        stride = self.allowed.volume.layout.stride_x
        return self.allowed.shape, stride, tuple(self.scale)

    def _run(self, name: str, *arguments: Any) -> None:
        """Launch a kernel with a thread for each voxel; does not wait for the device.

        Args:
            name: of the function in `gpu_reconstruction_kernels`.
            arguments: of the kernel.

        Raises:
            gpu.DeviceError: the device fails.
        """

        def launch() -> None:
            """Start the named kernel on the device with one thread for each voxel; does
            not wait for it.
            """
            from flexdt.twin.reconstruction.kernels import (
                gpu_reconstruction_kernels as kernels,
            )

            blocks = -(-self.allowed.flat.size // gpu.LINEAR)
            getattr(kernels, name)[blocks, gpu.LINEAR](*arguments)

        gpu.demand(launch)
