"""Sharpness that a volume states, beside the truth: drawn scans, sound and spoilt.

    python tests/studies/sharpness_table.py --count 60 --seed 1

A turned box with a bore is projected, six rays a pixel, and spoilt: blurred by the spot or by
rotation, with the axis moved, turned too far, frames lost or moved, noisy, or of few views.
The truth: the box's own faces, along which the voxels of a volume without noise
are sorted by their distance (slanted edge, 10 to 90 %), the distance of doubled edges as drawn,
and rings of the spectrum that noise leaves, beside the volume without noise. What
`accuracy.edges_mm` claims is true where half of the tiles of the sides' faces are no wider.
Prints a line a scan, and the ratios by kind. Exits with 1 where a sound scan is said to be
doubled, or half of those with a moved axis are not; widths are printed.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from bias_bound import Solid
from scipy.ndimage import gaussian_filter

import flexdt as fx

ROWS, COLS, FIELD_MM = 64, 104, 20.0
KINDS = (
    "clean", "noise", "spot", "rotation", "axis", "scale", "lost", "slip", "few",
)  # fmt: skip
DOUBLED = ("axis", "scale", "slip", "lost")


@dataclass(frozen=True)
class Case:
    """A drawn scan.

    Attributes:
        kind: of `KINDS`.
        figure: how much, in words.
        images: with noise; clean: without.
        geometry: as stated.
        box: the solid whose faces are known.
        apart_mm: of doubled edges, where it is known.
    """

    kind: str
    figure: str
    images: np.ndarray
    clean: np.ndarray
    geometry: fx.ConeVec
    box: Solid
    apart_mm: float
    voxel_mm: float


def projected(solids: list[Solid], scan: fx.ConeVec) -> np.ndarray:
    """Line integrals, means of 3 x 2 rays a pixel, (n, ROWS, COLS)."""
    c = (np.arange(3 * COLS) - (3 * COLS - 1) / 2) / 3
    r = (np.arange(2 * ROWS) - (2 * ROWS - 1) / 2) / 2
    out = np.empty((len(scan), ROWS, COLS), np.float32)
    for view, row in enumerate(scan.rows):
        source, panel, u, v = row.reshape(4, 3)
        ray = panel + c[None, :, None] * u + r[:, None, None] * v - source
        ray /= np.linalg.norm(ray, axis=2, keepdims=True)
        fine = sum(solid.mu * solid.chords(source, ray) for solid in solids)
        out[view] = np.reshape(fine, (ROWS, 2, COLS, 3)).mean(axis=(1, 3))
    return out


def drawn(seed: int, number: int) -> Case:
    """Draw a scan; the kinds take turns."""
    rng = np.random.default_rng([seed, number])
    kind = KINDS[number % len(KINDS)]
    sod = FIELD_MM * float(rng.uniform(8.0, 16.0))
    sdd = sod * float(rng.uniform(1.3, 3.0))
    pixel = 2.0 * sdd * np.tan(np.arcsin(FIELD_MM / sod)) / COLS
    views = int(rng.integers(28, 44)) if kind == "few" else int(rng.integers(170, 260))
    angles = float(rng.uniform(0.0, 360.0)) + np.arange(views) * 360.0 / views
    box = Solid(
        "box", rng.uniform(-1.5, 1.5, 3), rng.uniform([8, 6.5, 5.5], [11, 8.5, 7.5]),
        float(rng.uniform(0.1, 0.35)), 0.03,
    )  # fmt: skip
    bore = Solid(
        "cylinder", box.centre + [2.0, 1.0, 0.0], np.array([2.5, 2.5, 30.0]), 0.0, -0.02
    )

    def scan_of(angles: np.ndarray, aside: float = 0.0) -> fx.ConeVec:
        return fx.ConeVec.circular(
            sod=sod, sdd=sdd, angles=angles, shape=(ROWS, COLS), pixel=pixel,
            offset=(aside, 0.0),
        )  # fmt: skip

    stated = scan_of(angles)
    true, figure, apart = stated, "", 0.0
    voxel = pixel * sod / sdd
    if kind == "axis":
        off = float(rng.uniform(0.35, 1.2))
        true, figure, apart = (
            scan_of(angles, off * pixel),
            f"{off:.2f} px",
            2 * off * voxel,
        )
    if kind == "scale":
        part = float(rng.uniform(0.96, 0.985))
        true, figure = scan_of(angles[0] + part * (angles - angles[0])), f"{part:.3f}"
    if kind == "lost":
        at, count = int(rng.integers(views // 4, 3 * views // 4)), int(rng.integers(3, 8))
        kept = np.delete(angles, np.arange(at, at + count))
        true, stated = scan_of(kept), scan_of(angles[: len(kept)])
        figure = f"{count} frames"
    images = projected([box, bore], true)
    if kind == "spot":
        blur = float(rng.uniform(0.7, 2.2))
        images = gaussian_filter(images, (0.0, blur, blur))
        figure = f"{blur:.2f} px"
    if kind == "rotation":
        step = 360.0 / views
        turns = [
            projected([box, bore], scan_of(angles + part * step * 2.0))
            for part in (-0.375, -0.125, 0.125, 0.375)
        ]
        images = np.mean(turns, axis=0, dtype=np.float32)
        figure = f"{2.0 * step:.1f} deg"
    if kind == "slip":
        by, at = int(rng.integers(1, 3)), int(rng.integers(views // 3, 2 * views // 3))
        images[at:] = np.roll(images[at:], by, axis=2)
        figure = f"{by} px"
    clean = images
    counts = 10.0 ** float(
        rng.uniform(3.0, 4.3) if kind == "noise" else rng.uniform(4.3, 5.5)
    )
    light = np.maximum(rng.poisson(counts * np.exp(-clean.astype(float))), 0.5)
    noisy = -np.log(light / counts).astype(np.float32)
    if kind == "noise":
        figure = f"{counts:.0f} photons"
    return Case(kind, figure, noisy, clean, stated, box, apart, voxel)


def true_width(volume: fx.Volume, box: Solid, axis: int, share: float = 25.0) -> float:
    """Width from 10 to 90 % of the box's two faces across a local axis, in tiles of the
    faces: that of the sharpest `share` of 100 [mm].
    """
    z, y, x = np.meshgrid(*volume.centers()[::-1], indexing="ij")
    local = box.local(np.stack([x, y, z], -1)) * box.half
    voxel = volume.voxel_xyz[0]
    first, second = (k for k in (0, 1, 2) if k != axis)
    tile = 6.0 * voxel
    widths = []
    for side in (-1.0, 1.0):
        away = side * local[..., axis] - box.half[axis]
        near = np.abs(away) < 7.0 * voxel
        for other in (first, second):
            near &= np.abs(local[..., other]) < box.half[other] - 6.0 * voxel
        if axis == 2:  # beside the bore
            near &= np.hypot(local[..., 0] - 2.0, local[..., 1] - 1.0) > 2.5 + 6.0 * voxel
        places = np.floor(local[near][:, [first, second]] / tile).astype(int)
        for one in np.unique(places, axis=0):
            here = (places == one).all(axis=1)
            width = width_of(away[near][here] / voxel, volume.data[near][here])
            if width is not None:
                widths.append(width * voxel)
    return float(np.percentile(widths, share))


def width_of(away: np.ndarray, values: np.ndarray) -> float | None:
    """Distance [voxels] between 90 and 10 % of an edge, from values at distances outwards;
    None of too few.
    """
    if len(away) < 250:
        return None
    bins = np.arange(-6.6, 6.61, 0.3)
    which = np.digitize(away, bins)
    place = 0.5 * (bins[1:] + bins[:-1])
    mean = np.array([
        values[which == k].mean() if (which == k).any() else np.nan
        for k in range(1, len(bins))
    ])  # fmt: skip
    known = np.isfinite(mean)
    mean, place = mean[known], place[known]
    high, low = mean[place < -4.5].mean(), mean[place > 4.5].mean()
    share = (mean - low) / (high - low)
    ends = []
    for level in (0.9, 0.1):
        past = np.flatnonzero(share < level)
        if not len(past) or not past[0]:
            return None
        k = int(past[0])
        part = (share[k - 1] - level) / (share[k - 1] - share[k])
        ends.append(place[k - 1] + part * (place[k] - place[k - 1]))
    return float(ends[1] - ends[0])


def true_detail(noisy: fx.Volume, clean: fx.Volume) -> float:
    """Where rings of the middle plane's spectrum correlate with those without noise by
    less than 0.541, which is half a bit of the halves [mm].
    """
    plane = noisy.shape[1] // 2
    window = np.hanning(noisy.shape[0])[:, None] * np.hanning(noisy.shape[2])
    a, b = (
        np.fft.fft2((one.data[:, plane] - one.data[:, plane].mean()) * window)
        for one in (noisy, clean)
    )
    voxel = noisy.voxel_xyz[0]
    k = np.hypot(
        np.fft.fftfreq(noisy.shape[0], voxel)[:, None],
        np.fft.fftfreq(noisy.shape[2], voxel),
    )
    width = 2.0 / (noisy.shape[0] * voxel)
    last = 0.5 / voxel
    for low in np.arange(2.0 * width, last, width):
        ring = (k >= low) & (k < low + width)
        like = (a[ring] * b[ring].conj()).real.sum() / np.sqrt(
            (np.abs(a[ring]) ** 2).sum() * (np.abs(b[ring]) ** 2).sum()
        )
        if like < 0.541:
            return float(1.0 / low)
    return 2.0 * voxel


def main() -> None:
    """Print the table, and end with 1 where it is not as promised."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    ratios: dict[str, list[float]] = defaultdict(list)
    told: dict[str, list[bool]] = defaultdict(list)
    wrong, within = [], []
    for number in range(options.count):
        case = drawn(options.seed, number)
        cells = int(2 * 14.0 / case.voxel_mm)
        grid = fx.Grid((int(2 * 10.5 / case.voxel_mm), cells, cells), case.voxel_mm)
        clean = fx.fdk(case.clean, case.geometry, grid, errors=False, progress=False)
        volume = fx.fdk(case.images, case.geometry, grid, progress=False)
        found = volume.sharpness
        truth = np.mean([true_width(clean, case.box, axis) for axis in (0, 1)])
        along = true_width(clean, case.box, 2)
        detail = true_detail(volume, clean)
        told[case.kind].append(found.doubled)
        parts = []
        accuracy = volume.accuracy
        if accuracy is not None and accuracy.edges_mm is not None:
            true = max(true_width(clean, case.box, axis, 50.0) for axis in (0, 1))
            ratios[f"{case.kind} edges"].append(accuracy.edges_mm / true)
            within.append(accuracy.edges_mm >= true)
            why = accuracy.edges_cause or "as measured"
            parts.append(f"edges {accuracy.edges_mm:.3f} ({why}) of {true:.3f}")
        for name, width, true in (
            ("across", found.across, truth),
            ("along", found.along, along),
        ):
            if width is None:
                parts.append(f"{name} - of {true:.3f}")
                continue
            ratios[f"{case.kind} {name}"].append(width.mm / true)
            wrong.append(abs(width.mm / true - 1.0) > 0.2)
            parts.append(f"{name} {width.mm:.3f} ({width.error_mm:.3f}) of {true:.3f}")
        if found.detail_mm is not None and case.kind in ("clean", "noise", "spot"):
            ratios[f"{case.kind} detail"].append(found.detail_mm / detail)
            parts.append(f"detail {found.detail_mm:.3f} of {detail:.3f}")
        if found.doubled_mm is not None:
            parts.append(
                f"apart {found.doubled_mm:.3f} ({found.doubled_error_mm:.3f}) of "
                f"{case.apart_mm:.3f}, {'doubled' if found.doubled else '-'}"
            )
        print(f"{number} {case.kind} {case.figure}: voxel {case.voxel_mm:.3f}; "
              + "; ".join(parts), flush=True)  # fmt: skip
    for name, values in ratios.items():
        print(
            f"{name}: {np.min(values):.2f} {np.median(values):.2f} {np.max(values):.2f}"
        )
    for kind, said in told.items():
        print(f"{kind}: {sum(said)} of {len(said)} doubled")
    sound = sum(sum(said) for kind, said in told.items() if kind not in DOUBLED)
    print(f"widths more than a fifth off: {sum(wrong)} of {len(wrong)}")
    print(f"edges within what is claimed: {sum(within)} of {len(within)}")
    if sound or np.mean(told["axis"] or [1.0]) < 0.5:
        sys.exit(1)


if __name__ == "__main__":
    main()
