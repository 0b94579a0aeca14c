"""`flexdt check` and `flexdt script new`, offline: exit codes, positions, one JSON document."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from flexdt.clients.cli.command_tree import run

GOOD = "camera\tset exposure\t100\t\tACK\t\t\r\ntra_obj\tmove absolute\t10\t\tACK\t\t\r\n"
BAD = (
    "camera set exposure fast ACK\r\n"
    "warp move absolute 3 ACK extra words here and more\r\n"
    "tra_obj move sideways 3 ACK\r\n"
    "rot_obj move absolute ACK\r\n"
)


@pytest.fixture
def script(tmp_path: Path) -> Path:
    path = tmp_path / "scan.txt"
    path.write_bytes(GOOD.encode())
    return path


def test_a_good_script_exits_0(script: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["check", str(script)]) == 0
    captured = capsys.readouterr()
    assert "tra_obj" in captured.out
    assert captured.out.splitlines()[-1] == f"{script}: ok"


def test_the_last_line_counts_the_warnings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A target beyond its travel is set to the limit: ok, but not in silence."""
    path = tmp_path / "far.txt"
    path.write_bytes(GOOD.encode() + b"mag_det\tmove absolute\t1200\t\tACK\t\t\r\n")
    assert run(["check", str(path)]) == 0
    captured = capsys.readouterr()
    count = captured.err.count("warning: ")
    assert count > 0
    s = "s" if count > 1 else ""
    assert captured.out.splitlines()[-1] == f"{path}: ok, {count} warning{s}"


def test_the_text_says_what_is_assumed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "shot.txt"
    shot = "tube\txrayon\t\t\tACK\t\t\r\ncamera\ttake image\t\t\tACK\t\t\r\n"
    path.write_text(GOOD + shot + "camera\tsave image\tscan_0.tif\t\tACK\t\t\r\n")
    assert run(["check", str(path)]) == 0
    assert len(capsys.readouterr().out.splitlines()) <= 25
    assert run(["check", "-v", str(path)]) == 0
    captured = capsys.readouterr()
    assert "nothing moves ver_tube, ver_det, tra_tube, tra_det, mag_det" in captured.err
    rows = captured.out.splitlines()
    assert rows[0].split("  ")[0] == "line"
    column = rows[0].index("assumed [s]")
    document = json_of(path, capsys)
    # Each step's assumed part is its own, as in the document.
    told = [
        float(row[column:].split("  ")[0] or 0.0) for row in rows[1 : 1 + len(document)]
    ]
    assert told == [pytest.approx(step["assumed_s"], abs=0.006) for step in document]
    assert sum(told) > 0.0
    facts = dict(row.split(":", 1) for row in rows if ":" in row)
    assert facts["sample"].strip() == "none (empty stage assumed)"
    assert (
        facts["start"].strip().startswith("the machine's home, assumed: ver_tube=26.2917")
    )


def json_of(path: Path, capsys: pytest.CaptureFixture[str]) -> list[dict[str, float]]:
    run(["check", str(path), "--json"])
    steps: list[dict[str, float]] = json.loads(capsys.readouterr().out)["steps"]
    return steps


def test_json_is_one_document(script: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["check", str(script), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["ok"] is True
    assert document["problems"] == []
    for key in (
        "steps",
        "duration_s",
        "frames",
        "bytes",
        "collisions",
        "min_clearance_mm",
    ):
        assert key in document
    assert {"line", "start_s", "duration_s", "what"} <= document["steps"][0].keys()


def test_every_error_of_a_bad_script_has_its_place(
    script: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script.write_bytes(BAD.encode())
    assert run(["check", str(script)]) == 1
    captured = capsys.readouterr()
    places = [line for line in captured.err.splitlines() if ": error: " in line]
    assert {int(line.removeprefix(f"{script}:").split(":")[0]) for line in places} == {
        1,
        2,
        3,
        4,
    }
    assert captured.out.splitlines()[-1] == f"{script}: not ok"


def test_a_bad_script_in_json_says_so_on_standard_output_alone(
    script: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script.write_bytes(BAD.encode())
    assert run(["check", str(script), "--json"]) == 1
    captured = capsys.readouterr()
    document = json.loads(captured.out)
    assert document["ok"] is False
    assert {p["line"] for p in document["problems"]} >= {1, 2, 3, 4}
    assert captured.err == ""


def test_warnings_alone_exit_0(script: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """mag_det 1060 is clamped to its limit 1059 on the FleX-ray, which is a warning."""
    script.write_bytes(b"mag_det move absolute 1060.000000 ACK\r\n")
    assert run(["check", str(script)]) == 0
    assert "scan.txt:1" in capsys.readouterr().err


def test_a_limit_that_the_machine_rejects_exits_3(
    script: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from importlib import resources

    text = (resources.files("flexdt.twin") / "data/machines/flexray.toml").read_text()
    machine = tmp_path / "strict.toml"
    machine.write_text(text.replace('on_limit = "clamp"', 'on_limit = "reject"'))
    script.write_bytes(b"mag_det move absolute 1200 ACK\r\n")
    assert run(["check", str(script), "--machine", str(machine)]) == 3
    script.write_bytes(
        b"mag_det move absolute 1200 ACK\r\ntra_obj move sideways 1 ACK\r\n"
    )
    assert run(["check", str(script), "--machine", str(machine)]) == 1
    assert "mag_det" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        (
            'default_profile = "cwi-2023-08-21"',
            'default_profile = "nix"',
            "own.toml: default_profile: no profile called 'nix'",
        ),
        (
            "factor = -1.0",
            "factor = 0.0",
            "own.toml: virtual_axes.ver_obj.factor: must be ",
        ),
        (
            "moves = { ver_tube = -1.0, ver_det = -1.0 }",
            "moves = {}",
            "own.toml: virtual_axes.ver_obj.moves: must be ",
        ),
    ],
)
def test_a_machine_that_does_not_hold_is_told_with_file_and_key(
    script: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    old: str,
    new: str,
    line: str,
) -> None:
    from importlib import resources

    text = (resources.files("flexdt.twin") / "data/machines/flexray.toml").read_text()
    assert old in text
    own = tmp_path / "own.toml"
    own.write_text(text.replace(old, new))
    script.write_bytes(b"ver_obj move absolute 340 ACK\r\n")
    assert run(["check", str(script), "--machine", str(own)]) == 1
    told = capsys.readouterr().err
    assert line in told
    assert "internal" not in told


def test_other_profiles_can_be_named(script: Path) -> None:
    assert run(["check", str(script), "--profile", "thesis"]) == 0


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["missing.txt"], "missing.txt: No such file or directory"),
        (["{script}", "--machine", "nowhere"], "no machine called 'nowhere'"),
        (["{script}", "--machine", "missing.toml"], "missing.toml: No such file"),
        (["{script}", "--profile", "nowhere"], "no profile called 'nowhere'"),
    ],
)
def test_bad_inputs_exit_1_in_one_line(
    words: list[str], says: str, script: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["check", *(word.format(script=script) for word in words)]) == 1
    captured = capsys.readouterr()
    assert says in captured.err
    assert len(captured.err.splitlines()) == 1
    assert captured.out == ""


def test_a_broken_machine_file_names_key_and_value(
    script: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    machine = tmp_path / "mine.toml"
    machine.write_text("schema = 1\nname = 3\n")
    assert run(["check", str(script), "--machine", str(machine)]) == 1
    err = capsys.readouterr().err
    assert f"{machine}: name: " in err
    assert "Traceback" not in err


def test_binary_rubbish_is_an_invalid_script(
    script: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script.write_bytes(bytes(range(256)) * 4)
    assert run(["check", str(script)]) == 1
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["fly", "step", "tiled", "helical", "calibration"])
def test_script_new_writes_what_check_accepts(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"{kind}.txt"
    words = ["--frames", "41", "--averages", "5", "--out", str(path), "--json"]
    assert run(["script", "new", "--kind", kind, *words]) == 0
    made = json.loads(capsys.readouterr().out)
    assert made["text"].encode() == path.read_bytes()
    assert run(["check", str(path), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["problems"] == []
    assert (report["frames"], report["duration_s"]) == (
        made["frames"],
        made["duration_s"],
    )


def test_script_new_positions(capsysbinary: pytest.CaptureFixture[bytes]) -> None:
    words = [
        "--frames",
        "41",
        "--exposure",
        "500",
        "--position",
        "500:3",
        "--position",
        "700",
    ]
    assert run(["script", "new", "--kind", "calibration", *words]) == 0
    text = capsysbinary.readouterr().out.decode()
    assert text.count("take and save image sequence") == 2
    assert "\r\nmag_obj\tmove absolute\t485.080800\t" in text


def test_script_new_refuses_the_impossible(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "x.txt"
    assert (
        run(["script", "new", "--kind", "fly", "--sdd", "3000", "--out", str(path)]) == 3
    )
    assert "mag_det target" in capsys.readouterr().err
    assert not path.exists()
    assert run(["script", "new", "--kind", "fly", "--roi", "1 2 3"]) == 2
    assert run(["script", "new", "--kind", "sideways"]) == 2
    assert run(["script", "new", "--kind", "fly", "--roi", "0 0 5000 100"]) == 3
    assert run(["script", "new", "--kind", "fly", "--kv", "-1", "--out", str(path)]) == 3
    assert (
        run(["script", "new", "--kind", "fly", "--kv", "1000", "--out", str(path)]) == 3
    )
    capsys.readouterr()
    close = ["--sod", "600", "--sdd", "600"]
    assert run(["script", "new", "--kind", "fly", *close, "--out", str(path)]) == 3
    captured = capsys.readouterr()
    assert "x.txt:19:1: error: " in captured.err
    assert "[collision]" in captured.err
    assert captured.err.endswith("nothing was written\n")
    assert captured.out == ""
    assert not path.exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--kind", "helical", "--rise", "-5"], "rise_mm is -5; allowed: 0.001 to"),
        (["--kind", "helical", "--rise", "0"], "rise_mm is 0; allowed"),
        (["--kind", "helical", "--rise", "nan"], "rise_mm is nan; allowed"),
        (["--kind", "fly", "--sdd", "nan"], "sdd_mm is nan; allowed"),
        (
            ["--kind", "fly", "--roi", "10 10 0 0"],
            "ROI 10 10 0 0 holds no pixel at binning",
        ),
        (["--kind", "fly", "--mode", "HW9"], "HW9"),
        (["--kind", "fly", "--kv", "1e6"], "tube kV 1e+06 is outside [0, 90]"),
    ],
)
def test_script_new_names_what_was_asked(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["script", "new", *words]) != 0
    told = capsys.readouterr().err
    assert said in told
    assert "assumed" not in told
    assert "depend on each other" not in told


@pytest.mark.parametrize(
    ("option", "value", "of"),
    [("position", "500", "calibration"), ("tiles", "0", "tiled"), ("turns", "0", "helical"),
     ("rise", "0", "helical")],
)  # fmt: skip
def test_script_new_refuses_options_of_another_kind(
    option: str, value: str, of: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["script", "new", "--kind", "fly", f"--{option}", value]) == 2
    assert f"--{option} is for --kind {of}, not fly" in capsys.readouterr().err


@pytest.mark.parametrize(
    "roi", [["800", "620", "1199", "939"], ["800 620 1199 939"], ["800,620, 1199,939"]]
)
def test_script_new_takes_a_roi_as_one_word_or_as_four(
    roi: list[str], capsysbinary: pytest.CaptureFixture[bytes]
) -> None:
    assert (
        run(["script", "new", "--kind", "fly", "--exposure", "500", "--roi", *roi]) == 0
    )
    assert b"set ROI\t800 620 1199 939\t" in capsysbinary.readouterr().out


def test_html_report_and_a_named_sample(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script, page = tmp_path / "s.txt", tmp_path / "s.html"
    words = ["script", "new", "--kind", "fly", "--sod", "150", "--out", str(script)]
    assert run(words) == 0
    capsys.readouterr()
    assert (
        run(["check", str(script), "--sample", "wide", "--html", str(page), "--json"])
        == 0
    )
    report = json.loads(capsys.readouterr().out)
    assert report["sample"]["diameter_mm"] == pytest.approx(80 * 2**0.5)
    assert any("truncat" in p["code"] for p in report["problems"])
    assert page.read_text().startswith("<!doctype html>")


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be"])
def test_a_script_in_utf_16_is_one_line(
    encoding: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script = tmp_path / "s.txt"
    script.write_bytes("tube\tset kV\t60\t\tACK\t\t\r\n".encode(encoding) * 40)
    assert run(["check", str(script)]) == 1
    err = capsys.readouterr().err
    assert "s.txt:1:1: error: the script is UTF-16 text; save it as UTF-8" in err
    assert len(err.splitlines()) == 1


def test_the_table_shows_what_will_happen_and_not_only_what_was_asked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script = tmp_path / "s.txt"
    script.write_text(
        "rot_obj\tset speed\t1000\t\tACK\t\t\r\n"
        "mag_obj\tmove absolute\t3000\t\tACK\t\t\r\n"
        "mag_obj\tmove absolute\t600\t\tACK\t\t\r\n"
    )
    run(["check", str(script)])
    out = capsys.readouterr().out
    assert "rot_obj speed 1000 (limited to rot_obj " in out
    assert "mag_obj to 3000 (limited to mag_obj 996 mm)\n" in out
    assert "mag_obj to 600\n" in out


def test_a_binary_mesh_is_no_text_of_another_coding(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """80 bytes of head may all be zero; a UTF-16 text has zeros in every second place alone."""
    mesh = tmp_path / "part.stl"
    mesh.write_bytes(bytes(80) + (60).to_bytes(4, "little") + bytes(range(50)) * 60)
    assert run(["check", str(mesh)]) != 0
    said = "".join(capsys.readouterr())
    assert "UTF-16" not in said
    assert "binary data" in said
    mesh.write_bytes(GOOD.encode("utf-16-le"))
    assert run(["check", str(mesh)]) != 0
    assert "UTF-16" in "".join(capsys.readouterr())
