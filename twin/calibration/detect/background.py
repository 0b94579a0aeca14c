"""Backgrounds of the beads apart from their phantom: curved ones and foreign objects.

Subtracting a plane fitted to the ring around a spot removes a straight gradient. A curved
one (a bad flat field, scatter) or an edge (an object missing from the model) shifts every
centroid by less than the eye can see and by more than the reported uncertainty allows.
Both show in the ring, averaged over blocks of pixels; pixels under the bead itself are
not used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.detect.windows import (
    pixel_noise,
)
from flexdt.twin.geometry.conventions import Float32Array, FloatArray

BLOCK_PX: int = 5
"""Side of a block [px]; noise averages out over blocks, edges do not."""
MAX_SHADOW = 0.3
"""Line integral of a bead above which a block is left out."""
MIN_BEND_CHI2 = 40.0
"""Chi-square that the seven bent terms must explain in the median window (white noise: 6.3)."""
FAR_OUT = 7.0
"""Standard deviations of a window's misfit above the median one from which it is disturbed."""


@dataclass(frozen=True, eq=False)
class Background:
    """The backgrounds of m windows.

    Attributes:
        misfit: (m,) mean square of the residuals of a smooth background, over the median
            window's; 1 where it cannot be judged.
        disturbed: (m,) the misfit is further from the others' than noise makes it.
        bend: (m, side, side) curvature to subtract after a plane, None if backgrounds are
            straight.
        plane: (m, 3) line integral behind the middle of each window and its change by a pixel
            to the right and down.
        slope: (m, 2) its change by a pixel to the right and down beside `bend`.
    """

    misfit: FloatArray
    disturbed: npt.NDArray[np.bool_]
    bend: Float32Array | None
    plane: FloatArray
    slope: FloatArray


def survey(flat: Float32Array, alone: Float32Array) -> Background:
    """Judge the backgrounds of windows: how far they are from smooth ones, whether they
    bend, and their planes.

    Means of blocks of `BLOCK_PX` without a bead's shadow (`MAX_SHADOW`) are fitted by
    planes and by polynomials of third degree. Windows with fewer than 24 free blocks
    count as smooth (ratio 1, plane 0). The bend is None unless the median window bends
    (`_bends`).

    Args:
        flat: (m, side, side) line integrals, nan outside the image.
        alone: (m, side, side) the beads alone, rendered there.
    """
    m = flat.shape[0]
    side = flat.shape[1]
    count = side // BLOCK_PX
    edge = (side - count * BLOCK_PX) // 2
    seen, beads = (_blocks(a, edge, count) for a in (flat, alone))
    off = seen - beads
    valid = np.isfinite(off) & (beads < MAX_SHADOW)
    off[~valid] = 0.0
    shapes = _shapes((np.arange(count) + 0.5) * BLOCK_PX + edge - 0.5, side)
    enough = valid.sum(axis=1) >= 24
    straight, plane = _fitted(off, valid, shapes[:, :3], enough)
    curved, coefficients = _fitted(off, valid, shapes, enough)
    variance = pixel_noise(flat, edge, count * BLOCK_PX) ** 2 / BLOCK_PX**2
    gain = (straight - curved) / np.maximum(variance, 1e-12)
    bent = bool(enough.any()) and _bends(
        gain[enough], curved[enough], variance[enough], valid
    )
    free = valid.sum(axis=1) - (shapes.shape[1] if bent else 3)
    misfit = (
        (curved if bent else straight) / np.maximum(free, 1) / np.maximum(variance, 1e-12)
    )
    if enough.any():
        typical = max(float(np.median(misfit[enough])), 1.0)
    else:
        typical = 1.0
    ratio = np.where(enough, np.maximum(misfit / typical, 1.0), 1.0)
    limit = 1.0 + FAR_OUT * np.sqrt(2.0 / np.maximum(free, 1))
    bend: Float32Array | None = None
    slope = plane[:, 1:] / (side / 2)
    if bent:
        slope = coefficients[:, 1:3] / (side / 2)
        fine = _shapes(np.arange(side, dtype=np.float64), side)
        coefficients[:, :3] = 0.0
        bend = (coefficients @ fine.T).astype(np.float32).reshape(m, side, side)
    plane = plane / np.array([1.0, side / 2, side / 2])
    return Background(ratio, enough & (ratio > limit), bend, plane, slope)


def backdrop(behind: Background, side: int) -> Float32Array:
    """Return the line integrals of smooth backgrounds, (m, side, side): planes and bend."""
    at = (np.arange(side) - (side - 1) / 2).astype(np.float32)
    value, right, down = behind.plane.astype(np.float32).T[:, :, None, None]
    out = value + right * at + down * at[:, None]
    return np.asarray(out if behind.bend is None else out + behind.bend)


def levelled(
    flat: Float32Array, slope: FloatArray, which: npt.NDArray[np.bool_]
) -> Float32Array:
    """Subtract the background's slope (m, 2) from the windows `which` (m,).

    `flat`: (m, side, side) line integrals. Returns new ones, unchanged in their middles.
    """
    at = (np.arange(flat.shape[1]) - (flat.shape[1] - 1) / 2).astype(np.float32)
    right, down = slope[which].astype(np.float32).T[:, :, None, None]
    out = flat.copy()
    out[which] -= right * at + down * at[:, None]
    return out


def _bends(
    gain: FloatArray,
    curved: FloatArray,
    variance: FloatArray,
    valid: npt.NDArray[np.bool_],
) -> bool:
    """Check whether bent terms explain much (`MIN_BEND_CHI2`), and leave little beyond
    noise.

    `gain`, `curved`: (m,) squares that they explain and leave, in units of the
    `variance`.
    """
    free = float(np.median(valid.sum(axis=1)))
    left = float(np.median(curved / np.maximum(variance, 1e-12))) - free
    explained = float(np.median(gain))
    return explained > MIN_BEND_CHI2 and left < 0.3 * explained


def _blocks(windows: Float32Array, edge: int, count: int) -> FloatArray:
    """Compute means of blocks of BLOCK_PX x BLOCK_PX pixels, row by row.

    `windows`: (m, side, side); `edge`: first used row and column; `count`: blocks along a side.
    Returns (m, count^2); nan for blocks with nan."""
    inner = windows[:, edge : edge + count * BLOCK_PX, edge : edge + count * BLOCK_PX]
    part = inner.reshape(len(windows), count, BLOCK_PX, count * BLOCK_PX).sum(axis=2)
    summed = part.reshape(len(windows), count, count, BLOCK_PX).sum(axis=3)
    return np.asarray(summed.reshape(len(windows), -1), dtype=np.float64) / BLOCK_PX**2


def _shapes(places: FloatArray, side: int) -> FloatArray:
    """Evaluate ten polynomials, 1 to y^3, on a square grid at `places` [px] of a side.

    Coordinates are -1 to 1 over the window. Returns (p^2, 10), row by row.
    """
    t = (places - (side - 1) / 2) / (side / 2)
    y, x = (a.ravel() for a in np.meshgrid(t, t, indexing="ij"))
    one = np.ones_like(x)
    return np.stack(
        [one, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3], axis=1
    )


def _fitted(
    off: FloatArray,
    valid: npt.NDArray[np.bool_],
    shapes: FloatArray,
    enough: npt.NDArray[np.bool_],
) -> tuple[FloatArray, FloatArray]:
    """Fit polynomials to the usable blocks of each window by least squares (with a ridge
    of 1e-6).

    Args:
        off: (m, b) block means less the beads; 0 in unusable blocks.
        valid: (m, b) usable blocks.
        shapes: (b, p) polynomials.
        enough: (m,) windows with enough blocks; others have coefficients of 0.

    Returns:
        Sums of squares of the residuals (m,), and coefficients (m, p).
    """
    p = shapes.shape[1]
    weight = valid.astype(np.float64)
    gram = (
        weight @ (shapes[:, :, None] * shapes[:, None, :]).reshape(len(shapes), -1)
    ).reshape(-1, p, p)
    gram += 1e-6 * np.eye(p)
    gram[~enough] = np.eye(p)
    right = off @ shapes
    coefficients = np.linalg.solve(gram, right[:, :, None])[:, :, 0]
    coefficients[~enough] = 0.0
    left = np.einsum("mi,mi->m", off, off) - np.einsum("mp,mp->m", coefficients, right)
    return np.asarray(np.maximum(left, 0.0)), np.asarray(coefficients, dtype=np.float64)
