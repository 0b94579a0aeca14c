"""The second measurement: every bead is measured again where the first fit predicts it.

Once a rough fit exists, the position of every bead is known to a fraction of a pixel. Each one is
measured again in a window there, after subtracting the phantom's own body (bricks, cuboid),
rendered at that geometry and blurred as the images are. An edge of the body behind a bead then no
longer shifts its centroid, touching spots are separated, spots cut by the image's edge are fitted,
and no bead is missed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.detect import spot_kernels as kernels
from flexdt.twin.calibration.detect.background import Background, survey
from flexdt.twin.calibration.detect.detection import BLUR_PX, CAP, MISFIT, covariances_of
from flexdt.twin.calibration.detect.fading import evened, fading
from flexdt.twin.calibration.detect.seen_body import NO_BODY, SeenBody, see_body
from flexdt.twin.calibration.detect.windows import (
    Windows,
    blurred_windows,
    edged,
    free_of_others,
    render_windows,
    without_beads,
)
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection.analytic_solids import Scene, Solid, Sphere

# Windows in the form that the compiled kernels take, and the kernels applied to all of them.


@dataclass(frozen=True, eq=False)
class Patches:
    """Windows as the kernels want them, (m = n k, ...): what is expected where.

    Attributes:
        flat: (m, side, side) line integrals minus the body.
        offsets: (m, 2) expected place in the window.
        radii, stretch, peaks: (m,), (m, 3), (m,) expected spots.
        windows: where they were cut.
        entire: indices of whole, lone spots.
    """

    flat: Float32Array
    offsets: FloatArray
    radii: FloatArray
    stretch: FloatArray
    peaks: FloatArray
    windows: Windows
    entire: npt.NDArray[np.intp]


def centroids(
    patches: Patches, index: npt.NDArray[np.intp], least: FloatArray | None = None
) -> FloatArray:
    """`measure` in some windows; zeros elsewhere. least: (m,) noise to weigh pixels for."""
    results = np.zeros((len(patches.flat), kernels.RESULTS))
    least = np.zeros(len(results)) if least is None else least
    for i in index:
        x, y = patches.offsets[i]
        kernels.measure(patches.flat[i], x, y, patches.radii[i], CAP, least[i], results[i])
    return results


def fits(
    patches: Patches,
    index: npt.NDArray[np.intp],
    blur: tuple[float, float],
    free_radius: bool,
    masks: npt.NDArray[np.uint8],
) -> FloatArray:
    """`fit_ball` in some windows; zeros elsewhere. blur: with the veil; masks: usable pixels of
    those windows."""
    results = np.zeros((len(patches.flat), kernels.RESULTS))
    whole = patches.windows.whole.ravel()
    for i, mask in zip(index, masks, strict=True):
        kernels.fit_ball(
            patches.flat[i], mask, *patches.offsets[i], patches.radii[i], patches.stretch[i],
            patches.peaks[i], *blur, whole[i], free_radius, results[i],
        )  # fmt: skip
    return results


def ring_noise(results: FloatArray, entire: npt.NDArray[np.intp]) -> float:
    """Typical noise of the line integrals round whole spots; 0 without any."""
    good = results[entire, kernels.OK] > 0
    return float(np.median(results[entire[good], kernels.NOISE])) if good.any() else 0.0


def take(
    results: FloatArray,
    fits: FloatArray,
    fitted: npt.NDArray[np.intp],
    whole: npt.NDArray[np.bool_],
) -> npt.NDArray[np.intp]:
    """Put fits into `results`: all of the partial spots', the good ones of the whole.

    Returns:
        Those that were put, in the order of `fitted`.
    """
    good = (fits[fitted, kernels.OK] > 0) & (fits[fitted, kernels.NOISE] < MISFIT)
    part = fitted[~whole[fitted]]
    results[part] = fits[part]
    # Radius, peak and likeness stay those of the centroid: they judge the spot.
    lone = fitted[whole[fitted] & good]
    for place in (
        kernels.X, kernels.Y, kernels.VAR_X, kernels.COV_XY, kernels.VAR_Y, kernels.BIAS
    ):  # fmt: skip
        results[lone, place] = fits[lone, place]
    return np.asarray(fitted[~whole[fitted] | good])


def contrasts(results: FloatArray, patches: Patches) -> FloatArray:
    """Contrast of each bead, (m,): the median over its whole spots, else as expected, scaled as
    the others' are."""
    shape = patches.windows.whole.shape
    seen = np.where(results[:, kernels.OK] > 0, results[:, kernels.PEAK], np.nan).reshape(shape)
    given = patches.peaks.reshape(shape)[0]
    out = np.full(len(given), np.nan)
    for bead in range(len(out)):
        values = seen[:, bead][np.isfinite(seen[:, bead])]
        if len(values) >= 3:
            out[bead] = np.median(values)
    known = np.isfinite(out)
    ratio = float(np.median(out[known] / given[known])) if known.any() else 1.0
    out[~known] = given[~known] * ratio
    return np.broadcast_to(out, shape).ravel().copy()


def usable(patches: Patches, index: npt.NDArray[np.intp]) -> npt.NDArray[np.uint8]:
    """Usable pixels of some windows: inside the image and free of other beads' spots."""
    masks = np.isfinite(patches.flat[index]).astype(np.uint8)
    windows = patches.windows
    k = windows.corner.shape[1]
    for i, position in enumerate(index.tolist()):
        frame, bead = divmod(position, k)
        if windows.crowded[frame, bead]:
            masks[i] &= free_of_others(windows, frame, bead)
    return masks


# Blur of the images and apparent size of the beads, estimated from the spots themselves.
#
# The profile that is fitted is an approximation, so the estimate is corrected by the same estimate
# from rendered beads. Without whole spots the assumed values are returned, marked as not seen.

SAMPLE = 24
"""Spots from which blur and size are estimated, about."""
BLURS = (0.12, 0.25, 0.45, 0.7, 1.1, 1.7, 2.5, 3.6)
"""Blurs that are tried [px]."""
VEILS = (0.0, 0.1, 0.2, 0.3, 0.45, 0.6)
"""Veils that are tried."""
CHECK_FINE = 3
"""Rays along a pixel's side where that estimate is checked on rendered beads."""
BODY_BLUR_PX = 0.18
"""Blur of the images below which the rendered body is subtracted as it is."""


def balls_of(model: BeadModel, contrast: FloatArray, size: float = 1.0) -> Scene:
    """The beads alone, as balls with the contrast (k,) and the size they are seen with."""
    return Scene(
        tuple(
            Solid(Sphere((x, y, z), r * size), "bead", max(peak, 1e-3) / (2.0 * r * size))
            for (x, y, z), r, peak in zip(
                model.beads.tolist(), model.bead_radius_mm.tolist(), contrast.tolist(), strict=True
            )
        )
    )


def rest_of_blur(blur: float, fine: int) -> float:
    """Blur left to apply when fine x fine rays of a pixel have been averaged already."""
    return math.sqrt(max(blur**2 - (1.0 - 1.0 / fine**4) / 12.0, 0.01))


@dataclass(frozen=True)
class Sharp:
    """Blur of the images [px] and size of the beads.

    Attributes:
        blur, scale: blur and factor from expected to apparent radius with which a fit leaves least.
        veil: part of the light about a bead that it does not take away, with which it leaves least.
        seen: they were seen, not assumed.
        true: the blur with which rendered beads look the same.
        size: likewise the factor on the beads' radii.
    """

    blur: float
    scale: float
    veil: float
    seen: bool
    true: float
    size: float


def seen_sharpness(
    sharp: Sharp, patches: Patches, sample: npt.NDArray[np.intp], cone: ConeVec, model: BeadModel
) -> Sharp:
    """Blur and size corrected by what the same estimate makes of rendered beads: the fit's profile
    is an approximation, and where a spot is cut by the edge its radius decides its place."""
    if not sharp.seen or sharp.blur < BODY_BLUR_PX:
        return sharp
    k = patches.windows.corner.shape[1]
    frames, beads = np.divmod(sample, k)
    few = patches.windows.pick(frames, beads)
    balls = balls_of(model, patches.peaks[:k])
    rays = render_windows(balls, cone[frames], few, CHECK_FINE)
    seen = blurred_windows(rays, rest_of_blur(sharp.blur, CHECK_FINE))
    side = few.side
    rendered = replace(
        patches, flat=seen.reshape(-1, side, side), offsets=patches.offsets[sample],
        radii=patches.radii[sample], stretch=patches.stretch[sample], peaks=patches.peaks[sample],
        windows=few,
    )  # fmt: skip
    found = sharpness(rendered, np.arange(len(sample)), sharp.blur)
    if not found.seen:
        return sharp
    true = 2.0 * sharp.blur - found.blur
    if not abs(true - sharp.blur) < 0.2 * sharp.blur:
        return sharp
    return replace(sharp, true=true, size=sharp.scale / found.scale)


_Tried = tuple[FloatArray, FloatArray, FloatArray]
"""Blurs that were tried with one veil, the misfits of the fits and the sizes they found."""


def sharpness(patches: Patches, sample: npt.NDArray[np.intp], blur: float) -> Sharp:
    """Blur, veil and apparent size from some whole spots, by the fit that leaves least.

    A bead that is not as made shows here too; a spot cut by the edge has its centre where its
    radius puts it. Without whole spots: the assumed blur, and the expected size.
    """
    if len(sample) < 3:
        return Sharp(blur, 1.0, 0.0, False, blur, 1.0)
    masks, blurs = usable(patches, sample), np.array(BLURS)

    def tried(veil: float, blurs: FloatArray) -> _Tried:
        """Blurs from the least on, until one leaves much more than the one before."""
        misfit, scale = np.full(len(blurs), np.inf), np.ones(len(blurs))
        for i, trial in enumerate(blurs.tolist()):
            results = fits(patches, sample, (trial, veil), True, masks)
            good = sample[results[sample, kernels.OK] > 0]
            if len(good) >= 3:
                misfit[i] = float(np.median(results[good, kernels.NOISE]))
                scale[i] = float(np.median(results[good, kernels.RADIUS] / patches.radii[good]))
            if i > 0 and misfit[i] > 1.5 * misfit[i - 1]:
                break
        return blurs, misfit, scale

    def near(last: _Tried) -> FloatArray:
        """The blurs next to the one that leaves least."""
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
    veil, last = _lowest(np.array(VEILS[: len(found)]), least), found[int(least.argmin())]
    if veil > 0.0:
        last = tried(veil, near(last))
    best = _lowest(last[0], last[1])
    apparent = float(np.interp(best, last[0], last[2]))
    return Sharp(best, apparent, veil, True, best, apparent)


def _lowest(tried: FloatArray, misfit: FloatArray) -> float:
    """Where a misfit is least: a hyperbola about the right place, so its square is a parabola."""
    i = int(np.argmin(misfit))
    near = slice(i - 1, i + 2)
    if 0 < i < len(tried) - 1 and np.isfinite(misfit[near]).all():
        a, b, _ = np.polyfit(tried[near], np.square(misfit[near]), 2)
        if a > 0:
            return float(np.clip(-b / (2.0 * a), tried[i - 1], tried[i + 1]))
    return float(tried[i])


MISS_PX = 4.0
"""A measurement further than this from its prediction is not that bead."""
SHARE = 0.35
"""Least share of a spot in view that is still fitted."""
FIT_NOISE = 0.008
"""Noise of the line integrals above which whole spots are fitted too: a fit weighs photons as
they count, and halves the error of a centroid there (measured)."""
FIT_BLUR_PX = 0.4
"""Least blur for that: an unblurred ball sampled at pixel centres misleads a fit by 0.015 px."""
FEW_WINDOWS = 600
"""Up to so many windows the body is rendered with 3 x 3 rays a pixel, else 2 x 2."""
FADING_FRAMES = 60
"""Frames from which it is read how beads fade behind a body, at least if there are as many."""
LARGEST_PX = 0.6
"""A larger systematic error of a rendered spot is not believed."""
NEAR_PX = 0.15
"""Spots further from their prediction are not judged by what is beside them."""
FOREIGN = 10.0
"""Misfit of a background, by the others', from which a spot is left out."""
LOST = 0.3
"""Largest share of the spots that is left out because of what lies beside them."""
EDGE = 0.04
"""Height of a body's edge (line integral) at a bead's rim from which its centroid is preferred."""
SAMPLING_PX = 0.0005
"""Error that depends on a spot's place in the pixel grid and is left after the correction by
rendered spots: images of other rays a pixel, blur estimated (measured without noise)."""
SHARP_SAMPLING_PX = 0.0001
"""The same where nothing is blurred, and the rendered rays are the images' own."""


@dataclass(frozen=True, eq=False)
class Refined:
    """Bead positions of n frames, (n, k, ...), nan where there is none.

    Attributes:
        tracks: (n, k, 2) pixels.
        covariances: (n, k, 2, 2).
        bias: (n, k) sphere-centre bias factors.
        contrast: (n, k) line integral through the middle.
        size: apparent over expected radius of whole spots, blur allowed for; nan if unknown.
        blur_px: blur of the images, as the spots show it or assumed.
        sampling_px: what remains of the error that depends on a spot's place in the pixel grid.
        body: the phantom's, as the images have it.
    """

    tracks: FloatArray
    covariances: FloatArray
    bias: FloatArray
    contrast: FloatArray
    size: float
    blur_px: float
    sampling_px: float
    body: SeenBody = NO_BODY


def measure_beads(
    images: npt.NDArray[np.float32],
    windows: Windows,
    cone: ConeVec,
    model: BeadModel,
    contrast: float | FloatArray,
    scene: Scene | None = None,
    *,
    draft: bool = False,
) -> Refined:
    """Measure every bead in its window.

    Args:
        images: (n, k, side, side) line integrals from `crop`.
        windows: where they were cut out.
        cone: geometry the windows were planned with.
        model: the beads.
        contrast: line integral through the middle of a bead, one or (k,), as detected.
        scene: the phantom's solids; what is not a bead is subtracted. None: only planes are.
        draft: leave out the correction by rendered beads, which takes most of the time and needs a
            geometry that is right to a few hundredths of a pixel.
    """
    n, k = windows.corner.shape[:2]
    side = windows.side
    body: Float32Array | None = None
    data, seen = images, NO_BODY
    described = Scene(()) if scene is None else without_beads(scene, model)
    if described.solids:
        seen = see_body(images, described, cone, model, windows)
        if seen.factor > 0:
            body = render_windows(seen.scene(described), cone, windows)
            data = images - body
    patches = Patches(
        data.reshape(n * k, side, side),
        (windows.predicted - windows.corner).reshape(-1, 2),
        windows.radii.ravel(),
        windows.stretch.reshape(-1, 3),
        np.broadcast_to(np.asarray(contrast, dtype=np.float64), (n, k)).ravel().copy(),
        windows,
        np.flatnonzero(windows.whole),
    )
    there = np.isfinite(patches.flat[patches.entire, side // 2, side // 2])
    patches = replace(patches, entire=patches.entire[there])
    sample = patches.entire[:: max(1, len(patches.entire) // SAMPLE)]
    first = centroids(patches, sample)
    patches = replace(patches, peaks=contrasts(first, patches))
    sharp = sharpness(patches, sample, BLUR_PX)
    if not draft:
        sharp = seen_sharpness(sharp, patches, sample, cone, model)
    balls = balls_of(model, patches.peaks[:k], sharp.size)
    if sharp.blur < BODY_BLUR_PX:
        alone = None if draft else render_windows(balls, cone, windows)
    else:
        # A blurred image comes from pixels that integrate, so an edge must not be put where the
        # nearest ray is.
        fine = 3 if n * k <= FEW_WINDOWS and not draft else 2
        rest = rest_of_blur(sharp.true, fine)
        beads = render_windows(balls, cone, windows, fine)
        alone = blurred_windows(beads, rest)
        if body is not None:
            # Blur acts on intensities, where body and bead multiply, and so do pixels: what the
            # body adds to the line integral depends on the bead in front of it.
            seen = see_body(images, described, cone, model, windows, sharp.true)
            whole = Scene((*balls.solids, *seen.scene(described).solids))
            both = render_windows(whole, cone, windows, fine)
            data = images - (blurred_windows(both, rest) - alone)
            patches = replace(patches, flat=data.reshape(n * k, side, side))
    measured = _measured(patches, None if draft else alone, body, sharp)
    return replace(measured, body=seen)


def _measured(
    patches: Patches, alone: Float32Array | None, body: Float32Array | None, sharp: Sharp
) -> Refined:
    """Centroids and fits, less what the same measurement of the same beads rendered without noise
    (`alone`; None leaves them as they are) shows to be their systematic error.

    The rendered spots contain what pixels and blur do to a ball, its neighbours, and the
    displacement of a ball's spot from the projection of its centre.
    """
    windows = patches.windows
    n, k = windows.corner.shape[:2]
    behind: Background | None = None
    if alone is not None:
        alone = alone.reshape(patches.flat.shape)
        behind = survey(patches.flat, alone)
        if behind.bend is not None:
            patches = replace(patches, flat=patches.flat - behind.bend)
        patches = _evened(patches, behind, body)
    results = centroids(patches, patches.entire)
    patches = replace(patches, peaks=contrasts(results, patches), radii=patches.radii * sharp.scale)
    fitted = np.flatnonzero((windows.share > SHARE) & ~windows.whole)
    if ring_noise(results, patches.entire) > FIT_NOISE and sharp.blur >= FIT_BLUR_PX:
        # Start where the centroid is; it stays where the fit fails, and where an edge of the body
        # touches the rim, which a fit relies on.
        good = patches.entire[results[patches.entire, kernels.OK] > 0]
        if body is not None:
            good = good[~edged(body, windows, EDGE).ravel()[good]]
        fitted = np.concatenate([fitted, good])
    start = patches.offsets.copy()
    begun = fitted[results[fitted, kernels.OK] > 0]
    start[begun] = results[begun][:, [kernels.X, kernels.Y]]
    masks = usable(patches, fitted)
    blur = sharp.blur, sharp.veil
    fitting = fits(replace(patches, offsets=start), fitted, blur, False, masks)
    taken = take(results, fitting, fitted, windows.whole.ravel())
    if alone is not None:
        model = replace(patches, flat=alone)
        expected = centroids(model, patches.entire, results[:, kernels.NOISE])
        taken = taken[results[taken, kernels.OK] > 0]
        expected[taken] = fits(model, taken, blur, False, masks[np.isin(fitted, taken)])[taken]
        sure = (results[:, kernels.OK] > 0) & (expected[:, kernels.OK] > 0)
        error = expected[:, [kernels.X, kernels.Y]] - patches.offsets
        sure &= np.hypot(error[:, 0], error[:, 1]) < LARGEST_PX
        results[sure, kernels.X] -= error[sure, 0]
        results[sure, kernels.Y] -= error[sure, 1]
        results[sure, kernels.BIAS] = 0.0
    if behind is not None:
        _discount(results, behind, patches.offsets)
    return _accept(results.reshape(n, k, -1), windows, patches.peaks.reshape(n, k), sharp)


def _evened(patches: Patches, behind: Background, body: Float32Array | None) -> Patches:
    """The windows with beads whose contrast is the same all over, as some frames show it."""
    frames, beads = patches.windows.whole.shape
    few = patches.entire[patches.entire // beads % max(1, frames // FADING_FRAMES) == 0]
    found = centroids(patches, few)
    seen = found[:, kernels.OK] > 0
    level, thick = behind.plane[:, 0], body
    if body is not None:
        thick = np.asarray(body.reshape(-1, *patches.flat.shape[1:]))
        level = level + thick[:, thick.shape[1] // 2, thick.shape[1] // 2]
    shape = frames, beads
    peaks = found[:, kernels.PEAK].reshape(shape)
    slope = fading(peaks, level.reshape(shape), seen.reshape(shape))
    if slope == 0.0:
        return patches
    return replace(patches, flat=evened(patches.flat, behind.plane, thick, slope))


def _discount(results: FloatArray, behind: Background, expected: FloatArray) -> None:
    """Trust spots less that have something foreign beside them, and leave out the worst, unless
    there are too many. Those that are not where they are expected are not judged: that is a matter
    of the fit, and their own rim looks foreign."""
    there = results[:, kernels.OK] > 0
    off = results[:, [kernels.X, kernels.Y]] - expected
    there &= np.hypot(off[:, 0], off[:, 1]) < NEAR_PX
    bad = there & behind.disturbed
    for place in (kernels.VAR_X, kernels.COV_XY, kernels.VAR_Y):
        results[bad, place] *= behind.misfit[bad]
    worst = bad & (behind.misfit > FOREIGN)
    if worst.sum() <= LOST * max(int(there.sum()), 1):
        results[worst, kernels.OK] = 0.0


def _accept(results: FloatArray, windows: Windows, contrast: FloatArray, sharp: Sharp) -> Refined:
    """What passes the checks of place, size, contrast and likeness."""
    whole = windows.whole
    place = results[..., [kernels.X, kernels.Y]] + windows.corner
    off = np.linalg.norm(place - windows.predicted, axis=2)
    peak = results[..., kernels.PEAK]
    good = (results[..., kernels.OK] > 0) & (off < MISS_PX)
    good &= np.where(
        whole,
        (results[..., kernels.SCORE] > 0.9)
        & (np.abs(np.log(np.maximum(results[..., kernels.RADIUS], 1e-9) / windows.radii)) < 0.2)
        & (np.abs(np.log(np.maximum(peak, 1e-9) / contrast)) < math.log(1.6)),
        results[..., kernels.NOISE] < MISFIT,
    )
    return Refined(
        np.where(good[..., None], place, np.nan),
        np.where(good[..., None, None], covariances_of(results), np.nan),
        np.where(good, results[..., kernels.BIAS], 0.0),
        np.where(good, peak, np.nan),
        sharp.scale if sharp.seen else math.nan,
        sharp.blur,
        SHARP_SAMPLING_PX if sharp.blur < BODY_BLUR_PX else SAMPLING_PX,
    )


def contrast_of(values: Sequence[FloatArray]) -> float:
    """Typical contrast of detections in several frames; nan without any."""
    parts = [v for v in values if len(v)]
    return float(np.median(np.concatenate(parts))) if parts else math.nan
