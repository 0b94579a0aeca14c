"""What `ProcessPoolExecutor` does when its worker is killed: at work, or while bytes travel.

    python tests/studies/executor_kills.py

docs/decisions/0018-worker-processes.md quotes it.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from pathlib import Path

SIZE = 400 << 20
READ = 30 << 20
"""Bytes of a result that have been read when its sender is killed."""
PATIENCE_S = 10.0


def received() -> int:
    """Bytes that this process has read so far, from whatever."""
    lines = Path("/proc/self/io").read_text("ascii").splitlines()
    return int(next(line for line in lines if line.startswith("rchar")).split()[1])


def at_work(pool: ProcessPoolExecutor, pid: int) -> Future[object]:
    """Killed while it works."""
    future: Future[object] = pool.submit(time.sleep, 60.0)
    time.sleep(0.5)
    os.kill(pid, signal.SIGKILL)
    return future


def taking_arguments(pool: ProcessPoolExecutor, pid: int) -> Future[object]:
    """Killed while its arguments come."""
    os.kill(pid, signal.SIGSTOP)
    future: Future[object] = pool.submit(len, bytes(SIZE))
    time.sleep(1.5)
    os.kill(pid, signal.SIGKILL)
    return future


def sending_a_result(pool: ProcessPoolExecutor, pid: int) -> Future[object]:
    """Kill a worker by SIGKILL while its result is on the way, once READ bytes of it have
    come.

    Returns:
        The future of that result.
    """
    before = received()
    future: Future[object] = pool.submit(bytes, SIZE)
    while received() - before < READ:
        time.sleep(0.0005)
    os.kill(pid, signal.SIGKILL)
    return future


CASES: tuple[Callable[[ProcessPoolExecutor, int], Future[object]], ...] = (
    at_work, taking_arguments, sending_a_result,
)  # fmt: skip


def main() -> None:
    """Print what becomes of each future, and whether the pool's thread ends."""
    print(f"Python {sys.version.split()[0]}")
    for case in CASES:
        pool = ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"))
        future = case(pool, pool.submit(os.getpid).result())
        try:
            how = type(future.exception(PATIENCE_S)).__name__
        except TimeoutError:
            how = f"no end within {PATIENCE_S:g} s"
        except BrokenExecutor as error:
            how = type(error).__name__
        thread = vars(pool)["_executor_manager_thread"]
        pool.shutdown(wait=False)
        if thread is not None:
            thread.join(5.0)
        alive = thread is not None and thread.is_alive()
        print(
            f"{case.__name__}: {how}; the pool's thread {'lives on' if alive else 'has ended'}"
        )
    sys.stdout.flush()
    os._exit(0)  # Python's own end would wait for the thread that lives on


if __name__ == "__main__":
    main()
