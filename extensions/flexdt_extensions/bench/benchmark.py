"""The benchmark from end to end: cases, peers, times side by side, errors against exact
lengths.

Contestants run turn by turn, so that a disturbance meets all; the minimum is the
machine's best, the median the usual time. `timed` and `plain` make entries of the
benchmark's document.

The cases are data: volumes, geometries, detectors. C1, C2 and C3 are the cases that peers
were measured with; no code was tuned for the others. Volumes are filled with random
numbers, so no empty space can be skipped (but for the ball).
"""

from __future__ import annotations

import math
import os
import platform
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from typing import Any

import numpy as np

from flexdt.measuring import gpu, threads
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import (
    Float32Array,
    FloatArray,
    rotation_about,
    rotation_z,
)
from flexdt.twin.projection import Volume, forward, warm_up
from flexdt_extensions.bench.peers import Peer, Runner, peers

SOD = 600.0
SDD = 1059.0
C1_SHAPE = (498, 240, 160)
C2_SHAPE = (512, 512, 512)
BINNED = (760, 956)
FULL = (1944, 1536)
PITCH = {BINNED: 0.1496, FULL: 0.0748}
TILT_DEG = (0.4, 0.7, 0.3)
"""Rotation in the detector's plane, and two out of it [deg]."""
NONE = (0.0, 0.0, 0.0)
LYING_TILT_DEG = (90.0, 0.0, 0.0)
FAR_RATIO = 100.0
START_RAD = 0.3
"""First angle [rad]: no axis of the volume is special."""


@dataclass(frozen=True)
class Case:
    """One measurement: a volume, views of it, and whether peers take part.

    Attributes:
        name: as in the document.
        volume: builds it.
        geometry: all its views.
        shape: detector (rows, cols).
        peers: run the peers too.
        what: one line for people.
    """

    name: str
    volume: Callable[[], Volume]
    geometry: ConeVec
    shape: tuple[int, int]
    peers: bool
    what: str


def circle(
    views: int,
    shape: tuple[int, int],
    *,
    sod: float = SOD,
    sdd: float = SDD,
    pitch: float | None = None,
    tilt_deg: tuple[float, float, float] = NONE,
    height: float = 0.0,
    above_deg: float = 0.0,
) -> ConeVec:
    """Make views on a full circle, in the object frame; the central ray always passes
    through the origin.

    Args:
        views: number of views.
        shape: detector (rows, cols).
        sod, sdd: distances of source to axis and to detector [mm].
        pitch: of pixels [mm]; None for that of `PITCH`, which knows some shapes only.
        tilt_deg: of the detector about its normal, u and v [deg].
        height: of the source [mm].
        above_deg: turn of source and detector about u, which brings the source above the
            object [deg].
    """
    pixel = PITCH[shape] if pitch is None else pitch
    u = np.array([1.0, 0, 0])
    v = np.array([0, 0, -1.0])
    beam = np.array([0, 1.0, 0])
    for axis, angle in zip((beam, u, v), tilt_deg, strict=True):
        turn = rotation_about(axis, math.radians(angle))
        u = turn @ u
        v = turn @ v
    raise_ = rotation_about(np.array([1.0, 0, 0]), -math.radians(above_deg))
    rows = []
    for i in range(views):
        r = rotation_z(START_RAD + 2 * math.pi * i / views) @ raise_
        source = np.array([0, -sod, height])
        centre = np.array([0, sdd - sod, -height * (sdd / sod - 1)])
        rows.append(
            np.concatenate([r @ source, r @ centre, pixel * (r @ u), pixel * (r @ v)])
        )
    return ConeVec(np.array(rows))


def noise(
    shape: tuple[int, int, int], voxel: float | tuple[float, float, float] = 0.1
) -> Volume:
    """Make a volume of random numbers, the same every time."""
    values: Float32Array = np.random.default_rng(0).random(shape, dtype=np.float32)
    return Volume(values, voxel)


def ball(side: int) -> Volume:
    """Make a (side, side, side) volume of voxels of 0.1 mm with a ball of ones in its
    middle, whose radius is a tenth of the side; zeros elsewhere.
    """
    values = np.zeros((side,) * 3, np.float32)
    n = side // 10
    x = np.arange(-n, n + 1)
    inside = (x[:, None, None] ** 2 + x[:, None] ** 2 + x**2) <= n * n
    at = slice(side // 2 - n, side // 2 + n + 1)
    values[at, at, at] = inside
    return Volume(values, 0.1)


def peer_cases() -> list[Case]:
    """List the cases that have targets: C1, C2, C3 in one or several views, tilted, from
    above, one row, small and tilted.
    """
    c1 = partial(noise, C1_SHAPE)
    c2 = partial(noise, C2_SHAPE)
    above = [
        Case(
            f"above-{e}",
            c1,
            circle(8, BINNED, above_deg=e),
            BINNED,
            True,
            f"C1, 8 views from {e} degrees above",
        )
        for e in (30, 45, 60, 75)
    ]
    row = (1, 956)
    small = (95, 120)
    single = Case(
        "row", c1, circle(8, row, pitch=0.1496), row, True, "C1, 8 views, one row"
    )
    tilted = circle(8, small, pitch=1.2, tilt_deg=TILT_DEG)
    cube = partial(noise, (64, 64, 64), 0.8)
    little = Case(
        "small-tilt", cube, tilted, small, True, "64^3 voxels, 120 x 95 pixels, tilted"
    )
    return [
        *(
            Case(name, volume, circle(views, shape, tilt_deg=tilt), shape, True, what)
            for name, volume, views, shape, tilt, what in (
                ("C1", c1, 1, BINNED, NONE, "160 x 240 x 498 voxels, 956 x 760 pixels"),
                ("C2", c2, 1, BINNED, NONE, "512^3 voxels, 956 x 760 pixels"),
                ("C3", c1, 1, FULL, NONE, "C1's volume, 1536 x 1944 pixels"),
                ("C1x36", c1, 36, BINNED, NONE, "C1, 36 views in one call"),
                ("C2x10", c2, 10, BINNED, NONE, "C2, 10 views in one call"),
                ("C1-tilt", c1, 1, BINNED, TILT_DEG, "C1, detector tilted"),
                ("C2-tilt", c2, 1, BINNED, TILT_DEG, "C2, detector tilted"),
                ("C3-tilt", c1, 1, FULL, TILT_DEG, "C3, detector tilted"),
            )
        ),
        *above,
        single,
        little,
    ]


def untuned_cases() -> list[Case]:
    """List the projection cases that no code was tuned for: wide cones, large tilts, near
    and far sources, flat, long or anisotropic volumes.

    They show that results are exact and that no geometry is suddenly slow.
    """
    s = BINNED
    cube = (256, 256, 256)
    strong = (45.0, 45.0, 45.0)
    # 60 degrees across the detector's diagonal.
    wide = 2 * math.tan(math.radians(30)) * 80.0 / math.hypot(*s)
    cone: dict[str, Any] = {"sod": 40.0, "sdd": 80.0, "pitch": wide}
    aslant = (LYING_TILT_DEG[0] + TILT_DEG[0], *TILT_DEG[1:])
    near = {"sod": 19.2, "sdd": 60.0, "pitch": 0.08}
    small = (95, 120)
    # Nearly parallel rays pass no z level: only the walk through the voxel columns remains.
    far = {"sod": FAR_RATIO * SOD, "sdd": FAR_RATIO * SDD}
    rows: list[tuple[str, tuple[int, int, int], dict[str, Any], str]] = [
        ("cone-60", cube, cone, "60 degree cone"),
        ("cone-60-tilt", cube, cone | {"tilt_deg": TILT_DEG}, "and tilt"),
        ("tilt-45", C1_SHAPE, {"tilt_deg": strong}, "three tilts of 45 degrees"),
        ("roll-90", C1_SHAPE, {"tilt_deg": LYING_TILT_DEG}, "C1, detector on its side"),
        ("roll-90-tilt", C1_SHAPE, {"tilt_deg": aslant}, "and tilted"),
        ("near", cube, near, "source 1 mm off the box"),
        ("flat", (4, 1024, 1024), {"height": 100.0}, "4 slices of 1024^2, from above"),
        ("long", (2000, 32, 32), {}, "a rod 2000 voxels long"),
        ("far", C1_SHAPE, far, "C1, 100 times as far away"),
    ]
    c1 = partial(noise, C1_SHAPE)
    aniso = partial(noise, C1_SHAPE, (0.1, 0.2, 0.05))
    many = circle(1000, small, pitch=1.2)
    return [
        Case("ball", partial(ball, 512), circle(1, s), s, False, "a ball in empty 512^3"),
        *(
            Case(name, partial(noise, shape), circle(1, s, **how), s, False, what)
            for name, shape, how, what in rows
        ),
        Case("anisotropic", aniso, circle(1, s), s, False, "voxels 0.1 x 0.2 x 0.05 mm"),
        Case("on-axis", c1, on_axis(s), s, False, "rays along a voxel axis, tilted"),
        Case(
            "C1x1000", c1, many, small, False, "1000 views of 120 x 95 pixels in one call"
        ),
    ]


def all_cases() -> list[Case]:
    """List every case that is a projection of voxels."""
    return [*peer_cases(), *untuned_cases()]


def on_axis(shape: tuple[int, int]) -> ConeVec:
    """Make one tilted view whose central ray runs along y."""
    view = circle(1, shape, tilt_deg=TILT_DEG)
    back = rotation_z(-START_RAD)
    return view.moved(back, (0.0, 0.0, 0.0))


BUDGET_S = 6.0
"""Time limit of a contestant: no more rounds after it [s]."""
MIN_ROUNDS = 3
MAX_ROUNDS = 15
"""Least and largest number of rounds."""
SHORT_S = 1.5
MAX_SHORT_ROUNDS = 150
"""Limit of total time [s] below which a contestant runs up to so many rounds: other
load hides the best of a few short calls."""


@dataclass(frozen=True)
class CallTime:
    """Seconds a call: the best, the median, and how many calls."""

    best: float
    median: float
    calls: int


def interleaved(
    contestants: Mapping[str, Callable[[], object]],
    *,
    once: frozenset[str] = frozenset(),
    budget_s: float = BUDGET_S,
) -> dict[str, CallTime]:
    """Run contestants turn by turn and time their calls, each until `_enough`.

    Args:
        contestants: name to call; the first call of each is not counted (but for those in
            `once`, which are called one time in all). A call that returns a float
            (seconds) has been timed by itself, in its own process.
        once: too slow for more.
        budget_s: seconds a contestant may use before it drops out, after the least
            number.

    Returns:
        Name -> least and median time [s] and number of timed calls.
    """
    times: dict[str, list[float]] = {name: [] for name in contestants}
    for name, call in contestants.items():
        if name not in once:
            call()
    wanting = set(contestants)
    while wanting:
        for name, call in contestants.items():
            if name not in wanting:
                continue
            seen = times[name]
            start = time.perf_counter()
            answer = call()
            taken = time.perf_counter() - start
            seen.append(answer if isinstance(answer, float) else taken)
            if name in once or _enough(len(seen), sum(seen), budget_s):
                wanting.discard(name)
    return {
        name: CallTime(min(seen), float(np.median(seen)), len(seen))
        for name, seen in times.items()
    }


def _enough(rounds: int, spent_s: float, budget_s: float) -> bool:
    """Return whether a contestant has run often enough: at least MIN_ROUNDS, and until
    its time or its rounds are spent.

    The most rounds are MAX_SHORT_ROUNDS as long as all together took less than SHORT_S,
    else MAX_ROUNDS.

    Args:
        rounds: timed so far.
        spent_s: by them [s].
        budget_s: that they may take [s].
    """
    if rounds < MIN_ROUNDS:
        return False
    if spent_s < SHORT_S:
        most = MAX_SHORT_ROUNDS
    else:
        most = MAX_ROUNDS
    return spent_s > budget_s or rounds >= most


def errors(images: Float32Array, exact: Float32Array | FloatArray) -> tuple[float, float]:
    """Compute the (mean, worst) absolute difference, as a share of the exact images'
    maximum."""
    top = float(exact.max())
    difference = np.abs(images.astype(np.float64) - exact)
    return float(difference.mean()) / top, float(difference.max()) / top


def exact_images(
    volume: Volume, geometry: ConeVec, shape: tuple[int, int]
) -> Float32Array:
    """Project every ray on its own in double precision (positions and sums), rounded once at
    the end.

    Args:
        volume: to project.
        geometry: n views.
        shape: (rows, cols).

    Returns:
        (n, rows, cols).
    """
    from flexdt.measuring import box_of, siddon_kernels, voxel_rays

    out = np.zeros((len(geometry), *shape), np.float32)
    views = voxel_rays(geometry, volume.layout, shape)
    every = np.arange(len(geometry))
    tile = 8
    jobs = len(every) * -(-shape[1] // tile)
    siddon_kernels.project_rays(box_of(volume.layout), views, every, out, tile, 0, jobs)
    return out


def sorted_crossings(
    volume: Volume, geometry: ConeVec, shape: tuple[int, int], pixels: FloatArray
) -> FloatArray:
    """Compute line integrals by another way: all crossings of a ray, sorted, in NumPy.

    Shares no code with the projector; double precision.

    Args:
        volume: to project.
        geometry: of the views.
        shape: (rows, cols).
        pixels: (k, 3) view, row, column.

    Returns:
        (k,) line integrals.
    """
    data = volume.data
    size = np.array(volume.voxel_xyz)
    counts = np.array(volume.shape[::-1])
    low = np.array(volume.center_mm) - counts * size / 2
    result = np.zeros(len(pixels))
    for i, (view, r, c) in enumerate(pixels):
        row = geometry.rows[int(view)]
        start = row[0:3]
        end = (
            row[3:6]
            + (c - (shape[1] - 1) / 2) * row[6:9]
            + (r - (shape[0] - 1) / 2) * row[9:12]
        )
        d = end - start
        t = [np.array([0.0, 1.0])]
        for a in range(3):
            if d[a] != 0:
                t.append((low[a] + np.arange(counts[a] + 1) * size[a] - start[a]) / d[a])
        cuts = np.sort(np.clip(np.concatenate(t), 0.0, 1.0))
        middle = start + 0.5 * (cuts[1:] + cuts[:-1])[:, None] * d
        index = np.floor((middle - low) / size).astype(np.int64)
        inside = ((index >= 0) & (index < counts)).all(axis=1)
        x, y, z = index[inside].T
        lengths = np.diff(cuts)[inside] * np.linalg.norm(d)
        result[i] = float(np.sum(lengths * data[z, y, x].astype(np.float64)))
    return result


Entry = dict[str, Any]


def timed(
    name: str,
    views: int,
    calls: dict[str, Callable[[], object]],
    what: str,
    once: frozenset[str] = frozenset(),
) -> Entry:
    """Make an entry of the call named flexdt and those of the others.

    Contestants are called in turn; the first call of each is not counted.

    Args:
        name: of the case.
        views: of each call.
        calls: contestant -> call; one is "flexdt". A call that returns a float has timed
            itself [s].
        what: description of the case.
        once: contestants that are called one time only.

    Returns:
        The entry, with least and median times [ms per view] and ratios peer / flexdt of
        both.
    """
    timing = interleaved(calls, once=once)
    ours = timing.pop("flexdt")
    entry = plain(name, ours.best * 1e3 / views, what)
    entry["views"] = views
    entry["median_ms_per_view"] = ours.median * 1e3 / views
    for peer, seen in timing.items():
        entry["peers"][peer] = {
            "ms_per_view": seen.best * 1e3 / views,
            "median_ms_per_view": seen.median * 1e3 / views,
            "mean_error": None,
        }
        entry["ratio"][peer] = seen.best / ours.best
        entry["median_ratio"][peer] = seen.median / ours.median
    return entry


def plain(name: str, ms: float, what: str) -> Entry:
    """Make an entry of one time of one view, with the number of threads; its errors are
    None, its peers empty.

    Args:
        name: of the case.
        ms: time [ms].
        what: description.
    """
    return {
        "name": name,
        "what": what,
        "views": 1,
        "ms_per_view": ms,
        "mean_error": None,
        "worst_error": None,
        "peers": {},
        "ratio": {},
        "median_ratio": {},
        "threads": threads(),
    }


CHECKED = 300
"""Number of rays of each case that are checked by a second, independent exact method."""

Tell = Callable[[str], None]
Document = dict[str, Any]


def case_names() -> list[str]:
    """List the names that `only` accepts."""
    return [case.name for case in all_cases()]


def listing() -> list[str]:
    """List a line for every name, with its description."""
    return [f"{case.name:24} {case.what}" for case in all_cases()]


def run_bench(
    *, only: Sequence[str] = (), with_peers: bool = True, tell: Tell = lambda line: None
) -> Document:
    """Run the cases on this machine and return the benchmark document.

    Args:
        only: names of cases to run, see `case_names`; all if empty.
        with_peers: run other projectors too.
        tell: called with a line of text for each result.

    Returns:
        {machine, cases: [{name, views, ms_per_view, median_ms_per_view, mean_error,
        worst_error, peers: {name: {ms_per_view, mean_error}}, ratio: {name: x}, ...}],
        growth: {}}. Errors are shares of the maximum against double-precision exact
        lengths, ratios are peer / flexdt.
    """
    warm_up()
    found = peers() if with_peers else []
    missing = {p.name: p.missing for p in found}
    document: Document = {"machine": machine(missing), "cases": [], "growth": {}}
    began = document["machine"]["measured"]

    tell(heading(document["machine"]))
    for case in all_cases():
        if only and case.name not in only:
            continue
        entry = run_case(case, [p for p in found if p.missing is None and case.peers])
        entry["load"] = load()
        entry["measured"] = began
        document["cases"].append(entry)
        tell(line_of(entry))
    return document


def run_case(case: Case, contestants: Sequence[Peer]) -> Document:
    """Run one case: accuracy first, then all contestants turn by turn.

    The entry has ms per view, errors of flexdt and peers against the exact images, ratios
    to peers, the check of the reference, and ns per ray.

    Args:
        case: volume, views and detector.
        contestants: peers; a slow one is left out of several views.

    Returns:
        The entry, see `run_bench`.
    """
    volume = case.volume()
    views = len(case.geometry)
    out = np.empty((views, *case.shape), np.float32)
    exact = exact_images(volume, case.geometry, case.shape)
    pixels = _some_pixels(exact)
    second = sorted_crossings(volume, case.geometry, case.shape, pixels)
    at = tuple(pixels.astype(np.int64).T)
    check = float(np.abs(exact[at] - second).max() / exact.max())
    chosen = [p for p in contestants if not (p.slow and views > 1)]
    runners: dict[str, Runner] = {
        p.name: p.prepare(volume, case.geometry, case.shape) for p in chosen
    }
    calls: dict[str, Callable[[], object]] = {
        "flexdt": lambda: forward(volume, case.geometry, case.shape, out)
    }
    calls.update({name: runner.run for name, runner in runners.items()})
    try:
        slow = frozenset(p.name for p in chosen if p.slow)
        entry = timed(case.name, views, calls, case.what, slow)
        for name, runner in runners.items():
            entry["peers"][name]["mean_error"] = errors(runner.images(), exact)[0]
    finally:
        for runner in runners.values():
            runner.close()
    entry["mean_error"], entry["worst_error"] = errors(out, exact)
    entry["reference_check"] = check
    entry["ns_per_ray"] = entry["ms_per_view"] * views * 1e6 / out.size
    return entry


def _some_pixels(exact: np.ndarray[Any, np.dtype[np.float32]]) -> np.ndarray[Any, Any]:
    """Draw pixels in the volume's shadow, (k, 3) view, row, column, the same every
    time."""
    lit = np.flatnonzero(exact)
    chosen = np.random.default_rng(0).choice(lit, min(CHECKED, len(lit)), replace=False)
    return np.stack(np.unravel_index(chosen, exact.shape), axis=1).astype(np.float64)


def machine(missing: Mapping[str, str | None]) -> Document:
    """Describe the machine of the figures: time of the measurement (UTC), processor,
    cores, threads, load, GPU, versions, and which peers took part.

    Args:
        missing: peer -> why it takes no part, or None.
    """
    import llvmlite
    import numba

    model = platform.processor()
    try:
        with open("/proc/cpuinfo", encoding="ascii", errors="replace") as info:
            model = next(
                x.split(":", 1)[1].strip() for x in info if x.startswith("model name")
            )
    except (OSError, StopIteration):
        pass
    return {
        "measured": datetime.now(UTC).isoformat(timespec="minutes"),
        "cpu": model,
        "cores": os.cpu_count(),
        "threads": threads(),
        "load_at_start": load(),
        "gpu": gpu.availability().reason,
        "python": platform.python_version(),
        "numba": numba.__version__,
        "llvmlite": llvmlite.__version__,
        "numpy": np.__version__,
        "peers": {name: why or "took part" for name, why in missing.items()},
    }


def load() -> float | None:
    """Return the mean number of runnable processes in the last minute, where the
    system has it."""
    if hasattr(os, "getloadavg"):
        return os.getloadavg()[0]
    return None


def heading(machine: Document) -> str:
    """Say what `line_of` lists, in which units, and that other processes disturb it."""
    busy = "unknown"
    if machine["load_at_start"] is not None:
        busy = f"{machine['load_at_start']:.1f}"
    return (
        "forward projection: shortest of several calls, ms of wall time a view; mean and "
        "worst error as shares of the longest path integral; n x peer: it takes n times as "
        f"long\nload {busy} on {machine['cores']} cores; other processes lengthen all times"
    )


def line_of(entry: Document) -> str:
    """Format one result for people: name, ms per view, mean and worst error (if known),
    and for each peer how many times slower it is, with its ms.
    """
    text = f"{entry['name']:16} {entry['ms_per_view']:10.2f} ms"
    if entry["worst_error"] is not None:
        text += f"   mean {entry['mean_error']:.1e} worst {entry['worst_error']:.1e}"
    for name, ratio in entry["ratio"].items():
        text += f"   {ratio:5.1f} x {name} ({entry['peers'][name]['ms_per_view']:.1f} ms)"
    return text


def to_stderr(line: str) -> None:
    """Print progress, apart from the document on standard output."""
    print(line, file=sys.stderr, flush=True)
