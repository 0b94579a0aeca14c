"""The safety state as a pure machine: what happens on a contact, an E-stop, a reset.

`ready` takes every command. A motion that a contact cuts short is halted at its last free position
and counts as a blocked attempt; a motion that ends freely clears the count. At the machine's
`max_blocked_attempts` the state is `blocked`: motion is rejected until a reset (thesis 4.4.4).
While parts are in contact the state is `blocked` too; a reset does not change that, and the only
motions allowed are those that bring no touching pair nearer. `estopped` rejects motion and X-rays
until a reset. Each E-stop and each block has a number, so that a reset can say which one it is to
release. `Guard` is the interface of contact detection; `collision` implements it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Protocol

from flexdt.twin.errors import CollisionError, SafetyError
from flexdt.twin.motion.profiles import Trajectory
from flexdt.twin.scanner.state import Safety

RUNG_MM = 5e-3
"""Spacing of the floors [mm]: what all histories together may take from a gap within the margin.
Half the tolerance of a sweep, and large beside `ROUNDING_MM`."""
ROUNDING_MM = 1e-4
"""What rounding may take from a gap, and a braked path that strays from the one that was swept."""


def floor(gap: float, margin: float) -> float:
    """The gap that two parts keep from now on, whatever they are asked to do, until they are apart.

    Floors are rungs of a ladder, `RUNG_MM` apart. Its top rung is one above the safety margin, and
    what is free keeps to that. A pair that is nearer (after a restart with another machine file, or
    after coasting) keeps to the rung below its gap. The rungs do not move, and a gap that was kept
    above a rung has a floor no lower than that rung: so a thousand motions, new samples,
    corrections and restarts take no more from a gap than one, and nothing has to be remembered
    between them.

    Args:
        gap: between the two now, negative for the depth of an overlap [mm].
        margin: the machine's safety margin [mm].

    Returns:
        The least gap allowed [mm]; no more than `gap`, so that what has sunk below its rung by
        rounding may go anywhere but nearer.
    """
    rung = 1.0
    if gap < margin + RUNG_MM:
        rung = math.floor((gap - margin + 2.0 * ROUNDING_MM) / RUNG_MM)
    return min(gap, margin + rung * RUNG_MM - ROUNDING_MM)


@dataclass(frozen=True)
class Contact:
    """Where a motion comes to the safety margin.

    Attributes:
        pair: names of the two components.
        time: when [s].
        positions: of every motor then [mm, deg].
        last_free: positions at the last moment known to be free, a little before; where the
            motion starts in contact, the start.
        last_free_time: that moment [s].
        clearance_mm: certified clearance at `time`.
        free_before: whether there was a free moment before at all.
    """

    pair: tuple[str, str]
    time: float
    positions: Mapping[str, float]
    last_free: Mapping[str, float]
    last_free_time: float
    clearance_mm: float
    free_before: bool = True


class Guard(Protocol):
    """Finds contacts with what stands on one stage, and changes nothing."""

    def __call__(self, trajectories: Mapping[str, Trajectory], now: float, /) -> Contact | None:
        """The first contact from now on, given the trajectory of every motor; None if none."""

    def touching(
        self, positions: Mapping[str, float], *, deep: bool = False
    ) -> Mapping[tuple[str, str], float]:
        """Pairs of a pose that are within the safety margin, with their clearances [mm].

        An overlap has 0, or (`deep`) how deep it is as a negative one.
        """

    def standing(self, positions: Mapping[str, float]) -> Guard:
        """The guard of the same parts where they stand at a pose, without what they may sweep."""


def require_ready(safety: Safety, what: str) -> None:
    """Raise unless motion is allowed.

    Raises:
        SafetyError: E-stop in force, or blocked; says how to get out.
    """
    if safety.state == "estopped" or (safety.state == "blocked" and safety.contact is None):
        raise SafetyError(
            f"{what} is refused: {safety.reason}; a reset is needed",
            {"asked": what, "state": safety.state, "reason": safety.reason, "allowed": "reset"},
        )


def after_contact(safety: Safety, contact: Contact) -> Safety:
    """One more blocked attempt; at the maximum the state is blocked. An E-stop stays one."""
    if safety.state == "estopped":
        return safety
    attempts = safety.blocked_attempts + 1
    first, second = contact.pair
    if safety.contact is not None:  # blocked already, for a reason that lasts
        return replace(safety, blocked_attempts=attempts)
    if attempts < safety.max_blocked_attempts:
        return replace(safety, blocked_attempts=attempts)
    reason = f"motion was blocked {attempts} times in a row, last by {first} and {second}"
    return replace(
        safety, state="blocked", blocked_attempts=attempts, reason=reason, stop=safety.stop + 1
    )


def after_free_motion(safety: Safety) -> Safety:
    """A motion went through: the count of blocked attempts starts again."""
    return replace(safety, blocked_attempts=0) if safety.blocked_attempts else safety


def estopped(safety: Safety, by: str) -> Safety:
    """The E-stop was pressed, perhaps once more: the next stop."""
    reason = "the E-stop is in force"
    return replace(safety, state="estopped", reason=reason, stop=safety.stop + 1, stopped_by=by)


def released(safety: Safety, stop: int | None) -> Safety:
    """The state after a reset; a contact remains one, and is the next stop.

    Args:
        safety: before it.
        stop: number of the stop that it is to release; None for whichever there is.

    Raises:
        SafetyError: that is not the latest stop; nothing is released.
    """
    if stop is not None and stop != safety.stop:
        by = f" by {safety.stopped_by}" if safety.stopped_by else ""
        why = safety.reason or "it has been released"
        raise SafetyError(
            f"the reset is for another stop than the latest{by} ({why}); nothing is released",
            {"asked": stop, "allowed": safety.stop, "state": safety.state, "reason": safety.reason},
        )
    ready = replace(safety, state="ready", blocked_attempts=0, reason="", stopped_by="")
    return ready if safety.contact is None else in_contact(ready, safety.contact)


def in_contact(safety: Safety, pair: tuple[str, str] | None) -> Safety:
    """The state when `pair` is found in contact, or (None) when nothing is any more.

    Parts that have come apart leave the state blocked until a reset. An E-stop stays one.
    """
    if pair is None:
        if safety.contact is None:
            return safety
        reason = "parts were in contact and have come apart"
        apart = replace(safety, contact=None)
        return apart if safety.state == "estopped" else replace(apart, reason=reason)
    touching = replace(safety, contact=pair)
    if safety.state == "estopped":
        return touching
    reason = f"{pair[0]} and {pair[1]} are in contact; only motion that brings them apart is free"
    new = safety.state == "ready"
    return replace(touching, state="blocked", reason=reason, stop=safety.stop + new)


def collision_error(
    contact: Contact, now: float, safety: Safety, what: str, halts_at: Mapping[str, float]
) -> CollisionError:
    """The error for a motion that a contact cut short.

    Args:
        contact: what would have touched.
        now: time of the command [s].
        safety: the state after it.
        what: the command, for people.
        halts_at: where motors come to rest instead [mm, deg]; empty where nothing changes.
    """
    ahead = contact.time - now
    where = ", ".join(f"{axis} {value:.4g}" for axis, value in halts_at.items())
    outcome = f"motion halts at {where}" if where else "nothing changes"
    count, most = safety.blocked_attempts, safety.max_blocked_attempts
    return would_touch(
        what, contact.pair, ahead, contact.last_free, "are too close already",
        f"{outcome} (blocked attempt {count} of {most})", halts_at=dict(halts_at),
        blocked_attempts=count, max_blocked_attempts=most, state=safety.state,
    )  # fmt: skip


def would_touch(
    what: str, pair: tuple[str, str], ahead: float, last_free: Mapping[str, float], near: str,
    outcome: str, **data: object,
) -> CollisionError:  # fmt: skip
    """The error for a command, `what`, after which two parts meet in `ahead` [s], or are `near`."""
    how = f"would collide in {ahead:.3g} s" if ahead > 0.0 else near
    told = {"asked": what, "pair": list(pair), "time_s": ahead, "last_free": dict(last_free)}
    return CollisionError(f"{what}: {' and '.join(pair)} {how}; {outcome}", {**told, **data})
