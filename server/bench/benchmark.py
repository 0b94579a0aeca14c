"""The benchmark from end to end: cases, peers, further cases, document, figure, table."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from flexdt.server.bench import further_cases
from flexdt.server.bench.cases import Case, all_cases
from flexdt.server.bench.measure import errors, exact_images, sorted_crossings, timed
from flexdt.server.bench.peers import Peer, Runner, mesh_peers, peers
from flexdt.twin.projection import forward, gpu, warm_up
from flexdt.twin.projection.cpu import threads

CHECKED = 300
"""Rays of each case that are checked by a second, independent exact method."""

Tell = Callable[[str], None]
Wanted = Callable[[str], bool]
Document = dict[str, Any]


GROUPS: Mapping[tuple[str, ...], Callable[[Wanted, frozenset[str]], list[Document]]] = {
    ("scene-C1", "scene-C3"): lambda wanted, part: further_cases.scenes(),
    ("mesh",): lambda wanted, part: further_cases.meshes(part),
    tuple(further_cases.adjoint_names()): lambda wanted, part: further_cases.adjoint(wanted),
    ("FDK",): lambda wanted, part: [further_cases.fdk_entry(part)],
    ("cold-cached", "cold-uncached"): lambda wanted, part: further_cases.cold_start(),
    ("server-C1",): lambda wanted, part: further_cases.through_server(),
}
"""Names of cases beyond projection -> what measures them, given the names of peers taking part."""

CURVES: Mapping[str, Callable[[], list[Document]]] = {
    "rays": lambda: further_cases.growth_with_rays(),
    "voxels": lambda: further_cases.growth_with_voxels(),
    "threads": lambda: further_cases.growth_with_threads(),
}


def case_names() -> list[str]:
    """What `only` may name."""
    return [
        *(case.name for case in all_cases()),
        *(name for names in GROUPS for name in names),
        "growth",
        *(f"growth-{key}" for key in CURVES),
        "memory",
    ]


def listing() -> list[str]:
    """A line for every name, with what it is where it is a projection of voxels."""
    what = {case.name: case.what for case in all_cases()}
    return [f"{name:24} {what.get(name, '')}".rstrip() for name in case_names()]


def run_bench(
    *,
    only: Sequence[str] = (),
    with_peers: bool = True,
    extra: bool = True,
    tell: Tell = lambda line: None,
) -> Document:
    """Measure and return the benchmark document.

    Args:
        only: names of cases to run, see `case_names`; all if empty.
        with_peers: run other projectors beside ours.
        extra: scenes, meshes, adjoint, FDK, growth, cold start, server, memory.
        tell: told a line of text as each result comes in.

    Returns:
        {machine, cases: [{name, views, ms_per_view, median_ms_per_view, mean_error, worst_error,
        peers: {name: {ms_per_view, mean_error}}, ratio: {name: x}, ...}], growth}; errors are
        shares of the maximum against double-precision exact lengths, ratios are peer / flexdt.
    """
    warm_up()
    found = peers() if with_peers else []
    missing = {p.name: p.missing for p in found} | (mesh_peers() if with_peers else {})
    part = frozenset(name for name, why in missing.items() if why is None)
    document: Document = {"machine": machine(missing), "cases": [], "growth": {}}
    began = document["machine"]["measured"]

    def wanted(name: str) -> bool:
        return not only or name in only

    def add(entry: Document) -> None:
        entry["load"], entry["measured"] = load(), began
        document["cases"].append(entry)
        tell(line_of(entry))

    for case in all_cases():
        if not wanted(case.name):
            continue
        ready = [p for p in found if p.name in part and case.peers]
        add(run_case(case, ready))
    if not extra:
        return document
    for names, measure in GROUPS.items():
        if any(wanted(name) for name in names):
            for entry in measure(wanted, part):
                add(entry)
    for key, curve in CURVES.items():
        if wanted("growth") or wanted(f"growth-{key}"):
            document["growth"][key] = curve()
            tell(f"growth with {key}")
    if wanted("memory"):
        document["machine"]["memory_read"] = further_cases.bandwidth()
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
    for key in ("times_forward", "added_ms", "dot_product_error"):
        if key in entry:
            text += f"   {key} {entry[key]:.3g}"
    return text


def to_stderr(line: str) -> None:
    """Progress, apart from the document on standard output."""
    print(line, file=sys.stderr, flush=True)
