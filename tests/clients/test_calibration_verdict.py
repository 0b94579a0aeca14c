"""The first sentence of a calibration, and the commands that it proposes."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.main import get_command

import flexdt as fx
from flexdt.clients.cli.command_tree import build
from flexdt.clients.cli.commands.calibrate_commands import show
from flexdt.library.calibration.calibrate import digits, ranges, rounded_up
from flexdt.library.calibration.proposed_commands import NEXT, Typed, settling_commands
from flexdt.twin.findings import FindingCode, error

SCAN = fx.ConeVec.circular(sod=600, sdd=1059, angles=24, shape=(380, 478), pixel=0.2992)


@pytest.fixture(scope="module")
def data() -> fx.DataSet:
    return fx.simulate("lego", SCAN, noise=1)


def known(line: str) -> None:
    """The command and its options exist."""
    words = shlex.split(line, comments=True)
    assert words.pop(0) == "flexdt"
    command: Any = get_command(build())
    while words and words[0] in getattr(command, "commands", {}):
        command = command.commands[words.pop(0)]
    assert not getattr(command, "commands", {}), line
    options = {name for p in command.params for name in p.opts}
    assert {word for word in words if word.startswith("--")} <= options, line


@pytest.mark.slow
def test_a_good_calibration_says_what_it_is_good_for(data: fx.DataSet) -> None:
    document: Any = data.calibrate("lego").document
    (seen,) = document["image_space"]
    sigma = rounded_up(seen["axis_column"]["sigma"])
    assert document["verdict"].startswith(
        f"Safe to reconstruct: the rotation axis is known to {sigma} px. Absolute position: to "
    )
    asked = {
        n: p
        for n, p in document["parameters"].items()
        if p["asked"] and p["unit"] == "mm"
    }
    widest = max(asked, key=lambda name: asked[name]["sigma"])
    assert (
        f"{asked[widest]['sigma']:.2g} mm ({widest}), limited by" in document["verdict"]
    )
    assert document["next"]
    for line in document["next"]:
        known(line)


@pytest.mark.slow
def test_what_forbids_a_calibration_is_said_first_with_what_to_type(
    data: fx.DataSet,
) -> None:
    document: Any = data.calibrate("normal").document
    assert document["verdict"].startswith("Not to be used: ")
    assert document["problems"][0]["text"] in document["verdict"]
    assert document["next"]
    for line in document["next"]:
        known(line)


def test_lengths_in_another_unit_are_told(tmp_path: Path) -> None:
    """A phantom's file in metres: its beads are a thousandth of what is seen."""
    few = fx.ConeVec.circular(sod=600, sdd=1059, angles=6, shape=(380, 478), pixel=0.2992)
    beads = np.array([[5, 0, -12], [-4, 3, 0], [0, -6, 9.0]])
    files = []
    for millimetres in (1.0, 1000.0):
        lines = "".join(
            f"[[bead]]\nposition_mm = {bead}\nradius_mm = {2.0 / millimetres}\n"
            f'material = "steel"\n'
            for bead in (beads / millimetres).tolist()
        )
        file = tmp_path / f"{millimetres:g}.toml"
        file.write_text(f'schema = 1\nname = "mine"\n{lines}')
        files.append(str(file))
    seen = fx.simulate(files[0], few, noise=1)
    said = seen.calibrate(files[1]).document["problems"][0]["text"]
    assert said.endswith(
        "another phantom, or lengths of the phantom's file are in m, not in mm"
    )


def test_frames_that_are_all_dark_leave_no_others() -> None:
    counts = np.full((6, 380, 478), 300, dtype=np.uint16)
    few = fx.ConeVec.circular(sod=600, sdd=1059, angles=6, shape=(380, 478), pixel=0.2992)
    flat = np.full((380, 478), 40000, dtype=np.uint16)
    dark = fx.DataSet.from_arrays(counts, few, flat=flat)
    said = dark.calibrate("lego").document["problems"][0]["text"]
    assert said.endswith("6 of 6 frames are dark")


def test_scans_without_beads_are_to_be_aligned() -> None:
    few = fx.ConeVec.circular(sod=600, sdd=1059, angles=6, shape=(95, 120), pixel=1.2)
    rng = np.random.default_rng(1)
    counts = rng.poisson(30_000, (6, 95, 120)).astype(np.uint16)
    flat = np.full((95, 120), 30_000, dtype=np.uint16)
    air = fx.DataSet.from_arrays(counts, few, flat=flat)
    document: Any = air.calibrate("lego").document
    assert document["problems"][0]["code"] == "no_beads"
    assert document["next"][0].startswith("flexdt align DATASET  #")
    for line in document["next"]:
        known(line)


@pytest.mark.parametrize("code", sorted(NEXT))
def test_proposed_commands_exist(code: FindingCode) -> None:
    finding = error(code, "another phantom")
    for line in settling_commands(finding, Typed(("scan",), "lego"), ()):
        known(line)


def test_one_marker_alone_is_a_problem_that_is_named() -> None:
    phantom = fx.phantoms.bead_phantom("normal", 1)
    seen = SCAN.project_points(phantom.beads)
    marks = [(frame, 0, *seen[frame, 0].tolist(), None) for frame in range(len(seen))]
    document: Any = fx.calibrate(None, phantom, geometry=SCAN, markers=marks).document
    assert not document["identifiable"]
    (problem,) = document["problems"]
    assert problem["code"] == "undetermined"
    assert problem["severity"] == "error"
    assert document["weak"][0] in problem["text"]
    assert problem["text"] in document["verdict"]
    for line in document["next"]:
        known(line)


def test_marks_that_were_left_out_are_named() -> None:
    """Two marks are moved by some pixels; the others have noise of a tenth."""
    rng = np.random.default_rng(3)
    seen = SCAN.project_points(fx.phantoms.lego().beads)
    seen = seen + rng.normal(0.0, 0.1, seen.shape)
    moved = {(7, 2): (6.0, 0.0), (15, 0): (0.0, -9.0)}
    for at, by in moved.items():
        seen[at] += by
    marks = [
        (frame, marker, *seen[frame, marker].tolist(), None)
        for frame in range(len(seen))
        for marker in range(seen.shape[1])
    ]
    document: Any = fx.calibrate(None, "lego", geometry=SCAN, markers=marks).document
    found = {(o["frame"], o["marker"]): o["px"] for o in document["outliers"]}
    assert set(found) == set(moved)
    for at, by in moved.items():
        assert found[at] == pytest.approx(np.hypot(*by), abs=0.6)
    text = "\n".join(show(document))
    assert "2 of these left out" in text
    assert "bead 0 of frames 15" in text
    assert "bead 2 of frames 7" in text


@pytest.mark.parametrize("seed", range(20))
def test_ranges_hold_the_numbers(seed: int) -> None:
    rng = np.random.default_rng(seed)
    numbers = set(rng.integers(0, 30, 12).tolist())
    words = [word.split("-") for word in ranges(numbers).split(", ")]
    assert {
        n for a, *b in words for n in range(int(a), int(b[0] if b else a) + 1)
    } == numbers


@pytest.mark.parametrize("seed", range(5))
def test_a_rounded_sigma_is_never_a_smaller_one(seed: int) -> None:
    for sigma in 10.0 ** np.random.default_rng(seed).uniform(-8.0, 2.0, 50):
        said = float(rounded_up(float(sigma)))
        assert 1.0 - 1e-9 <= said / sigma <= 2.0
        assert len(f"{said:e}".partition("e")[0].rstrip("0.").replace(".", "")) == 1


def test_digits_are_those_of_the_sigma() -> None:
    assert digits(238.49909, 0.0012) == "238.4991"
    assert digits(0.05, 1.07) == "0.1"
    assert digits(None, 0.1) == digits(1.0, 0.0) == "-"
