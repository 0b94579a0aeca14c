"""Many environments at once: equal to single ones step by step, and to a reconstruction by
hand."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import flexdt_extensions.learning  # noqa: F401 - registers the environments
from flexdt.twin.errors import LimitError, UnknownNameError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.offsets import NOMINAL
from flexdt_extensions.learning.moved_scanner import Lab
from flexdt_extensions.learning.rewards import GRID, SIDE_MM
from flexdt_extensions.learning.vector_scanning import ScanVectorEnv, TurnedLab, Turntable

QUALITY, INFORMATION = "flexdt/NextAngleQuality-v0", "flexdt/NextAngleDiscrete-v0"


def close(one: Any, other: Any) -> None:
    """What is computed in another order differs in single precision's last digits."""
    np.testing.assert_allclose(one, other, rtol=2e-4, atol=2e-5)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (QUALITY, {"frames": 4}),
        (QUALITY, {"frames": 3, "observation": "state", "time_weight": 0.3}),
        (QUALITY, {"frames": 3, "task": "plates"}),
        (INFORMATION, {"frames": 4, "dose_weight": 0.7}),
        (INFORMATION, {"frames": 2, "observation": "projection"}),
    ],
)
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.slow
@pytest.mark.campaign(3)
def test_each_is_the_single_environment_step_by_step(
    name: str, words: dict[str, Any], mode: AutoresetMode
) -> None:
    """Two episodes and more, against environments of one, driven by Gymnasium's own loop."""
    count, rng = 3, np.random.default_rng(17)
    many = gymnasium.make_vec(name, num_envs=count, autoreset_mode=mode, **words)
    alone = gymnasium.make_vec(
        name, count, "sync", vector_kwargs={"autoreset_mode": mode}, **words
    )
    assert isinstance(many, ScanVectorEnv)
    assert not isinstance(alone, ScanVectorEnv)
    assert many.single_observation_space == alone.single_observation_space
    assert many.metadata["autoreset_mode"] == mode
    first, second = many.reset(seed=5), alone.reset(seed=5)
    close(first[0], second[0])
    for _ in range(2 * words["frames"] + 3):
        actions = rng.integers(0, 36, count)
        ours, theirs = many.step(actions), alone.step(actions)
        # A grey level may fall to the other side of a rounding.
        np.testing.assert_allclose(
            ours[0].astype(float),
            theirs[0],
            atol=1 if ours[0].dtype == np.uint8 else 1e-4,
        )
        np.testing.assert_allclose(ours[1], theirs[1], rtol=1e-5, atol=1e-3)
        np.testing.assert_array_equal(ours[2], theirs[2])
        np.testing.assert_array_equal(ours[3], theirs[3])
        assert set(ours[4]) == set(theirs[4])
        for key in (
            "worth",
            "frames",
            "seconds",
            "clock_s",
            "dose",
            "quality",
            "information",
        ):
            if key in theirs[4]:
                close(ours[4][key], theirs[4][key])


def matrix_by_hand(cone: ConeVec, shape: tuple[int, int]) -> np.ndarray:
    """(rays, voxels) lengths [mm] of a view's rays in voxels, each clipped against each box."""
    rows, cols = shape
    r, c = np.meshgrid(np.arange(rows) - (rows - 1) / 2, np.arange(cols) - (cols - 1) / 2,
                       indexing="ij")  # fmt: skip
    edge = SIDE_MM / GRID
    low = (np.arange(GRID) * edge - SIDE_MM / 2.0).astype(float)
    way = cone.detector[0] + r.reshape(-1, 1) * cone.v[0] + c.reshape(-1, 1) * cone.u[0]
    way = way - cone.source[0]
    begin, end = [], []
    for axis, spread in zip(range(3), ((0, 1, 1), (1, 0, 1), (1, 1, 0)), strict=True):
        at = low[None] - cone.source[0, axis]
        a, b = at / way[:, axis, None], (at + edge) / way[:, axis, None]
        shape3 = (len(way), *(1 if s else GRID for s in spread[::-1]))
        begin.append(np.minimum(a, b).reshape(shape3))
        end.append(np.maximum(a, b).reshape(shape3))
    part = np.minimum(np.minimum(*end[:2]), end[2]) - np.maximum(
        np.maximum(*begin[:2]), begin[2]
    )
    length = np.maximum(part, 0.0) * np.linalg.norm(way, axis=1)[:, None, None, None]
    return np.asarray(length.reshape(len(way), -1))


def sirt_by_hand(a: np.ndarray, b: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Six iterations of x += C A' R (b - A x), clipped at zero."""
    with np.errstate(divide="ignore"):
        r = np.where(a.sum(1) > 1e-6 * a.sum(1).max(), 1.0 / a.sum(1), 0.0)
        c = np.where(a.sum(0) > 1e-6 * a.sum(0).max(), 1.0 / a.sum(0), 0.0)
    for _ in range(6):
        x = np.maximum(x + c * (a.T @ (r * (b - a @ x))), 0.0)
    return x


def test_volumes_are_those_of_sirt_written_out_in_numpy() -> None:
    envs = ScanVectorEnv(2, action="discrete", task="quality", frames=5)
    envs.reset(seed=11)
    lab = Lab((SIDE_MM,) * 3)
    volumes = np.zeros((2, GRID**3))
    chosen = np.array([[3, 20], [11, 5], [11, 31]])  # one twice the same
    views = {
        s: matrix_by_hand(
            lab.small(lab.poses({"rot_obj": 10.0 * s}), NOMINAL), lab.small_shape
        )
        for s in set(chosen.ravel().tolist())
    }
    for frame, actions in enumerate(chosen):
        *_, infos = envs.step(actions)
        for k, env in enumerate(envs.envs):
            a = np.concatenate([views[s] for s in chosen[: frame + 1, k]])
            b = np.concatenate([image.ravel() for image in env.task.images]).astype(float)
            volumes[k] = sirt_by_hand(a, b, volumes[k])
            got = env.task.volume.data.ravel()
            assert volumes[k].max() > 0.01
            np.testing.assert_allclose(got, volumes[k], atol=2e-6)
            rest = np.sqrt(np.mean((b - a @ volumes[k]) ** 2) / np.mean(b**2))
            assert infos["residual"][k] == pytest.approx(rest, rel=1e-4)


def test_seeds_count_up_and_repeat() -> None:
    envs = gymnasium.make_vec(QUALITY, num_envs=3, frames=3)
    envs.reset(seed=40)
    assert envs.np_random_seed == (40, 41, 42)

    def run() -> tuple[np.ndarray, np.ndarray]:
        envs.reset(seed=[7, 8, 7])
        out = [
            envs.step(np.array([4, 4, 4])) for _ in range(7)
        ]  # beyond the first episode
        return np.array([step[0] for step in out]), np.array([step[1] for step in out])

    images, rewards = run()
    again, same = run()
    np.testing.assert_array_equal(images, again)
    np.testing.assert_array_equal(rewards, same)
    np.testing.assert_array_equal(rewards[:, 0], rewards[:, 2])
    assert not np.array_equal(rewards[:, 0], rewards[:, 1])
    # The second episode has an object of its own.
    assert not np.array_equal(images[0, 0], images[4, 0])


@pytest.mark.parametrize("way", ["anywhere", "on and on, past the end of the travel"])
def test_turns_looked_up_cost_what_the_scanner_takes(way: str) -> None:
    table, rng = Turntable((SIDE_MM,) * 3, 0.4), np.random.default_rng(3)
    angles = (
        rng.integers(0, 36, 60) * 10.0
        if way == "anywhere"
        else np.arange(60) * 170.0 % 360.0
    )
    real, looked_up = Lab((SIDE_MM,) * 3, 0.4), TurnedLab(table)
    for angle in angles:
        taken, ours = real.take({"rot_obj": angle}), looked_up.take({"rot_obj": angle})
        assert ours.seconds == pytest.approx(taken.seconds, abs=1e-9)
        assert ours.dose == pytest.approx(taken.dose)
        # A half turn goes either way.
        apart = looked_up.position("rot_obj") - real.position("rot_obj")
        assert (apart + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1e-9)
        np.testing.assert_allclose(
            looked_up.poses().cone_vec().rows, real.poses().cone_vec().rows, atol=1e-9
        )
    assert looked_up.now == pytest.approx(real.now)


def test_what_is_not_allowed_is_refused_before_anything_moves() -> None:
    with pytest.raises(UnknownNameError, match="vectorization_mode='sync'"):
        gymnasium.make_vec(QUALITY, num_envs=2, action="pose")
    with pytest.raises(LimitError, match="frames"):
        gymnasium.make_vec(QUALITY, num_envs=2, frames=0)
    envs = gymnasium.make_vec(QUALITY, num_envs=2)
    envs.reset(seed=1)
    with pytest.raises(ValueError, match="allowed: \\(2,\\)"):
        envs.step(np.array([1, 2, 3]))
    *_, infos = envs.step(np.array([1, 2]))
    assert infos["frames"].tolist() == [1, 1]


@pytest.mark.slow
def test_the_agent_example_learns_is_judged_and_draws(tmp_path: Path) -> None:
    script = Path(__file__).resolve().parents[2] / "examples" / "learning_agent.py"
    words = [
        "--seeds",
        "1",
        "--rounds",
        "2",
        "--episodes",
        "8",
        "--judged",
        "8",
        "--envs",
        "8",
        "--steps",
        "40",
    ]
    done = subprocess.run(
        [sys.executable, str(script), "--out", str(tmp_path), *words],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    document = json.loads((tmp_path / "agent.json").read_text())
    assert list(document["scores"]) == [
        "equidistant, full turn", "equidistant, half turn", "greedy", "agent"
    ]  # fmt: skip
    assert all(0.1 < score["mean"] < 0.8 for score in document["scores"].values())
    assert len(document["curves"][0]) == 2
    assert (tmp_path / "agent.png").read_bytes()[:4] == b"\x89PNG"
