"""A scene along the motion of all its motors: first contact, least clearance, trace.

Pairs are taken in the order in which their swept boxes could be near, so that most are
decided without computing a distance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from flexdt.twin.collision.collision_scene import CollisionScene
from flexdt.twin.collision.relative import (
    START,
    PairResult,
    Path,
    RelativeMotion,
    refine_pair,
    sweep_pair,
)
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.scanner.safety import Contact

Pair = tuple[int, int]


@dataclass(frozen=True)
class NearestPair:
    """The nearest pair of a pose."""

    mm: float
    pair: tuple[str, str] | None


@dataclass(frozen=True)
class SweepResult:
    """Result of a sweep.

    Attributes:
        contact: the first, or None.
        min_clearance_mm: least clearance up to the contact of bodies that move relative
            to each other; inf when none do. It occurs in the motion, and no clearance
            before the contact is smaller by more than the scene's accuracy (0.1 mm, or 2
            % if that is more).
        nearest: the pair that has it.
        looks: number of distance evaluations.
    """

    contact: Contact | None
    min_clearance_mm: float
    nearest: tuple[str, str] | None
    looks: int = 0


def first_contact(scene: CollisionScene, path: Path) -> Contact | None:
    """Find the first contact along a path, without clearances; None if there is none."""
    return PathSearch(scene, path).first_contact(only_contacts=True).contact


@dataclass(frozen=True, eq=False)
class PathSearch:
    """A scene on a path: the pairs that move relative to each other, nearest boxes first."""

    scene: CollisionScene
    path: Path
    _motions: dict[int, RelativeMotion] = field(
        default_factory=dict, init=False, repr=False
    )
    """Filled on first use; a search belongs to the thread that made it."""

    @cached_property
    def _nearest_first(self) -> tuple[list[Pair], list[float]]:
        """Pairs that move relative to each other, and bounds of their
        clearances, ascending [mm].

        The bounds are of the whole path's box of positions, never too large.
        """
        lower = self.path.q.min(axis=0)
        upper = self.path.q.max(axis=0)
        stack = self.scene.candidates(lower, upper)
        bounds = stack.clearances(lower, upper)
        moving = np.asarray((stack.moves & self.path.moving).any(axis=1))
        order = [k for k in np.argsort(bounds, kind="stable").tolist() if moving[k]]
        return [stack.pairs[k] for k in order], bounds[order].tolist()

    @property
    def pairs(self) -> list[Pair]:
        """Indices of the bodies of the pairs that move relative to each other."""
        return self._nearest_first[0]

    @property
    def bounds(self) -> list[float]:
        """Lower bounds of the pairs' clearances on the whole path, ascending [mm]."""
        return self._nearest_first[1]

    def motion(self, k: int) -> RelativeMotion:
        """Return the motion of the first body of pair k relative to the second; made once,
        then kept.
        """
        if k not in self._motions:
            a, b = (self.scene.bodies[i] for i in self.pairs[k])
            self._motions[k] = RelativeMotion(a, b, self.path)
        return self._motions[k]

    def first_contact(self, *, only_contacts: bool = False) -> SweepResult:
        """Find the first contact, and the least clearance on the way (not refined).

        Pairs are taken nearest bound first, and left out once their bound exceeds the
        best. With a contact, clearance and pair are the contact's.

        Args:
            only_contacts: skip pairs too distant for a contact, so that clearances are
                incomplete.

        Returns:
            The contact or None, the least clearance [mm] with its pair, and the number of
            distance evaluations.
        """
        limits = self.scene.limits
        best = math.inf
        nearest = None
        looks = 0
        first: tuple[float, int, PairResult] | None = None
        for k, bound in enumerate(self.bounds):
            if bound > limits.margin + limits.tolerance and (
                only_contacts or bound >= best
            ):
                break
            motion = self.motion(k)
            until = math.inf if first is None else first[0]
            if motion.time(START) > until:
                continue
            separate = self.scene.separation(self.pairs[k])
            found = sweep_pair(motion, separate, limits, until=until)
            looks += found.looks
            if found.contact is not None and motion.time(found.contact) < until:
                first = (motion.time(found.contact), k, found)
            if found.least < best:
                best = found.least
                nearest = self.scene.names(self.pairs[k])
        if first is None:
            return SweepResult(None, best, nearest, looks=looks)
        contact = self.contact(*first[1:])
        return SweepResult(contact, contact.clearance_mm, contact.pair, looks=looks)

    def refined(self, guess: SweepResult) -> SweepResult:
        """Refine the least clearance of a free path, from a guess.

        The guess is returned if no pair can be nearer; evaluations add up.

        Args:
            guess: result of a sweep that found no contact.

        Returns:
            The result with the least clearance within the scene's accuracy.
        """
        best = guess.min_clearance_mm
        nearest = guess.nearest
        looks = guess.looks
        for k, bound in enumerate(self.bounds):
            if bound >= best - self.scene.limits.slack(best):
                break
            separate = self.scene.separation(self.pairs[k])
            least, more = refine_pair(self.motion(k), separate, self.scene.limits, best)
            looks += more
            if least < best:
                best = least
                nearest = self.scene.names(self.pairs[k])
        return SweepResult(None, best, nearest, looks=looks)

    def contact(self, k: int, found: PairResult) -> Contact:
        """Convert the contact of pair k to the scene's terms.

        Without a contact in the result it is at the path's start. The last free moment is
        the start if there is none; the contact says so.

        Args:
            k: index of the pair.
            found: result of the pair's sweep.
        """
        motion = self.motion(k)
        at = START
        if found.contact is not None:
            at = found.contact
        time = motion.time(at)
        free = float(self.path.times[0])
        if found.last_free is not None:
            free = motion.time(found.last_free)
        return Contact(
            self.scene.names(self.pairs[k]),
            time,
            self.path.positions(time),
            self.path.positions(free),
            free,
            found.least,
            found.last_free is not None,
        )


def clearance(scene: CollisionScene, positions: Mapping[str, float]) -> NearestPair:
    """Find the nearest pair of a pose (all pairs that must not touch), with 0 for a contact."""
    q = scene.vector(positions)
    stack = scene.candidates(q, q)
    return _nearest(scene, q, stack.pairs, stack.clearances(q, q))


def touching(
    scene: CollisionScene, positions: Mapping[str, float]
) -> list[tuple[tuple[str, str], float]]:
    """List every pair of a pose that is within the margin, with its clearance [mm]."""
    found = bodies_touching(scene, scene.vector(positions))
    return [(scene.names(pair), gap) for pair, gap in found]


def bodies_touching(scene: CollisionScene, q: FloatArray) -> list[tuple[Pair, float]]:
    """List every pair within the margin with the motors at `q` (axes,), with
    its clearance [mm].

    Overlaps have clearance 0; in no order. Within the tolerance counts.
    """
    stack = scene.candidates(q, q)
    limit = scene.limits.margin + scene.limits.tolerance
    near = np.flatnonzero(stack.clearances(q, q) <= limit).tolist()
    gaps = [(stack.pairs[k], separation_at(scene, stack.pairs[k], q)) for k in near]
    return [(pair, gap) for pair, gap in gaps if gap <= limit]


def clearance_trace(
    scene: CollisionScene, path: Path, times: Sequence[float] | FloatArray
) -> tuple[tuple[float, float, tuple[str, str] | None], ...]:
    """Compute the least clearance of the scene at moments of a path.

    inf and None where no pair is near enough to be a candidate.

    Args:
        scene: bodies and pairs.
        path: of all motors.
        times: moments [s].

    Returns:
        (time [s], clearance [mm], nearest pair or None) for each moment.
    """
    if len(times) == 0:
        return ()
    q = path.vectors(np.asarray(times, dtype=np.float64))
    stack = scene.candidates(q.min(axis=0), q.max(axis=0))
    bounds = stack.clearances(q, q)
    nearest = [
        _nearest(scene, at, stack.pairs, near) for at, near in zip(q, bounds, strict=True)
    ]
    return tuple((float(t), n.mm, n.pair) for t, n in zip(times, nearest, strict=True))


def _nearest(
    scene: CollisionScene, q: FloatArray, pairs: Sequence[Pair], bounds: FloatArray
) -> NearestPair:
    """Find the nearest pair with the motors at `q`; `bounds` are lower bounds
    of the clearances.

    (inf, None) without pairs; of equal gaps the first is kept.
    """
    best = NearestPair(math.inf, None)
    for k in np.argsort(bounds, kind="stable").tolist():
        if bounds[k] >= best.mm:
            break
        gap = separation_at(scene, pairs[k], q)
        if gap < best.mm:
            best = NearestPair(gap, scene.names(pairs[k]))
    return best


def separation_at(scene: CollisionScene, pair: Pair, q: FloatArray) -> float:
    """Compute the certified clearance [mm] of a pair with the motors at `q` (axes,); 0
    for an overlap.

    It is never more than the true distance.
    """
    a, b = (scene.bodies[i] for i in pair)
    offset = q @ (a.slides - b.slides) + (a.origin - b.origin)
    turn_a = None
    if a.spins:
        turn_a = a.rotation(float(q @ a.turns))
    turn_b = None
    if b.spins:
        turn_b = b.rotation(float(q @ b.turns))
    return scene.separation(pair)(offset, turn_a, turn_b)[0]
