"""What the open beam will count, beside images that are made of it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import flexdt as fx
from flexdt.clients.cli.command_tree import run
from flexdt.phantoms.channels import chain_through
from flexdt.twin.machine.description import Machine, builtin_machine, profile_of
from flexdt.twin.machine.kinematics import motor_poses
from flexdt.twin.physics.chain import radiographs
from flexdt.twin.physics.detector import detector_of
from flexdt.twin.physics.exposure import ExposureSettings, ideal_response
from flexdt.twin.physics.exposure import expose as ideal_counts
from flexdt.twin.physics.predicted_beam import LEAST_COUNTS
from flexdt.twin.physics.readout import read_out
from flexdt.twin.physics.tube import tube_of
from flexdt.twin.script import check_script
from flexdt.twin.script.compose import compose_script
from flexdt.twin.script.planning.open_beam_findings import (
    OPEN_BEAM_CODES,
    open_beam_problems,
)
from flexdt.twin.script.planning.plan import ScanPlan
from flexdt.twin.script.planning.planner import plan_script
from flexdt.twin.script.scan_request import ScanRequest

MACHINES = ("flexray", "micro_ct", "unitom_xl", "xyzr_cabinet")
UNDECIDED = 0.03
"""Relative distance from a bound within which the panel's fixed pattern decides."""


def flat_image(plan: ScanPlan, physics: str) -> tuple[float, float, float]:
    """Make the first flat image: brightest and darkest count above dark, and the largest."""
    exposure = next(e for e in plan.exposures if e.kind == "flat")
    machine = plan.machine
    lit = ExposureSettings(exposure.kV, exposure.power_W, exposure.camera.exposure_ms)
    camera = replace(exposure.camera, averages=1, frames=1)
    nothing = np.zeros((1, 1, *camera.shape), np.float32)
    if physics == "ideal":
        model = ideal_response(machine)
        counts = ideal_counts(model, nothing[0, 0], lit).astype(float) - model.dark_counts
        return counts.max(), counts.min(), model.full_scale - model.dark_counts
    panel = replace(
        detector_of(machine.detector),
        gain_sigma=0.0,
        offset_sigma_counts=0.0,
        dead_fraction=0.0,
        dark_e_per_s=0.0,
    )
    positions = {name: np.array([x]) for name, x in exposure.positions.items()}
    view = motor_poses(machine, plan.profile, camera, positions).cone_vec().rows
    chain = chain_through([], panel, tube_of(machine.tube))
    made = radiographs(chain, nothing[:0], view, [lit])[0]
    assert made.expected is not None
    counts = (
        read_out(panel, made.expected, camera, lit).astype(float) - panel.offset_counts
    )
    return counts.max(), counts.min(), panel.full_scale - panel.offset_counts


def drawn_scan(rng: np.random.Generator) -> tuple[Machine, ScanPlan]:
    """Plan a scan of two images with voltage, power and time from dim to far too bright."""
    machine = builtin_machine(str(rng.choice(MACHINES)))
    low, high = machine.tube.min_kV, min(machine.tube.max_kV, 140.0)
    spec = machine.detector
    exposure_ms = float(np.exp(rng.uniform(np.log(spec.min_exposure_ms), np.log(5000.0))))
    power_W = float(machine.tube.max_W * 10.0 ** rng.uniform(-4, 0))
    wish = ScanRequest(
        "step", frames=2, exposure_ms=exposure_ms, kV=float(rng.uniform(max(low, 40), high)),
        power_W=power_W,
    )  # fmt: skip
    profile = profile_of(machine)
    return machine, plan_script(compose_script(wish, machine, profile), machine, profile)


@pytest.mark.daily(1)
@pytest.mark.parametrize("physics", ["poly", "ideal"])
def test_an_open_beam_is_called_saturated_or_starved_where_its_image_is(
    physics: Any,
) -> None:
    rng = np.random.default_rng(58)
    seen = dict.fromkeys((*OPEN_BEAM_CODES, "right"), 0)
    for _ in range(40):
        _, plan = drawn_scan(rng)
        brightest, _, full = flat_image(plan, physics)
        if (
            0.0 < 1.0 - brightest / full < UNDECIDED
            or abs(brightest / LEAST_COUNTS - 1.0) < 0.05
        ):
            continue
        codes = {p.code for p in open_beam_problems(plan, physics)}
        want = "right"
        if brightest >= full:
            want = "saturated_open_beam"
        elif brightest < LEAST_COUNTS:
            want = "starved_open_beam"
        assert codes == ({want} - {"right"}), (
            plan.machine,
            brightest,
            full,
            open_beam_problems(plan, physics),
        )
        seen[want] += 1
    assert min(seen.values()) >= 3


def test_the_proposed_exposure_fills_the_panel() -> None:
    rng = np.random.default_rng(59)
    tried = 0
    while tried < 12:
        machine, plan = drawn_scan(rng)
        for problem in open_beam_problems(plan):
            words = problem.message.split("; ")[1].removeprefix("not even ")
            time_ms = float(words.split(" ms")[0])
            power_W = (
                float(words.split(" at ")[1].split(" W")[0]) if " at " in words else None
            )
            group = next(g for g in plan.groups if g.kind == "flat")
            lit = ScanRequest("step", frames=2, exposure_ms=time_ms, kV=group.kV,
                              power_W=group.power_W if power_W is None else power_W)  # fmt: skip
            profile = profile_of(machine)
            text = compose_script(lit, machine, profile)
            brightest, _, full = flat_image(plan_script(text, machine, profile), "poly")
            if not words.startswith("not even"):
                assert brightest / full == pytest.approx(0.9, abs=0.02)
            tried += 1


@pytest.mark.parametrize("name", MACHINES)
@pytest.mark.parametrize("physics", ["poly", "ideal"])
def test_a_shipped_machine_s_own_settings_saturate_nothing(
    name: str, physics: Any
) -> None:
    machine = builtin_machine(name)
    profile = profile_of(machine)
    text = compose_script(ScanRequest("step", frames=2), machine, profile)
    plan = plan_script(text, machine, profile)
    brightest, _, full = flat_image(plan, physics)
    assert 0.3 * full < brightest < full
    report = check_script(text, machine, profile, physics=physics)
    assert not {p.code for p in report.problems} & set(OPEN_BEAM_CODES)


def test_larger_pixels_hold_more_charge() -> None:
    panel = fx.Detector()
    large = replace(
        panel, pixels=replace(panel.pixels, pitch_mm=2 * panel.pixels.pitch_mm)
    )
    camera = panel.camera((4, 4))
    assert large.gain(camera) == pytest.approx(4 * panel.gain(camera))


def test_a_forecast_is_of_the_machine_s_distances_and_panel() -> None:
    """Air kerma falls with the square of the distance; the micro-CT's source is 150 mm away."""
    kerma = {
        name: fx.expose(
            "normal-5", machine=name, kV=80.0, power_W=8.0, exposure_ms=100.0, images=1
        )
        for name in ("flexray", "micro_ct")
    }
    ratio = kerma["micro_ct"].asked.kerma_mGy / kerma["flexray"].asked.kerma_mGy
    assert ratio == pytest.approx((600.0 / 150.0) ** 2, rel=0.02)
    with pytest.raises(fx.TwinError, match="sod_mm is 600; allowed"):
        fx.expose("normal-5", machine="micro_ct", sod=600.0)


def test_contrast_on_saturated_pixels_is_not_given(
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = ["--sample", "normal-5", "--machine", "xyzr_cabinet", "--exposure", "60000"]
    assert run(["expose", *words]) == 0
    told = capsys.readouterr().out
    assert "not seen: these pixels are saturated" in told
    forecast = fx.expose("normal-5", machine="xyzr_cabinet", exposure_ms=60_000.0)
    assert forecast.asked.cnr is None
    assert forecast.best[0].cnr is not None


def test_check_and_script_new_say_it(
    tmp_path: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    script = tmp_path / "bright.txt"
    words = [
        "--machine",
        "xyzr_cabinet",
        "--exposure",
        "5000",
        "--frames",
        "3",
        "--kind",
        "step",
    ]
    assert run(["script", "new", *words, "--out", str(script)]) == 0
    assert "the open beam saturates the panel" in capsys.readouterr().err
    assert run(["check", str(script), "--machine", "xyzr_cabinet"]) == 0
    assert "the open beam saturates the panel" in capsys.readouterr().err
    report = fx.plan(script, "xyzr_cabinet").check()
    assert "saturated_open_beam" in {p.code for p in report.problems}
