"""Every command that a calibration's report proposes is run on the scan that produced it.

It must end right within 4 sigma, or refuse the numbers with a finding; files that it
promises are there.
"""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import flexdt as fx
from flexdt.clients.cli.boundary import NOT_IDENTIFIABLE
from flexdt.clients.cli.command_tree import run
from flexdt.library.calibration.proposed_commands import NEXT, Typed, settling_commands
from flexdt.library.datasets.exchange import with_geometry
from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.findings import error
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses

FRAMES, SHAPE, PIXEL_MM = 16, (304, 382), 0.374
SOD_MM, SDD_MM = 600.0, 1059.0
TRUTH = {
    "dO_x": 0.6,
    "dO_y": -0.4,
    "dO_z": 1.5,
    "alpha": 21.0,
    "tau_x": 0.3,
    "tau_z": 0.2,
}
SIGMAS = 4.0


def turned(sod: float = SOD_MM, factor: float = 1.0) -> Poses:
    """A turn; its true angles are `factor` times those."""
    angle = factor * 2.0 * math.pi * np.arange(FRAMES) / FRAMES
    return Poses.upright([0, 0, 0], [0, sod, 0], [0, SDD_MM, 0], PIXEL_MM, angle)


def swaying(poses: Poses) -> Poses:
    """The mount moves to and fro across the beam and up and down."""
    n = np.arange(len(poses))
    sway = np.stack([0.6 * np.sin(1.9 * n), 0.0 * n, 0.4 * np.cos(2.7 * n)], axis=1)
    return replace(poses, axis=poses.axis + sway)


def elsewhere(poses: Poses) -> Poses:
    """The panel is 25 mm further away than is said."""
    return replace(poses, detector=poses.detector + [0.0, 25.0, 0.0])


def jumping(poses: Poses) -> Poses:
    """The source steps aside in the middle of the turn."""
    aside = np.where(np.arange(len(poses)) < 9, 0.0, 0.2)
    return replace(poses, source=poses.source + aside[:, None] * [1.0, 0.0, 0.0])


@dataclass(frozen=True)
class Case:
    """A scan whose report proposes commands.

    Attributes:
        code: of the finding that decides; "": numbers are offered.
        true: where everything really is.
        phantom: that is named.
        moving: parameters with another value in each frame.
        advises: option that is in one of the proposed commands.
        anybody: the scan is a folder of TIFFs, with its geometry in a file.
        sample: that was scanned.
        warns: code of a warning beside the numbers; what is proposed mends it.
    """

    code: str
    true: Callable[[], Poses]
    phantom: str = "lego"
    moving: tuple[str, ...] = ()
    advises: str = ""
    anybody: bool = False
    sample: str = "lego"
    warns: str = ""


CASES = {
    "right": Case("", turned),
    "wrong_phantom": Case("wrong_phantom", turned, "normal"),
    "moves": Case(
        "",
        lambda: swaying(turned()),
        moving=("dO_x", "dO_y"),
        advises="--per-frame dO_x,",
        warns="vibration",
    ),
    "angle_scale": Case(
        "angle_scale", lambda: turned(factor=1.004), advises=",angle_scale"
    ),
    "reversed": Case("angle_reversed", lambda: turned(factor=-1.0)),
    "held_parameter": Case(
        "held_parameter", lambda: elsewhere(turned()), advises=",dD_z"
    ),
    "anybodys": Case("", turned, advises="--geometry GEOMETRY ", anybody=True),
    "anybodys_held": Case(
        "held_parameter", lambda: elsewhere(turned()), advises=",dD_z", anybody=True
    ),
    "jumps": Case("", lambda: jumping(turned()), advises="--per-frame dO_x,"),
}


def scanned(
    true: Poses, said: Poses, folder: Path, anybody: bool = False, sample: str = "lego"
) -> Path:
    """Save a scan of a sample at one geometry under another.

    Anybody's is a folder of TIFFs under other names, with a geometry file beside it.
    """
    geometry = true.cone_vec(Offsets.from_edge(TRUTH)).with_shape(SHAPE)
    data = fx.simulate(sample, geometry, noise=1)
    with_geometry(data, said.cone_vec(Offsets()).with_shape(SHAPE)).save(folder)
    if anybody:
        for file in list(folder.iterdir()):
            if file.name == "geometry.json":
                file.rename(folder.with_suffix(".json"))
            elif file.name.startswith("scan_"):
                file.rename(folder / file.name.replace("scan_", "view"))
            elif file.suffix != ".tif":
                file.unlink()
    return folder


def calibrated(words: list[str], report: Path) -> Any:
    """Run a calibration by its command, and return its document."""
    run(["calibrate", *words, "--report", str(report)])
    return json.loads(report.read_text())


def require_right_or_careful(document: Any, moving: tuple[str, ...] = ()) -> None:
    """Check that the numbers are right, or withheld with a reason."""
    if not document["identifiable"]:
        assert codes(document, "error")
    else:
        require_right(document, moving)


def codes(document: Any, severity: str) -> list[str]:
    """List the codes of a document's findings of a severity."""
    return [p["code"] for p in document["problems"] if p["severity"] == severity]


def require_right(document: Any, moving: tuple[str, ...] = ()) -> None:
    """Check that numbers are offered, within `SIGMAS` of the truth."""
    assert document["identifiable"], document["problems"]
    for name, value in TRUTH.items():
        found = document["parameters"][name]
        if name not in moving:
            assert abs(found["value"] - value) < SIGMAS * found["sigma"], name


def proposed(case: Case, folder: Path) -> tuple[Path, list[str], Any]:
    """Calibrate the scan of a case: its folder, what is proposed, and the document."""
    scan = scanned(case.true(), turned(), folder / "scan", case.anybody, case.sample)
    words = [str(scan)]
    if case.anybody:
        words = ["--frames", str(scan), "--geometry", str(scan.with_suffix(".json"))]
    document = calibrated([*words, "--phantom", case.phantom], folder / "first.json")
    first = codes(document, "error")[:1]
    assert first == [case.code] * bool(case.code), document["problems"]
    return scan, document["next"], document


def filled_in(line: str, scan: Path, folder: Path) -> list[str]:
    """Replace the words of a proposed command that its reader replaces."""
    places = {
        "SAMPLE": str(scan), "REPORT.json": str(folder / "first.json"), "NAME": "lego",
        "PLACE-1": str(scan), "PLACE-2": str(folder / "nearer"),
        "GEOMETRY": str(scan.with_suffix(".json")),
        "GEOMETRY-1": str(scan.with_suffix(".json")),
        "GEOMETRY-2": str(folder / "nearer.json"),
    }  # fmt: skip
    words = shlex.split(line, comments=True)
    assert words.pop(0) == "flexdt"
    return [places.get(word, word) for word in words]


def run_what_is_proposed(case: Case, folder: Path) -> None:
    """Calibrate a scan and run every command that is proposed on it."""
    scan, lines, first = proposed(case, folder)
    if case.warns:
        assert case.warns in codes(first, "warning")
        require_right(first, case.moving)
    assert any(case.advises in line for line in lines), lines
    for line in lines:
        words = filled_in(line, scan, folder)
        if str(folder / "nearer") in words:
            near = turned(0.75 * SOD_MM)
            scanned(near, near, folder / "nearer", case.anybody)
        if words[0] == "calibrate" and "report.html" not in words:
            document = calibrated(words[1:], folder / "next.json")
            require_right_or_careful(document, case.moving)
            if case.warns:
                assert document["identifiable"], document["problems"]
                assert case.warns not in codes(document, "warning")
        elif words[0] == "calibrate":
            assert run(words) == NOT_IDENTIFIABLE, line
        else:
            assert run(words) == 0, line
        for i, word in enumerate(words):
            if word in ("--out", "--report"):
                assert Path(words[i + 1]).exists(), line


@pytest.mark.parametrize("name", ["angle_scale"])
def test_what_a_report_proposes_ends_right(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run_what_is_proposed(CASES[name], tmp_path)


@pytest.mark.slow
@pytest.mark.campaign(1)
@pytest.mark.parametrize("name", sorted(set(CASES) - {"angle_scale"}))
def test_everything_a_report_proposes_ends_right_or_more_careful(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run_what_is_proposed(CASES[name], tmp_path)


PAIRS = np.array([[12.0, 0, -15], [-12, 0, -15], [0, 9, 15], [0, -9, 15]])
"""Four beads that half a turn maps onto themselves [mm]."""


@pytest.mark.parametrize("stated", [False, True])
def test_a_symmetric_phantom_is_calibrated_in_both_ways_that_are_advised(
    stated: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    beads = "".join(
        f'[[bead]]\nposition_mm = {p}\nradius_mm = 2\nmaterial = "steel"\n'
        for p in PAIRS.tolist()
    )
    Path("pairs.toml").write_text(f'schema = 1\nname = "pairs"\n{beads}')
    geometry = turned().cone_vec(Offsets.from_edge(TRUTH)).with_shape(SHAPE)
    data = fx.simulate("pairs.toml", geometry, noise=1)
    with_geometry(data, turned().cone_vec(Offsets()).with_shape(SHAPE)).save("scan")
    document = calibrated(["scan", "--phantom", "pairs.toml"], tmp_path / "first.json")
    assert document["parameters"]["alpha"]["value"] is None
    (problem,) = [p for p in document["problems"] if p["code"] == "ambiguous"]
    if stated:
        assert "--start alpha=21.0 --prior alpha=5" in problem["text"]
        turn = ["--start", "alpha=24", "--prior", "alpha=5"]
        words = ["scan", "--phantom", "pairs.toml", *turn]
    else:
        (line,) = [line for line in document["next"] if "--start" in line]
        words = shlex.split(line)[2:]
    document = calibrated(words, tmp_path / "next.json")
    assert document["identifiable"]
    column = document["image_space"][0]["axis_column"]
    across = TRUTH["dO_x"] + TRUTH["tau_x"]
    beam = SDD_MM / (SOD_MM + TRUTH["dO_z"] + TRUTH["tau_z"]) / PIXEL_MM
    true = (SHAPE[1] - 1) / 2 + across * beam
    assert abs(column["value"] - true) < SIGMAS * column["sigma"]
    if stated:
        require_right_or_careful(document)


def test_the_scan_is_named_where_it_is_the_samples_own() -> None:
    own = Typed(("my scan",), "unknown", ("g.json",), report="r.json").use()
    assert own == (
        "flexdt reconstruct 'my scan' --geometry g.json --correction r.json --out volume.tif"
    )
    frames = Typed((), "unknown", ("g.json",), {"frames": "tiffs"}, "r.json").use()
    assert shlex.split(frames)[2] == "tiffs"
    other = Typed(("beads",), "lego", report="r.json").use()
    assert other.endswith("  # SAMPLE: the folder of your sample's scan")


def test_every_command_of_the_table_has_a_case() -> None:
    unrun = {"bead_size"}  # as `wrong_phantom`
    assert set(NEXT) <= {case.code for case in CASES.values()} | unrun


def test_advice_of_a_finding_becomes_a_command() -> None:
    said = error(
        CalibrationCode.HELD_PARAMETER,
        "dD_z is held at 0 mm: free dD_z, det_roll too, or hold it",
        free=("dD_z", "det_roll"),
    )
    typed = Typed(("scan",), "lego", options={"prior": "dD_z=0,det_yaw=0.1"})
    (line,) = settling_commands(said, typed, ("dO_x",))
    assert line == (
        "flexdt calibrate scan --phantom lego --prior det_yaw=0.1 "
        "--free dO_x,dD_z,det_roll"
    )
    (line,) = settling_commands(
        error(
            CalibrationCode.DRIFT,
            "dO_x moves: --per-frame dO_x,dO_y follows it",
            per_frame=("dO_x", "dO_y"),
        ),
        typed,
        (),
    )
    assert line.endswith(" --per-frame dO_x,dO_y")
    (line,) = settling_commands(
        error(CalibrationCode.ONE_BEAD, "a single shadow"), typed, ()
    )
    assert line.endswith(" --report report.html")
