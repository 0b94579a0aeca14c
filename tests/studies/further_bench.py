"""Measurements beyond `flexdt bench`: the adjoint, scenes and meshes, FDK, growth, cold start,
memory, sizes that memory allows, and the way through the projector server.

    python tests/studies/further_bench.py --out out/further [--only FDK growth] [--no-peers]

writes `bench.json`, of the form that `flexdt bench` writes: `docs/tools/bench_page.py` takes
both. `--list` names the cases.

Growth is time against the number of rays, voxels along an edge and threads; the points of a
curve are timed in rotation, so that a disturbance affects all of them alike.

Scenes and meshes are compared with the same integrals in plain NumPy of double precision.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import importlib
import json
import os
import subprocess
import sys
import tempfile
import time
import timeit
import tracemalloc
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from unittest import mock

import numpy as np
from numba import njit, prange

from flexdt.phantoms import load_phantom
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection import (
    Body,
    Volume,
    back,
    cpu,
    forward,
    gpu,
    project_body,
    project_mesh,
    project_scene,
    room_like,
    warm_up,
)
from flexdt.twin.projection.analytic import TriangleMesh
from flexdt.twin.projection.analytic_solids import Box, Scene, Solid, Sphere
from flexdt.twin.projection.cpu import threads
from flexdt.twin.projection.kernels import fan_kernels
from flexdt.twin.projection.kernels.fan_types import Box as VoxelBox
from flexdt.twin.projection.operators import box_of, voxel_rays
from flexdt_extensions.bench import rtk_peer as rtk
from flexdt_extensions.bench.benchmark import (
    BINNED,
    C1_SHAPE,
    FULL,
    NONE,
    TILT_DEG,
    Document,
    Entry,
    circle,
    errors,
    interleaved,
    line_of,
    load,
    machine,
    noise,
    peer_cases,
    plain,
    timed,
    to_stderr,
    untuned_cases,
)
from flexdt_extensions.bench.peers import absent
from flexdt_extensions.bench.scanned_objects import ATTENUATION, KINDS

FIRST = next(iter(KINDS))
"""The object that is seen whole."""
MIDDLE_MM = 10.0
"""Radius about the axis in which a volume's mean is compared with the truth."""
RTK_PADDING = 0.5
"""Extension of rows given to RTK as cut off, over their length."""
ADJOINT = (
    "C1", "C1x36", "C1-tilt", "C2", "C3", "C2-tilt", "C3-tilt", "cone-60", "cone-60-tilt",
    "tilt-45", "roll-90", "roll-90-tilt", "near", "flat", "anisotropic", "on-axis", "C1x1000",
)  # fmt: skip
"""Cases whose adjoint is measured."""
INTO_NEW = ("C1", "C1-tilt")
"""Those of them in which it is measured without memory given to it, too."""


def adjoint_names() -> list[str]:
    """List the names of the cases of `adjoint`."""
    return [f"adjoint-{n}" for n in ADJOINT] + [f"adjoint-{n}-new" for n in INTO_NEW]


def adjoint(wanted: Callable[[str], bool]) -> list[Entry]:
    """Measure `back` beside `forward`, and how exactly they are each other's transpose,
    for each wanted case.

    Both write into memory they are given; in `-new` entries `back` makes new memory.

    Returns:
        Entries with the error of the dot product, relative to that of `forward`, and the
        least time of `back` divided by that of `forward`.
    """
    cases = {case.name: case for case in [*peer_cases(), *untuned_cases()]}
    entries = []
    for name in adjoint_names():
        if not wanted(name):
            continue
        new = name.endswith("-new")
        case = cases[name.removeprefix("adjoint-").removesuffix("-new")]
        volume, views = case.volume(), len(case.geometry)
        y = np.random.default_rng(1).random((views, *case.shape), dtype=np.float32)
        out, room = np.empty_like(y), room_like(volume)

        calls: dict[str, Callable[[], object]] = {
            "flexdt": partial(back, y, case.geometry, volume, None if new else room),
            "forward": partial(forward, volume, case.geometry, case.shape, out),
        }
        what = "back against forward" + (", into new memory" if new else "")
        entry = timed(name, views, calls, what)
        left = float(np.vdot(out.astype(np.float64), y))
        spread = back(y, case.geometry, volume, room).data
        right = float(np.vdot(spread.astype(np.float64), volume.data))
        entry["dot_product_error"] = abs(left - right) / abs(left)
        beside = entry["peers"].pop("forward")
        entry["times_forward"] = entry["ms_per_view"] / beside["ms_per_view"]
        del entry["ratio"]["forward"], entry["median_ratio"]["forward"]
        entries.append(entry)
    return entries


FDK_SHAPE = (380, 478)
FDK_SIZES: Mapping[str, tuple[int, int]] = {
    "FDK": (360, 256),
    "FDK-small": (180, 192),
    "FDK-tiny": (90, 128),
}
"""Name -> views, and voxels along an edge of a grid of 51.2 mm. On two cores at load 8 itk-rtk
takes 67 s for the small one; four kinds of the tiny one end within minutes."""


def fdk_what(size: str) -> str:
    """Describe one of `FDK_SIZES`."""
    views, edge = FDK_SIZES[size]
    return f"{views} views of {FDK_SHAPE[1]} x {FDK_SHAPE[0]} into {edge}^3"


def fdk_scan(size: str = "FDK") -> tuple[ConeVec, Volume]:
    """Make the views and the grid of one of `FDK_SIZES`."""
    views, edge = FDK_SIZES[size]
    grid = Volume(np.zeros((edge,) * 3), 51.2 / edge)
    return circle(views, FDK_SHAPE, pitch=0.3), grid


def fdk_names(size: str) -> list[str]:
    """List the names of the cases of `fdk_entries`; the size alone names the object that is
    entirely in view."""
    return [size if kind == FIRST else f"{size}-{kind}" for kind in KINDS]


def fdk_entries(
    size: str, wanted: Callable[[str], bool], part: frozenset[str]
) -> Iterator[Entry]:
    """Measure FDK of four kinds of images against RTK's, and yield the entries one by
    one: RTK may take minutes for each.

    Processor time and memory are also given as multiples of those of the first kind, the
    object seen whole, if that was measured.

    Args:
        size: key of FDK_SIZES.
        wanted: whether an entry of a name is measured.
        part: peers that take part.
    """
    geometry, grid = fdk_scan(size)
    first = None
    for name, kind in zip(fdk_names(size), KINDS, strict=True):
        if wanted(name):
            images = KINDS[kind](geometry, FDK_SHAPE)
            what = f"{fdk_what(size)}, {kind}; error: of the middle's mean"
            entry = fdk_entry(name, kind, what, images, geometry, grid, part)
            if kind == FIRST:
                first = entry
            if first is not None:
                entry["times_whole"] = entry["cpu_ms"] / first["cpu_ms"]
                entry["memory_times_whole"] = entry["peak_MB"] / first["peak_MB"]
            yield entry


def fdk_entry(
    name: str,
    kind: str,
    what: str,
    images: Float32Array,
    geometry: ConeVec,
    grid: Volume,
    part: frozenset[str],
) -> Entry:
    """Measure FDK of images into a grid, beside RTK's if it takes part.

    Args:
        name: of the entry.
        kind: of KINDS; noise has no error.
        what: description.
        images: (n, rows, cols).
        geometry: n views.
        grid: of the volume.
        part: peers that take part.

    Returns:
        The entry: times, error of the middle's mean, processor time [ms] without errors,
        that with errors divided by it, and largest memory beside the images [MB].
    """
    from flexdt.twin.reconstruction import fdk

    made: dict[str, Volume] = {}

    def ours(*, errors: bool = False) -> None:
        """Reconstruct by flexdt without warnings, and keep the volume."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            made["flexdt"] = fdk(images, geometry, grid, errors=errors)

    calls: dict[str, Callable[[], object]] = {"flexdt": ours}
    other = None
    if "itk-rtk" in part:
        pad = 0.0 if kind == FIRST else RTK_PADDING
        place = grid.shape, grid.voxel_xyz, grid.center_mm
        other = rtk.Rtk(rtk_fdk, images, geometry.rows, *place, pad)
        calls["itk-rtk"] = other.run
    try:
        entry = timed(name, 1, calls, what, frozenset({"itk-rtk"}))
        if kind != "noise":
            entry["mean_error"] = _middle_error(made["flexdt"])
            if other is not None:
                theirs = _middle_error(grid.like(other.images()))
                entry["peers"]["itk-rtk"]["mean_error"] = theirs
    finally:
        if other is not None:
            other.close()
    entry["cpu_ms"] = _spent(ours, time.process_time, rounds=2)[1]
    entry["errors_times"] = _spent(
        partial(ours, errors=True), time.process_time, rounds=2
    )[1]
    entry["errors_times"] /= entry["cpu_ms"]
    entry["peak_MB"] = peak_bytes(ours) / 1e6
    return entry


def peak_bytes(call: Callable[[], object]) -> int:
    """Measure the most bytes that NumPy's arrays and Python's objects take at a time in a
    call.
    """
    tracemalloc.start()
    try:
        call()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def rtk_fdk(
    images: Float32Array,
    rows: FloatArray,
    counts: tuple[int, int, int],
    voxel_mm: tuple[float, float, float],
    center_mm: tuple[float, float, float],
    padding: float = 0.0,
) -> rtk.Work:
    """Prepare RTK's FDK of projections (n, rows, cols) into a grid.

    Args:
        images: line integrals.
        rows: (n, 12) cone_vec.
        counts: voxels (nz, ny, nx).
        voxel_mm: pitch (x, y, z).
        center_mm: of the volume (x, y, z).
        padding: of rows that are cut off, over their length (its correction of
            truncation).

    Returns:
        The call to time, and the function of its volume (z, y, x).
    """
    import itk
    from itk import RTK

    kind = itk.Image[itk.F, 3]
    stack, geometry = rtk.rtk_stack(images, rows), rtk.rtk_geometry(rows)
    grid = rtk.rtk_volume(np.zeros(counts, np.float32), voxel_mm, center_mm)
    made: list[Float32Array] = []

    def run() -> None:
        """Reconstruct with the ramp filter alone, and keep the volume in our axes."""
        reconstruct = RTK.FDKConeBeamReconstructionFilter[kind].New()
        reconstruct.SetInput(0, grid)
        reconstruct.SetInput(1, stack)
        reconstruct.SetGeometry(geometry)
        reconstruct.GetRampFilter().SetTruncationCorrection(padding)
        reconstruct.GetRampFilter().SetHannCutFrequency(0.0)
        reconstruct.Update()
        # Back from (-y, z, x).
        made[:] = [itk.array_from_image(reconstruct.GetOutput())[::-1].transpose(1, 0, 2)]

    return run, lambda: np.ascontiguousarray(made[0])


def _middle_error(volume: Volume) -> float:
    """How far the mean about the axis is from the truth, as a share of it."""
    x, y, _ = volume.centers()
    middle = volume.data[len(volume.data) // 2, np.hypot(x, y[:, None]) < MIDDLE_MM]
    return abs(float(middle.mean()) / ATTENUATION - 1.0)


def cold_start() -> list[Entry]:
    """Measure a new process until its first image, of 8^3 voxels on C1's detector, with
    kernels on disk and with kernels compiled.

    The time is that of the imports and of `forward`.
    """
    code = (
        "import time; t = time.perf_counter(); "
        "from flexdt_extensions.bench.benchmark import BINNED, circle; "
        "from flexdt.twin.projection import Volume, forward; import numpy as np; "
        "v = Volume(np.ones((8, 8, 8), np.float32), 0.1); "
        "forward(v, circle(1, BINNED), BINNED); print(time.perf_counter() - t)"
    )
    entries = []
    for name, what in (
        ("cold-cached", "new process to its first small image, kernels on disk"),
        ("cold-uncached", "the same, `forward` compiled"),
    ):
        with tempfile.TemporaryDirectory() as folder:
            env = {**os.environ, **({"NUMBA_CACHE_DIR": folder} if "un" in name else {})}
            done = subprocess.run(
                [sys.executable, "-c", code],
                env=env,
                capture_output=True,
                text=True,
                check=True,
            )
        ms = float(done.stdout) * 1e3
        entries.append(plain(name, ms, what))
    return entries


def through_server() -> list[Entry]:
    """Measure C1 through a projector server over TCP, beside the same projection in this
    process.
    """
    command = [sys.executable, "-P", "-m", "flexdt.runtime.child"]
    with subprocess.Popen(
        [*command, "flexdt.server.projector.main", "--port", "0"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            assert process.stdout is not None
            ready = json.loads(process.stdout.readline())
            return asyncio.run(_through(ready["host"], ready["port"]))
        finally:
            process.terminate()


async def _through(host: str, port: int) -> list[Entry]:
    """Project C1 fifteen times through the server and directly, in turns.

    Returns:
        One entry: least and median time [ms], the direct one, their difference, and
        whether the bytes are the same.
    """
    from flexdt.server.imaging.projector_client import ProjectorClient
    from flexdt.server.imaging.projector_pool import ProjectorPool

    volume, view = noise(C1_SHAPE), circle(1, BINNED)
    out = np.empty((1, *BINNED), np.float32)
    remote, direct = [], []
    client = ProjectorPool([ProjectorClient(host, port)], patience_s=120.0)
    await client.put("C1", volume)
    await client.project("C1", view, BINNED)
    forward(volume, view, BINNED, out)
    for _ in range(15):
        start = time.perf_counter()
        images = await client.project("C1", view, BINNED)
        remote.append(time.perf_counter() - start)
        start = time.perf_counter()
        forward(volume, view, BINNED, out)
        direct.append(time.perf_counter() - start)
    await client.remove("C1")
    await client.close()
    same = bool(np.array_equal(images, out))
    entry = plain("server-C1", min(remote) * 1e3, "C1 through the projector server")
    entry["median_ms_per_view"] = float(np.median(remote)) * 1e3
    entry["direct_ms"] = min(direct) * 1e3
    entry["added_ms"] = (min(remote) - min(direct)) * 1e3
    entry["same_bytes"] = same
    return [entry]


@njit(parallel=True, nogil=True, cache=True, fastmath=True)
def read_all(data, workers):
    """Sum up an array in `workers` equal parts, in parallel, without the
    remainder of the division; the sum is returned so that no reading is optimised away.
    """
    sums = np.zeros(workers * 16)
    each = data.size // workers
    for w in prange(workers):
        part = data[w * each : (w + 1) * each]
        total = np.float32(0)
        for i in range(part.size):
            total += part[i]
        sums[w * 16] = total
    return sums.sum()


def bandwidth() -> Entry:
    """Measure the rate of plain reading from memory [GB/s], with one thread and with all."""
    data = np.ones(2**27, np.float32)
    entry: Entry = {}
    for name, workers in (("one_thread", 1), ("all_threads", threads())):
        read_all(data, workers)
        best = min(timeit.repeat(partial(read_all, data, workers), number=1, repeat=5))
        entry[f"{name}_GB_s"] = data.nbytes / best / 1e9
    return entry


BOUNDS = ("bound-C1", "bound-C2", "bound-C3", "bound-C1x36", "bound-C2x10", "bound-FDK")


def bounds(wanted: Callable[[str], bool]) -> list[Entry]:
    """Compute the times that memory bandwidth and serial parts allow, for the wanted
    cases.

    Returns:
        Entries. `least_MB` any method reads once; `asked_MB` ours reads, from caches or
        memory. `bound_ms` is `least_MB` at the rate of all threads. `cached_ms` is with
        every voxel column in one place, where it stays in the cache. `cpu_ms` is of all
        threads, as loads disturb it less. `serial_ms` is that of one thread beside the
        kernels, by its own clock.
    """
    rate = bandwidth()["all_threads_GB_s"]
    entries = []
    for case in peer_cases():
        name, views = f"bound-{case.name}", len(case.geometry)
        if name not in BOUNDS or not wanted(name):
            continue
        volume = case.volume()
        box, rays = (
            box_of(volume.layout),
            voxel_rays(case.geometry, volume.layout, case.shape),
        )
        out = np.empty((views, *case.shape), np.float32)
        call = partial(forward, volume, case.geometry, case.shape, out)
        same_place = partial(cpu.project, box._replace(hop_x=0, hop_y=0), rays, out)
        asked = (
            4
            * box.nz
            * np.mean([columns_passed(ray, box, case.shape[1]) for ray in rays])
        )
        entry = _bound(
            name, case.what, call, rate, volume.data.nbytes, float(asked), views
        )
        entry["cached_ms"], entry["cached_cpu_ms"] = (
            x / views for x in _spent(same_place)
        )
        with mock.patch.object(fan_kernels, "project_fans"):
            entry["serial_ms"] = _spent(call, time.thread_time)[1] / views
        entries.append(entry)
    if wanted(BOUNDS[-1]):
        entries.append(_fdk_bound(rate))
    return entries


def columns_passed(ray: FloatArray, box: VoxelBox, cols: int) -> int:
    """Count the voxel columns that the lines of a view's detector columns pass, seen
    along z.

    Args:
        ray: (12,) source, first pixel minus source, u, v in voxel units.
        box: of the volume.
        cols: detector columns.
    """
    start, far = ray[:2], ray[3:5] + np.arange(cols)[:, None] * ray[6:8]
    cuts = np.stack([-start / far, ((box.nx, box.ny) - start) / far])
    enter, leave = cuts.min(axis=0).max(axis=1), cuts.max(axis=0).min(axis=1)
    hit = enter < leave
    ends = [
        np.floor(start + t[hit, None] * far[hit]) for t in (enter + 1e-9, leave - 1e-9)
    ]
    return int(hit.sum() + np.abs(ends[1] - ends[0]).sum())


def _fdk_bound(rate: float) -> Entry:
    """Compute the bound of FDK, as if images were read once, and as by each tile of voxel
    columns that they meet.

    Args:
        rate: of reading from memory [GB/s].
    """
    from flexdt.twin.reconstruction import fdk
    from flexdt.twin.reconstruction.feldkamp import backprojection, fdk_views

    kernels = importlib.import_module("flexdt.twin.reconstruction.kernels.fdk_kernels")
    geometry, grid = fdk_scan()
    images = KINDS[FIRST](geometry, FDK_SHAPE)
    rows, cols = FDK_SHAPE
    x, y, _ = (np.sort(c)[[0, -1]] for c in grid.centers())
    tile = kernels.TILE
    places = [
        np.linspace(*ends, n + 1)
        for ends, n in zip((x, y), grid.shape[:0:-1], strict=True)
    ]
    px, py = np.meshgrid(places[0][::tile], places[1][::tile])
    asked = 0.0
    for g in fdk_views.view_table(geometry, (rows, cols)):
        depth = (px - g[0]) * g[3] + (py - g[1]) * g[4]
        c = g[8] + ((px - g[0]) * g[5] + (py - g[1]) * g[6]) / depth * g[7]
        corners = np.stack([c[:-1, :-1], c[1:, :-1], c[:-1, 1:], c[1:, 1:]])
        high = np.minimum(np.ptp(grid.centers()[2]) * g[9] / depth[:-1, :-1], rows)
        asked += float((4 * (np.ptp(corners, axis=0) + 2) * high).sum())
    call = partial(fdk, images, geometry, grid)
    least = images.nbytes + grid.data.nbytes
    entry = _bound(
        BOUNDS[-1], fdk_what("FDK"), call, rate, least, asked + grid.data.nbytes, 1
    )
    with contextlib.ExitStack() as stack:
        for name in ("weigh", "stand_up", "backproject"):
            stack.enter_context(mock.patch.object(kernels, name))
        stack.enter_context(mock.patch.object(backprojection, "filtered"))
        entry["serial_ms"] = _spent(call, time.thread_time)[1]
    return entry


def _bound(
    name: str,
    what: str,
    call: Callable[[], object],
    rate: float,
    least: int,
    asked: float,
    n: int,
) -> Entry:
    """Time a call, and make its entry beside the least time by memory bandwidth; `share`
    is that divided by the time of the call.

    Args:
        name, what: of the entry.
        call: to time.
        rate: of reading [GB/s].
        least, asked: bytes that any method and ours reads.
        n: views of a call.
    """
    wall, cpu_ms = _spent(call)
    entry = plain(name, wall / n, what)
    entry |= {
        "views": n,
        "cpu_ms": cpu_ms / n,
        "least_MB": least / 1e6,
        "asked_MB": asked / 1e6,
    }
    entry["bound_ms"] = least / rate / 1e6
    entry["share"] = entry["bound_ms"] / entry["ms_per_view"]
    return entry


def _spent(
    call: Callable[[], object],
    clock: Callable[[], float] = time.process_time,
    rounds: int = 5,
) -> tuple[float, float]:
    """Return the least time [ms] of `rounds` calls after a first one, by the wall clock
    and by `clock`.
    """
    found = []
    for _ in range(rounds + 1):
        wall, own = time.perf_counter(), clock()
        call()
        found.append([time.perf_counter() - wall, clock() - own])
    best = np.min(found[1:], axis=0) * 1e3
    return float(best[0]), float(best[1])


def bodies() -> list[Entry]:
    """Time solids and meshes of several sizes on both detectors, one view each, with
    processor time [ms].
    """
    things: dict[str, Body] = {
        name: load_phantom(name).scene for name in ("normal", "shepp-logan", "lego")
    }
    things |= {f"ball-{20 * 4**n}": ball_mesh(n) for n in (3, 5, 7)}
    entries = []
    for name, thing in things.items():
        for panel, shape in (("C1", BINNED), ("C3", FULL)):
            wall, cpu_ms = _spent(partial(project_body, thing, circle(1, shape), shape))
            entries.append(
                plain(f"body-{name}-{panel}", wall, "a view") | {"cpu_ms": cpu_ms}
            )
    return entries


SERIES = (("level", NONE), ("tilted", TILT_DEG))
"""The detector's tilt of each curve."""


@dataclass(frozen=True)
class Point:
    """A point of a curve: curve, abscissa, timed call and number of views."""

    series: str
    x: int
    call: Callable[[], object]
    views: int = 1


def growth_with_rays() -> list[Entry]:
    """Time a view of C1's volume against the number of rays, level and tilted."""
    volume = noise(C1_SHAPE)
    points: list[Point] = []
    for name, tilt in SERIES:
        for factor in (8, 4, 2, 1, 0.5, 0.25):
            shape = (round(760 / factor), round(956 / factor))
            view = circle(1, shape, pitch=0.1496 * factor, tilt_deg=tilt)
            points.append(Point(name, shape[0] * shape[1], _forward(volume, view, shape)))
    return _curve(points)


def growth_with_voxels() -> list[Entry]:
    """Time a view against voxels a side: the same field of view in smaller voxels, as
    many rays.
    """
    points: list[Point] = []
    for side in (32, 64, 128, 256, 384, 512):
        volume = noise((side,) * 3, 51.2 / side)
        for name, tilt in SERIES:
            view = circle(1, BINNED, tilt_deg=tilt)
            points.append(Point(name, side, _forward(volume, view, BINNED)))
    return _curve(points)


def growth_with_threads() -> list[Entry]:
    """Time a view of C1 against threads, by one view and by 36 in one call; the thread
    count is restored.
    """
    import numba

    before = numba.get_num_threads()
    volume = noise(C1_SHAPE)
    points: list[Point] = []
    for views, label in ((1, ""), (36, ", 36 views")):
        for name, tilt in SERIES:
            call = _forward(volume, circle(views, BINNED, tilt_deg=tilt), BINNED)
            count = 1
            while count <= before:

                def on(count: int = count, call: Callable[[], object] = call) -> None:
                    numba.set_num_threads(count)
                    call()

                points.append(Point(name + label, count, on, views))
                count *= 2
    try:
        return _curve(points)
    finally:
        numba.set_num_threads(before)


def _forward(
    volume: Volume, view: ConeVec, shape: tuple[int, int]
) -> Callable[[], object]:
    return partial(
        forward, volume, view, shape, np.empty((len(view), *shape), np.float32)
    )


def _curve(points: Sequence[Point]) -> list[Entry]:
    """Time all points turn by turn, so that a disturbance meets all.

    Returns:
        Series, x and least time a view [ms] of each.
    """
    timing = interleaved(
        {f"{i}": point.call for i, point in enumerate(points)}, budget_s=3.0
    )
    return [
        {
            "series": point.series,
            "x": point.x,
            "ms": timing[f"{i}"].best * 1e3 / point.views,
        }
        for i, point in enumerate(points)
    ]


CHECKED = 300
"""Rays through a mesh that are compared with the reference."""


def bead_scene() -> Scene:
    """Build a box with five steel beads, the usual calibration phantom."""
    beads = [Sphere((i - 2.0, 2 * i - 4.0, 8.0 * (i - 2)), 1.0) for i in range(5)]
    box = Solid(Box((0, 0, 0), (16.0, 24.0, 49.8)), "abs", 0.02)
    return Scene((box, *(Solid(bead, "steel", 0.3) for bead in beads)))


def scenes() -> list[Entry]:
    """Time an analytic scene, a box and five beads, on both detectors, with its errors
    against `scene_chords`.
    """
    scene = bead_scene()
    entries = []
    for name, shape in (("scene-C1", BINNED), ("scene-C3", FULL)):
        out = np.empty((1, *shape), np.float32)
        view = circle(1, shape)
        call = partial(project_scene, scene, view, shape, out)
        entry = timed(name, 1, {"flexdt": call}, "box and five beads, analytic")
        entry["mean_error"], entry["worst_error"] = errors(
            out, scene_chords(scene, view, shape)
        )
        entries.append(entry)
    return entries


def scene_chords(scene: Scene, view: ConeVec, shape: tuple[int, int]) -> FloatArray:
    """Compute line integrals of balls and upright boxes in one view, (1, rows, cols), in
    double precision.

    Each ray is cut by a quadratic equation or three pairs of planes.

    Raises:
        TypeError: another solid.
    """
    ray = view.pixel_centers(shape)[0] - view.source[0]
    square = np.einsum("rci,rci->rc", ray, ray)
    total = np.zeros(shape)
    for solid in scene.solids:
        match solid.shape:
            case Sphere(center, radius):
                p = view.source[0] - np.array(center)
                b = ray @ p
                root = np.sqrt(np.maximum(b * b - square * (p @ p - radius**2), 0.0))
                enter, leave = (-b - root) / square, (-b + root) / square
            case Box(center, size):
                p = np.array(center) - view.source[0]
                with np.errstate(divide="ignore"):
                    a, b = ((p + side * np.array(size) / 2) / ray for side in (-1, 1))
                enter = np.minimum(a, b).max(axis=2)
                leave = np.maximum(a, b).min(axis=2)
            case _:
                raise TypeError(f"no reference for {type(solid.shape).__name__}")
        inside = np.clip(leave, 0.0, 1.0) - np.clip(enter, 0.0, 1.0)
        total += solid.mu_per_mm * np.sqrt(square) * np.maximum(inside, 0.0)
    return np.asarray(total[None])


def ball_mesh(subdivisions: int) -> TriangleMesh:
    """Build a ball of 20 * 4^subdivisions triangles, 20 mm across."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=10.0)
    return TriangleMesh(ball.vertices, ball.faces)


def meshes(part: frozenset[str]) -> list[Entry]:
    """Time triangle meshes of a ball, beside embreex if it takes part, with the errors of
    CHECKED rays.
    """
    entries = []
    view = circle(1, BINNED)
    out = np.empty((1, *BINNED), np.float32)
    for subdivisions in (3, 5):
        mesh = ball_mesh(subdivisions)
        calls: dict[str, Callable[[], object]] = {
            "flexdt": partial(project_mesh, mesh, view, BINNED, out)
        }
        embree = Embree(mesh, view, BINNED) if "embreex" in part else None
        if embree is not None:
            calls["embreex"] = embree.run
        what = f"a ball of {len(mesh.faces)} triangles; errors of {CHECKED} rays"
        entry = timed(f"mesh-{len(mesh.faces)}", 1, calls, what)
        lit = np.argwhere(out[0])
        pixels = lit[np.random.default_rng(0).choice(len(lit), CHECKED, replace=False)]
        exact = mesh_paths(mesh, view, BINNED, pixels)
        at = (0, *pixels.T)
        entry["mean_error"], entry["worst_error"] = errors(out[at], exact)
        if embree is not None:
            entry["peers"]["embreex"]["mean_error"] = errors(embree.images()[at], exact)[
                0
            ]
        entries.append(entry)
    return entries


class Embree:
    """Path lengths through a convex mesh by embreex: the first hit from either side."""

    def __init__(self, mesh: TriangleMesh, view: ConeVec, shape: tuple[int, int]) -> None:
        """Build embreex's scene of a mesh, and the rays of a view from both ends."""
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh as EmbreeMesh

        self._scene = rtcore_scene.EmbreeScene()
        EmbreeMesh(self._scene, mesh.vertices[mesh.faces].astype(np.float32))
        ends = view.pixel_centers(shape)[0].reshape(-1, 3)
        ray = ends - view.source[0]
        self._length = np.linalg.norm(ray, axis=1)
        self._ahead = np.ascontiguousarray(
            (ray / self._length[:, None]).astype(np.float32)
        )
        self._behind = np.ascontiguousarray(-self._ahead)
        origins = np.broadcast_to(view.source[0], ends.shape)
        self._source = np.ascontiguousarray(origins.astype(np.float32))
        self._ends = np.ascontiguousarray(ends.astype(np.float32))
        self._shape = (1, *shape)
        self._result = np.zeros(0)

    def run(self) -> None:
        """See `Runner`."""
        enter = self._scene.run(self._source, self._ahead, query="DISTANCE")
        leave = self._scene.run(self._ends, self._behind, query="DISTANCE")
        self._result = np.where(enter < 1e30, self._length - enter - leave, 0.0)

    def images(self) -> Float32Array:
        """See `Runner`."""
        return self._result.reshape(self._shape).astype(np.float32)

    def close(self) -> None:
        """See `Runner`."""


def mesh_paths(
    mesh: TriangleMesh,
    view: ConeVec,
    shape: tuple[int, int],
    pixels: np.ndarray[tuple[int, ...]],
) -> FloatArray:
    """Compute the path lengths [mm] of single rays through a closed mesh, in double
    precision.

    Every triangle is tested for every ray (Moeller and Trumbore).

    Args:
        mesh: closed.
        view: one view.
        shape: (rows, cols).
        pixels: (k, 2) row, column.

    Returns:
        (k,).
    """
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    one, two, start = b - a, c - a, view.source[0] - a
    across = np.cross(start, one)
    ends = view.pixel_centers(shape)[0]
    result = np.zeros(len(pixels))
    for i, (r, column) in enumerate(pixels):
        ray = ends[r, column] - view.source[0]
        p = np.cross(ray, two)
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = 1.0 / np.einsum("ij,ij->i", one, p)
            u = scale * np.einsum("ij,ij->i", start, p)
            v = scale * (across @ ray)
            t = scale * np.einsum("ij,ij->i", two, across)
        hit = np.isfinite(scale) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        # Seen from outside, a triangle that turns its front to the source is an entry.
        away = -np.sign(scale[hit])
        result[i] = float(np.sum(away * np.clip(t[hit], 0.0, 1.0)) * np.linalg.norm(ray))
    return result


Wanted = Callable[[str], bool]
GROUPS: Mapping[tuple[str, ...], Callable[[Wanted, frozenset[str]], Iterable[Entry]]] = {
    ("scene-C1", "scene-C3"): lambda wanted, part: scenes(),
    ("mesh",): lambda wanted, part: meshes(part),
    tuple(adjoint_names()): lambda wanted, part: adjoint(wanted),
    **{tuple(fdk_names(size)): partial(fdk_entries, size) for size in FDK_SIZES},
    ("cold-cached", "cold-uncached"): lambda wanted, part: cold_start(),
    ("server-C1",): lambda wanted, part: through_server(),
    BOUNDS: lambda wanted, part: bounds(wanted),
    ("bodies",): lambda wanted, part: bodies(),
}
"""Names of cases -> function that measures them, given the names of peers taking part."""

CURVES: Mapping[str, Callable[[], list[Entry]]] = {
    "rays": lambda: growth_with_rays(),
    "voxels": lambda: growth_with_voxels(),
    "threads": lambda: growth_with_threads(),
}


FURTHER = (
    "times_forward", "added_ms", "dot_product_error", "cpu_ms", "least_MB", "asked_MB", "bound_ms",
    "share", "cached_ms", "cached_cpu_ms", "serial_ms", "times_whole", "errors_times", "peak_MB",
    "memory_times_whole",
)  # fmt: skip
"""Figures of an entry that its line ends with."""


def names() -> list[str]:
    """List the names that `--only` allows."""
    cases = [name for group in GROUPS for name in group]
    return [*cases, "growth", *(f"growth-{key}" for key in CURVES), "memory"]


def run(only: Sequence[str], with_peers: bool) -> Document:
    """Measure the cases named, or all, print each, and return the document.

    Args:
        only: names of cases, "growth", "growth-KEY" or "memory"; all if empty.
        with_peers: also measure RTK and embreex where they are installed.
    """
    warm_up()
    missing = (
        {name: absent(name) for name in ("itk-rtk", "embreex")} if with_peers else {}
    )
    part = frozenset(name for name, why in missing.items() if why is None)
    document: Document = {"machine": machine(missing), "cases": [], "growth": {}}

    def wanted(name: str) -> bool:
        return not only or name in only

    for group, measure in GROUPS.items():
        if any(wanted(name) for name in group):
            for entry in measure(wanted, part):
                entry["load"], entry["measured"] = load(), document["machine"]["measured"]
                document["cases"].append(entry)
                more = (f"   {key} {entry[key]:.3g}" for key in FURTHER if key in entry)
                to_stderr(line_of(entry) + "".join(more))
    for key, curve in CURVES.items():
        if wanted("growth") or wanted(f"growth-{key}"):
            document["growth"][key] = curve()
            to_stderr(f"growth with {key}")
    if wanted("memory"):
        document["machine"]["memory_read"] = bandwidth()
    return document


def main() -> None:
    """Measure the cases on the command line without a CUDA device, and print or write the
    document.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, help="write bench.json here, do not print it")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", choices=names())
    parser.add_argument(
        "--no-peers", action="store_true", help="do not run other programs"
    )
    parser.add_argument(
        "--list", action="store_true", help="name the cases, measure nothing"
    )
    options = parser.parse_args()
    if options.list:
        print("\n".join(names()))
        return
    os.environ["NUMBA_DISABLE_CUDA"] = "1"  # for the processes that this one starts
    with gpu.switched_off():
        document = run(options.only, not options.no_peers)
    text = json.dumps(document, indent=1)
    if options.out is None:
        print(text)
    else:
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "bench.json").write_text(text + "\n", "utf-8")


if __name__ == "__main__":
    main()
