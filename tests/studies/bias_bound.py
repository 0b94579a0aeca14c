"""Drawn scans: is `volume.bias_bound` a bound, and how tight is it?

    python tests/studies/bias_bound.py --count 200 --seed 1

Solids of known attenuation are projected along rays of this file's own, through drawn
geometries: whole turns, parts of turns, gaps, wedges, views at random or twice; panels in the
middle, aside, far aside, tilted; sources near and far; objects taller and wider than the
panel; noise, and a flat that drifts. Means of small even balls, all over the object, are
compared with the truth. Prints the part within the bound (and three times the noise), the
bound over the error, and how many volumes had a warning. Exits with 1 where more than one
region of fifty is outside.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections import Counter
from dataclasses import dataclass

import numpy as np

import flexdt as fx
from flexdt.twin.projection.volume import WARNING_BOUND
from flexdt.twin.reconstruction import field_of_view

REGIONS = 24
BALL = 2.6
"""Radius of a region [voxels]."""
SPARE = 5.5
"""Distance to any surface [voxels], at least."""


@dataclass(frozen=True)
class Solid:
    """An ellipsoid, an elliptic cylinder or a box, turned about z."""

    kind: str
    centre: np.ndarray
    half: np.ndarray
    turn: float
    mu: float

    def local(self, at: np.ndarray, *, direction: bool = False) -> np.ndarray:
        """Places or directions (..., 3) with the solid's half axes as units."""
        c, s = np.cos(self.turn), np.sin(self.turn)
        moved = at if direction else at - self.centre
        x, y, z = np.moveaxis(moved, -1, 0)
        return np.stack([c * x + s * y, c * y - s * x, z], -1) / self.half

    def inside(self, at: np.ndarray) -> np.ndarray:
        """Whether points (..., 3) are inside."""
        at = self.local(at)
        if self.kind == "ellipsoid":
            return (at**2).sum(axis=-1) < 1.0
        if self.kind == "cylinder":
            return ((at[..., :2] ** 2).sum(axis=-1) < 1.0) & (np.abs(at[..., 2]) < 1.0)
        return (np.abs(at) < 1.0).all(axis=-1)

    def chords(self, source: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Lengths along unit rays (..., 3)."""
        start, along = self.local(source), self.local(rays, direction=True)
        low, high = np.full(rays.shape[:-1], -np.inf), np.full(rays.shape[:-1], np.inf)
        flat = {"ellipsoid": (), "cylinder": (2,), "box": (0, 1, 2)}[self.kind]
        for axis in flat:
            step = np.where(np.abs(along[..., axis]) < 1e-12, 1e-12, along[..., axis])
            ends = np.stack([(-1.0 - start[axis]) / step, (1.0 - start[axis]) / step])
            low, high = (
                np.maximum(low, ends.min(axis=0)),
                np.minimum(high, ends.max(axis=0)),
            )
        round_ = {"ellipsoid": slice(0, 3), "cylinder": slice(0, 2), "box": slice(0, 0)}[
            self.kind
        ]
        if self.kind != "box":
            a = (along[..., round_] ** 2).sum(axis=-1)
            b = (along[..., round_] * start[round_]).sum(axis=-1)
            root = b * b - a * ((start[round_] ** 2).sum() - 1.0)
            half = np.sqrt(np.maximum(root, 0.0)) / a
            low, high = np.maximum(low, -b / a - half), np.minimum(high, -b / a + half)
        return np.maximum(high - low, 0.0)


@dataclass(frozen=True)
class Scan:
    """A drawn one."""

    said: str
    geometry: fx.ConeVec
    shape: tuple[int, int]
    solids: list[Solid]
    counts: float
    drift: float
    seed: int

    def images(self) -> np.ndarray:
        """Line integrals as measured, (n, rows, cols)."""
        rows, cols = self.shape
        c, r = np.arange(cols) - (cols - 1) / 2, np.arange(rows) - (rows - 1) / 2
        out = np.empty((len(self.geometry), rows, cols))
        for view, row in enumerate(self.geometry.rows):
            source, panel, u, v = row.reshape(4, 3)
            ray = panel + c[None, :, None] * u + r[:, None, None] * v - source
            ray /= np.linalg.norm(ray, axis=2, keepdims=True)
            out[view] = sum(solid.mu * solid.chords(source, ray) for solid in self.solids)
        if self.drift:
            out += self.drift * np.linspace(0.0, 1.0, len(out))[:, None, None]
        if self.counts:
            rng = np.random.default_rng(self.seed)
            light = np.maximum(rng.poisson(self.counts * np.exp(-out)), 0.5)
            out = -np.log(light / self.counts)
        return out.astype(np.float32)

    def truth(self, at: np.ndarray) -> np.ndarray:
        """The attenuation [1/mm] at points (..., 3); of solids that overlap the sum."""
        return sum(
            (solid.mu * solid.inside(at) for solid in self.solids),
            np.zeros(at.shape[:-1]),
        )


def drawn(seed: int, number: int) -> Scan:
    """Draw a scan that somebody could make: angles, panel, solids, noise and drift.

    Args:
        seed, number: the same give the same scan.
    """
    rng = np.random.default_rng([seed, number])
    rows, cols = int(rng.integers(32, 73)), int(rng.integers(56, 105))
    field = 20.0  # radius of the field of view of a panel in the middle [mm]
    wide = float(
        np.exp(rng.uniform(np.log(3.5), np.log(15.0)))
    )  # radius of the circle over it
    sod = field * wide
    sdd = sod * float(rng.uniform(1.2, 4.0))
    pixel = 2.0 * sdd * np.tan(np.arcsin(field / sod)) / cols
    fan = 2.0 * np.degrees(np.arcsin(field / sod))
    kind = str(rng.choice(["whole", "turns", "short", "gap", "lost", "wedges", "random", "twice"],
                          p=[0.36, 0.08, 0.16, 0.1, 0.1, 0.06, 0.07, 0.07]))  # fmt: skip
    views = int(rng.integers(int(1.2 * cols), int(2.6 * cols)))
    begin = float(rng.uniform(0.0, 360.0))
    if kind == "turns":
        angles = np.arange(views) * float(rng.uniform(1.2, 3.4)) * 360.0 / views
    elif kind == "short":
        angles = np.linspace(0.0, float(rng.uniform(190.0 + fan, 340.0)), views)
    elif kind in ("gap", "lost"):
        angles = np.arange(views) * 360.0 / views
        if kind == "gap":
            gap = float(rng.uniform(4.0, 0.8 * (180.0 - fan)))
            angles = angles[(angles < 150.0) | (angles > 150.0 + gap)]
        else:
            angles = np.delete(angles, rng.choice(views, views // 12, replace=False))
    elif kind == "wedges":
        arcs = [np.linspace(a, a + 5.0, views // 15) for a in np.arange(0.0, 360.0, 24.0)]
        angles = np.concatenate(arcs)
    elif kind == "random":
        angles = rng.uniform(0.0, 360.0, views)
    else:
        angles = np.arange(views) * 360.0 / views
        angles = np.concatenate([angles, angles]) if kind == "twice" else angles
    panel = str(
        rng.choice(["middle", "aside", "edge", "tilted"], p=[0.6, 0.2, 0.08, 0.12])
    )
    if panel in ("aside", "edge") and kind in ("short", "gap"):
        panel = "middle"
    part = {"aside": rng.uniform(0.1, 0.8), "edge": rng.uniform(0.85, 0.97)}.get(
        panel, 0.0
    )
    aside = float(part * rng.choice([-1.0, 1.0]) * 0.5 * cols * pixel)
    most = 5.0 if panel == "tilted" else 0.0
    tilts = tuple(rng.uniform(-most, most, 3).tolist())
    geometry = fx.ConeVec.circular(
        sod=sod, sdd=sdd, angles=begin + angles, shape=(rows, cols), pixel=pixel,
        offset=(aside, 0.0), tilts=tilts,
    )  # fmt: skip
    far = field * (1.0 + part)
    tall = 0.5 * rows * pixel * sod / sdd
    thing = str(rng.choice(["small", "tall", "cut"], p=[0.5, 0.25, 0.25]))
    size = float(rng.uniform(0.55, 0.92)) * far
    if thing == "cut":
        size = far * float(rng.uniform(1.05, 1.7))
    height = tall * float(rng.uniform(0.4, 0.85)) if thing == "small" else 1.6 * tall
    outer = str(rng.choice(["ellipsoid", "cylinder", "box"], p=[0.3, 0.4, 0.3]))
    ratio = float(rng.uniform(0.7, 1.0))
    half = np.array([size, size * ratio, height])
    if outer == "box":
        half[:2] *= 0.72
    body = Solid(outer, np.zeros(3), half, float(rng.uniform(0.0, 3.0)), 0.6 / size)
    solids = [body]
    room = np.minimum(half, [far, far, tall])
    for _ in range(int(rng.integers(0, 6))):
        at = rng.uniform(-0.6, 0.6, 3) * room
        solids.append(Solid(
            str(rng.choice(["ellipsoid", "cylinder", "box"])), at,
            rng.uniform(0.08, 0.3, 3) * room, float(rng.uniform(0.0, 3.0)),
            float(rng.choice([-1.0, rng.uniform(0.3, 2.0)])) * body.mu,
        ))  # fmt: skip
    counts = float(rng.choice([0.0, 10.0 ** rng.uniform(3.5, 5.5)]))
    drift = float(rng.choice([0.0, rng.uniform(-0.05, 0.05)], p=[0.85, 0.15]))
    said = (f"{kind}, {len(angles)} views, {cols} x {rows}, {panel} {part:.2f}, sod {wide:.1f}, "
            f"{thing} {size / far:.2f} {outer} of {len(solids)}, counts {counts:.3g}, "
            f"drift {drift:+.3f}")  # fmt: skip
    return Scan(said, geometry, (rows, cols), solids, counts, drift, number)


@dataclass(frozen=True)
class Judged:
    """What came of a scan: of each region error, bound and noise of its mean, over the
    truth."""

    errors: np.ndarray
    bounds: np.ndarray
    noise: np.ndarray
    refused: str = ""
    warned: bool = False


def judged(scan: Scan) -> Judged:
    """Reconstruct, and compare."""
    none = np.zeros(0)
    try:
        grid = field_of_view(scan.geometry, scan.shape)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            volume = fx.fdk(scan.images(), scan.geometry, grid)
    except fx.TwinError as error:
        return Judged(none, none, none, str(error))
    data, bound, sigma = volume.data, volume.bias_bound, volume.sigma
    if bound is None:  # a warning says so
        return Judged(none, none, none, "what it may be off by is not known")
    rng = np.random.default_rng(scan.seed)
    axes = volume.centers()
    ball = np.stack(np.meshgrid(*[np.arange(-2, 3)] * 3, indexing="ij"), -1).reshape(
        -1, 3
    )
    ball = ball[np.linalg.norm(ball, axis=1) <= BALL]
    shell = rng.standard_normal((150, 3))
    shell *= SPARE * grid.voxel_mm / np.linalg.norm(shell, axis=1, keepdims=True)
    body, rows = scan.solids[0].mu, []
    for _ in range(60 * REGIONS):
        index = np.array([rng.integers(2, n - 2) for n in data.shape[::-1]])
        at = np.array([places[i] for places, i in zip(axes, index, strict=True)])
        there = scan.truth(np.concatenate([[at], at + shell, at + 0.6 * shell]))
        kx, ky, kz = (index + ball).T
        values, true = data[kz, ky, kx], float(there[0])
        if true < 0.3 * body or np.ptp(there) > 1e-12 or np.isnan(values).any():
            continue
        spread = (
            0.0
            if sigma is None
            else float(np.linalg.norm(sigma[kz, ky, kx])) / len(values)
        )
        most = float(bound[kz, ky, kx].mean())
        rows.append([float(values.mean()) / true - 1.0, most / true, spread / true])
        if len(rows) == REGIONS:
            break
    errors, bounds, noise = np.array(rows).reshape(-1, 3).T
    accuracy = volume.accuracy
    warned = accuracy is not None and (accuracy.cut_off or accuracy.most > WARNING_BOUND)
    return Judged(errors, bounds, noise, warned=warned)


def main() -> int:
    """Draw, judge and count."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="number of the first draw")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--every", action="store_true", help="print all draws")
    chosen = parser.parse_args()
    counts: Counter[str] = Counter()
    all_errors, all_bounds, within = [], [], []
    begun = time.process_time()
    for i in range(chosen.first, chosen.first + chosen.count):
        scan = drawn(chosen.seed, i)
        found = judged(scan)
        if found.refused or not len(found.errors):
            verdict = f"refused: {found.refused}" if found.refused else "no even region"
            counts[verdict.partition(":")[0]] += 1
            if chosen.every:
                print(f"{i}: {verdict}: {scan.said}"[:200], flush=True)
            continue
        excess = np.abs(found.errors) - 3.0 * found.noise
        good = excess <= found.bounds
        within += good.tolist()
        all_errors += np.abs(found.errors).tolist()
        all_bounds += found.bounds.tolist()
        most = float(excess.max())
        verdict = "right within 1 %" if most <= 0.01 else "1 to 5 % off somewhere"
        verdict = "more than 5 % off somewhere" if most > 0.05 else verdict
        verdict += ", warned" if found.warned else ""
        counts[verdict] += 1
        if chosen.every or not good.all():
            k = int(np.argmax(excess - found.bounds))
            numbers = (found.errors[k], found.bounds[k], found.noise[k])
            print(f"{i}: {verdict}, {good.sum()} of {len(good)} within: {scan.said}\n    "
                  + "error {:+.2%}, bound {:.2%}, noise {:.2%}".format(*numbers)
                  + f"; most {excess.max():.2%}", flush=True)  # fmt: skip
    errors, bounds = np.array(all_errors), np.array(all_bounds)
    print(f"{np.mean(within):.2%} of {len(within)} even regions within the bound")
    for least, most in ((0.0, np.inf), (0.0, 0.003), (0.003, 0.01), (0.01, np.inf)):
        some = (errors >= least) & (errors < most)
        if some.any():
            ratio = float(np.median(bounds[some] / np.maximum(errors[some], 1e-6)))
            print(
                f"bound over error, median, {some.sum()} errors {least} to {most}: {ratio:.1f}"
            )
    for verdict, count in counts.most_common():
        print(f"{count:6} {verdict}")
    print(f"{time.process_time() - begun:.0f} CPU s")
    return 1 if np.mean(within) < 0.98 else 0


if __name__ == "__main__":
    sys.exit(main())
