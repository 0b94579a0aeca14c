"""The entries of the benchmark's document."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from flexdt.server.bench.measure import interleaved
from flexdt.twin.projection.cpu import threads

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
        entry["peers"][peer] = {"ms_per_view": seen.best * 1e3 / views, "mean_error": None}
        entry["ratio"][peer] = seen.best / ours.best
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
        "threads": threads(),
    }
