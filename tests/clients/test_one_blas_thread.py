"""One thread for linear algebra: what the system says of who worked, inside and after."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

WORK = """
import threading
from contextlib import ExitStack
from pathlib import Path
import numpy as np
from scipy.linalg import blas
from flexdt.library.calibration.one_blas_thread import one_blas_thread

wide = np.ones((1000, 1000))

def others():
    "Processor time of the other threads [ticks], proc(5)."
    own = str(threading.get_native_id())
    tasks = [t for t in Path("/proc/self/task").iterdir() if t.name != own]
    rows = [(t / "stat").read_text().rpartition(")")[2].split() for t in tasks]
    return sum(int(r[11]) + int(r[12]) for r in rows)

def shared():
    before = others()
    for _ in range(3):
        wide @ wide
        blas.dgemm(1.0, wide, wide)
    return others() > before

first, second = ExitStack(), ExitStack()
first.enter_context(one_blas_thread())
second.enter_context(one_blas_thread())
first.close()
print(shared())
second.close()
print(shared())
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="proc(5) is of Linux")
def test_others_work_only_when_the_last_use_has_ended() -> None:
    env = {**os.environ, "OPENBLAS_NUM_THREADS": "2"}
    done = subprocess.run(
        [sys.executable, "-c", WORK], env=env, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["False", "True"]
