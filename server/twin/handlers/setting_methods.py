"""clock.set, tube.set and camera.set."""

from __future__ import annotations

from flexdt.protocol import state_model as w
from flexdt.protocol.methods import motion_messages as p
from flexdt.server.twin import wire_values as views
from flexdt.server.twin.core import TwinServer
from flexdt.server.twin.handlers.handler import Client, answers, change_settings, ensure_idle
from flexdt.twin.errors import SafetyError
from flexdt.twin.machine.camera import Roi
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.scanner.settings import CameraChange


@answers(p.CLOCK_SET)
def set_clock(twin: TwinServer, client: Client, params: p.ClockSet) -> w.ClockState:
    """How fast twin time runs."""
    twin.clock.set_speed_up(params.speed_up)
    twin.changed()
    return views.clock_view(twin.clock)


@answers(p.TUBE_SET)
async def set_tube(twin: TwinServer, client: Client, params: p.TubeSet) -> w.TubeState:
    """Change the tube; omitted settings stay."""

    stops = twin.scanner.stops

    def change(scanner: ScannerTwin) -> None:
        now = twin.clock.now()
        if params.on and twin.scanner.stops != stops:
            raise SafetyError(
                "X-rays stay off: motion was stopped meanwhile",
                {"asked": "xrays on", "allowed": "asking again"},
            )
        scanner.set_tube(kV=params.kV, power_W=params.power_W, on=params.on, now=now)

    if params.kV is None and params.power_W is None:
        change(twin.scanner)  # X-rays never come on by themselves, so nothing must be remembered
        twin.changed()
    else:
        await change_settings(twin, change, ensure_idle(twin, client, "tube.set", "tube.set"))
    return views.tube_view(twin.scanner.tube, twin.clock.now())


@answers(p.CAMERA_SET)
async def set_camera(twin: TwinServer, client: Client, params: p.CameraSet) -> w.CameraState:
    """Change the camera; omitted settings stay."""

    def change(scanner: ScannerTwin) -> None:
        scanner.set_camera(**camera_change(params))

    await change_settings(twin, change, ensure_idle(twin, client, "camera.set", "camera.set"))
    return views.camera_view(twin.scanner.camera, twin.machine)


def camera_change(params: p.CameraSet) -> CameraChange:
    """What to change, as the twin has it."""
    roi = None if params.roi is None else Roi(*params.roi)
    change: CameraChange = {**params.model_dump(), "roi": roi}  # type: ignore[typeddict-item]
    return change
