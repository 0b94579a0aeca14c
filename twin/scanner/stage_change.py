"""Another sample or correction under motors that stand or move: when it may be put in force.

What stands on the stage and where changes with the sample and with the correction. Both are
certified as moves are: whatever is under way must be free of the new stage, or at least a stop of
it, and where nothing moves no pair may come within the safety margin.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from flexdt.twin.errors import CollisionError, SafetyError
from flexdt.twin.motion.profiles import Trajectory
from flexdt.twin.scanner.joining import Lookahead, Trajectories
from flexdt.twin.scanner.safety import Contact, Guard, floor
from flexdt.twin.scanner.state import NamedCorrection, Sample

MANY_LEGS = 500
"""A programme of more trajectories than these is too long to be swept at a takeover."""


@dataclass(frozen=True)
class Verdict:
    """A change that may be put in force.

    Attributes:
        contact: what lies ahead of the motion under way on the new stage; None if it is free.
        halted: motor -> trajectory that rests before that contact; None where all carry on.
    """

    contact: Contact | None = None
    halted: Trajectories | None = None


@dataclass(frozen=True)
class StageChange:
    """A change with all that its sweep needs; frozen, so that the sweep may run in a thread.

    Attributes:
        sample: what is to stand on the stage.
        correction: what is to be in force; None for none.
        guard: finds contacts with both of them.
        ahead: all motors, with the guard that is in force.
        version: of the stage, the stops and the programmes that it is made for.
        moves: motor -> trajectory that begins with the change.
        targets, paces: what those moves come from.
    """

    sample: Sample
    correction: NamedCorrection | None
    guard: Guard | None = field(repr=False)
    ahead: Lookahead = field(repr=False)
    version: tuple[int, int, int]
    moves: Mapping[str, Trajectory] = field(repr=False)
    targets: Mapping[str, float]
    paces: Mapping[str, tuple[float, float]]
    found: Verdict | None = None
    """What `certified` has found."""

    def certified(self) -> StageChange:
        """The same change, once it is known that it may be put in force.

        Raises:
            CollisionError: what is under way is not free of the new stage, and no stop of it is.
        """
        return replace(self, found=self.verdict())

    def renewed(self, before: StageChange) -> Verdict:
        """The verdict at the takeover, from the one that was found `before`; raises as `verdict`.

        Raises:
            SafetyError: a long programme has begun meanwhile; nothing changes.
        """
        still, found = before.version == self.version and not self.moves, before.found
        if still and found is not None and found.contact is None:
            return Verdict()  # what was free to its end is so still
        if self.ahead.legs <= MANY_LEGS:
            return self.verdict()
        if still and found is not None and found.contact is not None:
            halted = self.ahead.halted_at_once(found.contact)
            if halted is not None:
                return Verdict(found.contact, halted)
        raise SafetyError(
            "the motion under way has changed meanwhile; nothing changes",
            {"allowed": "asking again"},
        )

    def verdict(self) -> Verdict:
        """Whether what is under way may carry on, or how it is halted; raises as `certified`."""
        changed, now = self.ahead.on(self.guard), self.ahead.now
        under_way = self.ahead.ahead()
        before = self.ahead.touching(deep=True)
        for pair, clearance in changed.touching(deep=True).items():
            # What is within the margin already may stay there, and keeps its floor.
            margin = self.ahead.machine.safety_margin_mm
            if pair not in before or clearance < floor(before[pair], margin):
                raise self._refused(pair, 0.0, {})
        contact = changed.contact(under_way) if under_way else None
        halted = None
        if contact is not None:
            halted = changed.halted(under_way, contact)
            if halted is None or self.moves:
                raise self._refused(contact.pair, contact.time - now, contact.last_free)
        if self.moves:
            met = changed.contact({**under_way, **self.moves})
            if met is not None:
                raise self._refused(met.pair, met.time - now, met.last_free)
        return Verdict(contact, halted)

    def _refused(
        self, pair: tuple[str, str], seconds: float, last_free: Mapping[str, float]
    ) -> CollisionError:
        how = f"would collide in {seconds:.3g} s" if seconds > 0.0 else "would be too close"
        what = f"sample {self.sample.name!r}" if self.sample.name else "the empty stage"
        if self.correction is not None:
            what += f" with correction {self.correction.name!r}"
        return CollisionError(
            f"{what}: {' and '.join(pair)} {how}; nothing changes",
            {
                "asked": what,
                "pair": list(pair),
                "time_s": seconds,
                "last_free": dict(last_free),
                "halts_at": {},
                "allowed": "a pose at which it is free, or another placement",
            },
        )
