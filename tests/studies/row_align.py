"""Is the axis column that `align` tells from one row, or from half a turn, where it says?

    python tests/studies/row_align.py [--count 200] [--seed 1] [--kind one_row] [--json]

Every scan has a random object of ellipses, a scanner that is not where it is said to be (axis
beside the beam by up to 2 % of the columns; panel off, turned and nearer or farther), noise of
counted photons and of the flat field's, and a whole turn or half a turn and the fan. Kinds:

one_row: a panel of one row, at random one to three.
symmetric: one row of objects whose density is the same after half a turn.
untold: one row of what tells no column: air, a grating wider than the panel, an even slab.
half_turn: a panel of many rows, half a turn and the fan.

The line integrals are chords in closed form, written out here with kinematics of their own.
Errors are those of the column in px, and over the stated sigma. Exit code 1 where more than 1 %
are off by more than 3 sigma, or the root mean square in sigmas is not within 0.7 and 1.2.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import warnings
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

import flexdt as fx

SOD, SDD, WIDTH, FINE = 600.0, 1059.0, 143.0, 3
KINDS: Final = ("one_row", "symmetric", "half_turn", "untold")


@dataclass
class Scan:
    """Sizes in mm and rad; the source is the origin, y goes along the beam, z up."""

    views: int
    shape: tuple[int, int]
    span: float
    photons: float
    bodies: np.ndarray
    """(k, 8): centre, half axes, angle about z, 1/mm."""
    axis_x: float = 0.0
    panel: tuple[float, float, float] = (0.0, 0.0, 0.0)
    roll: float = 0.0
    yaw: float = 0.0

    @property
    def pitch(self) -> float:
        return WIDTH / self.shape[1]

    def degrees(self) -> np.ndarray:
        return np.arange(self.views) * self.span / self.views

    def steps(self) -> tuple[np.ndarray, np.ndarray]:
        """u and v of a pixel."""
        c, s = math.cos(self.roll), math.sin(self.roll)
        u, v = np.array([c, 0.0, -s]), np.array([-s, 0.0, -c])
        c, s = math.cos(-self.yaw), math.sin(-self.yaw)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return turn @ u * self.pitch, turn @ v * self.pitch

    def centre(self) -> np.ndarray:
        return np.array([self.panel[0], SDD + self.panel[2], self.panel[1]])

    def column(self) -> float:
        """Where the axis crosses the middle row."""
        u, v = self.steps()
        seen = []
        for z in (-9.0, 9.0):
            ray = np.array([self.axis_x, SOD, z])
            seen.append(np.linalg.solve(np.array([u, v, -ray]).T, -self.centre())[:2])
        (c0, r0), (c1, r1) = seen
        return float(c0 - r0 * (c1 - c0) / (r1 - r0) + (self.shape[1] - 1) / 2)

    def lines(self) -> np.ndarray:
        """Line integrals (views, rows, cols), the mean over rays across each pixel."""
        rows, cols = self.shape
        u, v = self.steps()
        across = (np.arange(cols * FINE) - (cols * FINE - 1) / 2) / FINE
        down = np.arange(rows) - (rows - 1) / 2
        rays = self.centre() + across[:, None] * u + down[:, None, None] * v
        rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        out = np.zeros((self.views, rows, cols * FINE), dtype=np.float32)
        for k, turn in enumerate(np.radians(self.degrees())):
            for x, y, z, a, b, c, own, density in self.bodies:
                # The stage turns clockwise seen from above.
                co, si = math.cos(-turn), math.sin(-turn)
                at = np.array([x * co - y * si + self.axis_x, x * si + y * co + SOD, z])
                co, si = math.cos(own - turn), math.sin(own - turn)
                frame = np.array([[co, si, 0.0], [-si, co, 0.0], [0.0, 0.0, 1.0]])
                frame /= np.array([a, b, c])[:, None]
                d, m = rays @ frame.T, frame @ at
                dd, dm = np.square(d).sum(axis=-1), d @ m
                out[k] += (
                    2 * density * np.sqrt(np.maximum(dm**2 - dd * (m @ m - 1), 0)) / dd
                )
        return out.reshape(self.views, rows, cols, FINE).mean(axis=3)

    def data(self, rng: np.random.Generator) -> fx.DataSet:
        """Expose the scan and return it as a data set with the nominal circle."""
        flat = rng.poisson(self.photons, (20, *self.shape)).mean(axis=0) * 4
        counts = np.minimum(rng.poisson(self.photons * np.exp(-self.lines())) * 4, 65535)
        cone = fx.ConeVec.circular(
            sod=SOD, sdd=SDD, angles=self.degrees(), shape=self.shape, pixel=self.pitch
        )
        return fx.DataSet.from_arrays(counts, cone, dark=np.zeros(self.shape), flat=flat)


def ellipses(rng: np.random.Generator, tall: bool) -> np.ndarray:
    """A body with holes and grains in it, or some that stand alone: ellipsoids, or
    cylinders."""
    n = int(rng.integers(3, 12))
    out = np.zeros((n, 8))
    far, turn = 24 * np.sqrt(rng.uniform(0, 1, n)), rng.uniform(0, 2 * math.pi, n)
    out[:, 0], out[:, 1] = far * np.cos(turn), far * np.sin(turn)
    out[:, 2] = rng.uniform(-15, 15, n) if tall else 0.0
    out[:, 3:6] = rng.uniform(1, 7, (n, 3))
    out[:, 6], out[:, 7] = rng.uniform(0, math.pi, n), rng.choice([-0.01, 0.01, 0.03], n)
    if rng.random() < 0.7:
        body = [
            *rng.uniform(-3, 3, 2),
            0,
            *rng.uniform(18, 30, 2),
            22,
            rng.uniform(0, 3),
            0.02,
        ]
        out = np.vstack([body, out])
    else:
        out[:, 7] = np.abs(out[:, 7])
    if not tall:
        out[:, 5] = 1e4
    return out


def drawn(kind: str, rng: np.random.Generator) -> Scan:
    """Draw a scan of one of KINDS: few rows, symmetric bodies, or half a turn."""
    rows = int(rng.integers(1, 4)) if kind == "one_row" else 1
    half = kind == "half_turn" or rng.random() < 0.5
    cols = int(rng.choice([192, 256, 384]))
    if kind == "half_turn":
        rows, cols = 96, 120
    bodies = ellipses(rng, rows > 3)
    if kind == "symmetric":
        bodies = np.vstack([bodies, bodies * [-1, -1, 1, 1, 1, 1, 1, 1]])
    fan = math.degrees(math.atan(WIDTH / 2 / SDD))
    span = 180 + 2 * fan + rng.uniform(0, 20) if half else 360.0
    views = int(rng.integers(120, 400) * (span / 360) ** 0.5)
    return Scan(
        views, (rows, cols), span, float(10 ** rng.uniform(2.5, 4.1)), bodies,
        axis_x=rng.uniform(-1, 1) * 0.02 * WIDTH * SOD / SDD,
        panel=(rng.normal(0, 1), rng.uniform(-1, 1), rng.normal(0, 1)),
        roll=math.radians(rng.normal(0, 0.3)), yaw=math.radians(rng.normal(0, 0.3)),
    )  # fmt: skip


def untold(rng: np.random.Generator) -> Scan:
    """What tells no column."""
    scan = drawn("symmetric", rng)
    which = rng.integers(3)
    if which == 0:
        scan.bodies[:, 7] = 0.0
    elif which == 1:
        scan.bodies = np.array([[0, 0, 0, 200.0, 200.0, 1e4, 0, 0.005]])
    else:
        scan.bodies[:, 7] *= 1e-4
    return scan


def tried(kind: str, seed: int) -> dict[str, Any]:
    """Align a drawn scan; its error and sigma in columns, or why it was refused.

    The same kind and seed give the same scan.
    """
    rng = np.random.default_rng([KINDS.index(kind), seed])
    scan = untold(rng) if kind == "untold" else drawn(kind, rng)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = scan.data(rng).align()
    told: dict[str, Any] = {
        "kind": kind, "seed": seed, "views": scan.views, "span": scan.span, "shape": scan.shape,
        "photons": scan.photons, "seconds": found.document["seconds"],
    }  # fmt: skip
    if not found.identifiable:
        return {**told, "refused": found.alignment.refused["axis_column_px"]}
    p: Any = found.parameters["axis_column_px"]
    told |= {"error": p["value"] - scan.column(), "sigma": p["sigma"]}
    return told


def main(words: list[str] | None = None) -> int:
    """Align many scans of one kind and print the errors.

    Returns:
        1 where errors and sigmas do not fit, or anything was told of scans that allow
        nothing.
    """
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kind", choices=KINDS, default="one_row")
    parser.add_argument(
        "--json", action="store_true", help="one line for each scan as well"
    )
    o = parser.parse_args(words)
    runs = []
    for seed in range(o.seed, o.seed + o.count):
        runs.append(tried(o.kind, seed))
        if o.json:
            print(json.dumps(runs[-1]), flush=True)
    good = [run for run in runs if "error" in run]
    if not good:
        print(f"{o.kind}: all of {o.count} refused")
        return int(o.kind != "untold")
    error, sigma = np.array([[run["error"], run["sigma"]] for run in good]).T
    pull = error / sigma
    rms, far = math.sqrt(float(np.square(pull).mean())), int((np.abs(pull) > 3).sum())
    print(
        f"{o.kind}: {len(good)} of {o.count} told; error "
        f"{np.sqrt(np.square(error).mean()):.3f} px "
        f"rms (median {np.median(np.abs(error)):.3f}, largest "
        f"{np.abs(error).max():.3f}), sigma "
        f"{np.median(sigma):.3f} px; in sigmas {rms:.2f} rms, {far} beyond 3"
    )
    if o.kind == "untold":
        return 1
    return int(far > max(1, 0.01 * len(good)) or not 0.7 < rms < 1.2)


if __name__ == "__main__":
    sys.exit(main())
