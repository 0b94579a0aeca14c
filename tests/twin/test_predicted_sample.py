"""What pixels behind a sample will count, beside images that are made of it."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import flexdt as fx
from flexdt.phantoms.exposure_forecast import exposure_problems
from flexdt.phantoms.samples import as_phantom
from flexdt.twin.machine.description import builtin_machine, profile_of
from flexdt.twin.physics.detector import detector_of
from flexdt.twin.physics.predicted_beam import CountShares, PredictedExposure
from flexdt.twin.physics.tube import tube_of
from flexdt.twin.script.compose import compose_script
from flexdt.twin.script.planning.open_beam_findings import open_beam_problems
from flexdt.twin.script.planning.plan import ScanPlan
from flexdt.twin.script.planning.planner import plan_script
from flexdt.twin.script.scan_request import ScanRequest

FEW_COUNTS = 10
TOLD = re.compile(r"about ([\d.e+-]+) % of the projections' pixels will be (\w+)")


def drawn(rng: np.random.Generator, material: str) -> tuple[ScanPlan, Any]:
    """Plan two views of a rod through which hardly anything comes, or which hides little."""
    machine = builtin_machine("flexray")
    exposure_ms = float(np.exp(rng.uniform(np.log(40.0), np.log(900.0))))
    wish = ScanRequest("step", frames=2, exposure_ms=exposure_ms, kV=float(rng.uniform(45, 90)),
                       power_W=float(rng.uniform(10, 60)))  # fmt: skip
    profile = profile_of(machine)
    plan = plan_script(compose_script(wish, machine, profile), machine, profile)
    rod = {"kind": "cylinder", "center": [0, 0, 0], "radius": float(rng.uniform(4, 20)),
           "height": 60, "material": material}  # fmt: skip
    return plan, rod


def made(plan: ScanPlan, rod: Any) -> CountShares:
    """Make the first image, with every pixel and without noise, and count its pixels."""
    first = next(e for e in plan.exposures if e.kind == "projection")
    panel = replace(
        detector_of(plan.machine.detector), gain_sigma=0.0, offset_sigma_counts=0.0,
        dead_fraction=0.0, dark_e_per_s=0.0, exposure_ms=first.camera.exposure_ms,
    )  # fmt: skip
    filters = tube_of(plan.machine.tube).filters
    tube = fx.Tube(kV=first.kV, power_W=first.power_W, filters=filters)
    cone = plan.geometry[:1].with_shape(first.camera.shape)
    counts = (
        fx.simulate(rod, cone, tube=tube, detector=panel, noise=None)
        .counts(0)
        .astype(float)
    )
    saturated = float((counts >= panel.full_scale).mean())
    return CountShares(
        saturated, float((counts - panel.offset_counts < FEW_COUNTS).mean())
    )


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.daily(1)
@pytest.mark.parametrize("seed", range(12))
def test_shares_of_pixels_are_those_of_images(seed: int) -> None:
    rng = np.random.default_rng(6200 + seed)
    starved = 0
    for material in ("steel", "pmma", "copper"):
        plan, rod = drawn(rng, material)
        told = {
            name: float(share) / 100.0
            for problem in exposure_problems(plan, as_phantom(rod))
            for share, name in TOLD.findall(problem.message)
        }
        seen = made(plan, rod)
        open_beam = {p.code.split("_")[0] for p in open_beam_problems(plan)}
        for name in {"saturated", "starved"} - open_beam:
            assert told.get(name, 0.0) == pytest.approx(getattr(seen, name), abs=0.012), (
                material
            )
        starved += seen.starved > 0.01
    assert starved


def test_opening_says_what_was_predicted_and_what_images_show(tmp_path: Path) -> None:
    """Saturated images are said by opening alone; a prediction, where images are silent."""
    cone = fx.ConeVec.circular(sod=600, sdd=700, angles=3, shape=(20, 30), pixel=1.0)
    rod = {"kind": "sphere", "center": [0, 0, 0], "radius": 2, "material": "pmma"}
    with pytest.warns(UserWarning, match="are saturated"):
        bright = fx.simulate(rod, cone, exposure_ms=900.0)
    replace(bright, warnings=()).save(tmp_path / "bright")
    assert "100 % of the pixels of the flat image are saturated" in str(
        fx.open(tmp_path / "bright").warnings
    )
    dim = fx.simulate(rod, cone, exposure_ms=60.0)
    dim.save(tmp_path / "dim")
    assert "saturated" not in str(fx.open(tmp_path / "dim").warnings)


def test_flexdt_json_keeps_a_prediction(scan_folder: Path) -> None:
    document = json.loads((scan_folder / "flexdt.json").read_text())
    [found] = document["predicted"]
    assert found["kV"] == document["tube"]["kV"]
    assert 0.0 < found["open_beam_fill"] < 1.0
    assert (found["saturated"], found["starved"], found["doubts"]) == (0.0, 0.0, [])
    document["predicted"][0]["doubts"] = ["about 12 % of the pixels will be starved"]
    (scan_folder / "flexdt.json").write_text(json.dumps(document))
    assert "predicted at submission: about 12 %" in str(fx.open(scan_folder).warnings)
    del document["predicted"]  # as older software wrote it
    (scan_folder / "flexdt.json").write_text(json.dumps(document))
    assert "predicted" not in str(fx.open(scan_folder).warnings)


@pytest.fixture
def scan_folder(tmp_path: Path) -> Path:
    """Let a twin in this process make a scan."""
    from in_process import Lab, run, script

    async def body(lab: Lab) -> None:
        client = lab.client()
        job = await client.call(
            "script.submit", text=script(3), name="scan", speed_up="max"
        )
        assert (await lab.ended(client, job["job"]))["state"] == "done"

    run(tmp_path, body)
    return tmp_path / "scan"


def test_an_unknown_sample_has_no_shares() -> None:
    from flexdt.twin.dataset.flexdt_json import PredictedEntry

    entry = PredictedEntry.of(PredictedExposure(90.0, 50.0, 100.0, 0.75))
    assert (entry.open_beam_fill, entry.saturated, entry.starved) == (0.75, None, None)
