"""A script, or streamed poses, to a plan: simulate it, check the beam's view, collect problems.

The result is data; nothing moves. Collisions are checked by `dry_run`, which takes the check as a
function. Poses are planned as the script with the same steps, dark and flat included.

`views` are what the beam sees of the sample. Poses come from the nominal geometry. The sample is a
cylinder about the rotation axis, or only the axis where its size is unknown, so a report about
truncation is about the cylinder that holds the sample at every angle of a full rotation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

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
    unknown_axis,
)
from flexdt.twin.machine.kinematics import motor_poses
from flexdt.twin.script import commands as c
from flexdt.twin.script.commands import ImageKind
from flexdt.twin.script.compose import REFERENCES, beside_beam
from flexdt.twin.script.parse import Source, parse_script
from flexdt.twin.script.plan import SampleSize, ScanPlan, StartState
from flexdt.twin.script.planned_scanner import Motors, clamp
from flexdt.twin.script.problems import ScriptProblem, in_order
from flexdt.twin.script.simulated_script import Simulation


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


Pose = Mapping[str, float]
Route = Callable[[Pose, Pose], Sequence[Pose] | None]
"""Where the motors stand and where they go, to moves one after the other; None: no free path."""


def plan_poses(
    poses: Sequence[Pose],
    machine: Machine,
    profile: Profile,
    exposure_ms: float | None = None,
    *,
    start: StartState | None = None,
    sample: SampleSize | None = None,
    flat: bool | Pose = True,
    route: Route | None = None,
) -> ScanPlan:
    """Streamed poses (thesis 4.6.2) as a plan: dark and flat, then one projection a pose.

    The axes of a pose start together and all arrive before its image. The flat is taken at the
    first pose, but with the sample beside the beam; X-rays stay on from then on. Dark and flat
    average as many images as those of a composed script. The settings file is written at the first
    pose. Line i + 1 of problems and steps is pose i; line 0 is what comes before.

    Args:
        poses: axis -> position [mm, deg]; axes left out stay where they are.
        machine: whose axes these are.
        profile: zero offsets.
        exposure_ms: of every image; None keeps the camera's current exposure.
        start: the scanner before; the machine's homes if None.
        sample: its size, if known.
        flat: where the sample is out of the beam; True finds it, False takes no flat.
        route: finds a free path to the flat and from there to the first pose; None: the direct one.

    Raises:
        UnknownNameError: a pose names an axis that the machine does not have.
        LimitError: no motor takes the sample out of the beam.

    Example:
        >>> from flexdt.twin.machine.description import builtin_machine, builtin_profile
        >>> machine = builtin_machine("flexray")
        >>> profile = builtin_profile(machine.default_profile)
        >>> plan_poses([{"rot_obj": 0.0}, {"rot_obj": 90.0}], machine, profile, 100.0)
        <ScanPlan on flexray: 25 steps, 2 projections, 21.5 s, 0 errors, 0 warnings>
    """
    asked: Pose = flat if isinstance(flat, Mapping) else {}
    for axis in (name for pose in (*poses, asked) for name in pose):
        if not machine.has(axis):
            raise unknown_axis(axis, machine)
    begin = StartState.of(machine) if start is None else start
    camera = begin.camera
    exposure = camera.exposure_ms if exposure_ms is None else exposure_ms
    commands: list[c.Command] = [
        c.SetMode(mode=camera.mode),
        c.SetRoi(roi=camera.roi),
        c.SetExposure(exposure_ms=exposure),
        c.SetFrames(frames=1),
        c.SetVoltage(kV=begin.kV),
        c.SetPower(power_W=begin.power_W),
    ]
    told: list[ScriptProblem] = []
    back: Sequence[Pose] = ()
    references = [*_image("di000000.tif"), c.XrayOn(), c.WaitXrayReady()]
    if flat is False or not poses:
        told = [ScriptProblem("warning", "no_flat", 0, 1, _NO_FLAT)]
    else:
        first = _arrival(begin.positions, poses[0], machine, begin)
        if flat is True:
            radius = 0.0 if sample is None else sample.diameter_mm / 2
            sides = beside_beam(machine, profile, camera, first, radius)
            places = [{**first, **side} for side in sides]
        else:
            places = [_arrival(begin.positions, asked, machine, begin)]
        ways = ((place, _legs(begin.positions, place, route)) for place in places)
        place, out = next((way for way in ways if way[1] is not None), (places[0], None))
        if out is None:
            told = [ScriptProblem("warning", "flat_path", 0, 1, _NO_PATH)]
            out = _legs(begin.positions, place) or ()
        back = _legs(place, first, route) or _legs(place, first) or ()
        for leg in (*out, asked):
            commands += _moves(leg)
        references += _image("io000000.tif")
    commands += [c.XrayOff(), c.SetAverages(averages=REFERENCES), *references]
    commands.append(c.SetAverages(averages=camera.averages))
    for i, pose in enumerate(poses):
        line = i + 1
        for leg in (*back, pose) if i == 0 else (pose,):
            commands += _moves(leg, line)
        if i == 0:
            commands.append(c.WriteSettingsFile(line=line))
        commands += _image(f"scan_{i:06d}.tif", line)
    commands.append(c.XrayOff(line=len(poses)))
    plan = plan_script(c.Script.of(commands), machine, profile, start=begin, sample=sample)
    return replace(plan, problems=in_order((*told, *plan.problems)))


_NO_FLAT: Final = (
    "no flat image is taken, as `flat` is false; without one the data set cannot be reconstructed"
)
_NO_PATH: Final = (
    "no free path takes the sample out of the beam for the flat image; give `flat` a pose where it "
    "is outside, or false to leave the flat image out"
)


def _image(file: str, line: int = 0) -> list[c.Command]:
    return [c.TakeImage(line=line), c.SaveImage(path=file, line=line)]


def _moves(pose: Pose, line: int = 0) -> list[c.Command]:
    """Moves that start together; asking each again waits until all have arrived."""
    moves = [c.MoveAbsolute(component=a, target=float(v), line=line) for a, v in pose.items()]
    return [*(replace(k, wait=c.Wait.NO_WAIT) for k in moves if len(moves) > 1), *moves]


def _arrival(positions: Pose, pose: Pose, machine: Machine, start: StartState) -> dict[str, float]:
    """Where all motors stand at a pose that is reached from `positions`, within their travel."""
    motors = Motors(machine, replace(start, positions=positions))
    out = dict(positions)
    for axis, value in pose.items():
        out |= clamp(machine, motors.targets(axis, value, 0.0), axis)
    return out


def _legs(start: Pose, end: Pose, route: Route | None = None) -> Sequence[Pose] | None:
    """The moves from one place to another: `route`'s, or all motors at once."""
    goal = {axis: value for axis, value in end.items() if value != start[axis]}
    return ([goal] if goal else []) if route is None else route(start, goal)


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
        return _beyond(self.left, self.right, self.camera.shape[1])

    @property
    def cut_rows(self) -> FloatArray:
        """Rows of the projection beyond the top and the bottom edge, (n, 2); NaN if unknown."""
        return _beyond(self.top, self.bottom, self.camera.shape[0])


def _beyond(low: FloatArray, high: FloatArray, size: int) -> FloatArray:
    return np.maximum(np.stack([-0.5 - low, high - (size - 0.5)], axis=1), 0.0)


def views(plan: ScanPlan) -> Iterator[View]:
    """The saved images of `plan` by camera setting and kind; long sequences are sampled."""
    batches: dict[tuple[CameraSettings, ImageKind], tuple[list[int], list[int]]] = {}
    first = 0
    for g in plan.groups:
        if g.files and min(g.camera.shape) > 0:
            camera = replace(g.camera, frames=1, averages=1, exposure_ms=1.0)
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
    aside = [radius * (sine * toward + sign * cosine * across) for sign in (1.0, -1.0)]
    return [np.column_stack([p.axis[:, :2] + xy, p.source[:, 2]]) for xy in aside]


def _rims(p: Poses, radius: float, half_height: float) -> list[FloatArray]:
    """Nearest and farthest points of the cylinder's two rims."""
    along = (p.source - p.axis)[:, :2]
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    return [
        p.axis + np.column_stack([depth * along, np.full(len(along), height)])
        for depth in (radius, -radius)
        for height in (half_height, -half_height)
    ]


def _project(p: Poses, points: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """One world point for each pose to (n, 2) pixels."""
    moved = ConeVec.from_vectors(p.source - points, p.detector - points, p.u, p.v)
    return moved.project_points(np.zeros((1, 3)), shape)[:, 0, :]
