"""Requests of several clients that end at drawn moments, and the server that ends under them.

Every request is a task of its own, begun at a drawn moment and mostly cancelled at another, as of
a connection that breaks. Disk and projector fail and recover meanwhile. In the end everything is
released (the disk, the projector, the scan, the clock), and then each request that is left must
end, and the server must, too: with a simulated loop a wait that nothing can end is `Deadlock`,
which names it.
"""

from __future__ import annotations

import asyncio
import random
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import numpy.typing as npt
from estop_histories import SlowLoop
from in_process import ROI, Client, M, P, PointProjector, script

from flexdt.protocol import RpcError
from flexdt.protocol.rpc_errors import too_large
from flexdt.runtime.files.directory import open_data
from flexdt.runtime.wire_errors import ProjectorUnavailable
from flexdt.server.storage.dataset_writer import DatasetWriter
from flexdt.server.twin.core import TwinServer
from flexdt.testing.in_process import SimulatedLoop
from flexdt.twin.dataset.dataset_errors import DatasetWriteError, DiskFullError
from flexdt.twin.scanner.state import Sample

Call = tuple[str, dict[str, Any]]
GAPS_S = (0.0, 0.0, 0.001, 0.02, 0.3, 5.0, 60.0)
"""Times between two events, and between a request and its end [virtual s]."""
SLOW_S = (0.0, 0.0005, 0.02, 0.5)
"""Mean times of a thread's work [virtual s]."""
SAMPLES = ("chiral", "empty", "normal-3")
READY: tuple[Call, ...] = (("session.control", {"action": "force"}), ("safety.reset", {}))
"""What lets a client move and scan."""
CLIENTS = 4
PATIENCE_S = 3000.0
"""For what has been released [virtual s]; nothing in a history takes as long."""


class Failing(PointProjector):
    """A projector that answers with errors of several kinds while it is told to."""

    error: Exception | None = None

    async def project(self, name: str, cone_vec: Any, shape: tuple[int, int]) -> Any:
        """Compute an image, or raise."""
        if self.error is not None:
            raise self.error
        return await super().project(name, cone_vec, shape)


class Room:
    """A twin server, its clients, and what goes wrong.

    Args:
        seed: draws all.
        root: data directory.
    """

    def __init__(self, seed: int, root: Path) -> None:
        self.rng = random.Random(f"cancelled {seed}")
        self.projector = Failing()
        self.twin = TwinServer(
            M,
            P,
            self.projector,
            open_data(root),
            speed_up=self.rng.choice(["max", 1.0, 100.0]),
            seed=lambda: 5,
            wall=asyncio.get_running_loop().time,
        )
        self.disk: type[Exception] | None = None
        self.tasks: dict[asyncio.Task[Any], str] = {}
        self.outcome: Counter[str] = Counter()
        self.jobs = 0

    def drawn(self) -> Call:
        """Draw a request of any kind that waits for something."""
        rng = self.rng
        axis = rng.choice(sorted(M.axes))
        low, high = M.axes[axis].lower, M.axes[axis].upper
        move = {
            "targets": {axis: rng.uniform(low, high)},
            "wait": rng.random() < 0.7,
            "plan": rng.random() < 0.3,
        }
        job = {}
        if self.jobs and rng.random() < 0.2:
            job = {"job": f"job-{rng.randint(1, self.jobs)}"}
        calls: list[Call] = [
            ("axes.move", move),
            ("axes.stop", {}),
            ("safety.estop", {}),
            ("safety.reset", {}),
            ("tube.set", {"on": True}),
            ("camera.set", {"roi": ROI}),
            ("axes.set", {"axis": "rot_obj", "speed": rng.uniform(1.0, 20.0)}),
            ("sample.set", {"name": rng.choice(SAMPLES)}),
            ("calibration.apply", {"parameters": {"det_roll": rng.uniform(-1.0, 1.0)}}),
            ("calibration.revert", {}),
            ("clock.set", {"speed_up": rng.choice(["max", 1.0, 50.0])}),
            ("session.control", {"action": "force"}),
            ("projection.get", {"binning": 8}),
            ("script.check", {"text": script(3)}),
            ("job.list", {}),
            ("job.forget", {}),
            ("state.subscribe", {"topics": ["state", "projection"], "max_rate_hz": 0.2}),
        ]
        jobs: list[Call] = [
            ("script.submit", {"text": script(rng.choice([1, 3, 40]))}),
            ("job.pause", job),
            ("job.resume", job),
            ("job.step", job),
            ("job.abort", job),
        ]
        return rng.choice(rng.choice([calls, jobs, jobs]))

    async def ask(self, client: Client, call: Call) -> None:
        """Ask, and count what came of it."""
        name, params = call
        try:
            answer = await client.call(name, **params)
        except RpcError as error:
            self.outcome[f"{name} refused"] += 1
            if error.code == -32603:
                raise AssertionError(f"{name} {params}: {error}") from error
        except asyncio.CancelledError:
            self.outcome[f"{name} cut off"] += 1
            raise
        else:
            self.outcome[f"{name} answered"] += 1
            if name == "script.submit":
                self.jobs = max(self.jobs, int(answer["job"][4:]))

    def begin(self, client: Client) -> None:
        """Begin a drawn request, and mostly draw when it ends."""
        call = self.drawn()
        task = asyncio.create_task(self.ask(client, call), name=f"{call}")
        self.tasks[task] = call[0]
        if self.rng.random() < 0.6:
            loop = asyncio.get_running_loop()
            for _ in range(self.rng.choice([1, 1, 2])):
                loop.call_later(self.rng.choice(GAPS_S), task.cancel)

    def fail(self) -> None:
        """Let disk and projector fail or recover."""
        kinds: list[type[Exception] | None] = [None, None, DiskFullError]
        self.disk = self.rng.choice([*kinds, DatasetWriteError, OSError])
        gone: list[Exception | None] = [None, None, ProjectorUnavailable("drawn")]
        self.projector.error = self.rng.choice([*gone, too_large("drawn", 2, 1)])

    async def live(self, steps: int, *, released: bool) -> None:
        """Draw requests and failures; then release everything and wait, or (`released`
        False) end the server in the middle.
        """
        await self.twin.start(Sample("chiral"))
        clients = [Client(self.twin, f"client-{i}") for i in range(CLIENTS)]
        for _ in range(steps):
            client = self.rng.choice(clients)
            if self.rng.random() < 0.7:
                for name, params in READY[: self.rng.choice([1, 2, 2])]:
                    with suppress(RpcError):
                        await client.call(name, **params)
            self.begin(client)
            if self.rng.random() < 0.15:
                self.fail()
            await asyncio.sleep(self.rng.choice(GAPS_S))
        if released:
            await self.release(clients[0])
        await self.twin.stop()
        for task in self.tasks:
            task.cancel()
        for task in self.tasks:
            with suppress(asyncio.CancelledError):
                await task

    async def release(self, client: Client) -> None:
        """Let all that may wait for something have it, until nothing waits."""
        self.disk = self.projector.error = None
        await client.call("session.control", action="force")
        await client.call("clock.set", speed_up="max")
        async with asyncio.timeout(PATIENCE_S):
            while any(not task.done() for task in self.tasks) or self.twin.jobs.current:
                for name, params in (*READY, ("job.resume", {})):
                    with suppress(RpcError):
                        await client.call(name, **params)
                await asyncio.sleep(10.0)
                job = self.twin.jobs.current
                if job is not None and job.phase == "paused" and job.error is not None:
                    await client.call("job.abort", job=job.id)  # as by a contact


def run_cancelled(seed: int, root: Path, steps: int = 30) -> Counter[str]:
    """Run a history on virtual time; what came of its requests.

    Raises:
        Deadlock, TimeoutError: somebody waits for ever.
    """
    rng = random.Random(seed)
    kind = rng.choice([SimulatedLoop, SlowLoop])

    def loop() -> SimulatedLoop:
        made = kind(random.Random(seed))
        if isinstance(made, SlowLoop):
            made.journal_s, made.others_s = rng.choice(SLOW_S), rng.choice(SLOW_S)
        return made

    async def main() -> Counter[str]:
        room = Room(seed, root)
        honest = DatasetWriter.put

        def put(writer: DatasetWriter, name: str, image: npt.NDArray[np.uint16]) -> None:
            """Write an image, or fail as the disk does now."""
            if room.disk is not None:
                raise room.disk("drawn")
            honest(writer, name, image)

        with mock.patch.object(DatasetWriter, "put", put):
            await room.live(steps, released=rng.random() < 0.5)
        return room.outcome

    with asyncio.Runner(loop_factory=loop) as runner:
        return runner.run(main())
