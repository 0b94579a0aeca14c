"""Rendered radiographs for the studies, and runs of the full pipeline on them, identities
unknown.

Pixels integrate the intensity over 4 x 4 points wherever a bead is near, as a real detector
does; a ball sampled once a pixel moves by 0.006 px. The image is blurred, and photons are
counted. The pipeline knows the nominal poses and the phantom only.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration import BeadModel
from flexdt.twin.calibration.detect.detection import SpotFinder
from flexdt.twin.calibration.detect.windows import (
    Windows,
    blur_kernel,
    crop,
    overlap,
    plan_windows,
    window_intensities,
)
from flexdt.twin.calibration.fit.priors import exact
from flexdt.twin.calibration.frame_source import FrameSpots, look_at
from flexdt.twin.calibration.pipeline import (
    CalibrationRequest,
    Scan,
    calibrate,
    detector_for,
)
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.projection import Scene, project_scene
from flexdt_extensions.studies.experiments import SHAPE, WorkUnit, require_counts
from flexdt_extensions.studies.runs import Run, attempted, geometry_of, run_of

COUNTS = 5000.0
"""Open-beam photons of a pixel in noisy images (calibration.md)."""
BLUR_PX = 0.7
"""Blur of noisy images, standard deviation [px]."""
FINE = 4
"""Number of points along each side of a pixel near a bead."""


@dataclass(frozen=True)
class Rendering:
    """How images are made. counts: open-beam photons, None for no noise; blur in pixels."""

    counts: float | None = COUNTS
    blur_px: float = BLUR_PX
    fine: int = FINE


CLEAN = Rendering(counts=None, blur_px=0.0, fine=1)
"""Rendering of exact line integrals: one ray a pixel, no blur, no noise."""


def intensities(
    scene: Scene,
    model: BeadModel,
    cone: ConeVec,
    shape: tuple[int, int],
    fine: int = FINE,
) -> Float32Array:
    """Compute the transmitted share of the open beam at pixel centers, near beads as a
    mean over the pixel.

    Args:
        scene: to render.
        model: its beads.
        cone: n views.
        shape: (rows, cols).
        fine: rays along each side of a pixel near beads; 1 or less: none but the
            centre's.

    Returns:
        (n, rows, cols), from 0 to 1.
    """
    out = np.exp(-project_scene(scene, cone, shape))
    if fine <= 1:
        return out
    plan = plan_windows(model, cone, shape)
    n, k = plan.corner.shape[:2]
    windows = window_intensities(scene, cone, plan, fine)
    for f in range(n):
        for b in range(k):
            inside, there = overlap(plan, f, b)
            out[f][there] = windows[f, b][inside]
    return out


@dataclass(frozen=True, eq=False)
class RenderedFrames:
    """Radiographs of one scan, kept small: counts, or clean line integrals round the
    object.

    Attributes:
        kept: uint16 counts (rows, cols), or float32 line integrals of the part that is
            not zero.
        corner: (row, column) of each kept part.
        looks: spots found in each.
        shape: (rows, cols).
        camera: noise and blur.
    """

    kept: tuple[npt.NDArray[np.generic], ...]
    corner: tuple[tuple[int, int], ...]
    looks: tuple[FrameSpots, ...]
    shape: tuple[int, int]
    camera: Rendering

    def __len__(self) -> int:
        return len(self.kept)

    def look(self, detector: SpotFinder) -> list[FrameSpots]:
        """Return the spots found when the frames were made (the detector is the same)."""
        return list(self.looks)

    def windows(self, plan: Windows) -> Float32Array:
        """Cut windows (n, k, side, side) of line integrals out of the images; see
        `Frames`.

        With a camera that counts, they are made from its counts, else they are noiseless.
        """
        n, k = plan.corner.shape[:2]
        out = np.empty((n, k, plan.side, plan.side), dtype=np.float32)
        for i in range(n):
            if self.camera.counts is None:
                out[i] = crop(self.image(i), plan, i)
            else:
                # No photon counts as half of one; outside the image there is nothing.
                counts = crop(self.kept[i], plan, i)
                out[i] = line_integrals(counts, self.camera.counts)
        return out

    def image(self, index: int) -> Float32Array:
        """Compute the line integrals of one frame, (rows, cols); without counts zero
        outside the part that was kept.
        """
        kept = self.kept[index]
        (top, left) = self.corner[index]
        if self.camera.counts is not None:
            return line_integrals(kept, self.camera.counts)
        full = np.zeros(self.shape, dtype=np.float32)
        full[top : top + kept.shape[0], left : left + kept.shape[1]] = kept
        return full

    def take(self, frames: Sequence[int]) -> RenderedFrames:
        """Return some of the frames, by number and in this order, as frames of their own."""
        return RenderedFrames(
            tuple(self.kept[i] for i in frames),
            tuple(self.corner[i] for i in frames),
            tuple(self.looks[i] for i in frames),
            self.shape,
            self.camera,
        )


def line_integrals(counts: npt.NDArray[np.generic], open_counts: float) -> Float32Array:
    """Compute -ln(counts / open beam); a count of zero is taken as a half."""
    floor = np.maximum(counts.astype(np.float32), np.float32(0.5))
    return np.asarray(np.float32(np.log(open_counts)) - np.log(floor), dtype=np.float32)


def render(
    scene: Scene,
    model: BeadModel,
    poses: Poses,
    truth: Offsets,
    camera: Rendering,
    seed: Sequence[int],
    shape: tuple[int, int] = SHAPE,
) -> RenderedFrames:
    """Make the radiographs of a scan and detect the beads in them.

    Images without noise are line integrals, cropped to the part that is not zero; noisy
    ones are whole, as counts.

    Args:
        scene: the phantom's solids.
        model: its beads, near which pixels integrate.
        poses: nominal poses.
        truth: the hidden geometry the images are made with.
        camera: noise and blur.
        seed: key of the noise; frame i uses [*seed, i].
        shape: (rows, cols).

    Returns:
        The images with their corners, and the spots found in each.
    """
    detector = detector_for(model, poses)
    kept: list[npt.NDArray[np.generic]] = []
    corner: list[tuple[int, int]] = []
    looks: list[FrameSpots] = []
    for image in exposures(scene, model, poses.cone_vec(truth), camera, seed, shape):
        if camera.counts is None:
            rows = np.nonzero(image.any(axis=1))[0]
            cols = np.nonzero(image.any(axis=0))[0]
            box = (
                slice(int(rows[0]), int(rows[-1]) + 1) if len(rows) else slice(0, 1),
                slice(int(cols[0]), int(cols[-1]) + 1) if len(cols) else slice(0, 1),
            )
            kept.append(image[box].astype(np.float32))
            corner.append((box[0].start, box[1].start))
            looks.append(look_at(image.astype(np.float32), detector))
        else:
            kept.append(image)
            corner.append((0, 0))
            looks.append(look_at(line_integrals(image, camera.counts), detector))
    return RenderedFrames(tuple(kept), tuple(corner), tuple(looks), shape, camera)


def exposures(
    scene: Scene,
    model: BeadModel,
    cone: ConeVec,
    camera: Rendering,
    seed: Sequence[int],
    shape: tuple[int, int] = SHAPE,
) -> Iterator[npt.NDArray[np.generic]]:
    """Render the frames of a scan one after the other: uint16 counts (rows, cols), or
    line integrals without noise.

    Args:
        scene: the phantom's solids.
        model: its beads, near which pixels integrate.
        cone: true geometry.
        camera: noise and blur.
        seed: key of the noise; frame i uses [*seed, i].
        shape: (rows, cols).
    """
    block = 12
    # Blur brings in signal from just outside the detector.
    margin = math.ceil(4.0 * camera.blur_px)
    rows, cols = shape
    wide = (rows + 2 * margin, cols + 2 * margin)
    if camera.blur_px > 0:
        kernel = blur_kernel(camera.blur_px)
    else:
        kernel = None
    for start in range(0, len(cone), block):
        part = cone[start : start + block]
        for i, image in enumerate(intensities(scene, model, part, wide, camera.fine)):
            if kernel is not None:
                image = cv2.sepFilter2D(image, -1, kernel, kernel)
                image = image[margin : margin + rows, margin : margin + cols]
            if camera.counts is None:
                yield -np.log(image)
            else:
                rng = np.random.default_rng([*seed, start + i])
                yield photons(np.float32(camera.counts) * image, rng)


def photons(expected: Float32Array, rng: np.random.Generator) -> npt.NDArray[np.uint16]:
    """Draw Poisson counts, (rows, cols)."""
    return np.asarray(np.minimum(rng.poisson(expected), 65535), np.uint16)


_made: dict[tuple[object, ...], tuple[RenderedFrames, ...]] = {}
"""The radiographs of the last task; tasks that differ in the solver alone share them."""


def image_runs(task: WorkUnit, model: BeadModel, scene: Scene) -> list[Run]:
    """Calibrate rendered images with each number of projections of a task, identities
    unknown; a failure is a run, too.

    The images of the largest N are made once; smaller N take every so many of them, with
    the same noise.

    Args:
        task: one setting in one scenario.
        model: the beads.
        scene: the phantom.

    Raises:
        LimitError: some N do not divide the largest.
    """
    require_counts(task.counts, rendered=True)
    most = max(task.counts)

    def solve(n: int) -> Run:
        """Calibrate from `n` of the images; without a result the note gives the reason.

        They are spread evenly; offsets have no prior, and the phantom is as exact as the
        thesis takes it to be. A run with errors has no problem to judge.
        """
        everything, truth = geometry_of(task, most)
        chosen = list(range(0, most, most // n))
        scans = [
            Scan(frames.take(chosen), poses[np.array(chosen)], f"placement {g + 1}")
            for g, (frames, poses) in enumerate(
                zip(_render(task, model, scene), everything, strict=True)
            )
        ]
        result = calibrate(
            scans,
            model,
            CalibrationRequest(
                free=task.free, priors=exact(task.free), bead_tolerance_mm=0.0
            ),
            scene=scene,
        )
        note = "; ".join(f.text for f in result.errors)
        if result.fit is None or note:
            problem = None
        else:
            problem = result.fit.problem
        return run_of(task, n, result.fit, truth, problem, note)

    return [attempted(task.setting, task.scenario, n, solve) for n in task.counts]


def _render(task: WorkUnit, model: BeadModel, scene: Scene) -> tuple[RenderedFrames, ...]:
    """Render the radiographs of a task's largest number of projections, or return those
    of the last call if it had the same.

    The radiographs of the last key are kept, and replaced by those of another.

    Args:
        task: its phantom, scenario, fidelity and seed.
        model: the beads.
        scene: the phantom.

    Returns:
        One scan for each placement.
    """
    if task.fidelity == "clean":
        camera = CLEAN
    else:
        camera = Rendering()
    most = max(task.counts)
    everything, truth = geometry_of(task, most)
    placements = task.experiment == "detector" and task.setting
    key = task.phantom, placements, task.scenario, task.variant, most, camera, task.seed
    if key not in _made:
        _made.clear()
        seed = [task.seed, *f"{task.phantom}{placements}{task.scenario}".encode()]
        _made[key] = tuple(
            render(scene, model, poses, truth, camera, [*seed, g])
            for g, poses in enumerate(everything)
        )
    return _made[key]
