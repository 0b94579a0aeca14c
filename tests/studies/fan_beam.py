"""A slice from a fan beam beside a plain compiled loop, in turns: processor seconds, and
results.

    python tests/studies/fan_beam.py [--views 720] [--columns 512] [--rounds 5]
    NUMBA_NUM_THREADS=1 python tests/studies/fan_beam.py

The loop has the weights, filter and backprojection that a textbook gives for a whole turn of a
panel in the middle (Kak and Slaney 1988, 3.4.2), shares nothing with `twin/reconstruction`, and
runs on one thread. Times are the least of the rounds, all compiled, from line integrals to
volume.
"""

from __future__ import annotations

import argparse
import sys
import time

import numba
import numpy as np

import flexdt as fx

SOD, SDD, WIDTH = 600.0, 1059.0, 143.0


def sinogram(views: int, cols: int, pitch: float) -> np.ndarray:
    """Line integrals (views, 1, cols) of four discs, with noise; the source of view k starts at
    -y and goes counter-clockwise."""
    at = (np.arange(cols) - (cols - 1) / 2) * pitch
    aside = np.arctan(at / SDD)
    # Of the line: its direction's angle, and the signed distance from the axis.
    turn = np.arange(views)[:, None] * 2 * np.pi / views + np.pi / 2 - aside
    away = SOD * np.sin(aside)
    out = 0.003 * np.random.default_rng(0).standard_normal((views, cols))
    for x, y, radius, density in (
        (0, 0, 30, 0.02),
        (8, 3, 6, 0.02),
        (-12, 5, 4, -0.01),
        (3, -15, 8, 0.01),
    ):
        away_here = away - (x * np.sin(turn) - y * np.cos(turn))
        out += 2 * density * np.sqrt(np.maximum(radius**2 - away_here**2, 0.0))
    return out[:, None].astype(np.float32)


@numba.njit(cache=True, error_model="numpy")
def _spread(lines, pitch, size, voxel, out):  # type: ignore[no-untyped-def]
    """Add filtered lines (views, cols) of a circle to a square image, by a plain loop.

    Args:
        lines: filtered.
        pitch: of the columns [mm].
        size: pixels of the image's side.
        voxel: their width [mm].
        out: the image (size, size), which is added to.
    """
    views, cols = lines.shape
    for k in range(views):
        c, s = np.cos(2 * np.pi * k / views), np.sin(2 * np.pi * k / views)
        for iy in range(size):
            y = (iy - (size - 1) / 2) * voxel
            for ix in range(size):
                x = (ix - (size - 1) / 2) * voxel
                depth = SOD - x * s + y * c
                at = (x * c + y * s) / depth * SDD / pitch + (cols - 1) / 2
                i = int(np.floor(at))
                if 0 <= i < cols - 1:
                    part = at - i
                    value = (1 - part) * lines[k, i] + part * lines[k, i + 1]
                    out[iy, ix] += value * (SOD / depth) ** 2


def plain(lines: np.ndarray, pitch: float, size: int, voxel: float) -> np.ndarray:
    """Reconstruct one row by filter and plain loop.

    Args:
        lines: line integrals (views, 1, cols) of a whole circle.
        pitch: of the columns [mm].
        size: pixels of the slice's side.
        voxel: their width [mm].

    Returns:
        The slice (size, size) [1/mm].
    """
    views, cols = lines.shape[0], lines.shape[2]
    scaled = pitch * SOD / SDD
    at = (np.arange(cols) - (cols - 1) / 2) * scaled
    weighted = lines[:, 0] * (SOD / np.hypot(SOD, at))
    n = np.arange(-cols, cols)
    taps = np.zeros(2 * cols)
    taps[n % 2 == 1] = -1 / (np.pi * n[n % 2 == 1] * scaled) ** 2
    taps[cols] = 1 / (4 * scaled**2)
    response = np.fft.rfft(np.fft.ifftshift(taps)).real * scaled
    ready = np.fft.irfft(np.fft.rfft(weighted, 2 * cols) * response, 2 * cols)[:, :cols]
    out = np.zeros((size, size))
    _spread(np.ascontiguousarray(ready), pitch, size, voxel, out)
    return out * np.pi / views


def main(words: list[str] | None = None) -> int:
    """Compare one row's FDK with a plain loop in time and in values.

    Returns:
        1 where they are apart by more than 1e-4 of the largest value.
    """
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--views", type=int, default=720)
    parser.add_argument("--columns", type=int, default=512)
    parser.add_argument("--rounds", type=int, default=5)
    o = parser.parse_args(words)
    pitch = WIDTH / o.columns
    scan = fx.ConeVec.circular(
        sod=SOD, sdd=SDD, angles=o.views, shape=(1, o.columns), pixel=pitch
    )
    voxel = 0.99 * pitch * SOD / SDD
    grid, lines = (
        fx.Grid((1, o.columns, o.columns), voxel),
        sinogram(o.views, o.columns, pitch),
    )
    ways = (
        lambda: fx.fdk(lines, scan, grid, errors=False).data[0],
        lambda: plain(lines, pitch, o.columns, voxel),
    )
    best, found = [np.inf, np.inf], [ways[0](), ways[1]()]
    for _ in range(o.rounds):
        for i, way in enumerate(ways):
            begun = time.process_time()
            found[i] = way()
            best[i] = min(best[i], time.process_time() - begun)
    middle = (np.arange(o.columns) - (o.columns - 1) / 2) * voxel
    inside = np.hypot(middle[:, None], middle) < 0.45 * WIDTH * SOD / SDD
    apart = np.abs(found[0] - found[1])[inside].max() / np.abs(found[1]).max()
    print(
        f"{o.columns}^2 from {o.views} views: flexdt {best[0]:.2f} CPU s with "
        f"{numba.get_num_threads()} threads, the plain loop {best[1]:.2f}; apart by {apart:.1e}"
    )
    return int(apart > 1e-4)


if __name__ == "__main__":
    sys.exit(main())
