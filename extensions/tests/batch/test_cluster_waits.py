"""Waits for a cluster, before a false SLURM that refuses, delays, kills and ends jobs."""

from __future__ import annotations

import asyncio
import inspect
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import Executor, wait
from pathlib import Path
from typing import Any

import pytest

from flexdt.extending import CommandError
from flexdt_extensions import cluster_watch, executors, slurm_jobs
from flexdt_extensions.executors import Slurm, dask_executor, slurm_executor
from flexdt_extensions.slurm_jobs import PLACEHOLDER, SlurmJobs, lifetime_s

WORDS = "Batch job submission failed: Invalid account or account/partition combination specified"
COMMANDS = {
    # A job is a process group of this machine, and a file with its state while it is in the
    # queue.
    "sbatch": """
cd {folder}
echo x >> submitted
case {mode} in
  refuses) echo "sbatch: error: {words}" >&2; exit 1;;
  delays) before="sleep 2; ";;
  ends) before="exit 3; ";;
  kills) [ "$(wc -l < submitted)" -gt 1 ] || after="sleep {kill_s}; kill -9 -- -\\$\\$";;
esac
cp "$1" job.sh
setsid bash -c "$before (bash job.sh) & ${{after:-true}}; wait; rm -f \\$\\$.job" > log 2>&1 & id=$!
[ {mode} = ends ] || echo "PENDING (Priority)" > $id.job
[ -z "$after" ] || (sleep {kill_s}; sleep 0.3; rm -f $id.job) > log 2>&1 &
echo "Submitted batch job $id"
""",
    "squeue": """
cd {folder}
for j in *.job; do [ -e "$j" ] && echo "${{j%.job}} $(cat $j)"; done
true
""",
    "sacct": 'echo "TIMEOUT|0:15"',
    "scancel": "for job; do kill -9 -- -$job; rm -f {folder}/$job.job; done",
}

FalseSlurm = Callable[..., Path]


@pytest.fixture
def false_slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FalseSlurm:
    """Puts a cluster's commands in front of PATH; returns the folder of its jobs."""

    def make(mode: str, kill_s: float = 0.0) -> Path:
        folder, bin_ = tmp_path / "jobs", tmp_path / "bin"
        for path in (folder, bin_):
            path.mkdir()
        for name, text in COMMANDS.items():
            written = text.format(folder=folder, mode=mode, words=WORDS, kill_s=kill_s)
            (bin_ / name).write_text(f"#!/bin/bash\n{written}\n")
            (bin_ / name).chmod(0o755)
        monkeypatch.setenv("PATH", f"{bin_}:{os.environ['PATH']}")
        monkeypatch.chdir(tmp_path)
        return folder

    monkeypatch.setattr(cluster_watch, "EVERY_S", 0.5)
    return make


def submitted(folder: Path) -> int:
    return len((folder / "submitted").read_text().splitlines())


SMALL = Slurm(jobs=1, cores=1, memory="1GiB")


def test_what_sbatch_refuses_is_said_in_its_words_at_once(
    false_slurm: FalseSlurm,
) -> None:
    folder = false_slurm("refuses")
    said = "Invalid account or account/partition"
    with pytest.raises(CommandError, match=said) as told, slurm_executor(SMALL):
        raise AssertionError("there is no work without jobs")
    assert told.value.exit_code == 4
    assert submitted(folder) == 1


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_a_queue_that_delays_is_told_with_its_reason(
    false_slurm: FalseSlurm, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = false_slurm("delays")
    with slurm_executor(SMALL) as pool:
        assert list(pool.map(math.sqrt, [4.0, 9.0])) == [2.0, 3.0]
    said = capsys.readouterr().err.splitlines()
    assert any(
        "waits for workers of jobs" in line and "PENDING (Priority)" in line
        for line in said
    )
    assert submitted(folder) == 1
    assert not list(folder.glob("*.job"))  # cancelled at the end


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_a_job_that_a_walltime_ends_is_submitted_again(
    false_slurm: FalseSlurm, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = false_slurm("kills", kill_s=6.0)
    with slurm_executor(SMALL) as pool:
        assert list(pool.map(time.sleep, [0.3] * 60)) == [None] * 60
    said = capsys.readouterr().err
    assert "has ended (TIMEOUT, exit code 0:15); another one is submitted" in said
    assert submitted(folder) == 2


def _as_a_batch_does(pool: Executor) -> None:
    flying = [pool.submit(math.sqrt, 4.0) for _ in range(20)]
    try:
        wait(flying)
        flying[0].result()
    finally:
        for future in flying:
            future.cancel()


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_jobs_that_end_before_their_workers_come_end_the_waiting(
    false_slurm: FalseSlurm, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = false_slurm("ends")
    said = "3 jobs have ended before a worker of theirs came"
    with pytest.raises(CommandError, match=said), slurm_executor(SMALL) as pool:
        _as_a_batch_does(pool)
    assert submitted(folder) == 3


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_a_scheduler_without_workers_is_told(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from distributed import LocalCluster

    monkeypatch.setattr(cluster_watch, "EVERY_S", 0.2)
    with (
        LocalCluster(
            n_workers=0, threads_per_worker=1, dashboard_address=":0"
        ) as cluster,
        dask_executor(cluster.scheduler_address) as pool,
    ):
        there = cluster.scheduler_address
        line = f"waits for workers of the dask scheduler at {there}: it has none"
        waiting, said = pool.submit(math.sqrt, 16.0), []
        while said.count(line) < 2:
            time.sleep(0.1)
            said += capsys.readouterr().err.splitlines()
        cluster.scale(1)
        assert waiting.result() == 4.0


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_a_scheduler_that_is_slow_is_waited_for(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The time limit is for an address where nothing listens, and for no answer of one that is."""
    from distributed import LocalCluster

    monkeypatch.setattr(executors, "SCHEDULER_S", 0.3)
    monkeypatch.setattr(cluster_watch, "EVERY_S", 0.2)
    monkeypatch.setattr(cluster_watch, "LOOK_S", 0.3)
    with LocalCluster(
        n_workers=0, threads_per_worker=1, dashboard_address=":0"
    ) as cluster:
        answers = cluster.scheduler.handlers
        at_once = {name: answers[name] for name in ("identity", "run_function")}

        def slowly(name: str) -> Callable[..., Any]:
            async def answer(*given: Any, **named: Any) -> Any:
                await asyncio.sleep(1.0)
                done = at_once[name](*given, **named)
                return await done if inspect.isawaitable(done) else done

            return answer

        answers |= {name: slowly(name) for name in at_once}
        with dask_executor(cluster.scheduler_address) as pool:
            waiting, said = pool.submit(math.sqrt, 16.0), ""
            time.sleep(1.0)  # the first looks are given up
            answers |= at_once
            while "it has none" not in said:  # the watch goes on
                time.sleep(0.1)
                said += capsys.readouterr().err
            cluster.scale(1)
            assert waiting.result() == 4.0


def test_signal_handlers_stay_as_they_were() -> None:
    """dask-jobqueue sets one when it is imported, so this needs a fresh process."""
    program = (
        "import signal; before = {n: signal.getsignal(n) for n in signal.valid_signals()}\n"
        "from flexdt_extensions.executors import Slurm, job_script\n"
        "job_script(Slurm())\n"
        "assert {n: signal.getsignal(n) for n in signal.valid_signals()} == before\n"
        "import os, time; os.kill(os.getpid(), signal.SIGINT); time.sleep(5)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], check=False, timeout=200,
                          capture_output=True, text=True)  # fmt: skip
    assert done.returncode == -signal.SIGINT, done.stderr
    assert "KeyboardInterrupt" in done.stderr


class Queue:
    """A queue as the commands show it, for drawn histories without processes."""

    def __init__(self) -> None:
        self.listed: dict[str, str] = {}
        self.submitted = 0
        self.refuses = self.silent = False

    def run(self, *words: str) -> subprocess.CompletedProcess[str]:
        out, code, error = "", 0, ""
        if words[0] == "squeue":
            out = "".join(f"{job} {state}\n" for job, state in self.listed.items())
            code, error = (
                (1, "Unable to contact slurm controller") if self.silent else (0, "")
            )
        elif words[0] == "sbatch" and self.refuses:
            code, error = 1, WORDS
        elif words[0] == "sbatch":
            assert PLACEHOLDER not in Path(words[1]).read_text()
            self.submitted += 1
            out = f"Submitted batch job {self.submitted}"
            self.listed[str(self.submitted)] = "PENDING (Priority)"
        return subprocess.CompletedProcess(words, code, out, error)


@pytest.mark.parametrize("seed", range(30))
def test_as_many_jobs_as_wanted_are_in_the_queue_whatever_ends(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    import random

    rng, queue = random.Random(seed), Queue()
    monkeypatch.setattr(slurm_jobs, "_run", queue.run)
    wanted = rng.randint(1, 4)
    jobs = SlurmJobs(f"run --name {PLACEHOLDER}", wanted)
    jobs.submit()
    for _ in range(60):
        queue.refuses, queue.silent = rng.random() < 0.2, rng.random() < 0.2
        running = [
            job for job in jobs.jobs if job.id in queue.listed and rng.random() < 0.8
        ]
        workers = [f"{job.name}-{i}" for job in running for i in range(2)]
        lines = jobs.tend(workers)
        for job in jobs.jobs:
            job.seen = True  # none is barren
        if queue.silent:
            assert "squeue: Unable to contact slurm controller" in lines
            continue
        if not workers:
            assert any(line.startswith("waits for workers") for line in lines)
        if queue.refuses and len(jobs.jobs) < wanted:
            assert f"sbatch refuses the job: {WORDS}" in lines
        elif not queue.refuses:
            assert len(jobs.jobs) == wanted
            assert {job.id for job in jobs.jobs} <= queue.listed.keys()
        if queue.listed and rng.random() < 0.4:
            queue.listed.pop(rng.choice(sorted(queue.listed)))


@pytest.mark.parametrize(
    ("walltime", "seconds"),
    [("60", 3600), ("10:00", 600), ("01:30:00", 5400), ("2-00", 172_800), ("1-12:30", 131_400),
     ("1-00:00:30", 86_430)],
)  # fmt: skip
def test_workers_end_a_little_before_the_walltime(walltime: str, seconds: int) -> None:
    left = lifetime_s(walltime)
    assert left is not None
    assert 0 < left <= seconds - 60
    assert left >= 0.9 * seconds - 60
