"""Is motion during a scan found, and are the sigmas true that are given with it?

`python tests/studies/motion_during_scan.py [--scans 20] [--images 1] [--seed 1] [--json]`
makes scans of five balls in which something moves: a runout (harmonics 2 to 5 of the turn, 20
um), a screw (1 mm along the axis), a drift of the focal spot (0.1 mm, exponential), jitter (20
um, every frame by itself), or nothing; by tracks with 0.02 px noise, and by radiographs. Tracks
and images are those of the rays, planes and balls of `prior_coverage`; nothing of the fit's
model is in them.

For each kind: the beads' distance from where the geometry has them without its motion and with it
[px rms],
the error of the deviations [um rms] without the part that turns once with the table (an object
beside the axis does the same), errors over sigmas of the six parameters and of the deviations, and
how often a parameter at rest was reported to move.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from prior_coverage import NOISE_PX, PIXEL, REACH, SDD, SHAPE, SOD, pixels, radiographs

from flexdt.phantoms import load_phantom
from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.diagnose.table.explained import explained
from flexdt.twin.calibration.diagnose.table.followed import frame_motions
from flexdt.twin.calibration.diagnose.table.group import Known
from flexdt.twin.calibration.fit.fit import estimate_geometry
from flexdt.twin.calibration.fit.priors import exact
from flexdt.twin.calibration.fit.problem import UNSTRAINED
from flexdt.twin.calibration.frame_source import ArrayFrames
from flexdt.twin.calibration.pipeline import CalibrationRequest, Scan, calibrate
from flexdt.twin.geometry.offsets import Offsets, to_internal
from flexdt.twin.geometry.poses import Poses

Array = npt.NDArray[np.float64]
ASKED: Final = {
    "runout": ("dO_x", "dO_y"), "screw": ("dO_y", "alpha"), "spot": ("dS_x", "dO_y"),
    "jitter": ("dO_x", "dO_y"), "nothing": ("dO_x", "alpha"),
}  # fmt: skip
"""Parameters that are allowed to move; only the first does (and none of the last)."""
SIX: Final = tuple(REACH)


def moved(rng: np.random.Generator, kind: str, turn: Array) -> Array:
    """Draw the deviations (n,) [mm] of the parameter that moves, of mean zero.

    A runout is a sum of two to five waves a turn, at most 0.02 mm; a screw 1 mm a turn to
    either side; a spot drifts to at most 0.1 mm, ever slower; jitter is 0.02 mm rms.

    Args:
        rng: generator.
        kind: of ASKED; "nothing" gives zeros.
        turn: (n,) part of the turn, from 0 to 1.
    """
    out = np.zeros(len(turn))
    if kind == "runout":
        for k in range(2, 6):
            out += rng.normal() * np.cos(2 * np.pi * (k * turn + rng.random()))
        out *= 0.02 / np.abs(out).max()
    elif kind == "screw":
        out = rng.choice([-1.0, 1.0]) * turn
    elif kind == "spot":
        out = 0.1 * (1.0 - np.exp(-turn * rng.uniform(1.0, 6.0)))
    elif kind == "jitter":
        out = 0.02 * rng.normal(size=len(turn))
    return out - out.mean()


def truths(
    rng: np.random.Generator, kind: str, turn: Array
) -> tuple[dict[str, float], list[dict[str, float]], Array]:
    """Draw a scan's offsets and motion.

    Returns:
        Offsets of the scan, those of each frame [mm, deg], and the deviations (n,) [mm].
    """
    truth = {n: float(rng.uniform(-r, r)) for n, r in REACH.items()}
    deviation = moved(rng, kind, turn)
    name = ASKED[kind][0]
    # A spot that moves is everything else that moves the other way.
    shares = {"dO_x": -1.0, "dD_x": -1.0} if name == "dS_x" else {name: 1.0}
    frames = [
        {**truth, **{n: truth.get(n, 0.0) + share * d for n, share in shares.items()}}
        for d in deviation.tolist()
    ]
    return truth, frames, deviation


def nominal(angles: Array) -> Poses:
    return Poses.upright([0, 0, 0], [0, SOD, 0], [0, SDD, 0], PIXEL, np.radians(angles))


def one(seed: int, kind: str, images: bool) -> dict[str, Any]:
    """Make a scan with motion, calibrate it with and without, and compare the estimated
    motion with the true one.

    Args:
        seed: of all draws.
        kind: of ASKED.
        images: from 90 radiographs; else from 180 frames of tracks.

    Returns:
        A row of errors [px, um], pulls, false and missed motions; kind and findings if it
        was refused.
    """
    rng = np.random.default_rng([seed, sorted(ASKED).index(kind)])
    beads = load_phantom("lego").beads
    count = 90 if images else 180
    turn = np.arange(count) / count
    angles = 360.0 * turn
    truth, frames, deviation = truths(rng, kind, turn)
    seen = np.concatenate(
        [pixels(beads, angles[i : i + 1], SOD, t) for i, t in enumerate(frames)]
    )
    names, poses = ASKED[kind], nominal(angles)
    model = BeadModel(beads, np.full(len(beads), 1.0))
    if images:
        shown = [
            radiographs(rng, beads, angles[i : i + 1], SOD, t)[0]
            for i, t in enumerate(frames)
        ]
        scan = Scan(ArrayFrames(shown, SHAPE), poses, priors=exact(SIX))
        found = calibrate(
            [scan], model, CalibrationRequest(priors=exact(SIX), per_frame=names)
        )
        if found.fit is None or not found.motions:
            return {"kind": kind, "refused": [f.code for f in found.findings]}
        fit, motion, certificate = found.fit, found.motions[0], found.fit.certificate
    else:
        tracks = seen + NOISE_PX * rng.normal(size=seen.shape)
        start = Offsets.from_edge({n: truth[n] for n in SIX})
        first = estimate_geometry(tracks, model, poses, shape=SHAPE, start=start)
        what = explained(first, Known(UNSTRAINED, 0.0, 1e-4, asked=names))
        fit, certificate = what.fit, what.fit.certificate
        (motion,) = frame_motions(what, names)
    cone = motion.applied(poses).cone_vec(fit.parameters)
    after = cone.project_points(beads, SHAPE) - seen
    before = poses.cone_vec(fit.parameters).project_points(beads, SHAPE) - seen
    once = np.stack([np.cos(2 * np.pi * turn), np.sin(2 * np.pi * turn)], axis=1)
    error = motion.values[:, 0] - deviation
    beyond = error - once @ np.linalg.lstsq(once, error, rcond=None)[0]
    moves = motion.values.any(axis=0)
    off = {n: certificate.estimates[n].value - truth[n] for n in SIX}
    off["alpha"] = (off["alpha"] + 180.0) % 360.0 - 180.0
    return {
        "kind": kind,
        "before_px": float(np.sqrt(np.mean(before**2))),
        "after_px": float(np.sqrt(np.mean(after**2))),
        "error_um": 1e3 * float(np.sqrt(np.mean(beyond**2))),
        "pulls": [off[n] / certificate.estimates[n].sigma for n in SIX],
        "deviation_pulls": (error / motion.sigma[:, 0]).tolist() if moves[0] else [],
        "false": int(moves[1]) + int(moves[0] and kind == "nothing"),
        "missed": int(not moves[0] and kind != "nothing"),
        "motion": to_internal("dO_x", float(np.ptp(motion.values[:, 0]))),
    }


def summary(kind: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Sum up the rows of one kind, those refused left out but for their count: counts,
    the median rms without motion and the largest with it [px], the motion's largest
    error [um], rms and largest pulls.
    """
    good = [r for r in rows if "refused" not in r]
    pulls = np.array([r["pulls"] for r in good])
    deviations = np.concatenate([r["deviation_pulls"] for r in good] or [np.zeros(0)])
    return {
        "kind": kind,
        "scans": len(rows),
        "refused": len(rows) - len(good),
        "before_px": float(np.nanmedian([r["before_px"] for r in good])),
        "after_px": float(np.max([r["after_px"] for r in good])),
        "error_um": float(np.max([r["error_um"] for r in good])),
        "pull": float(np.sqrt(np.mean(pulls**2))),
        "worst_pull": float(np.abs(pulls).max()),
        "deviation_pull": float(np.sqrt(np.mean(deviations**2)))
        if len(deviations)
        else None,
        "missed": sum(r["missed"] for r in good),
        "false": sum(r["false"] for r in good),
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Estimate the motion of scans of each kind, from tracks and from images, and print
    the sums; returns 0.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=20, help="of each kind, by tracks")
    parser.add_argument(
        "--images", type=int, default=1, help="of each kind, by radiographs"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    words = parser.parse_args(argv)
    document = {
        what: [
            summary(
                kind, [one(words.seed + i, kind, what == "images") for i in range(count)]
            )
            for kind in ASKED
        ]
        for what, count in (("tracks", words.scans), ("images", words.images))
        if count
    }
    if words.json:
        print(json.dumps(document))
        return 0
    for what, rows in document.items():
        print(f"{what}: before, after [px], error [um], pulls (worst), of deviations")
        for r in rows:
            own = "-" if r["deviation_pull"] is None else f"{r['deviation_pull']:.2f}"
            print(
                f"  {r['kind']:8} {r['before_px']:8.4f} {r['after_px']:8.4f} "
                f"{r['error_um']:7.2f} "
                f"{r['pull']:6.2f} ({r['worst_pull']:.2f}) {own:>5}  missed {r['missed']}, "
                f"false {r['false']}, refused {r['refused']} of {r['scans']}"
            )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
