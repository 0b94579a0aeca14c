"""The row in which the source turns: the panel's height at which planes through two sources
agree.

A panel that is higher than stated gives one view of a pair planes that lean to one side
and the other view planes that lean to the other. The panel's height is that at which all
pairs agree best. The sum of squares is followed by wide steps: noise is in its
derivatives too, so that the usual normal equations would promise too much and step too
short. The effect of noise alone on that sum is measured in images of noise.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from flexdt.twin.calibration.without_phantom.plane_pairs import PlanePairs
from flexdt.twin.errors import NotIdentifiableError
from flexdt.twin.geometry.conventions import FloatArray

GRID_HEIGHTS: Final = 25
"""Number of heights that are tried first."""
MIN_LEAD_SIGMAS: Final = 2.0
"""Standard deviations by which the best of them must be better than any that is not its
neighbor."""
MIN_BEND_SIGMAS: Final = 2.5
"""Least curvature of the minimum, in its own standard deviations."""
MIN_BEND_SHARE: Final = 0.05
"""Least share of the curvature left without any two neighboring blocks of heights."""
ROUNDS: Final = 8
FREE_ROUNDS: Final = 3
"""In which the level may change."""
NOISE_STEPS: Final = 4
"""Steps to either side of the minimum at which noise alone is evaluated."""
NO_MINIMUM: Final = "the views agree about as well with the source's plane at another row"


class Height(NamedTuple):
    """The panel's height above the stated one, its standard deviation, and the part of this
    that the frames' noise has, which more frames would lessen [px]."""

    px: float
    sigma: float
    of_noise: float


class _Bowl(NamedTuple):
    """Sums of squares about a height, one for each of `LEVELS`: where each would be least,
    sigmas of that, and second derivatives."""

    aims: FloatArray
    sigmas: FloatArray
    bends: FloatArray
    scale: FloatArray


def find_height(
    fine: PlanePairs, coarse: PlanePairs, reach: float, random: np.random.Generator
) -> Height:
    """Estimate the panel's height above the stated one.

    The level of smoothing with the least sigma counts; the sigma contains noise, the
    scatter of other sure levels, and the doubtful parameters.

    Args:
        fine: pairs of views.
        coarse: the same binned twice as much, for the search.
        reach: largest distance of trial heights from the start [px].
        random: for the images of noise.

    Raises:
        NotIdentifiableError: the disagreement has no minimum, or another one about as
            small.
    """
    up = np.eye(len(fine.start))[0]
    bowl, at, h = _settle(
        fine, coarse, np.linspace(-reach, reach, GRID_HEIGHTS), up, random
    )
    alone = fine.noise(random)
    places = at + h * np.arange(-NOISE_STEPS, NOISE_STEPS + 1)
    costs = [fine.costs(fine.start + y * up, alone) * bowl.scale for y in places]
    noise = np.stack([fine.total(c) for c in costs])
    slopes = (noise[2:] - noise[:-2]) / (2 * h)
    bends = np.diff(noise, 2, axis=0) / h**2
    blurred = np.sqrt(np.square(slopes).mean(axis=0)) / bowl.bends
    flat = bowl.bends < MIN_BEND_SIGMAS * np.sqrt(np.square(bends).mean(axis=0))
    sigmas = np.where(flat | (bowl.bends <= 0), np.inf, np.maximum(bowl.sigmas, blurred))
    level = int(sigmas.argmin())
    sigma = float(sigmas[level])
    at = float(bowl.aims[level])
    if not math.isfinite(sigma):
        raise NotIdentifiableError(NO_MINIMUM)
    others = bowl.aims[sigmas < 2 * sigma]
    variance = sigma**2 + float(np.square(others - at).mean())

    def slope(doubts: FloatArray) -> float:
        low, high = (fine.costs(fine.start + (at + s * h) * up + doubts) for s in (-1, 1))
        return float(fine.total((high - low) * bowl.scale)[level]) / (2 * h)

    base = slope(0.0 * up)
    for doubt in np.eye(len(up))[1:]:
        variance += ((slope(doubt) - base) / float(bowl.bends[level])) ** 2
    return Height(at, math.sqrt(variance), float(blurred[level]))


def _settle(
    fine: PlanePairs,
    coarse: PlanePairs,
    grid: FloatArray,
    up: FloatArray,
    random: np.random.Generator,
) -> tuple[_Bowl, float, float]:
    """Find the minimum by steps from the best height of a grid, `ROUNDS` at most; the
    first evaluation is of the coarse pairs.

    Args:
        fine, coarse: pairs of views.
        grid: trial heights, evenly spaced [px].
        up: direction of the height among the arguments.
        random: for the images of noise.

    Returns:
        The minimum, its place, and the half width of the steps that found it [px].

    Raises:
        NotIdentifiableError: as `find_height`, or if the steps do not settle.
    """
    at = _first(coarse, grid, up, random)
    h = float(grid[1] - grid[0])
    level = -1
    for n in range(ROUNDS):
        bowl = _bowl(coarse if n == 0 else fine, at, h, up)
        if n < FREE_ROUNDS or not math.isfinite(bowl.sigmas[level]):
            level = int(bowl.sigmas.argmin())
        sigma = float(bowl.sigmas[level])
        if not math.isfinite(sigma):
            break
        step = float(np.clip(bowl.aims[level] - at, -2 * h, 2 * h))
        if n > 0 and abs(step) < 0.2 * sigma + 0.01:
            return bowl, at, h
        at = at + step
        h = max(min(h, 4 * sigma), 0.5)
    raise NotIdentifiableError(NO_MINIMUM)


def _first(
    pairs: PlanePairs, grid: FloatArray, up: FloatArray, random: np.random.Generator
) -> float:
    """Find the height on a grid at which the views agree best.

    A minimum at the grid's end, or in a spike, does not count. Of the levels the surest
    one is taken; it must be better than any height but its neighbors by
    `MIN_LEAD_SIGMAS`.

    Args:
        pairs: of views.
        grid: trial heights [px].
        up: direction of the height among the arguments.
        random: for the images of noise.

    Returns:
        The height [px].

    Raises:
        NotIdentifiableError: no height is so; the message says by how much the best is
            better.
    """
    costs = np.stack([pairs.costs(pairs.start + y * up) for y in grid])
    scale = pairs.scales(costs.min(axis=0))
    noise = pairs.noise(random)
    alone = np.stack(
        [pairs.total(pairs.costs(pairs.start + y * up, noise) * scale) for y in grid]
    )
    found: list[tuple[float, float]] = []
    for of_level, wiggle in zip(
        (costs * scale).swapaxes(0, 1), alone.std(axis=0), strict=True
    ):
        total = pairs.total(of_level)
        best = int(total.argmin())
        # Planes that lie in a flat face of the object agree in a spike, not in a bowl.
        beside = np.abs(np.arange(len(grid)) - best) == 1
        spike = total[beside].min() > np.delete(total, best).min()
        if 0 < best < len(grid) - 1 and not spike:
            more = of_level[np.abs(np.arange(len(grid)) - best) > 1] - of_level[best]
            spread = np.maximum(pairs.spread(more), math.sqrt(2.0) * wiggle)
            better = pairs.total(more) / np.maximum(spread, 1e-300)
            found.append((float(better.min()), float(grid[best])))
    sure, height = max(found, default=(0.0, 0.0))
    if sure < MIN_LEAD_SIGMAS:
        raise NotIdentifiableError(
            f"{NO_MINIMUM} (the best is better by {sure:.1f} standard deviations; "
            f"at least {MIN_LEAD_SIGMAS:g})"
        )
    return height


def _bowl(pairs: PlanePairs, at: float, h: float, up: FloatArray) -> _Bowl:
    """Evaluate slope, curvature and sigma of all levels' costs about a height, by
    differences.

    Sigmas are widened where one part of the heights decides, and inf where the curvature
    is below `MIN_BEND_SIGMAS` or two blocks of heights have it all.

    Args:
        pairs: of views.
        at: height [px].
        h: step of the differences [px].
        up: (p,) the parameters' change by a pixel of height.

    Returns:
        The heights of least cost and their sigmas [px], inf where a level has no minimum,
        the curvatures, and the scales of the costs.
    """
    low, mid, high = (pairs.costs(pairs.start + (at + s * h) * up) for s in (-1, 0, 1))
    scale = pairs.scales(mid)
    slopes = (high - low) * scale / (2 * h)
    bends = (high + low - 2 * mid) * scale / h**2
    slope = pairs.total(slopes)
    bend = pairs.total(bends)
    steps = slope / np.where(bend > 0, bend, np.inf)
    left = pairs.spread(slopes - steps[:, None] * bends, blocks=True)
    sure = bend / np.maximum(pairs.spread(bends), 1e-300)
    # Of several levels the one that happens to bend most would be chosen, its sigma too small.
    wider = np.hypot(1.0, MIN_BEND_SIGMAS / np.maximum(sure, MIN_BEND_SIGMAS))
    sigmas = np.where(
        sure > MIN_BEND_SIGMAS,
        wider * left / np.where(sure > MIN_BEND_SIGMAS, bend, 1.0),
        np.inf,
    )
    # No two neighbouring blocks of heights may have the answer to themselves: a flat face
    # would.
    parts = pairs.blocks(np.stack([slopes, bends])).sum(axis=-2)
    rest_slope, rest_bend = (
        np.stack([slope, bend])[..., None] - parts[..., 1:] - parts[..., :-1]
    )
    alone = ~(rest_bend > np.maximum(MIN_BEND_SHARE * bend[:, None], 0.0))
    without = rest_slope / np.where(alone, 1.0, rest_bend) - steps[:, None]
    doubt = np.where(alone, np.inf, np.abs(without) / 2).max(axis=1)
    sigmas = np.maximum(sigmas, doubt)
    return _Bowl(at - steps, sigmas, bend, scale)
