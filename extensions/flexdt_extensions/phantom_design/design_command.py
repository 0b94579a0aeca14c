"""`flexdt phantom design`: a phantom for the least uncertainty in planned scans."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, assert_never

import typer

from flexdt.extending import (
    Answer,
    Free,
    MachineName,
    ProfileName,
    names,
    note,
    numbers,
    option,
    table,
    triple,
)
from flexdt.extending import position as place


def design(
    beads: int = option(5, "Beads to place.", metavar="K"),
    grid: Literal["lego", "free"] = option("lego", "Seats in bricks, or anywhere."),
    bricks: int = option(5, "lego: bricks in the stack."),
    studs: str = option("3x2", "lego: of a brick.", metavar="NxM"),
    per_brick: int | None = option(None, "lego: most beads in one brick.", min=1),
    size: str = option("20,40,60", "free: width, breadth, height [mm].", metavar="W,B,H"),
    radius: float = option(1.0, "Bead radius.", metavar="MM"),
    body: str = option("abs", "free: block.", metavar="MATERIAL"),
    bead: str = option("steel", metavar="MATERIAL"),
    position: list[str] | None = option(
        None, "One for each scan [mm].", metavar="SOD[:LATERAL]"
    ),
    sdd: float = option(1059.0, metavar="MM"),
    frames: int = option(360, "Simulate so many frames of each scan.", min=1),
    plan: Path | None = option(
        None, "A scan script instead of positions.", metavar="SCRIPT"
    ),
    free: Free = None,
    noise: float = option(0.1, "Measure positions with this noise.", metavar="PX"),
    tolerance: float | None = option(
        None,
        "How well beads will sit; left out: as calibrate assumes.",
        "--bead-tolerance",
        metavar="MM",
    ),
    criterion: Literal["a", "d", "worst"] = option("a", "What is minimised."),
    trials: int = option(60, "Fits that check it.", min=0),
    seed: int = option(1, "Same seed, same design."),
    out: Path | None = option(None, "Instruction, STL, phantom file.", metavar="DIR"),
    machine: MachineName = None,
    profile: ProfileName = None,
) -> Answer:
    """Choose bead places that determine the geometry best, and say how to build it.

    Without positions one scan at SOD 600 mm is planned; with --plan positions, --sdd and
    --frames have no effect. The design is compared with the spiral of the thesis.

    Yields:
        The document of --json, a table of sigmas, a verdict, and the files if written.
    """
    from flexdt.library.machines import machine as find_machine
    from flexdt.library.machines import profile as find_profile
    from flexdt.twin.calibration import SIX
    from flexdt.twin.calibration.fit.priors import known, prior_widths
    from flexdt_extensions.phantom_design import phantom_design as work
    from flexdt_extensions.phantom_design.information_table import PlannedScans
    from flexdt_extensions.phantom_design.seats import stack_of

    scanner = find_machine(machine)
    offsets = find_profile(profile, scanner, machine)
    if plan is not None:
        poses, shape = work.script_poses(
            plan.read_bytes().decode("utf-8", "surrogateescape"), scanner, offsets
        )
    else:
        if position:
            places = [place(word) for word in position]
        else:
            places = [(600.0, 0.0)]
        poses, shape = work.circle_poses(scanner, places, sdd, frames)
    if not (noise > 0 and (tolerance or 0.0) >= 0 and radius > 0):
        raise typer.BadParameter(
            "--noise and --radius must be positive, --bead-tolerance >= 0"
        )
    asked = names(free) if free else SIX
    priors = known(asked, scanners=[prior_widths(scanner, offsets)])
    scans = PlannedScans(poses, shape, noise, asked, tolerance, priors)
    request = work.DesignRequest(
        beads, radius, bead, per_brick, criterion, seed=seed, trials=trials
    )
    match grid:
        case "lego":
            form = "NxM, e.g. 3x2"
            n, m = map(int, numbers(studs, "studs", form, 2, by="x", whole=True))
            stack = stack_of((n, m), bricks)
            holder = work.BeadHolder(stack, stack.size_mm)
        case "free":
            sides = triple(size, "size", "W,B,H, e.g. 20,40,60")
            holder = work.BeadHolder(None, sides, body)
        case _:
            assert_never(grid)
    document = work.run_design(holder, scans, request, out=out, tell=note)
    yield document
    yield table(work.table_rows(document), work.HEADER)
    yield f"\n{work.verdict(document)}"
    if out is not None:
        yield (
            f"building instruction: {out / 'build.html'}; phantom: {out / 'phantom.json'}"
        )
