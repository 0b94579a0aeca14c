"""Do calibrations state the sigmas that were forecast?

`python tests/studies/forecasts.py [--scans 40] [--seed 0] [--draws N] [--unidentified]
[--json]` draws scans of 8 to 240 frames, 4 to 8 balls, magnifications 1.3 to 6 and panels of 190
to 1912 columns, with scanners and phantoms within their assumed tolerances, calibrates their
spots with all causes, and divides each stated sigma by that of `identifiability` at the true
place of the object. The shadows are those of `faults_drawn`. The bead of each spot is known and
positions have sigmas, as after a second measurement of images, or with `--unidentified` not.

What a scan states is a draw: a drift or a cause that the noise looks like stays open. With
`--draws N` each plan is scanned so often, and the command prints the factor by which sigmas
scatter (root mean square about the median): of the tenth, half and nine tenths of the plans. That
is the limit of any forecast; `identifiability` says the range of four scans in five.

The command fails if a median differs by MEDIAN_OFF, if fewer than LEAST_INSIDE of a quantity's
sigmas are in their range or, over all quantities, the share differs by more than INSIDE_OFF
where a range is worth the name (beyond WIDE), or if fewer than LEAST_ALIKE are within ALIKE where
the range is narrower than that.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.detect.detection import Detections
from flexdt.twin.calibration.diagnose.identifiability import Prediction, identifiability
from flexdt.twin.calibration.fit.fit import image_quantities
from flexdt.twin.calibration.fit.forecast import MOST
from flexdt.twin.calibration.frame_source import FrameSpots, FrameState, SpotFrames
from flexdt.twin.calibration.pipeline import CalibrationRequest, Scan, calibrate
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from faults_drawn import SHAPE, SIX, UNSEEN, World, reshaped, shadows

PANELS: Final = (
    (190, 239, 0.2992),
    (380, 478, 0.2992),
    (760, 956, 0.1496),
    (1520, 1912, 0.0748),
)
"""Rows, columns and pitch [mm]."""
ALIKE: Final = 1.25
"""Factor within which a stated sigma is as forecast."""
MEDIAN_OFF: Final = 0.1
LEAST_INSIDE: Final = 0.68
"""Of 60 scans: 80 % less two standard deviations."""
INSIDE_OFF: Final = 0.08
WIDE: Final = 1.05
LEAST_ALIKE: Final = 0.8
TENTHS: Final = (0.1, 0.5, 0.9)


@dataclass(frozen=True)
class Plan:
    """A planned scan, as the operator states it.

    Attributes:
        model: the phantom as stated.
        six: true place of the object, edge units.
        frames, shape, pixel, sod, sdd: of the scan.
        noise_px: standard deviation of a coordinate.
    """

    model: BeadModel
    six: dict[str, float]
    frames: int
    shape: tuple[int, int]
    pixel: float
    sod: float
    sdd: float
    noise_px: float

    @property
    def poses(self) -> Poses:
        """Nominal poses of one turn."""
        angles = 2.0 * np.pi * np.arange(self.frames) / self.frames
        return Poses.upright(
            [0, 0, 0], [0, self.sod, 0], [0, self.sdd, 0], self.pixel, angles
        )


@dataclass(frozen=True)
class Compared:
    """A stated sigma beside its forecast.

    Attributes:
        stated: by the calibration.
        sigma: forecast.
        low, high: range of the forecast.
    """

    stated: float
    sigma: float
    low: float
    high: float

    @property
    def ratio(self) -> float:
        """Stated over forecast."""
        return self.stated / self.sigma

    @property
    def inside(self) -> bool:
        """The stated sigma is in the range."""
        return self.low <= self.stated <= self.high

    @property
    def narrow(self) -> bool:
        """The range is within ALIKE of the forecast."""
        return self.low * ALIKE > self.sigma and self.high < self.sigma * ALIKE


def planned(seed: int) -> tuple[Plan, np.random.Generator]:
    """Draw a plan, and return the generator from which its scan is drawn."""
    rng = np.random.default_rng([seed, 12])
    frames = int(rng.choice([8, 12, 24, 36, 60, 120, 240]))
    rows, cols, pixel = PANELS[int(rng.integers(len(PANELS)))]
    sdd = float(rng.uniform(500.0, 1100.0))
    magnification = float(rng.uniform(1.3, 6.0))
    sod = sdd / magnification
    reach = min(rng.uniform(0.4, 0.8) * rows * pixel / 2 / magnification, 0.3 * sod)
    beads = _beads(rng, int(rng.integers(4, 9)), reach)
    noise = float(rng.uniform(0.005, 0.04))
    sizes = (0.1 * reach, 0.1 * reach, 0.02 * sod, 20.0, 0.05 * reach, 0.05 * reach)
    six = {n: float(s * rng.uniform(-1, 1)) for n, s in zip(SIX, sizes, strict=True)}
    model = BeadModel(beads, np.full(len(beads), 0.04 * reach))
    return Plan(model, six, frames, (rows, cols), pixel, sod, sdd, noise), rng


def world_of(plan: Plan, rng: np.random.Generator) -> World:
    """Draw a scanner and a phantom within their assumed tolerances."""
    unseen = {n: float(w * rng.normal()) for n, w in UNSEEN.items()}
    strain = 1e-3 * rng.normal(size=(3, 3)) + (1.0 + 1e-3 * rng.normal()) * np.eye(3)
    shown = np.ones((plan.frames, len(plan.model)), dtype=bool)
    return World(
        reshaped(plan.model.beads, strain), plan.model.bead_radius_mm, {**plan.six, **unseen},
        360.0 * np.arange(plan.frames) / plan.frames, np.zeros((plan.frames, 3)), shown,
        plan.sod, plan.sdd, plan.pixel,
    )  # fmt: skip


def stated(
    plan: Plan, world: World, rng: np.random.Generator, known: bool = True
) -> dict[str, float] | None:
    """Calibrate noisy spots, and return the sigmas of the six parameters and of the
    quantities in the image; None if the scan is refused.

    Args:
        plan: as stated.
        world: as it is.
        rng: of the noise.
        known: the bead of each spot, and with it the sigmas of the positions, as after a
            second measurement of images; else spots are identified, and count alike.
    """
    rows, cols = plan.shape
    centres, spot_sizes = shadows(world)
    centres = centres + (np.array([cols, rows]) - SHAPE[::-1]) / 2
    looks = []
    index = np.full((plan.frames, len(plan.model)), -1)
    for i, (places, size) in enumerate(zip(centres, spot_sizes, strict=True)):
        spots = places + plan.noise_px * rng.normal(size=places.shape)
        inside = (spots > size[:, None]) & (
            spots < np.array([cols, rows]) - size[:, None]
        )
        order = rng.permutation(np.flatnonzero(inside.all(axis=1)))
        index[i, order] = np.arange(len(order))
        found = Detections.of_points(spots[order], plan.noise_px, size[order], plan.shape)
        outlines = replace(found, bias=np.ones(len(order)))
        looks.append(FrameSpots(outlines, FrameState.USABLE))
    scan = Scan(SpotFrames(looks), plan.poses, index=index if known else None)
    result = calibrate([scan], plan.model, CalibrationRequest(second_look=False))
    if not result.identifiable or result.fit is None:
        return None
    (seen,) = image_quantities(result.fit)
    return result.fit.sigmas | {n: e.sigma for n, e in seen.items()}


def forecast_of(plan: Plan, causes: bool = True) -> Prediction:
    """Forecast a plan at the true place of its object."""
    return identifiability(
        plan.model, plan.poses, plan.noise_px, shape=plan.shape,
        at=Offsets.from_edge(plan.six), causes=causes,
    )  # fmt: skip


def compared(seed: int, known: bool = True) -> dict[str, Compared] | None:
    """Draw and calibrate a scan, and compare its stated sigmas with the forecast ones.

    Args:
        seed: of the scan.
        known: see `stated`.

    Returns:
        Of the six parameters and the quantities in the image; None if it is refused.
    """
    plan, rng = planned(seed)
    found = stated(plan, world_of(plan, rng), rng, known)
    if found is None:
        return None
    expected = forecast_of(plan)
    return {
        n: Compared(found[n], sigma, *expected.ranges[n])
        for n, sigma in (expected.sigmas | expected.image_sigmas).items()
    }


def scatter(seed: int, draws: int) -> dict[str, float]:
    """Compute how much the sigmas differ that scans of one plan state: the root mean
    square of their logarithms about the median.

    Args:
        seed: of the plan.
        draws: of noise, phantom and scanner.
    """
    plan, _ = planned(seed)
    some = []
    for draw in range(draws):
        rng = np.random.default_rng([seed, 13, draw])
        found = stated(plan, world_of(plan, rng), rng)
        if found is not None:
            some.append(found)
    logs = np.log([list(one.values()) for one in some])
    off = logs - np.median(logs, axis=0)
    return dict(zip(some[0], np.sqrt(np.mean(off**2, axis=0)).tolist(), strict=True))


def _beads(rng: np.random.Generator, count: int, reach: float) -> np.ndarray:
    """Draw balls apart from each other in a box of 1.4 x 1.4 x 1.8 reaches, (count, 3)
    [mm]."""
    while True:
        beads = rng.uniform(-1, 1, size=(count, 3)) * [
            0.7 * reach,
            0.7 * reach,
            0.9 * reach,
        ]
        apart = np.linalg.norm(beads[:, None] - beads, axis=2)[~np.eye(count, dtype=bool)]
        if apart.min() > 0.3 * reach and np.ptp(beads[:, 2]) > 0.8 * reach:
            return beads


def main(argv: Sequence[str] | None = None) -> int:
    """Calibrate drawn scans and print how stated and forecast sigmas compare.

    Returns:
        1 if they do not, else 0.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--draws", type=int, default=0)
    parser.add_argument("--unidentified", action="store_true")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    seeds = range(args.seed, args.seed + args.scans)
    if args.draws:
        every = [scatter(seed, args.draws) for seed in seeds]
        for name in every[0]:
            values = np.exp([one[name] for one in every])
            print(
                f"{name:14}" + "  ".join(f"{q:.2f}" for q in np.quantile(values, TENTHS))
            )
        return 0
    found = [compared(seed, not args.unidentified) for seed in seeds]
    some = [one for one in found if one is not None]
    rows = {name: _figures([one[name] for one in some]) for name in some[0]}
    wide = [v.inside for one in some for v in one.values() if v.high > WIDE * v.low]
    inside = float(np.mean(wide))
    if args.json:
        counts = {"scans": args.scans, "offered": len(some), "wide_inside": inside}
        print(json.dumps({**counts, "ratios": rows}))
    else:
        print(f"{len(some)} of {args.scans} offered; stated over forecast sigma:")
        for name, row in rows.items():
            print(f"  {name:14}" + "  ".join(f"{k} {v:.2f}" for k, v in row.items()))
        print(f"{inside:.3f} of {len(wide)} sigmas with a wide range are in it")
    return int(
        abs(inside - MOST) > INSIDE_OFF
        or any(
            abs(row["median"] - 1.0) > MEDIAN_OFF
            or row["inside"] < LEAST_INSIDE
            or row["narrow_alike"] < LEAST_ALIKE
            for row in rows.values()
        )
    )


def _figures(found: Sequence[Compared]) -> dict[str, float]:
    """Sum up one quantity: median, least and largest ratio, the shares within ALIKE and
    within the range, and of those with a narrow range the share and how many are within
    ALIKE (nan without any).
    """
    values = np.array([one.ratio for one in found])
    alike = np.abs(np.log(values)) < math.log(ALIKE)
    narrow = np.array([one.narrow for one in found])
    return {
        "median": float(np.median(values)),
        "least": float(values.min()),
        "largest": float(values.max()),
        "alike": float(np.mean(alike)),
        "inside": float(np.mean([one.inside for one in found])),
        "narrow": float(np.mean(narrow)),
        "narrow_alike": float(alike[narrow].mean()) if narrow.any() else math.nan,
    }


if __name__ == "__main__":
    raise SystemExit(main())
