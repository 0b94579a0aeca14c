"""Parts of a plan, as frozen values: start, steps, images, settings, beam, sample."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.machine.description import Machine
from flexdt.twin.scanner.state import StagePlacement
from flexdt.twin.script.commands import AnyCommand, ImageKind
from flexdt.twin.values import Array, ArrayValue


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
        duration_s: how long it takes; a move goes on after the script did when it does
            not wait.
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

    It is centred at the sample's reference height.
    """

    diameter_mm: float
    height_mm: float = 0.0
    source: str = "given"

    @classmethod
    def around(
        cls,
        size_mm: Sequence[float],
        source: str = "given",
        offset: StagePlacement | None = None,
    ) -> SampleSize:
        """Make the cylinder that contains a box of `size_mm` (x, y, z) at `offset`,
        at every angle."""
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
