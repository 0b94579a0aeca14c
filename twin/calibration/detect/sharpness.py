"""Blur of the images and apparent size of the beads, estimated from the spots themselves.

The profile that is fitted is an approximation, which finds where to begin; rendered beads give
blur and size. Without complete spots the assumed values are returned, marked as not seen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.detect import spot_kernels as kernels
from flexdt.twin.calibration.detect.bead_hardening import (
    ATTENUATIONS,
    Profiles,
)
from flexdt.twin.calibration.detect.bead_sizes import BeadSize, bead_size
from flexdt.twin.calibration.detect.patches import Patches, centroids, fits, usable
from flexdt.twin.calibration.detect.windows import (
    Balls,
    Windows,
    blur_kernel,
    blurred_light,
    blurred_windows,
    distances2,
    exposed_light,
    rays_of,
    render_windows,
    window_rays,
)
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection.analytic_solids import Scene, Solid, Sphere

SAMPLE = 24
"""Number of spots from which blur and size are estimated."""
BLURS = (0.12, 0.25, 0.45, 0.7, 1.1, 1.7, 2.5, 3.6)
"""Trial blurs [px]."""
VEILS = (0.0, 0.1, 0.2, 0.3, 0.45, 0.6)
"""Trial veils, as a share of the light."""
RADIUS_RAYS = 18
"""Rays along a bead's radius where spots are compared with rendered ones."""
CHECK_FINE = 3
"""Least number of rays along a pixel's side there."""
MOST_FINE = 6
"""Largest number of rays along a pixel's side."""
EXPOSED_FINE = 2
"""The same in each moment of an exposure, of which there are many."""
BODY_BLUR_PX = 0.18
"""Blur of the images below which the rendered body is subtracted as it is."""
ALIKE = 1.1
"""Ratio of the contrasts of two beads below which they harden the beam alike."""
PROFILES = 12
"""Number of spots from which a hardening is estimated."""
LATTICE_ORDER = 2.0
"""Power of the number of rays along a pixel's side by which the error of a spot's place falls:
no two of them share a row (measured: 1.7 to 2.0 with the weights of noisy images)."""
OPEN_LIGHT = 0.999
"""Light of the softest term from which a pixel lies beside a bead."""
_Tried = tuple[FloatArray, FloatArray, FloatArray]
"""Trial blurs with one veil, the misfits of their fits and the fitted sizes."""


def balls_of(model: BeadModel, contrast: FloatArray, size: float = 1.0) -> Scene:
    """Make a scene of the beads alone, in the order of the model.

    `contrast`: (k,) line integrals through their centers, 0.001 at least. `size`: factor
    on the radii.
    """
    return Scene(
        tuple(
            Solid(Sphere((x, y, z), r * size), "bead", max(peak, 1e-3) / (2.0 * r * size))
            for (x, y, z), r, peak in zip(
                model.beads.tolist(),
                model.bead_radius_mm.tolist(),
                contrast.tolist(),
                strict=True,
            )
        )
    )


def rest_of_blur(blur: float, fine: int) -> float:
    """Compute the blur [px] left after averaging fine x fine rays of a pixel, 0 at
    least.
    """
    return math.sqrt(max(blur**2 - pixel_variance(fine), 0.0))


def fine_rays(windows: Windows, rays: int, least: int) -> int:
    """Return the rays along a pixel's side that put `rays` along the usual bead's
    radius.
    """
    if windows.moments:
        return EXPOSED_FINE
    fine = math.ceil(rays / float(np.median(windows.radii)))
    return min(max(fine, least), MOST_FINE)


def pixel_variance(fine: int) -> float:
    """Return the variance that averaging fine x fine rays of a pixel gives to an image [px^2]."""
    return (1.0 - 1.0 / fine**4) / 12.0


@dataclass(frozen=True)
class Sharp:
    """Blur of the images [px] and size of the beads.

    Attributes:
        blur, scale: blur, and factor from expected to apparent radius, of the best fit.
        veil: part of the light about a bead that it does not take away, of the best fit.
        seen: whether they were estimated, not assumed.
        true: the blur with which rendered beads look the same.
        size: the same for the factor on the beads' radii.
        sigma: standard deviation of the logarithm of that; inf where rendered beads did not
            tell it.
        lift: the same for the factor on the beads' contrast, of which blur takes a part.
    """

    blur: float
    scale: float
    veil: float
    seen: bool
    true: float
    size: float
    sigma: float = math.inf
    lift: float = 1.0


def seen_sharpness(
    sharp: Sharp,
    patches: Patches,
    sample: npt.NDArray[np.intp],
    cone: ConeVec,
    model: BeadModel,
) -> tuple[Sharp, Balls]:
    """Estimate blur, size and contrast by rendered beads (`bead_size`), and how the beads harden
    the beam.

    The fit's profile is an approximation, and where a spot is cut by the edge its radius
    decides its place.

    Args:
        sharp: the estimate of the images.
        patches: the windows.
        sample: indices of complete spots.
        cone: geometry of their frames.
        model: the beads.

    Returns:
        The estimate, and the beads as they attenuate; `sharp` itself if nothing is seen.
    """
    found = None
    if sharp.seen:
        fine = rays_to_check(sharp, patches.windows)
        plain = balls_of(model, patches.peaks[: len(model)])
        first = BeadSize(sharp.scale, math.inf, rest_of_blur(sharp.blur, fine) ** 2)
        found = bead_size(patches, sample, cone, plain, fine, first)
    if found is not None:
        variance = found.variance + (pixel_variance(fine) if fine > 1 else 0.0)
        lift = found.lift(float(np.median(patches.peaks)))
        sharp = replace(
            sharp,
            true=math.sqrt(variance),
            size=found.size,
            sigma=found.sigma,
            lift=lift,
        )
    return sharp, hardened_balls(sharp, patches, cone, model)


def rays_to_check(sharp: Sharp, windows: Windows) -> int:
    """Return the rays along a pixel's side with which spots are rendered to be compared: one
    where the images have one, too.
    """
    if sharp.blur < BODY_BLUR_PX:
        return 1
    return fine_rays(windows, RADIUS_RAYS, CHECK_FINE)


def spread(index: npt.NDArray[np.intp], most: int) -> npt.NDArray[np.intp]:
    """Pick at most `most` of some indices, evenly from the first to the last."""
    places = np.linspace(0, len(index) - 1, min(most, len(index)))
    return np.asarray(index[places.astype(np.intp)])


def hardened_balls(
    sharp: Sharp, patches: Patches, cone: ConeVec, model: BeadModel
) -> Balls:
    """Group the beads by contrast, and estimate how each group hardens the beam.

    Args:
        sharp: blur and size of the images.
        patches: the windows.
        cone: geometry of the frames.
        model: the beads.

    Returns:
        Scenes of beads with their hardening, which is None where too few spots show it.
    """
    k = patches.windows.corner.shape[1]
    contrast = sharp.lift * patches.peaks[:k]
    order = np.argsort(contrast)
    breaks = np.flatnonzero(np.diff(np.log(contrast[order])) > math.log(ALIKE)) + 1
    solids = balls_of(model, contrast, sharp.size).solids
    groups = []
    for group in np.split(order, breaks):
        spots = patches.entire[np.isin(patches.entire % k, group)]
        spots = spread(spots, PROFILES)
        ball = Scene(tuple(solids[i] for i in group))
        profiles = _profiles_of(ball, sharp, patches, spots, cone)
        groups.append((ball, None if profiles is None else profiles.fitted()))
    return tuple(groups)


def _profiles_of(
    ball: Scene,
    sharp: Sharp,
    patches: Patches,
    spots: npt.NDArray[np.intp],
    cone: ConeVec,
) -> Profiles | None:
    """Collect the light behind alike beads in some of their spots, from pixels within 1.15
    radii and 2 px that have a value, over the open beam beside each spot.

    Args:
        ball: the beads, for one energy.
        sharp: blur of the images.
        patches: the windows.
        spots: indices of complete spots of these beads.
        cone: geometry of the frames.

    Returns:
        The profiles; None without spots.
    """
    if len(spots) == 0:
        return None
    frames, beads = np.divmod(spots, patches.windows.corner.shape[1])
    few = patches.windows.pick(frames, beads)
    rays = rays_to_check(sharp, patches.windows)
    factors = -np.array(ATTENUATIONS, dtype=np.float32)[:, None, None, None, None]
    most = 0.0

    def light_of(near: ConeVec, some: Windows, place: FloatArray) -> Float32Array:
        """Render what each term leaves of the light, (terms, m, 1, side, side)."""
        nonlocal most
        rays = window_rays(ball, near, some, place)
        most = max(most, float(rays.max()))
        return np.asarray(np.exp(factors * rays))

    if few.moments:
        light = exposed_light([ball], few, rays, light_of, (len(ATTENUATIONS),))[:, :, 0]
    else:
        light = np.zeros((len(ATTENUATIONS), len(spots), few.side, few.side), np.float32)
        for view, place, weight in rays_of(cone[frames], few, rays):
            light += light_of(view, few, place)[:, :, 0] * weight[:, :, None]
    blur = sharp.true if rays == 1 else rest_of_blur(sharp.true, rays)
    light = blurred_light(light, blur_kernel(blur))
    seen = patches.flat[spots]
    beside = np.where(light[-1] < OPEN_LIGHT, np.nan, seen)
    level = np.nanmedian(beside.reshape(len(spots), -1), axis=1)[:, None, None]
    reach = 1.15 * few.radii[:, 0, None, None] + 2.0
    near = distances2(few.corner, few.side, few.predicted)[:, 0] < reach**2
    use = np.isfinite(seen) & np.isfinite(level) & near
    return Profiles(
        light[:, use].T.astype(np.float64) - 1.0,
        np.exp(level - seen)[use].astype(np.float64),
        1.1 * most,
    )


def _rendered(
    patches: Patches, sample: npt.NDArray[np.intp], seen: Float32Array, few: Windows
) -> Patches:
    """Return the windows `sample` (j,) with rendered line integrals `seen` instead."""
    return replace(
        patches,
        flat=seen.reshape(-1, few.side, few.side),
        offsets=patches.offsets[sample],
        radii=patches.radii[sample],
        stretch=patches.stretch[sample],
        peaks=patches.peaks[sample],
        windows=few,
    )


def rendering_error(
    true: Sharp,
    balls: Balls,
    patches: Patches,
    sample: npt.NDArray[np.intp],
    cone: ConeVec,
    alone: Float32Array,
    fine: int,
    noise: float,
) -> float:
    """Estimate the error of rendered spots' places that finite rays leave, by the same spots
    from half as many rays along a pixel's side.

    The images have no part in it, so a fault of the scan does not enlarge it.

    `true`: estimate for the images; `balls`: the beads; `patches`: windows of the images;
    `sample`: indices of the windows to compare; `cone`: geometry of the frames; `alone`: all
    windows rendered with `fine` rays and blurred, (n, k, side, side); `fine`: rays along a
    pixel's side; `noise`: of the images' line integrals, by which pixels are weighted: more
    noise, more weight of the rims.
    Returns rms error of a coordinate [px], by `LATTICE_ORDER`; 0 if no spot can be measured in
    both.
    """
    frames, beads = np.divmod(sample, patches.windows.corner.shape[1])
    few = patches.windows.pick(frames, beads)
    rays = max(fine // 2, 1)
    drawn = render_windows(Scene(()), cone[frames], few, rays, balls)
    rough = blurred_windows(drawn, rest_of_blur(true.true, rays))
    every = np.arange(len(sample))
    least = np.full(len(sample), noise)
    found = [
        centroids(_rendered(patches, sample, seen, few), every, least)
        for seen in (alone[frames, beads], rough)
    ]
    good = (found[0][:, kernels.OK] > 0) & (found[1][:, kernels.OK] > 0)
    if not good.any():
        return 0.0
    places = [kernels.X, kernels.Y]
    change = float(np.sqrt(np.square((found[0] - found[1])[good][:, places]).mean()))
    return change / float((fine / rays) ** LATTICE_ORDER - 1.0)


def sharpness(patches: Patches, sample: npt.NDArray[np.intp], blur: float) -> Sharp:
    """Estimate blur, veil and apparent size from some complete spots, by the best fit
    among `BLURS` and `VEILS` and a parabola about it.

    A bead of another size than described shows here too; a spot cut by the edge has its
    center where its radius puts it.

    Args:
        patches: the windows.
        sample: indices of complete spots.
        blur: assumed, with the expected size [px].

    Returns:
        The estimate; the assumed values, as not seen, if there are fewer than three spots
        or good fits.
    """
    if len(sample) < 3:
        return Sharp(blur, 1.0, 0.0, False, blur, 1.0)
    masks = usable(patches, sample)
    blurs = np.array(BLURS)

    def tried(veil: float, blurs: FloatArray) -> _Tried:
        """Fit the windows with each blur, from the least on, until one leaves more than
        1.5 times the misfit of the one before.

        Args:
            veil: part of the light about a bead that it does not take away.
            blurs: increasing blurs [px].

        Returns:
            `blurs`; the median misfits, inf where not tried or with fewer than three good
            fits; and median fitted over predicted radii, 1 there.
        """
        misfit = np.full(len(blurs), np.inf)
        scale = np.ones(len(blurs))
        for i, trial in enumerate(blurs.tolist()):
            results = fits(patches, sample, (trial, veil), True, masks)
            good = sample[results[sample, kernels.OK] > 0]
            if len(good) >= 3:
                misfit[i] = float(np.median(results[good, kernels.NOISE]))
                scale[i] = float(
                    np.median(results[good, kernels.RADIUS] / patches.radii[good])
                )
            if i > 0 and misfit[i] > 1.5 * misfit[i - 1]:
                break
        return blurs, misfit, scale

    def near(last: _Tried) -> FloatArray:
        """Return the trial blurs next to the one that leaves least in `last`, and it: two
        or three of `BLURS`."""
        i = int(np.searchsorted(blurs, last[0][int(last[1].argmin())]))
        return blurs[max(i - 1, 0) : i + 2]

    found = [tried(VEILS[0], blurs)]
    if not math.isfinite(found[0][1].min()):
        return Sharp(blur, 1.0, 0.0, False, blur, 1.0)
    # A veil changes the blur that fits by little, so its neighbours are tried.
    for trial in VEILS[1:]:
        found.append(tried(trial, near(found[-1])))
        if not found[-1][1].min() < found[-2][1].min():
            break
    least = np.array([misfit.min() for _, misfit, _ in found])
    veil = _lowest(np.array(VEILS[: len(found)]), least)
    last = found[int(least.argmin())]
    if veil > 0.0:
        last = tried(veil, near(last))
    best = _lowest(last[0], last[1])
    apparent = float(np.interp(best, last[0], last[2]))
    return Sharp(best, apparent, veil, True, best, apparent)


def _lowest(tried: FloatArray, misfit: FloatArray) -> float:
    """Find the minimum of a misfit whose square is a parabola near it.

    Returns a place between the neighbors of the best of the increasing trials; that trial
    itself at an end, beside one not tried (inf), or if the parabola opens downwards.
    """
    i = int(np.argmin(misfit))
    near = slice(i - 1, i + 2)
    if 0 < i < len(tried) - 1 and np.isfinite(misfit[near]).all():
        a, b, _ = np.polyfit(tried[near], np.square(misfit[near]), 2)
        if a > 0:
            return float(np.clip(-b / (2.0 * a), tried[i - 1], tried[i + 1]))
    return float(tried[i])
