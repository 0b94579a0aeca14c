"""Second look at the images where the geometry says the beads are.

Once a rough fit exists, every bead's place is known to a fraction of a pixel. Each is measured
again in a window there, after the phantom's own body (bricks, cuboid), rendered at that geometry
and blurred as the images are, is subtracted: a body's edge behind a bead no longer pulls its
centroid, touching shadows are separated, shadows cut by the edge are fitted, and none is missed.
It refuses to find beads on its own and to keep images.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration import detect_kernels as kernels
from flexdt.twin.calibration.background import Background, survey
from flexdt.twin.calibration.beads import BeadModel
from flexdt.twin.calibration.detect import BLUR_PX, CAP, MISFIT
from flexdt.twin.calibration.windows import (
    Windows,
    blurred_windows,
    body_scale,
    edged,
    free_of_others,
    render_windows,
    without_beads,
)
from flexdt.twin.conventions import Float32Array, FloatArray
from flexdt.twin.geometry import ConeVec
from flexdt.twin.projection.shapes import Scene, Solid, Sphere

MISS_PX = 4.0
"""A measurement further than this from its prediction is not that bead."""
SHARE = 0.35
"""Least share of a shadow in view that is still fitted."""
FIT_NOISE = 0.008
"""Noise of the line integrals above which whole shadows are fitted too: a fit weighs photons as
they count, and halves the error of a centroid there (measured)."""
FIT_BLUR_PX = 0.4
"""Least blur for that: an unblurred ball sampled at pixel centres misleads a fit by 0.015 px."""
FEW_WINDOWS = 600
"""Up to so many windows the body is rendered with 3 x 3 rays a pixel, else 2 x 2."""
SAMPLE = 24
"""Shadows from which blur and size are estimated, about."""
CHECK_FINE = 3
"""Rays along a pixel's side where that estimate is checked on rendered beads."""
LARGEST_PX = 0.6
"""A larger systematic error of a rendered shadow is not believed."""
NEAR_PX = 0.15
"""Shadows further from their prediction are not judged by what is beside them."""
LOST = 0.3
"""Largest share of the shadows that is left out because of what lies beside them."""
EDGE = 0.04
"""Height of a body's edge (line integral) at a bead's rim from which its centroid is preferred."""
SAMPLING_PX = 0.0005
"""Error that depends on a shadow's place in the pixel grid and is left after the correction by
rendered shadows: images of other rays a pixel, blur estimated (measured without noise)."""
SHARP_SAMPLING_PX = 0.0001
"""The same where nothing is blurred, and the rendered rays are the images' own."""
BODY_BLUR_PX = 0.18
"""Blur of the images below which the rendered body is subtracted as it is."""


@dataclass(frozen=True, eq=False)
class Measured:
    """Bead positions of n frames, (n, k, ...), nan where there is none.

    Attributes:
        tracks: (n, k, 2) pixels.
        covariances: (n, k, 2, 2).
        bias: (n, k) sphere-centre bias factors.
        contrast: (n, k) line integral through the middle.
        size: apparent over expected radius of whole shadows, blur allowed for; nan if unknown.
        blur_px: blur of the images, as the shadows show it or assumed.
        sampling_px: what remains of the error that depends on a shadow's place in the pixel grid.
    """

    tracks: FloatArray
    covariances: FloatArray
    bias: FloatArray
    contrast: FloatArray
    size: float
    blur_px: float
    sampling_px: float


@dataclass(frozen=True, eq=False)
class _Patches:
    """Windows as the kernels want them, (m = n k, ...): what is expected where.

    Attributes:
        flat: (m, side, side) line integrals minus the body.
        offsets: (m, 2) expected place in the window.
        radii, stretch, peaks: (m,), (m, 3), (m,) expected shadows.
        windows: where they were cut.
        entire: indices of whole, lone shadows.
    """

    flat: Float32Array
    offsets: FloatArray
    radii: FloatArray
    stretch: FloatArray
    peaks: FloatArray
    windows: Windows
    entire: npt.NDArray[np.intp]


def measure_beads(
    images: npt.NDArray[np.float32],
    windows: Windows,
    cone: ConeVec,
    model: BeadModel,
    contrast: float | FloatArray,
    scene: Scene | None = None,
    *,
    cap: float = CAP,
    blur: float = BLUR_PX,
    draft: bool = False,
) -> Measured:
    """Measure every bead in its window.

    Args:
        images: (n, k, side, side) line integrals from `crop`.
        windows: where they were cut out.
        cone: geometry the windows were planned with.
        model: the beads.
        contrast: line integral through the middle of a bead, one or (k,), as detected.
        scene: the phantom's solids; what is not a bead is subtracted. None: only planes are.
        cap: line integrals above the background are cut here in centroids.
        blur: of the images [px], where they do not show it themselves.
        draft: leave out the correction by rendered beads, which takes most of the time and needs a
            geometry that is right to a few hundredths of a pixel.
    """
    n, k = windows.corner.shape[:2]
    side = windows.side
    body: Float32Array | None = None
    data = images
    if scene is not None:
        body = render_windows(without_beads(scene, model), cone, windows)
        data = images - np.float32(body_scale(images, body, windows)) * body
    patches = _Patches(
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
    first = _centroids(patches, sample, cap)
    patches = replace(patches, peaks=_contrasts(first, patches))
    sharp = _sharpness(patches, sample, blur)
    if not draft:
        sharp = _seen_sharpness(sharp, patches, sample, cone, model)
    balls = balls_of(model, patches.peaks[:k], sharp.size)
    if sharp.blur < BODY_BLUR_PX:
        alone = None if draft else render_windows(balls, cone, windows)
    else:
        # A blurred image comes from pixels that integrate, so an edge must not be put where the
        # nearest ray is.
        fine = 3 if n * k <= FEW_WINDOWS and not draft else 2
        rest = _rest(sharp.true, fine)
        beads = render_windows(balls, cone, windows, fine)
        alone = blurred_windows(beads, rest)
        if scene is not None and body is not None:
            # Blur acts on intensities, where body and bead multiply, and so do pixels: what the
            # body adds to the line integral depends on the bead in front of it.
            scale = body_scale(images, blurred_windows(body, sharp.true), windows)
            rest_of_it = without_beads(scene, model).solids
            whole = Scene((*balls.solids, *(_denser(s, scale) for s in rest_of_it)))
            both = render_windows(whole, cone, windows, fine)
            data = images - (blurred_windows(both, rest) - alone)
            body *= np.float32(scale)
            patches = replace(patches, flat=data.reshape(n * k, side, side))
    return _measured(patches, None if draft else alone, body, cap, sharp)


def _denser(solid: Solid, factor: float) -> Solid:
    return replace(solid, mu_per_mm=solid.mu_per_mm * factor)


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


def _measured(
    patches: _Patches,
    alone: Float32Array | None,
    body: Float32Array | None,
    cap: float,
    sharp: _Sharp,
) -> Measured:
    """Centroids and fits, less what the same measurement of the same beads rendered without noise
    (`alone`; None leaves them as they are) shows to be their systematic error.

    The rendered shadows contain what pixels and blur do to a ball, its neighbours, and the
    displacement of a ball's shadow from the shadow of its centre.
    """
    windows = patches.windows
    n, k = windows.corner.shape[:2]
    behind: Background | None = None
    if alone is not None:
        alone = alone.reshape(patches.flat.shape)
        behind = survey(patches.flat, alone)
        if behind.bend is not None:
            patches = replace(patches, flat=patches.flat - behind.bend)
    results = _centroids(patches, patches.entire, cap)
    patches = replace(
        patches, peaks=_contrasts(results, patches), radii=patches.radii * sharp.scale
    )
    fitted = np.flatnonzero((windows.share > SHARE) & ~windows.whole)
    if _noise(results, patches.entire) > FIT_NOISE and sharp.blur >= FIT_BLUR_PX:
        # Start where the centroid is; it stays where the fit fails, and where an edge of the body
        # touches the rim, which a fit relies on.
        good = patches.entire[results[patches.entire, kernels.OK] > 0]
        if body is not None:
            good = good[~edged(body, windows, EDGE).ravel()[good]]
        fitted = np.concatenate([fitted, good])
    start = patches.offsets.copy()
    begun = fitted[results[fitted, kernels.OK] > 0]
    start[begun] = results[begun][:, [kernels.X, kernels.Y]]
    masks = _masks(patches, fitted)
    blur = sharp.blur
    fits = _fits(replace(patches, offsets=start), fitted, blur, False, masks)
    taken = _take(results, fits, fitted, windows.whole.ravel())
    if alone is not None:
        model = replace(patches, flat=alone)
        expected = _centroids(model, patches.entire, cap, results[:, kernels.NOISE])
        taken = taken[results[taken, kernels.OK] > 0]
        expected[taken] = _fits(model, taken, blur, False, masks[np.isin(fitted, taken)])[taken]
        sure = (results[:, kernels.OK] > 0) & (expected[:, kernels.OK] > 0)
        error = expected[:, [kernels.X, kernels.Y]] - patches.offsets
        sure &= np.hypot(error[:, 0], error[:, 1]) < LARGEST_PX
        results[np.ix_(sure, [kernels.X, kernels.Y])] -= error[sure]
        results[sure, kernels.BIAS] = 0.0
    if behind is not None:
        _discount(results, behind, patches.offsets)
    return _accept(results.reshape(n, k, -1), windows, patches.peaks.reshape(n, k), sharp)


def _discount(results: FloatArray, behind: Background, expected: FloatArray) -> None:
    """Leave out the shadows with something foreign beside them, or trust them less where there are
    too many for that. Those that are not where they are expected are not judged: that is a matter
    of the fit, and their own rim looks foreign."""
    there = results[:, kernels.OK] > 0
    off = results[:, [kernels.X, kernels.Y]] - expected
    bad = there & behind.disturbed & (np.hypot(off[:, 0], off[:, 1]) < NEAR_PX)
    if bad.sum() <= LOST * max(int(there.sum()), 1):
        results[bad, kernels.OK] = 0.0
        return
    places = [kernels.VAR_X, kernels.COV_XY, kernels.VAR_Y]
    results[np.ix_(bad, places)] *= behind.misfit[bad, None]


def _rest(blur: float, fine: int) -> float:
    """Blur left to apply when fine x fine rays of a pixel have been averaged already."""
    return math.sqrt(max(blur**2 - (1.0 - 1.0 / fine**4) / 12.0, 0.01))


def _centroids(
    patches: _Patches,
    index: npt.NDArray[np.intp],
    cap: float,
    least: FloatArray | None = None,
) -> FloatArray:
    """`measure` in some windows; zeros elsewhere. least: (m,) noise to weigh pixels for."""
    results = np.zeros((len(patches.flat), kernels.RESULTS))
    least = np.zeros(len(patches.flat)) if least is None else np.ascontiguousarray(least)
    kernels.measure_windows(
        patches.flat, index, patches.offsets, patches.radii, cap, least, results
    )
    return results


def _fits(
    patches: _Patches,
    index: npt.NDArray[np.intp],
    blur: float,
    free_radius: bool,
    masks: npt.NDArray[np.uint8],
) -> FloatArray:
    """`fit_ball` in some windows; zeros elsewhere. masks: usable pixels of those windows."""
    results = np.zeros((len(patches.flat), kernels.RESULTS))
    kernels.fit_windows(
        patches.flat, index, masks, patches.offsets, patches.radii,
        patches.stretch, patches.peaks, blur, patches.windows.whole.ravel(), free_radius, results,
    )  # fmt: skip
    return results


def _noise(results: FloatArray, entire: npt.NDArray[np.intp]) -> float:
    """Typical noise of the line integrals round whole shadows; 0 without any."""
    good = results[entire, kernels.OK] > 0
    return float(np.median(results[entire[good], kernels.NOISE])) if good.any() else 0.0


def _take(
    results: FloatArray,
    fits: FloatArray,
    fitted: npt.NDArray[np.intp],
    whole: npt.NDArray[np.bool_],
) -> npt.NDArray[np.intp]:
    """Put fits into `results`: all of the partial shadows', the good ones of the whole.

    Returns:
        Those that were put, in the order of `fitted`.
    """
    places = [kernels.X, kernels.Y, kernels.VAR_X, kernels.COV_XY, kernels.VAR_Y, kernels.BIAS]
    good = (fits[fitted, kernels.OK] > 0) & (fits[fitted, kernels.NOISE] < MISFIT)
    part = fitted[~whole[fitted]]
    results[part] = fits[part]
    # Radius, peak and likeness stay those of the centroid: they judge the shadow.
    lone = fitted[whole[fitted] & good]
    results[np.ix_(lone, places)] = fits[np.ix_(lone, places)]
    return fitted[~whole[fitted] | good]


def _contrasts(results: FloatArray, patches: _Patches) -> FloatArray:
    """Contrast of each bead, (m,): the median over its whole shadows, else as expected, scaled as
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


@dataclass(frozen=True)
class _Sharp:
    """Blur of the images [px] and size of the beads.

    Attributes:
        blur, scale: blur and factor from expected to apparent radius with which a fit leaves least.
        seen: they were seen, not assumed.
        true: the blur with which rendered beads look the same.
        size: likewise the factor on the beads' radii.
    """

    blur: float
    scale: float
    seen: bool
    true: float
    size: float


def _seen_sharpness(
    sharp: _Sharp,
    patches: _Patches,
    sample: npt.NDArray[np.intp],
    cone: ConeVec,
    model: BeadModel,
) -> _Sharp:
    """Blur and size corrected by what the same estimate makes of rendered beads: the fit's profile
    is an approximation, and where a shadow is cut by the edge its radius decides its place."""
    if not sharp.seen or sharp.blur < BODY_BLUR_PX:
        return sharp
    k = patches.windows.corner.shape[1]
    frames, beads = np.divmod(sample, k)
    few = patches.windows.pick(frames, beads)
    balls = balls_of(model, patches.peaks[:k])
    rays = render_windows(balls, cone[frames], few, CHECK_FINE)
    seen = blurred_windows(rays, _rest(sharp.blur, CHECK_FINE))
    side = few.side
    rendered = replace(
        patches, flat=seen.reshape(-1, side, side), offsets=patches.offsets[sample],
        radii=patches.radii[sample], stretch=patches.stretch[sample], peaks=patches.peaks[sample],
        windows=few,
    )  # fmt: skip
    found = _sharpness(rendered, np.arange(len(sample)), sharp.blur)
    if not found.seen:
        return sharp
    true = 2.0 * sharp.blur - found.blur
    if not abs(true - sharp.blur) < 0.2 * sharp.blur:
        return sharp
    return replace(sharp, true=true, size=sharp.scale / found.scale)


def _sharpness(patches: _Patches, sample: npt.NDArray[np.intp], blur: float) -> _Sharp:
    """Blur and apparent size from some whole shadows, by the fit that leaves least.

    A bead that is not as made shows here too; a shadow cut by the edge has its centre where its
    radius puts it. Without whole shadows: the assumed blur, and the expected size.
    """
    if len(sample) < 3:
        return _Sharp(blur, 1.0, False, blur, 1.0)
    blurs = np.array([0.12, 0.25, 0.45, 0.7, 1.1, 1.7])
    masks = _masks(patches, sample)
    misfit, scale = np.full(len(blurs), np.inf), np.ones(len(blurs))
    for i, trial in enumerate(blurs):
        results = _fits(patches, sample, trial, True, masks)
        good = sample[results[sample, kernels.OK] > 0]
        if len(good) >= 3:
            misfit[i] = float(np.median(results[good, kernels.NOISE]))
            scale[i] = float(np.median(results[good, kernels.RADIUS] / patches.radii[good]))
        if i > 0 and misfit[i] > 1.5 * misfit[i - 1]:
            break
    i = int(np.argmin(misfit))
    if not np.isfinite(misfit[i]):
        return _Sharp(blur, 1.0, False, blur, 1.0)
    best = float(blurs[i])
    if 0 < i < len(blurs) - 1 and np.isfinite(misfit[i - 1 : i + 2]).all():
        # Misfit is a hyperbola about the right blur, so its square is a parabola.
        near = slice(i - 1, i + 2)
        a, b, _ = np.polyfit(blurs[near], np.square(misfit[near]), 2)
        if a > 0:
            best = float(np.clip(-b / (2.0 * a), blurs[i - 1], blurs[i + 1]))
    apparent = float(np.interp(best, blurs, scale))
    return _Sharp(best, apparent, True, best, apparent)


def _masks(patches: _Patches, index: npt.NDArray[np.intp]) -> npt.NDArray[np.uint8]:
    """Usable pixels of some windows: inside the image and free of other beads' shadows."""
    masks = np.isfinite(patches.flat[index]).astype(np.uint8)
    windows = patches.windows
    k = windows.corner.shape[1]
    for i, position in enumerate(index.tolist()):
        frame, bead = divmod(position, k)
        if windows.crowded[frame, bead]:
            masks[i] &= free_of_others(windows, frame, bead)
    return masks


def _accept(results: FloatArray, windows: Windows, contrast: FloatArray, sharp: _Sharp) -> Measured:
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
    covariance = np.empty((*good.shape, 2, 2))
    covariance[..., 0, 0] = results[..., kernels.VAR_X]
    covariance[..., 1, 1] = results[..., kernels.VAR_Y]
    covariance[..., 0, 1] = covariance[..., 1, 0] = results[..., kernels.COV_XY]
    return Measured(
        np.where(good[..., None], place, np.nan),
        np.where(good[..., None, None], covariance, np.nan),
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
