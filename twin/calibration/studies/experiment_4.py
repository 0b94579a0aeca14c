"""Experiment 4 as a synthetic twin: why the thesis's real results depend on N (figure 6.4).

Eleven scans with the geometries of Table 6.6, 360 frames each by the scanner's smooth-scan rule
(image i at i * 360 / (M - 1)), a hidden mount, beads off their model by a tolerance. They are
fitted twice from N of the frames: with the frames' own angles, and with the bookkeeping that
reproduces the thesis's numbers, frames floor(linspace(0, M - 1, N)) assumed at 360 n / N.
Bead positions are points here, not images. Only the size of the hidden mount is the thesis's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.fit.fit import FitResult, estimate_geometry
from flexdt.twin.calibration.fit.problem import (
    SIX,
    Reading,
    from_printed_reading,
    to_printed_reading,
)
from flexdt.twin.calibration.studies.experiments import PIXEL_MM, SHAPE
from flexdt.twin.calibration.studies.runs import Run, clean, errors_of
from flexdt.twin.calibration.studies.thesis_tables import thesis
from flexdt.twin.geometry.conventions import from_unity
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses

FRAMES: Final = 360
COUNTS: Final = tuple(n for n in range(3, FRAMES + 1) if FRAMES % n == 0)
"""Numbers of projections: the thesis's, which are the divisors of 360."""
FIRST_MOUNT: Final = 6
"""Scans 1 to 6 share a mount, the others another (thesis 6.5)."""
NOISE_PX: Final = 0.03
TOLERANCE_MM: Final = 0.03
"""Assumed: detection noise, and how far a bead lies off its model."""


def scan_names() -> tuple[str, ...]:
    """Scan1 to Scan11."""
    return tuple(thesis()["table_6_6_scans"])


def poses_of(name: str, frames: int = FRAMES) -> Poses:
    """Nominal poses of a scan of Table 6.6; angles by the smooth-scan rule."""
    row = thesis()["table_6_6_scans"][name]
    return Poses(
        from_unity(row["source"]),
        from_unity(row["object"]),
        from_unity(row["detector"]),
        np.array([PIXEL_MM, 0.0, 0.0]),
        np.array([0.0, 0.0, -PIXEL_MM]),
        2.0 * math.pi * np.arange(frames) / (frames - 1),
    )


def hidden(name: str) -> Offsets:
    """The mount of a scan: of the size the thesis found at N = 360, in the mount reading."""
    row = thesis()["table_A_4_at_360"][name]
    values = {n: row[n] for n in SIX}
    return to_printed_reading(Offsets.from_edge(values), Reading.MOUNT_SHIFT)


def number_of(name: str) -> int:
    """The number of a scan in the thesis's tables, 1 to 11."""
    return scan_names().index(name) + 1


def real_runs(
    name: str,
    model: BeadModel,
    seed: int = 1,
    *,
    noise_px: float = NOISE_PX,
    counts: Sequence[int] = COUNTS,
) -> tuple[list[Run], dict[str, object]]:
    """Fits of one scan at every N, with both bookkeepings.

    Args:
        name: of the scan.
        model: the beads as they should be.
        seed: of noise and of the beads' places.
        noise_px: of the detections.
        counts: numbers of projections.

    Returns:
        Runs with the right angles, and the curve of alpha against N: ours, with the thesis's
        bookkeeping, and the thesis's own.
    """
    poses, truth = poses_of(name), hidden(name)
    number = number_of(name)
    off = TOLERANCE_MM * np.random.default_rng([seed, 99]).normal(size=model.beads.shape)
    real = BeadModel(model.beads + off, model.bead_radius_mm)
    rng = np.random.default_rng([seed, 0 if number <= FIRST_MOUNT else 1, number])
    tracks = poses.cone_vec(truth).project_points(real.beads, SHAPE)
    tracks = tracks + noise_px * rng.normal(size=tracks.shape)
    runs, curve = [], {}
    printed = thesis()[f"table_A_{number + 4}_scan_{number}"]
    for n in counts:
        chosen = np.floor(np.linspace(0, FRAMES - 1, n)).astype(np.intp)
        right = _fit(tracks[chosen], model, poses[chosen])
        counted = Poses(
            poses.source[chosen], poses.axis[chosen], poses.detector[chosen], poses.u[chosen],
            poses.v[chosen], 2.0 * math.pi * np.arange(n) / n,
        )  # fmt: skip
        wrong = _fit(tracks[chosen], model, counted)
        errors = errors_of(right.values, in_mount_reading(truth))
        runs.append(
            Run(
                name, f"N = {n}", n, right.identifiable, errors, right.sigmas, right.iterations,
                right.cost_reduction_pct,
                float(np.mean(list(errors.values()))) < 0.2, right.certificate.weak,
            )
        )  # fmt: skip
        curve[str(n)] = {
            "ours_alpha": clean(right.values["alpha"]),
            "thesis_bookkeeping_alpha": clean(wrong.values["alpha"]),
            "thesis_alpha": printed[str(n)]["alpha"] if str(n) in printed else None,
            "thesis_bookkeeping_rms_px": clean(wrong.certificate.rms_px),
            "ours_rms_px": clean(right.certificate.rms_px),
        }
    return runs, {"setting": name, "alpha_by_projections": curve}


def _fit(tracks: np.ndarray, model: BeadModel, poses: Poses) -> FitResult:
    return estimate_geometry(
        tracks, model, poses, shape=SHAPE, noise_px=NOISE_PX, reading=Reading.MOUNT_SHIFT,
        free_beads=True, bead_tolerance_mm=TOLERANCE_MM,
    )  # fmt: skip


def in_mount_reading(truth: Offsets) -> Offsets:
    """The truth in the mount reading, as the fits report it."""
    return from_printed_reading(truth, Reading.MOUNT_SHIFT)


def explained(curves: Sequence[dict[str, object]]) -> dict[str, float]:
    """How well the bookkeeping reproduces the thesis: rms of alpha's change against N = 360.

    Returns:
        `thesis`: rms of the thesis's own change over N < 360 [deg]; `left`: rms of what is left of
        it after subtracting the simulated change; `ours`: rms of our change with right angles.
    """
    own, left, ours = [], [], []
    for curve in curves:
        rows = curve["alpha_by_projections"]
        assert isinstance(rows, dict)
        last = rows.get(str(FRAMES))
        if last is None:
            continue
        for n, row in rows.items():
            if n == str(FRAMES) or row["thesis_alpha"] is None or int(n) < 10:
                continue
            change = row["thesis_alpha"] - last["thesis_alpha"]
            simulated = row["thesis_bookkeeping_alpha"] - last["thesis_bookkeeping_alpha"]
            own.append(change)
            left.append(change - simulated)
            ours.append(row["ours_alpha"] - last["ours_alpha"])

    def rms(values: list[float]) -> float:
        return float(np.sqrt(np.mean(np.square(values)))) if values else math.nan

    return {"thesis": rms(own), "left": rms(left), "ours": rms(ours)}
