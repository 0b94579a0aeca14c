"""Messages of a scanner, made from an executed script or from motion of the test's own.

It shares nothing with what follows them: JSON by hand, positions by the textbook's trapezium.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass

from flexdt.twin.script.executed_log import Executed

FEEDBACK_S = 0.8


def event(key: int, words: tuple[str, ...], what: str = "", reply: str = "") -> bytes:
    """One message in the interface's form."""
    component, command, arg1, arg2 = (*words, "", "", "")[:4]
    return json.dumps(
        {"component": component, "comp_phys": "", "command": command, "arg1": arg1, "arg2": arg2,
         "reply": reply, "reply type": what, "comp_type": "other", "tick count": 7, "UUID": key}
    ).encode()  # fmt: skip


def replay(log: bytes, lines: tuple[Executed, ...]) -> Iterator[tuple[float, bytes]]:
    """(time, message) of a recorded scan: what a listener would have heard, by its own stamps.

    The stamp of a repeated question was written after its wait, so what lasts into the next
    line began before its stamp.
    """
    columns = _columns(log, lines)
    for key, (line, words) in enumerate(zip(lines, columns, strict=True), 1):
        following = lines[key].sent_s if key < len(lines) else math.inf
        sent = min(line.sent_s, following - line.own_s)
        yield sent, event(key, words)
        yield sent, event(key, words, "RCV")
        if words[4] == "no wait":
            continue
        for k in range(1, math.ceil(line.own_s / FEEDBACK_S)):
            yield sent + k * FEEDBACK_S, event(key, words, "FDB")
        yield sent + line.own_s, event(key, words, "ACK", line.reply.decode("latin-1"))


def _columns(log: bytes, lines: tuple[Executed, ...]) -> list[tuple[str, ...]]:
    """The first five columns of each executed line of a log.

    The log has to contain the lines in that order, with their replies; ValueError
    otherwise.
    """
    found, rest = [], log
    for line in lines:
        head = rest.split(b"\t", 5)
        found.append(tuple(part.decode("latin-1").strip("\r\n") for part in head[:5]))
        at = rest.index(
            line.reply + b"\t" if line.reply else b"\t", len(b"\t".join(head[:5]))
        )
        end = rest.index(b"\n", at + len(line.reply) + 10)
        rest = rest[end + 1 :]
    return found


@dataclass(frozen=True)
class Motor:
    """A motor as the textbook has it: trapezium from rest to rest, after a delay."""

    name: str
    start: float
    target: float
    speed: float
    acceleration: float
    delay_s: float = 0.0

    @property
    def duration_s(self) -> float:
        """Seconds from the begin of motion to rest, without the delay."""
        way = abs(self.target - self.start)
        if way < self.speed**2 / self.acceleration:
            return 2.0 * math.sqrt(way / self.acceleration)
        return way / self.speed + self.speed / self.acceleration

    def position(self, time: float) -> float:
        """Position at a time after the command; the start before the delay is over, the
        target afterwards.
        """
        t = min(max(time - self.delay_s, 0.0), self.duration_s)
        way, total = abs(self.target - self.start), self.duration_s
        ramp = min(self.speed / self.acceleration, total / 2.0)
        top = ramp * self.acceleration
        if t < ramp:
            done = 0.5 * self.acceleration * t * t
        elif t <= total - ramp:
            done = 0.5 * top * ramp + top * (t - ramp)
        else:
            done = way - 0.5 * self.acceleration * (total - t) ** 2
        return self.start + math.copysign(done, self.target - self.start)

    def messages(
        self, key: int, at: float, offset: float = 0.0
    ) -> Iterator[tuple[float, bytes]]:
        """(time, message) of a move that begins at `at`; `offset` is added to what it reads."""
        words = (self.name, "move absolute", repr(self.target))
        yield at, event(key, words)
        yield at, event(key, words, "RCV")
        took = self.delay_s + self.duration_s
        for k in range(1, math.ceil(took / FEEDBACK_S)):
            reads = self.position(k * FEEDBACK_S) + offset
            yield at + k * FEEDBACK_S, event(key, words, "FDB", f"{reads:.10f}")
        yield at + took, event(key, words, "ACK", f"{self.target + offset:.10f}")
