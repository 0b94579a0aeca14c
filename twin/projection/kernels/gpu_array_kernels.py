"""CUDA kernels: arithmetic on flat arrays of single precision, and sums of them.

Imported only where a CUDA device (or numba's simulator of one) has been found. Arguments are not
checked.
"""

from __future__ import annotations

import math

import numpy as np
from numba import cuda

ADD, SUBTRACT, MULTIPLY, MAXIMUM, RATIO = range(5)
DOT, SUM, LARGEST = range(3)
FOLDING = (256, 256)
"""Blocks, and threads a block, of `fold`."""
RUN = 64
"""Numbers added in single precision before they join the rest in double precision, of which
consumer cards do a 64th as many a second."""


@cuda.jit
def combine(kind, a, b, number, alone, out):
    """out = a (kind) b, or a (kind) number if alone; a RATIO is 0 where b is at most `number`."""
    i = cuda.grid(1)
    if i >= out.size:
        return
    x = a[i]
    y = number if alone else b[i]
    if kind == ADD:
        x += y
    elif kind == SUBTRACT:
        x -= y
    elif kind == MULTIPLY:
        x *= y
    elif kind == MAXIMUM:
        x = max(x, y)
    else:
        x = x / y if y > number else np.float32(0)
    out[i] = x


@cuda.jit
def fold(kind, a, b, parts):
    """parts[i] = what thread i finds in every parts.size-th run of numbers: same bytes each time.

    kind: DOT adds a b, SUM adds a, LARGEST takes the largest a.
    """
    i = cuda.grid(1)
    if i >= parts.size:
        return
    # Which numbers a thread adds depends on `parts` alone, and the host adds the parts in order.
    total = -math.inf if kind == LARGEST else 0.0
    for first in range(i * RUN, a.size, parts.size * RUN):
        last = min(first + RUN, a.size)
        part = a[first]  # single precision within a run
        if kind == DOT:
            part *= b[first]
        for k in range(first + 1, last):
            x = a[k]
            if kind == DOT:
                part += x * b[k]
            elif kind == SUM:
                part += x
            else:
                part = max(part, x)
        if kind == LARGEST:
            total = max(total, float(part))
        else:
            total += part
    parts[i] = total
