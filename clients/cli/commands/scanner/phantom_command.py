"""`flexdt phantom {list,make,design}`: the phantoms that ship, and new ones as files.

A phantom file is JSON and may be named wherever `--phantom` is.
"""

from __future__ import annotations

import json as json_text
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import typer

from flexdt import machines
from flexdt.clients.cli import option_values, options
from flexdt.clients.cli.console import note, table
from flexdt.clients.cli.options import Answer, argument, option
from flexdt.clients.failure import CommandError

if TYPE_CHECKING:
    from flexdt.phantoms import Phantom


def list_phantoms() -> Answer:
    """List the phantoms that ship."""
    from flexdt.phantoms import load_phantom, phantom_names

    found = {name: load_phantom(name) for name in phantom_names()}
    yield {"phantoms": [_summary(name, p) for name, p in found.items()]}
    rows = [
        (name, " x ".join(f"{s:g}" for s in p.size_mm), len(p.beads), p.description)
        for name, p in found.items()
    ]
    yield table(rows, ("name", "size [mm]", "beads", "what it is"))
    yield "\nCuboids take a number of beads: normal-7 has seven."


def make(
    file: Path = argument(..., "FILE.json", "Where to write it."),
    like: str | None = option(None, "Begin with this cuboid of `phantom list`.", metavar="NAME"),
    size: str | None = option(None, "Set width, breadth and height [mm].", metavar="W,B,H"),
    beads: int = option(5, "Put so many beads on a spiral.", metavar="K"),
    radius: float = option(2.0, "Set the beads' radius.", metavar="MM"),
    body: str = option("abs", "Make the body of this material.", metavar="MATERIAL"),
    bead: str = option("steel", "Make the beads of this material.", metavar="MATERIAL"),
    mesh: Path | None = option(None, "Fill this mesh: STL, OBJ, PLY, GLB or OFF.", metavar="FILE"),
    unit: str | None = option(None, "Read the mesh in this unit; default: mm, for GLB m."),
    stl: Path | None = option(None, "Write its surfaces, too, to print it.", metavar="FILE.stl"),
) -> Answer:
    """Write a new phantom: a bead cuboid of your own size, or a mesh."""
    if sum(given is not None for given in (like, size, mesh)) != 1:
        raise typer.BadParameter("give one of --like NAME, --size W,B,H or --mesh FILE")
    for path in (file, stl):
        if path is not None and not path.absolute().parent.is_dir():
            raise CommandError(f"{path}: the folder does not exist")
    from flexdt.phantoms import bead_phantom, mesh_phantom

    if mesh is not None:
        made = mesh_phantom(mesh, unit=unit, material=body, name=file.stem)
    else:
        made = bead_phantom(
            like if like is not None else _size(size or ""),
            beads,
            bead_radius_mm=radius,
            body_material=body,
            bead_material=bead,
        )
    file.write_text(json_text.dumps(made.to_dict()), encoding="utf-8")
    if stl is not None:
        made.mesh().export(stl, file_type="stl")
    for line in made.assumed:
        note(f"assumed: {line}")
    yield {"file": str(file), "stl": stl, **_summary(made.name, made)}
    yield f"{file}: {made.description}"


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
    position: list[str] | None = option(None, "One for each scan [mm].", metavar="SOD[:LATERAL]"),
    sdd: float = option(1059.0, metavar="MM"),
    frames: int = option(360, "Of each scan.", min=1),
    plan: Path | None = option(None, "A scan script instead of positions.", metavar="SCRIPT"),
    free: options.Free = None,
    noise: float = option(0.1, "Of a position.", metavar="PX"),
    tolerance: float = option(0.0, "How well beads will sit.", "--bead-tolerance", metavar="MM"),
    criterion: Literal["a", "d", "worst"] = option("a", "What is minimised."),
    trials: int = option(60, "Fits that check it.", min=0),
    seed: int = option(1, "Same seed, same design."),
    out: Path | None = option(None, "Instruction, STL, phantom file.", metavar="DIR"),
    machine: options.MachineName = None,
    profile: options.ProfileName = None,
) -> Answer:
    """Choose bead places that determine the geometry best, and say how to build it."""
    from flexdt.clients.calibration import phantom_design as work
    from flexdt.phantoms.bricks import Brickwork
    from flexdt.twin.calibration.design.information_table import PlannedScans
    from flexdt.twin.calibration.fit.problem import SIX

    scanner = machines.machine(machine)
    if plan is not None:
        offsets = machines.profile(profile, scanner, machine)
        poses, shape = work.script_poses(
            plan.read_bytes().decode("utf-8", "surrogateescape"), scanner, offsets
        )
    else:
        places = [option_values.position(word) for word in position] if position else [(600.0, 0.0)]
        poses, shape = work.circle_poses(scanner, places, sdd, frames)
    if not (noise > 0 and tolerance >= 0 and radius > 0):
        raise typer.BadParameter("--noise and --radius must be positive, --bead-tolerance >= 0")
    scans = PlannedScans(poses, shape, noise, option_values.names(free) if free else SIX, tolerance)
    request = work.DesignRequest(
        beads, radius, bead, per_brick, criterion, seed=seed, trials=trials
    )
    if grid == "lego":
        stack = Brickwork(_studs(studs), bricks)
        holder = work.BeadHolder(stack, stack.size_mm)
    else:
        holder = work.BeadHolder(None, _size(size), body)
    document = work.run_design(holder, scans, request, out=out, tell=note)
    yield document
    yield table(work.table_rows(document), work.HEADER)
    yield f"\n{work.verdict(document)}"
    if out is not None:
        yield (f"building instruction: {out / 'build.html'}; phantom: {out / 'phantom.json'}")


def _studs(text: str) -> tuple[int, int]:
    n, m = map(int, option_values.numbers(text, "studs", "NxM, e.g. 3x2", 2, by="x", whole=True))
    return n, m


def _size(text: str) -> tuple[float, float, float]:
    return option_values.triple(text, "size", "W,B,H, e.g. 20,40,60")


def _summary(name: str, phantom: Phantom) -> dict[str, object]:
    return {
        "name": name,
        "size_mm": list(phantom.size_mm),
        "beads": len(phantom.beads),
        "bead_radius_mm": phantom.bead_radius_mm.tolist(),
        "description": phantom.description,
        "assumed": list(phantom.assumed),
    }
