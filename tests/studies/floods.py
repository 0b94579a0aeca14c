"""Floods on the viewer and the gateway, and what an honest page and program notice of them.

    python tests/studies/floods.py [--seconds 8] [NAME...]

Starts the servers, lets attackers loose one kind at a time, and prints for each the round trips of
an honest `state.get` (of a page) or `status_time_get` (of a program) and the memory of the process
before and after. Exit code 1 when a process has ended, or an answer was an internal error.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import itertools
import json
import multiprocessing
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

import msgpack
import viser
import zmq
import zmq.asyncio
from websockets.asyncio.client import ClientConnection, connect
from websockets.typing import Subprotocol

from flexdt.clients.launch.processes import Servers

CAMERA: dict[str, Any] = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [3, 3, 3], "fov": 1.0,
    "near": 0.01, "far": 1000, "image_height": 400, "image_width": 600, "look_at": [0, 0, 0],
    "up_direction": [0, 0, 1],
}  # fmt: skip
HANDLE = {"name": "/gizmos/object", "owner": ""}
GAP_S = 0.1
STARTS_S = 1.5
PROCESSES = multiprocessing.get_context("spawn")
numbers = itertools.count(1)


class Ports:
    """Where the servers listen, and their processes."""

    def __init__(self, servers: Servers) -> None:
        ready: Any = servers.ready
        self.viewer = int(ready["viewer"]["port"])
        self.out, self.into = int(ready["gateway"]["port"]), int(ready["gateway"]["inbound"])
        self._up = servers.pid
        self.pids = self.children()

    def children(self) -> dict[str, int]:
        """Module -> process id of each server."""
        found = {}
        for pid in Path(f"/proc/{self._up}/task/{self._up}/children").read_text().split():
            words = Path(f"/proc/{pid}/cmdline").read_text().split("\0")
            found[words[words.index("-m") + 2]] = int(pid)
        return found

    def megabytes(self, module: str) -> float:
        """Resident memory of a server."""
        text = Path(f"/proc/{self.pids[module]}/status").read_text()
        return float(text.split("VmRSS:")[1].split()[0]) / 1e3

    def page(self, number: int) -> connect:
        """A page's connection."""
        url = f"ws://127.0.0.1:{self.viewer}/ws/{number:012x}"
        return connect(url, max_size=None, proxy=None, compression=None)

    def view(self, number: int) -> connect:
        """A frame of viser in a page."""
        url = f"ws://127.0.0.1:{self.viewer}/scene/{number:012x}/iso"
        spoken = [Subprotocol(f"viser-v{viser.__version__}")]
        return connect(url, max_size=None, proxy=None, compression=None, subprotocols=spoken)


async def deaf(connection: ClientConnection) -> None:
    """Take everything and look at nothing."""
    async for _ in connection:
        pass


async def say_for_ever(connection: Any, what: Callable[[int], bytes | str]) -> None:
    """As fast as the other end takes it."""
    async with connection as open_one:
        hearing = asyncio.create_task(deaf(open_one))
        try:
            for i in itertools.count():
                await open_one.send(what(i))
        finally:
            hearing.cancel()


async def half_open(ports: Ports) -> None:
    """Thousands of connections that say nothing."""
    held = []
    for port in (ports.viewer, ports.out, ports.into):
        for _ in range(1000):
            held.append(await asyncio.open_connection("127.0.0.1", port))
    await asyncio.sleep(60)


async def endless_messages(ports: Ports) -> None:
    """Sixty pages, each with a message that does not end."""

    async def pieces() -> AsyncIterator[str]:
        while True:
            yield "x" * (1 << 20)

    async def one(number: int) -> None:
        async with ports.page(number) as page:
            await page.send(pieces())

    while True:
        await asyncio.gather(*(one(i) for i in range(60)), return_exceptions=True)


async def requests(ports: Ports) -> None:
    """Four pages that ask as fast as they can."""
    said = json.dumps({"id": 1, "method": "state.get", "params": {}})
    await asyncio.gather(*(say_for_ever(ports.page(i), lambda _: said) for i in range(4)))


async def cameras(ports: Ports) -> None:
    """Four views that tell where they look as fast as they can."""
    said = msgpack.packb(CAMERA)
    await asyncio.gather(*(say_for_ever(ports.view(i), lambda _: said) for i in range(4)))


async def drags(ports: Ports) -> None:
    """Somebody drags the sample to and fro without an end."""

    def what(i: int) -> bytes:
        kinds = ("DragStart", "Update", "Update", "DragEnd")
        said: dict[str, Any] = {"type": f"TransformControls{kinds[i % 4]}Message", **HANDLE}
        if "Update" in said["type"]:
            said |= {"wxyz": [1, 0, 0, 0], "position": [0.1 * (i % 7), 0.3, 0.1]}
        return bytes(msgpack.packb(CAMERA if i == 0 else said))

    async with ports.page(7) as page:
        await asyncio.gather(deaf(page), say_for_ever(ports.view(7), what))


async def rubbish(ports: Ports) -> None:
    """Bytes that are nothing, at a page, a view and the gateway."""

    async def events() -> None:
        async with program(ports) as (_, say):
            for i in itertools.count():
                await say.send(b"\xff" * 100)
                if i % 100 == 0:
                    await asyncio.sleep(0.01)

    views = (say_for_ever(ports.view(i), lambda i: b"\xc1" * (i % 999)) for i in range(2))
    pages = (say_for_ever(ports.page(i), lambda i: "[" * (i % 9999)) for i in range(2))
    await asyncio.gather(events(), *views, *pages)


async def commands(ports: Ports) -> None:
    """Questions, stops and components that nobody has, at the gateway."""
    kinds = [("scanner", "status_time_get"), ("mag_obj", "stop"), ("heater", "x" * 900)]
    async with program(ports) as (_, say):
        for i in itertools.count(10**9):
            component, command = kinds[i % 3]
            await say.send(
                json.dumps({"component": component, "command": command, "UUID": i}).encode()
            )
            if i % 100 == 0:
                await asyncio.sleep(0.01)


FLOODS: dict[str, tuple[str, Callable[[Ports], Awaitable[None]]]] = {
    "half_open": ("flexdt.clients.viewer.main", half_open),
    "endless_messages": ("flexdt.clients.viewer.main", endless_messages),
    "requests": ("flexdt.clients.viewer.main", requests),
    "cameras": ("flexdt.clients.viewer.main", cameras),
    "drags": ("flexdt.clients.viewer.main", drags),
    "rubbish": ("flexdt.clients.viewer.main", rubbish),
    "commands": ("flexdt.clients.gateway.main", commands),
}


@contextlib.asynccontextmanager
async def program(ports: Ports) -> AsyncIterator[tuple[Any, Any]]:
    """A program's two sockets."""
    context = zmq.asyncio.Context()
    hear, say = context.socket(zmq.SUB), context.socket(zmq.PUB)
    hear.subscribe(b"")
    hear.connect(f"tcp://127.0.0.1:{ports.out}")
    say.connect(f"tcp://127.0.0.1:{ports.into}")
    try:
        yield hear, say
    finally:
        context.destroy(linger=0)


MOST_WAITS = 30


class Honest:
    """Asks ten times a second, and keeps how long each answer took [s]."""

    def __init__(self) -> None:
        self.times: list[float] = []
        self.internal = 0

    async def page(self, ports: Ports) -> None:
        """Through a page."""
        async with ports.page(0xABC) as page:
            while True:
                id, begun = next(numbers), time.monotonic()
                await page.send(json.dumps({"id": id, "method": "state.get", "params": {}}))
                async for message in page:
                    if isinstance(message, str) and f'"id": {id},' in message[:60]:
                        break
                self._note(begun, "internal error" in str(message)[:200])
                await asyncio.sleep(GAP_S)

    async def program(self, ports: Ports) -> None:
        """Through the gateway; what never arrived is asked again after a second."""
        async with program(ports) as (hear, say):
            while True:
                id, begun = next(numbers), time.monotonic()
                event = {"component": "scanner", "command": "status_time_get", "UUID": id}
                await say.send(json.dumps(event).encode())
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(1.0):
                        heard: dict[str, Any] = {}
                        while heard.get("UUID") != id or heard["reply type"] not in ("ACK", "ERR"):
                            heard = json.loads(await hear.recv())
                        self._note(begun, "internal error" in heard["reply"])
                await asyncio.sleep(GAP_S)

    def _note(self, begun: float, internal: bool) -> None:
        self.times.append(time.monotonic() - begun)
        self.internal += internal


def attack(ports: Ports, name: str) -> None:
    """In a process of its own, so that what it costs there is nobody's."""
    with contextlib.suppress(OSError):
        asyncio.run(FLOODS[name][1](ports))  # type: ignore[arg-type]


async def trial(ports: Ports, name: str, seconds: float) -> bool:
    """One flood; prints what came of it, and whether all went well."""
    module, _ = FLOODS[name]
    honest = Honest()
    asks = honest.program if module == "flexdt.clients.gateway.main" else honest.page
    asking = asyncio.create_task(asks(ports))
    await asyncio.sleep(1.0)
    before = ports.megabytes(module)
    attacker = PROCESSES.Process(target=attack, args=(ports, name), daemon=True)
    attacker.start()
    await asyncio.sleep(STARTS_S)
    honest.times.clear()
    await asyncio.sleep(seconds)
    for _ in range(MOST_WAITS):
        if honest.times:
            break
        # A question to the gateway that was lost is asked again: a short flood may see no answer.
        await asyncio.sleep(1.0)
    alive, after = ports.children() == ports.pids, ports.megabytes(module)
    ended = asking.done()
    attacker.kill()
    attacker.join()
    asking.cancel()
    await asyncio.gather(asking, return_exceptions=True)
    times = sorted(honest.times) or [float("nan")]
    print(f"{name:18} {len(times):4} answers, median {times[len(times) // 2] * 1e3:6.0f} ms, worst "
          f"{times[-1] * 1e3:6.0f} ms; {before:.0f} -> {after:.0f} MB; internal errors: "
          f"{honest.internal}; processes ended: {0 if alive else 'some'}", flush=True)  # fmt: skip
    return alive and not ended and honest.internal == 0 and bool(honest.times)


def main() -> int:
    """Run the floods; returns the exit code."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(FLOODS)}")
    options.add_argument("--seconds", type=float, default=8.0, help="of each flood")
    chosen = options.parse_args()
    with tempfile.TemporaryDirectory(prefix="flexdt-floods-") as folder:
        log = Path(folder) / "log"
        given = {"data": Path(folder) / "data", "speed-up": 8, "gateway-port": 0}
        with Servers(given, log, viewer=True) as servers:
            ports = Ports(servers)

            async def all_of_them() -> list[bool]:
                return [await trial(ports, n, chosen.seconds) for n in chosen.names or FLOODS]

            sound = asyncio.run(all_of_them())
        print(f"{len(log.read_bytes().splitlines())} lines of log, {log.stat().st_size} bytes")
        traced = log.read_text().count('"traceback"')
    print(f"tracebacks: {traced}")
    return 0 if all(sound) and traced == 0 else 1


if __name__ == "__main__":
    sys.exit(main())
