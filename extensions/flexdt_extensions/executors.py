"""Executors for tasks: processes of this machine, a dask scheduler, or a cluster's queue.

Functions and their arguments must be picklable, because they travel to another process.

A cluster's workers come from a SLURM queue, through dask-jobqueue: each job takes its share of a
node, and each worker has one thread.

Items travel to the workers and their arrays travel back, so nodes need flexdt installed but no
shared folder.

The TOML files of batches and SLURM jobs are read here; errors name file, key path and value.
"""

from __future__ import annotations

import logging
import os
import signal
import threading
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

from flexdt.extending import CommandError, message_of, package
from flexdt.twin.errors import TwinError


def read_toml(path: Path) -> dict[str, Any]:
    """The content of a TOML file.

    Raises:
        CommandError: no TOML.
        OSError: the file cannot be read.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise CommandError(f"{path}: no TOML: {error}") from None


def problems_of(name: str, error: ValidationError) -> list[str]:
    """What is wrong in a document, line by line, with key paths."""
    lines = []
    for e in error.errors(include_url=False, include_context=False):
        path = ".".join(str(part) for part in e["loc"]) or "plan"
        message = message_of(e)
        shown = "" if isinstance(e["input"], dict | BaseModel) else f" (got {e['input']!r})"
        lines.append(f"{name}: {path}: {message}{'' if 'got' in message else shown}")
    return lines


_NUMBERED: Final = ("NUMBA_NUM", "OMP_NUM", "OPENBLAS_NUM", "MKL_NUM", "VECLIB_MAXIMUM")
SINGLE: Final[Mapping[str, str]] = {f"{name}_THREADS": "1" for name in _NUMBERED}
"""Environment of workers that share a machine: one thread each, so sums have one order."""

SCHEDULER_S = 10.0
"""How long to try to reach a dask scheduler."""
REFUSED: Final = 4
"""Exit code where there is no connection."""


def executor(jobs: int | None, scheduler: str | None) -> AbstractContextManager[Executor | None]:
    """Something to map tasks with: a dask scheduler, own processes, or None for this process."""
    if scheduler is not None:
        return dask_executor(scheduler)
    return nullcontext() if _count(jobs) <= 1 else processes(jobs)


def _count(jobs: int | None) -> int:
    return os.cpu_count() or 1 if jobs is None else jobs


@contextmanager
def processes(jobs: int | None) -> Iterator[Executor]:
    """Processes that start afresh, use one thread each, and end with this one, however it ends.

    Afresh, because a fork of a process whose kernels run in threads (OpenMP) is ended by them.
    """
    before = {name: os.environ[name] for name in SINGLE if name in os.environ}
    pool = ProcessPoolExecutor(_count(jobs), get_context("spawn"), initializer=_end_with_parent)
    os.environ.update(SINGLE)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)
        for name in SINGLE:
            os.environ.pop(name, None)
        os.environ.update(before)


def _end_with_parent() -> None:
    """End this worker when its parent has ended; by itself it would wait for work for ever.

    Ctrl-C in a terminal reaches every process; it is the parent that decides.
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
def dask_executor(address: Any) -> Iterator[Executor]:
    """The workers of a dask scheduler.

    Args:
        address: of a scheduler, or a cluster object of dask.

    Raises:
        TwinError: dask.distributed is not installed, or what is given is no address.
        CommandError: the scheduler cannot be reached or is lost, or workers die of a task.
    """
    distributed = package("distributed", "a scheduler", "batch", "flexdt-extensions")
    # What these log of a lost scheduler comes as one line from here.
    for name in ("distributed", "distributed.client", "tornado.application", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = distributed.Client(address, timeout=SCHEDULER_S)
    except OSError as error:
        raise CommandError(f"no dask scheduler at {address}: {error}", REFUSED) from None
    except ValueError as error:
        raise TwinError(
            f"{str(address)!r} is no address of a dask scheduler, e.g. 10.0.0.1:8786: {error}",
            {"asked": str(address)},
        ) from None
    try:
        with client, client.get_executor() as pool:
            yield pool
    except CancelledError:
        raise CommandError(
            f"the dask scheduler at {address} is lost; once there is one, run the command again to "
            "go on",
            REFUSED,
        ) from None
    except distributed.KilledWorker as error:
        raise CommandError(
            f"workers died of the same task again and again (too little memory?): {error}; run the "
            "command again to go on"
        ) from None


@dataclass(frozen=True)
class Slurm:
    """What to ask SLURM for.

    Attributes:
        jobs: how many jobs.
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
    """What to ask SLURM for from a TOML file with the names of `Slurm`; the others keep defaults.

    Raises:
        CommandError: no TOML, or every problem with its name.
        OSError: the file cannot be read.
    """
    try:
        return TypeAdapter(Slurm).validate_python(read_toml(path))
    except ValidationError as error:
        raise CommandError(problems_of(str(path), error)) from None


def job_script(wanted: Slurm) -> str:
    """The script each SLURM job runs, as dask-jobqueue writes it.

    Raises:
        TwinError: dask-jobqueue is not installed.
    """
    with _cluster(wanted) as cluster:
        return str(cluster.job_script())


@contextmanager
def slurm_executor(wanted: Slurm) -> Iterator[Executor]:
    """The workers of SLURM jobs that this submits, and cancels at the end.

    Raises:
        TwinError: dask-jobqueue is not installed, or `sbatch` is not here.
    """
    import shutil

    if shutil.which("sbatch") is None:
        raise TwinError(
            "there is no sbatch here: run on a login node, or print the job's script with "
            "--slurm-script and use --scheduler",
            {"asked": "slurm"},
        )
    with _cluster(wanted) as cluster:
        cluster.scale(jobs=wanted.jobs)
        with dask_executor(cluster) as pool:
            yield pool


def slurm_workers(path: Path) -> AbstractContextManager[Executor]:
    """As `slurm_executor`, for what a TOML file asks; see `read_slurm`."""
    return slurm_executor(read_slurm(path))


def _cluster(wanted: Slurm) -> Any:
    return package("dask_jobqueue", "SLURM", "slurm", "flexdt-extensions").SLURMCluster(
        queue=wanted.queue,
        account=wanted.account,
        cores=wanted.cores,
        processes=wanted.cores,
        memory=wanted.memory,
        walltime=wanted.walltime,
        job_extra_directives=list(wanted.extra),
        job_script_prologue=[*wanted.setup, *(f"export {k}={v}" for k, v in SINGLE.items())],
        scheduler_options={"dashboard": False},
    )
