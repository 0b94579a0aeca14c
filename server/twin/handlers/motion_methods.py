"""axes.*, safety.*, clock.set, tube.set and camera.set: commands to the motors, and
settings."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from flexdt.protocol import state_model as w
from flexdt.protocol.fields import Empty
from flexdt.protocol.methods import scanner_messages as p
from flexdt.server.scans.stage import wait_for_way
from flexdt.server.twin import state_views
from flexdt.server.twin.core import TwinServer
from flexdt.server.twin.handlers.handler import (
    Client,
    answers,
    change_settings,
    ensure_idle,
)
from flexdt.twin.errors import SafetyError
from flexdt.twin.machine.camera import Roi
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.scanner.state import CameraChange

DURABLE_S = 0.02
"""Longest time for which the answer to an E-stop waits for the disk [real s]."""


@answers(p.AXES_MOVE)
async def move(twin: TwinServer, client: Client, params: p.Move) -> p.MoveResult:
    """Start a move of motors; with `plan` find and start a way around obstacles instead
    (see `_move_around_obstacles`).

    A way that is under way is canceled once the motors have the new command; a refused
    move that changes nothing leaves it. The answer is sent at once, or with `wait` when
    the motors rest.

    Returns:
        The longest duration [s]; warnings of targets limited to the travel and, with
        `wait`, of motors that rest elsewhere; `moves` None; `arrived`, None without
        `wait`.
    """
    if params.plan:
        return await _move_around_obstacles(twin, client, params)
    now = twin.clock.now()
    limits = twin.scanner.limit_messages(params.targets, now, relative=params.relative)
    with _cancelling_detour(twin):
        durations = twin.scanner.move(
            params.targets, now, relative=params.relative, shortest=params.shortest
        )
    warnings = limits
    arrived = None
    if params.wait:
        wanted = {m: t for m, t in twin.scanner.targets(now).items() if m in durations}
        short = await _unreached_targets(twin, wanted)
        warnings = [*limits, *short]
        arrived = not short
    seconds = max(durations.values(), default=0.0)
    return p.MoveResult(
        duration_s=seconds, warnings=warnings, moves=None, arrived=arrived
    )


async def _unreached_targets(twin: TwinServer, wanted: Mapping[str, float]) -> list[str]:
    """Wait until the motors rest, and list a warning for each that does not rest exactly
    at its target.

    Args:
        twin: whose motors.
        wanted: motor -> target [mm, deg].
    """
    await twin.motion_ended(wanted)
    reached = twin.scanner.positions(twin.clock.now())
    return [
        f"{m} rests at {reached[m]:g} and not at {t:g}: it was stopped or sent elsewhere"
        for m, t in wanted.items()
        if reached[m] != t
    ]


@contextmanager
def _cancelling_detour(twin: TwinServer) -> Iterator[None]:
    """Run a command of motion, then cancel a way around obstacles.

    One that raises without changing motors' programmes lets it go on.
    """
    before = twin.scanner.programmes
    refused = True
    try:
        yield
        refused = False
    finally:
        if not refused or twin.scanner.programmes != before:
            twin.detours.cancel()
        twin.changed()


async def _move_around_obstacles(
    twin: TwinServer, client: Client, params: p.Move
) -> p.MoveResult:
    """Find free moves to the targets and start them one by one; an earlier way ends with
    its present leg.

    With `wait` the answer comes at the end of the way. Later a failure is a warning in
    the log in either case.

    Returns:
        Duration of the way [s]; warnings; the moves, each motor -> target; `arrived`,
        None without `wait`.

    Raises:
        CollisionError: no free way was found.
        RpcError: -32003, the client has lost control meanwhile.
    """
    twin.detours.cancel()
    now = twin.clock.now()
    limits = twin.scanner.limit_messages(params.targets, now, relative=params.relative)
    way = await twin.detours.plan(
        params.targets, relative=params.relative, shortest=params.shortest
    )
    twin.control.ensure_allowed(client.name, "axes.move")
    task = twin.detours.go(way)

    def report(task: asyncio.Task[None]) -> None:
        """Log a warning if the way has ended by an error; nothing if it was canceled."""
        if not task.cancelled() and task.exception() is not None:
            twin.tell("warning", f"the way around ended early: {task.exception()}")

    task.add_done_callback(report)
    warnings = [*limits, *way.warnings]
    arrived = None
    moves = [dict(leg) for leg in way.legs]
    if params.wait:
        short = await wait_for_way(task)
        short += await _unreached_targets(
            twin, {m: t for leg in moves for m, t in leg.items()}
        )
        warnings = warnings + short
        arrived = not short
    return p.MoveResult(
        duration_s=way.duration_s, warnings=warnings, moves=moves, arrived=arrived
    )


@answers(p.AXES_JOG)
def jog(twin: TwinServer, client: Client, params: p.Jog) -> p.MoveResult:
    """Run an axis at a velocity until the lease ends or as far as it is free.

    Warns if it is cut short, and cancels a way around obstacles.
    """
    with _cancelling_detour(twin):
        jogged = twin.scanner.jog(
            params.axis, params.velocity, params.lease_s, twin.clock.now()
        )
    return p.MoveResult(
        duration_s=jogged.duration_s, warnings=jogged.warnings, moves=None
    )


@answers(p.AXES_SET)
async def set_axis(
    twin: TwinServer, client: Client, params: p.AxisSet
) -> p.AxisSetResult:
    """Set speed and acceleration of an axis's future motions, and save them; those left
    out stay.

    It needs control and an idle twin. Motion under way is not changed.

    Returns:
        The axis with the speed and acceleration that are in force.
    """

    def change(scanner: ScannerTwin) -> None:
        """Set the axis's speed and acceleration; None leaves one."""
        scanner.set_axis(
            params.axis, speed=params.speed, acceleration=params.acceleration
        )

    await change_settings(twin, change, ensure_idle(twin, client, "axes.set", "axes.set"))
    axis = twin.scanner.state(twin.clock.now()).axes[params.axis]
    return p.AxisSetResult(
        axis=params.axis, speed=axis.speed, acceleration=axis.acceleration
    )


@answers(p.AXES_STOP)
def stop(twin: TwinServer, client: Client, params: Empty) -> w.Stopped:
    """Bring the motors to rest; a running scan pauses, a detour is canceled.

    It counts as a stop even if nothing moves. X-rays stay as they are.
    """
    twin.detours.cancel()
    twin.interrupt("stop")
    stopping = twin.scanner.stop(twin.clock.now())
    twin.changed()
    return state_views.stopped_view(twin.state(), stopping, twin.clock.now())


@answers(p.SAFETY_ESTOP)
async def estop(twin: TwinServer, client: Client, params: Empty) -> w.Stopped:
    """Stop as the machine's E-stop does with X-rays off, log it, and save that it is in force.

    It acts at once; the answer waits for the disk for at most `DURABLE_S`. A running scan
    pauses, and a way around obstacles ends. While it is in force already it stops again, but
    nothing is written.
    Returns the state with the stopping motion, at its beginning; `unsaved` says so if the disk
    does not have the E-stop yet.
    """
    twin.detours.cancel()
    twin.interrupt("E-stop")
    stopping = twin.scanner.estop(twin.clock.now(), client.name)
    twin.tell("warning", f"E-stop by {client.name}", about="estop")
    twin.changed()
    stopped = state_views.stopped_view(twin.state(), stopping, twin.clock.now())
    await twin.journal.durable(DURABLE_S)
    return stopped.model_copy(update={"unsaved": twin.unsaved()})


@answers(p.SAFETY_RESET)
def reset(twin: TwinServer, client: Client, params: p.Reset) -> w.State:
    """Leave E-stop or blocked state, if `stop` (None: any) is the latest.

    It does not wait for the disk.
    """
    twin.scanner.reset(twin.clock.now(), params.stop)
    twin.changed()
    twin.journal.changed(at_once=True)
    return twin.state()


@answers(p.CLOCK_SET)
def set_clock(twin: TwinServer, client: Client, params: p.ClockSet) -> w.ClockState:
    """Set the speed of twin time for now and later; return the clock's state."""
    twin.clock.set_speed_up(params.speed_up)
    twin.changed()
    return state_views.clock_view(twin.clock)


@answers(p.TUBE_SET)
async def set_tube(twin: TwinServer, client: Client, params: p.TubeSet) -> w.TubeState:
    """Change the tube's voltage, power and X-rays; omitted settings stay.

    A change of voltage or power needs control and an idle twin, and is saved. X-rays
    alone are switched at once, also during a job.

    Returns:
        The tube's state afterwards.

    Raises:
        SafetyError: X-rays were to go on and motion was stopped after the request came.
    """

    stops = twin.scanner.stops

    def change(scanner: ScannerTwin) -> None:
        """Set the tube; None leaves a setting.

        Raises:
            SafetyError: X-rays are to go on and motion was stopped after the request
                came.
        """
        now = twin.clock.now()
        if params.on and twin.scanner.stops != stops:
            raise SafetyError(
                "X-rays stay off: motion was stopped meanwhile",
                {"asked": "xrays on", "allowed": "asking again"},
            )
        scanner.set_tube(kV=params.kV, power_W=params.power_W, on=params.on, now=now)

    if params.kV is None and params.power_W is None:
        change(
            twin.scanner
        )  # X-rays never come on by themselves, so nothing must be remembered
        twin.changed()
    else:
        await change_settings(
            twin, change, ensure_idle(twin, client, "tube.set", "tube.set")
        )
    return state_views.tube_view(twin.scanner.tube, twin.clock.now())


@answers(p.CAMERA_SET)
async def set_camera(
    twin: TwinServer, client: Client, params: p.CameraSet
) -> w.CameraState:
    """Change the camera (needs an idle twin and control); omitted settings stay.

    Returns the camera's state afterwards.
    """

    def change(scanner: ScannerTwin) -> None:
        """Set the camera; None leaves a setting."""
        scanner.set_camera(**camera_change(params))

    await change_settings(
        twin, change, ensure_idle(twin, client, "camera.set", "camera.set")
    )
    return state_views.camera_view(twin.scanner.camera, twin.machine)


def camera_change(params: p.CameraSet) -> CameraChange:
    """Convert the parameters to keyword arguments of `set_camera`; None means unchanged."""
    roi = None
    if params.roi is not None:
        roi = Roi(*params.roi)
    change: CameraChange = {**params.model_dump(), "roi": roi}  # type: ignore[typeddict-item]
    return change
