"""Frames of a turn that repeat the one before although the stage turned.

What a frame shows of a repeated exposure is compared with what the scan's other frames
show of a turn. Two measures of the difference of each frame from the one before it tell
the two apart: how much of the change between the frames about them it has (`turned`: 1
after a turn, 0 after none), and how much of it is smooth (`smooth`: that of white noise
after none). Their values after a turn, and the scatter of these values, are those of the
same scan: nothing about the object, the light or the step is assumed.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import Float32Array, FloatArray

CHANCE: Final = 0.05
"""Probability that a scan has a repeated frame, before the images; assumed."""
REPORTED_ODDS: Final = 100.0
"""Odds of a repeated frame, or of a gap between tiles, from which it is reported, and odds
against a gap from which it is excluded."""
MOST_REPEATED: Final = 0.25
"""Share of frames above which nothing is told: the object, not the list, is at rest."""
SMOOTHING_PX: Final = 1.5
"""Standard deviation of the smoothing that separates structures from noise [px]."""
SCATTER_FREEDOM: Final = 8.0
"""Degrees of freedom of the scatter of turned frames, and of the evidence of tiles (Student): a
third of the fewest borders."""
NEIGHBOURS: Final = 3
"""Frames on each side whose smoothness is usual for a place."""
MIN_RELIABLE: Final = 0.5
"""Share of a change that is no noise from which a frame counts for what is usual."""
LEAST_SCATTER: Final = 0.05
"""Least relative scatter of either measure: lamps flicker and stages hesitate (assumed)."""
ROBUST: Final = 1.4826
"""Standard deviation over the median of absolute deviations."""
MOST_LOG_RATIO: Final = 600.0
"""Largest logarithm of a likelihood ratio."""
LOST_TURNED: Final = 1.5
"""Change of a frame after a missing one: two steps of four where one of three is usual."""


class Changes(NamedTuple):
    """Measures of the difference of each frame from the one before it.

    Attributes:
        turned: its part along the change between the frames about both, (n,).
        sigma: standard deviation of that, (n,).
        reliable: share of the change about both that is no noise, (n,); the part found is
            reduced to it.
        smooth: logarithm of its smooth power over that of white noise, (n,).
        sampling: standard deviation of that for white noise.
        equal: whether both frames are the same to the last digit, (n,).
    """

    turned: FloatArray
    sigma: FloatArray
    reliable: FloatArray
    smooth: FloatArray
    sampling: float
    equal: npt.NDArray[np.bool_]


def find_repeated(views: Float32Array, gaps: FloatArray) -> tuple[list[int], list[int]]:
    """Find frames that repeat the one before although the stage turned, and the likeliest
    place of a missing frame among the others.

    Args:
        views: (n, rows, cols), sorted by angle.
        gaps: after each, (n,) [rad].

    Returns:
        Places of both kinds: of frames after a missing one at most one, and only beside a
        repeated one; none at all if more than `MOST_REPEATED` of the frames look repeated.
    """
    changes = measure_changes(views, gaps)
    turned = np.roll(gaps, 1) > 1e-6
    odds = CHANCE / (1.0 - CHANCE) / len(views) * np.exp(_log_ratio(changes))
    same = np.flatnonzero(((odds > REPORTED_ODDS) | changes.equal) & turned)
    if len(same) == 0 or len(same) > MOST_REPEATED * len(views):
        return [], []
    even = np.roll(gaps, 1) < 1.5 * np.median(gaps)
    apart = np.abs(np.arange(len(views))[:, None] - same)
    clear = np.minimum(apart, len(views) - apart).min(axis=1) > 2
    # Where one is repeated and the list is full, another one is missing.
    odds = np.where(even & clear, np.exp(_log_ratio_of_loss(changes)) / len(views), 0.0)
    lost = int(odds.argmax())
    return same.tolist(), [lost] if odds[lost] > 1.0 else []


def measure_changes(views: Float32Array, gaps: FloatArray) -> Changes:
    """Measure the change of each frame from the one before it, apart from shifts of the
    image and of its level.

    The change is compared with that of its smoothed neighbors on either side, times the
    gap's share of theirs. The first frame follows the last.

    Args:
        views: (n, rows, cols), sorted by angle.
        gaps: after each, (n,) [rad].

    Returns:
        Of each frame its part of that change with sigma and reliability, the smoothness of
        its change without shifts, and whether it equals the frame before.
    """
    from scipy.ndimage import gaussian_filter

    n = len(views)
    soft = gaussian_filter(views, (0, SMOOTHING_PX, SMOOTHING_PX)).astype(np.float64)
    span = np.roll(gaps, 2) + np.roll(gaps, 1) + gaps
    share = np.roll(gaps, 1) / np.maximum(span, 1e-12)
    turned, sigma, reliable, smooth = np.zeros((4, n))
    equal = np.zeros(n, dtype=bool)
    for i, (down, right) in enumerate(zip(*np.gradient(soft, axis=(1, 2)), strict=True)):
        own = (views[i] - views[i - 1]).astype(np.float64).ravel()
        about = (soft[(i + 1) % n] - soft[i - 2]).ravel() * share[i]
        equal[i] = not own.any()
        table = np.stack(
            [about, right.ravel(), down.ravel(), np.ones(about.size)], axis=1
        )
        inverse = np.linalg.pinv(table.T @ table, rcond=1e-12, hermitian=True)
        fitted = inverse @ (table.T @ own)
        left = own - table @ fitted
        variance = float(left @ left) / max(own.size - 4, 1)
        turned[i] = fitted[0]
        sigma[i] = math.sqrt(max(variance * float(inverse[0, 0]), 0.0))
        noise = variance * share[i] ** 2 / (4.0 * math.pi * SMOOTHING_PX**2)
        reliable[i] = max(1.0 - noise * own.size * float(inverse[0, 0]), 0.0)
        shifted = (table[:, 1:] @ fitted[1:]).reshape(soft[i].shape)
        smooth[i] = _smoothness(own.reshape(soft[i].shape) - shifted)
    sampling = math.sqrt(4.0 * math.pi * SMOOTHING_PX**2 / views[0].size)
    return Changes(turned, sigma + 1e-12, reliable, smooth, sampling, equal)


def _smoothness(image: FloatArray) -> float:
    """Compute the logarithm of the power of a smoothed image over that of white noise of
    the same power; 0 for an image of zeros.
    """
    from scipy.ndimage import gaussian_filter

    power = float(np.square(image).mean())
    if power == 0.0:
        return 0.0
    soft = gaussian_filter(image, SMOOTHING_PX, mode="wrap")
    white = power / (4.0 * math.pi * SMOOTHING_PX**2)
    return math.log(max(float(np.square(soft).mean()) / white, 1e-12))


def _log_ratio(changes: Changes) -> FloatArray:
    """Compute the logarithm of the likelihood of a repeat over a turn, (n,), at most
    MOST_LOG_RATIO; 0 where nothing changes about a frame, as where a round body turns
    back.
    """
    from scipy.ndimage import generic_filter

    usual = _usual(changes)
    own = np.hypot(changes.sigma, LEAST_SCATTER * np.abs(usual))
    off = changes.turned - usual
    of_turn = _log_student(off, own * _unexplained(off, own))
    of_none = _log_normal(changes.turned, own)
    about = generic_filter(
        changes.smooth, np.median, footprint=_neighbourhood(), mode="wrap"
    )
    noise = np.full(len(about), math.hypot(changes.sampling, LEAST_SCATTER))
    off = changes.smooth - about
    of_turn = of_turn + _log_student(off, noise * _unexplained(off, noise))
    of_none = of_none + _log_normal(changes.smooth, noise)
    ratio = np.minimum(of_none - of_turn, MOST_LOG_RATIO)
    return np.asarray(np.where(changes.reliable > MIN_RELIABLE, ratio, 0.0))


def _log_ratio_of_loss(changes: Changes) -> FloatArray:
    """Compute the logarithm of the likelihood of a missing frame before each over none,
    (n,).
    """
    usual = _usual(changes)
    own = np.hypot(changes.sigma, LEAST_SCATTER * np.abs(usual))
    own = own * _unexplained(changes.turned - usual, own)
    lost = _log_student(changes.turned - LOST_TURNED * usual, own)
    ratio = lost - _log_student(changes.turned - usual, own)
    return np.asarray(np.minimum(ratio, MOST_LOG_RATIO))


def _usual(changes: Changes) -> FloatArray:
    """Compute the part of the change that each frame would have after a turn, (n,): its
    reliable share of what the scan's reliable frames have; 0 without such frames.
    """
    known = changes.reliable > MIN_RELIABLE
    if not known.any():
        return np.zeros(len(known))
    ratio = changes.turned[known] / changes.reliable[known]
    return np.asarray(float(np.median(ratio)) * changes.reliable)


def _neighbourhood() -> FloatArray:
    """Mark the neighbors of a frame, but not the frame itself, (2 NEIGHBOURS + 1,)."""
    near = np.ones(2 * NEIGHBOURS + 1)
    near[NEIGHBOURS] = 0.0
    return near


def _log_normal(deviation: FloatArray, sigma: FloatArray) -> FloatArray:
    """Return the logarithm of the normal density but for a constant, (n,)."""
    return np.asarray(-0.5 * np.square(deviation / sigma) - np.log(sigma))


def _log_student(deviation: FloatArray, sigma: FloatArray) -> FloatArray:
    """Return the logarithm of Student's density but for the normal one's constant, (n,)."""
    square = np.square(deviation / sigma)
    power = -(SCATTER_FREEDOM + 1.0) / 2.0 * np.log1p(square / SCATTER_FREEDOM)
    return np.asarray(power - np.log(sigma))


def _unexplained(deviation: FloatArray, sigma: FloatArray) -> float:
    """Compute the factor on sigmas that explains most frames' scatter, at least 1."""
    return max(ROBUST * float(np.median(np.abs(deviation / sigma))), 1.0)
