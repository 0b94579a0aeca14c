"""A scan shows one object: another file under its sample's name never comes into its images."""

from __future__ import annotations

import json
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from in_process import PointProjector, digest, script
from simulation import Client, Simulation

from flexdt.protocol import RpcError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array

FRAMES = 12


class Shows(PointProjector):
    """Every content has a brightness of its own."""

    async def project(
        self, name: str, cone_vec: ConeVec, shape: tuple[int, int]
    ) -> Float32Array:
        lines = await super().project(name, cone_vec, shape)
        return lines + np.float32(zlib.crc32(name.encode()) % 1000 / 1000)


class Scene:
    """A twin on whose stage an upload stands."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.sim = Simulation(root, 1, projector=Shows())
        self.sim.__enter__()
        self.sim.start()
        self.client = self.sim.client()
        self.upload(0.1)
        self.call("sample.set", file="mine")

    def call(self, method: str, **params: Any) -> Any:
        return self.sim.call(self.client, method, **params)

    def upload(self, value: float, material: str | None = None) -> None:
        data = np.full((8, 8, 8), value, "<f4").tobytes()
        self.call("sample.upload", name="mine", kind="voxels", format="raw", total=len(data),
                  data=data, shape=[8, 8, 8], voxel_mm=[1.0, 1.0, 1.0],
                  **({} if material is None else {"material": material}))  # fmt: skip

    def begin(self, name: str, frames: int = 5) -> None:
        self.call("script.submit", text=script(FRAMES), name=name, seed=3)
        self.until(lambda job: job["frames_done"] >= frames)

    def until(self, holds: Any) -> Any:
        for _ in range(4000):
            job = self.call("job.status")
            if holds(job):
                return job
            self.sim.advance(0.25)
        raise AssertionError(job)

    def images(self, name: str) -> dict[str, str]:
        return digest(self.sim.data / name)

    def whole(self) -> dict[str, str]:
        """What an undisturbed scan gives, by another twin."""
        other = Scene(self.root / "other")
        try:
            other.begin("a", FRAMES)
            other.until(lambda job: job["state"] == "done")
            return other.images("a")
        finally:
            other.sim.__exit__()

    def killed(self) -> None:
        self.sim.kill()
        self.sim.start()
        self.client: Client = self.sim.client()


@pytest.fixture
def scene(tmp_path: Path) -> Any:
    made = Scene(tmp_path)
    yield made
    made.sim.__exit__()


@pytest.mark.parametrize("material", [None, "pmma"])
@pytest.mark.daily(1)
def test_a_paused_scan_goes_on_with_the_file_it_began_with(
    scene: Scene, material: str | None
) -> None:
    scene.begin("a")
    scene.call("job.pause")
    before = scene.until(lambda job: job["state"] == "paused")
    scene.upload(0.1 if material else 0.9, material)
    scene.call("job.resume")
    job = scene.until(lambda job: job["error"] is not None)
    assert (job["state"], job["error"]["code"]) == ("paused", -32003)
    assert (
        "'mine' has been uploaded anew since this scan began" in job["error"]["message"]
    )
    assert job["frames_done"] == before["frames_done"]
    scene.upload(0.1)
    scene.call("job.resume")
    scene.until(lambda job: job["state"] == "done")
    assert scene.images("a") == scene.whole()


def test_a_running_scan_of_what_stands_no_longer_on_the_stage_notices_another_file(
    scene: Scene,
) -> None:
    scene.begin("a")
    scene.killed()
    scene.call("sample.set", name="empty")
    scene.call("script.submit", text=script(FRAMES), name="a")
    scene.until(lambda job: job["frames_done"] >= 7)
    scene.upload(0.9)  # it does not stand there: nobody minds
    job = scene.until(lambda job: job["state"] in ("paused", "done"))
    assert (job["state"], job["error"]["code"]) == ("paused", -32003)
    scene.upload(0.1)
    scene.call("job.resume")
    scene.until(lambda job: job["state"] == "done")
    assert scene.images("a") == scene.whole()


@pytest.mark.parametrize("method", ["job.resume", "script.submit"])
@pytest.mark.daily(1)
def test_an_interrupted_scan_is_refused_while_another_file_has_the_name(
    scene: Scene, method: str
) -> None:
    scene.begin("a")
    scene.killed()
    there = scene.images("a")
    scene.upload(0.9)
    words = {"job": scene.call("job.list")["jobs"][0]["job"]}
    how = words if method == "job.resume" else {"text": script(FRAMES), "name": "a"}
    with pytest.raises(RpcError, match="'mine' has been uploaded anew") as refused:
        scene.call(method, **how)
    assert refused.value.code == -32003
    assert scene.images("a") == there
    scene.upload(0.1)
    scene.call(method, **how)
    scene.until(lambda job: job["state"] == "done")
    assert scene.images("a") == scene.whole()


def test_what_an_older_server_wrote_is_resumed_and_pinned_from_then_on(
    scene: Scene,
) -> None:
    """It knew of no revision."""
    scene.begin("a")
    scene.killed()
    file = scene.sim.data / "jobs" / "a.json"
    record = json.loads(file.read_text())
    assert record.pop("revision")
    file.write_text(json.dumps(record))
    scene.call("script.submit", text=script(FRAMES), name="a")
    scene.until(lambda job: job["frames_done"] >= 7)
    assert json.loads(file.read_text())["revision"]
    scene.until(lambda job: job["state"] == "done")
    assert scene.images("a") == scene.whole()
