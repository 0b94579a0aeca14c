"""Fading of the beads' contrast with the thickness behind them, and its removal.

Scattered light and a beam of several energies make a bead fainter where more material is
behind it, so the side of a spot with less behind it counts for more, and all centroids
are off in the direction in which the body becomes thinner. `fading` estimates from the
beads themselves how their contrast falls, and `evened` undoes it.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import Float32Array, FloatArray

OUTLIER_RATIO = 4.5
"""Contrasts off by so many times the median deviation (three standard deviations) are
outliers."""
MEAN_ROUNDS = 10
"""Rounds in which the means of frames and beads are subtracted in turns; few are missing."""


def fading(
    contrast: FloatArray, behind: FloatArray, seen: npt.NDArray[np.bool_]
) -> float:
    """Estimate how contrast changes with the line integral behind a bead, as a share of
    it.

    Each bead is compared with itself in other frames, and each frame's mean is
    subtracted, so beads of several sizes and a beam that drifts have no effect. Outliers
    (`OUTLIER_RATIO`) are left out in three rounds. The estimate is shrunk by its noise
    (James and Stein), so that no slope gives 0. Contrast C falls by at most as much as
    the thickness behind grows, if a ball passes nothing but scattered light; where
    scattered light is uneven it grows with the line integral, by exp(C) - 1 times as
    much. Values beyond these are an error of the level, which is in the contrast too: the
    result is limited to them.

    Args:
        contrast: of each bead in each frame, (n, k), above 0 where seen.
        behind: line integrals behind their middles, (n, k).
        seen: which of them are measured, (n, k).

    Returns:
        Relative change a unit of line integral; 0 if too few are seen or nothing varies.
    """
    logarithm = np.log(np.where(seen, contrast, 1.0))
    use = seen
    for _ in range(3):
        change, more = (_against_own_means(a, use) for a in (logarithm, behind))
        free = int(use.sum()) - int(use.any(axis=0).sum()) - int(use.any(axis=1).sum())
        power = float(np.square(more).sum())
        if free < 1 or power <= 0.0:
            return 0.0
        slope = float((change * more).sum()) / power
        left = np.abs(_against_own_means(logarithm - slope * behind, seen))
        use = seen & (left <= OUTLIER_RATIO * float(np.median(left[seen])))
    variance = max(float(np.square(change).sum()) - slope**2 * power, 0.0) / free / power
    slope *= max(1.0 - variance / max(slope**2, 1e-30), 0.0)
    usual = float(np.median(contrast[use]))
    return min(max(slope, -1.0 / usual), math.expm1(usual) / usual)


def _against_own_means(values: FloatArray, seen: npt.NDArray[np.bool_]) -> FloatArray:
    """Subtract from values (n, k) the means of their frame and of their bead, in turn
    `MEAN_ROUNDS` times; 0 where not seen.
    """
    out = np.where(seen, values, 0.0)
    for _ in range(MEAN_ROUNDS):
        for axis in (0, 1):
            count = np.maximum(seen.sum(axis=axis, keepdims=True), 1)
            out = np.where(seen, out - out.sum(axis=axis, keepdims=True) / count, 0.0)
    return np.asarray(out)


def evened(
    flat: Float32Array, plane: FloatArray, body: Float32Array | None, slope: float
) -> Float32Array:
    """Scale contrasts so that each bead has a uniform background, that of its middle.

    The bead's part of each pixel is multiplied by exp(-slope times the change of the
    background from the middle).

    Args:
        flat: (m, side, side) line integrals without the phantom's body.
        plane: of `Background`, (m, 3).
        body: line integrals of the body (m, side, side), or None.
        slope: of the contrast, from `fading`.

    Returns:
        New windows (m, side, side).
    """
    at = (np.arange(flat.shape[1]) - (flat.shape[1] - 1) / 2).astype(np.float32)
    value, right, down = plane.astype(np.float32).T[:, :, None, None]
    more = right * at + down * at[:, None]
    level = value + more
    if body is not None:
        middle = flat.shape[1] // 2
        more = more + body - body[:, middle, middle][:, None, None]
    return np.asarray(level + (flat - level) * np.exp(np.float32(-slope) * more))
