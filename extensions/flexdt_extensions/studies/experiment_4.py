"""Experiment 4: the thesis's 242 fits of eleven real scans, explained by simulation.

Each of the two groups of scans gets one physical truth: axis, mount and the angle of the
first frame. Beads seen under it, by the scanner's smooth-scan rule (image i at i * 360 /
(M - 1)), are fitted as the author's public code does: frames floor(linspace(0, M - 1, N))
with assumed angles 360 n / N, the mount turned by +phi and the phantom by -(phi + alpha),
centroids of binary blobs, Algorithm 2. The truth is fitted so that this reproduces the
logged estimates at N = 360; every other N is predicted. The same spots are also fitted by
ours, with the frames' own angles. The LEGO phantom's beads replace the author's, whose
places are not public; nor are the radiographs.

The experiment's synthetic twin on images has radiographs with beam hardening and photon
noise of a LEGO phantom whose beads are off its model, and a reconstruction of the first
scan to find them.

As in the thesis, the bead positions in the first scan's volume are the model with which
the other scans are calibrated. Images are taken at constant speed after the run-up, image
i at i * 360 / (M - 1). The calibration does not know the hidden mount, the true bead
positions or the spectrum. Mount and tolerance are assumed, not the thesis's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Final

import numpy as np

from flexdt.twin.calibration import SIX, BeadModel, Reading, estimate_geometry
from flexdt.twin.calibration.detect.windows import blur_kernel
from flexdt.twin.calibration.fit.priors import exact
from flexdt.twin.calibration.fit.problem import from_printed_reading, to_printed_reading
from flexdt.twin.calibration.frame_source import ArrayFrames
from flexdt.twin.calibration.pipeline import (
    Calibration,
    CalibrationRequest,
    Scan,
    calibrate,
)
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray, from_unity
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.physics import EffectiveBeam
from flexdt.twin.projection import Scene, Sphere, Volume, project_materials
from flexdt.twin.reconstruction import fdk
from flexdt_extensions.studies.algorithm_2 import (
    SMALL_STEP,
    STEP,
    Iterated,
    bead_pairs,
    iterate,
    stacked,
)
from flexdt_extensions.studies.experiments import (
    PIXEL_MM,
    SHAPE,
    author,
    thesis,
    unity_poses,
)
from flexdt_extensions.studies.rendered_runs import line_integrals, photons
from flexdt_extensions.studies.runs import Run, attempted, clean, fitted_run

STEPS: Final = np.array([STEP, STEP, STEP, SMALL_STEP, SMALL_STEP, SMALL_STEP])
OFFSET_SIGNS: Final = np.array([1.0, 1.0, 1.0, 1.0, 1.0, -1.0])
"""Signs of the author's offsets: they turn against the phantom, so a mount has its z
reversed."""
FITTED_PROJECTIONS: Final = 360
"""Number of projections whose logs give the truth; the others are predicted."""
ENOUGH: Final = 36
"""Least number of projections at which simulation and logs are compared."""
NOISE_SHARE: Final = 1.5
"""Weight of noise in the mean square residual: 1 in ten coordinates a frame, 2 in ten
distances."""
GROUPS: Final = (slice(0, 6), slice(6, 11))
"""Scans 1 to 6 share a mount, the others another (thesis 6.5)."""


@dataclass(frozen=True)
class GroupTruth:
    """Common truth of a group of scans.

    Attributes:
        values: dO [mm], the phantom's angle in the first frame [deg], and the mount's
            place in the world at that frame [mm]; named as in `SIX`.
        noise_px: for each SOD, noise of the detections on top of rounding to agree with
            the logged residuals at N = 360.
    """

    values: FloatArray
    noise_px: Mapping[float, float]


@lru_cache
def scan_names() -> tuple[str, ...]:
    """List Scan1 to Scan11."""
    return tuple(author()["real"]["scans"])


def poses_of(name: str, angle: FloatArray) -> Poses:
    """Make a real scan's nominal poses as the author's code has them, for stage angles
    (n,) [rad].
    """
    real = author()["real"]
    scan = real["scans"][name]
    detector = np.add(scan["detector"], real["detector_added"])
    return unity_poses(scan["source"], scan["object"], detector, angle)


def logged(name: str, used: int) -> tuple[FloatArray, float, int]:
    """Read a fit of the thesis's logs by scan and number of projections.

    Args:
        name: of the scan.
        used: number of projections.

    Returns:
        The six estimates (`SIX`) [mm, deg], rms residual [px], and iterations.
    """
    number = scan_names().index(name) + 1
    row = thesis()[f"table_A_{number + 4}_scan_{number}"][str(used)]
    after, iterations = next(
        f[2:] for f in author()["real"]["scans"][name]["fits"] if f[0] == used
    )
    # Five beads: ten coordinates and ten distances a frame; the cost is half the sum of
    # squares.
    return (
        np.array([row[n] for n in SIX]),
        math.sqrt(2.0 * after / (20 * used)),
        int(iterations),
    )


def counts() -> tuple[int, ...]:
    """List the numbers of projections of the logs."""
    return tuple(int(fit[0]) for fit in author()["real"]["scans"]["Scan1"]["fits"])


def true_angles(name: str, used: int) -> FloatArray:
    """Stage angles [rad] of the frames that the author takes."""
    last = int(author()["real"]["scans"][name]["frames"]) - 1
    return 2.0 * math.pi * np.floor(np.linspace(0, last, used)) / last


def spots(name: str, truth: FloatArray, used: int, model: BeadModel) -> FloatArray:
    """Project the beads of a scan under a truth.

    Args:
        name: of the scan.
        truth: the six values of `GroupTruth` [mm, deg].
        used: number of projections.
        model: k beads.

    Returns:
        (used, k, 2) [px].
    """
    angle = math.radians(truth[3])
    poses = poses_of(name, true_angles(name, used) + angle)
    poses = replace(
        poses,
        axis=poses.axis + from_unity(truth[:3]),
        mount=_rotate(truth[4], truth[5], angle),
    )
    return poses.cone_vec().project_points(model.beads, SHAPE)


def authors_fit(
    name: str, seen: FloatArray, model: BeadModel, radius_px: float | None = None
) -> Iterated:
    """Fit spots as the author's code does: by `iterate` on coordinates and pair
    distances.

    It begins at zero offsets and the nominal start angle, with views spread evenly over
    one turn.

    Args:
        name: of the scan.
        seen: detections (n, k, 2) [px], in the order of the beads.
        model: the beads.
        radius_px: of the blobs, whose centroids are predicted as those of whole pixels;
            None predicts points.
    """
    start = math.radians(author()["real"]["scans"][name]["start_deg"])
    phi = start + 2.0 * math.pi * np.arange(len(seen)) / len(seen)
    poses = poses_of(name, phi)
    whole = np.ones(seen.shape[:2], dtype=np.bool_)
    pairs = bead_pairs(whole)

    def residual(x: FloatArray) -> FloatArray:
        """Compute the residuals [px] at the six values `x`, stacked over the visible
        pairs, as the author's code has them.
        """
        moved = replace(
            poses,
            axis=poses.axis + from_unity(x[:3]) + _rotate(x[4], x[5], phi),
            angle=phi + math.radians(x[3]),
        )
        predicted = moved.cone_vec().project_points(model.beads, SHAPE)
        if radius_px is not None:
            predicted = binary_centroids(predicted, radius_px)
        return stacked(predicted, seen, whole, pairs)

    return iterate(residual, np.zeros(6), STEPS, 1e-2)


def _rotate(x: float, z: float, angle: float | FloatArray) -> FloatArray:
    """Rotate Unity's (x, 0, z) from x to z by an angle [rad]; in the world's axes
    (..., 3)."""
    w = (x + 1j * z) * np.exp(1j * np.asarray(angle))
    return np.stack([w.real, w.imag, np.zeros(w.shape)], axis=-1)


def binary_centroids(centres: FloatArray, radius_px: float) -> FloatArray:
    """Compute centroids (..., 2) [px] of the pixels whose centers are within a radius of
    each center, each pixel counted alike.
    """
    base = np.floor(centres)
    x, y = np.moveaxis(centres - base, -1, 0)[..., None]
    rows = np.arange(-math.ceil(radius_px), math.ceil(radius_px) + 2)
    half = np.sqrt(np.maximum(radius_px**2 - (rows - y) ** 2, -1.0) + 0j)
    first = np.ceil(x - half.real)
    last = np.floor(x + half.real)
    number = np.where(half.imag > 0, 0.0, np.maximum(last - first + 1.0, 0.0))
    total = number.sum(axis=-1)
    across = (number * (first + last) / 2.0).sum(axis=-1) / total
    down = (number * rows).sum(axis=-1) / total
    return np.asarray(base + np.stack([across, down], axis=-1))


def physical_truth(group: slice, model: BeadModel) -> GroupTruth:
    """Estimate the truth of a group of scans by fixed-point iteration, four times.

    With it the simulated estimates at N = 360 differ from the logged ones by a median of
    zero over the group's scans.

    Args:
        group: of `scan_names`.
        model: the beads.

    Returns:
        The six values and, for each SOD, the noise [px] that the logs have beyond the
        simulated fit.
    """
    names = scan_names()[group]
    logs = [logged(name, FITTED_PROJECTIONS) for name in names]
    starts = [author()["real"]["scans"][name]["start_deg"] for name in names]
    values = np.median([values for values, *_ in logs], axis=0) * OFFSET_SIGNS
    values[3] += float(np.median(starts))
    fits: list[Iterated] = []
    for _ in range(4):
        fits = [
            authors_fit(n, spots(n, values, FITTED_PROJECTIONS, model), model)
            for n in names
        ]
        off = [log[0] - fit.x for log, fit in zip(logs, fits, strict=True)]
        values = values + np.median(off, axis=0) * OFFSET_SIGNS
    excess: dict[float, list[float]] = {}
    for name, log, fit in zip(names, logs, fits, strict=True):
        rest = (log[1] ** 2 - 2.0 * fit.cost / (20 * FITTED_PROJECTIONS)) / NOISE_SHARE
        excess.setdefault(_sod(name), []).append(rest)
    noise = {
        sod: math.sqrt(max(float(np.median(rest)), 0.0)) for sod, rest in excess.items()
    }
    return GroupTruth(values, noise)


def _sod(name: str) -> float:
    return float(author()["real"]["scans"][name]["object"][2])


def real_runs(
    name: str,
    model: BeadModel,
    truth: GroupTruth,
    seed: int = 1,
    *,
    exact: bool = False,
    used: Sequence[int] | None = None,
) -> tuple[list[Run], dict[str, Any]]:
    """Fit one scan's simulated spots at every N, by the author's code and ours.

    Estimates are [mm, deg]; ours are None where they are not determined.

    Args:
        name: of the scan.
        model: the beads.
        truth: of the scan's group.
        seed: of the noise.
        exact: points without rounding and noise; the noise counts in the rms residual all
            the same.
        used: numbers of projections; None is those of the logs.

    Returns:
        Runs of ours; and {"setting": name, "by_projections": N as text -> logged and
        simulated estimates, rms [px] and iterations, and our alpha, less the nominal
        start angle [deg], and rms [px]}.
    """
    start = author()["real"]["scans"][name]["start_deg"]
    dO_x, dO_y, dO_z, alpha, *mount = truth.values
    shift = _rotate(mount[0], mount[1], math.radians(alpha))
    hidden = Offsets.from_edge(
        {
            "dO_x": dO_x,
            "dO_y": dO_y,
            "dO_z": dO_z,
            "alpha": alpha,
            "tau_x": -shift[0],
            "tau_z": -shift[1],
        }
    )
    rows = {}
    runs = []
    for n in counts() if used is None else used:
        points = spots(name, truth.values, n, model)
        radius = None
        if not exact:
            first = poses_of(name, np.zeros(1))
            axis = float(first.sod[0] + truth.values[2])
            radius = float(np.mean(model.bead_radius_mm) * first.sdd[0] / axis / PIXEL_MM)
            noise = np.random.default_rng([seed, scan_names().index(name), n])
            points = binary_centroids(points, radius)
            points = points + truth.noise_px[_sod(name)] * noise.normal(size=points.shape)
        theirs = authors_fit(name, points, model, radius)
        square = 2.0 * theirs.cost / (20 * n)
        if exact:
            square += NOISE_SHARE * truth.noise_px[_sod(name)] ** 2
        poses = poses_of(name, true_angles(name, n))
        ours = estimate_geometry(
            points, model, poses, shape=SHAPE, noise_px=0.1, reading=Reading.MOUNT_SHIFT
        )
        runs.append(fitted_run(name, f"N = {n}", n, ours, hidden, 0.2))
        values, rms, iterations = logged(name, n)
        rows[str(n)] = {
            "logged": dict(zip(SIX, values.tolist(), strict=True)),
            "logged_rms_px": rms,
            "logged_iterations": iterations,
            "simulated": dict(zip(SIX, theirs.x.tolist(), strict=True)),
            "simulated_rms_px": math.sqrt(square),
            "simulated_iterations": theirs.iterations,
            # The author counts from the start of the run-up.
            "ours_alpha": clean(ours.values["alpha"] - start),
            "ours_rms_px": clean(ours.certificate.rms_px),
        }
    return runs, {"setting": name, "by_projections": rows}


def explained(curves: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Compare each scan's logs with their simulation, over N from ENOUGH up; scans
    without such N are left out.

    Returns:
        One row a scan: rms and largest absolute difference of alpha [deg]; the rms
        residual's largest difference [%], simulated over logged less 1, with its sign;
        numbers of fits compared and of those within 1 deg and 15 %; the differences' rms
        of the other estimates [mm]; and mean iterations, [logged, simulated].
    """
    out = []
    for curve in curves:
        rows = [row for n, row in curve["by_projections"].items() if int(n) >= ENOUGH]
        if not rows:
            continue
        off = np.array([[r["simulated"][n] - r["logged"][n] for n in SIX] for r in rows])
        rms = np.array(
            [100.0 * (r["simulated_rms_px"] / r["logged_rms_px"] - 1.0) for r in rows]
        )
        alpha = np.abs(off[:, 3])
        both = np.sqrt(np.mean(off**2, axis=0))
        out.append(
            {
                "setting": curve["setting"],
                "alpha_rms_deg": float(both[3]),
                "alpha_largest_deg": float(alpha.max()),
                "rms_largest_pct": float(rms[np.argmax(np.abs(rms))]),
                "fits": len(rows),
                "within": int(((alpha < 1.0) & (np.abs(rms) < 15.0)).sum()),
                "off_mm": {n: float(both[i]) for i, n in enumerate(SIX) if i != 3},
                "iterations": [
                    float(np.mean([r[f"{k}_iterations"] for r in rows]))
                    for k in ("logged", "simulated")
                ],
            }
        )
    return out


FRAMES: Final = 120
"""Number of frames of a scan here (the thesis took 1434 and 360)."""
COUNTS: Final = (3, 5, 8, 10, 15, 24, 36, 60, 120)
PHOTONS: Final = 20_000.0
BLUR_PX: Final = 0.7
VOXEL_MM: Final = 0.08
"""Assumed: open-beam photons, blur [px], and voxel of the volume in which beads are sought
[mm]."""
TOLERANCE_MM: Final = 0.03
"""Assumed: standard deviation of a bead from its model [mm]."""


def nominal_poses(name: str, frames: int) -> Poses:
    """Make nominal poses of a scan of Table 6.6; angles by the smooth-scan rule."""
    row = thesis()["table_6_6_scans"][name]
    angle = 2.0 * math.pi * np.arange(frames) / (frames - 1)
    return unity_poses(row["source"], row["object"], row["detector"], angle)


def hidden(name: str) -> Offsets:
    """Return the mount of a scan: of the thesis's size at N = 360, in the mount
    reading."""
    row = thesis()["table_A_4_at_360"][name]
    values = {n: row[n] for n in SIX}
    return to_printed_reading(Offsets.from_edge(values), Reading.MOUNT_SHIFT)


def hidden_phantom(scene: Scene, model: BeadModel, seed: int) -> tuple[Scene, BeadModel]:
    """Build the true phantom: beads off their model by `real.TOLERANCE_MM`."""
    off = TOLERANCE_MM * np.random.default_rng([seed, 99]).normal(size=model.beads.shape)
    return moved_beads(scene, model, off)


def moved_beads(
    scene: Scene, model: BeadModel, shift: FloatArray
) -> tuple[Scene, BeadModel]:
    """Shift each bead of a model and its solid; every sphere of the scene is taken for
    the nearest bead.

    Args:
        scene: solids of the phantom.
        model: its k beads.
        shift: (k, 3) [mm].

    Returns:
        The scene and the model with shifted beads.
    """
    solids = []
    for solid in scene.solids:
        ball = solid.shape
        if isinstance(ball, Sphere):
            gap = np.linalg.norm(model.beads - np.asarray(ball.center), axis=1)
            x, y, z = (np.asarray(ball.center) + shift[int(np.argmin(gap))]).tolist()
            solid = replace(solid, shape=replace(ball, center=(x, y, z)))
        solids.append(solid)
    return Scene(tuple(solids)), BeadModel(model.beads + shift, model.bead_radius_mm)


def radiographs(
    scene: Scene, cone: ConeVec, beam: EffectiveBeam, seed: Sequence[int]
) -> list[Float32Array]:
    """Simulate line integrals as a scanner's normalization gives them, one (rows, cols) a
    frame.

    Args:
        scene: the solids; every material must be one of the beam's.
        cone: true geometry.
        beam: effective energies of tube, materials and panel.
        seed: of the photon noise; frame i uses [*seed, i].
    """
    import cv2

    kernel = blur_kernel(BLUR_PX)
    none = np.zeros((len(beam.names), 1), dtype=np.float32)
    open_beam = float(beam.transmit(none)[0][0])
    out = []
    for i in range(len(cone)):
        paths = project_materials(scene, cone[i : i + 1], SHAPE)
        stack = np.stack([paths[name][0] for name in beam.names])
        share = beam.transmit(stack)[0] / np.float32(open_beam)
        seen = np.asarray(cv2.sepFilter2D(share, -1, kernel, kernel), dtype=np.float32)
        counts = photons(np.float32(PHOTONS) * seen, np.random.default_rng([*seed, i]))
        out.append(line_integrals(counts, PHOTONS))
    return out


def found_beads(
    images: Sequence[Float32Array], cone: ConeVec, model: BeadModel
) -> BeadModel:
    """Reconstruct a scan near the model's beads and find their centers in the volume.

    A center is the mean place of voxels above half the 99.5 % quantile of the bead's
    grid, weighted by the excess. The beads' tolerance is `TOLERANCE_MM`.

    Args:
        images: line integrals of a full turn.
        cone: their geometry, corrected.
        model: where the beads should be.
    """
    stack = np.stack(images)
    centres = np.empty_like(model.beads)
    for k, (centre, radius) in enumerate(
        zip(model.beads, model.bead_radius_mm, strict=True)
    ):
        side = 2 * int(np.ceil(1.8 * radius / VOXEL_MM)) + 1
        x0, y0, z0 = centre.tolist()
        grid = Volume(np.zeros((side, side, side), np.float32), VOXEL_MM, (x0, y0, z0))
        data = np.asarray(
            fdk(stack, cone, grid, window="hann", errors=False).data, dtype=np.float64
        )
        weight = np.clip(data - 0.5 * float(np.quantile(data, 0.995)), 0.0, None)
        place = (np.arange(side) - (side - 1) / 2) * VOXEL_MM
        z, y, x = np.meshgrid(place, place, place, indexing="ij")
        for axis, along in enumerate((x, y, z)):
            centres[k, axis] = centre[axis] + float((weight * along).sum() / weight.sum())
    # Their places in each other's frame are found better than the model has them; the volume's
    # scale is no better known than its geometry, which the model's beads gave.
    return BeadModel(
        centres, model.bead_radius_mm, TOLERANCE_MM, f"{model.name}, reconstructed"
    )


def first_scan(
    name: str,
    scene: Scene,
    model: BeadModel,
    beam: EffectiveBeam,
    seed: int,
    frames: int = FRAMES,
) -> tuple[BeadModel, Calibration]:
    """Calibrate a scan from the phantom's model, reconstruct it, and find the beads.

    Args:
        name: of the scan.
        scene, model: the phantom as designed; its beads are free within their tolerance.
        beam: effective energies of the images.
        seed: of beads and noise.
        frames: images of the scan.

    Returns:
        The beads found, and the calibration.

    Raises:
        TwinError: the scan's geometry is not determined.
    """
    really, _ = hidden_phantom(scene, model, seed)
    poses = nominal_poses(name, frames)
    images = radiographs(really, poses.cone_vec(hidden(name)), beam, [seed, 0])
    request = CalibrationRequest(
        reading=Reading.MOUNT_SHIFT, bead_tolerance_mm=TOLERANCE_MM, priors=exact()
    )
    result = calibrate(
        [Scan(ArrayFrames(images, SHAPE), poses, name)], model, request, scene=scene
    )
    if result.fit is None:
        reasons = "; ".join(f.text for f in result.errors)
        raise TwinError(
            f"{name}, whose volume gives the beads, has no geometry: {reasons}"
        )
    # The last image repeats the first angle.
    turn = poses[np.arange(frames - 1)].cone_vec(result.fit.parameters)
    return found_beads(images[:-1], turn, model), result


def image_runs(
    name: str,
    scene: Scene,
    model: BeadModel,
    found: BeadModel,
    beam: EffectiveBeam,
    seed: int,
    *,
    frames: int = FRAMES,
    counts: Sequence[int] = COUNTS,
) -> list[Run]:
    """Simulate the images of one scan, with hidden mount and bead places, and calibrate it
    from N of them, with the beads as they were found.

    A run that fails has its error as a note, and its estimates are compared with the
    truth in the printed reading.

    Args:
        name: Scan1 to Scan11.
        scene, model: the phantom as designed.
        found: its beads as the first scan's volume shows them.
        beam: effective energies of the images.
        seed: of beads and noise.
        frames: images of the scan.
        counts: numbers of images to calibrate from, evenly spread.

    Returns:
        A run for each count.
    """
    really, _ = hidden_phantom(scene, model, seed)
    poses = nominal_poses(name, frames)
    truth = hidden(name)
    printed = from_printed_reading(truth, Reading.MOUNT_SHIFT)
    images = radiographs(really, poses.cone_vec(truth), beam, [seed, int(name[4:])])

    def solve(n: int) -> Run:
        """Calibrate from `n` of the images, spread evenly over the scan; returns the run
        with its errors as its note.

        Bead places may shift within the found tolerance; poses are taken as exact.
        """
        chosen = np.floor(np.linspace(0, frames - 1, n)).astype(np.intp)
        some = ArrayFrames([images[i] for i in chosen], SHAPE)
        result = calibrate(
            [Scan(some, poses[chosen], name)],
            found,
            CalibrationRequest(
                reading=Reading.MOUNT_SHIFT,
                bead_tolerance_mm=found.tolerance_mm,
                priors=exact(),
            ),
            scene=scene,
        )
        note = "; ".join(f.text for f in result.errors)
        return fitted_run(name, f"N = {n}", n, result.fit, printed, 0.2, note)

    return [attempted(name, f"N = {n}", n, solve) for n in counts]


def off_truth(found: BeadModel, truth: BeadModel) -> FloatArray:
    """Compare found beads with the true ones after the best rigid motion: distances
    (k,) [mm]."""
    a = found.beads - found.beads.mean(axis=0)
    b = truth.beads - truth.beads.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    flip = np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))])
    return np.asarray(np.linalg.norm(a @ (u @ flip @ vt) - b, axis=1))
