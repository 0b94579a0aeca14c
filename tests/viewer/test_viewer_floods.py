"""The floods of `tests/studies/floods.py` in short: nothing ends or fails, and others go on."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

STUDY = Path(__file__).parents[1] / "studies" / "floods.py"


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="needs Linux's /proc")
@pytest.mark.campaign
def test_floods_end_nothing_and_others_are_answered() -> None:
    names = ["endless_messages", "cameras", "commands"]
    done = subprocess.run(
        [sys.executable, str(STUDY), "--seconds", "1", *names],
        capture_output=True, text=True, timeout=280, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    lines = [line for line in done.stdout.splitlines() if " answers, " in line]
    assert [line.split()[0] for line in lines] == names
    assert all(" 0 answers" not in line for line in lines)
    assert "tracebacks: 0" in done.stdout
