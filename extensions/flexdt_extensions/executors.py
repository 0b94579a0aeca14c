"""Executors for tasks: processes of this machine, a dask scheduler, or a cluster's queue.

Functions and their arguments must be picklable, because they travel to another process.

A cluster's workers come from a SLURM queue (`slurm_jobs`), by the script that
dask-jobqueue writes: each job takes its share of a node, and each worker has one thread.
While a cluster has no workers, `cluster_watch` prints the reason.

Items travel to the workers and their arrays travel back, so nodes need flexdt installed
but no shared folder.

The TOML files of batches and SLURM jobs are read here; errors name file, key path and
value.
"""

from __future__ import annotations

import logging
import os
import signal
import socket
import threading
import time
import tomllib
from collections.abc import Iterator, Mapping
from concurrent.futures import CancelledError, Executor, ProcessPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from multiprocessing import connection, get_context, parent_process
from pathlib import Path
from typing import Annotated, Any, Final

from annotated_types import Ge
from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from flexdt.extending import CommandError, package, problem_words
from flexdt.twin.errors import TwinError
from flexdt_extensions.cluster_watch import ClusterWatch
from flexdt_extensions.slurm_jobs import REFUSED, SlurmJobs, Tend, lifetime_s


def read_toml(path: Path) -> dict[str, Any]:
    """Read and parse a TOML file in UTF-8.

    Raises:
        CommandError: it is no TOML; names the file.
        OSError: the file cannot be read.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise CommandError(f"{path}: no TOML: {error}") from None


def problems_of(name: str, error: ValidationError) -> list[str]:
    """List the problems of a document, one line each: name, key path, message and the
    value given (unless that is a table).
    """
    lines = []
    for e in error.errors(include_url=False):
        path = ".".join(str(part) for part in e["loc"]) or "plan"
        message = problem_words(e)
        if isinstance(e["input"], dict | BaseModel):
            shown = ""
        else:
            shown = f" (got {e['input']!r})"
        lines.append(f"{name}: {path}: {message}{'' if 'got' in message else shown}")
    return lines


_NUMBERED: Final = ("NUMBA_NUM", "OMP_NUM", "OPENBLAS_NUM", "MKL_NUM", "VECLIB_MAXIMUM")
SINGLE: Final[Mapping[str, str]] = {f"{name}_THREADS": "1" for name in _NUMBERED}
"""Environment of workers that share a machine: one thread each, so sums have one order."""

SCHEDULER_S = 10.0
"""Time for which nothing may listen at a scheduler's address before that is an error [s]."""
ANSWER_S = 600.0
"""Time that a scheduler or worker that is there may take for an answer [s]: it may have work, and
its machine may pause. A connection that breaks is told at once."""


def executor(
    jobs: int | None, scheduler: str | None
) -> AbstractContextManager[Executor | None]:
    """Choose an executor to map tasks with.

    A scheduler comes before `jobs`. `jobs` None is the number of cores.

    Returns:
        A context that yields the executor of a dask scheduler or of own processes; None
        for at most one job.
    """
    if scheduler is not None:
        return dask_executor(scheduler)
    if _count(jobs) <= 1:
        return nullcontext()
    return processes(jobs)


def _count(jobs: int | None) -> int:
    return os.cpu_count() or 1 if jobs is None else jobs


@contextmanager
def processes(jobs: int | None) -> Iterator[Executor]:
    """Start `jobs` spawned processes of one thread each, which end with this one, however
    it ends.

    They are spawned, as the kernels' threads (OpenMP) would end a fork. Meanwhile the
    environment limits libraries to one thread; it is restored at the end, where waiting
    tasks are canceled.
    """
    before = {name: os.environ[name] for name in SINGLE if name in os.environ}
    pool = ProcessPoolExecutor(
        _count(jobs), get_context("spawn"), initializer=_end_with_parent
    )
    os.environ.update(SINGLE)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)
        for name in SINGLE:
            os.environ.pop(name, None)
        os.environ.update(before)


def _end_with_parent() -> None:
    """Ignore SIGINT in this worker and exit it at once with code 1 when its parent has
    ended.

    Ctrl-C in a terminal reaches every process; the parent decides. Without a parent
    process nothing is watched.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    if parent is None:
        return
    sentinel = parent.sentinel

    def watch() -> None:
        connection.wait([sentinel])
        os._exit(1)

    threading.Thread(target=watch, name="parent-watch", daemon=True).start()


@contextmanager
def dask_executor(address: Any, tend: Tend | None = None) -> Iterator[Executor]:
    """Connect to the workers of a dask scheduler, and watch them while the context lasts.

    Silences the log of dask and its connections for the whole process. An error in the
    context that is not the cluster's is raised as it is.

    Args:
        address: of a scheduler, or a cluster object of dask.
        tend: called at each look at the workers while the work goes on; None prints where
            there are none.

    Yields:
        Their executor.

    Raises:
        TwinError: dask.distributed is not installed, or `address` is not valid.
        CommandError: the scheduler cannot be reached or is lost, or workers die of a
            task.
    """
    distributed = package("distributed", "a scheduler", "batch", "flexdt-extensions")
    # Their messages about a lost scheduler are replaced by one line from here.
    for name in ("distributed", "distributed.client", "tornado.application", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        if isinstance(address, str):
            _wait_for_listener(address)
        client = distributed.Client(address, timeout=ANSWER_S)
    except OSError as error:
        raise CommandError(f"no dask scheduler at {address}: {error}", REFUSED) from None
    except ValueError as error:
        raise TwinError(
            f"{str(address)!r} is no address of a dask scheduler, e.g. 10.0.0.1:8786: {error}",
            {"asked": str(address)},
        ) from None
    watch = ClusterWatch(
        client, tend or (lambda workers: [] if workers else [_none_at(address)])
    )
    try:
        with client, watch, client.get_executor() as pool:
            yield pool
    except Exception as error:
        if (
            watch.error is not None
        ):  # it has closed the client, which ends the work in its own ways
            raise watch.error from None
        told = _readable_error(error, address, distributed.KilledWorker)
        if told is None:
            raise
        raise told from None


def _wait_for_listener(address: str) -> None:
    """Wait until connections to a dask address are accepted, `SCHEDULER_S` at most.

    The system accepts them for a process that is busy or stopped; where there is none it refuses.
    Nothing is asked of an address without host and port.

    Raises:
        OSError: nothing listens there.
        ValueError: `address` is not valid.
    """
    from distributed.comm.addressing import get_address_host_port, parse_address

    if parse_address(address)[0] not in ("tcp", "tls", "ws", "wss"):
        return
    place = get_address_host_port(address)
    until = time.monotonic() + SCHEDULER_S
    while True:
        try:
            socket.create_connection(place, timeout=SCHEDULER_S).close()
            return
        except OSError:
            if time.monotonic() >= until:
                raise
        time.sleep(0.1)


def _readable_error(
    error: Exception, address: Any, killed: type[Exception]
) -> CommandError | None:
    """Convert an error of dask, a lost scheduler or workers that died of one task, to one
    for people.

    Args:
        error: of any kind.
        address: of the scheduler.
        killed: dask's error on workers that died.

    Returns:
        The error; None for any other error.
    """
    if isinstance(error, CancelledError):
        return CommandError(
            f"the dask scheduler at {address} is lost; "
            "once there is one, run the command again to go on",
            REFUSED,
        )
    if isinstance(error, killed):
        return CommandError(
            "workers died of the same task again and again (too little memory?): "
            f"{error}; run the "
            "command again to go on"
        )
    return None


def _none_at(address: Any) -> str:
    return f"waits for workers of the dask scheduler at {address}: it has none"


@dataclass(frozen=True)
class Slurm:
    """Request to SLURM.

    Attributes:
        jobs: number of jobs.
        cores: of each; as many workers.
        memory: of each job, e.g. "8GiB".
        walltime: of each job, HH:MM:SS.
        queue, account: where the site wants them.
        extra: further directives, e.g. "--gres=gpu:1".
        setup: lines of shell before the workers start, e.g. "module load python".
    """

    __pydantic_config__ = ConfigDict(extra="forbid")
    jobs: Annotated[int, Ge(1)] = 4
    cores: Annotated[int, Ge(1)] = 4
    memory: str = "8GiB"
    walltime: str = "01:00:00"
    queue: str | None = None
    account: str | None = None
    extra: tuple[str, ...] = ()
    setup: tuple[str, ...] = ()


def read_slurm(path: Path) -> Slurm:
    """Read a request to SLURM from a TOML file with the names of `Slurm`; the others keep
    defaults.

    Raises:
        CommandError: no TOML, or every problem with its name.
        OSError: the file cannot be read.
    """
    try:
        return TypeAdapter(Slurm).validate_python(read_toml(path))
    except ValidationError as error:
        raise CommandError(problems_of(str(path), error)) from None


def job_script(wanted: Slurm) -> str:
    """Write the script each SLURM job runs, as dask-jobqueue does.

    Raises:
        TwinError: dask-jobqueue is not installed.
    """
    with _cluster(wanted) as cluster:
        return str(cluster.job_script())


@contextmanager
def slurm_executor(wanted: Slurm) -> Iterator[Executor]:
    """Submit SLURM jobs and connect to their workers; cancel the jobs at the end.

    Jobs that end early are replaced while the context lasts.

    Args:
        wanted: number, size and queue of the jobs.

    Yields:
        The workers' executor.

    Raises:
        TwinError: dask-jobqueue is not installed, or `sbatch` is not here.
        CommandError: sbatch refuses the jobs, or they end before their workers come.
    """
    import shutil

    if shutil.which("sbatch") is None:
        raise TwinError(
            "there is no sbatch here: run on a login node, or print the job's script with "
            "--slurm-script and use --scheduler",
            {"asked": "slurm"},
        )
    with _cluster(wanted) as cluster:
        jobs = SlurmJobs(str(cluster.job_script()), wanted.jobs)
        try:
            jobs.submit()
            with dask_executor(cluster, jobs.tend) as pool:
                yield pool
        finally:
            jobs.close()


def slurm_workers(path: Path) -> AbstractContextManager[Executor]:
    """Start the workers of a TOML file's request; see `slurm_executor` and
    `read_slurm`."""
    return slurm_executor(read_slurm(path))


@contextmanager
def _same_signals() -> Iterator[None]:
    """Restore this process's signal handlers at the end of the context.

    dask-jobqueue sets one when it is imported, with which Ctrl-C would end a program as
    if all were done.
    """
    before = {number: signal.getsignal(number) for number in signal.valid_signals()}
    try:
        yield
    finally:
        for number, handler in before.items():
            if handler is not None and signal.getsignal(number) is not handler:
                signal.signal(number, handler)


def _cluster(wanted: Slurm) -> Any:
    """Make dask-jobqueue's cluster, without workers.

    One process for each core, each library with one thread.

    Args:
        wanted: size, queue and set-up of each job; workers leave before its walltime
            ends.

    Raises:
        TwinError: dask-jobqueue is not installed.
    """
    with _same_signals():
        jobqueue = package("dask_jobqueue", "SLURM", "slurm", "flexdt-extensions")
    lifetime = lifetime_s(wanted.walltime)
    return jobqueue.SLURMCluster(
        queue=wanted.queue,
        account=wanted.account,
        cores=wanted.cores,
        processes=wanted.cores,
        memory=wanted.memory,
        walltime=wanted.walltime,
        job_extra_directives=list(wanted.extra),
        job_script_prologue=[
            *wanted.setup,
            *(f"export {k}={v}" for k, v in SINGLE.items()),
        ],
        worker_extra_args=[] if lifetime is None else ["--lifetime", f"{lifetime}s"],
        scheduler_options={"dashboard": False},
    )
