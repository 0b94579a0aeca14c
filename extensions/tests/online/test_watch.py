"""A client that watches a scan ends it: twin, scan and watcher are processes and connections.

The truth is what the twin is told to hide; the sigmas are those of `flexdt calibrate` on what
is left of the data set, by the ordinary command line.
"""

from __future__ import annotations

import json
import random
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
import tifffile
from adaptive_stopping import NAME, drawn_truth, hiding, submit
from lab import Process

import flexdt as fx
from flexdt.clients import FINAL_STATES, TwinClient
from flexdt.clients.cli.command_tree import run
from flexdt.clients.launch.processes import Servers
from flexdt.protocol.rpc_errors import RpcError
from flexdt.twin.errors import TwinError, UnknownNameError
from flexdt_extensions.watch import bead_phantoms, tolerances, watch

FRAMES = 60
MOST = 55
"""Frames that are scanned at most: the watcher has the others' time for its fits."""
SEEDS = range(6)


@contextmanager
def step_by_step(mine: TwinClient, job: str) -> Iterator[None]:
    """Scan the first `MOST` frames of a job one after the other, and wait for whoever ends it.

    So no watcher, however slow, comes too late.
    """
    over = threading.Event()

    def steps() -> None:
        while not over.wait(0.02):
            status = mine.job_status(job)
            if status.state in FINAL_STATES or status.frames_done >= MOST:
                return
            if status.state == "paused":
                with suppress(RpcError):  # it has just been ended
                    mine.step_job(job)

    while mine.job_status(job).state == "queued":
        time.sleep(0.02)
    mine.pause_job(job)
    stepping = threading.Thread(target=steps)
    stepping.start()
    try:
        yield
    finally:
        over.set()
        stepping.join()


def calibrated(
    folder: Path, capsys: pytest.CaptureFixture[str], *options: str
) -> dict[str, Any]:
    capsys.readouterr()
    assert run(["calibrate", str(folder), "--phantom", "lego", "--json", *options]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


@pytest.mark.daily(1)
@pytest.mark.timeout(300)
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.slow
@pytest.mark.campaign(1)
def test_the_job_ends_early_and_its_data_set_is_worth_what_was_asked(
    rays: Process, tmp_path: Path, capsys: pytest.CaptureFixture[str], seed: int
) -> None:
    rng = random.Random(seed)
    truth = drawn_truth(rng)
    wanted = {"tau_x": rng.uniform(1.5e-4, 3e-4), "tau_z": rng.uniform(1.5e-4, 3e-4)}
    with hiding(rays, tmp_path, truth) as port, TwinClient("127.0.0.1", port) as mine:
        job, _ = submit(mine, rng, FRAMES, 25.0)
        words = ",".join(f"{name}={most}" for name, most in wanted.items())
        capsys.readouterr()
        with step_by_step(mine, job):
            code = run(["job", "watch", "lego", job, "--stop-when", words,
                        "--json", "--server", f"127.0.0.1:{port}"])  # fmt: skip
        told = json.loads(capsys.readouterr().out)
        status = mine.job_status(job)
    assert (code, told["reached"], status.state) == (0, True, "aborted")
    assert told["frames"] <= status.frames_done < FRAMES
    data = fx.open(tmp_path / "data" / NAME)
    assert not data.complete
    assert data.reason.startswith(
        f"aborted: sigmas reached after {told['frames']} frames: "
    )
    assert all(f"{name} " in data.reason for name in wanted)
    assert len(data.present) == status.frames_done
    for i in data.present:  # each is whole, and none is half written
        assert tifffile.imread(data.folder / data.frames[i].file).shape == data.shape
    assert not list(data.folder.glob(".*"))
    found = calibrated(data.folder, capsys)
    assert found["identifiable"]
    for name, most in wanted.items():
        assert found["parameters"][name]["sigma"] <= most
    for name, value in truth.items():
        fitted = found["parameters"][name]
        assert abs(fitted["value"] - value) < 4.0 * fitted["sigma"] + 5e-5


def test_what_is_not_reached_lets_the_scan_end_by_itself(
    servers: Servers, data_dir: Path
) -> None:
    with TwinClient(*servers.address) as client:
        job, _ = submit(client, random.Random(1), 5, 50.0)
        heard = list[int]()
        found = watch(client, "lego", {"tau_x": 1e-9}, job,
                      tell=lambda state: heard.append(len(state.detections)))  # fmt: skip
        assert (found.reached, found.job.state, found.frames) == (False, "done", 5)
        assert heard == [1, 2, 3, 4, 5]
        assert found.sigmas["tau_x"] is not None
        assert found.sigmas["tau_x"] > 1e-9
        assert fx.open(data_dir / NAME).complete
        with pytest.raises(UnknownNameError, match="'warp' is not estimated here"):
            watch(client, "lego", {"warp": 1.0}, job)
        with pytest.raises(TwinError, match="no tolerance given"):
            watch(client, "lego", {}, job)


def test_a_shell_is_proposed_phantoms_with_beads_and_parameters() -> None:
    assert "lego" in bead_phantoms("")
    assert not bead_phantoms("she")  # the Shepp-Logan has no beads
    assert tolerances("dO_x=0.1,al") == ["dO_x=0.1,alpha="]
