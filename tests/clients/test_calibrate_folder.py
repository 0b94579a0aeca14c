"""Calibration and comparison of folders: from TIFFs and texts alone, damaged ones, the
report."""

from __future__ import annotations

import json
import math
import re
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
import tifffile
from bead_scan import bead_scan

from flexdt.clients.cli.command_tree import run
from flexdt.library.calibration.bead_tracks import write_tracks
from flexdt.library.calibration.calibrate import (
    calibrate_datasets,
    find_phantom,
    inside_95,
)
from flexdt.library.calibration.calibration_report import write_report
from flexdt.library.comparison import compare_folder, write_comparison
from flexdt.library.reading.folders import load_dataset
from flexdt.phantoms import load_phantom
from flexdt.twin.calibration.fit.problem import SIX
from flexdt.twin.calibration.pipeline import CalibrationRequest
from flexdt.twin.errors import TwinError, UnknownNameError
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.machine.description import builtin_machine, builtin_profile

M = builtin_machine()
P = builtin_profile(M.default_profile)
SIGMA_MOST = {"dO_z": 0.8}
"""Sigma [mm] that the phantom's scale, known to 0.1 %, leaves of the source's distance."""
TRUTH = {
    "dO_x": 0.912345678901, "dO_y": -0.623456789012, "dO_z": 2.534567890123,
    "alpha": 33.045678901234, "tau_x": 0.456789012345, "tau_z": -0.367890123456,
}  # fmt: skip
"""Twelve digits each, so that they are found wherever they are."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A turn of 37 images (the last repeats the first) of the LEGO phantom, TRUTH hidden."""
    return bead_scan(tmp_path_factory.mktemp("scans"), TRUTH, 37)


@pytest.fixture
def copy(folder: Path, tmp_path: Path) -> Path:
    """A copy to damage, without flexdt.json: TIFFs and the two texts, as a scanner writes."""
    target = tmp_path / "copy"
    shutil.copytree(folder, target)
    (target / "flexdt.json").unlink()
    return target


@pytest.mark.campaign(1)
def test_a_scanners_folder_is_calibrated_to_the_hidden_truth(
    copy: Path, tmp_path: Path
) -> None:
    outcome = calibrate_datasets([load_dataset(copy)], "lego")
    document = outcome.document
    assert document["identifiable"] is True
    assert document["rank"] == 6
    assert document["frames"] == 37
    assert document["detections"] == 5 * 37
    assert document["problems"] == []
    for name, value in TRUTH.items():
        found = document["parameters"][name]  # type: ignore[index]
        assert abs(found["value"] - value) < 5 * found["sigma"] + 1e-6
        assert found["images"] < 0.25
        assert found["sigma"] < SIGMA_MOST.get(name, 0.5)
    (seen,) = document["image_space"]  # type: ignore[misc]
    assert seen["axis_column"]["sigma"] < 0.002
    assert seen["magnification"]["sigma"] < 1.5e-3 * seen["magnification"]["value"], (
        "its scale's"
    )
    assert "of it 0.0" in document["limited"]["dO_x"]  # type: ignore[index]
    assert inside_95(outcome, TRUTH) == bool(
        outcome.calibration.fit.certificate.inside_95(  # type: ignore[union-attr]
            TRUTH | dict.fromkeys(M.priors, 0.0)
        )
    )
    assert not inside_95(outcome, TRUTH | {"dO_x": 2.0})
    assert not inside_95(
        outcome, TRUTH | {"det_roll": 1.0}
    )  # not estimated, so assumed absent
    json.dumps(document, allow_nan=False)
    write_report(outcome, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert "Safe to reconstruct: the rotation axis is known to" in page
    assert page.count("<svg") >= 8
    # An arrow with a dot for each of the five beads' positions that are in the fit.
    used = outcome.calibration.fit.certificate.used.sum()  # type: ignore[union-attr]
    groups = dict(
        re.findall(
            r'<g id="[^"]*residuals-over-the-detector[^"]*-bead-(.+?)">(.*?)</g>',
            page,
            re.S,
        )
    )
    lines, dots = (
        [g for name, g in groups.items() if name.endswith("places") is ends]
        for ends in (False, True)
    )
    assert len(lines) == len(dots) == 5
    assert sum(len(re.findall(r"\bM ", g)) for g in lines) == used
    assert sum(g.count("<use") for g in dots) == used
    write_report(outcome, tmp_path / "report.json")
    assert json.loads((tmp_path / "report.json").read_text())["rank"] == 6
    pushed, nominal = outcome.correction.parameters.to_edge(), NOMINAL.to_edge()
    changed = {name for name, value in pushed.items() if value != nominal[name]}
    assert changed == set(TRUTH) | set(M.priors)


@pytest.mark.slow
@pytest.mark.campaign
def test_an_exact_phantom_tells_the_magnification(copy: Path) -> None:
    exact = CalibrationRequest(free=SIX, bead_tolerance_mm=0.0)
    found = calibrate_datasets([load_dataset(copy)], "lego", exact).document
    (seen,) = found["image_space"]  # type: ignore[misc]
    assert seen["magnification"]["sigma"] < 2e-5
    assert found["parameters"]["dO_z"]["sigma"] < 0.5  # type: ignore[index]


def test_the_truth_is_nowhere_in_the_data_set(folder: Path) -> None:
    """Calibration reads a folder; nothing in it tells the truth it was made with: none of the
    six values, in mm, degrees or radians, in figures or as the bytes of a float."""
    values = [*TRUTH.values(), math.radians(TRUTH["alpha"])]
    digits = [f"{abs(v):.9f}".lstrip("0").removeprefix(".")[:7].encode() for v in values]
    packed = [struct.pack(order, v) for v in values for order in ("<d", ">d")]
    files = list(folder.iterdir())
    assert {p.suffix for p in files} >= {".tif", ".txt", ".json"}
    for path in files:
        data = path.read_bytes()
        assert not any(p in data for p in packed), path.name
        if path.suffix == ".tif":
            continue
        assert b"truth" not in data.lower(), path.name
        assert not any(d in data for d in digits), path.name
    assert digits[0] == b"9123456"  # what is looked for is what repr() would write


@pytest.mark.slow
def test_two_scans_in_one_fit(copy: Path, folder: Path) -> None:
    with pytest.raises(TwinError, match=r"scans 1 and 2 .* same images"):
        calibrate_datasets([load_dataset(copy), load_dataset(folder)], "lego")
    rng = np.random.default_rng(4)
    for file in copy.glob("scan_*.tif"):  # a scan of its own: another noise
        image = tifffile.imread(file).astype(np.int64)
        image += rng.integers(-5, 6, image.shape)
        tifffile.imwrite(file, np.clip(image, 0, 16383).astype(np.uint16))
    outcome = calibrate_datasets([load_dataset(copy), load_dataset(folder)], "lego")
    assert outcome.document["identifiable"] is True
    assert outcome.document["frames"] == 74
    apart = calibrate_datasets(
        [load_dataset(copy), load_dataset(folder)],
        "lego",
        CalibrationRequest(per_scan=("alpha", "tau_x", "tau_z")),
    ).document["parameters"]
    assert apart["alpha@0"]["value"] == pytest.approx(33.0, abs=0.1)  # type: ignore[index]
    assert apart["alpha@1"]["value"] == pytest.approx(33.0, abs=0.1)  # type: ignore[index]


@pytest.mark.slow
def test_the_command_knows_readings_scans_and_what_is_held(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["calibrate", str(folder), "--phantom", "lego", "--json"]

    def values(*more: str) -> dict[str, float]:
        assert run([*words, *more]) == 0
        document = json.loads(capsys.readouterr().out)
        return {n: p["value"] for n, p in document["parameters"].items()}

    printed, mount = values(), values("--reading", "mount")
    assert mount["dO_x"] == pytest.approx(printed["dO_x"] + printed["tau_x"], abs=1e-4)
    assert mount["dO_y"] == pytest.approx(printed["dO_y"], abs=1e-6)
    assert run([*words, "--per-scan", "alpha"]) == 2
    assert "allowed with: several data sets" in " ".join(capsys.readouterr().err.split())
    twice = ["calibrate", str(folder), str(folder), "--phantom", "lego"]
    assert run([*twice, "--per-scan", "alpha", "--free", "dO_x"]) == 1
    assert (
        "alpha is to have a value in each scan but is not free" in capsys.readouterr().err
    )
    four = ("--free", "dO_x,dO_y,dO_z,alpha")
    assert values(*four)["tau_x"] == pytest.approx(printed["tau_x"], abs=1e-3)
    assert run([*words, *four, "--prior", "none"]) == 5
    said = capsys.readouterr()
    assert "tau_x is held at 0 mm, the data say 0.45" in said.err
    assert "[held_parameter]" in said.err
    assert all(p["value"] is None for p in json.loads(said.out)["parameters"].values())


def test_some_of_the_same_images_are_no_second_scan(
    copy: Path, folder: Path, tmp_path: Path
) -> None:
    for file in copy.glob("scan_*.tif"):
        if int(file.stem[-6:]) % 5:
            file.unlink()
    with pytest.raises(
        TwinError, match=r"same images \(8 of 37 frames\); give each image once"
    ):
        calibrate_datasets([load_dataset(folder), load_dataset(copy)], "lego")


def test_what_cannot_be_asked_for(folder: Path) -> None:
    with pytest.raises(UnknownNameError, match="unknown parameter 'foo'; allowed: dO_x"):
        calibrate_datasets(
            [load_dataset(folder)], "lego", CalibrationRequest(free=("dO_x", "foo"))
        )
    with pytest.raises(TwinError, match="no parameter is free"):
        CalibrationRequest(free=())
    for tolerance in (-1.0, float("nan"), float("inf")):
        with pytest.raises(TwinError, match="bead tolerance"):
            CalibrationRequest(bead_tolerance_mm=tolerance)
    with pytest.raises(
        TwinError, match="tau_x is to have a value in each scan but is not free"
    ):
        CalibrationRequest(free=("dO_x",), per_scan=("tau_x",))


def test_missing_and_broken_frames_are_named_and_survived(copy: Path) -> None:
    for i in (3, 4, 5, 20):
        (copy / f"scan_{i:06d}.tif").unlink()
    (copy / "scan_000009.tif").write_bytes(b"not a tiff")
    tifffile.imwrite(copy / "scan_000011.tif", np.zeros((10, 20), np.uint16))
    outcome = calibrate_datasets([load_dataset(copy)], "lego")
    assert outcome.document["identifiable"] is True
    codes = [p["code"] for p in outcome.document["problems"]]  # type: ignore[attr-defined]
    # What six images fewer leave open may widen the intervals, and is told.
    assert codes[0] == "frames_missing"
    assert set(codes[1:]) <= {"causes_open"}
    text = outcome.document["problems"][0]["text"]  # type: ignore[index]
    assert "6 of 37" in text
    assert "scan_000009.tif" in text
    assert "scan_000011.tif" in text
    assert "20" in text.split("scan_000011.tif")[1]  # its size
    assert "scan_000003.tif" not in text  # not there at all
    used = outcome.calibration.fit.certificate.beads_per_frame  # type: ignore[union-attr]
    assert used[[3, 4, 5, 9, 11, 20]].tolist() == [0] * 6


def test_half_a_scan_in_the_dark(copy: Path) -> None:
    dark = tifffile.imread(copy / "di000000.tif")
    for i in range(18, 37):
        tifffile.imwrite(copy / f"scan_{i:06d}.tif", dark)
    document = calibrate_datasets([load_dataset(copy)], "lego").document
    assert document["identifiable"] is True
    assert [p["code"] for p in document["problems"]] == ["frames_dark"]  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("phantom", "codes"),
    [("compact-4", {"wrong_phantom"}), ("normal-5", {"wrong_phantom", "no_beads"})],
)
@pytest.mark.daily(1)
def test_another_phantom_is_refused(copy: Path, phantom: str, codes: set[str]) -> None:
    document = calibrate_datasets([load_dataset(copy)], phantom).document
    assert document["identifiable"] is False
    assert {p["code"] for p in document["problems"]} & codes  # type: ignore[attr-defined]
    assert all(p["value"] is None for p in document["parameters"].values())  # type: ignore[attr-defined]
    with pytest.raises(TwinError, match="offers no correction"):
        _ = calibrate_datasets([load_dataset(copy)], phantom).correction


def test_a_phantom_must_exist_and_have_beads(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="no phantom called"):
        find_phantom("brick")
    with pytest.raises(TwinError, match="no beads"):
        find_phantom("shepp-logan")
    file = tmp_path / "own.json"
    file.write_text(json.dumps(load_phantom("normal-4").to_dict()))
    assert len(find_phantom(str(file)).beads) == 4


@pytest.mark.slow
def test_compare_shows_the_correction_removing_the_difference(
    copy: Path, tmp_path: Path
) -> None:
    comparison = compare_folder(copy, "lego", 0.5)
    document = comparison.document
    assert comparison.within
    assert document["before"]["rms_px"] > 5.0  # type: ignore[index]
    assert document["after"]["rms_px"] < 0.05  # type: ignore[index]
    assert document["after"]["image_rms"] < 0.3 * document["before"]["image_rms"]  # type: ignore[index]
    assert not compare_folder(copy, "lego", 1e-6).within
    write_comparison(comparison, tmp_path / "out")
    assert (tmp_path / "out" / "report.html").is_file()
    after = tifffile.imread(next((tmp_path / "out").glob("*_after.tif")))
    assert after.shape == comparison.after.shape[1:]
    assert np.isfinite(after).all()
    with pytest.raises(TwinError, match=r"(wrong|another) phantom"):
        compare_folder(copy, "compact-4")


@pytest.mark.slow
def test_tracks_tell_where_the_beads_are_before_and_after(
    folder: Path, tmp_path: Path
) -> None:
    outcome = calibrate_datasets([load_dataset(folder)], "lego")
    write_tracks(outcome, tmp_path / "tracks.json")
    (scan,) = json.loads((tmp_path / "tracks.json").read_text())["datasets"]
    assert scan["before"] == "nominal"
    assert [f["file"] for f in scan["frames"]] == [f"scan_{i:06d}.tif" for i in range(37)]
    compared = compare_folder(folder, "lego", shown=1).document
    for when in ("before", "after"):
        rms = compared[when]["rms_px"]  # type: ignore[index]
        assert scan[f"rms_{when}_px"] == pytest.approx(rms, rel=1e-6)
    # The truth's own projection of the beads, by the geometry alone: sizes bias shadows by <
    # 0.1.
    dataset = load_dataset(folder)
    true = dataset.poses.cone_vec(Offsets.from_edge(TRUTH))
    wanted = true.project_points(load_phantom("lego").beads, dataset.shape)
    got = np.array([f["after"] for f in scan["frames"]], dtype=float)
    assert np.nanmax(np.abs(got - wanted)) < 0.3
    seen = [sum(m is not None for m in f["measured"]) for f in scan["frames"]]
    assert min(seen) >= 2
