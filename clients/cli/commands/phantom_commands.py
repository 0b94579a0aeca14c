"""`flexdt phantom`: phantoms that ship, and new ones.

A phantom file is JSON and may be named wherever `--phantom` is.
"""

from __future__ import annotations

import json as json_text
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from flexdt.clients.cli import option_values, value_completion
from flexdt.clients.cli.command_settings import PhantomMakeSettings
from flexdt.clients.cli.console import note, table
from flexdt.clients.cli.options import Answer, argument, option
from flexdt.clients.cli.settings_file import chosen

if TYPE_CHECKING:
    from flexdt.phantoms import Phantom


def list_phantoms() -> Answer:
    """List the phantoms that ship.

    Yields:
        The phantoms as document of --json, a table of name, size [mm], number of beads and
        description, and a note on cuboids.
    """
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
    file: Path = argument(..., "FILE.json"),
    like: str | None = option(
        None, metavar="NAME", proposes=value_completion.sample_names
    ),
    size: str | None = option(None, metavar="W,B,H"),
    beads: int = option(5, metavar="K"),
    radius: float = option(2.0, metavar="MM"),
    body: str = option("abs", metavar="MATERIAL"),
    mesh: Path | None = option(None, metavar="FILE"),
    unit: str | None = option(None),
    stl: Path | None = option(None, metavar="FILE.stl", written=True),
) -> Answer:
    """Write a new phantom: a bead cuboid of your own size, or a mesh.

    Args:
        file: Where to write it.
        like: Begin with this cuboid of `phantom list`.
        size: Set width, breadth and height [mm].
        beads: Put so many beads on a spiral.
        radius: Set the beads' radius.
        body: Make the body of this material.
        mesh: Fill this mesh: STL, OBJ, PLY, GLB or OFF.
        unit: Read the mesh in this unit; default: mm, for GLB m.
        stl: Write its surfaces, too, to print it.

    Yields:
        The summary as document of --json, then a line; assumptions go to standard
        error. Exactly one of --like, --size and --mesh, else a usage error; an existing
        file is replaced.
    """
    if sum(given is not None for given in (like, size, mesh)) != 1:
        raise typer.BadParameter("give one of --like NAME, --size W,B,H or --mesh FILE")
    option_values.require_folder(file, stl)
    from flexdt.phantoms import bead_phantom, mesh_phantom

    if mesh is not None:
        made = mesh_phantom(mesh, unit=unit, material=body, name=file.stem)
    else:
        made = bead_phantom(
            like if like is not None else _size(size or ""),
            beads,
            bead_radius_mm=radius,
            body_material=body,
            bead_material=chosen(PhantomMakeSettings).bead,
        )
    file.write_text(json_text.dumps(made.to_dict()), encoding="utf-8")
    if stl is not None:
        made.mesh().export(stl, file_type="stl")
    for line in made.assumed:
        note(f"assumed: {line}")
    yield {"file": str(file), "stl": stl, **_summary(made.name, made)}
    yield f"{file}: {made.description}"


def _size(text: str) -> tuple[float, float, float]:
    return option_values.triple(text, "size", "W,B,H, e.g. 20,40,60")


def _summary(name: str, phantom: Phantom) -> dict[str, object]:
    """Describe a phantom for `--json`: name, size [mm], number of beads, their radii
    [mm], description, and assumptions about it.

    Radii are a list, empty without beads.
    """
    return {
        "name": name,
        "size_mm": list(phantom.size_mm),
        "beads": len(phantom.beads),
        "bead_radius_mm": phantom.bead_radius_mm.tolist(),
        "description": phantom.description,
        "assumed": list(phantom.assumed),
    }
