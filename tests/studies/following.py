"""How soon `flexdt follow` knows: age of the mirror, and time from a fault to its alarm.

    python tests/studies/following.py [--runs 5] [--seed 1]

A scanner of the study's own runs in another process and publishes over ZeroMQ; both processes
read the same monotonic clock. A wrong limit and an offset count from the message that shows
them, a slow motor from the moment at which it is 0.3 s behind, a lost link from the death
(killed) or the standstill (stopped, as with a cable out) of the scanner's process.
"""

from __future__ import annotations

import argparse
import asyncio
import multiprocessing as mp
import os
import random
import signal
import sys
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import zmq

sys.path.insert(0, str(Path(__file__).parents[2]))

from flexdt.clients.following.session import FollowSession
from flexdt.twin.collision.plan_report import collision_check
from flexdt.twin.following.follower import Follower
from flexdt.twin.following.mirror import Alarm, Mirror
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.script import parse_script
from flexdt.twin.script.executed_log import MotorReply, motor_cluster
from tests.support.scanner_traffic import Motor, event

FLEXRAY = builtin_machine("flexray")
SCRIPT = "mag_obj\tmove absolute\t300\t\tACK\t\t\n" + "".join(
    f"rot_obj\tmove absolute\t{10 * i}\t\tACK\t\t\ncamera\ttake image\t\t\tACK\t\t\n"
    for i in range(36)
)


def scanner(pipe: Connection) -> None:
    """The scanner's process: publishes what it is given, and says when it did."""
    socket = zmq.Context().socket(zmq.PUB)
    pipe.send(socket.bind_to_random_port("tcp://127.0.0.1"))
    while True:
        data = pipe.recv()
        pipe.send(time.monotonic())
        socket.send(data)


class Bench:
    """A scanner and who follows it."""

    def __init__(self) -> None:
        """Start the scanner's process and a session that collects alarms; nothing is
        followed yet.
        """
        self.pipe, theirs = mp.Pipe()
        self.process = mp.get_context("spawn").Process(
            target=scanner, args=(theirs,), daemon=True
        )
        self.process.start()
        self.port = self.pipe.recv()
        self.alarms: list[Alarm] = []
        self.seen: list[tuple[float, Mirror]] = []
        follower = Follower(
            FLEXRAY, builtin_profile(FLEXRAY.default_profile), parse_script(SCRIPT),
            collision=collision_check(),
        )  # fmt: skip
        self.session = FollowSession(follower, self.alarms.append, changed=self._changed)

    def _changed(self, mirror: Mirror) -> None:
        self.seen.append((time.monotonic(), mirror))

    async def say(self, data: bytes) -> float:
        """Publish; returns when [s]."""
        self.pipe.send(data)
        return float(await asyncio.to_thread(self.pipe.recv))

    async def until(self, holds: Callable[[], bool], seconds: float = 30.0) -> None:
        async with asyncio.timeout(seconds):
            while not holds():
                await asyncio.sleep(0.002)

    async def alarm(self, *kinds: str) -> Alarm:
        await self.until(lambda: any(a.kind in kinds for a in self.alarms))
        return next(a for a in self.alarms if a.kind in kinds)

    async def __aenter__(self) -> Bench:
        """Follow the scanner, and wait until the subscription holds."""
        self.task = asyncio.create_task(self.session.run(f"tcp://127.0.0.1:{self.port}"))
        await self.until(lambda: self.session.mirror.connected)
        await asyncio.sleep(0.3)  # the subscription follows the handshake
        return self

    async def __aexit__(self, *_: object) -> None:
        """End the session and the scanner's process."""
        self.task.cancel()
        await asyncio.gather(self.task, return_exceptions=True)
        self.process.kill()
        self.process.join()


async def ages(count: int, rng: random.Random) -> list[float]:
    """Times from a published position to the mirror that has it [s], while the script's
    rest is checked.
    """
    out = []
    async with Bench() as bench:
        await bench.say(event(1, ("mag_obj", "move absolute", "300")))
        for i in range(count):
            key, at = 10 + i, 300.0 + rng.uniform(-200, 200)
            words = ("mag_obj", "status_position_get")
            await bench.say(event(key, words))
            sent = await bench.say(event(key, words, "ACK", f"{at:.10f}"))
            await bench.until(
                lambda at=at: abs(bench.session.mirror.positions["mag_obj"] - at) < 1e-6
            )
            moment = next(
                t for t, m in bench.seen if abs(m.positions["mag_obj"] - at) < 1e-6
            )
            out.append(moment - sent)
            bench.seen.clear()
            await asyncio.sleep(rng.uniform(0.0, 0.1))
    return out


async def wrong_limit(rng: random.Random) -> float:
    """Answer with a limit lower than known; seconds until the alarm."""
    axis = FLEXRAY.axes["tra_obj"]
    at = rng.uniform(-50, 50)
    reply = MotorReply(
        at, at, axis.speed, axis.acceleration, axis.lower, axis.upper - rng.uniform(1, 50),
        axis.max_speed, axis.max_acceleration,
    )  # fmt: skip
    async with Bench() as bench:
        words = ("tra_obj", "move absolute", repr(at))
        await bench.say(event(1, words))
        sent = await bench.say(
            event(1, words, "ACK", motor_cluster(reply).decode("latin-1"))
        )
        return (await bench.alarm("limits")).at_s - sent


async def offset(rng: random.Random) -> float:
    """Answer with a position beside the target; seconds until the alarm."""
    async with Bench() as bench:
        words = ("tra_obj", "move absolute", "20.0")
        await bench.say(event(1, words))
        at = 20.0 + rng.choice([-1, 1]) * rng.uniform(0.05, 1.0)
        sent = await bench.say(event(1, words, "ACK", f"{at:.10f}"))
        return (await bench.alarm("offset")).at_s - sent


async def slow(rng: random.Random) -> float:
    """Move slower than known; seconds from where it is 0.3 s behind until the alarm."""
    axis = FLEXRAY.axes["mag_obj"]
    moved = Motor(
        "mag_obj",
        axis.home,
        axis.home - 400.0,
        axis.speed * rng.uniform(0.3, 0.8),
        axis.acceleration,
    )
    nominal = Motor(
        "mag_obj", axis.home, axis.home - 400.0, axis.speed, axis.acceleration
    )
    grid = np.arange(0.0, moved.duration_s, 0.001)
    there = np.interp(
        [-moved.position(t) for t in grid], [-nominal.position(t) for t in grid], grid
    )
    behind = float(grid[np.argmax(grid - there > 0.3)])
    async with Bench() as bench:
        began = None
        for at, data in moved.messages(1, 0.0):
            began = time.monotonic() if began is None else began
            await asyncio.sleep(max(0.0, began + at - time.monotonic()))
            await bench.say(data)
            if any(a.kind == "slow" for a in bench.alarms):
                break
        assert began is not None
        return (await bench.alarm("slow")).at_s - (began + behind)


async def lost(rng: random.Random, how: signal.Signals) -> float:
    """End the scanner's process by a signal; seconds until the alarm."""
    async with Bench() as bench:
        await bench.say(event(1, ("tube", "xrayon")))
        await asyncio.sleep(rng.uniform(0.3, 0.8))
        began = time.monotonic()
        assert bench.process.pid is not None
        os.kill(bench.process.pid, how)
        return (await bench.alarm("lost")).at_s - began


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    rng = random.Random(options.seed)
    found = asyncio.run(ages(100 * options.runs, rng))
    print(f"seed {options.seed}; {os.cpu_count()} cores; load {os.getloadavg()[0]:.1f}")
    print(
        f"age of the mirror: median {1e3 * np.median(found):.1f} ms, 99 % "
        f"{1e3 * np.quantile(found, 0.99):.1f} ms, worst {1e3 * max(found):.1f} ms, "
        f"n = {len(found)}"
    )
    for name, fault in (
        ("wrong limit", wrong_limit),
        ("offset", offset),
        ("slow motor", slow),
        ("lost link, killed", lambda r: lost(r, signal.SIGKILL)),
        ("lost link, stopped", lambda r: lost(r, signal.SIGSTOP)),
    ):
        took = [asyncio.run(fault(rng)) for _ in range(options.runs)]
        middle, worst = np.median(took), max(took)
        print(
            f"{name}: alarmed after {middle:.3f} s, worst {worst:.3f} s, n = {len(took)}"
        )


if __name__ == "__main__":
    main()
