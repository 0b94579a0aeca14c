"""Balls on a turntable, drawn: spots with places, sizes and contrasts, and how they came about.

A phantom of the field (two rings, ball plate, helix, ball bar) or of scattered balls is put on
the stage with drawn offsets. `MISTAKES` change what is really there, or what is believed of it.
Pinhole and turntable are written out here: nothing of the identification is in them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Rng = np.random.Generator

SHAPE: Final = (760, 956)
PIXEL: Final = 0.1496
SOD: Final = 450.0
SDD: Final = 1059.0
NOISE_PX: Final = 0.02
REACH: Final = {
    "dO_x": 5.0, "dO_y": 5.0, "dO_z": 8.0, "alpha": 180.0, "tau_x": 2.0, "tau_z": 2.0,
}  # fmt: skip
"""Half the range of drawn offsets [mm, deg]."""


@dataclass(frozen=True, eq=False)
class Drawn:
    """A scan: what is there, and what is believed.

    Attributes:
        beads, radii, mu: of the balls that are there, (k, 3), (k,) [mm], (k,) [1/mm].
        believed_beads, believed_radii, believed_mu: those of the phantom's file.
        angles, believed_angles: (n,) of the stage [deg].
        truth: of the offsets [mm, deg].
        lean: rotation of the phantom as it stands on the stage, (3, 3).
        believed: distances and pixel: sod, sdd, pixel [mm].
        later: from this frame on the phantom stands otherwise: (frame, rotation, shift).
        after: done to the spots of the frames.
        names: pattern that a finding's text or code must match; "" if it is right.
        bin: the camera joins so many pixels along a side.
    """

    beads: Array
    radii: Array
    mu: Array
    believed_beads: Array
    believed_radii: Array
    believed_mu: Array
    angles: Array
    believed_angles: Array
    truth: Mapping[str, float]
    lean: Array = field(default_factory=lambda: np.eye(3))
    believed: Mapping[str, float] = field(
        default_factory=lambda: {"sod": SOD, "sdd": SDD, "pixel": PIXEL}
    )
    later: tuple[int, Array, Array] | None = None
    after: Callable[[list[Array]], list[Array]] | None = None
    names: str = ""
    bin: int = 1

    @property
    def shape(self) -> tuple[int, int]:
        """Of the images."""
        return SHAPE[0] // self.bin, SHAPE[1] // self.bin


def about(axis: Array, degrees: float) -> Array:
    """Rotation by Rodrigues' formula, (3, 3)."""
    x, y, z = axis / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    a = math.radians(degrees)
    return np.asarray(np.eye(3) + math.sin(a) * k + (1 - math.cos(a)) * k @ k)


def places(scan: Drawn) -> Array:
    """Where the balls are in the laboratory, (n, k, 3): source at the origin, beam along y."""
    t = {**dict.fromkeys(REACH, 0.0), **scan.truth}
    tau = np.array([t["tau_x"], t["tau_z"], 0.0])
    pivot = np.array([t["dO_x"], SOD + t["dO_z"], t["dO_y"]]) + tau
    out = []
    for i, angle in enumerate(scan.angles):
        mean = scan.beads.mean(axis=0)
        balls = mean + (scan.beads - mean) @ scan.lean.T
        if scan.later is not None and i >= scan.later[0]:
            balls = balls @ scan.later[1].T + scan.later[2]
        turn = about(np.array([0, 0, 1.0]), -(angle + t["alpha"]))
        out.append((balls - tau) @ turn.T + pivot)
    return np.array(out)


def spots(scan: Drawn, rng: Rng, noise_px: float = NOISE_PX) -> list[Array]:
    """Spots of each frame, (m, 4): column, row, radius [px], contrast, in any order."""
    at = places(scan)
    pixel = PIXEL * scan.bin
    rows, cols = scan.shape
    out = []
    for balls in at:
        scale = SDD / balls[:, 1] / pixel
        x = balls[:, 0] * scale + (cols - 1) / 2
        y = -balls[:, 2] * scale + (rows - 1) / 2
        r = scan.radii * scale
        seen = (x > r) & (x < cols - 1 - r) & (y > r) & (y < rows - 1 - r)
        # Balls whose shadows touch are not told apart.
        gap = np.hypot(x[:, None] - x, y[:, None] - y) + 1e9 * np.eye(len(x))
        seen &= (gap > 1.15 * (r[:, None] + r) + 2.0).all(axis=1)
        table = np.stack(
            [
                x + noise_px * rng.standard_normal(len(x)),
                y + noise_px * rng.standard_normal(len(x)),
                r * (1.03 + 0.01 * rng.standard_normal(len(x))),
                2 * scan.radii * scan.mu * np.exp(0.03 * rng.standard_normal(len(x))),
            ],
            axis=1,
        )[seen]
        out.append(table[rng.permutation(len(table))])
    return out if scan.after is None else scan.after(out)


def rings(count: int = 12, radius: float = 22.0, apart: float = 30.0) -> Array:
    """Two rings of balls about z."""
    turn = 2 * math.pi * np.arange(count) / count
    ring = radius * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    return np.concatenate([ring - [0, 0, apart / 2], ring + [0, 0, apart / 2]])


def plate(count: int = 5, pitch: float = 9.0) -> Array:
    """An upright square plate of balls, its normal along y."""
    side = pitch * (np.arange(count) - (count - 1) / 2)
    return np.array([[x, 0.0, z] for z in side for x in side])


def bar(count: int = 5, pitch: float = 9.0) -> Array:
    """Balls on a line that leans from the axis by 20 deg."""
    along = pitch * (np.arange(count) - (count - 1) / 2)
    return np.outer(along, [math.sin(0.35), 0.0, math.cos(0.35)])


def helix(count: int = 16, radius: float = 18.0, height: float = 44.0) -> Array:
    """A helix of 1.5 turns about z."""
    part = np.arange(count) / (count - 1)
    turn = 3 * math.pi * part
    up = height * (part - 0.5)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), up], axis=1)


def scattered(rng: Rng, count: int = 8) -> Array:
    """Balls anywhere in a cylinder, 6 mm apart at least."""
    out: list[Array] = []
    while len(out) < count:
        p = rng.uniform([-20, -20, -22], [20, 20, 22])
        if np.hypot(*p[:2]) < 20 and all(np.linalg.norm(p - q) > 6 for q in out):
            out.append(p)
    return np.array(out)


def scan_of(beads: Array, rng: Rng, frames: int = 30, radius: float = 1.0) -> Drawn:
    """A right scan of a full turn with drawn offsets."""
    truth = {n: float(rng.uniform(-r, r)) for n, r in REACH.items()}
    radii, mu = np.full(len(beads), radius), np.full(len(beads), 0.4)
    angles = 360.0 / frames * np.arange(frames)
    return Drawn(beads, radii, mu, beads, radii, mu, angles, angles, truth)


def odd_ball(scan: Drawn, rng: Rng) -> Drawn:
    """One ball is 1.3 to 2 times as large as the others, and the phantom's file says so."""
    radii = scan.radii.copy()
    radii[rng.integers(len(radii))] *= rng.uniform(1.3, 2.0)
    return replace(scan, radii=radii, believed_radii=radii)


def odd_material(scan: Drawn, rng: Rng) -> Drawn:
    """One ball attenuates 3 to 6 times as much as the others, and the file says so."""
    mu = scan.mu.copy()
    mu[rng.integers(len(mu))] *= rng.uniform(3.0, 6.0)
    return replace(scan, mu=mu, believed_mu=mu)


def _leaning(low: float, high: float, names: str) -> Callable[[Drawn, Rng], Drawn]:
    def change(scan: Drawn, rng: Rng) -> Drawn:
        way = rng.uniform(0, 2 * math.pi)
        across = np.array([math.cos(way), math.sin(way), 0.0])
        lean = about(across, rng.uniform(low, high))
        return replace(scan, lean=lean, names=names)

    return change


def _scaled(factor: float, names: str) -> Callable[[Drawn, Rng], Drawn]:
    """The phantom's file is in another unit."""

    def change(scan: Drawn, rng: Rng) -> Drawn:
        return replace(
            scan, believed_beads=scan.beads / factor,
            believed_radii=scan.radii / factor, names=names,
        )  # fmt: skip

    return change


def _binned(scan: Drawn, rng: Rng) -> Drawn:
    return replace(scan, bin=2, names="bin|pixels")


def _diameters(scan: Drawn, rng: Rng) -> Drawn:
    return replace(scan, believed_radii=2 * scan.radii, names="diameter")


def _half(scan: Drawn, rng: Rng) -> Drawn:
    return replace(scan, believed_radii=0.5 * scan.radii, names="half the radii")


def _remounted(scan: Drawn, rng: Rng) -> Drawn:
    lean = about(rng.standard_normal(3) * [1, 1, 0], rng.uniform(0, 2.0))
    turn = about(np.array([0, 0, 1.0]), rng.uniform(-40, 40)) @ lean
    at = int(rng.integers(8, len(scan.angles) - 8))
    shift = np.array([*rng.uniform(-3, 3, 2), rng.uniform(-0.5, 0.5)])
    return replace(
        scan,
        later=(at, turn, shift),
        names="stands|remount|placed anew|phantom was moved",
    )


def _exchanged(scan: Drawn, rng: Rng) -> Drawn:
    a, b = rng.choice(len(scan.beads), 2, replace=False)
    beads = scan.beads.copy()
    beads[[a, b]] = 0.5 * (beads[[a, b]] + beads[[b, a]]) + [
        [1.0, 2.0, 3.0],
        [2.0, -3.0, -2.0],
    ]
    return replace(scan, believed_beads=beads, names="bead")


def _radians(scan: Drawn, rng: Rng) -> Drawn:
    """The settings have radians where degrees are expected."""
    return replace(scan, believed_angles=np.radians(scan.angles), names="radian")


def _mirrored(scan: Drawn, rng: Rng) -> Drawn:
    return replace(scan, believed_beads=scan.beads * [-1, 1, 1], names="mirror")


def _reversed(scan: Drawn, rng: Rng) -> Drawn:
    return replace(scan, believed_angles=-scan.angles, names="angle_reversed")


def _shuffled(scan: Drawn, rng: Rng) -> Drawn:
    order = rng.permutation(len(scan.angles))
    return replace(scan, believed_angles=scan.angles[order], names="order|frame_numbers")


def _other_phantom(scan: Drawn, rng: Rng) -> Drawn:
    return replace(
        scan, believed_beads=scattered(rng, len(scan.beads)), names="wrong_phantom"
    )


def _two_phantoms(scan: Drawn, rng: Rng) -> Drawn:
    """A second one of the same kind stands beside the first."""
    lean = about(np.array([0, 0, 1.0]), rng.uniform(20, 340))
    second = scan.beads @ lean.T + [
        rng.choice([-1, 1]) * rng.uniform(20, 26),
        rng.uniform(-6, 6),
        rng.uniform(-4, 4),
    ]
    return replace(
        scan, beads=np.concatenate([scan.beads, second]),
        radii=np.tile(scan.radii, 2), mu=np.tile(scan.mu, 2),
        names="extra_spots|two phantoms|second phantom",
    )  # fmt: skip


MISTAKES: Final[Mapping[str, Callable[[Drawn, Rng], Drawn]]] = {
    "leans_a_little": _leaning(0.5, 2.5, "lean"),
    "leans": _leaning(2.5, 12.0, "lean"),
    "leans_far": _leaning(20.0, 60.0, "lean"),
    "on_its_side": _leaning(85.0, 95.0, "lean|side"),
    "on_its_head": _leaning(180.0, 180.0, "head|upside"),
    "cm": _scaled(10.0, "cm"),
    "inches": _scaled(25.4, "inch"),
    "binned": _binned,
    "diameters": _diameters,
    "half_radii": _half,
    "remounted": _remounted,
    "exchanged": _exchanged,
    "radians": _radians,
    "mirrored": _mirrored,
    "reversed": _reversed,
    "shuffled": _shuffled,
    "other_phantom": _other_phantom,
    "two_phantoms": _two_phantoms,
}
