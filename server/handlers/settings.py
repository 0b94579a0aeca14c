"""clock.set, tube.set and camera.set."""

from __future__ import annotations

from collections.abc import Mapping

from flexdt.protocol import params as p
from flexdt.protocol import state as w
from flexdt.server import views
from flexdt.server.core import TwinServer
from flexdt.server.handlers.table import Client, Handler
from flexdt.twin.camera import Roi


def set_clock(twin: TwinServer, client: Client, params: p.ClockSet) -> w.ClockState:
    """How fast twin time runs."""
    twin.clock.set_speed_up(params.speed_up)
    twin.changed()
    return views.clock_view(twin.clock)


def set_tube(twin: TwinServer, client: Client, params: p.TubeSet) -> w.TubeState:
    """What is left out stays."""
    now = twin.clock.now()
    twin.scanner.set_tube(kV=params.kV, power_W=params.power_W, on=params.on, now=now)
    twin.changed()
    return views.tube_view(twin.scanner.tube, now)


def set_camera(twin: TwinServer, client: Client, params: p.CameraSet) -> w.CameraState:
    """What is left out stays."""
    twin.scanner.set_camera(
        exposure_ms=params.exposure_ms,
        mode=params.mode,
        roi=None if params.roi is None else Roi(*params.roi),
        averages=params.averages,
        frames=params.frames,
    )
    twin.changed()
    return views.camera_view(twin.scanner.camera, twin.machine)


TABLE: Mapping[str, Handler] = {
    "clock.set": set_clock,
    "tube.set": set_tube,
    "camera.set": set_camera,
}
