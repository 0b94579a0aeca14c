"""Iterative reconstruction on the matched pair of projector and adjoint, for any trajectory.

SIRT, SART (ordered subsets), CGLS and EM (maximum likelihood for positive data). Each algorithm is
one function; all see geometry through `forward` and `back` only. Everything is held in memory. The
caller chooses the number of iterations; there is no stopping rule.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import LimitError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import Grid, Volume
from flexdt.twin.reconstruction.problem import SMALLEST, Problem, Step, Watch, dot, far_apart


def sirt(
    projections: npt.ArrayLike,
    cone_vec: ConeVec | npt.ArrayLike,
    like: Volume | Grid,
    *,
    iterations: int = 50,
    start: Volume | None = None,
    nonnegative: bool = False,
    watch: Watch | None = None,
) -> Volume:
    """Simultaneous iterative reconstruction: x += C A' R (b - A x), R and C inverse row and
    column sums. The residual weighted with R never grows.

    Args:
        projections: (n, rows, cols) line integrals.
        cone_vec: ConeVec or (n, 12) [mm].
        like: the grid, or a volume on it, whose values are not used.
        iterations: how many.
        start: first guess on the same grid; zero by default.
        nonnegative: clip at zero after each iteration.
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
    problem = Problem.of(projections, cone_vec, like, iterations)
    rows, columns = problem.inverse_sums(problem.geometry)
    x = problem.first(start)
    for i in range(iterations):
        rest = problem.measured - problem.project(x)
        problem.tell(watch, i, iterations, rest)
        rest *= rows
        x = x + columns * problem.spread(rest)
        if nonnegative:
            np.maximum(x, 0.0, out=x)
    return replace(problem.like, data=x)


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
    watch: Watch | None = None,
) -> Volume:
    """SIRT's step on one subset of views after another: faster at first, noisier in the end.

    Args:
        projections, cone_vec, like, start, nonnegative, watch: as for `sirt`.
        iterations: passes through all views.
        subsets: number of subsets; each takes every k-th view, so it sees all directions.
        relaxation: part of each step that is taken.
    """
    problem = Problem.of(projections, cone_vec, like, iterations)
    count = min(subsets, len(problem.geometry))
    if count < 1 or not 0.0 < relaxation < 2.0:
        raise LimitError(
            f"{subsets} subsets, relaxation {relaxation:g}; allowed: at least 1, and between 0 "
            "and 2",
            {"asked": [subsets, relaxation]},
        )
    parts = [np.arange(k, len(problem.geometry), count) for k in far_apart(count)]
    sums = [problem.inverse_sums(problem.geometry[part]) for part in parts]
    x = problem.first(start)
    for i in range(iterations):
        squares = 0.0
        for part, (rows, columns) in zip(parts, sums, strict=True):
            geometry = problem.geometry[part]
            rest = problem.measured[part] - problem.project(x, geometry)
            squares += float(np.vdot(rest, rest))
            rest *= rows
            x = x + np.float32(relaxation) * columns * problem.spread(rest, geometry)
            if nonnegative:
                np.maximum(x, 0.0, out=x)
        if watch is not None:
            watch(Step(i + 1, iterations, float(np.sqrt(squares / problem.measured.size))))
    return replace(problem.like, data=x)


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
    problem = Problem.of(projections, cone_vec, like, iterations)
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
    return replace(problem.like, data=x)


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
    """
    problem = Problem.of(projections, cone_vec, like, iterations)
    measured = np.maximum(problem.measured, 0.0)
    whole = problem.spread(np.ones_like(measured)).copy(order="K")
    seen = whole > SMALLEST * whole.max()
    x = problem.first(start)
    if start is None:
        reach = problem.project(np.ones_like(x))
        x = np.where(seen, np.float32(measured.sum() / max(float(reach.sum()), 1e-30)), 0.0)
        x = x.astype(np.float32)
    for i in range(iterations):
        image = problem.project(x)
        problem.tell(watch, i, iterations, problem.measured - image)
        floor = SMALLEST * float(image.max())
        ratio = np.divide(measured, image, out=np.zeros_like(image), where=image > floor)
        gain = problem.spread(ratio)
        x = x * np.divide(gain, whole, out=np.zeros_like(gain), where=seen)
    return replace(problem.like, data=x)
