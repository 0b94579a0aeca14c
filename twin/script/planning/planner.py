"""A script to a plan: simulate it, fill its gaps, check the beam's view, collect problems.

The result is data; nothing moves. Collisions are checked by `dry_run`, which takes the check as a
function.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from flexdt.twin.machine.description import (
    Machine,
    Profile,
    builtin_machine,
    profile_of,
    unknown_axis,
)
from flexdt.twin.script import commands as c
from flexdt.twin.script.parse import Source, parse_script
from flexdt.twin.script.planning.plan import SampleSize, ScanPlan, StartState
from flexdt.twin.script.planning.sample_in_beam import beam_problems
from flexdt.twin.script.planning.simulated_script import Simulation
from flexdt.twin.script.problems import in_order


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
        fly_scans=tuple(s.imaging.fly_scans),
        settings=s.settings,
        beam=s.tube.intervals(end),
        sample=sample if sample is not None else s.sample,
        problems=in_order((*script.warnings, *s.problems)),
        duration_s=end,
    )
    extra = beam_problems(plan)
    return replace(plan, problems=in_order((*script.warnings, *extra, *s.problems)))


def plan_poses(
    poses: Sequence[Mapping[str, float]],
    machine: Machine,
    profile: Profile,
    exposure_ms: float | None = None,
    *,
    start: StartState | None = None,
    sample: SampleSize | None = None,
) -> ScanPlan:
    """Streamed poses (thesis 4.6.2) as a plan: a dark, X-rays on, then one projection a pose.

    The axes of a pose start together and all arrive before its image. No flat is taken, because
    that needs a motion that was not requested. Line i + 1 of problems and steps is pose i.

    Args:
        poses: axis -> position [mm, deg]; axes left out stay where they are.
        machine: whose axes these are.
        profile: zero offsets.
        exposure_ms: of every image; None keeps the camera's current exposure.
        start: the scanner before; the machine's homes if None.
        sample: its size, if known.

    Raises:
        UnknownNameError: a pose names an axis that the machine does not have.

    Example:
        >>> from flexdt.twin.machine.description import builtin_machine, builtin_profile
        >>> machine = builtin_machine("flexray")
        >>> profile = builtin_profile(machine.default_profile)
        >>> plan_poses([{"rot_obj": 0.0}, {"rot_obj": 90.0}], machine, profile, 100.0)
        <ScanPlan on flexray: 20 steps, 2 projections, 13.2 s, 0 errors, 0 warnings>
    """
    begin = StartState.of(machine) if start is None else start
    camera = begin.camera
    exposure = camera.exposure_ms if exposure_ms is None else exposure_ms
    commands: list[c.Command] = [
        c.SetMode(mode=camera.mode),
        c.SetRoi(roi=camera.roi),
        c.SetExposure(exposure_ms=exposure),
        c.SetFrames(frames=1),
        c.SetAverages(averages=camera.averages),
        c.SetVoltage(kV=begin.kV),
        c.SetPower(power_W=begin.power_W),
        c.XrayOff(),
        c.TakeImage(),
        c.SaveImage(path="di000000.tif"),
        c.XrayOn(),
        c.WaitXrayReady(),
        c.WriteSettingsFile(),
    ]
    for i, pose in enumerate(poses):
        line = i + 1
        for axis in pose:
            if not machine.has(axis):
                raise unknown_axis(axis, machine)
        moves = [
            c.MoveAbsolute(component=a, target=float(v), line=line, wait=c.Wait.NO_WAIT)
            for a, v in pose.items()
        ]
        arrivals = [
            c.MoveAbsolute(component=a, target=float(v), line=line) for a, v in pose.items()
        ]
        commands += moves
        if len(moves) > 1 or not moves:
            commands += arrivals
        else:
            commands[-1:] = arrivals
        commands += [
            c.TakeImage(line=line),
            c.SaveImage(path=f"scan_{i:06d}.tif", line=line),
        ]
    commands.append(c.XrayOff(line=len(poses)))
    return plan_script(c.Script.of(commands), machine, profile, start=begin, sample=sample)


def simulated(commands: tuple[c.Command, ...], machine: Machine, start: StartState) -> Simulation:
    """The commands run on a virtual clock: steps, motion and images, without what the beam sees."""
    simulation = Simulation(machine, start)
    simulation.run(commands)
    inferred = simulation.imaging.inferred_averages
    if inferred is not None:  # it holds for the images before the scan too
        simulation = Simulation(machine, start, inferred)
        simulation.run(commands)
    return simulation
