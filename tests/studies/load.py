"""Many clients at once: `python tests/studies/load.py [--clients 200] [--seconds 20]`.

Every client subscribes to the state at 20 Hz and checks the order of what it gets; some also
ask `state.get` twice a second, and those answers are timed. First a real-time scan runs with
the projector on one thread, then one at full speed. One more client subscribes to everything
and never reads. Prints the latencies and what the twin's memory and descriptors did. The
clients live in processes of their own: the same cores, but not the server's interpreter.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import random
import socket
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from lab import Process, Wire, fly_script, machine, percentile, projector, twin

PER_PROCESS = 95
ASKING = 10
"""Clients that ask state.get twice a second; in a process of their own, so that what is timed
is the server and not how busy a crowd of clients is with its events."""


async def client(port: int, seconds: float, asks: bool, result: dict[str, Any]) -> None:
    """Subscribe, ask now and then, and count what comes, for some seconds or until it is
    cut off.

    Args:
        port: of the twin.
        seconds: how long.
        asks: whether it asks.
        result: counts of all clients of this process; changed.
    """
    reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=1 << 22)
    writer.write(b'{"jsonrpc":"2.0","id":0,"method":"state.subscribe","params":'
                 b'{"topics":["state","job"],"max_rate_hz":20}}\n')  # fmt: skip
    last: dict[str, int] = {}
    sent: dict[int, float] = {}
    until = time.monotonic() + seconds

    async def ask() -> None:
        """Ask about twice a second, not in step with others, and note when."""
        number = 0
        await asyncio.sleep(random.uniform(0.0, 0.5))  # people do not ask in step
        while time.monotonic() < until:
            await asyncio.sleep(random.uniform(0.4, 0.6))
            number += 1
            sent[number] = time.perf_counter()
            writer.write(b'{"jsonrpc":"2.0","id":%d,"method":"state.get"}\n' % number)

    asking = asyncio.create_task(ask()) if asks else None
    try:
        while time.monotonic() < until:
            try:
                line = await asyncio.wait_for(
                    reader.readline(), until - time.monotonic() + 0.01
                )
            except TimeoutError:
                break
            at = time.perf_counter()
            if not line:
                result["lost"] += 1
                break
            # Decoding 200 x 20 whole states a second is the clients' cost, not the server's.
            if line.startswith(b'{"jsonrpc":"2.0","method":"event"'):
                head = json.loads(line[: line.index(b',"data":')] + b"}}")["params"]
                topic, seq = head["topic"], head["seq"]
                result["events"] += 1
                if seq <= last.get(topic, -1):
                    result["disorder"] += 1
                last[topic] = seq
            else:
                number = int(line[line.index(b'"id":') + 5 : line.index(b',"result"')])
                if number:
                    result["latency"].append(at - sent.pop(number))
    finally:
        if asking is not None:
            asking.cancel()
        writer.close()


def crowd(port: int, count: int, seconds: float, asks: bool, pipe: Any) -> None:
    """Run many clients in one process, and send their counts by the pipe."""

    async def main() -> dict[str, Any]:
        """Run the clients, and return what they counted together."""
        result: dict[str, Any] = {"events": 0, "disorder": 0, "lost": 0, "latency": []}
        clients = (client(port, seconds, asks, result) for _ in range(count))
        await asyncio.gather(*clients)
        return result

    pipe.send(asyncio.run(main()))


def phase(server: Process, count: int, seconds: float) -> dict[str, Any]:
    """Let a crowd of processes subscribe for some seconds; ASKING of the clients also
    ask.

    Returns:
        Sums of what they counted, and all latencies [s].
    """
    workers = []
    rest = count - ASKING
    sizes = [ASKING, *(min(PER_PROCESS, rest - s) for s in range(0, rest, PER_PROCESS))]
    for i, size in enumerate(sizes):
        ours, theirs = multiprocessing.Pipe()
        arguments = (server.port, size, seconds, i == 0, theirs)
        p = multiprocessing.Process(target=crowd, args=arguments)
        p.start()
        workers.append((p, ours))
    total: dict[str, Any] = {"events": 0, "disorder": 0, "lost": 0, "latency": []}
    for p, pipe in workers:
        for key, value in pipe.recv().items():
            total[key] += value
        p.join()
    return total


def main() -> int:
    """Measure many clients beside a scan in real time and one at full speed; 1 where one
    missed events.
    """
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--clients", type=int, default=200)
    p.add_argument("--seconds", type=float, default=20.0)
    options = p.parse_args()
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "data"
        rays = projector()
        server = twin(rays.port, data, "--speed-up", 1, log=Path(folder) / "twin.log")
        try:
            wire = Wire(server.port)
            wire.call("sample.set", name="lego")
            deaf = socket.create_connection(("127.0.0.1", server.port))
            deaf.sendall(b'{"jsonrpc":"2.0","id":1,"method":"state.subscribe","params":'
                         b'{"topics":["state","projection","job","log"]}}\n')  # fmt: skip
            script = fly_script(1801, exposure_ms=100.0, roi="32 8 1943 1527")
            for name, pace in (("real time", 1), ("full speed", "max")):
                job = wire.call("script.submit", text=script, speed_up=pace)["job"]
                while wire.call("job.status", job=job)["frames_done"] < 3:
                    time.sleep(0.05)
                before, frames = (
                    server.memory_mb(),
                    wire.call("job.status", job=job)["frames_done"],
                )
                begun = time.monotonic()
                got = phase(server, options.clients, options.seconds)
                took = time.monotonic() - begun
                done = wire.call("job.status", job=job)["frames_done"] - frames
                ms = [1000 * x for x in got["latency"]]
                factor = wire.call("state.get")["clock"]["real_time_factor"]
                print(
                    f"{name}: {options.clients} clients, {got['events'] / took:.0f} events/s, "
                    f"{got['disorder']} out of order, {got['lost']} cut off; {len(ms)} state.get: "
                    f"median {percentile(ms, 0.5):.1f} ms, p99 {percentile(ms, 0.99):.1f} ms, "
                    f"worst {max(ms):.1f} ms; {done / took:.1f} frames/s (x{factor:.2f}); "
                    f"twin {before:.0f} -> {server.memory_mb():.0f} MB, "
                    f"{server.descriptors()} descriptors. {machine()}.", flush=True,
                )  # fmt: skip
                wire.call("job.abort", job=job)
                wire.wait(job, "aborted")
                failed += got["disorder"] + got["lost"]
            deaf.close()
            time.sleep(0.5)
            print(
                f"afterwards: {server.memory_mb():.0f} MB, {server.descriptors()} descriptors"
            )
        finally:
            server.end()
            rays.end()
        bad = server.logged("error", "critical", "unstructured")
        for entry in bad[:3]:
            print("LOG:", str(entry)[-800:])
    return 1 if failed or bad else 0


if __name__ == "__main__":
    sys.exit(main())
