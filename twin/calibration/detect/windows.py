"""Windows around the predicted positions of the beads: planned, cut out, mended, rendered.

With them the second measurement can subtract the phantom's body and the neighboring
beads without processing entire images.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.detect.bead_hardening import Hardening
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection.analytic import project_scene
from flexdt.twin.projection.analytic_solids import Scene, Solid, Sphere

Part = tuple[slice, slice]
_Light = TypeVar("_Light", Float32Array, FloatArray)
Balls = tuple[tuple[Scene, Hardening | None], ...]
"""Beads of one contrast each, and how they harden the beam; None: not at all."""
LEAST_NOISE = 1e-3
"""Noise of line integrals that is assumed at least: no pixel counts a million photons."""
LEAST_SEEN = 4
"""Frames in which a pixel must be seen before it can be called dead."""
MAX_STILL_SPREAD = 0.1
"""Largest spread of a dead pixel's values over the frames, in units of the noise."""
DEAD_SIGMAS = 5.0
"""Least difference of a dead pixel from its neighbors in some frame, in units of the noise."""
EVEN_STEPS = (0.7548776662466927, 0.5698402909980532)
"""Parts of a pixel from one window's lattice to the next one's: multiples of them are spread
evenly over a square (powers of 1 / 1.3247..., the root of x^3 = x + 1)."""
WIDEST_DEAD = 4
"""Pixels along the shorter side of a gap that is filled."""
MOMENTS = (6, 24)
"""Least and largest number of moments of an exposure."""
MOMENT_PX = 1.5
"""Part of a bead's longest way for each of them in between [px]: about two blurs."""
SHADOW_MARGIN = 1.1
"""Factor on a shadow's major semi-axis, and 2 px, within which it lies about the image of a
ball's middle."""
PART_STEP = 8
"""Sides of the rendered parts of windows are multiples of it [px]: those alike are rendered
together."""
PART_PIXELS = 400_000
"""Pixels that are rendered together at most, about."""
Turning = Callable[[float], ConeVec]
"""Gives the geometry of all frames at a part of a step from the middle of each exposure."""
LightOf = Callable[["ConeVec", "Windows", FloatArray], Float32Array]
"""Gives the light in windows of a geometry, for rays through one place of each pixel."""


@dataclass(frozen=True, eq=False)
class Windows:
    """Windows in n frames around k beads.

    Attributes:
        corner: (n, k, 2) column and row of each window's first pixel.
        side: windows are side x side pixels.
        predicted: (n, k, 2) expected spot centers [px].
        radii: (n, k) minor semi-axes of the spots [px].
        stretch: (n, k, 3) direction of the major semi-axis and its ratio to the minor.
        share: (n, k) share of each spot in the image, 0 to 1.
        crowded: (n, k) the spot touches another's.
        whole: (n, k) the spot and some space around it are in the image, and no other
            spot is.
        shape: (rows, cols).
        moments: geometry of the frames at moments that are spread evenly over each exposure;
            none: images of instants.
    """

    corner: npt.NDArray[np.int64]
    side: int
    predicted: FloatArray
    radii: FloatArray
    stretch: FloatArray
    share: FloatArray
    crowded: npt.NDArray[np.bool_]
    whole: npt.NDArray[np.bool_]
    shape: tuple[int, int]
    moments: tuple[ConeVec, ...] = ()

    def pick(self, frames: npt.NDArray[np.intp], beads: npt.NDArray[np.intp]) -> Windows:
        """Select the windows of m (frame, bead) pairs, as if of m frames with one bead
        each: arrays become (m, 1, ...).
        """

        arrays: dict[str, Any] = {
            n: a for n, a in vars(self).items() if n not in ("side", "shape", "moments")
        }
        return replace(
            self,
            moments=tuple(cone[frames] for cone in self.moments),
            **{n: a[frames, beads][:, None] for n, a in arrays.items()},
        )


def plan_windows(
    model: BeadModel,
    cone: ConeVec,
    shape: tuple[int, int],
    smear: FloatArray | float = 0.0,
) -> Windows:
    """Plan windows around the expected spots of all beads.

    All windows have one odd side, for the largest spot. Spots closer than 1.12 times both
    major semi-axes and 3 px are crowded; only complete, uncrowded ones are `whole`.
    Windows may be off the image.

    Args:
        model: the beads.
        cone: geometry of the n frames, as well as it is known.
        shape: (rows, cols) of the images.
        smear: length by which each spot is smeared in an exposure, (n, k) or one [px].
    """
    predicted = cone.project_points(model.beads, shape)
    minor, stretch = shadow_ellipses(model, cone, predicted, shape)
    major = minor * stretch[..., 2]
    half = np.broadcast_to(0.5 * np.asarray(smear), major.shape)
    side = 2 * math.ceil(float(np.nanmax(1.62 * major + half)) + 8.0) + 1
    corner = np.floor(np.nan_to_num(predicted) + 0.5).astype(np.int64) - side // 2
    rows, cols = shape
    # Share of the disc inside, from the segment cut off at each edge (corners: product).
    share = np.ones(predicted.shape[:2])
    for axis, size in ((0, cols), (1, rows)):
        for distance in (predicted[..., axis] + 0.5, size - 0.5 - predicted[..., axis]):
            share = share * _disc_share(distance / major)
    gap = np.linalg.norm(predicted[:, :, None] - predicted[:, None], axis=3)
    wide = 1.12 * major + half
    touch = gap < wide[:, :, None] + wide[:, None] + 3.0
    touch &= ~np.eye(len(model), dtype=bool)
    crowded = touch.any(axis=2)
    room = (1.15 * major + half + 2.5)[..., None]
    inside = ((predicted > room) & (predicted < np.array([cols, rows]) - 1 - room)).all(
        axis=2
    )
    return Windows(
        corner, side, predicted, minor, stretch, share, crowded, inside & ~crowded, shape
    )


def shadow_ellipses(
    model: BeadModel, cone: ConeVec, predicted: FloatArray, shape: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """Compute the ellipses that the beads cast on the detector from centers (n, k, 2)
    [px].

    Returns minor semi-axes (n, k) [px of columns], and (n, k, 3): direction of the major
    ones (column, row; (1, 0) at the foot point) and major over minor axis.
    """
    minor, ratio = _semi_axes(model, cone)
    away = predicted - cone.piercing_points(shape)[:, None]
    length = np.linalg.norm(away, axis=2, keepdims=True)
    direction = np.where(length > 1e-9, away / np.maximum(length, 1e-9), [1.0, 0.0])
    return minor, np.concatenate([direction, ratio[..., None]], axis=2)


def _semi_axes(model: BeadModel, cone: ConeVec) -> tuple[FloatArray, FloatArray]:
    """Compute the minor semi-axes [px of columns] of the shadows of k beads in n frames, and
    major over minor axis, each (n, k).
    """
    # A section of the ball's tangent cone: half-angle b, axis at t from the panel's normal.
    ray = model.beads[None] - cone.source[:, None]
    distance = np.linalg.norm(ray, axis=2)
    cos_t = np.einsum("nkj,nj->nk", ray, cone.normal) / distance
    sin_b = np.minimum(model.bead_radius_mm[None] / distance, 0.99)
    root = np.sqrt(np.maximum(cos_t**2 - sin_b**2, 1e-6))
    pitch = np.linalg.norm(cone.u, axis=1)
    minor = (cone.source_detector_distance / pitch)[:, None] * sin_b / root
    return minor, np.maximum(np.sqrt(1.0 - sin_b**2) / root, 1.0)


def _disc_share(t: FloatArray) -> FloatArray:
    """Compute the share of a unit disc on the near side of a line at signed distance `t`
    from its center: 0 for -1 and less, 1 for 1 and more."""
    s = np.clip(t, -1.0, 1.0)
    return np.asarray(0.5 + (s * np.sqrt(1.0 - s * s) + np.arcsin(s)) / math.pi)


def crop(image: npt.ArrayLike, windows: Windows, frame: int) -> Float32Array:
    """Cut out the k windows of one frame's image.

    Args:
        image: (rows, cols).
        windows: places of all frames' windows.
        frame: number of the frame.

    Returns:
        New float32 (k, side, side), nan outside the image.
    """
    data = np.asarray(image)
    side = windows.side
    out = np.full((len(windows.corner[frame]), side, side), np.nan, dtype=np.float32)
    for k in range(len(out)):
        inside, there = overlap(windows, frame, k)
        out[k][inside] = data[there]
    return out


def overlap(windows: Windows, frame: int, bead: int) -> tuple[Part, Part]:
    """Return the part that a window shares with its image; both slices are empty where
    they do not overlap.

    Args:
        windows: of all frames.
        frame: number of the frame.
        bead: number of the bead.

    Returns:
        (rows, columns) as slices of the window, and the same of the image.
    """
    (rows, cols) = windows.shape
    side = windows.side
    x, y = windows.corner[frame, bead].tolist()
    left = max(x, 0)
    top = max(y, 0)
    right = max(min(x + side, cols), left)
    bottom = max(min(y + side, rows), top)
    return (
        (slice(top - y, bottom - y), slice(left - x, right - x)),
        (slice(top, bottom), slice(left, right)),
    )


def mended(images: Float32Array, windows: Windows) -> Float32Array:
    """Fill dead pixels of the windows from their neighbors.

    A dead pixel is constant over `LEAST_SEEN` frames or more (within `MAX_STILL_SPREAD`
    of the noise), which noise allows no other pixel, and differs from its neighbors by
    `DEAD_SIGMAS` in some frame. Areas wider than `WIDEST_DEAD` pixels both ways are left:
    they may be starved.

    Args:
        images: (n, k, side, side) line integrals.
        windows: their places.

    Returns:
        A filled copy; `images` itself without dead pixels.
    """
    side = windows.side
    noise = float(np.median(pixel_noise(images.reshape(-1, side, side), 0, side)))
    low = np.full(windows.shape, np.inf, dtype=np.float32)
    high = -low
    seen = np.zeros(windows.shape, dtype=np.uint16)
    places = [
        (f, k, *overlap(windows, f, k))
        for f, k in np.ndindex(*images.shape[:2])
        if np.isfinite(images[f, k]).any()
    ]
    for f, k, inside, there in places:
        part = images[f, k][inside]
        np.fmin(low[there], part, out=low[there])
        np.fmax(high[there], part, out=high[there])
        seen[there] += 1
    still = np.zeros(windows.shape, dtype=np.uint8)
    known = seen >= LEAST_SEEN
    still[known] = high[known] - low[known] < MAX_STILL_SPREAD * noise
    wide = np.ones((WIDEST_DEAD + 1, WIDEST_DEAD + 1), dtype=np.uint8)
    still[cv2.morphologyEx(still, cv2.MORPH_OPEN, wide) > 0] = 0
    dead = np.zeros(windows.shape, dtype=np.bool_)
    suspects = [place for place in places if still[place[3]].any()]
    filled = [_filled(images[f, k][i], still[t] > 0) for f, k, i, t in suspects]
    for (f, k, inside, there), fill in zip(suspects, filled, strict=True):
        dead[there] |= np.abs(fill - images[f, k][inside]) > DEAD_SIGMAS * noise
    if not dead.any():
        return images
    out = images.copy()
    for (f, k, inside, there), fill in zip(suspects, filled, strict=True):
        out[f, k][inside] = np.where(dead[there], fill, images[f, k][inside])
    return out


def _filled(image: Float32Array, dead: npt.NDArray[np.bool_]) -> Float32Array:
    """Fill dead pixels by the mean of their finite neighbors (of four), from the edges
    of each dead area inwards.

    Args:
        image: (rows, cols).
        dead: (rows, cols).

    Returns:
        A copy; areas wider than `WIDEST_DEAD` keep NaN in their middle.
    """
    sides = np.pad(np.where(dead, np.float32(np.nan), image), 1, constant_values=np.nan)
    inner = sides[1:-1, 1:-1]
    for _ in range((WIDEST_DEAD + 1) // 2):
        around = np.stack(
            [sides[:-2, 1:-1], sides[2:, 1:-1], sides[1:-1, :-2], sides[1:-1, 2:]]
        )
        there = np.isfinite(around)
        fill = dead & np.isnan(inner) & there.any(axis=0)
        inner[fill] = (
            np.where(there, around, 0.0).sum(axis=0)[fill] / there.sum(axis=0)[fill]
        )
    return np.ascontiguousarray(inner)


def without_beads(scene: Scene, model: BeadModel) -> Scene:
    """Return a new scene without the balls that are the model's beads (`_is_bead`)."""
    return Scene(tuple(s for s in scene.solids if not _is_bead(s, model)))


def _is_bead(solid: Solid, model: BeadModel) -> bool:
    """Check whether a solid of the scene is one of the phantom's beads: a sphere whose
    center is within half a radius of the nearest bead's; False for any other shape.
    """
    if not isinstance(solid.shape, Sphere):
        return False
    gap = np.linalg.norm(model.beads - np.asarray(solid.shape.center), axis=1)
    k = int(np.argmin(gap))
    return bool(gap[k] < 0.5 * model.bead_radius_mm[k])


def render_windows(
    scene: Scene, cone: ConeVec, windows: Windows, fine: int = 1, balls: Balls = ()
) -> Float32Array:
    """Render line integrals of a scene in every window, (n, k, side, side).

    fine x fine rays' intensities are averaged; one ray puts an edge up to half a pixel
    off. `balls`: beads that harden the beam.
    """
    if fine == 1 and not windows.moments:
        return _hardened_rays(scene, cone, windows, np.zeros(2), balls)
    return np.asarray(
        -np.log(window_intensities(scene, cone, windows, fine, balls)), dtype=np.float32
    )


def window_intensities(
    scene: Scene, cone: ConeVec, windows: Windows, fine: int, balls: Balls = ()
) -> Float32Array:
    """Render the transmitted share of the open beam in every window.

    Args:
        scene: to render.
        cone: n views.
        windows: k windows in each.
        fine: rays along each side of a pixel, which are averaged.
        balls: beads that harden the beam, besides the scene.

    Returns:
        (n, k, side, side), from 0 to 1.
    """
    if windows.moments and not scene.solids:
        return exposed_light(
            [ball for ball, _ in balls],
            windows,
            fine,
            lambda near, few, place: np.exp(
                -_hardened_rays(scene, near, few, place, balls)
            ),
        )
    n, k = windows.corner.shape[:2]
    total = np.zeros((n, k, windows.side, windows.side), dtype=np.float32)
    for near, place, weight in rays_of(cone, windows, fine):
        light = np.exp(-_hardened_rays(scene, near, windows, place, balls))
        light *= weight[..., None, None]
        total += light
    return total


def rays_of(
    cone: ConeVec, windows: Windows, fine: int
) -> list[tuple[ConeVec, FloatArray, Float32Array]]:
    """List the rays whose light makes a pixel: the geometry of each, its place in the pixel
    and its weight, see `spread_lattice`. Each moment of an exposure has as many.

    Args:
        cone: n views, of instants.
        windows: k windows in each.
        fine: rays along each side of a pixel; 1: through its middle.
    """
    moments = windows.moments or (cone,)
    if fine == 1:
        share = np.full(windows.corner.shape[:2], 1.0 / len(moments), np.float32)
        return [(near, np.zeros(2), share) for near in moments]
    return [
        (near, place, weight / np.float32(len(moments)))
        for m, near in enumerate(moments)
        for place, weight in spread_lattice(windows, fine, m)
    ]


def exposed_light(
    scenes: Sequence[Scene],
    windows: Windows,
    fine: int,
    light_of: LightOf,
    terms: tuple[int, ...] = (),
) -> Float32Array:
    """Render the light behind beads in exposures, at each moment only where shadows reach.

    Args:
        scenes: of all beads that `light_of` renders, and nothing else.
        windows: k windows in n frames, with moments.
        fine: rays along each side of a pixel, see `rays_of`.
        light_of: gives the light, (*terms, m, 1, size, size), of rays through one place of
            each pixel in m windows of one bead each.
        terms: shape of what is rendered at once.

    Returns:
        (*terms, n, k, side, side), the mean of the moments; 1 where there is no shadow.
    """
    n, k = windows.corner.shape[:2]
    still = replace(windows, moments=())
    cones = ConeVec.concatenate(windows.moments)
    first, size = reached(scenes, cones, windows)
    places, weights = _rays_of_moments(windows, fine)
    out = np.ones((*terms, n, k, windows.side, windows.side), np.float32)
    for side in np.unique(size[size > 0]).tolist():
        every = np.argwhere(size == side)
        count = math.ceil(len(every) * side**2 / PART_PIXELS)
        for some in np.array_split(every, count):
            moment, frame, bead = some.T
            corner = windows.corner[frame, bead] + first[moment, frame, bead]
            few = replace(still.pick(frame, bead), corner=corner[:, None], side=side)
            near = cones[moment * n + frame]
            dark = np.zeros((*terms, len(some), side, side), np.float32)
            for place, weight in zip(places, weights, strict=True):
                light = light_of(near, few, place[moment, frame, bead][:, None])
                dark += weight[moment, frame, bead, None, None] * (
                    1.0 - light[..., 0, :, :]
                )
            left, top = first[moment, frame, bead].T.tolist()
            for i, (f, b) in enumerate(some[:, 1:].tolist()):
                rows = slice(top[i], top[i] + side)
                out[..., f, b, rows, left[i] : left[i] + side] -= dark[..., i, :, :]
    return out


def reached(
    scenes: Sequence[Scene], cone: ConeVec, windows: Windows
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Find the square part of each window that shadows of balls reach.

    Args:
        scenes: of spheres.
        cone: n views; or those of several moments, one after another.
        windows: k windows in each of the n.

    Returns:
        Column and row of its first pixel in the window, (moments, n, k, 2), and its side
        (moments, n, k), a multiple of `PART_STEP` or that of the window; 0: no shadow.
    """
    spheres = [s.shape for scene in scenes for s in scene.solids]
    places = np.array([s.center for s in spheres if isinstance(s, Sphere)])
    radii = np.array([s.radius for s in spheres if isinstance(s, Sphere)])
    model = BeadModel(places, radii)
    moments = len(cone) // len(windows.corner)
    middle = cone.project_points(model.beads, windows.shape)
    minor, ratio = _semi_axes(model, cone)
    reach = (SHADOW_MARGIN * minor * ratio + 2.0)[:, None, :, None]
    at = middle[:, None] - np.tile(windows.corner, (moments, 1, 1))[:, :, None]
    # A bead that is nowhere may be anywhere.
    low = np.nan_to_num(np.floor(at - reach), nan=0.0).clip(0, windows.side)
    high = np.nan_to_num(np.ceil(at + reach) + 1, nan=windows.side).clip(0, windows.side)
    there = (low < high).all(axis=3, keepdims=True)
    begin = np.where(there, low, windows.side).min(axis=2)
    end = np.where(there, high, 0.0).max(axis=2)
    width = np.maximum(end - begin, 0.0).max(axis=2)
    side = np.minimum(PART_STEP * np.ceil(width / PART_STEP), windows.side)
    first = np.minimum(begin, windows.side - side[..., None])
    shape = (moments, *windows.corner.shape[:2])
    return (
        first.reshape(*shape, 2).astype(np.int64),
        side.reshape(shape).astype(np.int64),
    )


def _rays_of_moments(windows: Windows, fine: int) -> tuple[FloatArray, Float32Array]:
    """Return places (rays, moments, n, k, 2) and weights (rays, moments, n, k) of the rays
    of `rays_of`.
    """
    shape = (1, len(windows.moments), *windows.corner.shape[:2])
    share = np.float32(1.0 / len(windows.moments))
    if fine == 1:
        return np.zeros((*shape, 2)), np.full(shape, share)
    rays = [spread_lattice(windows, fine, m) for m in range(len(windows.moments))]
    places = np.array([[place for place, _ in moment] for moment in rays])
    weights = np.array([[weight for _, weight in moment] for moment in rays])
    return places.swapaxes(0, 1), share * weights.swapaxes(0, 1)


def exposed(
    windows: Windows, model: BeadModel, turning: Turning, share: float
) -> Windows:
    """Return windows of frames that are exposed over a share of a step; 0: of instants.

    Args:
        windows: of the beads.
        model: the beads.
        turning: gives the geometry at a part of a step from the middle of each frame.
        share: of a step.
    """
    if share == 0.0:
        return replace(windows, moments=())
    way = float(np.linalg.norm(ways(windows, model, turning), axis=2).max()) * share
    least, most = MOMENTS
    count = min(max(least, math.ceil(way / MOMENT_PX)), most)
    # Their variance is that of an even exposure.
    parts = (np.arange(count) + 0.5 - 0.5 * count) / math.sqrt(count**2 - 1.0)
    return replace(windows, moments=tuple(turning(share * t) for t in parts.tolist()))


def ways(windows: Windows, model: BeadModel, turning: Turning) -> FloatArray:
    """Compute the way of each bead's image in a step of the stage, (n, k, 2) [px]."""
    before, after = (
        turning(part).project_points(model.beads, windows.shape) for part in (-0.5, 0.5)
    )
    return np.asarray(after - before)


def lattice(fine: int) -> list[tuple[float, float]]:
    """Return places (column, row) of fine^2 rays in a pixel, from its center.

    No two share a column or row, so that an edge along either is placed to 1 / fine^2 px.
    """
    n = fine * fine
    out = []
    for m in range(n):
        across, down = divmod(m, fine)
        out.append(
            ((m + 0.5) / n - 0.5, (down * fine + fine - 1 - across + 0.5) / n - 0.5)
        )
    return out


def spread_lattice(
    windows: Windows, fine: int, moment: int = 0
) -> list[tuple[FloatArray, Float32Array]]:
    """Return (n, k, 2) places of fine^2 rays in windows' pixels, and weights (n, k).

    Each window, and each `moment` of the exposure, has the lattice shifted otherwise, or
    an edge at one place of the grid is misplaced alike in all frames; weights keep the
    middle of the light in the pixel's.
    """
    n, k = windows.corner.shape[:2]
    number = np.arange(n)[:, None] + n * np.arange(k) + n * k * moment
    shift = (number[..., None] * np.array(EVEN_STEPS) % 1.0 - 0.5) / fine**2
    places = np.array(lattice(fine))
    tilt = shift @ np.linalg.inv(places.T @ places)
    return [
        (place + shift, (1.0 / fine**2 - tilt @ place).astype(np.float32))
        for place in places
    ]


def _hardened_rays(
    scene: Scene,
    cone: ConeVec,
    windows: Windows,
    place: FloatArray,
    balls: Balls,
) -> Float32Array:
    """Render line integrals of a scene and of beads that harden the beam, (n, k, side, side),
    for rays through one place in each pixel.
    """
    parts = [window_rays(scene, cone, windows, place)] if scene.solids else []
    for ball, curve in balls:
        rays = window_rays(ball, cone, windows, place)
        parts.append(rays if curve is None else curve(rays))
    return np.asarray(sum(parts[1:], parts[0]))


def window_rays(
    scene: Scene, cone: ConeVec, windows: Windows, place: FloatArray
) -> Float32Array:
    """Render line integrals of windows, for rays through one place in each pixel; also
    pixels off the image.

    Args:
        scene: to render.
        cone: geometry of n frames.
        windows: k windows a frame.
        place: right and down from the pixel's center, (2,) or (n, k, 2) [px].

    Returns:
        (n, k, side, side) line integrals.
    """
    n, k = windows.corner.shape[:2]
    rows, cols = windows.shape
    side = windows.side
    at = windows.corner + (side - 1) / 2 - (np.array([cols, rows]) - 1) / 2 + place
    detector = (
        cone.detector[:, None]
        + at[..., :1] * cone.u[:, None]
        + at[..., 1:] * cone.v[:, None]
    )
    source, u, v = (np.repeat(part, k, axis=0) for part in (cone.source, cone.u, cone.v))
    near = ConeVec.from_vectors(source, detector.reshape(-1, 3), u, v)
    return np.asarray(project_scene(scene, near, (side, side)).reshape(n, k, side, side))


def edged(body: Float32Array, windows: Windows, step: float) -> npt.NDArray[np.bool_]:
    """Check whether an edge of the body crosses a bead's spot or is within 2.5 px of it:
    a second difference of 4 px, along rows or columns, above `step`.

    Args:
        body: (n, k, side, side) line integrals of everything but the bead.
        windows: their places.
        step: least height of an edge that counts.

    Returns:
        (n, k) bool.
    """
    # A ramp has no second difference; an edge has one of its height.
    bend = np.zeros_like(body)
    bend[:, :, 2:-2] = np.abs(body[:, :, 4:] + body[:, :, :-4] - 2.0 * body[:, :, 2:-2])
    across = np.abs(body[..., 4:] + body[..., :-4] - 2.0 * body[..., 2:-2])
    np.maximum(bend[..., 2:-2], across, out=bend[..., 2:-2])
    reach = (windows.radii * windows.stretch[..., 2] + 2.5)[..., None, None]
    found = np.empty(body.shape[:2], np.bool_)
    for i, at in enumerate(
        windows.corner
    ):  # distances of one frame at a time: they are float64
        near = distances2(at, windows.side, windows.predicted[i]) < reach[i] ** 2
        found[i] = (bend[i] * near).max(axis=(1, 2)) > step
    return found


def distances2(
    corner: npt.NDArray[np.int64], side: int, places: FloatArray
) -> FloatArray:
    """Compute squared distances [px^2] of windows' pixels from places (..., 2).

    Returns (..., side, side).
    """
    i = np.arange(side)
    x, y = np.moveaxis((places - corner)[..., None], -2, 0)
    return np.asarray(((i - x) ** 2)[..., None, :] + ((i - y) ** 2)[..., None])


def blur_kernel(blur: float) -> FloatArray:
    """Make a one-dimensional kernel on pixels whose variance is exactly blur^2, sum 1, of
    odd length: three values below a variance of 0.35 px^2, else a Gaussian integrated
    over pixels.

    A sampled Gaussian loses most of its variance below half a pixel.

    Args:
        blur: standard deviation [px].
    """
    variance = blur * blur
    if variance < 0.35:
        return np.array([variance / 2.0, 1.0 - variance, variance / 2.0])
    # A Gaussian integrated over pixels has 1 / 12 more.
    inner = math.sqrt(variance - 1.0 / 12.0)
    half = math.ceil(4.0 * inner)
    edges = (np.arange(-half, half + 2) - 0.5) / (inner * math.sqrt(2.0))
    share = np.diff([math.erf(e) for e in edges])
    return np.asarray(share / share.sum())


def blurred_windows(line_integrals: Float32Array, blur: float) -> Float32Array:
    """Blur line integrals (n, k, side, side) as intensities, edges repeated.

    `blur` is the standard deviation [px].
    """
    out = blurred_light(np.exp(-line_integrals), blur_kernel(blur))
    return np.asarray(-np.log(out), dtype=np.float32)


def blurred_light(light: _Light, kernel: FloatArray) -> _Light:
    """Blur intensities (..., side, side) by a kernel along rows and columns; edges are
    repeated outwards.
    """
    out = np.empty_like(light)
    side = light.shape[-1]
    for i, window in enumerate(light.reshape(-1, side, side)):
        out.reshape(-1, side, side)[i] = cv2.sepFilter2D(
            window, -1, kernel, kernel, borderType=cv2.BORDER_REPLICATE
        )
    return out


def free_of_others(windows: Windows, frame: int, bead: int) -> npt.NDArray[np.bool_]:
    """Mark pixels of this bead's window in this frame that no other bead's spot comes
    near (within 3 px), (side, side) bool.
    """
    d2 = distances2(windows.corner[frame, bead], windows.side, windows.predicted[frame])
    reach = windows.radii[frame] * windows.stretch[frame, :, 2] + 3.0
    touched = d2 < (reach**2)[:, None, None]
    touched[bead] = False
    return ~np.asarray(touched.any(axis=0))


def pixel_noise(flat: Float32Array, edge: int, width: int) -> FloatArray:
    """Estimate the noise of each window's pixels from the median difference of neighbors
    in six rows at its top and bottom.

    Args:
        flat: (m, side, side) line integrals, nan outside the image.
        edge: first used row and column.
        width: number of used rows and columns, 7 at least.

    Returns:
        (m,) standard deviations, at least `LEAST_NOISE`; for windows with nan in these
        rows the others' median.
    """
    rows = [
        edge,
        edge + 3,
        edge + 6,
        edge + width - 7,
        edge + width - 4,
        edge + width - 1,
    ]
    strips = flat[:, rows, edge : edge + width]
    steps = np.abs(np.diff(strips, axis=2)).reshape(len(flat), -1)
    good = np.isfinite(steps).all(axis=1)
    out = np.zeros(len(flat))
    if good.any():
        out[good] = np.median(steps[good], axis=1) / (0.6745 * math.sqrt(2.0))
        out[~good] = np.median(out[good])
    return np.asarray(np.maximum(out, LEAST_NOISE))
