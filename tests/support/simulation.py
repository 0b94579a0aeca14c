"""A whole twin server and its clients in one process, on a virtual clock and a disk that fails.

After FoundationDB: handlers, jobs, storage and clients are the real ones; time, threads and
disk are simulated and everything random comes from one seed, so that a seed that fails is a
test.

    sim = Simulation(tmp_path, seed=7)          # a data directory, a clock; nothing runs yet
    with sim:                                   # ends whatever runs
        sim.start()                             # a server, as `flexdt twin` starts one
        a, b = sim.client(), sim.client()       # as many as wanted, before or after a restart
        sim.call(a, "axes.move", targets={"rot_obj": 10})      # result, or raises RpcError
        one = sim.begin(a, "axes.move", targets={"mag_obj": 500}, wait=True)   # beside others
        sim.advance(2.0)                        # virtual seconds of the wall
        sim.call(b, "axes.stop")
        sim.answer(one)                         # its result, when it has come
        sim.twin.scanner, sim.twin.clock        # look inside
        sim.kill(); sim.start()                 # kill -9, and a new server in the same directory
        sim.cut(); sim.start()                  # a power cut: what was not safe on disk may be lost
        sim.stop(); sim.start()                 # SIGTERM
        sim.disk.set(Fault(at=3))               # the 4th change of the disk from now fails (ENOSPC)

`sim.run(coroutine)` runs anything else inside the loop. A client made before a kill is of no
use after it. A fault without `error` cuts the power in the middle of whatever runs: calls then
raise `Crashed`; go on with `sim.start()`. Options of `TwinServer` (`speed_up`, `limits`, `seed`
as `noise`, ...) are the constructor's; `speed_up` is 1 unless given, "max" for scans at full
speed.
"""

from __future__ import annotations

import asyncio
import logging
import random
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, TypeVar

from in_process import Client, M, P, PointProjector
from simulated_disk import Disk, Fault

from flexdt.runtime.files.directory import open_data
from flexdt.runtime.files.own_documents import lock_folder
from flexdt.server.twin.core import TwinServer
from flexdt.testing.in_process import SimulatedLoop
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.scanner.state import Sample

__all__ = ["Client", "Crashed", "Fault", "Simulation"]

T = TypeVar("T")
PATIENCE_S = 3600.0
"""Virtual seconds that an answer may take."""


class Crashed(Exception):
    """The power was cut before the answer came."""


class Simulation:
    """One machine: a directory, a clock, and a twin server while one runs.

    Args:
        root: where the data directory `data` is made.
        seed: of everything random, the order of threads included.
        machine, profile: of the servers.
        sample: on the stage where nothing is remembered; "" for the empty stage.
        noise: the seed of a scan's noise; None switches noise off.
        projector: of the servers; by default one that shows a point.
        options: of `TwinServer`.
    """

    def __init__(
        self,
        root: Path,
        seed: int = 0,
        *,
        machine: Machine = M,
        profile: Profile = P,
        sample: str = "",
        noise: int | None = 5,
        projector: Any = None,
        **options: Any,
    ) -> None:
        """Make the data directory and the disk that watches it; no server runs yet."""
        self.rng = random.Random(seed)
        self.data = root / "data"
        self.data.mkdir(parents=True, exist_ok=True)
        self.disk = Disk(self.data, self.rng)
        self.machine, self.profile, self.sample = machine, profile, sample
        self.projector = PointProjector() if projector is None else projector
        self.options: dict[str, Any] = {"speed_up": 1.0, "seed": lambda: noise, **options}
        self.log: list[logging.LogRecord] = []
        """What the servers logged."""
        self._loop: SimulatedLoop | None = None
        self._time = 0.0
        self._lock: Callable[[], None] | None = None
        self._clients = 0
        self._handler = _LogRecords(self.log)
        self._watched = self.disk.watched()

    def __enter__(self) -> Simulation:
        self._watched.__enter__()
        logging.getLogger("flexdt").addHandler(self._handler)
        return self

    def __exit__(self, *_: object) -> None:
        """Kill the server, if one runs, and leave the system's calls and the log to
        themselves.
        """
        try:
            self.kill()
        finally:
            logging.getLogger("flexdt").removeHandler(self._handler)
            self._watched.__exit__(None, None, None)

    @property
    def twin(self) -> TwinServer:
        """The server that runs."""
        assert self._loop is not None, "no server runs"
        return self._twin

    @property
    def time(self) -> float:
        """Virtual seconds since the beginning."""
        return self._time if self._loop is None else self._loop.time()

    # Processes ----------------------------------------------------------------------------------

    def start(self) -> None:
        """Start a server; what the one before left on the disk is all that it knows.

        Raises:
            Crashed: the power was cut meanwhile.
            OSError, TwinError: it does not start.
        """
        if self.disk.off:  # by a fault
            self.cut()
        assert self._loop is None, "a server runs already"
        self._loop = SimulatedLoop(self.rng, self._time)
        try:
            self.run(self._start())
        except BaseException:
            self.kill()
            raise

    async def _start(self) -> None:
        """Start a server as `flexdt.server.twin.main` does: lock the directory, then
        recall the stage.
        """
        root = open_data(self.data)
        self._lock = lock_folder(root)
        assert self._loop is not None
        self._twin = TwinServer(
            self.machine, self.profile, self.projector, root, wall=self._loop.time,
            **self.options,
        )  # fmt: skip
        sample = self._twin.recall()
        await self._twin.start(Sample(self.sample) if sample is None else sample)

    def stop(self) -> None:
        """SIGTERM: the server ends in good order."""
        self.run(self.twin.stop())
        self._end()

    def kill(self) -> None:
        """kill -9: what was written is on the disk, nothing else is."""
        self.disk.off = True
        self._end()
        self.disk.on()

    def cut(self) -> None:
        """A power cut: of what was not made safe on the disk, some is lost."""
        self.disk.off = True
        self._end()
        self.disk.cut()
        self.disk.on()

    def _end(self) -> None:
        """Unlock the directory and cancel all that runs, again and again: it is a kill,
        no request.

        The time goes on from there at the next start. Nothing happens if no server runs.
        """
        if self._lock is not None:
            self._lock()
            self._lock = None
        if self._loop is None:
            return
        loop, self._loop = self._loop, None
        self._time = loop.time()
        while tasks := asyncio.all_tasks(loop):
            # In the order of their making: that of a set of tasks is another in each process.
            for task in sorted(tasks, key=lambda t: (len(t.get_name()), t.get_name())):
                task.cancel()
            done, _ = loop.run_until_complete(asyncio.wait(tasks, timeout=1.0))
            for task in done:
                if not task.cancelled():
                    task.exception()
        loop.close()

    # Clients ------------------------------------------------------------------------------------

    def client(self) -> Client:
        """A connection of its own to the server that runs."""
        self._clients += 1
        return Client(self.twin, f"client-{self._clients}")

    def call(self, client: Client, method: str, /, **params: Any) -> Any:
        """Ask, and let time pass until the answer is there; see `answer`."""
        return self.run(client.call(method, **params))

    def begin(self, client: Client, method: str, /, **params: Any) -> asyncio.Task[Any]:
        """Ask, without waiting: the request is served while others are."""
        assert self._loop is not None
        return self._loop.create_task(client.call(method, **params))

    def answer(self, task: asyncio.Task[Any]) -> Any:
        """Wait for the answer of one that was begun.

        Raises:
            RpcError: the server's error.
            Crashed: the power was cut before the answer came.
            TimeoutError: it never comes.
        """
        return self.run(_of(task))

    def advance(self, seconds: float) -> None:
        """Let virtual time pass, and whatever happens in it happen."""
        # Two timers of one instant have no order: Python 3.12 takes the one of the patience
        # first.
        self.run(asyncio.sleep(seconds), seconds + PATIENCE_S)

    def run(self, work: Awaitable[T], patience_s: float = PATIENCE_S) -> T:
        """Run a coroutine in the server's loop.

        Args:
            work: the coroutine.
            patience_s: of the loop's time.

        Returns:
            Its result.

        Raises:
            Crashed: the power was cut meanwhile, whatever it raised.
            TimeoutError: it takes longer.
            Exception: what it raises otherwise.
        """
        assert self._loop is not None, "no server runs"

        async def bounded() -> T:
            return await asyncio.wait_for(work, patience_s)

        try:
            result = self._loop.run_until_complete(bounded())
        except BaseException:
            if self.disk.off:
                raise Crashed from None
            raise
        if self.disk.off:
            raise Crashed
        return result


async def _of(task: asyncio.Task[T]) -> T:
    return await task


class _LogRecords(logging.Handler):
    def __init__(self, records: list[logging.LogRecord]) -> None:
        super().__init__()
        self._records = records

    def emit(self, record: logging.LogRecord) -> None:
        self._records.append(record)
