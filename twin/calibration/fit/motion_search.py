"""Which parameters move, and how: a search among rivals, by their evidence.

Every parameter may stand still, wander (`Waves`) or follow jumps and a ramp (`Course`). From
one choice the search goes to the best that differs in one parameter, or has one parameter
in exchange for another, until none is better. What comes near the best is returned with
its probability, so that the sigmas contain what the tracks leave open.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from functools import partial
from itertools import product
from typing import Final, NamedTuple

import numpy as np

from flexdt.twin.calibration.fit.motion_model import (
    Course,
    MotionChoice,
    MotionModel,
    Pick,
    Waves,
)

WIDTHS: Final = tuple(10.0 ** (0.5 * k) for k in range(-2, 9))
"""Trial widths, in units of the sigma from one frame."""
WAVES: Final = (1.0, 4.0, 16.0, 64.0, math.inf)
"""Trial smoothness: half waves in a scan above which amplitudes fall; inf: no fall."""
ROUGH: Final = tuple(product((2, 5), (0, 2, 4)))
"""Places of WIDTHS and WAVES that are tried first."""
HEIGHTS: Final = (1.0, 10.0, 100.0, 1000.0)
"""Trial widths of the heights of courses, in units of the sigma from one frame."""
MAX_LIKELIHOOD_LOSS: Final = 2.0
"""Loss of log likelihood up to which width and smoothness are not rejected."""
MAX_EVIDENCE_LOSS: Final = 12.0
"""Logarithm of the evidence ratio beyond which choices have no weight."""
ONE_PERIOD: Final = 2
"""Half waves of the cosine with one period a scan."""
MIN_EVIDENCE: Final = 6.0
"""Gain in log likelihood from which a parameter counts as moving: white noise has it in less
than one of a thousand fits (55 pairs of width and smoothness are tried)."""
MOST_COURSES_OF_ONE: Final = 3
"""Largest number of courses that a parameter follows; a busier one wanders."""
EXACT_LOG_CHANCE: Final = math.log(1e-3)
"""Logarithm of the probability that what is stated to be exactly known moves; assumed."""
COURSE_CHANCE: Final = 0.1
"""Probability that a parameter jumps or drifts, before the scan is seen; assumed."""
MOST_RIVALS: Final = 24
"""Largest number of other choices that are returned."""
ROOM_PROBABILITY: Final = 0.01
"""Probability from which a choice's widths are judged, too."""
MOST_ROUNDS: Final = 12
KEPT_ODDS: Final = 100.0
"""Odds of a rival up to which a parameter that was asked for is the one that moves."""


class Likely(NamedTuple):
    """The most likely choice and its rivals.

    Attributes:
        choice: of each parameter.
        gains: logarithm of the likelihood that each parameter gains by moving.
        rivals: other choices, with their probabilities in units of the choice's.
    """

    choice: MotionChoice
    gains: tuple[float, ...]
    rivals: tuple[tuple[MotionChoice, float], ...]


def most_likely(
    model: MotionModel,
    asked: int,
    start: MotionChoice | None = None,
    exact: Collection[int] = (),
) -> Likely:
    """Search for the most likely motion.

    What was asked for is kept, unless a rival is more probable by KEPT_ODDS.

    Args:
        model: of all parameters that may move.
        asked: number of parameters that were asked for, the first ones.
        start: a choice from which the search begins, besides that of no motion.
        exact: numbers of parameters that are stated to be exactly known.

    Raises:
        LinAlgError: the equations are singular without motion.
    """
    search = _Search(model, exact)
    every = range(model.pull.shape[1])
    nothing: MotionChoice = (None,) * len(every)
    model.likelihood(nothing)
    wish = search.climbed(nothing, range(asked))
    tops = [wish, *(search.climbed(one, every) for one in {wish, nothing, start} if one)]
    best = max(tops, key=search.score)
    wish = search.best_of(range(asked))
    if search.score(wish) > search.score(best) - math.log(KEPT_ODDS):
        best = wish
    for other in search.other_frames(best):
        search.score(other)
    return Likely(search.roomy(best), search.gains(best), search.rivals(best))


class _Search:
    """Choices of a model that were judged, each once."""

    def __init__(self, model: MotionModel, exact: Collection[int] = ()) -> None:
        """Begin without any.

        Args:
            model: of all parameters.
            exact: numbers of those that are stated to be exactly known.
        """
        self._model = model
        self._exact = frozenset(exact)
        self._known: dict[MotionChoice, float] = {}
        self._course = math.log(COURSE_CHANCE) - math.log(
            model.courses.shape[1] * len(HEIGHTS)
        )

    def likelihood(self, choice: MotionChoice) -> float:
        """Compute the log likelihood of a choice; -inf if its columns are singular."""
        if choice not in self._known:
            try:
                self._known[choice] = self._model.likelihood(choice)
            except np.linalg.LinAlgError:
                self._known[choice] = -math.inf
        return self._known[choice]

    def score(self, choice: MotionChoice) -> float:
        """Compute the logarithm of the probability of a choice, up to a constant."""
        out = self.likelihood(choice)
        for i, pick in enumerate(choice):
            if pick is not None and i in self._exact:
                out += EXACT_LOG_CHANCE
            if isinstance(pick, Course):
                out += self._course * len(pick.shapes)
            elif pick is not None:
                out -= MIN_EVIDENCE
        return out

    def climbed(self, choice: MotionChoice, among: Sequence[int]) -> MotionChoice:
        """Go from a choice to the best one nearby until none is better; returns the last.

        Args:
            choice: the first one.
            among: numbers of the parameters that may begin to move.
        """
        for _ in range(MOST_ROUNDS):
            best = max(self._around(choice, among), key=self.score)
            if not self.score(best) > self.score(choice):
                break
            choice = best
            for i, pick in enumerate(choice):
                if isinstance(pick, Waves):
                    choice = self._uphill(choice, i)
        return choice

    def best_of(self, among: Sequence[int]) -> MotionChoice:
        """Return the best choice in which only some parameters move."""
        some = [choice for choice in self._known if moves(choice) <= set(among)]
        return max(some, key=self.score)

    def _around(
        self, choice: MotionChoice, among: Sequence[int]
    ) -> Iterator[MotionChoice]:
        """Yield choices that differ in one parameter, or exchange two."""
        still = [i for i in among if choice[i] is None]
        for i in still:
            yield from self._moved(choice, i)
        for i, pick in enumerate(choice):
            if pick is None:
                continue
            without = _with(choice, i, None)
            yield without
            if isinstance(pick, Course):
                yield from self._wanders(without, i)
                yield from self._courses_beside(choice, i, pick)
                yield from _taken_over(without, pick)
            else:
                yield from self._follows(without, i)
            for j in still:
                if isinstance(pick, Course):
                    yield _with(without, j, pick)
                    yield from self._follows(without, j)
                else:
                    yield self._uphill(_with(without, j, pick), j)

    def _moved(self, choice: MotionChoice, i: int) -> Iterator[MotionChoice]:
        """Yield choices in which a still parameter moves."""
        yield from self._follows(choice, i)
        yield from self._wanders(choice, i)

    def _follows(self, choice: MotionChoice, i: int) -> Iterator[MotionChoice]:
        """Yield choices in which a parameter follows its best course, then one more, as
        long as that is more likely; none where the equations are singular.
        """
        for _ in range(MOST_COURSES_OF_ONE):
            before = choice
            pick = choice[i]
            if isinstance(pick, Course) and len(pick.shapes) >= MOST_COURSES_OF_ONE:
                return
            try:
                course = self._model.best_course(choice, i, HEIGHTS)
            except np.linalg.LinAlgError:
                return
            choice = _with(choice, i, course)
            yield choice
            if len(course.shapes) > 1 and self.score(choice) < self.score(before):
                return

    def _courses_beside(
        self, choice: MotionChoice, i: int, pick: Course
    ) -> Iterator[MotionChoice]:
        """Yield choices in which a parameter follows a course more, or less."""
        yield from self._follows(choice, i)
        if len(pick.shapes) > 1:
            for shape in pick.shapes:
                rest = tuple(s for s in pick.shapes if s != shape)
                yield _with(choice, i, Course(rest, pick.width))

    def _wanders(self, choice: MotionChoice, i: int) -> Iterator[MotionChoice]:
        """Yield choices in which a still parameter wanders by one of ROUGH."""
        for w, t in ROUGH:
            yield _with(choice, i, Waves(WIDTHS[w], WAVES[t]))

    def _uphill(self, choice: MotionChoice, i: int) -> MotionChoice:
        """Climb on the grid of WIDTHS and WAVES of a parameter that wanders, by steps to
        the eight neighbours.
        """
        pick = choice[i]
        assert isinstance(pick, Waves)
        at = WIDTHS.index(pick.width), WAVES.index(pick.waves)
        while True:
            around = [
                (w, t)
                for w, t in product(
                    range(at[0] - 1, at[0] + 2), range(at[1] - 1, at[1] + 2)
                )
                if 0 <= w < len(WIDTHS) and 0 <= t < len(WAVES)
            ]
            best = max(
                around,
                key=lambda one: self.likelihood(
                    _with(choice, i, Waves(WIDTHS[one[0]], WAVES[one[1]]))
                ),
            )
            if best == at:
                return _with(choice, i, Waves(WIDTHS[at[0]], WAVES[at[1]]))
            at = best

    def other_frames(self, choice: MotionChoice) -> Iterator[MotionChoice]:
        """Yield a choice with each of its jumps up to two frames earlier or later."""
        jumps = range(len(self._model.sizes), self._model.courses.shape[1])
        for i, pick in enumerate(choice):
            if not isinstance(pick, Course):
                continue
            for shape, shift in product(pick.shapes, (-2, -1, 1, 2)):
                rest = tuple(s for s in pick.shapes if s != shape)
                moved = shape + shift
                if shape in jumps and moved in jumps and moved not in rest:
                    yield _with(choice, i, Course(rest, pick.width).beside(moved))

    def gains(self, choice: MotionChoice) -> tuple[float, ...]:
        """Compute the logarithm of the likelihood that each parameter gains by moving, or
        would gain; 0 if it does not.
        """
        out = []
        for i, pick in enumerate(choice):
            if pick is not None:
                gain = self.likelihood(choice) - self.likelihood(_with(choice, i, None))
            else:
                tried = [
                    value
                    for other, value in self._known.items()
                    if other[i] is not None and _with(other, i, None) == choice
                ]
                gain = max(tried, default=-math.inf) - self.likelihood(choice)
            out.append(max(gain, 0.0))
        return tuple(out)

    def rivals(self, choice: MotionChoice) -> tuple[tuple[MotionChoice, float], ...]:
        """List other choices by probability: the best of each set of parameters that
        wander or follow a course.
        """
        top = self.score(choice)
        kinds: dict[tuple[object, ...], tuple[float, MotionChoice]] = {}
        for other in self._known:
            score = self.score(other)
            kind = tuple(_kind(pick) for pick in other)
            if score > top - MAX_EVIDENCE_LOSS and (
                kind not in kinds or score > kinds[kind][0]
            ):
                kinds[kind] = (score, other)
        kinds.pop(tuple(_kind(pick) for pick in choice), None)
        some = sorted(kinds.values(), key=lambda one: -one[0])[:MOST_RIVALS]
        out = []
        for score, other in some:
            weight = math.exp(score - top)
            if weight > ROOM_PROBABILITY:
                out.append((self.roomy(other), weight))
            else:
                out.append((other, weight))
        return tuple(out)

    def roomy(self, choice: MotionChoice) -> MotionChoice:
        """Widen the deviations of a choice as far as the tracks do not reject it.

        One scan hardly determines a width: among the values that it does not reject
        (`MAX_LIKELIHOOD_LOSS`) and that are no narrower, that one is taken which leaves
        most room to motions that turn once with the table, which other parameters do too.
        """
        for i, best in enumerate(choice):
            if not isinstance(best, Waves):
                continue
            top = self.likelihood(choice)
            wider = [
                Waves(*pair) for pair in product(WIDTHS, WAVES) if pair[0] >= best.width
            ]
            by_room = sorted(wider, key=partial(self._room, i), reverse=True)
            wide = next(
                pick
                for pick in by_room
                if self.likelihood(_with(choice, i, pick)) >= top - MAX_LIKELIHOOD_LOSS
            )
            choice = _with(choice, i, wide)
        return choice

    def _room(self, i: int, pick: Waves) -> tuple[float, Waves]:
        """Return the variance that a prior leaves to motions that turn once with the table."""
        return float(self._model.spectrum(i, pick)[0][ONE_PERIOD]), pick


def _taken_over(choice: MotionChoice, pick: Course) -> Iterator[MotionChoice]:
    """Yield choices in which a parameter that follows courses takes over those of another."""
    for j, other in enumerate(choice):
        if isinstance(other, Course):
            shapes = tuple(sorted({*other.shapes, *pick.shapes}))
            if len(shapes) <= MOST_COURSES_OF_ONE:
                yield _with(choice, j, Course(shapes, other.width))


def moves(choice: Sequence[Pick]) -> frozenset[int]:
    """Return the numbers of the parameters that a choice moves."""
    return frozenset(i for i, pick in enumerate(choice) if pick is not None)


def _kind(pick: Pick) -> object:
    """Return what tells priors of deviations apart, but for their widths."""
    if isinstance(pick, Course):
        return pick.shapes
    return None if pick is None else -1


def _with(choice: MotionChoice, i: int, pick: Pick) -> MotionChoice:
    """Return a choice with another prior of one parameter."""
    return (*choice[:i], pick, *choice[i + 1 :])
