"""How many frames and minutes `flexdt job watch` saves, and whether what is left is worth it.

    python tests/studies/adaptive_stopping.py [--scans 20] [--seed 0]

Each drawn scan is 60 to 120 images of the LEGO phantom at golden-section angles, of a twin
process that hides a drawn misalignment; the watcher asks for drawn sigmas of tau_x and tau_z.
Minutes are those of the scan's own clock. It runs `--speed-up` times as fast as the
laboratory's, so frames go by during a fit that a real scan would not have taken. The sigmas
afterwards are those of `flexdt.calibrate` on the data set as it is left, and the truth is
compared with them.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np

import flexdt as fx
from flexdt.clients import TwinClient
from flexdt_extensions.watch import watch

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from lab import Process, machine, projector, twin

MOST = {"dO_x": 1.0, "dO_y": 1.0, "dO_z": 2.0, "alpha": 5.0, "tau_x": 0.5, "tau_z": 0.5}
"""Largest offsets that are hidden [mm, deg]."""
NAME = "beads"


def drawn_truth(rng: random.Random) -> dict[str, float]:
    """Offsets to hide, edge units."""
    return {name: round(rng.uniform(-most, most), 4) for name, most in MOST.items()}


def drawn_wish(rng: random.Random) -> dict[str, float]:
    """Sigmas to ask for [mm], from easy ones to some that take a good part of the scan."""
    return {
        name: float(f"{1e-4 * 4.0 ** rng.random():.3g}") for name in ("tau_x", "tau_z")
    }


@contextmanager
def hiding(rays: Process, folder: Path, truth: Mapping[str, float]) -> Iterator[int]:
    """The port of a twin that hides `truth`; its data are in `folder`/data."""
    hidden = folder / "truth.toml"
    hidden.write_text("".join(f"{name} = {value}\n" for name, value in truth.items()))
    (folder / "data").mkdir()
    process = twin(rays.port, folder / "data", "--truth", hidden, "--speed-up", "max")
    try:
        yield process.port
    finally:
        process.end()


def submit(
    client: TwinClient, rng: random.Random, frames: int, speed_up: float
) -> tuple[str, float]:
    """A job whose angles lie all over the turn from the first on, and how long it is to
    take."""
    client.set_sample("lego")
    client.set_camera(mode="HW4SW1High")
    client.set_tube(power_W=rng.uniform(5.0, 30.0))
    client.move({"mag_obj": rng.uniform(500.0, 700.0), "mag_det": 1000.0}, wait=True)
    first = rng.uniform(0.0, 360.0)
    poses = [{"rot_obj": round((first + 222.4922 * i) % 360.0, 3)} for i in range(frames)]
    planned = client.check_trajectory(poses, 100.0).duration_s
    job = client.submit_trajectory(
        poses, 100.0, NAME, speed_up, seed=rng.randrange(99)
    ).job
    return job, planned


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--scans", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--speed-up", type=float, default=3.0)
    options = parser.parse_args()
    rays = projector()
    print(f"{machine()}; seeds {options.seed} to {options.seed + options.scans - 1}")
    print(
        "scan  frames   of  minutes    of  ended  sigma/asked  worst |truth - value|/sigma"
    )
    rows, pulls = [], []
    for seed in range(options.seed, options.seed + options.scans):
        rng = random.Random(seed)
        truth, wish, frames = drawn_truth(rng), drawn_wish(rng), rng.randrange(60, 121)
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            with (
                hiding(rays, folder, truth) as port,
                TwinClient("127.0.0.1", port, timeout_s=300.0) as client,
            ):
                job, planned = submit(client, rng, frames, options.speed_up)
                watch(client, "lego", wish, job)
                status = client.job_status(job)
            fit = fx.calibrate(folder / "data" / NAME, "lego").parameters
        share = max(float(fit[n]["sigma"]) / most for n, most in wish.items())
        off = [
            abs(float(fit[n]["value"]) - x) / float(fit[n]["sigma"])
            for n, x in truth.items()
        ]
        pulls += off
        early = status.state == "aborted"
        took = status.elapsed_s if early else planned
        rows.append((status.frames_done, frames, took / 60, planned / 60, early, share))
        print(
            f"{seed:4d} {rows[-1][0]:7d} {frames:4d} {rows[-1][2]:8.2f} {rows[-1][3]:5.2f} "
            f"{'early' if early else 'whole':>6} {share:12.2f} {max(off):12.2f}",
            flush=True,
        )
    rays.end()
    made, of, took, planned = (sum(row[i] for row in rows) for i in range(4))
    cut = [row for row in rows if row[4]]
    print(
        f"{len(cut)} of {len(rows)} ended early; {of - made} of {of} frames and "
        f"{planned - took:.0f} of {planned:.0f} minutes saved; sigma within what was asked in "
        f"{sum(row[5] <= 1.0 for row in cut)} of {len(cut)}; truth within 1.96 sigma "
        f"{100 * np.mean(np.array(pulls) < 1.96):.0f} % of {len(pulls)}, worst {max(pulls):.1f}"
    )


if __name__ == "__main__":
    main()
