"""`flexdt expose`: the exposure of a scan predicted, or measured in a data set."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Final

import typer

from flexdt.clients.cli import options, value_completion
from flexdt.clients.cli.console import duration, size, table, warn
from flexdt.clients.cli.options import Answer, argument, option
from flexdt.library import machines

if TYPE_CHECKING:
    from flexdt.library.expose import Forecast, Measured, Transmission

FRAMES: Final = 361
DETAIL: Final = "void:0.5"
SHOWN_SETTINGS: Final = 5
"""Number of proposed settings that are shown."""


def expose(
    dataset: Path | None = argument(None, "[DATASET]"),
    sample: str = option(
        "lego", metavar="NAME or FILE", proposes=value_completion.sample_names
    ),
    material: str | None = option(
        None, metavar="M", proposes=value_completion.material_names
    ),
    kV: list[float] | None = option(None, "--kV", "--kv"),
    power: float | None = option(None, metavar="W"),
    filter: str = option("", metavar="MATERIAL:MM"),
    exposure: float | None = option(None, metavar="MS"),
    averages: int = option(1),
    mode: str | None = option(None, metavar="NAME", proposes=value_completion.mode_names),
    roi: options.Roi = None,
    frames: int = option(FRAMES),
    sod: float | None = option(None, metavar="MM"),
    sdd: float | None = option(None, metavar="MM"),
    detail: str = option(DETAIL, metavar="MATERIAL:MM"),
    machine: options.MachineName = None,
) -> Answer:
    """Predict transmission, contrast to noise, dose and the best voltage and filter.

    Args:
        dataset: Measure a scan's radiographs instead.
        sample: Predict the scan of this sample.
        material: Fill a mesh file with this material.
        kV: Try this voltage; repeat it for more, and the best is chosen.
        power: Set the tube's power.
        filter: Put this filter beside the machine's own.
        exposure: Expose each image so long.
        averages: Average so many read-outs in an image.
        mode: Set the camera's mode.
        frames: Take so many images of the scan.
        sod: Set the distance from source to axis; default: as `flexdt script new` sets it.
        sdd: Set the distance from source to panel; default: likewise.
        detail: See this detail; void:MM for less of the sample.

    Yields:
        The forecast (or, of a data set, the measured exposure) as document of --json,
        then its lines. Assumptions and warnings go to standard error. Raises
        typer.BadParameter for an option beside a data set, which has been made.
    """
    from flexdt.library import expose as of
    from flexdt.library.reading.folders import load_dataset
    from flexdt.twin.machine.camera import Roi

    if dataset is not None:
        stated = {
            "sample": sample != "lego", "material": material, "kV": kV, "power": power,
            "filter": filter, "exposure": exposure, "averages": averages != 1, "mode": mode,
            "roi": roi, "frames": frames != FRAMES, "sod": sod, "sdd": sdd,
            "detail": detail != DETAIL, "machine": machine,
        }  # fmt: skip
        for name, given in stated.items():
            if given:
                raise typer.BadParameter(
                    f"--{name}: has no effect on a scan that was made; allowed with: --sample"
                )
        data = load_dataset(dataset)
        warn(data.warnings, dataset)
        measured = of.exposure_of(data)
        yield asdict(measured)
        yield from _transmission_lines(measured)
        return
    forecast = of.expose(
        sample,
        kV=kV or None,
        power_W=power,
        filter=filter,
        exposure_ms=exposure,
        averages=averages,
        mode=mode,
        roi=None if roi is None else Roi(*roi),
        images=frames,
        sod=sod,
        sdd=sdd,
        detail=detail,
        machine=machines.machine(machine),
        material=material,
    )
    warn(forecast.assumed)
    yield asdict(forecast)
    yield from _forecast_lines(forecast)


def _transmission_lines(found: Forecast | Measured) -> Answer:
    """Yield two lines: transmission (least and percentiles), and saturated ("unknown" if
    None) and starved pixels [%].

    Transmission is a share from 0 to 1.
    """
    seen: Transmission = found.transmission
    yield (
        f"transmission: least {seen.least:.3g}, 1 % below {seen.p1:.3g}, "
        f"5 % below {seen.p5:.3g}, half below {seen.median:.3g}"
    )
    if found.saturated is None:
        full = "unknown"
    else:
        full = f"{100 * found.saturated:.3g} % of the pixels"
    yield f"saturated {full}, starved {100 * found.starved:.3g} %"


def _forecast_lines(forecast: Forecast) -> Answer:
    """Yield the forecast as text: counts, contrast, dose and the best settings.

    Shows the first `SHOWN_SETTINGS` of the best settings. A detail without contrast is
    "not seen": its pixels are saturated. Settings are in the forecast's order; kerma is
    in mGy.

    Args:
        forecast: of the exposure.
    """
    yield from _transmission_lines(forecast)
    asked = forecast.asked
    seen = "not seen: these pixels are saturated"
    if asked.cnr is not None:
        seen = f"contrast {asked.cnr:.3g} times the noise"
    yield f"{forecast.detail} on the darkest ray: {seen}; {forecast.contrast_words()}"
    yield (
        f"air kerma on the axis {asked.kerma_mGy:.3g} mGy; {forecast.images} images, at least "
        f"{duration(forecast.seconds)}, {size(forecast.bytes)}"
    )
    rows = [
        (
            f"{s.kV:g}",
            s.filter or "-",
            f"{s.averages} x {s.exposure_ms:.4g}",
            "-" if s.cnr is None else f"{s.cnr:.3g}",
            f"{s.kerma_mGy:.3g}",
        )
        for s in forecast.best[:SHOWN_SETTINGS]
    ]
    yield f"best of {len(forecast.best)} settings of the same power and time:"
    yield table(rows, ("kV", "filter", "ms", "contrast/noise", "mGy"))
