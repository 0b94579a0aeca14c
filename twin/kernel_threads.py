"""Where the compiled kernels' parallel loops run, as the process decides."""

from __future__ import annotations

import ctypes
from typing import Final

ALONE: Final = ctypes.c_int64(0)
"""Not 0: parallel loops run in the calling thread. Kernels look at each loop; set after a
fork."""

waiting = "as OpenMP does by default"
"""How threads wait for each other at the end of a loop; `flexdt.process_threads` says it."""
