"""The benchmark from end to end: cases, peers, times side by side, errors against exact lengths.

Contestants run turn by turn, so that what disturbs one disturbs all; the minimum is what the
machine can do, the median what one gets. `timed` and `plain` make entries of the benchmark's
document.
"""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np

from flexdt.measuring import gpu, threads
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection import Volume, forward, warm_up
from flexdt_extensions.bench.cases import Case, all_cases
from flexdt_extensions.bench.peers import Peer, Runner, peers

BUDGET_S = 6.0
"""A contestant that has run this long runs no more rounds."""
AT_LEAST, AT_MOST = 3, 15
"""Rounds."""
SHORT_S, MANY = 1.5, 150
"""A contestant whose rounds took less than this in all runs up to so many: what else the machine
does hides the best of a few short calls."""


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
    """Time contestants turn by turn.

    Args:
        contestants: name to call; the first call of each is not counted (but for those in `once`,
            which are called one time in all). A call that returns a float (seconds) has been timed
            by itself, in its own process.
        once: too slow for more.
        budget_s: seconds a contestant may use before it drops out, after the least number.
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
        name: CallTime(min(seen), float(np.median(seen)), len(seen)) for name, seen in times.items()
    }


def _enough(rounds: int, spent_s: float, budget_s: float) -> bool:
    """Whether a contestant has run often enough."""
    if rounds < AT_LEAST:
        return False
    most = MANY if spent_s < SHORT_S else AT_MOST
    return spent_s > budget_s or rounds >= most


def errors(images: Float32Array, exact: Float32Array | FloatArray) -> tuple[float, float]:
    """(mean, worst) absolute difference, as a share of the exact images' maximum."""
    top = float(exact.max())
    difference = np.abs(images.astype(np.float64) - exact)
    return float(difference.mean()) / top, float(difference.max()) / top


def exact_images(volume: Volume, geometry: ConeVec, shape: tuple[int, int]) -> Float32Array:
    """Every ray on its own in double precision (positions and sums), rounded once at the end."""
    from flexdt.measuring import box_of, siddon_kernels, voxel_rays

    out = np.zeros((len(geometry), *shape), np.float32)
    views = voxel_rays(geometry, volume.layout, shape)
    every = np.arange(len(geometry))
    siddon_kernels.project_rays(box_of(volume.layout), views, every, out, 8)
    return out


def sorted_crossings(
    volume: Volume, geometry: ConeVec, shape: tuple[int, int], pixels: FloatArray
) -> FloatArray:
    """The same integrals by another way: all crossings of a ray, sorted, in NumPy.

    Args:
        pixels: (k, 3) view, row, column.
    """
    data = volume.data
    size, counts = np.array(volume.voxel_xyz), np.array(volume.shape[::-1])
    low = np.array(volume.center_mm) - counts * size / 2
    result = np.zeros(len(pixels))
    for i, (view, r, c) in enumerate(pixels):
        row = geometry.rows[int(view)]
        start = row[0:3]
        end = row[3:6] + (c - (shape[1] - 1) / 2) * row[6:9] + (r - (shape[0] - 1) / 2) * row[9:12]
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
    """An entry for the call named flexdt beside those of the others."""
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
    """An entry of one time."""
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
"""Rays of each case that are checked by a second, independent exact method."""

Tell = Callable[[str], None]
Document = dict[str, Any]


def case_names() -> list[str]:
    """What `only` may name."""
    return [case.name for case in all_cases()]


def listing() -> list[str]:
    """A line for every name, with what it is."""
    return [f"{case.name:24} {case.what}" for case in all_cases()]


def run_bench(
    *, only: Sequence[str] = (), with_peers: bool = True, tell: Tell = lambda line: None
) -> Document:
    """Measure and return the benchmark document.

    Args:
        only: names of cases to run, see `case_names`; all if empty.
        with_peers: run other projectors beside ours.
        tell: told a line of text as each result comes in.

    Returns:
        {machine, cases: [{name, views, ms_per_view, median_ms_per_view, mean_error, worst_error,
        peers: {name: {ms_per_view, mean_error}}, ratio: {name: x}, ...}], growth: {}}; errors are
        shares of the maximum against double-precision exact lengths, ratios are peer / flexdt.
    """
    warm_up()
    found = peers() if with_peers else []
    missing = {p.name: p.missing for p in found}
    document: Document = {"machine": machine(missing), "cases": [], "growth": {}}
    began = document["machine"]["measured"]

    for case in all_cases():
        if only and case.name not in only:
            continue
        entry = run_case(case, [p for p in found if p.missing is None and case.peers])
        entry["load"], entry["measured"] = load(), began
        document["cases"].append(entry)
        tell(line_of(entry))
    return document


def run_case(case: Case, contestants: Sequence[Peer]) -> Document:
    """One case: accuracy first, then everyone turn by turn."""
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
    """Pixels in the volume's shadow, (k, 3) view, row, column, the same every time."""
    lit = np.flatnonzero(exact)
    chosen = np.random.default_rng(0).choice(lit, min(CHECKED, len(lit)), replace=False)
    return np.stack(np.unravel_index(chosen, exact.shape), axis=1).astype(np.float64)


def machine(missing: Mapping[str, str | None]) -> Document:
    """What the figures were measured on, when, and who took part (peer -> why not, or None)."""
    import llvmlite
    import numba

    model = platform.processor()
    try:
        with open("/proc/cpuinfo", encoding="ascii", errors="replace") as info:
            model = next(x.split(":", 1)[1].strip() for x in info if x.startswith("model name"))
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
    """Processes that wanted to run in the last minute, where the system says so."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else None


def line_of(entry: Document) -> str:
    """One result for people."""
    text = f"{entry['name']:16} {entry['ms_per_view']:10.2f} ms"
    if entry["worst_error"] is not None:
        text += f"   mean {entry['mean_error']:.1e} worst {entry['worst_error']:.1e}"
    for name, ratio in entry["ratio"].items():
        text += f"   {ratio:5.1f} x {name} ({entry['peers'][name]['ms_per_view']:.1f} ms)"
    return text


def to_stderr(line: str) -> None:
    """Progress, apart from the document on standard output."""
    print(line, file=sys.stderr, flush=True)
