"""The plan of a scan, and the report about it, as plain frozen data.

A `ScanPlan` describes a script before it runs, on a clock that starts at 0: the position
of each axis at any time, and the time, pose, settings and file of every image. Images of
a sequence are columns of arrays and become `Exposure` values only on request. A
`CheckReport` is the result of `ScanPlan.check`: problems, collisions and clearances, the
beam's view, dose.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from flexdt.twin.backends import backend
from flexdt.twin.findings import Findings
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.machine.kinematics import motor_poses
from flexdt.twin.motion.profiles import AxisPath, Trajectory
from flexdt.twin.script.planning.check_findings import Clearance, Dose, Optics
from flexdt.twin.script.planning.plan_values import (
    BeamOn,
    Exposure,
    ExposureGroup,
    PlanStep,
    SampleSize,
    Settings,
    StartState,
)
from flexdt.twin.script.planning.time_ranges import Range, step_range, total_range
from flexdt.twin.script.problems import Problems, WithProblems
from flexdt.twin.values import ArrayValue, JsonValue

_OF_STEP = (
    "line",
    "start_s",
    "duration_s",
    "holds_s",
    "assumed_s",
    "assumed_from",
    "what",
)
HOME_ASSUMED = "the machine's home, assumed"
EMPTY = "none"
EMPTY_ASSUMED = "empty stage assumed"


@dataclass(frozen=True, eq=False, repr=False)
class ScanPlan(WithProblems, ArrayValue, JsonValue):
    """A script simulated on a virtual clock.

    Attributes:
        start: the scanner before the script.
        steps: one for each command that has an effect or takes time, in the script's
            order.
        trajectories: axis -> (time, trajectory), each in force until the next; axes that
            never move have none.
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
    problems: Problems
    duration_s: float

    def __repr__(self) -> str:
        """Format as one line: machine, steps, projections, duration [s], errors and warnings."""
        return (
            f"<ScanPlan on {self.machine.name}: {len(self.steps)} steps, {self.frames} "
            f"projections, {self.duration_s:.1f} s, {len(self.errors)} errors, "
            f"{len(self.warnings)} warnings>"
        )

    @property
    def ok(self) -> bool:
        """Whether it may run."""
        return not self.errors

    @property
    def assumed_s(self) -> float:
        """Duration from the machine's timing."""
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
        """Nominal poses of the projections that are saved, with the profile's zero offsets.

        Dark and flat images have none; empty without projections.
        """
        nowhere = motor_poses(self.machine, self.profile, self.start.camera, {})[:0]
        parts = [
            motor_poses(self.machine, self.profile, group.camera, positions)
            for group, positions in saved_images(self)
            if group.kind == "projection"
        ]
        return Poses.concatenate([nowhere, *parts])

    @property
    def geometry(self) -> ConeVec:
        """Nominal geometry of the projections that are saved; it carries the detector's
        shape where all of them have the same."""
        shapes = {g.camera.shape for g, _ in saved_images(self) if g.kind == "projection"}
        return self.poses.cone_vec().with_shape(
            shapes.pop() if len(shapes) == 1 else None
        )

    def check(self, sample: object = None) -> CheckReport:
        """Check the plan: problems, collisions, truncation and dose, as `flexdt check` does.

        Args:
            sample: the sample on the stage, as `flexdt.plan` takes it; None: that of the
                script.

        Returns:
            `ok` is False with an error or a collision, and `to_dict()` is the JSON.
        """
        report: CheckReport = backend("scripts").check(self, sample)
        return report

    def plot(self, report: CheckReport | None = None) -> Any:
        """Plot motors, X-rays, exposures and clearance over time.

        `report`: from `check`; None checks now. Returns matplotlib's figure."""
        return backend("plots").plot_plan(
            self, self.check() if report is None else report
        )

    @cached_property
    def paths(self) -> Mapping[str, AxisPath]:
        """Axis -> its position as a function of time; at its start position where it never
        moves.
        """
        return {
            axis: AxisPath.of(self.start.positions[axis], self.trajectories.get(axis, ()))
            for axis in self.machine.axes
        }

    def positions(self, times: npt.ArrayLike) -> dict[str, FloatArray]:
        """Compute axis -> positions at `times` [s], of the same shape."""
        return {axis: path.positions(times) for axis, path in self.paths.items()}

    @cached_property
    def starts(self) -> FloatArray:
        """Nominal moment of every image, (n,) [s], in the order of `exposures`."""
        return np.concatenate([g.starts for g in self.groups] or [np.empty(0)])

    @cached_property
    def image_positions(self) -> Mapping[str, FloatArray]:
        """Axis -> (n,) position [mm, deg] at the nominal moment of every image, saved or not.

        Positions that a trigger determines are the exact ones.
        """
        out = self.positions(self.starts)
        first = 0
        for group in self.groups:
            for axis, values in group.exact.items():
                out[axis][first : first + len(group)] = values
            first += len(group)
        return out

    def subframe_positions(self, samples: int) -> dict[str, FloatArray]:
        """Compute positions spread over each image's exposure.

        The samples are symmetric about the nominal pose (assumed: the trigger's place within the
        exposure is not published), so their mean has no bias against it at constant speed. An
        exposure covers all averages; images of a group that stands have equal samples.

        Args:
            samples: number of moments in an exposure.

        Returns axis -> (n, samples) positions [mm, deg] of all images, saved or not.
        """
        offsets = (np.arange(samples) + 0.5) / samples - 0.5
        of_group = [
            g.camera.exposure_ms * g.camera.averages / 1000.0 * g.moving
            for g in self.groups
        ]
        counts = np.array([len(g) for g in self.groups], dtype=int)
        lengths = np.repeat(np.array(of_group), counts)
        times = self.starts[:, None] + lengths[:, None] * offsets
        nominal = self.image_positions
        moved = self.positions(times)
        centre = self.positions(self.starts)
        return {n: nominal[n][:, None] + moved[n] - centre[n][:, None] for n in moved}

    @cached_property
    def exposures(self) -> tuple[Exposure, ...]:
        """Every image of the plan as one value, in the order of time; long plans have
        many.

        Images that are not saved have no file (None).
        """
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
                        i,
                        g.kind,
                        file,
                        start,
                        g.camera.exposure_ms,
                        g.camera.averages,
                        g.xrays_on,
                        g.kV,
                        g.power_W,
                        g.camera,
                        where,
                        g.step,
                        g.line,
                        g.moving,
                    )
                )
        return tuple(out)


def saved_images(plan: ScanPlan) -> Iterator[tuple[ExposureGroup, dict[str, FloatArray]]]:
    """Yield each group that saves images, with its motors' positions.

    Groups without files are skipped.

    Yields the group, and axis -> (n,) positions of its images [mm, deg].
    """
    first = 0
    for group in plan.groups:
        rows = slice(first, first + len(group))
        first += len(group)
        if group.files:
            yield group, {n: v[rows] for n, v in plan.image_positions.items()}


@dataclass(frozen=True)
class CheckReport(WithProblems):
    """The complete report; `to_dict` is the document of `flexdt check --json`."""

    plan: ScanPlan
    problems: Findings
    clearance: Clearance | None
    optics: tuple[Optics, ...]
    dose: Dose
    text: str = field(default="", repr=False)
    start_known: bool = True
    """Whether the start was given; otherwise the machine's home positions are assumed."""

    def __repr__(self) -> str:
        """Format as one line: ok or not, number of collisions, and the plan.

        0 collisions if they were not checked.
        """
        hits = 0
        if self.clearance:
            hits = len(self.clearance.collisions)
        return (
            f"<CheckReport: {'ok' if self.ok else 'not ok'}, "
            f"{hits} collisions, of {self.plan!r}>"
        )

    @property
    def ok(self) -> bool:
        """Whether there is no error and no collision; warnings do not count."""
        return not self.errors  # a collision is one

    @property
    def start(self) -> str:
        """Positions of the motors at the start, as text; assumed homes are named so."""
        at = ", ".join(f"{name}={x:g}" for name, x in self.plan.start.positions.items())
        if self.start_known:
            return at
        return f"{HOME_ASSUMED}: {at}"

    @property
    def sample(self) -> str:
        """The sample on the stage, as text: diameter, height if known, and source.

        Without one the stage is empty, or assumed empty if the start is not known.
        """
        size = self.plan.sample
        if size is None:
            if self.start_known:
                return EMPTY
            return f"{EMPTY} ({EMPTY_ASSUMED})"
        high = ""
        if size.height_mm:
            lower, upper = size.span_mm
            high = f", {upper - lower:g} mm high"
            if size.rims_mm:
                high += f" from {lower:g} to {upper:g} mm"
        return f"{size.diameter_mm:g} mm across{high} ({size.source})"

    def to_dict(self) -> dict[str, object]:
        """Return the JSON document of `flexdt check --json`; times in s, lengths in mm.

        It has problems, steps, durations and their ranges, numbers of images and bytes,
        collisions, clearance, optics, dose, start and sample. Without a collision check
        `collisions_checked` is false and the clearance is empty; without a sample
        `sample` is None, and an unknown height is None.
        """
        plan = self.plan
        clearance = self.clearance
        size = plan.sample
        found = clearance or Clearance()
        return {
            "ok": self.ok,
            "machine": plan.machine.name,
            "profile": plan.profile.name,
            "problems": [p.to_dict() for p in self.problems],
            "steps": [
                {n: getattr(s, n) for n in _OF_STEP}
                | _range(step_range(s, plan.machine.timing))
                for s in plan.steps
            ],
            "duration_s": plan.duration_s,
            **_range(total_range(plan.steps, plan.duration_s, plan.machine.timing)),
            "computed_s": plan.computed_s,
            "assumed_s": plan.assumed_s,
            "timing_source": plan.machine.timing.source,
            "frames": plan.frames,
            "images": sum(len(g.files) for g in plan.groups),
            "bytes": plan.bytes,
            "collisions": [x.to_dict() for x in found.collisions],
            "collisions_checked": clearance is not None,
            "min_clearance_mm": found.min_clearance_mm,
            "min_clearance_pair": found.min_clearance_pair
            and list(found.min_clearance_pair),
            "clearance": [list(p) for p in found.trace],
            "optics": [o.to_dict() for o in self.optics],
            "dose": dict(vars(self.dose)),
            "start": {"known": self.start_known, "positions": dict(plan.start.positions)},
            "summary": {"sample": self.sample, "start": self.start},
            "sample": size and {**vars(size), "height_mm": size.height_mm or None},
        }


def _range(found: Range | None) -> dict[str, float | None]:
    """Return a 90 % range as {p5_s, p95_s}, both None for None."""
    low, high = found or (None, None)
    return {"p5_s": low, "p95_s": high}
