"""A reverse proxy as hubs run it: another address, below a path, with or without rewriting."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Iterator
from concurrent.futures import Future


async def _pump(source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
    with contextlib.suppress(OSError):
        while data := await source.read(1 << 16):
            sink.write(data)
            await sink.drain()
    sink.close()


@contextlib.contextmanager
def proxied(
    port: int, prefix: str, *, host_kept: bool = True, stripped: bool = True
) -> Iterator[tuple[int, list[str]]]:
    """Serve what a port serves below a path of another port.

    Args:
        port: of the server behind it.
        prefix: begins and ends with a slash; what is not below it is answered with 404.
        host_kept: the server sees the browser's Host, else its own address.
        stripped: the server sees paths without the prefix.

    Yields:
        Port of the proxy, and the requests that were not below the path.
    """
    astray: list[str] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError, asyncio.IncompleteReadError):
            head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1")
            method, path, rest = head.split(" ", 2)
            if not path.startswith(prefix):
                astray.append(path)
                writer.write(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n")
                writer.close()
                return
            path = "/" + path.removeprefix(prefix) if stripped else path
            lines = f"{method} {path} {rest}".split("\r\n")
            if not host_kept:
                own = f"Host: 127.0.0.1:{port}"
                lines = [own if x.lower().startswith("host:") else x for x in lines]
            source, sink = await asyncio.open_connection("127.0.0.1", port)
            sink.write("\r\n".join(lines).encode("latin-1"))
            await asyncio.gather(_pump(reader, sink), _pump(source, writer))

    async def run(listens: Future[int], ended: asyncio.Event) -> None:
        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        listens.set_result(server.sockets[0].getsockname()[1])
        await ended.wait()
        server.close()

    listens: Future[int] = Future()
    loop = asyncio.new_event_loop()
    ended = asyncio.Event()
    # In a thread of its own: playwright keeps a loop running in the caller's.
    thread = threading.Thread(target=loop.run_until_complete, args=(run(listens, ended),))
    thread.start()
    try:
        yield listens.result(60.0), astray
    finally:
        loop.call_soon_threadsafe(ended.set)
        thread.join()
        for task in asyncio.all_tasks(loop):
            task.cancel()
        loop.close()
