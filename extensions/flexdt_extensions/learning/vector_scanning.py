"""Many scan environments at once whose scanners only turn their samples.

Each is a `ScanEnv` with its own object, noise and seed; independent data are computed
once for all: motion times, poses, and the rays of the 36 angles as lists of voxels and
lengths. An object's clean images of all angles are projected when it is drawn, and SIRT
runs for all objects in one compiled call, so that a chosen angle adds its rays to those
taken.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from flexdt.phantoms import Phantom
from flexdt.twin.errors import UnknownNameError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.geometry.offsets import NOMINAL
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.projection import project_scene
from flexdt_extensions.learning.moved_scanner import Lab, Taken, choices
from flexdt_extensions.learning.rewards import (
    GRID,
    ITERATIONS,
    PHOTONS,
    SIDE_MM,
    QualityTask,
    column_information,
    noisy,
)
from flexdt_extensions.learning.scanning import SECTORS, Action, Observation, ScanEnv

VoxelArray = npt.NDArray[np.uint32]
MIN_SUM_SHARE = 1e-6
"""Sums of lengths below this part of the largest are not divided by, as in `flexdt.sirt`."""


class Turntable:
    """Shared data of scanners that only turn their samples.

    Args:
        size_mm, exposure_s: as for `Lab`.
    """

    def __init__(self, size_mm: tuple[float, float, float], exposure_s: float) -> None:
        """Make a scanner at rest and one that turns, with a box of `size_mm` on the
        stage; nothing is computed yet.
        """
        self.still = Lab(size_mm, exposure_s)
        self._moved = Lab(size_mm, exposure_s)
        self._ways: dict[tuple[float, float], tuple[Taken, float]] = {}
        self._poses: dict[float, Poses] = {}

    def way(self, start: float, target: float) -> tuple[Taken, float]:
        """Compute the cost of a turn of rot_obj the shorter way; each is computed once,
        up to whole turns.

        Args:
            start: angle [deg].
            target: angle, up to whole turns [deg].

        Returns:
            Time and dose, and the angle at the end [deg].
        """
        upper = self.still.range_of("rot_obj")[1]
        if abs(start) > upper - 360.0:
            turns = 0.0
        else:
            turns = start - start % 360.0
        key = start - turns, target % 360.0
        if key not in self._ways:
            lab = self._moved
            lab.scanner.place({"rot_obj": key[0]}, lab.now)
            self._ways[key] = lab.take({"rot_obj": key[1]}), lab.position("rot_obj")
        taken, end = self._ways[key]
        return taken, end + turns

    def poses(self, angle: float) -> Poses:
        """Return the nominal pose with rot_obj at an angle [deg]; each is computed once."""
        key = angle % 360.0
        if key not in self._poses:
            self._poses[key] = self.still.poses({"rot_obj": key})
        return self._poses[key]

    @cached_property
    def rays(self) -> Rays:
        """Of all sectors."""
        return Rays(self)


@lru_cache(4)
def turntable(size_mm: tuple[float, float, float], exposure_s: float) -> Turntable:
    """Make the turntable, the same for all environments of this process."""
    return Turntable(size_mm, exposure_s)


class TurnedLab(Lab):
    """A `Lab` on a common turntable: same times, poses and doses, looked up; only rot_obj
    moves."""

    def __init__(self, table: Turntable) -> None:
        """Begin at the angle and time of the table's scanner at rest, with no dose."""
        still = table.still
        self.machine = still.machine
        self.scanner = still.scanner
        self.exposure_s = still.exposure_s
        self.table = table
        self.angle = still.position("rot_obj")
        self.now = self.dose = 0.0

    def position(self, axis: str) -> float:
        """Return the position of a motor [mm, deg]."""
        if axis == "rot_obj":
            return self.angle
        return self.table.still.position(axis)

    def take(self, targets: dict[str, float]) -> Taken:
        """Take a frame as `Lab.take`, for the target of rot_obj; other targets are
        ignored. Adds to time [s] and dose.
        """
        taken, self.angle = self.table.way(self.angle, targets["rot_obj"])
        self.now += taken.seconds
        self.dose += taken.dose
        return taken

    def poses(self, targets: dict[str, float] | None = None) -> Poses:
        """Return the poses as `Lab.poses`."""
        angle = (targets or {}).get("rot_obj", self.angle)
        return self.table.poses(angle)


class Rays:
    """The projector of the coarse detector at all sectors as a sparse matrix, with its sums.

    Attributes:
        cone, information: of the sectors.
        first, voxel, length, rows, columns: see `sirt_kernels.solve`.
    """

    def __init__(self, table: Turntable) -> None:
        """Compute, for all rays of the 36 angles, the voxels that they pass with their
        lengths, each ray's total length, each view's total length in each voxel, and the
        information of each view.

        Lengths are in [mm]; rays are listed by view; voxels passed by 0 mm are left out.

        Args:
            table: poses and detector.
        """
        lab = table.still
        poses = [table.poses(360.0 * i / SECTORS) for i in range(SECTORS)]
        self.cone = lab.small(Poses.concatenate(poses), NOMINAL)
        self.information = column_information(lab, self.cone)
        views = [_lengths(self.cone[i], lab.small_shape) for i in range(SECTORS)]
        rays = len(views[0][0])
        counts = np.concatenate([(length > 0.0).sum(axis=1) for _, length in views])
        ends = np.cumsum([0, *counts])
        self.first = np.stack(
            [ends[i * rays : (i + 1) * rays + 1] for i in range(SECTORS)]
        )
        self.voxel = np.concatenate([voxel[length > 0.0] for voxel, length in views])
        self.length = np.concatenate([length[length > 0.0] for _, length in views])
        self.rows = np.stack([length.sum(axis=1) for _, length in views])
        self.columns = np.stack(
            [
                np.bincount(v.ravel(), n.ravel(), GRID**3).astype(np.float32)
                for v, n in views
            ]
        )

    def solve(self, tasks: Sequence[SharedQuality]) -> None:
        """Run SIRT with all frames of each object, as `QualityTask` does, for many
        objects at once, and update their tasks.

        Objects may have different numbers of frames.

        Args:
            tasks: with at least one frame each.
        """
        from flexdt_extensions.learning import sirt_kernels

        counts = np.array([len(task.sectors) for task in tasks])
        taken = np.zeros((len(tasks), counts.max()), np.int64)
        images = np.zeros((*taken.shape, self.rows.shape[1]), np.float32)
        for k, task in enumerate(tasks):
            taken[k, : counts[k]] = task.sectors
            images[k, : counts[k]] = np.reshape(task.images, (counts[k], -1))
        volumes = np.stack([task.volume.data.ravel() for task in tasks])
        squares = sirt_kernels.solve(
            self.first,
            self.voxel,
            self.length,
            self.rows,
            self.columns,
            taken,
            counts,
            images,
            volumes,
            ITERATIONS,
            np.float32(MIN_SUM_SHARE),
        )
        sizes = np.einsum("kir,kir->k", images, images, dtype=np.float64)
        for k, task in enumerate(tasks):
            pixels = counts[k] * images.shape[2]
            task.solved(volumes[k], squares[k] / pixels, sizes[k] / pixels)


class SharedQuality(QualityTask):
    """A `QualityTask` that is solved together with others."""

    def __init__(
        self, table: Turntable, draw: Callable[[np.random.Generator], Phantom]
    ) -> None:
        self.table = table
        super().__init__(draw)

    def reset(self, lab: Lab, rng: np.random.Generator) -> None:
        """Draw a new object, project it at every sector without noise, and forget the
        frames.
        """
        super().reset(lab, rng)
        self._clean = project_scene(self._scene, self.table.rays.cone, lab.small_shape)
        self.sectors: list[int] = []
        self._ahead = False

    def show(self, lab: Lab, poses: Poses) -> Float32Array:
        """Return the clean image of the present angle; see `QualityTask`."""
        return np.asarray(self._clean[_sector(lab.position("rot_obj"))])

    def measure(self, sector: int, rng: np.random.Generator) -> None:
        """Take the next frame ahead of `add`."""
        self.images.append(noisy(self._clean[sector], PHOTONS, rng))
        self.sectors.append(sector)
        self._ahead = True

    def add(self, lab: Lab, poses: Poses, rng: np.random.Generator) -> float:
        """Take one frame, solve for the volume and return its gain in quality; see
        `QualityTask`.

        A frame that was measured and solved ahead is not taken again; `poses` is ignored.
        """
        if not self._ahead:
            self.measure(_sector(lab.position("rot_obj")), rng)
            self.table.rays.solve([self])
        self._ahead = False
        self._precision += self.table.rays.information[self.sectors[-1]]
        return self.judge()

    def solved(self, values: Float32Array, square: float, size: float) -> None:
        """Take a reconstruction, the mean squares of its residual and of the images."""
        self.volume = self.volume.like(values.reshape(self.volume.shape))
        self._residual = float(np.sqrt(square / max(size, 1e-12)))


class _TurnEnv(ScanEnv):
    """A `ScanEnv` on a common turntable."""

    def __init__(self, **words: Any) -> None:
        """Make an environment; a task of quality is replaced by one that is solved
        together with others, see `SharedQuality`.

        `words` are those of `ScanEnv`.
        """
        super().__init__(**words)
        if isinstance(self.task, QualityTask):
            table = turntable(self.task.size_mm, self.lab.exposure_s)
            self.task = SharedQuality(table, self.task.draw)

    def new_lab(self) -> Lab:
        """Make a scanner that only turns; see `ScanEnv`."""
        return TurnedLab(turntable(self.task.size_mm, self._exposure_s))

    def measure(self, action: Action) -> SharedQuality | None:
        """Take the frame of an action that is to come, and return the task, to be solved
        with others; None (and no frame) if the task is not shared or the move would
        collide.
        """
        if not isinstance(self.task, SharedQuality) or not isinstance(
            self.lab, TurnedLab
        ):
            return None
        taken, end = self.lab.table.way(self.lab.angle, self.targets(action)["rot_obj"])
        if taken.collided:
            return None
        self.task.measure(_sector(end), self.np_random)
        return self.task


class ScanVectorEnv(SyncVectorEnv):
    """Many `ScanEnv` with discrete actions: equal to as many single ones, at many times the
    speed.

    Spaces, seeds (`reset(seed=s)` seeds them with s, s + 1, ...), infos and autoreset are those
    of Gymnasium's `SyncVectorEnv`.

    Args:
        num_envs: how many.
        autoreset_mode: Gymnasium's.
        words: keywords of `ScanEnv`.

    Raises:
        UnknownNameError: actions that are not discrete, or as `ScanEnv`.
        LimitError: as `ScanEnv`.

    Example:
        >>> envs = ScanVectorEnv(3, action="discrete", task="quality", frames=2)
        >>> observations, infos = envs.reset(seed=1)
        >>> observations, rewards, *_ = envs.step(np.array([0, 9, 18]))
        >>> rewards.shape
        (3,)
    """

    def __init__(
        self,
        num_envs: int,
        *,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        **words: Any,
    ) -> None:
        """Make the environments; arguments: see the class.

        Raises:
            UnknownNameError: another action than "discrete".
        """
        action = words.get("action", "angle")
        if action != "discrete":
            what = (
                f"environments that share a turntable have no action {action!r}; there is"
            )
            more = "; for others: vectorization_mode='sync'"
            raise UnknownNameError.among(what, action, ["discrete"], more)
        super().__init__(
            [lambda: _TurnEnv(**words) for _ in range(num_envs)],
            autoreset_mode=autoreset_mode,
        )
        self._turned = cast("list[_TurnEnv]", self.envs)

    def step(
        self, actions: npt.ArrayLike
    ) -> tuple[
        Observation,
        npt.NDArray[np.float64],
        npt.NDArray[np.bool_],
        npt.NDArray[np.bool_],
        dict[str, Any],
    ]:
        """Run one step of each environment, with all frames solved together.

        Environments that are reset by this step take no frame.

        Args:
            actions: (num_envs,), one of 36 angles each.

        Returns:
            As of Gymnasium's `SyncVectorEnv`: observations, rewards, terminated and
            truncated (num_envs,), and infos.

        Raises:
            ValueError: another shape.
            LimitError: no such angle.
        """
        chosen = np.asarray(actions)
        if chosen.shape != (self.num_envs,):
            raise ValueError(
                f"actions have shape {chosen.shape}; allowed: ({self.num_envs},)"
            )
        choices(chosen, [SECTORS] * self.num_envs)
        same_step = self.autoreset_mode == AutoresetMode.SAME_STEP
        steps = [
            env.measure(action)
            for env, action, over in zip(
                self._turned, chosen, self._autoreset_envs, strict=True
            )
            if same_step or not over
        ]
        tasks = [task for task in steps if task is not None]
        if tasks:
            tasks[0].table.rays.solve(tasks)
        return super().step(chosen)


def _sector(angle: float) -> int:
    return round(angle * SECTORS / 360.0) % SECTORS


def _lengths(cone: ConeVec, shape: tuple[int, int]) -> tuple[VoxelArray, Float32Array]:
    """Compute the flat indices of the voxels that each ray of one view crosses, and its
    lengths in them [mm], both (rays, k).

    A ray is cut at every plane between voxels, in the order in which it meets them;
    pieces outside the volume have index and length 0.

    Args:
        cone: one view.
        shape: detector (rows, cols).
    """
    rows, cols = ((np.arange(n) - (n - 1) / 2.0) for n in shape)
    ends = cone.detector + (
        rows[:, None, None] * cone.v + cols[:, None] * cone.u
    ).reshape(-1, 3)
    way = ends - cone.source
    edge = SIDE_MM / GRID
    planes = np.arange(GRID + 1) * edge - SIDE_MM / 2.0
    with np.errstate(
        divide="ignore", invalid="ignore"
    ):  # a ray along the planes of an axis
        cuts = (planes - cone.source[:, :, None]) / way[:, :, None]
    cuts = np.sort(np.nan_to_num(np.clip(cuts, 0.0, 1.0)).reshape(len(way), -1))
    middle = (cuts[:, 1:] + cuts[:, :-1]) / 2.0
    points = cone.source + middle[..., None] * way[:, None]
    cell = np.floor((points + SIDE_MM / 2.0) / edge).astype(np.int64)
    inside = ((cell >= 0) & (cell < GRID)).all(axis=2)
    length = np.where(inside, np.diff(cuts) * np.linalg.norm(way, axis=1)[:, None], 0.0)
    voxel = np.where(
        inside, (cell[..., 2] * GRID + cell[..., 1]) * GRID + cell[..., 0], 0
    )
    return voxel.astype(np.uint32), length.astype(np.float32)
