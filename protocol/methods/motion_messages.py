"""axes.*, safety.*, clock.set, tube.set and camera.set: motors, stops, and settings."""

from __future__ import annotations

from typing import Annotated

from annotated_types import Ge, Le
from pydantic import Field

from flexdt.protocol import fields as f
from flexdt.protocol.fields import Exposure, Params, Power, RoiAsked, ShortText, SpeedUp, Voltage
from flexdt.protocol.method import Method, by_hand, command
from flexdt.protocol.methods.document_messages import Averages, Frames
from flexdt.protocol.state_model import CameraState, ClockState, State, Stopped, TubeState


class Move(f.Params):
    """Targets of one or several axes, which start together."""

    targets: f.Targets
    """axis -> position [mm or deg], in the script's sign"""
    relative: bool = False
    """targets are displacements"""
    wait: bool = False
    """answer when the motion has ended"""
    plan: bool = False
    """go around obstacles, as a series of free moves"""
    shortest: bool = False
    """rot_obj by the shortest way, not accumulated"""


class Jog(f.Params):
    """Move at a velocity until the lease runs out or is renewed."""

    axis: f.AxisName
    velocity: f.Velocity
    """[mm/s or deg/s], signed; 0 stops"""
    lease_s: Annotated[float, Ge(1e-6), Le(10)] = 0.5
    """of the twin's clock"""


class AxisSet(f.Params):
    """Speed and acceleration of later moves."""

    axis: f.AxisName
    speed: f.Pace | None = None
    """[mm/s or deg/s]"""
    acceleration: f.Pace | None = None
    """[mm/s2 or deg/s2]"""


class Reset(f.Params):
    """Leave the emergency stop, or blocked."""

    stop: Annotated[int, Ge(0), Le(2**53)] | None = None
    """release this stop (safety.stop) alone; null: any"""


class MoveResult(f.Result):
    """What the motion will take."""

    duration_s: f.NonNegative
    """of the twin's clock"""
    warnings: list[str] = Field(default_factory=list)
    moves: list[dict[str, float]] | None = None
    """with plan: the moves in order, axis -> target"""
    arrived: bool | None = None
    """with wait: whether the motors rest at their targets; false after a stop"""


class AxisSetResult(f.Result):
    """Speed and acceleration in force."""

    axis: str
    speed: float
    acceleration: float


AXES_MOVE = by_hand("axes.move", Move, MoveResult, "move axes to targets, starting together")
AXES_JOG = by_hand("axes.jog", Jog, MoveResult, "move at a velocity until the lease runs out")
AXES_SET = by_hand("axes.set", AxisSet, AxisSetResult, "set an axis's speed and acceleration")
AXES_STOP = Method("axes.stop", f.Empty, Stopped, "bring all axes to rest", urgent=True)
SAFETY_ESTOP = Method("safety.estop", f.Empty, Stopped, "emergency stop; X-rays off", urgent=True)
SAFETY_RESET = command("safety.reset", Reset, State, "leave the emergency stop")


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
    roi: RoiAsked | None = None
    """left, top, right, bottom; inclusive, unbinned"""
    averages: Averages | None = None
    frames: Frames | None = None


CLOCK_SET = command("clock.set", ClockSet, ClockState, "set how fast the twin's time runs")
TUBE_SET = by_hand("tube.set", TubeSet, TubeState, "set kV, power and X-rays on or off")
CAMERA_SET = by_hand("camera.set", CameraSet, CameraState,
                     "set exposure, mode, ROI, averages, frames")  # fmt: skip
