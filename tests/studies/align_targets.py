"""`flexdt align` on scans of known geometry: errors, sigmas and refusals beside the
targets.

    python tests/studies/align_targets.py [--views 180] [--binning 2] [--geometries 10]
    [--json] python tests/studies/align_targets.py --spoilt
    python tests/studies/align_targets.py --jitter 1
    python tests/studies/align_targets.py --edge

`--jitter` shifts every frame at random and prints the rest of the shifts after
`align(per_frame=True)`. `--edge` reconstructs a ball (FDK) with the data set's geometry, the
aligned and the true one, and prints the width of its edge (10 to 90 %).

Objects are sums of ellipsoids and boxes, whose line integrals are closed forms, written out
here with kinematics of their own: nothing is shared with the tested code. Geometries are drawn
by a seed. Errors are in pixels of the binned panel; the table also gives them in those of the
default mode (956 x 760 of 0.1496 mm).
"""

from __future__ import annotations

import argparse
import json
import math
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numba
import numpy as np
from scipy.optimize import curve_fit
from scipy.special import ndtr

import flexdt as fx

SOD, SDD, PIXEL = 600.0, 1059.0, 0.1496


@dataclass(frozen=True)
class Hidden:
    """A scanner as it is: axis and panel in the frame of the source, y along the beam, z up.

    Attributes:
        views: over the turn.
        shape: (rows, cols).
        pixel: [mm].
        axis_x: the axis beside the beam [mm].
        panel: (x, z) of the panel's centre [mm].
        tilts: roll about the beam, pitch about x, yaw about the vertical, right-handed about
            the directions that conventions.md names [deg].
        span: of the turn [deg].
        drift: of the source in x over the scan [mm].
        jitter: (views, 2) columns and rows by which frames show the object aside; None: not.
        sod, sdd: distances of axis and panel from the source [mm].
    """

    views: int
    shape: tuple[int, int]
    pixel: float
    axis_x: float = 0.0
    panel: tuple[float, float] = (0.0, 0.0)
    tilts: tuple[float, float, float] = (0.0, 0.0, 0.0)
    span: float = 360.0
    drift: float = 0.0
    jitter: np.ndarray | None = None
    sod: float = SOD
    sdd: float = SDD

    def degrees(self) -> np.ndarray:
        """Of the stage in every view, (views,)."""
        return np.arange(self.views) * self.span / self.views

    def nominal(self) -> fx.ConeVec:
        """Return the geometry that the data set states: centred and not tilted."""
        return fx.ConeVec.circular(
            sod=self.sod,
            sdd=self.sdd,
            angles=self.degrees(),
            shape=self.shape,
            pixel=self.pixel,
        )

    def steps(self) -> tuple[np.ndarray, np.ndarray]:
        """Compute the panel's pixel steps u and v, (3,) each [mm], with its roll, pitch
        and yaw.
        """
        roll, pitch, yaw = (math.radians(t) for t in self.tilts)
        u = np.array([math.cos(roll), 0.0, -math.sin(roll)])
        v = np.array([-math.sin(roll), 0.0, -math.cos(roll)])
        c, s = math.cos(pitch), math.sin(pitch)
        lean = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
        c, s = math.cos(-yaw), math.sin(-yaw)
        swing = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return swing @ lean @ u * self.pixel, swing @ lean @ v * self.pixel

    def placed(self, k: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Compute source, panel's centre, u and v of a view, (3,) each, as the object
        sees them [mm].

        Args:
            k: number of the view, or a place between two; with jitter the view's own
                counts.
        """
        part = k / self.views
        phi = math.radians(part * self.span)
        c, s = math.cos(phi), math.sin(phi)
        # The object turns clockwise seen from above; seen from it, everything else the other
        # way.
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        pivot = np.array([self.axis_x, self.sod, 0.0])
        source = turn @ (np.array([self.drift * (part - 0.5), 0.0, 0.0]) - pivot)
        centre = turn @ (np.array([self.panel[0], self.sdd, self.panel[1]]) - pivot)
        u, v = self.steps()
        u, v = turn @ u, turn @ v
        if self.jitter is not None:
            centre = centre - self.jitter[int(k), 0] * u - self.jitter[int(k), 1] * v
        return source, centre, u, v

    def axis_in_image(self) -> tuple[float, float]:
        """Compute the column where the axis crosses the middle row [px], and the axis's
        angle [deg]; its upper end leans to the right for positive angles.
        """
        u, v = self.steps()
        centre = np.array([self.panel[0], self.sdd, self.panel[1]])
        seen = []
        for z in (-10.0, 10.0):
            ray = np.array([self.axis_x, self.sod, z])
            seen.append(np.linalg.solve(np.column_stack([u, v, -ray]), -centre)[:2])
        (c0, r0), (c1, r1) = seen
        column = c0 - r0 * (c1 - c0) / (r1 - r0)
        return column + (self.shape[1] - 1) / 2, math.degrees(
            math.atan2(c1 - c0, r0 - r1)
        )

    def source_row(self) -> float:
        """Compute the row of the level ray from the source to the axis [px]."""
        u, v = self.steps()
        centre = np.array([self.panel[0], self.sdd, self.panel[1]])
        ray = np.array([self.axis_x, self.sod, 0.0])
        seen = np.linalg.solve(np.column_stack([u, v, -ray]), -centre)
        return float(seen[1] + (self.shape[0] - 1) / 2)


def drawn(rng: np.random.Generator, plain: Hidden) -> Hidden:
    """Draw axis, panel and tilts of a scanner about those of a plain one; the rest is the
    plain one's.
    """
    wide = plain.pixel * plain.shape[1] / 956
    return replace(
        plain,
        axis_x=float(rng.uniform(-12, 12)) * plain.pixel * SOD / SDD,
        panel=(float(rng.uniform(-3, 3)) * wide, float(rng.uniform(-30, 30)) * wide),
        tilts=(
            float(rng.uniform(-1, 1)),
            float(rng.normal(0, 0.4)),
            float(rng.normal(0, 0.2)),
        ),
    )


@dataclass(frozen=True)
class Solids:
    """Ellipsoids and boxes: centre, half axes and attenuation [1/mm], (k, 7) each."""

    ellipsoids: np.ndarray
    boxes: np.ndarray


def lego(rng: np.random.Generator) -> Solids:
    """Draw a hollow brick beside the axis, with studs, and nine beads."""
    shift = rng.uniform(-4, 4, 2)
    boxes = [[0, 0, 0, 16, 8, 10, 0.02], [0, 0, -1, 14.5, 6.5, 9, -0.02]]
    boxes += [[x, y, 11, 2.4, 2.4, 1, 0.02] for x in (-12, -4, 4, 12) for y in (-4, 4)]
    beads = [
        [*(rng.uniform(-1, 1, 3) * (15, 7, 9)), *(3 * [rng.uniform(0.5, 0.8)]), 0.4]
        for _ in range(9)
    ]
    out = Solids(np.array(beads), np.array(boxes, dtype=float))
    out.ellipsoids[:, :2] += shift
    out.boxes[:, :2] += shift
    return out


def porous(rng: np.random.Generator) -> Solids:
    """Draw an ellipsoid beside the axis, with 80 pores in it."""
    body = [[*rng.uniform(-3, 3, 2), 0, *rng.uniform(15, 20, 2), 22, 0.03]]
    for _ in range(80):
        direction = rng.normal(size=3)
        place = direction / np.linalg.norm(direction) * rng.uniform(0, 0.8) ** (1 / 3)
        body.append([*(np.array(body[0][:3]) + place * body[0][3:6]),
                     *(3 * [rng.uniform(0.8, 2.2)]), -0.03])  # fmt: skip
    return Solids(np.array(body), np.zeros((0, 7)))


def smooth(rng: np.random.Generator) -> Solids:
    """Draw five bodies whose density falls off smoothly, as 12 shells each."""
    out = []
    for _ in range(5):
        centre, half = rng.uniform(-9, 9, 3), rng.uniform(7, 12, 3)
        out += [
            [*centre, *(half * math.sqrt((k + 0.5) / 12)), 0.02 / 12] for k in range(12)
        ]
    return Solids(np.array(out), np.zeros((0, 7)))


def truncated(rng: np.random.Generator) -> Solids:
    """Draw a porous body that is wider and higher than the field of view, at 0.4 of the
    attenuation of `porous`.
    """
    inside = porous(rng)
    wide = inside.ellipsoids.copy()
    wide[:, :3] *= 2.9
    wide[:, 3:6] *= np.where(np.arange(len(wide))[:, None] == 0, 2.9, 1.6)
    wide[:, 6] *= 0.4
    return Solids(wide, inside.boxes)


OBJECTS: Final[Mapping[str, Callable[[np.random.Generator], Solids]]] = {
    "lego": lego, "porous": porous, "smooth": smooth, "truncated": truncated,
}  # fmt: skip


@numba.njit(cache=True, fastmath=True)
def _window(solid, source, centre, u, v, shape):  # type: ignore[no-untyped-def]
    """Find the first row and column of the pixels that may see the solid's bounding box,
    and those after the last.

    Returns:
        Top, bottom, left, right; all of the image where a corner is not ahead of the
        source.
    """
    normal, to = np.cross(u, v), centre - source
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for corner in range(8):
        sign = np.array([corner & 1, corner >> 1 & 1, corner >> 2 & 1]) * 2.0 - 1.0
        way = solid[:3] + sign * solid[3:6] - source
        ahead = np.dot(way, normal) / np.dot(to, normal)
        if ahead <= 1e-6:
            return 0, shape[0], 0, shape[1]
        at = way / ahead - to
        place = np.array([np.dot(at, v) / np.dot(v, v), np.dot(at, u) / np.dot(u, u)])
        low, high = np.minimum(low, place), np.maximum(high, place)
    size = np.array([shape[0], shape[1]])
    first = np.minimum(np.maximum(np.floor(low + (size - 1) / 2), 0), size)
    last = np.minimum(np.maximum(np.ceil(high + (size - 1) / 2) + 1, 0), size)
    return int(first[0]), int(last[0]), int(first[1]), int(last[1])


@numba.njit(cache=True, fastmath=True)
def add_chords(source, centre, u, v, solids, round_, out):  # type: ignore[no-untyped-def]
    """Add the line integrals of solids to an image, in place.

    Args:
        source, centre: of the view (3,) [mm].
        u, v: pixel steps (3,) [mm].
        solids: (k, 7) centre, half axes [mm] and attenuation [1/mm].
        round_: ellipsoids; else boxes.
        out: (rows, cols).
    """
    rows, cols = out.shape
    for k in range(len(solids)):
        e = solids[k]
        top, bottom, left, right = _window(e, source, centre, u, v, out.shape)
        start = (source - e[:3]) / e[3:6]
        for r in range(top, bottom):
            for c in range(left, right):
                i, j = c - (cols - 1) / 2, r - (rows - 1) / 2
                dx = centre[0] + i * u[0] + j * v[0] - source[0]
                dy = centre[1] + i * u[1] + j * v[1] - source[1]
                dz = centre[2] + i * u[2] + j * v[2] - source[2]
                length = math.sqrt(dx * dx + dy * dy + dz * dz)
                wx, wy, wz = dx / e[3], dy / e[4], dz / e[5]
                if round_:
                    a = wx * wx + wy * wy + wz * wz
                    b = wx * start[0] + wy * start[1] + wz * start[2]
                    root = b * b - a * (start @ start - 1.0)
                    if root > 0.0:
                        out[r, c] += e[6] * 2.0 * math.sqrt(root) / a * length
                    continue
                low, high = 0.0, 1.0
                for w, s in ((wx, start[0]), (wy, start[1]), (wz, start[2])):
                    if abs(w) < 1e-12:
                        if abs(s) > 1.0:
                            high = -1.0
                        continue
                    t0, t1 = (-1.0 - s) / w, (1.0 - s) / w
                    low, high = max(low, min(t0, t1)), min(high, max(t0, t1))
                if high > low:
                    out[r, c] += e[6] * (high - low) * length


def project(hidden: Hidden, solids: Solids, rays: int = 3) -> np.ndarray:
    """Compute line integrals (views, rows, cols), the mean over `rays` x `rays` of each
    pixel.
    """
    rows, cols = hidden.shape
    out = np.empty((hidden.views, rows, cols), dtype=np.float32)
    for k in range(hidden.views):
        source, centre, u, v = hidden.placed(k)
        fine = np.zeros((rays * rows, rays * cols))
        add_chords(source, centre, u / rays, v / rays, solids.ellipsoids, True, fine)
        add_chords(source, centre, u / rays, v / rays, solids.boxes, False, fine)
        out[k] = fine.reshape(rows, rays, cols, rays).mean(axis=(1, 3))
    return out


def measured(
    lines: np.ndarray, hidden: Hidden, photons: float, rng: np.random.Generator,
    keep: np.ndarray | None = None, ramp: float = 0.0,
) -> fx.DataSet:  # fmt: skip
    """Make a data set of counts with Poisson noise, the mean of 20 flat images, and dark
    images of 0.

    A count is a photon, or 60 counts where there are at most 1000 photons; counts end at
    65535. Warnings are suppressed.

    Args:
        lines: line integrals (n, rows, cols).
        hidden: the scanner; the data set states its nominal geometry.
        photons: of the open beam, a pixel and frame.
        rng: for the noise.
        keep: which frames the data set has, in which order; default: all.
        ramp: relative change of the flat images from the left end to the right one.
    """
    gain = 1.0 if photons > 1000 else 60.0
    flat = (
        np.stack([rng.poisson(photons, hidden.shape) for _ in range(20)]).mean(axis=0)
        * gain
    )
    flat *= 1.0 + ramp * (np.arange(hidden.shape[1]) / (hidden.shape[1] - 1) - 0.5)
    counts = np.minimum(rng.poisson(photons * np.exp(-lines)) * gain, 65535).astype(
        np.uint16
    )
    chosen = np.arange(len(lines)) if keep is None else keep
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return fx.DataSet.from_arrays(
            counts[chosen],
            hidden.nominal()[chosen],
            dark=np.zeros(hidden.shape),
            flat=flat,
        )


def errors(found: Any, hidden: Hidden) -> dict[str, tuple[float, float]]:
    """Compare an alignment with the truth: (found less true, sigma) of "column" [px],
    "roll" (the axis's angle [deg]) and, if they were found, "yaw" [deg] and "row" [px].
    """
    column, angle = hidden.axis_in_image()
    p = found.parameters
    out = {
        "column": (p["axis_column_px"]["value"] - column, p["axis_column_px"]["sigma"])
    }
    out["roll"] = (_angle(found) - angle, p["det_roll"]["sigma"])
    if "det_yaw" in p:
        aside = math.degrees(math.atan(hidden.panel[0] / SDD))
        out["yaw"] = (
            p["det_yaw"]["value"] - hidden.tilts[2] + aside,
            p["det_yaw"]["sigma"],
        )
    if "source_row_px" in p:
        row = p["source_row_px"]
        out["row"] = (row["value"] - hidden.source_row(), row["sigma"])
    return out


def _angle(found: Any) -> float:
    """Return the angle of the axis in the image by the corrected geometry [deg]."""
    cone = found.dataset.with_correction(found.correction).geometry
    (c0, r0), (c1, r1) = cone.project_points([[0, 0, -10], [0, 0, 10]])[0]
    return math.degrees(math.atan2(c1 - c0, r0 - r1))


def left_of(
    true: np.ndarray, motion: Any, hidden: Hidden, degrees: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the shifts that a motion leaves, less those that all frames share or that
    turn once with the stage.

    Args:
        true: (n, 2) shifts [px].
        motion: found.
        hidden: the scanner.
        degrees: (n,) of the stage.

    Returns:
        The rest and its sigmas, both (n, 2) as columns and rows [px].
    """
    to_px = hidden.sdd / hidden.sod / hidden.pixel
    angle = np.radians(degrees)
    modes = np.column_stack([np.ones(len(angle)), np.cos(angle), np.sin(angle)])
    left = motion.values * [to_px, -to_px] - true
    return left - modes @ np.linalg.lstsq(modes, left, rcond=None)[
        0
    ], motion.sigma * to_px


def shifted(
    name: str, plain: Hidden, size: float, photons: float, seed: tuple[int, ...]
) -> str:
    """Align one scan with shifts of `size` pixels (0.1496 mm, rms) in every frame, and
    describe in words how much is left.

    Args:
        name: of the object.
        plain: the scanner without offsets.
        size: of the shifts [px].
        photons: of the open beam.
        seed: of all draws.

    Returns:
        One line; the reason if no motion was found.
    """
    rng = np.random.default_rng([*seed, sorted(OBJECTS).index(name)])
    hidden, solids = drawn(rng, plain), OBJECTS[name](rng)
    factor = hidden.pixel / PIXEL
    true = rng.normal(0, size / factor, (hidden.views, 2))
    data = measured(project(replace(hidden, jitter=true), solids), hidden, photons, rng)
    begun = time.perf_counter()
    found = data.align(per_frame=True)
    took = time.perf_counter() - begun
    motion, row = found.alignment.motion, errors(found, hidden).get("row")
    if motion is None:
        return str(found.document["refused"].get("motion", found.document["refused"]))
    left, sigma = left_of(true, motion, hidden, hidden.degrees())
    sigma = np.nan_to_num(sigma).mean(axis=0)
    cells = [f"{name} {photons:g}", "left"]
    cells += [f"{a * factor:.3f}" for a in left.std(axis=0)]
    cells += ["+-", *(f"{a * factor:.3f}" for a in sigma)]
    cells += [
        "row",
        "-" if row is None else f"{row[0] * factor:.2f} +- {row[1] * factor:.2f}",
    ]
    cells += [f"{took:.1f} s"]
    return "  ".join(cells)


RADIUS: Final = 14.0
"""Of the ball whose edge is looked at [mm]."""


def edges(plain: Hidden, rng: np.random.Generator) -> list[float]:
    """Reconstruct a ball with nominal, aligned and true geometry, and measure the width
    of its edge in each.

    Args:
        plain: the scanner without offsets, which are drawn.
        rng: of offsets and noise.

    Returns:
        Widths from 10 to 90 % [voxels], in this order.
    """
    hidden = drawn(rng, plain)
    ball = Solids(np.array([[2.0, -1.0, 0.0, *3 * [RADIUS], 0.02]]), np.zeros((0, 7)))
    data = measured(project(hidden, ball), hidden, 10_000.0, rng)
    aligned = data.with_correction(data.align().correction)
    true = fx.ConeVec(
        np.array([np.concatenate(hidden.placed(k)) for k in range(hidden.views)])
    )
    voxel = hidden.pixel * SOD / SDD
    across = int(2.4 * RADIUS / voxel)
    like = fx.Grid((3, across, across), voxel).blank()
    at = (np.arange(across) - (across - 1) / 2) * voxel
    away = (np.hypot(at - 2.0, at[:, None] + 1.0) - RADIUS) / voxel
    near = np.abs(away) < 20
    widths = []
    for geometry in (data.geometry, aligned.geometry, true):
        image = fx.fdk(data.line_integrals(), geometry, like, errors=False).data[1]
        found, _ = curve_fit(
            lambda at, low, high, sigma, shift: low + (high - low) * ndtr((shift - at) / sigma),
            away[near], image[near], p0=(0.0, 0.02, 2.0, 0.0),
        )  # fmt: skip
        widths.append(float(2.563 * abs(found[2])))  # 10 to 90 %
    return widths


SPOILT: Final = ("clean", "flat ramp 1 %", "flat ramp 3 %", "frame repeated", "3 frames missing",
                 "one in twelve missing", "first again at 360 deg", "200 deg", "350 deg",
                 "drift 0.5 px", "slip 1 px")  # fmt: skip


def spoilt(
    kind: str, hidden: Hidden, solids: Solids, rng: np.random.Generator
) -> tuple[np.ndarray, Hidden, np.ndarray, float]:
    """Project solids with something wrong in the scan, of SPOILT.

    Args:
        kind: of the fault.
        hidden: the scanner.
        solids: the object.
        rng: chooses frames.

    Returns:
        Line integrals, the scanner with the fault, indices of the frames that the data
        set has, and the flat images' `ramp`, see `measured`.
    """
    n = hidden.views
    span = {"200 deg": 200.0, "350 deg": 350.0}.get(kind, 360.0)
    drift = 0.5 * hidden.pixel * SOD / (SDD - SOD) if kind.startswith("drift") else 0.0
    hidden = replace(hidden, span=span, drift=drift)
    ramp = 0.01 * float(kind.split()[2]) if kind.startswith("flat") else 0.0
    lines, keep = project(hidden, solids), np.arange(n)
    if kind == "frame repeated":
        keep[n // 3 + 1 :] -= 1
        lines = lines[keep]
        keep = np.arange(n)
    elif kind == "slip 1 px":  # and it stays there
        lines[n // 3 :] = np.roll(lines[n // 3 :], 1, axis=2)
    elif kind == "3 frames missing":
        keep = np.setdiff1d(keep, n // 4 + np.arange(3))
    elif kind == "one in twelve missing":
        keep = np.setdiff1d(keep, rng.choice(n, n // 12, replace=False))
    elif kind == "first again at 360 deg":
        hidden = replace(hidden, views=n + 1, span=360.0 * (n + 1) / n)
        lines, keep = np.concatenate([lines, lines[:1]]), np.arange(n + 1)
    return lines, hidden, keep, ramp


def main() -> None:
    """Align drawn scans and print a line of errors and pulls for each object, kind and
    number of photons, or those that the options choose.
    """
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--views", type=int, default=180)
    parser.add_argument("--binning", type=int, default=2)
    parser.add_argument("--geometries", type=int, default=10)
    parser.add_argument("--objects", default=",".join(OBJECTS))
    parser.add_argument("--photons", default="10000,100")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--spoilt", action="store_true", help="data sets with something wrong"
    )
    parser.add_argument(
        "--jitter", type=float, help="rms shift of every frame [px of 0.1496 mm]"
    )
    parser.add_argument(
        "--edge", action="store_true", help="edges of a reconstructed ball"
    )
    parser.add_argument(
        "--json", action="store_true", help="one line for each scan instead"
    )
    o = parser.parse_args()
    shape = (760 // o.binning, 956 // o.binning)
    plain = Hidden(o.views, shape, PIXEL * o.binning)
    if o.edge:
        print(
            "width of a ball's edge, voxels: as the data set says, aligned, as it really was"
        )
        for k in range(o.geometries):
            widths = edges(plain, np.random.default_rng([o.seed, k]))
            print("  ".join(f"{w:6.1f}" for w in widths), flush=True)
        return
    if o.jitter is not None:
        print(
            f"shifts of {o.jitter:g} px in every frame, rms: left in columns and rows, px"
        )
        for name in o.objects.split(","):
            for photons in map(float, o.photons.split(",")):
                for k in range(o.geometries):
                    print(
                        shifted(name, plain, o.jitter, photons, (o.seed, k)), flush=True
                    )
        return
    if not o.json:
        print(
            f"{o.views} views of {shape[0]} x {shape[1]} px; errors in px of 0.1496 mm and deg"
        )
        print(
            f"{'scan':40s}  told  column rms  max  roll rms  max  yaw rms  row rms  max  rows"
            "  pulls c/r/y/row  >4 sigma  s"
        )
    for name in o.objects.split(","):
        for kind in SPOILT if o.spoilt else ("",):
            runs = {float(p): [] for p in o.photons.split(",")}
            for k in range(o.geometries):
                rng = np.random.default_rng([o.seed, k, sorted(OBJECTS).index(name)])
                hidden, solids = drawn(rng, plain), OBJECTS[name](rng)
                lines, hidden, keep, ramp = spoilt(kind, hidden, solids, rng)
                for photons, limit_messages in runs.items():
                    data = measured(lines, hidden, photons, rng, keep, ramp)
                    begun = time.perf_counter()
                    found = data.align()
                    took = time.perf_counter() - begun
                    told = errors(found, hidden) if found.identifiable else {}
                    limit_messages.append((told, took))
                    if o.json:
                        why = (
                            None if told else found.document["refused"]["axis_column_px"]
                        )
                        line = {"object": name, "kind": kind, "photons": photons, "geometry": k,
                                "errors": told, "refused": why, "warnings": found.warnings,
                                "seconds": round(took, 2)}  # fmt: skip
                        print(json.dumps(line), flush=True)
            for photons, limit_messages in runs.items():
                if not o.json:
                    print(
                        _line(f"{name} {photons:g} {kind}", limit_messages, o.binning),
                        flush=True,
                    )


def _line(
    label: str, runs: list[tuple[dict[str, tuple[float, float]], float]], factor: int
) -> str:
    """Format the runs of one kind: aligned of all, rms and largest error of each
    parameter, pulls, values beyond four sigmas, mean time [s].

    Args:
        label: of the line.
        runs: (errors by parameter, seconds) of each; empty errors where nothing was
            found.
        factor: binning, to state pixels of 0.1496 mm.
    """
    told = [r for r, _ in runs if r]
    cells = [f"{label:40s}  {len(told)}/{len(runs)}"]
    pulls, wild = [], 0
    for name, unit in (("column", factor), ("roll", 1), ("yaw", 1), ("row", factor)):
        values = np.array([r[name] for r in told if name in r]).reshape(-1, 2)
        if len(values) == 0:
            cells.append("-")
            pulls.append("-")
            continue
        rms, most = math.sqrt(np.mean(values[:, 0] ** 2)), np.abs(values[:, 0]).max()
        cells.append(
            f"{rms * unit:.4f}" + ("" if name == "yaw" else f" {most * unit:.4f}")
        )
        if name == "row":
            cells[-1] += f" {len(values)}"
        pull = values[:, 0] / values[:, 1]
        wild += int((np.abs(pull) > 4).sum())
        pulls.append(f"{math.sqrt(np.mean(pull**2)):.2f}")
    return "  ".join(
        [*cells, "/".join(pulls), str(wild), f"{np.mean([s for _, s in runs]):.1f}"]
    )


if __name__ == "__main__":
    main()
