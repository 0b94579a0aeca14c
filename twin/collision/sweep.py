"""First contact and least clearance of one pair of bodies along their relative motion.

It advances from certified gap to certified gap (see `relative`), so motion that counts as free
keeps the margin everywhere, not only where it was evaluated: clearance >= margin along everything
before the reported contact. A contact is reported where the certified gap is within `tolerance` of
the margin. A pair that is as near as that when a motion begins keeps to its floor instead
(`twin.scanner.safety.floor`), which depends on the gap alone, so that no number of motions wears it
down.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from flexdt.twin.collision.relative import START, Look, Moment, RelativeMotion, Separate
from flexdt.twin.scanner.safety import ROUNDING_MM, floor


@dataclass(frozen=True)
class Limits:
    """What counts as a contact, and how well the least clearance is wanted [mm].

    Attributes:
        margin: clearance that is kept.
        tolerance: a gap within this of the margin is a contact.
        accuracy: absolute [mm] and relative error allowed in the least clearance (it is never
            reported smaller than it is).
    """

    margin: float
    tolerance: float
    accuracy: tuple[float, float]

    def slack(self, clearance: float) -> float:
        """Error allowed in a least clearance of this size."""
        return max(self.accuracy[0], self.accuracy[1] * clearance)


@dataclass(frozen=True)
class PairResult:
    """What one pair's sweep found.

    Attributes:
        least: smallest clearance looked at before the contact, or at it [mm].
        contact: where the margin is reached, or None.
        last_free: a moment before it with a little more clearance; None if there is none.
        looks: number of distance evaluations.
    """

    least: float
    contact: Moment | None
    last_free: Moment | None
    looks: int


def sweep_pair(
    motion: RelativeMotion,
    separate: Separate,
    limits: Limits,
    *,
    start: Moment = START,
    until: float = math.inf,
) -> PairResult:
    """Follow one pair until it touches, the motion ends, or `until` [s].

    A pair that starts within the tolerance of the margin, or nearer, may move, but not below its
    floor.

    Args:
        motion: of one body relative to the other.
        separate: their certified clearance in a pose.
        limits: margin, tolerance.
        start: where to begin.
        until: what happens after this time does not matter [s].
    """
    level, near = floor(math.inf, limits.margin), limits.margin + limits.tolerance
    clear = near + limits.tolerance
    at, before, looks, least = start, None, 0, math.inf
    while True:
        look = motion.look(at, separate)
        looks += 1
        least = min(least, look.gap)
        if looks == 1 and 0.0 < look.gap <= near:
            level = max(0.0, floor(look.gap, limits.margin))
            near, clear = level + 0.5 * ROUNDING_MM, level + ROUNDING_MM
        elif look.gap <= near:
            if before is None:
                return PairResult(look.gap, at, None, looks)
            # The bound that led here holds as well as the look.
            free = _last_free(motion, before, clear)
            return PairResult(max(look.gap, level), at, free, looks)
        before = look
        following = motion.next_at(look, level)
        if following is None or motion.time(following) > until:
            break
        at = following
    # Free. Where it ends nearest is a good guess of the least clearance.
    end = motion.nearest_end(before)
    if motion.time(end) <= until:
        least, looks = min(least, motion.look(end, separate).gap), looks + 1
    return PairResult(least, None, None, looks)


def refine_pair(
    motion: RelativeMotion, separate: Separate, limits: Limits, best: float
) -> tuple[float, int]:
    """Least clearance of a pair that is known to be free, if it is below `best` [mm].

    Returns:
        A clearance that occurs, not more than `limits.slack` above the least (`best` if nothing
        is below that), and the number of evaluations.
    """
    at: Moment | None = START
    looks = 0
    while at is not None:
        look = motion.look(at, separate)
        looks += 1
        best = min(best, look.gap)
        level = best - limits.slack(best)
        if level <= 0.0:
            break
        at = motion.next_at(look, level)
    return best, looks


def _last_free(motion: RelativeMotion, before: Look, wanted: float) -> Moment:
    """The last moment known to have clearance `wanted`, or the last one looked at."""
    if before.gap <= wanted:
        return before.at
    return motion.next_at(before, wanted) or before.at
