"""The studies behind docs/evidence/physics.json and reconstruction.json, with what they must
show: physics_figures, detector_figures, reference_scan, and, where the peers are installed,
compare_fdk and compare_gvxr; and silent_errors.
"""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

STUDIES = Path(__file__).resolve().parents[1] / "studies"


def run(name: str, *words: object) -> dict[str, Any]:
    done = subprocess.run(
        [sys.executable, str(STUDIES / f"{name}.py"), *map(str, words)],
        capture_output=True, text=True, timeout=290, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    begin, end = done.stdout.index("{\n"), done.stdout.rindex("}") + 1
    document: dict[str, Any] = json.loads(done.stdout[begin:end])
    return document


@pytest.mark.slow
@pytest.mark.campaign
def test_drawn_scans_are_right_or_said() -> None:
    study = STUDIES / "silent_errors.py"
    done = subprocess.run(
        [sys.executable, str(study), "--count", "30"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    assert "right" in done.stdout


def test_physics_figures() -> None:
    import physics_figures as study

    assert study.slabs() < 1e-4
    wedge = study.wedge()
    assert wedge["worst_error"] < 1e-3
    assert wedge["attenuation_last_per_mm"] < 0.5 * wedge["attenuation_first_per_mm"]
    detector = study.detector()
    assert detector["gain_over_truth"] == pytest.approx(1.0, abs=0.02)
    assert detector["read_noise_over_truth"] == pytest.approx(1.0, abs=0.02)
    assert detector["brightest"] == 16383
    assert 2.0 < detector["half_modulation_lp_per_mm"] < 4.0


def test_detector_figures() -> None:
    """Noise power and modulation of images are theory's; the energy kept is as published."""
    import detector_figures as study

    theory = study.Theory.of(0.1496, study.TIME_MS)
    f, power = study.noise_power(0.1496, 12, 128)
    assert np.mean(power / theory.noise_power(f)) == pytest.approx(1.0, abs=0.03)
    at, modulation = study.edge(0.0748, 4)
    wanted = study.Theory.of(0.0748, study.TIME_MS).mtf(at)
    np.testing.assert_allclose(modulation[at < 0.25], wanted[at < 0.25], atol=0.01)
    stopped, kept, published = study.thick_response()
    np.testing.assert_allclose(stopped, published, rtol=0.004)
    assert (kept <= published * 1.004).all()
    ours, nist = study.thin_response("CsI")  # no L photons escape here
    assert (ours / nist).min() > 1.0
    assert (ours / nist).max() < 1.07


@pytest.mark.slow
@pytest.mark.campaign
def test_reference_scan(tmp_path: Path) -> None:
    """A tenth of the frames at half the resolution: servers, poly physics, both texts."""
    words = ("--out", tmp_path, "--frames", 96, "--voxel", 0.2, "--physics", "poly")
    figures = run("reference_scan", *words)
    for source in ("flexdt.json", "texts alone"):
        assert max(figures[source]["bead_errors_mm"]) < 0.02
    sharp = [figures[source]["sharpness"] for source in ("flexdt.json", "texts alone")]
    assert sharp[1] == pytest.approx(sharp[0], rel=0.01)
    # The servers' own peak may be that of compiling their kernels, before anything is sampled.
    assert max(figures["reader_peak_gib"], figures["servers_peak_gib"]) < 4.0
    assert 0.2 < figures["all_processes_peak_gib"] < 4.0
    document = json.loads((tmp_path / "data" / "reference" / "flexdt.json").read_text())
    assert document["noise"]["model"]["physics_poly"] == 1.0


@pytest.mark.slow
@pytest.mark.campaign
def test_compare_fdk() -> None:
    if importlib.util.find_spec("itk") is None:
        pytest.skip("itk-rtk is not installed")
    figures = run("compare_fdk", "--views", 120, "--voxels", 40, "--repeat", 1)
    assert figures["flexdt_ball"] == pytest.approx(1.0, abs=0.01)
    assert figures["largest_difference"] < 2e-7  # of attenuations of 0.05 / mm


@pytest.mark.slow
def test_compare_gvxr() -> None:
    pytest.importorskip("gvxrPython3", reason="gvxr does not load", exc_type=ImportError)
    figures = run("compare_gvxr")
    assert figures["mean"] < 0.002
    assert figures["mean_if_mirrored"] > 0.01  # so a mirrored image would be seen
    assert figures["part_off_edges"] > 0.9
    assert figures["worst_off_edges"] < 0.01
    assert figures["least_transmission"] < 0.02
