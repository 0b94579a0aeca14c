"""The smooth-scan rule of fly scans, and what can be inferred from a script that leaves gaps.

With N images, exposure e, m averages and T = e m: speed v = turn / (N - 1) / T, and the motion
starts v^2 / (2 a) + 4 T v before the first image and ends as far behind the last (checked against
seven published scans to 1e-5 deg). Lengths are in the axis's unit (deg or mm), times in s.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

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
