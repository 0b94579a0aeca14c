"""The X-ray tube: voltage, power, on or off, as settable signals.

`bps.mv(tube.kV, 90, tube.power_W, 20, tube.on, True)` waits until X-rays are stable.
"""

from __future__ import annotations

from ophyd_async.core import SignalRW, StandardReadable, StandardReadableFormat

from flexdt.clients.lab.lab_connection import LabConnection, TwinBackend, settable


class TwinTube(StandardReadable):
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
            self.kV: SignalRW[float] = settable(
                TwinBackend(link, "tube.kV", float, lambda s: s.tube.kV,
                            put=lambda v: client.set_tube(kV=v), units="kV")
            )  # fmt: skip
            self.power_W: SignalRW[float] = settable(
                TwinBackend(link, "tube.power_W", float, lambda s: s.tube.power_W,
                            put=lambda v: client.set_tube(power_W=v), units="W")
            )  # fmt: skip
            self.on: SignalRW[bool] = settable(
                TwinBackend(link, "tube.on", bool, lambda s: s.tube.on, put=switch)
            )
        super().__init__(name=name)
