"""Drawn geometries on a CUDA device or in its simulator, compared with double precision.

    python tests/studies/gpu_geometries.py --count 2000 --seed 1            # numba's simulator
    python tests/studies/gpu_geometries.py --count 400 --device --most 60   # the device
    python tests/studies/gpu_geometries.py --first 500 --count 500 --seed 1  # the next 500

Forward and adjoint of each; every array has cells around the volume that no kernel may touch:
NaN where it is read, 0 where it is added to. Ends with status 1 where an error exceeds
MOST_ERROR or a cell outside was touched, 3 where --device finds no device.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

MOST_ERROR = 3e-6
"""Of the maximum of an image, or of the volume that the adjoint gives."""
KINDS = (
    "diagonal", "level", "rolled", "turned", "source inside", "pixels inside", "one row",
    "one column", "along z", "steep", "far", "upright",
)  # fmt: skip
"""Geometries, drawn in turns; `rolled` panels are turned by 30 to 60 degrees about the beam,
and `diagonal` ones, too, where rays of one warp run along x and along y. Columns of `upright`
panels are parallel to z, either way up."""
AROUND = 64
"""Cells before and behind the volume's, beside as many as it has."""
Floats = npt.NDArray[np.float64]
Draw = np.random.Generator


@dataclass(frozen=True)
class Case:
    """A volume and views of it.

    Attributes:
        kind: of KINDS.
        counts, voxel_mm, center_mm: x, y, z of its grid.
        rows: (n, 12) as of a `ConeVec` [mm].
        shape: of the detector (rows, cols).
        data: (nz, ny, nx).
        values: of the adjoint, (n, rows, cols).
    """

    kind: str
    counts: npt.NDArray[np.int64]
    voxel_mm: Floats
    center_mm: Floats
    rows: Floats
    shape: tuple[int, int]
    data: npt.NDArray[np.float32]
    values: npt.NDArray[np.float32]


@dataclass(frozen=True)
class Found:
    """What was measured of a case.

    Attributes:
        kind: of the case.
        by_slabs: views that the slab walk took.
        forward, adjoint: worst error, of the maximum (of 1 where no ray meets the volume).
        ordered: worst error of the deterministic adjoint, of the maximum (0 if not asked).
        outside: whether a cell outside the volume was touched.
        same: whether the deterministic adjoint gave equal bytes twice (True if not asked).
        seconds: of both kernels with their copies.
    """

    kind: str
    by_slabs: int
    forward: float
    adjoint: float
    ordered: float
    outside: bool
    same: bool
    seconds: float

    @property
    def wrong(self) -> bool:
        """Whether the case is not as promised (NaN is not)."""
        small = self.forward <= MOST_ERROR and self.adjoint <= MOST_ERROR
        return not small or self.outside or not self.same


def drawn(numbers: range, seed: int, most: int) -> Iterator[Case]:
    """Draw cases of all kinds in turns.

    Args:
        numbers: of the cases.
        seed: of the draws; case i is the same in whatever range of numbers.
        most: voxels along an axis.
    """
    for i in numbers:
        yield drawn_case(np.random.default_rng([seed, i]), KINDS[i % len(KINDS)], most)


def drawn_case(draw: Draw, kind: str, most: int) -> Case:
    """Draw a case of a kind: volume, views and images.

    Args:
        draw: draws all.
        kind: see `drawn_view`.
        most: voxels of a side.
    """
    counts = draw.integers(2, most + 1, 3)
    if draw.random() < 0.2:
        counts[draw.integers(3)] = draw.integers(1, 3)
    voxel = 0.4 * np.exp(draw.uniform(-0.7, 0.7, 3))
    radius = float(np.linalg.norm(counts * voxel)) / 2
    center = draw.uniform(-0.2, 0.2, 3) * radius
    shape = (int(draw.integers(2, most + 21)), int(draw.integers(2, most // 2 + 5)))
    if kind == "one row":
        shape = (1, shape[1])
    if kind == "one column":
        shape = (shape[0], 1)
    views = int(draw.integers(1, 4))
    rows = np.array([drawn_view(draw, kind, radius, shape) for _ in range(views)])
    rows[:, 0:3] += center
    rows[:, 3:6] += center
    data = draw.random(counts[::-1], dtype=np.float32)
    data[: counts[2] // 2, counts[1] // 2 :] *= 3
    values = draw.random((views, *shape), dtype=np.float32)
    return Case(kind, counts, voxel, center, rows, shape, data, values)


def drawn_view(draw: Draw, kind: str, radius: float, shape: tuple[int, int]) -> Floats:
    """Draw a row (12,) of a geometry about the origin.

    Args:
        draw: draws all.
        kind: how the view lies; other names give a plain one.
        radius: of a ball that holds the volume [mm].
        shape: rows and columns.
    """
    wide = math.radians(60)
    around, above = draw.uniform(0, 2 * np.pi), draw.uniform(-0.2, 0.2)
    if kind == "diagonal":
        around = np.pi / 4 * (1 + 2 * draw.integers(4)) + draw.uniform(-0.1, 0.1)
    if kind == "along z":
        above = draw.choice([-1, 1]) * (np.pi / 2 - draw.uniform(0, 0.1))
    if kind == "steep":
        above = draw.choice([-1, 1]) * draw.uniform(0.4, 1.5)
    away = radius * draw.uniform(1.1, 8)
    behind = radius * draw.uniform(1.1, 5)
    if kind == "diagonal":
        away, behind = away + 2 * radius, behind + radius
    if kind == "far":
        away *= 100
    if kind == "source inside":
        away = radius * draw.uniform(0, 0.5)
    if kind == "pixels inside":
        behind = radius * draw.uniform(0, 0.5)
    roll, pitch, yaw = draw.uniform(-0.05, 0.05, 3)
    if kind in ("rolled", "diagonal"):
        roll = draw.choice([-1, 1]) * draw.uniform(wide / 2, wide)
    if kind in ("turned", "one row", "one column", "source inside", "pixels inside"):
        roll, pitch, yaw = draw.uniform(-wide, wide, 3) * (1, 0.5, 0.5)
    c, s, up, out = math.cos(around), math.sin(around), math.sin(above), math.cos(above)
    beam = np.array([out * c, out * s, up])
    u, v = np.array([-s, c, 0.0]), np.array([up * c, up * s, -out])
    for axis, angle in ((v, yaw), (u, pitch), (beam, roll)):
        u, v = turned(u, axis, angle), turned(v, axis, angle)
    if kind == "upright":
        u[2], v = 0.0, np.array([0.0, 0.0, draw.choice([-1.0, 1.0])])
    magnified = (away + behind) / max(away, 0.3 * radius)
    spans = 2 * radius * magnified * draw.uniform(0.5, 1.1, 2) / np.array(shape)
    # A pixel about the panel's middle looks at the volume's centre: something is seen.
    aside = (
        np.round(draw.uniform(0.25, 0.75, 2) * (np.array(shape) - 1)) + 0.5
    ) / np.array(shape)
    off = (0.5 - aside) * np.array(shape) + draw.uniform(-0.01, 0.01, 2)
    u, v = spans[1] * u, spans[0] * v
    return np.concatenate([-away * beam, behind * beam + off[1] * u + off[0] * v, u, v])


def turned(vector: Floats, axis: Floats, angle: float) -> Floats:
    """A vector turned about a unit axis (Rodrigues)."""
    c, s = math.cos(angle), math.sin(angle)
    return c * vector + s * np.cross(axis, vector) + (1 - c) * (axis @ vector) * axis


def measure(case: Case, *, twice: bool) -> Found:
    """Run both kernels of a case, and compare.

    Args:
        case: drawn.
        twice: run the deterministic adjoint twice, too.
    """
    from exact_rays import VoxelGrid, line_integrals, ray_ends, spread_back

    from flexdt.twin.geometry.cone_vec import ConeVec
    from flexdt.twin.projection import Volume, gpu
    from flexdt.twin.projection.operators import box_of, layout_data, voxel_rays
    from flexdt.twin.projection.volume import blank_layout

    volume = Volume(case.data, tuple(case.voxel_mm), tuple(case.center_mm))
    layout = blank_layout(volume)
    layout_data(layout)[...] = 1
    used = layout.flat > 0
    layout_data(layout)[...] = case.data
    size = layout.flat.size
    place = slice(size + AROUND, 2 * size + AROUND)
    room = np.full(3 * size + 2 * AROUND, np.nan, np.float32)
    room[place][used] = layout.flat[used]
    box = box_of(layout)._replace(base=layout.base + place.start)
    rays = voxel_rays(ConeVec(case.rows), layout, case.shape)
    begun = time.perf_counter()
    there = gpu.project_there(box, gpu.upload(room), rays, case.shape)
    images = np.asarray(there.copy_to_host(), np.float64)

    def spread(deterministic: bool) -> npt.NDArray[np.float32]:
        sums = gpu.upload(np.zeros_like(room))
        gpu.spread_there(box, sums, rays, case.values, deterministic=deterministic)
        return np.asarray(sums.copy_to_host())

    sums = spread(False)
    seconds = time.perf_counter() - begun
    touched = sums != 0
    touched[place] &= ~used
    grid = VoxelGrid(case.counts, case.voxel_mm, case.center_mm)
    starts, ends = ray_ends(case.rows, case.shape)
    exact = line_integrals(grid, case.data, starts, ends).reshape(images.shape)
    back = spread_back(grid, case.values, starts, ends)

    def error_of(found: npt.NDArray[np.float32]) -> float:
        layout.flat[...] = found[place]
        return float(np.abs(layout_data(layout) - back).max() / (back.max() or 1.0))

    ordered = [spread(True), spread(True)] if twice else []
    return Found(
        case.kind,
        int(gpu.by_slabs(box, rays, case.shape).sum()),
        float(np.abs(images - exact).max() / (exact.max() or 1.0)),
        error_of(sums),
        error_of(ordered[0]) if twice else 0.0,
        bool(touched.any() or np.isnan(images).any() or not used.any()),
        len({one.tobytes() for one in ordered}) <= 1,
        seconds,
    )


def campaign(
    numbers: range,
    seed: int,
    most: int,
    tell: Callable[[str], None],
    *,
    twice: bool,
    budget_s: float = math.inf,
) -> dict[str, object]:
    """Measure drawn cases until all are done or the time is up: {count, worst, kinds, wrong,
    ...}.

    Args:
        numbers, seed, most: see `drawn`.
        tell: told a line for each case that is wrong.
        twice: see `measure`.
        budget_s: seconds after which no case is begun.
    """
    seen: list[Found] = []
    wrong: list[dict[str, object]] = []
    begun = time.monotonic()
    for i, case in zip(numbers, drawn(numbers, seed, most), strict=True):
        if time.monotonic() - begun > budget_s:
            break
        try:
            found = measure(case, twice=twice)
        except Exception as error:
            wrong.append({"case": i, "kind": case.kind, "error": repr(error)})
            tell(f"case {i}: {wrong[-1]}")
            if len(wrong) > 5:
                break
            continue
        seen.append(found)
        if found.wrong:
            wrong.append({"case": i, **asdict(found)})
            tell(f"case {i}: {wrong[-1]}")
    return {
        "count": len(seen) + sum("error" in one for one in wrong),
        "first": numbers.start,
        "asked": len(numbers),
        "seed": seed,
        "most": most,
        "seconds_a_case": (time.monotonic() - begun) / max(1, len(seen)),
        "kernel_seconds_a_case": float(np.mean([f.seconds for f in seen]))
        if seen
        else None,
        "forward_worst": max((f.forward for f in seen), default=None),
        "adjoint_worst": max((f.adjoint for f in seen), default=None),
        "ordered_worst": max((f.ordered for f in seen), default=None),
        "by_kind": {
            kind: {
                "cases": len(some),
                "forward": max(f.forward for f in some),
                "adjoint": max(f.adjoint for f in some),
                "by_slabs": sum(f.by_slabs for f in some),
            }
            for kind in KINDS
            if (some := [f for f in seen if f.kind == kind])
        },
        "outside": sum(f.outside for f in seen),
        "wrong": wrong,
    }


def main() -> int:
    """Measure and print a document."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--most", type=int, default=12, help="voxels along an axis")
    parser.add_argument(
        "--budget-s", type=float, default=math.inf, help="begin no case after"
    )
    parser.add_argument(
        "--device", action="store_true", help="a device, not the simulator"
    )
    parser.add_argument("--out", type=Path, help="write the document here, too")
    options = parser.parse_args()
    if not options.device and os.environ.get("NUMBA_ENABLE_CUDASIM") != "1":
        # Numba reads it when it is imported.
        environment = {**os.environ, "NUMBA_ENABLE_CUDASIM": "1"}
        os.execve(sys.executable, [sys.executable, *sys.argv], environment)
    from flexdt.twin.projection import gpu

    if not options.device:
        from device_simulator import as_on_a_device

        as_on_a_device()
    elif not gpu.availability().present:
        print(f"no device: {gpu.availability().reason}", file=sys.stderr)
        return 3
    document = campaign(
        range(options.first, options.first + options.count),
        options.seed,
        options.most,
        lambda line: print(line, file=sys.stderr),
        twice=options.device,
        budget_s=options.budget_s,
    )
    document["device"] = gpu.availability().reason if options.device else "simulator"
    text = json.dumps(document, indent=1)
    print(text)
    if options.out is not None:
        options.out.write_text(text + "\n", "utf-8")
    return int(bool(document["wrong"]))


if __name__ == "__main__":
    sys.exit(main())
