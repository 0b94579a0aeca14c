"""`flexdt simulate`: the images of a CTSimU scenario.

The work is in `flexdt.clients.scenario`; this command passes options to it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flexdt.clients.cli import options
from flexdt.clients.cli.console import emit, note, say


def simulate(
    scenario: Annotated[Path, typer.Argument(metavar="SCENARIO.json")],
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="A new folder; default: the scenario's name."),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of the noise.")] = 0,
    rays: Annotated[
        int, typer.Option("--rays", min=1, max=16, help="Along each side of a pixel.")
    ] = 3,
    json: options.Json = False,
) -> None:
    """Simulate a CTSimU scenario: projections, dark and flat images as TIFF, and metadata.

    What the scenario asks and cannot be done is an error; what is left out is a warning.
    """
    from flexdt.clients.scenario import ScenarioImages

    images = ScenarioImages(scenario, seed, rays)
    for text in images.scan.notes:
        note(f"{scenario}: warning: {text}")
    metadata = images.write(scenario.stem if out is None else out)
    scan = images.scan
    rows, cols = scan.geometry.shape or (0, 0)
    document = {
        "scenario": str(scenario), "out": str(metadata.parent), "metadata": str(metadata),
        "projections": len(images), "darks": scan.dark.number, "flats": scan.flat.number,
        "shape": [rows, cols], "max_intensity": images.brightest, "warnings": list(scan.notes),
    }  # fmt: skip
    if json:
        emit(document)
        return
    say(f"{metadata.parent}: {len(images)} projections, {scan.dark.number} dark and "
        f"{scan.flat.number} flat images of {cols} x {rows} pixels; {metadata.name}")  # fmt: skip
