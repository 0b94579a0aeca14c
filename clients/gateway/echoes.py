"""Commands of others as the scanner's own events: every client sees every command.

Moves and settings over the twin's wire, from the viewer for one, are derived from changes
of its state; a script's commands are sent line by line as its job reaches them. Time is
an argument.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

from flexdt.clients.gateway.vocabulary import component_type
from flexdt.protocol.acquila import AcquilaEvent, Exchange
from flexdt.protocol.state_model import AxisState, JobStatus, State
from flexdt.twin.script import grammar
from flexdt.twin.script.parse import CodeLine, read_script, rows

Key = tuple[str, str]
MOVE: Final = "move absolute"
ACTIVE_STATES: Final = ("running", "paused")


@dataclass(frozen=True)
class ScriptLine:
    """A command of a script in the interface's words; `waits` for its end or not."""

    words: tuple[str, ...]
    waits: bool


def script_lines(script: bytes) -> tuple[ScriptLine, ...]:
    r"""Read the commands of a script, one a step of its plan; `waits` only for ACK.

    Example:
        >>> script_lines(b"tube\txrayon\t\t\tACK\t\t")
        (ScriptLine(words=('tube', 'xrayon', '', ''), waits=True),)
    """
    made = {row.line: row for row in rows(script)}
    found = []
    for command in read_script(script)[0].commands:
        texts = _texts(made[command.line])
        waits = command.wait.value == "ACK"
        found.append(ScriptLine(texts, waits))
    return tuple(found)


def _texts(row: CodeLine) -> tuple[str, ...]:
    """Split a row into component, command and two arguments, also in the space-padded
    form; missing ones are "", further ones are dropped.

    The result has four strings. A row without tabs is split by the grammar's command with
    the most words, else by its words.
    """
    texts = [f.text for f in (row.columns if row.columns is not None else row.words())]
    if row.columns is not None:
        matched = None
    else:
        matched = grammar.match(texts[0], texts[1:])
    if matched is not None:
        spec, count = matched
        arguments = texts[1 + count :][: spec.arguments]
        texts = [texts[0], " ".join(texts[1 : 1 + count]), *arguments]
    return (*texts, "", "", "", "")[:4]


@dataclass
class Echoes:
    """State and script lines sent so far, to derive the next events from.

    Args:
        reply: text of a completed move, from its axis and state.
    """

    reply: Callable[[str, AxisState], str]
    uuids: random.Random = field(default_factory=random.Random)
    _known: dict[Key, str] = field(default_factory=dict)
    _moves: dict[str, Exchange] = field(default_factory=dict)
    _job: str = ""
    _script: tuple[ScriptLine, ...] | None = None
    _next: int = 0
    _line: Exchange | None = None

    def adopt(self, state: State, component: str) -> None:
        """Store a component's state after a command, so that it is not echoed."""
        self._known |= {k: v for k, v in told(state).items() if k[0] == component}

    def see(
        self, state: State, own: Collection[str], now: float
    ) -> Iterator[AcquilaEvent]:
        """Yield the events for changes of the state.

        Nothing is yielded at the first call, and no changes while a script of a job is
        echoed. A move ends when its axis rests; a new target makes the former one fail.
        Components in `own` get no events. X-rays are reported as command xrayon or xrayoff
        without argument. All other changes end at once with their value; a move gives
        feedback when it is due. The state is stored as known in any case.

        Args:
            state: of the twin.
            own: components with running commands of the interface, which send their own
                events.
            now: real time [s].
        """
        new = told(state)
        for key, value in new.items() if self._known else ():
            before = self._known.get(key)
            if before in (None, value) or key[0] in own or self._script is not None:
                continue
            component, command = key
            if component in self._moves:
                yield self._moves.pop(component).failed("stopped or sent elsewhere")
            if command == "xrays":
                words = (component, value, "")
            else:
                words = (component, command, value)
            exchange, *begun = self._begin((*words, "")[:4], state, now)
            yield from begun
            if command == MOVE:
                self._moves[component] = exchange
            else:
                yield exchange.done(value if command != "xrays" else "")
        self._known = dict(new)
        for axis, exchange in list(self._moves.items()):
            if not state.axes[axis].moving:
                yield self._moves.pop(axis).done(self.reply(axis, state.axes[axis]))
            elif now >= exchange.next_feedback:
                yield exchange.feedback(f"{state.axes[axis].position:.10f}", now)

    def follow(
        self,
        status: JobStatus,
        script: Callable[[JobStatus], bytes | None],
        state: State,
        now: float,
    ) -> Iterator[AcquilaEvent]:
        """Yield the events for the lines that a job has reached.

        Yields nothing while the job is queued or its text is not there. Each line's event
        begins when the job reaches its step; the one before then ends. A job that ends
        otherwise than "done" makes its line fail. Each line ends with its reply, or at
        once if it does not wait ("command sent"); lines of components elsewhere only get
        their command sent. Feedback, when due, is the axis's position or the job's text.
        A finished job is forgotten.

        Args:
            status: of the job.
            script: returns a job's text, called once; None if it is not to be sent or
                cannot be read.
            state: of the twin.
            now: real time [s].
        """
        if status.state != "queued" and status.job != self._job:
            text = script(status)
            self._job = status.job
            self._next = 0
            self._line = None
            if text is None:
                self._script = None
            else:
                self._script = script_lines(text)
        if status.job != self._job or self._script is None:
            return
        over = status.state not in (*ACTIVE_STATES, "queued")
        if status.state == "done":
            reached = len(self._script)
        else:
            reached = 1 + (status.step or 0)
        if status.step is None and status.state != "done":
            reached = self._next
        while self._next < min(reached, len(self._script)):
            yield from self._end(state)
            line = self._script[self._next]
            words = (grammar.own_name(line.words[0], state.axes), *line.words[1:])
            self._line, *begun = self._begin(words, state, now)
            if component_type(words[0], state.axes) is None:  # whose own it is replies
                self._line = None
                begun = begun[:1]
            yield from begun
            if not line.waits:
                yield from self._end(state, "command sent")
            self._next += 1
        if self._line is not None and now >= self._line.next_feedback:
            axis = state.axes.get(self._line.command.component)
            if axis is None:
                what = status.what
            else:
                what = f"{axis.position:.10f}"
            yield self._line.feedback(what, now)
        if over:
            if status.state == "done":
                yield from self._end(state)
            elif self._line is not None:
                yield self._line.failed(f"the scan ended {status.state}")
            self._line = None
            self._script = None

    def _begin(
        self, words: tuple[str, ...], state: State, now: float
    ) -> tuple[Exchange, AcquilaEvent, AcquilaEvent]:
        """Make the exchange of a command that somebody else gave.

        An unknown component has the kind "other". The command gets a random number and the time
        [ms] modulo 2^32.

        `words`: component, command and two arguments; `state`: of the twin, which names its
        axes; `now`: time [s].
        Returns the exchange, the command's event and that of its reception.
        """
        kind = component_type(words[0], state.axes) or "other"
        uuid = self.uuids.getrandbits(52) + 1
        tick = int(now * 1000) % 2**32
        component, name, arg1, arg2 = words[:4]
        command = AcquilaEvent(
            component, name, arg1, arg2, comp_type=kind, tick_count=tick, uuid=uuid
        )
        exchange = Exchange(command, kind, now)
        return exchange, command, exchange.received(now)

    def _end(self, state: State, reply: str | None = None) -> Iterator[AcquilaEvent]:
        """End the script line under way: yield its last event; yields nothing if no line
        is under way.

        Without a `reply`: the axis's position after a move, "TRUE" after REPEAT UNTIL,
        the argument after "set ..." (except on the scanner), else "". The line is
        forgotten in any case.
        """
        line = self._line
        self._line = None
        if line is None:
            return
        if reply is None:
            axis = state.axes.get(line.command.component)
            moved = axis is not None and line.command.command == MOVE
            echoed = (
                line.command.command.startswith("set ")
                and line.command.component != "scanner"
            )
            if echoed:
                reply = line.command.arg1
            else:
                reply = ""
            if line.command.command.startswith("REPEAT UNTIL"):
                reply = "TRUE"
            if moved and axis:
                reply = self.reply(line.command.component, axis)
        yield line.done(reply)


def told(state: State) -> Mapping[Key, str]:
    """Return all values that commands can set, in the scanner's words and decimals.

    Axes have their target as a move, and speed and acceleration where these are known;
    virtual axes are left out. Decimals: 6, for speed, target and position 10. The
    camera's values are mode, exposure [ms], averages, frames and region.

    Returns:
        (component, command) -> argument; `xrays` has the command itself.
    """
    tube = state.tube
    camera = state.camera
    made = {
        ("tube", "xrays"): "xrayon" if tube.on else "xrayoff",
        ("tube", "set kV"): f"{tube.kV:.6f}",
        ("tube", "set power"): f"{tube.power_W:.6f}",
        ("camera", "set mode"): camera.mode,
        ("camera", "set exposure"): f"{camera.exposure_ms:.6f}",
        ("camera", "set number of averages"): str(camera.averages),
        ("camera", "set number of frames"): str(camera.frames),
        ("camera", "set ROI"): " ".join(map(str, camera.roi)),
    }
    for name, axis in state.axes.items():
        if axis.virtual:
            continue
        for command, value in (
            ("set speed", axis.speed),
            ("set acceleration", axis.acceleration),
        ):
            if value is not None:
                made[name, command] = f"{value:.{10 if command == 'set speed' else 6}f}"
        made[name, MOVE] = f"{axis.target:.10f}"
    return made
