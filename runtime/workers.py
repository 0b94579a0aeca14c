"""Processes for heavy work: parsing, planning, sweeping, strangers' files (see `worker`).

A process is started when it is first needed and kept for a while. It is replaced after
work that took much memory, and ended when its work takes too long, dies, or is no longer
wanted; only the requester gets an error.
"""

from __future__ import annotations

import asyncio
import json
import os
import pickle
import selectors
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

from flexdt.message_words import reason_of
from flexdt.protocol.rpc_errors import Code, RpcError, busy, too_large
from flexdt.runtime.fair_turns import FairTurns
from flexdt.runtime.process import process_seconds
from flexdt.runtime.worker import Parts, Work, receive_parts, send_parts

MAX_KEPT_BYTES = 400 << 20
"""Memory above which a process is replaced, so that it is given back [bytes]."""
MAX_IDLE_S = 120.0
"""Time for which a process without work is kept [s]."""
CHECK_INTERVAL_S = 0.2
"""Interval at which the processor time of a working process is checked [s]."""
ENVIRONMENT = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
}
"""Environment that restricts numerical libraries to one thread."""


class Worker:
    """One process; its methods block, so call them from a thread.

    Args:
        memory_bytes: that it may take.
    """

    def __init__(self, memory_bytes: int) -> None:
        """Start a worker process with a memory limit [bytes], connected by a socket pair.

        It inherits the environment without the token and with one thread for each
        library; its standard streams go nowhere.

        Raises:
            OSError: the system cannot start a process.
        """
        self._memory = memory_bytes
        ours, theirs = socket.socketpair()
        # It reads strangers' files, and has no use for the token.
        environment = {k: v for k, v in os.environ.items() if k != "FLEXDT_TOKEN"}
        try:
            self._process = subprocess.Popen(
                [
                    sys.executable,
                    "-P",
                    "-m",
                    "flexdt.runtime.worker",
                    str(theirs.fileno()),
                    str(memory_bytes),
                ],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                env={**environment, **ENVIRONMENT},
            )
        except BaseException:
            ours.close()
            raise
        finally:
            # While this process holds that end, too, it would never see the worker close it.
            theirs.close()
        self._channel = ours
        self.kept = True
        """Whether it may have further work."""

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def ask(
        self, work: Work, arguments: Sequence[object], raw: Parts, seconds: float
    ) -> list[bytes]:
        """Have one piece of work done by the process, and return its parts; blocks.

        Any failure but a refusal kills the process, and so does a peak memory above
        `MAX_KEPT_BYTES`, after the answer.

        Args:
            work: function called there.
            arguments: that it takes first, pickled.
            raw: that it takes after them, sent as they are.
            seconds: of processor time that it may take; doing nothing for so long ends
                it, too.

        Raises:
            RpcError: the work's own refusal; -32008 where it takes too long, too much
                memory, or ends its process.
            RuntimeError: a fault of ours, with its traceback.
        """
        sound = False
        try:
            # Of each transfer; how long the work may take is processor time, see `_wait`.
            self._channel.settimeout(seconds)
            call = pickle.dumps((work, arguments))
            send_parts(self._channel, [f"{seconds}".encode(), call, *raw])
            self._wait(seconds)
            how, peak, *answer = receive_parts(self._channel)
            # Running out of memory may leave anything half made, and only its end gives what a
            # large process took back to the system.
            sound = how in (b"done", b"refused") and int(peak) <= MAX_KEPT_BYTES
        except TimeoutError:
            raise too_large(
                _label(work), f"more than {seconds:g}", seconds, "s"
            ) from None
        except (OSError, EOFError, ValueError):
            raise self._end_error(work, seconds) from None
        finally:
            # An answer that came later would be taken for that of the next request.
            if not sound:
                self.kill()
        match how:
            case b"done":
                return answer
            case b"refused":
                raise RpcError(*json.loads(answer[0]))
            case b"memory":
                limit_mib = self._memory >> 20
                raise too_large(
                    _label(work), f"more than {limit_mib}", limit_mib, "MiB of memory"
                )
        raise RuntimeError(answer[0].decode("utf-8", "replace"))

    def _wait(self, seconds: float) -> None:
        """Wait until an answer begins, without reading it.

        Where processor time cannot be read, real time counts.

        Args:
            seconds: of processor time that the work may take; doing nothing for so long
                ends the wait, too.

        Raises:
            TimeoutError: the work has used, or done nothing for, so much time.
        """
        # Not the time that passes: work must not fail because the machine is busy.
        begun = used = process_seconds(self.pid)
        since = time.monotonic()
        with selectors.DefaultSelector() as answer:
            answer.register(self._channel, selectors.EVENT_READ)
            while not answer.select(min(CHECK_INTERVAL_S, seconds)):
                now = process_seconds(self.pid)
                if now != used:
                    used = now
                    since = time.monotonic()
                if now is None or begun is None:
                    worked = 0.0
                else:
                    worked = now - begun
                if worked > seconds or time.monotonic() - since > seconds:
                    raise TimeoutError

    def _end_error(self, work: Work, seconds: float) -> RpcError:
        """Kill the process, and make, not raise, the error -32008 that it ended during
        its work.

        It has the exit code and the allowed seconds and memory.
        """
        self.kill()
        return RpcError(
            Code.TOO_LARGE,
            f"the process of {_label(work)} ended with code {self._process.returncode}",
            {
                "asked": _label(work),
                "allowed": {"seconds": seconds, "memory_bytes": self._memory},
            },
        )

    def stop(self) -> None:
        """End the process without waiting for it; the requester gets an error."""
        self.kept = False
        self._process.kill()

    def kill(self) -> None:
        """Kill the process unless it has ended, wait for its end, and close the channel."""
        with suppress(OSError):
            self.stop()
        self._process.wait()
        self._channel.close()


class Workers:
    """Some processes for the pieces of work of one server.

    Args:
        count: at a time; further work waits its turn.
        memory_bytes: of each.
        seconds: of processor time that one piece of work may take.
        most_waiting: requests that may wait for a place; None for any number.
    """

    def __init__(
        self,
        count: int,
        memory_bytes: int,
        seconds: float,
        most_waiting: int | None = None,
    ) -> None:
        """Set up `count` places for work at a time; no process starts before the first work.

        A process has `memory_bytes`, a piece of work `seconds`. Places are given by
        client in turn (`fair_turns`), to at most `most_waiting` who wait.
        """
        self.memory_bytes = memory_bytes
        self.seconds = seconds
        self._turns = FairTurns(count, most_waiting)
        self._threads = ThreadPoolExecutor(count, thread_name_prefix="worker")
        self._idle: list[Worker] = []
        self._timer: asyncio.TimerHandle | None = None

    @property
    def ready(self) -> bool:
        """Whether one is idle."""
        return bool(self._idle)

    async def ask(self, work: Work, *arguments: object, raw: Parts = ()) -> list[bytes]:
        """Have one piece of work done by an idle or a new worker, once there is a free
        place.

        If this is canceled, the worker is stopped. Afterwards a worker that may have
        further work becomes idle.

        Args:
            work: function that a worker calls.
            arguments: of the function.
            raw: its binary arguments, which are not pickled.

        Returns:
            The parts that the function returns.

        Raises:
            RpcError: as `Worker.ask`; -32003, no process could be started, or too many
                requests wait.
            RuntimeError: as `Worker.ask`.
        """
        # First the place, then the process: requests that wait hold none.
        async with self._turns:
            loop = asyncio.get_running_loop()
            worker = self._idle.pop() if self._idle else None
            if worker is None:
                # In a thread, because a start blocks for as long as the system takes.
                worker = await loop.run_in_executor(self._threads, self._new)
            asked = loop.run_in_executor(
                self._threads, worker.ask, work, arguments, raw, self.seconds
            )
            try:
                # A thread cannot be cancelled: it reads until `stop` has ended the process.
                return await asyncio.shield(asked)
            except asyncio.CancelledError:
                worker.stop()
                asked.add_done_callback(
                    lambda asked: asked.exception()
                )  # retrieved, so that asyncio does not log it
                raise
            finally:
                self._keep(worker)

    def _new(self) -> Worker:
        """Start a worker process.

        Raises:
            RpcError: -32003, no process could be started; the caller may try again.
        """
        try:
            return Worker(self.memory_bytes)
        except OSError as error:  # descriptors, processes or memory have run out
            data = {"allowed": "try again later"}
            raise busy(f"no process could be started: {reason_of(error)}", data) from None

    def _keep(self, worker: Worker) -> None:
        """Make a worker idle if it may have further work, and begin anew the `MAX_IDLE_S`
        after which all idle ones are ended.
        """
        if worker.kept:
            self._idle.append(worker)
        if self._timer is not None:
            self._timer.cancel()
        self._timer = asyncio.get_running_loop().call_later(MAX_IDLE_S, self.rest)

    def rest(self) -> None:
        """End the idle processes and the timer; those at work go on."""
        while self._idle:
            self._idle.pop().kill()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def close(self) -> None:
        """End the idle processes, and the threads without waiting for those at work."""
        self.rest()
        # Workers at work end by themselves as soon as our end of their socket is closed.
        self._threads.shutdown(wait=False)


def _label(work: Work) -> str:
    """Name a piece of work by its module."""
    return "the work of " + work.__module__.rsplit(".", 1)[-1].replace("_", " ")
