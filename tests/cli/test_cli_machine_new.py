"""`flexdt machine new`: from options, from answers, and what it refuses."""

from __future__ import annotations

import random
import sys
from pathlib import Path

import pytest
import typer

from flexdt.clients.cli.command_tree import run
from flexdt.library import machines
from flexdt.twin.collision.home_check import check_home
from flexdt.twin.errors import GeometryError, MachineFileError
from flexdt.twin.machine.description import Profile, parse_machine
from flexdt.twin.scanner.scanner import ScannerTwin


def test_options_make_a_file_that_the_other_commands_take(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "lab.toml"
    words = ["machine", "new", "lab", "--out", str(file), "--base", "xyzr_cabinet",
             "--detector", "1000x800", "--pitch", "0.1x0.12", "--sod", "60:500", "--sdd", "800",
             "--kv", "100", "--limit", "R=-720:720", "--without", "Y"]  # fmt: skip
    assert run(words) == 0
    assert run(["machine", "check", str(file)]) == 0
    made = machines.machine(file)
    assert (made.detector.columns, made.detector.row_pitch_mm) == (1000, 0.12)
    assert (made.fixed["detector_y"], made.axes["Z"].upper, made.tube.kV) == (
        800.0,
        500.0,
        100.0,
    )
    assert "Y" not in made.axes
    script = tmp_path / "scan.txt"
    fly = ["script", "new", "--kind", "fly", "--frames", "61", "--exposure", "500"]
    assert run([*fly, "--machine", str(file), "--out", str(script)]) == 0
    assert run(["check", str(script), "--machine", str(file)]) == 0
    capsys.readouterr()


def test_a_terminal_is_asked_for_what_is_not_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[str] = []

    def prompt(question: str, default: str, **_: object) -> str:
        asked.append(question)
        return "60" if question.startswith("SOD") else default

    monkeypatch.setattr(sys.stdin, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(typer, "prompt", prompt)
    file = tmp_path / "mine.toml"
    assert run(["machine", "new", "mine", "--out", str(file), "--base", "micro_ct"]) == 0
    assert [question.split()[0] for question in asked] == [
        "Panel,",
        "Pixel,",
        "SOD,",
        "SDD,",
        "Tube,",
    ]
    made = machines.machine(file)
    assert made.fixed == {"object_y": 60.0, "detector_y": 300.0}
    assert len(file.read_text("utf-8").splitlines()) < 12
    capsys.readouterr()


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["--base", "nix"], 1, "no machine called 'nix' ships"),
        (["--detector", "big"], 2, "not of the form NUMBERxNUMBER"),
        (["--sod", "9:3"], 2, "the lower end of '9:3' is above the upper"),
        (["--sod", "3:9:12"], 2, "not of the form VALUE or LOWER:UPPER"),
        (
            ["--base", "micro_ct", "--sod", "3:9"],
            3,
            "micro_ct has no motor along the SOD",
        ),
        (["--bits", "24"], 1, "detector.bits"),
        (["--limit", "tilt=0:1"], 1, "unknown axis 'tilt'"),
        (["--pitch", "nan"], 2, "not finite"),
        (["--power", "nan"], 2, "not finite"),
        (["--sod", "60:500", "--limit", "Z=100:400"], 3, "are both said"),
        (["--kv", "200:100"], 2, "the lower end of '200:100' is above the upper"),
        (["--kv", "20"], 1, "tube.kV: must be from min_kV to max_kV, [30, 20]"),
        (
            ["--sod=-20:500"],
            1,
            "SOD goes from -20 to 500 mm over the travel (Z; zero offset 0 mm)",
        ),
        (["--limit", "Z=-20:850"], 1, "SOD goes from -20 to 850 mm over the travel"),
        (["--sod", "1:15"], 1, "at home source and"),
        (["--sod", "900", "--sdd", "800"], 1, "at home SOD is 900 mm and SDD 800 mm"),
    ],
)
def test_wrong_answers_write_nothing(
    words: list[str],
    code: int,
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = tmp_path / "mine.toml"
    assert run(["machine", "new", "mine", "--out", str(file), *words]) == code
    assert said in " ".join(capsys.readouterr().err.split())
    assert not file.exists()


def test_a_panel_on_a_rail(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "rail.toml"
    words = [
        "machine",
        "new",
        "rail",
        "--out",
        str(file),
        "--sdd",
        "500:1200",
        "--kv",
        "40:160",
    ]
    assert run(words) == 0
    made = machines.machine(file)
    assert (made.tube.min_kV, made.tube.max_kV) == (40.0, 160.0)
    assert (made.axes["D"].lower, made.axes["D"].upper, made.axes["D"].home) == (
        500,
        1200,
        1000,
    )
    assert made.chain(next(c for c in made.components if c.role == "panel")) == ("D",)
    capsys.readouterr()
    assert run(["machine", "check", str(file)]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["SDD", "D", "500", "1200", "1000"] in rows
    script = tmp_path / "scan.txt"
    words = [
        "script",
        "new",
        "--kind",
        "fly",
        "--frames",
        "61",
        "--exposure",
        "500",
        "--sdd",
        "700",
    ]
    assert run([*words, "--machine", str(file), "--out", str(script)]) == 0
    moves = [line.split("\t") for line in script.read_text().splitlines()]
    assert {row[2] for row in moves if row[:2] == ["D", "move absolute"]} == {
        "700.000000"
    }
    capsys.readouterr()


def test_check_says_what_distances_are_the_sum_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "sum.toml"
    file.write_text(
        'base = "xyzr_cabinet"\nname = "sum"\nsample_height_mm = 2.0\n'
        "[geometry]\nobject_y = { Z = -0.5 }\n[fixed]\nobject_y = 600.0\n"
    )
    assert run(["machine", "check", str(file)]) == 0
    rows = [line.split("  ") for line in capsys.readouterr().out.splitlines()]
    cells = [[cell.strip() for cell in row if cell.strip()] for row in rows]
    assert ["SOD", "600 - 0.5 Z", "175", "590", "400"] in cells
    assert ["sample up", "2 + Y", "-98", "152", "2"] in cells


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[axes.Z]\nhome = 25.0\n", "axes: at home source and lift touch"),
        (
            "[fixed]\ndetector_y = 300.0\n",
            "at home SOD is 400 mm and SDD 300 mm; allowed: 0 < SOD",
        ),
        ("[fixed]\nobject_y = -420.0\n", "at home SOD is -20 mm"),
    ],
)
def test_a_machine_that_cannot_stand_at_home_is_refused(
    text: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "bad.toml"
    file.write_text(f'base = "xyzr_cabinet"\nname = "bad"\n{text}')
    assert run(["machine", "check", str(file)]) == 1
    assert said in " ".join(capsys.readouterr().err.split())


def test_show_says_whose_a_value_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(
        'base = "unitom_xl"\nname = "mine"\n[axes.mag_obj]\nupper = 900.0\n'
        '[[components]]\nname = "xray_source"\nsize_mm = [110.0, 350.0, 110.0]\n'
    )
    assert run(["machine", "show", str(file)]) == 0
    out = capsys.readouterr().out
    assert "upper: this file; else measured, log, n = 1" in out
    assert "size_mm: this file; else assumed" in out
    [panel] = [line.split() for line in out.splitlines() if line.startswith("detector  ")]
    assert panel[1:8] == ["panel", "mag_det", "+", "ver_det", "+", "tra_det", "460"]


@pytest.mark.parametrize("name", ["", 'a"b', "a b", "tab\there", "a\udcff"])
def test_a_name_is_one_word(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "mine.toml"
    code = run(["machine", "new", name, "--out", str(file)])
    if code == 0:  # a quotation mark in a word is none of our business
        assert machines.machine(file).name == name == 'a"b'
    else:
        assert code == 1
        assert not file.exists()
        assert "name" in capsys.readouterr().err


@pytest.mark.parametrize("offset", [-20.0, 0.0, 15.0])
def test_what_check_accepts_starts_and_what_it_refuses_does_not(offset: float) -> None:
    """Drawn travels: the twin's own start is the witness."""
    rng = random.Random(int(offset))
    for _ in range(20):
        lower = rng.uniform(-40.0, 40.0)
        text = f'base = "xyzr_cabinet"\nname = "near"\n[axes.Z]\nlower = {lower}\n'
        machine = parse_machine(text)
        profile = Profile(name="p", machine="near", source="test", c_obj=offset)
        said = ""
        try:
            ScannerTwin(machine, profile).require_applicable(None)
        except GeometryError as error:
            said = str(error)
        if not said:
            check_home(machine, profile, "near.toml")
        else:
            assert "the machine file's travel puts" in said
            with pytest.raises(MachineFileError, match="SOD goes from"):
                check_home(machine, profile, "near.toml")
