"""The safety state as a pure machine: transitions on a contact, an E-stop, a reset.

`ready` takes every command. A motion that a contact cuts short is halted at its last free
position and counts as a blocked attempt; a motion that ends freely clears the count. At
the machine's `max_blocked_attempts` the state is `blocked`: motion is rejected until a
reset (thesis 4.4.4). While parts are in contact the state is `blocked` too; a reset does
not change that, and the only motions allowed are those that bring no touching pair
nearer. `estopped` rejects motion and X-rays until a reset. Each E-stop and each block has
a number, so that a reset can name the one to release. `Guard` is the interface of contact
detection; `collision` implements it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Protocol, assert_never

from flexdt.twin.errors import CollisionError, SafetyError
from flexdt.twin.motion.profiles import Trajectory
from flexdt.twin.scanner.state import Safety

RUNG_MM = 5e-3
"""Spacing of the floors [mm]: the most that all histories together take from a gap.

Half the tolerance of a sweep, and large beside `ROUNDING_MM`.
"""
ROUNDING_MM = 1e-4
"""Amount by which rounding, and a braked path beside the swept one, may reduce a gap [mm]."""


def floor(gap: float, margin: float) -> float:
    """Compute the gap that two parts keep from now on, whatever the commands,
    until they separate.

    Floors are rungs of a ladder, `RUNG_MM` apart. Its top rung is one above the safety
    margin, and free parts keep to that. A pair that is nearer (after a restart with
    another machine file, or after coasting) keeps to the rung below its gap. The rungs do
    not move, and a gap that was kept above a rung has a floor no lower than that rung: so
    a thousand motions, new samples, corrections and restarts take no more from a gap than
    one, and nothing has to be remembered between them.

    Args:
        gap: between the two now, negative for the depth of an overlap [mm].
        margin: the machine's safety margin [mm].

    Returns:
        The least gap allowed [mm]; no more than `gap`, so that a pair below its rung by
        rounding may move anywhere but nearer.
    """
    rung = 1.0
    if gap < margin + RUNG_MM:
        rung = math.floor((gap - margin + 2.0 * ROUNDING_MM) / RUNG_MM)
    return min(gap, margin + rung * RUNG_MM - ROUNDING_MM)


@dataclass(frozen=True)
class Contact:
    """A motion reaching the safety margin.

    Attributes:
        pair: names of the two components.
        time: when [s].
        positions: of every motor then [mm, deg].
        last_free: positions at the last moment known to be free, a little before; where
            the motion starts in contact, the start.
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
    """Finds contacts on one stage; it changes nothing."""

    def __call__(
        self, trajectories: Mapping[str, Trajectory], now: float, /
    ) -> Contact | None:
        """Find the first contact from `now` on, given the trajectory of every
        motor; None if none."""

    def touching(
        self, positions: Mapping[str, float], *, deep: bool = False
    ) -> Mapping[tuple[str, str], float]:
        """Find the pairs of a pose within the safety margin, with their clearances [mm].

        An overlap has 0, or (`deep`) how deep it is as a negative one.
        """

    def standing(self, positions: Mapping[str, float]) -> Guard:
        """Return the guard of the same parts fixed at a pose, without their sweep."""


def require_ready(safety: Safety, what: str) -> None:
    """Check that the safety state allows motion.

    It does while ready, and while blocked by a contact that lasts: the guard then allows
    only motion that brings no touching pair nearer.

    Args:
        safety: state in force.
        what: command, for the message.

    Raises:
        SafetyError: E-stopped, or blocked without a contact; the message says that a
            reset is needed.
    """
    match safety.state:
        case "ready":
            refused = False
        case "blocked":
            refused = safety.contact is None
        case "estopped":
            refused = True
        case _:
            assert_never(safety.state)
    if refused:
        raise SafetyError(
            f"{what} is refused: {safety.reason}; a reset is needed",
            {
                "asked": what,
                "state": safety.state,
                "reason": safety.reason,
                "allowed": "reset",
            },
        )


def after_contact(safety: Safety, contact: Contact) -> Safety:
    """Count a blocked attempt; at the maximum the state becomes blocked.

    Becoming blocked counts as a stop, and has a reason with the two parts. With an E-stop
    in force nothing changes. While parts are in contact attempts are counted, and nothing
    else changes.

    Args:
        safety: state before the attempt.
        contact: that blocked it.

    Returns:
        The state after it.
    """
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
        safety,
        state="blocked",
        blocked_attempts=attempts,
        reason=reason,
        stop=safety.stop + 1,
    )


def after_free_motion(safety: Safety) -> Safety:
    """Clear the count of blocked attempts after a motion that went through."""
    if safety.blocked_attempts:
        return replace(safety, blocked_attempts=0)
    return safety


def estopped(safety: Safety, by: str) -> Safety:
    """Return the state after a press of the E-stop, perhaps a repeated one: each is the
    next stop.
    """
    reason = "the E-stop is in force"
    return replace(
        safety, state="estopped", reason=reason, stop=safety.stop + 1, stopped_by=by
    )


def released(safety: Safety, stop: int | None) -> Safety:
    """Release an E-stop or a block; blocked attempts count from 0 again.

    With parts in contact the state is blocked again at once, as the next stop. A reset of
    a ready state is allowed.

    Args:
        safety: before it.
        stop: number of the stop that it is to release; None for whichever there is.

    Returns:
        The state after the reset.

    Raises:
        SafetyError: that is not the latest stop; nothing is released.
    """
    if stop is not None and stop != safety.stop:
        by = ""
        if safety.stopped_by:
            by = f" by {safety.stopped_by}"
        why = safety.reason or "it has been released"
        raise SafetyError(
            f"the reset is for another stop than the latest{by} ({why}); nothing is released",
            {
                "asked": stop,
                "allowed": safety.stop,
                "state": safety.state,
                "reason": safety.reason,
            },
        )
    ready = replace(safety, state="ready", blocked_attempts=0, reason="", stopped_by="")
    if safety.contact is None:
        return ready
    return with_contact(ready, safety.contact)


def with_contact(safety: Safety, pair: tuple[str, str] | None) -> Safety:
    """Record that `pair` is in contact, or (None) that nothing is any more.

    A contact blocks; one of a ready scanner counts as a stop. Parts that have come apart
    leave the state blocked until a reset, with that as its reason. An E-stop stays one,
    with its own reason; only the pair is recorded.

    Args:
        safety: present state.
        pair: two parts; None for no contact, which changes nothing if there was none.

    Returns:
        The state after it.
    """
    if pair is None:
        if safety.contact is None:
            return safety
        reason = "parts were in contact and have come apart"
        separated = replace(safety, contact=None)
        if safety.state == "estopped":
            return separated
        return replace(separated, reason=reason)
    touching = replace(safety, contact=pair)
    if safety.state == "estopped":
        return touching
    reason = f"{pair[0]} and {pair[1]} are in contact; only motion that brings them apart is free"
    new = safety.state == "ready"
    return replace(touching, state="blocked", reason=reason, stop=safety.stop + new)


def collision_error(
    contact: Contact, now: float, safety: Safety, what: str, halts_at: Mapping[str, float]
) -> CollisionError:
    """Make the error for a motion that a contact cut short; returned, not raised.

    It has the pair, the time to the contact [s], the last free positions, and the
    attempts so far.

    Args:
        contact: the two parts and the time.
        now: time of the command [s].
        safety: the state after it.
        what: the command, for people.
        halts_at: where motors come to rest instead [mm, deg]; empty where nothing
            changes.
    """
    ahead = contact.time - now
    where = ", ".join(f"{axis} {value:.4g}" for axis, value in halts_at.items())
    outcome = "nothing changes"
    if where:
        outcome = f"motion halts at {where}"
    count = safety.blocked_attempts
    allowed = safety.max_blocked_attempts
    return would_touch(
        what,
        contact.pair,
        ahead,
        contact.last_free,
        "are too close already",
        f"{outcome} (blocked attempt {count} of {allowed} in a row; "
        f"the last one blocks all motion until a reset)",
        halts_at=dict(halts_at),
        blocked_attempts=count,
        max_blocked_attempts=allowed,
        state=safety.state,
    )


def would_touch(
    what: str,
    pair: tuple[str, str],
    ahead: float,
    last_free: Mapping[str, float],
    near: str,
    outcome: str,
    **data: object,
) -> CollisionError:
    """Make (do not raise) the error for a command after which two parts meet or are too
    near.

    `ahead`: time until then [s]; 0 where they are `near` now. `last_free`: motor -> [mm,
    deg]; `outcome`: in words.
    """
    how = near
    if ahead > 0.0:
        how = f"would collide in {ahead:.3g} s"
    facts = {
        "asked": what,
        "pair": list(pair),
        "time_s": ahead,
        "last_free": dict(last_free),
    }
    return CollisionError(
        f"{what}: {' and '.join(pair)} {how}; {outcome}", {**facts, **data}
    )
