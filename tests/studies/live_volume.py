"""How long the slices of a running scan take: a scan at its own pace, and beside it the process
that the viewer starts for "Slices so far", at each size.

`python tests/studies/live_volume.py [FRAMES]` starts its own servers and prints, for each size,
the views a second, the seconds from one picture to the next, and how far the volume was behind
the scan's last image when that was saved.
"""

from __future__ import annotations

import itertools
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import flexdt as fx
from flexdt.runtime.workers import ENVIRONMENT
from flexdt.twin.machine.description import builtin_machine, profile_of
from flexdt.twin.script.compose import compose_script
from flexdt.twin.script.scan_request import ScanRequest


def measured(twin: fx.TwinClient, data: Path, side: int, frames: int) -> str:
    """Scan while slices of the volume grow, and return the figures as a row of a table.

    Args:
        twin: client in control.
        data: its data directory.
        side: of the slices [voxels].
        frames: of the scan.

    Raises:
        AssertionError: the slices met a problem, or the scan is not done.
    """
    machine = builtin_machine("flexray")
    script = compose_script(
        ScanRequest(frames=frames), machine, profile_of(machine, None)
    )
    name = f"slices-{side}"
    job = twin.submit_script(script, name, 1.0).job
    grower = subprocess.Popen(
        [sys.executable, "-m", "flexdt.clients.viewer.volumes.live_volume"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env={**os.environ, **ENVIRONMENT},
    )  # fmt: skip
    assert grower.stdin is not None
    assert grower.stdout is not None
    print(data / name, side, sep="\t", file=grower.stdin, flush=True)
    last = data / name / f"scan_{frames - 1:06d}.tif"
    steps, views, behind, voxel_mm, ended = [], [], 0.0, 0.0, 0.0
    for line in grower.stdout:
        told, now = json.loads(line.split("\t")[1]), time.monotonic()
        assert "problem" not in told, told
        steps.append(now)
        views.append(told["views"])
        voxel_mm, ended = told["voxel_mm"], time.time()
        if "done" in told:
            break
    grower.stdin.close()
    grower.wait()
    assert twin.wait_job(job).state == "done"
    behind = ended - last.stat().st_mtime
    between = [b - a for a, b in itertools.pairwise(steps)]
    rate = (views[-1] - views[0]) / (steps[-1] - steps[0])
    return (
        f"| {side} | {1000 * voxel_mm:.0f} um | {rate:.1f} | "
        f"{statistics.median(between):.2f} s | "
        f"{max(between):.2f} s | {behind:.1f} s |"
    )


def main(frames: int = 120) -> None:
    """The table."""
    print(f"load average before: {os.getloadavg()[0]:.1f}; {os.cpu_count()} processors")
    print(
        "| side | voxel | views/s | from picture to picture | at worst | behind the last image |"
    )
    print("|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder, fx.LocalTwin(data=folder) as twin:
        twin.set_sample("lego")
        for side in (128, 192, 256):
            print(measured(twin, Path(folder), side, frames), flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
