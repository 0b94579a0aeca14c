"""The environment in which an agent chooses how to reconstruct a noisy scan.

Each step is one attempt with an algorithm, a strength and a constraint; the reward is the gain
in quality over the best attempt so far, less the work. Work counts projections instead of
seconds, so that an episode is the same on every machine. Observations never contain the truth.
"""

from __future__ import annotations

import math
from typing import Any, Final

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.error import ResetNeeded

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.offsets import NOMINAL
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.projection import Volume, forward, project_scene
from flexdt.twin.reconstruction import cgls, fdk, sirt
from flexdt_extensions.learning.moved_scanner import Lab, choices, require_positive
from flexdt_extensions.learning.rewards import (
    GRID,
    SIDE_MM,
    blank,
    noisy,
    quality,
    random_object,
)

ALGORITHMS: Final = ("fdk", "sirt", "cgls")
WINDOWS: Final = ("ram-lak", "shepp-logan", "cosine", "hamming", "hann")
"""Windows in the order of the actions, which trained agents depend on: a copy on purpose."""
SIRT_ITERATIONS: Final = (5, 10, 20, 40, 80)
CGLS_ITERATIONS: Final = (2, 3, 5, 8, 13)
VIEWS: Final = (12, 60)
PHOTONS: Final = (3e2, 3e4)

Observation = npt.NDArray[np.float32]
Action = npt.NDArray[np.int64]


class ReconstructionEnv(gymnasium.Env[Observation, Action]):
    """Choose algorithm, strength and constraint for a scan of a random object.

    Actions: (algorithm, strength, nonnegative): FDK with one of five windows, SIRT with 5 to 80
    or CGLS with 2 to 13 iterations; then clipped at zero or not.

    Observations, (13,) in [0, 1]: views, photons, attempts left, whether there was one, its
    algorithm, strength and constraint, its residual, its roughness, whether it was the best so
    far, and its work.

    Args:
        attempts: of an episode, which then terminates.
        work_weight: reward lost per hundred projections computed (each of all views).
        render_mode: None or rgb_array.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 2}  # noqa: RUF012 - Gymnasium's own

    def __init__(
        self, attempts: int = 5, work_weight: float = 0.5, render_mode: str | None = None
    ) -> None:
        """Check the settings and make the spaces; see the class.

        Nothing is reconstructed before `reset`.

        Raises:
            LimitError: a setting outside its range.
        """
        require_positive(attempts=attempts)
        require_positive(or_zero=True, work_weight=work_weight)
        self.attempts = attempts
        self.work_weight = work_weight
        self.render_mode = render_mode
        self.action_space = gymnasium.spaces.MultiDiscrete(
            [len(ALGORITHMS), len(WINDOWS), 2]
        )
        self.observation_space = gymnasium.spaces.Box(0.0, 1.0, (13,), np.float32)
        self._lab = Lab((SIDE_MM, SIDE_MM, SIDE_MM))
        self._views = VIEWS[0]
        self._photons = PHOTONS[0]
        self._left = attempts
        self._images = np.zeros((0, 1, 1), np.float32)
        self._cone: ConeVec | None = None
        self._truth = self._volume = blank()
        self._best = 0.0
        self._last = np.zeros(10, np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode: draw an object, a number of views and a dose, and make noisy
        images; nothing is reconstructed.

        Args:
            seed: of the episode; None continues the current random sequence.
            options: not used.

        Returns:
            Observation, and `quality`, `best` and `work`, all 0.
        """
        super().reset(seed=seed)
        rng = self.np_random
        thing = random_object(rng)
        self._views = int(rng.integers(VIEWS[0], VIEWS[1] + 1))
        low, high = (math.log(p) for p in PHOTONS)
        self._photons = math.exp(rng.uniform(low, high))
        poses = Poses.concatenate(
            [
                self._lab.poses({"rot_obj": 360.0 * i / self._views})
                for i in range(self._views)
            ]
        )
        self._cone = self._lab.small(poses, NOMINAL)
        clean = project_scene(thing.scene, self._cone, self._lab.small_shape)
        self._images = noisy(clean, self._photons, rng)
        self._truth = thing.volume(SIDE_MM / GRID)
        self._volume = blank()
        self._best = 0.0
        self._left = self.attempts
        self._last = np.zeros(10, np.float32)
        return self._observe(), {"quality": 0.0, "best": 0.0, "work": 0.0}

    def step(
        self, action: Action
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Reconstruct once, and compare with the hidden object.

        The reward is 20 times the gain over the best quality so far, less `work_weight`
        for 100 projections of all views.

        Args:
            action: algorithm, strength, nonnegative; an index each.

        Returns:
            Observation, reward, whether the attempts are used up, False, and `quality`,
            `best`, `work`.

        Raises:
            LimitError: not an action of this environment.
            ResetNeeded: the episode has not begun, or is over.
        """
        algorithm, strength, nonnegative = choices(
            action, [len(ALGORITHMS), len(WINDOWS), 2]
        )
        if self._cone is None or self._left <= 0:
            raise ResetNeeded("there is no episode to go on with: call reset() first")
        volume, work = self._run(algorithm, strength, bool(nonnegative))
        self._volume = volume
        reached = quality(volume, self._truth)
        gain = max(0.0, reached - self._best)
        self._best = max(self._best, reached)
        self._left -= 1
        rest = self._images - forward(volume, self._cone, self._lab.small_shape)
        scale = float(np.mean(self._images**2))
        kind = np.zeros(3, np.float32)
        kind[algorithm] = 1.0
        self._last = np.array(
            [
                1.0,
                *kind,
                strength / 4.0,
                nonnegative,
                math.sqrt(float(np.mean(rest**2)) / max(scale, 1e-12)),
                _roughness(volume),
                float(gain > 0.0),
                work / (work + 40.0),
            ],
            np.float32,
        )
        reward = 20.0 * gain - self.work_weight * work / 100.0
        info = {"quality": reached, "best": self._best, "work": work}
        return self._observe(), reward, self._left <= 0, False, info

    def render(self) -> npt.NDArray[np.uint8] | None:
        """Render the middle slice of the last attempt, uint8 (rows, cols, 3); None without a
        render mode.

        Values from 0 to 0.08/mm become black to white; each pixel is enlarged 8 times.
        """
        if self.render_mode is None:
            return None
        middle = self._volume.data[GRID // 2]
        grey = np.clip(middle * (255.0 / 0.08), 0.0, 255.0).astype(np.uint8)
        return np.repeat(np.kron(grey, np.ones((8, 8), np.uint8))[..., None], 3, axis=2)

    def _run(
        self, algorithm: int, strength: int, nonnegative: bool
    ) -> tuple[Volume, float]:
        """Reconstruct by an algorithm, from zero, onto the episode's grid.

        The work of FDK is 1, that of SIRT and CGLS 2 an iteration. SIRT is clipped in
        each iteration, the others at the end.

        Args:
            algorithm: index into ALGORITHMS.
            strength: index into windows or numbers of iterations.
            nonnegative: set negative values to 0.

        Returns:
            The volume, and the work in projections of all views.
        """
        assert self._cone is not None
        images = self._images
        cone = self._cone
        like = blank()
        match ALGORITHMS[algorithm]:
            case "fdk":
                volume = fdk(images, cone, like, window=WINDOWS[strength], errors=False)
                work = 1.0
            case "sirt":
                count = SIRT_ITERATIONS[strength]
                volume = sirt(
                    images, cone, like, iterations=count, nonnegative=nonnegative
                )
                work = 2.0 * count
            case _:
                count = CGLS_ITERATIONS[strength]
                volume = cgls(images, cone, like, iterations=count)
                work = 2.0 * count
        if nonnegative:
            volume = Volume(
                np.maximum(volume.data, 0.0), volume.voxel_mm, volume.center_mm
            )
        return volume, work

    def _observe(self) -> Observation:
        """Return the observation (13,), clipped to 0 to 1: number of views, photons
        (logarithmic), attempts left, and ten figures of the last attempt.
        """
        low, high = (math.log(p) for p in PHOTONS)
        head = [
            (self._views - VIEWS[0]) / (VIEWS[1] - VIEWS[0]),
            (math.log(self._photons) - low) / (high - low),
            self._left / self.attempts,
        ]
        return np.asarray(
            np.clip(np.concatenate([head, self._last]), 0.0, 1.0), np.float32
        )


def _roughness(volume: Volume) -> float:
    """Compute the mean step between neighboring voxels over the rms value, at most 1."""
    data = np.asarray(volume.data, np.float64)
    steps = np.mean([np.abs(np.diff(data, axis=a)).mean() for a in range(3)])
    return min(1.0, float(steps) / max(float(np.sqrt(np.mean(data**2))), 1e-12))
