"""Runs the commands of a script on a virtual clock and records steps, motion,
images and problems.

There is one method for each kind of command. Each returns when the command takes effect
and when it is complete; the command's wait decides when the script continues. A problem
never ends the planning: steps and frames are planned all the same. `planner` judges the
beam's view.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Final, assert_never

from flexdt.twin.errors import LimitError
from flexdt.twin.findings import Place
from flexdt.twin.machine.description import Machine, unknown_axis
from flexdt.twin.machine.travel import Arrival, Rate, arrival, rate
from flexdt.twin.motion.drives import least_rate
from flexdt.twin.motion.profiles import Trajectory
from flexdt.twin.scanner.state import (
    CameraChange,
    TubeSettings,
    changed_camera,
    changed_tube,
)
from flexdt.twin.script import commands as c
from flexdt.twin.script.grammar import describe, is_reserved, own_name
from flexdt.twin.script.planning import planned_scanner as planned
from flexdt.twin.script.planning.plan_values import (
    PlanStep,
    SampleSize,
    Settings,
    StartState,
)
from flexdt.twin.script.planning.planned_images import ImageCollector
from flexdt.twin.script.problems import Collector, ScriptCode

# The binary argument of `scanner set sample info`: the sample's size and names.
#
# The layout was found in a published script and its settings files (no public
# specification; assumed): big-endian, diameter [mm] as a double, then texts, each a
# 4-byte length and its bytes: sample name, project, owner, and others. Data of another
# form are not an error, because the scan itself does not use the argument.

_MAX_DIAMETER_MM = 10_000.0
_CAMERA: Final = (c.CameraSetting, c.TakeImage, c.SaveImage, c.TakeSequence)


def sample_size(data: bytes) -> SampleSize | None:
    """Decode the sample's diameter, a big-endian double [mm], of `set sample info`.

    None for less than 12 bytes, or not within 0 to `_MAX_DIAMETER_MM`.
    """
    if len(data) < 12:
        return None
    (diameter,) = struct.unpack_from(">d", data)
    if not (math.isfinite(diameter) and 0.0 < diameter <= _MAX_DIAMETER_MM):
        return None
    return SampleSize(diameter, source="set sample info")


class Simulation:
    """A scanner on a virtual clock; lives only while a plan is made.

    Args:
        machine: whose axes, limits, camera and timing these are.
        start: the scanner before the script.
        averages: inferred in a first run, or None.
        now: time of the start [s].
        ready_at: when X-rays that were switched on before are ready [s].
    """

    def __init__(
        self,
        machine: Machine,
        start: StartState,
        averages: int | None = None,
        *,
        now: float = 0.0,
        ready_at: float = 0.0,
    ) -> None:
        """Begin at `now` with motors, tube and camera as `start` has them, and no steps.

        `averages` is the number of averages assumed where the script sets none.
        """
        self.machine = machine
        self.now = now
        self.motors = planned.Motors(machine, start)
        on = start.xrays_on
        self.tube = planned.PlannedTube(
            start.kV, start.power_W, on is True, on is not None, ready_at
        )
        self.camera = planned.PlannedCamera(start.camera)
        self.findings = Collector()
        self.imaging = ImageCollector(
            machine, self.motors, self.tube, self.camera, self.findings, averages
        )
        self.settings: Settings | None = None
        self.sample: SampleSize | None = None
        self.steps: list[PlanStep] = []

    @property
    def end(self) -> float:
        """When commands, motion and camera are all done [s]."""
        return max(self.now, self.motors.end, self.camera.free_at)

    def run(self, commands: tuple[c.Command, ...]) -> None:
        """Simulate all commands in order: advance the clock, and add a step for each.

        A camera command waits until the camera is free (assumed). Names are matched to
        the machine's whatever their case. A problem of a command does not end the
        simulation.

        Args:
            commands: of the script, in order; problems go to `findings`.
        """
        axes = (*self.machine.axes, *self.machine.virtual_axes)
        for command in commands:
            if isinstance(command, c.MotorCommand | c.Custom):
                command = replace(command, component=own_name(command.component, axes))
            self.findings.place = Place(command.line, command.column)
            before = self.now
            if isinstance(
                command, _CAMERA
            ):  # a busy camera keeps the script waiting (assumed)
                self.now = max(self.now, self.camera.free_at)
            effect = next(
                _EFFECTS[cls] for cls in type(command).__mro__ if cls in _EFFECTS
            )
            span = effect(self, command)
            self.now = self._release(command, span)
            holds = self.now - before
            self.steps.append(
                PlanStep(
                    index=len(self.steps),
                    line=command.line,
                    start_s=span.start,
                    duration_s=span.end - span.start,
                    holds_s=holds,
                    assumed_s=min(span.assumed, holds),
                    assumed_from=f"{self.machine.name} timing" if span.assumed else "",
                    what=describe(command) + span.note,
                    command=command,
                    kind=span.kind if command.wait is c.Wait.ACK else "command",
                )
            )

    def _release(self, command: c.Command, span: planned.Span) -> float:
        """Compute the moment [s] at which the script goes on after a command, by its
        wait.

        With ACK it is the end of the command; with POS the passing of its trigger, if it
        has one; else at once. It is never before now.
        """
        match command.wait:
            case c.Wait.ACK:
                return max(self.now, span.end)
            case c.Wait.POS:
                return max(self.now, self.now if span.release is None else span.release)
            case c.Wait.NO_WAIT | c.Wait.RCV:
                return self.now
            case _:
                assert_never(command.wait)

    def timed(self, kind: str, length: float = 0.0, note: str = "") -> planned.Span:
        """Make the span of a command from now: its length [s] and its kind's time.

        The script's own expected duration is only a bound.
        """
        overhead = self.machine.timing.seconds(kind)
        return planned.Span(
            self.now, self.now + length + overhead, overhead, kind, note=note
        )

    # scanner -------------------------------------------------------------------------------

    def _custom(self, command: c.Custom) -> planned.Span:
        """Count the time of an unknown command, which has no effect; warn if it is to a
        motor of the machine.
        """
        if command.component in self.machine.axes:
            self.findings.warn(
                ScriptCode.CUSTOM_COMPONENT,
                f"{command.component}: the twin does not know this command "
                "of the axis; no effect",
            )
        return self.timed("command", note=" (no effect)")

    def _sample_info(self, command: c.SetSampleInfo) -> planned.Span:
        """Set the sample's size from the argument, if it states one; return the time that
        the command takes.
        """
        size = sample_size(command.data)
        if size is not None:
            self.sample = size
        return self.timed("command")

    def _write_settings(self, _command: c.WriteSettingsFile) -> planned.Span:
        """Record positions, rates and settings of this moment in `settings`.

        Args:
            _command: not used; it has no arguments.

        Returns:
            The time that the command takes.
        """
        motors = self.motors.all
        self.settings = Settings(
            self.motors.positions(self.now),
            {n: m.speed for n, m in motors.items()},
            {n: m.acceleration for n, m in motors.items()},
            self.camera.settings,
            self.tube.kV,
            self.tube.power_W,
            self.tube.on if self.tube.known else None,
            time_s=self.now,
            step=len(self.steps),
        )
        return self.timed("write_settings")

    # tube ----------------------------------------------------------------------------------

    def _xray_on(self, _command: c.XrayOn) -> planned.Span:
        """Switch X-rays on at the end of the command, and set when they are ready.

        If on already, it takes the time of any command.
        """
        if self.tube.on:
            return self.timed("command", note=" (already on)")
        span = self.timed("xrayon")
        self.tube.switch(True, span.end)
        self.tube.ready_at = span.end + self.machine.timing.xray_ready_s
        return span

    def _xray_off(self, _command: c.XrayOff) -> planned.Span:
        """Switch X-rays off at once; if they are known to be off, only the time of asking
        counts.

        Returns the time that the command takes."""
        if not self.tube.on and self.tube.known:
            return self.timed("xrayoff_again", note=" (already off)")
        self.tube.switch(False, self.now)
        return self.timed("xrayoff")

    def _ready(self, _command: c.WaitXrayReady) -> planned.Span:
        """Wait until X-rays are ready; at once if they are already.

        With X-rays off it would wait for ever: an error is reported, and the script goes
        on.

        Returns:
            The time that the command takes; a wait counts as assumed.
        """
        if not self.tube.on:
            message = (
                "waits until the X-rays are ready, but they are off: "
                "the script would hang here"
            )
            self.findings.error(ScriptCode.XRAY_NEVER_READY, message)
            return self.timed("command")
        left = self.tube.ready_at - self.now
        if left <= 0.0:
            return self.timed("command")
        return planned.Span(self.now, self.now + left, left, "xray_ready")

    def _set_tube(self, change: Mapping[str, float]) -> planned.Span:
        """Set voltage or power; report a value that is not allowed and keep the old one.

        Args:
            change: one setting, kV or power_W, and its value.

        Returns:
            The time that the command takes.
        """
        [(name, value)] = change.items()
        now = TubeSettings(self.tube.kV, self.tube.power_W)
        try:
            changed_tube(self.machine.tube, now, change.get("kV"), change.get("power_W"))
        except LimitError as error:
            self.findings.error(ScriptCode.LIMIT, error.message)
            value = getattr(now, name)
        self.tube.set(self.now, name, value)
        return self.timed("set_tube")

    # camera --------------------------------------------------------------------------------

    def _set_camera(self, change: CameraChange) -> planned.Span:
        """Set a camera setting; report a value that is not allowed and keep the old one.

        Args:
            change: one setting and its value.

        Returns:
            The time that the command takes; the camera is busy until its end.
        """
        [(name, value)] = change.items()
        now = self.camera.settings
        try:
            changed_camera(self.machine.detector, now, change)
        except LimitError as error:
            region = "edge" in error.data or "binning" in error.data
            code = ScriptCode.LIMIT
            if "setting" not in error.data:
                code = ScriptCode.ROI if region else ScriptCode.MODE
            self.findings.error(code, error.message)
            value = getattr(now, name)
        self.camera.set(name, value)
        span = self.timed("set_camera")
        self.camera.free_at = span.end
        return span

    # motors --------------------------------------------------------------------------------

    def _axis(self, command: c.MotorCommand) -> bool:
        """Return whether the machine has the command's axis; report it if not.

        A name that scanners reserve is an error, another one a warning: a custom
        component without effect.
        """
        name = command.component
        if self.machine.has(name):
            return True
        if is_reserved(name):
            self.findings.error(
                ScriptCode.UNKNOWN_COMPONENT, unknown_axis(name, self.machine).message
            )
        else:
            self.findings.warn(
                ScriptCode.CUSTOM_COMPONENT,
                f"{name!r} is a custom component: allowed, without effect here",
            )
        return False

    def _set_rate(self, command: c.SetSpeed | c.SetAcceleration) -> planned.Span:
        """Set an axis's speed or acceleration, limited to those of its motors; report
        what lies beyond, or below the least one, at which it then stays.

        The motors of a virtual axis get their share. An axis that the machine lacks is
        reported and changes nothing.

        Args:
            command: with axis and value [mm/s, deg/s, per s].

        Returns:
            The time that the command takes, with a note of limited motors.
        """
        if not self._axis(command):
            return self.timed("command", note=" (no effect)")
        what: Rate = "acceleration"
        if isinstance(command, c.SetSpeed):
            what = "speed"
        requested = getattr(command, what)
        least = least_rate(self.machine, command.component)
        if requested < least:
            self.findings.error(
                ScriptCode.LIMIT,
                f"{what} of {command.component} is {requested:g}; allowed: from {least:g} on",
            )
            requested = least
        limited = rate(self.machine, command.component, what, requested)
        note = ""
        shares = self.machine.moves(command.component)
        self._report(limited)
        for motor, value in limited.motors.items():
            setattr(self.motors.all[motor], what, value)
            if limited.messages and value < requested * abs(shares[motor]):
                unit = (
                    f"{self.machine.axes[motor].unit}/{'s' if what == 'speed' else 's2'}"
                )
                note += f" (limited to {motor} {value:g} {unit})"
        return self.timed("set_motor", note=note)

    def _report(self, found: Arrival) -> None:
        """Report a target beyond a limit: a warning if the machine clamps it, else an error."""
        for message in found.messages:
            if found.is_clamped(self.machine):
                self.findings.warn(
                    ScriptCode.LIMIT_CLAMPED, f"{message}; set to the limit"
                )
            else:
                self.findings.error(ScriptCode.LIMIT, message)

    def _move(self, command: c.MoveAbsolute) -> planned.Span:
        """Start a move of an axis within its travel; register its trigger, and report
        what lies beyond.

        A target beyond travel is replaced by the limit. An axis that the machine lacks is
        reported and nothing moves.

        Args:
            command: with axis, target [mm, deg] and wait.

        Returns:
            The time span of the motion, the moment at which the script goes on (with
            POS), and a note of limited motors. With ACK the machine's overhead is in the
            span.
        """
        if not self._axis(command):
            return self.timed("command", note=" (no effect)")
        name = command.component
        requested = self.motors.targets(name, command.target, self.now)
        limited = arrival(self.machine, name, requested)
        targets = limited.motors
        note = ""
        self._report(limited)
        for motor, target in targets.items():
            if limited.messages and target != requested[motor]:
                note += (
                    f" (limited to {motor} {target:g} {self.machine.axes[motor].unit})"
                )
        begin = {m: self.motors.all[m].position(self.now) for m in targets}
        trajectories = {
            m: self.motors.all[m].move(targets[m], self.now, *rate)
            for m, rate in self.motors.rates(name).items()
        }
        end = max(t.end for t in trajectories.values())
        release = None
        if command.wait is c.Wait.POS and command.trigger is not None:
            release = self._register_trigger(
                command, command.trigger, trajectories, begin, end
            )
        if command.wait is not c.Wait.ACK:
            return planned.Span(self.now, end, release=release, note=note)
        kind = "move_standing"
        if end > self.now:
            kind = "move"
        return self.timed(kind, end - self.now, note)

    def _register_trigger(
        self,
        command: c.MoveAbsolute,
        trigger: float,
        made: Mapping[str, Trajectory],
        begin: Mapping[str, float],
        end: float,
    ) -> float:
        """Find the moment at which the motor passes the trigger, and register the
        trigger.

        Of a virtual axis the motor is the one it is defined by.

        Args:
            command: the move.
            trigger: position of the axis at which the script goes on [unit].
            made: motor -> trajectory.
            begin: motor -> position before the move.
            end: of the motion [s].

        Returns:
            Moment [s]; `end`, with an error reported and no trigger registered, if the
            motor never passes it.
        """
        virtual = self.machine.virtual_axes.get(command.component)
        if virtual is None:
            motor = command.component
        else:
            motor = virtual.of
        position = trigger
        if virtual is not None:
            position = (trigger - virtual.constant) / virtual.factor
        trajectory = made[motor]
        time = trajectory.time_at(position)
        if time is None:
            unit = self.machine.axes[motor].unit
            self.findings.error(
                ScriptCode.UNREACHABLE_TRIGGER,
                f"{command.component} never passes the trigger {trigger:g} {unit} on "
                f"its way from {begin[motor]:g} to {trajectory.target:g} {unit}: "
                "the script would hang here",
            )
            self.imaging.trigger = None
            return end
        unit = self.machine.axes[motor].unit
        run_up = abs(position - begin[motor])
        self.imaging.trigger = planned.Trigger(
            command.component, motor, unit, trajectory, position, time, run_up
        )
        return time


_Effect = Callable[[Simulation, Any], planned.Span]

_EFFECTS: Final[Mapping[type[c.Command], _Effect]] = {
    c.Command: lambda s, _: s.timed("command"),
    c.Pause: lambda s, k: s.timed("command", k.duration_ms / 1000.0),
    c.SetSampleInfo: Simulation._sample_info,
    c.WriteSettingsFile: Simulation._write_settings,
    c.XrayOn: Simulation._xray_on,
    c.XrayOff: Simulation._xray_off,
    c.WaitXrayReady: Simulation._ready,
    c.TubeSetting: lambda s, k: s._set_tube(k.arguments),
    c.CameraSetting: lambda s, k: s._set_camera(k.arguments),
    c.TakeImage: lambda s, k: s.imaging.take(k, s.now, len(s.steps)),
    c.SaveImage: lambda s, k: s.imaging.save(k, s.now, len(s.steps)),
    c.TakeSequence: lambda s, k: s.imaging.sequence(k, s.now, len(s.steps)),
    c.MoveAbsolute: Simulation._move,
    c.SetSpeed: Simulation._set_rate,
    c.SetAcceleration: Simulation._set_rate,
    c.Custom: Simulation._custom,
}
"""Simulator of each command's type, or of the nearest type above it."""
