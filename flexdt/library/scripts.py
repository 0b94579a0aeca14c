"""Machines and scan scripts as plans: the public functions `flexdt.machine` and
`flexdt.plan`, and functions of plans that need more than the core.
"""

from __future__ import annotations

from dataclasses import replace
from os import PathLike
from pathlib import Path

import numpy as np

from flexdt.library.machines import machine as find_machine
from flexdt.library.machines import profile as find_profile
from flexdt.phantoms import Phantom
from flexdt.phantoms.samples import as_phantom
from flexdt.runtime.files.limited_files import limited_bytes
from flexdt.twin.collision.convex_pieces import convex_pieces
from flexdt.twin.collision.plan_report import collision_check
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.script import (
    CheckReport,
    SampleSize,
    ScanPlan,
    Script,
    plan_script,
)
from flexdt.twin.script.dry_run import CollisionCheck, check_plan
from flexdt.twin.script.planning.plan_values import StartState
from flexdt.twin.signatures import File, public

machine = public(find_machine)


@public
def plan(
    script: Script | str | bytes | PathLike[str],
    machine: Machine | str | PathLike[str] | None = None,
    *,
    profile: Profile | str | PathLike[str] | None = None,
    sample: object = None,
) -> ScanPlan:
    """Plan a scan script on a clock that starts at 0, without a server.

    Args:
        script: from `parse_script`, its text or bytes, or its path. A text of one line
            that names a file is a path to it.
        machine: a machine, its shipped name or its file; the FleX-ray if None.
        profile: zero offsets, their shipped name or file; the machine's default if None.
        sample: on the stage, for truncation: anything that `flexdt.simulate` takes.

    Returns:
        The plan: `.poses`, `.geometry`, `.duration_s`, `.problems`, `.check()`,
        `.plot()`, `==`, `.to_dict()`.

    Raises:
        ScriptError: the script does not parse; lists every error with its line.
        OSError: the file cannot be read.

    Example:
        >>> found = plan("rot_obj move absolute 90 ACK")
        >>> found.duration_s, found.check().ok
        (4.0, True)
    """
    if isinstance(script, str) and "\n" not in script and _names_a_file(script):
        script = Path(script)
    if isinstance(machine, Machine):
        chosen = machine
    else:
        chosen = find_machine(machine)
    size = size_of(None if sample is None else as_phantom(sample))
    return plan_script(script, chosen, find_profile(profile, chosen), sample=size)


def check(plan: ScanPlan, sample: object = None) -> CheckReport:
    """Check a plan; see `ScanPlan.check`.

    Collisions are checked if the machine has components; exposures with a `sample` and
    without errors. The start is known unless it is the default.
    """
    if sample is None:
        phantom = None
    else:
        phantom = as_phantom(sample)
    if plan.machine.components:
        collision = collisions(phantom)
    else:
        collision = None
    known = plan.start != StartState.of(plan.machine)
    return with_exposures(check_plan(plan, (), collision, "", known), phantom)


def with_exposures(report: CheckReport, phantom: Phantom | None) -> CheckReport:
    """Add warnings of projections in which the sample's pixels will be saturated or starved.

    `report`: of a dry run; one with errors is returned unchanged. `phantom`: on the stage; None
    adds no warning.
    """
    if phantom is None or report.errors:
        return report
    from flexdt.phantoms.exposure_forecast import exposure_problems

    more = exposure_problems(report.plan, phantom)
    return replace(report, problems=report.problems.and_also(more).by_place())


def size_of(phantom: Phantom | None) -> SampleSize | None:
    """Return the size of a phantom on the stage, from the corners of its mesh, or its
    stated box where it has no matter; None for no phantom leaves it to the script."""
    if phantom is None:
        return None
    corners = phantom.mesh(around=True).vertices
    if not len(corners):  # a phantom without matter
        return SampleSize.around(phantom.size_mm, phantom.name)
    return SampleSize.of_points(np.asarray(corners, np.float64), phantom.name)


def collisions(phantom: Phantom | None) -> CollisionCheck:
    """Make the collision check with the phantom's mesh, or with the script's sample size."""
    return collision_check(
        None if phantom is None else convex_pieces(phantom.mesh(around=True))
    )


def read(path: File) -> bytes:
    """Read the bytes of a script's file."""
    return limited_bytes(Path(path), "script")


def _names_a_file(text: str) -> bool:
    """Check whether one line is a path: the file exists, or the line looks like its name."""
    return Path(text).is_file() or (" " not in text and text.endswith(".txt"))
