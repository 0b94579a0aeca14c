"""Steps a second of the learning environments, one at a time and many at once.

    python tests/studies/learning_speed.py [--envs N] [--seconds S]

Actions are drawn from a seed; steps that only begin a new episode are timed but not counted.
"""

from __future__ import annotations

import argparse
import os
import time

import gymnasium
import numpy as np

import flexdt_extensions.learning  # noqa: F401 - registers the environments

NAMES = ("flexdt/NextAngleQuality-v0", "flexdt/NextAngleDiscrete-v0")


def single(name: str, seconds: float) -> tuple[float, float]:
    """Steps a second of one environment, by the clock and of the processor's time."""
    env = gymnasium.make(name)
    env.action_space.seed(1)
    env.reset(seed=1)
    env.step(env.action_space.sample())  # compiles
    env.reset(seed=1)
    steps, used, begun = 0, time.process_time(), time.perf_counter()
    while (taken := time.perf_counter() - begun) < seconds:
        *_, over, cut, _ = env.step(env.action_space.sample())
        steps += 1
        if over or cut:
            env.reset()
    return steps / taken, steps / (time.process_time() - used)


def many(name: str, count: int, seconds: float) -> tuple[float, float]:
    """The same of `count` environments together."""
    envs = gymnasium.make_vec(name, num_envs=count)
    envs.action_space.seed(1)
    envs.reset(seed=1)
    for _ in range(18):  # compiles, and looks up most turns once
        envs.step(envs.action_space.sample())
    envs.reset(seed=1)
    steps, before = 0, np.zeros(count, bool)
    used, begun = time.process_time(), time.perf_counter()
    while (taken := time.perf_counter() - begun) < seconds:
        *_, over, cut, _ = envs.step(envs.action_space.sample())
        steps += int(count - before.sum())
        before = over | cut
    return steps / taken, steps / (time.process_time() - used)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--envs", type=int, default=64)
    parser.add_argument("--seconds", type=float, default=10.0)
    given = parser.parse_args()
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores before the first")
    for name in NAMES:
        for what, (clock, used) in (
            ("alone", single(name, given.seconds)),
            (f"{given.envs} together", many(name, given.envs, given.seconds)),
        ):
            print(
                f"{name}, {what}: {clock:.1f} steps/s by the clock, {used:.1f} a CPU second, "
                f"load {os.getloadavg()[0]:.1f}"
            )


if __name__ == "__main__":
    main()
