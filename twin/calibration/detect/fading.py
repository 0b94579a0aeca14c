"""Fading of the beads' contrast with the thickness behind them, and its removal.

Scattered light and a beam of several energies make a bead fainter where more material is
behind it, so the side of a spot with less behind it counts for more, and all centroids
are off in the direction in which the body becomes thinner. `fading` estimates from the
beads themselves how their contrast falls, and `evened` undoes it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import Float32Array, FloatArray

OUTLIER_RATIO = 4.5
"""Contrasts off by so many times the median deviation (three standard deviations) are
outliers."""
MEAN_ROUNDS = 10
"""Rounds in which the means of frames and beads are subtracted in turns; few are missing."""
LEAST_WIDTH = 1e-3
"""Least prior width of a slope: what it does to a spot is below 0.001 px."""
USUAL_SPREAD = 0.01
"""Usual standard deviation of a relative contrast; it counts as `USUAL_COUNT` values, so that few
spots that agree by chance tell nothing."""
USUAL_COUNT = 3
WIDTHS = 24
"""Prior widths that are tried, from `LEAST_WIDTH` on."""


@dataclass(frozen=True)
class Fading:
    """How the contrast of a bead changes with the line integral behind it.

    Attributes:
        slope: relative change a unit of line integral.
        sigma: its standard deviation. All frames have one slope, so its error shifts all
            their spots together.
    """

    slope: float
    sigma: float


def fading(
    contrast: FloatArray, behind: FloatArray, seen: npt.NDArray[np.bool_]
) -> Fading:
    """Estimate how contrast changes with the line integral behind a bead, as a share of
    it.

    Each bead is compared with itself in other frames, and each frame's mean is
    subtracted, so beads of several sizes and a beam that drifts have no effect. Outliers
    (`OUTLIER_RATIO`) are left out in three rounds. The result lies between -1 / C, as
    where a ball passes only scattered light, and (exp(C) - 1) / C: beyond, it is an error
    of the level.

    Args:
        contrast: of each bead in each frame, (n, k), above 0 where seen.
        behind: line integrals behind their middles, (n, k).
        seen: which of them are measured, (n, k).

    Returns:
        The slope; its prior if too few are seen or nothing varies, and 0 without spots.
    """
    if not seen.any():
        return Fading(0.0, 0.0)
    logarithm = np.log(np.where(seen, contrast, 1.0))
    use = seen
    for _ in range(3):
        change, more = (_against_own_means(a, use) for a in (logarithm, behind))
        free = int(use.sum()) - int(use.any(axis=0).sum()) - int(use.any(axis=1).sum())
        power = float(np.square(more).sum())
        if free < 1 or power <= 0.0:
            return _shrunk(0.0, math.inf, 1, float(np.median(contrast[seen])))
        slope = float((change * more).sum()) / power
        left = np.abs(_against_own_means(logarithm - slope * behind, seen))
        use = seen & (left <= OUTLIER_RATIO * float(np.median(left[seen])))
    left_over = max(float(np.square(change).sum()) - slope**2 * power, 0.0)
    free += USUAL_COUNT
    variance = (left_over + USUAL_COUNT * USUAL_SPREAD**2) / free / power
    usual = float(np.median(contrast[use]))
    found = _shrunk(slope, variance, free, usual)
    limited = min(max(found.slope, -1.0 / usual), math.expm1(usual) / usual)
    return Fading(limited, found.sigma)


def _shrunk(slope: float, variance: float, free: int, contrast: float) -> Fading:
    """Combine an estimated slope with its prior, normal about 0 and of unknown width.

    Widths are log-uniform from `LEAST_WIDTH` to tanh(C / 4) / C (evenly scattered light
    changes a contrast C by no more), each weighted by its evidence, a t distribution. So
    a clear slope is hardly changed, also beyond these widths.
    `variance`: of the slope, estimated with `free` degrees of freedom; inf: nothing is
    known. `contrast`: usual line integral through a bead.
    """
    most = math.tanh(contrast / 4.0) / contrast
    prior = np.geomspace(LEAST_WIDTH, max(most, LEAST_WIDTH), WIDTHS) ** 2
    if math.isinf(variance):
        return Fading(0.0, math.sqrt(float(prior.mean())))
    whole = prior + variance
    evidence = (1.0 + slope**2 / (free * whole)) ** (-0.5 * (free + 1)) / np.sqrt(whole)
    evidence /= evidence.sum()
    share = prior / whole
    mean = float(evidence @ share) * slope
    spread = share * variance + np.square(share * slope - mean)
    return Fading(mean, math.sqrt(float(evidence @ spread)))


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

    `flat`: (m, side, side) line integrals without the `body`; `plane`: of `Background`,
    (m, 3); `slope`: of the contrast, from `fading`. Returns new windows.
    """
    at = _from_middle(flat.shape[1])
    value, right, down = plane.astype(np.float32).T[:, :, None, None]
    level = value + right * at + down * at[:, None]
    change = np.float32(-slope) * more_behind(plane, body, flat.shape[1])
    return np.asarray(level + (flat - level) * np.exp(change))


def more_behind(plane: FloatArray, body: Float32Array | None, side: int) -> Float32Array:
    """Compute how much more is behind each pixel than behind the middle of its window.

    `plane`: of `Background`, (m, 3); `body`: line integrals of the body (m, side, side), or
    None; `side`: of the windows.
    Returns line integrals (m, side, side).
    """
    at = _from_middle(side)
    _, right, down = plane.astype(np.float32).T[:, :, None, None]
    more = right * at + down * at[:, None]
    if body is not None:
        middle = side // 2
        more = more + body - body[:, middle, middle][:, None, None]
    return np.asarray(more)


def _from_middle(side: int) -> Float32Array:
    """Return the places of a window's pixels along a side, from its middle."""
    return (np.arange(side) - (side - 1) / 2).astype(np.float32)
