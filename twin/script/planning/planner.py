"""A script to a plan: simulate it, fill its gaps, check the beam's view, collect problems.

The result is data; nothing moves. Collisions are checked by `dry_run`, which takes the check as a
function.

`views` are what the beam sees of the sample. Poses come from the nominal geometry. The sample is a
cylinder about the rotation axis, or only the axis where its size is unknown, so a report about
truncation is about the cylinder that holds the sample at every angle of a full rotation.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.machine.description import (
    Machine,
    Profile,
    builtin_machine,
    profile_of,
)
from flexdt.twin.machine.kinematics import motor_poses
from flexdt.twin.script import commands as c
from flexdt.twin.script.commands import ImageKind
from flexdt.twin.script.parse import Source, parse_script
from flexdt.twin.script.planning.plan import SampleSize, ScanPlan, StartState
from flexdt.twin.script.planning.simulated_script import Simulation
from flexdt.twin.script.problems import ScriptProblem, in_order


def plan_script(
    script: c.Script | Source,
    machine: Machine | None = None,
    profile: Profile | None = None,
    *,
    start: StartState | None = None,
    sample: SampleSize | None = None,
) -> ScanPlan:
    """Simulate `script` on a clock that starts at 0.

    Problems of the script are in `ScanPlan.problems`; steps, motion and images are planned all the
    same. Averages that the script leaves out and that follow from speed and run-up are used for the
    images before the scan too.

    Args:
        script: from `parse_script`, or a text or path to be parsed.
        machine: whose axes, limits, camera and timing these are; the FleX-ray if None.
        profile: zero offsets, for what the beam sees; the machine's default if None.
        start: the scanner before the script; the machine's homes and defaults if None.
        sample: its size; None takes the size that the script gives, if any.

    Returns:
        The plan; equal scripts on equal scanners give equal plans.

    Raises:
        ScriptError: a text that does not parse.

    Example:
        >>> plan = plan_script("rot_obj move absolute 90 ACK")
        >>> plan
        <ScanPlan on flexray: 1 steps, 0 projections, 4.0 s, 0 errors, 0 warnings>
        >>> plan == plan_script("rot_obj move absolute 90 ACK")
        True
        >>> float(plan.positions(2.0)["rot_obj"])
        45.0
    """
    if not isinstance(script, c.Script):
        script = parse_script(script)
    machine = builtin_machine() if machine is None else machine
    begin = StartState.of(machine) if start is None else start
    s = simulated(script.commands, machine, begin)
    end = s.end
    plan = ScanPlan(
        machine=machine,
        profile=profile_of(machine) if profile is None else profile,
        start=begin,
        steps=tuple(s.steps),
        trajectories={n: tuple(m.moves) for n, m in s.motors.all.items() if m.moves},
        groups=s.imaging.groups(),
        settings=s.settings,
        beam=s.tube.intervals(end),
        sample=sample if sample is not None else s.sample,
        problems=in_order((*script.warnings, *s.findings.problems)),
        duration_s=end,
    )
    extra = beam_problems(plan)
    return replace(plan, problems=in_order((*script.warnings, *extra, *s.findings.problems)))


def simulated(commands: tuple[c.Command, ...], machine: Machine, start: StartState) -> Simulation:
    """The commands run on a virtual clock: steps, motion and images, without what the beam sees."""
    simulation = Simulation(machine, start)
    simulation.run(commands)
    inferred = simulation.imaging.inferred_averages
    if inferred is not None:  # it holds for the images before the scan too
        simulation = Simulation(machine, start, inferred)
        simulation.run(commands)
    return simulation


BoolArray = npt.NDArray[np.bool_]

_PROBES = 33
"""Images of one sequence that are looked at; the way between them is smooth."""


@dataclass(frozen=True, eq=False)
class View:
    """Images of one camera setting and kind, and the sample's projection in them [pixels].

    Attributes:
        left, right: columns of the projection's edges, (n,); equal where the size is unknown.
        top, bottom: rows, (n,); NaN where the height is unknown.
        axis: column of the rotation axis, (n,).
    """

    kind: ImageKind
    camera: CameraSettings
    lines: tuple[int, ...]
    poses: Poses
    left: FloatArray
    right: FloatArray
    top: FloatArray
    bottom: FloatArray
    axis: FloatArray

    @property
    def outside(self) -> BoolArray:
        """Whether no part of the sample is projected onto the image, (n,) bool."""
        rows, cols = self.camera.shape
        middle = _project(self.poses, self.poses.axis, (rows, cols))[:, 1]
        top, bottom = (np.where(np.isnan(y), middle, y) for y in (self.top, self.bottom))
        return np.asarray(
            (self.right < -0.5) | (self.left > cols - 0.5) | (bottom < -0.5) | (top > rows - 0.5)
        )

    @property
    def cut_columns(self) -> FloatArray:
        """Columns of the projection beyond the left and the right edge, (n, 2)."""
        cols = self.camera.shape[1]
        return np.maximum(np.stack([-0.5 - self.left, self.right - (cols - 0.5)], axis=1), 0.0)

    @property
    def cut_rows(self) -> FloatArray:
        """Rows of the projection beyond the top and the bottom edge, (n, 2); NaN if unknown."""
        rows = self.camera.shape[0]
        return np.maximum(np.stack([-0.5 - self.top, self.bottom - (rows - 0.5)], axis=1), 0.0)


def views(plan: ScanPlan) -> Iterator[View]:
    """The saved images of `plan` by camera setting and kind; long sequences are sampled."""
    batches: dict[tuple[CameraSettings, ImageKind], tuple[list[int], list[int]]] = {}
    seen: dict[CameraSettings, CameraSettings] = {}
    first = 0
    for g in plan.groups:
        if g.files and min(g.camera.shape) > 0:
            camera = seen.get(g.camera)
            if camera is None:
                camera = replace(g.camera, frames=1, averages=1, exposure_ms=1.0)
                seen[g.camera] = camera
            index, lines = batches.setdefault((camera, g.kind), ([], []))
            count = min(len(g), _PROBES) if g.moving else 1
            probes = np.linspace(0, len(g) - 1, count).round().astype(int).tolist()
            index += [first + i for i in probes]
            lines += [g.line] * len(probes)
        first += len(g)
    for (camera, kind), (index, lines) in batches.items():
        positions = {n: x[index] for n, x in plan.image_positions.items()}
        yield _view(plan, camera, kind, tuple(lines), positions)


def beam_problems(plan: ScanPlan) -> tuple[ScriptProblem, ...]:
    """Warnings: the sample outside the beam in projections, or inside it in flats."""
    found: list[ScriptProblem] = []
    for view in views(plan):
        outside = view.outside
        if view.kind == "projection" and outside.any():
            found.append(_aggregate(view, outside, "sample_out_of_beam", _outside_text(view)))
        if view.kind == "flat" and not outside.all():
            found.append(_aggregate(view, ~outside, "sample_in_flat", _inside_text(view)))
    return tuple(found)


def _aggregate(view: View, bad: BoolArray, code: str, text: str) -> ScriptProblem:
    lines = sorted({line for line, b in zip(view.lines, bad.tolist(), strict=True) if b})
    more = f" (and at {len(lines) - 1} more lines)" if len(lines) > 1 else ""
    return ScriptProblem("warning", code, lines[0], 1, text + more)


def _outside_text(view: View) -> str:
    i = int(np.argmax(view.outside))
    rows, cols = view.camera.shape
    side, sides = "above or below", f"rows 0 to {rows - 1}"
    if view.right[i] < -0.5 or view.left[i] > cols - 0.5:
        side, sides = "left" if view.right[i] < -0.5 else "right", f"columns 0 to {cols - 1}"
        side += " of"
    return (
        f"the sample is out of the beam: the shadow of its axis lies at column {view.axis[i]:.0f}, "
        f"{side} the image's {sides}; projections show no sample"
    )


def _inside_text(view: View) -> str:
    i = int(np.argmin(view.outside))
    if view.left[i] == view.right[i]:
        where = f"the shadow of its axis lies at column {view.axis[i]:.0f}"
    else:
        where = f"its shadow spans columns {view.left[i]:.0f} to {view.right[i]:.0f}"
    return f"the sample is in the beam in a flat image: {where} of 0 to {view.camera.shape[1] - 1}"


def _view(
    plan: ScanPlan,
    camera: CameraSettings,
    kind: ImageKind,
    lines: tuple[int, ...],
    positions: dict[str, FloatArray],
) -> View:
    p = motor_poses(plan.machine, plan.profile, camera, positions)
    shape = camera.shape
    axis = _project(p, p.axis, shape)[:, 0]
    left = right = axis
    top = bottom = np.full(len(p), np.nan)
    size = plan.sample
    if size is not None:
        radius, half = size.diameter_mm / 2, size.height_mm / 2
        edges = [_project(p, q, shape)[:, 0] for q in _tangents(p, radius)]
        left, right = np.minimum(*edges), np.maximum(*edges)
        if half > 0.0:
            rows = [_project(p, q, shape)[:, 1] for q in _rims(p, radius, half)]
            top, bottom = np.min(rows, axis=0), np.max(rows, axis=0)
    return View(kind, camera, lines, p, left, right, top, bottom, axis)


def _tangents(p: Poses, radius: float) -> list[FloatArray]:
    """Points where the rays that just touch the cylinder do so, at the source's height."""
    to_source = p.source - p.axis
    flat = to_source[:, :2]
    distance = np.linalg.norm(flat, axis=1, keepdims=True)
    toward = flat / distance
    sine = np.minimum(radius / distance, 1.0)
    cosine = np.sqrt(1.0 - sine**2)
    across = np.stack([-toward[:, 1], toward[:, 0]], axis=1)
    out = []
    for sign in (1.0, -1.0):
        point = p.axis.copy()
        point[:, :2] += radius * (sine * toward + sign * cosine * across)
        point[:, 2] = p.source[:, 2]
        out.append(point)
    return out


def _rims(p: Poses, radius: float, half_height: float) -> list[FloatArray]:
    """Nearest and farthest points of the cylinder's two rims."""
    along = (p.source - p.axis)[:, :2]
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    out = []
    for depth in (radius, -radius):
        for height in (half_height, -half_height):
            point = p.axis.copy()
            point[:, :2] += depth * along
            point[:, 2] += height
            out.append(point)
    return out


def _project(p: Poses, points: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """One world point for each pose to (n, 2) pixels."""
    moved = ConeVec.from_vectors(p.source - points, p.detector - points, p.u, p.v)
    return moved.project_points(np.zeros((1, 3)), shape)[:, 0, :]
