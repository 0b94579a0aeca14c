"""Does `align` tell gaps between tiles that are not there, or miss those that are?

    python tests/studies/natural_objects.py [--count 200] [--seed 1] [--gaps] [--only
    foam,bottle] python tests/studies/natural_objects.py --near [--count 64] [--seed 1]
    python tests/studies/natural_objects.py --fans [--count 40]

Every scan is a full turn of an object as people scan them: foam in a cylinder, a bottle, a
circuit board, toy bricks, a bone, a printed part, a stone, a bundle of wires; sizes, places,
scanner, noise, hardening, blur, rings and numbers of views are drawn. `--gaps` sets the right
part of the panel .8 to 2 px aside, at a column that the object passes. `--near` does so within
five columns of the axis, where both ends of rays say nothing: such a gap need not be named, but
must be in the column's sigma.
`--fans` are half turns and the fan of wires that harden the beam.
`--json` prints a line for each scan.

Exit code 1 where a scan without a gap is told of one or warned of repeated frames, where a gap
(but of `--near`) is not named, or where a column is more than 4 sigma off.

Line integrals are those of turned ellipsoids, cylinders and boxes whose densities add, in
closed form along rays spread over each pixel, with kinematics of their own.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final
from unittest.mock import patch

import numba
import numpy as np
from scipy.ndimage import gaussian_filter

import flexdt as fx
from flexdt.twin.calibration.without_phantom import turn_planes
from flexdt.twin.errors import NotIdentifiableError

SOD_MM, SDD_MM, WIDTH_MM = 600.0, 1059.0, 143.0
ACROSS, DOWN = 3, 2
"""Rays across and down each pixel."""
ELLIPSOID, CYLINDER, BOX = 0, 1, 2
SIGMAS: Final = 4.0
LEAST_SHADOW: Final = 0.02
"""Line integral from which an object passes a column."""
NEAR_COLUMNS: Final = 5
"""Columns from the axis within which `--near` begins gaps."""

Rng = np.random.Generator


@dataclass
class Solids:
    """Bodies whose densities add; z is the rotation axis [mm, 1/mm]."""

    kinds: list[int] = field(default_factory=list)
    centres: list[np.ndarray] = field(default_factory=list)
    frames: list[np.ndarray] = field(default_factory=list)
    """(3, 3) each: a point relative to the centre to the unit ball, cylinder or cube."""
    reaches: list[float] = field(default_factory=list)
    densities: list[float] = field(default_factory=list)

    def add(
        self,
        kind: int,
        centre: Any,
        half: Any,
        density: float,
        turn: np.ndarray | None = None,
    ) -> None:
        """Add a body.

        Args:
            kind: ELLIPSOID, CYLINDER or BOX.
            centre: [mm].
            half: half axes [mm].
            density: [1/mm].
            turn: rotation (3, 3); None for none.
        """
        own = np.asarray(half, dtype=float)
        rotation = np.eye(3) if turn is None else turn
        self.kinds.append(kind)
        self.centres.append(np.asarray(centre, dtype=float))
        self.frames.append(rotation.T / own[:, None])
        far = (own.max(), math.hypot(max(own[:2]), own[2]), float(np.linalg.norm(own)))
        self.reaches.append(far[kind])
        self.densities.append(density)

    def rod(self, a: np.ndarray, b: np.ndarray, radius: float, density: float) -> None:
        """Add a round rod between two points."""
        along = np.asarray(b, dtype=float) - a
        long = float(np.linalg.norm(along))
        self.add(
            CYLINDER, (np.asarray(a) + b) / 2, (radius, radius, long / 2), density,
            frame_along(along / long),
        )  # fmt: skip

    def placed(self, turn: np.ndarray, by: np.ndarray) -> Solids:
        """Turn all bodies about the origin, then move them."""
        return Solids(
            self.kinds, [turn @ c + by for c in self.centres], [m @ turn.T for m in self.frames],
            self.reaches, self.densities,
        )  # fmt: skip


def frame_along(axis: np.ndarray) -> np.ndarray:
    """Give a rotation whose third column is an axis."""
    other = np.eye(3)[int(np.abs(axis).argmin())]
    u = np.cross(other, axis)
    u /= np.linalg.norm(u)
    return np.column_stack([u, np.cross(axis, u), axis])


def about_z(angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def any_turn(rng: Rng) -> np.ndarray:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    return np.asarray(q * np.sign(np.diag(r)))


def bubbles(
    rng: Rng, solids: Solids, count: int, wide: float, high: float, density: float
) -> None:
    """Add balls in a cylinder that do not overlap; fewer where there is no room after 8
    tries for each.

    Args:
        rng: draws all.
        solids: is added to.
        count: how many.
        wide, high: radius and half height of the cylinder [mm].
        density: of the balls.
    """
    places: list[tuple[np.ndarray, float]] = []
    for _ in range(8 * count):
        r = float(rng.lognormal(math.log(wide * 0.13), 0.35))
        far, turn = (wide - r) * math.sqrt(rng.random()), rng.uniform(0, 2 * math.pi)
        at = np.array(
            [far * math.cos(turn), far * math.sin(turn), rng.uniform(-high, high)]
        )
        if far + r > wide - 0.3 or any(np.linalg.norm(at - p) < r + q for p, q in places):
            continue
        places.append((at, r))
        solids.add(ELLIPSOID, at, (r, r, r), density)
        if len(places) == count:
            break


# The objects, about the origin


def foam(rng: Rng) -> Solids:
    """Foam in a cylinder, with or without a wall of its own."""
    s, wide, high = Solids(), rng.uniform(14, 30), rng.uniform(20, 60)
    density = rng.uniform(0.005, 0.03)
    if rng.random() < 0.5:
        wall = rng.uniform(0.5, 2)
        s.add(
            CYLINDER,
            (0, 0, 0),
            (wide + wall, wide + wall, high),
            density * rng.uniform(1, 3),
        )
        s.add(CYLINDER, (0, 0, 0), (wide, wide, high + 1), density - s.densities[-1])
    else:
        s.add(CYLINDER, (0, 0, 0), (wide, wide, high), density)
    bubbles(
        rng,
        s,
        int(rng.integers(30, 200)),
        wide,
        min(high, 28),
        -density * rng.uniform(0.6, 1),
    )
    return s


def bottle(rng: Rng) -> Solids:
    """A bottle with a neck and a cap, some liquid in it."""
    s, wide, wall = Solids(), rng.uniform(12, 28), rng.uniform(0.5, 2.5)
    low, high, neck = -rng.uniform(18, 40), rng.uniform(2, 15), rng.uniform(4, 9)
    density = rng.uniform(0.01, 0.04)
    middle, half = (low + high) / 2, (high - low) / 2
    s.add(CYLINDER, (0, 0, middle), (wide, wide, half), density)
    s.add(CYLINDER, (0, 0, middle), (wide - wall, wide - wall, half - wall), -density)
    top = high + rng.uniform(4, 12)
    middle, half, bore = (high + top) / 2, (top - high) / 2, neck - wall / 2
    s.add(CYLINDER, (0, 0, middle), (neck, neck, half), density)
    s.add(CYLINDER, (0, 0, middle), (bore, bore, half), -density)
    s.add(CYLINDER, (0, 0, top), (neck * 1.3, neck * 1.3, 2), density * 0.8)
    level = rng.uniform(low + 3, high - 3)
    inside, low = wide - wall, low + wall
    s.add(CYLINDER, (0, 0, (low + level) / 2), (inside, inside, (level - low) / 2), 0.02)
    for _ in range(int(rng.integers(0, 12))):
        r, far, turn = (
            rng.uniform(0.5, 3),
            rng.uniform(0, 0.7) * inside,
            rng.uniform(0, 6.3),
        )
        at = (far * math.cos(turn), far * math.sin(turn), level - r * rng.random() * 5)
        s.add(ELLIPSOID, at, (r, r, r), 0.01)
    return s


def board(rng: Rng) -> Solids:
    """A circuit board with tracks, holes and components, upright."""
    s, wide, high = Solids(), rng.uniform(15, 30), rng.uniform(12, 25)
    thick = rng.uniform(0.4, 1.2)
    s.add(BOX, (0, 0, 0), (wide, thick, high), 0.02)
    for _ in range(int(rng.integers(5, 30))):
        x, z = rng.uniform(-wide, wide), rng.uniform(-high, high)
        long, across = rng.uniform(2, 12), rng.uniform(0.15, 0.5)
        half = (long, 0.05, across) if rng.random() < 0.5 else (across, 0.05, long)
        s.add(BOX, (x, thick, z), half, 0.3)
    for _ in range(int(rng.integers(5, 25))):
        x, z = rng.uniform(-wide, wide) * 0.9, rng.uniform(-high, high) * 0.9
        half = rng.uniform((0.5, 0.3, 0.5), (5, 2, 5))
        side = rng.choice([-1, 1])
        s.add(BOX, (x, side * (thick + half[1]), z), half, rng.uniform(0.01, 0.08))
    for _ in range(int(rng.integers(5, 40))):
        x, z = rng.uniform(-wide, wide) * 0.95, rng.uniform(-high, high) * 0.95
        s.add(
            CYLINDER,
            (x, 0, z),
            (0.4, 0.4, thick),
            -0.02,
            frame_along(np.array([0.0, 1.0, 0.0])),
        )
    return s


def bricks(rng: Rng) -> Solids:
    """Toy bricks with studs, hollow from below."""
    s, unit = Solids(), rng.uniform(3, 5)
    density = rng.uniform(0.01, 0.03)
    for k in range(int(rng.integers(2, 7))):
        nx, ny = int(rng.integers(1, 5)), int(rng.integers(1, 4))
        x, y = rng.integers(-2, 3, 2) * unit
        z, half = (k - 2.5) * 1.2 * unit, 0.6 * unit
        hx, hy = nx * unit / 2, ny * unit / 2
        s.add(BOX, (x, y, z), (hx, hy, half), density)
        inner = (hx - 0.2 * unit, hy - 0.2 * unit, half - 0.15 * unit)
        s.add(BOX, (x, y, z - 0.15 * unit), inner, -density)
        for i in range(nx):
            for j in range(ny):
                at = (
                    x + (i + 0.5) * unit - hx,
                    y + (j + 0.5) * unit - hy,
                    z + half + 0.1 * unit,
                )
                s.add(CYLINDER, at, (0.3 * unit, 0.3 * unit, 0.1 * unit), density)
    return s


def bone(rng: Rng) -> Solids:
    """A hard shell with a net of thin rods in it, in soft tissue or not."""
    s, wide = Solids(), rng.uniform(8, 20)
    wall, flat = rng.uniform(0.8, 3), rng.uniform(0.7, 1)
    high = rng.uniform(25, 60)
    s.add(CYLINDER, (0, 0, 0), (wide, wide * flat, high), 0.04)
    s.add(CYLINDER, (0, 0, 0), (wide - wall, wide * flat - wall, high + 1), -0.035)
    for _ in range(int(rng.integers(40, 150))):
        far, turn = (
            (wide - wall) * 0.8 * flat * math.sqrt(rng.random()),
            rng.uniform(0, 6.3),
        )
        at = np.array([far * math.cos(turn), far * math.sin(turn), rng.uniform(-24, 24)])
        along = any_turn(rng)[:, 0] * rng.uniform(1, 4)
        s.rod(at - along, at + along, rng.uniform(0.15, 0.5), 0.035)
    if rng.random() < 0.5:
        far = wide * rng.uniform(1.1, 1.6)
        s.add(ELLIPSOID, (0, 0, 0), (far, far * 0.9, high), 0.008)
    return s


def printed(rng: Rng) -> Solids:
    """A printed part: walls, a regular infill, holes."""
    s, half = Solids(), rng.uniform((8, 8, 10), (22, 22, 24))
    density, wall = rng.uniform(0.01, 0.03), rng.uniform(0.4, 1.2)
    s.add(BOX, (0, 0, 0), half, density)
    s.add(BOX, (0, 0, 0), half - wall, -density)
    step = rng.uniform(2.5, 6)
    for x in np.arange(-half[0] + step, half[0] - 0.5, step):
        s.add(BOX, (x, 0, 0), (wall / 3, half[1] - wall, half[2] - wall), density)
    for y in np.arange(-half[1] + step, half[1] - 0.5, step):
        s.add(BOX, (0, y, 0), (half[0] - wall, wall / 3, half[2] - wall), density)
    for _ in range(int(rng.integers(0, 4))):
        at = np.array([*rng.uniform(-0.6, 0.6, 2), 0.0]) * half
        r = rng.uniform(1.5, 3)
        s.add(CYLINDER, at, (r, r, half[2]), density * 0.7)
    return s


def stone(rng: Rng) -> Solids:
    """A lump of grains and pores."""
    s, half = Solids(), rng.uniform(10, 26, 3)
    s.add(ELLIPSOID, (0, 0, 0), half, 0.02, any_turn(rng))
    for _ in range(int(rng.integers(40, 250))):
        at = rng.normal(size=3)
        at *= 0.8 * rng.random() ** (1 / 3) / np.linalg.norm(at) * half.min()
        own = rng.lognormal(math.log(1.2), 0.5, 3)
        s.add(ELLIPSOID, at, own, float(rng.choice([-0.015, 0.01, 0.03])), any_turn(rng))
    return s


def wires(rng: Rng) -> Solids:
    """A bundle of bent thin wires, some in a sleeve."""
    s = Solids()
    for _ in range(int(rng.integers(3, 14))):
        far, turn = rng.uniform(0, 16), rng.uniform(0, 6.3)
        at = np.array([far * math.cos(turn), far * math.sin(turn), -30.0])
        radius, density = rng.uniform(0.12, 0.6), rng.uniform(0.1, 0.5)
        for _ in range(8):
            to = at + np.array([*rng.normal(0, 2.0, 2), 7.5])
            s.rod(at, to, radius, density)
            at = to
    if rng.random() < 0.4:
        wide = rng.uniform(18, 25)
        s.add(CYLINDER, (0, 0, 0), (wide, wide, 60), 0.015)
        s.add(CYLINDER, (0, 0, 0), (wide - 1, wide - 1, 61), -0.015)
    return s


OBJECTS: Final[dict[str, Callable[[Rng], Solids]]] = {
    draw.__name__: draw
    for draw in (foam, bottle, board, bricks, bone, printed, stone, wires)
}


@dataclass
class Scan:
    """A scanner as it is [mm, rad, px]; the source is the origin, y goes along the beam, z
    up."""

    kind: str
    solids: Solids
    shape: tuple[int, int]
    views: int
    span: float
    axis_x: float
    panel: tuple[float, float]
    roll: float
    lean: float
    yaw: float
    photons: float
    hardening: float
    blur: float
    rings: float
    gap: tuple[int, float] = (0, 0.0)
    """From this column on the panel stands so many pixels further to the right."""

    @property
    def pitch(self) -> float:
        return WIDTH_MM / self.shape[1]

    def degrees(self) -> np.ndarray:
        return np.arange(self.views) * self.span / self.views

    def steps(self) -> tuple[np.ndarray, np.ndarray]:
        """u and v of a pixel [mm]."""
        c, s = math.cos(self.roll), math.sin(self.roll)
        d, q = math.cos(self.lean), math.sin(self.lean)
        tilt = np.array([[1.0, 0.0, 0.0], [0.0, d, -q], [0.0, q, d]])
        turn = about_z(-self.yaw) @ tilt
        return turn @ (c, 0.0, -s) * self.pitch, turn @ (-s, 0.0, -c) * self.pitch

    def centre(self) -> np.ndarray:
        return np.array([self.panel[0], SDD_MM, self.panel[1]])

    def column(self) -> float:
        """Where the axis crosses the middle row."""
        u, v = self.steps()
        seen = []
        for z in (-9.0, 9.0):
            ray = np.array([self.axis_x, SOD_MM, z])
            seen.append(np.linalg.solve(np.array([u, v, -ray]).T, -self.centre())[:2])
        (c0, r0), (c1, r1) = seen
        return float(c0 - r0 * (c1 - c0) / (r1 - r0) + (self.shape[1] - 1) / 2)

    def lines(self, aside: float = 0.0) -> np.ndarray:
        """Line integrals (views, rows, cols) of a panel that stands `aside` to the right
        [px]."""
        at = (
            (np.arange(self.shape[1] * ACROSS) + 0.5) / ACROSS - self.shape[1] / 2 + aside
        )
        out = np.zeros((self.views, *self.shape))
        kinds, reaches = np.array(self.solids.kinds), np.array(self.solids.reaches)
        densities = np.array(self.solids.densities)
        centres, frames = np.array(self.solids.centres), np.array(self.solids.frames)
        u, v = self.steps()
        for k, turn in enumerate(np.radians(self.degrees())):
            # The stage turns clockwise seen from above; rays are turned the other way.
            back = about_z(turn)
            source = back @ np.array([-self.axis_x, -SOD_MM, 0.0])
            middle = back @ self.centre()
            across, down = back @ u, back @ v
            _rays(
                source,
                middle,
                across,
                down,
                at,
                kinds,
                centres,
                frames,
                reaches,
                densities,
                out[k],
            )
        return out

    def crosses(self, column: int) -> bool:
        """Whether anything passes a border of the panel while it turns, on both sides.

        A gap beside the object moves all of it alike, and nothing in the images tells it.
        """
        seen = self.lines()[:, :, column - 1 : column + 1].max(axis=(0, 1))
        return bool(seen.min() > LEAST_SHADOW)

    def light(self, aside: float = 0.0) -> np.ndarray:
        """Light in front of a panel that stands `aside` to the right [px]: blurred there, not
        by the panel, whose gap it does not know."""
        g = self.lines(aside)
        light = np.exp(-g * (1 - self.hardening * g / (1 + self.hardening * g)))
        return gaussian_filter(light, (0, self.blur, self.blur)) if self.blur else light

    def data(self, rng: Rng) -> fx.DataSet:
        """Make counts and a flat image of the light."""
        light = self.light()
        first, width = self.gap
        if width > 0:
            light[:, :, first:] = self.light(width)[:, :, first:]
        flat = rng.poisson(self.photons, (20, *self.shape)).mean(axis=0)
        flat *= 1 + self.rings * rng.normal(size=flat.shape)
        step = min(4.0, 60_000 / self.photons)
        counts = np.minimum(rng.poisson(self.photons * light) * step, 65535).astype(
            np.uint16
        )
        cone = fx.ConeVec.circular(
            sod=SOD_MM,
            sdd=SDD_MM,
            angles=self.degrees(),
            shape=self.shape,
            pixel=self.pitch,
        )
        return fx.DataSet.from_arrays(
            counts, cone, dark=np.zeros(self.shape), flat=flat * step
        )


@numba.njit(cache=True, error_model="numpy")
def _rays(  # type: ignore[no-untyped-def]
    source, middle, u, v, at, kinds, centres, frames, reaches, densities, out
):
    """Add the mean line integral of each pixel to `out`, body by body."""
    rows = out.shape[0]
    uu, vv = (u * u).sum(), (v * v).sum()
    n = np.cross(u, v)
    for b in range(len(kinds)):
        to = centres[b] - source
        scale = (middle * n).sum() / (to * n).sum()
        foot = to * scale - middle
        wide = 1.2 * reaches[b] * scale / math.sqrt(uu) + 2
        c, r = (foot * u).sum() / uu, (foot * v).sum() / vv
        top, end = (
            max(0, int(r + rows / 2 - wide)),
            min(rows, int(r + rows / 2 + wide) + 2),
        )
        # In the body's own frame a ray is p + t (m + x g + y h).
        p, m, g, h = -frames[b] @ to, frames[b] @ middle, frames[b] @ u, frames[b] @ v
        first, last = np.searchsorted(at, c - wide), np.searchsorted(at, c + wide)
        for row in range(top, end):
            for j in range(DOWN):
                y = row + (j + 0.5) / DOWN - rows / 2
                for i in range(first, last):
                    x = at[i]
                    dx, dy, dz = (
                        m[0] + x * g[0] + y * h[0],
                        m[1] + x * g[1] + y * h[1],
                        m[2] + x * g[2] + y * h[2],
                    )
                    chord = _chord(kinds[b], p[0], p[1], p[2], dx, dy, dz)
                    if chord > 0:
                        long = math.sqrt(
                            (middle[0] + x * u[0] + y * v[0]) ** 2
                            + (middle[1] + x * u[1] + y * v[1]) ** 2
                            + (middle[2] + x * u[2] + y * v[2]) ** 2
                        )
                        out[row, i // ACROSS] += (
                            densities[b] * chord * long / (ACROSS * DOWN)
                        )


@numba.njit(cache=True, error_model="numpy")
def _slab(p, d):  # type: ignore[no-untyped-def]
    """Enter and leave -1 to 1 along one axis."""
    a, b = (-1 - p) / d, (1 - p) / d
    return min(a, b), max(a, b)


@numba.njit(cache=True, error_model="numpy")
def _chord(kind, px, py, pz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Give the part of t for which p + t d is in the unit ball (0), cylinder (1) or cube
    (2).

    It is 0 for a ball or cylinder that is missed, negative or 0 where the ends or the
    cube are missed.
    """
    low, high = -1e30, 1e30
    if kind != BOX:
        round_z = 1.0 if kind == ELLIPSOID else 0.0
        dd = dx * dx + dy * dy + round_z * dz * dz
        dp = dx * px + dy * py + round_z * dz * pz
        root = dp * dp - dd * (px * px + py * py + round_z * pz * pz - 1)
        if root <= 0:
            return 0.0
        low, high = (-dp - math.sqrt(root)) / dd, (-dp + math.sqrt(root)) / dd
    else:
        for q, d in ((px, dx), (py, dy)):
            a, b = _slab(q, d)
            low, high = max(low, a), min(high, b)
    if kind != ELLIPSOID:
        a, b = _slab(pz, dz)
        low, high = max(low, a), min(high, b)
    return high - low


def drawn(kind: str, rng: Rng, gap: bool = False, near: bool = False) -> Scan:
    """Draw a scan of a kind of object, with a gap of the panel or one near the axis."""
    cols = int(rng.choice([160, 192, 240]))
    shape = (int(cols * rng.uniform(0.4, 0.8)), cols)
    lean = np.eye(3) if rng.random() < 0.5 else frame_along(
        np.array([*rng.normal(0, 0.06, 2), 1.0]) / math.hypot(1, 0.08)
    )  # fmt: skip
    by = np.array([*rng.normal(0, rng.choice([0.2, 1.0, 3.0]), 2), rng.uniform(-5, 5)])
    solids = OBJECTS[kind](rng).placed(about_z(rng.uniform(0, 6.3)) @ lean, by)
    scan = Scan(
        kind, solids, shape, int(rng.integers(100, 240)), 360.0,
        axis_x=rng.uniform(-1, 1) * 0.012 * WIDTH_MM * SOD_MM / SDD_MM,
        panel=(rng.uniform(-0.4, 0.4), rng.uniform(-3, 3)),
        roll=math.radians(rng.normal(0, 0.4)), lean=math.radians(rng.normal(0, 0.3)),
        yaw=math.radians(rng.normal(0, 0.2)), photons=float(10 ** rng.uniform(3.3, 4.5)),
        hardening=rng.choice([0.0, rng.uniform(0.02, 0.1)]),
        blur=rng.choice([0.0, rng.uniform(0.3, 1.0)]),
        rings=rng.choice([0.0, rng.uniform(0.001, 0.01)]),
    )  # fmt: skip
    if gap:
        scan.gap = int(cols * rng.uniform(0.35, 0.65)), rng.uniform(0.8, 2)
        while not scan.crosses(scan.gap[0]):
            scan.gap = int(cols * rng.uniform(0.35, 0.65)), scan.gap[1]
    if near:
        beside = int(rng.integers(-NEAR_COLUMNS, NEAR_COLUMNS + 1))
        scan.gap = round(scan.column()) + beside, rng.uniform(0.8, 2)
    return scan


def fan_of_wires(rng: Rng) -> Scan:
    """Draw half a turn and the fan of wires that harden the beam, a band of rows of it."""
    scan = drawn("wires", rng)
    fan = math.degrees(math.atan(WIDTH_MM / 2 / SDD_MM))
    scan.span = 180 + 2 * fan + rng.uniform(0, 20)
    scan.shape = (40, scan.shape[1])
    scan.hardening = rng.uniform(0.05, 0.2)
    return scan


def tried(
    kind: str, seed: int, gap: bool, fan: bool = False, near: bool = False
) -> dict[str, Any]:
    """Align one drawn scan, and say what is told and how far off.

    Args:
        kind: of object.
        seed: the same arguments give the same scan.
        gap: between two tiles of the panel.
        fan: wires that fan out, instead.
        near: the object is near the source.

    Returns:
        For JSON; "refused", or "error" and "sigma" in columns.
    """
    ways = [1] if fan else [2] if near else []
    rng = np.random.default_rng([list(OBJECTS).index(kind), seed, gap, *ways])
    scan = fan_of_wires(rng) if fan else drawn(kind, rng, gap, near)
    data = scan.data(rng)
    begun = time.process_time()
    with warnings.catch_warnings(), patch.object(turn_planes, "find_height", untold):
        warnings.simplefilter("ignore")
        found = data.align()
    told: dict[str, Any] = {
        "kind": kind, "seed": seed, "gap": scan.gap,
        "seconds": round(time.process_time() - begun, 2),
        "warnings": list(found.alignment.warnings),
    }  # fmt: skip
    words = " ".join(
        [*found.alignment.warnings, found.alignment.refused.get("axis_column_px", "")]
    )
    told["named"] = "between two tiles" in words or found.alignment.panel is not None
    told["open"] = "do not exclude that a tile" in words
    told["repeats"] = "repeat the one before" in words
    told["disagree"] = "opposite rays" in words and "apart" in words
    if not found.identifiable:
        return {**told, "refused": found.alignment.refused["axis_column_px"]}
    p: Any = found.parameters["axis_column_px"]
    told |= {"error": p["value"] - scan.column(), "sigma": p["sigma"]}
    told["pull"] = told["error"] / told["sigma"]
    return told


def untold(*_: object) -> None:
    raise NotIdentifiableError("not asked for")


def main(words: list[str] | None = None) -> int:
    """Align drawn scans of natural objects and print a summary; its exit code."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--gaps", action="store_true")
    parser.add_argument("--near", action="store_true")
    parser.add_argument("--fans", action="store_true")
    parser.add_argument("--only", help="objects, with commas between them")
    parser.add_argument(
        "--json", action="store_true", help="one line for each scan as well"
    )
    o = parser.parse_args(words)
    names = ["wires"] if o.fans else o.only.split(",") if o.only else list(OBJECTS)
    runs = []
    for k in range(o.count):
        seed = o.seed + k // len(names)
        runs.append(tried(names[k % len(names)], seed, o.gaps, o.fans, o.near))
        if o.json:
            print(json.dumps(runs[-1]), flush=True)
    return summary(runs, o.gaps, o.near)


def summary(runs: list[dict[str, Any]], gaps: bool, near: bool = False) -> int:
    """Print what went wrong, and a line for all.

    Args:
        runs: of `tried`.
        gaps: whether they have gaps.
        near: near the source; then words about gaps are not judged.

    Returns:
        1 where anything was wrong, or more than SIGMAS off.
    """
    wrong = [run for run in runs if (run["named"] != gaps and not near) or run["repeats"]]
    far = [run for run in runs if abs(run.get("pull", 0.0)) > SIGMAS]
    for run in [*wrong, *far]:
        print(json.dumps(run))
    pulls = np.array([run["pull"] for run in runs if "pull" in run])
    disagree = sum(run["disagree"] for run in runs)
    named, left_open = (sum(run[word] for run in runs) for word in ("named", "open"))
    print(
        f"{len(pulls)} of {len(runs)} told, {len(wrong)} with a wrong word about gaps or repeats, "
        f"{named} told a gap, {left_open} that one is not excluded, "
        f"{disagree} that two ways disagree, {len(far)} columns beyond {SIGMAS:g} sigma; in sigmas "
        f"{math.sqrt(float(np.square(pulls).mean())):.2f} rms, largest {np.abs(pulls).max():.2f}"
    )
    return int(bool(wrong or far))


if __name__ == "__main__":
    sys.exit(main())
