"""clock.set, tube.set and camera.set."""

from __future__ import annotations

from pydantic import Field

from flexdt.protocol.fields import Exposure, Params, Power, RoiAsked, ShortText, SpeedUp, Voltage
from flexdt.protocol.method import by_hand, command
from flexdt.protocol.scene_document import Averages, Frames
from flexdt.protocol.state_model import CameraState, ClockState, TubeState


class ClockSet(Params):
    """How fast the twin's time runs."""

    speed_up: SpeedUp


class TubeSet(Params):
    """X-ray tube settings; what is left out stays."""

    kV: Voltage | None = None
    power_W: Power | None = None
    on: bool | None = None


class CameraSet(Params):
    """Camera settings; what is left out stays."""

    exposure_ms: Exposure | None = None
    mode: ShortText | None = None
    roi: RoiAsked | None = Field(
        default=None, description="left, top, right, bottom; inclusive, unbinned"
    )
    averages: Averages | None = None
    frames: Frames | None = None


CLOCK_SET = command("clock.set", ClockSet, ClockState, "set how fast the twin's time runs")
TUBE_SET = by_hand("tube.set", TubeSet, TubeState, "set kV, power and X-rays on or off")
CAMERA_SET = by_hand("camera.set", CameraSet, CameraState,
                     "set exposure, mode, ROI, averages, frames")  # fmt: skip
