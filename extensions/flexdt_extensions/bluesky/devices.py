"""The laboratory as one device: axes by name, tube, camera, flyer, over one connection.

Voltage, power and on or off of the X-ray tube are settable signals; `bps.mv(tube.kV, 90,
tube.power_W, 20, tube.on, True)` waits until X-rays are stable.

An axis is readable, movable, stoppable, and checked before anything moves. `check_value`
judges a target by the machine's limits and by the twin's own plan of the path, so
`bluesky.simulators.check_limits` and every `set` report a target that the scanner would
reject. Positions have the script's sign, in mm and deg.
"""

from __future__ import annotations

import asyncio
import ssl as tls
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from bluesky.protocols import Location
from ophyd_async.core import (
    AsyncStageable,
    AsyncStatus,
    Device,
    MovableLogic,
    PathProvider,
    SignalR,
    SignalRW,
    StandardMovable,
    StandardReadable,
    StandardReadableFormat,
    TimeoutCalculator,
    WatchableAsyncStatus,
)

from flexdt.clients import AxisState, State, Transport
from flexdt.twin.machine.description import Machine, builtin_machine
from flexdt_extensions.bluesky.camera_device import TwinCamera
from flexdt_extensions.bluesky.flyer import TwinFlyer
from flexdt_extensions.bluesky.lab_connection import (
    LabConnection,
    LimitsExceeded,
    Put,
    ReadBeforeDescribed,
    TwinBackend,
    settable,
)

ARRIVAL_TOLERANCE = 1e-6
"""Distance from the target at which an axis has arrived [mm, deg]."""


@dataclass
class AxisLogic(MovableLogic[float]):
    """How an axis moves."""

    link: LabConnection
    axis: str
    collisions: bool
    stopped: bool = False
    """Whether it was stopped since the last target was set."""

    async def stop(self) -> None:
        """Brake this axis; a motion that is still being checked does not begin."""
        self.stopped = True
        await self.link.client.jog(self.axis, 0.0)

    async def check_move(self, new_position: float) -> None:
        """Check a move from the current position to a target; nothing moves.

        The twin checks collisions if `collisions` is set and the move is larger than
        `ARRIVAL_TOLERANCE`.

        Args:
            new_position: target [mm, deg].

        Raises:
            LimitsExceeded: beyond a limit, or two parts would touch; names them.
        """
        state = await self.link.fresh()
        axis = state.axes[self.axis]
        low, high = axis.limits
        if not low <= new_position <= high:
            raise LimitsExceeded(
                f"{self.axis} target {new_position:g} {axis.unit} is outside "
                f"[{low:g}, {high:g}] {axis.unit}",
                {"axis": self.axis, "asked": new_position, "allowed": [low, high]},
            )
        if not self.collisions or abs(new_position - axis.position) <= ARRIVAL_TOLERANCE:
            return
        poses = [{self.axis: new_position}]
        report = await self.link.client.check_trajectory(poses, flat=False)
        if report.collisions:
            first = report.collisions[0]
            raise LimitsExceeded(
                f"{self.axis} target {new_position:g} {axis.unit}: {' and '.join(first.pair)} "
                "would touch on the way",
                {
                    "axis": self.axis,
                    "asked": new_position,
                    "pair": list(first.pair),
                    "last_free": dict(first.last_free),
                },
            )

    async def move(self, new_position: float, timeout: TimeoutCalculator) -> None:
        """Move the axis and wait until it rests at the target; nothing if it has been
        stopped.

        Args:
            new_position: target [mm, deg].
            timeout: gives the longest wait [s].

        Raises:
            RpcError: a limit, a collision, a running job, or another controller.
            RuntimeError: another client stopped the axis on its way.
            TimeoutError: it took too long.
        """
        if self.stopped:
            return
        async with asyncio.timeout(timeout()):
            await self.link.client.move({self.axis: new_position})
            async for state in self.link.states():
                axis = state.axes[self.axis]
                if not axis.moving:
                    self._check_arrival(axis, new_position, state)
                    return

    def _check_arrival(self, axis: AxisState, target: float, state: State) -> None:
        """Check that an axis at rest is within `ARRIVAL_TOLERANCE` of its target.

        Raises:
            RuntimeError: it stopped before, perhaps by the emergency stop.
        """
        if abs(axis.position - target) > ARRIVAL_TOLERANCE:
            if state.safety.estop:
                why = " by the emergency stop"
            else:
                why = ""
            raise RuntimeError(
                f"{self.axis} stopped{why} at {axis.position:g} {axis.unit}, "
                f"on its way to {target:g}"
            )


class TwinAxis(ReadBeforeDescribed, StandardReadable, StandardMovable[float]):
    """One motor or virtual axis.

    Args:
        link: to the twin.
        axis: name in the machine, e.g. `rot_obj`.
        unit: mm or deg.
        name: of the device; a plan's data carry it.
        collisions: whether `check_value` checks for collisions too (some 50 ms each).
    """

    def __init__(
        self,
        link: LabConnection,
        axis: str,
        unit: str = "mm",
        name: str = "",
        *,
        collisions: bool = True,
    ) -> None:
        """Make signals: position (read, with limits), speed, acceleration (configuration)
        and target (moves the axis); see the class.

        `unit` is mm or deg; speed is in unit/s, acceleration in unit/s^2.
        """
        self._link = link
        self._axis = axis
        self._collisions = collisions
        client = link.client

        def member(name: str, put: Put[float], units: str) -> SignalRW[float]:
            return settable(link, f"axes.{axis}.{name}", float, put, units)

        with self.add_children_as_readables(StandardReadableFormat.HINTED_SIGNAL):
            position = TwinBackend(
                link,
                f"axes.{axis}.position",
                float,
                units=unit,
                limits=lambda state: state.axes[axis].limits,
            )
            self.readback = SignalR(position)
        with self.add_children_as_readables(StandardReadableFormat.CONFIG_SIGNAL):
            self.speed = member(
                "speed", lambda v: client.set_axis(axis, speed=v), f"{unit}/s"
            )
            self.acceleration = member(
                "acceleration",
                lambda v: client.set_axis(axis, acceleration=v),
                f"{unit}/s^2",
            )
        self.setpoint = member("target", lambda v: client.move({axis: v}), unit)
        super().__init__(name=name)

    def set(
        self, new_position: float, *more: Any, **options: Any
    ) -> WatchableAsyncStatus[float]:
        """Move there, unless `stop` comes first."""
        self.movable_logic.stopped = False
        return super().set(new_position, *more, **options)

    async def locate(self) -> Location[float]:
        """Return target and position from the newest known state.

        Nothing is awaited while the twin's states arrive: Bluesky loses the answer to a message
        that is interrupted, and its relative plans then take the axis to be at 0.
        """
        axis = (await self._link.known()).axes[self._axis]
        at = axis.position
        return Location(setpoint=at if axis.target is None else axis.target, readback=at)

    @cached_property
    def movable_logic(self) -> AxisLogic:
        """Setpoint, readback and connection by which ophyd moves this axis, with or
        without collision checks.
        """
        return AxisLogic(
            setpoint=self.setpoint,
            readback=self.readback,
            link=self._link,
            axis=self._axis,
            collisions=self._collisions,
        )


class TwinTube(ReadBeforeDescribed, StandardReadable):
    """The X-ray tube.

    Args:
        link: to the twin.
        name: of the device.
    """

    def __init__(self, link: LabConnection, name: str = "") -> None:
        """Make voltage, power and the switch of X-rays as signals.

        Writing the switch waits until X-rays are ready (or off).

        Args:
            link: to the twin.
            name: of the device.
        """
        client = link.client

        async def switch(on: bool) -> None:
            """Switch X-rays, and wait until they are ready or off.

            It returns at once when they are off.

            Raises:
                RuntimeError: somebody else switched them meanwhile.
            """
            await client.set_tube(on=on)
            async for state in link.states():
                if state.tube.on != on:
                    raise RuntimeError(
                        f"somebody else switched X-rays {'off' if on else 'on'}"
                    )
                if state.tube.ready or not on:
                    return

        with self.add_children_as_readables(StandardReadableFormat.CONFIG_SIGNAL):
            self.kV = settable(
                link, "tube.kV", float, lambda v: client.set_tube(kV=v), "kV"
            )
            self.power_W = settable(
                link, "tube.power_W", float, lambda v: client.set_tube(power_W=v), "W"
            )
            self.on = settable(link, "tube.on", bool, switch)
        super().__init__(name=name)


class TwinLab(Device, AsyncStageable):
    """A twin's devices.

    Each axis of the machine is an attribute: `lab.rot_obj`, `lab.mag_obj`, ... Plans
    stage the root of a device, which is the laboratory: it stages its camera and its
    flyer, so that each run begins a series of images of its own.

    Args:
        where: names folder and file of the camera's images.
        host, port, token, ssl: of the twin server.
        transport: replaces TCP, such as that of a twin in process
            (`flexdt.testing.twin`).
        machine: with the axes; a shipped name or a value.
        name: of the device.
        collisions: whether `check_value` checks for collisions too.
    """

    def __init__(
        self,
        where: PathProvider,
        host: str = "127.0.0.1",
        port: int = 55000,
        token: str | None = None,
        *,
        ssl: tls.SSLContext | None = None,
        transport: Transport | None = None,
        machine: Machine | str = "flexray",
        name: str = "",
        collisions: bool = True,
    ) -> None:
        """Make the devices of a machine's axes (also virtual ones), tube, camera and
        scans, as attributes; nothing connects yet.

        Arguments: see the class.
        """
        if isinstance(machine, str):
            scanner = builtin_machine(machine)
        else:
            scanner = machine
        self.link = LabConnection(host, port, token, ssl=ssl, transport=transport)
        self.axis_names = (*scanner.axes, *scanner.virtual_axes)
        for axis in self.axis_names:
            if axis in scanner.axes:
                unit = scanner.axes[axis].unit
            else:
                unit = "mm"
            setattr(self, axis, TwinAxis(self.link, axis, unit, collisions=collisions))
        self.tube = TwinTube(self.link)
        self.camera = TwinCamera(self.link, where)
        self.scan = TwinFlyer(
            self.link, machine=None if isinstance(machine, str) else machine
        )
        super().__init__(name=name)

    def axis(self, name: str) -> TwinAxis:
        """Return an axis by its name.

        Raises:
            KeyError: the machine has none of that name; lists them.
        """
        if name not in self.axis_names:
            raise KeyError(f"no axis {name!r}; there are: {', '.join(self.axis_names)}")
        found = getattr(self, name)
        assert isinstance(found, TwinAxis)
        return found

    @AsyncStatus.wrap
    async def stage(self) -> None:
        """Make camera and flyer ready for a new run."""
        await asyncio.gather(self.camera.stage(), self.scan.stage())

    @AsyncStatus.wrap
    async def unstage(self) -> None:
        """End the work of camera and flyer; a scan that has not ended is aborted."""
        await asyncio.gather(self.camera.unstage(), self.scan.unstage())

    async def close(self) -> None:
        """End the connection."""
        await self.link.close()
