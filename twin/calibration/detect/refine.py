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
from typing import Any

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.detect import spot_kernels as kernels
from flexdt.twin.calibration.detect.background import Background, evened, fading, survey
from flexdt.twin.calibration.detect.detection import BLUR_PX, MISFIT, covariances_of
from flexdt.twin.calibration.detect.patches import (
    Patches,
    centroids,
    contrasts,
    fits,
    ring_noise,
    take,
    usable,
)
from flexdt.twin.calibration.detect.windows import (
    Windows,
    blurred_windows,
    edged,
    render_windows,
    without_beads,
)
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection.analytic_solids import ConvexPolyhedron, Scene, Shape, Solid, Sphere

# The phantom's body as the images have it: how much it attenuates, and where it stands.
#
# A body is printed or glued together, and its description says neither its attenuation in this beam
# nor to a hundredth of a millimetre where it stands round the beads. Both are estimated from the
# surroundings of some beads, by least squares with rendered bodies, before the body is subtracted.

SAMPLE = 24
"""Windows that are looked at."""
LEAST = 0.3
"""Attenuation of a seen body over the described one below which the body is not this one: one that
is absent, turned or elsewhere has 0.01 to 0.03, one of half the attenuation 0.5."""
PRIOR_MM = 0.5
"""How far a body may stand from its description; holds a direction that no edge shows."""
FAR_MM = 2.0
"""A body found further away than that is another body."""
ROUNDS = 4
STILL_MM = 0.01
"""A step of the shift after which no further one is taken; what it leaves is of second order."""


@dataclass(frozen=True)
class SeenBody:
    """A body as the images have it.

    Attributes:
        factor: attenuation over the described one; 0 where the images do not show the body, nan
            where none is described.
        shift_mm: where it stands from where it is described, in the phantom's frame.
    """

    factor: float
    shift_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def scene(self, described: Scene) -> Scene:
        """The body's solids as they are seen."""
        return Scene(
            tuple(
                Solid(_shifted(s.shape, self.shift_mm), s.material, self.factor * s.mu_per_mm)
                for s in described.solids
            )
        )


NO_BODY = SeenBody(math.nan)
"""None is described."""


def see_body(
    images: npt.NDArray[np.float32],
    described: Scene,
    cone: ConeVec,
    model: BeadModel,
    windows: Windows,
    blur: float = 0.0,
) -> SeenBody:
    """Find the body in the rings round the beads.

    A body that is moved a little moves in each window as its bead would: the slope of the rendered
    body along rows and columns, times that shift of the bead, is what the images have more.

    Args:
        images: (n, k, side, side) line integrals.
        described: the body's solids.
        cone: geometry of the n frames.
        model: the k beads.
        windows: where the images were cut out.
        blur: of the images [px].

    Returns:
        The body; the described one if no ring has anything of it.
    """
    frames, beads = np.nonzero(~windows.crowded)
    some = np.linspace(0, len(frames) - 1, min(SAMPLE, len(frames))).astype(np.intp)
    frames, beads = frames[some], beads[some]
    if len(frames) == 0:
        return SeenBody(1.0)
    few, near = windows.pick(frames, beads), cone[frames]
    ring = _rings(few) & np.isfinite(images[frames, beads])
    seen = _levelled(images[frames, beads], ring)
    dof = np.maximum(ring.sum(axis=(1, 2)), 1)
    along = _shift_of_beads(near, model, beads, windows.shape)
    body, shift = SeenBody(1.0), np.zeros(3)
    for turn in range(ROUNDS):
        moved = SeenBody(1.0, body.shift_mm).scene(described)
        image = render_windows(moved, near, few)
        image = (blurred_windows(image, blur) if blur > 0 else image)[:, 0]
        here = _levelled(np.asarray(image), ring)
        if turn == 0:
            power, push = np.einsum("mp,mp->m", here, here), np.einsum("mp,mp->m", here, seen)
            telling = power > 1e-6 * dof
            if not telling.any():
                return SeenBody(1.0)
            # One foreign object in a ring must not decide, so the median over the windows is taken.
            factor = _middle(push[telling] / power[telling], power[telling])
            if factor < LEAST:
                return SeenBody(0.0)
        down, right = (np.asarray(slope) for slope in np.gradient(image, axis=(1, 2)))
        slopes = -np.stack([_levelled(right, ring), _levelled(down, ring)], axis=-1)
        design = np.concatenate([here[..., None], slopes @ along], axis=2)
        rest = ((seen - factor * here) ** 2).sum(axis=1) / dof
        typical = max(float(np.median(rest)), 1e-8)
        weight = np.minimum(1.0, 2.0 * typical / np.maximum(rest, 1e-12))
        normal = np.einsum("m,mpi,mpj->ij", weight, design, design)
        hold = typical / (factor * PRIOR_MM) ** 2 + 1e-12
        normal[1:, 1:] += hold * np.eye(3)
        pull = np.einsum("m,mpi,mp->i", weight, design, seen)
        pull[1:] -= hold * factor * shift
        found = np.linalg.solve(normal, pull)
        factor, step = float(found[0]), found[1:] / float(found[0])
        shift = shift + step
        if factor < LEAST or float(np.linalg.norm(shift)) > FAR_MM:
            return SeenBody(0.0)
        body = SeenBody(factor, (float(shift[0]), float(shift[1]), float(shift[2])))
        if float(np.linalg.norm(step)) < STILL_MM:
            break
    return body


def _shift_of_beads(
    cone: ConeVec, model: BeadModel, beads: npt.NDArray[np.intp], shape: tuple[int, int]
) -> FloatArray:
    """How the spot of a bead moves with the bead: (m, 2, 3) pixels (column, row) a millimetre."""
    one = np.arange(len(beads))
    there = cone.project_points(model.beads, shape)[one, beads]
    moved = [cone.project_points(model.beads + e, shape)[one, beads] for e in np.eye(3)]
    return np.stack([each - there for each in moved], axis=-1)


def _rings(windows: Windows) -> npt.NDArray[np.bool_]:
    """Pixels round the beads that no bead touches, (m, side, side)."""
    i = np.arange(windows.side)
    x, y = np.moveaxis((windows.predicted - windows.corner)[:, 0], -1, 0)[..., None, None]
    d2 = (i[None, None, :] - x) ** 2 + (i[None, :, None] - y) ** 2
    radii = windows.radii[:, 0, None, None]
    return np.asarray((d2 > (1.15 * radii + 2.0) ** 2) & (d2 < (1.6 * radii + 4.0) ** 2))


def _levelled(values: npt.NDArray[Any], ring: npt.NDArray[np.bool_]) -> FloatArray:
    """The values in each ring less their mean, 0 elsewhere, (m, side * side)."""
    inside = np.where(ring, values, 0.0).astype(np.float64)
    mean = inside.sum(axis=(1, 2)) / np.maximum(ring.sum(axis=(1, 2)), 1)
    return np.asarray(np.where(ring, inside - mean[:, None, None], 0.0).reshape(len(ring), -1))


def _middle(values: FloatArray, weights: FloatArray) -> float:
    """Weighted median."""
    order = np.argsort(values)
    heap = np.cumsum(weights[order])
    return float(values[order][int(np.searchsorted(heap, 0.5 * heap[-1]))])


def _shifted(shape: Shape, shift: tuple[float, float, float]) -> Shape:
    if isinstance(shape, ConvexPolyhedron):
        offsets = np.asarray(shape.offsets) + np.asarray(shape.normals) @ np.asarray(shift)
        return replace(shape, offsets=tuple(offsets.tolist()))
    x, y, z = (math.fsum(pair) for pair in zip(shape.center, shift, strict=True))
    return replace(shape, center=(x, y, z))


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
    sharp: Sharp,
    patches: Patches,
    sample: npt.NDArray[np.intp],
    cone: ConeVec,
    model: BeadModel,
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


def sharpness(patches: Patches, sample: npt.NDArray[np.intp], blur: float) -> Sharp:
    """Blur, veil and apparent size from some whole spots, by the fit that leaves least.

    A bead that is not as made shows here too; a spot cut by the edge has its centre where its
    radius puts it. Without whole spots: the assumed blur, and the expected size.
    """
    if len(sample) < 3:
        return Sharp(blur, 1.0, 0.0, False, blur, 1.0)
    masks, blurs = usable(patches, sample), np.array(BLURS)
    found = [_Blurs.tried(patches, sample, VEILS[0], masks, blurs)]
    if not math.isfinite(found[0].least):
        return Sharp(blur, 1.0, 0.0, False, blur, 1.0)
    # A veil changes the blur that fits by little, so its neighbours are tried.
    for trial in VEILS[1:]:
        found.append(_Blurs.tried(patches, sample, trial, masks, found[-1].near(blurs)))
        if not found[-1].least < found[-2].least:
            break
    misfit = np.array([one.least for one in found])
    veil, last = _lowest(np.array(VEILS[: len(found)]), misfit), found[int(misfit.argmin())]
    if veil > 0.0:
        last = _Blurs.tried(patches, sample, veil, masks, last.near(blurs))
    best = _lowest(last.blurs, last.misfit)
    apparent = float(np.interp(best, last.blurs, last.scale))
    return Sharp(best, apparent, veil, True, best, apparent)


@dataclass(frozen=True, eq=False)
class _Blurs:
    """Blurs that were tried with one veil, the misfits of the fits and the sizes they found."""

    blurs: FloatArray
    misfit: FloatArray
    scale: FloatArray

    @classmethod
    def tried(
        cls, patches: Patches, sample: npt.NDArray[np.intp], veil: float,
        masks: npt.NDArray[np.uint8], blurs: FloatArray,
    ) -> _Blurs:  # fmt: skip
        """From the least on, until they leave much more than the one before."""
        misfit, scale = np.full(len(blurs), np.inf), np.ones(len(blurs))
        for i, trial in enumerate(blurs.tolist()):
            results = fits(patches, sample, (trial, veil), True, masks)
            good = sample[results[sample, kernels.OK] > 0]
            if len(good) >= 3:
                misfit[i] = float(np.median(results[good, kernels.NOISE]))
                scale[i] = float(np.median(results[good, kernels.RADIUS] / patches.radii[good]))
            if i > 0 and misfit[i] > 1.5 * misfit[i - 1]:
                break
        return cls(blurs, misfit, scale)

    @property
    def least(self) -> float:
        return float(self.misfit.min())

    def near(self, blurs: FloatArray) -> FloatArray:
        """Those of `blurs` next to the one that leaves least."""
        i = int(np.searchsorted(blurs, self.blurs[int(self.misfit.argmin())]))
        return blurs[max(i - 1, 0) : i + 2]


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
    patches: Patches,
    alone: Float32Array | None,
    body: Float32Array | None,
    sharp: Sharp,
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
