"""Is a scan that is exposed while the stage turns told as that, and nothing false?

`python tests/studies/arcs_drawn.py [--count 40] [--seed 0] [--least 0.1] [--most 1.5]
[--json]` makes radiographs of balls with all seventeen offsets drawn from their priors, each
exposed over an arc of `--least` to `--most` steps in a turn of 24 to 120 frames, every second
one in an acrylic tube, and calibrates from them without a word on the exposure. `--most 0`
makes images of instants. Light, blur and noise are written out here and in `beam_faults`;
nothing of flexdt is in the images. A value that is more than four sigmas off is a confident
wrong answer, and the command fails.
"""

from __future__ import annotations

import argparse
import json
import math
import time
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import beam_faults
import cv2
import numpy as np
import numpy.typing as npt
import prior_coverage as own
from beam_faults import (
    ATTENUATION,
    BODY,
    WRONG_SIGMAS,
    Array,
    Laboratory,
    Rng,
    cylinder,
    rays,
)

from flexdt.twin.calibration.pipeline import Calibration
from flexdt.twin.errors import TwinError

FRAMES: Final = (24, 36, 48, 60, 90, 120)
MOMENT_PX: Final = 2.0
"""Largest way of a ball's image from one moment of an exposure to the next [px]."""


@dataclass(frozen=True)
class Told:
    """What came of one scan.

    Attributes:
        seed, frames, share, body: what was drawn.
        offered: whether numbers were.
        found: share of a step that was found; NaN if none was named.
        worst, where: largest error [sigma] of an offered value, and its name.
        off_px: rms distance of the measured spots from the mean image of each exposure,
            and from that of its middle [px].
        said: findings.
        cpu_s: of the calibration.
    """

    seed: int
    frames: int
    share: float
    body: str
    offered: bool
    found: float
    worst: float
    where: str
    off_px: tuple[float, float]
    said: tuple[str, ...]
    cpu_s: float

    @property
    def codes(self) -> set[str]:
        """Codes of the findings."""
        return {line.partition(":")[0] for line in self.said}


def exposed(
    lab: Laboratory,
    rng: Rng,
    beads: Array,
    angles: Array,
    arc: float,
    truth: Mapping[str, float],
) -> list[npt.NDArray[np.float32]]:
    """Simulate line integrals of balls that turn while a frame is exposed, in a tube that
    stands still; one image (rows, cols) for each angle.

    Args:
        lab: materials, sizes, blur and photons.
        rng: of the noise.
        beads: (k, 3) [mm].
        angles: (n,) of the middles of the exposures [deg].
        arc: that the stage turns in an exposure [deg].
        truth: offsets [mm, deg].
    """
    ball, body = ATTENUATION[lab.ball][1], ATTENUATION[lab.body][1]
    tube = np.ones(own.SHAPE)
    if lab.body != "air":
        ends = np.array([[0.0, 0.0, -30.0], [0.0, 0.0, 30.0]])
        ((low, high),), _ = own.places(ends, np.zeros(1), own.SOD, truth)
        tube = np.exp(-body * cylinder(rays(truth), low, high, lab.body_mm))
    way = np.diff(
        own.pixels(beads, angles[0] + np.array([0.0, 90.0]), own.SOD, truth), axis=0
    )
    moments = 1 + 2 * math.ceil(0.5 * np.radians(arc) * np.abs(way).max() / MOMENT_PX)
    # So few moments have the variance of an even exposure.
    parts = (np.arange(moments) - 0.5 * (moments - 1)) / math.sqrt(max(moments**2 - 1, 1))
    out = []
    for angle in angles.tolist():
        shown, passing = np.ones(own.SHAPE), np.ones(own.SHAPE)
        at, panel = own.places(beads, angle + arc * parts, own.SOD, truth)
        middles = own.pixels(beads, angle + arc * parts, own.SOD, truth)
        for balls, centres in zip(at, middles, strict=True):
            touched = []
            for place, centre in zip(balls, centres, strict=True):
                where, passed = own.shadow(place, centre, panel, lab.cast_mm, own.SOD)
                before = passing[where]
                passing[where] *= passed(ball - body)
                shown[where] -= (before - passing[where]) / moments
                touched.append(where)
            for where in touched:
                passing[where] = 1.0
        shown = cv2.GaussianBlur(shown * tube, (0, 0), lab.blur_px[0])
        counts = np.maximum(rng.poisson(lab.photons * shown), 0.5)
        out.append((-np.log(counts / lab.photons)).astype(np.float32))
    return out


def drawn(seed: int, least: float, most: float) -> tuple[Any, ...]:
    """Draw a scan: laboratory, balls, angles [deg], share of a step, offsets, images."""
    rng = np.random.default_rng([seed, 73])
    lab = Laboratory(mono=True, **(BODY if seed % 2 else {}))  # type: ignore[arg-type]
    beads = own.spread(rng, 4.5 * lab.radius_mm)
    truth = own.drawn(rng, 1.0, False)
    frames = int(rng.choice(FRAMES))
    share = float(rng.uniform(least, most)) if most > 0 else 0.0
    angles = 360.0 * np.arange(frames) / frames
    images = exposed(lab, rng, beads, angles, share * 360.0 / frames, truth)
    return lab, beads, angles, share, truth, images


def told(seed: int, least: float = 0.1, most: float = 1.5) -> Told:
    """Make a scan, calibrate from it and compare the answer with the truth."""
    lab, beads, angles, share, truth, images = drawn(seed, least, most)
    begin = time.process_time()
    try:
        result = beam_faults.calibrated(lab, beads, angles, images)
    except TwinError as error:
        return Told(
            seed, len(angles), share, lab.body, False, math.nan, 0.0, "",
            (math.nan, math.nan), (f"refused: {error}",), time.process_time() - begin,
        )  # fmt: skip
    cpu = time.process_time() - begin
    said = tuple(f"{f.code}: {f.text}" for f in result.findings)
    off = beam_faults.errors_of(result, truth, lab) if result.identifiable else {}
    where = max(off, key=lambda n: off[n], default="")
    return Told(
        seed, len(angles), share, lab.body, result.identifiable, _found(result),
        off.get(where, 0.0), where, _distances(result, beads, angles, share, truth), said, cpu,
    )  # fmt: skip


def _found(result: Calibration) -> float:
    """Return the share of a step that was found, NaN without one."""
    told = [m.smear.share for m in result.measured if m.smear.told]
    return told[0] if told else math.nan


def _distances(
    result: Calibration,
    beads: Array,
    angles: Array,
    share: float,
    truth: Mapping[str, float],
) -> tuple[float, float]:
    """Compute the rms distances of measured spots from the mean image of each exposure and
    from the image of its middle [px]; NaN without a second measurement.
    """
    if not result.measured:
        return math.nan, math.nan
    tracks = result.measured[0].tracks
    parts = (np.arange(24) + 0.5) / 24 - 0.5
    arc = share * (angles[1] - angles[0])
    some = [own.pixels(beads, angles + arc * p, own.SOD, truth) for p in parts]
    middle = own.pixels(beads, angles, own.SOD, truth)
    means = np.mean(some, axis=0), middle
    mean, instant = (float(np.sqrt(np.nanmean((tracks - m) ** 2))) for m in means)
    return mean, instant


def main(argv: Sequence[str] | None = None) -> int:
    """Calibrate drawn scans, print a line for each and the counts.

    Returns:
        1 if a value is more than WRONG_SIGMAS off, else 0.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--least", type=float, default=0.1)
    parser.add_argument("--most", type=float, default=1.5)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    warnings.simplefilter("ignore")
    scans: list[Told] = []
    for seed in range(args.seed, args.seed + args.count):
        scans.append(one := told(seed, args.least, args.most))
        if args.json:
            print(json.dumps(asdict(one)), flush=True)
            continue
        print(f"{one.seed} {one.frames:4} frames {one.share:.2f} steps {one.body:5} offered "
              f"{one.offered:d} found {one.found:.3f} worst {one.worst:.1f} {one.where} off "
              f"{one.off_px[0]:.4f} {one.off_px[1]:.4f} px, cpu {one.cpu_s:.1f} "
              f"{sorted(one.codes)}", flush=True)  # fmt: skip
    offered = [s for s in scans if s.offered]
    wrong = [s.seed for s in offered if s.worst > WRONG_SIGMAS]
    summary = {
        "scans": len(scans),
        "offered": len(offered),
        "named": sum("exposure_arc" in s.codes for s in scans),
        "codes": dict(Counter(code for s in scans for code in s.codes)),
        "confidently wrong": wrong,
        "largest sigmas": max((s.worst for s in offered), default=0.0),
    }
    print(json.dumps(summary))
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
