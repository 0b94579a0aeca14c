"""Kernel threads in a process: they sleep while they wait, and a forked child computes alone.

GNU OpenMP reads its environment once, when it is loaded. By default its threads spin at
the end of each parallel loop; beside other programs they take the cores from the thread
that computes.

A fork copies the calling thread alone. GNU OpenMP ends a process that starts a parallel
loop after a fork of a process that had started one, so parallel loops of such a child run
in its own thread. Processes started by `spawn` or `forkserver` use all cores.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Mapping
from contextlib import suppress
from typing import Final

from flexdt.twin import kernel_threads

OPENMP: Final = "libgomp.so.1"
"""GNU OpenMP as numba's layer names it."""
SLEEPING: Final[Mapping[str, str]] = {"OMP_WAIT_POLICY": "passive"}
"""Environment that OpenMP reads when it is loaded: waiting threads sleep."""
CHOSEN_BY: Final = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")
"""Environment variables by which users choose how OpenMP's threads wait."""
LAYER: Final = "numba.np.ufunc.parallel"
DEVICE: Final = "flexdt.twin.projection.gpu"


def load_sleeping() -> str:
    """Load OpenMP so that its threads sleep while they wait, unless the user's
    environment chose otherwise or it is loaded already.

    The environment is unchanged afterwards: other libraries and child processes keep
    their defaults.

    Returns:
        How its threads wait, as a phrase; that of the kernels' own threads where OpenMP
        cannot be loaded.
    """
    chosen = [f"{name}={os.environ[name]}" for name in CHOSEN_BY if name in os.environ]
    if chosen:
        return f"as {' '.join(chosen)} says"
    with suppress(OSError):
        ctypes.CDLL(OPENMP, mode=os.RTLD_NOLOAD | os.RTLD_NOW)
        return "as OpenMP was loaded before flexdt"
    os.environ.update(SLEEPING)
    try:
        ctypes.CDLL(OPENMP)
    except OSError:
        return kernel_threads.waiting
    finally:
        for name in SLEEPING:
            del os.environ[name]
    return "asleep"


def _in_child() -> None:
    """Restrict a forked child: no GPU, and one thread if the parent had started kernel
    threads.

    Modules that were not loaded are left alone.
    """
    gpu = sys.modules.get(DEVICE)
    if gpu is not None:
        gpu.leave_after_fork()
    layer = sys.modules.get(LAYER)
    if layer is not None and layer._is_initialized:
        kernel_threads.ALONE.value = 1


def watch() -> None:
    """Let kernel threads of this process sleep while they wait (Linux only), and restrict
    forked children from now on, see `_in_child`.
    """
    if sys.platform == "linux":
        kernel_threads.waiting = load_sleeping()
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=_in_child)
