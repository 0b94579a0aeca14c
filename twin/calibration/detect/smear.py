"""The arc that the object turns while a frame is exposed, from the smear of the beads' spots.

A spot is smeared along the path of its bead, by a variance of way^2 share^2 / 12 for the way of
a step and the share of it that an exposure lasts. The way differs from spot to spot, while a
detector's blur, round or not, is that of all spots. Least squares of the light in some windows
tell the share's square beside such a blur; each window's place, contrast and background are
its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import log_ndtr

from flexdt.twin.calibration.detect.windows import Windows, distances2
from flexdt.twin.calibration.fit.priors import LOG_CHANCE, NAMED_LOG_ODDS
from flexdt.twin.geometry.conventions import Float32Array, FloatArray

SMEAR_SAMPLE = 64
"""Number of spots from which the smear is estimated."""
LEAST_SPOTS = 8
"""Least number of them: four values are common to all."""
SQUARED_WIDTH = 0.5
"""Width of the squared share of a step before it is seen, which is 0 to 1 mostly; assumed."""
MOST_STEPS = 10
"""Most steps to the arc."""
LARGEST_SQUARE = 4.0
"""Largest squared share of a step that is tried."""
LARGEST_STEP = 0.25
"""Largest step of it, beside a doubling."""
STILL_SHARE = 0.01
"""Change of the squared share, relative, from which it counts as still."""
STILL_SIGMAS = 0.3
"""The same in standard deviations."""
CONTRAST = 2
"""Number of the contrast among the values of a spot."""
LEAST_LIGHT = 1e-3
"""Added to the share of light in a pixel, against a division by none."""


@dataclass(frozen=True)
class Smear:
    """The arc of an exposure, as seen in the smear of spots.

    Attributes:
        squared: square of the share of a step, as estimated; may be negative by noise.
        sigma: its standard deviation; inf: not measured.
        told: whether the spots were measured as smeared by it.
        blur: of the images beside it [px]; NaN where it is not told.
        contrast: line integral through the middle of each bead, beside it; none where it is
            not known.
    """

    squared: float = 0.0
    sigma: float = math.inf
    told: bool = False
    blur: float = math.nan
    contrast: tuple[float, ...] = ()

    @property
    def measured(self) -> bool:
        """Whether the images say anything."""
        return math.isfinite(self.sigma)

    @property
    def share(self) -> float:
        """Share of a step that an exposure lasts; 0 where none is seen."""
        return math.sqrt(max(self.squared, 0.0)) if self.told else 0.0

    @property
    def left(self) -> float:
        """Standard deviation of the squared share that is not undone; inf: unknown."""
        return self.sigma if self.told else math.hypot(self.squared, self.sigma)

    @property
    def log_odds(self) -> float:
        """Logarithm of the odds that the object turns in an exposure, to an object at rest.

        The evidence of a square that is positive, with a prior of half a normal
        distribution of `SQUARED_WIDTH`, beside a square of 0.
        """
        if not self.measured:
            return LOG_CHANCE
        total = math.hypot(self.sigma, SQUARED_WIDTH)
        pull = self.squared / self.sigma * SQUARED_WIDTH / total
        side = math.log(2.0) + float(log_ndtr(pull))
        return LOG_CHANCE + math.log(self.sigma / total) + 0.5 * pull**2 + side

    @property
    def named(self) -> bool:
        """Whether the arc is beyond doubt."""
        return self.log_odds > NAMED_LOG_ODDS


UNMEASURED = Smear()


class Step(NamedTuple):
    """By how much spots of the images are more smeared than rendered ones.

    Attributes:
        square: of the share of a step.
        sigma: its standard deviation; inf: not determined.
        variance: of the round blur [px^2].
        contrast: (m,) of each spot, relative; None: not determined.
    """

    square: float
    sigma: float
    variance: float = 0.0
    contrast: FloatArray | None = None


def small(change: float, square: float, sigma: float) -> bool:
    """Check whether a change of a squared share is small beside it or its sigma."""
    return abs(change) < max(STILL_SHARE * square, STILL_SIGMAS * sigma)


def solved(
    square: float,
    first: Step,
    step_at: Callable[[float], Step],
) -> Smear:
    """Find the arc with which rendered spots are as smeared as those of the images.

    Steps are linear and believed near the solution alone: it is bracketed, then found by
    the false position (Illinois: the end that stays counts half).

    Args:
        square: squared share of a step to begin with.
        first: the step from there, as of `squared_step`.
        step_at: gives it elsewhere.

    Returns:
        The arc, with a sigma by the slope of the steps; as seen at first where an object at
        rest is more likely, `UNMEASURED` where no arc explains the smear.
    """
    step, sigma = first[:2]
    found = Smear(square + step, sigma)
    if not found.log_odds > 0.0:
        return found
    low, high = (0.0, math.inf), (math.inf, 0.0)
    gain = 1.0
    for _ in range(MOST_STEPS):
        if square > 0.0 and small(step / gain, square, sigma / gain):
            break
        if step > 0.0:
            high = (high[0], 0.5 * high[1]) if low[0] > 0.0 else high
            low = square, step
        else:
            low = (low[0], 0.5 * low[1]) if math.isfinite(high[0]) else low
            high = square, step
        last, before = square, step
        if math.isinf(high[0]):
            square += min(step / gain, square + LARGEST_STEP)
        elif math.isinf(low[1]):
            square = max(square + step, 0.25 * square)
        else:
            part = low[1] / (low[1] - high[1])
            square = low[0] + part * (high[0] - low[0])
        if square > LARGEST_SQUARE:
            return UNMEASURED
        step, sigma = step_at(square)[:2]
        gain = min(max((before - step) / (square - last), 0.1), 3.0)
    found = Smear(square + step / gain, sigma / gain, True)
    return found if found.log_odds > 0.0 else UNMEASURED


def squared_step(
    seen: Float32Array,
    drawn: Float32Array,
    windows: Windows,
    way: FloatArray,
    share: float,
    ends: Float32Array | None = None,
) -> Step:
    """Estimate by how much the square of the share of a step is larger in the images than in
    rendered spots.

    Linear in small differences of place, contrast, background (a plane), blur (three values
    of all spots) and smear. Spots with a larger misfit than twice the median weigh less. The
    standard deviation is by the scatter of the spots, which holds for errors that the pixels
    of a window share.

    Args:
        seen: (m, side, side) line integrals of the images, nan where there are none.
        drawn: of the rendered spots.
        windows: m of one bead each.
        way: (m, 2) of each bead's image in a step [px].
        share: of a step with which the spots are rendered.
        ends: as `drawn`, of the first and the last moment of each exposure alone; a longer
            exposure has more of them. None: smear is told from its variance.

    Returns:
        The difference; not determined with fewer than `LEAST_SPOTS` spots, or where they do
        not tell smear and blur apart.
    """
    count = len(seen)
    if count < LEAST_SPOTS:
        return Step(0.0, math.inf)
    columns, left = _columns(seen, drawn, windows, way, share, ends)
    own = columns.shape[1] - 4
    gram = columns @ columns.transpose(0, 2, 1)
    push = np.einsum("mcp,mp->mc", columns, left)
    inner = (
        gram[:, :own, :own]
        + 1e-9
        * np.eye(own)
        * np.trace(gram[:, :own, :own], axis1=1, axis2=2)[:, None, None]
    )
    taken = np.linalg.solve(inner, gram[:, :own, own:])
    normal = gram[:, own:, own:] - gram[:, own:, :own] @ taken
    right = push[:, own:] - np.einsum("mac,ma->mc", taken, push[:, :own])
    alone = np.linalg.solve(inner, push[:, :own, None])[..., 0]
    misfit = np.square(left).sum(axis=1) - np.einsum("ma,ma->m", alone, push[:, :own])
    weight = np.ones(count)
    for _ in range(2):
        whole = np.einsum("m,mab->ab", weight, normal)
        scale = np.sqrt(np.maximum(np.diag(whole), 1e-300))
        if np.linalg.cond(whole / np.outer(scale, scale)) > 1e10:
            return Step(0.0, math.inf)
        inverse = np.linalg.inv(whole)
        found = inverse @ (weight @ right)
        rest = (
            misfit - 2.0 * right @ found + np.einsum("a,mab,b->m", found, normal, found)
        )
        weight = np.minimum(1.0, 2.0 * np.median(rest) / np.maximum(rest, 1e-12))
    off = weight[:, None] * (right - normal @ found)
    spread = inverse @ (off.T @ off) @ inverse * count / (count - 4.0)
    variance = 0.5 * float(found[1] + found[3])
    contrast = (taken @ found - alone)[:, CONTRAST]
    return Step(float(found[0]), float(np.sqrt(spread[0, 0])), variance, contrast)


def _columns(
    seen: Float32Array,
    drawn: Float32Array,
    windows: Windows,
    way: FloatArray,
    share: float,
    ends: Float32Array | None,
) -> tuple[Float32Array, Float32Array]:
    """Make the derivatives of the light in the pixels near each spot, and what rendered spots
    leave of it, over the root of the light.

    Args:
        seen, drawn, windows, way, share, ends: as of `squared_step`.

    Returns:
        (m, columns, pixels): place (2), contrast, background (3), smear, blur (3); and
        (m, pixels). 0 for pixels that do not count.
    """
    reach = 1.15 * windows.radii[:, 0] * windows.stretch[:, 0, 2] + 2.5
    reach += 0.5 * share * np.linalg.norm(way, axis=1)
    # Only the middle of the windows is used.
    side = windows.side
    half = min(math.ceil(float(reach.max())) + 1, side // 2 - 1)
    part = slice(side // 2 - half, side // 2 + half + 1)
    place = windows.predicted[:, 0] - windows.corner[:, 0]
    near = distances2(windows.corner[:, 0], side, windows.predicted[:, 0])
    use = near[:, part, part] < (reach**2)[:, None, None]
    image = seen[:, part, part]
    use &= np.isfinite(image)
    light = np.exp(-drawn)
    middle = light[:, part, part]
    right = np.roll(light, -1, 2)[:, part, part]
    back = np.roll(light, 1, 2)[:, part, part]
    down = np.roll(light, -1, 1)[:, part, part]
    up = np.roll(light, 1, 1)[:, part, part]
    corners = [
        np.roll(light, (i, j), (1, 2))[:, part, part]
        for i, j in ((-1, -1), (-1, 1), (1, -1), (1, 1))
    ]
    xx = right - 2.0 * middle + back
    yy = down - 2.0 * middle + up
    xy = 0.25 * (corners[0] - corners[1] - corners[2] + corners[3])
    at = np.arange(side, dtype=np.float32)[part]
    x = (at - place[:, :1]).astype(np.float32)[:, None, :]
    y = (at - place[:, 1:]).astype(np.float32)[:, :, None]
    across, along = (way.T[..., None, None] / math.sqrt(24.0)).astype(np.float32)
    size = np.float32(1.0 / half)
    longer = across**2 * xx + 2.0 * across * along * xy + along**2 * yy
    if ends is not None:
        longer = (np.exp(-ends)[:, part, part] - middle) / np.float32(2.0 * share**2)
    weight = np.where(use, 1.0 / np.sqrt(middle + LEAST_LIGHT), 0.0).astype(np.float32)
    terms = (
        0.5 * (right - back),
        0.5 * (down - up),
        drawn[:, part, part] * middle,
        middle,
        size * x * middle,
        size * y * middle,
        longer,
        0.5 * xx,
        xy,
        0.5 * yy,
    )
    count = len(seen)
    columns = np.stack([(weight * term).reshape(count, -1) for term in terms], axis=1)
    left = weight * np.where(use, np.exp(-np.where(use, image, 0.0)) - middle, 0.0)
    return columns, left.reshape(count, -1)
