"""Parts of a plan, as frozen values: start, steps, images, settings, beam, sample."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.machine.description import Machine
from flexdt.twin.scanner.state import StagePlacement
from flexdt.twin.script.commands import AnyCommand, ImageKind
from flexdt.twin.values import Array, ArrayValue

ROUNDING_MM: Final = 1e-9
"""A circle so little beyond others lies within them."""


@dataclass(frozen=True)
class StartState:
    """The scanner before the script [mm, deg, per second; kV, W]."""

    positions: Mapping[str, float]
    speeds: Mapping[str, float]
    accelerations: Mapping[str, float]
    camera: CameraSettings
    kV: float
    power_W: float
    xrays_on: bool | None = False
    """None: unknown. They count as off, and switching them off takes its time."""

    @classmethod
    def of(cls, machine: Machine) -> StartState:
        """Make the state of a machine at home with its default settings; whether X-rays
        are on is unknown.
        """
        return cls(
            {n: a.home for n, a in machine.axes.items()},
            {n: a.speed for n, a in machine.axes.items()},
            {n: a.acceleration for n, a in machine.axes.items()},
            machine.detector.camera,
            machine.tube.kV,
            machine.tube.power_W,
            None,
        )


@dataclass(frozen=True)
class PlanStep:
    """One command on the plan's clock.

    Attributes:
        index: place in `ScanPlan.steps`.
        line: line of the script.
        start_s: when the command starts to take effect.
        duration_s: how long it takes; a move for which the script does not wait continues
            while the script goes on.
        holds_s: how long the script waits for it; the next step starts then.
        assumed_s: the part of `holds_s` from the machine's timing and not from moves,
            pauses and exposures.
        assumed_from: where that part comes from.
        what: one readable line.
        command: the typed command.
        kind: the machine's time that it is (`Timing`).
    """

    index: int
    line: int
    start_s: float
    duration_s: float
    holds_s: float
    assumed_s: float
    assumed_from: str
    what: str
    command: AnyCommand
    kind: str = "command"

    @property
    def computed_s(self) -> float:
        """The part of `holds_s` that follows from moves, pauses and exposures."""
        return self.holds_s - self.assumed_s


@dataclass(frozen=True)
class Exposure:
    """One image: its settings and the position of every axis at its nominal moment `start_s`.

    `file` is a bare file name (no folder), None for a preview, which is not saved. `step`
    indexes `ScanPlan.steps`: the command that takes the image. `index` counts all images
    of the plan.
    """

    index: int
    kind: ImageKind
    file: str | None
    start_s: float
    exposure_ms: float
    averages: int
    xrays_on: bool
    kV: float
    power_W: float
    camera: CameraSettings
    positions: Mapping[str, float]
    step: int
    line: int
    moving: bool
    """Whether an axis moves during this image (fly scan)."""

    @property
    def duration_s(self) -> float:
        """Exposure times averages."""
        return self.exposure_ms * self.averages / 1000.0


@dataclass(frozen=True, eq=False)
class ExposureGroup(ArrayValue):
    """The images of one command: n of one kind with one setting.

    Attributes:
        files: n bare file names, or empty for a preview.
        starts: (n,) nominal moments [s].
        exact: axes whose positions are known by rule, (n,) each; others follow the
            trajectories.
        moving: whether an axis moves meanwhile.
    """

    kind: ImageKind
    files: tuple[str, ...]
    starts: Array
    camera: CameraSettings
    xrays_on: bool
    kV: float
    power_W: float
    step: int
    line: int
    moving: bool = False
    exact: Mapping[str, Array] = field(default_factory=dict)

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self.starts)

    @property
    def bytes(self) -> int:
        """Pixel bytes of the images that are saved (uint16)."""
        rows, cols = self.camera.shape
        return 2 * rows * cols * len(self.files)


@dataclass(frozen=True, kw_only=True)
class Settings(StartState):
    """The scanner at the moment of `write settings file`, and when that was."""

    time_s: float
    step: int


@dataclass(frozen=True)
class BeamOn:
    """An interval in which X-rays are on with one setting [s, kV, W]."""

    start_s: float
    end_s: float
    kV: float
    power_W: float


@dataclass(frozen=True)
class SampleSize:
    """A cylinder about the rotation axis that contains the sample [mm]; height 0 is unknown.

    It is centered at the sample's reference height.

    Attributes:
        diameter_mm, height_mm: of the cylinder.
        source: of the size, for people.
        rims_mm: circles about the axis, (radius, height) each: the body of revolution of
            their convex hull contains the sample at every angle. Empty where only the
            cylinder is known.
    """

    diameter_mm: float
    height_mm: float = 0.0
    source: str = "given"
    rims_mm: tuple[tuple[float, float], ...] = ()

    @classmethod
    def around(
        cls,
        size_mm: Sequence[float],
        source: str = "given",
        offset: StagePlacement | None = None,
    ) -> SampleSize:
        """Make the cylinder about the rotation axis that contains a box [mm] at every
        angle.

        A box tilted about x or y counts as its sphere. `offset`: None: upright in the
        stage's middle; `source`: of the size, for people.
        """
        if offset is None:
            at = StagePlacement()
        else:
            at = offset
        x, y, z = size_mm
        radius = 0.5 * math.hypot(x, y)
        if at.rx or at.ry:
            radius = 0.5 * math.hypot(x, y, z)
            z = 2.0 * radius
        return cls(2.0 * (radius + math.hypot(at.x, at.y)), z + 2.0 * abs(at.z), source)

    @classmethod
    def of_points(cls, points_mm: FloatArray, source: str = "given") -> SampleSize:
        """Make the cylinder, and rims, that contain points (k, 3) [mm] at every angle.

        It is as high above the stage's origin as below it. `source`: of the size, for
        people.
        """
        radius = np.hypot(points_mm[:, 0], points_mm[:, 1])
        height = points_mm[:, 2]
        diameter_mm = 2.0 * float(radius.max())
        height_mm = 2.0 * float(np.abs(height).max())
        return cls(diameter_mm, height_mm, source, _outer_rims(radius, height))

    @property
    def span_mm(self) -> tuple[float, float]:
        """Lowest and highest point over the stage's origin [mm]; equal ones: unknown."""
        heights = [height for _, height in self.outline_mm]
        return min(heights), max(heights)

    @property
    def outline_mm(self) -> tuple[tuple[float, float], ...]:
        """The rims, else those of the cylinder: circles (radius, height) about the axis."""
        if self.rims_mm:
            return self.rims_mm
        radius = self.diameter_mm / 2
        half = self.height_mm / 2
        return (radius, -half), (radius, half)


def _outer_rims(
    radius: FloatArray, height: FloatArray
) -> tuple[tuple[float, float], ...]:
    """Find the circles on the convex hull of a body of revolution, from the lowest up.

    Of circles at one height only the widest counts.

    Args:
        radius, height: of its circles, (k,) each [mm].

    Returns (radius, height) of those that the others' hull does not contain.
    """
    order = np.lexsort((-radius, height))
    _, first = np.unique(height[order], return_index=True)
    widest = order[first]
    chain: list[tuple[float, float]] = []
    for r, z in zip(radius[widest].tolist(), height[widest].tolist(), strict=True):
        while len(chain) > 1 and _lies_within(chain[-2], chain[-1], (r, z)):
            chain.pop()
        chain.append((r, z))
    return tuple(chain)


def _lies_within(
    below: tuple[float, float], middle: tuple[float, float], above: tuple[float, float]
) -> bool:
    """Check whether a circle lies within the cone through one below and one above it."""
    share = (middle[1] - below[1]) / (above[1] - below[1])
    return middle[0] <= below[0] + share * (above[0] - below[0]) + ROUNDING_MM
