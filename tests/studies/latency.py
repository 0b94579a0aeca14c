"""E-stop beside every load: `python tests/studies/latency.py [--seconds 10] [--loads NAME
...]`.

One client sends `safety.estop` every 20 ms and times the answers, another subscribes to the
state, which changes with every E-stop, and a third is the load, in a process of its own with a
low priority. After each load the twin's `/metrics` tell how long turns of its loop took
meanwhile. In turns with the E-stops it asks a bare echo server, whose answers tell what the
machine itself takes. A real-time process that oversleeps tells when the whole machine stood still
(a virtual one does). Prints a table and exits with 1 where a figure is beyond its limit (times
`--slack`, for machines that are busy with other things).
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import math
import multiprocessing
import os
import socket
import struct
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from lab import Wire, machine, percentile, projector, twin

LIMITS = {
    "p99": 20.0,
    "worst": 100.0,
    "age": 250.0,
    "hold p99.9": 10.0,
    "hold worst": 50.0,
}
"""E-stop round trip, age of the state at a subscriber, turns of the loop [ms]."""
PROBE_S = 0.02
GET = b'{"jsonrpc":"2.0","id":1,"method":"state.get"}\n'


def line(method: str, params: bytes) -> bytes:
    """A request as a line of JSON; params are JSON already."""
    return b'{"jsonrpc":"2.0","id":1,"method":"%b","params":%b}\n' % (
        method.encode(),
        params,
    )


def dial(port: int) -> socket.socket:
    return socket.create_connection(("127.0.0.1", port), timeout=200.0)


def drain(sock: socket.socket) -> None:
    """Throw away all that comes, in a thread."""

    def work() -> None:
        with contextlib.suppress(OSError):
            while sock.recv(1 << 20):
                pass

    threading.Thread(target=work, daemon=True).start()


def pipeline(count: int, what: bytes = GET * 100) -> Callable[[int, float], int]:
    """`count` connections that send without waiting for answers."""

    def load(port: int, seconds: float) -> int:
        """Send the requests again and again on all connections, which read apart; the
        bytes sent.
        """
        until = time.monotonic() + seconds
        socks = [dial(port) for _ in range(count)]
        for sock in socks:
            drain(sock)
            sock.settimeout(0.05)
        sent = 0
        unsent = dict.fromkeys(socks, what)
        while time.monotonic() < until:
            for sock in socks:
                with contextlib.suppress(TimeoutError):
                    n = sock.send(unsent[sock])
                    sent += n
                    unsent[sock] = unsent[sock][n:] or what
        for sock in socks:
            sock.close()
        return sent

    return load


def flood(what: bytes) -> Callable[[int, float], int]:
    """Bytes that are no request, by a connection that is made anew whenever it is cut."""

    def load(port: int, seconds: float) -> int:
        """Send on one connection, and on another whenever it is closed; the bytes sent."""
        until, sent = time.monotonic() + seconds, 0
        while time.monotonic() < until:
            with contextlib.suppress(OSError), dial(port) as sock:
                drain(sock)
                while time.monotonic() < until:
                    sock.sendall(what)
                    sent += len(what)
        return sent

    return load


def asking(
    *lines: bytes, count: int = 1, once: bool = False
) -> Callable[[int, float], int]:
    """`count` connections that send these lines in turn, each after the answer to the last."""

    def load(port: int, seconds: float) -> int:
        """Ask and wait for answers on all connections; the number of answers."""
        until = time.monotonic() + seconds
        done = [0]

        def one() -> None:
            """Ask on a connection of its own until the time is over, at least each line
            once.

            An end of the connection raises AssertionError.
            """
            sock = dial(port)
            file = sock.makefile("rb")
            while True:
                for each in lines:
                    sock.sendall(each)
                    while b'"method":"event"' in (answer := file.readline())[:60]:
                        pass
                    assert answer
                    done[0] += 1
                if once or time.monotonic() >= until:
                    return

        threads = [threading.Thread(target=one) for _ in range(count)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return done[0]

    return load


def idle(port: int, seconds: float) -> int:
    time.sleep(seconds)
    return 0


def poses(size: int) -> bytes:
    each = ",".join('{"rot_obj":%.2f}' % (i * 0.01) for i in range(size))
    return line("trajectory.check", b'{"poses":[%b]}' % each.encode())


def script(size: int) -> bytes:
    """A request that checks a script of `size` moves."""
    rows = "".join(
        f"rot_obj\tmove absolute\t{i % 360}\t\tACK\t\t\r\n" for i in range(size)
    )
    return line("script.check", json.dumps({"text": rows}).encode())


def unfitting(size: int) -> bytes:
    return line("trajectory.check", b'{"poses":[%b]}' % b",".join([b"0"] * (size // 2)))


def unfitting_names(size: int) -> bytes:
    each = b",".join(b'"a%d":"x"' % i for i in range(size // 13))
    return line("axes.move", b'{"targets":{%b}}' % each)


def upload(size: int) -> Callable[[int, float], int]:
    """Voxels in MessagePack, 4 MiB a frame, again and again."""

    def load(port: int, seconds: float) -> int:
        """Upload voxels of about `size` bytes in parts of 4 MiB, again and again; the
        bytes sent.

        The time is looked at before each upload.
        """
        import msgpack

        until, sock, sent = time.monotonic() + seconds, dial(port), 0
        side = int((size // 4) ** (1 / 3))
        total = 4 * side**3
        data = bytes(4 << 20)
        while time.monotonic() < until:
            for start in range(0, total, len(data)):
                part = data[: min(len(data), total - start)]
                body = msgpack.packb({
                    "jsonrpc": "2.0", "id": 1, "method": "sample.upload",
                    "params": {"name": "load", "kind": "voxels", "format": "raw", "total": total,
                               "start": start, "data": part, "shape": [side] * 3,
                               "voxel_mm": [0.1, 0.1, 0.1]},
                })  # fmt: skip
                sock.sendall(struct.pack(">I", len(body)) + body)
                (length,) = struct.unpack(">I", sock.recv(4, socket.MSG_WAITALL))
                sock.recv(length, socket.MSG_WAITALL)
                sent += len(part)
        return sent

    return load


def batch(count: int) -> bytes:
    return b"[" + b",".join([GET.strip()] * count) + b"]\n"


SUBSCRIBE = b'{"topics":["state","projection","job","log"],"max_rate_hz":%d}'


def loads(scale: float) -> dict[str, Callable[[int, float], int]]:
    """Every load by name; `scale` makes the large ones smaller."""
    mb = int(1e6 * scale)
    return {
        "idle": idle,
        "one observer pipelines state.get": pipeline(1),
        "five observers pipeline state.get": pipeline(5),
        "check of 100 000 poses": asking(poses(int(100_000 * scale)), once=True),
        "check of 20 000 lines": asking(script(int(20_000 * scale)), once=True),
        "15 MB of unfitting poses": asking(unfitting(15 * mb)),
        "15 MB of unfitting targets": asking(unfitting_names(15 * mb)),
        "a JSON line of 16 MB": asking(
            line("state.get", b'{"x":"%b"}' % (b"x" * (16 * mb)))
        ),
        "a JSON line above the limit": asking(
            line("state.get", b'"%b"' % (b"x" * (40 * mb)))
        ),
        "uploads of 100 MB": upload(100 * mb),
        "batches of 1000": asking(batch(1000)),
        "deep JSON": asking(b"[" * 30_000 + b"\n", b'{"a":' * 6_000 + b"\n", GET),
        "blank lines": flood(b"\n" * (1 << 18)),
        "two-byte lines": flood(b"1\n" * (1 << 17)),
        "empty frames": flood(bytes(4) * (1 << 16)),
        "50 clients check 200 poses": asking(poses(200), count=int(50 * scale) or 1),
        "5 observers want images": asking(line("projection.get", b"{}"), count=5),
        "5 observers subscribe and subscribe": pipeline(
            5, b"".join(line("state.subscribe", SUBSCRIBE % (1 + i)) for i in range(50))
        ),
        "5 observers pipeline axes.stop": pipeline(5, line("axes.stop", b"{}") * 50),
        "100 observers pipeline ping": pipeline(
            int(100 * scale) or 1, line("session.ping", b"{}") * 20
        ),
    }


class Ages:
    """Longest time without a new state at a subscriber [ms]."""

    def __init__(self, port: int) -> None:
        """Start a process that subscribes at a port, and wait until it has."""
        ours, theirs = multiprocessing.Pipe()
        self._pipe = ours
        process = multiprocessing.Process(target=_watch, args=(port, theirs), daemon=True)
        process.start()
        ours.recv()

    def take(self) -> float:
        """Since this was last asked."""
        self._pipe.send(None)
        worst: float = self._pipe.recv()
        return worst


class Echo:
    """A bare asyncio server in a process of its own that sends lines back: what of a round trip is
    the machine's."""

    def __init__(self) -> None:
        """Start it and connect."""
        ours, theirs = multiprocessing.Pipe()
        multiprocessing.Process(target=_echo, args=(theirs,), daemon=True).start()
        self._sock = dial(ours.recv())
        self._sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._file = self._sock.makefile("rb")

    def ask(self) -> float:
        """One round trip [ms]."""
        begun = time.perf_counter()
        self._sock.sendall(GET)
        self._file.readline()
        return 1000 * (time.perf_counter() - begun)


class Stalls:
    """How long the machine itself stood still: a real-time process that oversleeps [ms]."""

    def __init__(self) -> None:
        """Start a process that sleeps; `known` says whether it could be real-time."""
        ours, theirs = multiprocessing.Pipe()
        self._pipe = ours
        multiprocessing.Process(target=_oversleep, args=(theirs,), daemon=True).start()
        self.known: bool = ours.recv()

    def take(self) -> float:
        """Worst since this was last asked; NaN where the system grants no real-time
        priority."""
        self._pipe.send(None)
        worst: float = self._pipe.recv()
        return worst if self.known else math.nan


def _echo(pipe: Any) -> None:
    """Send each line of each connection back, for ever; the port goes through the pipe."""

    async def back(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while line := await reader.readline():
            writer.write(line)

    async def serve() -> None:
        server = await asyncio.start_server(back, "127.0.0.1", 0)
        pipe.send(server.sockets[0].getsockname()[1])
        await server.serve_forever()

    asyncio.run(serve())


def _oversleep(pipe: Any) -> None:
    """Sleep a millisecond at a time for ever; asked by the pipe, send the longest
    oversleep since [ms].
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        pipe.send(True)
    except (OSError, AttributeError):
        pipe.send(False)
    worst = 0.0
    while True:
        begun = time.perf_counter()
        time.sleep(0.001)
        worst = max(worst, 1000 * (time.perf_counter() - begun) - 1)
        if pipe.poll():
            pipe.recv()
            pipe.send(worst)
            worst = 0.0


def _watch(port: int, pipe: Any) -> None:
    """Subscribe and read for ever; asked by the pipe, send the longest time without a
    state [ms].
    """
    sock = dial(port)
    sock.sendall(line("state.subscribe", b'{"topics":["state"],"max_rate_hz":100}'))
    sock.settimeout(0.002)
    pipe.send(None)
    last, worst, data = time.perf_counter(), 0.0, b""
    while True:
        with contextlib.suppress(TimeoutError):
            data += sock.recv(1 << 18)
        while (end := data.find(b"\n")) >= 0:
            # Decoding costs this client's time and is no part of what is measured.
            if b'"topic":"state"' in data[:200]:
                now = time.perf_counter()
                worst, last = max(worst, now - last), now
            data = data[end + 1 :]
        if pipe.poll():
            pipe.recv()
            now = time.perf_counter()
            pipe.send(1000 * max(worst, now - last))
            worst = 0.0


def holds(port: int) -> tuple[dict[float, int], float]:
    """Turns of the loop up to each bound [s], and the longest since this was last asked
    [ms].

    Args:
        port: of the pages for monitoring.
    """
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics") as page:
        text = page.read().decode()
    counts, worst = {}, 0.0
    for each in text.splitlines():
        if each.startswith("flexdt_loop_hold_seconds_bucket"):
            bound = each.split('le="')[1].split('"')[0]
            counts[float(bound)] = int(float(each.split()[-1]))
        elif each.startswith("flexdt_loop_hold_worst_seconds"):
            worst = 1000 * float(each.split()[-1])
    return counts, worst


def p999(before: dict[float, int], after: dict[float, int]) -> float:
    """Bound below which 99.9 % of the turns between two scrapes were [ms]."""
    many = after[float("inf")] - before[float("inf")]
    bounds = (b for b in sorted(after) if after[b] - before[b] >= 0.999 * many)
    return 1000 * next(bounds)


def probes(
    wire: Wire, echo: Echo, busy: Callable[[], bool]
) -> Iterator[tuple[float, float]]:
    """Round trips of E-stops and of the echo in turns while a load works [ms]."""
    while busy():
        begun = time.perf_counter()
        wire.call("safety.estop")
        taken = 1000 * (time.perf_counter() - begun)
        time.sleep(0.5 * PROBE_S)
        yield taken, echo.ask()
        time.sleep(0.5 * PROBE_S)


def _load(work: Callable[[int, float], int], port: int, seconds: float) -> None:
    os.nice(10)  # its own cost apart
    work(port, seconds)


def main() -> int:
    """Measure E-stops beside each load, and print a table.

    Returns:
        1 where something was beyond its limit, a load failed, or an error was not
        handled.
    """
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--seconds", type=float, default=10.0, help="of each load")
    p.add_argument("--loads", nargs="*", help="all, if left out")
    p.add_argument("--scale", type=float, default=1.0, help="of what is large")
    p.add_argument("--slack", type=float, default=1.0, help="factor on all limits")
    options = p.parse_args()
    every = loads(options.scale)
    failed: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        rays = projector()
        server = twin(
            rays.port,
            Path(folder) / "data",
            "--http-port",
            0,
            log=Path(folder) / "twin.log",
        )
        http = int(server.ready["http_port"])
        try:
            wire = Wire(server.port)
            wire.call("safety.estop")
            ages, stalls, echo = Ages(server.port), Stalls(), Echo()
            print("| beside | E-stops | p50 | p99 | worst | echo p50 | p99 | worst | state age |"
                  " loop p99.9 | worst | MB | machine stood still |")  # fmt: skip
            print("|---" * 13 + "|")
            for name in options.loads or every:
                before, _ = holds(http)
                next(probes(wire, echo, lambda: True))
                ages.take()
                stalls.take()
                work = multiprocessing.Process(
                    target=_load, args=(every[name], server.port, options.seconds)
                )
                work.start()
                both = list(probes(wire, echo, work.is_alive))
                ms, bare = [a for a, _ in both], [b for _, b in both]
                after, held = holds(http)
                work.join()
                got = {
                    "p99": percentile(ms, 0.99), "worst": max(ms), "age": ages.take(),
                    "hold p99.9": p999(before, after), "hold worst": held,
                }  # fmt: skip
                print(
                    f"| {name} | {len(ms)} | {percentile(ms, 0.5):.1f} | {got['p99']:.1f} | "
                    f"{got['worst']:.1f} | {percentile(bare, 0.5):.1f} | "
                    f"{percentile(bare, 0.99):.1f} | {max(bare):.1f} | "
                    f"{got['age']:.0f} | {got['hold p99.9']:.0f} | "
                    f"{got['hold worst']:.0f} | {server.memory_mb():.0f} | "
                    f"{stalls.take():.0f} |", flush=True,
                )  # fmt: skip
                beyond = [k for k, v in got.items() if v > options.slack * LIMITS[k]]
                failed += [f"{name}: {k} {got[k]:.1f} ms" for k in beyond]
                if work.exitcode:
                    failed.append(f"{name}: the load failed")
            print(f"{len(every)} loads known; times in ms. {machine()}.")
        finally:
            server.end()
            rays.end()
        bad = server.logged("error", "critical", "unstructured")
        for entry in bad[:3]:
            print("LOG:", str(entry)[-800:])
    for each in failed:
        print("BEYOND ITS LIMIT:", each)
    print(f"{len(failed)} beyond their limits; {len(bad)} unhandled exceptions")
    return 1 if failed or bad else 0


if __name__ == "__main__":
    sys.exit(main())
