"""An operator at a running scan: watches, pauses, moves, resumes; the data set does not
notice."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

Plain = Any
FRAMES = 121


@pytest.mark.slow
def test_pause_move_resume(
    plain: Plain,
    servers: Any,
    connect: Callable[..., Plain],
    fly_script: Callable[..., str],
    data_dir: Path,
) -> None:
    plain.call("sample.set", name="normal-5")
    text = fly_script(FRAMES, exposure_ms=100)
    job = plain.call("script.submit", text=text, name="operated", speed_up=4)["job"]
    watcher = connect(servers.address)
    watcher.call("state.subscribe", topics=["job"])
    plain.until(job, lambda s: s["frames_done"] >= 3)
    assert plain.ask("axes.move", targets={"tra_obj": 20})["error"]["code"] == -32003

    plain.call("job.pause", job=job)
    paused = plain.until(job, lambda s: s["state"] == "paused")
    assert 3 <= paused["frames_done"] < FRAMES
    plain.call("axes.move", targets={"tra_obj": 20, "ver_tube": 50}, wait=True)
    assert plain.call("state.get")["axes"]["tra_obj"]["position"] == 20.0
    plain.call("job.resume", job=job)
    assert plain.wait(job)["frames_done"] == FRAMES

    seen = []
    while not seen or seen[-1]["state"] != "done":
        seen.append(watcher.receive()["params"]["data"])
    assert {s["job"] for s in seen} == {job}
    states = [s["state"] for s in seen]
    assert "paused" in states
    done = [s["frames_done"] for s in seen]
    assert done == sorted(done)

    folder = data_dir / "operated"
    document = json.loads((folder / "flexdt.json").read_text())
    assert document["complete"] is True
    # The last image repeats the first angle: same pose, so the same counts but for the noise.
    first, last, other = (
        tifffile.imread(folder / f"scan_{i:06d}.tif").astype(float) for i in (0, 120, 30)
    )
    assert np.abs(first - last).mean() < 0.2 * np.abs(first - other).mean()


def settled(plain: Plain, job: str) -> int:
    """Frames done once those under way have come out of the pipeline."""
    done, since = -1, time.monotonic()
    while time.monotonic() - since < 1.5:
        now = plain.call("job.status", job=job)["frames_done"]
        if now != done:
            done, since = now, time.monotonic()
        time.sleep(0.05)
    return done


@pytest.mark.slow
def test_step_by_step(
    plain: Plain, fly_script: Callable[..., str], data_dir: Path
) -> None:
    text = fly_script(FRAMES, exposure_ms=100)
    job = plain.call("script.submit", text=text, name="stepped", speed_up=4)["job"]
    plain.until(job, lambda s: s["frames_done"] >= 2)
    plain.call("job.pause", job=job)
    plain.until(job, lambda s: s["state"] == "paused")
    before = settled(plain, job)
    for k in range(1, 4):
        plain.call("job.step", job=job)
        status = plain.until(
            job, lambda s, n=before + k: s["state"] == "paused" and s["frames_done"] >= n
        )
        assert status["frames_done"] == before + k
        assert settled(plain, job) == before + k
    plain.call("job.abort", job=job)
    assert plain.wait(job)["state"] == "aborted"
    assert (
        json.loads((data_dir / "stepped" / "flexdt.json").read_text())["complete"]
        is False
    )


@pytest.mark.slow
def test_the_same_script_under_the_same_name_takes_up_where_it_stopped(
    plain: Plain, fly_script: Callable[..., str], data_dir: Path
) -> None:
    text = fly_script(FRAMES, exposure_ms=100)
    job = plain.call("script.submit", text=text, name="resumed", speed_up=4)["job"]
    plain.until(job, lambda s: s["frames_done"] >= 10)
    plain.call("job.abort", job=job)
    plain.wait(job)
    folder = data_dir / "resumed"
    kept = {
        p.name: (p.stat().st_mtime_ns, p.read_bytes()) for p in folder.glob("scan_*.tif")
    }
    assert 10 <= len(kept) < FRAMES
    job = plain.call("script.submit", text=text, name="resumed")["job"]
    assert plain.wait(job)["state"] == "done"
    for name, (when, content) in kept.items():
        assert ((folder / name).stat().st_mtime_ns, (folder / name).read_bytes()) == (
            when,
            content,
        )
    assert len(list(folder.glob("scan_*.tif"))) == FRAMES
    assert json.loads((folder / "flexdt.json").read_text())["complete"] is True
