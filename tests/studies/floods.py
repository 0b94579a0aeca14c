"""Floods on the viewer and the gateway, and what an honest page and program notice of them.

    python tests/studies/floods.py [--seconds 8] [NAME...]
    python tests/studies/floods.py --connections 1000 [--real-time]

The second one is about a twin with a token. A peer without the token makes 10 000 connections a
minute (`strangers.py`), while so many new clients with the token connect, say hello, ping and
send an E-stop, every other one from the address of the peer. It prints the times from before
connecting to the answers (without the flood, beside it, and with all places taken) and the
bytes of log, apart from the lines about those E-stops. `--real-time` is for machines that are
busy with other things. Exit code 1 when a client had no answer, or an hour would log more than
1 MB; times are not judged.

Starts the servers, lets attackers loose one kind at a time, and prints for each the round trips
of an honest `state.get` (of a page) or `status_time_get` (of a program) and the memory of the
process before and after. Exit code 1 when a process has ended, or an answer was an internal
error.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import itertools
import json
import multiprocessing
import os
import random
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
from latency import Stalls
from websockets.asyncio.client import ClientConnection, connect
from websockets.typing import Subprotocol

from flexdt.clients.launch.processes import Servers

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from lab import machine, percentile, twin
from strangers import draw, hello, play, request

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
        """Read the ports of running servers and the ids of their processes."""
        ready: Any = servers.ready
        self.viewer = int(ready["viewer"]["port"])
        self.out, self.into = (
            int(ready["gateway"]["port"]),
            int(ready["gateway"]["inbound"]),
        )
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
        return connect(
            url, max_size=None, proxy=None, compression=None, subprotocols=spoken
        )


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
        """The i-th message of somebody who drags the object; the first one tells of a
        camera.
        """
        kinds = ("DragStart", "Update", "Update", "DragEnd")
        said: dict[str, Any] = {
            "type": f"TransformControls{kinds[i % 4]}Message",
            **HANDLE,
        }
        if "Update" in said["type"]:
            said |= {"wxyz": [1, 0, 0, 0], "position": [0.1 * (i % 7), 0.3, 0.1]}
        return bytes(msgpack.packb(CAMERA if i == 0 else said))

    async with ports.page(7) as page:
        await asyncio.gather(deaf(page), say_for_ever(ports.view(7), what))


async def rubbish(ports: Ports) -> None:
    """Bytes that are nothing, at a page, a view and the gateway."""

    async def events() -> None:
        """Send bytes that are no message to the gateway, without an end."""
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
                json.dumps(
                    {"component": component, "command": command, "UUID": i}
                ).encode()
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
    """A program's two sockets at the gateway; they are closed at the end.

    Yields:
        The one that hears, and the one that says.
    """
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
                await page.send(
                    json.dumps({"id": id, "method": "state.get", "params": {}})
                )
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
                        while heard.get("UUID") != id or heard["reply type"] not in (
                            "ACK",
                            "ERR",
                        ):
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
    """Flood a server for some seconds while somebody honest asks, and print what came of
    it.

    Args:
        ports: of the servers.
        name: one of FLOODS.
        seconds: how long, after it has begun.

    Returns:
        Whether the servers live, no error was internal, and answers came.
    """
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
        # A question to the gateway that was lost is asked again: a short flood may see no
        # answer.
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


TOKEN = "sixteen letters or more"
A_MINUTE = 10_000
CLIENTS_S = 16.0
"""New clients a second."""
PEER, OTHER = "127.0.0.2", "127.0.0.3"
PLACES = 64
PATIENCE_S = 10.0
SETTLED_S = 5.0
"""After this the flood has as many connections as it gets, and the log has had its first
lines."""


def strangers(port: int, seed: int, made: Any, alone: bool) -> None:
    """In a process of its own: open connections at an even rate until it is killed.

    Args:
        port: of the twin.
        seed: of what they say.
        made: shared number; counts them.
        alone: the machine is; then the process becomes real-time.
    """
    if alone:
        real_time(0)  # else a busy machine makes the flood a small one

    async def work() -> None:
        """Open A_MINUTE drawn connections a minute, without an end, and count them."""
        rng, open_ = random.Random(seed), set[asyncio.Task[bytes]]()
        begun = time.monotonic()
        for i in itertools.count(1):
            task = asyncio.create_task(play(draw(rng), "127.0.0.1", port, PEER))
            open_.add(task)
            task.add_done_callback(open_.discard)
            made.value = i
            await asyncio.sleep(max(0.0, begun + 60.0 / A_MINUTE * i - time.monotonic()))

    asyncio.run(work())


async def client(port: int, source: str) -> dict[str, float]:
    """Connect with the token from an address; hello, ping and E-stop one after the other.

    Returns:
        Answer -> time from before it connected [ms]; those are missing that did not come
        in PATIENCE_S or were errors.
    """
    begun, times = time.perf_counter(), dict[str, float]()
    with contextlib.suppress(OSError, TimeoutError):
        async with asyncio.timeout(PATIENCE_S):
            reader, writer = await asyncio.open_connection(
                "127.0.0.1", port, local_addr=(source, 0)
            )
            try:
                said = (hello(TOKEN), request("session.ping"), request("safety.estop"))
                for name, line in zip(("hello", "ping", "E-stop"), said, strict=True):
                    writer.write(line)
                    if "result" not in json.loads(await reader.readline() or b"{}"):
                        break
                    times[name] = 1000 * (time.perf_counter() - begun)
            finally:
                writer.transport.abort()
    return times


async def newcomers(port: int, count: int) -> dict[str, list[dict[str, float]]]:
    """Clients that come one after the other; by their address."""
    tasks: dict[str, list[asyncio.Task[dict[str, float]]]] = {OTHER: [], PEER: []}
    begun = time.monotonic()
    for i in range(count):
        source = (OTHER, PEER)[i % 2]
        tasks[source].append(asyncio.create_task(client(port, source)))
        await asyncio.sleep(max(0.0, begun + (i + 1) / CLIENTS_S - time.monotonic()))
    return {source: await asyncio.gather(*each) for source, each in tasks.items()}


async def holders(port: int) -> list[asyncio.StreamWriter]:
    """Clients that hold all places: each has asked for something ordinary."""
    held = []
    for _ in range(PLACES):
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(hello(TOKEN) + request("rpc.discover"))
        await reader.readline()
        held.append(writer)
    return held


def real_time(pid: int) -> None:
    """Have a process (0: this one) run before others, where the system grants it."""
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(pid, os.SCHED_RR, os.sched_param(1))


async def part(count: int, folder: Path, *, flood: bool, full: bool, alone: bool) -> bool:
    """Let new clients come to one twin, print their times, and end it.

    Args:
        count: of clients.
        folder: an empty one.
        flood: with strangers beside.
        full: all places are taken.
        alone: the machine is; then processes become real-time.

    Returns:
        Whether all was well.
    """
    secret = folder / "token"
    secret.write_text(TOKEN)
    limit = f"max_clients={PLACES}"
    server = twin(
        9, folder / "data", "--token-file", secret, "--limit", limit, log=folder / "log"
    )
    made = PROCESSES.Value("l", 0)
    attacker = PROCESSES.Process(
        target=strangers, args=(server.port, 1, made, alone), daemon=True
    )
    try:
        held = await holders(server.port) if full else []
        await newcomers(server.port, 8)  # what the first answers need is loaded now
        sizes = [logged(folder / "log")]
        if flood:
            attacker.start()
        await asyncio.sleep(SETTLED_S)
        sizes.append(logged(folder / "log"))
        if alone:
            real_time(server.pid)
            real_time(0)
        begun, work, before = time.monotonic(), server.processor_s(), made.value
        got = await newcomers(server.port, count)
        lasted = time.monotonic() - begun
        sizes.append(logged(folder / "log"))
        rate = (made.value - before) * 60.0 / lasted
        share = (server.processor_s() - work) / lasted
        for writer in held:
            writer.close()
    finally:
        if attacker.pid is not None:
            attacker.kill()
            attacker.join()
        server.end()
    hour = sizes[1] - sizes[0] + (sizes[2] - sizes[1]) * 3600.0 / lasted
    sound = hour < 1e6
    for source, each in got.items():
        where = "the peer's address" if source == PEER else "another address"
        for name in ("ping", "E-stop"):
            ms = [times[name] for times in each if name in times]
            sound = sound and len(ms) == len(each)
            shown = [percentile(ms, q) for q in (0.5, 0.99, 0.999, 1.0)] if ms else []
            late = sum(t > 100.0 for t in ms) + len(each) - len(ms)
            times_ms = " | ".join(f"{t:.1f}" for t in shown)
            print(f"| {rate:.0f} | {'taken' if full else 'free'} | {where} | "
                  f"{name} | {len(ms)} of {len(each)} | {late} | {times_ms} | {share:.0%} | "
                  f"{hour / 1e3:.0f} kB |", flush=True)  # fmt: skip
    return sound


def logged(log: Path) -> int:
    """Bytes of log but for the lines that the new clients' own E-stops write."""
    return sum(
        len(line) for line in log.read_bytes().splitlines() if b"E-stop by" not in line
    )


async def connections(count: int, *, alone: bool) -> bool:
    """Let new clients come without the flood, beside it, and beside it with all places
    taken.

    A table is printed.

    Returns:
        Whether all was well.
    """
    sound, stalls = True, Stalls()
    print("| connections a minute | places | clients from | | answered | beyond 100 ms | p50 | "
          "p99 | p99.9 | worst | processor | log in an hour |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    for flood, full in ((False, False), (True, False), (True, True)):
        with tempfile.TemporaryDirectory(prefix="flexdt-floods-") as folder:
            well = await part(count, Path(folder), flood=flood, full=full, alone=alone)
            sound = sound and well
    print(
        f"times in ms; the machine stood still for {stalls.take():.0f} ms at most. {machine()}."
    )
    return sound


def main() -> int:
    """Run the floods; returns the exit code."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument(
        "names", nargs="*", metavar="NAME", help=f"of {', '.join(FLOODS)}"
    )
    options.add_argument("--seconds", type=float, default=8.0, help="of each flood")
    options.add_argument("--connections", type=int, metavar="CLIENTS", help="see above")
    options.add_argument(
        "--real-time",
        action="store_true",
        help="give the flood, the clients and the twin's loop priority",
    )
    chosen = options.parse_args()
    if chosen.connections:
        return (
            0
            if asyncio.run(connections(chosen.connections, alone=chosen.real_time))
            else 1
        )
    with tempfile.TemporaryDirectory(prefix="flexdt-floods-") as folder:
        log = Path(folder) / "log"
        given = {"data": Path(folder) / "data", "speed-up": 8, "gateway-port": 0}
        with Servers(given, log, viewer=True) as servers:
            ports = Ports(servers)

            async def all_of_them() -> list[bool]:
                return [
                    await trial(ports, n, chosen.seconds) for n in chosen.names or FLOODS
                ]

            sound = asyncio.run(all_of_them())
        print(
            f"{len(log.read_bytes().splitlines())} lines of log, {log.stat().st_size} bytes"
        )
        traced = log.read_text().count('"traceback"')
    print(f"tracebacks: {traced}")
    return 0 if all(sound) and traced == 0 else 1


if __name__ == "__main__":
    sys.exit(main())
