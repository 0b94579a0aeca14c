"""What a client without control may do with samples ends nobody's scan, and fills neither
disk nor list."""

from __future__ import annotations

import random
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from in_process import script
from simulation import Client, Simulation

from flexdt.protocol import RpcError
from flexdt.runtime.access import TwinLimits

FRAMES = 6
CONTENTS = (0.1, 0.5, 0.9)


def voxels(name: str, value: float, side: int = 8) -> dict[str, Any]:
    data = np.full((side, side, side), value, "<f4").tobytes()
    return {
        "name": name,
        "kind": "voxels",
        "format": "raw",
        "total": len(data),
        "data": data,
        "shape": [side, side, side],
        "voxel_mm": [1.0, 1.0, 1.0],
    }


class Two:
    """A controller with a scan of its upload, and an observer."""

    def __init__(self, sim: Simulation) -> None:
        self.sim = sim
        self.controller, self.observer = sim.client(), sim.client()
        self.controls("sample.upload", **voxels("mine", 0.1))
        self.controls("sample.set", file="mine")

    def controls(self, method: str, **params: Any) -> Any:
        return self.sim.call(self.controller, method, **params)

    def observes(self, method: str, **params: Any) -> Any:
        return self.sim.call(self.observer, method, **params)

    def until(self, *states: str) -> Any:
        for _ in range(4000):
            job = self.controls("job.status")
            if job["state"] in states:
                return job
            self.sim.advance(0.25)
        raise AssertionError(job)


def deed(rng: random.Random, two: Two, who: Client, name: str) -> None:
    """One drawn request of a client; the observer may do whatever is no urgent request."""
    match rng.choice(["upload", "upload", "delete", "set", "forget", "resume", "pause"]):
        case "upload":
            two.sim.call(who, "sample.upload", **voxels(name, rng.choice(CONTENTS)))
        case "delete":
            two.sim.call(who, "sample.delete", name=name)
        case "set":
            two.sim.call(who, "sample.set", file=name)
        case "forget":
            two.sim.call(who, "job.forget", days=0.0)
        case "resume":
            two.sim.call(who, "job.resume")
        case "pause":
            two.sim.call(who, "job.pause")


@pytest.mark.parametrize("seed", range(8))
def test_nothing_that_an_observer_sends_ends_a_scan(seed: int, tmp_path: Path) -> None:
    rng = random.Random(seed)
    with Simulation(tmp_path, seed) as sim:
        sim.start()
        two = Two(sim)
        two.controls("script.submit", text=script(FRAMES), name="a", seed=3)
        killed = rng.random() < 0.4
        sim.advance(rng.uniform(0.5, 20.0))
        if killed:  # the job can be resumed, and nobody has control
            sim.kill()
            sim.start()
            two.controller, two.observer = sim.client(), sim.client()
            two.controls("session.control", action="acquire")
        elif rng.random() < 0.7:
            with suppress(RpcError):
                two.controls("job.pause")
        if rng.random() < 0.5:
            with suppress(RpcError):  # it stands on the stage no longer
                two.controls("sample.set", name="empty")
        for _ in range(12):
            sim.advance(rng.choice([0.0, 0.0, 0.3, 2.0]))
            with suppress(RpcError):
                deed(rng, two, two.observer, rng.choice(["mine", "mine", "yours"]))
        job = two.controls("job.list")["jobs"][0]
        if job["state"] != "done":
            with suppress(RpcError):  # it may run
                two.controls("job.resume", job=job["job"])
        assert two.until("done", "failed", "incomplete", "aborted")["state"] == "done"


def test_a_paused_scan_outlives_an_upload_under_its_samples_name(tmp_path: Path) -> None:
    with Simulation(tmp_path, 1) as sim:
        sim.start()
        two = Two(sim)
        two.controls("script.submit", text=script(FRAMES), name="a", seed=3)
        sim.advance(8.0)
        two.controls("job.pause")
        two.until("paused")
        two.controls("sample.set", name="empty")
        with pytest.raises(RpcError) as refused:
            two.observes("sample.upload", **voxels("mine", 0.9))
        assert refused.value.code == -32003
        assert "sample.upload" in refused.value.message
        two.controls("job.resume")
        two.until("done")


def test_observers_have_a_quota_of_their_own(tmp_path: Path) -> None:
    small = voxels("x", 0.1, 2)["total"]
    limits = TwinLimits(max_observer_samples=3, max_observer_bytes=3 * small + 100)
    with Simulation(tmp_path, 1, limits=limits) as sim:
        sim.start()
        two = Two(sim)
        with pytest.raises(RpcError, match="observers have sent 0 uploads") as refused:
            two.observes("sample.upload", **voxels("large", 0.1, 8))
        assert refused.value.code == -32001
        for number in range(3):
            two.observes("sample.upload", **voxels(f"o{number}", 0.1, 2))
        with pytest.raises(RpcError, match="it would be 4 of"):
            two.observes("sample.upload", **voxels("o3", 0.1, 2))
        two.controls("sample.upload", **voxels("more", 0.1, 8))
        sim.kill()  # the files say who sent them
        sim.start()
        two.controller, two.observer = sim.client(), sim.client()
        two.controls("session.control", action="acquire")
        with pytest.raises(RpcError, match="observers have sent 3 uploads"):
            two.observes("sample.upload", **voxels("o3", 0.1, 2))
        two.controls("sample.delete", name="o1")
        two.observes("sample.upload", **voxels("o3", 0.1, 2))
