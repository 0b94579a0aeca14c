"""`flexdt check` finds collisions offline: exit code 3, line, pair, time, clearances."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from flexdt.clients.cli.command_tree import run

INTO_THE_SAMPLE = (
    "scanner\tpause\t0\t\tACK\t\t\r\n"
    "tra_obj\tmove absolute\t10\t\tACK\t\t\r\n"
    "mag_det\tmove absolute\t500\t\tACK\t\t\r\n"
)


@pytest.fixture
def script(tmp_path: Path) -> Path:
    path = tmp_path / "scan.txt"
    path.write_bytes(INTO_THE_SAMPLE.encode())
    return path


def test_a_collision_exits_3_and_names_line_pair_and_time(
    script: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["check", str(script), "--json"]) == 3
    document = json.loads(capsys.readouterr().out)
    assert document["ok"] is False
    assert document["collisions_checked"] is True
    first = document["collisions"][0]
    assert first["line"] == 3
    assert first["pair"] == ["sample_base", "detector_platform"]
    # 403.08 mm at 50 mm/s, and half a second more for the ramp.
    start = document["steps"][2]["start_s"]
    assert first["time_s"] == pytest.approx(start + 0.5 + 403.0816 / 50.0, abs=1e-3)
    assert first["last_free"]["mag_det"] == pytest.approx(
        1059 - 403.0816 + 0.02, abs=1e-3
    )
    assert document["min_clearance_mm"] == pytest.approx(1.0, abs=0.011)
    assert len(document["clearance"]) > 50


def test_an_invalid_script_wins_over_a_collision(tmp_path: Path) -> None:
    path = tmp_path / "scan.txt"
    path.write_bytes(
        (INTO_THE_SAMPLE + "tra_obj\tmove sideways\t1\t\tACK\t\t\r\n").encode()
    )
    assert run(["check", str(path)]) == 1


def test_a_free_script_tells_its_least_clearance(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The panel comes to 105.08 mm behind the axis; 25.08 mm are left of base and platform."""
    path = tmp_path / "scan.txt"
    moves = "mag_det\tmove absolute\t680\t\tACK\t\t\r\nrot_obj\tmove absolute\t360\t\tACK\t\t\r\n"
    path.write_bytes(moves.encode())
    assert run(["check", str(path), "--sample", "lego"]) == 0
    out = capsys.readouterr().out
    assert (
        "none; parts in relative motion stay 25.08 mm apart (sample_base and detector_platform)"
        in out
    )
