"""What version 0.1 wrote opens unchanged: a data set, and the data directory of a stopped twin.

`tests/data/v0.1` was written by that version's own code (the last commit before 0.2.0): the sample
normal-3, a move, a correction, a script of four frames in an ROI of 64 x 48 pixels, `scene.save`.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
from in_process import Lab, M, P, run

import flexdt as fx
from flexdt.runtime.files.directory import open_data
from flexdt.server.twin.core import TwinServer

OLD = Path(__file__).parents[1] / "data" / "v0.1"


def digests(folder: Path) -> dict[str, str]:
    return {
        f.name: hashlib.sha256(f.read_bytes()).hexdigest()
        for f in sorted(folder.iterdir())
    }


def test_a_data_set_of_version_0_1_opens_unchanged() -> None:
    before = digests(OLD / "old")
    data = fx.open(OLD / "old")
    document = json.loads((OLD / "old" / "flexdt.json").read_text("utf-8"))
    frames = [f for f in document["frames"] if f["kind"] == "projection"]
    rows = np.array([f["cone_vec"] for f in frames])
    assert len(data) == len(frames) == 4
    np.testing.assert_array_equal(data.cone_vec.rows, rows)
    # Its geometry follows from its motors as it did then.
    np.testing.assert_allclose(data.poses.cone_vec().rows, rows, atol=1e-12)
    assert data.counts(0).shape == (48, 64)
    assert data.counts(0).max() > 1000
    assert digests(OLD / "old") == before


def test_a_twin_goes_on_where_one_of_version_0_1_stopped(tmp_path: Path) -> None:
    root = tmp_path / "data"
    shutil.copytree(OLD, root)

    async def body(lab: Lab) -> None:
        await lab.twin.stop()
        lab.twin = TwinServer(
            M, P, lab.projector, open_data(root), speed_up="max"
        )  # as `flexdt.server.twin.main` begins
        sample = lab.twin.recall()
        assert sample is not None
        await lab.twin.start(sample)
        client = lab.client()
        state = await client.call("state.get")
        assert state["axes"]["mag_obj"]["position"] == 520.0
        assert state["sample"]["name"] == "normal-3"
        assert state["correction"]["name"] == "found"
        listed = await client.call("calibration.list")
        [found] = [c for c in listed["corrections"] if c["name"] == "found"]
        moved = {n: v for n, v in found["parameters"].items() if v not in (0.0, 1.0)}
        assert moved == {"dO_x": 0.5, "alpha": 2.0}
        jobs = await client.call("job.list")
        assert [(j["name"], j["state"]) for j in jobs["jobs"]] == [("old", "done")]
        scene = json.loads((OLD / "scene.json").read_text("utf-8"))
        await client.call("axes.move", targets={"mag_obj": 700.0}, wait=True)
        await client.call("scene.load", **scene)
        state = await client.call("state.get")
        assert state["axes"]["mag_obj"]["target"] == 520.0

    run(tmp_path / "other", body)
    assert digests(root / "old") == digests(OLD / "old")
