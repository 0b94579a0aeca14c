"""Do the intervals hold when the detector is not where the machine file has it?

`python examples/research/prior_coverage.py [--scans 1000] [--wider 2] [--skewed] [--json]` makes
bead tracks with detector shifts, tilts and axis tilts drawn from the priors and counts how often
the truth lies in the 95 % intervals and in the joint 95 % region. `--wider 2` draws them twice as
wide as the fit believes, `--skewed` from a one-sided distribution of the same mean square. The
tracks come from rays and planes written out here; nothing of the fit's model is in them.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from flexdt.twin.calibration.diagnose.fixed_parameters import (
    PriorsJudged,
    judge_priors,
    loosened,
)
from flexdt.twin.calibration.fit.fit import FitResult, estimate_geometry
from flexdt.twin.calibration.fit.image_quantities import image_quantities
from flexdt.twin.calibration.fit.priors import ASSUMED, exact
from flexdt.twin.geometry.poses import Poses

Array = npt.NDArray[np.float64]

SHAPE: Final = (760, 956)
PIXEL: Final = 0.1496
SOD: Final = 600.0
SDD: Final = 1059.0
NOISE_PX: Final = 0.02
REACH: Final = {"dO_x": 5.0, "dO_y": 5.0, "dO_z": 10.0, "alpha": 20.0, "tau_x": 2.0, "tau_z": 2.0}
"""Half the range [mm, deg] of what is estimated freely."""


def pixels(beads: Array, angles: Array, sod: float, truth: Mapping[str, float]) -> Array:
    """Columns and rows at which the beads' centres appear, (n, k, 2).

    The source is at the origin, the beam along +y, z is up; each ray from the source through a bead
    is cut with the plane of the panel by solving for the three unknowns of their equation.

    Args:
        beads: (k, 3) in the object [mm].
        angles: (n,) of the stage [deg], clockwise seen from above.
        sod: distance of the rotation axis [mm].
        truth: offsets [mm, deg]; a name that is left out is 0.
    """

    def t(name: str) -> float:
        return truth.get(name, 0.0)

    tau = np.array([t("tau_x"), t("tau_z"), 0.0])
    pivot = np.array([t("dO_x"), sod + t("dO_z"), t("dO_y")]) + tau
    lean = Rotation.from_euler("xy", [t("axis_tilt_x"), t("axis_tilt_z")], degrees=True)
    # The panel is turned about its own directions, one after the other.
    across, down = np.array([PIXEL, 0, 0]), np.array([0, 0, -PIXEL])
    for about, angle in (("down", "det_yaw"), ("across", "det_pitch"), ("normal", "det_roll")):
        axis = {"down": down, "across": across, "normal": np.cross(across, down)}[about]
        turn = Rotation.from_rotvec(axis / np.linalg.norm(axis) * math.radians(t(angle)))
        across, down = turn.apply(across), turn.apply(down)
    panel = np.array([t("dD_x"), SDD + t("dD_z"), t("dD_y")])
    out = np.empty((len(angles), len(beads), 2))
    for i, angle in enumerate(angles):
        turned = Rotation.from_rotvec([0, 0, -math.radians(angle + t("alpha"))]).apply(beads - tau)
        for k, place in enumerate(lean.apply(turned) + pivot):
            # place * s = panel + a * across + b * down
            _, a, b = np.linalg.solve(np.stack([place, -across, -down], axis=1), panel)
            out[i, k] = a + (SHAPE[1] - 1) / 2, b + (SHAPE[0] - 1) / 2
    return out


def drawn(rng: np.random.Generator, wider: float, skewed: bool) -> dict[str, float]:
    """Offsets of a scan [mm, deg]: the six in their range, the others from their priors.

    Skewed is an exponential distribution: one-sided, and its root mean square is the width of the
    prior times `wider`.
    """
    truth = {n: float(rng.uniform(-r, r)) for n, r in REACH.items()}
    for name, width in ASSUMED.items():
        value = rng.exponential() / math.sqrt(2) if skewed else rng.normal()
        truth[name] = float(value * width * wider)
    return truth


def scan(
    rng: np.random.Generator, truth: Mapping[str, float], frames: int, places: int, sure: bool
) -> tuple[FitResult, PriorsJudged, dict[str, float]]:
    """The fit of one scan (of two placements at two SODs if `places` is 2), what its images say of
    the priors, and the true values of what a reconstruction needs."""
    beads = rng.uniform([-12, -12, -26], [12, 12, 26], size=(5, 3))
    angles = 360.0 * np.arange(frames) / frames
    sods = [SOD, 0.75 * SOD][:places]
    tracks = np.concatenate([pixels(beads, angles, sod, truth) for sod in sods])
    tracks += NOISE_PX * rng.normal(size=tracks.shape)
    u, v = [PIXEL, 0, 0], [0, 0, -PIXEL]
    poses = Poses.concatenate(
        [Poses([0, 0, 0], [0, s, 0], [0, SDD, 0], u, v, np.radians(angles)) for s in sods]
    )

    def fitted(priors: Mapping[str, float]) -> FitResult:
        return estimate_geometry(tracks, beads, poses, shape=SHAPE, priors=priors)

    priors = exact() if sure else ASSUMED
    judged = judge_priors(fitted(loosened(priors)))  # as `pipeline.calibrate` does
    fit = fitted(loosened(priors, judged.factor))
    axis = np.array([truth["tau_x"], truth["tau_z"], 0.0])
    ((low, high),) = pixels(np.array([axis - [0, 0, 9], axis + [0, 0, 9]]), angles[:1], SOD, truth)
    slope = (high[0] - low[0]) / (low[1] - high[1])
    column = low[0] + slope * (low[1] - (SHAPE[0] - 1) / 2)
    seen = {"axis_column": column, "axis_angle": math.degrees(math.atan(slope))}
    return fit, judged, seen


def study(
    scans: int, wider: float = 1.0, skewed: bool = False, frames: int = 36, places: int = 1,
    sure: bool = False, seed: int = 0,
) -> dict[str, Any]:  # fmt: skip
    """Run the study.

    Args:
        scans: how many.
        wider: how many times wider than its prior an offset is drawn.
        skewed: draw one-sidedly.
        frames: of each placement.
        places: 1, or 2 for a second placement at three quarters of the SOD.
        sure: fit as if every prior were 0, as `flexdt calibrate --prior none`.
        seed: of the truths and the noise.

    Returns:
        Shares [%] of truths inside the intervals and regions among the answers offered, each with
        the binomial standard error for 95 %, and the largest error of an answer offered [sigma].
    """
    inside: dict[str, list[bool]] = {}
    worst, refused, widened, names = 0.0, 0, 0, list(REACH)
    errors: dict[str, list[float]] = {n: [] for n in REACH}
    for i in range(scans):
        rng = np.random.default_rng([seed, i])
        truth = drawn(rng, wider, skewed)
        fit, judged, seen = scan(rng, truth, frames, places, sure)
        if judged.finding is not None or not fit.identifiable:
            refused += 1
            continue
        widened += judged.factor > 1.0
        c = fit.certificate
        order = list(c.estimates)
        for what, chosen in (("the six", names), ("all", order)):
            region = inside.setdefault(f"joint region of {what}", [])
            region.append(c.inside_95({n: truth[n] for n in chosen}))
        quantities = image_quantities(fit)[0]
        for n, e, true in (
            *((n, c.estimates[n], truth[n]) for n in order),
            *((n, quantities[n], v) for n, v in seen.items()),
        ):
            inside.setdefault(n, []).append(e.low <= true <= e.high)
            if e.sigma > 0:  # held ones have none
                worst = max(worst, abs(true - e.value) / e.sigma)
        for n in names:
            errors[n].append(truth[n] - c.estimates[n].value)
    offered = scans - refused
    return {
        "scans": scans, "refused": refused, "widened": widened,
        "wider": wider, "skewed": skewed, "places": places,
        "binomial_error_pct": 100.0 * math.sqrt(0.95 * 0.05 / max(offered, 1)),
        "inside_pct": {n: 100.0 * float(np.mean(v)) for n, v in inside.items()},
        "rms_error": {n: float(np.sqrt(np.mean(np.square(v)))) for n, v in errors.items() if v},
        "largest_error_sigmas": worst,
    }  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=1000)
    parser.add_argument("--wider", type=float, default=1.0)
    parser.add_argument("--skewed", action="store_true")
    parser.add_argument("--frames", type=int, default=36)
    parser.add_argument("--places", type=int, choices=(1, 2), default=1)
    parser.add_argument("--exact", action="store_true", help="fit as with --prior none")
    parser.add_argument("--json", action="store_true")
    a = parser.parse_args(argv)
    found = study(a.scans, a.wider, a.skewed, a.frames, a.places, a.exact)
    if a.json:
        print(json.dumps(found))
        return 0
    print(f"{found['scans']} scans, {found['refused']} refused, priors widened in "
          f"{found['widened']}; largest error offered "
          f"{found['largest_error_sigmas']:.1f} sigma")  # fmt: skip
    print(f"inside the 95 % intervals and regions, +- {found['binomial_error_pct']:.1f} %:")
    for name, share in found["inside_pct"].items():
        print(f"  {name:24}{share:6.1f} %")
    listed = ", ".join(f"{n} {v:.3g}" for n, v in found["rms_error"].items())
    print(f"rms errors (mm, deg): {listed}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
