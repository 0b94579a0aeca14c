"""Workers from a SLURM queue, through dask-jobqueue: each job takes its share of a node, and each
worker has one thread.

Items travel to the workers and their arrays travel back, so nodes need flexdt installed but no
shared folder.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from flexdt.clients.batch.executors import SINGLE, dask_executor
from flexdt.twin.errors import TwinError


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

    jobs: int = 4
    cores: int = 4
    memory: str = "8GiB"
    walltime: str = "01:00:00"
    queue: str | None = None
    account: str | None = None
    extra: tuple[str, ...] = ()
    setup: tuple[str, ...] = field(default_factory=tuple)


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


def _cluster(wanted: Slurm) -> Any:
    try:
        from dask_jobqueue import SLURMCluster
    except ImportError:
        raise TwinError(
            "SLURM needs dask-jobqueue, which is not installed: pip install 'flexdt[slurm]'",
            {"asked": "slurm"},
        ) from None
    return SLURMCluster(
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
