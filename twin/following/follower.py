"""Changes of the knowledge about a followed machine by a message, or by time.

Every function returns another `Mirror`; sockets, files and clocks belong to the caller. A
command is predicted when it is heard, from the machine as it is known at that moment, by
the simulation that plans scripts. A reading of a moving motor is compared with the
predicted path as a delay: when the path passes that position, and how long ago. A motor
that starts late has a constant delay, one that is slow a growing one, whatever the
machine's overhead. The time of arrival is uncertain by the delay of reading, and the
value that is better for the machine is used.

Servers differ in their replies. Replies belong to commands by their UUID; a repeated
message, or one after the end, changes nothing; a missing end, and missing feedback, raise
one alarm.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, assert_never

from flexdt.twin.findings import ERROR, WARNING, Finding, FindingCode, Severity
from flexdt.twin.following.mirror import MAX_WAITING, Alarm, Heard, Mirror, Waiting
from flexdt.twin.machine.description import Machine, Profile, unknown_axis
from flexdt.twin.motion.profiles import Trajectory
from flexdt.twin.script import commands as c
from flexdt.twin.script.dry_run import CollisionCheck, check_plan
from flexdt.twin.script.executed_log import MotorReply, log_line, motor_reply, reply_bytes
from flexdt.twin.script.grammar import FIXED, ArgumentError, describe, find, number
from flexdt.twin.script.planning.open_beam_findings import OPEN_BEAM_CODES
from flexdt.twin.script.planning.plan_values import PlanStep, SampleSize
from flexdt.twin.script.planning.planner import plan_script, simulated
from flexdt.twin.script.planning.simulated_script import Simulation
from flexdt.twin.script.planning.time_ranges import Range, step_range, total_range
from flexdt.twin.script.problems import ScriptCode

NEAR_LIMIT_DISTANCE: Final = 0.5
"""Distance of a target from a limit below which a warning is given [mm or deg]."""
NEAR_PART_MM: Final = 5.0
"""Clearance on the way, beyond the safety margin, below which a warning is given [mm]."""
TARGET_TOLERANCE: Final = 0.02
"""Largest distance of a motor from its target at rest [mm or deg]; 0.005 in the public log."""
SLACK_S: Final = 0.3
"""Allowance for sockets and for the age of a reading when it is sent [s]."""
MAX_DRIFT_S: Final = 0.25
"""Largest growth of the delay behind the predicted path during a move [s]."""
MAX_SILENCE_S: Final = 2.5
"""Longest silence about a command under way [s]; the interface requires one
message a second."""
FORGOTTEN_AFTER_S: Final = 60.0
"""Silence, beyond its range, after which a command has no end any more [s]."""
WIDENING_WIDTHS: Final = 3.0
"""Widths of a 90 % range by which a time must be outside it for an alarm.

A good machine's is that far out less than once a day, for a normal or log-normal spread
of up to 50 %.
"""
_KINDS_OF_A_MOVE: Final = (
    "limit",
    "limit_near",
    "slow",
    "fast",
    "off_path",
    "offset",
    "moved",
)
"""Kinds of alarms about an axis's last move, cleared by the next."""
_KIND_OF_PROBLEM: Final[Mapping[FindingCode, str]] = {
    ScriptCode.LIMIT: "limit",
    ScriptCode.LIMIT_CLAMPED: "limit",
    ScriptCode.MODE: "mode",
    ScriptCode.ROI: "roi",
    ScriptCode.XRAY_NEVER_READY: "xray_never_ready",
}
"""Codes of problems that the plan of one command can find, and their kinds of alarm.

The others, such as no image to save, come from planning it alone.
"""


@dataclass(frozen=True)
class Follower:
    """A machine to compare with, and the script that is expected, if any.

    Args:
        machine: predicts: limits, rates, times, bodies.
        profile: zero offsets, for the bodies.
        script: the expected script; None for anything.
        sample: its size, for the check of the rest.
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
        """Update the mirror with a message: a command, feedback, an acknowledgement, its
        end or an error.

        A command is predicted (`_begin_command`), feedback is a reading
        (`_compare_reading`) and the sign of a server that speaks, unless it counts as one
        that does not, RCV only a sign of life, any other an end (`_end_command`).
        The link counts as up; an alarm of silence about the command ends, and if there
        was one, and the silence was longer than `MAX_SILENCE_S`, the server counts as one
        that does not speak.

        Args:
            mirror: before it.
            heard: the message.
            now: when it came [s].

        Returns:
            The mirror after it, with new log lines and alarms; a doubled reply or one
            after the end changes only when the machine was last heard.
        """
        mirror = replace(mirror, heard_s=now, lines=(), connected=True)
        mirror = mirror.cleared("link")
        if heard.what == "SEND":
            return self._begin_command(mirror, heard, now)
        waiting = mirror.command_of(heard)
        if waiting is None and any(
            map(heard.may_answer, mirror.ended)
        ):  # doubled, or late
            return mirror
        if waiting is not None:
            about = waiting.heard.words[0]
            if (
                "silent",
                about,
            ) in mirror.active and now - waiting.told_s > MAX_SILENCE_S:
                mirror = replace(mirror, speaks=False)
            mirror = mirror.with_waiting(waiting, told_s=now).cleared(about, "silent")
        match heard.what:
            case "FDB":
                mirror = replace(mirror, speaks=mirror.speaks is not False)
                return self._compare_reading(mirror, heard, waiting, now)
            case "RCV":
                return mirror
            case "ACK" | "ERR":
                return self._end_command(mirror, heard, waiting, now)
            case _:
                assert_never(heard.what)

    def tick(self, mirror: Mirror, now: float) -> Mirror:
        """Update the mirror after time without a message: alarms for overdue or silent
        commands.

        Only predicted ones, not superseded, count. An overdue one (`most_s` and
        `SLACK_S`) is a warning, after which ends count as not reported unless one was;
        then commands end by prediction, and arrivals are judged. Silence of
        `MAX_SILENCE_S` before is a warning, too, after which the server counts as silent,
        unless it has spoken. Commands silent for `FORGOTTEN_AFTER_S` or `most_s` are
        forgotten. The script is late `SLACK_S` after it was due. An alarm is raised once
        while it lasts.
        """
        if mirror.ends is False:
            mirror = self._end_overdue(mirror, "", now)
        for waiting in mirror.waiting.values():
            mirror = self._overdue_or_silent(mirror, waiting, now)
            quiet = now - waiting.told_s
            if quiet > max(FORGOTTEN_AFTER_S, waiting.most_s):
                mirror = _rests(mirror.finished(waiting.heard), waiting)
        if mirror.ends is False:
            mirror = self._arrivals(mirror, now)
        if mirror.due_s is not None and now > mirror.due_s + SLACK_S:
            due = f"{self._next(mirror)} was due {now - mirror.due_s:.1f} s ago"
            mirror = _alarm(
                mirror, now, ERROR, "late", "script", f"the script is late: {due}"
            )
        return mirror

    def _overdue_or_silent(self, mirror: Mirror, waiting: Waiting, now: float) -> Mirror:
        """Return the mirror, with a warning if a command under way is overdue, or silent
        before that.

        A command without a prediction, or superseded, is neither. Each of the two is only
        judged while the server is not known to keep ends, or its progress, to itself.
        """
        if waiting.predicted_s is None or waiting.superseded:
            return mirror
        took = now - waiting.sent_s
        if took > waiting.most_s + SLACK_S:
            if mirror.ends is False:
                return mirror
            mirror = self._outside(mirror, waiting, took, now)
            return replace(mirror, ends=mirror.ends or False)
        quiet = now - waiting.told_s
        if quiet <= MAX_SILENCE_S or mirror.speaks is False:
            return mirror
        message = (
            f"{waiting.heard.text!r} is under way and has said nothing for {quiet:.1f} s"
        )
        about = waiting.heard.words[0]
        mirror = _alarm(mirror, now, WARNING, "silent", about, message)
        return replace(mirror, speaks=mirror.speaks or False)

    def _arrivals(self, mirror: Mirror, now: float) -> Mirror:
        """Judge the arrival of each motor whose path is over and whose last reading is
        from after its end (`_arrival`).
        """
        for name, axis in mirror.axes.items():
            heard_s = axis.heard_s or 0.0
            path = axis.path
            if path is not None and path.end < heard_s < now - axis.delay_s - SLACK_S:
                mirror = self._arrival(mirror, name, axis.position, path.target, now)
        return mirror

    def linked(
        self, mirror: Mirror, connected: bool, now: float, why: str = ""
    ) -> Mirror:
        """Update the mirror after the link has come up or gone down.

        Coming up ends its alarms. Going down forgets commands under way and the due time,
        takes motors as at rest where last heard, and raises an error with the reason
        `why`.
        """
        if connected:
            return replace(mirror.cleared("link"), connected=True)
        axes = {n: a.at_rest for n, a in mirror.axes.items()}
        mirror = replace(mirror, connected=False, waiting={}, axes=axes, due_s=None)
        message = f"the link is lost: {why}; positions are those heard last"
        return _alarm(mirror, now, ERROR, "lost", "link", message)

    def with_ahead(self, mirror: Mirror, alarms: Iterable[Alarm]) -> Mirror:
        """Return the mirror with the alarms of `ahead`: new ones are added, and those
        that are over end.

        Active alarms whose subject begins with "ahead" end unless they are among
        `alarms`; others stay. An active one is not added again.
        """
        present = tuple(alarms)
        still = {(a.kind, a.about) for a in present}
        active = {k for k in mirror.active if not k[1].startswith("ahead") or k in still}
        mirror = replace(mirror, active=frozenset(active))
        for alarm in present:
            mirror = mirror.alarmed(alarm)
        return mirror

    def ahead(self, mirror: Mirror, now: float) -> tuple[Alarm, ...]:
        """Check the moves under way and the rest of the script, as `flexdt check` does.

        Of one line and code only the first error is kept; clearances only without
        collisions. It takes as long as such a check. Motors without a reading are assumed
        at home, which each alarm mentions. Without components or a check function,
        collisions are not checked.

        Args:
            mirror: the machine as it is known.
            now: time [s].

        Returns:
            Alarms: errors of the plan, warnings about the open beam, and one for a least
            clearance below the safety margin and `NEAR_PART_MM`.
        """
        under_way = [
            c.MoveAbsolute(component=name, target=axis.target)
            for name, axis in mirror.axes.items()
            if axis.path is not None and axis.path.end > now
        ]
        if self.script is not None:
            rest = self.script.commands[mirror.next_line :]
        else:
            rest = ()
        commands = c.Script.of([*under_way, *rest])
        plan = plan_script(
            commands, self.machine, self.profile, start=mirror.start, sample=self.sample
        )
        collision = None
        if self.machine.components:
            collision = self.collision
        report = check_plan(plan, (), collision)
        assumed = ""
        if mirror.assumed:
            assumed = f" ({', '.join(mirror.assumed)} assumed at home)"
        alarms: dict[tuple[str, int], Alarm] = {}
        exposures = report.warnings.of(*OPEN_BEAM_CODES)
        for p in (*report.errors, *exposures):  # of the contacts of one line, the first
            where = "the move under way"
            if p.line:
                where = f"line {p.line}"
            message = f"{where}: {p.message}{assumed}"
            alarm = Alarm(now, p.severity, p.code.value, f"ahead, {where}", message)
            alarms.setdefault((p.code, p.line), alarm)
        near = report.clearance
        bound = self.machine.safety_margin_mm + NEAR_PART_MM
        if near and not near.collisions and (near.min_clearance_mm or bound) < bound:
            parts = " and ".join(near.min_clearance_pair or ())
            message = f"{parts} come within {near.min_clearance_mm:.2f} mm{assumed}"
            alarms["clearance", 0] = Alarm(now, WARNING, "clearance", "ahead", message)
        return tuple(alarms.values())

    # -- commands ----------------------------------------------------------------------------

    def _begin_command(self, mirror: Mirror, heard: Heard, now: float) -> Mirror:
        """Update the mirror with a command: prediction, place in the script, command
        under way.

        A command that was heard before changes nothing; one whose end was heard first is
        applied at once. A command (no question) ends earlier ones of its component whose
        time is over, and writes log lines of those that were not waited for. An unknown
        axis is an alarm; a stop ends all predicted paths. At most `MAX_WAITING` are kept,
        the newest.

        Args:
            mirror: present state.
            heard: message with the command.
            now: moment [s].
        """
        again = (i for i in mirror.waiting if (i[0], i[2]) == (heard.key, heard.words))
        if any(again) or (heard.named and heard.identity in mirror.ended):
            return mirror
        ends = [(i[0], i[2][:2]) for i, unheard in mirror.ended.items() if unheard]
        if (
            heard.named and (heard.key, heard.words[:2]) in ends
        ):  # its end was heard before it
            return _apply_settings(
                mirror.finished(heard), heard.command, self.machine, now
            )
        if not heard.asks:
            mirror = self._end_overdue(_record_unwaited(mirror, now), heard.words[0], now)
        name, argument = heard.words[:2]
        if (
            not (name in FIXED or self.machine.has(name))
            and find(name, argument) is not None
        ):
            message = f"{heard.text!r} is not followed: {unknown_axis(name, self.machine).message}"
            mirror = _alarm(mirror, now, ERROR, "unknown_axis", name, message)
        if argument.lower() == "stop":
            mirror = replace(mirror, axes={n: a.at_rest for n, a in mirror.axes.items()})
        waiting = Waiting(heard, now, now)
        if heard.command is not None:
            mirror = self._follow_script(mirror, heard.command, now)
            mirror, waiting = self._predict(mirror, waiting, heard.command, now)
        newest = dict(list(mirror.waiting.items())[1 - MAX_WAITING :])
        return replace(mirror, waiting={**newest, heard.identity: waiting})

    def _end_overdue(self, mirror: Mirror, component: str, now: float) -> Mirror:
        """Mark commands of a component ("": all) whose predicted time is over as ended.

        Their settings are applied, without alarms. One without a prediction is over at
        once; each ends once, as superseded, and stays in `waiting`. A message's lateness
        counts as passed.
        """
        for waiting in mirror.waiting.values():
            over = now + waiting.heard.late_s - waiting.sent_s > (
                waiting.predicted_s or 0.0
            )
            if (
                over
                and not waiting.superseded
                and component in ("", waiting.heard.words[0])
            ):
                mirror = _apply_settings(mirror, waiting.heard.command, self.machine, now)
                mirror = mirror.with_waiting(waiting, superseded=True)
        return mirror

    def _predict(
        self, mirror: Mirror, waiting: Waiting, command: c.Command, now: float
    ) -> tuple[Mirror, Waiting]:
        """Predict one command, from the machine as it is now: paths and targets of its
        motors, its duration and bounds; raise alarms for its problems.

        Motors under way go on from their predicted paths; a trigger is ignored. Alarms of
        an axis's last move end with its next. Problems are those of `_KIND_OF_PROBLEM`;
        those about X-rays are left out while it is unknown whether they are on. A target
        near a limit is a warning.

        Args:
            mirror: the machine.
            waiting: the command under way; its prediction is added.
            command: the same, typed.
            now: time [s].

        Returns:
            The mirror, with the predicted paths of its axes, and the command with its
            expected duration and bounds [s] and, for a move, the targets of its motors.
        """
        sim = self._simulated(mirror, command, now)
        about = getattr(command, "component", "") or waiting.heard.words[0]
        if isinstance(command, c.MoveAbsolute):
            mirror = mirror.cleared(about, *_KINDS_OF_A_MOVE)
        mirror = _with_problems(mirror, sim.findings.problems, about, now)
        step = sim.steps[0]
        low, high = _bounds(step, self.machine)
        delay = max(0.0, high - step.computed_s)
        for name, path in sim.motors.begun(now).items():
            mirror = mirror.sent_on(name, path, waiting.heard, delay)
            mirror = self._near_limit(mirror, name, path.target, now)
        known = waiting.heard.words[0] in (*self.machine.axes, *self.machine.virtual_axes)
        motors = (
            self.machine.moves(about)
            if isinstance(command, c.MoveAbsolute) and known
            else ()
        )
        targets = {n: mirror.axes[n].target for n in motors}
        return mirror, replace(
            waiting, predicted_s=step.holds_s, least_s=low, most_s=high, targets=targets
        )

    def _simulated(self, mirror: Mirror, command: c.Command, now: float) -> Simulation:
        """Simulate one command from the machine as it is at `now`, motors under way on
        their predicted paths; its trigger and wait are ignored.
        """
        if isinstance(command, c.MoveAbsolute):
            command = replace(command, trigger=None)
        paths = {n: a.path for n, a in mirror.axes.items() if a.path is not None}
        moving = {n: p for n, p in paths.items() if p.end - mirror.axes[n].begun_s > now}
        arrived = {n: p.target for n, p in paths.items() if n not in moving}
        start = replace(mirror.start, positions={**mirror.positions, **arrived})
        sim = Simulation(self.machine, start, now=now, ready_at=mirror.ready_s)
        sim.motors.go_on(moving)
        sim.run((replace(command, wait=c.Wait.ACK),))
        return sim

    def _near_limit(self, mirror: Mirror, name: str, target: float, now: float) -> Mirror:
        """Return the mirror, with a warning `limit_near` if a target is less than
        `NEAR_LIMIT_DISTANCE` from a limit of its motor.

        A target beyond the limit counts, too; none if an alarm `limit` of the motor is
        active.
        """
        axis = self.machine.axes[name]
        left = min(target - axis.lower, axis.upper - target)
        if left >= NEAR_LIMIT_DISTANCE or ("limit", name) in mirror.active:
            return mirror
        message = f"{name} goes to {target:g} {axis.unit}, {left:g} from a limit"
        return _alarm(mirror, now, WARNING, "limit_near", name, message)

    def _follow_script(self, mirror: Mirror, command: c.Command, now: float) -> Mirror:
        """Compare a command with the script's next line: advance and compute when the
        following one is due, or raise a warning.

        Place, wait, times and trigger do not count (`_bare`). After the end, the first
        line begins the script anew. Another command is a warning `off_script` once the
        script has begun; before that, after its end, and without a script, it changes
        nothing. To advance ends the script's alarms. The next line is due when all lines
        so far have taken their longest; none after the last.

        Args:
            mirror: present state.
            command: that was sent.
            now: moment [s].
        """
        if self.script is None:
            return mirror
        bare = _bare(command)
        lines = self._bare
        at = mirror.next_line
        if at >= len(lines) and lines and bare == lines[0]:
            at = 0
        if at < len(lines) and bare == lines[at]:
            if at == 0 or mirror.began_s is None:
                began = now
            else:
                began = mirror.began_s
            steps = self._steps[: at + 1]
            holds = sum(s.holds_s for s in steps)
            total = total_range(steps, holds, self.machine.timing)
            if total is None:
                bounds = [_bounds(s, self.machine) for s in steps]
            else:
                bounds = [_wider(total)]
            high = sum(b[1] for b in bounds)
            due = None
            if at + 1 < len(lines):
                due = began + high
            mirror = mirror.cleared("script")
            return replace(mirror, next_line=at + 1, began_s=began, due_s=due)
        if mirror.began_s is None or at >= len(lines):
            return mirror
        message = f"{describe(command)!r} is not {self._next(mirror)}"
        return _alarm(mirror, now, WARNING, "off_script", "script", message)

    @cached_property
    def _bare(self) -> tuple[c.Command, ...]:
        """Commands of the script without place, wait and times; () without a script."""
        if self.script is None:
            return ()
        return tuple(map(_bare, self.script.commands))

    @cached_property
    def _steps(self) -> tuple[PlanStep, ...]:
        """Steps of the script, simulated from the machine's home and default settings; ()
        without a script.
        """
        if self.script is None:
            return ()
        start = Mirror.of(self.machine).start
        return tuple(simulated(tuple(self.script.commands), self.machine, start).steps)

    def _next(self, mirror: Mirror) -> str:
        """Describe the script's next command by line and text; "the script's end" if there
        is none.
        """
        if self.script is None or mirror.next_line >= len(self.script.commands):
            return "the script's end"
        command = self.script.commands[mirror.next_line]
        return f"line {command.line}, {describe(command)!r}"

    # -- replies -----------------------------------------------------------------------------

    def _end_command(
        self, mirror: Mirror, heard: Heard, waiting: Waiting | None, now: float
    ) -> Mirror:
        """Update the mirror with the end of a command: log line, range of its time,
        positions, settings.

        ERR raises an alarm `failed`, and the command's motors count as at rest; ACK ends
        that alarm. An ACK of a command with a trigger whose reply begins with POS leaves
        the move under way, superseded, and nothing more is updated. A time outside its
        bounds by more than `SLACK_S` is a warning `range`, one within them ends it. The
        end of a move records its arrival, that of a question is a reading, others'
        settings are applied. Without a record, settings and reading are taken alone. Ends
        count as reported from now on.

        Args:
            mirror: present state.
            heard: message that ends the command, ACK or ERR.
            waiting: the command's record; None if its begin was not heard.
            now: moment [s].
        """
        command = heard
        if waiting is not None:
            command = waiting.heard
        unheard = waiting is None and heard.what == "ACK"
        mirror = replace(mirror.finished(command, unheard), ends=True)
        if heard.what == "ERR":
            message = f"{heard.text}: the machine says {heard.reply[:200]!r}"
            mirror = _alarm(mirror, now, ERROR, "failed", heard.words[0], message)
            return _rests(mirror, waiting)
        mirror = mirror.cleared(heard.words[0], "failed")
        if waiting is None:
            mirror = _apply_settings(mirror, heard.command, self.machine, now)
            return self._compare_reading(mirror, heard, None, now)
        took = now - waiting.sent_s
        trigger = getattr(waiting.heard.command, "trigger", None)
        passed = trigger is not None and heard.reply.startswith("POS")
        lines = _line(waiting, "POS" if passed else "ACK", took, heard.reply)
        mirror = replace(mirror, lines=lines)
        if passed:  # the motor goes on, and its reply at the end may come or not
            return mirror.with_waiting(waiting, superseded=True, written=True)
        if waiting.predicted_s is not None and not waiting.superseded:
            least = took - heard.late_s
            longest = took + waiting.heard.late_s
            if longest < waiting.least_s - SLACK_S or least > waiting.most_s + SLACK_S:
                mirror = self._outside(mirror, waiting, took, now)
            else:
                mirror = mirror.cleared(waiting.heard.words[0], "range")
        if waiting.targets:
            return self._record_arrival(mirror, waiting, heard, now)
        if waiting.heard.asks or waiting.superseded:
            return self._compare_reading(mirror, heard, waiting, now)
        return _apply_settings(mirror, waiting.heard.command, self.machine, now)

    def _record_arrival(
        self, mirror: Mirror, waiting: Waiting, heard: Heard, now: float
    ) -> Mirror:
        """Update positions, limits and rates with the reply at the end of a move; raise
        an alarm if it is not at its target.

        Motors that another move has sent on since keep their paths. Without a readable
        position the others are taken to be at their targets.

        Args:
            mirror: present state.
            waiting: record of the move.
            heard: reply of its motor.
            now: moment [s].
        """
        axis = waiting.heard.words[0]
        at, motor = _read(heard)
        motors = [n for n in waiting.targets if _stays(mirror, n, waiting)]
        mirror = _rests(mirror, waiting)
        for name in motors:
            mirror = mirror.with_axis(name, position=waiting.targets[name], heard_s=now)
        if at is None:
            return mirror
        name, reply = self._motor(axis, at)
        mirror = self._arrival(mirror, name, reply, waiting.targets[name], now)
        if name in motors:
            mirror = mirror.with_axis(name, position=reply)
        if motor is None:
            return mirror
        return self._compare_limits(mirror, name, motor, now)

    def _arrival(
        self, mirror: Mirror, name: str, there: float, meant: float, now: float
    ) -> Mirror:
        """Raise an alarm `offset` if a motor is more than `TARGET_TOLERANCE` from its
        target.

        `there`: its position, `meant`: its target [mm, deg].
        """
        if abs(there - meant) <= TARGET_TOLERANCE:
            return mirror
        unit = self.machine.axes[name].unit
        message = f"{name} stands at {there:.6g} {unit} after a move to {meant:.6g}"
        return _alarm(mirror, now, ERROR, "offset", name, message)

    def _compare_limits(
        self, mirror: Mirror, name: str, motor: MotorReply, now: float
    ) -> Mirror:
        """Compare limits and rates of a motor's reply with those of the machine file.

        Only limits and maxima are compared, to 1e-6 (relative above 1). The mirror's
        speed and acceleration become the reply's.

        Args:
            mirror: present state.
            name: of the axis.
            motor: its reply.
            now: moment [s].

        Returns:
            The mirror with the motor's rates, and an error alarm (`limits`, `rates`) for
            each difference.
        """
        axis = self.machine.axes[name]
        for kind, theirs, ours in (
            ("limits", (motor.lower, motor.upper), (axis.lower, axis.upper)),
            (
                "rates",
                (motor.max_speed, motor.max_acceleration),
                (axis.max_speed, axis.max_acceleration),
            ),
        ):
            if any(
                abs(a - b) > 1e-6 * (1.0 + abs(b))
                for a, b in zip(theirs, ours, strict=True)
            ):
                text = (
                    f"{name}: the motor's own {kind} are {theirs[0]:g} and "
                    f"{theirs[1]:g}, machine "
                    f"{self.machine.name} has {ours[0]:g} and {ours[1]:g}"
                )
                mirror = _alarm(mirror, now, ERROR, kind, name, text)
        return mirror.with_axis(name, speed=motor.speed, acceleration=motor.acceleration)

    def _compare_reading(
        self, mirror: Mirror, heard: Heard, waiting: Waiting | None, now: float
    ) -> Mirror:
        """Compare a reading of a motor's position with its predicted path, or with the
        place where it stood.

        A motor's full reply also has its limits and rates compared (`_compare_limits`).

        Args:
            mirror: the machine.
            heard: feedback, or the answer to a question.
            waiting: the command it belongs to, or None.
            now: time [s].

        Returns:
            The mirror with the reading and perhaps an error alarm. A text that is no
            position, a repeated or old reading, and one of a move that another has
            replaced change nothing.
        """
        at, reply = _read(heard)
        asks = heard.asks or (waiting.heard.asks if waiting is not None else "")
        moves = waiting is not None and bool(waiting.targets)
        is_position = moves or asks == "position" or reply is not None
        axis = heard.words[0]
        if at is None or not is_position or not self.machine.has(axis):
            return mirror
        name, x = self._motor(axis, at)
        if waiting is not None and moves and not _stays(mirror, name, waiting):
            return mirror
        if reply is not None:
            mirror = self._compare_limits(mirror, name, reply, now)
        reading = _Reading(
            name, x, self.machine.axes[name].unit, moves, heard.late_s, now
        )
        path = mirror.axes[name].path
        if path is not None:
            return _compare_on_path(mirror, reading, path)
        explained = waiting is None and heard.words[1].startswith("move")
        return _compare_at_rest(mirror, reading, explained)

    def _motor(self, axis: str, at: float) -> tuple[str, float]:
        """Return the motor that a reading of `axis` is of, and its position.

        Virtual axes are converted.
        """
        virtual = self.machine.virtual_axes.get(axis)
        if virtual is None:
            return axis, at
        return virtual.of, (at - virtual.constant) / virtual.factor

    def _outside(
        self, mirror: Mirror, waiting: Waiting, took: float, now: float
    ) -> Mirror:
        """Return the mirror with a warning `range`: a command took `took` seconds, less
        or more than its bounds.
        """
        longer = "less"
        if took > waiting.most_s:
            longer = "more"
        least, most = f"{waiting.least_s:.2f}", f"{waiting.most_s:.2f}"
        expected = f"its range of {least} to {most} s"
        if least == most:
            expected = f"the {most} s that it always takes"
        message = f"{waiting.heard.text} has taken {took:.2f} s, {longer} than {expected}"
        return _alarm(mirror, now, WARNING, "range", waiting.heard.words[0], message)


@dataclass(frozen=True)
class _Reading:
    """A position of a motor in its own sign and unit.

    Attributes:
        motor: its name.
        x: position [unit].
        unit: mm or deg.
        of_move: whether it was told by a move under way, not asked for.
        late_s: by how much earlier it may have come than it was read [s].
        now: when it was read [s].
    """

    motor: str
    x: float
    unit: str
    of_move: bool
    late_s: float
    now: float


def _read(heard: Heard) -> tuple[float | None, MotorReply | None]:
    """Read a reply: its position [mm, deg], None if it has none, and the motor's full
    reply, None if it is no more than a number.
    """
    reply = motor_reply(reply_bytes(heard.reply))
    if reply is None:
        return _number(heard.reply), None
    return reply.position, reply


def _compare_at_rest(mirror: Mirror, reading: _Reading, explained: bool) -> Mirror:
    """Take a reading of a motor without a path as its position.

    If the motor was heard elsewhere before, and the reading does not come with a move of
    which no begin was heard (`explained`), that is an error alarm `moved`.
    """
    name = reading.motor
    seen = mirror.axes[name]
    mirror = mirror.with_axis(
        name, position=reading.x, target=reading.x, heard_s=reading.now
    )
    stays = abs(reading.x - seen.position) <= TARGET_TOLERANCE
    if seen.heard_s is None or stays or explained:
        return mirror
    stood = f"not at {seen.position:.6g}, and no move of it was heard"
    message = f"{name} stands at {reading.x:.6g} {reading.unit}, {stood}"
    return _alarm(mirror, reading.now, ERROR, "moved", name, message)


def _compare_on_path(mirror: Mirror, reading: _Reading, path: Trajectory) -> Mirror:
    """Compare a reading with the predicted path of its motor.

    A position nowhere on the path is an error alarm `off_path`; one within
    `TARGET_TOLERANCE` of start or target never is, nor is its delay judged. A repeated
    reading, and an old one, change nothing.
    """
    name = reading.motor
    arrived = abs(reading.x - path.target) <= TARGET_TOLERANCE
    at_start = abs(reading.x - path.pieces[0].position) <= TARGET_TOLERANCE
    passes = path.end if arrived else path.time_at(reading.x)
    here = mirror.with_axis(name, position=reading.x, heard_s=reading.now)
    if passes is None:
        if at_start:
            return here
        message = (
            f"{name} is at {reading.x:.6g} {reading.unit}, on no way to {path.target:.6g}"
        )
        return _alarm(here, reading.now, ERROR, "off_path", name, message)
    seen = mirror.axes[name]
    if reading.of_move and passes < seen.passed_s:
        # Feedback can be overtaken by later feedback: then it is no news. It counts where
        # it is the last after the path's end, and the server reports no ends: `_arrivals`
        # has nothing else to judge.
        last = mirror.ends is False and reading.now > path.end > seen.passed_s
        return here if last else mirror
    since = reading.now - (seen.heard_s or reading.now)
    if reading.of_move and passes == seen.passed_s and since < MAX_SILENCE_S:
        return mirror
    if arrived or at_start:
        return here.with_axis(name, passed_s=passes)
    return _compare_delay(here, reading, passes)


def _compare_delay(mirror: Mirror, reading: _Reading, passes: float) -> Mirror:
    """Compare the delay of a reading behind its motor's path with the motor's own, and
    with the promptest so far.

    The delay is now less the time `passes` [s] at which the path passes the reading: more
    than the motor's `delay_s` and `SLACK_S`, or growing by more than `MAX_DRIFT_S`, is an
    error alarm `slow`; a lead of that size `fast`.
    """
    name = reading.motor
    axis = mirror.axes[name]
    # The reading may be older than it seems by its lateness: the delay is between the two,
    # and each alarm takes the end that is better for the machine.
    least = reading.now - reading.late_s - passes
    most = reading.now - passes
    first = axis.behind_s or (least, most)
    at = f"the predicted path at {reading.x:.6g} {reading.unit}"
    if least > axis.delay_s + SLACK_S or least - first[1] > MAX_DRIFT_S:
        message = f"{name} is slow: {least:.2f} s behind {at}"
        mirror = _alarm(mirror, reading.now, ERROR, "slow", name, message)
    elif most + axis.begun_s < -SLACK_S or (most < 0.0 and first[0] - most > MAX_DRIFT_S):
        message = f"{name} is fast: {-most:.2f} s ahead of {at}"
        mirror = _alarm(mirror, reading.now, ERROR, "fast", name, message)
    promptest = min(first, (least, most), key=lambda behind: behind[1])
    return mirror.with_axis(name, behind_s=promptest, passed_s=passes)


def _with_problems(
    mirror: Mirror, problems: Iterable[Finding], about: str, now: float
) -> Mirror:
    """Return the mirror with alarms for the problems of one command's plan.

    Only those of `_KIND_OF_PROBLEM` count; those about X-rays are left out while it is
    unknown whether they are on.
    """
    for p in problems:
        unsure = mirror.xrays_on is None and p.code is ScriptCode.XRAY_NEVER_READY
        if p.code in _KIND_OF_PROBLEM and not unsure:
            kind = _KIND_OF_PROBLEM[p.code]
            mirror = _alarm(mirror, now, p.severity, kind, about, p.message)
    return mirror


def _alarm(
    mirror: Mirror, now: float, severity: Severity, kind: str, about: str, message: str
) -> Mirror:
    return mirror.alarmed(Alarm(now, severity, kind, about, message))


def _bounds(step: PlanStep, machine: Machine) -> Range:
    """Bound a step's time [s], which a healthy machine exceeds less than once a day.

    An assumed time may be 0 to twice itself.
    """
    measured = step_range(step, machine.timing)
    if measured is None:
        return (step.computed_s, step.holds_s + step.assumed_s)
    return _wider(measured)


def _wider(found: Range) -> Range:
    """Widen a 90 % range by `WIDENING_WIDTHS` of its width on each side, not below 0 s."""
    more = WIDENING_WIDTHS * (found[1] - found[0])
    return max(0.0, found[0] - more), found[1] + more


def _rests(mirror: Mirror, waiting: Waiting | None) -> Mirror:
    """Return the mirror with the motors of a command's move at rest, except those that
    another move has sent on; unchanged for None.
    """
    for name in () if waiting is None else waiting.targets:
        if waiting is not None and _stays(mirror, name, waiting):
            mirror = replace(
                mirror, axes={**mirror.axes, name: mirror.axes[name].at_rest}
            )
    return mirror


def _stays(mirror: Mirror, name: str, waiting: Waiting) -> bool:
    """Return whether a motor has no other move since."""
    return mirror.axes[name].mover in (None, waiting.heard.identity)


def _bare(command: c.Command) -> c.Command:
    """Return a command without its place in the text, wait, times and trigger, and its
    axis in lower case, for comparing commands.
    """
    bare = replace(
        command, line=0, column=1, wait=c.Wait.ACK, timeout_ms=None, expected_ms=None
    )
    if isinstance(bare, c.MotorCommand):
        bare = replace(bare, component=bare.component.lower())
    if isinstance(bare, c.MoveAbsolute):
        return replace(bare, trigger=None)
    return bare


def _record_unwaited(mirror: Mirror, now: float) -> Mirror:
    """Add log lines for the commands that the sender has not waited for, now that another
    follows; mark them as written.

    Questions get none, and each command one only. A move with a trigger has the wait POS
    and the time until now; any other "no wait" and 0 s.

    Args:
        mirror: present state.
        now: moment of the next command [s].
    """
    for waiting in mirror.waiting.values():
        if waiting.written or waiting.heard.asks:
            continue
        trigger = getattr(waiting.heard.command, "trigger", None)
        if trigger is None:
            wait = "no wait"
            took = 0.0
        else:
            wait = "POS"
            took = now - waiting.sent_s
        lines = (*mirror.lines, *_line(waiting, wait, took, "command sent"))
        mirror = replace(mirror, lines=lines).with_waiting(waiting, written=True)
    return mirror


def _line(waiting: Waiting, wait: str, took: float, reply: str) -> tuple[bytes, ...]:
    """Format the log line of a command that a script can have; () if it has one already or is no
    command of the language.

    A move under another name is written as "move absolute" with its target.
    `waiting`: record of the command; `wait`: its wait; `took`: its own time [s]; `reply`: of the
    machine.
    Returns () or the one line."""
    command = waiting.heard.command
    words = waiting.heard.words
    if waiting.written or command is None:
        return ()
    if isinstance(command, c.MoveAbsolute) and words[1] != "move absolute":
        words = (words[0], "move absolute", repr(command.target), "")
    return (log_line(words, wait, took, reply_bytes(reply), waiting.heard.stamp),)


def _number(text: str) -> float | None:
    """Parse a text as a finite number, or None."""
    try:
        return number(text.strip(), "position")
    except ArgumentError:
        return None


def _apply_settings(
    mirror: Mirror, command: c.Command | None, machine: Machine, now: float
) -> Mirror:
    """Apply a command that has ended to the mirror's settings: camera, tube, X-rays or an
    axis's rates.

    Rates of a virtual axis are set for its motors by their shares. X-rays on are ready
    after the machine's `xray_ready_s`; after a wait for them they are on and ready now.

    Args:
        mirror: present state.
        command: that has ended; other commands and None change nothing.
        machine: with the time that X-rays need.
        now: moment [s].
    """
    match command:
        case c.CameraSetting():
            return replace(mirror, camera=replace(mirror.camera, **command.arguments))
        case c.TubeSetting():
            return replace(mirror, **command.arguments)
        case c.XrayOn():
            return replace(
                mirror, xrays_on=True, ready_s=now + machine.timing.xray_ready_s
            )
        case c.XrayOff():
            return replace(mirror, xrays_on=False)
        case c.WaitXrayReady():
            return replace(mirror, xrays_on=True, ready_s=now)
        case c.SetSpeed() | c.SetAcceleration() if machine.has(command.component):
            rates = command.arguments
            for motor, share in machine.moves(rates.pop("component")).items():
                mirror = mirror.with_axis(
                    motor, **{n: x * abs(share) for n, x in rates.items()}
                )
    return mirror
