"""Anybody's calibration: markers of unknown positions, and markers that were marked by hand.

`python tests/studies/unknown_markers.py [--scans 10] [--drawn 200] [--hand 200] [--write
DIR]` renders scans of 5 to 20 balls (rays and planes of `prior_coverage`, nothing of the fit's
model), finds and links their spots without knowing how many there are, and compares the
positions found with the true ones up to place, turn and scale. `--drawn` does the same with 36
views of 12 markers of 0.05 px noise instead of images, `--hand` with annotations: 10 views of
12 markers, 0.5 px noise and a fifth missing. Each prints errors over sigmas. `--write` makes a
folder of float TIFFs, their geometry and such annotations, for `flexdt calibrate --frames` and
`--markers`.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from prior_coverage import PIXEL, SDD, SHAPE, SOD, drawn, pixels, radiographs

from flexdt.library.calibration.markers import (
    Markers,
    Scale,
    calibrate_unknown,
    seen_alone,
)
from flexdt.library.data_set import DataSet
from flexdt.library.reading.listed_images import markers_alone
from flexdt.twin.calibration.frame_source import ArrayFrames
from flexdt.twin.calibration.pipeline import Calibration, CalibrationRequest
from flexdt.twin.geometry.cone_vec import ConeVec

Array = npt.NDArray[np.float64]
SMALL: Final = (0.5, 0.8)
"""Radius [mm] and attenuation [1/mm] of the balls."""
APART: Final = 3.0
"""Balls are at least so far from each other [mm]."""
SIGMA_PX: Final = 0.05
HAND_PX: Final = 0.5


def geometry(angles: Array) -> ConeVec:
    """Return the nominal scan, as a foreign scanner would state it."""
    return ConeVec.circular(sod=SOD, sdd=SDD, angles=angles, shape=SHAPE, pixel=PIXEL)


def balls(rng: np.random.Generator, count: int) -> Array:
    """Draw positions (count, 3) [mm] more than APART from each other."""
    out: list[Array] = []
    while len(out) < count:
        new = rng.uniform([-13, -13, -20], [13, 13, 20])
        if all(np.linalg.norm(new - b) > APART for b in out):
            out.append(new)
    return np.array(out)


def unlike(found: Array, true: Array) -> tuple[float, float]:
    """Compare two sets of points, (k, 3) each in the same order, after the best shift,
    turn and scale (Umeyama 1991).

    Returns:
        Largest difference of a coordinate at the true scale [mm], and the factor by which
        the found points become as large as the true ones.
    """
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    u, s, vt = np.linalg.svd(a.T @ b)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    scale = float((s * np.diag(sign)).sum() / (a**2).sum())
    return float(np.abs(scale * a @ u @ sign @ vt - b).max()), scale


def truth_of(rng: np.random.Generator) -> dict[str, float]:
    """Draw offsets from their ranges and priors.

    Turn, height and place on the axis belong to the markers' own frame, and the axis's
    distance to their scale: these are 0.
    """
    return drawn(rng, 1.0, False) | {
        "alpha": 0.0,
        "tau_x": 0.0,
        "tau_z": 0.0,
        "dO_z": 0.0,
    }


def pulls(found: Calibration, truth: Mapping[str, float]) -> dict[str, float]:
    """Compute error over sigma of each parameter that images of unknown markers
    determine.
    """
    assert found.fit is not None
    fit = found.fit
    told = ("dO_x", "dD_x", "dD_z", "det_roll", "det_pitch", "det_yaw", "axis_tilt_z")
    return {n: (fit.values[n] - truth[n]) / fit.sigmas[n] for n in told}


def rendered(seed: int, frames: int = 36) -> dict[str, Any]:
    """Calibrate one scan of unknown balls from rendered images.

    Args:
        seed: of all draws.
        frames: of the turn.

    Returns:
        Numbers of balls and of those found, residual [px], largest error of a position
        [um], scale, whether identifiable, and pulls.
    """
    rng = np.random.default_rng([7, seed])
    truth, beads = truth_of(rng), balls(rng, int(rng.integers(5, 21)))
    angles = 360.0 * np.arange(frames) / frames
    images = radiographs(rng, beads, angles, SOD, truth, *SMALL)
    data = markers_alone(geometry(angles), "rendered")
    found, told = calibrate_unknown(
        data, ArrayFrames(images, SHAPE), None, CalibrationRequest(free=("dO_x",))
    )
    assert found.fit is not None
    fit = found.fit
    seen = pixels(beads, angles, SOD, truth)
    gap = np.linalg.norm(seen[:, :, None] - fit.problem.pixels[:, None], axis=3)
    which = np.nanmean(gap, axis=0).argmin(axis=0)
    worst, scale = unlike(fit.beads, beads[which])
    return {
        "beads": len(beads), "found": len(set(which.tolist())), "rms_px": fit.certificate.rms_px,
        "worst_um": 1000.0 * worst, "scale": scale, "identifiable": found.identifiable,
        "told": told, "pulls": pulls(found, truth),
    }  # fmt: skip


def marked(
    seed: int, views: int, count: int, noise: float, missing: float
) -> tuple[dict[str, float], Array, Array, Markers]:
    """Draw a scan and noisy annotations of its markers, some missing.

    Args:
        seed: of all draws.
        views: of the turn.
        count: markers.
        noise: of an annotation [px].
        missing: share of annotations.

    Returns:
        True offsets, angles [deg], positions (count, 3) [mm] and annotations.
    """
    rng = np.random.default_rng([8, seed])
    truth, beads = truth_of(rng), balls(rng, count)
    angles = 360.0 * np.arange(views) / views
    tracks = pixels(beads, angles, SOD, truth)
    tracks += noise * rng.normal(size=tracks.shape)
    tracks[rng.random(tracks.shape[:2]) < missing] = np.nan
    names = tuple(str(k) for k in range(count))
    return truth, angles, beads, Markers(names, tracks, np.full(tracks.shape[:2], noise))


def annotated(
    seed: int,
    views: int = 10,
    count: int = 12,
    noise: float = HAND_PX,
    missing: float = 0.2,
) -> dict[str, Any]:
    """Calibrate from annotations with the known distance of two markers; arguments as of
    `marked`.

    Returns:
        Residual [px], whether identifiable, pulls, largest error of a position [mm], and
        findings.
    """
    truth, angles, beads, markers = marked(seed, views, count, noise, missing)
    data = markers_alone(geometry(angles), "marked")
    (some,), markers = seen_alone(data, markers)
    mm = float(np.linalg.norm(beads[0] - beads[1]))
    found, told = calibrate_unknown(
        some,
        None,
        markers,
        CalibrationRequest(free=("dO_x",)),
        Scale("0", "1", mm, 0.001 * mm),
    )
    assert found.fit is not None
    return {
        "rms_px": found.fit.certificate.rms_px, "identifiable": found.identifiable, "told": told,
        "pulls": pulls(found, truth), "worst_mm": unlike(found.fit.beads, beads)[0],
        "findings": [f.code for f in found.findings],
    }  # fmt: skip


def write(folder: Path, seed: int = 0, views: int = 36) -> DataSet:
    """Write radiographs of 8 balls as float TIFFs in `frames` within a folder, with
    geometry.json (nominal) and markers.csv beside `frames`.

    The annotations in markers.csv are noisy, some are missing, and they are of 12 other
    markers, drawn apart: none of the balls in the images.

    Args:
        folder: gets them; made if it is not there, and must not contain `frames`.
        seed: of all draws.
        views: of the turn.

    Returns:
        The data set of the annotations: nominal geometry, no images.

    Raises:
        FileExistsError: `frames` is there already.
    """
    import tifffile

    rng = np.random.default_rng([7, seed])
    truth, beads = truth_of(rng), balls(rng, 8)
    angles = 360.0 * np.arange(views) / views
    frames = folder / "frames"
    frames.mkdir(parents=True)
    for i, image in enumerate(radiographs(rng, beads, angles, SOD, truth, *SMALL)):
        tifffile.imwrite(frames / f"view{i}.tif", image)
    scan = geometry(angles)
    scan.save(folder / "geometry.json")
    _, _, _, markers = marked(seed, views, 12, HAND_PX, 0.75 if views > 20 else 0.2)
    with (folder / "markers.csv").open("w", newline="", encoding="utf-8") as file:
        out = csv.writer(file)
        out.writerow(["frame", "marker", "column", "row"])
        for i, k in np.argwhere(np.isfinite(markers.tracks).all(axis=2)).tolist():
            out.writerow([i, k, *np.round(markers.tracks[i, k], 2).tolist()])
    return replace(markers_alone(scan, "written"), folder=folder)


def spread(rows: Sequence[Mapping[str, Any]]) -> str:
    """Format the root mean square of the pulls of each parameter, in words."""
    names = rows[0]["pulls"]
    return ", ".join(
        f"{n} {np.sqrt(np.mean([r['pulls'][n] ** 2 for r in rows])):.2f}" for n in names
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Calibrate unknown markers from images, positions and annotations, and print the
    results; returns 0.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=0, help="from images")
    parser.add_argument("--drawn", type=int, default=0, help="from positions")
    parser.add_argument("--hand", type=int, default=0, help="from annotations")
    parser.add_argument("--write", type=Path, default=None)
    a = parser.parse_args(argv)
    if a.write is not None:
        write(a.write)
    rows = [rendered(i) for i in range(a.scans)]
    for r in rows:
        print(f"{r['beads']} balls, {r['found']} found, rms {r['rms_px']:.4f} px, positions within "
              f"{r['worst_um']:.2f} um, scale {r['scale']:.4f}")  # fmt: skip
    cases = (
        ("images", rows),
        ("positions", [annotated(i, 36, 12, SIGMA_PX, 0.1) for i in range(a.drawn)]),
        ("annotations", [annotated(i) for i in range(a.hand)]),
    )
    for what, some in cases:
        if some:
            print(f"{what}: {len(some)}, identifiable {sum(r['identifiable'] for r in some)}, rms "
                  f"{np.mean([r['rms_px'] for r in some]):.3f} px; rms of error / sigma: "
                  f"{spread(some)}")  # fmt: skip
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
