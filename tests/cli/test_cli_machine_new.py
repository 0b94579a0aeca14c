"""`flexdt machine new`: from options, from answers, and what it refuses."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import typer

from flexdt.clients.cli import machines
from flexdt.clients.cli.entry import run


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
    assert (made.fixed["detector_y"], made.axes["Z"].upper, made.tube.kV) == (800.0, 500.0, 100.0)
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
        "Tube",
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
        (["--sod", "9:3"], 2, "not of the form VALUE or LOWER:UPPER"),
        (["--base", "micro_ct", "--sod", "3:9"], 3, "micro_ct has no motor along the SOD"),
        (["--bits", "24"], 1, "detector.bits"),
        (["--limit", "tilt=0:1"], 1, "unknown axis 'tilt'"),
    ],
)
def test_wrong_answers_write_nothing(
    words: list[str], code: int, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "mine.toml"
    assert run(["machine", "new", "mine", "--out", str(file), *words]) == code
    assert said in " ".join(capsys.readouterr().err.split())
    assert not file.exists()
