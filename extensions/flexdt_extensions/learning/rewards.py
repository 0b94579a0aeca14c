"""Values of an agent's frames: information about the geometry, or a reconstruction.

A task knows the hidden truth, renders the detector's images and scores the gain of each
frame.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.phantoms import Phantom, load_phantom, material
from flexdt.twin.calibration import (
    SIX,
    bead_model,
    build_problem,
    edge_factor,
    spot_radii,
    tolerance_of,
    visible_beads,
)
from flexdt.twin.calibration.identify import overlapping
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.projection import (
    Box,
    Ellipsoid,
    Scene,
    Solid,
    Volume,
    forward,
    project_scene,
)
from flexdt.twin.reconstruction import sirt
from flexdt_extensions.learning.moved_scanner import Lab

Vector = tuple[float, float, float]
NOISE_PX: Final = 0.1
PRIOR: Final = 50.0
"""Standard deviation of every parameter before the first frame, in tolerances (10 mm, 10
deg)."""
SIDE_MM: Final = 50.0
GRID: Final = 20
"""Number of voxels along each side of a reconstruction of SIDE_MM."""
PHOTONS: Final = 2e4
"""Open-beam photons of a coarse pixel."""
ITERATIONS: Final = 6
"""Number of SIRT iterations after each frame."""
COARSE: Final = 10
"""Number of columns along each side of the model that a planner's forecast of quality
uses."""


class InformationTask:
    """Calibrate with the LEGO phantom: worth is the Fisher information gained [nats].

    Half the increase of log det (prior + information), evaluated at a hidden misalignment.
    Beads that leave the detector or hide each other add nothing.
    """

    features = len(SIX)

    def __init__(self) -> None:
        """Begin with the LEGO phantom at nominal offsets; the information is that of the
        prior alone.
        """
        self.phantom = load_phantom("lego")
        self.size_mm = self.phantom.size_mm
        self._model = bead_model(self.phantom)
        self._truth = NOMINAL
        self._information = np.eye(len(SIX)) / PRIOR**2

    def reset(self, lab: Lab, rng: np.random.Generator) -> None:
        """Draw new true offsets of a few millimeters and degrees, and forget what was
        measured: only the prior is known. `lab` is ignored.
        """
        shift = rng.normal(0.0, 2.0, 3)
        tau = rng.normal(0.0, 1.0, 2)
        self._truth = Offsets.from_edge(
            {
                "dO_x": shift[0],
                "dO_y": shift[1],
                "dO_z": shift[2],
                "alpha": rng.normal(0.0, 5.0),
                "tau_x": tau[0],
                "tau_z": tau[1],
            }
        )
        self._information = np.eye(len(SIX)) / PRIOR**2

    def add(self, lab: Lab, poses: Poses, rng: np.random.Generator) -> float:
        """Take one frame and return the information gained [nats]."""
        before = _log_det(self._information)
        self._information = self._information + self._of(lab, poses, self._truth)[0]
        return 0.5 * (_log_det(self._information) - before)

    def state(self) -> Float32Array:
        """Return the logarithm of each sigma, clipped to -1...1: -1 for a thousandth of
        its tolerance, +1 for the prior.

        Sigmas belong to the hidden geometry; an estimate's would differ from them by
        little.
        """
        sigma = np.sqrt(np.diag(np.linalg.inv(self._information)))
        span = math.log10(PRIOR) + 3.0
        return np.asarray(
            np.clip(2.0 * (np.log10(sigma) + 3.0) / span - 1.0, -1, 1), np.float32
        )

    def show(self, lab: Lab, poses: Poses) -> Float32Array:
        """Compute line integrals on the coarse detector without noise, (rows, cols)."""
        cone = lab.small(poses, self._truth)
        return np.asarray(project_scene(self.phantom.scene, cone, lab.small_shape)[0])

    def forecast(self, lab: Lab, poses: Poses) -> FloatArray:
        """Compute the expected gain at the nominal geometry, given the information so
        far."""
        more = self._information + self._of(lab, poses, NOMINAL)
        return np.array([0.5 * (_log_det(m) - _log_det(self._information)) for m in more])

    def info(self) -> dict[str, float]:
        """Return the information so far (half the growth of its log determinant) and the
        worst sigma, in tolerances.
        """
        start = _log_det(np.eye(len(SIX)) / PRIOR**2)
        return {
            "information": 0.5 * (_log_det(self._information) - start),
            "worst_sigma": float(
                np.sqrt(np.diag(np.linalg.inv(self._information)).max())
            ),
        }

    def _of(self, lab: Lab, poses: Poses, at: Offsets) -> FloatArray:
        """Compute the information of each frame, (n, p, p), parameters in tolerances.

        It is that of the beads' spots with a noise of NOISE_PX; spots that overlap or are
        not visible give none.

        Args:
            lab: its detector.
            poses: n frames.
            at: offsets.
        """
        n = len(poses)
        k = len(self._model)
        sizes = np.broadcast_to(np.asarray(lab.shape, dtype=np.float64), (n, 2))
        problem = build_problem(
            np.zeros((n, k, 2)),
            self._model,
            poses,
            free=SIX,
            shape=sizes,
            noise_px=NOISE_PX,
            start=at,
        )
        names = problem.layout.names
        scale = np.array([tolerance_of(name) / edge_factor(name) for name in names])
        rows = (problem.jacobian(problem.start) * scale).reshape(n, k, 2, -1)
        pixels = poses.cone_vec(at).project_points(self._model.beads, lab.shape)
        seen = visible_beads(self._model, poses, sizes, at)
        seen &= ~overlapping(pixels, spot_radii(self._model, poses.cone_vec(at)))
        rows = rows * seen[..., None, None]
        return np.asarray(np.einsum("nkip,nkiq->npq", rows, rows))


class QualityTask:
    """Reconstruct a hidden object: worth is the drop of the volume's error.

    Quality is 1 - RMSE / RMS of the truth after warm-started SIRT on all frames so far.

    Args:
        draw: makes the objects, within 50 mm.
    """

    features = 2

    def __init__(
        self, draw: Callable[[np.random.Generator], Phantom] | None = None
    ) -> None:
        self.draw = random_object if draw is None else draw
        self.size_mm = (SIDE_MM, SIDE_MM, SIDE_MM)
        self._start(blank(), Scene(()))

    def _start(self, truth: Volume, scene: Scene) -> None:
        """Begin an episode with another object: no images, a blank volume, quality 0 and
        residual 1.
        """
        self._truth = truth
        self._scene = scene
        self.volume = blank()
        self.images: list[Float32Array] = []
        self._cones: list[ConeVec] = []
        self._precision = np.eye(COARSE * COARSE)
        self._quality = 0.0
        self._residual = 1.0

    def reset(self, lab: Lab, rng: np.random.Generator) -> None:
        """Draw a new object."""
        phantom = self.draw(rng)
        self._start(phantom.volume(SIDE_MM / GRID), phantom.scene)

    def add(self, lab: Lab, poses: Poses, rng: np.random.Generator) -> float:
        """Take one frame, go on with SIRT on all frames so far, and return the gain in
        quality.

        SIRT runs ITERATIONS from the present volume on; the noise is that of `PHOTONS`.

        Args:
            lab: the scanner.
            poses: of the frame.
            rng: of the noise.
        """
        cone = lab.small(poses, NOMINAL)
        image = noisy(self.show(lab, poses), PHOTONS, rng)
        self.images.append(image)
        self._cones.append(cone)
        self._precision += column_information(lab, cone)[0]
        geometry = ConeVec.concatenate(self._cones)
        images = np.stack(self.images)
        x = self.volume
        with (
            warnings.catch_warnings()
        ):  # the first frames of every episode are a limited arc
            warnings.filterwarnings("ignore", "the views leave out")
            self.volume = sirt(
                images, geometry, x, iterations=ITERATIONS, start=x, nonnegative=True
            )
        rest = images - forward(self.volume, geometry, lab.small_shape)
        self._residual = float(
            np.sqrt(np.mean(rest**2) / max(float(np.mean(images**2)), 1e-12))
        )
        return self.judge()

    def judge(self) -> float:
        """Compute the gain in quality of the last reconstruction."""
        before = self._quality
        self._quality = quality(self.volume, self._truth)
        return self._quality - before

    def state(self) -> Float32Array:
        """Return the residual of the present reconstruction, and the determined part
        of the object."""
        known = 1.0 - 1.0 / (1.0 + np.log(np.linalg.eigvalsh(self._precision)).mean())
        return np.array([min(self._residual, 1.0), min(max(known, 0.0), 1.0)], np.float32)

    def show(self, lab: Lab, poses: Poses) -> Float32Array:
        """Compute line integrals on the coarse detector; see `InformationTask`."""
        cone = lab.small(poses, NOMINAL)
        return np.asarray(project_scene(self._scene, cone, lab.small_shape)[0])

    def forecast(self, lab: Lab, poses: Poses) -> FloatArray:
        """Compute the expected information about any object of upright columns [nats]."""
        more = self._precision + column_information(lab, lab.small(poses, NOMINAL))
        return np.array([0.5 * (_log_det(m) - _log_det(self._precision)) for m in more])

    def info(self) -> dict[str, float]:
        """Return quality and residual so far."""
        return {"quality": self._quality, "residual": self._residual}


def random_object(rng: np.random.Generator) -> Phantom:
    """Draw a water body, elongated and turned about z, with four to seven ellipsoids in
    it; within 50 mm.

    Each ellipsoid adds -0.8, 1 or 2 times water's attenuation.
    """
    water = material("water").mu_per_mm
    turn = rng.uniform(0.0, math.pi)
    body = Ellipsoid(
        (0.0, 0.0, 0.0),
        (rng.uniform(18, 23), rng.uniform(8, 14), rng.uniform(15, 20)),
        _turned_axes(turn),
    )
    solids = [Solid(body, "water", water)]
    for _ in range(int(rng.integers(4, 8))):
        along = rng.uniform(-12, 12)
        across = rng.uniform(-4, 4)
        x = along * math.cos(turn) - across * math.sin(turn)
        y = along * math.sin(turn) + across * math.cos(turn)
        a, b, c = rng.uniform(2.0, 4.5, 3)
        shape = Ellipsoid(
            (x, y, rng.uniform(-8, 8)), (a, b, c), _turned_axes(rng.uniform(0, math.pi))
        )
        solids.append(Solid(shape, "water", water * rng.choice([-0.8, 1.0, 2.0])))
    return Phantom(
        "random", "random ellipsoids", Scene(tuple(solids)), (SIDE_MM, SIDE_MM, SIDE_MM)
    )


def random_plates(rng: np.random.Generator) -> Phantom:
    """Draw one or two parallel upright plates of twice water's attenuation, within 50 mm,
    turned by any angle about z.

    A few views see them edge-on.
    """
    water = material("water").mu_per_mm
    axes = _turned_axes(rng.uniform(0.0, math.pi))
    count = int(rng.integers(1, 3))
    apart = rng.uniform(12.0, 18.0)
    start = rng.uniform(-4.0, 4.0)
    solids = []
    for i in range(count):
        across = start + apart * (i - (count - 1) / 2.0)
        center = (across * axes[1][0], across * axes[1][1], rng.uniform(-4.0, 4.0))
        size = (rng.uniform(20.0, 32.0), rng.uniform(4.0, 8.0), rng.uniform(15.0, 30.0))
        solids.append(Solid(Box(center, size, axes), "water", 2.0 * water))
    return Phantom(
        "plates", "random plates", Scene(tuple(solids)), (SIDE_MM, SIDE_MM, SIDE_MM)
    )


def noisy(image: Float32Array, photons: float, rng: np.random.Generator) -> Float32Array:
    """Add the noise of `photons` in the open beam to line integrals."""
    counts = rng.poisson(photons * np.exp(-image.astype(np.float64)))
    return np.asarray(np.log(photons) - np.log(np.maximum(counts, 0.5)), dtype=np.float32)


def quality(volume: Volume, truth: Volume) -> float:
    """Compute 1 - RMSE / RMS of the truth; 0 for an empty volume, 1 for a perfect one."""
    rms = float(np.sqrt(np.mean(truth.data.astype(np.float64) ** 2)))
    error = volume.data.astype(np.float64) - truth.data
    return 1.0 - float(np.sqrt(np.mean(error**2))) / rms


def _turned_axes(angle: float) -> tuple[Vector, Vector, Vector]:
    c = math.cos(angle)
    s = math.sin(angle)
    return ((c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0))


def blank() -> Volume:
    """Make the grid of reconstructions, at zero."""
    return Volume(np.zeros((GRID, GRID, GRID), np.float32), SIDE_MM / GRID)


def column_information(lab: Lab, cone: ConeVec) -> FloatArray:
    """Compute the information of each of n frames about the object's c upright columns,
    (n, c, c), in units of their prior's.
    """
    rows, cols = lab.small_shape
    # An expected spread of 0.02/mm and photon noise of the line integral.
    a = column_lengths(cone, cols) * (0.02 * math.sqrt(PHOTONS * rows) / 3.0)
    return np.asarray(np.einsum("nci,ncj->nij", a, a))


def column_lengths(cone: ConeVec, cols: int, samples: int = 80) -> FloatArray:
    """Sample the length of each ray of the middle row in each upright column of the
    object.

    Lengths are horizontal.

    Args:
        cone: n views.
        cols: of the detector.
        samples: points on a ray within the object's circle.

    Returns:
        (n, cols, COARSE^2) [mm].
    """
    across = (np.arange(cols) - (cols - 1) / 2.0)[None, :, None]
    ends = (cone.detector[:, None] + across * cone.u[:, None])[..., :2]
    start = cone.source[:, None, :2]
    way = ends - start
    length = np.linalg.norm(way, axis=2, keepdims=True)
    way = way / length
    middle = -np.einsum("nci,nci->nc", np.broadcast_to(start, way.shape), way)
    reach = SIDE_MM / math.sqrt(2.0)
    along = middle[..., None] + reach * (2.0 * (np.arange(samples) + 0.5) / samples - 1.0)
    points = start[:, :, None] + along[..., None] * way[:, :, None]
    cell = np.floor((points / SIDE_MM + 0.5) * COARSE).astype(np.int64)
    inside = ((cell >= 0) & (cell < COARSE)).all(axis=3)
    number = np.where(inside, cell[..., 1] * COARSE + cell[..., 0], COARSE * COARSE)
    rays = np.arange(len(cone) * cols)[:, None]
    flat = rays * (COARSE * COARSE + 1) + number.reshape(len(rays), -1)
    counts = np.bincount(flat.ravel(), minlength=len(rays) * (COARSE * COARSE + 1))
    grid = counts.reshape(len(cone), cols, -1)[..., :-1]
    return np.asarray(grid * (2.0 * reach / samples))


def _log_det(matrix: npt.NDArray[np.float64]) -> float:
    return float(np.linalg.slogdet(matrix)[1])


Task = InformationTask | QualityTask
"""Task of an environment; both have the same methods."""

TASKS: Final[Mapping[str, Callable[[], Task]]] = {
    "information": InformationTask,
    "quality": QualityTask,
    "plates": lambda: QualityTask(random_plates),
}
