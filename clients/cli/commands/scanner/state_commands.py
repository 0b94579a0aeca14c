"""`flexdt state`, `tube`, `camera` and `clock`: the scanner's state, shown or set.

The twin checks ranges; its error is printed as it comes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from flexdt.clients.cli import option_values, options
from flexdt.clients.cli.console import table
from flexdt.clients.cli.options import Answer, Twin, argument, option

if TYPE_CHECKING:
    from flexdt.protocol.state_model import AxisState, State, TubeState


def state(twin: Twin) -> Answer:
    """Show axes, geometry, tube, camera, sample, safety, job."""
    with twin() as client:
        current = client.state()
    yield current
    yield table([_axis(n, a) for n, a in current.axes.items()],
                ("axis", "position", "target", "velocity", "limits", "unit", ""))  # fmt: skip
    yield ""
    for name, text in _facts(current):
        yield f"{name:12} {text}"


def _axis(name: str, axis: AxisState) -> tuple[str, ...]:
    lower, upper = axis.limits
    doing = "moving" if axis.moving else "virtual" if axis.virtual else ""
    return (
        name, f"{axis.position:.4f}", f"{axis.target:.4f}", f"{axis.velocity:.3f}",
        f"[{lower:g}, {upper:g}]", axis.unit, doing,
    )  # fmt: skip


def _facts(state: State) -> list[tuple[str, str]]:
    g, c, t, s = state.geometry, state.camera, state.tube, state.sample
    rows, cols = c.shape
    facts = [
        ("geometry", f"SOD {g.SOD_mm:.4f} mm, SDD {g.SDD_mm:.4f} mm, magnification "
                     f"{g.magnification:.4f}, voxel {g.voxel_size_mm * 1000:.3f} um"),
        ("view", f"{g.field_of_view_mm[0]:.2f} x {g.field_of_view_mm[1]:.2f} mm, piercing point "
                 f"column {g.piercing_point_px[0]:.2f}, row {g.piercing_point_px[1]:.2f}"),
        ("tube", f"{xrays(t)}, {t.kV:g} kV, {t.power_W:g} W"),
        ("camera", f"{c.mode}, {cols} x {rows} pixels of {c.pixel_mm:g} mm, {c.exposure_ms:g} ms"),
        ("sample", s.name or "none"),
        ("safety", " ".join(w for w in (state.safety.state, state.safety.message) if w)),
        ("clock", f"{state.clock.time_s:.2f} s, speed-up {state.clock.speed_up}"),
        ("correction", state.correction.name if state.correction else "none"),
        ("controller", state.controller or "nobody"),
    ]  # fmt: skip
    if state.image is not None:
        i = state.image
        cut = f", sample cut off at: {', '.join(i.truncated)}" if i.truncated else ""
        facts.append(("image", f"{i.saturated:.1%} saturated, {i.starved:.1%} starved{cut}"))
    if state.job is not None:
        j = state.job
        facts.append(("job", f"{j.job} {j.state}, {j.frames_done} of {j.frames_total} frames"))
    return facts


def tube(
    twin: Twin,
    kV: float | None = option(None, "Set the tube's voltage.", "--kv"),
    power_W: float | None = option(None, "Set the tube's power.", "--power", metavar="W"),
    on: bool | None = option(None, "Switch X-rays on or off.", "--on/--off"),
) -> Answer:
    """Set the X-ray tube, or show it; what is left out stays."""
    with twin() as client:
        if kV is None and power_W is None and on is None:
            t = client.state().tube
        else:
            t = client.set_tube(kV=kV, power_W=power_W, on=on)
    yield t
    yield f"X-rays {xrays(t)}, {t.kV:g} kV, {t.power_W:g} W"


def xrays(tube: TubeState) -> str:
    """Off, on, or when they will be ready."""
    if tube.on and not tube.ready:
        return f"on, ready in {tube.ready_in_s or 0.0:.1f} s"
    return "on" if tube.on else "off"


def camera(
    twin: Twin,
    exposure_ms: float | None = option(None, "Set the exposure time.", "--exposure", metavar="MS"),
    mode: str | None = option(None, "Set the mode: HWaSWbHigh or HWaSWbLow."),
    roi: options.Roi = None,
    averages: int | None = option(None, "Average so many read-outs in an image."),
) -> Answer:
    """Set the camera, or show it; what is left out stays."""
    with twin() as client:
        if exposure_ms is None and mode is None and roi is None and averages is None:
            c = client.state().camera
        else:
            c = client.set_camera(exposure_ms=exposure_ms, mode=mode, roi=roi, averages=averages)
    yield c
    rows, cols = c.shape
    yield (f"{c.mode}, {cols} x {rows} pixels of {c.pixel_mm:g} mm, {c.exposure_ms:g} ms, "
           f"averages {c.averages}, ROI {' '.join(map(str, c.roi))}")  # fmt: skip


def clock(twin: Twin, speed_up: str = argument(..., "X or max")) -> Answer:
    """Set how fast the twin's time runs."""
    wanted = option_values.speed_up(speed_up)
    with twin() as client:
        now = client.set_clock(wanted)
    yield now
    yield f"speed-up {now.speed_up}, {now.time_s:.2f} s on the twin's clock"
