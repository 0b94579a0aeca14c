"""Baselines for the scan environment: random, equidistant, and greedy for information.

A policy is a function of the environment: it reads only what an agent may know and returns an
action.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from flexdt_extensions.learning.scanning import SECTORS, Action, ScanEnv

Policy = Callable[[ScanEnv, int], Action]
"""Environment and number of the frame (from 0) to action."""


def uniform(env: ScanEnv, frame: int) -> Action:
    """Any action; poses anywhere in the travel, collisions included."""
    if env.kind == "pose":
        return env.np_random.uniform(-1.0, 1.0, 4).astype(np.float32)
    return env.action_for({"rot_obj": float(env.np_random.uniform(-180.0, 180.0))})


def equidistant(env: ScanEnv, frame: int) -> Action:
    """One turn in equal steps, as every scan script does."""
    return env.action_for({"rot_obj": 360.0 * frame / env.frames})


def greedy(env: ScanEnv, frame: int) -> Action:
    """The angle that promises most information for its time, at the nominal geometry."""
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
    """What happened, frame by frame.

    Attributes:
        rewards: of each step.
        infos: what the environment said of each.
        targets: motor positions asked for.
        collided: it ended so.
    """

    rewards: tuple[float, ...]
    infos: tuple[dict[str, Any], ...]
    targets: tuple[dict[str, float], ...]
    collided: bool


def play(env: ScanEnv, policy: Policy, seed: int) -> Episode:
    """One episode from `seed`."""
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
