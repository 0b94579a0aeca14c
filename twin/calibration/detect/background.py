"""What lies behind the beads besides their own phantom: curved backgrounds and foreign objects.

Subtracting a plane fitted to the ring around a spot removes a straight gradient. A curved one (a
bad flat field, scatter) or an edge (something that is not in the model) shifts every centroid by
less than the eye can see and by more than the reported uncertainty allows. Both show in the ring,
averaged over blocks of pixels; pixels under the bead itself are not used.

A gradient has a second effect that no plane removes. Scattered light and a beam of several energies
make a bead fainter where more lies behind it, so the side of a spot behind which there is less
counts for more, and all centroids are off in the direction in which the body becomes thinner.
`fading` reads from the beads themselves how their contrast falls, and `evened` undoes it.

Two more things are in the windows that are no bead. The phantom's own body is printed or glued
together, and its description says neither its attenuation in this beam nor to a hundredth of a
millimetre where it stands round the beads: `see_body` estimates both from the surroundings of some
beads, by least squares with rendered bodies, before the body is subtracted. And a camera with lag
shows a bead once more, faintly, where it stood one frame ago. Where it will stand in the next frame
there is nothing yet: what both places show in common (the body, the panel) is no lag.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.detect.windows import (
    Windows,
    blurred_windows,
    distances2,
    pixel_noise,
    render_windows,
)
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection.analytic_solids import ConvexPolyhedron, Scene, Shape, Solid

if TYPE_CHECKING:
    from flexdt.twin.calibration.frame_source import Frames

BLOCK: int = 5
"""Pixels along a block's side; noise averages out over them, edges do not."""
SHADOW = 0.3
"""Line integral of a bead above which a block is left out."""
BENT = 40.0
"""Chi-square that the seven bent terms must explain in the median window (white noise: 6.3)."""
OUTLIER = 4.5
"""Contrasts that are off by so many times what half of them are (three standard deviations) are not
those of that bead."""
MEANS = 10
"""Rounds in which the means of frames and beads are taken off in turns; few are missing."""
FAR_OUT = 7.0
"""Standard deviations of a window's misfit above the median one from which it is disturbed."""


@dataclass(frozen=True, eq=False)
class Background:
    """What was found behind m windows.

    Attributes:
        misfit: (m,) mean square of what a smooth background leaves, by the median window's; 1 where
            it cannot be judged.
        disturbed: (m,) the misfit is further from the others' than noise makes it.
        bend: (m, side, side) what to subtract besides a plane, or None where it is straight.
        plane: (m, 3) line integral behind the middle of each window and its change by a pixel to
            the right and down.
    """

    misfit: FloatArray
    disturbed: npt.NDArray[np.bool_]
    bend: Float32Array | None
    plane: FloatArray


def survey(flat: Float32Array, alone: Float32Array) -> Background:
    """Judge windows (m, side, side) of line integrals, given the beads alone rendered there.

    Pixels outside the image are nan.
    """
    m, side = flat.shape[0], flat.shape[1]
    count = side // BLOCK
    edge = (side - count * BLOCK) // 2
    seen, beads = (_blocks(a, edge, count) for a in (flat, alone))
    off = seen - beads
    valid = np.isfinite(off) & (beads < SHADOW)
    off[~valid] = 0.0
    shapes = _shapes((np.arange(count) + 0.5) * BLOCK + edge - 0.5, side)
    enough = valid.sum(axis=1) >= 24
    straight, plane = _fitted(off, valid, shapes[:, :3], enough)
    curved, coefficients = _fitted(off, valid, shapes, enough)
    variance = pixel_noise(flat, edge, count * BLOCK) ** 2 / BLOCK**2
    gain = (straight - curved) / np.maximum(variance, 1e-12)
    bent = bool(enough.any()) and _bends(gain[enough], curved[enough], variance[enough], valid)
    free = valid.sum(axis=1) - (shapes.shape[1] if bent else 3)
    misfit = (curved if bent else straight) / np.maximum(free, 1) / np.maximum(variance, 1e-12)
    typical = max(float(np.median(misfit[enough])), 1.0) if enough.any() else 1.0
    ratio = np.where(enough, np.maximum(misfit / typical, 1.0), 1.0)
    limit = 1.0 + FAR_OUT * np.sqrt(2.0 / np.maximum(free, 1))
    bend: Float32Array | None = None
    if bent:
        fine = _shapes(np.arange(side, dtype=np.float64), side)
        coefficients[:, :3] = 0.0
        bend = (coefficients @ fine.T).astype(np.float32).reshape(m, side, side)
    plane = plane / np.array([1.0, side / 2, side / 2])
    return Background(ratio, enough & (ratio > limit), bend, plane)


def fading(contrast: FloatArray, behind: FloatArray, seen: npt.NDArray[np.bool_]) -> float:
    """How contrast changes with the line integral behind a bead, as a share of it.

    Each bead is compared with itself in other frames, and each frame's mean is taken off, so beads
    of several sizes and a beam that drifts say nothing. What noise may have made of it is taken off
    (James and Stein), so that of no slope nothing is left. Contrast C falls by at most as much as
    what lies behind grows, if a ball lets nothing but scattered light through; where scattered
    light is not even it grows with the line integral, by exp(C) - 1 times as much. What is beyond
    these is an error of the level, which is in the contrast as well.

    Args:
        contrast: of each bead in each frame, (n, k).
        behind: line integrals behind their middles, (n, k).
        seen: which of them are measured, (n, k).
    """
    logarithm = np.log(np.where(seen, contrast, 1.0))
    use = seen
    for _ in range(3):
        change, more = (_against_own_means(a, use) for a in (logarithm, behind))
        free = int(use.sum()) - int(use.any(axis=0).sum()) - int(use.any(axis=1).sum())
        power = float(np.square(more).sum())
        if free < 1 or power <= 0.0:
            return 0.0
        slope = float((change * more).sum()) / power
        left = np.abs(_against_own_means(logarithm - slope * behind, seen))
        use = seen & (left <= OUTLIER * float(np.median(left[seen])))
    variance = max(float(np.square(change).sum()) - slope**2 * power, 0.0) / free / power
    slope *= max(1.0 - variance / max(slope**2, 1e-30), 0.0)
    usual = float(np.median(contrast[use]))
    return min(max(slope, -1.0 / usual), math.expm1(usual) / usual)


def _against_own_means(values: FloatArray, seen: npt.NDArray[np.bool_]) -> FloatArray:
    """Values (n, k) less what their frame and their bead have in common, 0 where not seen."""
    out = np.where(seen, values, 0.0)
    for _ in range(MEANS):
        for axis in (0, 1):
            count = np.maximum(seen.sum(axis=axis, keepdims=True), 1)
            out = np.where(seen, out - out.sum(axis=axis, keepdims=True) / count, 0.0)
    return np.asarray(out)


def evened(
    flat: Float32Array, plane: FloatArray, body: Float32Array | None, slope: float
) -> Float32Array:
    """Windows (m, side, side) with each bead as it would be were there as much behind all of it as
    there is behind its middle.

    Args:
        flat: line integrals without the phantom's body.
        plane: as `Background` has it.
        body: line integrals of the body, or None.
        slope: of the contrast, as `fading` has it.
    """
    at = (np.arange(flat.shape[1]) - (flat.shape[1] - 1) / 2).astype(np.float32)
    value, right, down = plane.astype(np.float32).T[:, :, None, None]
    more = right * at + down * at[:, None]
    level = value + more
    if body is not None:
        middle = flat.shape[1] // 2
        more = more + body - body[:, middle, middle][:, None, None]
    return np.asarray(level + (flat - level) * np.exp(np.float32(-slope) * more))


def _bends(
    gain: FloatArray, curved: FloatArray, variance: FloatArray, valid: npt.NDArray[np.bool_]
) -> bool:
    """Whether bent terms explain much in the median window, and most of what there is to explain:
    edges are not explained by them."""
    free = float(np.median(valid.sum(axis=1)))
    left = float(np.median(curved / np.maximum(variance, 1e-12))) - free
    explained = float(np.median(gain))
    return explained > BENT and left < 0.3 * explained


def _blocks(windows: Float32Array, edge: int, count: int) -> FloatArray:
    """Means of blocks, (m, count^2)."""
    inner = windows[:, edge : edge + count * BLOCK, edge : edge + count * BLOCK]
    part = inner.reshape(len(windows), count, BLOCK, count * BLOCK).sum(axis=2)
    summed = part.reshape(len(windows), count, count, BLOCK).sum(axis=3)
    return np.asarray(summed.reshape(len(windows), -1), dtype=np.float64) / BLOCK**2


def _shapes(places: FloatArray, side: int) -> FloatArray:
    """Polynomials up to the third degree on a grid of places, (places^2, 10), planes first."""
    t = (places - (side - 1) / 2) / (side / 2)
    y, x = (a.ravel() for a in np.meshgrid(t, t, indexing="ij"))
    one = np.ones_like(x)
    return np.stack([one, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3], axis=1)


def _fitted(
    off: FloatArray, valid: npt.NDArray[np.bool_], shapes: FloatArray, enough: npt.NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray]:
    """Sum of squares that polynomials leave in each window, (m,), and their coefficients."""
    p = shapes.shape[1]
    weight = valid.astype(np.float64)
    gram = (weight @ (shapes[:, :, None] * shapes[:, None, :]).reshape(len(shapes), -1)).reshape(
        -1, p, p
    )
    gram += 1e-6 * np.eye(p)
    gram[~enough] = np.eye(p)
    right = off @ shapes
    coefficients = np.linalg.solve(gram, right[:, :, None])[:, :, 0]
    coefficients[~enough] = 0.0
    left = np.einsum("mi,mi->m", off, off) - np.einsum("mp,mp->m", coefficients, right)
    return np.asarray(np.maximum(left, 0.0)), np.asarray(coefficients, dtype=np.float64)


BODY_SAMPLE = 24
"""Windows that are looked at."""
LEAST_BODY = 0.3
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
    some = np.linspace(0, len(frames) - 1, min(BODY_SAMPLE, len(frames))).astype(np.intp)
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
            factor = _weighted_median(push[telling] / power[telling], power[telling])
            if factor < LEAST_BODY:
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
        if factor < LEAST_BODY or float(np.linalg.norm(shift)) > FAR_MM:
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
    d2 = distances2(windows.corner, windows.side, windows.predicted)[:, 0]
    radii = windows.radii[:, 0, None, None]
    return np.asarray((d2 > (1.15 * radii + 2.0) ** 2) & (d2 < (1.6 * radii + 4.0) ** 2))


def _levelled(values: npt.NDArray[Any], ring: npt.NDArray[np.bool_]) -> FloatArray:
    """The values in each ring less their mean, 0 elsewhere, (m, side * side)."""
    inside = np.where(ring, values, 0.0).astype(np.float64)
    mean = inside.sum(axis=(1, 2)) / np.maximum(ring.sum(axis=(1, 2)), 1)
    return np.asarray(np.where(ring, inside - mean[:, None, None], 0.0).reshape(len(ring), -1))


def _weighted_median(values: FloatArray, weights: FloatArray) -> float:
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


SURE = 5.0
"""Sigmas from which lag is taken out. The beads must agree: what turns with the object, ahead of
one bead or behind it, looks like lag of that bead alone."""
SEEN_AT_LEAST = 0.002
"""Lag below which it is left: a ghost so faint moves no shadow by a thousandth of its width."""
LEAST_LIGHT = 0.005
"""Part of the open beam that is left at least where lag is taken out of a shadow."""
LAG_SAMPLE = 48
"""Frames that are looked at, about."""
FEWEST_BEADS = 3
"""Beads from which lag is estimated at least."""


@dataclass(frozen=True)
class Lag:
    """Part of a frame that the next one shows, and its standard deviation."""

    part: float = 0.0
    sigma: float = math.inf

    @property
    def seen(self) -> bool:
        """It is there beyond doubt."""
        return self.part > max(SURE * self.sigma, SEEN_AT_LEAST)


def lag_of(images: Float32Array, frames: Frames, plan: Windows) -> Lag:
    """Lag of a scan, from places that no bead of the frame itself is near.

    Args:
        images: (n, k, side, side) windows of the plan, line integrals.
        frames: of the scan, in the order in which they were taken.
        plan: windows round the beads of each frame.
    """
    light = np.exp(-images)
    sums, some = [], slice(None, None, max(1, len(light) // LAG_SAMPLE))
    for step in (1, -1):
        there = _rolled(plan, step)
        shadow = np.roll(light, step, axis=0)
        shadow[0 if step == 1 else -1] = np.nan  # the first has none before it
        shown, near = np.exp(-frames.windows(there)[some]), _near(there.corner[some], plan, some)
        sums.append(_products(shown, np.where(near, np.nan, shadow[some])))
    (with_before, before), (with_after, after) = sums
    if min(np.count_nonzero(before), np.count_nonzero(after)) < FEWEST_BEADS:
        return Lag()
    one, other = (float(p.sum() / q.sum()) for p, q in ((with_before, before), (with_after, after)))
    apart = (with_before - one * before) / before.sum() - (with_after - other * after) / after.sum()
    part = max(one - other, 0.0)
    return Lag(part / (1.0 + part), math.sqrt(float((apart**2).sum())))


def without_lag(frames: Frames, plan: Windows, lag: Lag) -> Float32Array:
    """The windows of every frame, (n, k, side, side), less what is of the frame before; what that
    one shows of its own predecessor is taken out first. Frames without one stay as they are."""
    light = np.full((*plan.corner.shape[:2], plan.side, plan.side), np.nan)
    for back in (2, 1, 0):
        shown = np.exp(-np.roll(frames.windows(_rolled(plan, -back)), back, axis=0))
        shown[:back] = np.nan
        rest = np.maximum((shown - lag.part * light) / (1.0 - lag.part), LEAST_LIGHT)
        light = np.where(np.isfinite(rest), rest, shown)
    return np.asarray(-np.log(light), dtype=np.float32)


def _rolled(plan: Windows, step: int) -> Windows:
    """The plan with the places of the frame `step` before in each frame."""
    names = ("corner", "predicted", "radii", "stretch", "share", "crowded", "whole")
    return replace(plan, **{n: np.roll(getattr(plan, n), step, axis=0) for n in names})


def _near(corner: npt.NDArray[np.int64], plan: Windows, some: slice) -> npt.NDArray[np.bool_]:
    """Pixels of windows (n, k, side, side) near to which a bead of that frame stands."""
    reach = (1.12 * plan.radii * plan.stretch[..., 2] + 3.0)[some]
    out = np.zeros((*corner.shape[:2], plan.side, plan.side), dtype=bool)
    for bead in range(reach.shape[1]):
        d2 = distances2(corner, plan.side, plan.predicted[some, bead, None])
        out |= d2 <= (reach[:, bead] ** 2)[:, None, None, None]
    return out


def _products(light: Float32Array, shadow: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Of each bead the products, summed over its windows, of its shadow in another frame with what
    the images show at its place there, and with itself, (k,) each."""
    use = np.isfinite(light) & np.isfinite(shadow)
    one, other = (_bent(values, use) for values in (shadow, light))
    return (one * other).sum(axis=(0, 2, 3)), (one * one).sum(axis=(0, 2, 3))


def _bent(light: npt.NDArray[Any], use: npt.NDArray[np.bool_]) -> FloatArray:
    """The windows less a paraboloid through what is used of each (the body); 0 elsewhere."""
    x = np.linspace(-1.0, 1.0, light.shape[-1])
    right, down = np.broadcast_arrays(x[None, :], x[:, None])
    terms = np.stack([right**0, right, down, right**2, right * down, down**2])
    normal = np.einsum("nkrc,arc,brc->nkab", use, terms, terms) + 1e-9 * np.eye(len(terms))
    values = np.where(use, light, 0.0)
    push = np.einsum("nkrc,arc->nka", values, terms)
    smooth = np.einsum("nka,arc->nkrc", np.linalg.solve(normal, push[..., None])[..., 0], terms)
    return np.where(use, values - smooth, 0.0)
