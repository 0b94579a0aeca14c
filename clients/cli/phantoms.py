"""`flexdt phantom {list,make}`: the phantoms that ship, and new ones as files.

A phantom file is JSON and may be named wherever `--phantom` is. It refuses to know how phantoms are
made (see `flexdt.phantoms`).
"""

from __future__ import annotations

import json as json_text
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flexdt.clients.cli import options, values
from flexdt.clients.cli.console import emit, say, table
from flexdt.clients.failure import CommandError

if TYPE_CHECKING:
    from flexdt.phantoms import Phantom


def register(app: typer.Typer) -> None:
    """Add this module's commands."""
    group = typer.Typer(
        help="Phantoms: objects to scan.", no_args_is_help=True, add_completion=False
    )
    group.command("list")(list_phantoms)
    group.command("make")(make)
    app.add_typer(group, name="phantom")


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
    mesh: Annotated[Path | None, typer.Option("--mesh", metavar="FILE", help="STL or OBJ.")] = None,
    unit: Annotated[str, typer.Option("--unit", help="Of the mesh's coordinates.")] = "mm",
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
    if json:
        emit({"file": str(file), "stl": stl, **_summary(made.name, made)})
    else:
        say(f"{file}: {made.description}")


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
    parts = values.names(text)
    if len(parts) != 3:
        raise typer.BadParameter(f"size {text!r} is not W,B,H, e.g. 20,40,60")
    return tuple(values.number(part, "a side of --size") for part in parts)


def _summary(name: str, phantom: Phantom) -> dict[str, object]:
    return {
        "name": name,
        "size_mm": list(phantom.size_mm),
        "beads": len(phantom.beads),
        "bead_radius_mm": phantom.bead_radius_mm.tolist(),
        "description": phantom.description,
        "assumed": list(phantom.assumed),
    }
