"""The balls that a scan shows, without a phantom's model, and how they are like its beads.

`link` finds the balls that turn together as the angles say. Where it explains the spots, angles
and order of the frames are right, and the places of the balls are known up to the nominal
geometry. A similarity (turn, mirror image, scale) that brings the beads of a model to them tells
in one step how the phantom stands, in which unit its file is, whether it is its mirror image, and
whether there are two of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.detect.detection import Detections
from flexdt.twin.calibration.unknown_markers import Index, link
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses

EXPLAINED: Final = 0.65
"""Least share of the spots that turn together for the angles to be right."""
MOST_BALLS: Final = 40
"""Balls in whose triples a model's are sought."""
MOST_TRIPLES: Final = 12
"""Triples of a model's beads that are sought."""
MOST_FITS: Final = 2000
"""Triples of balls that are compared with one of beads."""
OFF: Final = 0.03
"""Distance of a ball from its bead as a share of the phantom's radius, in a nominal geometry
(assumed: a panel rolled by a degree moves a ball by half of it)."""
MATCHED: Final = 0.6
"""Least share of the lesser number of balls and beads that are each other."""
FEWEST: Final = 4
"""Fewest balls that tell a phantom."""


@dataclass(frozen=True, eq=False)
class Constellation:
    """Balls that turn together.

    Attributes:
        places: (k, 3) in the object's frame of a nominal geometry [mm].
        radii: (k,) of their spots at those places [mm].
        index: (n, k) spot of each ball in each frame, -1 without one.
        explained: share of the spots that are one of them.
    """

    places: FloatArray
    radii: FloatArray
    index: Index
    explained: float

    def only(self, balls: npt.NDArray[np.intp]) -> Constellation:
        """Keep some balls."""
        return Constellation(
            self.places[balls], self.radii[balls], self.index[:, balls], self.explained
        )


@dataclass(frozen=True, eq=False)
class Likeness:
    """How beads are like balls: ball = scale * rotation @ bead + shift.

    Attributes:
        rotation: (3, 3), of determinant -1 for a mirror image.
        scale: of lengths.
        shift: (3,) [mm].
        beads, balls: numbers of those that are each other.
        rms: distance of them as a share of the phantom's radius.
    """

    rotation: FloatArray
    scale: float
    shift: FloatArray
    beads: npt.NDArray[np.intp]
    balls: npt.NDArray[np.intp]
    rms: float

    @property
    def mirrored(self) -> bool:
        """The balls are the mirror image of the beads."""
        return bool(np.linalg.det(self.rotation) < 0.0)

    @property
    def lean(self) -> float:
        """Angle between the phantom's z and the vertical [rad]."""
        return math.acos(min(max(float(self.rotation[2, 2]), -1.0), 1.0))

    def turned_from(
        self, other: Likeness, within_mm: float, rise_mm: float = 0.0
    ) -> bool:
        """Check whether the balls differ from others by a turn of the stage alone.

        `other`: how the same beads are like the others; `within_mm`: shift that is none [mm];
        `rise_mm`: of the stage as it turns, a radian [mm].
        """
        turn = self.rotation @ other.rotation.T
        upright = float(turn[2, 2]) > math.cos(math.radians(0.5))
        off = self.shift - turn @ other.shift
        # Growing angles turn the balls clockwise.
        off[2] += rise_mm * math.atan2(turn[1, 0], turn[0, 0])
        return upright and bool(np.linalg.norm(off) < within_mm)

    @property
    def leaning(self) -> FloatArray:
        """The turn about a horizontal line that leans the phantom so, (3, 3)."""
        return lean_of(self.rotation)


def lean_of(rotation: FloatArray) -> FloatArray:
    """Split a turn into one about a horizontal line and then one about the vertical; return the
    first, (3, 3).
    """
    z = rotation.T @ np.array([0.0, 0.0, 1.0])
    # R^T z is where the vertical is in the phantom; the lean turns it upright by the least angle.
    axis = np.cross(z, [0.0, 0.0, 1.0])
    sine, cosine = float(np.linalg.norm(axis)), float(z[2])
    if sine < 1e-12:
        return np.eye(3) if cosine > 0 else np.diag([1.0, -1.0, -1.0])
    x, y, _ = axis / sine
    cross = np.array([[0.0, 0.0, y], [0.0, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + sine * cross + (1.0 - cosine) * cross @ cross)


def constellation(
    detections: Sequence[Detections], poses: Poses, start: Offsets
) -> Constellation | None:
    """Find the balls that turn together; None where they do not explain the spots
    (`EXPLAINED`).

    Args:
        detections: spots of each frame.
        poses: nominal geometry.
        start: offsets that are known before.
    """
    total = sum(len(d) for d in detections)
    if total == 0:
        return None
    try:
        index, places, at = link(detections, poses, start)
    except TwinError:
        return None
    explained = float((index >= 0).sum()) / total
    if explained < EXPLAINED:
        return None
    cone = poses.cone_vec(at)
    depth = np.einsum("nkj,nj->nk", places[None] - cone.source[:, None], cone.normal)
    pitch = np.linalg.norm(cone.u, axis=1)
    per_px = depth * (pitch / cone.source_detector_distance)[:, None]
    seen = np.full(index.shape, np.nan)
    for i, d in enumerate(detections):
        there = index[i] >= 0
        seen[i, there] = d.radii_px[index[i, there]]
    radii = np.nanmedian(seen * per_px, axis=0)
    return Constellation(places, radii, index, explained)


def likeness(beads: FloatArray, balls: FloatArray) -> Likeness | None:
    """Find the similarity that brings most beads to balls; of several the one that is no
    mirror image and turns the vertical least. None where fewer than `MATCHED` of them match.

    Args:
        beads: (k, 3) of a phantom [mm].
        balls: (n, 3) [mm].
    """
    least = max(FEWEST, math.ceil(MATCHED * min(len(beads), len(balls))))
    if min(len(beads), len(balls)) < FEWEST or len(balls) > MOST_BALLS:
        return None
    size = float(np.linalg.norm(beads - beads.mean(axis=0), axis=1).max())
    best: list[Likeness] = []
    for triple in _triples(beads):
        for rotation, scale, shift in _fits(beads, balls, triple):
            moved = scale * beads @ rotation.T + shift
            found = _matched(beads, balls, moved, 2.0 * OFF * scale * size)
            if found is None or len(found.beads) < least:
                continue
            best.append(found)
        if best and max(len(b.beads) for b in best) >= min(len(beads), len(balls)):
            break
    if not best:
        return None
    most = max(len(b.beads) for b in best)
    best = [b for b in best if len(b.beads) == most]
    good = 2.0 * min(b.rms for b in best) + 1e-3
    return min(
        (b for b in best if b.rms < good),
        key=lambda b: (b.mirrored, round(b.lean, 2), b.rms),
    )


def _triples(beads: FloatArray) -> list[tuple[int, int, int]]:
    """Choose triples of beads that span large triangles of three different sides, the largest
    first and no bead in more than half of them.
    """
    some = np.linspace(0, len(beads) - 1, min(len(beads), 12)).round().astype(int)
    found = []
    for a, b, c in combinations(some.tolist(), 3):
        across = np.cross(beads[b] - beads[a], beads[c] - beads[a])
        found.append((float(np.linalg.norm(across)), (a, b, c)))
    found.sort(reverse=True)
    out: list[tuple[int, int, int]] = []
    uses = np.zeros(len(beads), dtype=int)
    for area, triple in found:
        if area <= 1e-6 * found[0][0]:
            break
        if (uses[list(triple)] < MOST_TRIPLES // 2).all():
            out.append(triple)
            uses[list(triple)] += 1
        if len(out) == MOST_TRIPLES:
            break
    return out


def _fits(
    beads: FloatArray, balls: FloatArray, triple: tuple[int, int, int]
) -> list[tuple[FloatArray, float, FloatArray]]:
    """List the similarities (rotation, scale, shift) that bring three beads to three balls
    and most others near a ball, the best first.
    """
    a, b, c = (beads[i] for i in triple)
    ab, ac, bc = (float(np.linalg.norm(q - p)) for p, q in ((a, b), (a, c), (b, c)))
    apart = np.linalg.norm(balls[:, None] - balls, axis=2)
    scale = apart / ab
    size = float(np.linalg.norm(beads - beads.mean(axis=0), axis=1).max())
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.hypot(
            apart[:, None, :] / scale[:, :, None] - ac,
            apart[None] / scale[:, :, None] - bc,
        )
    off[scale <= 0.0] = np.inf
    n = len(balls)
    off[np.arange(n), :, np.arange(n)] = np.inf
    off[:, np.arange(n), np.arange(n)] = np.inf
    order = np.argsort(off, axis=None)[:MOST_FITS]
    order = order[off.ravel()[order] < 2.0 * OFF * size]
    i, j, k = np.unravel_index(order, off.shape)
    frame = _frame(a, b, c)
    out = []
    for sign in (1.0, -1.0):
        turned = _frame(balls[i], balls[j], balls[k]) * [1.0, 1.0, sign]
        rotation = turned @ frame.T
        size_of = scale[i, j]
        moved = size_of[:, None, None] * np.einsum("cij,kj->cki", rotation, beads - a)
        moved += balls[i][:, None]
        gap = np.linalg.norm(moved[:, :, None] - balls, axis=3).min(axis=2)
        near = (gap < (2.0 * OFF * size * size_of)[:, None]).sum(axis=1)
        for f in np.flatnonzero(near >= max(FEWEST, near.max(initial=0) - 1))[
            :24
        ].tolist():
            shift = balls[i[f]] - size_of[f] * rotation[f] @ a
            out.append((int(near[f]), rotation[f], float(size_of[f]), shift))
    out.sort(key=lambda one: -one[0])
    return [one[1:] for one in out]


def _frame(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Return right-handed directions of triangles as columns, (..., 3, 3)."""
    x = b - a
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    y = c - a
    y = y - (y * x).sum(axis=-1, keepdims=True) * x
    y = y / np.maximum(np.linalg.norm(y, axis=-1, keepdims=True), 1e-300)
    return np.stack([x, y, np.cross(x, y)], axis=-1)


def _matched(
    beads: FloatArray, balls: FloatArray, moved: FloatArray, reach: float
) -> Likeness | None:
    """Match beads with balls one to one, and fit the similarity of those that match; None for
    fewer than `FEWEST`, or where they are not within `OFF`.

    Args:
        beads: (k, 3) [mm].
        balls: (n, 3) [mm].
        moved: (k, 3) the beads near the balls.
        reach: largest distance of a match [mm].
    """
    out = None
    for _ in range(2):
        gap = np.linalg.norm(moved[:, None] - balls, axis=2)
        nearest = gap.argmin(axis=1)
        mine = gap.min(axis=1) < reach
        mine &= gap.argmin(axis=0)[nearest] == np.arange(len(beads))
        which = np.flatnonzero(mine)
        if len(which) < FEWEST:
            return None
        whose = nearest[which]
        rotation, scale, shift = similarity(beads[which], balls[whose])
        moved = scale * beads @ rotation.T + shift
        size = scale * float(np.linalg.norm(beads - beads.mean(axis=0), axis=1).max())
        rms = float(np.sqrt(np.mean((moved[which] - balls[whose]) ** 2))) / size
        out = Likeness(rotation, scale, shift, which, whose, rms)
    return out if out is not None and out.rms < OFF else None


def similarity(
    beads: FloatArray, balls: FloatArray
) -> tuple[FloatArray, float, FloatArray]:
    """Fit ball = scale * rotation @ bead + shift by least squares; the rotation may mirror
    (Arun et al., IEEE Trans. PAMI 9 (1987) 698, without its condition on the determinant).

    Args:
        beads, balls: (m, 3), which belong together [mm].
    """
    middle, there = beads.mean(axis=0), balls.mean(axis=0)
    p, q = beads - middle, balls - there
    u, s, vt = np.linalg.svd(q.T @ p)
    sign = np.ones(3)
    if s[2] < 1e-3 * s[0]:  # In a plane: no mirror image is needed.
        sign[2] = np.sign(np.linalg.det(u @ vt))
    rotation = (u * sign) @ vt
    scale = float((s * sign).sum() / (p**2).sum())
    return np.asarray(rotation), scale, there - scale * rotation @ middle
