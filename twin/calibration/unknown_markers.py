"""Markers at unknown positions: the spots of each marker, and its position.

Two spots of different frames are two rays. Where the rays (nearly) meet there may be a
marker, and there is one if many other frames have a spot at its projection. Positions and
assignment are rough, those of a nominal geometry; the bundle adjustment of
`pipeline.calibrate` then estimates positions and geometry together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.detect.detection import Detections
from flexdt.twin.calibration.fit.fit import estimate_geometry
from flexdt.twin.calibration.identify import assign
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses

Index = npt.NDArray[np.int64]

UNKNOWN: Final = "unknown"
"""Name of a phantom of markers at unknown positions."""
ANYWHERE_MM: Final = 1e3
"""Standard deviation of the prior on the position of an unknown marker."""
GATES_PX: Final = (12.0, 5.0, 3.0)
"""Largest distance of a spot from a marker's projection: in the first rough geometry,
after one fit, after two [px]."""
MIN_SEEN_SHARE: Final = 0.3
"""Least share of the frames with a spot of a marker."""
BASE_FRAMES: Final = 6
"""Number of frames whose spots are paired with those of others."""
MAX_SCORED_FRAMES: Final = 60
"""Largest number of frames in which candidates are compared."""


def link(
    detections: Sequence[Detections], poses: Poses, start: Offsets
) -> tuple[Index, FloatArray, Offsets]:
    """Find the marker of each spot.

    Tried from the axis centered on the spots and from `start`; the better one is refined
    by two fits (axis and roll free) with narrower gates. Markers seen in fewer than three
    frames, or than `MIN_SEEN_SHARE` of those with spots, are left out.

    Args:
        detections: spots of each of the n frames, one at least.
        poses: nominal geometry; angles must be right, distances may be off by
            centimeters.
        start: offsets to begin with.

    Returns:
        (n, k) number of the spot of marker k, -1 without one; positions (k, 3) [mm], from
        the highest marker to the lowest; and their offsets.

    Raises:
        TwinError: fewer than three markers are found.
    """
    counts = np.array([len(d) for d in detections], dtype=np.int64)
    n = len(detections)
    m = max(int(counts.max(initial=0)), 1)
    shape = detections[0].shape
    points = np.full((n, m, 2), np.inf)
    for i, d in enumerate(detections):
        points[i, : len(d)] = d.centers
    best: tuple[int, FloatArray, Offsets] = (0, np.zeros((0, 3)), start)
    for aside in (centred(points, poses, shape, start), start) if counts.any() else ():
        cone = poses.cone_vec(aside)
        found = _found(points, counts, cone, shape)
        index = assign(cone.project_points(found, shape), points, counts, GATES_PX[0])
        if int((index >= 0).sum()) > best[0]:
            best = int((index >= 0).sum()), found, aside
    _, places, at = best
    for gate in GATES_PX:
        if len(places) < 3:
            raise TwinError(
                f"{len(places)} markers are found that move as the angles say, "
                f"among {counts.mean():.1f} spots in each of {n} frames; allowed: three "
                "or more. Look at the angles and at the axis's place",
                {"asked": len(places), "allowed": ">= 3"},
            )
        cone = poses.cone_vec(at)
        index = assign(cone.project_points(places, shape), points, counts, gate)
        often = np.count_nonzero(index >= 0, axis=0)
        enough = often >= max(3, MIN_SEEN_SHARE * np.count_nonzero(counts))
        index = index[:, enough]
        places = places[enough]
        if gate != GATES_PX[-1] and enough.sum() >= 3:
            tracks = _picked(points, index)
            fit = estimate_geometry(
                tracks,
                places,
                poses,
                ("dO_x", "det_roll"),
                shape=shape,
                start=at,
                free_beads=True,
                bead_tolerance_mm=ANYWHERE_MM,
                priors={"det_roll": 1.0},
                bound=np.inf,
            )
            places = fit.beads
            at = fit.parameters
    order = np.argsort(-places[:, 2])
    return index[:, order], places[order], at


def triangulate(tracks: FloatArray, cone: ConeVec, shape: tuple[int, int]) -> FloatArray:
    """Triangulate the point nearest to the rays of each marker, by least squares.

    Args:
        tracks: (n, k, 2) pixels (column, row), nan where unseen; each seen twice or more.
        cone: geometry of the n frames.
        shape: detector (rows, cols).

    Returns:
        (k, 3) [mm].

    Raises:
        TwinError: a marker is seen fewer than twice, or always in the same direction;
            names the first.
    """
    source, ray = _rays(tracks, cone, shape)
    seen: npt.NDArray[np.bool_] = np.asarray(np.isfinite(tracks).all(axis=2))
    across = np.where(
        seen[..., None, None], np.eye(3) - ray[..., None] * ray[..., None, :], 0.0
    )
    normal = across.sum(axis=0)
    weak = np.asarray(np.linalg.cond(normal) > 1e8)
    if weak.any():
        raise TwinError(
            f"marker {int(np.argmax(weak))} is seen in too few directions to say where it is; "
            "allowed: two or more",
            {"marker": int(np.argmax(weak))},
        )
    right = np.einsum("nkij,nkj->ki", across, np.broadcast_to(source[:, None], ray.shape))
    return np.asarray(np.linalg.solve(normal, right[..., None])[..., 0])


def centred(
    points: FloatArray, poses: Poses, shape: tuple[int, int], start: Offsets
) -> Offsets:
    """Move the axis in `start` (dO_x) to the mean column of the spots: over a full turn they
    agree. Other offsets stay.

    `points`: (n, m, 2) pixels, not finite without a spot; one finite at least. `poses`: nominal
    geometry. `shape`: detector (rows, cols). `start`: offsets to begin with.
    """
    flat = points[np.isfinite(points).all(axis=2)]
    scale = float(np.median(np.linalg.norm(poses.u, axis=1) * poses.sod / poses.sdd))
    axis = float(
        poses.cone_vec(start).project_points(np.zeros((1, 3)), shape)[:, 0, 0].mean()
    )
    return replace(start, dO_x=start.dO_x + scale * (float(flat[:, 0].mean()) - axis))


def _rays(
    tracks: FloatArray, cone: ConeVec, shape: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """Compute the ray to each spot.

    `tracks`: (n, k, 2) column and row [px], nan where unseen; `cone`: geometry of the n frames;
    `shape`: detector (rows, cols).
    Returns sources (n, 3) [mm] and unit directions (n, k, 3).
    """
    off = tracks - (np.array(shape[::-1]) - 1) / 2
    at = (
        cone.detector[:, None]
        + off[..., :1] * cone.u[:, None]
        + off[..., 1:] * cone.v[:, None]
        - cone.source[:, None]
    )
    return cone.source, at / np.linalg.norm(at, axis=2, keepdims=True)


def _found(
    points: FloatArray, counts: Index, cone: ConeVec, shape: tuple[int, int]
) -> FloatArray:
    """Find positions of markers, those with most spots first.

    Candidates are where rays of two frames nearly meet (closer than the first gate, on
    the panel), for up to `BASE_FRAMES` frames with two others each. The candidate with
    most spots in up to `MAX_SCORED_FRAMES` frames is triangulated and takes its spots
    away from the others, until none has three, and `MIN_SEEN_SHARE` of the frames.

    Args:
        points: (n, m, 2) pixels, inf beyond each frame's count.
        counts: (n,) spots in each frame.
        cone: rough geometry.
        shape: detector (rows, cols).

    Returns:
        (k, 3) [mm]; (0, 3) for fewer than three frames with spots.
    """
    finite = np.where(np.isfinite(points), points, np.nan)
    source, ray = _rays(finite, cone, shape)
    usable = np.flatnonzero(counts > 0)
    if len(usable) < 3:
        return np.zeros((0, 3))
    pitch = np.median(np.linalg.norm(cone.u, axis=1))
    gap = GATES_PX[0] * pitch
    candidates = []
    bases = usable[np.linspace(0, len(usable) - 1, BASE_FRAMES).astype(int)]
    for i in np.unique(bases).tolist():
        for step in (len(usable) // 4, len(usable) // 3):
            j = int(
                usable[(int(np.searchsorted(usable, i)) + max(step, 1)) % len(usable)]
            )
            a = ray[i, : counts[i], None]
            b = ray[j, None, : counts[j]]
            between = source[j] - source[i]
            dot = (a * b).sum(axis=2)
            # The nearest points of two lines.
            with np.errstate(invalid="ignore", divide="ignore"):
                s = ((a @ between) - dot * (b @ between)) / (1 - dot**2)
                t = (dot * (a @ between) - (b @ between)) / (1 - dot**2)
            p = source[i] + s[..., None] * a
            q = source[j] + t[..., None] * b
            near = np.linalg.norm(p - q, axis=2) < gap
            candidates.append(((p + q) / 2)[near])
    places = np.concatenate(candidates)
    some = usable[
        np.linspace(0, len(usable) - 1, min(len(usable), MAX_SCORED_FRAMES)).astype(int)
    ]
    spots = points[some].copy()
    with np.errstate(invalid="ignore"):
        predicted = cone[some].project_points(places, shape)
        distance = np.linalg.norm(predicted[:, :, None] - spots[:, None], axis=3)
    out: list[FloatArray] = []
    while len(places):
        nearest = distance.min(axis=2)
        close = nearest < GATES_PX[0]
        score = (
            close.sum(axis=0)
            - (np.where(close, nearest, 0.0).sum(axis=0) / GATES_PX[0]) / 2
        )
        k = int(np.argmax(score))
        if close[:, k].sum() < max(3, MIN_SEEN_SHARE * len(some)):
            break
        frames = np.flatnonzero(close[:, k])
        taken = np.full((len(some), 1, 2), np.nan)
        chosen = distance[frames, k].argmin(axis=1)
        taken[frames, 0] = spots[frames, chosen]
        out.append(triangulate(taken, cone[some], shape)[0])
        distance[frames, :, chosen] = np.inf
        spots[frames, chosen] = np.inf
    return np.array(out).reshape(-1, 3)


def _picked(points: FloatArray, index: Index) -> FloatArray:
    chosen = points[np.arange(len(points))[:, None], np.maximum(index, 0)]
    return np.where((index >= 0)[..., None], chosen, np.nan)
