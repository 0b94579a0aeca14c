"""`flexdt commission` against laboratories whose hidden machine, texts, images and logs are
made by `past_laboratory.py`, which uses nothing of flexdt, and against the one public log."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import laboratories
import numpy as np
import pytest
import scanner_traffic
from bead_scan import bead_scan
from past_laboratory import Laboratory

from flexdt.clients.cli.command_tree import run
from flexdt.clients.cli.commands.script_files import read_log_file
from flexdt.clients.following.recording import Recorded, format_recorded
from flexdt.library import machines
from flexdt.library.commission import commission
from flexdt.twin.commissioning import PastScan, scripted
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.script.executed_log import read_log
from flexdt.twin.script.parse import read_script

LOG = Path(__file__).parents[1] / "data" / "logs" / "unitom_xl_201106_001.txt"


def require_right(out: laboratories.Outcome) -> None:
    assert out.wrong == []
    assert len(out.columns) >= 3
    # A gap beside the axis that images cannot exclude widens the sigma of a column.
    for name, error in out.columns.items():
        assert abs(error) < max(0.05, 2.0 * out.column_sigmas[name]), (name, error)
    assert set(out.pulls) == {"axs_tan", "det_tan", "det_roll_deg", "drift"}
    assert all(abs(pull) < 3.0 for pull in out.pulls.values())
    assert out.missed == []
    assert out.false == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 8])
@pytest.mark.campaign(1)
def test_a_laboratory_is_found_and_every_planted_contradiction_named(
    seed: int, tmp_path: Path
) -> None:
    lab = Laboratory(seed)
    found = commission(lab.write(tmp_path), read_log_file)
    assert len(lab.planted) >= 3
    require_right(laboratories.judged(lab, found))


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.campaign
def test_six_laboratories() -> None:
    """A gap beside the axis that images cannot exclude is in the sigma of a column: of 0.05 to
    0.26 px here, with errors of up to 0.17 px. Half of the columns are nearer than 0.02 px."""
    outcomes = list(laboratories.laboratories(6, seed=7))
    assert len(outcomes) == 6
    errors = []
    for out in outcomes:
        assert out.wrong == [] == out.missed
        for name, error in out.columns.items():
            assert abs(error) < 3.0 * out.column_sigmas[name], (name, error)
            assert out.column_sigmas[name] < 0.5
        errors += list(map(abs, out.columns.values()))
        assert abs(out.pulls["drift"]) < 3.0
    assert np.median(errors) < 0.02


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> tuple[Laboratory, list[Path]]:
    """One without a contradiction, of two scans: too few for a drift."""
    made = Laboratory(31, scans=2, plants=0)
    return made, made.write(tmp_path_factory.mktemp("past"))


@pytest.mark.slow
def test_the_command_writes_a_machine_a_profile_and_a_report(
    lab: tuple[Laboratory, list[Path]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made, folders = lab
    out = tmp_path / "lab"
    words = [*map(str, folders), "--out", str(out)]
    # The laboratory's limits are drawn without its bodies: its stage would go behind the
    # source.
    assert run(["commission", *words, "--json"]) == 1
    said = capsys.readouterr()
    assert "machine.toml: `flexdt machine check` refuses it: " in said.err
    assert run(["machine", "check", str(out / "machine.toml")]) == 1
    assert (
        capsys.readouterr().err.count("SOD goes from")
        == said.err.count("SOD goes from")
        == 1
    )
    document = json.loads(said.out)
    assert document["disagreements"][0]["about"] == "machine.toml"
    assert document == json.loads((out / "commission.json").read_text())
    assert sorted(p.name for p in tmp_path.iterdir()) == ["lab"]
    machine = machines.machine(out / "machine.toml")
    profile = machines.profile(out / "profile.toml", machine)
    for name, limits in made.rig.limits.items():
        axis = machine.axes[name]
        assert (axis.lower, axis.upper, axis.max_speed, axis.max_acceleration) == limits
    assert profile.c_obj == pytest.approx(made.c_obj, abs=1e-5)
    assert profile.c_det == pytest.approx(made.c_det, abs=1e-5)
    assert profile.src_ort == pytest.approx(made.src_ort, abs=1e-5)
    sigma = {row["offset"]: row["sigma"] for row in document["zero_offsets"]}
    assert abs(profile.axs_tan - made.axs_tan - made.hidden_axs) < 3 * sigma["axs_tan"]
    assert abs(profile.det_tan - made.det_tan - made.hidden_det) < 3 * sigma["det_tan"]
    assert sigma["c_obj"] is None
    page = (out / "report.html").read_text()
    assert all(f"<h2>{title}</h2>" in page for title in ("scans", "not_judged", "next"))
    named = {row["about"] for row in document["disagreements"]}
    assert {"limits of tra_obj", "rates of mag_obj"} <= named
    asked = {row["what"]: row["settled_by"] for row in document["not_judged"]}
    assert asked["drift"] == "later"
    assert asked["limits of tra_tube"] == "recorded"
    assert asked["c_obj"] == "beads"


@pytest.mark.slow
def test_the_scans_that_it_proposes_can_be_made(
    lab: tuple[Laboratory, list[Path]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """On a machine that keeps its shipped limits: the laboratory's are drawn without its
    bodies."""
    folder = tmp_path / "past"
    shutil.copytree(lab[1][1], folder)
    (folder / "script_executed.txt").unlink()
    monkeypatch.chdir(tmp_path)
    assert run(["commission", "past", "--out", "lab", "--json"]) == 0
    proposed = json.loads(capsys.readouterr().out)["next"]
    assert 1 <= len(proposed) <= 3
    assert [p["settles"] for p in proposed] == sorted(p["settles"] for p in proposed)[
        ::-1
    ]
    for scan in proposed:
        name, *words = scan["command"].split()
        assert name == "flexdt"
        assert run(words) == 0, capsys.readouterr().err
        assert run(["check", "next.txt", "--machine", "lab/machine.toml",
                    "--profile", "lab/profile.toml"]) == 0  # fmt: skip


@pytest.mark.slow
def test_scans_of_the_twin_agree_with_themselves_and_tell_its_hidden_axis(
    tmp_path: Path,
) -> None:
    folder = bead_scan(tmp_path, {"dO_x": 0.31}, 31)
    found = commission([folder], read_log_file)
    assert list(found.findings) == []
    usual = builtin_profile("cwi-2023-08-21")
    line = found.offsets.lines["axs_tan"]
    assert line.scans == 1
    assert line.sigma is not None
    assert abs(line.value - usual.axs_tan - 0.31) < max(4 * line.sigma, 0.02)
    for name in ("src_ort", "c_obj", "c_det"):
        assert found.offsets.lines[name].value == pytest.approx(
            getattr(usual, name), abs=1e-5
        )
    assert found.machine == builtin_machine()


def test_the_public_log_alone_and_the_same_once_more(tmp_path: Path) -> None:
    folder = tmp_path / "unitom"
    folder.mkdir()
    shutil.copy(LOG, folder)
    alone = commission([folder], read_log_file)
    twice = commission([LOG, folder, LOG], read_log_file)
    assert alone.fit is not None
    assert twice.fit is not None
    assert len(alone.fit.lines.rows) == len(twice.fit.lines.rows) == 57
    axis = alone.machine.axes["tra_obj"]
    assert (axis.lower, axis.upper, axis.max_speed) == (12.0, 319.0, 50.0)
    assert any(
        "unitom_xl is taken by the motors' limits" in q.why for q in alone.questions
    )
    assert alone.machine.name == "unitom_xl"


def test_executed_scripts_are_scans_and_the_former_command_makes_the_same_machine(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With a base that was named, and with the one that the motors' limits show."""
    made = tmp_path / "made"
    words = [str(LOG), "--base", "unitom_xl", "--out"]
    assert run(["commission", *words, str(made), "--json"]) == 0
    said = capsys.readouterr()
    document = json.loads(said.out)
    assert said.err == ""
    assert run(["machine", "fit", *words, str(tmp_path / "fit.toml"), "--json"]) == 0
    fitted = capsys.readouterr()
    assert fitted.err == (
        "warning: `flexdt machine fit` is deprecated: `flexdt commission LOG... "
        "--base unitom_xl --out DIR` writes DIR/machine.toml\n"
    )
    assert document["fit"] == json.loads(fitted.out)
    assert (made / "machine.toml").read_text() == (tmp_path / "fit.toml").read_text()
    assert [(s["scan"], s["executed_lines"]) for s in document["scans"]] == [
        (str(LOG), 57)
    ]
    measured = {t["command"]: t["n"] for t in document["times"] if t["n"]}
    assert measured == {k: t["n"] for k, t in document["fit"]["timing"].items()}
    assert not any(q["what"] == str(LOG) for q in document["not_judged"])
    named, found = (
        commission([LOG], read_log_file, base) for base in ("unitom_xl", None)
    )
    assert found.machine == named.machine
    assert found.questions[0].what == "which scanner it is"
    assert named.questions == found.questions[1:]


def test_files_that_are_no_scans_and_bases_that_lack_a_motor_are_errors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--out", str(tmp_path / "out")]
    script = tmp_path / "script.txt"
    script.write_text("rot_obj\tmove absolute\t90\t\tACK\n")
    assert run(["commission", str(script), *out]) == 1
    assert f"{script}: no line of an executed script" in capsys.readouterr().err
    mini = Path(__file__).parents[1] / "data" / "machines" / "mini.toml"
    assert run(["commission", str(LOG), "--base", str(mini), *out]) == 1
    assert "(another machine is named with --base)" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_folders_of_two_scanners_are_refused_with_the_folders_of_each(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By the limits that a script's motors reply, and by serial numbers."""
    folders = Laboratory(31, scans=2, plants=0).write(tmp_path / "past")
    log = tmp_path / "unitom"
    log.mkdir()
    shutil.copy(LOG, log)
    out = tmp_path / "out"
    words = [*map(str, folders), "--out", str(out)]
    assert run(["commission", str(log), *words]) == 1
    said = capsys.readouterr().err
    assert (
        f"unitom_xl (by the motors' limits in its executed script), no serial number: {log}"
        in said
    )
    assert (
        f"flexray (by its settings text), serial number 042_0001: {folders[0]}, " in said
    )
    for scan in ([str(LOG)], ["--traffic", str(LOG)]):
        assert run(["commission", *words, *scan]) == 1
        said = capsys.readouterr().err
        assert f"no serial number: {LOG}" in said
        assert ("--traffic is deprecated" in said) == (len(scan) == 2)
    text = (folders[1] / "scan settings.txt").read_text()
    (folders[1] / "scan settings.txt").write_text(text.replace("042_0001", "042_0002"))
    assert run(["commission", *words]) == 1
    said = capsys.readouterr().err
    for serial, folder in zip(("042_0001", "042_0002"), folders, strict=True):
        assert f"serial number {serial}: {folder}" in said
    assert not out.exists()


def saved(count: int, single: bool) -> bytes:
    """A script of so many projections: one sequence, or single images, besides a dark and
    flats."""
    single_images = "".join(
        f"camera\ttake image\t\t\tACK\ncamera\tsave image\tE:\\a\\scan_{k:06d}.tif\t\tACK\n"
        for k in range(count)
    )
    sequence = (
        f"camera\tset number of frames\t{count}\t\tACK\n"
        "camera\ttake and save image sequence\tE:\\a\\scan_\t\tACK\t0\n"
    )
    head = "".join(
        f"camera\ttake image\t\t\tACK\ncamera\tsave image\tE:\\a\\{name}\t\tACK\n"
        for name in ("di000000.tif", "io000000.tif", "io000001.tif")
    )
    return (head + (single_images if single else sequence)).encode()


@pytest.mark.parametrize("single", [True, False])
@pytest.mark.parametrize("count", [1, 5, 12])
def test_projections_of_a_script_are_counted_however_they_are_taken(
    single: bool, count: int
) -> None:
    script, problems = read_script(saved(count, single))
    assert [p for p in problems if p.severity == "error"] == []
    scan = PastScan("a", commands=script.commands)
    assert scripted(scan, builtin_machine())["projections"] == count


def test_limits_from_a_recording_of_raw_messages(
    tmp_path: Path, lab: tuple[Laboratory, list[Path]]
) -> None:
    made, folders = lab
    log = (folders[1] / "script_executed.txt").read_bytes()
    raw = scanner_traffic.replay(log, read_log(log)[0])
    traffic = tmp_path / "traffic.txt"
    traffic.write_bytes(b"".join(format_recorded(Recorded(at, 0.0, m)) for at, m in raw))
    folder = tmp_path / "past"
    shutil.copytree(folders[1], folder)
    (folder / "script_executed.txt").unlink()
    found = commission([folder, traffic], read_log_file)
    for name, limits in made.rig.limits.items():
        axis = found.machine.axes[name]
        assert (axis.lower, axis.upper, axis.max_speed, axis.max_acceleration) == limits
    assert not any(q.what == "limits of mag_obj" for q in found.questions)


def test_errors_are_sentences_and_nothing_is_left(
    tmp_path: Path, lab: tuple[Laboratory, list[Path]], capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    empty, taken, out = tmp_path / "empty", tmp_path / "taken", tmp_path / "out"
    empty.mkdir()
    taken.mkdir()
    (taken / "notes").write_text("mine")
    for words, said in (
        ([str(empty)], "no settings text, executed script or radiograph"),
        ([str(tmp_path / "nowhere")], "cannot read folder"),
    ):
        assert run(["commission", *words, "--out", str(out)]) == 1
        assert said in capsys.readouterr().err
    assert run(["commission", str(lab[1][0]), "--out", str(taken)]) == 1
    assert "allowed: a new or an empty folder" in capsys.readouterr().err

    def full(*_: object) -> str:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("flexdt.library.commission.page", full)
    assert run(["commission", str(lab[1][0]), "--out", str(out)]) == 1
    assert "No space left" in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["empty", "taken"]


@pytest.mark.slow
def test_a_scan_that_cannot_be_read_is_named_and_the_others_count(
    tmp_path: Path, lab: tuple[Laboratory, list[Path]]
) -> None:
    bad = tmp_path / "bad"
    shutil.copytree(lab[1][0], bad)
    (bad / "scan settings.txt").write_text("SOD : far\n")
    (bad / "script_executed.txt").write_text("tube\tnothing\n")
    found = commission([bad, *lab[1]], read_log_file)
    whys = [q.why for q in found.questions if q.what == str(bad)]
    assert any("cannot read 'SOD : far'" in why for why in whys)
    assert any("no line of an executed script" in why for why in whys)
    assert len(found.offsets.columns) == 2
