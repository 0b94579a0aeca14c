"""Workers of studies: they start whatever the asking process did before."""

from __future__ import annotations

import math

import numpy as np

from flexdt.twin.projection import Volume, forward
from flexdt_extensions.executors import executor

ROW = [0.0, -600.0, 0.0, 0.0, 459.0, 0.0, 0.15, 0.0, 0.0, 0.0, 0.0, -0.15]


def test_workers_start_after_kernels_have_run_in_threads() -> None:
    """A fork of a process with OpenMP threads is ended by them; a fresh process is not."""
    volume = Volume(np.ones((8, 8, 8), dtype=np.float32), 0.1)
    assert forward(volume, np.array([ROW] * 4), (16, 16)).max() > 0.5
    with executor(2, None) as pool:
        assert pool is not None
        assert list(pool.map(math.sqrt, [4.0, 9.0, 16.0])) == [2.0, 3.0, 4.0]


def test_one_job_needs_no_worker() -> None:
    with executor(1, None) as pool:
        assert pool is None
