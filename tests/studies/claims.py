"""Drawn right and wrong scans: is what `volume.accuracy` claims true, and is a cause named?

    python tests/studies/claims.py --right 60 --wrong 2 --seed 1
    python tests/studies/claims.py --right 20 --wrong 0 --algorithm sirt

Objects are sums of ellipsoids, elliptic cylinders and boxes in closed form (soft, dense in soft,
plates, boxes, textured, sparse, nearly symmetric, tall); geometries are this file's own rows of
source, panel and steps (whole, short, few views, panel aside, arcs by a panel aside, tilted,
rolled, helix, cone angles up to 22 degrees); pixels are thin rays or means of 3 x 3; with and
without noise. `--wrong` draws so many scans of each kind of `WRONG`, in which images or stated
geometry are then made wrong. A claim is true where nine of ten balls in even parts of the volume
of the same images without noise are right within it. A wrong scan's cause is named where it is
the first or the second cause of the accuracy, or of the contradiction, by its identifier; a claim
that is false, but holds if that cause is taken as stated, is counted apart ("by a condition").
`--algorithm`: of smaller scans, the volume and claim of another algorithm. The noise: the share of
voxels that noise moves by at most twice `sigma`.
Prints what was claimed, what was true and what was told; exits with 1 where less than 88 % of the
claims about right scans are true, or more than 1 % of right scans are told of a contradiction.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

import flexdt as fx
from flexdt.twin import reconstruction
from flexdt.twin.projection.volume import CAUSES, ONE_ENERGY
from flexdt.twin.reconstruction.bias import STATED
from flexdt.twin.reconstruction.coarse_scan import Clipped
from flexdt.twin.reconstruction.consistency.suspects import KINDS, SIDES

REGIONS = 40
BALL = 2.3
"""Radius of a region whose mean is taken [voxels]."""
SPARE = 4.5
"""Least distance of its middle to a surface [voxels]."""
SPECTRUM = ((1.0, 1.6), (1.0, 1.0), (1.0, 0.6))
"""Shares of three energies, and attenuation there over the mean one's."""


@dataclass(frozen=True)
class Body:
    """An ellipsoid (round in 3), an elliptic cylinder (2) or a box (0), turned about z."""

    round: int
    centre: tuple[float, float, float]
    half: tuple[float, float, float]
    turn: float
    mu: float

    def local(self, at, shift=True):
        c, s = np.cos(self.turn), np.sin(self.turn)
        x, y, z = np.moveaxis(at - np.array(self.centre) if shift else at, -1, 0)
        return np.stack([c * x + s * y, c * y - s * x, z], -1) / np.array(self.half)

    def inside(self, at):
        at = self.local(at)
        curved = (at[..., : self.round] ** 2).sum(-1) < 1.0
        return curved & (np.abs(at[..., self.round :]) < 1.0).all(-1)

    def chords(self, source, rays):
        """Lengths inside along unit rays (..., 3) from one point."""
        start, along = self.local(source), self.local(rays, shift=False)
        low, high = np.full(rays.shape[:-1], -1e9), np.full(rays.shape[:-1], 1e9)
        for axis in range(self.round, 3):
            step = np.where(np.abs(along[..., axis]) < 1e-12, 1e-12, along[..., axis])
            one, two = (-1.0 - start[axis]) / step, (1.0 - start[axis]) / step
            low = np.maximum(low, np.minimum(one, two))
            high = np.minimum(high, np.maximum(one, two))
        if self.round:
            part, first = along[..., : self.round], start[: self.round]
            a, b = (part**2).sum(-1) + 1e-30, (part * first).sum(-1)
            root = np.sqrt(np.maximum(b * b - a * ((first**2).sum() - 1.0), 0.0)) / a
            low, high = np.maximum(low, -b / a - root), np.minimum(high, -b / a + root)
        return np.maximum(high - low, 0.0)


@dataclass(frozen=True)
class Drawn:
    """A scan: what is true of it, and what is said.

    Attributes:
        said: in words.
        true, stated: (n, 12) rows.
        shape: (rows, cols).
        bodies: of the object.
        rays: a side of a pixel.
        counts: of the open beam, 0 for no noise.
        hard: by three energies.
        causes: of `CAUSES` and `KINDS` of the reconstruction, one of which is what is wrong;
            empty of a right scan, and of an error that has none.
    """

    said: str
    true: np.ndarray
    stated: np.ndarray
    shape: tuple[int, int]
    bodies: tuple[Body, ...]
    rays: int = 1
    counts: float = 0.0
    hard: bool = False
    seed: int = 0
    causes: tuple[str, ...] = ()
    change: Callable[[np.ndarray, np.random.Generator], np.ndarray] | None = None
    order: np.ndarray | None = field(default=None, repr=False)

    def integrals(self, row: np.ndarray) -> np.ndarray:
        """Of the rays of one view, (rows * rays, cols * rays)."""
        rows, cols = self.shape
        source, panel, u, v = row.reshape(4, 3)
        c = (np.arange(cols * self.rays) + 0.5) / self.rays - cols / 2
        r = (np.arange(rows * self.rays) + 0.5) / self.rays - rows / 2
        ray = panel + c[None, :, None] * u + r[:, None, None] * v - source
        ray /= np.linalg.norm(ray, axis=2, keepdims=True)
        return sum(body.mu * body.chords(source, ray) for body in self.bodies)

    def images(self) -> np.ndarray:
        """Line integrals as measured, (n, rows, cols), float32."""
        rows, cols = self.shape
        rng = np.random.default_rng([self.seed, 77])
        out = np.empty((len(self.true), rows, cols))
        total = sum(share for share, _ in SPECTRUM)
        for view, row in enumerate(self.true):
            paths = self.integrals(row)
            if self.hard:
                light = sum(w * np.exp(-m * paths) for w, m in SPECTRUM) / total
            else:
                light = np.exp(-paths)
            if self.rays > 1:
                split = light.reshape(rows, self.rays, cols, self.rays)
                light = split.mean((1, 3))
            out[view] = light
        if self.counts:
            out = np.maximum(rng.poisson(self.counts * out), 0.5) / self.counts
        out = -np.log(out)
        if self.change is not None:
            out = self.change(out, rng)
        return out.astype(np.float32)

    def truth(self, at: np.ndarray) -> np.ndarray:
        """Attenuation at points (..., 3)."""
        return sum(body.mu * body.inside(at) for body in self.bodies)


def circle(angles, sod, sdd, pixel, aside=0.0, tilts=(0.0, 0.0, 0.0), rise=0.0, up=0.0):
    """Rows of source, panel, u and v; tilts are roll, pitch and yaw [deg]."""
    angles = np.asarray(angles, float)
    c, s, o = np.cos(angles), np.sin(angles), np.zeros(len(angles))
    z = np.stack([o, o, rise * (angles - angles.mean()) / (2.0 * np.pi)], 1)
    away, side = np.stack([s, -c, o], 1), np.stack([c, s, o], 1)
    top = np.array([0.0, 0.0, 1.0])
    roll, pitch, yaw = np.radians(tilts)
    u = np.cos(yaw) * side + np.sin(yaw) * away
    v = -np.cos(pitch) * top + np.sin(pitch) * away
    u, v = np.cos(roll) * u + np.sin(roll) * v, np.cos(roll) * v - np.sin(roll) * u
    panel = -(sdd - sod) * away + z + aside * pixel * side + up * pixel * top
    return np.concatenate([sod * away + z, panel, pixel * u, pixel * v], 1)


def body_of(rng, kind, radius, height):
    """Bodies of an object of a kind within a cylinder."""
    r, h = radius, height
    mu = float(rng.uniform(0.4, 1.6)) / (2.0 * r)

    def small(mus, count, sizes):
        made = []
        for _ in range(count):
            at = rng.uniform(-0.55, 0.55, 3) * [r, r, h]
            half = rng.uniform(*sizes, 3) * min(r, h)
            rounds = int(rng.choice([3, 2, 0]))
            turn = float(rng.uniform(0, 3))
            made.append(
                Body(rounds, tuple(at), tuple(half), turn, float(rng.choice(mus)))
            )
        return made

    def outer(rounds, ratio=None, size=1.0):
        ratio = float(rng.uniform(0.6, 1.0)) if ratio is None else ratio
        side = size * r * (0.72 if rounds == 0 else 1.0)
        turn = float(rng.uniform(0, 3))
        return Body(rounds, (0.0, 0.0, 0.0), (side, side * ratio, h), turn, mu)

    if kind == "soft":
        return [
            outer(int(rng.choice([3, 2, 0]))),
            *small([-0.5 * mu, 0.4 * mu, mu], 4, (0.15, 0.35)),
        ]
    if kind == "dense":
        return [outer(int(rng.choice([3, 2]))), *small([5 * mu, 8 * mu], 3, (0.06, 0.14))]
    if kind == "plate":
        return [outer(0, ratio=float(rng.uniform(0.15, 0.35)))]
    if kind == "boxes":
        return [
            outer(0),
            *[replace(b, round=0) for b in small([mu, -0.6 * mu], 3, (0.15, 0.35))],
        ]
    if kind == "textured":
        return [outer(2), *small([-0.3 * mu, 0.3 * mu], 40, (0.05, 0.12))]
    if kind == "sparse":
        return small([2 * mu, 3 * mu, 4 * mu], 4, (0.2, 0.32))
    if kind == "round":
        hole = float(rng.choice([0.0, 0.4]))
        inner = [Body(2, (0, 0, 0), (hole * r, hole * r, h), 0.0, -mu)] if hole else []
        return [outer(2, ratio=1.0), *inner]
    return [outer(2, size=0.9), *small([0.5 * mu, -0.5 * mu], 3, (0.2, 0.35))]  # tall


OBJECTS = ("soft", "dense", "plate", "boxes", "textured", "sparse", "round", "tall")
COURSES = (
    "whole", "whole", "short", "few", "aside", "arc aside", "tilted", "rolled", "helix", "cone",
)  # fmt: skip
ALGORITHMS = {
    "fdk": {},
    "sirt": {"iterations": 30},
    "sart": {"iterations": 4},
    "cgls": {"iterations": 10},
    "em": {"iterations": 30},
    "tv": {"iterations": 40},
}
"""Name -> options."""
SMALLER = 0.75
"""Factor on rows, columns and views of scans for iterations."""


def right(
    seed: int, number: int, course: str = "", thing: str = "", size: float = 1.0
) -> Drawn:
    """Draw a right scan; the same numbers give the same one, of another size of its images."""
    rng = np.random.default_rng([seed, number])
    course = course or str(rng.choice(COURSES))
    thing = thing or str(rng.choice(OBJECTS))
    rows, cols = int(rng.integers(32, 57)), int(rng.integers(48, 81))
    rows, cols = round(size * rows), round(size * cols)
    views = int(rng.integers(int(1.4 * cols), int(2.2 * cols)))
    sod = float(np.exp(rng.uniform(np.log(70.0), np.log(300.0))))
    sdd = sod * float(rng.uniform(1.3, 3.0))
    radius = 10.0  # of the object's cylinder [mm]
    cover = float(rng.uniform(1.12, 1.35))
    span, rise, aside, tilts = 2.0 * np.pi, 0.0, 0.0, (0.0, 0.0, 0.0)
    if course == "cone":
        sod = float(rng.uniform(28.0, 45.0))
    if course == "tilted":
        tilts = tuple(rng.uniform(-4.0, 4.0, 3))
    if course == "rolled":
        tilts = (float(rng.uniform(-5.0, 5.0)), 0.0, 0.0)
    if course == "few":
        views = round(size * int(rng.integers(36, 60)))
    if course in ("short", "arc aside"):
        fan = 2.0 * np.arcsin(cover * radius / sod)
        span = float(rng.uniform(np.pi + fan + 0.15, 1.9 * np.pi))
    pixel = 2.0 * cover * sdd * np.tan(np.arcsin(radius / sod)) / cols
    if "aside" in course:
        aside = float(rng.uniform(0.1, 0.35)) * cols
        pixel /= 1.0 - 0.7 * abs(aside) / cols
    tall = 0.5 * rows * pixel / sdd * (sod - radius)
    height = tall * float(rng.uniform(0.45, 0.85))
    if thing == "tall":
        height = 1.6 * tall
    if course == "cone":
        height = tall * 0.9
    if course == "helix":
        span, rise = 4.0 * np.pi, 0.8 * tall
        views = int(1.7 * views)
        height = min(height, tall)
    end = not np.isclose(span, 2.0 * np.pi)
    angles = rng.uniform(0, 6) + np.linspace(0.0, span, views, endpoint=end)
    angles *= float(rng.choice([-1.0, 1.0]))
    geometry = circle(angles, sod, sdd, pixel, aside, tilts, rise)
    bodies = tuple(body_of(rng, thing, radius, height))
    counts = float(rng.choice([0.0, 10.0 ** rng.uniform(3.7, 5.3)]))
    rays = int(rng.choice([1, 3]))
    words = (f"{course}, {thing}, {views} x {rows} x {cols}, sod {sod:.0f}, "
             f"{rays} rays, counts {counts:.2g}")  # fmt: skip
    return Drawn(
        words, geometry, geometry, (rows, cols), bodies, rays, counts, seed=number
    )


def _again(scan, rng, **changes):
    """The stated circle of a drawn whole scan, with changes."""
    source, panel, u, _ = np.split(scan.true, 4, 1)
    sod = np.hypot(*source[0, :2])
    sdd = sod + np.hypot(*panel[0, :2])
    angles = np.unwrap(np.arctan2(source[:, 0], -source[:, 1]))
    given = {"angles": angles, "sod": sod, "sdd": sdd, "pixel": np.linalg.norm(u[0])}
    for name, change in changes.items():
        given[name] = change(given[name]) if callable(change) else change
    return circle(**given)


def _moved(rows, along, down=0.0):
    """Panels moved along their rows and columns [pixels]."""
    rows = rows.copy()
    rows[:, 3:6] += np.reshape(along, (-1, 1)) * rows[:, 6:9]
    rows[:, 3:6] += np.reshape(down, (-1, 1)) * rows[:, 9:12]
    return rows


def _sign(rng):
    return float(rng.choice([-1.0, 1.0]))


def _geometry(make):
    """A kind whose stated geometry is made wrong."""
    return lambda scan, rng: replace(scan, stated=make(scan, rng))


def _images(make):
    """A kind whose images are made wrong."""
    return lambda scan, rng: replace(scan, change=lambda p, noise: make(p, rng))


def _true(make):
    """A kind whose true geometry differs from the stated one."""
    return lambda scan, rng: replace(scan, true=make(scan, rng))


def _order(make):
    return _images(lambda p, rng: p[make(len(p), rng)])


def _n(scan):
    return len(scan.true)


def _step(scan, rng):
    at = int(_n(scan) * rng.uniform(0.25, 0.75))
    return np.where(np.arange(_n(scan)) < at, 0.0, _sign(rng) * rng.uniform(1.0, 3.0))


def _foreign(p, rng):
    """Some neighbouring images are of another time: shifted and brighter object."""
    at = rng.choice(len(p), max(2, len(p) // 30), replace=False)
    p = p.copy()
    p[at] = np.roll(p[rng.permutation(len(p))[: len(at)]], 3, axis=2) * 1.3
    return p


def _lost(scan, rng):
    """Frames were lost, and the stated angles spread over those that are left."""
    at = np.delete(np.arange(_n(scan)), np.arange(20, 20 + max(3, _n(scan) // 25)))
    return replace(scan, true=scan.true[at], stated=scan.stated[: len(at)])


def _doubled(n, rng):
    at = int(rng.integers(n // 4, n // 2))
    return np.r_[:at, at, at : n - 1]


def _haze(p, rng):
    return -np.log((np.exp(-p) + 0.02) / 1.02)


def _scattered(p, rng):
    return -np.log(np.exp(-p) + 0.03 * np.exp(-p).mean())


def _lens(scan, rng):
    k = 0.03 * _sign(rng)
    rows, cols = scan.shape

    def change(p, noise):
        from scipy.ndimage import map_coordinates

        y, x = np.indices((rows, cols)).astype(float)
        dx, dy = x - (cols - 1) / 2, y - (rows - 1) / 2
        far = 1.0 + k * (dx**2 + dy**2) / (cols / 2) ** 2
        places = [(rows - 1) / 2 + dy * far, (cols - 1) / 2 + dx * far]
        return np.stack(
            [map_coordinates(one, places, order=1, mode="nearest") for one in p]
        )

    return replace(scan, change=change)


WRONG: dict[
    str, tuple[Callable[[Drawn, np.random.Generator], Drawn], tuple[str, ...]]
] = {
    "offset": (
        _geometry(lambda s, g: _moved(s.true, _sign(g) * g.uniform(1, 4))),
        ("axis",),
    ),
    "half pixel": (
        _geometry(lambda s, g: _moved(s.true, _sign(g) * 0.5)),
        ("axis",),
    ),
    "roll": (
        _geometry(lambda s, g: _again(s, g, tilts=(_sign(g) * g.uniform(1, 3), 0, 0))),
        ("roll",),
    ),
    "pitch": (
        _geometry(lambda s, g: _again(s, g, tilts=(0, _sign(g) * 5, 0))),
        ("pitch",),
    ),
    "yaw": (_geometry(lambda s, g: _again(s, g, tilts=(0, 0, _sign(g) * 5))), ("yaw",)),
    "sod": (
        _geometry(lambda s, g: _again(s, g, sod=lambda d: d * (1 + _sign(g) * 0.02))),
        ("distance",),
    ),
    "sdd": (
        _geometry(lambda s, g: _again(s, g, sdd=lambda d: d * (1 + _sign(g) * 0.02))),
        ("distance",),
    ),
    "pixel": (
        _geometry(lambda s, g: _again(s, g, pixel=lambda d: d * 1.05)),
        ("distance",),
    ),
    "angle scale": (
        _geometry(lambda s, g: _again(s, g, angles=lambda a: a[0] + 0.97 * (a - a[0]))),
        ("turn", "span"),
    ),
    "half turn": (
        _geometry(lambda s, g: _again(s, g, angles=lambda a: a[0] + 0.55 * (a - a[0]))),
        ("turn", "span"),
    ),
    "direction": (
        _geometry(lambda s, g: _again(s, g, angles=lambda a: 2 * a[0] - a)),
        ("direction", "columns"),
    ),
    "columns": (_images(lambda p, g: p[:, :, ::-1]), ("direction", "columns")),
    "drift": (
        _true(lambda s, g: _moved(s.true, np.linspace(0, _sign(g) * 3, _n(s)))),
        ("axis",),
    ),
    "swing": (
        _true(lambda s, g: _moved(s.true, 3 * np.sin(np.linspace(0, 18, _n(s))))),
        ("axis",),
    ),
    "step": (_true(lambda s, g: _moved(s.true, _step(s, g))), ("axis",)),
    "slip": (
        _true(lambda s, g: _moved(s.true, 0.0, _step(s, g))),
        ("slip",),
    ),
    "tremble": (
        _true(lambda s, g: _moved(s.true, g.uniform(-3, 3, _n(s)))),
        ("axis", "images"),
    ),
    "lost": (_lost, ("lost",)),
    "doubled": (_order(_doubled), ("lost",)),
    "foreign": (_images(_foreign), ("images",)),
    "interlaced": (_order(lambda n, g: np.r_[0:n:2, 1:n:2]), ("interlaced",)),
    "names": (
        _order(lambda n, g: np.array(sorted(range(n), key=str))),
        ("names",),
    ),
    "swapped": (
        _order(
            lambda n, g: np.r_[: n // 3, n // 3 + 6 : n // 3 - 1 : -1, n // 3 + 7 : n]
        ),
        ("lost", "images"),
    ),
    "gain step": (
        _images(
            lambda p, g: (
                p + np.where(np.arange(len(p)) < len(p) // 2, 0, 0.05)[:, None, None]
            )
        ),
        ("gain", "drift"),
    ),
    "gain": (
        _images(lambda p, g: p + 0.05 * g.standard_normal(len(p))[:, None, None]),
        ("gain", "drift"),
    ),
    "weight": (
        _images(
            lambda p, g: p * (1 + 0.1 * (np.arange(len(p)) > len(p) // 2))[:, None, None]
        ),
        ("gain",),
    ),
    "haze": (_images(_haze), ("haze",)),
    "dark": (
        _images(lambda p, g: -np.log(np.maximum(np.exp(-p) - 0.02, 1e-4) / 0.98)),
        ("haze",),
    ),
    "hard": (lambda s, g: replace(s, hard=True), ("hardening", "haze")),
    "clipped": (_images(lambda p, g: np.minimum(p, 0.6 * p.max())), ("clipped",)),
    "lens": (_lens, ("lens",)),
    "log twice": (
        _images(lambda p, g: -np.log(np.maximum(p, 1e-2))),
        ("images", "beyond"),
    ),
    "ghost": (
        _images(lambda p, g: 0.9 * p + 0.1 * np.roll(p, 1, axis=0)),
        ("images",),
    ),
    "scatter": (_images(_scattered), ("haze",)),
}
assert {cause for _, causes in WRONG.values() for cause in causes} <= {*CAUSES, *KINDS}


def wrong(kind: str, seed: int, number: int) -> Drawn:
    """Draw a scan of a whole turn, whose images or geometry are wrong."""
    rng = np.random.default_rng([seed, number, sorted(WRONG).index(kind)])
    things = [one for one in OBJECTS if one not in ("round", "tall")]
    scan = right(seed, 1000 + number, "whole", str(rng.choice(things)))
    make, causes = WRONG[kind]
    made = make(scan, rng)
    return replace(made, said=f"{kind}: {scan.said}", causes=causes)


@dataclass
class Judged:
    """What came of a scan; figures are relative errors."""

    said: str
    text: str
    claimed: float = np.nan
    off: float = np.nan
    told: bool = False
    named: bool = False
    taken: bool = False
    noise: float = np.nan
    within: float = np.nan
    seconds: float = 0.0
    words: int = 0

    @property
    def true(self) -> bool:
        return self.off <= self.claimed


def judged(scan: Drawn, algorithm: str = "fdk") -> Judged:
    """Reconstruct, and compare what is claimed with what is true."""
    options = dict(ALGORITHMS[algorithm], progress=False)
    make = getattr(fx, algorithm, None) or getattr(reconstruction, algorithm)
    rows = scan.shape[0]
    source, panel, u, _ = np.split(scan.stated, 4, 1)
    sod = np.hypot(*source[0, :2])
    sdd = sod + abs(panel[0, 0] * source[0, 0] + panel[0, 1] * source[0, 1]) / sod
    voxel = float(np.linalg.norm(u[0])) * sod / sdd
    high = max(np.abs(body.centre[2]) + body.half[2] for body in scan.bodies)
    layers = int(min(2 * high, rows * voxel) / voxel) + 4
    side = int(21.0 / voxel) + 3
    images = scan.images()
    begun = time.process_time()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            grid = fx.Grid((layers, side, side), voxel)
            volume = make(images, scan.stated, grid, errors=True, **options)
        except fx.TwinError as error:
            return Judged(scan.said, f"refused: {error}", told=True)
        accuracy = volume.accuracy
        bound = volume.bias_bound
        first, second, *_ = [*named(volume), "", ""]
        spent = time.process_time() - begun
        noise = np.nan
        if scan.counts:
            clean = replace(scan, counts=0.0).images()
            noisy, sigma = volume.data, volume.sigma
            volume = make(clean, scan.stated, volume, errors=False, **options)
            if sigma is not None:
                inside = scan.truth(places_of(volume)) > 0.0
                moved = np.abs(noisy - volume.data) <= 2.0 * sigma
                noise = float(moved[inside & np.isfinite(noisy)].mean())
    said = [str(one.message) for one in caught]
    whole = "None" if accuracy is None else accuracy.details
    text = "; ".join([whole, *said])
    words = len(str(accuracy).split())
    told = "contradict each other" in text or "fit better if" in text
    out = Judged(scan.said, text, told=told, seconds=spent, noise=noise, words=words)
    out.named = bool({first, second} & {*scan.causes})
    if accuracy is not None:
        out.taken = bool({*accuracy.taken} & {*map(condition, scan.causes)})
    if accuracy is not None and not accuracy.cut_off:
        out.claimed = accuracy.most
    errors, bounds = regions(scan, volume, bound)
    if len(errors):
        beyond = np.abs(errors)
        out.off = float(np.sort(beyond)[int(np.ceil(0.9 * len(beyond))) - 1])
        if bound is not None:
            out.within = float((beyond <= bounds).mean())
    return out


def named(volume: fx.Volume) -> list[str]:
    """Identifiers of what is told to be wrong, the first first."""
    bias = getattr(volume, "_bias", None)
    contradiction = None if bias is None else bias.bias.contradiction
    if isinstance(contradiction, Clipped):
        return ["clipped"]
    if contradiction is not None:
        return list(contradiction.kinds)
    accuracy = volume.accuracy
    return [] if accuracy is None else [accuracy.cause, accuracy.next]


def condition(cause: str) -> str:
    """What an accuracy takes as stated where it leaves a cause open."""
    if cause in KINDS:
        return "rotation" if cause in SIDES else "order"
    return ONE_ENERGY if cause == "hardening" else STATED.get(cause, cause)


def places_of(volume):
    """Middles of voxels, (nz, ny, nx, 3) of x, y, z."""
    z, y, x = np.meshgrid(*volume.centers()[::-1], indexing="ij")
    return np.stack([x, y, z], -1)


def regions(scan, volume, bound):
    """Relative errors of balls' means, and their bounds."""
    rng = np.random.default_rng([scan.seed, 5])
    data, voxel = volume.data, volume.voxel_xyz[0]
    axes = volume.centers()
    ball = np.stack(np.meshgrid(*[np.arange(-2, 3)] * 3, indexing="ij"), -1).reshape(
        -1, 3
    )
    ball = ball[np.linalg.norm(ball, axis=1) <= BALL]
    shell = rng.standard_normal((120, 3))
    shell *= SPARE * voxel / np.linalg.norm(shell, axis=1, keepdims=True)
    main = max(abs(body.mu) for body in scan.bodies[:1])
    at = np.stack([rng.integers(2, n - 2, 6000) for n in data.shape[::-1]], -1)
    places = np.stack([axes[k][at[:, k]] for k in range(3)], -1)
    middle = scan.truth(places)
    chosen = np.flatnonzero(middle > 0.3 * main)
    found = []
    for k in chosen:
        around = np.concatenate([places[k] + shell, places[k] + 0.5 * shell])
        if (
            np.ptp(scan.truth(around)) > 1e-12
            or abs(scan.truth(around[:1])[0] - middle[k]) > 1e-12
        ):
            continue
        kx, ky, kz = (at[k] + ball).T
        values = data[kz, ky, kx]
        if np.isnan(values).any():
            continue
        most = 0.0 if bound is None else float(bound[kz, ky, kx].mean())
        if np.isnan(most):  # nothing is claimed where some view does not see
            continue
        found.append([float(values.mean()) / middle[k] - 1.0, most / middle[k]])
        if len(found) == REGIONS:
            break
    return np.array(found).reshape(-1, 2).T


def share(part: int, whole: int) -> str:
    return f"{part} of {whole} ({100.0 * part / max(whole, 1):.0f} %)"


def main() -> int:
    """Draw, judge and count."""
    sys.stdout.reconfigure(line_buffering=True)
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--right", type=int, default=40, help="right scans")
    parser.add_argument("--wrong", type=int, default=1, help="wrong scans of each kind")
    parser.add_argument(
        "--kinds", default="", help="of wrong scans, with commas; all without"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--algorithm", choices=ALGORITHMS, default="fdk", help="that makes the volumes"
    )
    parser.add_argument("--every", action="store_true", help="print all scans")
    chosen = parser.parse_args()
    made = []
    for k in range(chosen.right):
        size = 1.0 if chosen.algorithm == "fdk" else SMALLER
        made.append(judged(right(chosen.seed, k, size=size), chosen.algorithm))
        one = made[-1]
        bad = (
            one.told
            or not np.isfinite(one.claimed)
            or (np.isfinite(one.off) and not one.true)
        )
        if bad or chosen.every:
            print(f"  - {one.said}\n      off {one.off:.2%}: {one.text[:230]}")
    claims = [one for one in made if np.isfinite(one.claimed)]
    tested = [one for one in claims if np.isfinite(one.off)]
    print("right scans")
    print("  a claim:", share(len(claims), len(made)))
    print("  claims true:", share(sum(one.true for one in tested), len(tested)))
    print("  told of a contradiction:", share(sum(one.told for one in made), len(made)))
    ratios = [one.claimed / max(one.off, 1e-4) for one in tested]
    print(f"  claimed over true, median: {np.median(ratios) if ratios else np.nan:.1f}")
    within = [one.within for one in made if np.isfinite(one.within)]
    print(f"  regions within bias_bound: {np.mean(within) if within else np.nan:.1%}")
    noise = [one.noise for one in made if np.isfinite(one.noise)]
    print(f"  voxels within 2 sigma of noise: {np.mean(noise) if noise else np.nan:.1%}")
    print(f"  CPU s a scan: {np.mean([one.seconds for one in made]) if made else 0:.2f}")
    print(f"  longest sentence: {max((one.words for one in made), default=0)} words")
    kinds = [one for one in chosen.kinds.split(",") if one] or list(WRONG)
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for kind in kinds:
        for k in range(chosen.wrong):
            one = judged(wrong(kind, chosen.seed, k), chosen.algorithm)
            false = np.isfinite(one.claimed) and np.isfinite(one.off) and not one.true
            false = false and not one.named
            counts[kind].update(
                n=1,
                false=int(false and not one.taken),
                taken=int(false and one.taken),
                named=int(one.named),
            )
            if chosen.every or not one.named or false:
                print(
                    f"  - {one.said}\n      off {one.off:.2%} "
                    f"{'named' if one.named else ''}: {one.text[:260]}"
                )
    total = sum(counts.values(), Counter())
    if total:
        print(
            "wrong scans\n  no false claim:",
            share(total["n"] - total["false"], total["n"]),
        )
        print("  claims true by a condition alone:", share(total["taken"], total["n"]))
        print("  cause named:", share(total["named"], total["n"]))
        print(
            "  of kinds: "
            + "; ".join(f"{kind} {c['named']}/{c['n']}" for kind, c in counts.items())
        )
    few = tested and sum(one.true for one in tested) < 0.88 * len(tested)
    return int(bool(few) or sum(one.told for one in made) > 0.01 * len(made))


if __name__ == "__main__":
    sys.exit(main())
