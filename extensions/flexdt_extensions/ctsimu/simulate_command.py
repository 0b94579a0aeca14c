"""`flexdt simulate`: the images of a CTSimU scenario.

The work is in `flexdt_extensions.ctsimu.scenario`; this command passes options to it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from flexdt.extending import Answer, argument, option, rays_a_side, warn
from flexdt.twin.errors import TwinError


def simulate(
    scenario: Path = argument(..., "SCENARIO.json"),
    out: Path | None = option(
        None, "Write to this new folder; default: the scenario's name.", metavar="DIR"
    ),
    seed: int = option(0, "Draw the noise from this seed.", min=0),
    rays: Any = option(
        "auto",
        "Trace so many rays along each side of a pixel that an edge reaches; auto: so many "
        "that the error stays below the noise.",
        metavar="N or auto",
        parser=rays_a_side,
    ),
) -> Answer:
    """Simulate a CTSimU scenario: projections, dark and flat images as TIFF, and metadata.

    What the scenario asks and cannot be done is an error; what is left out is a warning.

    Yields:
        Files, counts, shape, largest intensity and warnings as document of --json, then one
        line.
    """
    from flexdt_extensions.ctsimu.scenario import ScenarioImages

    if scenario.is_file() and scenario.suffix.lower() != ".json":
        raise TwinError.instead(
            f"{scenario}: `flexdt simulate` takes a CTSimU scenario",
            str(scenario),
            f"a .json file; to scan a mesh or a phantom: flexdt sample {scenario}, "
            f"or in Python flexdt.simulate({str(scenario)!r}, geometry)",
        )
    images = ScenarioImages(scenario, seed, rays)
    warn(images.scan.notes, scenario)
    metadata = images.write(scenario.stem if out is None else out)
    scan = images.scan
    rows, cols = scan.geometry.shape or (0, 0)
    yield {
        "scenario": str(scenario),
        "out": str(metadata.parent),
        "metadata": str(metadata),
        "projections": len(images),
        "darks": scan.dark.number,
        "flats": scan.flat.number,
        "shape": [rows, cols],
        "max_intensity": images.brightest,
        "warnings": list(scan.notes),
    }
    yield (
        f"{metadata.parent}: {len(images)} projections, {scan.dark.number} dark and "
        f"{scan.flat.number} flat images of {cols} x {rows} pixels; {metadata.name}"
    )
