"""Images of drawn objects beside closed forms: rays a pixel, models, and other programs.

    python tests/studies/pixel_area_table.py --count 60 [--astra DIR]

Each object is a soft sphere, cylinder, box or cone with one to three dense ones in it; every other
one stands upright. The wanted image is the mean over each pixel of closed-form chords
(`area_integrals`, which shares no code with flexdt). Errors are root mean squares over the image,
in per cent of its largest value; processor time is of one view, the second call. Solids are
projected as they are (rays 1, 2, 3, auto), and as voxels as large as the pixel, or half of it, that
hold the mean of 4 x 4 x 4 samples: exact lengths, the model "linear", and RTK's Joseph. ASTRA's
line kernel (2D) has the middle row of cylinders. Afterwards: the image of single voxels, and the
cost of 3 x 3 rays.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from area_integrals import Drawn, area_means, drawn_objects
from drawn_bodies import parts_of

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import Volume, back, forward, pixel_areas
from flexdt.twin.rays_a_pixel import Rays

MOST_IN_RTK = 24
"""Volumes of one voxel size that RTK is given."""
SIDE = 64
SCAN = ConeVec.circular(sod=600, sdd=1059, angles=[0.55], shape=(SIDE, SIDE), pixel=0.8)
PIXEL = 0.8 * 600 / 1059
"""Edge of a pixel at the axis [mm]."""


def timed(work: Callable[[], Any]) -> tuple[Any, float]:
    """Result and processor seconds of a second call."""
    work()
    begun = time.process_time()
    out = work()
    return out, time.process_time() - begun


def sampled(bodies: list[Drawn], edge: float, points: int = 4) -> Volume:
    """Voxels that hold the mean of points^3 samples, (z, y, x)."""
    n = 2 * int(np.ceil(14.0 / edge))
    fine = (np.arange(n * points) + 0.5) / points - n / 2
    data = np.zeros((n, n, n), np.float32)
    for one in bodies:
        for k in range(n):
            z = fine[k * points : (k + 1) * points] * edge
            if np.abs(z - one.center[2]).min() > np.linalg.norm(one.size):
                continue
            at = np.stack(
                np.meshgrid(z, fine * edge, fine * edge, indexing="ij")[::-1], -1
            )
            p = (at - one.center) @ one.axes.T
            a, b, c = one.size
            x, y, w = p[..., 0], p[..., 1], p[..., 2]
            if one.kind == "sphere":
                inside = x * x + y * y + w * w < a * a
            elif one.kind == "box":
                inside = (np.abs(x) < a) & (np.abs(y) < b) & (np.abs(w) < c)
            elif one.kind == "cylinder":
                inside = (x * x + y * y < a * a) & (np.abs(w) < c)
            else:
                inside = (np.abs(w) < c) & (x * x + y * y < (a * (c - w) / (2 * c)) ** 2)
            share = inside.reshape(points, n, points, n, points).mean((0, 2, 4))
            data[k] += (one.mu * share).astype(np.float32)
    return Volume(data, edge)


def josephs(volumes: list[Volume]) -> Any:
    """Prepare RTK's Joseph projector for each of some volumes, for a process of its own: its
    images (m, rows, cols), and one more whose first row has the processor ms of each."""
    from flexdt_extensions.bench.rtk_peer import joseph

    ready = [
        joseph(v.data, v.voxel_xyz, v.center_mm, SCAN.rows, (SIDE, SIDE)) for v in volumes
    ]
    times = np.zeros((1, SIDE, SIDE), np.float32)

    def run() -> None:
        """Project each once."""
        for i, (project, _) in enumerate(ready):
            begun = time.process_time()
            project()
            times[0].reshape(-1)[i] = 1e3 * (time.process_time() - begun)

    return run, lambda: np.concatenate([*(images() for _, images in ready), times])


def beside_rtk(
    volumes: list[Volume], wanted: list[Any]
) -> tuple[list[float], list[float]]:
    """Errors [% of the largest] and processor ms a view of RTK's images."""
    from flexdt_extensions.bench.rtk_peer import Rtk

    peer = Rtk(josephs, volumes)
    peer.run()
    peer.run()
    *images, times = peer.images()
    peer.close()
    return (
        [_error(i[None], w) for i, w in zip(images, wanted, strict=True)],
        times.reshape(-1)[: len(volumes)].tolist(),
    )


def astra_row(volume: Volume, folder: str) -> Any:
    """The middle row's images by ASTRA's line kernel, (n, cols), through the middle slices."""
    sys.path.append(folder)
    import astra

    n = volume.shape[0]
    half = 0.5 * n * volume.voxel_xyz[0]
    slices = 0.5 * (volume.data[n // 2 - 1] + volume.data[n // 2])
    space = astra.create_vol_geom(n, n, -half, half, -half, half)
    vectors = [[*r[0:2], *r[3:5], *r[6:8]] for r in SCAN.rows.tolist()]
    fan = astra.create_proj_geom("fanflat_vec", SIDE, np.array(vectors))
    projector = astra.create_projector("line_fanflat", fan, space)
    _, found = astra.create_sino(np.ascontiguousarray(slices[::-1]), projector)
    return found


def _error(images: Any, wanted: Any) -> float:
    """Root mean square error, in per cent of the largest value."""
    return float(100 * np.sqrt(((images - wanted) ** 2).mean()) / wanted.max())


def studied(
    seed: int, astra: str | None
) -> tuple[dict[str, tuple[float, float]], dict[str, Volume], Any]:
    """Errors [% of the largest] and processor ms a view of one object, its volumes, and the
    wanted images."""
    bodies = drawn_objects(seed)
    parts = parts_of(bodies)
    wanted = np.array([area_means(bodies, row, (SIDE, SIDE)) for row in SCAN.rows])

    found: dict[str, tuple[float, float]] = {}
    volumes: dict[str, Volume] = {}
    choices: list[Rays] = [1, 2, 3, "auto"]
    for rays in choices:
        images, seconds = timed(
            lambda rays=rays: pixel_areas.area_means(parts, SCAN, (SIDE, SIDE), rays)
        )
        found[f"solids, rays={rays}"] = _error(images, wanted), 1e3 * seconds / len(SCAN)
    for name, edge in (("1 pixel", PIXEL), ("1/2 pixel", PIXEL / 2)):
        volume = sampled(bodies, edge, 4 if edge == PIXEL else 2)
        _ = volume.layout
        ways: dict[str, dict[str, Any]] = {
            "exact": {},
            "exact, rays=3": {"rays": 3},
            "exact, rays=auto": {"rays": "auto"},
            "linear": {"model": "linear"},
        }
        for way, given in ways.items():
            images, seconds = timed(
                lambda volume=volume, given=given: forward(volume, SCAN, **given)
            )
            found[f"voxels of {name}, {way}"] = (
                _error(images, wanted),
                1e3 * seconds / len(SCAN),
            )
        volumes[name] = volume
        if astra is not None and bodies[0].kind == "cylinder" and seed % 2:
            row = 0.5 * (wanted[:, SIDE // 2 - 1] + wanted[:, SIDE // 2])
            line = astra_row(volume, astra)
            linear = forward(volume, SCAN, model="linear")
            ours = 0.5 * (linear[:, SIDE // 2 - 1] + linear[:, SIDE // 2])
            found[f"voxels of {name}, middle row: ASTRA's line"] = _error(line, row), 0.0
            found[f"voxels of {name}, middle row: linear"] = _error(ours, row), 0.0
    return found, volumes, wanted


def single_voxels(count: int) -> dict[str, list[float]]:
    """Sums of the images of single voxels over their mass: mean, least, largest."""
    rng = np.random.default_rng(79)
    out = {}
    for ratio in (4.0, 2.0, 1.0, 0.5, 0.25):
        for way, given in (("exact", {}), ("linear", {"model": "linear"})):
            sums = []
            for _ in range(count):
                edge = 0.2 * ratio
                data = np.zeros((3, 3, 3), np.float32)
                data[1, 1, 1] = 1.0
                place = rng.uniform(-1, 1, 3)
                one = ConeVec.circular(
                    sod=300,
                    sdd=600,
                    angles=[rng.uniform(0, 6)],
                    shape=(31, 31),
                    pixel=0.4,
                )
                volume = Volume(data, edge, tuple(place.tolist()))
                normal = np.cross(one.u[0], one.v[0]) / 0.16
                away = abs(float((place - one.source[0]) @ normal))
                slant = float(np.linalg.norm(place - one.source[0])) / away
                mass = edge**3 * (600 / away) ** 2 / 0.16 * slant
                sums.append(float(forward(volume, one, **given).sum()) / mass)  # type: ignore[arg-type]
            out[f"voxel of {ratio:g} pixels, {way}"] = [
                round(float(x), 4) for x in (np.mean(sums), min(sums), max(sums))
            ]
    return out


def costs() -> dict[str, float]:
    """Processor time of 3 x 3 rays over that of one, and of adjoints over their forward."""
    scan = ConeVec.circular(sod=600, sdd=1059, angles=8, shape=(760, 956), pixel=0.1496)
    scan = scan[1:3]
    shape = (760, 956)
    rng = np.random.default_rng(1)
    volume = Volume(rng.random((498, 240, 160), dtype=np.float32), 0.1)
    _ = volume.layout
    out = {}

    def best(work: Callable[[], Any]) -> float:
        return min(timed(work)[1] for _ in range(5))

    one = best(lambda: forward(volume, scan))
    out["voxels (C1)"] = best(lambda: forward(volume, scan, rays=3)) / one
    out["voxels (C1), 2 x 2"] = best(lambda: forward(volume, scan, rays=2)) / one
    out["linear over exact (C1)"] = (
        best(lambda: forward(volume, scan, model="linear")) / one
    )
    ones = np.ones((2, *shape), np.float32)
    adjoint = best(lambda: back(ones, scan, volume, model="linear"))
    out["adjoint over forward, linear (C1)"] = adjoint / (
        out["linear over exact (C1)"] * one
    )
    for seed in (0, 1, 2, 3):
        parts = parts_of(
            [
                Drawn(b.kind, tuple(2 * s for s in b.size), b.axes, 2 * b.center, b.mu)  # type: ignore[arg-type]
                for b in drawn_objects(seed)
            ]
        )
        one = best(lambda: pixel_areas.area_means(parts, scan, shape, 1))  # noqa: B023
        several = best(lambda: pixel_areas.area_means(parts, scan, shape, 3))  # noqa: B023
        out[f"drawn object {seed}"] = several / one
    return {name: round(value, 2) for name, value in out.items()}


def main() -> None:
    """Print the table, and what is promised of it; exit 1 where a promise does not hold."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--count", type=int, default=60)
    options.add_argument(
        "--first", type=int, default=0, help="number of the first object"
    )
    options.add_argument("--table", action="store_true", help="the objects alone")
    options.add_argument("--astra", help="folder with ASTRA, where it is not installed")
    options.add_argument("--json", action="store_true")
    asked = options.parse_args()
    rows: dict[str, list[tuple[float, float]]] = {}
    kept: dict[str, list[Volume]] = {}
    images = []
    for seed in range(asked.first, asked.first + asked.count):
        found, volumes, wanted = studied(seed, asked.astra)
        images.append(wanted)
        for name, values in found.items():
            rows.setdefault(name, []).append(values)
        for name, volume in volumes.items():
            if len(kept.setdefault(name, [])) < MOST_IN_RTK:
                kept[name].append(volume)
    for name, some in kept.items():
        try:
            both = beside_rtk(some, images[: len(some)])
        except (ImportError, RuntimeError) as reason:
            print(f"no RTK: {reason}", file=sys.stderr)
        else:
            rows[f"voxels of {name}, RTK's Joseph"] = list(zip(*both, strict=True))
    table = {}
    for name, values in rows.items():
        errors, times = np.array(values).T
        table[name] = {
            "rms": round(float(np.sqrt((errors**2).mean())), 3),
            "p90": round(float(np.percentile(errors, 90)), 3),
            "worst": round(float(errors.max()), 3),
            "ms": round(float(np.median(times)), 1),
            "objects": len(errors),
        }
    voxels = {} if asked.table else single_voxels(200)
    ratios = {} if asked.table else costs()
    if asked.json:
        print(json.dumps({"table": table, "voxels": voxels, "costs": ratios}, indent=1))
    else:
        print(f"{'':48s} rms %   p90 % worst %  ms a view  objects")
        for name, row in table.items():
            print(
                f"{name:48s} {row['rms']:6.3f} {row['p90']:6.3f} {row['worst']:6.3f} "
                f"{row['ms']:9.1f} {row['objects']:6d}"
            )
        for name, three in voxels.items():
            print(f"{name:48s} mean {three[0]:.4f}, {three[1]:.3f} to {three[2]:.3f}")
        for name, ratio in ratios.items():
            print(f"cost of 3 x 3 rays or of a model, {name}: {ratio:.2f}")
    held = table["solids, rays=auto"]["worst"] <= 0.3 and all(
        0.98 <= three[0] <= 1.02 for name, three in voxels.items() if "linear" in name
    )
    sys.exit(0 if held else 1)


if __name__ == "__main__":
    main()
