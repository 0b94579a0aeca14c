"""Beads that move against each other during a scan: a part that slips, or beads that are loose.

Such a motion leaves residuals that are correlated from frame to frame, as slow errors of spots
do, so it is not judged with the other causes, which count correlated residuals as few. Beads are
displaced in the phantom from a frame on, at once or evenly to the last frame. With and without
that, the residuals are judged beside the same rivals (causes of the residuals, motion of
everything, errors that repeat with the turn, beads that stand elsewhere in all frames) and with
the same errors of spots, uncorrelated or slow.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_triangular
from scipy.special import chdtri, gammaln, logsumexp

from flexdt.twin.calibration.diagnose import Finding, error
from flexdt.twin.calibration.diagnose.causes import LEAST_BEADS, Candidates, Choice, Known
from flexdt.twin.calibration.diagnose.causes.candidates import clipped, usual_noise
from flexdt.twin.calibration.diagnose.causes.cause import (
    REPEATING,
)
from flexdt.twin.calibration.diagnose.causes.columns import LEAST_VISIBLE, WAVES
from flexdt.twin.calibration.diagnose.causes.every_cause import (
    MOTION_WIDTHS,
    PRIOR_FACTORS,
)
from flexdt.twin.calibration.diagnose.causes.explained import REPEATING_FRAMES
from flexdt.twin.calibration.diagnose.wobble import LEANS
from flexdt.twin.calibration.fit.certificate import widened
from flexdt.twin.calibration.fit.evidence import LOG_CHANCE, NAMED_LOG_ODDS, Judged, Table
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.fit.fitted_motion import derivative
from flexdt.twin.calibration.fit.problem import FitProblem, edge_factors, layout
from flexdt.twin.calibration.fit.residual_structure import HARMONICS, larger
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.motion import MOVABLE

SEEN_CHANCE: Final = 0.01
"""Probability that chance makes a right scan worth a closer look."""
LEAST_FRAMES: Final = 8
"""Number of frames of a scan in which beads are told to move."""
LEAST_SIDE: Final = 2
"""Least number of frames before a bead moves, and after."""
COARSE_STEPS: Final = 12
"""Number of frames that are tried at first."""
STARTS: Final = 4
"""Number of starts of the search for beads that move."""
MOST_PIECES: Final = 4
"""Largest number of sets of beads that move, each from a frame of its own."""
LEAST_TOLD: Final = 0.05
"""Part of the largest displacement from which others are told."""
SHARES: Final = tuple(2e-4 * 4.0**k for k in range(5))
"""Widths of a displacement, as parts of the phantom's size."""
SLOW_ERRORS: Final = tuple(itertools.product((0.7, 0.9, 0.97), (1.0, 3.0, 10.0, 30.0)))
"""Correlations of slow errors of spots from frame to frame, and their sizes in units of errors
that are not correlated."""
LEAST_SHARE: Final = 1e-12
"""Part of a sum of squares that is rounding."""


class Piece(NamedTuple):
    """Beads that are elsewhere in the phantom from a frame on.

    Attributes:
        beads: their numbers, ascending.
        frame: the first that shows them elsewhere.
        slow: they move on evenly to the last frame.
    """

    beads: tuple[int, ...]
    frame: int
    slow: bool

    def course(self, frames: int) -> FloatArray:
        """Return the share of the way that is gone in each frame, (frames,)."""
        place = np.arange(frames)
        if not self.slow:
            return np.asarray((place >= self.frame) * 1.0)
        last_still = self.frame - 1
        return np.clip((place - last_still) / (frames - 1 - last_still), 0.0, 1.0)


class Score(NamedTuple):
    """What a piece explains.

    Attributes:
        gain: logarithm of its odds against none.
        width: of the displacements [mm].
        noise: standard deviation of the residuals that it leaves.
    """

    gain: float
    width: float
    noise: float


@dataclass(frozen=True, eq=False)
class Model:
    """Columns of a table with their priors.

    Attributes:
        columns: (c,).
        widths: (c,) of the priors; inf without one.
        chance: logarithm of its probability before the scan is seen, where it is one of many.
    """

    columns: npt.NDArray[np.intp]
    widths: FloatArray
    chance: float = 0.0

    def beside(self, columns: Iterable[int], width: float, chance: float = 0.0) -> Model:
        """Add columns of one width; those that are there get the larger of both."""
        there = dict(zip(self.columns.tolist(), self.widths.tolist(), strict=True))
        for column in columns:
            there[column] = max(there.get(column, 0.0), width)
        widths = np.array(list(there.values()))
        return Model(np.array(list(there), np.intp), widths, self.chance + chance)

    def wider(self, count: int, factor: float) -> Model:
        """Multiply the widths of the first columns by a factor."""
        widths = self.widths.copy()
        widths[:count] *= factor
        return Model(self.columns, widths)


@dataclass(frozen=True, eq=False)
class Verdict:
    """What is judged of pieces.

    Attributes:
        pieces: beads that move.
        odds: logarithm of the odds that they do.
        moved: the most likely model with them.
        ways: (beads of all pieces, 3) their displacements [mm].
        rest: root mean square of the whitened residuals with them.
    """

    pieces: tuple[Piece, ...]
    odds: float
    moved: Judged
    ways: FloatArray
    rest: float

    @property
    def named(self) -> bool:
        """They move beyond doubt."""
        return self.odds > NAMED_LOG_ODDS

    def finding(self, group: npt.NDArray[np.int64]) -> Finding:
        """Make the error that beads move against the others.

        Args:
            group: (n,) scan of each frame.
        """
        ends = list(itertools.accumulate(len(piece.beads) for piece in self.pieces))
        sizes = np.linalg.norm(self.ways, axis=1)
        parts = []
        for piece, end in zip(self.pieces, ends, strict=True):
            size = float(sizes[end - len(piece.beads) : end].max())
            if size < LEAST_TOLD * sizes.max():
                continue
            scan = int(group[piece.frame])
            frame = piece.frame - int(np.flatnonzero(group == scan)[0])
            place = f"frame {frame}" + (f" of scan {scan + 1}" if group.max() > 0 else "")
            one = len(piece.beads) == 1
            how = "slowly, beginning at" if piece.slow else "from"
            on = "" if piece.slow else " on"
            parts.append(
                f"bead{'s' * (not one)} {', '.join(map(str, piece.beads))} "
                f"move{'s' * one} by {size:.2g} mm {how} {place}{on}"
            )
        return error(
            "beads_moved",
            "beads move against the others during the scan: "
            f"{'; '.join(parts)}. Something is loose or slips in the phantom: fix its beads, "
            "and measure again",
        )


def with_loose_beads(
    plain: FitResult, fit: FitResult, known: Known
) -> tuple[FitResult, Verdict | None]:
    """Judge whether beads move against each other, and widen the sigmas of a fit where that
    is open.

    Args:
        plain: fit without causes of the residuals.
        fit: the same with them.
        known: statements on the phantom and the positions.

    Returns:
        The fit, wider where the residuals speak for beads that move but do not prove it, and
        the verdict if it is beyond doubt; `fit` and None for fewer than `LEAST_FRAMES`
        frames or `LEAST_BEADS` beads, and where no bead steps more than chance makes it.
    """
    n, k = plain.problem.seen.shape
    if n < LEAST_FRAMES or k < LEAST_BEADS or not _steps(fit, known.floor):
        return fit, None
    trial = _Trial(plain, fit, known)
    best: Verdict | None = None
    for pieces in trial.found():
        verdict = trial.judged(pieces)
        if best is None or verdict.odds > best.odds:
            best = verdict
        if best.named:
            return fit, best
    if best is None or best.odds < LOG_CHANCE:
        return fit, None
    return _widened(plain, fit, best), None


def _widened(plain: FitResult, fit: FitResult, verdict: Verdict) -> FitResult:
    """Widen the sigmas of a fit to those that it has where beads move, too; not of one that
    is not identifiable.
    """
    if not fit.identifiable:
        return fit
    count = plain.problem.layout.parameter_count
    factor = edge_factors(plain.problem.layout.names[:count])
    change = fit.solution.x[:count] - plain.solution.x[:count]
    off = (verdict.moved.mean[:count] - change) * factor
    own = fit.certificate.covariance
    other = verdict.moved.covariance(count) * np.outer(factor, factor)
    both = larger(own, other + np.outer(off, off))
    return replace(fit, certificate=widened(fit.certificate, both - own))


def _steps(fit: FitResult, floor: float) -> bool:
    """Check whether a bead's place before or after some frame differs from what the fit has,
    by more than chance makes it in `SEEN_CHANCE` of scans.

    Args:
        fit: whose residuals are looked at.
        floor: least standard deviation of whitened residuals.
    """
    problem = fit.problem
    n, k = problem.seen.shape
    residual = problem.whitened(fit.solution.x)
    lengths = np.linalg.norm(residual, axis=2)
    noise = usual_noise(lengths[problem.seen], floor)
    if not noise > 0.0:
        return False
    share = clipped(lengths, noise)[..., None]
    own = _own_columns(problem, fit.solution.x).reshape(n, k, 2, k, 3)
    slope = np.einsum("nbcbx->nbcx", own) * share[..., None]
    push = np.einsum("nbcx,nbc->nbx", slope, residual * share)
    gram = np.einsum("nbcx,nbcy->nbxy", slope, slope)
    most = 0.0
    for way in (1, -1):  # It may be the fit's place before, or after.
        sums = np.cumsum(push[::way], axis=0)[LEAST_SIDE - 1 : n - LEAST_SIDE]
        squares = np.cumsum(gram[::way], axis=0)[LEAST_SIDE - 1 : n - LEAST_SIDE]
        power = np.trace(squares, axis1=2, axis2=3)[..., None, None]
        squares = squares + (1e-9 * power + 1e-300) * np.eye(3)
        steps = np.linalg.solve(squares, sums[..., None])[..., 0]
        most = max(most, float(np.einsum("nbx,nbx->nb", sums, steps).max(initial=0.0)))
    return most > noise**2 * float(chdtri(3, SEEN_CHANCE / (2 * n * k)))


def _own_columns(problem: FitProblem, x: FloatArray) -> FloatArray:
    """Compute whitened rows of the beads' coordinates, (2 n k, 3 k) [1/mm]."""
    params, beads = problem.spread(x)
    alone = layout((), len(params), (), len(beads), True)
    model = replace(problem.model, beads=beads)
    free = replace(
        problem, base=params, layout=alone, model=model, panel=None, turning=None
    )
    return free.jacobian(free.start, problem.seen)


class _Trial:
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
        """Return the columns of the displacements of a piece, (m, 3 beads) [1/mm]."""
        c = self.candidates
        course = piece.course(self.frames)[self.frame]
        at = [c.count + 3 * bead + axis for bead in piece.beads for axis in range(3)]
        return np.asarray(c.rows[:, at] * course[:, None])

    def chance(self, piece: Piece) -> float:
        """Return the logarithm of the probability of a piece before the scan is seen: sets
        of as many beads, and frames, are equally likely.
        """
        k = self.beads
        m = len(piece.beads)
        sets = gammaln(k + 1) - gammaln(m + 1) - gammaln(k - m + 1)
        return LOG_CHANCE - math.log(2.0 * self.frames * k) - float(sets)

    def found(self) -> Iterator[tuple[Piece, ...]]:
        """Yield the pieces that explain most of what is left without causes, and with the
        most likely ones, where they are likely at all; each once.
        """
        before: list[tuple[Piece, ...]] = [()]
        for base in (self.nothing, self.rival):
            pieces = self._explaining(base)
            if pieces not in before:
                yield pieces
            before.append(pieces)

    def _explaining(self, base: Model) -> tuple[Piece, ...]:
        """Find pieces that explain what a model leaves, step by step, `MOST_PIECES` at
        most, each further one beyond doubt; in the order of their frames.
        """
        rows, widths, values = self._rows_of(base)
        noise = self.candidates.noise
        out: list[Piece] = []
        while len(out) < MOST_PIECES:
            search = _Search(self, _Left(rows, widths, values, noise))
            piece = search.best(out)
            gain, width, noise = search.score(piece)
            if gain < (NAMED_LOG_ODDS if out else 0.0) or piece in out:
                break
            out.append(piece)
            more = self.columns(piece)
            rows = np.concatenate([rows, more], axis=1)
            widths = np.append(widths, np.full(more.shape[1], width))
        return tuple(sorted(out, key=lambda piece: piece.frame))

    def judged(self, pieces: tuple[Piece, ...]) -> Verdict:
        """Judge pieces beside all rivals, with every kind of errors of spots.

        The slow errors are judged beside those rivals alone that are the most likely with
        other errors, and only where these do not exclude the pieces.
        """
        c = self.candidates
        motions = self._motions(pieces)
        own = np.concatenate([self.columns(piece) for piece in pieces], axis=1)
        first = c.rows.shape[1] + motions.shape[1]
        ways = range(first, first + own.shape[1])
        rows = np.concatenate([c.rows, motions, own], axis=1)
        contest = _Contest(self, rows, ways, pieces)
        moving = sorted({bead for piece in pieces for bead in piece.beads})
        rivals = self._rivals(moving, range(c.rows.shape[1], first))
        rivals += [
            self._moving_as_one(base, motions) for base in (self.nothing, self.rival)
        ]
        contest.compare(rivals)
        if contest.odds > LOG_CHANCE:
            likely = [rivals[i] for i in contest.likely()]
            beads = {tuple(moving), tuple(range(self.beads))}
            for (part, size), some in itertools.product(SLOW_ERRORS, beads):
                contest.compare(likely, (part, size, some))
        moved = contest.moved
        left = (c.values - rows[:, moved.columns] @ moved.mean) / self.share
        found = dict(zip(moved.columns.tolist(), moved.mean.tolist(), strict=True))
        return Verdict(
            pieces,
            contest.odds,
            moved,
            np.array([found[way] for way in ways]).reshape(-1, 3),
            float(np.sqrt(np.mean(left**2))),
        )

    def _rivals(self, moving: Sequence[int], motions: range) -> list[Model]:
        """List the rivals of beads that move: nothing, the most likely causes, these with wide
        priors, with errors that repeat, with those beads elsewhere in all frames, and with
        all motions of everything.
        """
        c = self.candidates
        likely = self.rival
        out = [self.nothing, likely, likely.wider(c.count, max(PRIOR_FACTORS))]
        for cause in c.causes:
            if cause.name == REPEATING:
                out += [likely.beside(cause.columns, width) for width in cause.widths]
        own = [c.count + 3 * bead + axis for bead in moving for axis in range(3)]
        out += [likely.beside(own, share * self.size) for share in SHARES]
        out += [likely.beside(motions, width * c.noise) for width in MOTION_WIDTHS]
        return out

    def _moving_as_one(self, base: Model, motions: FloatArray) -> Model:
        """Add single motions of everything to a model, the one that explains most after the
        other, as long as that is more likely, `MOST_PIECES` at most.

        Args:
            base: the model.
            motions: (m, columns) behind those of the causes.
        """
        first = self.candidates.rows.shape[1]
        rows, widths, values = self._rows_of(base)
        chance = LOG_CHANCE - math.log(motions.shape[1])
        noise = self.candidates.noise
        out = base
        for _ in range(MOST_PIECES):
            left = _Left(rows, widths, values, noise)
            push = motions.T @ left.values - (left.basis.T @ motions).T @ left.along
            power = 1.0 - np.square(left.basis.T @ motions).sum(axis=0)
            power = np.maximum(power, LEAST_VISIBLE**2)
            best = int(np.argmax(push**2 / power))
            width = max(abs(float(push[best] / power[best])), left.noise)
            score = left.score(power[best : best + 1, None], push[best : best + 1], width)
            if score.gain + chance < 0.0:
                break
            noise = score.noise
            out = out.beside([first + best], width, chance)
            rows = np.concatenate([rows, motions[:, best : best + 1]], axis=1)
            widths = np.append(widths, width)
        return out

    def _rows_of(self, base: Model) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the columns of a model, (m, c), their widths, (c,), and the residuals, (m,),
        about the means of its priors.
        """
        c = self.candidates
        rows = c.rows[:, base.columns]
        means = np.where(np.isinf(base.widths), 0.0, c.means[base.columns])
        return rows, base.widths, c.values - rows @ means

    def _motions(self, pieces: Sequence[Piece]) -> FloatArray:
        """Return the shifts by motions of object, source, panel and axis, (m, columns) of
        unit length: a ramp, half waves of the scan, waves of the turn, and the courses of
        the pieces.
        """
        problem = self.candidates.problem
        place = (np.arange(self.frames) + 0.5) / self.frames
        shapes = [place - 0.5]
        shapes += [np.cos(math.pi * wave * place) for wave in range(1, WAVES)]
        for harmonic in range(1, HARMONICS + 1):
            turn = harmonic * np.asarray(problem.poses.angle)
            shapes += [np.cos(turn), np.sin(turn)]
        courses = {piece[1:]: piece.course(self.frames) for piece in pieces}
        shapes += courses.values()
        table = np.stack(shapes, axis=1)[self.frame]
        kept = np.repeat(problem.seen.ravel(), 2)
        x = self.candidates.x
        out = []
        for name in (*MOVABLE, *LEANS):
            slope = derivative(problem, x, name, problem.seen)[kept] * self.share
            out.append(slope[:, None] * table)
        every = np.concatenate(out, axis=1)
        return np.asarray(every / np.maximum(np.linalg.norm(every, axis=0), 1e-300))

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


class _Contest:
    """Models without and with beads that move, each beside the same rivals."""

    def __init__(
        self,
        trial: _Trial,
        rows: FloatArray,
        ways: range,
        pieces: Sequence[Piece],
    ) -> None:
        """Begin without any model.

        Args:
            trial: the residuals.
            rows: (m, q) of all columns.
            ways: columns of the displacements.
            pieces: that are judged.
        """
        self._trial = trial
        self._rows = rows
        self._ways = ways
        self._chance = sum(trial.chance(piece) for piece in pieces)
        self._widths = [share * trial.size for share in SHARES]
        self._still: list[tuple[float, int]] = []
        self._moved: list[tuple[float, int, Judged, float]] = []

    def compare(
        self,
        rivals: Sequence[Model],
        slow: tuple[float, float, Sequence[int]] | None = None,
    ) -> None:
        """Judge rivals alone, and with beads that move beside them.

        Args:
            rivals: models.
            slow: part, size and beads of slow errors; None: errors are uncorrelated.
        """
        trial = self._trial
        c = trial.candidates
        used = sorted({*self._ways, *(i for r in rivals for i in r.columns.tolist())})
        both = np.column_stack([self._rows[:, used], c.values])
        volume = 0.0
        if slow is not None:
            both, volume = trial.uncorrelated(both, *slow)
        table = Table(both[:, :-1], both[:, -1], c.known.floor)
        place = {column: i for i, column in enumerate(used)}
        means = np.zeros(len(used))
        for column, i in place.items():
            means[i] = c.means[column] if column < len(c.means) else 0.0

        def judged(model: Model) -> Judged | None:
            """Judge a model by the table of the columns that are used."""
            at = [place[column] for column in model.columns.tolist()]
            found = table.judged(at, model.widths, c.noise, means[at])
            if found is None:
                return None
            return replace(found, columns=model.columns, evidence=found.evidence - volume)

        for i, rival in enumerate(rivals):
            still = judged(rival)
            if still is not None:
                self._still.append((still.evidence, i))
            for width in self._widths:
                moved = judged(rival.beside(self._ways, width))
                if moved is not None:
                    odds = moved.evidence + self._chance - math.log(len(SHARES))
                    self._moved.append((odds, i, moved, width))
        if slow is None and self._moved:
            # The width hardly depends on the errors.
            self._widths = [max(self._moved, key=lambda one: one[0])[3]]

    @property
    def odds(self) -> float:
        """Logarithm of the odds that beads move; -inf where that cannot be judged."""
        if not self._moved or not self._still:
            return -math.inf
        moved = logsumexp([evidence for evidence, *_ in self._moved])
        return float(moved - logsumexp([evidence for evidence, _ in self._still]))

    @property
    def moved(self) -> Judged:
        """The most likely model with beads that move."""
        return max(self._moved, key=lambda one: one[0])[2]

    def likely(self) -> list[int]:
        """Return the numbers of the first two rivals and of the two most likely ones of
        each side.
        """
        out = {0, 1}
        moved = [(evidence, i) for evidence, i, _, _ in self._moved]
        for side in (self._still, moved):
            out |= {i for _, i in sorted(side, reverse=True)[:2]}
        return sorted(out)


class _Left:
    """What a model leaves of the residuals.

    Attributes:
        values: (m,) residuals.
        basis: (m, c) of what the model takes up, with its priors.
        along: (c,) products of both.
        noise: standard deviation of what is left.
    """

    def __init__(
        self, rows: FloatArray, widths: FloatArray, values: FloatArray, noise: float
    ) -> None:
        """Project the residuals.

        Args:
            rows, widths: (m, c) columns of the model, and (c,) widths of their priors.
            values: (m,) to be explained, priors of mean 0.
            noise: standard deviation of the values.
        """
        weight = np.where(np.isinf(widths), 0.0, noise / widths)
        size = np.sqrt(np.einsum("mc,mc->c", rows, rows) + weight**2)
        size = np.where(size > 0, size, 1.0)
        table = np.concatenate([rows / size, np.diag(weight / size)])
        self.values = values
        self.basis = np.linalg.qr(table)[0][: len(rows)]
        self.along = self.basis.T @ values
        square = float(values @ values)
        total = square - float(self.along @ self.along)
        self._total = max(total, LEAST_SHARE * square)
        self.noise = math.sqrt(self._total / len(values))

    def score(self, gram: FloatArray, push: FloatArray, width: float) -> Score:
        """Judge further columns of a width.

        Args:
            gram: (q, q) products of the columns, less what the model takes up.
            push: (q,) products with the residuals, likewise.
            width: of their priors.
        """
        one = np.eye(len(push))
        count = len(self.values)
        noise = self.noise
        for _ in range(2):
            whole = gram + (noise / width) ** 2 * one
            left = self._total - float(push @ np.linalg.solve(whole, push))
            left = max(left, LEAST_SHARE * self._total)
            noise = math.sqrt(left / count)
        volume = float(np.linalg.slogdet(one + gram * (width / noise) ** 2)[1])
        gain = -0.5 * (count * math.log(left / self._total) + volume)
        return Score(gain, width, noise)


class _Search:
    """The pieces that explain most of what a model leaves of the residuals."""

    def __init__(self, trial: _Trial, left: _Left) -> None:
        """Begin without any piece.

        Args:
            trial: the residuals.
            left: of them by the model.
        """
        self._trial = trial
        self._left = left
        self._products: dict[tuple[int, bool], tuple[FloatArray, FloatArray]] = {}
        self._scores: dict[Piece, Score] = {}

    def _of_all_beads(self, frame: int, slow: bool) -> tuple[FloatArray, FloatArray]:
        """Return products of the columns of all beads, (3 k, 3 k), and with the residuals,
        (3 k,), less what the model takes up.
        """
        key = (frame, slow)
        if key not in self._products:
            every = Piece(tuple(range(self._trial.beads)), frame, slow)
            columns = self._trial.columns(every)
            taken = self._left.basis.T @ columns
            self._products[key] = (
                columns.T @ columns - taken.T @ taken,
                columns.T @ self._left.values - taken.T @ self._left.along,
            )
        return self._products[key]

    def score(self, piece: Piece) -> Score:
        """Judge a piece, once (cached), with the width that its displacements have."""
        if piece not in self._scores:
            gram, push = self._of_all_beads(piece.frame, piece.slow)
            at = [3 * bead + axis for bead in piece.beads for axis in range(3)]
            gram = gram[np.ix_(at, at)]
            push = push[at]
            size = self._trial.size
            least = (self._left.noise / size) ** 2 * np.eye(len(at))
            found = np.linalg.solve(gram + least, push)
            width = float(np.sqrt(np.mean(found**2)))
            width = min(max(width, SHARES[0] * size), size)
            score = self._left.score(gram, push, width)
            chance = self._trial.chance(piece)
            self._scores[piece] = score._replace(gain=score.gain + chance)
        return self._scores[piece]

    def _gain(self, piece: Piece) -> float:
        """Return the gain of a piece."""
        return self.score(piece).gain

    def best(self, before: Sequence[Piece]) -> Piece:
        """Find the most likely piece, from `STARTS` sets of beads and ways to move, each with
        its best frame, by single changes.

        Args:
            before: pieces of the model, whose beads and frames are tried, too.
        """
        n = self._trial.frames
        even = np.linspace(LEAST_SIDE, n - LEAST_SIDE, min(COARSE_STEPS, n - 3))
        frames = {*even.round().astype(int).tolist(), *(p.frame for p in before)}
        sets = self._sets() | {piece.beads for piece in before}
        some = [
            Piece(beads, frame, slow)
            for beads, frame, slow in itertools.product(sets, frames, (False, True))
        ]
        starts: dict[tuple[tuple[int, ...], bool], Piece] = {}
        for piece in sorted(some, key=self._gain, reverse=True):
            starts.setdefault((piece.beads, piece.slow), piece)
        likely = itertools.islice(starts.values(), STARTS)
        return max(map(self._climbed, likely), key=self._gain)

    def _sets(self) -> set[tuple[int, ...]]:
        """List sets of beads: each alone, and those on either side of a plane across each
        axis.
        """
        places = self._trial.candidates.problem.model.beads
        k = self._trial.beads
        out: set[tuple[int, ...]] = {(bead,) for bead in range(k)}
        for order in np.argsort(places, axis=0).T.tolist():
            for i in range(1, k):
                out |= {tuple(sorted(order[:i])), tuple(sorted(order[i:]))}
        return out

    def _climbed(self, piece: Piece) -> Piece:
        """Add and leave out beads, move the frame, and change how they move, as long as that
        is more likely.
        """
        n = self._trial.frames
        k = self._trial.beads
        coarse = max(n // COARSE_STEPS // 2, 1)
        reach = sorted({sign * step for sign in (-1, 1) for step in (0, 1, 2, coarse)})
        while True:
            some = [piece]
            for step, slow in itertools.product(reach, (False, True)):
                if LEAST_SIDE <= piece.frame + step <= n - LEAST_SIDE:
                    some.append(Piece(piece.beads, piece.frame + step, slow))
            for bead in range(k):
                beads = tuple(sorted({*piece.beads} ^ {bead}))
                if 0 < len(beads) < k:
                    some.append(piece._replace(beads=beads))
            best = max(some, key=self._gain)
            if best == piece:
                return piece
            piece = best
