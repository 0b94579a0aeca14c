"""Streamed poses to a plan: the script with the same steps, dark and flat included."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

from flexdt.twin.findings import Finding, Findings, warning
from flexdt.twin.machine.description import (
    Machine,
    Profile,
    unknown_axis,
)
from flexdt.twin.machine.travel import clamp
from flexdt.twin.script import commands as c
from flexdt.twin.script.motor_targets import beside_beam
from flexdt.twin.script.planning.plan import ScanPlan
from flexdt.twin.script.planning.plan_values import SampleSize, StartState
from flexdt.twin.script.planning.planned_scanner import Motors
from flexdt.twin.script.planning.planner import plan_script
from flexdt.twin.script.problems import ENTIRE, ScriptCode
from flexdt.twin.script.scan_request import REFERENCES

Pose = Mapping[str, float]
Route = Callable[[Pose, Pose], Sequence[Pose] | None]
"""Finds the moves from one pose to another; None if there is no free path."""
_NO_FLAT: Final = (
    "no flat image is taken, as `flat` is false; without one the data set "
    "cannot be reconstructed"
)
_NO_PATH: Final = (
    "no free path takes the sample out of the beam for the flat image; give `flat` a pose "
    "where it is outside, or false to leave the flat image out"
)


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
    """Plan streamed poses (thesis 4.6.2): dark and flat, then one projection a pose.

    The axes of a pose start together and all arrive before its image. The flat is taken
    at the first pose, but with the sample beside the beam; X-rays stay on from then until
    after the last pose. Dark and flat average as many images as those of a composed
    script. The settings file is written at the first pose. Line i + 1 of problems and
    steps is pose i; line 0 is everything before.

    A plan without a flat has the warning `no_flat` (also without poses), and one
    with a blocked path to the flat position has `flat_path`, and moves there anyway, all
    motors at once.

    Args:
        poses: axis -> position [mm, deg]; axes left out stay where they are.
        machine: whose axes these are.
        profile: zero offsets.
        exposure_ms: of every image; None keeps the camera's current exposure.
        start: the scanner before; the machine's homes if None.
        sample: its size, if known.
        flat: where the sample is out of the beam; True finds it, the first place with a
            free path; False takes no flat.
        route: finds a free path to the flat and from there to the first pose; None: the
            direct one.

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
    problems: list[Finding] = []
    back: Sequence[Pose] = ()
    commands = _settings(begin, exposure_ms)
    references = [*_image("di000000.tif"), c.XrayOn(), c.WaitXrayReady()]
    if flat is False or not poses:
        problems = [warning(ScriptCode.NO_FLAT, _NO_FLAT, place=ENTIRE)]
    else:
        first = _arrival(begin.positions, poses[0], machine, begin)
        if flat is True:
            radius = 0.0 if sample is None else sample.diameter_mm / 2
            sides = beside_beam(machine, profile, begin.camera, first, radius)
            places = [{**first, **side} for side in sides]
        else:
            places = [_arrival(begin.positions, asked, machine, begin)]
        way = _way_to_flat(begin.positions, places, first, route)
        if not way.free:
            problems = [warning(ScriptCode.FLAT_PATH, _NO_PATH, place=ENTIRE)]
        back = way.back
        for leg in (*way.out, asked):
            commands += _moves(leg)
        references += _image("io000000.tif")
    commands += [c.XrayOff(), c.SetAverages(averages=REFERENCES), *references]
    commands.append(c.SetAverages(averages=begin.camera.averages))
    for i, pose in enumerate(poses):
        line = i + 1
        for leg in (*back, pose) if i == 0 else (pose,):
            commands += _moves(leg, line)
        if i == 0:
            commands.append(c.WriteSettingsFile(line=line))
        commands += _image(f"scan_{i:06d}.tif", line)
    commands.append(c.XrayOff(line=len(poses)))
    plan = plan_script(
        c.Script.of(commands), machine, profile, start=begin, sample=sample
    )
    return replace(plan, problems=Findings((*problems, *plan.problems)).by_place())


def _settings(begin: StartState, exposure_ms: float | None) -> list[c.Command]:
    """Make the commands that state the settings: those in force, and an exposure, the
    camera's own if None.
    """
    camera = begin.camera
    exposure = camera.exposure_ms if exposure_ms is None else exposure_ms
    return [
        c.SetMode(mode=camera.mode),
        c.SetRoi(roi=camera.roi),
        c.SetExposure(exposure_ms=exposure),
        c.SetFrames(frames=1),
        c.SetVoltage(kV=begin.kV),
        c.SetPower(power_W=begin.power_W),
    ]


@dataclass(frozen=True)
class _FlatWay:
    """Moves to the place of the flat image, `out`, and from there to the first pose,
    `back`; `free` is False where no free path leads out.
    """

    out: Sequence[Pose]
    back: Sequence[Pose]
    free: bool


def _way_to_flat(
    start: Pose, places: Sequence[Pose], first: Pose, route: Route | None
) -> _FlatWay:
    """Choose the first of the places with a free path, and the moves there and back.

    Where none has, the way leads to the first place, all motors at once; so does the way
    back where the route finds none.
    """
    ways = ((place, _legs(start, place, route)) for place in places)
    place, out = next((way for way in ways if way[1] is not None), (places[0], None))
    back = _legs(place, first, route) or _legs(place, first) or ()
    if out is None:
        return _FlatWay(_legs(start, place) or (), back, free=False)
    return _FlatWay(out, back, free=True)


def _image(file: str, line: int = 0) -> list[c.Command]:
    """Make the commands that take and save one image."""
    return [c.TakeImage(line=line), c.SaveImage(path=file, line=line)]


def _moves(pose: Pose, line: int = 0) -> list[c.Command]:
    """Make the commands that move a pose's axes [mm, deg] together and wait for each.

    Of several, each is first sent without waiting, then again.
    """
    moves = [
        c.MoveAbsolute(component=a, target=float(v), line=line) for a, v in pose.items()
    ]
    return [*(replace(k, wait=c.Wait.NO_WAIT) for k in moves if len(moves) > 1), *moves]


def _arrival(
    positions: Pose, pose: Pose, machine: Machine, start: StartState
) -> dict[str, float]:
    """Compute the positions of all motors at a pose reached from `positions`, within travel.

    Axes that the pose does not name stay.
    """
    motors = Motors(machine, replace(start, positions=positions))
    out = dict(positions)
    for axis, value in pose.items():
        out |= clamp(machine, motors.targets(axis, value, 0.0), axis)
    return out


def _legs(start: Pose, end: Pose, route: Route | None = None) -> Sequence[Pose] | None:
    """List the moves [mm, deg] between two poses, of changed motors only.

    By `route`, or all at once; None if the route finds none.
    """
    goal = {axis: value for axis, value in end.items() if value != start[axis]}
    if route is None:
        return [goal] if goal else []
    return route(start, goal)
