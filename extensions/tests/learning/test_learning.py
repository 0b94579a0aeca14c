"""Gymnasium environments: its own checker, seeds, costs by hand, collisions, forecasts."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

from flexdt.twin.errors import LimitError, UnknownNameError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.offsets import NOMINAL
from flexdt.twin.projection import Volume, forward
from flexdt_extensions.learning import ENVIRONMENTS
from flexdt_extensions.learning.moved_scanner import Lab
from flexdt_extensions.learning.rewards import (
    COARSE,
    SIDE_MM,
    QualityTask,
    column_lengths,
    noisy,
)
from flexdt_extensions.learning.scanning import POLICIES, ScanEnv, play


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_gymnasium_checks_every_environment(name: str) -> None:
    """Warnings are errors here, so the checker's advice counts, too."""
    check_env(gymnasium.make(name).unwrapped)


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_same_seed_same_episode_and_another_differs(name: str) -> None:
    def run(seed: int) -> list[float]:
        env = gymnasium.make(name)
        env.action_space.seed(seed)
        first, _ = env.reset(seed=seed)
        out = [float(np.asarray(first, np.float64).sum())]
        for _ in range(3):
            obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
            assert env.observation_space.contains(obs)
            out += [float(np.asarray(obs, np.float64).sum()), float(reward)]
            out += [v for v in info.values() if isinstance(v, float)]
            if terminated or truncated:
                break
        return out

    assert run(5) == run(5)
    assert run(5) != run(6)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("flexdt/NextAngle-v0", {"frames": 0}),
        ("flexdt/NextPose-v0", {"frames": -3}),
        ("flexdt/NextAngle-v0", {"exposure_s": -1.0}),
        ("flexdt/NextAngle-v0", {"exposure_s": math.nan}),
        ("flexdt/NextAngle-v0", {"frames": 2.5}),
        ("flexdt/Reconstruction-v0", {"attempts": 0}),
    ],
)
def test_numbers_that_make_no_sense_are_refused(
    name: str, words: dict[str, float]
) -> None:
    with pytest.raises(LimitError, match="allowed: more than 0"):
        gymnasium.make(name, **words)


@pytest.mark.parametrize("weight", ["time_weight", "dose_weight", "collision_penalty"])
@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
def test_costs_are_not_negative(weight: str, value: float) -> None:
    with pytest.raises(LimitError, match=f"{weight} .* allowed: 0 or more"):
        gymnasium.make("flexdt/NextAngle-v0", **{weight: value})


@pytest.mark.parametrize(
    ("name", "good", "bad"),
    [
        ("flexdt/NextAngleDiscrete-v0", 3, (36, -1, 1.7, [1, 2], math.nan)),
        ("flexdt/NextPose-v0", np.zeros(4), (np.zeros(2), np.full(4, np.nan))),
        (
            "flexdt/Reconstruction-v0",
            [0, 0, 0],
            ([3, 0, 0], [0, -1, 0], [0, 0], [0, 0.5, 0]),
        ),
    ],
)
def test_what_is_no_action_changes_nothing(
    name: str, good: Any, bad: tuple[Any, ...]
) -> None:
    env = gymnasium.make(name).unwrapped
    with pytest.raises(ResetNeeded):
        env.step(good)
    env.reset(seed=3)
    for action in bad:
        with pytest.raises(LimitError, match="allowed"):
            env.step(action)
    found = env.step(good)
    env.reset(seed=3)
    again = env.step(good)
    np.testing.assert_array_equal(found[0], again[0])
    assert found[1:] == again[1:]
    over = found[2] or found[3]
    while not over:
        *_, terminated, truncated, _ = env.step(good)
        over = terminated or truncated
    with pytest.raises(ResetNeeded):
        env.step(good)


def test_time_is_the_motors_trapezoid_and_dose_the_inverse_square() -> None:
    lab = Lab((20.0, 20.0, 40.0), exposure_s=0.5)
    axis = lab.machine.axes["rot_obj"]
    turn = 170.0
    ramp = axis.speed / axis.acceleration
    assert turn > axis.speed * ramp  # it reaches its speed
    expected = turn / axis.speed + ramp + 0.5
    assert lab.seconds_to({"rot_obj": turn}) == pytest.approx(expected)
    taken = lab.take({"rot_obj": turn})
    assert taken.seconds == pytest.approx(expected)
    # The shorter way back: 350 deg is 180 deg away, 10 deg only 160.
    assert lab.seconds_to({"rot_obj": 10.0}) < lab.seconds_to({"rot_obj": 350.0})
    near, far = lab.take({"mag_obj": 400.0}), lab.take({"mag_obj": 800.0})
    offset = float(lab.poses().sod[0]) - 800.0
    ratio = ((800.0 + offset) / (400.0 + offset)) ** 2
    assert near.dose / far.dose == pytest.approx(ratio)


def test_collision_ends_the_episode() -> None:
    env = gymnasium.make("flexdt/NextPose-v0").unwrapped
    env.reset(seed=1)
    far = env.action_for({"rot_obj": 0.0, "mag_obj": 500.0, "mag_det": 900.0})
    *_, terminated, _, info = env.step(far)
    assert not terminated
    assert info["worth"] > 0.0
    before = env.lab.position("mag_det")
    near = env.action_for({"rot_obj": 0.0, "mag_obj": 500.0, "mag_det": 400.0})
    _, reward, terminated, truncated, info = env.step(near)
    # It stopped on its way, with the panel still beyond the sample.
    assert 500.0 < env.lab.position("mag_det") < before
    assert terminated
    assert not truncated
    assert info["collision"]
    assert reward <= -env.collision_penalty
    assert info["frames"] == 1


def test_reward_is_worth_less_costs() -> None:
    env = ScanEnv(action="discrete", time_weight=0.3, dose_weight=0.2)
    env.reset(seed=2)
    _, reward, _, _, info = env.step(np.int64(9))
    assert reward == pytest.approx(
        info["worth"] - 0.3 * info["seconds"] - 0.2 * info["dose"]
    )
    assert info["information"] == pytest.approx(info["worth"])


def test_actions_and_targets_are_inverse() -> None:
    for kind in ("angle", "discrete", "pose"):
        env = ScanEnv(action=kind)  # type: ignore[arg-type]
        env.reset(seed=0)
        want = {"rot_obj": -70.0, "mag_obj": 512.0, "tra_obj": 33.0}
        got = env.targets(env.action_for(want))
        turned = (got["rot_obj"] - want["rot_obj"] + 180.0) % 360.0 - 180.0
        assert turned == pytest.approx(0.0, abs=1e-4)
        if kind == "pose":
            assert got["mag_obj"] == pytest.approx(512.0, abs=1e-3)
            assert got["tra_obj"] == pytest.approx(33.0, abs=1e-3)


def test_forecast_of_information_is_what_a_frame_brings_when_nothing_is_hidden() -> None:
    env = ScanEnv(action="discrete", time_weight=0.0)
    env.reset(seed=1)
    env.task._truth = NOMINAL  # type: ignore[attr-defined]
    for sector in (0, 7, 20):
        expected = env.forecast([env.targets(np.int64(sector))])[0]
        *_, info = env.step(np.int64(sector))
        assert info["worth"] == pytest.approx(expected, rel=1e-9)


def test_planner_columns_agree_with_the_projector() -> None:
    """Sampled lengths of rays in the object's columns beside exact ones of the voxel
    projector."""
    lab = Lab((SIDE_MM,) * 3)
    cone = lab.small(lab.poses({"rot_obj": 33.0}), NOMINAL)
    cols = lab.small_shape[1]
    ours = column_lengths(cone, cols, samples=4000)[0]
    flat = ConeVec.from_vectors(
        cone.source * [1, 1, 0], cone.detector * [1, 1, 0], cone.u * [1, 1, 0], cone.v
    )
    weights = np.random.default_rng(1).random(COARSE * COARSE).astype(np.float32)
    volume = Volume(
        weights.reshape(1, COARSE, COARSE), (SIDE_MM / COARSE, SIDE_MM / COARSE, SIDE_MM)
    )
    exact = forward(volume, flat, (1, cols))[0, 0]
    np.testing.assert_allclose(ours @ weights, exact, atol=0.15)
    assert exact.max() > 20.0


def test_quality_reaches_far_and_only_by_frames() -> None:
    env = ScanEnv(action="discrete", task="quality", frames=10)
    done = play(env, POLICIES["equidistant"], seed=4)
    qualities = [i["quality"] for i in done.infos]
    assert qualities[0] < 0.6 < qualities[-1] < 1.0
    assert isinstance(env.task, QualityTask)
    assert not done.collided


def test_noise_is_poisson() -> None:
    image = np.full((200, 200), 1.5, np.float32)
    out = noisy(image, 1000.0, np.random.default_rng(1))
    counts = 1000.0 * math.exp(-1.5)
    assert out.mean() == pytest.approx(1.5, abs=0.003)
    assert out.std() == pytest.approx(counts**-0.5, rel=0.03)


def test_greedy_knows_more_after_few_frames_than_random() -> None:
    env = ScanEnv(action="discrete", frames=5, time_weight=0.0)
    worst = {
        name: np.mean(
            [play(env, POLICIES[name], s).infos[-1]["information"] for s in range(3)]
        )
        for name in ("random", "greedy")
    }
    assert worst["greedy"] > worst["random"]


def test_reconstruction_rewards_only_what_beats_the_best() -> None:
    env = gymnasium.make("flexdt/Reconstruction-v0").unwrapped
    env.reset(seed=3)
    action = np.array([1, 2, 1])
    _, first, terminated, _, info = env.step(action)
    _, again, _, _, same = env.step(action)
    assert info["quality"] == same["quality"]
    assert first == pytest.approx(20.0 * info["quality"] - 0.5 * info["work"] / 100.0)
    assert again == pytest.approx(-0.5 * info["work"] / 100.0)
    assert not terminated
    for _ in range(env.attempts - 2):
        *_, terminated, _, _ = env.step(np.array([0, 0, 0]))
    assert terminated
    assert 0.2 < info["quality"] < 1.0


@pytest.mark.slow
def test_the_baselines_example_draws_and_writes(tmp_path: Path) -> None:
    script = Path(__file__).resolve().parents[2] / "examples" / "learning_baselines.py"
    words = ["--out", str(tmp_path), "--episodes", "1", "--frames", "3"]
    done = subprocess.run(
        [sys.executable, str(script), *words], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    document = json.loads((tmp_path / "baselines.json").read_text())
    for task, key in (("information", "worst_sigma"), ("quality", "quality")):
        assert set(document[task]) == set(POLICIES)
        assert all(len(curve[key]) == 3 for curve in document[task].values())
    assert (tmp_path / "baselines.png").read_bytes()[:4] == b"\x89PNG"
    assert "<svg" in (tmp_path / "baselines.svg").read_text()


def test_unknown_words_are_refused() -> None:
    with pytest.raises(UnknownNameError, match="discrete"):
        ScanEnv(action="jump")  # type: ignore[arg-type]


def test_without_gymnasium_one_line_says_what_to_install() -> None:
    code = (
        "import sys; sys.modules['gymnasium'] = None; import flexdt_extensions.learning"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 1
    assert "pip install 'flexdt-extensions[learn]'" in done.stderr
