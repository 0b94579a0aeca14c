"""The residuals of a scan, and the columns that may explain them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import gammaln

from flexdt.twin.calibration.diagnose.causes import Candidates, Choice, Known
from flexdt.twin.calibration.diagnose.causes.columns import WAVES, coordinates
from flexdt.twin.calibration.diagnose.causes.explained import REPEATING_FRAMES
from flexdt.twin.calibration.diagnose.slipped.piece import Model, Piece, walk
from flexdt.twin.calibration.diagnose.wobble import LEANS
from flexdt.twin.calibration.fit.evidence import LOG_CHANCE
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.fit.fitted_motion import derivative
from flexdt.twin.calibration.fit.residual_structure import HARMONICS
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.motion import MOVABLE


class Residuals:
    """The residuals of a scan, and everything that may explain them but beads that move.

    Attributes:
        candidates: causes of the residuals, judged as if no bead moved.
        frames, beads: their numbers.
        frame, bead, part: (m,) of each row; `part` is 0 across, 1 down.
        share: (m,) weight of each row.
        size: of the phantom [mm].
        nothing, rival: without causes, and with the most likely ones.
    """

    def __init__(self, plain: FitResult, fit: FitResult, known: Known) -> None:
        """Tabulate the residuals of a fit without causes.

        Args:
            plain: the fit.
            fit: with causes, of which the borders of tiles are tried, too.
            known: statements on the phantom and the positions.
        """
        problem = plain.problem
        n, k = problem.seen.shape
        borders = () if fit.problem.panel is None else fit.problem.panel.borders
        self.candidates = Candidates(
            problem, plain.solution.x, known, borders, repeating=n >= REPEATING_FRAMES
        )
        self.frames = n
        self.beads = k
        self.group = problem.group
        kept = np.flatnonzero(np.repeat(problem.seen.ravel(), 2))
        self.frame = kept // (2 * k)
        self.bead = kept // 2 % k
        self.part = kept % 2
        self.share = self.candidates.share
        self.size = float(np.ptp(problem.model.beads, axis=0).max())
        self.nothing = self._model((0.0,) * len(self.candidates.causes))
        self.rival = self._model(self.candidates.best())

    def _model(self, choice: Choice) -> Model:
        """Return the columns of causes with given widths, of the geometry, and of what always
        holds.
        """
        columns, widths = self.candidates.columns_of(choice)
        return Model(np.array(columns, np.intp), widths)

    def columns(self, piece: Piece) -> FloatArray:
        """Return the columns of the displacements of a piece, (m, 3 beads) [1/mm]; behind them
        those of a random walk along its way, where it moves freely.
        """
        c = self.candidates
        course = piece.course(self.frames)[self.frame]
        at = c.count + coordinates(piece.beads)
        own = np.asarray(c.rows[:, at] * course[:, None])
        if not piece.toward:
            return own
        along = c.rows[:, at] @ np.array(piece.toward)
        return np.column_stack([own, along[:, None] * walk(self.frames)[self.frame]])

    def chance(self, piece: Piece) -> float:
        """Return the logarithm of the probability of a piece before the scan is seen: sets
        of as many beads, and frames, are equally likely.
        """
        k = self.beads
        m = len(piece.beads)
        sets = gammaln(k + 1) - gammaln(m + 1) - gammaln(k - m + 1)
        return LOG_CHANCE - math.log(2.0 * self.frames * k) - float(sets)

    def rows_of(self, base: Model) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the columns of a model, (m, c), their widths, (c,), and the residuals, (m,),
        about the means of its priors.
        """
        c = self.candidates
        rows = c.rows[:, base.columns]
        means = np.where(np.isinf(base.widths), 0.0, c.means[base.columns])
        return rows, base.widths, c.values - rows @ means

    def motions(self, pieces: Sequence[Piece]) -> FloatArray:
        """Return the shifts by motions of object, source, panel and axis, (m, columns) of
        unit length: a ramp, half waves of the scan, waves of the turn, and the courses of
        the pieces.
        """
        place = (np.arange(self.frames) + 0.5) / self.frames
        shapes = [place - 0.5]
        shapes += [np.cos(math.pi * wave * place) for wave in range(1, WAVES)]
        for harmonic in range(1, HARMONICS + 1):
            turn = harmonic * np.asarray(self.candidates.problem.poses.angle)
            shapes += [np.cos(turn), np.sin(turn)]
        courses = {piece[1:]: piece.course(self.frames) for piece in pieces}
        shapes += courses.values()
        table = np.stack(shapes, axis=1)[self.frame]
        every = np.einsum("mp,mc->mpc", self._slopes, table).reshape(len(table), -1)
        return np.asarray(every / np.maximum(np.linalg.norm(every, axis=0), 1e-300))

    def walks(self) -> FloatArray:
        """Return the shifts by random walks of object, source, panel and axis, (m, parameters,
        parts of a walk), of which the first part is of unit length.
        """
        parts = walk(self.frames)[self.frame]
        every = np.einsum("mp,mc->mpc", self._slopes, parts)
        first = np.linalg.norm(every[:, :, :1], axis=0)
        return np.asarray(every / np.maximum(first, 1e-300))

    @cached_property
    def _slopes(self) -> FloatArray:
        """(m, parameters) shifts by a unit of each parameter that may move."""
        problem = self.candidates.problem
        kept = np.repeat(problem.seen.ravel(), 2)
        x = self.candidates.x
        names = (*MOVABLE, *LEANS)
        slopes = [derivative(problem, x, name, problem.seen)[kept] for name in names]
        return np.stack(slopes, axis=1) * self.share[:, None]

    def uncorrelated(
        self, rows: FloatArray, part: float, size: float, beads: Sequence[int]
    ) -> tuple[FloatArray, float]:
        """Weight rows so that their errors are uncorrelated, if those of some beads are slow
        in part.

        Args:
            rows: (m, q).
            part: correlation of slow errors from one frame of a scan to the next.
            size: standard deviation of slow errors, in units of the others.
            beads: that have them.

        Returns:
            Rows of the same shape, and half the logarithm of the determinant of the
            errors' covariance.
        """
        out = rows.copy()
        volume = 0.0
        for bead, axis in itertools.product(beads, (0, 1)):
            mine = np.flatnonzero((self.bead == bead) & (self.part == axis))
            frame = self.frame[mine]
            same = np.equal.outer(self.group[frame], self.group[frame])
            alike = np.where(same, part ** np.abs(np.subtract.outer(frame, frame)), 0.0)
            factor = np.linalg.cholesky(np.eye(len(mine)) + size**2 * alike)
            out[mine] = solve_triangular(factor, rows[mine], lower=True)
            volume += float(np.log(np.diag(factor)).sum())
        return out, volume
