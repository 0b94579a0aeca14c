"""The camera's commands on the plan's clock: when each image is taken, where and to which file.

Sequences over a moving axis follow the smooth-scan rule of fly scans. Gaps in the script
(frames, averages) are inferred from speed and run-up where possible; otherwise a
documented default is used, with a warning that names it.

The rule: with N images, exposure e, m averages and T = e m, speed v = turn / (N - 1) / T,
and the motion starts v^2 / (2 a) + 4 T v before the first image and ends as far behind
the last (checked against seven published scans to 1e-5 deg). Lengths are in the axis's
unit (deg or mm), times in s.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, assert_never

import numpy as np

from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.description import Machine
from flexdt.twin.script import commands as c
from flexdt.twin.script.commands import ImageKind
from flexdt.twin.script.grammar import image_name, kind_of, sequence_names, shorten
from flexdt.twin.script.planning import planned_scanner as planned
from flexdt.twin.script.planning.plan_values import ExposureGroup
from flexdt.twin.script.problems import Collector, ScriptCode

MARGIN_IMAGES: Final = 4.0
"""Images' worth of constant speed before the first and after the last image."""
FULL_TURN_DEG: Final = 360.0
MAX_INFERRED_STEPS: Final = 1_000_000
"""Largest number of steps that is inferred; more is a mistake in the script."""
_TIME_TOLERANCE_S = 1e-9
_POSITION_TOLERANCE = 1e-7
_MISMATCH_STEPS = 0.05
"""Steps by which stated frames may miss a whole turn without a warning."""


def run_up(speed: float, acceleration: float, period_s: float) -> float:
    """Compute the length before the first image: speeding up, then four images.

    Args:
        speed: of the scan [unit/s].
        acceleration: of the axis [unit/s2].
        period_s: exposure time of an image, averages included [s].

    Returns:
        Length [unit], deg or mm as the axis has.
    """
    return speed * speed / (2.0 * acceleration) + MARGIN_IMAGES * period_s * speed


@dataclass(frozen=True)
class Inference:
    """Values that fill the gaps; `notes` has for each setting how it was found."""

    frames: int
    averages: int
    increment: float
    mismatch: float
    """Length by which frames x speed x period misses the increments, over the whole scan."""
    notes: dict[str, str]


def infer(
    trigger: planned.Trigger, exposure_s: float, frames: int | None, averages: int | None
) -> Inference | None:
    """Infer averages, then frames, then the increment from speed and run-up.

    The scan's length is the motion's less a run-up at each end, rounded to whole turns.
    Averages follow from frames, else from the run-up. `frames x speed x period` within
    half a step of full turns means images at turn / (frames - 1), as the scanner's own
    software counts; otherwise they are where the motor is.
    Returns notes on what was not stated, too; None if averages do not follow, or steps
    are less than half or `MAX_INFERRED_STEPS` or more.
    """
    length = _length(trigger)
    rotation = trigger.unit == "deg"
    notes: dict[str, str] = {}
    if averages is None:
        inferred = _averages(trigger, exposure_s, frames, length)
        if inferred is None:
            return None
        averages, notes["averages"] = inferred
    step = trigger.speed * exposure_s * averages
    if frames is None:
        steps = length / step
        if not 0.5 <= steps < MAX_INFERRED_STEPS:
            return None
        frames = round(steps) + 1
        notes["frames"] = (
            f"{steps:.2f} steps of {step:.6g} at this speed, exposure and averages make "
            f"{length:g}; rounded, {frames} frames"
        )
    increment, mismatch = images(step, frames, rotation)
    return Inference(frames, averages, increment, mismatch, notes)


def images(step: float, frames: int, rotation: bool) -> tuple[float, float]:
    """Compute the increment between a scan's images, and its mismatch [mm, deg].

    A rotation within half a step of whole turns is divided equally; the mismatch is by
    how much steps exceed turns. Else it is `step`, and 0.
    """
    scan = step * (frames - 1)
    turns = round(scan / FULL_TURN_DEG)
    if rotation and turns >= 1 and abs(scan - turns * FULL_TURN_DEG) < 0.5 * step:
        return turns * FULL_TURN_DEG / (frames - 1), scan - turns * FULL_TURN_DEG
    return step, 0.0


def _length(trigger: planned.Trigger) -> float:
    """Compute the length of a triggered scan without its run-ups [mm, deg].

    It runs from the trigger to one run-up before the target. An angle within 1 deg of
    whole turns (one or more) is rounded to them. May be negative.
    """
    length = abs(trigger.trajectory.target - trigger.position) - trigger.run_up
    turns = round(length / FULL_TURN_DEG)
    if trigger.unit == "deg" and turns >= 1 and abs(length - turns * FULL_TURN_DEG) < 1.0:
        return turns * FULL_TURN_DEG
    return length


def _averages(
    trigger: planned.Trigger, exposure_s: float, frames: int | None, length: float
) -> tuple[int, str] | None:
    """Infer the number of averages, an image's period over its exposure, and how.

    The period is the length over steps and speed or, with fewer than two frames or no
    length, the run-up less the way to full speed, over `MARGIN_IMAGES` and the speed.
    `length` of motion is in mm or deg. Returns None for less than 1, or no whole number
    within 2 %.
    """
    speed = trigger.speed
    acceleration = trigger.acceleration
    if frames is not None and frames > 1 and length > 0.0:
        period = length / (frames - 1) / speed
        how = f"speed and {frames} frames"
    else:
        period = (trigger.run_up - speed**2 / (2.0 * acceleration)) / (
            MARGIN_IMAGES * speed
        )
        how = f"speed, run-up {trigger.run_up:.6f} and acceleration {acceleration:g}"
    ratio = period / exposure_s
    averages = round(ratio)
    if averages < 1 or abs(ratio - averages) > 0.02 * averages:
        return None
    return averages, f"{ratio:.5g} from {how}"


class ImageCollector:
    """Collects the images of a script; lives only while a plan is made.

    Args:
        machine, motors, tube, camera: the simulated scanner.
        findings: takes problems.
        averages: inferred in a first run, for images before the scan; None: not known.
    """

    def __init__(
        self,
        machine: Machine,
        motors: planned.Motors,
        tube: planned.PlannedTube,
        camera: planned.PlannedCamera,
        findings: Collector,
        averages: int | None,
    ) -> None:
        """Begin to collect a script's images; findings are added to `findings`.

        `averages` is a hint from outside; unless None, the camera takes it as assumed
        setting.
        """
        self.machine = machine
        self.motors = motors
        self.tube = tube
        self.camera = camera
        self.findings = findings
        self.trigger: planned.Trigger | None = None
        self.images: list[ExposureGroup] = []
        self.last: int | None = None
        """Index of the image taken last; while it was taken, `moved` were under way."""
        self.moved: list[str] = []
        self.names: set[str] = set()
        self.hint = averages
        self.inferred_averages: int | None = None
        self._reported: set[str] = set()
        if averages is not None:
            camera.assume("averages", averages)

    def groups(self) -> tuple[ExposureGroup, ...]:
        """Return all images, in the order in which they were taken."""
        return tuple(self.images)

    # commands ------------------------------------------------------------------------------

    def take(self, command: c.TakeImage, now: float, step: int) -> planned.Span:
        """Simulate `take image`: add one image, not saved yet; frames are for sequences.

        The camera is busy for exposure times averages, and the overhead. `step`: the
        command's.
        """
        self._add_images(np.array([now], dtype=np.float64), now, step, command.line)
        settings = self.camera.settings
        length = settings.exposure_ms * settings.averages / 1000.0
        return self._keep_busy(now, length, "take_image_overhead")

    def save(self, command: c.SaveImage, now: float, _step: int) -> planned.Span:
        """Simulate `save image`: name the last image, which determines its kind; report
        problems.

        No file name, and no image taken before, are errors, and nothing is saved; an axis
        that moved while the image was taken is a warning. Saved again it is added as a
        copy.

        Args:
            command: with the file's name.
            now: moment of the script [s].
            _step: not used.

        Returns:
            The time that the command takes; the camera is busy until its end.
        """
        name = image_name(command.path)
        if name is None:
            self.findings.error(
                ScriptCode.PATH,
                f"{shorten(command.path)!r} does not end with a file name",
            )
        elif self.last is None:
            self.findings.error(
                ScriptCode.NOTHING_TO_SAVE, "no image has been taken since the start"
            )
        else:
            taken = self.images[self.last]
            saved = replace(taken, files=(name,), kind=kind_of(name))
            if (
                taken.files
            ):  # saved before under another name: a second copy of the same image
                self.images.append(saved)
            else:
                self.images[self.last] = saved
            self._check_saved(saved)
            if self.moved:
                message = f"{', '.join(self.moved)} still moves while {name} is taken"
                self.findings.warn(ScriptCode.MOVING, f"{message} (line {saved.line})")
        return self._keep_busy(now, 0.0, "save_image")

    def sequence(self, command: c.TakeSequence, start: float, step: int) -> planned.Span:
        """Simulate `take and save image sequence`: back to back, during any motion.

        The images are added, with positions of a fly scan where a trigger is armed, which
        is used up. Inferred settings, motion without a trigger, and projections during
        which nothing moves are warnings.

        Args:
            command: with prefix and first number of the file names.
            start: moment of the first exposure [s].
            step: index of the command's step.

        Returns:
            The time that the command takes, with a note of the number of images; the
            camera is busy until its end.
        """
        trigger = self._active(start)
        moving = self.motors.moving(start)
        inference = self._infer(trigger)
        settings = self.camera.settings
        frames = settings.frames
        period = settings.exposure_ms * settings.averages / 1000.0
        starts = start + period * np.arange(frames, dtype=np.float64)
        exact: dict[str, FloatArray] = {}
        if trigger is not None and inference is not None:
            starts, exact = self._fly_scan_times(trigger, inference, start, period)
        elif moving and frames > 1:
            message = (
                f"{', '.join(moving)} moves during the sequence without a trigger (POS)"
            )
            which = "where each image lies depends on the timing of commands"
            self.findings.warn(ScriptCode.NO_TRIGGER, f"{message}: {which}")
        files = sequence_names(command.prefix, command.first, frames)
        draft = self._add_images(
            starts, start, step, command.line, kind_of(files[0]), files, exact
        )
        if draft.kind == "projection" and frames > 1 and not moving:
            self.findings.warn(
                ScriptCode.STATIC_SEQUENCE, "nothing moves during this sequence"
            )
        self._check_saved(draft)
        self.trigger = None
        length = float(starts[-1] - start) + period
        span = self._keep_busy(start, length, self.machine.timing.sequence)
        message = f": {frames} images" + (
            f" over {trigger.axis}" if trigger is not None else ""
        )
        return replace(span, note=message)

    # time ----------------------------------------------------------------------------------

    def _keep_busy(self, start: float, length: float, kind: str) -> planned.Span:
        """Keep the camera busy for `length` [s] and the overhead of `kind`; return that
        time span.
        """
        overhead = self.machine.timing.seconds(kind)
        end = start + length + overhead
        self.camera.free_at = end
        return planned.Span(start, end, overhead, kind)

    def _add_images(
        self,
        starts: FloatArray,
        start: float,
        step: int,
        line: int,
        kind: ImageKind = "preview",
        files: tuple[str, ...] = (),
        exact: Mapping[str, FloatArray] | None = None,
    ) -> ExposureGroup:
        """Add images with exposures from `starts` (n,) [s], and remember them as the
        last.

        X-rays and motion are those at `start`, the command's; motors under way are kept
        in `moved`. `exact`: axis -> positions (n,) better known than by time.
        """
        tube = self.tube
        self.moved = self.motors.moving(start)
        lit = tube.lit(start)
        moving = bool(self.moved)
        group = ExposureGroup(
            kind,
            files,
            starts,
            self.camera.settings,
            lit,
            tube.kV,
            tube.power_W,
            step,
            line,
            moving,
            exact or {},
        )
        self.last = len(self.images)
        self.images.append(group)
        return group

    # fly scans -----------------------------------------------------------------------------

    def _active(self, start: float) -> planned.Trigger | None:
        """Return the trigger whose motion is still under way at `start` [s], else None.

        None also if its motor has begun another move since.
        """
        t = self.trigger
        if t is None or t.trajectory.end <= start:
            return None
        moves = self.motors.all[t.motor].moves
        if moves and moves[-1][1] is t.trajectory:
            return t
        return None

    def _infer(self, trigger: planned.Trigger | None) -> Inference | None:
        """Infer frames and averages that the script leaves out, set them in the camera,
        and warn of both.

        Averages that do not follow are those in force. Frames that do not follow, or
        without a trigger, are 1. Inferred averages are remembered for the images before.

        Args:
            trigger: of the sequence, or None.

        Returns:
            Frames and averages that fit the motion; None where none fit, or without a
            trigger.
        """
        camera = self.camera
        averages = None
        if "averages" in camera.said:
            averages = camera.settings.averages
        frames = None
        if "frames" in camera.said:
            frames = camera.settings.frames
        inferred = None
        if trigger is not None:
            exposure_s = camera.settings.exposure_ms / 1000.0
            inferred = infer(trigger, exposure_s, frames, averages)
            if inferred is None and averages is None:
                inferred = infer(trigger, exposure_s, frames, camera.settings.averages)
        if averages is None and inferred is not None and "averages" in inferred.notes:
            self.inferred_averages = inferred.averages
            camera.assume("averages", inferred.averages)
            how = f"{inferred.averages} inferred ({inferred.notes['averages']})"
            message = f"the number of averages is not set; {how}, and taken for images before this"
            self.findings.warn(ScriptCode.AVERAGES_UNSAID, f"{message} line too")
            self._reported.add("averages")
        if frames is None:
            count = 1 if inferred is None else inferred.frames
            how = "1 is assumed"
            if inferred is not None:
                how = f"inferred from {inferred.notes['frames']}"
            self.findings.warn(
                ScriptCode.FRAMES_UNSAID, f"the number of frames is not set; {how}"
            )
            camera.assume("frames", count)
        return inferred

    def _fly_scan_times(
        self, trigger: planned.Trigger, found: Inference, start: float, period: float
    ) -> tuple[FloatArray, dict[str, FloatArray]]:
        """Compute the nominal moments of a fly scan's images, and positions by the rule;
        report deviations.

        Warnings: a sequence that starts more than `_TIME_TOLERANCE_S` after the trigger
        (the first image is then where the motor is); stated frames that miss whole turns
        by more than `_MISMATCH_STEPS` increments; a motor that is off the rule by more
        than `_POSITION_TOLERANCE`, by a short run-up or an overrun (then all images are
        where the motor is, one period apart).

        Args:
            trigger: the motion during the scan.
            found: frames and increment.
            start: of the sequence [s].
            period: exposure time of an image, averages included [s].

        Returns:
            Moments (n,) [s]; motor -> positions (n,), empty if the images are where the
            motor is.
        """
        trajectory = trigger.trajectory
        unit = trigger.unit
        speed = trigger.speed
        sign = -1.0
        if trajectory.target >= trigger.position:
            sign = 1.0
        count = np.arange(found.frames, dtype=np.float64)
        late = start - trigger.time
        if late > _TIME_TOLERANCE_S:
            message = f"the sequence starts {late:.3g} s after {trigger.axis} passed its trigger"
            where = f"{trajectory.position(start):.6g}, not {trigger.position:g} {unit}"
            self.findings.warn(ScriptCode.LATE_START, f"{message}: image 0 is at {where}")
        if (
            abs(found.mismatch) > _MISMATCH_STEPS * found.increment
            and "frames" not in found.notes
        ):
            self.findings.warn(
                ScriptCode.FRAME_ANGLES,
                f"{found.frames} frames of {period * 1000:g} ms at {speed:.9g} {unit}/s "
                f"cover {found.mismatch:+.4g} {unit} more than whole turns; images "
                f"are put at steps of {found.increment:.9g} {unit}",
            )
        if late <= _TIME_TOLERANCE_S:
            first = trigger.position
        else:
            first = trajectory.position(start)
        wanted = first + sign * found.increment * count
        starts = start + found.increment / speed * count
        off = np.abs(trajectory.positions(starts) - wanted) > _POSITION_TOLERANCE
        exact = {trigger.motor: wanted}
        if off.any():
            velocity = abs(trajectory.velocity(trigger.time))
            if velocity < speed * (1 - 1e-9):
                code = ScriptCode.RUN_UP
                short = f"the run-up of {trigger.run_up:.4g} {unit} is too short"
                message = f"passes the trigger at {velocity:.4g} of {speed:.4g} {unit}/s: {short}"
            else:
                code = ScriptCode.SCAN_OVERRUN
                which = f"(from image {int(np.argmax(off))} on)"
                message = f"slows down before the last of {len(off)} images {which}"
            self.findings.warn(
                code, f"{trigger.axis} {message}; images lie where the motor is"
            )
            starts = start + period * count
            exact = {}
        return starts, exact

    # findings about a saved image ----------------------------------------------------------

    def _check_saved(self, draft: ExposureGroup) -> None:
        """Note the names of saved images; warn of repeated names, missing settings and
        X-rays that do not fit the kind.

        A dark does not fit X-rays on, any other kind X-rays off. Of repeated names the
        first is named.
        """
        clash = next((f for f in draft.files if f in self.names), None)
        if clash is not None:
            self.findings.warn(
                ScriptCode.OVERWRITES, f"{clash} is saved twice; the last one stays"
            )
        self.names.update(draft.files)
        self._warn_of_defaults(draft)
        match draft.kind:
            case "dark":
                if draft.xrays_on:
                    self.findings.warn(
                        ScriptCode.XRAYS_ON, "a dark image is taken with X-rays on"
                    )
                return
            case "flat":
                message = "a flat image is"
            case "projection" | "preview":
                message = "projections are"
            case _:
                assert_never(draft.kind)
        if not draft.xrays_on:
            self.findings.warn(ScriptCode.XRAYS_OFF, f"{message} taken with X-rays off")

    def _warn_of_defaults(self, draft: ExposureGroup) -> None:
        """Warn, once each, of the settings that a saved image takes from the machine's
        defaults.

        They are mode, exposure, ROI and averages; with X-rays on, voltage and power too.
        Averages are left out where a hint was given, or a warning says that they are
        inferred.
        """
        s = draft.camera
        self._default("mode", "the camera mode", s.mode)
        self._default("exposure_ms", "the exposure", f"{s.exposure_ms:g} ms")
        self._default("roi", "the ROI", str(s.roi))
        known = self.hint is not None or "averages" in self.camera.said
        if not known and "averages" not in self._reported:
            self._reported.add("averages")
            self.findings.warn(
                ScriptCode.AVERAGES_UNSAID,
                "the number of averages is not set; 1 is assumed",
            )
        if draft.xrays_on:
            self._default("kV", "the tube voltage", f"{draft.kV:g} kV")
            self._default("power_W", "the tube power", f"{draft.power_W:g} W")

    def _default(self, name: str, what: str, value: str) -> None:
        """Warn, once, that no value of setting `name` is stated, and `value` is assumed.

        `what`: the setting in words; nothing is done if it is stated.
        """
        if name not in self.camera.said | self.tube.said | self._reported:
            self._reported.add(name)
            self.findings.warn(
                ScriptCode.DEFAULT_ASSUMED,
                f"{what} is not set; {value} of the machine file is assumed",
            )
