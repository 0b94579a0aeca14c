"""The linear mixed model of motion: a fit's columns, and parameters' deviations in frames.

Deviations of a parameter have one of two priors. They are normal, smaller where they bend
more (second differences; banded, so everything is solved frame by frame); or they follow
courses of one number each: a jump at a frame, or a ramp over a scan. What jumps is told from what
wanders by its evidence, and so are two parameters that jump at the same frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import linalg

from flexdt.twin.calibration.fit.fit import LEAST_NOISE
from flexdt.twin.calibration.fit.residual_structure import cross
from flexdt.twin.geometry.conventions import FloatArray

COLUMNS: Final = 512
"""Number of covariance columns processed at a time."""
MOST_COURSES: Final = 720
"""Largest number of frames of a scan at which jumps are tried."""


class Course(NamedTuple):
    """Deviations that are a sum of courses.

    Attributes:
        shapes: their numbers, of `MotionModel.courses`, rising.
        width: of each height, in sigmas from one frame.
    """

    shapes: tuple[int, ...]
    width: float

    def beside(self, shape: int) -> Course:
        """Return the same with a further course."""
        return Course(tuple(sorted((*self.shapes, shape))), self.width)


class Waves(NamedTuple):
    """Normal deviations.

    Attributes:
        width: in sigmas from one frame.
        waves: half waves in a scan above which amplitudes fall; inf: no fall.
    """

    width: float
    waves: float


Pick = Waves | Course | None
"""Prior of a parameter's deviations; None: it does not move."""
MotionChoice = tuple[Pick, ...]
"""Of each parameter."""


class Height(NamedTuple):
    """A further column: the height of a course.

    Attributes:
        parameter: number of the one that follows it.
        shape: (n,) deviations, see `MotionModel.course`.
        width: see `Course`.
    """

    parameter: int
    shape: FloatArray
    width: float


class Answer(NamedTuple):
    """The deviations of a choice.

    Attributes:
        values: (n, p) from their mean, internal units; 0 where a parameter does not move.
        sigma: (n, p) of them; nan where a parameter does not move.
        added: (g, g) covariance that they add to the fit's columns.
        inflation: factor, 1 or more, by which they take up its degrees of freedom.
        columns: (g,) change of the fit's columns.
    """

    values: FloatArray
    sigma: FloatArray
    added: FloatArray
    inflation: float
    columns: FloatArray


class MotionModel:
    """Linear mixed model: the fit's g columns, and p parameters' deviations in n frames.

    The prior precision of a parameter's deviations is (1 + D'D / l^2) / v, with D the second
    differences of frames: it has five diagonals, so everything is solved in bands. Its
    directions are nearly cosines of the frame's number.

    Attributes:
        plain: (g, g) normal equations of the fit's columns, scaled, with their priors.
        push: (g,) right-hand side of the same.
        pairs, mixed, pull: (n, p, p), (n, g, p), (n, p): sums over each frame's rows of two
            derivatives, of one and a column, of one and the residual.
        scale: (g,) length of the fit's columns.
        total: sum of squares of the residuals, priors included.
        freedom: number of rows and priors less g.
        sizes: frames of each scan.
        column: (n, p) column of the fit to which a deviation belongs; -1: to no column.
        courses: (n, c) ramps of each scan, then jumps: 0 before a frame, 1 from it to the
            end of its scan.
    """

    def __init__(
        self,
        rows: FloatArray,
        residual: FloatArray,
        motion: FloatArray,
        frame: npt.NDArray[np.intp],
        sizes: Sequence[int],
        column: npt.NDArray[np.int64],
        weight: FloatArray,
        off: FloatArray,
    ) -> None:
        """Sum up the normal equations, with columns scaled to unit length; the rows are
        not kept.

        Args:
            rows: (m, g) derivatives by the fit's columns.
            residual: (m,).
            motion: (m, p) derivatives by the parameters of each row's frame.
            frame: (m,) of each row.
            sizes: frames of each scan.
            column: (n, p), see the class.
            weight: (g,) of the priors; 0 without.
            off: (g,) distance of their means.
        """
        n = sum(sizes)
        p = motion.shape[1]
        g = rows.shape[1]
        self.sizes = sizes
        self.column = column
        self.scale = np.sqrt(np.einsum("mg,mg->g", rows, rows) + weight)
        self.scale[self.scale == 0.0] = 1.0
        rows = rows / self.scale
        weight = weight / self.scale**2
        off = off * self.scale
        self.pairs = np.zeros((n, p, p))
        self.mixed = np.zeros((n, g, p))
        self.pull = np.zeros((n, p))
        np.add.at(self.pairs, frame, motion[:, :, None] * motion[:, None, :])
        np.add.at(self.mixed, frame, rows[:, :, None] * motion[:, None, :])
        np.add.at(self.pull, frame, motion * residual[:, None])
        self.plain = cross(rows, rows) + np.diag(weight + 1e-10)
        self.push = np.einsum("mg,m->g", rows, residual) + weight * off
        self.total = float(np.sum(residual**2) + np.sum(weight * off**2))
        self.freedom = max(len(residual) + int((weight > 0).sum()) - g, 1)
        self.courses = _courses(sizes)
        self._one_frame = 1.0 / np.maximum(np.einsum("nii->i", self.pairs) / n, 1e-300)
        self._centred: dict[int, FloatArray] = {}
        self._precisions: dict[float, _Precision] = {}

    def one_frame(self, i: int) -> float:
        """Compute the variance of a parameter's deviation from one frame."""
        return float(self._one_frame[i])

    def course(self, i: int, shapes: Sequence[int]) -> FloatArray:
        """Compute the deviations of a parameter that follow courses, from their mean, (n,
        courses), as high as the sigma from one frame.

        Args:
            i: number of the parameter.
            shapes: numbers of courses.
        """
        return self._every_course(i)[:, list(shapes)]

    def _every_course(self, i: int) -> FloatArray:
        """Compute the deviations of a parameter that follow each course, once; see `course`."""
        if i not in self._centred:
            out = self.courses.copy()
            own = self.column[:, i]
            for label in np.unique(own):
                out[own == label] -= out[own == label].mean(axis=0)
            self._centred[i] = np.asarray(out * math.sqrt(self.one_frame(i)))
        return self._centred[i]

    def spectrum(self, i: int, pick: Waves) -> list[FloatArray]:
        """Compute the variance of the amplitude of each scan's cosines, for deviations
        that are level at the ends.

        Args:
            i: number of the parameter.
            pick: width, in sigmas from one frame, and smoothness of its motion.

        Returns:
            For each scan (frames,), by the number of half waves, falling; the mean from
            one half wave on is the squared width.
        """
        variance = pick.width**2 * self.one_frame(i)
        return [variance * shares for shares in _shares(self.sizes, pick.waves)]

    def _of_one(self, waves: float) -> _Precision:
        """Return the prior precision of deviations of unit width, made once."""
        if waves not in self._precisions:
            self._precisions[waves] = _precision(self.sizes, waves)
        return self._precisions[waves]

    def _diagonals(self, i: int, pick: Waves) -> FloatArray:
        """Compute the prior precision of a parameter's deviations, (3, n); see `_Precision`.

        Args:
            i: number of the parameter.
            pick: width and smoothness of its motion.
        """
        return self._of_one(pick.waves).diagonals / (pick.width**2 * self.one_frame(i))

    def _logarithm_of_prior(self, i: int, pick: Waves) -> float:
        """Compute the logarithm of the determinant of the same."""
        variance = pick.width**2 * self.one_frame(i)
        return self._of_one(pick.waves).logarithm - len(self.pull) * math.log(variance)

    def _factor(self, moving: Sequence[int], choice: MotionChoice) -> FloatArray:
        """Factorise the deviations' normal equations, frame by frame (banded Cholesky);
        raises LinAlgError if they are not positive definite.

        Args:
            moving: numbers of the p moving parameters.
            choice: width and smoothness of each parameter; those of moving ones are not
                None.

        Returns:
            (2 p + 1, n p) lower Cholesky factor as `scipy.linalg.cho_solve_banded` takes
            it.
        """
        n = len(self.pull)
        p = len(moving)
        band = np.zeros((2 * p + 1, n, p))
        for a, i in enumerate(moving):
            for b in range(a + 1):
                band[a - b, :, b] = self.pairs[:, i, moving[b]]
            pick = choice[i]
            assert pick is not None
            assert not isinstance(pick, Course)
            band[[0, p, 2 * p], :, a] += self._diagonals(i, pick)
        return np.asarray(
            linalg.cholesky_banded(
                band.reshape(2 * p + 1, n * p), lower=True, check_finite=False
            )
        )

    def _eliminated(self, choice: MotionChoice) -> _Eliminated:
        """Eliminate the normal deviations of a choice from the normal equations (Schur
        complement). The heights of its courses are further columns.

        Args:
            choice: of each parameter.

        Returns:
            The reduced equations, and the factors with which deviations follow from their
            solution; with empty factors if there are no normal deviations.
        """
        moving = [
            i
            for i, pick in enumerate(choice)
            if pick is not None and not isinstance(pick, Course)
        ]
        heights = [
            Height(i, self.course(i, pick.shapes)[:, at], pick.width)
            for i, pick in enumerate(choice)
            if isinstance(pick, Course)
            for at in range(len(pick.shapes))
        ]
        plain, push, mixed = self._with_courses(heights)
        if not moving:
            empty = np.zeros((0, len(push)))
            return _Eliminated(
                (), heights, mixed, np.zeros((1, 0)), empty, empty, plain, push, 0.0
            )
        band = self._factor(moving, choice)
        across = mixed[:, :, moving].transpose(0, 2, 1).reshape(-1, len(push))
        pull = self.pull[:, moving].ravel()
        both = linalg.cho_solve_banded((band, True), np.column_stack([across, pull]))
        inner = both[:, :-1]
        alone = both[:, -1]
        return _Eliminated(
            tuple(moving),
            heights,
            mixed,
            band,
            across,
            inner,
            plain - cross(across, inner),
            push - np.einsum("ng,n->g", across, alone),
            float(np.sum(pull * alone)),
        )

    def _with_courses(
        self, heights: Sequence[Height]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Append c heights of courses to the fit's columns.

        Returns:
            Normal equations (g + c, g + c) and (g + c,) with priors, and sums (n, g + c, p)
            of each frame's products with the parameters.
        """
        if not heights:
            return self.plain, self.push, self.mixed
        g = len(self.push)
        size = g + len(heights)
        n, p = self.pull.shape
        mixed = np.concatenate([self.mixed, np.zeros((n, len(heights), p))], axis=1)
        plain = np.zeros((size, size))
        plain[:g, :g] = self.plain
        push = np.concatenate([self.push, np.zeros(len(heights))])
        for at, one in enumerate(heights, g):
            mixed[:, at] = one.shape[:, None] * self.pairs[:, one.parameter]
            push[at] = one.shape @ self.pull[:, one.parameter]
        for at, one in enumerate(heights, g):
            own = one.shape @ mixed[:, :, one.parameter]
            plain[at] = own
            plain[:, at] = own
            plain[at, at] += 1.0 / one.width**2
        return plain, push, mixed

    def likelihood(self, choice: MotionChoice) -> float:
        """Compute the logarithm of the restricted likelihood of a choice of motions, up
        to a constant; the noise is eliminated.

        Args:
            choice: of each parameter.

        Raises:
            LinAlgError: the equations are singular.
        """
        part = self._eliminated(choice)
        lower, rest = self._reduced(part)
        return self._logarithm(choice, part, lower, rest)

    def _reduced(self, part: _Eliminated) -> tuple[FloatArray, float]:
        """Factorise reduced equations; returns the lower factor and the sum of squares that
        is left.
        """
        lower = linalg.cholesky(part.left, lower=True, check_finite=False)
        found = linalg.solve_triangular(lower, part.push, lower=True)
        rest = self.total - part.explained - float(np.sum(found**2))
        return lower, max(rest, LEAST_NOISE**2)

    def _logarithm(
        self, choice: MotionChoice, part: _Eliminated, lower: FloatArray, rest: float
    ) -> float:
        """Return the logarithm of the restricted likelihood of reduced equations."""
        volume = 2.0 * (np.log(np.diag(lower)).sum() + np.log(part.band[0]).sum())
        for i, pick in enumerate(choice):
            if isinstance(pick, Course):
                volume += 2.0 * len(pick.shapes) * math.log(pick.width)
            elif pick is not None:
                volume -= self._logarithm_of_prior(i, pick)
        return float(-0.5 * (volume + self.freedom * math.log(rest)))

    def best_course(
        self, choice: MotionChoice, i: int, widths: Sequence[float]
    ) -> Course:
        """Find the course of a parameter that is most likely beside the motions of a
        choice.

        Args:
            choice: in which the parameter does not move, or follows courses, to which one
                is added.
            i: number of the parameter.
            widths: to try; that of the other courses is kept.

        Raises:
            LinAlgError: the equations are singular.
        """
        part = self._eliminated(choice)
        lower, rest = self._reduced(part)
        before = choice[i]
        if isinstance(before, Course):
            widths = (before.width,)
        else:
            before = Course((), widths[0])
        shapes = self.course(i, range(self.courses.shape[1]))
        power = np.einsum("nc,n->c", shapes**2, self.pairs[:, i, i])
        across = part.mixed[:, :, i].T @ shapes
        pull = self.pull[:, i] @ shapes
        if part.moving:
            beside = self.pairs[:, list(part.moving), i]
            deviations = (beside[:, :, None] * shapes[:, None, :]).reshape(
                -1, shapes.shape[1]
            )
            inner = linalg.cho_solve_banded((part.band, True), deviations)
            power = power - np.einsum("nc,nc->c", deviations, inner)
            across = across - part.across.T @ inner
            pull = pull - self.pull[:, list(part.moving)].ravel() @ inner
        over = linalg.solve_triangular(lower, across, lower=True)
        power = np.maximum(power - np.einsum("gc,gc->c", over, over), 0.0)
        pull = pull - linalg.solve_triangular(lower, part.push, lower=True) @ over
        best = (-math.inf, 0, widths[0])
        for width in widths:
            whole = power + 1.0 / width**2
            left = np.maximum(rest - pull**2 / whole, LEAST_NOISE**2)
            gain = -0.5 * (
                np.log(whole) + 2.0 * math.log(width) + self.freedom * np.log(left)
            )
            gain[list(before.shapes)] = -math.inf
            at = int(np.argmax(gain))
            best = max(best, (float(gain[at]), at, width))
        return Course(before.shapes, best[2]).beside(best[1])

    def solved(self, choice: MotionChoice) -> Answer:
        """Solve for the deviations of a choice.

        Args:
            choice: of each parameter.

        Raises:
            LinAlgError: the equations are singular.
        """
        part = self._eliminated(choice)
        inverse = linalg.inv(part.left)
        fixed = inverse @ part.push
        g = len(self.push)
        rest = max(self.total - part.explained - float(fixed @ part.push), 0.0)
        noise2 = rest / self.freedom

        values = np.zeros(self.pull.shape)
        variance = np.full(self.pull.shape, np.nan)
        covariance = inverse[:g, :g] - linalg.inv(self.plain)
        columns = fixed[:g]
        taken = float(len(part.heights))
        for i in dict.fromkeys(one.parameter for one in part.heights):
            values[:, i], variance[:, i] = self._solved_courses(i, part, inverse, fixed)
        if part.moving:
            waves = self._solved_waves(part, inverse, fixed)
            values[:, part.moving] = waves.values
            variance[:, part.moving] = waves.variance
            covariance = covariance + waves.added
            columns = columns + waves.columns
            taken += waves.taken

        return Answer(
            values,
            np.sqrt(noise2 * np.maximum(variance, 0.0)),
            noise2 * covariance / np.outer(self.scale, self.scale),
            self.freedom / max(self.freedom - taken, 1.0),
            columns / self.scale,
        )

    def _solved_courses(
        self, i: int, part: _Eliminated, inverse: FloatArray, fixed: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Compute the deviations of a parameter that follows courses.

        Args:
            i: number of the parameter.
            part: reduced equations.
            inverse: of them.
            fixed: their solution.

        Returns:
            Values and variances in units of the noise's, (n,) each.
        """
        g = len(self.push)
        own = [at for at, one in enumerate(part.heights, g) if one.parameter == i]
        shapes = np.stack([part.heights[at - g].shape for at in own], axis=1)
        of_heights = inverse[np.ix_(own, own)]
        variance = np.einsum("nc,cd,nd->n", shapes, of_heights, shapes)
        return shapes @ fixed[own], variance

    def _solved_waves(
        self, part: _Eliminated, inverse: FloatArray, fixed: FloatArray
    ) -> _Waves:
        """Compute the normal deviations from their means, which are the parameters' own
        values: the fit's columns are then the two together.

        Args:
            part: reduced equations with normal deviations.
            inverse: of them.
            fixed: their solution.
        """
        n = len(self.pull)
        g = len(self.push)
        p = len(part.moving)
        pull = self.pull[:, part.moving].ravel()
        found = linalg.cho_solve_banded((part.band, True), pull) - part.inner @ fixed
        square = self._variances(part, inverse)
        information = np.einsum("nii->ni", self.pairs)[:, part.moving].ravel()

        column_of_mean, mean_of, each = _averages(self.column[:, part.moving])
        place = np.arange(n * p)
        with_mean = linalg.cho_solve_banded((part.band, True), each)
        with_fixed = -inverse @ (part.inner.T @ each)
        with_mean -= part.inner @ with_fixed
        of_means = np.einsum("nc,nd->cd", each, with_mean)
        means = found @ each
        centred = square - 2.0 * with_mean[place, mean_of] + np.diag(of_means)[mean_of]

        into = np.zeros((g, len(means)))
        for kind, column in enumerate(column_of_mean.tolist()):
            if column >= 0:
                into[column, kind] = self.scale[column]
        both = with_fixed[:g] @ into.T
        return _Waves(
            (found - means[mean_of]).reshape(n, p),
            centred.reshape(n, p),
            both + both.T + into @ of_means @ into.T,
            into @ means,
            float(np.sum(np.minimum(information * square, 1.0))),
        )

    def _variances(self, part: _Eliminated, inverse: FloatArray) -> FloatArray:
        """Compute the variances of normal deviations, in units of the noise's, (n p,)."""
        square = np.einsum("ng,gh,nh->n", part.inner, inverse, part.inner, optimize=True)
        total = len(square)
        for begin in range(0, total, COLUMNS):
            unit = np.eye(total, min(COLUMNS, total - begin), -begin)
            solved = linalg.cho_solve_banded((part.band, True), unit)
            across = np.arange(unit.shape[1])
            square[begin + across] += solved[begin + across, across]
        return np.asarray(square)


class _Waves(NamedTuple):
    """Normal deviations of p parameters in n frames.

    Attributes:
        values: (n, p) from their means.
        variance: (n, p) of them, in units of the noise's variance.
        added: (g, g) covariance that their means add to the fit's columns, in the same.
        columns: (g,) what their means add to the fit's columns.
        taken: degrees of freedom: what the data add to each deviation's prior.
    """

    values: FloatArray
    variance: FloatArray
    added: FloatArray
    columns: FloatArray
    taken: float


@dataclass(frozen=True, eq=False)
class _Eliminated:
    """Normal equations of the fit's g columns and of c courses' heights once the normal
    deviations are eliminated.

    Attributes:
        moving: numbers of the eliminated parameters.
        heights: of the c courses.
        mixed: (n, g + c, parameters) sums over each frame's products.
        band, across, inner: factors of the eliminated deviations.
        left, push: (g + c, g + c), (g + c,) the equations.
        explained: sum of squares that the deviations alone explain.
    """

    moving: tuple[int, ...]
    heights: Sequence[Height]
    mixed: FloatArray
    band: FloatArray
    across: FloatArray
    inner: FloatArray
    left: FloatArray
    push: FloatArray
    explained: float


def _averages(
    own: npt.NDArray[np.int64],
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.intp], FloatArray]:
    """Find the means that deviations are taken from: one of each parameter and column.

    Args:
        own: (n, p) columns of the fit to which deviations of p parameters belong.

    Returns:
        The column of each of k means, (k,); the mean that each deviation belongs to, (n p,);
        and the matrix whose columns average the deviations, (n p, k).
    """
    n, p = own.shape
    labels = (own - own.min() + 1) * p + np.arange(p)
    kinds, first, mean_of = np.unique(
        labels.ravel(), return_index=True, return_inverse=True
    )
    size = np.bincount(mean_of).astype(np.float64)
    each = np.zeros((n * p, len(kinds)))
    each[np.arange(n * p), mean_of] = 1.0 / size[mean_of]
    return own.ravel()[first], mean_of, each


class _Precision(NamedTuple):
    """The prior precision of n deviations, a banded matrix: (1 + D'D / stiffness^2) /
    variance of each scan. Scans are not connected.

    Attributes:
        diagonals: (3, n) the main diagonal and the two below it.
        logarithm: of its determinant.
    """

    diagonals: FloatArray
    logarithm: float


def _precision(sizes: Sequence[int], waves: float) -> _Precision:
    """Compute the prior precision of deviations of unit width.

    Args:
        sizes: frames of each scan.
        waves: half waves in a scan above which amplitudes fall.
    """
    parts = []
    for size, shares in zip(sizes, _shares(sizes, waves), strict=True):
        inner = np.ones(size - 2)  # frames with a second difference [1, -2, 1]
        diagonal = np.convolve(inner, [1.0, 4.0, 1.0])
        beside = np.r_[np.convolve(inner, [-2.0, -2.0]), 0.0]
        squared = np.stack([diagonal, beside, np.r_[inner, 0.0, 0.0]])
        squared /= _stiffness(size, waves) ** 2
        squared[0] += 1.0
        parts.append(squared / shares[0])
    whole = np.concatenate(parts, axis=1)
    lower = linalg.cholesky_banded(whole, lower=True)
    return _Precision(whole, 2.0 * float(np.log(lower[0]).sum()))


def _shares(sizes: Sequence[int], waves: float) -> list[FloatArray]:
    """Compute the variances of the amplitudes of each scan's cosines, falling, by the number
    of half waves; the mean from one half wave on is 1.
    """
    out = []
    for size in sizes:
        bends = (2.0 * np.sin(0.5 * math.pi * np.arange(size) / size)) ** 2
        shares = 1.0 / (1.0 + (bends / _stiffness(size, waves)) ** 2)
        out.append(shares * (size - 1) / shares[1:].sum())
    return out


def _stiffness(size: int, waves: float) -> float:
    """Compute the eigenvalue of the second differences at which amplitudes fall.

    Args:
        size: frames of the scan.
        waves: half waves in the scan; inf for as many as frames or more.
    """
    if waves < size:
        return (2.0 * math.sin(0.5 * math.pi * waves / size)) ** 2
    return math.inf


def _courses(sizes: Sequence[int]) -> FloatArray:
    """Make ramps and jumps of scans; see `MotionModel.courses`.

    A jump leaves two frames on either side: a single one that is elsewhere is no motion.
    """
    n = sum(sizes)
    out = []
    jumps = []
    begin = 0
    for size in sizes:
        ramp = np.zeros(n)
        ramp[begin : begin + size] = np.linspace(-0.5, 0.5, size)
        out.append(ramp)
        step = max(1, size // MOST_COURSES)
        for frame in range(begin + 2, begin + size - 1, step):
            jump = np.zeros(n)
            jump[frame : begin + size] = 1.0
            jumps.append(jump)
        begin += size
    return np.stack([*out, *jumps], axis=1)
