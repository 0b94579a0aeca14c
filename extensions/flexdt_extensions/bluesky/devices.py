"""The whole laboratory as one device: axes by name, tube, camera, flyer, over one connection.

Voltage, power and on or off of the X-ray tube are settable signals; `bps.mv(tube.kV, 90,
tube.power_W, 20, tube.on, True)` waits until X-rays are stable.
"""

from __future__ import annotations

import asyncio
import ssl as tls

from ophyd_async.core import (
    AsyncStageable,
    AsyncStatus,
    Device,
    PathProvider,
    StandardReadable,
    StandardReadableFormat,
)

from flexdt.clients import Transport
from flexdt.twin.machine.description import Machine, builtin_machine
from flexdt_extensions.bluesky.axes import TwinAxis
from flexdt_extensions.bluesky.camera_device import TwinCamera
from flexdt_extensions.bluesky.flyer import TwinFlyer
from flexdt_extensions.bluesky.lab_connection import LabConnection, ReadBeforeDescribed, settable


class TwinTube(ReadBeforeDescribed, StandardReadable):
    """The X-ray tube.

    Args:
        link: to the twin.
        name: of the device.
    """

    def __init__(self, link: LabConnection, name: str = "") -> None:
        client = link.client

        async def switch(on: bool) -> None:
            await client.set_tube(on=on)
            async for state in link.states():
                if state.tube.on != on:
                    raise RuntimeError(f"somebody else switched X-rays {'off' if on else 'on'}")
                if state.tube.ready or not on:
                    return

        with self.add_children_as_readables(StandardReadableFormat.CONFIG_SIGNAL):
            self.kV = settable(link, "tube.kV", float, lambda v: client.set_tube(kV=v), "kV")
            self.power_W = settable(
                link, "tube.power_W", float, lambda v: client.set_tube(power_W=v), "W"
            )
            self.on = settable(link, "tube.on", bool, switch)
        super().__init__(name=name)


class TwinLab(Device, AsyncStageable):
    """A twin's devices.

    Each axis of the machine is an attribute: `lab.rot_obj`, `lab.mag_obj`, ... Plans stage the root
    of a device, which is the laboratory: it stages its camera and its flyer, so that each run
    begins a series of images of its own.

    Args:
        where: names folder and file of the camera's images.
        host, port, token, ssl: of the twin server.
        transport: replaces TCP, such as that of a twin in process (`flexdt.testing.twin`).
        machine: whose axes there are; a shipped name or a value.
        name: of the device.
        collisions: whether `check_value` asks the twin about collisions too.
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
        scanner = builtin_machine(machine) if isinstance(machine, str) else machine
        self.link = LabConnection(host, port, token, ssl=ssl, transport=transport)
        self.axis_names = (*scanner.axes, *scanner.virtual_axes)
        for axis in self.axis_names:
            unit = scanner.axes[axis].unit if axis in scanner.axes else "mm"
            setattr(self, axis, TwinAxis(self.link, axis, unit, collisions=collisions))
        self.tube = TwinTube(self.link)
        self.camera = TwinCamera(self.link, where)
        self.scan = TwinFlyer(self.link, machine=None if isinstance(machine, str) else machine)
        super().__init__(name=name)

    def axis(self, name: str) -> TwinAxis:
        """An axis by its name.

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
        """End what camera and flyer still do; a scan that has not ended is aborted."""
        await asyncio.gather(self.camera.unstage(), self.scan.unstage())

    async def close(self) -> None:
        """End the connection."""
        await self.link.close()
