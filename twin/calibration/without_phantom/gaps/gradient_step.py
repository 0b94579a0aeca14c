"""A gap between two tiles in the smooth parts of single frames.

Across a gap the image changes by more than the gradient beside it: by the gap's width
times that gradient, whatever the object. The product of the step at a border with the
gradient beside it, less the gradient's square, is that width times this square. The
gradient is the mean of both sides, near and further off, so that the object's curvature
has little part in it and noise a known one; what is left of both, the other borders of
the scan show: they are the null, in mean and scatter. Steep edges are left to
`frame_evidence.py`; a liquid, a wall that hardly moves, and the inside of a bottle have
gradients only.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.repeated_frames import ROBUST
from flexdt.twin.calibration.without_phantom.turn import MEDIAN_OF_CHI_SQUARE
from flexdt.twin.geometry.conventions import FloatArray

BLOCK_FRAMES: Final = 4
"""Number of neighboring frames whose errors are taken as one: they show the same bodies."""
CURVATURE_SHARE: Final = 0.25
"""Part of the squared difference of both sides' gradients that counts as variance of the
gradient at the border: half of their difference, squared."""
THIRD_DIFFERENCE_POWER: Final = 20.0
"""Variance of third differences of white noise, over the noise's."""
CHANCE_POWER: Final = 1.25
"""Variance of the product of two gradients of white noise, over its variance squared: each
has that of the noise, and they share half of it."""
MIN_GRADIENT_SIGMAS: Final = 4.0
"""Standard deviations by noise alone from which gradients count."""
UNKNOWN_WIDTH_PX: Final = 1e6
"""Standard deviation of a width that nothing determines [px]."""
ROBUST_ROUNDS: Final = 20
"""Rounds of the reweighted line through all borders."""
OUTLYING_SIGMAS: Final = 2.0
"""Residuals, in standard deviations, from which a border counts less in that line."""


class GradientSteps(NamedTuple):
    """Widths of gaps by smooth parts of single frames.

    Attributes:
        width: at each border, (c,) [px]; 0 is the usual border.
        sigma: standard deviation of each, by frames and by the other borders, (c,) [px].
    """

    width: FloatArray
    sigma: FloatArray


def gradient_steps(
    around: FloatArray, smooth: npt.NDArray[np.bool_], frames: int
) -> GradientSteps:
    """Estimate the width of a gap at each border by the step there over the gradient
    beside it.

    Args:
        around: differences of neighboring columns about each border, without what all
            frames share, (m, c, 7); the fourth is that across the border.
        smooth: the places that count, (m, c).
        frames: number of frames, of m / frames rows each.

    Returns:
        (c,) each; sigmas are `UNKNOWN_WIDTH_PX` at borders without gradients.
    """
    across = around[:, :, 3]
    near = (around[:, :, 1] + around[:, :, 5]) / 2.0
    far = (around[:, :, 0] + around[:, :, 6]) / 2.0
    third = np.square(np.diff(around, 2, axis=2))
    noise = float(np.median(third)) / MEDIAN_OF_CHI_SQUARE / THIRD_DIFFERENCE_POWER
    bent = around[:, :, 5:].mean(axis=2) - around[:, :, :2].mean(axis=2)
    weight = smooth / np.maximum(2.0 * noise + CURVATURE_SHARE * np.square(bent), 1e-30)
    # A pixel of each side is in both, with opposite signs.
    power = _of_frames(weight * (near * far + noise / 2.0), frames)
    excess = _of_frames(weight * across * (near + far) / 2.0, frames) - power
    whole = power.sum(axis=0)
    line = _usual_line(whole, excess.sum(axis=0))
    by_chance = noise * np.sqrt(CHANCE_POWER * np.square(weight).sum(axis=0))
    known = whole > MIN_GRADIENT_SIGMAS * by_chance
    over = np.where(known, whole, 1.0)
    width = (excess.sum(axis=0) - line.offset - line.slope * whole) / over
    rest = excess - line.offset / frames - (line.slope + width) * power
    sigma = np.hypot(scatter_of_sums(rest), line.scatter) / over
    return GradientSteps(
        np.where(known, width, 0.0), np.where(known, sigma, UNKNOWN_WIDTH_PX)
    )


class UsualLine(NamedTuple):
    """A line through the values of most borders, and their scatter about it."""

    offset: float
    slope: float
    scatter: float


def _of_frames(values: FloatArray, frames: int) -> FloatArray:
    """Sum values of rows (m, c) over the rows of each frame, (frames, c)."""
    return np.asarray(values.reshape(frames, -1, values.shape[1]).sum(axis=1))


def _usual_line(power: FloatArray, excess: FloatArray) -> UsualLine:
    """Fit the excess of the usual border as a line of its gradient's power, robustly: a
    border with a gap has next to no part in it.

    Args:
        power: of the gradients at each border, (c,).
        excess: of the steps across, (c,).
    """
    table = np.stack([np.ones_like(power), power], axis=1)
    weight = np.ones(len(power))
    for _ in range(ROBUST_ROUNDS):
        scaled = table * weight[:, None]
        fitted = np.linalg.lstsq(scaled, excess * weight, rcond=None)[0]
        rest = excess - table @ fitted
        scatter = ROBUST * float(np.median(np.abs(rest))) + 1e-300
        weight = 1.0 / np.sqrt(1.0 + np.square(rest / (OUTLYING_SIGMAS * scatter)))
    return UsualLine(float(fitted[0]), float(fitted[1]), scatter)


def scatter_of_sums(values: FloatArray) -> FloatArray:
    """Compute the sigma of sums over frames, (c,), from blocks of neighbors, which are
    alike.
    """
    blocks = np.add.reduceat(values, np.arange(0, len(values), BLOCK_FRAMES), axis=0)
    return np.asarray(np.sqrt(np.square(blocks).sum(axis=0)))
