"""Is anything that `align` tells far off? Random objects and scanners, with what spoils such
scans.

    python tests/studies/align_faults.py [--count 200] [--seed 1] [--only cube] [--column]
    [--json]

Every scan has an object drawn at random, a scanner that is not where it is said to be, and one
or two of some fifty kinds of trouble. Every second one is asked for shifts of single frames
too. A line for each kind tells how often column, row and shifts were told and how far they were
off at most, in standard deviations; exit code 1 when anything was off by more than `--sigmas`
(default 5). Gaps between tiles and lists of frames that are wrong (one is there twice) have to
be named, too. `--column` leaves row and shifts, which take most of the time, untold.

Line integrals and kinematics are those of tests/studies/align_targets.py.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import warnings
import zlib
from collections import Counter, defaultdict
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import Any, Final, NoReturn
from unittest.mock import patch

import numpy as np
from align_targets import (
    OBJECTS,
    PIXEL,
    SDD,
    SOD,
    Hidden,
    Solids,
    add_chords,
    drawn,
    left_of,
    truncated,
)
from scipy.ndimage import gaussian_filter

import flexdt as fx
from flexdt.twin.calibration.without_phantom import turn_planes
from flexdt.twin.errors import NotIdentifiableError

Rng = np.random.Generator


@dataclass
class Scan:
    """A scan before it is made. Sizes of shifts are in pixels of the binned panel."""

    hidden: Hidden
    ellipsoids: np.ndarray
    boxes: np.ndarray
    shift: np.ndarray
    """(views, 2) columns and rows by which frames show the object aside."""
    gain: np.ndarray
    """(views,) of the beam."""
    late: np.ndarray
    """(views,) steps by which the stage is ahead of where it is said to be."""
    photons: float = 40_000.0
    rays: int = 4
    still: np.ndarray = field(default_factory=lambda: np.zeros((0, 7)))
    """Boxes that do not turn, in the frame of `Hidden`."""
    ramp: tuple[float, float] = (0.0, 0.0)
    """Of the flat field, over the columns and rows."""
    pattern: float = 0.0
    hardening: float = 0.0
    scatter: float = 0.0
    blur: float = 0.0
    lag: float = 0.0
    gap: tuple[int, float] = (0, 0.0)
    """From this column on the panel is so many pixels further to the right."""
    growth: float = 0.0
    """Of the object during the scan."""
    loose_mm: float = 0.0
    """By which its last part moves in x after 60 % of the scan."""
    dead: tuple[int, int] = (0, 0)
    """Columns and rows."""
    left_out: np.ndarray | None = None
    """Frames that the data set lacks."""
    repeats: bool = False
    """Whether frame views / 3 is there twice, and all after it come one late."""
    swapped: tuple[int, int] | None = None
    """A frame that is lost, and another that is exposed twice, so that their number is
    right."""
    nominal: Callable[[fx.ConeVec], fx.ConeVec] = lambda cone: cone

    def boxes_added(self, *boxes: list[float]) -> None:
        self.boxes = np.vstack([self.boxes, *(np.array([b], dtype=float) for b in boxes)])

    def ellipsoids_added(self, *ellipsoids: list[float]) -> None:
        new = (np.array([e], dtype=float) for e in ellipsoids)
        self.ellipsoids = np.vstack([self.ellipsoids, *new])

    def object_is(self, ellipsoids: list[list[float]], boxes: list[list[float]]) -> None:
        self.ellipsoids = np.array(ellipsoids, dtype=float).reshape(-1, 7)
        self.boxes = np.array(boxes, dtype=float).reshape(-1, 7)

    def scaled(self, part: slice, by: float) -> None:
        for solids in (self.ellipsoids, self.boxes):
            solids[:, part] *= by


def balls(rng: Rng) -> Solids:
    e = [[*rng.uniform(-13, 13, 2), rng.uniform(-18, 18), *3 * [rng.uniform(1, 4)],
          rng.uniform(0.01, 0.1)] for _ in range(rng.integers(3, 12))]  # fmt: skip
    return Solids(np.array(e), np.zeros((0, 7)))


def blocks(rng: Rng) -> Solids:
    b = [[*rng.uniform(-12, 12, 2), rng.uniform(-15, 15), *rng.uniform(1, 6, 3),
          rng.uniform(0.005, 0.04)] for _ in range(rng.integers(2, 9))]  # fmt: skip
    return Solids(np.zeros((0, 7)), np.array(b))


USUAL: Final = (OBJECTS["lego"], OBJECTS["porous"], OBJECTS["smooth"], balls, blocks)

Fault = Callable[[Scan, Rng], None]
FAULTS: Final[dict[str, Fault]] = {}


def fault(draw: Fault) -> Fault:
    FAULTS[draw.__name__] = draw
    return draw


def either(rng: Rng) -> float:
    return float(rng.choice([-1, 1]))


def aside(rng: Rng, low: float, high: float) -> tuple[float, float]:
    """x and y of a place so far from the axis."""
    angle, far = rng.uniform(0, 2 * math.pi), rng.uniform(low, high)
    return far * math.cos(angle), far * math.sin(angle)


# Objects


@fault
def nothing(s: Scan, rng: Rng) -> None:
    pass


@fault
def cube(s: Scan, rng: Rng) -> None:
    half = rng.uniform(6, 14)
    s.object_is([], [[*rng.uniform(-3, 3, 3), half, half, half, 0.02]])


@fault
def plates(s: Scan, rng: Rng) -> None:
    """The object is plates: two to six of them, or one at any height."""
    several = np.linspace(-16, 16, rng.integers(2, 7))
    heights = several if rng.random() < 0.5 else [rng.uniform(-15, 15)]
    s.object_is([], [[*rng.uniform(-2, 2, 2), z, 15, rng.uniform(8, 15), rng.uniform(0.3, 2), 0.02]
                     for z in heights])  # fmt: skip


@fault
def column_of_a_box(s: Scan, rng: Rng) -> None:
    s.object_is([], [[*rng.uniform(-4, 4, 2), 0, *rng.uniform(4, 10, 2), 20, 0.02]])


@fault
def round_about_the_axis(s: Scan, rng: Rng) -> None:
    at, wide, high = rng.uniform(-10, 10, 4), rng.uniform(4, 12, 4), rng.uniform(3, 9, 4)
    bodies = zip(at.tolist(), wide.tolist(), high.tolist(), strict=True)
    s.object_is([[0, 0, z, r, r, h, 0.03] for z, r, h in bodies], [])


@fault
def taller_than_the_panel(s: Scan, rng: Rng) -> None:
    by = rng.uniform(1.5, 3)
    for column in (2, 5):
        s.scaled(slice(column, column + 1), by)


@fault
def wider_than_the_panel(s: Scan, rng: Rng) -> None:
    s.object_is(truncated(rng).ellipsoids[:31].tolist(), [])
    s.scaled(slice(0, 6), rng.uniform(0.5, 1))


@fault
def off_the_axis(s: Scan, rng: Rng) -> None:
    for solids in (s.ellipsoids, s.boxes):
        solids[:, 0] += rng.uniform(5, 20)


@fault
def high_or_low(s: Scan, rng: Rng) -> None:
    by = rng.uniform(12, 25) * either(rng)
    for solids in (s.ellipsoids, s.boxes):
        solids[:, 2] += by


@fault
def strong(s: Scan, rng: Rng) -> None:
    s.scaled(slice(6, 7), float(rng.choice([5, 10])))


# What turns with it


@fault
def holder(s: Scan, rng: Rng) -> None:
    s.boxes_added([*rng.uniform(-8, 8, 2), 100, *rng.uniform(1, 4, 2), 100, 0.03])


@fault
def table(s: Scan, rng: Rng) -> None:
    """A table stands below the object and turns with it."""
    wide, z = rng.choice([12, 20, 30, 60]), rng.uniform(-28, -18)
    s.boxes_added(
        [*rng.uniform(-3, 3, 2), z - 50, wide, wide * rng.uniform(0.7, 1), 50, 0.02]
    )


@fault
def disc(s: Scan, rng: Rng) -> None:
    wide, z = rng.choice([20, 30, 60]), rng.uniform(-28, -18)
    s.ellipsoids_added([*rng.uniform(-3, 3, 2), z - 3, wide, wide, 3, 0.03])


@fault
def arm(s: Scan, rng: Rng) -> None:
    long = rng.uniform(20, 50)
    s.boxes_added([long / 2 + 10, rng.uniform(-3, 3), rng.uniform(-10, 10), long / 2, 2,
                   rng.uniform(1, 4), 0.02])  # fmt: skip


@fault
def thin_rod(s: Scan, rng: Rng) -> None:
    half = rng.uniform(0.5, 2)
    s.boxes_added([*aside(rng, 8, 20), 100 * either(rng), half, half, 100 - rng.uniform(-15, 10),
                   rng.uniform(0.003, 0.03)])  # fmt: skip


@fault
def rods_from_end_to_end(s: Scan, rng: Rng) -> None:
    for _ in range(rng.integers(1, 4)):
        half = rng.uniform(0.3, 1)
        s.boxes_added([*aside(rng, 5, 20), 0, half, half, 200, rng.uniform(0.003, 0.03)])


@fault
def wires(s: Scan, rng: Rng) -> None:
    """One to four thin wires stand beside the object."""
    for _ in range(rng.integers(1, 5)):
        half = rng.uniform(0.3, 1)
        s.boxes_added([*aside(rng, 18, 32), rng.uniform(-15, 15), half, half, rng.uniform(2, 25),
                       rng.uniform(0.005, 0.04)])  # fmt: skip


@fault
def jar(s: Scan, rng: Rng) -> None:
    """A weak jar or block surrounds the object, often wider than the image."""
    wide = rng.uniform(20, 90)
    add = s.ellipsoids_added if rng.random() < 0.5 else s.boxes_added
    add([*rng.uniform(-5, 5, 2), rng.uniform(-20, 20), wide * rng.uniform(0.7, 1), wide,
         rng.uniform(25, 200), rng.uniform(0.0003, 0.004)])  # fmt: skip


@fault
def foam(s: Scan, rng: Rng) -> None:
    s.ellipsoids_added(*([*rng.uniform(-45, 45, 3), *rng.uniform(5, 15, 3),
                          rng.uniform(0.0002, 0.0015)] for _ in range(20)))  # fmt: skip


# What does not


@fault
def still_table(s: Scan, rng: Rng) -> None:
    """A table stands still behind the object while it turns."""
    x, y = rng.uniform(-10, 10, 2)
    wide, z, dense = (
        rng.uniform(10, 80),
        rng.uniform(-78, -68),
        rng.uniform(0.0001, 0.003),
    )
    s.still = np.array([[x, SOD + y, z, wide, 20, 50, dense]])


@fault
def still_strip(s: Scan, rng: Rng) -> None:
    """A thin strip stands still, anywhere in front of or behind the object."""
    x, z, y = *rng.uniform(-25, 25, 2), rng.uniform(-100, 100)
    wide, high, dense = (
        rng.uniform(0.5, 3),
        rng.uniform(0.5, 10),
        rng.uniform(0.001, 0.01),
    )
    s.still = np.array([[x, SOD + y, z, wide, 1, high, dense]])


# Motion


@fault
def shaken(s: Scan, rng: Rng) -> None:
    s.shift += rng.normal(0, rng.choice([0.03, 0.1, 0.3]), s.shift.shape)


@fault
def shaken_aside(s: Scan, rng: Rng) -> None:
    s.shift[:, 0] += rng.normal(0, rng.uniform(0.03, 0.3), len(s.shift))


@fault
def shaken_upwards(s: Scan, rng: Rng) -> None:
    s.shift[:, 1] += rng.normal(0, rng.uniform(0.03, 0.3), len(s.shift))


@fault
def drift_upwards(s: Scan, rng: Rng) -> None:
    s.shift[:, 1] += (
        np.linspace(-0.5, 0.5, len(s.shift)) * rng.uniform(0.3, 1) * either(rng)
    )


@fault
def drift_aside(s: Scan, rng: Rng) -> None:
    s.shift[:, 0] += (
        np.linspace(-0.5, 0.5, len(s.shift)) * rng.uniform(0.3, 1) * either(rng)
    )


@fault
def wobble(s: Scan, rng: Rng) -> None:
    turns = np.linspace(0, 2 * np.pi, len(s.shift)) * rng.integers(1, 4)
    s.shift[:, 1] += rng.uniform(0.06, 0.4) * np.sin(turns + rng.uniform(0, 6))


@fault
def step_upwards(s: Scan, rng: Rng) -> None:
    late = np.linspace(0, 1, len(s.shift)) > rng.uniform(0.2, 0.8)
    s.shift[:, 1] += late * rng.uniform(0.05, 0.4) * either(rng)


@fault
def grows(s: Scan, rng: Rng) -> None:
    s.growth = rng.uniform(0.005, 0.02)


@fault
def loose(s: Scan, rng: Rng) -> None:
    s.loose_mm = 1.5


@fault
def stage_hesitates(s: Scan, rng: Rng) -> None:
    degrees = rng.choice([0.05, 0.2, 0.5])
    s.late += rng.normal(0, degrees, len(s.late)) * s.hidden.views / s.hidden.span


@fault
def turn_is_longer_than_said(s: Scan, rng: Rng) -> None:
    s.late += np.arange(len(s.late)) * rng.uniform(0.003, 0.01) * either(rng)


# Frames


@fault
def few_views(s: Scan, rng: Rng) -> None:
    n = int(rng.integers(24, 61))
    s.hidden = replace(s.hidden, views=n)
    s.shift, s.gain, s.late = s.shift[:n], s.gain[:n], s.late[:n]


@fault
def neighbours_missing(s: Scan, rng: Rng) -> None:
    s.left_out = s.hidden.views // 4 + np.arange(rng.integers(1, 4))


@fault
def some_missing(s: Scan, rng: Rng) -> None:
    n = s.hidden.views
    s.left_out = rng.choice(n, max(1, int(n * rng.uniform(0.03, 0.15))), replace=False)


@fault
def repeated(s: Scan, rng: Rng) -> None:
    s.repeats = True


@fault
def lost_and_exposed_again(s: Scan, rng: Rng) -> None:
    lost, again = rng.choice(s.hidden.views, 2, replace=False).tolist()
    s.swapped = lost, again


@fault
def clockwise(s: Scan, rng: Rng) -> None:
    s.hidden = replace(s.hidden, span=-360.0)


@fault
def more_than_a_turn(s: Scan, rng: Rng) -> None:
    s.hidden = replace(s.hidden, span=float(rng.choice([365, 370, 400, 540, 720, 1080])))


# Images


@fault
def beam_varies(s: Scan, rng: Rng) -> None:
    size, part = rng.uniform(0.01, 0.03), np.arange(len(s.gain)) / len(s.gain)
    slow = np.sin(2 * np.pi * rng.uniform(0.3, 2) * part + rng.uniform(0, 6))
    s.gain += size * (slow if rng.random() < 0.5 else rng.normal(size=len(s.gain)))


@fault
def hardening(s: Scan, rng: Rng) -> None:
    s.hardening = rng.uniform(0.02, 0.05)
    s.scaled(slice(6, 7), 2.0)


@fault
def flat_ramp(s: Scan, rng: Rng) -> None:
    s.ramp = (rng.uniform(0.01, 0.04) * either(rng), 0.0)


@fault
def flat_ramp_upwards(s: Scan, rng: Rng) -> None:
    s.ramp = (0.0, rng.uniform(0.01, 0.04) * either(rng))


@fault
def pattern(s: Scan, rng: Rng) -> None:
    s.pattern = rng.uniform(0.003, 0.02)


@fault
def dead_columns(s: Scan, rng: Rng) -> None:
    s.dead = (int(rng.integers(1, 5)), 0)


@fault
def dead_rows(s: Scan, rng: Rng) -> None:
    s.dead = (0, int(rng.integers(1, 4)))


@fault
def little_light(s: Scan, rng: Rng) -> None:
    s.photons = float(rng.choice([100, 400, 1000, 4000]))


@fault
def few_rays_a_pixel(s: Scan, rng: Rng) -> None:
    s.rays = int(rng.integers(1, 3))


@fault
def scatter(s: Scan, rng: Rng) -> None:
    s.scatter = rng.uniform(0.01, 0.08)


@fault
def lag(s: Scan, rng: Rng) -> None:
    s.lag = rng.uniform(0.01, 0.05)


@fault
def blur(s: Scan, rng: Rng) -> None:
    s.blur = rng.uniform(0.5, 2)


@fault
def tiles_apart(s: Scan, rng: Rng) -> None:
    cols = s.hidden.shape[1]
    s.gap = (int(cols * rng.uniform(0.35, 0.65)), rng.uniform(0.5, 2))


# The scanner


@fault
def near_the_source(s: Scan, rng: Rng) -> None:
    """The object is close to the source: a wide cone, and the object scaled to its image."""
    sod = rng.uniform(60, 120)
    sdd = sod * rng.uniform(2.5, 3.5)
    size = SDD / SOD / (sdd / sod) * rng.uniform(0.5, 1)
    s.scaled(slice(0, 6), size)
    s.scaled(slice(6, 7), 1 / size)
    s.hidden = replace(s.hidden, sod=sod, sdd=sdd)


@fault
def part_of_the_panel(s: Scan, rng: Rng) -> None:
    """Only few rows or few columns of the panel are read."""
    rows, cols = s.hidden.shape
    low = rng.random() < 0.5
    shape = (
        (int(rng.integers(20, 60)), cols) if low else (rows, int(rng.integers(60, 110)))
    )
    s.hidden = replace(s.hidden, shape=shape)


@fault
def rolled(s: Scan, rng: Rng) -> None:
    s.hidden = replace(
        s.hidden, tilts=(rng.uniform(2, 5) * either(rng), *s.hidden.tilts[1:])
    )


@fault
def pitch_and_yaw(s: Scan, rng: Rng) -> None:
    pitch, yaw = rng.uniform(1, 3) * either(rng), rng.uniform(0.5, 2) * either(rng)
    s.hidden = replace(s.hidden, tilts=(s.hidden.tilts[0], pitch, yaw))


@fault
def panel_far_off(s: Scan, rng: Rng) -> None:
    up = rng.uniform(30, 60) * either(rng) * rng.choice([1, 2, 4])
    s.hidden = replace(s.hidden, panel=(rng.uniform(-40, 40) * PIXEL, up * PIXEL))


@fault
def frame_of_another(s: Scan, rng: Rng) -> None:
    """The data set tells its geometry in a frame that is moved along z and turned about it, or
    moved and turned in any way, so that z is no longer the axis."""
    angles, by = rng.uniform(-1, 1, 2) * (3, 0.5), rng.uniform(-200, 200, 3)
    if rng.random() < 0.5:
        angles[1], by[:2] = 0.0, 0.0
    (c, r), (d, q) = ((math.cos(a), math.sin(a)) for a in angles)
    about_z = np.array([[c, -r, 0], [r, c, 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, d, -q], [0, q, d]])
    s.nominal = lambda cone: cone.moved(about_x @ about_z, by)


@fault
def distance_wrong(s: Scan, rng: Rng) -> None:
    """The geometry given has a distance to the panel that is wrong by 1 to 4 %."""
    by = 1 + rng.uniform(0.01, 0.04) * either(rng)
    s.nominal = lambda cone: fx.ConeVec.circular(
        sod=s.hidden.sod, sdd=s.hidden.sdd * by, angles=s.hidden.degrees(), shape=s.hidden.shape,
        pixel=s.hidden.pixel,
    )  # fmt: skip


def scan(kinds: list[str], seed: int) -> tuple[Scan, Rng]:
    """Draw an object and a scanner, and put faults into them.

    Args:
        kinds: of faults, by the names of their functions, in that order.
        seed: the same kinds and seed give the same scan.

    Returns:
        The scan, and the generator for what is drawn next.
    """
    rng = np.random.default_rng([seed, *(zlib.crc32(k.encode()) for k in kinds)])
    binning, n = int(rng.choice([4, 5, 6])), int(rng.integers(60, 121))
    plain = Hidden(n, (760 // binning, 956 // binning), PIXEL * binning)
    solids = USUAL[rng.integers(len(USUAL))](rng)
    s = Scan(drawn(rng, plain), solids.ellipsoids.astype(float), solids.boxes.astype(float),
             np.zeros((n, 2)), np.ones(n), np.zeros(n))  # fmt: skip
    for kind in kinds:
        FAULTS[kind](s, rng)
    return s, rng


def lines(s: Scan) -> np.ndarray:
    """Line integrals (views, rows, cols)."""
    out = seen(s, 0.0)
    column, width = s.gap
    if width:
        out[:, :, column:] = seen(s, width)[:, :, column:]
    return out


def seen(s: Scan, beyond: float) -> np.ndarray:
    """Line integrals (views, rows, cols) on a panel that stands `beyond` pixels further
    to the right.
    """
    hidden, rays = s.hidden, s.rays
    rows, cols = hidden.shape
    out = np.empty((hidden.views, rows, cols), dtype=np.float32)
    for k in range(hidden.views):
        source, centre, u, v = hidden.placed(k + s.late[k])
        centre = centre - (s.shift[k, 0] - beyond) * u - s.shift[k, 1] * v
        size = np.array([*6 * [1 + s.growth * (k / hidden.views - 0.5)], 1.0])
        e, b = s.ellipsoids * size, s.boxes * size
        if k > 0.6 * hidden.views:
            (e if len(e) else b)[-1, 0] += s.loose_mm
        fine = np.zeros((rows * rays, cols * rays))
        add_chords(source, centre, u / rays, v / rays, e, True, fine)
        add_chords(source, centre, u / rays, v / rays, b, False, fine)
        if len(s.still):
            u, v = hidden.steps()
            centre = np.array([hidden.panel[0], hidden.sdd, hidden.panel[1]]) + beyond * u
            add_chords(np.zeros(3), centre, u / rays, v / rays, s.still, False, fine)
        out[k] = fine.reshape(rows, rays, cols, rays).mean(axis=(1, 3))
    return out


def images(s: Scan, rng: Rng) -> tuple[np.ndarray, np.ndarray]:
    """Expose the scan, with scatter, blur, lag and noise where it has them.

    Returns:
        Counts of all frames, and the flat image.
    """
    rows, cols = s.hidden.shape
    g = lines(s)
    if s.swapped:
        lost, again = s.swapped
        order = np.insert(np.arange(s.hidden.views), again, again)
        g = g[np.delete(order, np.flatnonzero(order == lost)[0])]
    light = np.exp(-(g - s.hardening * g**2))
    if s.scatter:
        light += s.scatter * gaussian_filter(light, (0, 15, 15))
    if s.blur:
        light = gaussian_filter(light, (0, s.blur, s.blur))
    light = (1 - s.lag) * light + s.lag * np.concatenate([light[:1], light[:-1]])
    light *= s.gain[:, None, None]
    step = 1.0 if s.photons > 3000 else 30_000 / s.photons
    flat = rng.poisson(s.photons, (20, rows, cols)).mean(axis=0) * step
    flat *= 1 + s.ramp[0] * np.linspace(-0.5, 0.5, cols)
    flat *= 1 + s.ramp[1] * np.linspace(-0.5, 0.5, rows)[:, None]
    flat *= 1 + s.pattern * rng.normal(size=flat.shape)
    counts = np.minimum(rng.poisson(s.photons * light) * step, 65535).astype(np.uint16)
    counts[:, :, rng.integers(0, cols, s.dead[0])] = int(rng.choice([0, 1000, 65535]))
    counts[:, rng.integers(0, rows, s.dead[1])] = int(rng.choice([0, 1000, 65535]))
    return counts, flat


def tried(kinds: list[str], seed: int, per_frame: bool) -> dict[str, Any]:
    """Align one scan, and compare what is told with the truth.

    Args:
        kinds, seed: see `scan`.
        per_frame: estimate a shift of each frame.

    Returns:
        Kinds, refusals, warnings, and errors over sigmas by name (none where nothing is
        told).
    """
    s, rng = scan(kinds, seed)
    counts, flat = images(s, rng)
    hidden, n = s.hidden, s.hidden.views
    shown = np.arange(n)
    if s.repeats:
        shown[n // 3 + 1 :] -= 1
    there = np.arange(n) if s.left_out is None else np.setdiff1d(np.arange(n), s.left_out)
    shown = shown[there]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        data = fx.DataSet.from_arrays(
            counts[shown],
            s.nominal(hidden.nominal())[there],
            dark=np.zeros(hidden.shape),
            flat=flat,
        )
        found = data.align(per_frame=per_frame)
    told: dict[str, Any] = {"kinds": kinds, "seed": seed, "per_frame": per_frame,
                            "refused": dict(found.document["refused"]),  # type: ignore[call-overload]
                            "warnings": list(found.alignment.warnings), "pulls": {}}  # fmt: skip
    words = " ".join([*found.alignment.warnings, *found.alignment.refused.values()])
    told["gap"] = (s.gap[1] > 0, "between two tiles" in words)
    told["list"] = (s.repeats or s.swapped is not None, "repeat the one before" in words)
    if not found.identifiable:
        return told
    shift = s.shift[shown]
    true = {
        "axis_column_px": hidden.axis_in_image()[0],
        "source_row_px": hidden.source_row(),
    }
    for i, (name, value) in enumerate(true.items()):
        if name in found.parameters:
            p: Any = found.parameters[name]
            # The mean of what frames are shifted by counts as the geometry's.
            errors = p["value"] - value - np.array([shift[:, i].mean(), 0.0])
            told["pulls"][name] = float(errors[np.abs(errors).argmin()]) / p["sigma"]
    motion = found.alignment.motion
    if motion is not None:
        left, sigma = left_of(shift, motion, hidden, hidden.degrees()[there])
        for i, name in enumerate(("shifts aside", "shifts down")):
            if motion.values[:, i].any():
                pulls = left[:, i] / sigma[:, i]
                told["pulls"][name] = float(np.sqrt(np.mean(np.square(pulls))))
    return told


def main(words: list[str] | None = None) -> int:
    """Align drawn scans with one fault or two, and print what comes of each kind.

    Args:
        words: of the command line; None for the process's own.

    Returns:
        1 where a value told is more sigmas off than allowed.
    """
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", help="kinds, with commas between them")
    parser.add_argument("--sigmas", type=float, default=5.0)
    parser.add_argument("--column", action="store_true", help="no row, no shifts")
    parser.add_argument(
        "--json", action="store_true", help="one line for each scan as well"
    )
    o = parser.parse_args(words)
    with ExitStack() as column_only:
        if o.column:
            column_only.enter_context(patch.object(turn_planes, "find_height", untold))
        runs = tried_in_turn(o)
    return summary(runs, o.sigmas)


def tried_in_turn(o: argparse.Namespace) -> list[dict[str, Any]]:
    """Try `--count` scans, each with the next kind of trouble, at times with one more."""
    rng, runs = np.random.default_rng(o.seed), []
    names = sorted(o.only.split(",") if o.only else FAULTS)
    for k in range(o.count):
        if k % len(names) == 0:
            order = rng.permutation(names).tolist()
        kinds = [order[k % len(names)]]
        if rng.random() < 0.15:
            kinds.append(str(rng.choice([x for x in FAULTS if x not in kinds])))
        runs.append(tried(kinds, int(rng.integers(2**31)), k % 2 == 1 and not o.column))
        if o.json:
            print(json.dumps(runs[-1]), flush=True)
    return runs


def untold(*_: object) -> NoReturn:
    raise NotIdentifiableError("not asked for")


def summary(runs: list[dict[str, Any]], sigmas: float) -> int:
    """Print a line for each kind and one for each scan too far off.

    Args:
        runs: of `tried`.
        sigmas: from where an error is too large.

    Returns:
        1 if any is, else 0.
    """
    of_kind = defaultdict(list)
    for run in runs:
        of_kind[run["kinds"][0]].append(run)
    told = ("axis_column_px", "source_row_px", "shifts aside", "shifts down")
    print("told, and the largest error in standard deviations\n" + f"{'':26s}scans  "
          + "  ".join(f"{name:>14s}" for name in told))  # fmt: skip
    for kind, some in (*sorted(of_kind.items()), ("all", runs)):
        cells = []
        for name in told:
            pulls = [abs(run["pulls"][name]) for run in some if name in run["pulls"]]
            cells.append(f"{len(pulls):5d} {max(pulls):8.2f}" if pulls else f"{'-':>14s}")
        print(f"{kind:26s}{len(some):5d}  " + "  ".join(cells))
    far = [run for run in runs if any(abs(p) > sigmas for p in run["pulls"].values())]
    for what, name in (("gap", "gaps between tiles"), ("list", "wrong lists of frames")):
        named = Counter(run[what] for run in runs if what in run)
        of = [named[there, True] + named[there, False] for there in (True, False)]
        print(f"{name}: {named[True, True]} of {of[0]} named, warned in "
              f"{named[False, True]} of {of[1]} scans without one")  # fmt: skip
    for run in far:
        print(f"more than {sigmas:g}: {run['kinds']}, seed {run['seed']}, {run['pulls']}")
    return int(bool(far))


if __name__ == "__main__":
    sys.exit(main())
