"""Second look at the images where the geometry says the beads are.

Once a rough fit exists, every bead's place is known to a fraction of a pixel. Each is measured
again in a window there, after the phantom's own body (bricks, cuboid) and the other beads, rendered
at that geometry, are subtracted: a body's edge behind a bead no longer pulls its centroid, touching
shadows are separated, shadows cut by the edge are fitted, and none is missed. It refuses to find
beads on its own and to keep images: it asks for small windows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration import detect_kernels as kernels
from flexdt.twin.calibration.beads import BeadModel
from flexdt.twin.calibration.detect import BLUR_PX, CAP
from flexdt.twin.conventions import Float32Array, FloatArray
from flexdt.twin.geometry import ConeVec
from flexdt.twin.projection.analytic import project_scene
from flexdt.twin.projection.shapes import Scene, Solid, Sphere

MISS_PX = 4.0
"""A measurement further than this from its prediction is not that bead."""
SHARE = 0.35
"""Least share of a shadow in view that is still fitted."""


@dataclass(frozen=True, eq=False)
class Windows:
    """Where to look in n frames for k beads.

    Attributes:
        corner: (n, k, 2) column and row of each window's first pixel.
        side: windows are side x side pixels.
        predicted: (n, k, 2) expected shadow centres [px].
        radii: (n, k) minor semi-axes of the shadows [px].
        stretch: (n, k, 3) direction of the major semi-axis and its ratio to the minor.
        share: (n, k) share of each shadow in the image, 0 to 1.
        crowded: (n, k) the shadow touches another's.
        whole: (n, k) the shadow and some room round it are in the image, and it is alone.
        shape: (rows, cols).
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


@dataclass(frozen=True, eq=False)
class Measured:
    """Bead positions of n frames, (n, k, ...), nan where there is none.

    Attributes:
        tracks: (n, k, 2) pixels.
        covariances: (n, k, 2, 2).
        bias: (n, k) sphere-centre bias factors.
        contrast: (n, k) line integral through the middle.
        size_ratio: (n, k) measured over expected radius of whole shadows.
    """

    tracks: FloatArray
    covariances: FloatArray
    bias: FloatArray
    contrast: FloatArray
    size_ratio: FloatArray


def plan_windows(model: BeadModel, cone: ConeVec, shape: tuple[int, int]) -> Windows:
    """Windows round the expected shadows of all beads.

    Args:
        model: the beads.
        cone: geometry of the n frames, as well as it is known.
        shape: (rows, cols) of the images.
    """
    predicted = cone.project_points(model.beads, shape)
    minor, stretch = shadow_ellipses(model, cone, predicted, shape)
    major = minor * stretch[..., 2]
    side = 2 * math.ceil(float(1.62 * np.nanmax(major)) + 8.0) + 1
    corner = np.floor(np.nan_to_num(predicted) + 0.5).astype(np.int64) - side // 2
    rows, cols = shape
    # Share of the disc inside, from the segment cut off at each edge (corners: product).
    share = np.ones(predicted.shape[:2])
    for axis, size in ((0, cols), (1, rows)):
        for distance in (predicted[..., axis] + 0.5, size - 0.5 - predicted[..., axis]):
            share = share * _disc_share(distance / major)
    gap = np.linalg.norm(predicted[:, :, None] - predicted[:, None], axis=3)
    touch = gap < 1.12 * (major[:, :, None] + major[:, None]) + 3.0
    touch &= ~np.eye(len(model), dtype=bool)
    crowded = touch.any(axis=2)
    room = (1.15 * major + 2.5)[..., None]
    inside = ((predicted > room) & (predicted < np.array([cols, rows]) - 1 - room)).all(axis=2)
    return Windows(
        corner, side, predicted, minor, stretch, share, crowded, inside & ~crowded, shape
    )


def shadow_ellipses(
    model: BeadModel, cone: ConeVec, predicted: FloatArray, shape: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """Minor semi-axes (n, k) [px] and (n, k, 3) direction and ratio of the major ones.

    A ball's shadow is the section of its tangent cone (half-angle beta, axis at theta from the
    detector's normal): semi-axes f sin b / sqrt(cos^2 t - sin^2 b) and, towards the foot point,
    cos b / sqrt(cos^2 t - sin^2 b) times that.
    """
    ray = model.beads[None] - cone.source[:, None]
    distance = np.linalg.norm(ray, axis=2)
    cos_t = np.einsum("nkj,nj->nk", ray, cone.normal) / distance
    sin_b = np.minimum(model.bead_radius_mm[None] / distance, 0.99)
    root = np.sqrt(np.maximum(cos_t**2 - sin_b**2, 1e-6))
    pitch = np.linalg.norm(cone.u, axis=1)
    minor = (cone.source_detector_distance / pitch)[:, None] * sin_b / root
    away = predicted - cone.piercing_points(shape)[:, None]
    length = np.linalg.norm(away, axis=2, keepdims=True)
    direction = np.where(length > 1e-9, away / np.maximum(length, 1e-9), [1.0, 0.0])
    ratio = np.sqrt(1.0 - sin_b**2) / root
    return minor, np.concatenate([direction, np.maximum(ratio, 1.0)[..., None]], axis=2)


def _disc_share(t: FloatArray) -> FloatArray:
    """Share of a unit disc on the near side of a line at signed distance `t` from its centre."""
    s = np.clip(t, -1.0, 1.0)
    return np.asarray(0.5 + (s * np.sqrt(1.0 - s * s) + np.arcsin(s)) / math.pi)


def crop(image: npt.ArrayLike, windows: Windows, frame: int) -> Float32Array:
    """The k windows of one frame's image, float32 (k, side, side), nan outside the image."""
    data = np.asarray(image)
    rows, cols = windows.shape
    side = windows.side
    out = np.full((len(windows.corner[frame]), side, side), np.nan, dtype=np.float32)
    for k, (x, y) in enumerate(windows.corner[frame].tolist()):
        left, top, right, bottom = max(x, 0), max(y, 0), min(x + side, cols), min(y + side, rows)
        if left < right and top < bottom:
            out[k, top - y : bottom - y, left - x : right - x] = data[top:bottom, left:right]
    return out


def without_beads(scene: Scene, model: BeadModel) -> Scene:
    """The scene less the balls that are the model's beads."""
    return Scene(tuple(s for s in scene.solids if _bead_of(s, model) is None))


def _bead_of(solid: Solid, model: BeadModel) -> int | None:
    match solid.shape:
        case Sphere(center=center):
            gap = np.linalg.norm(model.beads - np.asarray(center), axis=1)
            k = int(np.argmin(gap))
            return k if gap[k] < 0.5 * model.bead_radius_mm[k] else None
        case _:
            return None


def render_windows(scene: Scene, cone: ConeVec, windows: Windows) -> Float32Array:
    """Line integrals of a scene in every window, (n, k, side, side)."""
    n, k = windows.corner.shape[:2]
    rows, cols = windows.shape
    side = windows.side
    middle = windows.corner + (side - 1) / 2 - (np.array([cols, rows]) - 1) / 2
    detector = (
        cone.detector[:, None]
        + middle[..., :1] * cone.u[:, None]
        + middle[..., 1:] * cone.v[:, None]
    )
    spread = [
        np.broadcast_to(part[:, None], (n, k, 3)).reshape(-1, 3)
        for part in (cone.source, cone.u, cone.v)
    ]
    rows_ = ConeVec.from_vectors(spread[0], detector.reshape(-1, 3), spread[1], spread[2])
    return project_scene(scene, rows_, (side, side)).reshape(n, k, side, side)


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
) -> Measured:
    """Measure every bead in its window.

    Args:
        images: (n, k, side, side) line integrals from `crop`.
        windows: where they were cut out.
        cone: geometry the windows were planned with.
        model: the beads.
        contrast: line integral through the middle of a bead, one or (k,), as detected.
        scene: the phantom's solids; what is not a bead is subtracted. None: only planes are.
        cap: line integrals above the background are cut here.
        blur: of the images [px], for the fits of partial shadows.
    """
    n, k = windows.corner.shape[:2]
    side = windows.side
    data = images
    if scene is not None:
        body = render_windows(without_beads(scene, model), cone, windows)
        data = data - np.float32(_body_scale(data, body, windows)) * body
    flat = data.reshape(n * k, side, side)
    offsets = (windows.predicted - windows.corner).reshape(-1, 2)
    radii = windows.radii.ravel().copy()
    stretch = windows.stretch.reshape(-1, 3)
    results = np.zeros((n * k, kernels.RESULTS))
    whole = windows.whole
    entire = np.flatnonzero(whole)
    kernels.measure_windows(flat, entire, offsets, radii, cap, results)
    peaks = _contrasts(results.reshape(n, k, -1), whole, contrast)
    partial = np.flatnonzero((windows.share > SHARE) & ~whole)
    if len(partial):
        radii *= _radius_scale(flat, windows, entire, offsets, radii, stretch, peaks, cap, blur)
        kernels.fit_windows(
            flat, partial, _masks(flat, windows, partial), offsets, radii, stretch, peaks, cap,
            blur, False, results,
        )  # fmt: skip
    return _accept(results.reshape(n, k, -1), windows, whole, peaks.reshape(n, k))


def _contrasts(
    results: FloatArray, whole: npt.NDArray[np.bool_], contrast: float | FloatArray
) -> FloatArray:
    """Contrast of each bead, (n * k,): the median over its whole shadows, else as given, scaled
    as the others' are."""
    seen = np.where(whole & (results[..., kernels.OK] > 0), results[..., kernels.PEAK], np.nan)
    given = np.broadcast_to(np.asarray(contrast, dtype=np.float64), whole.shape[1:])
    out = np.full(len(given), np.nan)
    for bead in range(len(out)):
        values = seen[:, bead][np.isfinite(seen[:, bead])]
        if len(values) >= 3:
            out[bead] = np.median(values)
    known = np.isfinite(out)
    ratio = float(np.median(out[known] / given[known])) if known.any() else 1.0
    out[~known] = given[~known] * ratio
    return np.broadcast_to(out, whole.shape).ravel().copy()


def _radius_scale(
    flat: Float32Array,
    windows: Windows,
    entire: npt.NDArray[np.intp],
    offsets: FloatArray,
    radii: FloatArray,
    stretch: FloatArray,
    peaks: FloatArray,
    cap: float,
    blur: float,
) -> float:
    """Factor from expected to apparent radius, from whole shadows; 1 without enough of them.

    Blur that is not as assumed, and a bead that is not as made, show here; a shadow cut by the
    edge has its centre where its radius puts it.
    """
    some = entire[:: max(1, len(entire) // 40)]
    if len(some) < 3:
        return 1.0
    results = np.zeros((len(flat), kernels.RESULTS))
    kernels.fit_windows(
        flat, some, _masks(flat, windows, some), offsets, radii, stretch, peaks, cap, blur, True,
        results,
    )  # fmt: skip
    good = some[results[some, kernels.OK] > 0]
    if len(good) < 3:
        return 1.0
    return float(np.median(results[good, kernels.RADIUS] / radii[good]))


def _masks(
    flat: Float32Array, windows: Windows, index: npt.NDArray[np.intp]
) -> npt.NDArray[np.uint8]:
    """Usable pixels of some windows: inside the image and free of other beads' shadows."""
    masks = np.isfinite(flat[index]).astype(np.uint8)
    k = windows.corner.shape[1]
    for i, position in enumerate(index.tolist()):
        frame, bead = divmod(position, k)
        if windows.crowded[frame, bead]:
            masks[i] &= _free_of_others(windows, frame, bead)
    return masks


def _body_scale(data: Float32Array, body: Float32Array, windows: Windows) -> float:
    """Factor between the rendered and the seen body, from the windows' rings; 1 if unclear.

    A real body's attenuation differs from the model's (material, beam hardening).
    """
    side = windows.side
    step = max(1, data.size // (side * side * 24))
    i = np.arange(side)
    offsets = (windows.predicted - windows.corner).reshape(-1, 2)[::step]
    d2 = (i[None, None, :] - offsets[:, 0, None, None]) ** 2 + (
        i[None, :, None] - offsets[:, 1, None, None]
    ) ** 2
    radii = windows.radii.ravel()[::step, None, None]
    alone = ~windows.crowded.ravel()[::step, None, None]
    ring = (d2 > (1.15 * radii + 2.0) ** 2) & (d2 < (1.6 * radii + 4.0) ** 2) & alone
    seen = data.reshape(-1, side, side)[::step]
    model = body.reshape(-1, side, side)[::step]
    ring &= np.isfinite(seen)
    weight = ring.astype(np.float64)
    count = np.maximum(weight.sum(axis=(1, 2), keepdims=True), 1.0)
    a = np.where(ring, seen, 0.0)
    b = np.where(ring, model, 0.0)
    a = np.where(ring, a - a.sum(axis=(1, 2), keepdims=True) / count, 0.0)
    b = np.where(ring, b - b.sum(axis=(1, 2), keepdims=True) / count, 0.0)
    power = float(np.sum(b * b))
    if power < 1e-4 * max(float(weight.sum()), 1.0) * 0.01:
        return 1.0
    scale = float(np.sum(a * b)) / power
    return scale if 0.3 < scale < 3.0 else 1.0


def _free_of_others(windows: Windows, frame: int, bead: int) -> npt.NDArray[np.uint8]:
    """1 where no other bead's shadow falls in this window."""
    side = windows.side
    x, y = windows.corner[frame, bead]
    columns, rows = np.meshgrid(np.arange(side) + x, np.arange(side) + y)
    free = np.ones((side, side), np.uint8)
    for other in range(windows.predicted.shape[1]):
        if other == bead:
            continue
        cx, cy = windows.predicted[frame, other]
        reach = windows.radii[frame, other] * windows.stretch[frame, other, 2] + 3.0
        free[(columns - cx) ** 2 + (rows - cy) ** 2 < reach * reach] = 0
    return free


def _accept(
    results: FloatArray,
    windows: Windows,
    whole: npt.NDArray[np.bool_],
    contrast: float | FloatArray,
) -> Measured:
    place = results[..., [kernels.X, kernels.Y]] + windows.corner
    off = np.linalg.norm(place - windows.predicted, axis=2)
    peak = results[..., kernels.PEAK]
    good = (results[..., kernels.OK] > 0) & (off < MISS_PX)
    good &= np.where(
        whole,
        (results[..., kernels.SCORE] > 0.9)
        & (np.abs(np.log(np.maximum(results[..., kernels.RADIUS], 1e-9) / windows.radii)) < 0.2)
        & (np.abs(np.log(np.maximum(peak, 1e-9) / contrast)) < math.log(1.6)),
        results[..., kernels.NOISE] < 0.12 * np.minimum(contrast, CAP),
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
        np.where(good & whole, results[..., kernels.RADIUS] / windows.radii, np.nan),
    )


def contrast_of(values: Sequence[FloatArray]) -> float:
    """Typical contrast of detections in several frames; nan without any."""
    parts = [v for v in values if len(v)]
    return float(np.median(np.concatenate(parts))) if parts else math.nan
