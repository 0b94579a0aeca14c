"""What the compute thread does before the first request: thread count and compilation.

Kept apart so that only this module touches numba. It refuses to serve.
"""

from __future__ import annotations

import numba
import numpy as np

from flexdt.twin.geometry import ConeVec
from flexdt.twin.projection import Volume, back, warm_up


def available_threads() -> int:
    """How many threads the kernels may use on this machine."""
    return int(numba.get_num_threads())


def begin(threads: int) -> None:
    """Set the thread count of this thread's kernels and compile (or load) all of them.

    Raises:
        ValueError: more threads than numba was started with.
    """
    numba.set_num_threads(threads)
    warm_up()
    level = ConeVec.from_vectors((0, -10, 0), (0, 10, 0), (1, 0, 0), (0, 0, -1))
    back(np.ones((1, 5, 6), np.float32), level, Volume(np.ones((4, 3, 2), np.float32), 0.5))
