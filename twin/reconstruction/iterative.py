"""Iterative reconstruction on the matched pair of projector and adjoint, for any trajectory.

SIRT, SART (ordered subsets), CGLS and EM (maximum likelihood for positive data). Each
algorithm is one function; all see geometry through `LinearSystem` only. Everything is
held in memory. The caller chooses the number of iterations. SIRT and SART weigh line
integrals by variances that are given, and then end when the residual is no more than that
noise; they take the spectrum's hardening in several materials into account. SIRT, SART
and CGLS solve a fine region in coarse surroundings.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any, Final, TypeVar

import numpy as np
import numpy.typing as npt

from flexdt.twin import long_work
from flexdt.twin.errors import LimitError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.long_work import Advance, Progress
from flexdt.twin.projection import Grid, Volume
from flexdt.twin.projection.linear import Model
from flexdt.twin.projection.linear_operator import dot
from flexdt.twin.reconstruction.beam_hardening import Polychromatic
from flexdt.twin.reconstruction.linear_system import (
    ALL,
    LinearSystem,
    Some,
    Step,
    Watch,
    ones,
    ratio,
    solved,
)
from flexdt.twin.signatures import public

Algorithm = TypeVar("Algorithm", bound=Callable[..., Volume])
NOT_AGAIN: Final = frozenset({"watch", "progress", "errors"})
"""Options of a call that do not change its volume."""


def finding_errors(algorithm: Algorithm) -> Algorithm:
    """Let an algorithm's `errors=True` find those of its volume, by the same call once more."""
    signature = inspect.signature(algorithm)

    @wraps(algorithm)
    def call(*arrays: Any, **options: Any) -> Any:
        errors = options.pop("errors", False)
        made = algorithm(*arrays, **options)
        if not errors:
            return made
        from flexdt.twin.reconstruction.iterative_errors import checked

        stated = signature.bind(*arrays, **options)
        stated.apply_defaults()
        images, views, _ = stated.args
        given = {k: v for k, v in stated.kwargs.items() if k not in NOT_AGAIN}
        return checked(made, images, views, algorithm, given)

    return call  # type: ignore[return-value]


def far_apart(count: int) -> list[int]:
    """Order 0 .. count-1 so that neighbors in time are far apart (golden-section)."""
    return [int(i) for i in np.argsort((np.arange(count) * 0.6180339887498949) % 1.0)]


@public
@finding_errors
def sirt(
    projections: npt.ArrayLike,
    cone_vec: ConeVec | npt.ArrayLike,
    like: Volume | Grid,
    *,
    iterations: int = 50,
    start: Volume | None = None,
    nonnegative: bool = False,
    variances: npt.ArrayLike | None = None,
    hardening: Polychromatic | None = None,
    surroundings: Volume | Grid | None = None,
    model: Model = "exact",
    watch: Watch | None = None,
    progress: Progress = None,
    errors: bool = False,
) -> Volume:
    """Reconstruct by SIRT: x += C A' R (b - A x), R and C inverse row and column sums.

    The residual weighted with R never grows.

    With `variances`, weighted least squares: R holds one over them, C one over the
    curvature. It ends with the first iteration in which only noise is left: squares over
    variances that are 1 in the mean.

    With `hardening`, A x is the spectrum's measurement through the materials of x, which
    are separated by value in every iteration. The residual is then scaled by line
    integrals at one energy over those of the spectrum. (Their difference added to b would
    have the same solution, but diverges where thin steel attenuates more than twice as
    much as at that energy.) The volume has the attenuation at this energy.

    With `surroundings`, coarse voxels about the grid are reconstructed along with it, so
    that matter beyond it is not pressed into it. They fill the space out to
    `surroundings`, in voxels of about its size, an integer number of which fills the grid
    along each axis (so none is larger).

    Args:
        projections: (n, rows, cols) line integrals.
        cone_vec: ConeVec or (n, 12) [mm].
        like: the grid, or a volume on it, whose values are not used.
        iterations: how many; with `variances` at most.
        start: first guess on the same grid; zero by default.
        nonnegative: clip at zero after each iteration.
        variances: (n, rows, cols) of the line integrals; of N photons counted, about 1 /
            N.
        hardening: spectrum and materials of the object, `Polychromatic.of`; line
            integrals are then those measured, uncorrected.
        surroundings: grid of the whole object, coarser than `like`, which lies in it.
        model: of the projector: "linear" for something smooth (docs/operator.md).
        watch: called in every iteration.
        progress: a bar after two seconds; False for none, or what takes the fraction
            done.
        errors: find `sigma`, `bias_bound` and `accuracy` of the volume, and warn of images
            that contradict their geometry. The images are kept; `sigma` makes the volume two
            times more when it is first asked for.

    Returns:
        Volume [1/mm] on the grid of `like`.

    Raises:
        GeometryError: shapes that do not fit, or surroundings that do not reach beyond
            the grid.
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
    problem = LinearSystem.of(
        projections,
        cone_vec,
        like,
        iterations,
        variances,
        hardening,
        surroundings,
        model=model,
    )
    with long_work.during("solving by SIRT", progress) as advance:
        return solved(
            problem,
            lambda p: _subset_steps(
                p, [ALL], 1.0, iterations, start, nonnegative, watch, advance
            ),
        )


@finding_errors
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
    hardening: Polychromatic | None = None,
    surroundings: Volume | Grid | None = None,
    model: Model = "exact",
    watch: Watch | None = None,
    progress: Progress = None,
    errors: bool = False,
) -> Volume:
    """Reconstruct by SIRT's step on subsets of views in turn: faster at first, noisier in
    the end.

    Args:
        projections, cone_vec, like, start, nonnegative, variances: as for `sirt`.
        hardening, surroundings, watch, progress, errors: as for `sirt`.
        iterations: passes through all views.
        subsets: number of subsets, at most one a view; each takes every k-th view, so it
            sees all directions.
        relaxation: part of each step that is taken, between 0 and 2.

    Returns:
        Volume [1/mm] on the grid of `like`.

    Raises:
        GeometryError: as `sirt`.
        LimitError: no iterations or subsets, or a relaxation out of its range.

    Example:
        >>> scan = ConeVec.circular(sod=600, sdd=1000, angles=12, shape=(8, 8), pixel=1)
        >>> volume = Volume(np.full((4, 4, 4), 0.02, np.float32), 1.0)
        >>> from flexdt.twin.projection import forward
        >>> found = sart(forward(volume, scan), scan, like=volume, iterations=20)
        >>> bool(abs(found.data - 0.02).max() < 0.002)
        True
    """
    problem = LinearSystem.of(
        projections,
        cone_vec,
        like,
        iterations,
        variances,
        hardening,
        surroundings,
        model=model,
    )
    count = min(subsets, len(problem.geometry))
    if count < 1 or not 0.0 < relaxation < 2.0:
        given = f"{subsets} subsets, relaxation {relaxation:g}"
        raise LimitError.instead(
            given, [subsets, relaxation], "at least 1, and between 0 and 2"
        )
    parts = [np.arange(k, len(problem.geometry), count) for k in far_apart(count)]
    with long_work.during("solving by SART", progress) as advance:
        return solved(
            problem,
            lambda p: _subset_steps(
                p, parts, relaxation, iterations, start, nonnegative, watch, advance
            ),
        )


def _subset_steps(
    problem: LinearSystem,
    parts: Sequence[Some],
    relaxation: float,
    iterations: int,
    start: Volume | None,
    nonnegative: bool,
    watch: Watch | None,
    advance: Advance,
) -> Volume:
    """Take SIRT's step on the views of each part in turn, for each iteration.

    Args:
        problem: images, geometry and grid.
        parts: views of each part.
        relaxation: factor on the steps.
        iterations: at most as many; with weights fewer, once the mean weighted square of
            the residuals is 1 or less, as of noise alone.
        start: first volume; zeros without.
        nonnegative: negative values become 0 after each step.
        watch: called with each iteration's residual, as it was before each part's step;
            None: no residual is computed.
        advance: called with the share that is done.
    """
    sums = [problem.scales(part) for part in parts]
    weighted = problem.weights is not None
    x = problem.first(start)
    for i in range(iterations):
        squares = noise = 0.0
        for part, (rows, columns) in zip(parts, sums, strict=True):
            rest, more = problem.misfit(x, part)
            squares += 0.0 if watch is None else dot(rest, rest)
            scaled = rows * rest
            noise += dot(rest, scaled) if weighted else 0.0
            x = x + np.float32(relaxation) * columns * problem.spread(more * scaled, part)
            if nonnegative:
                np.maximum(x, 0.0, out=x)
        if watch is not None:
            watch(
                Step(i + 1, iterations, float(np.sqrt(squares / problem.measured.size)))
            )
        advance((i + 1) / iterations)
        if weighted and noise <= problem.measured.size:
            break
    return problem.volume(x)


@public
@finding_errors
def cgls(
    projections: npt.ArrayLike,
    cone_vec: ConeVec | npt.ArrayLike,
    like: Volume | Grid,
    *,
    iterations: int = 15,
    start: Volume | None = None,
    surroundings: Volume | Grid | None = None,
    model: Model = "exact",
    watch: Watch | None = None,
    progress: Progress = None,
    errors: bool = False,
) -> Volume:
    """Reconstruct by conjugate gradients for least squares: the residual falls every
    iteration.

    Ends early if the gradient is exactly 0. Values may be negative.

    Args: as for `sirt`.

    Returns:
        Volume [1/mm] on the grid of `like`.

    Raises:
        GeometryError: shapes that do not fit, or surroundings that do not reach beyond
            the grid.
        LimitError: no iterations.

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
    problem = LinearSystem.of(
        projections, cone_vec, like, iterations, surroundings=surroundings, model=model
    )
    with long_work.during("solving by CGLS", progress) as advance:
        return solved(problem, lambda p: _cgls(p, iterations, start, watch, advance))


def _cgls(
    problem: LinearSystem,
    iterations: int,
    start: Volume | None,
    watch: Watch | None,
    advance: Advance,
) -> Volume:
    """Take steps along conjugate directions (CGLS).

    Args:
        problem: images, geometry and grid.
        iterations: at most as many; ends when the gradient is exactly 0.
        start: first volume; zeros without.
        watch: called before each step with the residual.
        advance: called with the share that is done.
    """
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
        # Exact along any direction: once rounding has spoilt the gradients, steps stay small.
        size = np.float32(dot(rest, image) / dot(image, image))
        x = x + size * direction
        rest -= size * image
        gradient = problem.spread(rest)
        new = dot(gradient, gradient)
        direction = gradient + np.float32(new / norm) * direction
        norm = new
        advance((i + 1) / iterations)
    return problem.volume(x)


@finding_errors
def em(
    projections: npt.ArrayLike,
    cone_vec: ConeVec | npt.ArrayLike,
    like: Volume | Grid,
    *,
    iterations: int = 30,
    start: Volume | None = None,
    model: Model = "exact",
    watch: Watch | None = None,
    progress: Progress = None,
    errors: bool = False,
) -> Volume:
    """Reconstruct by expectation maximization: x *= A'(b / A x) / A' 1, always positive.

    Negative line integrals (noise) count as zero. Args: as for `sirt`; a first guess must
    be positive wherever the object may be, without one all voxels that a ray meets begin
    with one value.

    Returns:
        Volume [1/mm] on the grid of `like`; 0 in voxels that no ray meets.

    Raises:
        GeometryError: shapes that do not fit.
        LimitError: no iterations.

    Example:
        >>> scan = ConeVec.circular(sod=600, sdd=1000, angles=12, shape=(8, 8), pixel=1)
        >>> volume = Volume(np.full((4, 4, 4), 0.02, np.float32), 1.0)
        >>> from flexdt.twin.projection import forward
        >>> found = em(forward(volume, scan), scan, like=volume, iterations=100)
        >>> bool(abs(found.data - 0.02).max() < 0.002)
        True
    """
    problem = LinearSystem.of(projections, cone_vec, like, iterations, model=model)
    with long_work.during("solving by EM", progress) as advance:
        return solved(problem, lambda p: _em(p, iterations, start, watch, advance))


def _em(
    problem: LinearSystem,
    iterations: int,
    start: Volume | None,
    watch: Watch | None,
    advance: Advance,
) -> Volume:
    """Multiply by the back-projected ratios of measured and projected line integrals (MLEM), for
    all iterations.

    Args:
        problem: images, geometry and grid; negative line integrals count as 0.
        iterations: how many.
        start: first volume; without, one value in all voxels that a ray meets.
        watch: called before each step with its residual, to the images as they were given.
        advance: called with the share that is done.

    Returns the volume; 0 in voxels that no ray meets.
    """
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
        advance((i + 1) / iterations)
    return problem.volume(x)
