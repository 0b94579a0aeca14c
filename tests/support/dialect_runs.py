"""Drawn conversations run through a follower: what of them is told, and what is not."""

from __future__ import annotations

from collections.abc import Iterable
from math import exp

from flexdt.clients.following.session import FollowSession
from flexdt.twin.following.follower import Follower
from flexdt.twin.following.mirror import Alarm
from flexdt.twin.machine.description import Machine, builtin_machine, builtin_profile
from tests.support.dialects import TOLD_S, Conversation, Message

FLEXRAY = builtin_machine("flexray")
TICK_S = 0.1
AFTER_S = 3.0


class Listener:
    """A session on a clock of its own.

    Args:
        stalls: (from, to) in which the listener does not read: what comes then is read at its
            end.
        machine: what is known.
    """

    def __init__(
        self, stalls: Iterable[tuple[float, float]] = (), machine: Machine = FLEXRAY
    ) -> None:
        """Begin at time 0 with no alarm; `alarms` collects all that follow."""
        self.alarms: list[Alarm] = []
        self.now = 0.0
        follower = Follower(machine, builtin_profile(FLEXRAY.default_profile))
        self.session = FollowSession(follower, self.alarms.append, clock=lambda: self.now)
        self.stalls = list(stalls)

    def hear(self, messages: Iterable[Message]) -> Listener:
        """Take messages in order of time, with clock ticks in between; returns itself.

        A message within a stall is taken at the stall's end, with the delay that it had.
        """
        for at, data in messages:
            stall = next((s for s in self.stalls if s[0] <= at < s[1]), (at, at))
            self.wait(stall[0])
            self.now = stall[1]
            self.session.message(data, stall[1], stall[1] - stall[0])
        return self

    def wait(self, until: float) -> Listener:
        """Let time pass until `until` [s]; returns itself.

        The session ticks each TICK_S while it waits for something; else only once, at the
        end.
        """
        while self.now + TICK_S < until:
            busy = self.session.mirror.waiting
            self.now = self.now + TICK_S if busy else until - TICK_S / 2
            self.session.tick(self.now)
        self.now = max(self.now, until)
        return self


def measured(overhead: tuple[float, float], n: int = 30) -> Machine:
    """The FleX-ray machine with measured times, all kinds of command alike.

    Args:
        overhead: median [s] and spread of the logarithm of each kind's time.
        n: how many commands of each kind they are known from.
    """
    median, spread = overhead
    ends = {
        "p5_s": median * exp(-1.645 * spread),
        "p95_s": median * exp(1.645 * spread),
        "n": n,
    }
    kinds = ("move", "move_standing", "set_tube", "set_camera", "command")
    timing = {**{f"{kind}_s": median for kind in kinds}, "source": "measured",
              "spread": dict.fromkeys(kinds, ends)}  # fmt: skip
    made = FLEXRAY.model_dump() | {"timing": FLEXRAY.timing.model_dump() | timing}
    return Machine.model_validate(made)


def missed(made: Conversation, stalls: Iterable[tuple[float, float]] = ()) -> list[str]:
    """What of a conversation is not told in time, or is told though nothing is wrong.

    Wrong are: a fault without its alarm within TOLD_S, an error before AFTER_S before the
    first fault of the machine, and more warnings up to there than one and one for each
    fault.

    Args:
        made: what to hear.
        stalls: (from, to) in which the listener does not read [s].

    Returns:
        A line for each; empty if all is well.
    """
    listener = Listener(stalls).hear(made.heard())
    listener.wait(max((f.at_s for f in made.faults), default=listener.now) + AFTER_S)
    wrong = []
    for fault in made.faults:
        found = [
            a for a in listener.alarms if a.kind in fault.kinds and a.about == fault.about
        ]
        soon = [a for a in found if a.at_s <= fault.at_s + TOLD_S]
        if not soon:
            wrong.append(f"{made.dialect.name}: not told in time: {fault}; told: {found}")
    machine = [f for f in made.faults if f.kinds != {"range"}]
    first = min((f.at_s for f in machine), default=float("inf")) - AFTER_S
    wrong += [
        f"{made.dialect.name}: {a}"
        for a in listener.alarms
        if a.severity == "error" and a.at_s < first
    ]
    warnings = [a for a in listener.alarms if a.severity == "warning" and a.at_s < first]
    if len(warnings) > 1 + len(made.faults):
        wrong.append(f"{made.dialect.name}: {len(warnings)} warnings: {warnings}")
    return wrong
