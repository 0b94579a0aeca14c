"""Spots of beads that turn while a frame is exposed: smear, blur and contrasts, and places.

A smeared spot is no ball: its profile tells neither blur nor contrast, and neither its
centroid nor the fit of a ball has the place that the bead has in the middle of the exposure.
So spots are compared with rendered ones of the same smear, all pixels at once.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.detect import spot_kernels as kernels
from flexdt.twin.calibration.detect.background import backdrop, survey
from flexdt.twin.calibration.detect.patches import Patches
from flexdt.twin.calibration.detect.sharpness import (
    BLURS,
    CHECK_FINE,
    RADIUS_RAYS,
    Sharp,
    balls_of,
    fine_rays,
    hardened_balls,
    rest_of_blur,
    spread,
)
from flexdt.twin.calibration.detect.smear import (
    LARGEST_SQUARE,
    LEAST_LIGHT,
    LEAST_SPOTS,
    SMEAR_SAMPLE,
    UNMEASURED,
    Smear,
    Step,
    small,
    squared_step,
)
from flexdt.twin.calibration.detect.windows import (
    Balls,
    Turning,
    Windows,
    blurred_windows,
    exposed,
    render_windows,
    ways,
)
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection.analytic_solids import Scene

MOST_STEPS = 12
"""Most steps to smear, blur and contrasts."""
STILL_BLUR = 0.02
"""Change of the blur's variance, relative, from which it counts as still."""
STILL_CONTRAST = 0.005
"""Change of a contrast, relative, from which it counts as still."""
LARGEST_FACTOR = 2.0
"""Largest factor on a contrast in a step."""
PLACE_STEPS = 5
"""Most steps to the place of a spot."""
STILL_PX = 0.02
"""Step of a spot's place after which its template is not shifted again: what the slope of the
template leaves is of second order."""
RIM_PX = 6.5
"""Pixels about a spot's rim that tell its background."""
BESIDE = 0.02
"""Share of a shadow's depth below which a pixel is beside it."""
LEAST_PIXELS = 40
"""Least number of usable pixels of a spot."""


def followed(
    patches: Patches,
    sharp: Sharp,
    cone: ConeVec,
    model: BeadModel,
    turning: Turning,
    smear: Smear,
) -> tuple[Smear, Balls]:
    """Estimate smear, blur and contrasts together, from `SMEAR_SAMPLE` complete spots.

    They are rendered until they look like those of the images: first as if light had one
    energy, then as hardened as the images show it.

    Args:
        patches: the windows, less the body.
        sharp: size of the beads.
        cone: geometry of the frames.
        model: the beads.
        turning: geometry within an exposure.
        smear: to begin with, told.

    Returns:
        The smear, `UNMEASURED` where the spots do not determine it; and the beads as they
        attenuate.
    """
    windows = patches.windows
    k = windows.corner.shape[1]
    sample = spread(patches.entire, SMEAR_SAMPLE)
    if len(sample) < LEAST_SPOTS:
        return UNMEASURED, ()
    frames, beads = np.divmod(sample, k)
    way = ways(windows, model, turning)[frames, beads]
    seen = patches.flat[sample]
    level = np.zeros_like(seen)
    flat = patches.flat.copy()
    square, variance, sigma = smear.squared, smear.blur**2, smear.sigma
    contrast = np.array(smear.contrast or patches.peaks[:k])
    balls: Balls = ()
    hardened = bool(smear.contrast)
    for _ in range(MOST_STEPS):
        now = exposed(windows, model, turning, math.sqrt(square))
        blur = math.sqrt(variance)
        if hardened:
            flat[sample] = seen - level
            peaks = np.tile(contrast, len(flat) // k)
            beside = replace(patches, flat=flat, windows=now, peaks=peaks, entire=sample)
            balls = hardened_balls(replace(sharp, true=blur), beside, cone, model)
        else:
            balls = ((balls_of(model, contrast, sharp.size), None),)
        few = now.pick(frames, beads)
        drawn = _drawn(balls, cone[frames], few, blur)
        level = backdrop(survey(seen, drawn), few.side)
        ends = _ends(balls, cone[frames], few, blur, turning, math.sqrt(square), frames)
        step = squared_step(seen - level, drawn, few, way, math.sqrt(square), ends)
        if not math.isfinite(step.sigma):
            return UNMEASURED, balls
        factor = _factors(step, beads, k)
        still = (
            small(step.square, square, step.sigma)
            and abs(step.variance) < STILL_BLUR * variance
            and bool((np.abs(factor - 1.0) < STILL_CONTRAST).all())
        )
        sigma = step.sigma if still else math.hypot(step.sigma, step.square)
        square = max(square + step.square, 0.25 * square)
        variance = max(variance + step.variance, 0.25 * variance, BLURS[0] ** 2)
        contrast = contrast * factor
        if square > LARGEST_SQUARE:
            return UNMEASURED, balls
        if still and hardened:
            break
        hardened = hardened or still
    found = Smear(square, sigma, True, math.sqrt(variance), tuple(contrast.tolist()))
    return (found if found.log_odds > 0.0 else UNMEASURED), balls


def _drawn(balls: Balls, cone: ConeVec, few: Windows, blur: float) -> Float32Array:
    """Render beads in windows of one bead each, (m, side, side) line integrals."""
    fine = fine_rays(few, RADIUS_RAYS, CHECK_FINE)
    rays = render_windows(Scene(()), cone, few, fine, balls)
    return np.asarray(blurred_windows(rays, rest_of_blur(blur, fine))[:, 0])


def _ends(
    balls: Balls,
    cone: ConeVec,
    few: Windows,
    blur: float,
    turning: Turning,
    share: float,
    frames: npt.NDArray[np.intp],
) -> Float32Array:
    """Render the mean of the first and the last moment of each exposure, see `_drawn`."""
    moments = tuple(turning(part * share)[frames] for part in (-0.5, 0.5))
    return _drawn(balls, cone, replace(few, moments=moments), blur)


def _factors(step: Step, beads: npt.NDArray[np.intp], k: int) -> FloatArray:
    """Return the factors on the contrasts of k beads: the median of their spots', that of all
    spots where a bead has none.
    """
    assert step.contrast is not None
    out = np.full(k, float(np.median(step.contrast)))
    for bead in np.unique(beads).tolist():
        out[bead] = np.median(step.contrast[beads == bead])
    return np.asarray(np.clip(1.0 + out, 1.0 / LARGEST_FACTOR, LARGEST_FACTOR))


class Placed(NamedTuple):
    """Places of m spots.

    Attributes:
        shift: (m, 2) from where they are rendered [px]; NaN where it is not determined.
        covariance: (m, 2, 2), by the scatter of the pixels.
        contrast: (m,) factor on that of the rendered spot.
        misfit: (m,) what is left beyond noise, as a share of the spot's shadow.
        share: (m,) part of the shadow in usable pixels.
    """

    shift: FloatArray
    covariance: FloatArray
    contrast: FloatArray
    misfit: FloatArray
    share: FloatArray


def placed(
    flat: Float32Array,
    alone: Float32Array,
    masks: npt.NDArray[np.bool_],
    index: npt.NDArray[np.intp],
) -> Placed:
    """Fit rendered spots to those of the images: place, contrast and a plane behind them.

    Pixels weigh as photons count.

    Args:
        flat: (m, side, side) line integrals, less body and background.
        alone: of the rendered spots.
        masks: (m, side, side) pixels that tell of the window's bead.
        index: windows to fit; others stay NaN.
    """
    m = len(flat)
    out = Placed(
        np.full((m, 2), np.nan),
        np.full((m, 2, 2), np.nan),
        np.full(m, np.nan),
        np.full(m, np.nan),
        np.zeros(m),
    )
    for i in index.tolist():
        rows, cols = (np.flatnonzero(masks[i].any(axis=a)) for a in (1, 0))
        if not len(rows):
            continue
        part = slice(rows[0], rows[-1] + 1), slice(cols[0], cols[-1] + 1)
        use = masks[i][part] & np.isfinite(flat[i][part])
        shadow = 1.0 - np.exp(-alone[i])
        out.share[i] = shadow[part][use].sum() / max(float(shadow.sum()), 1e-12)
        if use.sum() >= LEAST_PIXELS:
            _place(np.exp(-flat[i][part]), np.exp(-alone[i]), part, use, out, i)
    return out


def _place(
    seen: Float32Array,
    light: Float32Array,
    part: tuple[slice, slice],
    use: npt.NDArray[np.bool_],
    out: Placed,
    number: int,
) -> None:
    """Fit one rendered spot, see `placed`.

    Args:
        seen: light of the images in a part of the window.
        light: (side, side) of the rendered spot.
        part: of the window.
        use: its usable pixels.
        out: written at `number`, unless the pixels do not determine the place.
    """
    from scipy.ndimage import shift

    y, x = (a[use] for a in np.mgrid[part])
    x, y = (x - x.mean()) / light.shape[0], (y - y.mean()) / light.shape[0]
    target = seen[use].astype(np.float64)
    place, contrast, level = np.zeros(2), 1.0, np.zeros(3)
    for _ in range(PLACE_STEPS):
        moved = (
            shift(light, place[::-1], order=3, mode="nearest") if place.any() else light
        )
        right = 0.5 * (np.roll(moved, -1, 1) - np.roll(moved, 1, 1))[part][use]
        down = 0.5 * (np.roll(moved, -1, 0) - np.roll(moved, 1, 0))[part][use]
        lit = np.maximum(moved[part][use], 1e-6).astype(np.float64)
        behind = np.exp(-(level[0] + level[1] * x + level[2] * y))
        dark = np.log(lit)
        lit = lit**contrast * behind
        weight = 1.0 / np.sqrt(lit + LEAST_LIGHT)
        columns = weight * np.stack(
            [
                -right * behind * contrast,
                -down * behind * contrast,
                dark * lit,
                -lit,
                -x * lit,
                -y * lit,
            ]
        )
        left = weight * (target - lit)
        gram = columns @ columns.T
        scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        if np.linalg.cond(gram / np.outer(scale, scale)) > 1e10:
            return
        step = np.linalg.solve(gram, columns @ left)
        place = place + np.clip(step[:2], -2.0, 2.0)
        contrast = min(max(contrast + float(step[2]), 0.2), 5.0)
        level = level + step[3:]
        if np.hypot(*step[:2]) < STILL_PX and abs(step[2]) < STILL_PX:
            break
    left = left - step @ columns
    variance = float(left @ left) / (len(left) - len(step))
    power = np.square(target - behind).sum()
    out.shift[number] = place
    out.covariance[number] = np.linalg.inv(gram)[:2, :2] * variance
    out.contrast[number] = contrast
    # A count's variance is its mean; beside the shadow all that is left is noise.
    shadow = 1.0 - lit / behind
    beside = shadow < BESIDE * shadow.max()
    noise2 = np.square(left[beside]).mean() if beside.any() else 0.0
    by_noise = noise2 * np.sum(1.0 / np.square(weight))
    foreign = max(float(np.square(left / weight).sum() - by_noise), 0.0)
    out.misfit[number] = math.sqrt(foreign / max(power, 1e-12))


def own_pixels(
    windows: Windows, way: FloatArray, index: npt.NDArray[np.intp]
) -> npt.NDArray[np.bool_]:
    """Mark the pixels that tell of a window's bead: on its path and `RIM_PX` about it, and not
    on another bead's.

    Args:
        windows: n frames of k beads.
        way: (n, k, 2) of each bead's image in an exposure [px].
        index: windows to mark.

    Returns:
        (n k, side, side); none in other windows.
    """
    n, k = windows.corner.shape[:2]
    side = windows.side
    major = windows.radii * windows.stretch[..., 2]
    out = np.zeros((n * k, side, side), np.bool_)
    inner = slice(1, side - 1)
    for i in index.tolist():
        frame, bead = divmod(i, k)
        corner = windows.corner[frame, bead]
        near = _from_path(corner, side, windows.predicted[frame, bead], way[frame, bead])
        mark = near < 1.12 * major[frame, bead] + RIM_PX
        for other in range(k) if windows.crowded[frame, bead] else ():
            if other != bead:
                place, along = windows.predicted[frame, other], way[frame, other]
                away = _from_path(corner, side, place, along)
                mark &= away > major[frame, other] + 3.0
        out[i, inner, inner] = mark[inner, inner]
    return out


def _from_path(
    corner: npt.NDArray[np.int64], side: int, middle: FloatArray, way: FloatArray
) -> FloatArray:
    """Compute the distance of the pixels of a window from a straight path, (side, side)
    [px].
    """
    at = np.arange(side)
    x = (at + corner[0] - middle[0])[None, :]
    y = (at + corner[1] - middle[1])[:, None]
    length = float(np.hypot(*way))
    along, across = way / max(length, 1e-9)
    beyond = np.abs(x * along + y * across) - 0.5 * length
    return np.asarray(np.hypot(np.maximum(beyond, 0.0), x * across - y * along))


def results_of(found: Placed, patches: Patches) -> FloatArray:
    """Write places as the kernels do, (m, RESULTS); zeros where nothing was found.

    What is missing of a spot makes its place depend on its size and blur.
    """
    results = np.zeros((len(found.shift), kernels.RESULTS))
    good = np.isfinite(found.shift[:, 0])
    missing = kernels.PARTIAL_ERROR * patches.radii * np.clip(1.0 - found.share, 0.0, 1.0)
    floor = kernels.FIT_FLOOR_PX**2 + missing**2
    place = patches.offsets + found.shift
    columns = {
        kernels.X: place[:, 0],
        kernels.Y: place[:, 1],
        kernels.RADIUS: patches.radii,
        kernels.PEAK: patches.peaks * found.contrast,
        kernels.MISFIT: found.misfit,
        kernels.SCORE: found.share,
        kernels.VAR_X: found.covariance[:, 0, 0] + floor,
        kernels.COV_XY: found.covariance[:, 0, 1],
        kernels.VAR_Y: found.covariance[:, 1, 1] + floor,
        kernels.OK: np.ones(len(good)),
    }
    for column, values in columns.items():
        results[good, column] = values[good]
    return results
