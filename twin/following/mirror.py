"""The knowledge about a followed machine at one moment: plain, frozen values.

Positions are in the script's sign and unit (mm, deg); times are those of the listener
[s]. Every value is as old as the message that it came from, and has its time.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field, replace
from typing import Final, Literal

from flexdt.twin.findings import Severity
from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.machine.description import Machine
from flexdt.twin.motion.profiles import Trajectory
from flexdt.twin.script import commands as c
from flexdt.twin.script.planning.plan_values import StartState

MAX_ALARMS: Final = 100
"""Number of alarms that a mirror keeps, the newest; all are counted."""
MAX_WAITING: Final = 256
"""Largest number of commands without an end, and of ended ones, that are remembered."""

What = Literal["SEND", "RCV", "FDB", "ACK", "ERR"]
Identity = tuple[Hashable, int, tuple[str, str, str, str]]


@dataclass(frozen=True)
class Heard:
    """One message of the scanner's interface.

    Attributes:
        key: a command and its replies have the same, and seldom other commands.
        what: SEND is a command, the others reply to one.
        words: component, command, argument 1 and 2, as they came.
        command: the same, typed; None where it is none of a script.
        reply: text of a reply; of a cluster one character for each byte.
        asks: of a question, the quantity of its answer: `position`, `kV`...
        stamp: time of day at which it came, hh:mm:ss.mmm, for the record.
        tick: the sender's clock, copied into replies by some programs and renewed by
            others.
        late_s: by how much earlier it may have come than it was read [s].
    """

    key: Hashable
    what: What
    words: tuple[str, str, str, str]
    command: c.Command | None = None
    reply: str = ""
    asks: str = ""
    stamp: str = "00:00:00.000"
    tick: int = 0
    late_s: float = 0.0

    @property
    def identity(self) -> Identity:
        """Key, tick and words: equal for a command that is heard twice."""
        return self.key, self.tick, self.words

    @property
    def named(self) -> bool:
        """Whether the message has a UUID."""
        return self.key != " ".join(self.words[:2])

    def may_answer(self, command: Identity) -> bool:
        """Return whether this message can be a reply to a command: by its key, and without a
        UUID by its arguments, too. Arguments of such a reply must be the command's or empty."""
        same = self.words[2:] in (command[2][2:], ("", ""))
        return command[0] == self.key and (self.named or same)

    @property
    def text(self) -> str:
        """The command in one line."""
        return " ".join(word for word in self.words if word)[:120]


@dataclass(frozen=True)
class Alarm:
    """Something to look at.

    Attributes:
        at_s: when it was noticed.
        severity: `warning` for a healthy machine's deviations (one time in ten is outside
            a 90 % range), `error` for others.
        kind: `limit`, `limits`, `limit_near`, `offset`, `moved`, `slow`, `fast`,
            `off_path`, `range`, `late`, `collision`, `clearance`, `failed`, `off_script`,
            `unknown_axis`, `silent`, `lost`, or a code of `flexdt check`.
        about: axis, component or line that it is about.
        message: one readable line.
    """

    at_s: float
    severity: Severity
    kind: str
    about: str
    message: str


@dataclass(frozen=True)
class SeenAxis:
    """One motor.

    Attributes:
        position: heard last, or home where `heard_s` is None.
        target: its place at rest, or its target.
        speed, acceleration: in force for moves to come.
        heard_s: when the position was heard; None: never, so it is assumed.
        path: predicted motion, in the listener's time; None at rest.
        mover: the command that `path` is of.
        begun_s: how much earlier than `path` it may have begun [s].
        delay_s: by how much it may be behind `path`: the most that a move takes beyond
            its motion.
        passed_s: the latest moment of `path` that a reading has shown.
        behind_s: (at least, at most) by how much the promptest reading was behind `path`.
    """

    position: float
    target: float
    speed: float
    acceleration: float
    heard_s: float | None = None
    path: Trajectory | None = None
    mover: Identity | None = None
    begun_s: float = 0.0
    delay_s: float = 0.0
    passed_s: float = -math.inf
    behind_s: tuple[float, float] | None = None

    @property
    def at_rest(self) -> SeenAxis:
        """The axis without a path."""
        return replace(self, path=None, mover=None, passed_s=-math.inf, behind_s=None)


@dataclass(frozen=True)
class Waiting:
    """A command of which no end has been heard; times [s], None where nothing is predicted."""

    heard: Heard
    sent_s: float
    told_s: float
    """Time of the last message about it."""
    predicted_s: float | None = None
    least_s: float = 0.0
    most_s: float = 0.0
    targets: Mapping[str, float] = field(default_factory=dict)
    """Motor -> target of a move [mm, deg]."""
    written: bool = False
    """Whether the record has it already."""
    superseded: bool = False
    """Whether it counts as over without an end: its time is over and its component goes on."""


@dataclass(frozen=True)
class Mirror:
    """A followed machine.

    Attributes:
        axes: motors by name.
        camera, kV, power_W: settings, the machine's defaults until heard.
        xrays_on: None until heard.
        ready_s: when X-rays are predicted to be ready.
        waiting: commands without an end yet, oldest first.
        ended: commands that have ended, oldest first, and whether only their end was
            heard.
        ends: whether the server reports the end of commands; None until one has been
            heard to, False once one was overdue before.
        speaks: whether the server reports long commands once a second; False once one was
            not.
        heard_s: when the last message came.
        connected: whether there is a link.
        alarms: the newest, oldest first; `raised` counts all.
        active: (kind, about) of conditions that hold and are not reported again.
        next_line: index of the script's next command; `began_s` when its first was heard,
            and `due_s` by when the next is sent, nine of ten times.
        lines: additions of the last message to the record.
    """

    axes: Mapping[str, SeenAxis]
    camera: CameraSettings
    kV: float
    power_W: float
    xrays_on: bool | None = None
    ready_s: float = 0.0
    waiting: Mapping[Identity, Waiting] = field(default_factory=dict)
    ended: Mapping[Identity, bool] = field(default_factory=dict)
    ends: bool | None = None
    speaks: bool | None = None
    heard_s: float | None = None
    connected: bool = False
    alarms: tuple[Alarm, ...] = ()
    raised: int = 0
    active: frozenset[tuple[str, str]] = frozenset()
    next_line: int = 0
    began_s: float | None = None
    due_s: float | None = None
    lines: tuple[bytes, ...] = ()

    @classmethod
    def of(cls, machine: Machine) -> Mirror:
        """Make the mirror before any message: motors at home, the machine's default settings.

        All of it is assumed; whether X-rays are on is unknown.
        """
        axes = {
            n: SeenAxis(a.home, a.home, a.speed, a.acceleration)
            for n, a in machine.axes.items()
        }
        return cls(axes, machine.detector.camera, machine.tube.kV, machine.tube.power_W)

    @property
    def positions(self) -> dict[str, float]:
        """Motor -> position [mm, deg], as heard last."""
        return {name: axis.position for name, axis in self.axes.items()}

    @property
    def assumed(self) -> tuple[str, ...]:
        """Motors whose position has not been heard."""
        return tuple(name for name, axis in self.axes.items() if axis.heard_s is None)

    @property
    def start(self) -> StartState:
        """The mirrored state as the start of a plan: positions and rates of all motors,
        camera, tube, X-rays (None: unknown).
        """
        return StartState(
            self.positions,
            {n: a.speed for n, a in self.axes.items()},
            {n: a.acceleration for n, a in self.axes.items()},
            self.camera,
            self.kV,
            self.power_W,
            self.xrays_on,
        )

    def command_of(self, reply: Heard) -> Waiting | None:
        """Find the waiting command that `reply` may answer; None if there is none.

        Of several the one with the same component and command, then the same tick, is
        taken; of equals the oldest.
        """

        def alike(waiting: Waiting) -> tuple[bool, bool]:
            """Rank a waiting command for `max`: by agreement of component and command,
            then of tick.
            """
            return waiting.heard.words[:2] == reply.words[
                :2
            ], waiting.heard.tick == reply.tick

        candidates = (w for i, w in self.waiting.items() if reply.may_answer(i))
        return max(candidates, key=alike, default=None)

    def with_waiting(self, command: Waiting, **changes: object) -> Mirror:
        """Return the mirror with fields of a command changed; it is added to those that
        wait if it is not among them."""
        changed = replace(command, **changes)  # type: ignore[arg-type]
        return replace(self, waiting={**self.waiting, command.heard.identity: changed})

    def finished(self, command: Heard, unheard: bool = False) -> Mirror:
        """Move a command from waiting to ended; only the last `MAX_WAITING` ended ones are kept.

        `command`: that has ended; `unheard`: whether only its end was heard."""
        left = {i: w for i, w in self.waiting.items() if i != command.identity}
        newest = dict(list(self.ended.items())[1 - MAX_WAITING :])
        return replace(self, waiting=left, ended={**newest, command.identity: unheard})

    @property
    def under_way(self) -> tuple[str, ...]:
        """Commands that have not ended, as far as is known."""
        return tuple(w.heard.text for w in self.waiting.values() if not w.superseded)

    def age_s(self, now: float) -> float | None:
        """Return the age of the last message [s]; None if there was none."""
        if self.heard_s is None:
            return None
        return max(0.0, now - self.heard_s)

    def with_axis(self, name: str, **changes: object) -> Mirror:
        """Return the mirror with fields of one axis changed."""
        axes = {**self.axes, name: replace(self.axes[name], **changes)}  # type: ignore[arg-type]
        return replace(self, axes=axes)

    def sent_on(
        self, name: str, path: Trajectory, mover: Heard, delay_s: float
    ) -> Mirror:
        """Return the mirror with a motor that a command has sent on a path.

        `delay_s`: the most that a move takes beyond its motion.
        """
        axis = replace(
            self.axes[name].at_rest,
            begun_s=mover.late_s,
            delay_s=delay_s,
            path=path,
            target=path.target,
            mover=mover.identity,
        )
        return replace(self, axes={**self.axes, name: axis})

    def alarmed(self, alarm: Alarm) -> Mirror:
        """Add an alarm, unless one of its kind and subject is active already; it is
        active from then on.

        Only the last `MAX_ALARMS` are kept; `raised` counts all.
        """
        key = (alarm.kind, alarm.about)
        if key in self.active:
            return self
        newest = (*self.alarms, alarm)[-MAX_ALARMS:]
        return replace(
            self, alarms=newest, raised=self.raised + 1, active=self.active | {key}
        )

    def cleared(self, about: str, *kinds: str) -> Mirror:
        """End the active conditions about something, of `kinds` or (none given) of all kinds.

        The list of past alarms stays.
        """
        ended = {k for k in self.active if k[1] == about and (not kinds or k[0] in kinds)}
        if ended:
            return replace(self, active=self.active - ended)
        return self

    def to_dict(self, now: float) -> dict[str, object]:
        """Return the JSON form at a moment: link, axes, tube, camera, commands under way,
        script's place, alarms, and ages [s].

        An age is None where nothing was heard; an axis's `expected` is its position on
        the predicted path at `now`. Axes are in mm and deg.

        Args:
            now: moment [s].
        """

        def ago(then: float | None) -> float | None:
            """Return the age of a moment [s], to the millisecond and not below 0; None for None."""
            if then is None:
                return None
            return round(max(0.0, now - then), 3)

        return {
            "connected": self.connected,
            "age_s": ago(self.heard_s),
            "axes": {
                name: {
                    "position": a.position,
                    "target": a.target,
                    "expected": a.position if a.path is None else a.path.position(now),
                    "moving": a.path is not None and a.path.end > now,
                    "age_s": ago(a.heard_s),
                }
                for name, a in self.axes.items()
            },
            "tube": {"on": self.xrays_on, "kV": self.kV, "power_W": self.power_W},
            "camera": {**self.camera.stated, "roi": list(self.camera.roi.edges)},
            "waiting": list(self.under_way),
            "next_line": self.next_line,
            "alarms": [
                {
                    "age_s": ago(a.at_s),
                    **{n: x for n, x in vars(a).items() if n != "at_s"},
                }
                for a in self.alarms
            ],
            "raised": self.raised,
        }
