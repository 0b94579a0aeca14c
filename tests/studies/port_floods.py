"""A flood of connections without the token at each port, and what pages and programs notice of
it.

    python tests/studies/port_floods.py [--count 200] [--a-minute 10000] [--real-time] [PORT...]

Starts projector, twin, viewer and gateway with a token. A peer without it makes 10 000
connections a minute to one port after the other: silent ones, halves of requests, garbage,
whole requests that are refused; seven of ten it keeps. Beside it, every other one from the
peer's own address, pages are loaded (HTML, program, styles, the page's connection and its
session with the twin) and press E-STOP, the pages for monitoring are read, users of the
projector introduce themselves, and programs at the gateway connect and ask. Prints how many had
an answer, how many within a second, and the times from before connecting [ms]. Exit code 1
where one had no answer; times are not judged. `--real-time` is for machines that are busy with
other things.
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
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import zmq
import zmq.asyncio
from websockets.asyncio.client import connect

from flexdt.protocol import hello_params
from flexdt.server.projector.wire import ProjectorLink

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from lab import Process, machine, percentile, projector, twin
from strangers import Stranger, draw, play

TOKEN = "sixteen letters or more"
PEER, OTHER = "127.0.0.2", "127.0.0.1"
PROCESSES = multiprocessing.get_context("spawn")
PATIENCE_S = 20.0
SETTLED_S = 5.0
"""After this the flood has as many connections as it gets."""
GAP_S = 0.05
numbers = itertools.count(1)


@dataclass
class Bench:
    """The servers, and where their ports are.

    Attributes:
        ports: name -> port.
        cookie: of a browser that has shown the token.
    """

    ports: dict[str, int]
    cookie: str = ""
    processes: list[Process] = field(default_factory=list)


def started(folder: Path) -> Bench:
    """All servers, with a token."""
    secret = folder / "token"
    secret.write_text(TOKEN)
    shown = ("--token-file", secret, "--http-port", 0)
    rays = projector(*shown)
    server = twin(rays.port, folder / "data", *shown, "--projector-token-file", secret)
    where = f"127.0.0.1:{server.port}"
    page = Process("flexdt.clients.viewer.main", "--twin", where, "--port", 0, *shown)
    gate = Process("flexdt.clients.gateway.main", "--server", where, "--port", 0,
                   "--token-file", secret, "--data", folder / "saved")  # fmt: skip
    ports = {
        "twin": server.port, "projector": rays.port, "viewer": page.port,
        "gateway in": int(gate.ready["inbound"]), "gateway out": gate.port,
        "pages of the twin": int(server.ready["http_port"]),
        "pages of the projector": int(rays.ready["http_port"]),
        "pages of the viewer": int(page.ready["http_port"]),
    }  # fmt: skip
    return Bench(ports, processes=[gate, page, server, rays])


# -- the flood --------------------------------------------------------------------------------


def draw_http(rng: random.Random) -> Stranger:
    """A peer of an HTTP port."""
    host = b"Host: 127.0.0.1\r\n"
    upgrade = (
        b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    )
    kinds: dict[str, tuple[bytes, ...]] = {
        "half a line": (b"GET / HT",),
        "half a head": (b"GET / HTTP/1.1\r\n" + host, b"Accept: *"),
        "a page": (b"GET / HTTP/1.1\r\n" + host + b"\r\n",),
        "figures": (b"GET /metrics HTTP/1.1\r\n" + host + b"\r\n",),
        "a connection": (b"GET /ws/%012x HTTP/1.1\r\n" % rng.getrandbits(48) + host + upgrade
                         + b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n",),
        "a long line": (b"GET /" + b"x" * 100_000,),
    }  # fmt: skip
    kind = rng.choice(sorted(kinds))
    return Stranger(kind, kinds[kind], rng.random() < 0.7)


def real_time(pid: int) -> None:
    """Have the threads of a process run before others, where the system grants it."""
    for thread in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(OSError, AttributeError):
            os.sched_setscheduler(int(thread.name), os.SCHED_RR, os.sched_param(1))


def flood(port: int, a_minute: int, made: Any, alone: bool) -> None:
    """In a process of its own: open connections at an even rate until it is killed.

    Args:
        port: of the server.
        a_minute: how many.
        made: shared number; counts them.
        alone: the machine is; then the process becomes real-time.
    """
    if alone:
        real_time(os.getpid())  # else a busy machine makes the flood a small one

    async def work() -> None:
        """Open drawn connections at the rate asked, sockets and HTTP in turns, without an
        end.
        """
        rng, open_ = random.Random(port), set[asyncio.Task[bytes]]()
        begun = time.monotonic()
        for i in itertools.count(1):
            stranger = (draw, draw_http)[i % 2](rng)
            task = asyncio.create_task(play(stranger, "127.0.0.1", port, PEER))
            open_.add(task)
            task.add_done_callback(open_.discard)
            made.value = i
            await asyncio.sleep(max(0.0, begun + 60.0 / a_minute * i - time.monotonic()))

    asyncio.run(work())


# -- who is honest ----------------------------------------------------------------------------


async def fetched(port: int, path: str, source: str, *more: str) -> tuple[int, str]:
    """Get a path from an address of this machine, and read the answer to its end.

    Args:
        port, path: what.
        source: the client's address.
        more: header lines.

    Returns:
        Status and head of the answer.
    """
    reader, writer = await asyncio.open_connection(
        "127.0.0.1", port, local_addr=(source, 0)
    )
    try:
        head = "".join(f"{line}\r\n" for line in (f"Host: 127.0.0.1:{port}", *more))
        writer.write(f"GET {path} HTTP/1.1\r\n{head}\r\n".encode())
        answer = await reader.read()
    finally:
        writer.transport.abort()
    head, _, _ = answer.partition(b"\r\n\r\n")[0].decode().partition("\0")
    return int(head.split(" ")[1]), head


async def page(bench: Bench, source: str) -> dict[str, float]:
    """Load a page and press E-STOP; milliseconds of both, none of what failed."""
    port, begun = bench.ports["viewer"], time.perf_counter()
    for path in ("/", "/main.js", "/style.css"):
        status, _ = await fetched(port, path, source, f"Cookie: {bench.cookie}")
        if status not in (200, 404):  # whatever the files are called
            return {}
    url = f"ws://127.0.0.1:{port}/ws/{next(numbers):012x}"
    async with connect(url, max_size=None, proxy=None, local_addr=(source, 0),
                       additional_headers={"Cookie": bench.cookie}) as shown:  # fmt: skip
        await until(shown, '"type": "session", "connected": true')
        loaded, id = time.perf_counter(), next(numbers)
        await shown.send(json.dumps({"id": id, "method": "safety.estop", "params": {}}))
        answer = json.loads(await until(shown, f'"id": {id},'))
        ended = time.perf_counter()
    times = {"page is loaded": 1000 * (loaded - begun)}
    return times | (
        {"page's E-STOP": 1000 * (ended - loaded)} if "result" in answer else {}
    )


async def until(shown: Any, mark: str) -> str:
    """The next message that has the mark near its beginning."""
    async for message in shown:
        if isinstance(message, str) and mark in message[:60]:
            return message
    return "{}"


async def figures(bench: Bench, source: str) -> dict[str, float]:
    """Read the pages for monitoring; milliseconds of each that answers."""
    begun, times = time.perf_counter(), dict[str, float]()
    for name, port in bench.ports.items():
        if name.startswith("pages"):
            begun = time.perf_counter()
            status, _ = await fetched(port, "/metrics", source)
            if status == 200:
                times[f"/metrics, {name.rpartition(' ')[2]}"] = 1000 * (
                    time.perf_counter() - begun
                )
    return times


async def user(bench: Bench, source: str) -> dict[str, float]:
    """A user of the projector introduces itself."""
    begun = time.perf_counter()
    link = await ProjectorLink.connect("127.0.0.1", bench.ports["projector"])
    try:
        await link.ask("session.hello", hello_params("flood", TOKEN))
        await link.ask("health", {})
    finally:
        link.close()
    return {"user of the projector": 1000 * (time.perf_counter() - begun)}


async def program(bench: Bench, source: str) -> dict[str, float]:
    """A program connects to the gateway and asks; what is lost on the way is asked again."""
    begun = time.perf_counter()
    context = zmq.asyncio.Context()
    hear, say = context.socket(zmq.SUB), context.socket(zmq.PUB)
    try:
        hear.subscribe(b"")
        hear.connect(f"tcp://127.0.0.1:{bench.ports['gateway out']}")
        say.connect(f"tcp://127.0.0.1:{bench.ports['gateway in']}")
        asked = set[int]()
        while True:
            asked.add(id := next(numbers))
            event = {"component": "scanner", "command": "status_time_get", "UUID": id}
            await say.send(json.dumps(event).encode())
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(0.1):
                    heard: dict[str, Any] = {}
                    while heard.get("UUID") not in asked or heard["reply type"] != "ACK":
                        heard = json.loads(await hear.recv())
                    return {
                        "program at the gateway": 1000 * (time.perf_counter() - begun)
                    }
    finally:
        context.destroy(linger=0)


HONEST: tuple[Callable[[Bench, str], Awaitable[dict[str, float]]], ...] = (
    page, figures, user, program,
)  # fmt: skip
ASKED = ("page is loaded", "page's E-STOP", "/metrics, twin", "/metrics, projector",
         "/metrics, viewer", "user of the projector", "program at the gateway")  # fmt: skip


async def honest(bench: Bench, count: int) -> dict[str, list[float]]:
    """So many of each, one after the other; what each took [ms]."""
    found: dict[str, list[float]] = {name: [] for name in ASKED}
    for i in range(count):
        for each in HONEST:
            with contextlib.suppress(Exception):
                async with asyncio.timeout(PATIENCE_S):
                    for name, ms in (await each(bench, (OTHER, PEER)[i % 2])).items():
                        found[name].append(ms)
        await asyncio.sleep(GAP_S)
    return found


async def trial(
    bench: Bench, name: str | None, count: int, a_minute: int, alone: bool
) -> bool:
    """A flood at one port (None: no flood); prints what came of it, and whether all had
    answers."""
    made = PROCESSES.Value("l", 0)
    attacker = None
    if name is not None:
        attacker = PROCESSES.Process(
            target=flood, args=(bench.ports[name], a_minute, made, alone), daemon=True
        )
        attacker.start()
        await asyncio.sleep(SETTLED_S)
    before, begun = made.value, time.monotonic()
    found = await honest(bench, count)
    rate = (made.value - before) * 60.0 / (time.monotonic() - begun)
    if attacker is not None:
        attacker.kill()
        attacker.join()
    for what, ms in found.items():
        shown = (
            " | ".join(f"{percentile(ms, q):.0f}" for q in (0.5, 0.99, 1.0))
            if ms
            else "| |"
        )
        print(f"| {name or 'none'} | {rate:.0f} | {what} | {len(ms)} of {count} | "
              f"{sum(t <= 1000.0 for t in ms)} | {shown} |", flush=True)  # fmt: skip
    return all(len(ms) == count for ms in found.values()) and all(
        process.alive() for process in bench.processes
    )


async def all_of_them(
    bench: Bench, names: list[str], count: int, a_minute: int, alone: bool
) -> bool:
    """Without a flood, and with one at each port."""
    _, head = await fetched(
        bench.ports["viewer"], f"/?token={TOKEN.replace(' ', '%20')}", OTHER
    )
    bench.cookie = head.split("Set-Cookie: ")[1].split(";")[0]
    await honest(bench, 2)  # what the first answers need is loaded now
    for process in bench.processes if alone else ():
        real_time(process.pid)
    if alone:
        real_time(os.getpid())
    print("| flood at | a minute | | answered | within 1 s | p50 | p99 | worst |")
    print("|---|---|---|---|---|---|---|---|")
    sound = [await trial(bench, name, count, a_minute, alone) for name in (None, *names)]
    return all(sound)


def main() -> int:
    """Run the floods; returns the exit code."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument(
        "names", nargs="*", metavar="PORT", help="as the table names them"
    )
    options.add_argument("--count", type=int, default=200, help="of each that is honest")
    options.add_argument(
        "--a-minute", type=int, default=10_000, help="connections of the peer"
    )
    options.add_argument(
        "--real-time", action="store_true", help="give all of this priority"
    )
    chosen = options.parse_args()
    with tempfile.TemporaryDirectory(prefix="flexdt-floods-") as folder:
        bench = started(Path(folder))
        try:
            names = chosen.names or list(bench.ports)
            alone, count = chosen.real_time, chosen.count
            sound = asyncio.run(all_of_them(bench, names, count, chosen.a_minute, alone))
        finally:
            for process in bench.processes:
                process.end()
    print(f"times in ms. {machine()}.")
    return 0 if sound else 1


if __name__ == "__main__":
    sys.exit(main())
