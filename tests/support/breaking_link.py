"""A link between a browser and a viewer that is slow, late, and lost whenever a test says so."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import dataclass, field

CHUNK = 4096


@dataclass
class Link:
    """What a test may do to it.

    Attributes:
        port: at which browsers connect.
        bytes_s: most bytes a second in each direction of all connections together; None:
            as many as there are.
        delay_s: of each byte.
    """

    port: int = 0
    bytes_s: float | None = None
    delay_s: float = 0.0
    _open: set[asyncio.StreamWriter] = field(default_factory=set)
    _loop: asyncio.AbstractEventLoop | None = None
    _busy: dict[bool, float] = field(default_factory=lambda: {True: 0.0, False: 0.0})

    def cut(self) -> None:
        """End all connections, without a word to either side."""
        assert self._loop is not None
        self._loop.call_soon_threadsafe(self._cut)

    def _cut(self) -> None:
        for writer in list(self._open):
            writer.transport.abort()

    async def pump(
        self, source: asyncio.StreamReader, sink: asyncio.StreamWriter, up: bool
    ) -> None:
        """Carry bytes on, each when its turn and its delay have come."""
        loop = asyncio.get_running_loop()
        queue: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(64)

        async def deliver() -> None:
            while True:
                due, data = await queue.get()
                await asyncio.sleep(max(0.0, due - loop.time()))
                if not data:
                    break
                sink.write(data)
                await sink.drain()

        delivery = asyncio.create_task(deliver())
        with contextlib.suppress(OSError):
            while data := await source.read(CHUNK):
                if self.bytes_s is not None:  # one line for all connections
                    begins = max(loop.time(), self._busy[up])
                    self._busy[up] = begins + len(data) / self.bytes_s
                    await asyncio.sleep(max(0.0, self._busy[up] - loop.time()))
                await queue.put((loop.time() + self.delay_s, data))
        await queue.put((0.0, b""))
        with contextlib.suppress(OSError):
            await delivery
        with contextlib.suppress(RuntimeError):  # the test is over
            sink.close()

    async def serve(
        self, port: int, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        """Carry one connection."""
        with contextlib.suppress(OSError):
            source, sink = await asyncio.open_connection("127.0.0.1", port)
            self._open |= {writer, sink}
            up, down = self.pump(reader, sink, True), self.pump(source, writer, False)
            await asyncio.gather(up, down, return_exceptions=True)
            self._open -= {writer, sink}


@contextlib.contextmanager
def linked(port: int) -> Iterator[Link]:
    """Serve what a port serves over a link."""
    link = Link()
    loop = asyncio.new_event_loop()
    ended = asyncio.Event()
    listens: Future[int] = Future()

    async def run() -> None:
        link._loop = loop
        server = await asyncio.start_server(
            lambda reader, writer: link.serve(port, reader, writer), "127.0.0.1", 0
        )
        listens.set_result(server.sockets[0].getsockname()[1])
        await ended.wait()
        server.close()
        link._cut()

    # In a thread of its own: playwright keeps a loop running in the caller's.
    thread = threading.Thread(target=loop.run_until_complete, args=(run(),))
    thread.start()
    try:
        link.port = listens.result(60.0)
        yield link
    finally:
        loop.call_soon_threadsafe(ended.set)
        thread.join()
        for task in asyncio.all_tasks(loop):
            task.cancel()
        loop.close()
