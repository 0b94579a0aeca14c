"""Experiment 4's synthetic twin on images: radiographs with beam hardening and photon noise of a
LEGO phantom whose beads are off its model, and a reconstruction of the first scan to find them.

As in the thesis, the bead positions in the first scan's volume are the model with which the other
scans are calibrated. Images are taken at constant speed after the run-up, image i at
i * 360 / (M - 1). The calibration does not know the hidden mount, the true bead positions or the
spectrum. Mount and tolerance are assumed, not the thesis's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from flexdt.twin.calibration import SIX, BeadModel, Reading
from flexdt.twin.calibration.detect.windows import blur_kernel
from flexdt.twin.calibration.fit.priors import exact
from flexdt.twin.calibration.fit.problem import from_printed_reading, to_printed_reading
from flexdt.twin.calibration.frame_source import ArrayFrames
from flexdt.twin.calibration.pipeline import Calibration, CalibrationRequest, Scan, calibrate
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.physics import EffectiveBeam
from flexdt.twin.projection import Scene, Sphere, Volume, project_materials
from flexdt.twin.reconstruction import fdk
from flexdt_extensions.studies.experiments import SHAPE, thesis, unity_poses
from flexdt_extensions.studies.rendered_runs import line_integrals, photons
from flexdt_extensions.studies.runs import Run, fitted_run

FRAMES: Final = 120
"""Frames of a scan here (the thesis took 1434 and 360)."""
COUNTS: Final = (3, 5, 8, 10, 15, 24, 36, 60, 120)
PHOTONS: Final = 20_000.0
BLUR_PX: Final = 0.7
VOXEL_MM: Final = 0.08
"""Assumed: open-beam photons, blur, voxels of the volume the beads are sought in."""
TOLERANCE_MM: Final = 0.03
"""Assumed: how far a bead lies off its model."""


def poses_of(name: str, frames: int) -> Poses:
    """Nominal poses of a scan of Table 6.6; angles by the smooth-scan rule."""
    row = thesis()["table_6_6_scans"][name]
    angle = 2.0 * math.pi * np.arange(frames) / (frames - 1)
    return unity_poses(row["source"], row["object"], row["detector"], angle)


def hidden(name: str) -> Offsets:
    """The mount of a scan: of the size the thesis found at N = 360, in the mount reading."""
    row = thesis()["table_A_4_at_360"][name]
    values = {n: row[n] for n in SIX}
    return to_printed_reading(Offsets.from_edge(values), Reading.MOUNT_SHIFT)


def hidden_phantom(scene: Scene, model: BeadModel, seed: int) -> tuple[Scene, BeadModel]:
    """The phantom as it really is: beads off their model by `real.TOLERANCE_MM`."""
    off = TOLERANCE_MM * np.random.default_rng([seed, 99]).normal(size=model.beads.shape)
    return moved_beads(scene, model, off)


def moved_beads(scene: Scene, model: BeadModel, shift: FloatArray) -> tuple[Scene, BeadModel]:
    """Beads (k, 3) off their model: the solids that are beads move too."""
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
    """Line integrals as a scanner's normalisation gives them, one (rows, cols) a frame.

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


def found_beads(images: Sequence[Float32Array], cone: ConeVec, model: BeadModel) -> BeadModel:
    """Bead centres in the volume that a scan's images give, sought near the model's.

    Args:
        images: line integrals of a full turn.
        cone: their geometry, corrected.
        model: where the beads should be.
    """
    stack = np.stack(images)
    centres = np.empty_like(model.beads)
    for k, (centre, radius) in enumerate(zip(model.beads, model.bead_radius_mm, strict=True)):
        side = 2 * int(np.ceil(1.8 * radius / VOXEL_MM)) + 1
        x0, y0, z0 = centre.tolist()
        grid = Volume(np.zeros((side, side, side), np.float32), VOXEL_MM, (x0, y0, z0))
        data = np.asarray(fdk(stack, cone, grid, window="hann").data, dtype=np.float64)
        weight = np.clip(data - 0.5 * float(np.quantile(data, 0.995)), 0.0, None)
        place = (np.arange(side) - (side - 1) / 2) * VOXEL_MM
        z, y, x = np.meshgrid(place, place, place, indexing="ij")
        for axis, along in enumerate((x, y, z)):
            centres[k, axis] = centre[axis] + float((weight * along).sum() / weight.sum())
    # Their places in each other's frame are found better than the model has them; the volume's
    # scale is no better known than its geometry, which the model's beads gave.
    return BeadModel(centres, model.bead_radius_mm, TOLERANCE_MM, f"{model.name}, reconstructed")


def first_scan(
    name: str, scene: Scene, model: BeadModel, beam: EffectiveBeam, seed: int, frames: int = FRAMES
) -> tuple[BeadModel, Calibration]:
    """Calibrate a scan from the phantom's model, its beads free within their tolerance, reconstruct
    it with the result, and find the beads."""
    really, _ = hidden_phantom(scene, model, seed)
    poses = poses_of(name, frames)
    images = radiographs(really, poses.cone_vec(hidden(name)), beam, [seed, 0])
    request = CalibrationRequest(
        reading=Reading.MOUNT_SHIFT, bead_tolerance_mm=TOLERANCE_MM, priors=exact()
    )
    result = calibrate([Scan(ArrayFrames(images, SHAPE), poses, name)], model, request, scene=scene)
    assert result.fit is not None
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
    """Calibrations of one scan from N of its images, with the beads as they were found.

    Args:
        name: Scan1 to Scan11.
        scene, model: the phantom as designed.
        found: its beads as the first scan's volume shows them.
        beam: effective energies of the images.
        seed: of beads and noise.
        frames: images of the scan.
        counts: numbers of images to calibrate from.
    """
    really, _ = hidden_phantom(scene, model, seed)
    poses, truth = poses_of(name, frames), hidden(name)
    printed = from_printed_reading(truth, Reading.MOUNT_SHIFT)
    images = radiographs(really, poses.cone_vec(truth), beam, [seed, int(name[4:])])
    runs = []
    for n in counts:
        chosen = np.floor(np.linspace(0, frames - 1, n)).astype(np.intp)
        some = ArrayFrames([images[i] for i in chosen], SHAPE)
        result = calibrate(
            [Scan(some, poses[chosen], name)],
            found,
            CalibrationRequest(
                reading=Reading.MOUNT_SHIFT, bead_tolerance_mm=found.tolerance_mm, priors=exact()
            ),
            scene=scene,
        )
        note = "; ".join(f.text for f in result.errors)
        runs.append(fitted_run(name, f"N = {n}", n, result.fit, printed, 0.2, note))
    return runs


def off_truth(found: BeadModel, truth: BeadModel) -> FloatArray:
    """Distance of each found bead from the true one after the best rigid motion, (k,) [mm]."""
    a = found.beads - found.beads.mean(axis=0)
    b = truth.beads - truth.beads.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    flip = np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))])
    return np.asarray(np.linalg.norm(a @ (u @ flip @ vt) - b, axis=1))
