"""A whole twin in the process and thread of its test: no socket, no server process, no sleep.

The server, its connections and its clients are the real ones. They share one event loop, whose time
is virtual and passes only while a call waits, so the same calls give the same answers, at once.
"""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Callable, Coroutine, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from os import PathLike, fspath
from pathlib import Path
from typing import Any, Literal, TypeVar

from flexdt.clients.client.client import TwinClient
from flexdt.clients.client.transport import ConnectionLost
from flexdt.machines import machine as find_machine
from flexdt.machines import profile as find_profile
from flexdt.protocol import METHODS, Codec, Connection, Message
from flexdt.runtime.access import ConnectionLimits
from flexdt.runtime.files.directory import open_data
from flexdt.server.imaging.truth import TrueGeometry
from flexdt.server.network.tcp import TcpServer
from flexdt.server.scans.checking import Checks
from flexdt.server.twin.application import TwinSession
from flexdt.server.twin.core import TwinServer
from flexdt.testing.virtual_time import Deadlock, SimulatedLoop
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.projection import Body, project_body
from flexdt.twin.scanner.state import Sample

__all__ = ["Deadlock", "DirectProjector", "InProcessTransport", "InProcessTwin", "twin"]

T = TypeVar("T")


class DirectProjector:
    """The projector's work without its server."""

    def __init__(self) -> None:
        self.known: dict[str, Body] = {}

    async def put(self, name: str, body: Body) -> None:
        """Name a body."""
        self.known[name] = body

    async def remove(self, name: str) -> None:
        """Forget a body."""
        del self.known[name]

    async def project(self, name: str, cone_vec: ConeVec, shape: tuple[int, int]) -> Float32Array:
        """Line integrals, float32 (n, rows, cols)."""
        return project_body(self.known[name], cone_vec, shape)


class InProcessTransport:
    """A client's transport to a server of the same event loop: bytes both ways, as over TCP.

    Args:
        loop: of both.
        serve: makes the server's end of a connection.
    """

    def __init__(
        self, loop: asyncio.AbstractEventLoop, serve: Callable[[], asyncio.Protocol]
    ) -> None:
        self._loop, self._serve = loop, serve
        self._pipe: _Pipe | None = None

    async def open(self) -> None:
        """Connect anew.

        Raises:
            RuntimeError: in another event loop.
        """
        if asyncio.get_running_loop() is not self._loop:
            raise RuntimeError(
                "a twin in process answers on its own event loop: RunEngine({}, loop=twin.loop), "
                "or twin.run(...)"
            )
        self.close()
        self._wire, self._pipe = Connection(Codec.MSGPACK), _Pipe(self._serve())

    async def send(self, message: Message) -> None:
        """Hand one message to the server."""
        data = self._wire.send(message)
        if self._pipe is None or self._pipe.is_closing():
            raise ConnectionLost("the twin has ended the connection")
        self._pipe.server.data_received(data)

    async def receive(self) -> list[Message]:
        """Messages, or an empty list at the end."""
        messages: list[Message] = []
        while not messages and self._pipe is not None:
            data = await self._pipe.inbox.get()
            if not data:
                break
            messages = self._wire.receive_data(data)
        return messages

    def close(self) -> None:
        """End the connection."""
        if self._pipe is not None:
            self._pipe.close()


class _Pipe(asyncio.Transport):
    """The server's side of a connection; whatever it writes is at the client at once."""

    def __init__(self, server: asyncio.Protocol) -> None:
        super().__init__({"peername": ("in-process", 0)})
        self.server, self.inbox = server, asyncio.Queue[bytes]()
        self._closing = False
        server.connection_made(self)

    def write(self, data: bytes | bytearray | memoryview) -> None:
        if data and not self._closing:
            self.inbox.put_nowait(bytes(data))

    def close(self) -> None:
        if not self._closing:
            self._closing = True
            self.inbox.put_nowait(b"")
            asyncio.get_running_loop().call_soon(self.server.connection_lost, None)

    abort = close

    def is_closing(self) -> bool:
        return self._closing

    def get_write_buffer_size(self) -> int:
        return 0

    def _nothing(self, *_: Any, **__: Any) -> None:
        """What is waiting lies in the same memory on either side."""

    set_write_buffer_limits = pause_reading = resume_reading = _nothing


class _Client(TwinClient):
    """A blocking client that lets virtual time pass while it waits."""

    def __init__(self, twin: InProcessTwin, name: str) -> None:
        self._twin = twin
        super().__init__(transport=twin.transport(), name=name)

    def _wait(self, work: Coroutine[Any, Any, T]) -> T:
        return self._twin.run(work)


class InProcessTwin:
    """A twin server and its event loop; made by `twin`.

    Attributes:
        client: a connected `TwinClient`.
        loop: of virtual time, for what is asynchronous: `RunEngine({}, loop=twin.loop)`.
        server: the twin server's parts, to look inside.
        machine: the scanner.
        data: the folder in which data sets appear.
    """

    client: TwinClient

    def __init__(self, loop: SimulatedLoop, server: TwinServer) -> None:
        self.loop, self.server = loop, server
        self.machine, self.data = server.machine, server.root
        self._shell = TcpServer(
            lambda peer: TwinSession(server, peer), ConnectionLimits(), None, METHODS
        )

    @property
    def time(self) -> float:
        """The twin's clock [s]."""
        return self.server.clock.now()

    def advance(self, seconds: float) -> None:
        """Let virtual seconds of the laboratory pass, and whatever happens in them happen."""
        self.run(asyncio.sleep(seconds))

    def connect(self, name: str = "flexdt.testing") -> TwinClient:
        """Another client: a second controller, or somebody who watches."""
        return _Client(self, name)

    def transport(self) -> InProcessTransport:
        """A connection of its own, for `AsyncTwinClient` and for Bluesky's `TwinLab`."""
        return InProcessTransport(self.loop, self._shell.connection)

    def run(self, work: Coroutine[Any, Any, T]) -> T:
        """The result of a coroutine on the twin's loop; time passes until it is there.

        Raises:
            Deadlock: nothing is left that could end the wait.
            RuntimeError: called in that loop, where it would wait for itself.
        """
        if not self.loop.is_running():
            return self.loop.run_until_complete(work)
        if asyncio._get_running_loop() is self.loop:
            work.close()
            raise RuntimeError("a blocking call in the twin's own event loop: await it instead")
        return asyncio.run_coroutine_threadsafe(work, self.loop).result()

    async def close(self) -> None:
        """End the server, its connections and whatever else runs in the loop."""
        await self._shell.close()
        await self.server.stop()
        left = asyncio.all_tasks() - {asyncio.current_task()}
        for task in left:
            task.cancel()
        await asyncio.gather(*left, return_exceptions=True)


@contextmanager
def twin(
    *,
    machine: Machine | str | PathLike[str] | None = None,
    profile: Profile | str | PathLike[str] | None = None,
    sample: str = "",
    truth: Mapping[str, float] | None = None,
    physics: Literal["ideal", "mono", "poly"] = "ideal",
    speed_up: float | Literal["max"] = 1.0,
    seed: int | None = 0,
    data: str | PathLike[str] | None = None,
) -> Iterator[InProcessTwin]:
    """A twin in this process, for tests; it ends with the `with` block.

    Motion takes the machine's true time, by its speeds and accelerations, on a virtual clock that
    passes while a call waits (`move(..., wait=True)`, `wait_job`) or in `advance`, and at no other
    time. Nothing sleeps, and the same calls give the same answers.

    Args:
        machine: the scanner, its shipped name or file; None for the FleX-ray.
        profile: its zero offsets, their shipped name or file; None for the machine's default.
        sample: on the stage at start, a phantom's name; none unless given.
        truth: hidden misalignment, parameter -> value [mm, deg], as a truth file has it.
        physics: how images are made: ideal, mono or poly.
        speed_up: the twin's seconds for each of the loop; "max" ends each motion at once.
        seed: of a scan's noise; None for images without noise.
        data: folder for all that the twin writes; None for a temporary one.

    Raises:
        MachineFileError, UnknownNameError: there is no such machine, profile or sample.

    Example:
        >>> with twin() as scanner:
        ...     move = scanner.client.move({"rot_obj": 90.0})
        ...     scanner.advance(move.duration_s / 2)
        ...     half = scanner.client.state().axes["rot_obj"]
        >>> half.position, half.moving
        (45.0, True)
    """
    chosen = machine if isinstance(machine, Machine) else find_machine(machine)
    zero = find_profile(profile, chosen)
    hidden = None if truth is None else TrueGeometry(Offsets.from_edge(dict(truth)))
    made = tempfile.TemporaryDirectory(prefix="flexdt-") if data is None else nullcontext(data)
    loop = SimulatedLoop()
    with made as folder:
        try:
            server = TwinServer(
                chosen, zero, DirectProjector(), open_data(Path(fspath(folder))), truth=hidden,
                speed_up=speed_up, seed=lambda: seed, physics=physics, wall=loop.time,
            )  # fmt: skip
            server.submissions.checks = Checks(apart=False)
            found = InProcessTwin(loop, server)
            found.run(server.start(Sample(sample)))
            try:
                found.client = found.connect()
                yield found
            finally:
                found.run(found.close())
        finally:
            loop.end()
