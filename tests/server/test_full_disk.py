"""On a full disk E-stop, settings and positions survive a kill; what does not is said."""

from __future__ import annotations

import errno
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from full_disk_histories import run_history, settings
from in_process import Lab, run, script
from simulation import Fault, Simulation

from flexdt.runtime.files.spare_files import SPARE_BYTES, SPARE_FILES

FULL = Fault(at=0, error=errno.ENOSPC, lasting=True)
BROKEN = Fault(at=0, error=errno.EIO, lasting=True)


@pytest.mark.daily(2)
@pytest.mark.parametrize("seed", range(12))
def test_what_was_acknowledged_on_a_full_disk_survives_a_kill(
    seed: int, tmp_path: Path
) -> None:
    """`tests/studies/full_disk.py` lives 500 such histories, and some on real full disks."""
    assert run_history(tmp_path, seed).asked > 0


def test_a_full_disk_takes_changes_without_end(tmp_path: Path) -> None:
    sim = Simulation(tmp_path)
    with sim:
        sim.start()
        client = sim.client()
        sim.call(client, "tube.set", kV=50.0)
        sim.disk.set(FULL)
        for kV in range(40, 40 + 3 * SPARE_FILES):
            sim.call(client, "tube.set", kV=float(kV))
        document = (sim.data / "state.json").read_bytes()
        assert len(document) == SPARE_BYTES
        assert json.loads(document)["scene"]["tube"]["kV"] == kV
        sim.kill()
        sim.start()  # a twin starts on a full disk, too
        client = sim.client()
        assert sim.call(client, "state.get")["tube"]["kV"] == kV
        sim.disk.set(None)
        sim.call(client, "tube.set", kV=41.0)
        assert (sim.data / "state.json").stat().st_size < SPARE_BYTES
        sim.call(client, "tube.set", kV=42.0)
        sizes = [f.stat().st_size for f in sim.data.glob(".reserve-*")]
        assert sizes == [SPARE_BYTES] * SPARE_FILES, "room is kept again"


def test_an_estop_that_no_disk_takes_is_said(tmp_path: Path) -> None:
    sim = Simulation(tmp_path)
    with sim:
        sim.start()
        client, watcher = sim.client(), sim.client()
        sim.call(watcher, "state.subscribe", topics=["state", "log"])
        job = sim.call(client, "script.submit", text=script(3), name="scan")["job"]
        sim.advance(0.5)
        sim.disk.set(BROKEN)
        assert sim.call(client, "safety.estop")["safety"]["estop"]
        sim.advance(0.5)
        unsaved = sim.call(client, "state.get")["unsaved"]
        assert "Input/output error" in unsaved
        assert str(sim.data) not in unsaved
        assert watcher.of("state")[-1]["data"]["unsaved"] == unsaved
        assert "a kill would lose it" in watcher.of("log")[-1]["data"]["message"]
        aborted = sim.call(client, "job.abort", job=job)
        assert "not on the disk" in aborted["warnings"][-1]
        sim.disk.set(None)
        sim.advance(61.0)
        assert sim.call(client, "state.get")["unsaved"] is None
        assert watcher.of("state")[-1]["data"]["unsaved"] is None
        sim.kill()
        sim.start()
        assert sim.call(sim.client(), "state.get")["safety"]["estop"]


def test_a_data_directory_that_was_removed_is_the_disk_s_fault(tmp_path: Path) -> None:
    """Not the parameters': -32602 would say that another request might do."""
    root = tmp_path / "data"

    async def body(lab: Lab) -> None:
        c = lab.client()
        await c.call("calibration.apply", parameters={"dD_x": 0.1}, name="one")
        while root.exists():  # the state is being written meanwhile
            shutil.rmtree(root, ignore_errors=True)
        voxels = {
            "kind": "voxels",
            "format": "raw",
            "shape": [1, 1, 1],
            "voxel_mm": [1.0] * 3,
        }
        asked: dict[str, dict[str, Any]] = {
            "tube.set": {"kV": 50.0},
            "sample.set": {"name": "lego"},
            "script.submit": {"text": script(3)},
            "calibration.apply": {"parameters": {"dD_x": 0.2}, "name": "two"},
            "calibration.revert": {},
            "sample.upload": {"name": "a", "total": 4, "data": bytes(4), **voxels},
            "dataset.list": {},
        }
        before = settings(await c.call("state.get"))
        for method, params in asked.items():
            error = await c.error(method, **params)
            assert error.code == -32001, (method, error)
            assert "No such file or directory" in error.message
            assert str(root) not in error.message
        assert settings(await c.call("state.get")) == before
        assert (await c.call("safety.estop"))["safety"]["estop"]
        await lab.until(lambda: lab.twin.journal.problem is not None, "it is noticed")
        assert "journal" in (await c.call("state.get"))["unsaved"]

    root.mkdir()
    run(root, body)
