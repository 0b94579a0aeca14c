"""The guard of the stage: it knows the sample, and follows the correction in force."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import pytest
from in_process import Lab, run

from flexdt.runtime.files.directory import open_data
from flexdt.server.scans import stage as stages
from flexdt.server.scans.stage import Stage
from flexdt.server.storage import stored_samples as samples
from flexdt.server.storage.stored_samples import SampleStore
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.motion import profiles as motion
from flexdt.twin.scanner.safety import Contact, Guard
from flexdt.twin.scanner.state import Sample, StagePlacement

M = builtin_machine()


def approach(guard: Guard) -> Contact:
    """Send the detector to the sample stage."""
    trajectories = {n: motion.at_rest(a.home) for n, a in M.axes.items()}
    trajectories["mag_det"] = motion.move(1059.0, 0.0, 500.0, 50.0, 50.0, 0.0)
    contact = guard(trajectories, 0.0)
    assert contact is not None
    return contact


def test_a_guard_is_of_one_correction(tmp_path: Path) -> None:
    stage = Stage(M, builtin_profile(M.default_profile), SampleStore(open_data(tmp_path)))
    guards = [
        stage.guard(Sample("lego"), p) for p in (NOMINAL, Offsets(dO_z=15.0, dD_z=-5.0))
    ]
    nominal, corrected = (approach(guard) for guard in guards if guard is not None)
    # The stage stands 15 mm nearer to the detector, which stands 5 mm nearer to it.
    ahead = corrected.last_free["mag_det"] - nominal.last_free["mag_det"]
    assert ahead == pytest.approx(20.0, abs=1e-6)


def test_the_sample_on_the_stage_decides(tmp_path: Path) -> None:
    stage = Stage(M, builtin_profile(M.default_profile), SampleStore(open_data(tmp_path)))
    far_out = Sample("lego", StagePlacement(y=200.0))
    guards = [stage.guard(s) for s in (Sample(), Sample("lego"), far_out)]
    contacts = [approach(g) for g in guards if g is not None]
    assert [c.pair for c in contacts] == [
        ("sample_base", "detector_platform"),
        ("sample_base", "detector_platform"),
        ("detector", "sample"),
    ]


def test_a_machine_without_components_has_no_guard(tmp_path: Path) -> None:
    bare = M.model_copy(update={"components": (), "allowed_contacts": ()})
    stage = Stage(
        bare, builtin_profile(M.default_profile), SampleStore(open_data(tmp_path))
    )
    assert stage.guard(Sample("lego")) is None
    assert stage.scene(Sample()) is None


def test_what_stands_on_the_stage_is_never_read_or_cut_anew_in_the_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nine changes that were refused drove it out: the next state held the loop for 14 s."""
    for where, name in ((stages, "convex_pieces"), (samples, "_parse")):
        made = getattr(where, name)

        def apart(*args: Any, _made: Any = made, **options: Any) -> Any:
            assert threading.current_thread() is not threading.main_thread()
            return _made(*args, **options)

        monkeypatch.setattr(where, name, apart)

    async def body(lab: Lab) -> None:
        c = lab.client()
        grid = {
            "kind": "voxels",
            "format": "raw",
            "shape": [2, 2, 2],
            "voxel_mm": [9.0] * 3,
        }
        for i in range(10):
            await c.call("sample.upload", name=f"v{i}", total=32, **grid, data=b"\0" * 32)
        await c.call("sample.set", name="v0")
        await c.call("axes.move", targets={"mag_det": 720.0}, wait=True)
        for i in range(1, 10):
            e = await c.error("sample.set", name=f"v{i}", offset={"y": 150.0 + i})
            assert e.code == -32002
        assert (await c.call("state.get"))["sample"]["name"] == "v0"
        assert (await c.call("safety.estop"))["safety"]["clearance_mm"] > 1.0
        assert (await c.call("axes.stop"))["sample"]["size_mm"] == (18.0, 18.0, 18.0)

    run(tmp_path, body)
