"""`flexdt phantom {list,make,design}`: the phantoms that ship, and new ones as files.

A phantom file is JSON and may be named wherever `--phantom` is.
"""

from __future__ import annotations

import json as json_text
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from flexdt.clients.cli import machines, option_values, options
from flexdt.clients.cli.console import emit, note, say, table
from flexdt.clients.failure import CommandError

if TYPE_CHECKING:
    from flexdt.phantoms import Phantom


def list_phantoms(json: options.Json = False) -> None:
    """List the phantoms that ship."""
    from flexdt.phantoms import load_phantom, phantom_names

    found = [load_phantom(name) for name in phantom_names()]
    if json:
        emit({"phantoms": [_summary(name, p) for name, p in zip(phantom_names(), found,
                                                                  strict=True)]})  # fmt: skip
        return
    rows = [
        (name, " x ".join(f"{s:g}" for s in p.size_mm), str(len(p.beads)), p.description)
        for name, p in zip(phantom_names(), found, strict=True)
    ]
    say(table(rows, ("name", "size [mm]", "beads", "what it is")))
    say("\nCuboids take a number of beads: normal-7 has seven.")


def make(
    file: Annotated[Path, typer.Argument(metavar="FILE.json", help="Where to write it.")],
    like: Annotated[
        str | None, typer.Option("--like", metavar="NAME", help="A cuboid of `phantom list`.")
    ] = None,
    size: Annotated[
        str | None, typer.Option("--size", metavar="W,B,H", help="Width, breadth, height [mm].")
    ] = None,
    beads: Annotated[int, typer.Option("--beads", metavar="K", help="Beads on a spiral.")] = 5,
    radius: Annotated[float, typer.Option("--radius", metavar="MM", help="Bead radius.")] = 2.0,
    body: Annotated[str, typer.Option("--body", metavar="MATERIAL")] = "abs",
    bead: Annotated[str, typer.Option("--bead", metavar="MATERIAL")] = "steel",
    mesh: Annotated[
        Path | None, typer.Option("--mesh", metavar="FILE", help="STL, OBJ, PLY, GLB or OFF.")
    ] = None,
    unit: Annotated[
        str | None,
        typer.Option("--unit", help="Of the mesh's coordinates; default: mm, for GLB m."),
    ] = None,
    stl: Annotated[
        Path | None, typer.Option("--stl", metavar="FILE.stl", help="Its surfaces, to print it.")
    ] = None,
    json: options.Json = False,
) -> None:
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
    if json:
        emit({"file": str(file), "stl": stl, **_summary(made.name, made)})
    else:
        say(f"{file}: {made.description}")


def design(
    beads: Annotated[int, typer.Option("--beads", metavar="K", help="Beads to place.")] = 5,
    grid: Annotated[
        Literal["lego", "free"], typer.Option("--grid", help="Seats in bricks, or anywhere.")
    ] = "lego",
    bricks: Annotated[int, typer.Option("--bricks", help="lego: bricks in the stack.")] = 5,
    studs: Annotated[str, typer.Option("--studs", metavar="NxM", help="lego: of a brick.")] = "3x2",
    per_brick: Annotated[
        int | None, typer.Option("--per-brick", min=1, help="lego: most beads in one brick.")
    ] = None,
    size: Annotated[
        str, typer.Option("--size", metavar="W,B,H", help="free: width, breadth, height [mm].")
    ] = "20,40,60",
    radius: Annotated[float, typer.Option("--radius", metavar="MM", help="Bead radius.")] = 1.0,
    body: Annotated[str, typer.Option("--body", metavar="MATERIAL", help="free: block.")] = "abs",
    bead: Annotated[str, typer.Option("--bead", metavar="MATERIAL")] = "steel",
    position: Annotated[
        list[str] | None,
        typer.Option("--position", metavar="SOD[:LATERAL]", help="One for each scan [mm]."),
    ] = None,
    sdd: Annotated[float, typer.Option("--sdd", metavar="MM")] = 1059.0,
    frames: Annotated[int, typer.Option("--frames", min=1, help="Of each scan.")] = 360,
    plan: Annotated[
        Path | None,
        typer.Option("--plan", metavar="SCRIPT", help="A scan script instead of positions."),
    ] = None,
    free: options.Free = None,
    noise: Annotated[float, typer.Option("--noise", metavar="PX", help="Of a position.")] = 0.1,
    tolerance: Annotated[
        float, typer.Option("--bead-tolerance", metavar="MM", help="How well beads will sit.")
    ] = 0.0,
    criterion: Annotated[
        Literal["a", "d", "worst"], typer.Option("--criterion", help="What is minimised.")
    ] = "a",
    trials: Annotated[int, typer.Option("--trials", min=0, help="Fits that check it.")] = 60,
    seed: Annotated[int, typer.Option("--seed", help="Same seed, same design.")] = 1,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Instruction, STL, phantom file.")
    ] = None,
    machine: options.MachineName = None,
    profile: options.ProfileName = None,
    json: options.Json = False,
) -> None:
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
        holder = work.Body(stack, stack.size_mm)
    else:
        width, breadth, height = _size(size)
        holder = work.Body(None, (width, breadth, height), body)
    document = work.run_design(holder, scans, request, out=out, tell=note)
    if json:
        emit(document)
        return
    say(table(work.table_rows(document), work.HEADER))
    say(f"\n{work.verdict(document)}")
    if out is not None:
        say(f"building instruction: {out / 'build.html'}; phantom: {out / 'phantom.json'}")


def _studs(text: str) -> tuple[int, int]:
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.strip().isdigit() for part in parts):
        raise typer.BadParameter(f"studs {text!r} are not NxM, e.g. 3x2")
    return int(parts[0]), int(parts[1])


def find(word: str) -> Phantom:
    """A phantom by shipped name or by file (TOML or JSON).

    Raises:
        UnknownNameError: neither.
        PhantomError: the file does not hold.
    """
    from flexdt.phantoms import load_phantom, load_phantom_file

    path = Path(word)
    if path.suffix.lower() in (".json", ".toml") or path.is_file():
        return load_phantom_file(path.read_text(encoding="utf-8"), word)
    return load_phantom(word)


def _size(text: str) -> tuple[float, ...]:
    return option_values.numbers(text, "size", 3, "W,B,H, e.g. 20,40,60")


def _summary(name: str, phantom: Phantom) -> dict[str, object]:
    return {
        "name": name,
        "size_mm": list(phantom.size_mm),
        "beads": len(phantom.beads),
        "bead_radius_mm": phantom.bead_radius_mm.tolist(),
        "description": phantom.description,
        "assumed": list(phantom.assumed),
    }
