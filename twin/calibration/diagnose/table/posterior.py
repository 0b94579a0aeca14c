"""The posterior of a table: which groups are there, how wide, and what the geometry is.

A model is a set of groups, each with the width that makes the residuals most likely. Its evidence
has all weights integrated out. What a further group would add is computed for a grid of widths
at once, from the eigenvalues of its columns beside those of the model, with the noise integrated
out (Student's form: the residuals' squares to the power of their number). The posterior is the
mixture of the best model and of it with one group more, one less, or one exchanged.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from scipy.linalg import eigh, lapack

from flexdt.twin.calibration.diagnose.table.group import OPEN_LOG_ODDS, Family
from flexdt.twin.calibration.diagnose.table.linearised import Linearised
from flexdt.twin.calibration.diagnose.table.products import Products
from flexdt.twin.calibration.fit.certificate import SPREAD_FREEDOM
from flexdt.twin.geometry.conventions import FloatArray

GRID: Final = 10.0 ** np.arange(-1.0, 3.6, 0.5)
"""Widths of a group that are tried, in standard deviations of a position."""
OCCAM: Final = 1.3 - math.log(len(GRID))
"""Logarithm of the part of the grid that a peak of the evidence covers."""
FACTORS: Final = ((1.0, 0.0), (3.0, math.log(1e-3)), (10.0, math.log(1e-3)))
"""Factors on the priors' widths, and the logarithm of their odds before the scan; assumed."""
MOST_GROUPS: Final = 8
MOST_ROUNDS: Final = 14
MOST_PASSES: Final = 25
SETTLED: Final = 0.05
"""Change of the logarithm of widths and noise at which they are found."""
LEAST_LOG_WEIGHT: Final = -9.0
"""Logarithm of the weight of a model, against the best, from which it counts."""
OPEN_GAIN: Final = -50.0
"""Evidence of widths that a group cannot have."""
ROUNDING: Final = 1e-9
"""Part of a column's length that is left of it, below which it is rounding."""

Group = tuple[int, int]
"""A group of a table: number of its family, and its own in that."""


class Solved(NamedTuple):
    """Weights of a model.

    Attributes:
        mean: (p,) of all its columns.
        covariance: (p, p).
        rest: squares of the residuals that they leave.
        log_volume: logarithm of the determinant of the precision, and the priors' part.
        moved: squares of the weights in their priors' widths.
    """

    mean: FloatArray
    covariance: FloatArray
    rest: float
    log_volume: float
    moved: float


@dataclass(frozen=True, eq=False)
class Model:
    """Groups with their widths, and what follows.

    Attributes:
        widths: group -> variance of its weights [squares of whitened units].
        noise2: variance of the whitened residuals.
        factor: on the priors' widths, of FACTORS.
        solved: its weights.
        evidence: logarithm, with the odds of its groups.
    """

    widths: Mapping[Group, float]
    noise2: float
    factor: int
    solved: Solved
    evidence: float


@dataclass(frozen=True, eq=False)
class Part:
    """One explanation of a mixture.

    Attributes:
        weight: its probability.
        widths: variance of the weights of each group that is there.
        mean, covariance: of the geometry's columns.
    """

    weight: float
    widths: Mapping[Group, float]
    mean: FloatArray
    covariance: FloatArray

    @property
    def groups(self) -> frozenset[Group]:
        """The groups that are there."""
        return frozenset(self.widths)


@dataclass(frozen=True, eq=False)
class Posterior:
    """What a table says.

    Attributes:
        best: the most probable model.
        parts: explanations, of weights of sum 1, the first that of `best`.
        families: of the groups.
    """

    best: Model
    parts: tuple[Part, ...]
    families: tuple[Family, ...]
    units: tuple[FloatArray, ...] = field(repr=False)

    def odds(self, groups: Iterable[Group]) -> float:
        """Return the logarithm of the odds that one of some groups is there."""
        some = frozenset(groups)
        there = sum(p.weight for p in self.parts if p.groups & some)
        return _log_odds(there)

    def cause_odds(self, *causes: str) -> float:
        """Return the logarithm of the odds that one of some causes is there."""
        there = sum(
            p.weight
            for p in self.parts
            if any(self.families[f].cause in causes for f, _ in p.groups)
        )
        return _log_odds(there)

    def name(self, group: Group) -> str:
        """Return the name of a group."""
        return self.families[group[0]].names[group[1]]


def _log_odds(there: float) -> float:
    away = max(1.0 - there, 1e-300)
    return math.log(max(there, 1e-300)) - math.log(away)


class Search:
    """Search of a table for the most probable model, and the mixture about it."""

    def __init__(
        self,
        table: Linearised,
        families: Sequence[Family],
        spread: float,
        values: FloatArray | None = None,
    ) -> None:
        """Prepare the products of a table.

        Args:
            table: of the fit.
            families: of all groups.
            spread: of the whitened residuals, expected before they are seen; 0: nothing is
                expected.
            values: (2 n k, d) that are to be explained, weighted, one after another (`draw`);
                None: those of the table.
        """
        self.table = table
        every = table.values[:, None] if values is None else values
        self.products = Products(table, families)
        self.free = [i for i, f in enumerate(families) if not f.always]
        self.spread = spread
        self.freedom = SPREAD_FREEDOM if spread > 0 else 0.0
        columns = [table.geometry]
        precision = [table.precision]
        self.always: list[tuple[int, slice]] = []
        at = table.parameters
        for i, f in enumerate(families):
            if not f.always:
                continue
            for g in range(len(f.names)):
                rows = self.products.rows(i, g)
                columns.append(rows)
                precision.append(np.full(rows.shape[1], f.always**-2.0))
                self.always.append((i, slice(at, at + rows.shape[1])))
                at += rows.shape[1]
        base = np.concatenate(columns, axis=1)
        self.base_count = base.shape[1]
        self.base_precision = np.concatenate(precision)
        self.base_mean = np.concatenate(
            [
                np.where(table.precision > 0, table.mean, 0.0),
                np.zeros(at - table.parameters),
            ]
        )
        self.base = self.products.block(np.column_stack([base, every]))
        self.draws = every.shape[1]
        self._totals = np.einsum("md,md->d", every, every)
        self.held: set[Group] = set()
        self._shapes: dict[int, tuple[FloatArray, FloatArray]] | None = None
        self.draw(0)
        self._gram: dict[tuple[int, int], FloatArray] = {}

    def draw(self, number: int) -> None:
        """Take the values of a number as those that are to be explained."""
        self.value = self.base_count + number
        self.total = float(self._totals[number])
        # Exact positions have residuals of rounding.
        self.least = 1e-12 * self.total + 1e-300
        self._squares: dict[tuple[Group, ...], tuple[FloatArray, FloatArray]] = {}

    def chance(self, group: Group) -> float:
        """Return the log odds of a group before the scan, with its width's share of the grid."""
        return float(self.products.families[group[0]].chances[group[1]]) + OCCAM

    def _between(self, one: int, other: int) -> FloatArray:
        """Return the products of two blocks, made once."""
        if one > other:
            return self._between(other, one).T
        if (one, other) not in self._gram:
            columns = self.products.columns
            self._gram[one, other] = columns(one).T @ columns(other)
        return self._gram[one, other]

    def _normal(self, groups: tuple[Group, ...]) -> tuple[FloatArray, FloatArray]:
        """Return products of the columns of a model, (p, p), and with the values, (p,)."""
        if groups not in self._squares:
            blocks = [self.base, *(self.products.group_block(*g) for g in groups)]
            whole = np.block([[self._between(a, b) for b in blocks] for a in blocks])
            keep = self._kept(len(whole))
            self._squares[groups] = whole[np.ix_(keep, keep)], whole[keep, self.value]
        return self._squares[groups]

    def columns(self, model: Model) -> FloatArray:
        """Return the columns of a model, (2 n k, p), as those of its weights."""
        groups = [self.products.group_block(*g) for g in model.widths]
        base = self.products.columns(self.base)[:, : self.base_count]
        return np.concatenate([base, *map(self.products.columns, groups)], axis=1)

    def _kept(self, count: int) -> list[int]:
        """List the columns of some blocks, the base's first, that are no values."""
        last = self.base_count + self.draws
        return [*range(self.base_count), *range(last, count)]

    def solve(self, widths: Mapping[Group, float], noise2: float, factor: int) -> Solved:
        """Solve a model for its weights.

        Args:
            widths: variance of the weights of each group.
            noise2: variance of the whitened residuals.
            factor: on the geometry's priors, of FACTORS.
        """
        groups = tuple(widths)
        gram, push = self._normal(groups)
        precision = self.base_precision.copy()
        precision[: self.table.parameters] /= FACTORS[factor][0] ** 2
        more = [
            np.full(self.products.own(f).shape[1], 1.0 / widths[f, g]) for f, g in groups
        ]
        precision = np.concatenate([precision, *more])
        about = np.concatenate([self.base_mean, np.zeros(len(push) - self.base_count)])
        whole = gram / noise2
        whole.flat[:: len(push) + 1] += precision
        right = push / noise2 + precision * about
        scale = 1.0 / np.sqrt(np.maximum(np.diag(whole), 1e-300))
        factored, failed = lapack.dpotrf(whole * np.outer(scale, scale), lower=0)
        if failed:
            whole.flat[:: len(push) + 1] *= 1.0 + 1e-10
            factored = np.linalg.cholesky(whole * np.outer(scale, scale)).T
        inverse, _ = lapack.dpotri(np.array(factored, order="F"), lower=0)
        inverse = np.triu(inverse) + np.triu(inverse, 1).T
        covariance = inverse * np.outer(scale, scale)
        mean = covariance @ right
        rest = self.total - 2.0 * float(mean @ push) + float(mean @ gram @ mean)
        volume = 2.0 * float(np.log(np.diag(factored) / scale).sum())
        stated = precision > 0
        volume -= float(np.log(precision[stated]).sum())
        moved = float((precision * (mean - about) ** 2).sum())
        return Solved(mean, covariance, max(rest, self.least), volume, moved)

    def _evidence(self, solved: Solved, noise2: float) -> float:
        square = solved.rest / noise2 + solved.moved + solved.log_volume
        expected = math.log(noise2) + self.spread**2 / noise2
        return -0.5 * (
            self.table.count * math.log(noise2) + square + self.freedom * expected
        )

    def model(
        self, widths: Mapping[Group, float], noise2: float, factor: int = 0
    ) -> Model:
        """Find the widths and the noise that make a set of groups most likely.

        The steps are MacKay's (Neural Computation 4 (1992) 415): a width is that of the
        weights that the images determine.

        Args:
            widths: from which the search starts.
            noise2: the same.
            factor: on the priors, of FACTORS.
        """
        found = dict(widths)
        solved = self.solve(found, noise2, factor)
        for _ in range(MOST_PASSES):
            before = [noise2, *found.values()]
            diagonal = np.diag(solved.covariance)
            at = self.base_count
            precision = self.base_precision.copy()
            precision[: self.table.parameters] /= FACTORS[factor][0] ** 2
            told = at - float((diagonal[:at] * precision).sum())
            for group in found:
                f, g = group
                count = self.products.own(f).shape[1]
                own = slice(at, at + count)
                if group in self.held:
                    at += count
                    continue
                seen = count - float(diagonal[own].sum()) / found[group]
                told += seen
                mean = solved.mean[own]
                fresh = float(mean @ mean) / max(seen, 1e-6)
                most = float(self.products.widest(f)[g]) ** 2
                found[group] = min(max(fresh, 1e-10 * noise2), most)
                at += count
            noise2 = (solved.rest + self.freedom * self.spread**2) / max(
                self.table.count - told + self.freedom, 1.0
            )
            noise2 = max(noise2, self.least)
            solved = self.solve(found, noise2, factor)
            after = [noise2, *found.values()]
            if all(
                abs(math.log(a / b)) < SETTLED for a, b in zip(after, before, strict=True)
            ):
                break
        return self._judged(found, noise2, factor, solved)

    def _judged(
        self, widths: dict[Group, float], noise2: float, factor: int, solved: Solved
    ) -> Model:
        """Make a model, with its evidence; that groups are held open is no question."""
        evidence = self._evidence(solved, noise2) + FACTORS[factor][1]
        evidence += sum(self.chance(group) for group in widths if group not in self.held)
        return Model(widths, noise2, factor, solved, evidence)

    def further(self, model: Model, *, pinned: bool = False) -> dict[int, Further]:
        """Compute what each further group would add to the evidence, by its width.

        Args:
            model: to which it is added.
            pinned: the model's noise is that of all that are compared; else it is integrated
                out.

        Returns:
            Family -> the gains of its groups.
        """
        groups = tuple(model.widths)
        blocks = [self.base, *(self.products.group_block(*g) for g in groups)]
        solved = model.solved
        noise2 = model.noise2
        left = solved.rest + self.freedom * self.spread**2 + noise2 * solved.moved
        count = self.table.count + self.freedom - self.table.parameters
        grid2 = GRID**2
        out = {}
        for f in self.free:
            crossed = np.concatenate([self.products.cross(f, b) for b in blocks], axis=2)
            push = crossed[:, :, self.value]
            crossed = crossed[:, :, self._kept(crossed.shape[2])]
            own = self.products.own(f)
            taken = crossed @ solved.covariance
            rest = push - crossed @ solved.mean
            values, vectors = self._spectrum(f, own, taken, crossed, noise2)
            most = np.maximum(values.max(axis=1), 0.0)
            trace = np.einsum("gcc->g", own)
            least = np.maximum(1e-6 * most, ROUNDING * trace)[:, None]
            turned = np.einsum("gcd,gc->gd", vectors, rest)
            told = values > least
            values = np.where(told, values, 0.0)
            turned = np.where(told, turned, 0.0)
            width = 1.0 + values[:, None] * grid2[:, None]
            gained = (turned[:, None] ** 2 * grid2[:, None] / width).sum(axis=2)
            gain = -0.5 * np.log(width).sum(axis=2)
            if pinned:
                gain += 0.5 * gained / noise2
            else:
                gain -= 0.5 * count * np.log(np.maximum(1.0 - gained / left, 1e-9))
            widest = self.products.widest(f)[:, None]
            gain = np.where(grid2 * noise2 > widest**2, OPEN_GAIN, gain)
            for chosen_f, chosen in groups:
                if chosen_f == f:
                    gain[chosen] = OPEN_GAIN
            out[f] = Further(
                gain, values, vectors, turned, taken[:, :, : self.table.parameters]
            )
        return out

    def _spectrum(
        self,
        f: int,
        own: FloatArray,
        taken: FloatArray,
        crossed: FloatArray,
        noise2: float,
    ) -> tuple[FloatArray, FloatArray]:
        """Return eigenvalues and vectors of each group's columns beside a model's."""
        if self._shapes is not None and f in self._shapes:
            return self._shapes[f]
        beside = own - taken @ crossed.transpose(0, 2, 1) / noise2
        if own.shape[1] == 1:
            found = beside[:, :, 0], np.ones_like(own)
        else:
            found = _eigen((beside + beside.transpose(0, 2, 1)) / 2)
        if self._shapes is not None:
            self._shapes[f] = found
        return found

    def keep_shapes(self) -> None:
        """Take the first model's eigenvalues for all draws that differ in noise alone."""
        self._shapes = {}

    def best_further(
        self, model: Model, further: Mapping[int, Further]
    ) -> tuple[Group, float, float]:
        """Find the group that adds most; returns it, what it adds to the logarithm of the
        odds with all its widths, and its best width's variance.
        """
        best = ((-1, -1), -math.inf, 0.0)
        for f, one in further.items():
            total = one.total + self.products.families[f].chances
            g = int(np.argmax(total))
            if total[g] > best[1]:
                width2 = model.noise2 * GRID[int(np.argmax(one.gain[g]))] ** 2
                best = ((f, g), float(total[g]), float(width2))
        return best

    def _pinned(self, model: Model, group: Group) -> Model:
        """Return a model without one of its groups, with the noise and the widths that it has
        beside it.
        """
        widths = _without(model.widths, group)
        solved = self.solve(widths, model.noise2, model.factor)
        return Model(widths, model.noise2, model.factor, solved, -math.inf)

    def climbed(self, model: Model) -> tuple[Model, dict[int, Further]]:
        """Climb from a model: add, drop or exchange groups, and widen the priors, as long as
        that is more probable.

        Returns:
            The model, and what further groups would add to it.
        """
        for _ in range(MOST_ROUNDS):
            changed = False
            for group in list(model.widths):
                less = self.model(
                    _without(model.widths, group), model.noise2, model.factor
                )
                if less.evidence > model.evidence:
                    model, changed = less, True
                    continue
                beside = self._pinned(model, group)
                some = self.further(beside, pinned=True)
                other, _, width2 = self.best_further(beside, some)
                if other != group:
                    exchanged = self.model(
                        {**less.widths, other: width2}, model.noise2, model.factor
                    )
                    if exchanged.evidence > model.evidence + 0.5:
                        model, changed = exchanged, True
            for factor in range(len(FACTORS)):
                if factor != model.factor:
                    wider = self.model(model.widths, model.noise2, factor)
                    if wider.evidence > model.evidence:
                        model, changed = wider, True
            further = self.further(model)
            group, gain, width2 = self.best_further(model, further)
            if gain > 0.0 and len(model.widths) < MOST_GROUPS:
                more = self.model(
                    {**model.widths, group: width2}, model.noise2, model.factor
                )
                if more.evidence > model.evidence:
                    model, changed = more, True
            if not changed:
                break
        return model, further

    def with_open(
        self,
        model: Model,
        further: Mapping[int, Further],
        group: Group,
        width: float = 0.0,
    ) -> Model:
        """Return a model with a group, held from now on, as wide as the residuals leave it
        open: the largest width that they speak against by odds of `OPEN_LOG_ODDS` at most.

        Args:
            model: without the group.
            further: what groups would add to it.
            group: of the table.
            width: that it has, in its own unit; 0: see above.
        """
        f, g = group
        gain = further[f].gain[g]
        open_ = GRID[gain >= max(float(gain.max()), 0.0) - OPEN_LOG_ODDS]
        width2 = model.noise2 * float(open_.max(initial=GRID[0])) ** 2
        if width > 0.0:
            width2 = (width * float(self.products.units[f][g])) ** 2
        widths = {**model.widths, group: width2}
        self.held.add(group)
        solved = self.solve(widths, model.noise2, model.factor)
        return self._judged(widths, model.noise2, model.factor, solved)

    def mixture(
        self,
        model: Model,
        further: Mapping[int, Further],
    ) -> Posterior:
        """Average over a model and those with one group more, one less, or one exchanged.

        Args:
            model: the most probable.
            further: what further groups would add to it. Groups that are held are in all.
        """
        count = self.table.parameters
        parts: list[tuple[float, Mapping[Group, float], FloatArray, FloatArray]] = []

        def take(one: Model, log_weight: float) -> None:
            parts.append(
                (log_weight, one.widths, one.solved.mean[:count],
                 one.solved.covariance[:count, :count])
            )  # fmt: skip

        def take_further(
            one: Model, some: Mapping[int, Further], log_weight: float
        ) -> None:
            mean = one.solved.mean[:count]
            covariance = one.solved.covariance[:count, :count]
            for f, more in some.items():
                chance = self.products.families[f].chances[:, None] - math.log(len(GRID))
                weight = log_weight + more.gain + chance
                for g, w in np.argwhere(weight > LEAST_LOG_WEIGHT).tolist():
                    width = more.values[g] + GRID[w] ** -2.0
                    taken = more.taken[g].T @ more.vectors[g] / one.noise2
                    off = -(taken @ (more.turned[g] / width))
                    wide = one.noise2 * (taken / width) @ taken.T
                    parts.append(
                        (
                            float(weight[g, w]),
                            {**one.widths, (f, g): one.noise2 * GRID[w] ** 2},
                            mean + off,
                            covariance + wide,
                        )
                    )

        take(model, 0.0)
        take_further(model, further, 0.0)
        for group in model.widths:
            if group in self.held:
                continue
            less = self.model(_without(model.widths, group), model.noise2, model.factor)
            take(less, less.evidence - model.evidence)
            beside = self._pinned(model, group)
            some = self.further(beside, pinned=True)
            f, g = group
            own = float(some[f].total[g] + self.products.families[f].chances[g])
            some[f].gain[g] = -np.inf
            take_further(beside, some, -own)
        for factor in range(len(FACTORS)):
            if factor < model.factor:
                narrow = self.model(model.widths, model.noise2, factor)
                take(narrow, narrow.evidence - model.evidence)
        logs = np.array([p[0] for p in parts])
        chances = np.exp(logs - logs.max())
        chances /= chances.sum()
        kept = [
            Part(float(c), widths, mean, covariance)
            for c, (_, widths, mean, covariance) in zip(chances, parts, strict=True)
        ]
        return Posterior(
            model, tuple(kept), self.products.families, tuple(self.products.units)
        )


def _eigen(squares: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return eigenvalues, (g, c), and vectors, (g, c, c), of symmetric matrices (g, c, c).

    LAPACK's divide and conquer does not converge for some matrices that are finite and well
    scaled; its QR iteration, which is slower, does.
    """
    try:
        values, vectors = np.linalg.eigh(squares)
    except np.linalg.LinAlgError:
        each = [eigh(one, driver="ev") for one in squares]
        values = np.stack([one[0] for one in each])
        vectors = np.stack([one[1] for one in each])
    return values, vectors


@dataclass(frozen=True, eq=False)
class Further:
    """What each group of a family would add to a model.

    Attributes:
        gain: (g, widths) of the logarithm of the evidence.
        values, vectors: (g, c) and (g, c, c) of its columns beside the model's, in units.
        turned: (g, c) what it would explain, along the vectors.
        taken: (g, c, p) products with the covariance of the geometry's columns.
    """

    gain: FloatArray
    values: FloatArray
    vectors: FloatArray
    turned: FloatArray
    taken: FloatArray

    @property
    def total(self) -> FloatArray:
        """Logarithm of the evidence averaged over the widths, (g,)."""
        return np.asarray(np.logaddexp.reduce(self.gain, axis=1) - math.log(len(GRID)))


def _without(widths: Mapping[Group, float], group: Group) -> dict[Group, float]:
    return {g: width for g, width in widths.items() if g != group}
