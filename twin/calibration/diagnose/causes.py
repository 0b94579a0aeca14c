"""Causes of the residuals: one table of causes, judged by their evidence.

A cause is a group of columns added to those of the geometry, with a prior of unknown
width: the phantom is strained, the object turns while it is exposed or read, beads are elsewhere,
the panel distorts, a tile begins, something moves, priors are too narrow. Every
combination that is tried has its evidence (`fit.evidence`). The most likely is fitted;
the results of all are averaged, so that the sigmas contain what the data leave open; a
cause is named where its odds exceed NAMED_LOG_ODDS.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.linalg import lapack

from flexdt.twin.calibration.diagnose.tiles import (
    GAP_WIDTHS_PX,
    alike_places,
    likely_border,
)
from flexdt.twin.calibration.fit.certificate import Rival, widened
from flexdt.twin.calibration.fit.evidence import Judged, Table
from flexdt.twin.calibration.fit.fit import RAYLEIGH_MEDIAN, FitResult
from flexdt.twin.calibration.fit.fitted_motion import derivative
from flexdt.twin.calibration.fit.problem import (
    ARC_PRIOR,
    ROWS_PRIOR,
    STRAINS,
    STRETCHES,
    ColumnLayout,
    FitProblem,
    Strain,
    edge_factors,
    turning_shifts,
)
from flexdt.twin.calibration.fit.residual_structure import (
    HARMONICS,
    MOVING,
    correlation_length,
    larger,
)
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.panel import Border, PanelModel

NAMED_LOG_ODDS: Final = math.log(1e4)
"""Logarithm of the odds from which a cause is named."""
OPEN_LOG_ODDS: Final = math.log(100.0)
"""Logarithm of the odds against a cause up to which it is left open."""
LOG_CHANCE: Final = math.log(0.1)
"""Logarithm of the probability that a scan has a cause, before it is seen; assumed."""
STATED_LOG_CHANCE: Final = math.log(0.5)
"""The same for a cause that the script states: images may be made of instants; assumed."""
ARC_TOLERANCE: Final = 0.2
"""Relative standard deviation of the squared share of a step that the script states: the
trigger's place in the exposure is not published; assumed."""
OUTLIER_SIGMAS: Final = 5.0
"""Robust standard deviations at which residuals are clipped."""
STRAIN_WIDTHS: Final = (1e-3, 2.5e-3, 6e-3, 1.5e-2, 4e-2)
BEAD_SHARES: Final = tuple(2e-4 * 2.0**k for k in range(8))
"""Widths of the beads' places as parts of the phantom's size."""
PANEL_WIDTHS_PX: Final = tuple(0.004 * 2.5**k for k in range(9))
MOTION_WIDTHS: Final = (1.0, 4.0, 16.0, 64.0)
"""Widths of a motion, in standard deviations of its estimate."""
LEAST_VISIBLE: Final = 1e-3
"""Part of a motion that the geometry must leave, for it to be told."""
WAVES: Final = 8
"""Number of shapes of a motion here: a ramp, and half waves in a scan."""
PRIOR_FACTORS: Final = (3.0, 10.0)
PRIOR_LOG_CHANCE: Final = math.log(1e-3)
"""Logarithm of the probability that the scanner is so many times further off than stated;
assumed."""
MIN_MOVING_FRAMES: Final = 2
"""Least number of frames between which something may move. In few of them motion is not told
from noise, and stays in the sigmas."""
LEAST_BEADS: Final = 3
"""Number of beads that a calibration needs."""
MOST_ROUNDS: Final = 4
MOST_BORDERS: Final = 2
MAX_EVIDENCE_LOSS: Final = 12.0
"""Logarithm of the evidence ratio beyond which models have no weight."""
LEAST_REST: Final = 1e-3
"""Part of a variance that is left where a rival explanation knows more."""
LEAST_RANK: Final = 1e-12
"""Part of a variance that is added against rounding."""
NO_PANEL_PX: Final = 1e-4
"""Width of the polynomials at a tile's border without other distortion [px]."""
SHAPES: Final = ("stretch", "shear")
"""The causes of a phantom of another shape."""
MOTION_OF: Final = "motion of "
APART: Final = " between scans"
"""End of the name of a motion from scan to scan."""
REPEATING: Final = "errors of spots"
"""The cause that each bead's spots have errors of their own, smooth in the angle."""
REPEATING_WIDTHS: Final = (0.1, 0.2, 0.4, 0.8, 1.6)
"""Widths of a wave of such errors, in standard deviations of a position."""
REPEATING_FRAMES: Final = 16
"""Least number of frames in which errors that repeat with the turn are told from others."""
MAX_REST_SHARE: Final = 0.5
"""Part of the residuals that other causes may leave where something seems to move, too."""
RIVALS: Final = (MOTION_OF, REPEATING, "priors")
"""Causes that only compete: they are followed elsewhere."""


@dataclass(frozen=True)
class Cause:
    """A cause that a scan may have.

    Attributes:
        name: of the cause.
        columns: of the table that it adds; empty for the widths of the priors.
        widths: of its columns that are tried.
        chance: logarithm of its probability before the scan is seen.
        always: width that it has where it is not chosen; 0: its columns are left out.
    """

    name: str
    columns: tuple[int, ...]
    widths: tuple[float, ...]
    chance: float = LOG_CHANCE
    always: float = 0.0


Choice = tuple[float, ...]
"""Width of each cause of a table; 0: not chosen."""


@dataclass(frozen=True)
class Found:
    """The causes of a fit.

    Attributes:
        odds: logarithm of the odds of each cause, by name; borders by their place.
        applied: names of causes that are columns of the fit.
        open: names of causes that the data neither show nor exclude.
        strain: of the phantom, (10,) and its covariance (10, 10); None: it is not judged.
        beside_motion: the fit with causes that are likely where something moves, too, and
            those causes; None where that is not so.
    """

    odds: dict[str, float] = field(default_factory=dict)
    applied: tuple[str, ...] = ()
    open: tuple[str, ...] = ()
    strain: tuple[FloatArray, FloatArray] | None = None
    beside_motion: tuple[FitResult, Found] | None = None

    def named(self, name: str) -> bool:
        """Check whether a cause of the fit is beyond doubt."""
        return name in self.applied and self.odds.get(name, -math.inf) > NAMED_LOG_ODDS


@dataclass(frozen=True, eq=False)
class Known:
    """Statements on the phantom and the positions.

    Attributes:
        strain: priors of the phantom's stretches and shears, 0: it has its stated shape.
        bead_tolerance_mm: of the request; None: unknown, 0: beads are at their stated
            places.
        floor: least standard deviation of whitened residuals.
        arc: part of a step that the object turns in an exposure, by the script, 0: it is
            at rest; None: not stated.
    """

    strain: Strain
    bead_tolerance_mm: float | None
    floor: float
    arc: float | None = None


Refit = Callable[..., FitResult]
"""Fits again with more parameters free: options of `fits_of_scans.refit_scans`."""


class Candidates:
    """The table of a fit: its geometry's columns, and those of every cause."""

    def __init__(
        self,
        problem: FitProblem,
        x: FloatArray,
        known: Known,
        borders: Sequence[Border],
        alike: float = 1.0,
        left_out: Sequence[int] = (),
        repeating: bool = False,
    ) -> None:
        """Tabulate the residuals' derivatives with respect to all causes, residuals of
        bad spots (beyond `OUTLIER_SIGMAS`) weighted less.

        Nothing is judged yet. Residuals are those without the causes that the fit has;
        the last columns are of motions.

        Args:
            problem: of the geometry's fit.
            x: its column values.
            known: statements on the phantom and the positions.
            borders: panel borders that are causes, too.
            alike: number of neighbouring frames whose residuals count as one.
            left_out: beads that are elsewhere: their positions are evidence of nothing.
            repeating: whether errors of spots that repeat with the turn are a cause, too.
        """
        self.problem = problem
        self.x = x
        self.use = problem.seen.copy()
        self.use[:, list(left_out)] = False
        self.known = known
        self.alike = alike
        self.borders = tuple(borders)
        self.repeating = repeating
        self.count = problem.layout.parameter_count
        everything, there = _with_every_column(problem, x, panel_of(problem, borders))
        rows = everything.jacobian(there, self.use)[np.repeat(self.use.ravel(), 2)]
        left = problem.whitened(x)[self.use]
        lengths = np.linalg.norm(left, axis=1)
        self.noise = max(float(np.median(lengths)) / RAYLEIGH_MEDIAN, known.floor)
        bounded = np.minimum(
            1.0, OUTLIER_SIGMAS * self.noise / np.maximum(lengths, 1e-12)
        )
        share = np.repeat(bounded, 2)[:, None]
        motions = self._motions()
        waves = [self._repeating()] if repeating else []
        table = np.concatenate([rows, *motions.values(), *waves], axis=1) * share
        causes = there - everything.start
        causes[: self.count] = 0.0
        values = left.ravel() + rows @ causes
        self.rows = table
        self.values = values * share[:, 0]
        self.table = Table(self.rows, self.values, known.floor, alike)
        first = rows.shape[1]
        last = first + sum(own.shape[1] for own in motions.values())
        self.visible = self._visible(first, last)
        self.causes = self._causes(everything, motions)
        self._judged: dict[Choice, Judged | None] = {}
        self.means = np.zeros(table.shape[1])
        self.means[: self.count] = (problem.prior_mean - x)[: self.count]
        self.means[everything.layout.arc_column] = (known.arc or 0.0) ** 2

    def of_values(self, values: FloatArray, floor: float) -> Candidates:
        """Return the table of other residuals.

        Args:
            values: (2 x seen positions,) whitened.
            floor: least standard deviation of them.
        """
        other = copy(self)
        other.values = values
        other.table = self.table.of_values(self.rows, values, floor)
        other._judged = {}
        return other

    def _motions(self) -> dict[str, FloatArray]:
        """Compute the image shifts of everything that may move: each free parameter of
        MOVING in each scan of `MIN_MOVING_FRAMES` frames or more, as a ramp and as one to
        `WAVES` - 1 half waves, and one that scans share from scan to scan.

        Returns:
            Name of the cause -> (2 x seen positions, columns) of unit length.
        """
        problem = self.problem
        n, k = self.use.shape
        seen = np.repeat(self.use.ravel(), 2)
        scans = [
            np.flatnonzero(problem.group == g) for g in range(problem.group.max() + 1)
        ]
        free = problem.layout.names[: self.count]
        shared = frozenset(free)
        bases = {name.split("@")[0] for name in free}
        out: dict[str, FloatArray] = {}
        for name in MOVING:
            if name not in bases:
                continue
            slope = derivative(problem, self.x, name, self.use).reshape(n, 2 * k)
            some = {}
            for scan, frames in enumerate(scans):
                if len(frames) >= MIN_MOVING_FRAMES:
                    where = f" in scan {scan + 1}" if len(scans) > 1 else ""
                    some[where] = _waves(frames, n)
            if len(scans) > 1 and name in shared:
                some[APART] = np.equal.outer(problem.group, range(len(scans)))
            for where, shapes in some.items():
                columns = (slope[:, :, None] * shapes[:, None]).reshape(2 * n * k, -1)
                columns = columns[seen]
                length = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
                out[MOTION_OF + name + where] = columns / length
        return out

    def _repeating(self) -> FloatArray:
        """Return errors of a bead's positions, across or down, as waves in the angle up to
        `HARMONICS` in a turn: (2 x seen positions, columns).

        The first wave has a standard deviation of a position, the others are smaller by
        their number, as of what is smooth.
        """
        n, k = self.use.shape
        number = np.arange(HARMONICS + 1)
        turn = self.problem.poses.angle[:, None] * number
        size = 1.0 / np.maximum(number, 1)
        waves = np.concatenate(
            [size * np.cos(turn), size[1:] * np.sin(turn[:, 1:])], axis=1
        )
        own = np.einsum("nw,bc->nbwc", waves, np.eye(2 * k))
        rows = own.reshape(n * 2 * k, -1)
        return np.asarray(rows[np.repeat(self.use.ravel(), 2)])

    def _visible(self, first: int, last: int) -> FloatArray:
        """Compute which part of each column's length widths are meant for: of a motion,
        what the geometry leaves of it, `LEAST_VISIBLE` at least.

        Over a part of a turn, or in a helix, an even drift is almost an object that
        stands elsewhere, or a panel and an axis that roll: what is seen of it is little
        beside what it is.

        Args:
            first: column of a motion.
            last: column after those of motions.

        Returns:
            (q,), 1 for other columns than motions.
        """
        own = slice(0, self.count)
        gram = self.table.gram
        out = np.ones(len(gram))
        inside = gram[own, own].copy()
        prior = self.noise / self.problem.prior_sigma[own]
        inside.flat[:: self.count + 1] += prior**2 / self.alike
        scale = 1.0 / np.sqrt(np.maximum(np.diag(inside), 1e-300))
        factor, failed = lapack.dpotrf(inside * np.outer(scale, scale), lower=1)
        if failed or first == last:  # Columns that nothing tells apart hide no more.
            return out
        push = scale[:, None] * gram[own, first:last]
        taken = np.square(lapack.dtrtrs(factor, push, lower=1)[0]).sum(axis=0)
        power = np.maximum(np.diag(gram)[first:last], 1e-300)
        out[first:last] = np.sqrt(np.maximum(1.0 - taken / power, LEAST_VISIBLE**2))
        return out

    def _causes(
        self, everything: FitProblem, motions: Mapping[str, FloatArray]
    ) -> tuple[Cause, ...]:
        """List the causes of the table: shape, beads, arc, rows, panel, borders, motion
        and priors, in this order.

        Exact beads have no cause of shape or position, a stage at rest none of arc or rows;
        beads need three at least; panel and borders only where the problem has a panel.
        Only widths above 1.5 times the stated one are tried.

        Args:
            everything: problem with a column for each cause but motions.
            motions: the columns of those, which are the table's last.

        Returns:
            Causes with their columns, the widths to try, and a width that always holds.
        """
        layout = everything.layout
        known = self.known
        out = []
        exact = known.bead_tolerance_mm == 0
        if not exact:
            first = layout.strain_columns.start
            last = layout.strain_columns.stop
            parts = range(first, first + STRETCHES), range(first + STRETCHES, last)
            for name, part, stated in zip(SHAPES, parts, known.strain, strict=True):
                widths = tuple(w for w in STRAIN_WIDTHS if w > 1.5 * stated)
                out.append(Cause(name, tuple(part), widths, always=stated))
            k = len(everything.model)
            if 3 * k - 7 >= 2:  # less a rigid motion and a scale
                size = float(np.ptp(everything.model.beads, axis=0).max())
                stated = known.bead_tolerance_mm or 0.0
                widths = tuple(w for s in BEAD_SHARES if (w := s * size) > 1.5 * stated)
                columns = tuple(
                    range(layout.bead_columns.start, layout.bead_columns.stop)
                )
                out.append(Cause("beads", columns, widths, always=stated))
        out += _arc(layout.arc_column, known.arc)
        if known.arc != 0.0:
            out.append(Cause("rows", (layout.rows_column,), (ROWS_PRIOR,)))
        panel = everything.panel
        if panel is not None:
            first = layout.panel_column
            bent = len(panel.names) - 2 * len(panel.borders)
            columns = tuple(range(first, first + bent))
            out.append(Cause("panel", columns, PANEL_WIDTHS_PX))
            for i, border in enumerate(panel.borders):
                at = first + bent + 2 * i
                chance = LOG_CHANCE + math.log(
                    alike_places(border, self._places, panel.shape)
                )
                out.append(
                    Cause(border_name(border), (at, at + 1), GAP_WIDTHS_PX, chance)
                )
        first = len(layout.names)
        widths = tuple(w * self.noise for w in MOTION_WIDTHS)
        for name, own in motions.items():
            columns = tuple(range(first, first + own.shape[1]))
            out.append(Cause(name, columns, widths))
            first += own.shape[1]
        if self.repeating:
            columns = tuple(range(first, len(self.rows[0])))
            widths = tuple(w * self.noise for w in REPEATING_WIDTHS)
            out.append(Cause(REPEATING, columns, widths))
        out.append(Cause("priors", (), PRIOR_FACTORS, PRIOR_LOG_CHANCE))
        return tuple(out)

    @cached_property
    def _places(self) -> FloatArray:
        """Predicted column and row of each position that counts, (m, 2) [px]."""
        return self.problem.residuals(self.x)[0][self.use]

    def judged(self, choice: Choice) -> Judged | None:
        """Judge a choice, once (cached).

        Columns of causes that are chosen or always hold are free within their widths; the
        evidence includes the causes' probabilities.

        Args:
            choice: width of each cause, 0 if not chosen; the last is a factor on the
                priors.

        Returns:
            The judged model; None if its columns are not separable.
        """
        if choice not in self._judged:
            columns, widths, chance = self._model(choice)
            self._judged[choice] = self._judged_model(columns, widths, chance)
        return self._judged[choice]

    def _model(self, choice: Choice) -> tuple[list[int], FloatArray, float]:
        """Return the columns of a choice, the widths of their priors, and the logarithm of
        its probability.
        """
        factor = choice[-1] or 1.0
        columns = list(range(self.count))
        widths = [self.problem.prior_sigma[: self.count] * factor]
        chance = 0.0
        for cause, pick in zip(self.causes, choice, strict=True):
            width = pick or cause.always
            if cause.columns and width > 0:
                columns += cause.columns
                widths.append(width / self.visible[list(cause.columns)])
            if pick:
                chance += cause.chance - math.log(len(cause.widths))
        return columns, np.concatenate(widths), chance

    def _judged_model(
        self, columns: list[int], widths: FloatArray, chance: float
    ) -> Judged | None:
        """Judge free columns with priors, and add the logarithm of their probability to the
        evidence; None if they are not separable.
        """
        model = self.table.judged(columns, widths, self.noise, self.means[columns])
        if model is None:
            return None
        return replace(model, evidence=model.evidence + chance)

    def elsewhere(self, choice: Choice, beads: Sequence[int]) -> bool:
        """Check whether it is more likely that some beads alone are anywhere in the phantom
        than that all are off by the width of a choice.

        Args:
            choice: with the cause "beads".
            beads: indices.
        """
        at = next(i for i, cause in enumerate(self.causes) if cause.name == "beads")
        size = float(np.ptp(self.problem.model.beads, axis=0).max())
        every = self.causes[at].columns
        own = [every[3 * bead + axis] for bead in beads for axis in range(3)]
        columns, widths, chance = self._model(with_pick(choice, at, 0.0))
        free = dict(zip(columns, widths.tolist(), strict=True)) | dict.fromkeys(own, size)
        chance += LOG_CHANCE - math.log(math.comb(len(every) // 3, len(beads)))
        model = self._judged_model(list(free), np.array(list(free.values())), chance)
        return model is not None and model.evidence > self.evidence(choice)

    def evidence(self, choice: Choice) -> float:
        """Return the logarithm of a choice's probability, up to a constant; -inf if it
        cannot be judged.
        """
        model = self.judged(choice)
        if model is None:
            return -math.inf
        return model.evidence

    def best(self, more: Sequence[Choice] = ()) -> Choice:
        """Find the choice of causes and widths with the most evidence, by changing one
        cause at a time (`_climbed`).

        Starts are no cause, the three best single causes, and the best of `more`. If no
        single cause has a tenth of the probability of none, the result is no cause.

        Args:
            more: other choices, such as those with one cause in exchange for another.
        """
        nothing: Choice = (0.0,) * len(self.causes)
        singles = [
            with_pick(nothing, i, width)
            for i, cause in enumerate(self.causes)
            for width in cause.widths
        ]
        ranked = sorted(singles, key=self.evidence, reverse=True)
        tops: dict[int, Choice] = {}
        for single in ranked:
            tops.setdefault(int(np.flatnonzero(single)[0]), single)
        likely = [
            s
            for s in tops.values()
            if self.evidence(s) > self.evidence(nothing) - math.log(10.0)
        ]
        if not likely:
            return nothing
        starts = [nothing, *likely[:3]]
        if more:
            starts.append(max(more, key=self.evidence))
        return max((self._climbed(start) for start in starts), key=self.evidence)

    def _climbed(self, choice: Choice) -> Choice:
        """Climb from a choice, one cause after the other and all its widths, until none
        has more evidence; returns that choice.
        """
        while True:
            before = choice
            for i, cause in enumerate(self.causes):
                picks = [with_pick(choice, i, w) for w in (0.0, *cause.widths)]
                choice = max(picks, key=self.evidence)
            if choice == before:
                return choice

    def odds(self) -> dict[str, float]:
        """Compute the logarithm of the odds of each cause, present to absent, summed over
        all choices judged so far.

        Returns:
            Name -> log odds; inf or -inf where only one side was judged, nan if none was.
        """
        out = {}
        for i, cause in enumerate(self.causes):
            sides: list[list[float]] = [[], []]
            for choice, model in self._judged.items():
                if model is not None:
                    sides[bool(choice[i])].append(model.evidence)
            out[cause.name] = _total(sides[1]) - _total(sides[0])
        return out

    def fitted(self, choice: Choice) -> Judged:
        """Return the model of the fit with the causes of a choice but its motions and the
        errors of spots, which are no columns of it; that of the choice itself if the
        other was not judged.

        Args:
            choice: must be separable.
        """
        besides = [c.name.startswith((MOTION_OF, REPEATING)) for c in self.causes]
        still = tuple(0.0 if m else w for m, w in zip(besides, choice, strict=True))
        model = self.judged(still) or self.judged(choice)
        assert model is not None
        return model

    def likely(self, choice: Choice) -> dict[Choice, float]:
        """List all judged choices whose evidence is at most `MAX_EVIDENCE_LOSS` below the
        largest, and their probabilities, of sum 1.

        Choices with other widths of the priors than one are left out: statements on the
        scanner are believed where the images do not contradict them.

        Args:
            choice: the one.
        """
        evidence = {
            other: model.evidence
            for other, model in self._judged.items()
            if model is not None and other[-1] == choice[-1]
        }
        best = max(evidence.values())
        some = {
            other: math.exp(one - best)
            for other, one in evidence.items()
            if one > best - MAX_EVIDENCE_LOSS
        }
        total = sum(some.values())
        return {other: weight / total for other, weight in some.items()}

    def rivals(self, likely: Mapping[Choice, float], at: Judged) -> list[Rival]:
        """List what the geometry's columns are in likely choices, about the values of one
        model, internal units.

        Args:
            likely: choices and their probabilities.
            at: the model.
        """
        own = at.mean[: self.count]
        out = []
        for choice, weight in likely.items():
            model = self._judged[choice]
            assert model is not None
            off = model.mean[: self.count] - own
            out.append(Rival(weight, off, model.covariance(self.count)))
        return out

    def spoken_for(self, likely: Mapping[Choice, float]) -> list[FloatArray]:
        """List, for each cause that the images speak for and leave open, the probabilities
        of likely choices given that it is there, (choices,) of sum 1.

        Args:
            likely: choices and their probabilities.
        """
        weights = np.array(list(likely.values()))
        there = np.array(list(likely)) > 0
        out = []
        for cause, part in zip(self.causes, there.T, strict=True):
            share = float(weights[part].sum())
            if 0.0 < share < 1.0 and math.log(share / (1.0 - share)) > cause.chance:
                out.append(weights * part / share)
        return out

    @property
    def drawn(self) -> FloatArray:
        """(q,) standard deviations of what the columns are in scans without causes: those
        of priors, and of what always holds; 0 for all others.
        """
        out = np.zeros(len(self.means))
        widths = self.problem.prior_sigma[: self.count]
        out[: self.count] = np.where(np.isfinite(widths), widths, 0.0)
        for cause in self.causes:
            out[list(cause.columns)] = cause.always
        return out

    def correlated(self, choice: Choice) -> float:
        """Return the correlation length of the residuals that a choice leaves [frames]; 1
        if it cannot be judged.
        """
        model = self.judged(choice)
        if model is None:
            return 1.0
        left = np.zeros((*self.use.shape, 2))
        explained = self.rows[:, model.columns] @ model.mean
        left[self.use] = (self.values - explained).reshape(-1, 2)
        return correlation_length(left, self.use, self.problem.group)

    def strain(self, choice: Choice) -> tuple[FloatArray, FloatArray] | None:
        """Return the phantom's strain (10,) in a choice, in the order of STRAINS, and its
        covariance (10, 10); None if a stated strain is 0 or the choice cannot be judged.
        """
        at = self.judged(choice)
        if at is None or not min(self.known.strain) > 0:
            return None
        last = self.count + len(STRAINS)
        own = slice(self.count, last)
        return at.mean[own], at.covariance(last)[own, own]

    def width(self, choice: Choice, name: str) -> float:
        """Return the width of the named cause in a choice; 0 if it is not chosen or not a
        candidate.
        """
        return self.widths(choice).get(name, 0.0)

    def widths(self, choice: Choice) -> dict[str, float]:
        """Return the widths of a choice by the names of their causes, for other tables."""
        return dict(zip([c.name for c in self.causes], choice, strict=True))

    def choice(self, widths: Mapping[str, float]) -> Choice:
        """Return the choice of this table with given widths; 0 for causes not given."""
        return tuple(widths.get(c.name, 0.0) for c in self.causes)

    def with_last_border(self, widths: Mapping[str, float]) -> list[Choice]:
        """List the choices with given widths of other causes and each of the last border."""
        name = border_name(self.borders[-1])
        border = next(c for c in self.causes if c.name == name)
        return [self.choice({**widths, name: width}) for width in border.widths]

    def parts(self, choice: Choice) -> list[Choice]:
        """List a choice, and what it leaves without one of its causes."""
        parts = [with_pick(choice, i, 0.0) for i, pick in enumerate(choice) if pick]
        return [choice, *parts]

    def rank(self, choice: Choice) -> tuple[float, float]:
        """Return the evidence of a choice, and the odds of the last border, by which
        tables of one fit are compared.
        """
        return self.evidence(choice), self.odds()[border_name(self.borders[-1])]

    def chosen_borders(self, choice: Choice) -> tuple[Border, ...]:
        """Return the borders of panel tiles that a choice has."""
        return tuple(b for b in self.borders if self.width(choice, border_name(b)))

    def border(self, choice: Choice) -> Border | None:
        """Find a tile's border that a choice's residuals suggest; borders known already
        are not found again.

        Args:
            choice: width of each cause.

        Returns:
            None if no border is likely, the choice cannot be judged, or the images have
            several shapes.
        """
        model = self.judged(choice)
        shape = image_shape(self.problem)
        if model is None or shape is None:
            return None
        problem = self.problem
        widths = np.concatenate(
            [np.full(self.count, np.inf)]
            + [
                w / self.visible[list(c.columns)]
                for c, p in zip(self.causes, choice, strict=True)
                if c.columns and (w := p or c.always) > 0
            ]
        )
        widths[: self.count] = problem.prior_sigma[: self.count]
        return likely_border(
            self.rows[:, model.columns],
            self.values,
            widths,
            model.noise * math.sqrt(self.alike),
            self._places,
            problem.whiten[self.use],
            shape,
            self.borders,
        )


def _waves(frames: npt.NDArray[np.intp], count: int) -> FloatArray:
    """Make the shapes of a motion: a ramp, and one to `WAVES` - 1 half waves.

    Args:
        frames: of a scan, in their order.
        count: of all frames.

    Returns:
        (count, WAVES), 0 in the frames of other scans.
    """
    place = (np.arange(len(frames)) + 0.5) / len(frames)
    out = np.zeros((count, WAVES))
    out[frames] = np.cos(math.pi * place[:, None] * np.arange(WAVES))
    out[frames, 0] = place - 0.5
    return out


def _arc(column: int, share: float | None) -> list[Cause]:
    """Make the cause that the object turns while a frame is exposed.

    Args:
        column: of the squared share of a step.
        share: of a step, by the script; None: not stated.

    Returns:
        One cause; more probable before the scan, and narrow, if stated. Empty for a share
        of 0.
    """
    if share is None:
        return [Cause("arc", (column,), (ARC_PRIOR,))]
    if share == 0.0:
        return []
    return [Cause("arc", (column,), (ARC_TOLERANCE * share**2,), STATED_LOG_CHANCE)]


def explained_by_causes(
    fit: FitResult, known: Known, refit: Refit, left_out: Sequence[int] = ()
) -> tuple[FitResult, Found]:
    """Fit with the most likely causes as columns, and average sigmas over those left
    open.

    Causes, up to `MOST_BORDERS` borders between panel tiles among them, are searched
    again after each new fit, until they stay the same or for `MOST_ROUNDS`. Residuals that
    a fit, and what moves, leave correlated from frame to frame count by their correlation
    length, so that slow errors are no evidence of slow causes.

    Args:
        fit: of the geometry, the phantom's strain with its prior.
        known: statements on the phantom and the positions.
        refit: fits again with `strain`, `arc`, `rows`, `bead_tolerance_mm` and `panel`.
        left_out: beads that are elsewhere; where some turn out to be, the causes of the
            other beads' residuals are searched anew.

    Returns:
        The new fit and the causes that were found; as `_undetermined` says if a fit with
        them is not identifiable; `fit` with the odds, and `Found.beside_motion`, if the
        object moves and more than `MAX_REST_SHARE` of the residuals is left.
    """
    first = fit
    borders: tuple[Border, ...] = ()
    applied: tuple[object, ...] = ()
    before: Mapping[str, float] = {}
    # Before a cause is fitted, it correlates the residuals itself.
    alike = 1.0
    for _ in range(MOST_ROUNDS):
        candidates, choice = _searched(fit, known, borders, alike, before, left_out)
        before = candidates.widths(choice)
        borders = candidates.chosen_borders(choice)
        options = _options(candidates, choice, borders)
        chosen = tuple(options.values())
        settled = chosen == applied or not (applied or any(chosen))
        # What moves is no column of the fit, and correlates its residuals itself.
        moves = any(pick for name, pick in before.items() if name.startswith(MOTION_OF))
        beside = candidates.correlated(choice) if moves else None
        if settled and alike == (beside or fit.certificate.enlargement):
            break
        if not settled:
            applied = chosen
            better = refit(**options)
            if not better.identifiable:
                return _undetermined(first, better, candidates, choice)
            fit = better
        alike = beside or fit.certificate.enlargement
    odds = candidates.odds()
    # What moves looks like other causes in part, and most of it stays in the residuals.
    if moves and fit.certificate.rms_px > MAX_REST_SHARE * first.certificate.rms_px:
        likely = None
        if names := _applied(candidates, choice):
            likely = (fit, Found(odds, names, (), candidates.strain(choice)))
        whole = Found(odds, beside_motion=likely)
        return _widened(first, candidates, motions_alone(candidates, choice)), whole
    names = _applied(candidates, choice)
    doubtful = tuple(
        n
        for n, o in odds.items()
        if -OPEN_LOG_ODDS < o < NAMED_LOG_ODDS and not n.startswith(RIVALS)
    )
    lost = lost_beads(first)
    elsewhere = (
        "beads" in names
        and not left_out
        and 0 < len(lost) <= len(first.problem.model) - LEAST_BEADS
        and candidates.elsewhere(choice, lost)
    )
    if elsewhere:
        return explained_by_causes(first, known, refit, lost)
    found = Found(odds, names, doubtful, candidates.strain(choice))
    return _widened(fit, candidates, choice), found


def motions_alone(candidates: Candidates, choice: Choice) -> Choice:
    """Return a choice without its other causes, if something moves in it."""
    alone = tuple(
        pick if c.name.startswith(MOTION_OF) else 0.0
        for c, pick in zip(candidates.causes, choice, strict=True)
    )
    return alone if any(alone) else choice


def _applied(candidates: Candidates, choice: Choice) -> tuple[str, ...]:
    """Name the causes of a choice that are columns of its fit."""
    return tuple(
        c.name
        for c, pick in zip(candidates.causes, choice, strict=True)
        if pick and not c.name.startswith(RIVALS)
    )


def _undetermined(
    first: FitResult, better: FitResult, candidates: Candidates, choice: Choice
) -> tuple[FitResult, Found]:
    """Choose what is stated where the images do not determine the geometry beside the most
    likely causes.

    Args:
        first: fit without causes.
        better: fit with those of `choice`, not identifiable.
        candidates: all causes, judged.
        choice: the most likely one.

    Returns:
        `better` with its causes if they are beyond doubt: no geometry can be offered then.
        Else `first`, wider by what the causes leave open, and the odds.
    """
    nothing = (0.0,) * len(choice)
    odds = candidates.odds()
    if candidates.evidence(choice) - candidates.evidence(nothing) > NAMED_LOG_ODDS:
        return better, Found(
            odds, _applied(candidates, choice), (), candidates.strain(choice)
        )
    return _widened(first, candidates, nothing), Found(odds)


def _searched(
    fit: FitResult,
    known: Known,
    borders: tuple[Border, ...],
    alike: float,
    before: Mapping[str, float],
    left_out: Sequence[int],
) -> tuple[Candidates, Choice]:
    """Find the most likely causes, borders of the panel's tiles among them.

    A border is looked for in what the most likely causes leave of the residuals, and in
    what they leave without one of them: places of beads that keep their rows in all
    frames explain a border along rows completely, and step by step the border does not
    take their place. The search ends with the first border
    that is not chosen. That border stays in the table if it is open.

    Args:
        fit: of the geometry.
        known: statements on the phantom and the positions.
        borders: found before.
        alike: number of neighbouring frames whose residuals count as one.
        before: width of each cause of the fit, from which the search starts, too.
        left_out: beads that are elsewhere.

    Returns:
        The table, with at most `MOST_BORDERS` borders, and its most likely choice.
    """
    problem = fit.problem
    x = fit.solution.x
    candidates = Candidates(problem, x, known, borders, alike, left_out)
    choice = candidates.best([candidates.choice(before)])
    # Only what is taken for another cause has to be told from errors of the spots.
    if _applied(candidates, choice) and len(problem.group) >= REPEATING_FRAMES:
        widths = candidates.widths(choice)
        candidates = Candidates(problem, x, known, borders, alike, left_out, True)
        choice = candidates.best([candidates.choice(widths)])
    while len(candidates.borders) < MOST_BORDERS:
        found: dict[Border, list[Choice]] = {}
        for part in candidates.parts(choice):
            border = candidates.border(part)
            if border is not None:
                found.setdefault(border, []).append(part)
        some = []
        for border, parts in found.items():
            every = (*candidates.borders, border)
            table = Candidates(
                problem, x, known, every, alike, left_out, candidates.repeating
            )
            more = [
                other
                for part in parts
                for other in table.with_last_border(candidates.widths(part))
            ]
            some.append((table, table.best(more)))
        if not some:
            break
        wider, chosen = max(some, key=lambda one: one[0].rank(one[1]))
        name = border_name(wider.borders[-1])
        if wider.width(chosen, name) or wider.odds()[name] > -OPEN_LOG_ODDS:
            candidates = wider
            choice = chosen
        if not wider.width(chosen, name):
            break
    return candidates, choice


def _widened(fit: FitResult, candidates: Candidates, choice: Choice) -> FitResult:
    """Add the differences between likely choices to the covariance of a fit; never
    narrows it.

    Where the images speak for a cause, the mean square is no less than that with it: how
    probable it is without them is assumed, and may be wrong.

    Args:
        fit: with the causes of `choice`.
        candidates: all causes, judged.
        choice: the most likely one.

    Returns:
        The fit with a wider certificate; itself if the choices agree.
    """
    own, more, likely, wider = left_open(candidates, choice)
    if len(likely) == 1 and own is candidates.judged(next(iter(likely))):
        return fit
    factor = edge_factors(fit.problem.layout.names[: candidates.count])
    unit = np.outer(factor, factor)
    certificate = fit.certificate
    apart = tuple(
        Rival(
            rival.weight,
            rival.off * factor,
            _changed(certificate.covariance, rival.covariance * unit + wider),
        )
        for rival in candidates.rivals(likely, own)
    )
    return replace(fit, certificate=replace(widened(certificate, more), rivals=apart))


def left_open(
    candidates: Candidates, choice: Choice
) -> tuple[Judged, FloatArray, dict[Choice, float], FloatArray]:
    """Compute what likely choices add to the covariance of the fit with the causes of one.

    Args:
        candidates: all causes, judged.
        choice: the most likely one.

    Returns:
        The model of the fit; the addition, (p, p), edge units; likely choices and their
        probabilities; and the change of the covariance of each choice, (p, p), edge units.
    """
    likely = candidates.likely(choice)
    own = candidates.fitted(choice)
    at = own.covariance(candidates.count)
    factor = edge_factors(candidates.problem.layout.names[: candidates.count])
    unit = np.outer(factor, factor)
    rivals = candidates.rivals(likely, own)
    square = np.array([r.covariance + np.outer(r.off, r.off) for r in rivals])
    mean = np.tensordot(list(likely.values()), square, 1)
    wide = mean
    for given in candidates.spoken_for(likely):
        wide = larger(wide, np.tensordot(given, square, 1))
    values, vectors = np.linalg.eigh((wide - at) * unit)
    more = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return own, more, likely, (wide - mean - at) * unit


def _changed(covariance: FloatArray, change: FloatArray) -> FloatArray:
    """Add a change, (p, p), to a covariance (p, p), of which at least `LEAST_REST` is left
    in every direction.
    """
    size = np.sqrt(np.diag(covariance))
    # Of exact positions it is the priors' alone and of lower rank.
    scaled = covariance / np.outer(size, size) + LEAST_RANK * np.eye(len(size))
    root = np.linalg.cholesky(scaled) * size[:, None]
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ change @ inverse.T)
    whole = root @ vectors
    return np.asarray((whole * np.maximum(1.0 + values, LEAST_REST)) @ whole.T)


def _options(
    candidates: Candidates, choice: Choice, borders: Sequence[Border]
) -> dict[str, object]:
    """Make the options of the refit for a choice; falsy where nothing changes.

    Args:
        candidates: the table.
        choice: width of each cause.
        borders: of tiles.

    Returns:
        `strain` (None if it is as stated before), `arc` and `rows` (bool),
        `bead_tolerance_mm` (None if not chosen) and `panel` (None without bends and borders,
        or where images differ in shape).
    """
    stated = candidates.known.strain
    strain = tuple(
        candidates.width(choice, n) or w for n, w in zip(SHAPES, stated, strict=True)
    )
    beads = candidates.width(choice, "beads")
    bent = candidates.width(choice, "panel")
    shape = image_shape(candidates.problem)
    panel = None
    if shape is not None and (bent or borders):
        panel = PanelModel(bent or NO_PANEL_PX, shape, tuple(borders))
    return {
        "strain": None if strain == stated else strain,
        "arc": bool(candidates.width(choice, "arc")),
        "rows": bool(candidates.width(choice, "rows")),
        "bead_tolerance_mm": beads or None,
        "panel": panel,
    }


def lost_beads(fit: FitResult) -> list[int]:
    """List the beads that are seen in three frames at least and that a fit left out of more
    than half of them.
    """
    seen = fit.problem.seen.sum(axis=0)
    used = fit.certificate.used.sum(axis=0)
    return np.flatnonzero((seen >= 3) & (used < 0.5 * seen)).tolist()


def image_shape(problem: FitProblem) -> tuple[int, int] | None:
    """Return (rows, cols) of the images; None where frames differ."""
    sizes = np.unique(2 * problem.origin + 1, axis=0)
    if len(sizes) == 1:
        return (int(sizes[0, 1]), int(sizes[0, 0]))
    return None


def panel_of(problem: FitProblem, borders: Sequence[Border]) -> PanelModel | None:
    """Make a panel model with every term that a distortion may have, of width 1 px, and
    the given borders; None for images of several shapes.
    """
    shape = image_shape(problem)
    if shape is None:
        return None
    return PanelModel(1.0, shape, tuple(borders))


def border_name(border: Border) -> str:
    """Name the cause that a tile begins at a border."""
    return f"tile from {('column', 'row')[border.axis]} {border.at:.0f}"


def with_pick(choice: Choice, i: int, pick: float) -> Choice:
    """Return a choice with another width of one cause."""
    return (*choice[:i], pick, *choice[i + 1 :])


def _total(evidence: Sequence[float]) -> float:
    """Compute the logarithm of a sum of probabilities from their logarithms, without
    overflow; -inf without any.
    """
    if not evidence:
        return -math.inf
    top = max(evidence)
    return top + math.log(sum(math.exp(e - top) for e in evidence))


def _with_every_column(
    problem: FitProblem, x: FloatArray, panel: PanelModel | None
) -> tuple[FitProblem, FloatArray]:
    """Add a column for every cause to a problem.

    Layout: the fit's parameters, beads, strain, arc, rows, panel; all beads are free.

    Args:
        problem: of the fit; not changed.
        x: (c,) its column values.
        panel: terms of distortion, or None.

    Returns:
        The problem, and values of all columns: those of the fit, and the problem's start
        for those that it does not have.
    """
    old = problem.layout
    count = old.parameter_count
    k = len(problem.model)
    terms = () if panel is None else panel.names
    names = [
        *old.names[:count],
        *(f"bead {b} {axis}" for b in range(k) for axis in "xyz"),
        *(f"strain {term}" for term in STRAINS),
        "arc",
        "rows",
        *(f"panel {term}" for term in terms),
    ]
    strain = count + 3 * k
    arc = strain + len(STRAINS)
    layout = ColumnLayout(
        tuple(names),
        old.asked,
        old.colmap,
        count,
        strain,
        arc,
        arc + 1,
        count,
        arc + 2,
        old.active,
        old.held,
    )
    base = problem.spread(x)[0]
    rows = problem.measured[..., 1] / (2.0 * problem.origin[:, None, 1] + 1.0)
    whole = replace(
        problem,
        layout=layout,
        panel=panel,
        base=base,
        turning=turning_shifts(
            problem.poses, problem.model, base, problem.group, problem.reading, rows
        ),
    )
    there = whole.start
    places = {name: i for i, name in enumerate(names)}
    for name, value in zip(old.names, x.tolist(), strict=True):
        if name in places:
            there[places[name]] = value
    return whole, there
