"""The reliability studies in a short form: the same programs as in docs/reliability.md."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

QUICK = [
    "broken_json", "wrong_types", "deep_json", "deep_msgpack", "huge_frame", "browser",
    "hostile_numbers", "half_frames", "open_bind", "escape_names", "escape_scripts", "links",
    "escape_samples", "hostile_stl", "hostile_meshes", "hostile_tiff", "pickles", "huge_voxels",
    "ten_errors", "vast_scripts", "control",
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


def test_kill_9_loses_nothing() -> None:
    assert "0 completed frames lost, 0 corrupt files" in run("kills.py", "--kills", "4")


def test_fuzzed_messages() -> None:
    assert "0 problems" in run("fuzz.py", "messages", "--count", "2000", "--seed", "9")


def test_fuzzed_scripts() -> None:
    assert "0 unhandled exceptions" in run("fuzz.py", "scripts", "--count", "800", "--seed", "9")


def test_attacks_get_nothing() -> None:
    """All but those that take long: see docs/reliability.md for the whole list."""
    out = run("attacks.py", *QUICK)
    assert f"{len(QUICK)} of {len(QUICK)} attacks failed; 0 unhandled exceptions" in out


def test_many_clients_keep_their_order() -> None:
    out = run("load.py", "--clients", "30", "--seconds", "3")
    assert out.count("0 out of order, 0 cut off") == 2


def test_an_estop_is_answered_beside_every_load() -> None:
    """Limits are a hundred times what they are on a machine that does nothing else."""
    out = run("latency.py", "--seconds", "0.5", "--scale", "0.1", "--slack", "100")
    assert "0 beyond their limits; 0 unhandled exceptions" in out


def test_a_few_simulated_hours() -> None:
    assert "0 unhandled exceptions" in run("soak.py", "--hours", "2", "--uses", "9")


def test_coverage_guided(tmp_path: Path) -> None:
    """The same inputs each time: a seed, and so many runs however long they take."""
    if importlib.util.find_spec("atheris") is None:
        pytest.skip("atheris has no wheel for this Python or system")
    options = ("-runs=3000", "-seed=7", "-len_control=0", "-max_len=400")
    told = run("fuzz_atheris.py", "each", *options, f"-artifact_prefix={tmp_path}/")
    assert "Done 3000 runs" in told
