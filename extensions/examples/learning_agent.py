"""An agent that learns from which angles to look at plates, beside angles fixed beforehand.

    python extensions/examples/learning_agent.py --out DIR [--seeds N] [--rounds N]
        [--episodes N] [--judged N]

Four views of one or two parallel plates at a hidden angle; the score is the quality of their
reconstruction (1 - RMSE / RMS). The agent is fitted Q iteration with a small network, written
out in NumPy: it plays episodes, learns what an angle was worth after what it had seen, and
plays again. It is judged once, after its last round, on plates from seeds that neither training
nor the choice of any parameter has seen. Writes agent.json, agent.png and agent.svg; needs the
extras learn and docs (for Matplotlib).
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from flexdt_extensions.learning.scanning import SECTORS, ScanEnv
from flexdt_extensions.learning.vector_scanning import ScanVectorEnv

FRAMES, GAIN = 4, 20.0
FEATURES = 4
PART = 5 * (1 + FEATURES)
INPUTS = FRAMES + (FRAMES - 1) * PART
JUDGED_SEED, TRAINING_SEED, PILOT_SEED = 9_000_000, 1_000_000, 5_000_000
Array = np.ndarray[Any, Any]
Policy = Callable[[Array, Array], Array]
"""Features of the frames so far (k, frames, 4) and their angles (k, frames) to sectors (k,)."""


def features(images: Array) -> Array:
    """Compute four features of images (k, rows, cols, 1) of 0 to 255: (k, 4).

    They are the horizontal variance of the mass in half widths (times 10), the highest gray
    value of 1, the mass (over 100), and the steepest step between columns of the column sums
    (over 5).
    """
    grey = images[..., 0].astype(np.float64) / 255.0
    columns = np.linspace(-1.0, 1.0, grey.shape[2])
    profile = grey.sum(axis=1) + 1e-9
    mass = profile.sum(axis=1)
    share = profile / mass[:, None]
    variance = share @ columns**2 - (share @ columns) ** 2
    edge = np.abs(np.diff(profile, axis=1)).max(axis=1)
    return np.stack(
        [10.0 * variance, grey.max(axis=(1, 2)), mass / 100.0, edge / 5.0], axis=1
    )


def questions(seen: Array, angles: Array, asked: Array) -> Array:
    """Make the network's input for every pair of a state and a possible angle.

    For each frame so far: its features, alone and times cosines and sines of twice and four
    times the angle between it and the one in question, because a plate looks the same from
    both sides; frames still to come are 0. The number of frames is coded one-hot.

    Args:
        seen: features of the frames so far, (k, frames, features).
        angles: of those frames [rad], (k, frames).
        asked: possible angles [rad], (n,).

    Returns:
        (k, n, `INPUTS`).
    """
    k, frames = angles.shape
    out = np.zeros((k, len(asked), INPUTS))
    out[:, :, frames] = 1.0
    for i in range(frames):
        turn = 2.0 * (asked[None] - angles[:, i, None])
        waves = [f(m * turn) for m in (1, 2) for f in (np.cos, np.sin)]
        harmonics = np.stack([np.ones_like(turn), *waves], axis=2)
        values = np.concatenate([np.ones((k, 1)), seen[:, i]], axis=1)
        block = harmonics[:, :, :, None] * values[:, None, None, :]
        at = FRAMES + PART * i
        out[:, :, at : at + PART] = block.reshape(k, len(asked), PART)
    return out


class Network:
    """Two hidden layers of tanh, fitted by Adam to mean squared error."""

    def __init__(self, inputs: int, rng: np.random.Generator, width: int = 64) -> None:
        """Draw normal weights of variance 1 / inputs for two hidden layers; biases are 0.

        Args:
            inputs: numbers of an input.
            rng: draws the weights, and later the training pairs.
            width: of both hidden layers.
        """
        sizes = [inputs, width, width, 1]
        self.rng = rng
        self.weights = [rng.normal(size=(a, b)) / np.sqrt(a) for a, b in pairwise(sizes)]
        self.biases = [np.zeros(b) for b in sizes[1:]]

    def __call__(self, x: Array) -> Array:
        return self._layers(x)[-1][..., 0]

    def _layers(self, x: Array) -> list[Array]:
        """Compute all layers for inputs (n, inputs): the input, two layers of tanh, and the
        linear output (n, 1).
        """
        out = [x]
        for i, (w, b) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = x @ w + b
            out.append(np.tanh(x) if i < 2 else x)
        return out

    def fit(self, x: Array, y: Array, steps: int, rate: float = 2e-3) -> None:
        """Minimise the mean squared error to y (n,) by Adam, in place.

        Args:
            x: inputs, (n, inputs).
            y: wanted outputs, (n,).
            steps: each of 256 pairs, drawn with replacement.
            rate: first step size; it falls linearly to nearly 0.
        """
        parameters = [*self.weights, *self.biases]
        first = [np.zeros_like(p) for p in parameters]
        second = [np.zeros_like(p) for p in parameters]
        for step in range(1, steps + 1):
            some = self.rng.integers(0, len(x), 256)
            layers = self._layers(x[some])
            slope = (layers[-1] - y[some, None]) / len(some)
            gradients: list[Array] = [np.empty(0)] * 6
            for i in (2, 1, 0):
                gradients[i], gradients[3 + i] = layers[i].T @ slope, slope.sum(axis=0)
                slope = (slope @ self.weights[i].T) * (1.0 - layers[i] ** 2)
            now = rate * (1.0 - step / (steps + 1))
            for p, g, m, v in zip(parameters, gradients, first, second, strict=True):
                m += 0.1 * (g - m)
                v += 0.001 * (g * g - v)
                p -= now * (m / (1 - 0.9**step)) / (np.sqrt(v / (1 - 0.999**step)) + 1e-8)


class Ensemble:
    """The mean of several networks: what one of them overestimates is chosen less often."""

    def __init__(self, rng: np.random.Generator, members: int = 3) -> None:
        self.members = [Network(INPUTS, rng) for _ in range(members)]

    def __call__(self, x: Array) -> Array:
        return np.mean([member(x) for member in self.members], axis=0)

    def fit(self, x: Array, y: Array, steps: int) -> None:
        """Fit each to pairs of its own drawing."""
        for member in self.members:
            member.fit(x, y, steps)


ANGLES = 2.0 * np.pi * np.arange(SECTORS) / SECTORS


def play(envs: ScanVectorEnv, policy: Policy, seeds: list[int]) -> dict[str, Array]:
    """Run one episode of `FRAMES` frames in each environment.

    Args:
        envs: k environments, stepped together.
        policy: chooses sectors from the features and angles so far.
        seeds: of the k episodes.

    Returns:
        "seen" (k, frames, features), "sectors" and "rewards" (k, frames).
    """
    observation, _ = envs.reset(seed=seeds)
    seen = np.zeros((envs.num_envs, 0, FEATURES))
    sectors = np.zeros((envs.num_envs, 0), np.int64)
    rewards = np.zeros((envs.num_envs, 0))
    for _ in range(FRAMES):
        chosen = policy(seen, ANGLES[sectors])
        observation, reward, *_ = envs.step(chosen)
        seen = np.concatenate([seen, features(observation)[:, None]], axis=1)
        sectors = np.concatenate([sectors, chosen[:, None]], axis=1)
        rewards = np.concatenate([rewards, reward[:, None]], axis=1)
    return {"seen": seen, "sectors": sectors, "rewards": rewards}


def fixed(sectors: list[int]) -> Policy:
    """Choose the same angles whatever is observed."""
    return lambda seen, angles: np.full(len(seen), sectors[seen.shape[1]])


def greedy_sectors() -> list[int]:
    """Choose `FRAMES` sectors one by one as the package's greedy baseline does: the highest
    forecast (the first of equals), blind to images.
    """
    env = ScanEnv(action="discrete", task="plates", frames=FRAMES, time_weight=0.0)
    env.reset(seed=0)
    chosen: list[int] = []
    for _ in range(FRAMES):
        forecast = env.forecast([env.targets(np.int64(s)) for s in range(SECTORS)])
        chosen.append(int(np.argmax(np.round(forecast, 9))))
        env.step(np.int64(chosen[-1]))
    return chosen


def best(network: Ensemble, rng: np.random.Generator, random_part: float) -> Policy:
    """Make a policy that chooses the sector of the highest predicted value.

    The first frame is always sector 0.

    Args:
        network: predicts values.
        rng: draws the exceptions.
        random_part: probability of a random sector instead.
    """

    def policy(seen: Array, angles: Array) -> Array:
        """Choose a sector for each of k episodes, from features (k, frames, features) and
        angles [rad] (k, frames).
        """
        k, frames = angles.shape
        if frames == 0:
            return np.zeros(k, np.int64)
        value = network(questions(seen, angles, ANGLES))
        drawn = rng.integers(0, SECTORS, k)
        return np.where(rng.random(k) < random_part, drawn, value.argmax(axis=1))

    return policy


def learn(
    envs: ScanVectorEnv,
    seed: int,
    rounds: int,
    episodes: int,
    steps: int,
    tell: Callable[[str], None],
) -> tuple[Ensemble, list[float]]:
    """Learn a policy by fitted Q iteration.

    The first round plays at random, later ones by the network with a quarter at random; each
    round refits the network three times to all episodes so far, with the value of the best
    next angle added to a frame's reward.

    Args:
        envs: environments, stepped together.
        seed: of the network and the objects.
        rounds: of playing and fitting.
        episodes: of a round; what is left over by the number of environments is not played.
        steps: of each fit.
        tell: called with a line after each round.

    Returns:
        The network, and the mean score of the episodes of each round.
    """
    rng = np.random.default_rng(seed)
    network = Ensemble(rng)
    games: list[dict[str, Array]] = []
    curve: list[float] = []
    count = envs.num_envs
    for number in range(rounds):
        policy = best(network, rng, 1.0 if number == 0 else 0.25)
        played = []
        for part in range(episodes // count):
            at = TRAINING_SEED * (1 + seed) + (number * episodes) + part * count
            played.append(play(envs, policy, list(range(at, at + count))))
        games += played
        curve.append(
            float(np.mean([g["rewards"].sum(axis=1).mean() for g in played]) / GAIN)
        )
        seen, sectors, rewards = (
            np.concatenate([g[key] for g in games])
            for key in ("seen", "sectors", "rewards")
        )
        # Backwards: the last frame's worth is its reward, an earlier one's what may follow,
        #     too.
        for _ in range(3):
            inputs, targets = [], []
            for frame in range(1, FRAMES):
                angles = ANGLES[sectors[:, :frame]]
                every = questions(seen[:, :frame], angles, ANGLES)
                taken = np.arange(len(every)), sectors[:, frame]
                target = rewards[:, frame] / GAIN
                if frame + 1 < FRAMES:
                    after = questions(
                        seen[:, : frame + 1], ANGLES[sectors[:, : frame + 1]], ANGLES
                    )
                    target = target + network(after).max(axis=1)
                inputs.append(every[taken])
                targets.append(target)
            network.fit(np.concatenate(inputs), np.concatenate(targets), steps)
        tell(
            f"seed {seed}, round {number + 1}: {curve[-1]:.3f} while it tries a quarter "
            "at random"
        )
    return network, curve


def judge(envs: ScanVectorEnv, policy: Policy, seed: int, judged: int) -> Array:
    """Score a policy on objects of their own seeds.

    Objects are played in groups of as many as there are environments; those of the last
    group beyond `judged` do not count.

    Args:
        envs: environments, stepped together.
        policy: to judge.
        seed: of the first object; the following ones count up.
        judged: number of objects.

    Returns:
        (judged,) sum of rewards over `GAIN`: 1 - RMSE / RMS.
    """
    count = envs.num_envs
    found = [
        play(envs, policy, list(range(seed + at, seed + at + count)))["rewards"].sum(
            axis=1
        )
        for at in range(0, judged, count)
    ]
    return np.concatenate(found)[:judged] / GAIN


def draw(document: dict[str, Any], out: Path) -> None:
    """Draw the curves of training, and bars of all policies' scores with their standard
    errors, into agent.png and agent.svg.

    Args:
        document: as written to agent.json.
        out: folder, which must exist.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(9.5, 3.6), layout="constrained")
    for curve in document["curves"]:
        left.plot(np.arange(1, len(curve) + 1), curve, "o-", ms=3)
    left.set(xlabel="round", ylabel="quality of the round's episodes", title="training")
    names = list(document["scores"])
    means = [document["scores"][n]["mean"] for n in names]
    errors = [document["scores"][n]["standard_error"] for n in names]
    right.barh(names, means, xerr=errors, color="#1b6ca8")
    right.set(
        xlabel="1 - RMSE / RMS", title=f"{document['judged']} plates not seen before"
    )
    for suffix in ("png", "svg"):
        figure.savefig(out / f"agent.{suffix}", dpi=110)
    plt.close(figure)


def main() -> None:
    """Train one agent a seed, judge it beside three fixed policies on plates not seen
    before, and write agent.json, agent.png and agent.svg.

    The agent's score is the mean over the seeds. --pilot judges on the plates that settings
    were chosen by. Prints the scores and how much the agent is better than the greedy one.
    """
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--episodes", type=int, default=384, help="of a round")
    parser.add_argument(
        "--steps", type=int, default=1500, help="of each fit of a network"
    )
    parser.add_argument("--judged", type=int, default=256)
    parser.add_argument("--envs", type=int, default=64)
    parser.add_argument(
        "--pilot", action="store_true", help="judge on the pilot's plates"
    )
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    envs = ScanVectorEnv(
        given.envs, action="discrete", task="plates", observation="projection", frames=FRAMES,
        time_weight=0.0, dose_weight=0.0,
    )  # fmt: skip
    at = PILOT_SEED if given.pilot else JUDGED_SEED
    policies = {
        "equidistant, full turn": fixed([0, 9, 18, 27]),
        "equidistant, half turn": fixed([0, 4, 9, 13]),
        "greedy": fixed(greedy_sectors()),
    }
    scores = {
        name: judge(envs, policy, at, given.judged) for name, policy in policies.items()
    }
    curves, agents = [], []
    for seed in range(given.seeds):
        network, curve = learn(
            envs, seed, given.rounds, given.episodes, given.steps, print
        )
        curves.append(curve)
        agents.append(
            judge(envs, best(network, np.random.default_rng(0), 0.0), at, given.judged)
        )
    scores["agent"] = np.mean(agents, axis=0)
    document = {
        "frames": FRAMES,
        "judged": given.judged,
        "scores": {
            name: {
                "mean": float(values.mean()),
                "standard_error": float(values.std() / np.sqrt(len(values))),
            }
            for name, values in scores.items()
        },
        "agents": [float(values.mean()) for values in agents],
        "curves": curves,
    }
    better = scores["agent"] - scores["greedy"]
    document["agent_less_greedy"] = {
        "mean": float(better.mean()),
        "standard_error": float(better.std() / np.sqrt(len(better))),
        "better_on": float((better > 0).mean()),
    }
    (given.out / "agent.json").write_text(
        json.dumps(document, indent=1), encoding="utf-8"
    )
    draw(document, given.out)
    for name, score in document["scores"].items():
        print(f"{name:24s} {score['mean']:.3f} +- {score['standard_error']:.3f}")
    print("agents of each seed:", " ".join(f"{a:.3f}" for a in document["agents"]))
    less = document["agent_less_greedy"]
    print(
        f"agent less greedy, plate by plate: {less['mean']:.3f} +- "
        f"{less['standard_error']:.3f}, "
        f"better on {less['better_on']:.0%}"
    )


if __name__ == "__main__":
    main()
