"""The plan of a scan as plain frozen data: steps, motion, images, all on a clock that starts at 0.

A `ScanPlan` describes a script before it runs: the position of each axis at any time, and the time,
pose, settings and file of every image. Images of a sequence are columns of arrays and become
`Exposure` values only on request.

`step_range` and `total_range` say between which times a step or a scan takes, nine of ten times,
by what a machine's logs tell.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from flexdt.twin.backends import backend
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.machine.description import Machine, Profile, Timing
from flexdt.twin.machine.kinematics import motor_poses
from flexdt.twin.motion.profiles import AxisPath, Trajectory
from flexdt.twin.scanner.state import StagePlacement
from flexdt.twin.script.commands import AnyCommand, ImageKind
from flexdt.twin.script.problems import ScriptProblem, WithProblems
from flexdt.twin.values import Array, ArrayValue, JsonValue

if TYPE_CHECKING:
    from flexdt.twin.script.dry_run import CheckReport


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
    """None: nobody knows. They count as off, and switching them off takes its time."""

    @classmethod
    def of(cls, machine: Machine) -> StartState:
        """The machine's homes and defaults; whether X-rays are on is not known."""
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
        duration_s: how long it takes; a move goes on after the script did when it does not wait.
        holds_s: how long the script waits for it; the next step starts then.
        assumed_s: the part of `holds_s` from the machine's timing and not from moves, pauses and
            exposures.
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
    """One image: what is set and where every axis stands at its nominal moment `start_s`.

    `file` is a bare file name (no folder), None for a preview, which is not saved. `step` indexes
    `ScanPlan.steps`: the command that takes the image. `index` counts all images of the plan.
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
        exact: axes whose positions are known by rule, (n,) each; others follow the trajectories.
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
        cls, size_mm: Sequence[float], source: str = "given", offset: StagePlacement | None = None
    ) -> SampleSize:
        """The cylinder that contains a box of `size_mm` (x, y, z) at `offset`, at every angle."""
        at = StagePlacement() if offset is None else offset
        x, y, z = size_mm
        radius = 0.5 * math.hypot(x, y)
        if at.rx or at.ry:
            radius = 0.5 * math.hypot(x, y, z)
            z = 2.0 * radius
        return cls(2.0 * (radius + math.hypot(at.x, at.y)), z + 2.0 * abs(at.z), source)


@dataclass(frozen=True, eq=False, repr=False)
class ScanPlan(WithProblems, ArrayValue, JsonValue):
    """A script simulated on a virtual clock.

    Attributes:
        start: the scanner before the script.
        steps: one for each command that has an effect or takes time, in the script's order.
        trajectories: axis -> (time, trajectory), each in force until the next; axes that never
            move have none.
        groups: all images, in the order in which they are taken.
        settings: at the last `write settings file`, or None.
        beam: when X-rays are on.
        sample: its size, if known.
        problems: errors and warnings, by line.
        duration_s: until the last command and the last motion are over.
    """

    machine: Machine
    profile: Profile
    start: StartState
    steps: tuple[PlanStep, ...]
    trajectories: Mapping[str, tuple[tuple[float, Trajectory], ...]]
    groups: tuple[ExposureGroup, ...]
    settings: Settings | None
    beam: tuple[BeamOn, ...]
    sample: SampleSize | None
    problems: tuple[ScriptProblem, ...]
    duration_s: float

    def __repr__(self) -> str:
        return (
            f"<ScanPlan on {self.machine.name}: {len(self.steps)} steps, {self.frames} projections,"
            f" {self.duration_s:.1f} s, {len(self.errors)} errors, {len(self.warnings)} warnings>"
        )

    @property
    def ok(self) -> bool:
        """Whether the script may run."""
        return not self.errors

    @property
    def assumed_s(self) -> float:
        """Part of the duration that comes from the machine's timing."""
        return sum(s.assumed_s for s in self.steps)

    @property
    def computed_s(self) -> float:
        """Part of the duration that follows from moves, pauses and exposures."""
        return self.duration_s - self.assumed_s

    @property
    def frames(self) -> int:
        """Number of projections that are saved."""
        return sum(len(g.files) for g in self.groups if g.kind == "projection")

    @property
    def bytes(self) -> int:
        """Pixel bytes of all images that are saved, dark and flat included."""
        return sum(g.bytes for g in self.groups)

    @cached_property
    def poses(self) -> Poses:
        """Nominal poses of the projections that are saved, with the profile's zero offsets."""
        nowhere = motor_poses(self.machine, self.profile, self.start.camera, {})[:0]
        parts = [
            motor_poses(self.machine, self.profile, group.camera, positions)
            for group, positions in saved_images(self)
            if group.kind == "projection"
        ]
        return Poses.concatenate([nowhere, *parts])

    @property
    def geometry(self) -> ConeVec:
        """Nominal geometry of the projections that are saved; it carries the detector's shape where
        all of them have the same."""
        shapes = {g.camera.shape for g, _ in saved_images(self) if g.kind == "projection"}
        return self.poses.cone_vec().with_shape(shapes.pop() if len(shapes) == 1 else None)

    def check(self, sample: object = None) -> CheckReport:
        """Problems, collisions, clearances, truncation and dose, as `flexdt check` reports them.

        Args:
            sample: what stands on the stage, as `flexdt.plan` takes it; None: what the script says.

        Returns:
            `ok` is False with an error or a collision, and
            `to_dict()` is the JSON.
        """
        report: CheckReport = backend("scripts").check(self, sample)
        return report

    def plot(self, report: CheckReport | None = None) -> Any:
        """Motors, X-rays, exposures and clearance over time; needs matplotlib (the extra `plots`).

        Args:
            report: from `check`; None checks now.

        Returns:
            matplotlib's figure.
        """
        return backend("plots").plot_plan(self, self.check() if report is None else report)

    @cached_property
    def paths(self) -> Mapping[str, AxisPath]:
        """Every axis's position as a function of time."""
        return {
            axis: AxisPath.of(self.start.positions[axis], self.trajectories.get(axis, ()))
            for axis in self.machine.axes
        }

    def positions(self, times: npt.ArrayLike) -> dict[str, FloatArray]:
        """Axis -> positions at `times` [s], same shape."""
        return {axis: path.positions(times) for axis, path in self.paths.items()}

    @cached_property
    def starts(self) -> FloatArray:
        """Nominal moment of every image, (n,) [s], in the order of `exposures`."""
        return np.concatenate([g.starts for g in self.groups] or [np.empty(0)])

    @cached_property
    def image_positions(self) -> Mapping[str, FloatArray]:
        """Axis -> (n,) position at the nominal moment of every image."""
        out = self.positions(self.starts)
        first = 0
        for group in self.groups:
            for axis, values in group.exact.items():
                out[axis][first : first + len(group)] = values
            first += len(group)
        return out

    def subframe_positions(self, samples: int) -> dict[str, FloatArray]:
        """Axis -> (n, samples) positions spread over each image's exposure.

        The samples lie symmetrically about the nominal pose (assumed: no public source says where
        in the exposure the trigger falls), so their mean has no bias against it.
        """
        offsets = (np.arange(samples) + 0.5) / samples - 0.5
        of_group = [g.camera.exposure_ms * g.camera.averages / 1000.0 * g.moving
                    for g in self.groups]  # fmt: skip
        counts = np.array([len(g) for g in self.groups], dtype=int)
        lengths = np.repeat(np.array(of_group), counts)
        times = self.starts[:, None] + lengths[:, None] * offsets
        nominal = self.image_positions
        moved = self.positions(times)
        centre = self.positions(self.starts)
        return {n: nominal[n][:, None] + moved[n] - centre[n][:, None] for n in moved}

    @cached_property
    def exposures(self) -> tuple[Exposure, ...]:
        """Every image, one by one."""
        names = list(self.image_positions)
        rows = np.array([self.image_positions[n] for n in names]).T.tolist()
        out: list[Exposure] = []
        for g in self.groups:
            files: Sequence[str | None] = g.files or [None] * len(g)
            for file, start in zip(files, g.starts.tolist(), strict=True):
                i = len(out)
                where = dict(zip(names, rows[i], strict=True))
                out.append(
                    Exposure(
                        i, g.kind, file, start, g.camera.exposure_ms, g.camera.averages, g.xrays_on,
                        g.kV, g.power_W, g.camera, where, g.step, g.line, g.moving,
                    )
                )  # fmt: skip
        return tuple(out)


def saved_images(plan: ScanPlan) -> Iterator[tuple[ExposureGroup, dict[str, FloatArray]]]:
    """Images of a plan that are saved, group by group, with the motors' positions."""
    first = 0
    for group in plan.groups:
        rows = slice(first, first + len(group))
        first += len(group)
        if group.files:
            yield group, {n: v[rows] for n, v in plan.image_positions.items()}


Range = tuple[float, float]


class _OfKind(Protocol):
    @property
    def kind(self) -> str: ...


def step_range(step: PlanStep, timing: Timing) -> Range | None:
    """(5 %, 95 %) of how long the script waits for a step [s].

    None where no time of the machine is measured. A time that is only assumed, on a machine whose
    other times are measured, is taken as anything from nothing to twice itself.
    """
    if not timing.spread:
        return None
    below, above = _margins(step.kind, timing)
    return max(0.0, step.holds_s - below), step.holds_s + above


def total_range(steps: Iterable[_OfKind], duration_s: float, timing: Timing) -> Range | None:
    """(5 %, 95 %) of a scan's duration [s], or None as for `step_range`.

    Steps are independent of each other, but what a kind's median is wrong by, from n times, all
    its steps have in common: the variance of one step's error is (1 + 1/n) of the command's own,
    that of N steps N + N^2 / n. The drift of all times is common to all steps and added to that,
    as systematic errors are.

    Args:
        steps: of a plan, or lines of a log.
        duration_s: predicted.
        timing: of the machine.
    """
    if not timing.spread:
        return None
    squares, common = [0.0, 0.0], 0.0
    for kind, count in Counter(step.kind for step in steps).items():
        n = timing.spread[kind].n if kind in timing.spread else 1
        common += count * timing.drift * timing.seconds(kind)
        for i, margin in enumerate(_margins(kind, timing)):
            squares[i] += (count + count**2 / n) / (1.0 + 1.0 / n) * margin**2
    below, above = (math.sqrt(square) + common for square in squares)
    return max(0.0, duration_s - below), duration_s + above


def _margins(kind: str, timing: Timing) -> Range:
    middle = timing.seconds(kind)
    spread = timing.spread.get(kind)
    if spread is None:
        return middle, middle
    return middle - spread.p5_s, spread.p95_s - middle
