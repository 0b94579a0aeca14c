"""A gap between two tiles of the panel, found in the frames of an ordinary scan.

What lies in the gap is missing, so beyond it everything appears nearer by its width. Across a
border without a gap the columns of a frame follow one smooth curve; across one with a gap they do
so when those beyond it are put further away. Nothing else does that at one column in all rows and
frames: edges of a turning object pass all columns, and a dead column fits no curve. What stays the
same in all frames (rings, a wrong flat field) is left out, and where the object has an edge counts
less.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from flexdt.twin.dataset.normalise import binned_mean
from flexdt.twin.geometry.conventions import Float32Array, FloatArray

SIDE: Final = 4
"""Columns on each side of a border that a parabola is laid through."""
WIDTHS: Final = np.arange(0.0, 4.01, 0.1)
"""Widths of gaps that are tried [px]."""
ROWS: Final = 48
"""Rows that a frame is averaged to, where it has more."""
FRAMES: Final = 96
"""Frames that are looked at, of more every second, third and so on."""
STANDS_OUT: Final = 1.7
"""A gap explains so many times what it would explain at any other column. Of 24 drawn scans with a
gap of 0.5 to 2 px 18 are above it, of 57 without one 2 (`tests/studies/align_faults.py --only
tiles_apart --count 24 --seed 3`, and `--count 58 --seed 21`)."""


class Gap(NamedTuple):
    """Between two tiles: the first column beyond it, and how wide it is at most [px]. Drawn gaps
    were half to all of that.
    """

    column: int
    width: float


def averaged_rows(image: Float32Array) -> Float32Array:
    """A frame with about ROWS rows, if it has more."""
    return binned_mean(image, (-(-len(image) // ROWS), 1))


def find_gap(frames: Sequence[Float32Array]) -> Gap | None:
    """The gap that stands out, if there is one.

    Args:
        frames: line integrals of `averaged_rows`, some of a turn.
    """
    stack = np.asarray(frames, dtype=np.float64)
    if stack.shape[2] < 8 * SIDE:
        return None
    stack -= stack.mean(axis=0)
    columns = stack.reshape(-1, stack.shape[2]).T
    windows = np.lib.stride_tricks.sliding_window_view(columns, 2 * SIDE, axis=0)
    moments = np.array([_moments(w) for w in windows])  # (borders, n, n)
    left = np.array([np.einsum("ij,bji->b", _left(w), moments) for w in WIDTHS.tolist()])
    explained = 1.0 - left.min(axis=0) / np.maximum(left[0], 1e-300)
    border = int(explained.argmax())
    elsewhere = np.abs(np.arange(len(explained)) - border) > SIDE
    if explained[border] < STANDS_OUT * explained[elsewhere].max():
        return None
    return Gap(border + SIDE, float(WIDTHS[left[:, border].argmin()]))


def _moments(window: FloatArray) -> FloatArray:
    """(n, n) of the columns about a border; where one side is bent itself counts less."""
    bends = np.square(np.diff(window, 2, axis=1))
    bent = bends[:, : SIDE - 2].sum(axis=1) + bends[:, SIDE:].sum(axis=1)
    weights = 1.0 / (bent + np.median(bent) + 1e-30)
    return np.asarray((window * weights[:, None]).T @ window)


def _left(width: float) -> FloatArray:
    """(n, n): what a parabola does not explain of columns with a gap in their middle."""
    x = np.arange(2 * SIDE) - (SIDE - 0.5) + np.where(np.arange(2 * SIDE) < SIDE, 0.0, width)
    powers = np.vander(x / SIDE, 3)
    return np.asarray(np.eye(2 * SIDE) - powers @ np.linalg.pinv(powers))
