"""What a message, or time that passes, changes in what is known of a followed machine.

Every function returns another `Mirror`; sockets, files and clocks belong to who calls. A command
is predicted when it is heard, from the machine as it is known at that moment, by the simulation
that plans scripts. A reading of a moving motor is compared with the predicted path as a delay: when
the path passes that position, and how long ago. A motor that starts late has a constant delay, one
that is slow a growing one, whatever the machine's overhead.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

from flexdt.twin.following.mirror import MOST_WAITING, Alarm, Heard, Mirror, Waiting
from flexdt.twin.machine.description import Machine, Profile, unknown_axis
from flexdt.twin.script import commands as c
from flexdt.twin.script.executed_log import MotorReply, log_line, motor_reply
from flexdt.twin.script.grammar import FIXED, ArgumentError, describe, find, number
from flexdt.twin.script.planning.dry_run import CollisionCheck, check_plan
from flexdt.twin.script.planning.plan import PlanStep, Range, SampleSize, step_range, total_range
from flexdt.twin.script.planning.planner import plan_script, simulated
from flexdt.twin.script.planning.simulated_script import Simulation
from flexdt.twin.script.problems import Severity

NEAR_LIMIT: Final = 0.5
"""Distance of a target from a limit that is worth telling [mm or deg]."""
NEAR_PART_MM: Final = 5.0
"""Clearance on the way, beyond the safety margin, that is worth telling."""
AT_TARGET: Final = 0.02
"""How far from its target a motor may stand [mm or deg]; the public log's are within 0.005."""
SLACK_S: Final = 0.3
"""What sockets, and the age of a reading when it is sent, add to a time."""
DRIFT_S: Final = 0.25
"""By how much the delay behind the predicted path may grow during a move."""
SILENT_S: Final = 2.5
"""The interface's rules ask for one message a second of a command that lasts."""
FORGET_S: Final = 60.0
"""A command that has said nothing for so long, and beyond its range, has no end any more."""
_OF_A_MOVE: Final = ("limit", "limit_near", "slow", "fast", "off_path", "offset", "moved")
"""What was told of an axis's last move is told anew of its next."""
_OF_ONE_COMMAND: Final = {
    "limit": "limit", "limit_clamped": "limit", "mode": "mode", "roi": "roi",
    "xray_never_ready": "xray_never_ready",
}  # fmt: skip
"""Problems that a plan of one command tells, and the kinds of alarm that they are; the others, such
as no image to save, come from planning it alone."""


@dataclass(frozen=True)
class Follower:
    """A machine to compare with, and the script that is expected, if any.

    Args:
        machine: predicts: limits, rates, times, bodies.
        profile: zero offsets, for the bodies.
        script: what is expected to run; None for anything.
        sample: its size, for what is ahead.
        collision: finds contacts; None leaves them unchecked.

    Example:
        >>> from flexdt.twin.machine.description import builtin_machine, builtin_profile
        >>> flexray = builtin_machine("flexray")
        >>> follower = Follower(flexray, builtin_profile(flexray.default_profile))
        >>> words = ("tra_obj", "move absolute", "900", "")
        >>> move = Heard(1, "SEND", words, c.MoveAbsolute(component="tra_obj", target=900.0))
        >>> [(a.kind, a.about) for a in follower.hear(Mirror.of(flexray), move, now=0.0).alarms]
        [('limit', 'tra_obj')]
    """

    machine: Machine
    profile: Profile
    script: c.Script | None = None
    sample: SampleSize | None = None
    collision: CollisionCheck | None = None

    def hear(self, mirror: Mirror, heard: Heard, now: float) -> Mirror:
        """The machine after a message.

        Args:
            mirror: before it.
            heard: the message.
            now: when it came [s].
        """
        mirror = replace(mirror, heard_s=now, lines=(), connected=True)
        mirror = mirror.cleared("link")
        if heard.key in mirror.waiting:
            told = replace(mirror.waiting[heard.key], told_s=now)
            mirror = replace(mirror, waiting={**mirror.waiting, heard.key: told})
            mirror = mirror.cleared(heard.words[0], "silent")
        match heard.what:
            case "SEND":
                return self._sent(mirror, heard, now)
            case "FDB":
                return self._read(mirror, heard, now)
            case "ACK" | "ERR":
                return self._ended(mirror, heard, now)
        return mirror

    def tick(self, mirror: Mirror, now: float) -> Mirror:
        """The machine after time has passed without a message: what is overdue is told."""
        for key, waiting in mirror.waiting.items():
            took, quiet = now - waiting.sent_s, now - waiting.told_s
            if waiting.predicted_s is not None and took > waiting.p95_s + SLACK_S:
                mirror = self._outside(mirror, waiting, took, now)
            if quiet > SILENT_S and waiting.predicted_s is not None:
                what = f"{waiting.heard.text!r} is under way and has said nothing for {quiet:.1f} s"
                about = waiting.heard.words[0]
                mirror = _alarm(mirror, now, "warning", "silent", about, what)
            if quiet > max(FORGET_S, waiting.p95_s):
                left = {k: w for k, w in mirror.waiting.items() if k != key}
                mirror = self._rests(replace(mirror, waiting=left), waiting)
        if mirror.due_s is not None and now > mirror.due_s + SLACK_S:
            what = (
                f"the script is late: {self._next(mirror)} was due {now - mirror.due_s:.1f} s ago"
            )
            mirror = _alarm(mirror, now, "error", "late", "script", what)
        return mirror

    def linked(self, mirror: Mirror, connected: bool, now: float, why: str = "") -> Mirror:
        """The machine after the link has come up or gone down, which forgets commands under way."""
        if connected:
            return replace(mirror.cleared("link"), connected=True)
        axes = {n: replace(a, path=None, behind_s=None) for n, a in mirror.axes.items()}
        mirror = replace(mirror, connected=False, waiting={}, axes=axes, due_s=None)
        what = f"the link is lost: {why}; positions are those heard last"
        return _alarm(mirror, now, "error", "lost", "link", what)

    def told(self, mirror: Mirror, alarms: Iterable[Alarm]) -> Mirror:
        """The machine after `ahead` has found these; those that it finds again are not new."""
        found = tuple(alarms)
        still = {(a.kind, a.about) for a in found}
        kept = {k for k in mirror.active if not k[1].startswith("ahead") or k in still}
        mirror = replace(mirror, active=frozenset(kept))
        for alarm in found:
            mirror = mirror.alarmed(alarm)
        return mirror

    def ahead(self, mirror: Mirror, now: float) -> tuple[Alarm, ...]:
        """What goes wrong from here on: moves under way, and the rest of the script.

        This takes as long as `flexdt check` does. Motors of which nothing has been heard are
        assumed at home, and each alarm says so.
        """
        under_way = [
            c.MoveAbsolute(component=name, target=axis.target)
            for name, axis in mirror.axes.items()
            if axis.path is not None and axis.path.end > now
        ]
        rest = () if self.script is None else self.script.commands[mirror.next_line :]
        commands = c.Script.of([*under_way, *rest])
        plan = plan_script(
            commands, self.machine, self.profile, start=mirror.start, sample=self.sample
        )
        collision = self.collision if self.machine.components else None
        report = check_plan(plan, (), collision)
        assumed = f" ({', '.join(mirror.assumed)} assumed at home)" if mirror.assumed else ""
        found: dict[tuple[str, int], Alarm] = {}
        for p in report.errors:  # of the contacts of one line, the first
            where = f"line {p.line}" if p.line else "the move under way"
            what = f"{where}: {p.message}{assumed}"
            alarm = Alarm(now, "error", p.code, f"ahead, {where}", what)
            found.setdefault((p.code, p.line), alarm)
        near = report.clearance
        bound = self.machine.safety_margin_mm + NEAR_PART_MM
        if near and not near.collisions and (near.min_clearance_mm or bound) < bound:
            parts = " and ".join(near.min_clearance_pair or ())
            what = f"{parts} come within {near.min_clearance_mm:.2f} mm{assumed}"
            found["clearance", 0] = Alarm(now, "warning", "clearance", "ahead", what)
        return tuple(found.values())

    # -- commands ----------------------------------------------------------------------------

    def _sent(self, mirror: Mirror, heard: Heard, now: float) -> Mirror:
        if heard.key in mirror.waiting:
            return mirror
        if not heard.asks:
            mirror = _flushed(mirror, now)
        name, asked = heard.words[:2]
        if not (name in FIXED or self.machine.has(name)) and find(name, asked) is not None:
            what = f"{heard.text!r} is not followed: {unknown_axis(name, self.machine).message}"
            mirror = _alarm(mirror, now, "error", "unknown_axis", name, what)
        if asked.lower() == "stop":
            axes = {n: replace(a, path=None, behind_s=None) for n, a in mirror.axes.items()}
            mirror = replace(mirror, axes=axes)
        waiting = Waiting(heard, now, now)
        if heard.command is not None:
            mirror = self._on_script(mirror, heard.command, now)
            mirror, waiting = self._predicted(mirror, waiting, heard.command, now)
        kept = dict(list(mirror.waiting.items())[1 - MOST_WAITING :])
        return replace(mirror, waiting={**kept, heard.key: waiting})

    def _predicted(
        self, mirror: Mirror, waiting: Waiting, command: c.Command, now: float
    ) -> tuple[Mirror, Waiting]:
        """The prediction of one command, from the machine as it is now."""
        if isinstance(command, c.MoveAbsolute):
            command = replace(command, trigger=None)
        sim = Simulation(self.machine, mirror.start)
        sim.now, sim.tube.ready_at = now, mirror.ready_s
        for name, axis in mirror.axes.items():
            if axis.path is not None and axis.path.end > now:
                sim.motors.all[name].moves.append((axis.path.start, axis.path))
        sim.run((replace(command, wait=c.Wait.ACK),))
        step = sim.steps[0]
        moved = tuple(n for n, m in sim.motors.all.items() if m.moves and m.moves[-1][0] == now)
        about = getattr(command, "component", "") or waiting.heard.words[0]
        if isinstance(command, c.MoveAbsolute):
            mirror = mirror.cleared(about, *_OF_A_MOVE)
        for p in sim.findings.problems:
            if p.code in _OF_ONE_COMMAND and not (mirror.xrays_on is None and "xray" in p.code):
                kind = _OF_ONE_COMMAND[p.code]
                mirror = _alarm(mirror, now, "error", kind, about, p.message)
        for name in moved:
            path = sim.motors.all[name].moves[-1][1]
            mirror = mirror.with_axis(name, path=path, target=path.target, behind_s=None)
            mirror = self._near_limit(mirror, name, path.target, now)
        low, high = _range(step, self.machine)
        known = waiting.heard.words[0] in (*self.machine.axes, *self.machine.virtual_axes)
        moving = isinstance(command, c.MoveAbsolute) and known
        motors = tuple(self.machine.moves(about)) if moving else ()
        return mirror, replace(
            waiting,
            predicted_s=step.holds_s,
            p5_s=low,
            p95_s=high,
            motors=motors,
            delay_s=max(0.0, high - step.computed_s),
        )

    def _near_limit(self, mirror: Mirror, name: str, target: float, now: float) -> Mirror:
        axis = self.machine.axes[name]
        left = min(target - axis.lower, axis.upper - target)
        if left >= NEAR_LIMIT or ("limit", name) in mirror.active:
            return mirror
        what = f"{name} goes to {target:g} {axis.unit}, {left:g} from a limit"
        return _alarm(mirror, now, "warning", "limit_near", name, what)

    def _on_script(self, mirror: Mirror, command: c.Command, now: float) -> Mirror:
        """Where in the script this command is."""
        if self.script is None:
            return mirror
        bare, lines, at = _bare(command), self._bare, mirror.next_line
        if at >= len(lines) and lines and bare == lines[0]:
            at = 0
        if at < len(lines) and bare == lines[at]:
            began = now if at == 0 or mirror.began_s is None else mirror.began_s
            steps = self._steps[: at + 1]
            holds = sum(s.holds_s for s in steps)
            found = total_range(steps, holds, self.machine.timing)
            high = sum(_range(s, self.machine)[1] for s in steps) if found is None else found[1]
            due = began + high if at + 1 < len(lines) else None
            mirror = mirror.cleared("script")
            return replace(mirror, next_line=at + 1, began_s=began, due_s=due)
        if mirror.began_s is None or at >= len(lines):
            return mirror
        what = f"{describe(command)!r} is not {self._next(mirror)}"
        return _alarm(mirror, now, "warning", "off_script", "script", what)

    @cached_property
    def _bare(self) -> tuple[c.Command, ...]:
        return () if self.script is None else tuple(map(_bare, self.script.commands))

    @cached_property
    def _steps(self) -> tuple[PlanStep, ...]:
        if self.script is None:
            return ()
        start = Mirror.of(self.machine).start
        return tuple(simulated(tuple(self.script.commands), self.machine, start).steps)

    def _next(self, mirror: Mirror) -> str:
        if self.script is None or mirror.next_line >= len(self.script.commands):
            return "the script's end"
        command = self.script.commands[mirror.next_line]
        return f"line {command.line}, {describe(command)!r}"

    # -- replies -----------------------------------------------------------------------------

    def _ended(self, mirror: Mirror, heard: Heard, now: float) -> Mirror:
        waiting = mirror.waiting.get(heard.key)
        left = {k: w for k, w in mirror.waiting.items() if k != heard.key}
        mirror = replace(mirror, waiting=left)
        if heard.what == "ERR":
            mirror = _alarm(
                mirror, now, "error", "failed", heard.words[0],
                f"{heard.text}: the machine says {heard.reply[:200]!r}",
            )  # fmt: skip
            return self._rests(mirror, waiting)
        mirror = mirror.cleared(heard.words[0], "failed")
        if waiting is None:
            return self._read(mirror, heard, now)
        took = now - waiting.sent_s
        trigger = getattr(waiting.heard.command, "trigger", None)
        passed = trigger is not None and heard.reply.startswith("POS")
        lines = _line(waiting, "POS" if passed else "ACK", took, heard.reply)
        mirror = replace(mirror, lines=lines)
        if passed:  # the motor goes on, and nothing tells when it arrives
            return mirror
        if waiting.predicted_s is not None:
            if not waiting.p5_s - SLACK_S <= took <= waiting.p95_s + SLACK_S:
                mirror = self._outside(mirror, waiting, took, now)
            else:
                mirror = mirror.cleared(waiting.heard.words[0], "range")
        if waiting.motors:
            return self._arrived(mirror, waiting, heard, now)
        if waiting.heard.asks:
            return self._read(mirror, replace(heard, asks=waiting.heard.asks), now)
        return _after(mirror, waiting.heard.command, self.machine, now)

    def _arrived(self, mirror: Mirror, waiting: Waiting, heard: Heard, now: float) -> Mirror:
        """A move has ended: where, and with which limits, as its reply says."""
        axis = heard.words[0]
        motor = motor_reply(_bytes(heard.reply))
        at = motor.position if motor is not None else _number(heard.reply)
        mirror = self._rests(mirror, waiting)
        for name in waiting.motors:
            mirror = mirror.with_axis(name, position=mirror.axes[name].target, heard_s=now)
        if at is None:
            return mirror
        name, there = self._motor(axis, at)
        unit, meant = self.machine.axes[name].unit, mirror.axes[name].target
        if abs(there - meant) > AT_TARGET:
            what = f"{name} stands at {there:.6g} {unit} after a move to {meant:.6g}"
            mirror = _alarm(mirror, now, "error", "offset", name, what)
        mirror = mirror.with_axis(name, position=there)
        return mirror if motor is None else self._compared(mirror, name, motor, now)

    def _compared(self, mirror: Mirror, name: str, motor: MotorReply, now: float) -> Mirror:
        """Limits and rates of a motor's own reply beside those of the machine file."""
        axis = self.machine.axes[name]
        for what, theirs, ours in (
            ("limits", (motor.lower, motor.upper), (axis.lower, axis.upper)),
            (
                "rates",
                (motor.max_speed, motor.max_acceleration),
                (axis.max_speed, axis.max_acceleration),
            ),
        ):
            if any(abs(a - b) > 1e-6 * (1.0 + abs(b)) for a, b in zip(theirs, ours, strict=True)):
                text = (
                    f"{name}: the motor's own {what} are {theirs[0]:g} and {theirs[1]:g}, machine "
                    f"{self.machine.name} has {ours[0]:g} and {ours[1]:g}"
                )
                mirror = _alarm(mirror, now, "error", what, name, text)
        return mirror.with_axis(name, speed=motor.speed, acceleration=motor.acceleration)

    def _rests(self, mirror: Mirror, waiting: Waiting | None) -> Mirror:
        for name in () if waiting is None else waiting.motors:
            mirror = mirror.with_axis(name, path=None, behind_s=None)
        return mirror

    def _read(self, mirror: Mirror, heard: Heard, now: float) -> Mirror:
        """Feedback, or the answer to a question: a motor's position is compared with its path."""
        waiting = mirror.waiting.get(heard.key)
        asks = heard.asks or (waiting.heard.asks if waiting is not None else "")
        axis, motor = heard.words[0], motor_reply(_bytes(heard.reply))
        at = motor.position if motor is not None else _number(heard.reply)
        moves = waiting is not None and bool(waiting.motors)
        known = self.machine.has(axis) and (moves or asks == "position" or motor is not None)
        if at is None or not known:
            return mirror
        name, x = self._motor(axis, at)
        seen, path = mirror.axes[name], mirror.axes[name].path
        mirror = mirror.with_axis(name, position=x, heard_s=now)
        unit = self.machine.axes[name].unit
        if path is None:
            if seen.heard_s is not None and abs(x - seen.position) > AT_TARGET:
                what = (
                    f"{name} stands at {x:.6g} {unit}, not at {seen.position:.6g}, and no move of "
                    "it was heard"
                )
                mirror = _alarm(mirror, now, "error", "moved", name, what)
            return mirror.with_axis(name, target=x)
        if abs(x - path.pieces[0].position) <= AT_TARGET or abs(x - path.target) <= AT_TARGET:
            return mirror
        passes = path.time_at(x)
        if passes is None:
            what = f"{name} is at {x:.6g} {unit}, on no way to {path.target:.6g}"
            return _alarm(mirror, now, "error", "off_path", name, what)
        behind = now - passes
        longest = waiting.delay_s if waiting is not None else 0.0
        before = seen.behind_s
        if behind > longest + SLACK_S or (before is not None and behind - before > DRIFT_S):
            what = f"{name} is slow: {behind:.2f} s behind the predicted path at {x:.6g} {unit}"
            mirror = _alarm(mirror, now, "error", "slow", name, what)
        elif behind < -SLACK_S or (before is not None and before - behind > DRIFT_S):
            what = f"{name} is fast: {-behind:.2f} s ahead of the predicted path at {x:.6g} {unit}"
            mirror = _alarm(mirror, now, "error", "fast", name, what)
        return mirror.with_axis(name, behind_s=behind if before is None else before)

    def _motor(self, axis: str, at: float) -> tuple[str, float]:
        """The motor that a reading is of; of a virtual axis, the one that it is read from."""
        virtual = self.machine.virtual_axes.get(axis)
        if virtual is None:
            return axis, at
        return virtual.of, (at - virtual.constant) / virtual.factor

    def _outside(self, mirror: Mirror, waiting: Waiting, took: float, now: float) -> Mirror:
        longer = "more" if took > waiting.p95_s else "less"
        what = (
            f"{waiting.heard.text} has taken {took:.2f} s, {longer} than its range of "
            f"{waiting.p5_s:.2f} to {waiting.p95_s:.2f} s"
        )
        return _alarm(mirror, now, "warning", "range", waiting.heard.words[0], what)


def _alarm(
    mirror: Mirror, now: float, severity: Severity, kind: str, about: str, message: str
) -> Mirror:
    return mirror.alarmed(Alarm(now, severity, kind, about, message))


def _range(step: PlanStep, machine: Machine) -> Range:
    """(5 %, 95 %) of a step; a time that is only assumed may be anything up to twice itself."""
    found = step_range(step, machine.timing)
    return (step.computed_s, step.holds_s + step.assumed_s) if found is None else found


def _bare(command: c.Command) -> c.Command:
    """A command without its place in a text, its wait, its times and the case of its axis."""
    bare = replace(command, line=0, column=1, wait=c.Wait.ACK, timeout_ms=None, expected_ms=None)
    if isinstance(bare, c.MotorCommand):
        bare = replace(bare, component=bare.component.lower())
    return replace(bare, trigger=None) if isinstance(bare, c.MoveAbsolute) else bare


def _flushed(mirror: Mirror, now: float) -> Mirror:
    """The next command is sent, so whoever sends has not waited for those before it."""
    for key, waiting in mirror.waiting.items():
        if waiting.written or waiting.heard.asks:
            continue
        trigger = getattr(waiting.heard.command, "trigger", None)
        wait, took = ("no wait", 0.0) if trigger is None else ("POS", now - waiting.sent_s)
        lines = (*mirror.lines, *_line(waiting, wait, took, "command sent"))
        kept = {**mirror.waiting, key: replace(waiting, written=True)}
        mirror = replace(mirror, lines=lines, waiting=kept)
    return mirror


def _line(waiting: Waiting, wait: str, took: float, reply: str) -> tuple[bytes, ...]:
    """What the record gets of a command that a script can have."""
    command, words = waiting.heard.command, waiting.heard.words
    if waiting.written or command is None:
        return ()
    if isinstance(command, c.MoveAbsolute) and words[1] != "move absolute":
        words = (words[0], "move absolute", repr(command.target), "")
    return (log_line(words, wait, took, _bytes(reply), waiting.heard.stamp),)


def _bytes(text: str) -> bytes:
    """A reply's bytes: one for each character, as clusters come; or UTF-8."""
    try:
        return text.encode("latin-1")
    except UnicodeEncodeError:
        return text.encode("utf-8", "replace")


def _number(text: str) -> float | None:
    try:
        return number(text.strip(), "position")
    except ArgumentError:
        return None


def _after(mirror: Mirror, command: c.Command | None, machine: Machine, now: float) -> Mirror:
    """The mirror as the end of a command changes it."""
    match command:
        case c.CameraSetting():
            return replace(mirror, camera=replace(mirror.camera, **command.arguments))
        case c.TubeSetting():
            return replace(mirror, **command.arguments)
        case c.TakeImage() | c.TakeSequence():
            return replace(mirror, taken=mirror.taken + 1)
        case c.XrayOn():
            return replace(mirror, xrays_on=True, ready_s=now + machine.timing.xray_ready_s)
        case c.XrayOff():
            return replace(mirror, xrays_on=False)
        case c.WaitXrayReady():
            return replace(mirror, xrays_on=True, ready_s=now)
        case c.SetSpeed() | c.SetAcceleration() if machine.has(command.component):
            rates = command.arguments
            for motor, share in machine.moves(rates.pop("component")).items():
                mirror = mirror.with_axis(motor, **{n: x * abs(share) for n, x in rates.items()})
    return mirror
