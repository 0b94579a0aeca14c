"""`flexdt tube` and `flexdt camera`: change the settings, or show them.

The twin checks ranges; its error is printed as it comes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from flexdt.clients.cli import options
from flexdt.clients.cli.connecting import Twin, on_twin
from flexdt.clients.cli.console import emit, say

if TYPE_CHECKING:
    from flexdt.protocol.state_model import TubeState


def register(app: typer.Typer) -> None:
    """Add this module's commands."""
    app.command("tube")(tube)
    app.command("camera")(camera)


@on_twin
def tube(
    kV: Annotated[float | None, typer.Option("--kv", help="Voltage.")] = None,
    power_W: Annotated[float | None, typer.Option("--power", metavar="W", help="Power.")] = None,
    on: Annotated[bool | None, typer.Option("--on/--off", help="X-rays.")] = None,
    *,
    twin: Twin,
    json: options.Json = False,
) -> None:
    """Set the X-ray tube, or show it; what is left out stays."""
    with twin() as client:
        if kV is None and power_W is None and on is None:
            t = client.state().tube
        else:
            t = client.set_tube(kV=kV, power_W=power_W, on=on)
    if json:
        emit(t)
    else:
        say(f"X-rays {xrays(t)}, {t.kV:g} kV, {t.power_W:g} W")


def xrays(tube: TubeState) -> str:
    """Off, on, or when they will be ready."""
    if tube.on and not tube.ready:
        return f"on, ready in {tube.ready_in_s or 0.0:.1f} s"
    return "on" if tube.on else "off"


@on_twin
def camera(
    exposure_ms: Annotated[float | None, typer.Option("--exposure", metavar="MS")] = None,
    mode: Annotated[str | None, typer.Option("--mode", help="HWaSWbHigh or HWaSWbLow.")] = None,
    roi: options.Roi = None,
    averages: Annotated[int | None, typer.Option("--averages")] = None,
    *,
    twin: Twin,
    json: options.Json = False,
) -> None:
    """Set the camera, or show it; what is left out stays."""
    with twin() as client:
        if exposure_ms is None and mode is None and roi is None and averages is None:
            c = client.state().camera
        else:
            c = client.set_camera(exposure_ms=exposure_ms, mode=mode, roi=roi, averages=averages)
    if json:
        emit(c)
    else:
        rows, cols = c.shape
        say(f"{c.mode}, {cols} x {rows} pixels of {c.pixel_mm:g} mm, {c.exposure_ms:g} ms, "
            f"averages {c.averages}, ROI {' '.join(map(str, c.roi))}")  # fmt: skip
