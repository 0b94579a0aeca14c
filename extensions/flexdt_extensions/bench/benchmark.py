"""The benchmark from end to end: cases, peers, document."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from flexdt.measuring import gpu, threads
from flexdt.twin.projection import forward, warm_up
from flexdt_extensions.bench.cases import Case, all_cases
from flexdt_extensions.bench.measure import errors, exact_images, sorted_crossings, timed
from flexdt_extensions.bench.peers import Peer, Runner, peers

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
