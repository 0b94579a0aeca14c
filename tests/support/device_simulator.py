"""Programs in numba's simulator of a CUDA device: it is chosen when numba is imported."""

from __future__ import annotations

import os
import subprocess
import sys


def run_simulated(program: str, *arguments: str) -> None:
    """Run a program, which has to end without an error, in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments],
        env={**os.environ, "NUMBA_ENABLE_CUDASIM": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
