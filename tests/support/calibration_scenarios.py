"""The thesis's five scenarios and phantoms, written out for tests (Tables 6.1 and 6.2)."""

from __future__ import annotations

import math

import numpy as np

from flexdt.twin.calibration import BeadModel, Detections
from flexdt.twin.geometry.conventions import FloatArray, from_unity
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses

SHAPE = (760, 956)
PIXEL = 0.1496

# source, detector, start of the object (Unity axes), dO (Unity axes), alpha [deg]
SCENARIOS = {
    "G0": ((0, 45, 0), (0, 0, 674), (10, 15, 589), (-10, 5, -19), 10.0),
    "G1": ((8, 50, 0), (-5, 10, 720), (6, 28, 577), (-6, -6, -12), 5.0),
    "G2": ((-10, 55, 0), (8, 20, 760), (15, 42, 582), (-15, -12, -22), 15.0),
    "G3": ((5, 60, 0), (-8, -5, 800), (18, 23, 580), (-18, -8, -25), 25.0),
    "G4": ((-5, 38, 0), (10, 3, 690), (7, 20, 576), (-7, -2, -8), 3.0),
}


def scenario(name: str, frames: int) -> tuple[Poses, Offsets]:
    """The start poses of a named scenario of SCENARIOS, and the offsets that are hidden
    in it.

    Angles go once around: 360 deg * n / frames.

    Raises:
        KeyError: there is no such scenario.
    """
    source, detector, start, shift, alpha = SCENARIOS[name]
    poses = Poses(
        from_unity(source),
        from_unity(start),
        from_unity(detector),
        np.array([PIXEL, 0.0, 0.0]),
        np.array([0.0, 0.0, -PIXEL]),
        2 * math.pi * np.arange(frames) / frames,
    )
    edge = {"dO_x": shift[0], "dO_y": shift[1], "dO_z": shift[2], "alpha": alpha}
    return poses, Offsets.from_edge(edge)


def spiral(
    size: tuple[float, float, float], beads: int, radius: float = 2.0
) -> BeadModel:
    """Beads on the spiral of docs/calibration.md: one turn from the bottom to the top.

    Args:
        size: width, breadth and height of what the beads have to stay inside [mm].
        beads: how many; a single one lies at half height.
        radius: of each bead [mm]; bead centres keep so far from the sides.
    """
    k = np.arange(beads)
    height = (
        (k / (beads - 1) - 0.5) * (size[2] - 2 * radius) if beads > 1 else np.zeros(1)
    )
    angle = 2 * math.pi * k / beads
    return BeadModel(
        np.stack(
            [
                (size[0] / 2 - radius) * np.cos(angle),
                (size[1] / 2 - radius) * np.sin(angle),
                height,
            ],
            axis=1,
        ),
        np.array(radius),
    )


def exact_tracks(poses: Poses, truth: Offsets, model: BeadModel) -> FloatArray:
    """Projections of the beads' centres, without any noise."""
    return poses.cone_vec(truth).project_points(model.beads, SHAPE)


def shadows(
    tracks: FloatArray,
    seed: int,
    *,
    missing: float = 0.0,
    false: int = 0,
    noise: float = 0.05,
) -> list[Detections]:
    """Detections of each frame in random order, some left out, some invented.

    Places within ten pixels of an edge of SHAPE are not seen. The same seed gives the
    same detections.

    Args:
        tracks: (frames, beads, 2) true places [pixels].
        seed: of everything random.
        missing: part of the true places that is left out.
        false: places invented in each frame, anywhere on it.
        noise: standard deviation added to true places [pixels].
    """
    rng = np.random.default_rng(seed)
    rows, cols = SHAPE
    out = []
    for frame in tracks:
        inside = ((frame > 10) & (frame < [cols - 11, rows - 11])).all(axis=1)
        places = frame[inside & (rng.random(len(frame)) >= missing)]
        places = places + noise * rng.normal(size=places.shape)
        places = np.concatenate([places, rng.uniform([0, 0], [cols, rows], (false, 2))])
        rng.shuffle(places)
        k = len(places)
        out.append(
            Detections(
                places, np.tile(0.01 * np.eye(2), (k, 1, 1)), np.full(k, 15.0), np.full(k, 3.0),
                np.zeros(k), np.ones(k, dtype=bool), np.ones(k), SHAPE,
            )
        )  # fmt: skip
    return out
