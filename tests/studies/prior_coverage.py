"""Do the intervals hold when the detector is not where the machine file has it?

`python tests/studies/prior_coverage.py [--scans 1000] [--wider 2] [--skewed] [--json]`
makes bead tracks with detector shifts, tilts and axis tilts drawn from the priors and counts
how often the truth lies in the 95 % intervals and in the joint 95 % region. `--wider 2` draws
them twice as wide as the fit believes, `--skewed` from a one-sided distribution of the same
mean square. `--images` makes radiographs instead of tracks, of five balls, and calibrates from
them without knowing which ball is which. Tracks and images come from rays, planes and balls
written out here; nothing of the fit's model is in them.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.diagnose.fixed_parameters import (
    doubtful,
    judge_priors,
    loosened,
)
from flexdt.twin.calibration.fit.fit import FitResult, estimate_geometry, image_quantities
from flexdt.twin.calibration.fit.priors import OFFSETS, exact
from flexdt.twin.calibration.frame_source import ArrayFrames
from flexdt.twin.calibration.pipeline import CalibrationRequest, Scan, calibrate
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.geometry.told_lengths import TOLD

Array = npt.NDArray[np.float64]

SHAPE: Final = (760, 956)
PIXEL: Final = 0.1496
SOD: Final = 600.0
SDD: Final = 1059.0
NOISE_PX: Final = 0.02
REACH: Final = {
    "dO_x": 5.0,
    "dO_y": 5.0,
    "dO_z": 10.0,
    "alpha": 20.0,
    "tau_x": 2.0,
    "tau_z": 2.0,
}
"""Half the range of freely estimated parameters [mm, deg]."""
RADIUS: Final = 1.0
ATTENUATION: Final = 0.4
PHOTONS: Final = 10_000.0
BLUR_PX: Final = 0.7
RAYS: Final = 4
"""Of the images: radius [mm] and attenuation [1/mm] of a ball, photons a pixel, blur [px],
rays."""


def places(
    beads: Array, angles: Array, sod: float, truth: Mapping[str, float]
) -> tuple[Array, Array]:
    """Compute the places of beads and panel in the laboratory [mm].

    The source is at the origin, the beam along +y, z is up.

    Args:
        beads: (k, 3) in the object [mm].
        angles: (n,) of the stage [deg], clockwise seen from above.
        sod: distance of the rotation axis [mm].
        truth: offsets [mm, deg]; a name that is left out is 0.

    Returns:
        Beads (n, k, 3), and the panel (3, 3): its centre and the steps from one column
        and one row to the next.
    """

    def t(name: str) -> float:
        return truth.get(name, 0.0)

    tau = np.array([t("tau_x"), t("tau_z"), 0.0])
    pivot = np.array([t("dO_x"), sod + t("dO_z"), t("dO_y")]) + tau
    lean = Rotation.from_euler("xy", [t("axis_tilt_x"), t("axis_tilt_z")], degrees=True)
    # The panel is turned about its own directions, one after the other.
    across, down = np.array([PIXEL, 0, 0]), np.array([0, 0, -PIXEL])
    for about, angle in (
        ("down", "det_yaw"),
        ("across", "det_pitch"),
        ("normal", "det_roll"),
    ):
        axis = {"down": down, "across": across, "normal": np.cross(across, down)}[about]
        turn = Rotation.from_rotvec(axis / np.linalg.norm(axis) * math.radians(t(angle)))
        across, down = turn.apply(across), turn.apply(down)
    panel = np.array([t("dD_x"), SDD + t("dD_z"), t("dD_y")])
    turns = [Rotation.from_rotvec([0, 0, -math.radians(a + t("alpha"))]) for a in angles]
    out = np.array([lean.apply(turn.apply(beads - tau)) + pivot for turn in turns])
    return out, np.array([panel, across, down])


def pixels(beads: Array, angles: Array, sod: float, truth: Mapping[str, float]) -> Array:
    """Compute the columns and rows at which the beads' centres appear, (n, k, 2);
    arguments as of `places`.

    Each ray from the source through a bead is cut with the plane of the panel by solving
    for the three unknowns of their equation.
    """
    at, (panel, across, down) = places(beads, angles, sod, truth)
    out = np.empty((*at.shape[:2], 2))
    for i, k in np.ndindex(*at.shape[:2]):
        # place * s = panel + a * across + b * down
        _, a, b = np.linalg.solve(np.stack([at[i, k], -across, -down], axis=1), panel)
        out[i, k] = a + (SHAPE[1] - 1) / 2, b + (SHAPE[0] - 1) / 2
    return out


def radiographs(
    rng: np.random.Generator,
    beads: Array,
    angles: Array,
    sod: float,
    truth: Mapping[str, float],
    radius: float = RADIUS,
    attenuation: float = ATTENUATION,
) -> list[npt.NDArray[np.float32]]:
    """Simulate line integrals of balls, one image (rows, cols) for each angle.

    Each pixel counts the photons of RAYS x RAYS rays, blurred by BLUR_PX, with the noise
    of PHOTONS.

    Args:
        rng: of the noise.
        beads, angles, sod, truth: as of `places`.
        radius: of the balls [mm].
        attenuation: of the balls [1/mm].
    """
    at, panel = places(beads, angles, sod, truth)
    out = []
    for balls, centres in zip(at, pixels(beads, angles, sod, truth), strict=True):
        passing = np.ones(SHAPE)
        for ball, centre in zip(balls, centres, strict=True):
            where, passed = shadow(ball, centre, panel, radius, sod)
            passing[where] *= passed(attenuation)
        seen = PHOTONS * cv2.GaussianBlur(passing, (0, 0), BLUR_PX)
        out.append(
            (-np.log(np.maximum(rng.poisson(seen), 0.5) / PHOTONS)).astype(np.float32)
        )
    return out


def shadow(
    ball: Array,
    centre: Array,
    panel: Array,
    radius: float,
    sod: float,
    read: Callable[[Array], Array] | None = None,
) -> tuple[tuple[Array, ...], Callable[[float], Array]]:
    """Find the pixels about a ball's image, and the part of light that passes there.

    Args:
        ball: its centre [mm].
        centre: of its image [px].
        panel: as of `places`.
        radius: [mm].
        sod: of the axis [mm].
        read: rows (n,) -> the ball's centres when they are read (n, 3) [mm]; none: it rests.

    Returns:
        The pixels as an index of an image, and a function of an attenuation [1/mm] that
        gives the mean of RAYS x RAYS rays there.
    """
    middle, across, down = panel
    reach = int(1.3 * radius * SDD / (0.7 * sod) / PIXEL)
    n = 2 * reach + 1
    fine = (np.arange(RAYS * n) + 0.5) / RAYS - 0.5 - reach
    column, row = np.rint(centre).astype(int)
    a = (column + fine - (SHAPE[1] - 1) / 2)[None, :, None]
    b = (row + fine - (SHAPE[0] - 1) / 2)[:, None, None]
    ray = middle + a * across + b * down
    ray /= np.linalg.norm(ray, axis=2, keepdims=True)
    here = ball[None] if read is None else read(np.rint(row + fine))
    along = (ray * here[:, None]).sum(axis=2)
    square = (here**2).sum(axis=1)[:, None]
    chord = 2 * np.sqrt(np.maximum(radius**2 - square + along**2, 0.0))
    columns, rows = (c - reach + np.arange(n) for c in (column, row))
    ok = (
        ((rows >= 0) & (rows < SHAPE[0])).nonzero()[0],
        ((columns >= 0) & (columns < SHAPE[1])).nonzero()[0],
    )

    def passed(attenuation: float) -> Array:
        part = np.exp(-attenuation * chord).reshape(n, RAYS, n, RAYS).mean(axis=(1, 3))
        return np.asarray(part[np.ix_(*ok)])

    return np.ix_(rows[ok[0]], columns[ok[1]]), passed


def axis_in_image(truth: Mapping[str, float], angle: float = 0.0) -> dict[str, float]:
    """Compute where the rotation axis appears: "axis_column" in the middle row [px], and
    "axis_angle" [deg].
    """
    axis = np.array([truth["tau_x"], truth["tau_z"], 0.0])
    ends = np.array([axis - [0, 0, 9], axis + [0, 0, 9]])
    ((low, high),) = pixels(ends, np.array([angle]), SOD, truth)
    slope = (high[0] - low[0]) / (low[1] - high[1])
    column = low[0] + slope * (low[1] - (SHAPE[0] - 1) / 2)
    return {"axis_column": column, "axis_angle": math.degrees(math.atan(slope))}


def drawn(rng: np.random.Generator, wider: float, skewed: bool) -> dict[str, float]:
    """Draw the offsets of a scan [mm, deg]: the six evenly in their range, the others
    from their priors, `wider` times as wide.

    With `skewed` these are one-sided, of an exponential distribution with the same root
    mean square.
    """
    truth = {n: float(rng.uniform(-r, r)) for n, r in REACH.items()}
    for name, width in OFFSETS.items():
        value = rng.exponential() / math.sqrt(2) if skewed else rng.normal()
        truth[name] = float(value * width * wider)
    return truth


def scan(
    rng: np.random.Generator, truth: Mapping[str, float], frames: int, count: int, sure: bool,
    images: bool = False,
) -> tuple[FitResult | None, bool, dict[str, float]]:  # fmt: skip
    """Simulate and calibrate one scan.

    Args:
        rng: of beads and noise.
        truth: offsets [mm, deg].
        frames: of each placement.
        count: placements, 1 or 2, at two SODs.
        sure: fit as if every prior were 0.
        images: from radiographs; else from noisy points.

    Returns:
        The fit, None if it is refused; whether its priors were widened; and the true
        place of the axis in the image.
    """
    beads = spread(rng, 4 * RADIUS if images else 0.0)
    angles = 360.0 * np.arange(frames) / frames
    sods = [SOD, 0.75 * SOD][:count]
    turn = np.radians(angles)
    poses = [Poses.upright([0, 0, 0], [0, s, 0], [0, SDD, 0], PIXEL, turn) for s in sods]
    priors = exact() if sure else OFFSETS  # lengths are told right
    seen = axis_in_image(truth, float(angles[0]))
    if images:
        scans = [
            Scan(ArrayFrames(radiographs(rng, beads, angles, s, truth), SHAPE), p, str(s))
            for s, p in zip(sods, poses, strict=True)
        ]
        model = BeadModel(beads, np.full(len(beads), RADIUS))
        found = calibrate(
            scans, model, CalibrationRequest(priors=exact() if sure else {})
        )
        wide = "priors_narrow" in [f.code for f in found.findings]
        return found.fit if found.identifiable else None, wide, seen
    tracks = np.concatenate([pixels(beads, angles, sod, truth) for sod in sods])
    tracks += NOISE_PX * rng.normal(size=tracks.shape)

    def fitted(priors: Mapping[str, float]) -> FitResult:
        """Fit the geometry to the tracks with these priors; a sigma of any size
        is reported.
        """
        return estimate_geometry(
            tracks,
            beads,
            Poses.concatenate(poses),
            shape=SHAPE,
            priors=priors,
            bound=math.inf,
        )

    judged = judge_priors(fitted(loosened(priors)))  # as `pipeline.calibrate` does
    fit = fitted(loosened(priors, judged.factor))
    refused = judged.finding is not None or not fit.identifiable
    fit = doubtful(fit, judged, lambda name: fitted({**priors, name: 1e3}))
    return None if refused else fit, judged.factor > 1.0, seen


def spread(rng: np.random.Generator, apart: float) -> Array:
    """Draw five balls in a box, their centres at least `apart` [mm] from each other, (5,
    3) [mm].
    """
    while True:
        beads = rng.uniform([-12, -12, -26], [12, 12, 26], size=(5, 3))
        distance = np.linalg.norm(beads[:, None] - beads, axis=2)
        if distance[~np.eye(5, dtype=bool)].min() >= apart:
            return beads


def study(
    scans: int, wider: float = 1.0, skewed: bool = False, frames: int = 36, count: int = 1,
    sure: bool = False, seed: int = 0, images: bool = False,
) -> dict[str, Any]:  # fmt: skip
    """Draw, fit and compare scans with their truth.

    Args:
        scans: number.
        wider: width of drawn offsets over that of their priors.
        skewed: draw one-sidedly.
        frames: of each placement.
        count: 1, or 2 for a second placement at three quarters of the SOD.
        sure: fit as if every prior were 0, as `flexdt calibrate --prior none`.
        seed: of the truths and the noise.
        images: calibrate from radiographs.

    Returns:
        Shares [%] of truths inside the 95 % intervals and regions among the answers
        offered, the binomial standard error of one such share [%], the six's rms errors
        [mm, deg], the largest error of an answer offered [sigma], and counts.
    """
    inside: dict[str, list[bool]] = {}
    worst, refused, widened, names = 0.0, 0, 0, list(REACH)
    errors: dict[str, list[float]] = {n: [] for n in REACH}
    for i in range(scans):
        rng = np.random.default_rng([seed, i])
        truth = drawn(rng, wider, skewed) | dict.fromkeys(TOLD, 0.0)
        fit, wider_priors, seen = scan(rng, truth, frames, count, sure, images)
        if fit is None:
            refused += 1
            continue
        widened += wider_priors
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
        "wider": wider, "skewed": skewed, "places": count,
        "binomial_error_pct": 100.0 * math.sqrt(0.95 * 0.05 / max(offered, 1)),
        "inside_pct": {n: 100.0 * float(np.mean(v)) for n, v in inside.items()},
        "rms_error": {n: float(np.sqrt(np.mean(np.square(v)))) for n, v in errors.items() if v},
        "largest_error_sigmas": worst,
    }  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study of the command line and print its figures; returns 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=1000)
    parser.add_argument("--wider", type=float, default=1.0)
    parser.add_argument("--skewed", action="store_true")
    parser.add_argument("--frames", type=int, default=36)
    parser.add_argument("--places", type=int, choices=(1, 2), default=1)
    parser.add_argument(
        "--images", action="store_true", help="calibrate from radiographs"
    )
    parser.add_argument("--exact", action="store_true", help="fit as with --prior none")
    parser.add_argument("--json", action="store_true")
    a = parser.parse_args(argv)
    found = study(
        a.scans, a.wider, a.skewed, a.frames, a.places, a.exact, images=a.images
    )
    if a.json:
        print(json.dumps(found))
        return 0
    print(f"{found['scans']} scans, {found['refused']} refused, priors widened in "
          f"{found['widened']}; largest error offered "
          f"{found['largest_error_sigmas']:.1f} sigma")  # fmt: skip
    print(
        f"inside the 95 % intervals and regions, +- {found['binomial_error_pct']:.1f} %:"
    )
    for name, share in found["inside_pct"].items():
        print(f"  {name:24}{share:6.1f} %")
    listed = ", ".join(f"{n} {v:.3g}" for n, v in found["rms_error"].items())
    print(f"rms errors (mm, deg): {listed}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
