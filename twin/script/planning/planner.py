"""A script to a plan: simulate it, check the beam's view, collect problems.

The result is data; nothing moves. Collisions are checked by `dry_run`, which takes the
check as a function.
"""

from __future__ import annotations

from dataclasses import replace

from flexdt.twin.findings import Findings
from flexdt.twin.machine.description import (
    Machine,
    Profile,
    builtin_machine,
    profile_of,
)
from flexdt.twin.script import commands as c
from flexdt.twin.script.parse import Source, parse_script
from flexdt.twin.script.planning.beam_view import beam_problems
from flexdt.twin.script.planning.plan import ScanPlan
from flexdt.twin.script.planning.plan_values import SampleSize, StartState
from flexdt.twin.script.planning.simulated_script import Simulation


def plan_script(
    script: c.Script | Source,
    machine: Machine | None = None,
    profile: Profile | None = None,
    *,
    start: StartState | None = None,
    sample: SampleSize | None = None,
) -> ScanPlan:
    """Simulate `script` on a clock that starts at 0.

    Problems of the script are in `ScanPlan.problems`; steps, motion and images are
    planned all the same. Averages that the script leaves out and that follow from speed
    and run-up are used for the images before the scan too.

    Args:
        script: from `parse_script`, or a text or path to be parsed.
        machine: whose axes, limits, camera and timing these are; the FleX-ray if None.
        profile: zero offsets, for the beam's view; the machine's default if None.
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
    if machine is None:
        machine = builtin_machine()
    if start is None:
        begin = StartState.of(machine)
    else:
        begin = start
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
        problems=Findings((*script.warnings, *s.findings.problems)).by_place(),
        duration_s=end,
    )
    extra = beam_problems(plan)
    return replace(
        plan,
        problems=Findings((*script.warnings, *extra, *s.findings.problems)).by_place(),
    )


def simulated(
    commands: tuple[c.Command, ...], machine: Machine, start: StartState
) -> Simulation:
    """Run commands on a virtual clock: steps, motion, images, without the beam's view.

    Averages inferred from a scan apply to the images before it, too: then the commands
    run again. Problems are in its findings.
    """
    simulation = Simulation(machine, start)
    simulation.run(commands)
    inferred = simulation.imaging.inferred_averages
    if inferred is not None:  # it holds for the images before the scan too
        simulation = Simulation(machine, start, inferred)
        simulation.run(commands)
    return simulation
