"""Candidates: the table of a fit's columns and those of every cause, judged by evidence."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import Final

import numpy as np

from flexdt.twin.calibration.diagnose.causes.cause import (
    MOTION_OF,
    REPEATING,
    TOLD,
    Choice,
    Known,
    border_name,
    with_pick,
)
from flexdt.twin.calibration.diagnose.causes.columns import (
    coordinates,
    image_shape,
    motion_columns,
    panel_of,
    repeating_columns,
    told_columns,
    visible_shares,
    with_every_column,
)
from flexdt.twin.calibration.diagnose.causes.every_cause import list_causes
from flexdt.twin.calibration.diagnose.tiles import alike_places, likely_border
from flexdt.twin.calibration.fit.certificate import Rival
from flexdt.twin.calibration.fit.evidence import LOG_CHANCE, OPEN_LOG_ODDS, Judged, Table
from flexdt.twin.calibration.fit.fit import RAYLEIGH_MEDIAN
from flexdt.twin.calibration.fit.problem import STRAINS, FitProblem
from flexdt.twin.calibration.fit.residual_structure import correlation_length
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.panel import Border, PanelModel

OUTLIER_SIGMAS: Final = 5.0
"""Robust standard deviations at which residuals are clipped."""
MOST_STRAINED: Final = 4
"""Number of beads of which every displacement is an affine map, of twelve numbers."""
MAX_EVIDENCE_LOSS: Final = 12.0
"""Logarithm of the evidence ratio beyond which models have no weight."""


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
        everything, there = with_every_column(problem, x, panel_of(problem, borders))
        rows = everything.jacobian(there, self.use)[np.repeat(self.use.ravel(), 2)]
        left = problem.whitened(x)[self.use]
        lengths = np.linalg.norm(left, axis=1)
        self.noise = usual_noise(lengths, known.floor)
        self.share = np.repeat(clipped(lengths, self.noise), 2)
        motions = motion_columns(problem, x, self.use)
        waves = [repeating_columns(problem, self.use)] if repeating else []
        told = told_columns(problem)
        again = [rows[:, [problem.layout.names.index(name) for name in told]]]
        table = np.concatenate([rows, *motions.values(), *waves, *again], axis=1)
        causes = there - everything.start
        causes[: self.count] = 0.0
        values = left.ravel() + rows @ causes
        self.rows = table * self.share[:, None]
        self.values = values * self.share
        self.table = Table(self.rows, self.values, known.floor, alike)
        first = rows.shape[1]
        last = first + sum(own.shape[1] for own in motions.values())
        own_prior = (self.noise / problem.prior_sigma[: self.count]) ** 2 / alike
        self.visible = visible_shares(self.table.gram, own_prior, first, last)
        self.causes = list_causes(
            everything,
            known,
            self.noise,
            motions,
            sum(wave.shape[1] for wave in waves),
            self._border_chances(everything.panel),
            told,
        )
        self._judged: dict[Choice, Judged | None] = {}
        self.means = np.zeros(table.shape[1])
        self.means[: self.count] = (problem.prior_mean - x)[: self.count]
        if known.arc_left is None:
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

    @cached_property
    def _places(self) -> FloatArray:
        """Predicted column and row of each position that counts, (m, 2) [px]."""
        return self.problem.residuals(self.x)[0][self.use]

    def _border_chances(self, panel: PanelModel | None) -> list[float]:
        """Compute the logarithm of each border's probability before the scan is seen; empty
        without a panel.
        """
        if panel is None:
            return []
        return [
            LOG_CHANCE + math.log(alike_places(border, self._places, panel.shape))
            for border in panel.borders
        ]

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
            columns, widths = self.columns_of(choice)
            chance = self._chance(choice)
            self._judged[choice] = self._judged_model(columns, widths, chance)
        return self._judged[choice]

    def columns_of(self, choice: Choice) -> tuple[list[int], FloatArray]:
        """Return the columns of a choice, those of the geometry and of what always holds
        among them, and the widths of their priors.
        """
        columns = list(range(self.count))
        widths = [self.problem.prior_sigma[: self.count] * (choice[-1] or 1.0)]
        for cause, pick in zip(self.causes, choice, strict=True):
            width = pick or cause.always
            if cause.columns and width > 0:
                columns += cause.columns
                widths.append(width / self.visible[list(cause.columns)])
        return columns, np.concatenate(widths)

    def _chance(self, choice: Choice) -> float:
        """Return the logarithm of the probability of a choice before the scan is seen."""
        return sum(
            cause.chance - math.log(len(cause.widths))
            for cause, pick in zip(self.causes, choice, strict=True)
            if pick
        )

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
        own = [every[i] for i in coordinates(beads).tolist()]
        still = with_pick(choice, at, 0.0)
        columns, widths = self.columns_of(still)
        free = dict(zip(columns, widths.tolist(), strict=True)) | dict.fromkeys(own, size)
        chance = LOG_CHANCE - math.log(math.comb(len(every) // 3, len(beads)))
        chance += self._chance(still)
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

    def with_open_places(self, choice: Choice) -> Choice:
        """Return a choice with the places of beads as wide as the images leave them open:
        the largest width that they speak against by odds of `OPEN_LOG_ODDS` at most, and
        the phantom's tolerance if that is less.

        No phantom has its beads exactly in their places, and of three or four any
        displacement is a strain: how far they are off is hardly in the images. More beads
        tell it.

        Args:
            choice: separable; returned as it is where the request states the tolerance,
                places are no cause, or there are more than `MOST_STRAINED` beads.
        """
        at = next((i for i, c in enumerate(self.causes) if c.name == "beads"), None)
        if at is None or self.known.bead_tolerance_mm is not None:
            return choice
        if len(self.problem.model) > MOST_STRAINED:
            return choice
        cause = self.causes[at]
        said = {w: self.evidence(with_pick(choice, at, w)) for w in cause.widths}
        # What is assumed of this cause before the scan does not count.
        before = cause.chance - math.log(len(cause.widths))
        said[0.0] = self.evidence(with_pick(choice, at, 0.0)) + before
        least = max(said.values()) - OPEN_LOG_ODDS
        widest = max(width for width, evidence in said.items() if evidence >= least)
        limit = self.problem.model.tolerance_mm or math.inf
        return with_pick(choice, at, max(choice[at], min(widest, limit)))

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
        besides = [c.name.startswith((MOTION_OF, REPEATING, TOLD)) for c in self.causes]
        still = tuple(0.0 if m else w for m, w in zip(besides, choice, strict=True))
        model = self.judged(still) or self.judged(choice)
        assert model is not None
        return model

    def likely(self, choice: Choice) -> dict[Choice, float]:
        """List all judged choices whose evidence is at most `MAX_EVIDENCE_LOSS` below the
        largest, and their probabilities, of sum 1; all with places of beads as wide as
        the choice leaves them open (`with_open_places`), if that is wider.

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
        likely = _probabilities(evidence)
        whole = self.with_open_places(choice)
        if whole == choice:
            return likely
        at = next(i for i, c in enumerate(self.causes) if c.name == "beads")
        opened = {with_pick(other, at, whole[at]) for other in likely}
        return _probabilities({other: self.evidence(other) for other in opened})

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
        """Return the phantom's strain (9,) in a choice, in the order of STRAINS, and its
        covariance (9, 9); None if a stated strain is 0 or the choice cannot be judged.
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
        # Priors are as stated, also where the choice widens them.
        widths = self.columns_of((*choice[:-1], 0.0))[1]
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


def usual_noise(lengths: FloatArray, floor: float) -> float:
    """Estimate the standard deviation of whitened residuals from their lengths, `floor` at
    least.
    """
    return max(float(np.median(lengths)) / RAYLEIGH_MEDIAN, floor)


def clipped(lengths: FloatArray, noise: float) -> FloatArray:
    """Return the weights of residuals by their lengths: 1 up to `OUTLIER_SIGMAS`."""
    return np.minimum(1.0, OUTLIER_SIGMAS * noise / np.maximum(lengths, 1e-12))


def _probabilities(evidence: Mapping[Choice, float]) -> dict[Choice, float]:
    """Compute the probabilities, of sum 1, of the choices whose evidence is at most
    `MAX_EVIDENCE_LOSS` below the largest.
    """
    best = max(evidence.values())
    some = {
        choice: math.exp(one - best)
        for choice, one in evidence.items()
        if one > best - MAX_EVIDENCE_LOSS
    }
    total = sum(some.values())
    return {choice: weight / total for choice, weight in some.items()}


def _total(evidence: Sequence[float]) -> float:
    """Compute the logarithm of a sum of probabilities from their logarithms, without
    overflow; -inf without any.
    """
    if not evidence:
        return -math.inf
    top = max(evidence)
    return top + math.log(sum(math.exp(e - top) for e in evidence))
