"""`flexdt sample`: what stands on the stage, set or listed; a file is uploaded first."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import typer

from flexdt.clients.cli.console import warn
from flexdt.clients.cli.options import Answer, Twin, argument, option


def sample(
    twin: Twin,
    name: str | None = argument(
        None,
        "NAME or FILE",
        "A mesh, phantom or scene file is sent first. Lists what there is if left out.",
    ),
    unit: Literal["um", "mm", "cm", "m", "inch"] | None = option(
        None, "Read a mesh in this unit; default: mm, for GLB m."
    ),
    material: str | None = option(None, "Fill a mesh with this material; default: abs."),
) -> Answer:
    """Put a sample on the stage, or list what there is."""
    from flexdt.clients.client.uploads import MESH_FORMATS, SCENE_FORMATS

    file = None if name is None else Path(name)
    kind = "" if file is None else file.suffix.lower().lstrip(".")
    if file is None or kind not in (*MESH_FORMATS, *SCENE_FORMATS) or not file.is_file():
        file = None
    if (file is None or kind not in MESH_FORMATS) and (unit is not None or material is not None):
        raise typer.BadParameter("--unit and --material are for a mesh file")
    with twin() as client:
        if name is None:
            found = client.samples()
            yield found
            yield from (f"{one.name:20} {one.description}" for one in found.samples)
            return
        if file is not None:
            if kind in SCENE_FORMATS:
                sent = client.upload_scene(file)
            else:
                sent = client.upload_mesh(file, unit=unit, material=material)
            now = client.set_sample(file=sent.name)
        else:
            now = client.set_sample(name)
    warn(now.warnings)
    yield now
    yield f"on the stage: {now.sample.name or 'nothing'}"
