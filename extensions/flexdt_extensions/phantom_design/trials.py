"""Simulated scans of designed beads: can they be identified, and how far do real fits scatter?

These figures check the predictions of `bead_search`, so they use nothing of the information matrix.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration import BeadModel, estimate_geometry, spot_radii, visible_beads
from flexdt.twin.calibration.detect.detection import Detections
from flexdt.twin.calibration.identify import Search, identify, overlapping
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt_extensions.phantom_design.information_table import PlannedScans

_TRIAL_SHIFT_MM: Final = 2.0


def share_identified(
    model: BeadModel, planned: PlannedScans, *, trials: int = 3, seed: int = 1, frames: int = 24
) -> float:
    """Share of simulated scans, each from a start angle of its own, whose beads are distinguished.

    Args:
        model: the beads.
        planned: the scans; at most `frames` frames of them are used.
        trials: scans; each has a random start angle and offsets of a few millimetres.
        seed: of angles, offsets and noise.
        frames: see `planned`.
    """
    some, _ = planned.thinned(frames)
    rng = np.random.default_rng([seed, 7])
    good = 0
    for trial in range(trials):
        shift = rng.normal(0.0, _TRIAL_SHIFT_MM, 3)
        turn = 2.0 * math.pi * (trial + rng.random()) / trials
        truth = Offsets(dO_x=shift[0], dO_y=shift[1], dO_z=shift[2], alpha=turn)
        shadows, owners = _shadows(model, some, truth, rng)
        try:
            found = identify(shadows, model, some.poses, search=Search(frames=frames))
        except TwinError:
            continue
        given = np.concatenate(
            [_named(index, owner) for index, owner in zip(found.index, owners, strict=True)]
        )
        good += not found.ambiguous and not (given == 0).any() and bool((given > 0).any())
    return good / trials


def measured_spread(
    model: BeadModel, planned: PlannedScans, *, trials: int = 60, seed: int = 1
) -> dict[str, float]:
    """Standard deviation of real fits to noisy simulated points, edge units.

    The check of `design.forecast`.

    Args:
        model: the beads; with a tolerance in `planned` each trial's beads are off by it.
        planned: the scans.
        trials: fits.
        seed: of the noise.
    """
    rng = np.random.default_rng([seed, 11])
    values: list[list[float]] = []
    tolerance = planned.bead_tolerance_mm
    free_beads = tolerance > 0
    for _ in range(trials):
        beads = model.beads + rng.normal(0.0, tolerance, model.beads.shape) * free_beads
        tracks = _tracks(BeadModel(beads, model.bead_radius_mm), planned, NOMINAL)
        tracks = tracks + rng.normal(0.0, planned.noise_px, tracks.shape)
        fit = estimate_geometry(
            tracks, model, planned.poses, planned.free, shape=planned.sizes(),
            noise_px=planned.noise_px, free_beads=free_beads,
            bead_tolerance_mm=tolerance if free_beads else None,
        )  # fmt: skip
        names = [name for name in planned.free if name in fit.values]
        values.append([fit.values[name] for name in names])
    spread = np.std(np.array(values), axis=0, ddof=1)
    return dict(zip(names, spread.tolist(), strict=True))


def _tracks(model: BeadModel, planned: PlannedScans, at: Offsets) -> FloatArray:
    """(n, k, 2) pixels of the spots that count, nan elsewhere."""
    cone = planned.poses.cone_vec(at)
    pixels = cone.project_points(model.beads, planned.shape)
    hidden = overlapping(pixels, spot_radii(model, planned.poses.cone_vec(at)))
    hidden |= ~visible_beads(model, planned.poses, planned.sizes(), at)
    return np.where(hidden[..., None], np.nan, pixels)


def _shadows(
    model: BeadModel, planned: PlannedScans, truth: Offsets, rng: np.random.Generator
) -> tuple[list[Detections], list[npt.NDArray[np.intp]]]:
    """Simulated detections in random order, and the bead of each."""
    tracks = _tracks(model, planned, truth)
    radii = spot_radii(model, planned.poses.cone_vec(truth))
    out, owners = [], []
    for frame, points in enumerate(tracks):
        seen = rng.permutation(np.flatnonzero(np.isfinite(points[:, 0])))
        noisy = points[seen] + rng.normal(0.0, planned.noise_px, (len(seen), 2))
        out.append(Detections.of_points(noisy, planned.noise_px, radii[frame, seen], planned.shape))
        owners.append(seen)
    return out, owners


def _named(index: npt.NDArray[np.int64], owner: npt.NDArray[np.intp]) -> npt.NDArray[np.int64]:
    """For each bead of a frame: 1 if its spot is its own, 0 if another's, -1 if it has none."""
    out = np.full(len(index), -1, dtype=np.int64)
    hit = index >= 0
    out[hit] = owner[index[hit]] == np.flatnonzero(hit)
    return out
