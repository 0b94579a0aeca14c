"""A complete twin in the process and thread of its test: no socket, no server process, no
sleep.

The server, its connections and its clients are the real ones. They share one event loop, whose
time is virtual and passes only while a call waits, so the same calls give the same answers, at
once.

The event loop never sleeps, and the same seed gives the same run. When nothing is ready
the clock jumps to the next timer. Work for threads runs in the loop itself, at once, or a
moment drawn from a seed later, so that concurrent work comes in many orders. A wait that
nothing can end is an error (`Deadlock`) instead of a test that hangs; a loop that runs
for ever in a thread (Bluesky's engine does that) waits for the next request instead.
"""

from __future__ import annotations

import asyncio
import random
import selectors
import tempfile
import threading
from collections.abc import Awaitable, Callable, Coroutine, Generator, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, Literal, Protocol, TypeGuard, TypeVar

from flexdt.clients.client.client import TwinClient
from flexdt.clients.client.transport import ConnectionLost, Transport
from flexdt.library import machines
from flexdt.protocol import METHODS, Codec, Connection, Message
from flexdt.runtime.access import ConnectionLimits
from flexdt.runtime.files.directory import open_data
from flexdt.server.network.tcp import TcpServer
from flexdt.server.scans.checking import Checks
from flexdt.server.twin.application import TwinSession
from flexdt.server.twin.core import TwinServer
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.machine.description import Machine
from flexdt.twin.projection import Body, project_body
from flexdt.twin.projection.pixel_areas import (
    Need,
    Within,
    paths_within,
    rays_needed,
)
from flexdt.twin.scanner.state import Sample

THREAD_DELAYS_S = (0.0, 0.0, 0.0004, 0.002, 0.03)
"""How long a thread takes to begin, one of these [virtual s]."""


class Deadlock(Exception):
    """Somebody waits, and nothing is left that could happen."""


class SimulatedLoop(asyncio.SelectorEventLoop):
    """Event loop on virtual time.

    Args:
        rng: draws the delay of work for threads; None: at once.
        start: of its clock [s].
    """

    def __init__(self, rng: random.Random | None = None, start: float = 0.0) -> None:
        """Make a loop whose clock starts at `start` [s] and jumps.

        `rng` draws delays of thread work from `THREAD_DELAYS_S`; None: no delay.
        """
        self._now = start
        self._rng = rng
        self.alone = False
        """Whether it runs until one result is there, so that nobody else can end a wait."""
        super().__init__(_Jumps(self))

    def time(self) -> float:
        """Return the virtual time [s]."""
        return self._now

    def jump(self, seconds: float) -> None:
        """Let time pass."""
        self._now += seconds

    def run_until_complete(self, future: Generator[Any, None, T] | Awaitable[T]) -> T:
        """Run the loop until a future is done, and return its result.

        Raises Deadlock: no event is left.
        """
        self.alone = True
        try:
            return super().run_until_complete(future)
        finally:
            self.alone = False

    def call_exception_handler(self, context: dict[str, Any]) -> None:
        """Log what failed in a callback; raise what is no `Exception`.

        So a test ends at its time limit.
        """
        error = context.get("exception")
        if _ends_all(error):
            raise error
        super().call_exception_handler(context)

    def create_task(  # type: ignore[override]
        self, coro: Coroutine[Any, Any, T], **options: Any
    ) -> asyncio.Task[T]:
        """Make a task; what is no `Exception` ends the loop, not the task alone."""
        task = super().create_task(coro, **options)
        task.add_done_callback(_pass_on)
        return task

    def come_to_rest(self) -> None:
        """Stop the loop if another thread runs it, and wait for that thread's end.

        If no thread runs it, nothing happens. Not to be called by that thread.
        """
        for thread in threading.enumerate():
            if thread.ident == self._thread_id:  # type: ignore[attr-defined]
                self.call_soon_threadsafe(self.stop)
                thread.join()

    def run_in_executor(  # type: ignore[override]
        self, executor: Any, func: Callable[..., Any], *args: Any
    ) -> asyncio.Future[Any]:
        """Run `func` in the loop's thread, soon; `executor` is ignored.

        With a random generator after one of `THREAD_DELAYS_S` [virtual s].
        """
        done: asyncio.Future[Any] = self.create_future()
        later = 0.0 if self._rng is None else self._rng.choice(THREAD_DELAYS_S)
        self.call_later(later, _work, done, func, args)
        return done


def _ends_all(error: BaseException | None) -> TypeGuard[BaseException]:
    """Return whether an error ends the program or the test, not what it came to."""
    return error is not None and not isinstance(error, Exception | asyncio.CancelledError)


def _pass_on(task: asyncio.Task[Any]) -> None:
    """Raise what ended a task if that ends all; others are left to who awaits the task."""
    # Its own field: to ask `exception` would count as having looked at every error.
    error = None if task.cancelled() else task._exception
    if _ends_all(error):
        raise error


def _work(
    done: asyncio.Future[Any], func: Callable[..., Any], args: tuple[Any, ...]
) -> None:
    """Run a function, even if its future was canceled, as a thread would, and complete
    the future.

    The future gets the result or the `Exception` raised, unless it was canceled. Other
    exceptions, such as KeyboardInterrupt, pass.
    """
    try:
        result = func(*args)
    except StopIteration as error:  # no future may have it
        if not done.cancelled():
            done.set_exception(RuntimeError(f"{func} raised {error!r}"))
    except Exception as error:
        if not done.cancelled():
            done.set_exception(error)
    else:
        if not done.cancelled():
            done.set_result(result)


def _waits(loop: asyncio.AbstractEventLoop) -> Iterator[str]:
    """Yield a line for each task of a loop that is not done: its name, and the chain of
    awaits, outermost first, that ends with what it waits for.
    """
    for task in asyncio.all_tasks(loop):
        places = []
        at: Any = task.get_coro()
        while frame := getattr(at, "cr_frame", None) or getattr(at, "gi_frame", None):
            code = frame.f_code
            place = f"{Path(code.co_filename).name}:{frame.f_lineno}"
            places.append(f"{code.co_qualname} ({place})")
            at = getattr(at, "cr_await", None) or getattr(at, "gi_yieldfrom", None)
        places.append(repr(task._fut_waiter))  # type: ignore[attr-defined]
        yield f"{task.get_name()}: {' > '.join(places)}"


class _Jumps(selectors.DefaultSelector):
    """Waits for no timer: time jumps instead."""

    def __init__(self, loop: SimulatedLoop) -> None:
        super().__init__()
        self._loop = loop

    def select(self, timeout: float | None = None) -> list[Any]:
        """Look for events without waiting; if there are none, let the clock jump by `timeout`.

        Without a time-out (None: no timer is set) it waits for real, unless the loop runs until
        one future is done (`run_until_complete`).

        Returns events as of the base class; [] after a jump.
        Raises Deadlock: no event, no timer, and the loop runs until one future is done.
        """
        if timeout is None and not self._loop.alone:
            return super().select()
        events = super().select(0.0)
        if not events and timeout is None:
            waiting = "".join(f"\n  {line}" for line in sorted(_waits(self._loop)))
            raise Deadlock(f"nothing is left that could happen; waiting:{waiting}")
        if not events and timeout is not None:
            self._loop.jump(timeout)
        return events


__all__ = ["Deadlock", "InProcessTwin", "twin"]

T = TypeVar("T")


class DirectProjector:
    """The projector's work without its server."""

    def __init__(self) -> None:
        """Begin without bodies."""
        self.known: dict[str, Body] = {}

    async def put(self, name: str, body: Body) -> None:
        """Name a body."""
        self.known[name] = body

    async def remove(self, name: str) -> None:
        """Forget a body."""
        del self.known[name]

    async def project(
        self, name: str, cone_vec: ConeVec, shape: tuple[int, int]
    ) -> Float32Array:
        """Compute line integrals, float32 (n, rows, cols)."""
        return project_body(self.known[name], cone_vec, shape)

    async def rays_needed(
        self,
        name: str,
        cone_vec: ConeVec,
        shape: tuple[int, int],
        need: tuple[Need, float],
    ) -> Within:
        """Find the pixels that need several rays."""
        return Within.of(rays_needed(self.known[name], cone_vec, shape, *need))

    async def paths_within(
        self, name: str, cone_vec: ConeVec, shape: tuple[int, int], within: Within
    ) -> Float32Array:
        """Compute integrals along rays of some pixels, float32 (rays,)."""
        return paths_within(self.known[name], cone_vec, shape, within)


class _Receiver(Protocol):
    """A server's end of one connection."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None: ...

    def connection_lost(self, exc: Exception | None) -> None: ...

    def data_received(self, data: bytes) -> None: ...


class InProcessTransport(asyncio.Transport):
    """A client's transport to a server of the same event loop; to the server it is asyncio's.

    Args:
        loop: of both.
        serve: makes the server's end of a connection.
    """

    place = "this process"

    def __init__(
        self, loop: asyncio.AbstractEventLoop, serve: Callable[[], _Receiver]
    ) -> None:
        """Make an unconnected transport; `serve` makes the server's side of each
        connection.
        """
        super().__init__({"peername": ("in-process", 0)})
        self._loop = loop
        self._serve = serve
        self._server: _Receiver | None = None

    async def open(self) -> None:
        """Connect, after closing an earlier connection.

        The connection starts with MessagePack and an empty inbox; nothing is waited for
        from the server.

        Raises:
            RuntimeError: called in another event loop.
        """
        if asyncio.get_running_loop() is not self._loop:
            say = "a twin in process answers on its own event loop: RunEngine({}, loop=twin.loop)"
            raise RuntimeError(f"{say}, or twin.run(...)")
        self.close()
        await asyncio.sleep(0.0)  # the end of an earlier connection comes first
        self._wire = Connection(Codec.MSGPACK)
        self._inbox = asyncio.Queue[bytes]()
        self._server = self._serve()
        self._server.connection_made(self)

    async def send(self, message: Message) -> None:
        """Hand one message to the server; raise ConnectionLost after the connection's
        end.
        """
        if self._server is None:
            raise ConnectionLost("the twin has ended the connection")
        self._server.data_received(self._wire.send(message))

    async def receive(self) -> list[Message]:
        """Wait for data and return the messages that it completes, at least one; [] once
        the connection has ended.

        Data that complete no message are kept, and the wait goes on."""
        messages: list[Message] = []
        while not messages and (data := await self._inbox.get()):
            messages = self._wire.receive_data(data)
        return messages

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Hand bytes to the client; dropped after the connection's end."""
        if self._server is not None:
            self._inbox.put_nowait(bytes(data))

    def close(self) -> None:
        """End the connection, from either side, once.

        A waiting `receive` returns []; the server learns of it in the next turn.
        """
        server, self._server = self._server, None
        if server is not None:
            self._inbox.put_nowait(b"")
            self._loop.call_soon(server.connection_lost, None)

    def is_closing(self) -> bool:
        """Return whether it ended."""
        return self._server is None

    def get_write_buffer_size(self, *_: Any, **__: Any) -> int:
        """Return 0: written bytes are in the client's memory at once."""
        return 0

    abort = close
    pause_reading = resume_reading = set_write_buffer_limits = get_write_buffer_size  # type: ignore[assignment]


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
        loop: of virtual time, for asynchronous programs: `RunEngine({}, loop=twin.loop)`.
        server: the twin server's parts, to look inside.
        data: the folder in which data sets appear.
    """

    client: TwinClient

    def __init__(self, loop: SimulatedLoop, server: TwinServer) -> None:
        """Take a loop and a server, neither started; `client` is set by `twin`."""
        self.loop = loop
        self.server = server
        self.data = server.root
        self._shell = TcpServer(
            partial(TwinSession, server), ConnectionLimits(), None, METHODS
        )

    def advance(self, seconds: float) -> None:
        """Let virtual seconds of the laboratory pass, with all that happens in them."""
        self.run(asyncio.sleep(seconds))

    def connect(self, name: str = "flexdt.testing") -> TwinClient:
        """Connect another client: a second controller, or an observer."""
        return _Client(self, name)

    def transport(self) -> Transport:
        """Make a connection for `AsyncTwinClient` and `TwinLab`."""
        return InProcessTransport(self.loop, self._shell.connection)

    def run(self, work: Coroutine[Any, Any, T]) -> T:
        """Run a coroutine on the twin's loop in virtual time, and return its result.

        From another thread, it waits for it there.

        Raises:
            Deadlock: no event is left that could end the wait.
            RuntimeError: called in an event loop, where it would wait for itself.
        """
        here = asyncio._get_running_loop()
        if self.loop.is_running() and here is not self.loop:
            return asyncio.run_coroutine_threadsafe(work, self.loop).result()
        if here is not None:
            work.close()
            raise RuntimeError(
                "a blocking call in an event loop: await it, or use LocalTwin"
            )
        return self.loop.run_until_complete(work)

    async def close(self) -> None:
        """End the server and its connections."""
        await self._shell.close()
        await self.server.stop()


@contextmanager
def twin(
    *,
    machine: Machine | str | PathLike[str] | None = None,
    sample: str = "",
    physics: Literal["ideal", "mono", "poly"] = "ideal",
    speed_up: float | Literal["max"] = 1.0,
    seed: int | None = 0,
    data: str | PathLike[str] | None = None,
) -> Iterator[InProcessTwin]:
    """Start a twin in this process, for tests, with a connected client; both end with the
    `with` block.

    Motion takes the machine's true time, by its speeds and accelerations, on a virtual
    clock that passes while a call waits (`move(..., wait=True)`, `wait_job`) or in
    `advance`, and at no other time. Nothing sleeps. Meshes and scenes that are sent, the
    calls about data sets, `fit_calibration`, `align_dataset` and `predict_exposure` are
    worked on in a process with limits, as always.

    Args:
        machine: the scanner, its shipped name or file; None for the FleX-ray. Its zero
            offsets are those of its default profile.
        sample: on the stage at start, a phantom's name; empty for no sample.
        physics: how images are made: ideal, mono or poly.
        speed_up: the twin's seconds for each of the loop; "max" ends each motion at once.
        seed: of a scan's noise; None for images without noise.
        data: folder for the twin's files; None for a temporary one.

    Raises:
        MachineFileError, UnknownNameError: unknown machine or sample.

    Example:
        >>> with twin() as scanner:
        ...     move = scanner.client.move({"rot_obj": 90.0})
        ...     scanner.advance(move.duration_s / 2)
        ...     half = scanner.client.state().axes["rot_obj"]
        >>> round(half.position, 6), half.moving
        (45.0, True)
    """
    chosen = machine if isinstance(machine, Machine) else machines.machine(machine)
    folder = tempfile.TemporaryDirectory() if data is None else nullcontext(data)
    loop = SimulatedLoop()
    with folder as root, asyncio.Runner(loop_factory=lambda: loop):
        server = TwinServer(
            chosen,
            machines.profile(None, chosen),
            DirectProjector(),
            open_data(Path(root)),
            speed_up=speed_up,
            seed=lambda: seed,
            physics=physics,
            wall=loop.time,
        )
        server.submissions.checks = Checks(apart=False)
        scanner = InProcessTwin(loop, server)
        scanner.run(server.start(Sample(sample)))
        try:
            scanner.client = scanner.connect()
            yield scanner
        finally:
            scanner.run(scanner.close())
            loop.come_to_rest()
