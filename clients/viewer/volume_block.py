"""A volume as a page draws it: 16-bit codes of voxels, or of means over cubes of them.

A page gets it once, and then scrolls, windows and turns it without asking; single voxels it asks
for by `exact`, because codes are rounded.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from flexdt.twin.geometry.conventions import Float32Array

MOST_VOXELS: Final = 14 << 20
"""Of a finished volume: 28 MB, and 239 x 239 x 190 voxels of the usual camera mode as they are."""
MOST_GROWING: Final = 3 << 20
"""Of one that comes anew every second: 6 MB."""
TOP: Final = 65534
"""Codes are 1 + 0..TOP between the least and the greatest value; 0 is a voxel without data."""
DARKEST: Final = 0.3
"""Streaks below air count up to this part of what is bright, so that air is dark."""
SAMPLES: Final = 200_000
"""Voxels from which the window is chosen."""


def block(data: Float32Array, most: int = MOST_VOXELS) -> tuple[dict[str, Any], bytes]:
    """A volume for a page.

    Args:
        data: (z, y, x) [1/mm]; not a number where no data cover.
        most: voxels at most; a larger volume becomes means over cubes.

    Returns:
        The head: shape (z, y, x) of the codes, `factor` voxels a side of a cube, the values `low`
        and `high` of codes 1 and TOP + 1, and the `window` to begin with. And the codes,
        little-endian.
    """
    factor = 1
    while np.prod([n // factor for n in data.shape]) > most:
        factor += 1
    nz, ny, nx = (n // factor for n in data.shape)
    cubes = np.empty((nz, ny, nx), np.float32)
    for k in range(nz):
        part = data[k * factor : (k + 1) * factor, : ny * factor, : nx * factor]
        cubes[k] = part.reshape(factor, ny, factor, nx, factor).mean(axis=(0, 2, 4))
    there = np.isfinite(cubes)
    low, high = (float(f(cubes, initial=0.0, where=there)) for f in (np.min, np.max))
    high = max(high, low + 1e-9)
    with np.errstate(invalid="ignore"):  # what is no number becomes 0 below
        codes = ((cubes - low) * (TOP / (high - low)) + 1.5).astype("<u2")
    codes[~there] = 0
    some = cubes.reshape(-1)[:: max(1, cubes.size // SAMPLES)]
    some = some[np.isfinite(some)]
    dark, bright = (
        (float(v) for v in np.percentile(some, (1.0, 99.8))) if some.size else (low, high)
    )
    window = [max(dark, -DARKEST * abs(bright)), max(bright, dark + 1e-9)]
    head = {"shape": [nz, ny, nx], "factor": factor, "low": low, "high": high, "window": window}
    return head, codes.tobytes()


def exact(data: Float32Array, place: tuple[int, int, int]) -> float | None:
    """The value of the voxel (x, y, z) [1/mm]; None where no data cover, or beside the volume."""
    x, y, z = place
    if not all(0 <= at < n for at, n in zip((z, y, x), data.shape, strict=True)):
        return None
    value = float(data[z, y, x])
    return value if np.isfinite(value) else None
