"""A scan during which the stage rises: from its folder to a sharp volume and other formats."""

from __future__ import annotations

import json
from pathlib import Path

import motion_during_scan as study
import numpy as np
import pytest
from prior_coverage import PIXEL, SDD, SOD, pixels
from prior_coverage import SHAPE as STUDY_SHAPE

import flexdt as fx
from flexdt.clients.cli.command_tree import run
from flexdt.twin.geometry.motion import Motion
from flexdt.twin.geometry.offsets import NAMES

VIEWS = 60
SHAPE = (380, 478)
PITCH = 0.2992


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, fx.ConeVec]:
    """The folder of a scan that believes itself circular, and its true geometry."""
    still = fx.ConeVec.circular(sod=600, sdd=1059, angles=VIEWS, shape=SHAPE, pixel=PITCH)
    rise = np.linspace(-0.5, 0.5, VIEWS)
    rows = still.rows.copy()
    rows[:, [2, 5]] -= rise[:, None]  # source and panel, seen from an object that rises
    true = fx.ConeVec(rows).with_shape(SHAPE)
    folder = tmp_path_factory.mktemp("motion") / "rising"
    fx.simulate("lego", true, noise=5).save(folder)
    still.save(folder / "geometry.json")
    return folder, true


@pytest.mark.slow
@pytest.mark.campaign
def test_a_screw_is_followed_from_calibration_to_volume(
    scan: tuple[Path, fx.ConeVec], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, true = scan
    report = tmp_path / "report.json"
    words = ["calibrate", str(folder), "--phantom", "lego", "--prior", "none"]
    # Of a scan that moves, the geometry of the mean is offered, and the motion is told.
    assert run([*words, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    for name in ("dO_x", "dO_y", "dO_z", "alpha", "tau_x", "tau_z"):
        value = told["parameters"][name]
        assert abs(value["value"]) < 4 * value["sigma"], name
    assert "drift" in {p["code"] for p in told["problems"]}
    assert any("--per-frame" in p["text"] for p in told["problems"])
    assert run([*words, "--per-frame", "dO_y,alpha", "--report", str(report)]) == 0
    said = capsys.readouterr().out
    assert (
        "dO_y moves by 0.98" in said
        or "dO_y moves by 0.99" in said
        or "dO_y moves by 1" in said
    )
    page = tmp_path / "report.html"
    assert run([*words, "--per-frame", "dO_y", "--report", str(page)]) == 0
    assert "rising: dO_y during the scan" in page.read_text("utf-8")
    document = json.loads(report.read_text("utf-8"))
    assert document["rms_px"] < 0.05
    motion = Motion.from_dict(document["motion"][0])
    np.testing.assert_allclose(
        motion.values[:, 0], np.linspace(-0.5, 0.5, VIEWS), atol=0.003
    )

    beads = np.asarray(fx.phantoms.lego().beads)
    for format, ending in (("csv", "csv"), ("rtk", "xml"), ("ctsimu", "json")):
        out = tmp_path / f"geometry.{ending}"
        words = ["export", str(folder), "--format", format, "--out", str(out)]
        assert run([*words, "--correction", str(report)]) == 0
        back = tmp_path / f"{format}.json"
        words = [
            "import",
            str(out),
            "--format",
            format,
            "--out",
            str(back),
            "--like",
            str(folder),
        ]
        assert run(words) == 0
        written = fx.ConeVec.load(back)
        off = written.project_points(beads, SHAPE) - true.project_points(beads, SHAPE)
        assert np.abs(off).max() < 0.05, format

    steepest = {}
    for name, correction in (("with", str(report)), ("without", "none")):
        out = tmp_path / f"{name}.mha"
        bead = ",".join(f"{v:.3f}" for v in beads[0])
        assert run(["reconstruct", str(folder), "--correction", correction, "--out", str(out),
                    "--voxel", "0.2", "--shape", "30,30,30", "--center", bead]) == 0  # fmt: skip
        # The steepest rise of the vertical profile through the bead's centre.
        profile = fx.Volume.load(out).data[:, 13:17, 13:17].mean(axis=(1, 2))
        steepest[name] = float(np.diff(profile).max() / np.median(profile[13:17]))
    assert steepest["with"] > 0.7
    assert steepest["without"] < 0.35

    other = tmp_path / "other"
    folder.rename(other)
    try:
        assert run(["export", str(other), "--format", "csv", "--correction", str(report),
                    "--out", str(tmp_path / "other.csv")]) == 0  # fmt: skip
        assert "is left out for" in capsys.readouterr().err
    finally:
        other.rename(folder)


def test_what_is_held_is_not_taken_for_motion(tmp_path: Path) -> None:
    """Jitter beside an object whose place on the table is exactly known, marked by hand."""
    rng = np.random.default_rng(4)
    beads, turn = np.asarray(fx.phantoms.lego().beads), np.arange(60) / 60
    truth, frames, deviation = study.truths(rng, "jitter", turn)
    for one in (truth, *frames):
        one["tau_x"] = one["tau_z"] = 0.0
    tracks = [
        pixels(beads, 360.0 * turn[i : i + 1], SOD, one) for i, one in enumerate(frames)
    ]
    seen = np.concatenate(tracks) + 0.02 * rng.normal(size=(60, len(beads), 2))
    np.save(tmp_path / "seen.npy", seen)
    angles = np.degrees(2 * np.pi * turn)
    scan = fx.ConeVec.circular(
        sod=SOD, sdd=SDD, angles=angles, shape=STUDY_SHAPE, pixel=PIXEL
    )
    exact = dict.fromkeys(set(NAMES) - {"dO_x", "dO_y", "dO_z", "alpha"}, 0.0)
    found = fx.calibrate(
        None, "lego", geometry=scan, markers=tmp_path / "seen.npy", priors=exact,
        free=["dO_x", "dO_y", "dO_z", "alpha"], per_frame=["dO_x"],
    )  # fmt: skip
    assert found.calibration.identifiable
    assert [f.code for f in found.calibration.findings] == ["held_unchecked"]
    motion = found.calibration.motions[0]
    pulls = (motion.values[:, 0] - deviation) / motion.sigma[:, 0]
    # Of the stated sigmas, 25 times the noise here, three degrees of freedom count.
    assert 0.4 < np.sqrt(np.mean(pulls**2)) < 1.6
    for name in ("dO_x", "dO_y", "dO_z", "alpha"):
        p = found.parameters[name]
        assert abs(p["value"] - truth[name]) < 4.5 * p["sigma"]  # type: ignore[operator]
    # What was found is in the geometry that is written, too.
    moved = found.datasets[0].with_correction(found.correction)
    off = moved.geometry.project_points(beads, STUDY_SHAPE) - np.concatenate(tracks)
    assert np.sqrt(np.mean(off**2)) < 0.02


def test_motion_on_the_command_line_is_checked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        run(["calibrate", str(tmp_path), "--phantom", "lego", "--per-frame", "tau_x"])
        == 1
    )
    assert (
        "'tau_x' cannot differ from frame to frame; allowed: dO_x"
        in capsys.readouterr().err
    )
