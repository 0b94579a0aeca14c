"""`flexdt expose`: image quality of a scan before it is made, or of a data set."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flexdt.clients.cli import machines, options
from flexdt.clients.cli.console import duration, emit, note, say, size, table

if TYPE_CHECKING:
    from flexdt.clients.expose import Forecast, Measured, Transmission

BEST = 5
"""Proposed settings that are shown."""


def expose(
    dataset: Annotated[
        Path | None,
        typer.Argument(metavar="[DATASET]", help="Measure a scan's radiographs instead."),
    ] = None,
    sample: Annotated[
        str, typer.Option("--sample", metavar="NAME or FILE", help="What is to be scanned.")
    ] = "lego",
    material: Annotated[
        str | None, typer.Option("--material", metavar="M", help="Of a mesh file.")
    ] = None,
    kV: Annotated[
        list[float] | None,
        typer.Option("--kV", "--kv", help="Again for more; the best is chosen among them."),
    ] = None,
    power: Annotated[float | None, typer.Option("--power", metavar="W")] = None,
    filter: Annotated[
        str, typer.Option("--filter", metavar="MATERIAL:MM", help="Beside the machine's own.")
    ] = "",
    exposure: Annotated[float | None, typer.Option("--exposure", metavar="MS")] = None,
    averages: Annotated[int, typer.Option("--averages")] = 1,
    frames: Annotated[int, typer.Option("--frames", help="Images of the scan.")] = 361,
    sod: Annotated[float, typer.Option("--sod", metavar="MM")] = 600.0,
    sdd: Annotated[float, typer.Option("--sdd", metavar="MM")] = 1059.0,
    detail: Annotated[
        str,
        typer.Option("--detail", metavar="MATERIAL:MM", help="What is to be seen; void:MM."),
    ] = "void:0.5",
    machine: options.MachineName = None,
    json: options.Json = False,
) -> None:
    """Predict transmission, contrast to noise, dose and the best voltage and filter."""
    from flexdt.clients import expose as of

    if dataset is not None:
        measured = of.exposure_of(dataset)
        emit(asdict(measured)) if json else _seen(measured)
        return
    forecast = of.expose(
        sample,
        kV=kV or None,
        power_W=power,
        filter=filter,
        exposure_ms=exposure,
        averages=averages,
        images=frames,
        sod=sod,
        sdd=sdd,
        detail=detail,
        machine=machines.machine(machine),
        material=material,
    )
    for text in forecast.assumed:
        note(f"warning: {text}")
    emit(asdict(forecast)) if json else _told(forecast)


def _seen(found: Forecast | Measured) -> None:
    seen: Transmission = found.transmission
    say(f"transmission: least {seen.least:.3g}, 1 % below {seen.p1:.3g}, 5 % below {seen.p5:.3g}, "
        f"half below {seen.median:.3g}")  # fmt: skip
    say(
        f"saturated {100 * found.saturated:.3g} % of the pixels, "
        f"starved {100 * found.starved:.3g} %"
    )


def _told(forecast: Forecast) -> None:
    _seen(forecast)
    asked = forecast.asked
    say(f"{forecast.detail} on the darkest ray: contrast {asked.cnr:.3g} times the noise")
    say(f"air kerma on the axis {asked.kerma_mGy:.3g} mGy; {forecast.images} images, at least "
        f"{duration(forecast.seconds)}, {size(forecast.bytes)}")  # fmt: skip
    rows = [
        (f"{s.kV:g}", s.filter or "-", f"{s.averages} x {s.exposure_ms:.4g}", f"{s.cnr:.3g}",
         f"{s.kerma_mGy:.3g}")
        for s in forecast.best[:BEST]
    ]  # fmt: skip
    say(f"best of {len(forecast.best)} settings of the same power and time:")
    say(table(rows, ("kV", "filter", "ms", "contrast/noise", "mGy")))
