"""The smooth-scan rule applied to a number of images: what a script of that many should
hold."""

from __future__ import annotations

from dataclasses import dataclass

from flexdt.twin.script.planning.planned_images import FULL_TURN_DEG, run_up


@dataclass(frozen=True)
class SmoothScan:
    """A fly scan that follows the rule; `start` and `end` are where the motion starts and
    ends."""

    frames: int
    period_s: float
    first: float
    speed: float
    acceleration: float
    start: float
    end: float

    @property
    def increment(self) -> float:
        """Step from image to image."""
        return self.speed * self.period_s


def smooth_scan(
    frames: int,
    exposure_s: float,
    averages: int,
    acceleration: float,
    *,
    first: float = 0.0,
    turn: float = FULL_TURN_DEG,
) -> SmoothScan:
    """Apply the rule to `frames` >= 2 images over `turn`, the last of them at first + turn.

    Raises:
        ValueError: fewer than two frames.
    """
    if frames < 2:
        raise ValueError(f"a fly scan has at least 2 frames, not {frames}")
    period = exposure_s * averages
    speed = turn / (frames - 1) / period
    margin = run_up(speed, acceleration, period)
    return SmoothScan(
        frames, period, first, speed, acceleration, first - margin, first + turn + margin
    )
