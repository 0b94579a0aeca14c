"""The camera's commands on the plan's clock: when each image is taken, where and to which file.

Sequences over a moving axis follow the smooth-scan rule of fly scans. Gaps in the script (frames,
averages) are inferred from speed and run-up where possible; otherwise a documented default is used,
with a warning that names it.

The rule: with N images, exposure e, m averages and T = e m, speed v = turn / (N - 1) / T, and the
motion starts v^2 / (2 a) + 4 T v before the first image and ends as far behind the last (checked
against seven published scans to 1e-5 deg). Lengths are in the axis's unit (deg or mm), times in s.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.description import Machine
from flexdt.twin.script import commands as c
from flexdt.twin.script import planned_scanner as planned
from flexdt.twin.script.commands import ImageKind
from flexdt.twin.script.grammar import image_name, kind_of, sequence_names, shorten
from flexdt.twin.script.plan import ExposureGroup
from flexdt.twin.script.problems import Findings

MARGIN_IMAGES: Final = 4.0
"""Images' worth of constant speed before the first and after the last image."""
FULL_TURN: Final = 360.0
MAX_STEPS: Final = 1_000_000
"""More than this is no inference but a mistake."""


def run_up(speed: float, acceleration: float, period_s: float) -> float:
    """Length before the first image: speeding up, then four images at constant speed."""
    return speed * speed / (2.0 * acceleration) + MARGIN_IMAGES * period_s * speed


@dataclass(frozen=True)
class Flight:
    """The settings of a fly scan in a script; lengths unsigned. None: left out."""

    speed: float
    acceleration: float
    run_up: float
    """From the start of the motion to the trigger."""
    run: float
    """From the trigger to the end of the motion."""
    exposure_s: float
    frames: int | None
    averages: int | None
    rotation: bool = True


@dataclass(frozen=True)
class Inference:
    """What fills the gaps; `notes` says for each setting how it was found."""

    frames: int
    averages: int
    increment: float
    mismatch: float
    """Length by which frames x speed x period misses the increments, over the whole scan."""
    notes: dict[str, str]


def infer(flight: Flight) -> Inference | None:
    """Averages, then frames, then the increment; None if speed and run-up do not tell.

    The scan's length is the motion's less one run-up at each end (the end is symmetric), rounded
    to whole turns for a rotation. Averages follow from frames where those are stated, else from
    the run-up. `frames x speed x period` within half a step of whole turns means that the images
    lie at turn / (frames - 1), as the scanner's own software counts; otherwise they lie where the
    motor is.
    """
    length = _length(flight)
    notes: dict[str, str] = {}
    averages = flight.averages
    if averages is None:
        found = _averages(flight, length)
        if found is None:
            return None
        averages, notes["averages"] = found
    step = flight.speed * flight.exposure_s * averages
    frames = flight.frames
    if frames is None:
        steps = length / step
        if not 0.5 <= steps < MAX_STEPS:
            return None
        frames = round(steps) + 1
        notes["frames"] = (
            f"{steps:.2f} steps of {step:.6g} at this speed, exposure and averages make "
            f"{length:g}; rounded, {frames} frames"
        )
    increment, mismatch = images(step, frames, flight.rotation)
    return Inference(frames, averages, increment, mismatch, notes)


def images(step: float, frames: int, rotation: bool) -> tuple[float, float]:
    """(increment, mismatch over the scan) for `frames` images with `step` of motion between."""
    scan = step * (frames - 1)
    turns = round(scan / FULL_TURN)
    if rotation and turns >= 1 and abs(scan - turns * FULL_TURN) < 0.5 * step:
        return turns * FULL_TURN / (frames - 1), scan - turns * FULL_TURN
    return step, 0.0


def _length(flight: Flight) -> float:
    length = flight.run - flight.run_up
    turns = round(length / FULL_TURN)
    if flight.rotation and turns >= 1 and abs(length - turns * FULL_TURN) < 1.0:
        return turns * FULL_TURN
    return length


def _averages(flight: Flight, length: float) -> tuple[int, str] | None:
    if flight.frames is not None and flight.frames > 1 and length > 0.0:
        period = length / (flight.frames - 1) / flight.speed
        how = f"speed and {flight.frames} frames"
    else:
        ramp = flight.speed**2 / (2.0 * flight.acceleration)
        period = (flight.run_up - ramp) / (MARGIN_IMAGES * flight.speed)
        how = f"speed, run-up {flight.run_up:.6f} and acceleration {flight.acceleration:g}"
    ratio = period / flight.exposure_s
    averages = round(ratio)
    if averages < 1 or abs(ratio - averages) > 0.02 * averages:
        return None
    return averages, f"{ratio:.5g} from {how}"


_TIME_EPS = 1e-9
_POSITION_EPS = 1e-7
_MISMATCH_STEPS = 0.05
"""Steps by which stated frames may miss a whole turn before it is worth a warning."""


class ImageCollector:
    """Collects images; lives only while a plan is made."""

    def __init__(
        self,
        machine: Machine,
        motors: planned.Motors,
        tube: planned.PlannedTube,
        camera: planned.PlannedCamera,
        findings: Findings,
        averages: int | None,
    ) -> None:
        self.machine, self.motors, self.tube, self.camera = machine, motors, tube, camera
        self.findings = findings
        self.trigger: planned.Trigger | None = None
        self.images: list[ExposureGroup] = []
        self.last: int | None = None
        """Index of the image taken last; while it was taken, `moved` were under way."""
        self.moved: list[str] = []
        self.names: set[str] = set()
        self.hint = averages
        self.inferred_averages: int | None = None
        self._complained: set[str] = set()
        if averages is not None:
            camera.assume("averages", averages)

    def groups(self) -> tuple[ExposureGroup, ...]:
        """All images, in the order in which they were taken."""
        return tuple(self.images)

    # commands ------------------------------------------------------------------------------

    def take(self, command: c.TakeImage, now: float, step: int) -> planned.Span:
        """`take image`: one image; the number of frames is for sequences."""
        self._taken(np.array([now], dtype=np.float64), now, step, command.line)
        settings = self.camera.settings
        length = settings.exposure_ms * settings.averages / 1000.0
        return self._busy(now, length, "take_image_overhead")

    def save(self, command: c.SaveImage, now: float, _step: int) -> planned.Span:
        """`save image`: gives the image taken last its name, and with it its kind."""
        name = image_name(command.path)
        if name is None:
            self.findings.error("path", f"{shorten(command.path)!r} does not end with a file name")
        elif self.last is None:
            self.findings.error("nothing_to_save", "no image has been taken since the start")
        else:
            taken = self.images[self.last]
            saved = replace(taken, files=(name,), kind=kind_of(name))
            if taken.files:  # saved before under another name: a second copy of the same image
                self.images.append(saved)
            else:
                self.images[self.last] = saved
            self._saved(saved)
            if self.moved:
                what = f"{', '.join(self.moved)} still moves while {name} is taken"
                self.findings.warn("moving", f"{what} (line {saved.line})")
        return self._busy(now, 0.0, "save_image")

    def sequence(self, command: c.TakeSequence, start: float, step: int) -> planned.Span:
        """`take and save image sequence`: back to back, over whatever moves meanwhile."""
        trigger = self._active(start)
        moving = self.motors.moving(start)
        inference = self._infer(trigger, start)
        settings = self.camera.settings
        frames = settings.frames
        period = settings.exposure_ms * settings.averages / 1000.0
        starts = start + period * np.arange(frames, dtype=np.float64)
        exact: dict[str, FloatArray] = {}
        if trigger is not None and inference is not None:
            starts, exact = self._fly(trigger, inference, start, period)
        elif moving and frames > 1:
            self.findings.warn(
                "no_trigger",
                f"{', '.join(moving)} moves during the sequence without a trigger (POS): where "
                "each image lies depends on the timing of commands",
            )
        files = sequence_names(command.prefix, command.first, frames)
        draft = self._taken(starts, start, step, command.line, kind_of(files[0]), files, exact)
        if draft.kind == "projection" and frames > 1 and not moving:
            self.findings.warn("static_sequence", "nothing moves during this sequence")
        self._saved(draft)
        self.trigger = None
        length = float(starts[-1] - start) + period
        span = self._busy(start, length, self.machine.timing.sequence)
        what = f": {frames} images" + (f" over {trigger.axis}" if trigger is not None else "")
        return replace(span, note=what)

    # time ----------------------------------------------------------------------------------

    def _busy(self, start: float, length: float, kind: str) -> planned.Span:
        overhead = self.machine.timing.seconds(kind)
        end = start + length + overhead
        self.camera.free_at = end
        return planned.Span(start, end, overhead, kind)

    def _taken(
        self,
        starts: FloatArray,
        start: float,
        step: int,
        line: int,
        kind: ImageKind = "preview",
        files: tuple[str, ...] = (),
        exact: Mapping[str, FloatArray] | None = None,
    ) -> ExposureGroup:
        """Images from `start` on, with the settings in force; they are the last ones then."""
        tube, self.moved = self.tube, self.motors.moving(start)
        lit, moving = tube.lit(start), bool(self.moved)
        made = ExposureGroup(
            kind, files, starts, self.camera.settings, lit, tube.kV, tube.power_W, step, line,
            moving, exact or {},
        )  # fmt: skip
        self.last = len(self.images)
        self.images.append(made)
        return made

    # fly scans -----------------------------------------------------------------------------

    def _active(self, start: float) -> planned.Trigger | None:
        """The trigger whose motion is still under way, if any."""
        t = self.trigger
        if t is None or t.trajectory.end <= start:
            return None
        moves = self.motors.all[t.motor].moves
        return t if moves and moves[-1][1] is t.trajectory else None

    def _infer(self, trigger: planned.Trigger | None, start: float) -> Inference | None:
        """Infer frames and averages that the script leaves out."""
        camera = self.camera
        averages = camera.settings.averages if "averages" in camera.said else None
        frames = camera.settings.frames if "frames" in camera.said else None
        found = None
        if trigger is not None:
            found = infer(self._flight(trigger, frames, averages))
        if found is None and trigger is not None and (averages is None or frames is None):
            fallback = camera.settings.averages if averages is None else averages
            found = infer(self._flight(trigger, frames, fallback))
        if averages is None:
            self._averages(found)
        if frames is None:
            count = 1 if found is None else found.frames
            how = "1 is assumed" if found is None else f"inferred from {found.notes['frames']}"
            self.findings.warn("frames_unsaid", f"the number of frames is not set; {how}")
            camera.assume("frames", count)
        return found

    def _averages(self, found: Inference | None) -> None:
        if found is not None and "averages" in found.notes:
            self.inferred_averages = found.averages
            self.camera.assume("averages", found.averages)
            self.findings.warn(
                "averages_unsaid",
                f"the number of averages is not set; {found.averages} inferred "
                f"({found.notes['averages']}), and taken for images before this line too",
            )
            self._complained.add("averages")

    def _flight(self, trigger: planned.Trigger, frames: int | None, averages: int | None) -> Flight:
        pieces = trigger.trajectory.pieces
        return Flight(
            speed=max(abs(p.velocity) for p in pieces),
            acceleration=max(abs(p.acceleration) for p in pieces),
            run_up=abs(trigger.run_up),
            run=abs(trigger.trajectory.target - trigger.position),
            exposure_s=self.camera.settings.exposure_ms / 1000.0,
            frames=frames,
            averages=averages,
            rotation=self.machine.axes[trigger.motor].kind == "rotation",
        )

    def _fly(
        self,
        trigger: planned.Trigger,
        found: Inference,
        start: float,
        period: float,
    ) -> tuple[FloatArray, dict[str, FloatArray]]:
        """Nominal moments of the images, and their positions where the rule gives them."""
        trajectory = trigger.trajectory
        unit = self.machine.axes[trigger.motor].unit
        speed = max(abs(p.velocity) for p in trajectory.pieces)
        sign = 1.0 if trajectory.target >= trigger.position else -1.0
        count = np.arange(found.frames, dtype=np.float64)
        late = start - trigger.time
        if late > _TIME_EPS:
            self.findings.warn(
                "late_start",
                f"the sequence starts {late:.3g} s after {trigger.axis} passed its trigger: image "
                f"0 is at {trajectory.position(start):.6g}, not {trigger.position:g} {unit}",
            )
        if abs(found.mismatch) > _MISMATCH_STEPS * found.increment and "frames" not in found.notes:
            self.findings.warn(
                "frame_angles",
                f"{found.frames} frames of {period * 1000:g} ms at {speed:.9g} {unit}/s cover "
                f"{found.mismatch:+.4g} {unit} more than whole turns; images are put at steps of "
                f"{found.increment:.9g} {unit}",
            )
        first = trigger.position if late <= _TIME_EPS else trajectory.position(start)
        wanted = first + sign * found.increment * count
        starts = start + found.increment / speed * count
        off = np.abs(trajectory.positions(starts) - wanted) > _POSITION_EPS
        exact = {trigger.motor: wanted}
        if off.any():
            self._not_steady(trigger, off, unit)
            starts, exact = start + period * count, {}
        return starts, exact

    def _not_steady(self, trigger: planned.Trigger, off: npt.NDArray[np.bool_], unit: str) -> None:
        speed = max(abs(p.velocity) for p in trigger.trajectory.pieces)
        velocity = abs(trigger.trajectory.velocity(trigger.time))
        if velocity < speed * (1 - 1e-9):
            self.findings.warn(
                "run_up",
                f"{trigger.axis} passes the trigger at {velocity:.4g} of {speed:.4g} {unit}/s: the "
                f"run-up of {abs(trigger.run_up):.4g} {unit} is too short; images lie where the "
                "motor is",
            )
        else:
            self.findings.warn(
                "scan_overrun",
                f"{trigger.axis} slows down before the last of {len(off)} images (from image "
                f"{int(np.argmax(off))} on); images lie where the motor is",
            )

    # what is worth saying about a saved image ----------------------------------------------

    def _saved(self, draft: ExposureGroup) -> None:
        clash = next((f for f in draft.files if f in self.names), None)
        if clash is not None:
            self.findings.warn("overwrites", f"{clash} is saved twice; the last one stays")
        self.names.update(draft.files)
        self._unsaid(draft)
        if draft.kind == "dark" and draft.xrays_on:
            self.findings.warn("xrays_on", "a dark image is taken with X-rays on")
        if draft.kind != "dark" and not draft.xrays_on:
            what = "a flat image is" if draft.kind == "flat" else "projections are"
            self.findings.warn("xrays_off", f"{what} taken with X-rays off")

    def _unsaid(self, draft: ExposureGroup) -> None:
        """One warning for each setting that a saved image takes from the machine's defaults."""
        s = draft.camera
        self._default("mode", "the camera mode", s.mode)
        self._default("exposure_ms", "the exposure", f"{s.exposure_ms:g} ms")
        self._default("roi", "the ROI", str(s.roi))
        known = self.hint is not None or "averages" in self.camera.said
        if not known and "averages" not in self._complained:
            self._complained.add("averages")
            self.findings.warn("averages_unsaid", "the number of averages is not set; 1 is assumed")
        if draft.xrays_on:
            self._default("kV", "the tube voltage", f"{draft.kV:g} kV")
            self._default("power_W", "the tube power", f"{draft.power_W:g} W")

    def _default(self, name: str, what: str, value: str) -> None:
        """One warning where the script states no value of a setting."""
        if name not in self.camera.said | self.tube.said | self._complained:
            self._complained.add(name)
            self.findings.warn(
                "default_assumed", f"{what} is not set; {value} of the machine file is assumed"
            )
