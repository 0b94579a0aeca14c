"""The environment in which an agent plans a scan: where to take the next frame.

The reward is the gain of the frame (information about the geometry, or quality of the
reconstruction) less its cost in time and dose; a collision ends the episode. Kinematic
time, swept collisions and projections come from the twin. Observations do not contain the
hidden truth, but their sigmas are computed at it, where an agent's own estimate would
give nearly the same.

Below it are baselines: random, equidistant, and greedy for information. A policy is a
function of the environment: it reads only data that an agent may know and returns an
action.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal, assert_never

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.error import ResetNeeded

from flexdt.twin.errors import LimitError, UnknownNameError
from flexdt.twin.geometry.poses import Poses
from flexdt_extensions.learning.moved_scanner import Lab, choices, require_positive
from flexdt_extensions.learning.rewards import TASKS, Task

Action = npt.NDArray[np.float32] | np.int64
Observation = npt.NDArray[Any]
Kind = Literal["angle", "discrete", "pose"]
SECTORS: Final = 36
"""Number of angles of a discrete action, and of sectors of the record of angles taken."""
POSE_AXES: Final = ("mag_obj", "tra_obj", "mag_det")
"""Motors that a pose moves besides rot_obj: sample along the beam, sideways; detector along
it."""
GAIN: Final = {"information": 1.0, "quality": 20.0, "plates": 20.0}
"""Reward for one nat, or for a quality of 1."""


class ScanEnv(gymnasium.Env[Observation, Action]):
    """Choose poses, one frame at a time.

    Actions: `angle`, one number in [-1, 1] for rot_obj from -180 to 180 deg; `discrete`,
    one of 36 angles; `pose`, four numbers in [-1, 1] for rot_obj and the full travel of
    mag_obj, tra_obj and mag_det, where stage and detector can run into each other.

    Observations: `state`, a vector in [-1, 1] (angle, the three other motors, frames
    left, time used, the task's own features, which of 36 sectors have a frame);
    `projection`, the coarse detector's image of the last frame as uint8 (rows, cols, 1).

    Args:
        action, observation: see above.
        task: information (calibrate with the LEGO phantom; gain in nats), quality
            (reconstruct a random object; gain of 1 - RMSE / RMS), or plates (the same of
            parallel plates).
        frames: of an episode; then it is truncated.
        time_weight: reward lost per second of motion and exposure.
        dose_weight: reward lost per unit of dose (see `Lab.take`).
        collision_penalty: reward lost by a collision, which ends the episode.
        exposure_s: of a frame [s].
        render_mode: None or rgb_array.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012 - Gymnasium's own

    def __init__(
        self,
        action: Kind = "angle",
        observation: Literal["state", "projection"] = "state",
        task: Literal["information", "quality", "plates"] = "information",
        frames: int = 16,
        time_weight: float = 0.02,
        dose_weight: float = 0.1,
        collision_penalty: float = 20.0,
        exposure_s: float = 0.5,
        render_mode: Literal["rgb_array"] | None = None,
    ) -> None:
        """Check the settings and make the scanner and the spaces; see the class.

        No episode runs before `reset`.

        Raises:
            UnknownNameError: no such action, observation or task.
            LimitError: a setting outside its range.
        """
        for what, value, allowed in (
            ("action", action, ("angle", "discrete", "pose")),
            ("observation", observation, ("state", "projection")),
            ("task", task, tuple(TASKS)),
        ):
            if value not in allowed:
                raise UnknownNameError.among(
                    f"no {what} {value!r}; there are", value, allowed
                )
        require_positive(frames=frames, exposure_s=exposure_s)
        require_positive(
            or_zero=True,
            time_weight=time_weight,
            dose_weight=dose_weight,
            collision_penalty=collision_penalty,
        )
        self.kind: Kind = action
        self.frames = frames
        self.time_weight = time_weight
        self.dose_weight = dose_weight
        self.collision_penalty = collision_penalty
        self.render_mode = render_mode
        self.task: Task = TASKS[task]()
        self._gain = GAIN[task]
        self._exposure_s = exposure_s
        self._shows = observation == "projection"
        self.lab = self.new_lab()
        self._last: Poses | None = None
        self._sectors = np.zeros(SECTORS, np.float32)
        self._taken = 0
        self._over = True
        match action:
            case "discrete":
                self.action_space = gymnasium.spaces.Discrete(SECTORS)
            case "angle":
                self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
            case "pose":
                self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)
            case _:
                assert_never(action)
        if self._shows:
            self.observation_space = gymnasium.spaces.Box(
                0, 255, (*self.lab.small_shape, 1), np.uint8
            )
        else:
            self.observation_space = gymnasium.spaces.Box(
                -1.0, 1.0, (7 + self.task.features + SECTORS,), np.float32
            )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode: draw a new hidden truth, and put the scanner at its start
        pose (SOD 600 mm), without a frame.

        Args:
            seed: of the episode; None continues the current random sequence.
            options: not used.

        Returns:
            Observation and info, see `_info`.
        """
        super().reset(seed=seed)
        self.lab = self.new_lab()
        self.task.reset(self.lab, self.np_random)
        self._last = None
        self._sectors = np.zeros(SECTORS, np.float32)
        self._taken = 0
        self._over = False
        return self._observe(), self._info(0.0, 0.0)

    def step(
        self, action: Action
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Move, take a frame, and return its worth less the costs of time and dose.

        After a collision, or the last frame, the episode is over; a collision costs a
        penalty and gives no frame.

        Args:
            action: see the class.

        Returns:
            Observation, reward, whether it collided, whether the frames are used up, and
            the task's figures with `collision`.

        Raises:
            LimitError: not an action of this environment.
            ResetNeeded: the episode has not begun, or is over.
        """
        if self._over:
            raise ResetNeeded("there is no episode to go on with: call reset() first")
        taken = self.lab.take(self.targets(action))
        cost = self.time_weight * taken.seconds + self.dose_weight * taken.dose
        if taken.collided:
            self._over = True
            return (
                self._observe(),
                -self.collision_penalty - cost,
                True,
                False,
                {**self._info(0.0, taken.seconds), "collision": True},
            )
        poses = self.lab.poses()
        worth = self.task.add(self.lab, poses, self.np_random)
        self._last = poses
        self._sectors[round(self.lab.position("rot_obj") / 10.0) % SECTORS] = 1.0
        self._taken += 1
        self._over = done = self._taken >= self.frames
        info = self._info(worth, taken.seconds)
        return self._observe(), self._gain * worth - cost, False, done, info

    def new_lab(self) -> Lab:
        """Make a scanner in its state at the start of an episode."""
        return Lab(self.task.size_mm, self._exposure_s)

    def render(self) -> npt.NDArray[np.uint8] | None:
        """Render the last frame, dark where the object absorbs, eight screen pixels a
        coarse pixel.

        None without a render mode.
        """
        if self.render_mode is None:
            return None
        grey = np.uint8(255) - self._grey()
        return np.repeat(np.kron(grey, np.ones((8, 8), np.uint8))[..., None], 3, axis=2)

    def targets(self, action: Action) -> dict[str, float]:
        """Convert an action to motor targets [deg, mm].

        Values outside -1 to 1 are clipped; each stands for the axis's full range. Without
        "pose" only rot_obj is a target.

        Args:
            action: of the kind of this environment.

        Raises:
            LimitError: not an action of this environment.
        """
        if self.kind == "discrete":
            return {"rot_obj": 360.0 * choices(action, [SECTORS])[0] / SECTORS}
        values = np.asarray(action, dtype=np.float64).ravel()
        if values.shape != self.action_space.shape or not np.isfinite(values).all():
            raise LimitError(
                f"action {values.tolist()}; allowed: {self.action_space}",
                {"asked": values.tolist(), "allowed": str(self.action_space)},
            )
        values = np.clip(values, -1.0, 1.0)
        out = {"rot_obj": 180.0 * float(values[0])}
        for axis, value in zip(POSE_AXES, values[1:], strict=False):
            lower, upper = self.lab.range_of(axis)
            out[axis] = lower + (upper - lower) * (float(value) + 1.0) / 2.0
        return out

    def action_for(self, targets: dict[str, float]) -> Action:
        """Convert targets (angle [deg]) to an action; the inverse of `targets`.

        "discrete": the nearest sector; else the angle in half turns, for "pose" with each
        axis scaled to -1...1 over its range (its present place if not in `targets`).
        """
        angle = (targets["rot_obj"] + 180.0) % 360.0 - 180.0
        match self.kind:
            case "discrete":
                return np.int64(round(angle * SECTORS / 360.0) % SECTORS)
            case "angle":
                moved: tuple[str, ...] = ()
            case "pose":
                moved = POSE_AXES
            case _:
                assert_never(self.kind)
        values = [angle / 180.0]
        for axis in moved:
            lower, upper = self.lab.range_of(axis)
            where = targets.get(axis, self.lab.position(axis))
            values.append(2.0 * (where - lower) / (upper - lower) - 1.0)
        return np.array(values, np.float32)

    def forecast(self, candidates: list[dict[str, float]]) -> npt.NDArray[np.float64]:
        """Compute the expected worth less the cost of time of each candidate, (m,), from
        data that an agent may know.

        Args:
            candidates: motor positions [deg, mm], not checked for collisions.
        """
        poses = Poses.concatenate([self.lab.poses(c) for c in candidates])
        seconds = np.array([self.lab.seconds_to(c) for c in candidates])
        worth = self.task.forecast(self.lab, poses)
        return np.asarray(worth - self.time_weight * seconds)

    def _observe(self) -> Observation:
        """Return the last projection as gray values (rows, cols, 1), or the state as a
        vector clipped to -1 to 1: sine and cosine of the angle, places, frames left,
        time, the task's state and the sectors seen.
        """
        if self._shows:
            return self._grey()[..., None]
        angle = math.radians(self.lab.position("rot_obj"))
        place = []
        for axis in POSE_AXES:
            lower, upper = self.lab.range_of(axis)
            place.append(2.0 * (self.lab.position(axis) - lower) / (upper - lower) - 1.0)
        head = [
            math.sin(angle),
            math.cos(angle),
            *place,
            1.0 - self._taken / self.frames,
            self.lab.now / (self.lab.now + 60.0),
        ]
        vector = np.concatenate([head, self.task.state(), self._sectors]).astype(
            np.float32
        )
        return np.clip(vector, -1.0, 1.0)

    def _grey(self) -> npt.NDArray[np.uint8]:
        """Convert the last frame's line integrals from 0 to 3 to 0 to 255; zeros
        before the first."""
        if self._last is None:
            return np.zeros(self.lab.small_shape, np.uint8)
        image = self.task.show(self.lab, self._last)
        return np.asarray(np.clip(image * (255.0 / 3.0), 0.0, 255.0), dtype=np.uint8)

    def _info(self, worth: float, seconds: float) -> dict[str, Any]:
        """Return the figures of a step: those of the task, worth, frames so far, seconds,
        clock_s, dose so far, and collision, always False here.

        Args:
            worth: of the frame.
            seconds: of the step.
        """
        return {
            **self.task.info(),
            "worth": worth,
            "frames": self._taken,
            "seconds": seconds,
            "clock_s": self.lab.now,
            "dose": self.lab.dose,
            "collision": False,
        }


Policy = Callable[[ScanEnv, int], Action]
"""Environment and number of the frame (from 0) to action."""


def uniform(env: ScanEnv, frame: int) -> Action:
    """Draw any action; poses anywhere in the travel, collisions included."""
    match env.kind:
        case "pose":
            return env.np_random.uniform(-1.0, 1.0, 4).astype(np.float32)
        case "angle" | "discrete":
            angle = float(env.np_random.uniform(-180.0, 180.0))
            return env.action_for({"rot_obj": angle})
        case _:
            assert_never(env.kind)


def equidistant(env: ScanEnv, frame: int) -> Action:
    """Choose one turn in equal steps, as every scan script does."""
    return env.action_for({"rot_obj": 360.0 * frame / env.frames})


def greedy(env: ScanEnv, frame: int) -> Action:
    """Choose the action whose expected worth less the cost of its time is largest, at the
    nominal geometry, of 36 angles (for "pose" each at up to four places of mag_obj);
    `frame` is ignored.
    """
    candidates = [{"rot_obj": 360.0 * i / SECTORS} for i in range(SECTORS)]
    if env.kind == "pose":
        here = env.lab.position("mag_obj")
        places = sorted({here, 450.0, 600.0, 750.0})
        candidates = [{**c, "mag_obj": place} for c in candidates for place in places]
    return env.action_for(candidates[int(np.argmax(env.forecast(candidates)))])


POLICIES: Final[Mapping[str, Policy]] = {
    "random": uniform,
    "equidistant": equidistant,
    "greedy": greedy,
}


@dataclass(frozen=True)
class Episode:
    """Record of an episode, frame by frame.

    Attributes:
        rewards: of each step.
        infos: of the environment, for each step.
        targets: motor positions of the actions.
        collided: it ended so.
    """

    rewards: tuple[float, ...]
    infos: tuple[dict[str, Any], ...]
    targets: tuple[dict[str, float], ...]
    collided: bool


def play(env: ScanEnv, policy: Policy, seed: int) -> Episode:
    """Run one episode of an environment by a policy.

    It ends by a collision or when the frames are used up.

    Args:
        env: environment, which is reset.
        policy: chooses an action from the environment and the number of the step.
        seed: of the episode.

    Returns:
        Rewards, infos and targets of all steps, and whether it ended by a collision.
    """
    env.reset(seed=seed)
    rewards: list[float] = []
    infos: list[dict[str, Any]] = []
    targets: list[dict[str, float]] = []
    collided = cut = False
    while not (collided or cut):
        action = policy(env, len(rewards))
        targets.append(env.targets(action))
        _, reward, collided, cut, info = env.step(action)
        rewards.append(float(reward))
        infos.append(info)
    return Episode(tuple(rewards), tuple(infos), tuple(targets), collided)
