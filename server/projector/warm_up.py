"""Preparation of the compute thread before the first request: thread count and compilation.

Only this module of the server imports numba.
"""

from __future__ import annotations

import numba

from flexdt.twin.projection import gpu, warm_up


def begin(threads: int) -> None:
    """Set the thread count of this thread's kernels and compile (or load) all that a server runs.

    Raises:
        ValueError: more threads than numba was started with.
    """
    numba.set_num_threads(threads)
    warm_up()


def backend() -> str:
    """What computes: "numba" on the processor, or the name of the CUDA device before it."""
    found = gpu.availability()
    return f"{found.reason} (CUDA), numba" if found.present else "numba"
