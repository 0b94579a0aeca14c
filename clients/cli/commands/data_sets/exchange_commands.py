"""`flexdt export` and `flexdt import`: geometry in the formats of other programs, and back.

The work is in `flexdt.clients.datasets.exchange`; these commands pass options to it.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import typer

from flexdt.clients.cli import option_values, options
from flexdt.clients.cli.console import note, warn
from flexdt.clients.cli.options import Answer, argument, option
from flexdt.clients.cli.settings_file import ExportSettings, chosen

if TYPE_CHECKING:
    from flexdt.clients.datasets.exchange import Given

Format = Literal["ctsimu", "rtk", "astra", "tomosipo", "flexdata", "csv"]
Exported = Literal[Format, "nxtomo"]
Rows = Literal["down", "up"]


def export(
    dataset: Path = argument(..., "DATASET"),
    format: Exported = option(..., "Write this program's format."),
    out: Path = option(..., "Write the geometry to this file.", metavar="FILE"),
    corrected: bool = option(
        True, "Apply the correction in force, or leave it out.", "--corrected/--nominal"
    ),
    correction: Path | None = option(
        None, "Apply the correction of this calibration report instead.", metavar="FILE"
    ),
    unknown: Path | None = option(
        None,
        "State, for CTSimU, what reconstruction does not know (TOML).",
        metavar="FILE",
    ),
    rows: Rows = option("down", "Count rows down or up; up: for images turned upside down."),
    texts: options.Texts = False,
) -> Answer:
    """Write a data set's geometry in another program's format; nxtomo holds its images, too.

    What the format cannot carry is an error, and nothing is written: docs/exchange.md.
    """
    if correction is not None and not corrected:
        raise typer.BadParameter("--correction and --nominal exclude each other")
    from flexdt.clients.cli.commands.data_sets.reconstruct_command import read_report, scan_of
    from flexdt.clients.datasets.exchange import export_dataset
    from flexdt.clients.launch.random_truth import read
    from flexdt.twin.geometry.offsets import NOMINAL, Offsets

    tolerance = chosen(ExportSettings).tolerance
    report = None if correction is None else read_report(correction)
    parameters = report.parameters if report else None if corrected else NOMINAL
    data = scan_of(dataset, texts, report)
    warn(data.warnings, dataset)
    real = None if unknown is None else Offsets.from_edge(read(unknown))
    written = export_dataset(
        data,
        out,
        format,
        parameters=parameters,
        real=real,
        rows_up=rows == "up",
        tolerance_mm=tolerance,
    )
    height, width = written.shape or (0, 0)
    yield {
        "format": format, "file": str(out), "views": len(written), "shape": [height, width],
        "corrected": corrected, "rows": "up" if format == "flexdata" else rows,
    }  # fmt: skip
    what = "corrected" if corrected else "nominal"
    yield f"{out}: {len(written)} views of {width} x {height} pixels, {what}, {format}"


def import_(
    file: Path = argument(..., "FILE"),
    format: Format = option(..., "Read this program's format."),
    out: Path = option(..., "Write the geometry to this file.", metavar="FILE.{json,npy}"),
    like: Path | None = option(
        None, "Take what FILE does not say from this data set.", metavar="DATASET"
    ),
    shape: str | None = option(
        None, "Set the detector's shape where FILE does not say it.", metavar="ROWS,COLS"
    ),
    pixel: str | None = option(
        None, "Set the pixel pitch where FILE does not say it (RTK).", metavar="MM or U,V"
    ),
    views: int | None = option(None, "Set the number of projections (flexDATA).", min=1),
    rows: Rows = option("down", "Count rows down or up; up: v is negated."),
    real: bool = option(
        False, "Take, of a CTSimU file, what is so, or what reconstruction knows.", "--real/--known"
    ),
) -> Answer:
    """Read a geometry in another program's format and write it as a geometry file.

    `flexdt reconstruct` and `calibrate` take it with --geometry, Python with `load_geometry`.
    """
    given = said(like, shape, pixel, views)
    from dataclasses import replace

    from flexdt.clients.datasets.exchange import import_geometry, save_geometry

    geometry = import_geometry(file, format, given, rows_up=rows == "up")
    if real and geometry.real is not None:
        geometry = replace(geometry, cone_vec=geometry.real, real=None, notes=())
    save_geometry(geometry, out)
    for text in geometry.notes:
        note(f"{file}: {text}")
    yield {
        "format": format, "file": str(file), "out": str(out), "views": len(geometry),
        "shape": None if geometry.shape is None else list(geometry.shape),
        "pixel_mm": list(geometry.pitch_mm), "notes": list(geometry.notes),
    }  # fmt: skip
    height, width = geometry.shape or (None, None)
    size = "unknown size" if width is None else f"{width} x {height} pixels"
    u, v = geometry.pitch_mm
    yield f"{out}: {len(geometry)} views of {size}, pixel {u:.6g} x {v:.6g} mm"


def said(
    like: Path | None, shape: str | None, pixel: str | None, views: int | None = None
) -> Given:
    """What the options say that a geometry's file does not."""
    size = pitch = None
    if shape is not None:
        form = "ROWS,COLS, e.g. 760,956"
        size = option_values.numbers(shape, "shape", form, 2, whole=True)
    if pixel is not None:
        pitch = option_values.numbers(pixel, "pixel pitch", "MM or U,V", 1, 2)
    if pitch is not None and min(pitch) <= 0.0:
        raise typer.BadParameter(f"pixel pitch {pixel!r} must be above 0")
    from flexdt.clients.datasets.dataset import load_dataset
    from flexdt.clients.datasets.exchange import Given

    known = Given() if like is None else Given.of(load_dataset(like))
    return Given(
        known.shape if size is None else (int(size[0]), int(size[1])),
        known.pitch_mm if pitch is None else (pitch[0], pitch[-1]),
        known.views if views is None else views,
    )
