"""Choose the slices of a volume that a notebook shows, and their window."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.library.datasets.pictures import PERCENTILES
from flexdt.twin.errors import TwinError

MAX_VALUES: Final = 1_000_000
"""Of which percentiles are taken; of more, about so many are taken, evenly spread."""
AXES: Final = (("z", 0, "xy"), ("y", 1, "xz"), ("x", 2, "yz"))
"""Name of an axis, its index in the data, and the axes of its layers (to the right, up)."""


def layer_of(data: npt.NDArray[Any], axis: int, index: int) -> npt.NDArray[Any]:
    """Return a layer of a volume, its last axis right, the other up."""
    layer: npt.NDArray[Any] = np.take(data, index, axis)[::-1]
    return layer


def grey_of(values: npt.NDArray[Any], low: float, high: float) -> npt.NDArray[np.uint8]:
    """Return values in 8 bits, with `low` black and `high` white; NaN is black."""
    grey = 255.0 * (np.nan_to_num(values, nan=low) - low) / (high - low)
    return np.asarray(np.clip(grey, 0, 255), dtype=np.uint8)


def window_of(
    values: npt.NDArray[Any], window: Sequence[float] | None
) -> tuple[float, float]:
    """Return the values of black and white: those given, else percentiles.

    At most about MAX_VALUES values are looked at, in even steps along each axis. Equal
    percentiles give white = black + 1.

    `values`: whose percentiles are taken where no window is given; NaN and infinite ones are
    left out. `window`: (black, white), or None for the PERCENTILES.
    Returns (black, white), black the smaller one; (0, 1) if no value is finite.
    Raises TwinError: not two numbers, the first the smaller one.
    """
    if window is None:
        step = max(1, round((values.size / MAX_VALUES) ** (1.0 / values.ndim)))
        seen = values[(slice(None, None, step),) * values.ndim]
        seen = seen[np.isfinite(seen)]
        low, high = np.percentile(seen, PERCENTILES).tolist() if seen.size else (0.0, 1.0)
        return low, high if high > low else low + 1.0
    if len(window) != 2 or not window[0] < window[1]:
        raise TwinError.instead(
            f"window {window!r}", list(window), "(black, white), black first"
        )
    return float(window[0]), float(window[1])
