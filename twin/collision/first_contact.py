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
    """Find the first contact along a path, without clearances, or None."""
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
        """Pairs that move relative to each other on the path, and lower bounds of their
        clearances, ascending [mm].

        The bounds hold for the box of all positions of the whole path.
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
        """Return the motion of the first body of the pair with index `k` in `pairs`
        relative to the second; made once, then kept.
        """
        if k not in self._motions:
            a, b = (self.scene.bodies[i] for i in self.pairs[k])
            self._motions[k] = RelativeMotion(a, b, self.path)
        return self._motions[k]

    def first_contact(self, *, only_contacts: bool = False) -> SweepResult:
        """Find the first contact on the path, and the least clearance on the way (not
        refined).

        Pairs are taken nearest bound first, and the search ends at one whose bound is
        beyond margin and tolerance and not below the best. With a contact, clearance and
        pair are the contact's.

        Args:
            only_contacts: stop at the first pair too distant for a contact; without a
                contact the clearance is then incomplete.

        Returns:
            The contact or None, the least clearance [mm] (inf without moving pairs) with
            its pair, and the number of distance evaluations.
        """
        limits = self.scene.limits
        best = math.inf
        nearest = None
        looks = 0
        first: tuple[float, int, PairResult] | None = None
        for k, bound in enumerate(self.bounds):
            # Bounds ascend: from here on no pair can touch, nor lower the best if that is
            # asked for.
            if bound > limits.margin + limits.tolerance and (
                only_contacts or bound >= best
            ):
                break
            motion = self.motion(k)
            until = math.inf if first is None else first[0]
            # It stands until after the contact that was found.
            if motion.time(START) > until:
                continue
            separate = self.scene.separation(self.pairs[k])
            # Only an earlier contact counts: no pair is swept beyond the first one so far.
            result = sweep_pair(motion, separate, limits, until=until)
            looks += result.looks
            if result.contact is not None and motion.time(result.contact) < until:
                first = (motion.time(result.contact), k, result)
            if result.least < best:
                best = result.least
                nearest = self.scene.names(self.pairs[k])
        if first is None:
            return SweepResult(None, best, nearest, looks=looks)
        contact = self.contact(*first[1:])
        return SweepResult(contact, contact.clearance_mm, contact.pair, looks=looks)

    def refined(self, guess: SweepResult) -> SweepResult:
        """Refine the least clearance of a free path, from a guess.

        Pairs whose bound cannot be below the best by more than the accuracy are skipped.
        The numbers of evaluations add up.

        Args:
            guess: result of a sweep that found no contact.

        Returns:
            Result without a contact; its least clearance is within the scene's accuracy,
            that of the guess if no pair is nearer.
        """
        best = guess.min_clearance_mm
        nearest = guess.nearest
        looks = guess.looks
        for k, bound in enumerate(self.bounds):
            # Bounds ascend: no later pair can lower the best by more than the accuracy.
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
        """Convert the sweep's result of the pair with index `k` to a `Contact`: names,
        times, positions of all motors, clearance.

        A result without a contact counts as one at the start of the pair's motion.
        Without a last free moment that is the start of the path, and `free_before` is
        False.

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
    """Find the nearest pair of a pose among all that must not touch, with 0 for an overlap;
    (inf, None) without pairs. `scene`: bodies and pairs. `positions`: motor -> position [mm,
    deg]; motors left out are at home."""
    q = scene.vector(positions)
    stack = scene.candidates(q, q)
    return _nearest(scene, q, stack.pairs, stack.clearances(q, q))


def touching(
    scene: CollisionScene, positions: Mapping[str, float]
) -> list[tuple[tuple[str, str], float]]:
    """List the pairs of a pose within the margin, by names, with clearances [mm]."""
    gaps = bodies_touching(scene, scene.vector(positions))
    return [(scene.names(pair), gap) for pair, gap in gaps]


def bodies_touching(scene: CollisionScene, q: FloatArray) -> list[tuple[Pair, float]]:
    """List every pair within margin plus tolerance with the motors at `q` (axes,), with
    its clearance [mm].

    Pairs are indices of bodies, in the scene's order; overlaps have clearance 0.
    """
    stack = scene.candidates(q, q)
    limit = scene.limits.margin + scene.limits.tolerance
    # Bounds of boxes are never above the gap: only pairs that they leave open cost a
    # distance.
    near = np.flatnonzero(stack.clearances(q, q) <= limit).tolist()
    gaps = [(stack.pairs[k], separation_at(scene, stack.pairs[k], q)) for k in near]
    return [(pair, gap) for pair, gap in gaps if gap <= limit]


def clearance_trace(
    scene: CollisionScene, path: Path, times: Sequence[float] | FloatArray
) -> tuple[tuple[float, float, tuple[str, str] | None], ...]:
    """Compute the least clearance of the scene at moments of a path.

    inf and None where no pair is near enough to be a candidate (`CollisionScene.candidates`); ()
    without times.

    `scene`: bodies and pairs. `path`: of all motors. `times`: moments [s]; outside the path its
    ends count.
    Returns (time [s], clearance [mm], nearest pair or None) for each moment.
    """
    if len(times) == 0:
        return ()
    q = path.vectors(np.asarray(times, dtype=np.float64))
    # Candidates of the box of all moments: chosen once, not once a moment.
    stack = scene.candidates(q.min(axis=0), q.max(axis=0))
    bounds = stack.clearances(q, q)
    nearest = [
        _nearest(scene, at, stack.pairs, near) for at, near in zip(q, bounds, strict=True)
    ]
    return tuple((float(t), n.mm, n.pair) for t, n in zip(times, nearest, strict=True))


def _nearest(
    scene: CollisionScene, q: FloatArray, pairs: Sequence[Pair], bounds: FloatArray
) -> NearestPair:
    """Find the nearest pair with the motors at `q`; `bounds` are lower bounds of the clearances.

    A `NearestPair` of inf and None without pairs; of equal gaps the one with the smaller bound
    is kept.

    `q`: (axes,) positions; `pairs`: m candidates; `bounds`: (m,) lower bounds of their
    clearances [mm].
    """
    best = NearestPair(math.inf, None)
    for k in np.argsort(bounds, kind="stable").tolist():
        # Bounds ascend in this order, and gaps are above theirs.
        if bounds[k] >= best.mm:
            break
        gap = separation_at(scene, pairs[k], q)
        if gap < best.mm:
            best = NearestPair(gap, scene.names(pairs[k]))
    return best


def separation_at(scene: CollisionScene, pair: Pair, q: FloatArray) -> float:
    """Compute the certified clearance [mm] of two bodies with the motors at `q`; 0 for an
    overlap.

    It is never more than the true distance. `pair`: indices; `q`: (axes,) [mm, deg].
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
