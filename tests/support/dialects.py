"""Conversations of message servers that differ, with faults in them, and what must be told of
them.

Ten dialects of one interface: its description to the letter, and as its own last pages have it;
the public client `acquila_zmq` in two versions and the log that its monitor recorded; Dexter,
whose JSON has no whole numbers; and what servers leave out or say twice. A conversation is a
machine of this file's own that moves by the textbook's trapezium, written as JSON by hand:
nothing here is shared with what reads it.
"""

from __future__ import annotations

import json
import math
import random
import struct
import uuid
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

FEEDBACK_S = 0.9
TOLD_S = 1.0
"""How soon after it can be known a fault must be told."""
AXES = {  # lower, upper, home, speed, acceleration, greatest speed and acceleration
    "tra_obj": (-234.0, 194.0, 0.0, 50.0, 50.0, 50.0, 125.0),
    "mag_obj": (70.0, 996.0, 600.0, 50.0, 50.0, 50.0, 125.0),
}


@dataclass(frozen=True)
class Dialect:
    """How a server writes what happens.

    Attributes:
        send: what a command says where a reply says what it is.
        tick: of a reply: `copied` from the command, `renewed`, `renewed FDB`, `none`,
            `constant`.
        uuid: `whole` (64 bits), `text`, `float` (replies lose digits), `count`, `zero`.
        arguments: whether replies repeat those of the command; `numbers` not as text.
        feedback: `position`, `text`, `empty`, or `none` at all.
        end: what the reply at the end has: `cluster`, `position`; or `none`, and no end is
            told.
        received, doubled, indented, topic, raw: RCV; everything twice; JSON of many lines; text
            before it; messages that are no JSON.
    """

    name: str
    send: str = ""
    tick: str = "copied"
    uuid: str = "whole"
    arguments: str = "text"
    feedback: str = "position"
    end: str = "cluster"
    received: bool = True
    doubled: bool = False
    indented: bool = False
    topic: str = ""
    raw: bool = False


DIALECTS = (
    Dialect("description", arguments="none"),
    Dialect("description, last pages", tick="renewed", arguments="none"),
    Dialect("acquila_zmq", "SENT", "renewed FDB", "text", end="position"),
    Dialect(
        "acquila_zmq, early",
        "SENT",
        "renewed",
        "text",
        arguments="numbers",
        end="position",
    ),
    Dialect("monitor log", "SENT", "renewed FDB", "text", feedback="text", raw=True),
    Dialect("Dexter", tick="constant", uuid="float", feedback="empty", indented=True),
    Dialect("no ticks", "SEND", "none", "count", feedback="none", received=False),
    Dialect("echoes", tick="renewed", doubled=True, topic="acquila "),
    Dialect("no ends", tick="none", end="none"),
    Dialect("no UUID", "SENT", tick="renewed", uuid="zero"),
)
Message = tuple[float, bytes]


@dataclass(frozen=True)
class Fault:
    """What must be told: some of `kinds` about something, `TOLD_S` after `at_s` at the
    latest."""

    at_s: float
    kinds: frozenset[str]
    about: str


@dataclass
class Conversation:
    """Commands one after the other, and their replies.

    Attributes:
        messages: (when [s], bytes), in the order of the commands.
        faults: of the machine and of the server.
        overhead: (median [s], spread of its logarithm) of what each command takes beside; None
            for a few hundredths of a second.
    """

    dialect: Dialect
    rng: random.Random
    now: float = 1.0
    messages: list[Message] = field(default_factory=list)
    faults: list[Fault] = field(default_factory=list)
    overhead: tuple[float, float] | None = None
    positions: dict[str, float] = field(
        default_factory=lambda: {n: a[2] for n, a in AXES.items()}
    )
    _count: int = 0
    _ticks: int = 1_380_210_404

    def heard(self) -> list[Message]:
        """The messages in the order in which they come."""
        return sorted(self.messages, key=lambda message: message[0])

    # -- what happens ------------------------------------------------------------------------

    def command(self) -> None:
        """Add something that a healthy machine does, drawn: mostly a move, else a setting
        or a pause.

        Positions are asked for only in dialects that report the end of a command.
        """
        what = self.rng.random()
        if what < 0.6:
            self.move()
        elif what < 0.7:
            self._short("tube", "set kV", f"{self.rng.uniform(50, 80):.1f}")
        elif what < 0.8:
            self._short("camera", "set number of averages", str(self.rng.randint(1, 9)))
        elif what < 0.9 and self.dialect.end != "none":
            axis = self.rng.choice(list(AXES))
            self._short(axis, "status_position_get", "", f"{self.positions[axis]:.10f}")
        else:
            self._lasting("scanner", "pause", self.rng.uniform(0.5, 6.0))

    def move(self, fault: str = "", slip: str = "") -> None:
        """A motor moves.

        Args:
            fault: of the machine: `slow`, `offset`, `limits`, `beyond`, `hangs`.
            slip: of the server: `dropped`, `doubled`, `late`, `lost end`, `late end`,
                `overtaken`.
        """
        rng, dialect = self.rng, self.dialect
        axis = rng.choice(list(AXES))
        lower, upper, _, speed, acceleration, most_speed, most_acceleration = AXES[axis]
        start = self.positions[axis]
        far = 120.0 if fault in ("slow", "hangs") else 0.0
        while True:
            target = round(rng.uniform(lower + 4, upper - 4), 4)
            if abs(target - start) >= far:
                break
        if fault == "beyond":
            target = upper + rng.uniform(0.01, 50.0)
            self.faults.append(Fault(self.now, frozenset({"limit"}), axis))
        factor = rng.uniform(0.3, 0.7) if fault == "slow" else 1.0
        ends_at = target + (
            rng.choice((-1, 1)) * rng.uniform(0.05, 3.0) if fault == "offset" else 0.0
        )
        stated = upper + (rng.uniform(1, 50) if fault == "limits" else 0.0)
        way, begun = abs(target - start), self.now
        nominal = trapezium(way, speed, acceleration)
        starts = self._more()
        took = starts + trapezium(way, speed * factor, acceleration)
        say = self._begin(axis, "move absolute", repr(target))
        late_at = math.inf
        count = max(0, math.ceil(took / FEEDBACK_S) - 1)
        pick = rng.randint(1, max(1, count))
        last = travelled(count * FEEDBACK_S - starts, way, speed * factor, acceleration)
        if fault == "offset" and dialect.end == "none" and way - last < 0.05:
            fault, ends_at = (
                "",
                target,
            )  # a last reading aside may as well be one overtaken
        for k in range(1, count + 1):
            t = k * FEEDBACK_S
            if fault == "hangs" and t > nominal / 2:
                break
            done = travelled(t - starts, way, speed * factor, acceleration)
            at = start + math.copysign(done, target - start)
            if way - done > 0.05 and t - reached(done, way, speed, acceleration) > 0.32:
                late_at = min(late_at, begun + t)
            delay = 0.0
            if k == pick and slip == "dropped":
                continue
            if k == pick and slip == "late":
                delay = rng.uniform(0.01, 0.15)
            if k == pick and slip == "overtaken":
                delay = 0.01 + (FEEDBACK_S if k < count else took - t)
            self._feedback(say, begun + t + delay, at)
            if k == pick and slip == "doubled":
                self._feedback(say, begun + t + rng.uniform(0.0, 2.0), at)
        self.now = begun + took
        overdue = begun + nominal + 0.3
        if fault == "hangs":
            silent = self.messages[-1][0] + 2.5
            first = overdue if dialect.end != "none" else silent
            if dialect.end != "none" or first < begun + nominal:  # else untold
                self.faults.append(Fault(first, frozenset({"range", "silent"}), axis))
            self.now = first + 30.0
            return
        if fault == "slow":
            shown = late_at if dialect.feedback == "position" else math.inf
            known = min(shown, overdue if dialect.end != "none" else math.inf)
            self.faults.append(Fault(known, frozenset({"slow", "range"}), axis))
        reply = cluster(ends_at, target, speed, acceleration, lower, stated, most_speed,
                        most_acceleration)  # fmt: skip
        if dialect.end == "position":
            reply = f"{ends_at:.10f}"
        told = self.now
        if slip in ("late end", "lost end") and dialect.end != "none":
            told += rng.uniform(1.0, 3.0)
            self.faults.append(Fault(self.now + 0.3, frozenset({"range"}), axis))
        gap = rng.choice((0.0, rng.uniform(0.0, 2.0)))
        if slip == "overtaken" and rng.random() < 0.5:
            gap = -0.004  # the next command is heard before this end
        if dialect.end == "none":
            self._say(say, told, "FDB", reply)
        elif slip != "lost end":
            self._say(say, told, "ACK", reply)
            if slip == "doubled":
                self._say(say, told + rng.uniform(0.0, 5.0), "ACK", reply)
        if fault == "offset":
            self.faults.append(
                Fault(told, frozenset({"offset", "off_path", "slow"}), axis)
            )
        if fault == "limits" and dialect.end != "position":
            self.faults.append(Fault(told, frozenset({"limits"}), axis))
        self.positions[axis] = ends_at
        self.now = told + 0.002 + gap

    def _short(
        self, component: str, command: str, argument: str, reply: str = ""
    ) -> None:
        """Add a command that takes no more than the overhead, and its end with `reply`.

        The end is left out in dialects that report none.
        """
        say = self._begin(component, command, argument)
        self.now += self._more()
        if self.dialect.end != "none":
            self._say(say, self.now, "ACK", reply)
        self.now += 0.002

    def _lasting(self, component: str, command: str, seconds: float) -> None:
        """Add a command that takes `seconds` and the overhead, with feedback each
        FEEDBACK_S, and its end.
        """
        say, begun = self._begin(component, command, str(round(1000 * seconds))), self.now
        for k in range(1, math.ceil(seconds / FEEDBACK_S)):
            self._feedback(say, begun + k * FEEDBACK_S, None)
        self.now += seconds + self._more()
        if self.dialect.end != "none":
            self._say(say, self.now, "ACK", "")
        self.now += 0.002

    def _more(self) -> float:
        if self.overhead is None:
            return self.rng.uniform(0.001, 0.08)
        return self.overhead[0] * math.exp(self.rng.gauss(0.0, self.overhead[1]))

    # -- how it is written -------------------------------------------------------------------

    def _begin(self, component: str, command: str, argument: str) -> dict[str, Any]:
        """Write a command and, where the dialect reports it, that it has been received.

        In dialects with raw messages something that is no message follows now and then.

        Returns:
            The message, for the replies to it.
        """
        dialect, rng = self.dialect, self.rng
        self._count += 1
        number: object = {
            "whole": rng.getrandbits(64), "float": rng.randint(1, 10**26), "count": self._count,
            "zero": 0, "text": str(uuid.UUID(int=rng.getrandbits(128))),
        }[dialect.uuid]  # fmt: skip
        value: object = argument
        if dialect.arguments == "numbers" and argument:
            value = float(argument) if "." in argument else int(argument)
        said: dict[str, Any] = {
            "component": component, "comp_phys": "", "command": command, "arg1": value,
            "arg2": "", "reply": "", "reply type": dialect.send, "comp_type": "other",
            "tick count": self._tick(self.now), "UUID": number,
        }  # fmt: skip
        if dialect.tick == "none":
            del said["tick count"], said["comp_type"]
        self._write(self.now, said)
        if dialect.received:
            self._say(said, self.now + 0.0005, "RCV", "")
        if dialect.raw and rng.random() < 0.05:
            self.messages.append(
                (self.now, rng.choice((b"hello", b"<xml/>", b"\xff\xfe", b"[1, 2]")))
            )
        return said

    def _feedback(self, said: dict[str, Any], at: float, position: float | None) -> None:
        """Write that a command goes on, as the dialect puts it; nothing in dialects
        without feedback.

        Args:
            said: the command's message.
            at: when [s].
            position: of the axis that moves; None if none does.
        """
        kind = self.dialect.feedback
        if kind == "none":
            return
        text = f"{position:.10f}" if kind == "position" and position is not None else ""
        self._say(said, at, "FDB", f"Moving... {at:.0f} sec" if kind == "text" else text)

    def _say(self, said: dict[str, Any], at: float, what: str, reply: str) -> None:
        """Write a reply to a command, with what the dialect leaves out or changes in
        replies.

        Args:
            said: the command's message; it is not changed.
            at: when [s].
            what: the reply type: RCV, FDB or ACK.
            reply: the text.
        """
        told, tick = {**said, "reply type": what, "reply": reply}, self.dialect.tick
        if self.dialect.arguments == "none":
            told |= {"arg1": "", "arg2": ""}
        if tick == "renewed" or (tick == "renewed FDB" and what == "FDB"):
            told["tick count"] = self._tick(at)
        if self.dialect.uuid == "float":
            told["UUID"] = float(said["UUID"])
        self._write(at, told)

    def _tick(self, at: float) -> int:
        return 7 if self.dialect.tick == "constant" else self._ticks + round(1000 * at)

    def _write(self, at: float, told: dict[str, Any]) -> None:
        """Append a message as the bytes of the dialect, twice (3 ms apart) where it
        doubles all.
        """
        text = json.dumps(
            told, indent=4 if self.dialect.indented else None, ensure_ascii=False
        )
        data = (self.dialect.topic + text).encode()
        self.messages.append((at, data))
        if self.dialect.doubled:
            self.messages.append((at + 0.003, data))


FAULTS = ("slow", "offset", "limits", "beyond", "hangs")
SLIPS = ("dropped", "doubled", "late", "lost end", "late end", "overtaken")


def conversation(dialect: Dialect, seed: int, commands: int = 8) -> Conversation:
    """Draw a conversation: some commands, perhaps a fault of the server, then perhaps one
    of the machine.

    The same dialect, seed and number give the same conversation. The fault of the machine
    is in a move beyond the commands, three seconds after the last.

    Args:
        dialect: how messages are written.
        seed: of all that is drawn.
        commands: how many; at least two.
    """
    rng = random.Random(f"{dialect.name} {seed}")
    made = Conversation(dialect, rng)
    fault, slip = rng.choice(("", *FAULTS)), rng.choice(("", *SLIPS))
    slips = rng.randint(1, commands - 1)
    for k in range(commands):
        if k == slips and slip:
            made.move(slip=slip)
        else:
            made.command()
    if fault:
        made.now += 3.0
        made.move(fault)
    return made


def healthy(
    dialect: Dialect,
    seed: int,
    seconds: float,
    overhead: tuple[float, float] | None = None,
) -> Iterator[Message]:
    """So many seconds of a machine and a server without a fault, nearly in order.

    Args:
        dialect: how messages are written.
        seed: of all that is drawn.
        seconds: of the machine's time, at least; the last command is ended.
        overhead: see `Conversation`.
    """
    made = Conversation(
        dialect, random.Random(f"{dialect.name} healthy {seed}"), overhead=overhead
    )
    while made.now < seconds:
        made.command()
        made.now += made.rng.choice((0.0, 0.0, made.rng.uniform(0.0, 20.0)))
        yield from made.heard()
        made.messages.clear()


def trapezium(way: float, speed: float, acceleration: float) -> float:
    """How long a move from rest to rest takes [s]."""
    if way < speed**2 / acceleration:
        return 2.0 * math.sqrt(way / acceleration)
    return way / speed + speed / acceleration


def travelled(time: float, way: float, speed: float, acceleration: float) -> float:
    """How far a move from rest to rest has got: 0 before it begins, the whole way after.

    Args:
        time: since it began [s].
        way: whole length, 0 or more.
        speed: the most.
        acceleration: of both ramps.
    """
    whole = trapezium(way, speed, acceleration)
    t = min(max(time, 0.0), whole)
    ramp = min(speed / acceleration, whole / 2.0)
    if t <= ramp:
        return 0.5 * acceleration * t * t
    if t >= whole - ramp:
        return way - 0.5 * acceleration * (whole - t) ** 2
    return 0.5 * acceleration * ramp**2 + acceleration * ramp * (t - ramp)


def reached(done: float, way: float, speed: float, acceleration: float) -> float:
    """When a move has got so far, by bisection [s]."""
    low, high = 0.0, trapezium(way, speed, acceleration)
    for _ in range(50):
        middle = 0.5 * (low + high)
        early = travelled(middle, way, speed, acceleration) < done
        low, high = (middle, high) if early else (low, middle)
    return low


def cluster(
    position: float, target: float, speed: float, acceleration: float, lower: float, upper: float,
    most_speed: float, most_acceleration: float,
) -> str:  # fmt: skip
    """A motor's status as the scanner flattens it, one character for each byte (latin-1)."""
    head = (position, target, speed, 0.0, acceleration, upper, lower, 0.0, most_speed, 0.0,
            most_acceleration, *[0.0] * 6)  # fmt: skip
    data = (
        struct.pack(">17d", *head)
        + bytes(7)
        + struct.pack(">2d", upper, lower)
        + bytes(108)
    )
    return data.decode("latin-1")
