"""Baselines of the learning environments: random, equidistant and greedy, side by side.

    python extensions/examples/learning_baselines.py --out DIR [--episodes N] [--frames N]

writes baselines.png, baselines.svg and baselines.json. Needs the extras learn and docs (for
Matplotlib).
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from flexdt_extensions.learning.scanning import POLICIES, ScanEnv, play

COLOURS = {"random": "#5f6c7b", "equidistant": "#1b6ca8", "greedy": "#c8553d"}


def run(task: str, frames: int, episodes: int) -> dict[str, dict[str, Any]]:
    """Play each policy's episodes of one task, at seeds 1 to `episodes`.

    Args:
        task: "information" or "quality".
        frames: of an episode.
        episodes: of each policy.

    Returns:
        Policy -> the task's figure ("worst_sigma" or "quality") and "clock_s" after each
        frame, as means over the episodes; mean and standard deviation of the summed reward.
    """
    key = {"information": "worst_sigma", "quality": "quality"}[task]
    out: dict[str, dict[str, Any]] = {}
    for name, policy in POLICIES.items():
        env = ScanEnv(action="angle", task=task, frames=frames)  # type: ignore[arg-type]
        played = [play(env, policy, seed) for seed in range(1, episodes + 1)]

        def mean(of: Any, played: Any = played) -> list[float]:
            """Average a figure of an info over the episodes, a value for each frame."""
            return np.mean([[of(i) for i in e.infos] for e in played], axis=0).tolist()

        out[name] = {
            key: mean(lambda i: i[key]),
            "clock_s": mean(lambda i: i["clock_s"]),
            "reward": float(np.mean([sum(e.rewards) for e in played])),
            "reward_std": float(np.std([sum(e.rewards) for e in played])),
        }
    return out


def draw(found: dict[str, dict[str, dict[str, Any]]], out: Path) -> None:
    """Draw a row for each task: its figure over the frames and over the scanner's clock.

    Args:
        found: task -> what `run` returns. Sigmas get a logarithmic axis.
        out: folder for baselines.png and baselines.svg, which must exist.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(9.5, 6.5), layout="constrained")
    labels = {
        "information": ("worst_sigma", "worst sigma / tolerance"),
        "quality": ("quality", "1 - RMSE / RMS"),
    }
    for row, (task, (key, label)) in zip(axes, labels.items(), strict=True):
        for name, curve in found[task].items():
            values, clock = np.array(curve[key]), curve["clock_s"]
            title = f"{name} (reward {curve['reward']:.1f})"
            row[0].plot(
                np.arange(1, len(values) + 1), values, "o-", ms=3, color=COLOURS[name]
            )
            row[1].plot(clock, values, "o-", ms=3, color=COLOURS[name], label=title)
        for axis in row:
            axis.set_ylabel(label)
            axis.grid(alpha=0.3)
            if task == "information":
                axis.set_yscale("log")
        row[0].set_xlabel("frames")
        row[1].set_xlabel("seconds of the scanner's clock")
        row[1].legend(fontsize=8)
        row[0].set_title(
            "Calibrate (LEGO phantom)" if task == "information" else "Reconstruct"
        )
    for suffix in ("png", "svg"):
        figure.savefig(out / f"baselines.{suffix}", dpi=110)
    plt.close(figure)


def main() -> None:
    """Run all policies on both tasks, write baselines.json, .png and .svg into --out (made
    if it is not there), and print rewards and clock.
    """
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--episodes", type=int, default=8)
    parser.add_argument("--frames", type=int, default=16)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    found = {
        task: run(task, given.frames, given.episodes)
        for task in ("information", "quality")
    }
    document = {"frames": given.frames, "episodes": given.episodes, **found}
    (given.out / "baselines.json").write_text(
        json.dumps(document, indent=1), encoding="utf-8"
    )
    draw(found, given.out)
    for task, policies in found.items():
        for name, curve in policies.items():
            print(
                f"{task:12s} {name:12s} reward {curve['reward']:7.2f} +- "
                f"{curve['reward_std']:.2f}, "
                f"{curve['clock_s'][-1]:6.1f} s"
            )


if __name__ == "__main__":
    main()
