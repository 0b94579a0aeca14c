"""A followed machine as a twin that nobody can command: viewer, clients and commands show it.

Serves the reading part of the twin server's wire on the loopback address. The state is the
mirror's: a moving motor is drawn on its predicted path until a reading contradicts it, and the
warnings say how old the last message is, which positions are assumed, and the newest alarms.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Mapping
from importlib.metadata import version
from typing import Any, Final

from flexdt.protocol import (
    PROTOCOL,
    Connection,
    Failure,
    Malformed,
    Message,
    Request,
    Response,
    RpcError,
    event,
    find,
)
from flexdt.protocol import state_model as w
from flexdt.protocol.rpc_errors import Code
from flexdt.runtime.access import check_bind
from flexdt.twin.collision.collision_scene import build_scene
from flexdt.twin.collision.scene_search import NearestPair, clearance
from flexdt.twin.errors import GeometryError, TwinError
from flexdt.twin.following.follower import Follower
from flexdt.twin.following.mirror import Mirror, SeenAxis
from flexdt.twin.machine.kinematics import motor_poses, virtual_reading
from flexdt.twin.scanner.readout import readout

EVENTS_S: Final = 0.04
SHOWN_ALARMS: Final = 5
CONTRADICTED: Final = ("slow", "fast", "off_path")
READ: Final = 1 << 16


class ReadOnlyTwin:
    """The server.

    Args:
        follower: the machine that the mirror is compared with.
        mirror: the mirror of the moment.
        clock: monotonic [s].
        address: of the scanner, for people.
    """

    def __init__(
        self,
        follower: Follower,
        mirror: Callable[[], Mirror],
        clock: Callable[[], float],
        address: str,
    ) -> None:
        self._follower, self._mirror, self._clock = follower, mirror, clock
        self._scene = build_scene(follower.machine, follower.profile)
        self._address, self._began, self._seq = address, clock(), 0
        self._methods: Mapping[str, Callable[[], Mapping[str, object]]] = {
            "session.hello": self._hello,
            "session.ping": lambda: {"time": self._now()},
            "state.get": self.state,
            "state.subscribe": dict,
            "state.unsubscribe": dict,
            "job.list": lambda: {"jobs": []},
        }

    async def serve(self, host: str, port: int) -> asyncio.Server:
        """Listen; port 0 is any free one.

        Raises:
            AccessError: others can reach the address, and there is no token.
            OSError: it is taken.
        """
        check_bind(host, None)
        return await asyncio.start_server(self._connected, host, port)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        wire = Connection()
        events: asyncio.Task[None] | None = None
        try:
            while not wire.closed and (data := await reader.read(READ)):
                for message in wire.receive_data(data):
                    if isinstance(message, Request) and message.method == "state.subscribe":
                        events = events or asyncio.create_task(self._events(wire, writer))
                    if (answer := self._answer(message)) is not None:
                        writer.write(wire.send(answer))
                await writer.drain()
        except (OSError, asyncio.CancelledError):  # the stream would report being cancelled
            return
        finally:
            if events is not None:
                events.cancel()
            writer.close()

    def _answer(self, message: Message) -> Message | None:
        match message:
            case Malformed():
                return message.reply
            case Request(id=id, method=name):
                try:
                    find(name)
                    if name not in self._methods:
                        raise RpcError(
                            Code.BUSY,
                            f"{name}: this is a machine that is followed, and nothing commands it",
                            {"asked": name, "allowed": sorted(self._methods)},
                        )
                    return Response(id, self._methods[name]())
                except RpcError as error:
                    return Failure(id, error)
        return None

    async def _events(self, wire: Connection, writer: asyncio.StreamWriter) -> None:
        """States while they change, and four a second for their age; a slow reader gets fewer."""
        last: object = None
        count = 0
        while True:
            mirror = self._mirror()
            moving = any(
                a.path is not None and a.path.end > self._clock() for a in mirror.axes.values()
            )
            count += 1
            if mirror is not last or moving or count % 6 == 0:
                last, self._seq = mirror, self._seq + 1
                writer.write(wire.send(event("state", self._seq, self._now(), self.state())))
                await writer.drain()
            await asyncio.sleep(EVENTS_S)

    def _now(self) -> float:
        return self._clock() - self._began

    def _hello(self) -> Mapping[str, object]:
        f = self._follower
        return {
            "protocol": PROTOCOL,
            "server": f"flexdt follow {version('flexdt')}",
            "machine": f.machine.name,
            "profile": f.profile.name,
            "session": "reader",
        }

    def state(self) -> dict[str, Any]:
        """The mirror as the twin's state document."""
        mirror, machine, now = self._mirror(), self._follower.machine, self._clock()
        axes = {name: self._axis(mirror, name, seen, now) for name, seen in mirror.axes.items()}
        positions = {name: axis.position for name, axis in axes.items()}
        for name, virtual in machine.virtual_axes.items():
            of = axes[virtual.of]
            at = virtual_reading(machine, name, positions)
            ends = sorted(virtual.constant + virtual.factor * x for x in of.limits)
            axes[name] = w.AxisState(
                position=at, target=at, velocity=0.0, limits=(ends[0], ends[1]), moving=of.moving,
                virtual=True,
            )  # fmt: skip
        near = self._nearest(positions)
        return w.State(
            time=now - self._began,
            axes=axes,
            tube=w.TubeState(
                on=bool(mirror.xrays_on), kV=mirror.kV, power_W=mirror.power_W,
                ready=bool(mirror.xrays_on) and now >= mirror.ready_s,
            ),
            camera=w.CameraState(**mirror.camera.facts(machine.detector.pixels)),
            sample=w.SampleState(name=None),
            geometry=self._geometry(mirror, positions),
            safety=w.SafetyState(
                state="ok",
                estop=False,
                message=self._address,
                clearance_mm=near.mm if math.isfinite(near.mm) else None,
                pair=None if near.pair is None else list(near.pair),
                warnings=self._warnings(mirror, now),
            ),
            clock=w.ClockState(time_s=now - self._began, speed_up=1.0, real_time_factor=1.0),
            controller="the scanner's own software",
        ).model_dump(mode="json")  # fmt: skip

    def _axis(self, mirror: Mirror, name: str, seen: SeenAxis, now: float) -> w.AxisState:
        axis, path = self._follower.machine.axes[name], seen.path
        told = any((kind, name) in mirror.active for kind in CONTRADICTED)
        moving = path is not None and path.end > now
        drawn = path is not None and moving and not told
        return w.AxisState(
            position=path.position(now) if path is not None and drawn else seen.position,
            target=seen.target,
            velocity=path.velocity(now) if path is not None and drawn else 0.0,
            limits=(axis.lower, axis.upper),
            moving=moving,
            unit="deg" if axis.unit == "deg" else "mm",
            speed=seen.speed,
            acceleration=seen.acceleration,
        )

    def _nearest(self, positions: Mapping[str, float]) -> NearestPair:
        try:
            return clearance(self._scene, positions)
        except TwinError:  # positions that this machine cannot have
            return NearestPair(math.inf, None)

    def _geometry(self, mirror: Mirror, positions: Mapping[str, float]) -> w.GeometryState:
        f = self._follower
        poses = motor_poses(f.machine, f.profile, mirror.camera, positions)
        found = readout(poses, mirror.camera, f.machine.detector.pixels)
        if found is None:
            raise GeometryError("the axis or the detector is not in front of the source", {})
        return w.GeometryState(**vars(found))

    def _warnings(self, mirror: Mirror, now: float) -> list[str]:
        age = mirror.age_s(now)
        heard = "nothing has been heard" if age is None else f"last message {age:.1f} s ago"
        link = "connected" if mirror.connected else "NOT CONNECTED"
        said = [f"followed machine {self._address}: {link}, {heard}"]
        if mirror.assumed:
            said.append(f"assumed at home, never heard: {', '.join(mirror.assumed)}")
        for a in mirror.alarms[-SHOWN_ALARMS:]:
            said.append(f"{a.severity}, {math.floor(now - a.at_s)} s ago: {a.message}")
        return said
