"""The second measurement: every bead is measured again where the first fit predicts it.

Once a rough fit exists, the position of every bead is known to a fraction of a pixel. Each one
is measured again in a window there, after subtracting the phantom's own body (bricks, cuboid),
rendered at that geometry and blurred as the images are. An edge of the body behind a bead then
no longer shifts its centroid, touching spots are separated, spots cut by the image's edge are
fitted, and no bead is missed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.detect import spot_kernels as kernels
from flexdt.twin.calibration.detect.background import (
    Background,
    backdrop,
    levelled,
    survey,
)
from flexdt.twin.calibration.detect.detection import BLUR_PX, MISFIT, covariances_of
from flexdt.twin.calibration.detect.fading import evened, fading, more_behind
from flexdt.twin.calibration.detect.patches import (
    Patches,
    centroids,
    contrasts,
    fits,
    ring_noise,
    take,
    usable,
)
from flexdt.twin.calibration.detect.seen_body import (
    BLURRED_FINE,
    NO_BODY,
    SeenBody,
    adjusted,
    see_body,
)
from flexdt.twin.calibration.detect.sharpness import (
    BLURS,
    BODY_BLUR_PX,
    CHECK_FINE,
    RADIUS_RAYS,
    SAMPLE,
    Sharp,
    balls_of,
    fine_rays,
    rendering_error,
    rest_of_blur,
    seen_sharpness,
    sharpness,
    spread,
)
from flexdt.twin.calibration.detect.smear import (
    SMEAR_SAMPLE,
    UNMEASURED,
    Smear,
    Step,
    solved,
    squared_step,
)
from flexdt.twin.calibration.detect.smeared_spots import (
    followed,
    own_pixels,
    placed,
    results_of,
)
from flexdt.twin.calibration.detect.windows import (
    Balls,
    Turning,
    Windows,
    blurred_windows,
    edged,
    exposed,
    render_windows,
    ways,
    without_beads,
)
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection.analytic_solids import Scene

MISS_PX = 4.0
"""A measurement further than this from its prediction is not that bead."""
LIKENESS = 0.9
"""Least likeness of a spot to a ball."""
SAME_SIZE = 0.2
"""Logarithm of the ratio of a spot's radius to the expected one, up to which it is as that of
the others."""
SAME_CONTRAST = math.log(1.6)
"""The same of its contrast."""
MIN_SHARE = 0.35
"""Least share of a spot in view that is still fitted."""
FIT_NOISE = 0.008
"""Noise of the line integrals above which complete spots are fitted too: a fit weighs
photons as they count, and halves the error of a centroid there (measured)."""
FIT_BLUR_PX = 0.4
"""Least blur for that: an unblurred ball sampled at pixel centers misleads a fit by 0.015
px."""
FEW_WINDOWS = 600
"""Up to so many windows a bead is rendered with `RADIUS_RAYS` along its radius."""
FEWER_RADIUS_RAYS = 12
"""Rays along a bead's radius in more windows, and in drafts."""
LARGEST_PX = 0.6
"""A larger systematic error of a rendered spot is not believed."""
NEAR_PX = 0.15
"""Largest distance of a spot from its prediction for a judgment of its background [px]."""
MAX_MISFIT = 10.0
"""Misfit of a background, relative to the others', from which a spot is left out."""
MAX_LOST_SHARE = 0.3
"""Largest share of the spots left out because of their background."""
MIN_EDGE = 0.04
"""Height of a body's edge (line integral) at a bead's rim from which its centroid is
preferred."""
SAMPLING_PX = 0.0005
"""Error that depends on a spot's place in the pixel grid and is left after the correction by
rendered spots: images of other rays a pixel, blur estimated (measured without noise)."""
SHARP_SAMPLING_PX = 0.0001
"""The same where nothing is blurred, and the rendered rays are the images' own."""


@dataclass(frozen=True, eq=False)
class Refined:
    """Bead positions of n frames, (n, k, ...), nan where a bead was not measured.

    Attributes:
        tracks: (n, k, 2) pixels.
        covariances: (n, k, 2, 2).
        bias: (n, k) sphere-centre bias factors.
        contrast: (n, k) line integral through the middle.
        size: of the beads over the stated one; nan if unknown.
        size_sigma: standard deviation of its logarithm, with blur and hardening open.
        blur_px: blur of the images, estimated from the spots or assumed.
        sampling_px: what remains of the error that depends on a spot's place in the pixel grid.
        common: (n, k, 2, c) shifts of the positions [px] by one standard deviation of each of
            c quantities that were estimated once for all frames: they do not average out.
        body: the phantom's, as seen in the images.
        as_fitted: blur and size of the best fit, which a geometry that is almost the same
            does not change; None unless from `measure_beads`.
        smear: the arc that the object turns in an exposure; positions are those of its middle.
    """

    tracks: FloatArray
    covariances: FloatArray
    bias: FloatArray
    contrast: FloatArray
    size: float
    size_sigma: float
    blur_px: float
    sampling_px: float
    common: FloatArray
    body: SeenBody = NO_BODY
    as_fitted: Sharp | None = None
    smear: Smear = UNMEASURED


def measure_beads(
    images: npt.NDArray[np.float32],
    windows: Windows,
    cone: ConeVec,
    model: BeadModel,
    contrast: float | FloatArray,
    scene: Scene | None = None,
    *,
    draft: bool = False,
    known: Sharp | None = None,
    turning: Turning | None = None,
    smear: Smear = UNMEASURED,
) -> Refined:
    """Measure every bead in its window, and from all spots blur, sizes, contrasts and arc.

    Args:
        images: (n, k, side, side) line integrals from `crop`; not changed.
        windows, cone: their places, and the geometry they were planned with.
        model, contrast: the beads, and line integrals through their middles, one or (k,).
        scene: solids to subtract, but beads; None: only planes are.
        draft: leave out the correction by rendered beads.
        known: blur and size that an earlier measurement found (`as_fitted`); None: estimated.
        turning: geometry within an exposure, whose arc is looked for unless `smear` has it;
            None: the object is at rest.
        smear: the arc that an earlier measurement found.

    Returns:
        Positions with covariances, nan where `_accept` refuses a spot; blur, size, body, arc.
    """
    if turning is not None and draft:
        windows = exposed(windows, model, turning, smear.share)
    start = _Start.of(images, windows, cone, model, contrast, scene)
    known = start.blur(known, smear.told)
    if turning is not None and smear.told and not draft:
        return _with_arc(start, known, turning, smear)
    return _looking_for_arc(start, known, turning, smear, draft)


@dataclass(frozen=True, eq=False)
class _Start:
    """The windows of a measurement, before it is known how the spots are blurred.

    Attributes:
        images: (n, k, side, side) line integrals.
        windows: their places.
        cone: geometry the windows were planned with.
        model: the beads.
        described: the body's solids.
        seen: the body in the images.
        body: its line integrals; None where none is described or seen.
        patches: the windows less the body, with the contrasts of their spots.
        sample: some of the complete spots.
        first: their centroids, (n k, RESULTS).
    """

    images: Float32Array
    windows: Windows
    cone: ConeVec
    model: BeadModel
    described: Scene
    seen: SeenBody
    body: Float32Array | None
    patches: Patches
    sample: npt.NDArray[np.intp]
    first: FloatArray

    @classmethod
    def of(
        cls,
        images: Float32Array,
        windows: Windows,
        cone: ConeVec,
        model: BeadModel,
        contrast: float | FloatArray,
        scene: Scene | None,
    ) -> _Start:
        """Subtract the body, and measure some complete spots; arguments as of
        `measure_beads`.
        """
        described = Scene(()) if scene is None else without_beads(scene, model)
        seen, body = _body(images, described, cone, model, windows)
        data = images if body is None else images - body
        patches = _patches(data, windows, contrast)
        sample = patches.entire[:: max(1, len(patches.entire) // SAMPLE)]
        first = centroids(patches, sample)
        patches = replace(patches, peaks=contrasts(first, patches))
        return cls(
            images, windows, cone, model, described, seen, body, patches, sample, first
        )

    def blur(self, known: Sharp | None, told: bool) -> Sharp:
        """Return blur and size as they are known, or estimate them; where the arc of an
        exposure is told, what is known need not have been seen.
        """
        if known is None or not (known.seen or told):
            return sharpness(self.patches, self.sample, BLUR_PX)
        return known


@dataclass(frozen=True, eq=False)
class _Drawn:
    """Rendered beads beside the images.

    Attributes:
        alone: beads rendered alone, (n, k, side, side); None in a draft of sharp images.
        patches: the windows, less the body behind such beads.
        seen: the body.
        rough: error of rendering with finite rays [px].
    """

    alone: Float32Array | None
    patches: Patches
    seen: SeenBody
    rough: float

    def finished(self, measured: Refined, known: Sharp, smear: Smear) -> Refined:
        """Add the error of rendering, and what is known of body, blur and arc."""
        return replace(
            measured,
            body=self.seen,
            as_fitted=known,
            smear=smear,
            covariances=measured.covariances + self.rough**2 * np.eye(2),
        )


def _looking_for_arc(
    start: _Start, known: Sharp, turning: Turning | None, smear: Smear, draft: bool
) -> Refined:
    """Measure spots whose arc is not told, and look for it where the object may turn; with
    one that is found, they are measured anew.

    A draft renders plain balls, and takes the arc as it is.
    """
    sharp = known
    if draft:
        k = start.windows.corner.shape[1]
        plain = balls_of(start.model, sharp.lift * start.patches.peaks[:k], sharp.size)
        balls: Balls = ((plain, None),)
    else:
        sharp, balls = seen_sharpness(
            sharp, start.patches, start.sample, start.cone, start.model
        )
    drawn = _drawn(start, start.patches, sharp, balls, draft)
    if turning is not None and drawn.alone is not None:
        if smear.told:
            way = smear.share * ways(start.windows, start.model, turning)
            measured = _measured_smeared(
                drawn.patches, drawn.alone, start.body, sharp, way
            )
            return drawn.finished(measured, known, smear)
        smear = _smeared(
            drawn.patches, drawn.alone, sharp, balls, start.cone, start.model, turning
        )
        if smear.told:
            return _with_arc(start, known, turning, smear)
    measured = _measured(drawn.patches, None if draft else drawn.alone, start.body, sharp)
    return drawn.finished(measured, known, smear)


def _with_arc(start: _Start, known: Sharp, turning: Turning, smear: Smear) -> Refined:
    """Measure spots that are smeared by an arc, by rendered ones that are smeared as much.

    If the spots do not tell the arc after all, they are measured as those of an object at
    rest, and the result says so.
    """
    # The profile of a round blur tells neither blur nor size of smeared spots.
    sharp = replace(known, scale=1.0, size=1.0, seen=False)
    smear, balls = followed(start.patches, sharp, start.cone, start.model, turning, smear)
    if not smear.told:
        known = start.blur(known, told=False)
        return replace(
            _looking_for_arc(start, known, None, UNMEASURED, draft=False), smear=smear
        )
    windows = exposed(start.windows, start.model, turning, smear.share)
    sharp = replace(sharp, true=smear.blur)
    peaks = np.tile(np.array(smear.contrast), len(windows.corner))
    patches = replace(start.patches, windows=windows, peaks=peaks)
    drawn = _drawn(start, patches, sharp, balls, draft=False)
    assert drawn.alone is not None
    way = smear.share * ways(windows, start.model, turning)
    measured = _measured_smeared(drawn.patches, drawn.alone, start.body, sharp, way)
    return drawn.finished(measured, known, smear)


def _drawn(
    start: _Start, patches: Patches, sharp: Sharp, balls: Balls, draft: bool
) -> _Drawn:
    """Render the beads as blurred as in the images, and with them the body behind them.

    Args:
        start: the images.
        patches: their windows, as they are exposed.
        sharp: blur and size.
        balls: that are rendered.
        draft: with fewer rays, the body as it is seen, and nothing for sharp images.
    """
    windows = patches.windows
    if sharp.blur < BODY_BLUR_PX:
        if draft:
            return _Drawn(None, patches, start.seen, 0.0)
        rays = render_windows(Scene(()), start.cone, windows, 1, balls)
        return _Drawn(blurred_windows(rays, sharp.true), patches, start.seen, 0.0)
    # A blurred image comes from pixels that integrate, so an edge must not be put where the
    # nearest ray is.
    if windows.whole.size <= FEW_WINDOWS and not draft:
        fine = fine_rays(windows, RADIUS_RAYS, CHECK_FINE)
    else:
        fine = fine_rays(windows, FEWER_RADIUS_RAYS, 2)
    rest = rest_of_blur(sharp.true, fine)
    beads = render_windows(Scene(()), start.cone, windows, fine, balls)
    alone = blurred_windows(beads, rest)
    rough = 0.0
    # Fewer rays than the images' place a rim by where the lattice lies.
    if not draft and len(start.sample):
        noise = ring_noise(start.first, start.sample)
        rough = rendering_error(
            sharp, balls, patches, start.sample, start.cone, alone, fine, noise
        )
    if start.body is None:
        return _Drawn(alone, patches, start.seen, rough)
    seen, behind = _behind(
        start.images, alone, start.described, start.cone, start.model, windows, fine, rest,
        balls, None if draft else rest_of_blur(sharp.true, BLURRED_FINE), start.seen,
    )  # fmt: skip
    flat = (start.images - behind).reshape(patches.flat.shape)
    return _Drawn(alone, replace(patches, flat=flat), seen, rough)


def _behind(
    images: Float32Array,
    alone: Float32Array,
    described: Scene,
    cone: ConeVec,
    model: BeadModel,
    windows: Windows,
    fine: int,
    rest: float,
    balls: Balls,
    left: float | None,
    seen: SeenBody,
) -> tuple[SeenBody, Float32Array]:
    """Render what the body adds to the line integrals (n, k, side, side).

    Blur acts on intensities, where body and bead multiply: it depends on the bead in
    front. `alone`: the beads, rendered with `fine`, `rest`, `balls`. `left`: blur besides
    `BLURRED_FINE` rays', with which the body is estimated again; None: `seen` is kept.
    """
    if left is not None:
        seen = see_body(images, described, cone, model, windows, left, seen)
    both = render_windows(seen.scene(described), cone, windows, fine, balls)
    behind = blurred_windows(both, rest) - alone
    if left is None:
        return seen, behind
    return adjusted(images, behind, cone, model, windows, seen)


def _body(
    images: Float32Array,
    described: Scene,
    cone: ConeVec,
    model: BeadModel,
    windows: Windows,
) -> tuple[SeenBody, Float32Array | None]:
    """Estimate the phantom's body in line integrals (n, k, side, side), and render it.

    `described`: its solids. Returns also None where none is described or seen.
    """
    if not described.solids:
        return NO_BODY, None
    seen = see_body(images, described, cone, model, windows)
    if not seen.factor > 0:
        return seen, None
    return seen, render_windows(seen.scene(described), cone, windows)


def _patches(
    data: Float32Array, windows: Windows, contrast: float | FloatArray
) -> Patches:
    """Put windows into the form of the kernels, with the spots whose middle has a value.

    Args:
        data: (n, k, side, side) line integrals, less the body.
        windows: their places.
        contrast: of a bead, one or (k,).
    """
    n, k = windows.corner.shape[:2]
    side = windows.side
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
    return replace(patches, entire=patches.entire[there])


def _smeared(
    patches: Patches,
    alone: Float32Array,
    sharp: Sharp,
    balls: Balls,
    cone: ConeVec,
    model: BeadModel,
    turning: Turning,
) -> Smear:
    """Estimate the arc that the object turns in an exposure from `SMEAR_SAMPLE` complete spots.

    Where it is more likely than an object at rest, the spots are rendered with it, until
    they are as smeared as in the images (`solved`).

    Args:
        patches: the windows, less the body.
        alone: beads at rest rendered alone, (n, k, side, side) or (n k, side, side).
        sharp, balls: with which they are.
        cone: geometry of the frames.
        model: the beads.
        turning: geometry within an exposure.

    Returns:
        The arc; `UNMEASURED` where the spots do not determine it.
    """
    windows = patches.windows
    sample = spread(patches.entire, SMEAR_SAMPLE)
    frames, beads = np.divmod(sample, windows.corner.shape[1])
    few = windows.pick(frames, beads)
    way = ways(windows, model, turning)[frames, beads]
    seen = patches.flat[sample]

    variance = sharp.true**2

    def step_at(square: float) -> Step:
        """Render the spots with an arc, and compare; the blur follows."""
        nonlocal variance
        now = exposed(windows, model, turning, math.sqrt(square)).pick(frames, beads)
        fine = 1 if sharp.blur < BODY_BLUR_PX else fine_rays(now, RADIUS_RAYS, CHECK_FINE)
        rays = render_windows(Scene(()), cone[frames], now, fine, balls)
        blur = math.sqrt(variance)
        drawn = blurred_windows(rays, blur if fine == 1 else rest_of_blur(blur, fine))
        step = squared_step(seen, drawn[:, 0], now, way, math.sqrt(square))
        variance = max(variance + step.variance, BLURS[0] ** 2)
        return step

    drawn = alone.reshape(patches.flat.shape)[sample]
    first = squared_step(seen, drawn, few, way, 0.0)
    found = solved(0.0, first, step_at)
    return replace(found, blur=math.sqrt(variance)) if found.told else found


def _measured(
    patches: Patches, alone: Float32Array | None, body: Float32Array | None, sharp: Sharp
) -> Refined:
    """Measure centroids and fits, corrected by the same measurement of rendered beads.

    The rendered spots contain the effects of pixels and blur on a ball, its neighbors,
    and the displacement of a ball's spot from the projection of its center; corrections
    of `LARGEST_PX` or more are not applied. Bent backgrounds, fading and the slope behind
    spots that are not complete are removed first. Complete spots are fitted too where the
    noise exceeds `FIT_NOISE` and the blur
    `FIT_BLUR_PX`, unless an edge of the body crosses them.

    Args:
        patches: the windows.
        alone: beads rendered alone without noise, (m, side, side) or (n, k, side, side);
            None: no correction, and backgrounds are not judged.
        body: line integrals of the body, or None.
        sharp: blur and apparent size.
    """
    windows = patches.windows
    n, k = windows.corner.shape[:2]
    behind: Background | None = None
    if alone is not None:
        alone = alone.reshape(patches.flat.shape)
        behind = survey(patches.flat, alone)
        if behind.bend is not None:
            patches = replace(patches, flat=patches.flat - behind.bend)
        found = centroids(patches, patches.entire)
        patches, fainter = _evened(patches, behind, body, alone, found)
        # A fit of a spot that is cut or touched knows a level alone.
        partial = ~windows.whole.ravel()
        patches = replace(patches, flat=levelled(patches.flat, behind.slope, partial))
    results = centroids(patches, patches.entire)
    patches = replace(
        patches, peaks=contrasts(results, patches), radii=patches.radii * sharp.scale
    )
    fitted = np.flatnonzero((windows.share > MIN_SHARE) & ~windows.whole)
    if ring_noise(results, patches.entire) > FIT_NOISE and sharp.blur >= FIT_BLUR_PX:
        # Start where the centroid is; it stays where the fit fails, and where an edge of the
        # body touches the rim, which a fit relies on.
        good = patches.entire[results[patches.entire, kernels.OK] > 0]
        if body is not None:
            good = good[~edged(body, windows, MIN_EDGE).ravel()[good]]
        fitted = np.concatenate([fitted, good])
    start = patches.offsets.copy()
    begun = fitted[results[fitted, kernels.OK] > 0]
    start[begun] = results[begun][:, [kernels.X, kernels.Y]]
    masks = usable(patches, fitted)
    blur = sharp.blur, sharp.veil
    fitting = fits(replace(patches, offsets=start), fitted, blur, False, masks)
    taken = take(results, fitting, fitted, windows.whole.ravel())
    common = np.zeros((n * k, 2, 1))
    if alone is not None:
        model = replace(patches, flat=alone)
        expected = centroids(model, patches.entire, results[:, kernels.NOISE])
        taken = taken[results[taken, kernels.OK] > 0]
        expected[taken] = fits(model, taken, blur, False, masks[np.isin(fitted, taken)])[
            taken
        ]
        sure = (results[:, kernels.OK] > 0) & (expected[:, kernels.OK] > 0)
        error = expected[:, [kernels.X, kernels.Y]] - patches.offsets
        sure &= np.hypot(error[:, 0], error[:, 1]) < LARGEST_PX
        results[sure, kernels.X] -= error[sure, 0]
        results[sure, kernels.Y] -= error[sure, 1]
        results[sure, kernels.BIAS] = 0.0
        shifted = replace(model, flat=alone + fainter)
        lone = np.setdiff1d(np.flatnonzero(sure), taken)
        changed = centroids(shifted, lone, results[:, kernels.NOISE])
        taken = taken[sure[taken]]
        # A fit begins where it ends without the change.
        shifted = replace(shifted, offsets=expected[:, [kernels.X, kernels.Y]].copy())
        fitting = fits(shifted, taken, blur, False, masks[np.isin(fitted, taken)])
        changed[taken] = fitting[taken]
        sure &= changed[:, kernels.OK] > 0
        common[sure, :, 0] = (changed - expected)[sure][:, [kernels.X, kernels.Y]]
    if behind is not None:
        _discount(results, behind, patches.offsets)
    accepted = _accept(
        results.reshape(n, k, -1), windows, patches.peaks.reshape(n, k), sharp
    )
    return replace(accepted, common=common.reshape(n, k, 2, -1))


def _measured_smeared(
    patches: Patches,
    alone: Float32Array,
    body: Float32Array | None,
    sharp: Sharp,
    way: FloatArray,
) -> Refined:
    """Measure smeared spots by rendered ones, once their backgrounds are removed.

    Args:
        patches: the windows.
        alone: beads rendered alone, (n, k, side, side), as smeared as in the images.
        body: line integrals of the body, or None.
        sharp: blur and size.
        way: (n, k, 2) of each bead's image in an exposure [px].
    """
    windows = patches.windows
    n, k = windows.corner.shape[:2]
    alone = alone.reshape(patches.flat.shape)
    index = np.flatnonzero(windows.share > MIN_SHARE)
    masks = own_pixels(windows, way, index)
    behind = survey(patches.flat, alone)
    plane = backdrop(replace(behind, bend=None), windows.side)
    if behind.bend is not None:
        patches = replace(patches, flat=patches.flat - behind.bend)
    found = placed(patches.flat - plane, alone, masks, index)
    results = results_of(found, patches)
    evened, fainter = _evened(patches, behind, body, alone, results)
    if evened is not patches:
        found = placed(evened.flat - plane, alone, masks, index)
        results = results_of(found, patches)
    changed = placed(alone + fainter, alone, masks, index)
    common = np.nan_to_num(changed.shift).reshape(n, k, 2, 1)
    _discount(results, behind, patches.offsets)
    results = results.reshape(n, k, -1)
    lone = replace(windows, whole=np.zeros_like(windows.whole))
    return replace(
        _accept(results, lone, patches.peaks.reshape(n, k), sharp), common=common
    )


def _evened(
    patches: Patches,
    behind: Background,
    body: Float32Array | None,
    alone: Float32Array,
    found: FloatArray,
) -> tuple[Patches, Float32Array]:
    """Return the windows with uniform contrast of each bead, by the fading found in them.

    Args:
        patches: the windows.
        behind: backgrounds.
        body: line integrals of the body, or None.
        alone: the beads alone, (m, side, side).
        found: (m, RESULTS) of the complete spots.

    Returns:
        The windows, the same if no fading is found; and the change of their line integrals by
        one standard deviation of the fading.
    """
    seen = np.zeros(len(found), np.bool_)
    seen[patches.entire] = found[patches.entire, kernels.OK] > 0
    level = behind.plane[:, 0]
    thick = body
    if body is not None:
        thick = np.asarray(body.reshape(-1, *patches.flat.shape[1:]))
        level = level + thick[:, thick.shape[1] // 2, thick.shape[1] // 2]
    shape = patches.windows.whole.shape
    peaks = found[:, kernels.PEAK].reshape(shape)
    found_slope = fading(peaks, level.reshape(shape), seen.reshape(shape))
    more = more_behind(behind.plane, thick, patches.flat.shape[1])
    fainter = np.asarray(np.float32(found_slope.sigma) * more * alone)
    if found_slope.slope != 0.0:
        flat = evened(patches.flat, behind.plane, thick, found_slope.slope)
        patches = replace(patches, flat=flat)
    return patches, fainter


def _discount(results: FloatArray, behind: Background, expected: FloatArray) -> None:
    """Multiply the variance of spots with a foreign background by its misfit, and drop those
    above `MAX_MISFIT`, unless these are more than `MAX_LOST_SHARE`.

    Spots `NEAR_PX` or more from their expected place are not judged: their own rim looks
    foreign.

    `results`: (m, RESULTS), changed in place; `behind`: backgrounds; `expected`: (m, 2) places
    in the windows.
    """
    there = results[:, kernels.OK] > 0
    off = results[:, [kernels.X, kernels.Y]] - expected
    there &= np.hypot(off[:, 0], off[:, 1]) < NEAR_PX
    bad = there & behind.disturbed
    for place in (kernels.VAR_X, kernels.COV_XY, kernels.VAR_Y):
        results[bad, place] *= behind.misfit[bad]
    worst = bad & (behind.misfit > MAX_MISFIT)
    if worst.sum() <= MAX_LOST_SHARE * max(int(there.sum()), 1):
        results[worst, kernels.OK] = 0.0


def _accept(
    results: FloatArray, windows: Windows, contrast: FloatArray, sharp: Sharp
) -> Refined:
    """Keep the results that pass the checks; others are nan (bias 0).

    All must be within `MISS_PX` of their prediction. Complete spots need likeness, and radius
    and contrast as the others have them (`judge_size` judges the beads' size); cut ones a misfit
    below `MISFIT`.

    Args:
        results: (n, k, RESULTS).
        windows: their places and expected spots.
        contrast: (n, k) expected.
        sharp: blur and apparent size.
    """
    whole = windows.whole
    place = results[..., [kernels.X, kernels.Y]] + windows.corner
    off = np.linalg.norm(place - windows.predicted, axis=2)
    peak = results[..., kernels.PEAK]
    good = (results[..., kernels.OK] > 0) & (off < MISS_PX)
    alike = results[..., kernels.SCORE] > LIKENESS
    wide = np.log(np.maximum(results[..., kernels.RADIUS], 1e-9) / windows.radii)
    some = wide[good & whole & alike]
    usual = float(np.median(some)) if some.size else 0.0
    faint = np.log(np.maximum(peak, 1e-9) / contrast)
    good &= np.where(
        whole,
        alike & (np.abs(wide - usual) < SAME_SIZE) & (np.abs(faint) < SAME_CONTRAST),
        results[..., kernels.MISFIT] < MISFIT,
    )
    return Refined(
        np.where(good[..., None], place, np.nan),
        np.where(good[..., None, None], covariances_of(results), np.nan),
        np.where(good, results[..., kernels.BIAS], 0.0),
        np.where(good, peak, np.nan),
        sharp.size if math.isfinite(sharp.sigma) else math.nan,
        sharp.sigma,
        sharp.true,
        SHARP_SAMPLING_PX if sharp.blur < BODY_BLUR_PX else SAMPLING_PX,
        np.zeros((*good.shape, 2, 0)),
    )
