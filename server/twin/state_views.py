"""The twin's values as the wire's models: one function each, units as the protocol has them."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from typing import TypeVar

from flexdt.protocol import state_model as w
from flexdt.runtime.log import log
from flexdt.server.scans.twin_clock import TwinClock
from flexdt.server.storage.scene_document import correction_fields
from flexdt.twin.collision.first_contact import NearestPair
from flexdt.twin.errors import GeometryError, TwinError
from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.machine.description import Machine
from flexdt.twin.scanner.joining import StopMotion
from flexdt.twin.scanner.state import NamedCorrection, Readout, Safety, TubeSettings

SAFETY_NAMES = {"ready": "ok", "blocked": "aborted", "estopped": "estop"}
"""The twin's safety states -> their names on the wire."""


def tube_view(tube: TubeSettings, now: float) -> w.TubeState:
    """Convert the tube to its wire form: on, kV, W, and whether X-rays are ready at `now`
    [twin s], else in how many seconds.
    """
    return w.TubeState(
        on=tube.on,
        kV=tube.kV,
        power_W=tube.power_W,
        ready=tube.ready(now),
        ready_in_s=tube.ready_in_s(now),
    )


def camera_view(camera: CameraSettings, machine: Machine) -> w.CameraState:
    """Convert the camera's state to its wire form."""
    return w.CameraState(**camera.facts(machine.detector.pixels))


Value = TypeVar("Value")


def derived(
    missing: dict[str, str], name: str, make: Callable[[], Value]
) -> Value | None:
    """Compute a derived part of the state, whatever it meets.

    `missing`: gets the reason under `name` where it could not be computed; `name`: of the part;
    `make`: computes it.
    Returns the part; None where it could not be computed.
    """
    try:
        return make()
    except TwinError as error:
        missing[name] = error.message
    except Exception as error:  # whatever it meets, where the motors are is told
        log(f"the state's {name} cannot be computed", logging.ERROR, error=True)
        missing[name] = f"it cannot be computed: {type(error).__name__}"
    return None


def geometry_view(readout: Readout | None) -> w.GeometryState:
    """Convert the derived geometry to its wire form.

    Raises GeometryError: None, axis or detector not before the source.
    """
    if readout is None:
        raise GeometryError(
            "the rotation axis or the detector is not in front of the source",
            {"check": "sod"},
        )
    return w.GeometryState(**vars(readout))


def safety_view(
    safety: Safety, clearance: NearestPair | None, margin_mm: float
) -> w.SafetyState:
    """Convert safety state and clearance to their wire form.

    `clearance_mm` and `pair` are None where nothing is near. A clearance below the margin
    adds a warning that names the pair.

    Args:
        safety: of the scanner.
        clearance: smallest one now; None or infinite where there is none.
        margin_mm: least clearance without a warning.
    """
    if clearance is None or not math.isfinite(clearance.mm):
        near = None
    else:
        near = clearance
    warnings = []
    if near is not None and near.pair is not None and near.mm < margin_mm:
        warnings = [
            f"{' and '.join(near.pair)} are within the margin, {near.mm:.2f} mm apart"
        ]
    return w.SafetyState(
        state=SAFETY_NAMES[safety.state],
        estop=safety.state == "estopped",
        message=safety.reason,
        stop=safety.stop,
        stopped_by=safety.stopped_by or None,
        blocked_attempts=safety.blocked_attempts,
        clearance_mm=None if near is None else near.mm,
        pair=None if near is None or near.pair is None else list(near.pair),
        warnings=warnings,
    )


def correction_view(
    correction: NamedCorrection | None, source: str | None
) -> w.Correction | None:
    """Convert a correction to its wire form, in mm and deg."""
    if correction is None:
        return None
    return w.Correction(**correction_fields(correction), source=source)


def clock_view(clock: TwinClock) -> w.ClockState:
    """Convert the clock to its wire form: twin time [s], speed-up, measured factor (or None)."""
    return w.ClockState(
        time_s=clock.now(),
        speed_up=clock.speed_up,
        real_time_factor=clock.real_time_factor,
    )


def stopped_view(state: w.State, stopping: StopMotion, now: float) -> w.Stopped:
    """Add a stopping motion to the wire state: its path, duration [s] and distances by
    motor.

    If it would hit something, it also has the pair of bodies and in how many seconds from
    `now`, at least 0; else None for both.
    """
    hit = stopping.would_hit
    how = w.Stopping(
        path=stopping.path,
        duration_s=stopping.duration_s,
        distances=dict(stopping.distances),
        would_hit=None if hit is None else list(hit.pair),
        would_hit_in_s=None if hit is None else max(0.0, hit.time - now),
    )
    return w.Stopped(**dict(state), stopping=how)
