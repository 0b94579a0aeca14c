"""The reliability studies in a short form: the same programs as in docs/reliability.md."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

QUICK = [
    "broken_json", "deep_json", "deep_msgpack", "huge_frame", "browser", "half_frames",
    "open_bind", "escape_names", "escape_scripts", "links", "hostile_stl", "hostile_meshes",
    "hostile_tiff", "pickles", "vast_scripts",
]  # fmt: skip
"""Attacks of tests/studies/attacks.py that take little time."""
STUDIES = Path(__file__).parents[1] / "studies"
pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


def run(*words: str) -> str:
    done = subprocess.run(
        [sys.executable, str(STUDIES / words[0]), *words[1:]],
        capture_output=True, text=True, timeout=580, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    return done.stdout + done.stderr


@pytest.mark.campaign
def test_kill_9_loses_nothing() -> None:
    assert "0 completed frames lost, 0 corrupt files" in run("kills.py", "--kills", "4")


@pytest.mark.campaign
def test_servers_whose_disk_fails_do_nothing_by_halves() -> None:
    assert "0 things were wrong" in run(
        "faults.py", "writes", "--count", "2", "--seed", "4"
    )


@pytest.mark.campaign(1)
@pytest.mark.parametrize("count", [200, 2000])
def test_absurd_values_in_every_field(tmp_path: Path, count: int) -> None:
    options = ("--count", str(count), "--seed", "9", "--out", str(tmp_path / "failures"))
    assert "0 problems" in run("fuzz_schema.py", *options)


@pytest.mark.campaign
def test_attacks_get_nothing() -> None:
    """All but those that take long: see docs/evidence/reliability.json for the whole list."""
    out = run("attacks.py", *QUICK)
    assert f"{len(QUICK)} of {len(QUICK)} attacks failed; 0 unhandled exceptions" in out


@pytest.mark.campaign
def test_new_clients_are_answered_beside_a_flood_of_connections() -> None:
    run(
        "floods.py", "--connections", "40"
    )  # it fails without an answer, or with a long log


@pytest.mark.campaign
def test_an_old_twin_costs_what_a_young_one_does() -> None:
    few = ("--samples", "60", "--corrections", "60", "--scans", "5", "--requests", "20")
    out = run(
        "age.py", "--jobs", "20000", *few, "--no-times"
    )  # a busy machine changes times
    assert "0 figures have grown" in out


def test_full_disks_lose_nothing() -> None:
    out = run("full_disk.py", "--histories", "6", "--seed", "40", "--jobs", "1")
    assert "0 lost something acknowledged" in out


@pytest.mark.campaign
def test_pages_and_programs_are_answered_beside_a_flood_at_any_port() -> None:
    """It fails without an answer, or where a process has ended."""
    run("port_floods.py", "--count", "3", "viewer", "projector", "pages of the twin")


@pytest.mark.campaign
def test_many_clients_keep_their_order() -> None:
    out = run("load.py", "--clients", "30", "--seconds", "2")
    assert out.count("0 out of order, 0 cut off") == 2


@pytest.mark.campaign(1)
def test_an_estop_is_answered_beside_every_load() -> None:
    """Limits are a hundred times what they are on a machine that does nothing else."""
    out = run("latency.py", "--seconds", "0.2", "--scale", "0.05", "--slack", "100")
    assert "0 beyond their limits; 0 unhandled exceptions" in out


@pytest.mark.campaign
def test_a_few_simulated_hours() -> None:
    assert "0 unhandled exceptions" in run("soak.py", "--hours", "1", "--uses", "9")
