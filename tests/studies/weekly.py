"""Run the programs of a weekly job, and say which failed.

    python tests/studies/weekly.py              # the jobs for the workflow's matrix, as JSON
    python tests/studies/weekly.py JOB          # run one: its commands, each even if another fails
    python tests/studies/weekly.py JOB --packages   # Debian's packages that it needs

The jobs are the tables of `weekly.toml`. Commands find the Python and the `flexdt` that run this
program. Exit code 1 where a command failed; after one of `setup` none is begun.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
TABLE = Path(__file__).with_name("weekly.toml")
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1"}
"""Of BLAS, whose threads wait for each other in products of a few hundred columns: calibrating
takes a tenth of the processor time."""


def jobs(table: Path = TABLE) -> dict[str, dict[str, Any]]:
    """Read the jobs by name, each with `commands` and perhaps `setup`, `packages` and
    `needs`.
    """
    return tomllib.loads(table.read_text(encoding="utf-8"))


def run(command: str) -> int:
    """Run a command by bash at the repository's root, print it and its wall time [s]; its
    exit code.
    """
    print(f"$ {command}", flush=True)
    here = Path(sys.executable).parent
    begun = time.monotonic()
    code = subprocess.run(
        ["bash", "-e", "-c", command],
        cwd=ROOT,
        env={
            **ONE_THREAD,
            **os.environ,
            "PATH": f"{here}{os.pathsep}{os.environ['PATH']}",
        },
        check=False,
    ).returncode
    print(f"exit code {code} after {time.monotonic() - begun:.0f} s\n", flush=True)
    return code


def run_job(job: dict[str, Any]) -> list[str]:
    """Run a job's commands after its setup; those that failed.

    Where a command of the setup fails, the commands are not begun, and it alone is given.
    """
    for command in job.get("setup", ()):
        if run(command):
            return [command]
    return [command for command in job["commands"] if run(command)]


def main(words: list[str] | None = None) -> int:
    """Run a job, list its packages, or list the jobs; the exit code."""
    every = jobs()
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("job", nargs="?", choices=[*every])
    parser.add_argument("--packages", action="store_true")
    chosen = parser.parse_args(words)
    if chosen.job is None:
        print(json.dumps([name for name, job in every.items() if "needs" not in job]))
        return 0
    job = every[chosen.job]
    if chosen.packages:
        print(*job.get("packages", ()))
        return 0
    failed = run_job(job)
    for command in failed:
        print(f"FAILED: {command}")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
