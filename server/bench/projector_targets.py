"""What the projector is to reach, beside what was measured: a table made from the document alone.

Targets are ratios to itk-rtk's Joseph projector and FDK in the same run, shares of the maximum,
milliseconds, or ratios of the adjoint to the forward. LEAP cannot be installed from PyPI, so its
target is judged by a derived figure, and says so.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

Entries = Mapping[str, Mapping[str, Any]]
Found = tuple[float, str] | None
"""A figure and where it is from; None: not measured."""

LEAP_TO_RTK = {"C1x36": (71, 153), "C2x10": (369, 611)}
"""ms a view of LEAP's fastest CPU projector (separable footprint, circular scans only) and of
itk-rtk's Joseph, measured together once on two Zen 4 cores of about 2.9 GHz."""


@dataclass(frozen=True)
class Target:
    """One target.

    Attributes:
        what: for people.
        accepted, wanted: the figure to be accepted, and the one we are after (None: no other).
        more: more is better.
        form: how to print figures.
        find: the figure in the document's entries.
    """

    what: str
    accepted: float
    wanted: float | None
    more: bool
    form: str
    find: Callable[[Entries], Found]

    def verdict(self, value: float) -> str:
        """In words."""
        for bar, words in ((self.wanted, "wanted: met"), (self.accepted, "accepted: met")):
            if bar is not None and (value >= bar if self.more else value <= bar):
                return words
        return "**missed**"


def target_table(document: Mapping[str, Any]) -> list[str]:
    """The table as lines of Markdown."""
    entries = {entry["name"]: entry for entry in document["cases"]}
    lines = [
        "| target | to be accepted | wanted | measured | |",
        "|---|---|---|---|---|",
    ]
    for target in TARGETS:
        both = (target.accepted, target.wanted)
        bars = " | ".join("" if bar is None else target.form.format(bar) for bar in both)
        found = target.find(entries)
        if found is None:
            lines.append(f"| {target.what} | {bars} | not measured | |")
        else:
            value, where = found
            measured = target.form.format(value) + (f" ({where})" if where else "")
            lines.append(f"| {target.what} | {bars} | {measured} | {target.verdict(value)} |")
    return [*lines, ""]


def _ratio(name: str, peer: str = "itk-rtk") -> Callable[[Entries], Found]:
    def find(entries: Entries) -> Found:
        value = entries.get(name, {}).get("ratio", {}).get(peer)
        return None if value is None else (value, "")

    return find


def _leap(name: str) -> Callable[[Entries], Found]:
    leap, rtk = LEAP_TO_RTK[name]

    def find(entries: Entries) -> Found:
        found = _ratio(name)(entries)
        where = f"derived: our ratio to itk-rtk, times {leap} / {rtk} ms"
        return None if found is None else (found[0] * leap / rtk, where)

    return find


def _value(name: str, key: str) -> Callable[[Entries], Found]:
    def find(entries: Entries) -> Found:
        value = entries.get(name, {}).get(key)
        return None if value is None else (value, "")

    return find


def _worst(key: str, chosen: Callable[[str], bool]) -> Callable[[Entries], Found]:
    def find(entries: Entries) -> Found:
        values = [
            (entry[key], f"worst: {name}")
            for name, entry in entries.items()
            if chosen(name) and entry.get(key) is not None and name != "FDK"
        ]
        return max(values, default=None)

    return find


def _of_peers(name: str) -> bool:
    return name.removeprefix("adjoint-").startswith(("C1", "C2", "C3")) and "x1000" not in name


def _into_memory(name: str) -> bool:
    return name.startswith("adjoint-") and not name.endswith("-new")


TIMES, SHARE, MS = "{:.1f} x", "{:.0e}", "{:.1f} ms"
TARGETS = (
    Target("C1, level", 10, 20, True, TIMES, _ratio("C1")),
    Target("C2, level", 8, 15, True, TIMES, _ratio("C2")),
    Target("C3, level", 15, 25, True, TIMES, _ratio("C3")),
    Target("C1, 36 views", 12, 25, True, TIMES, _ratio("C1x36")),
    Target("C2, 10 views", 8, 18, True, TIMES, _ratio("C2x10")),
    Target("C1, 36 views, against the best LEAP", 5, None, True, TIMES, _leap("C1x36")),
    Target("C2, 10 views, against the best LEAP", 5, None, True, TIMES, _leap("C2x10")),
    *(
        Target(f"{name}, tilted, {kind}", accepted, wanted, True, TIMES, _ratio(f"{name}-tilt"))
        for kind, accepted, wanted in (("any processor", 2.5, 4), ("with AVX-512", 4, 8))
        for name in ("C1", "C2", "C3")
    ),
    Target("mean error, all cases", 1e-6, 3e-7, False, SHARE, _worst("mean_error", bool)),
    Target("worst error, all cases", 1e-5, 3e-6, False, SHARE, _worst("worst_error", bool)),
    Target("bead phantom on C1's detector", 5, 2, False, MS, _value("scene-C1", "ms_per_view")),
    Target("bead phantom on C3's detector", 15, 6, False, MS, _value("scene-C3", "ms_per_view")),
    Target("FDK", 5, 10, True, TIMES, _ratio("FDK")),
    Target(
        "adjoint against forward, C1 to C3",
        1.5, 1, False, "{:.2f} x",
        _worst("times_forward", lambda n: _into_memory(n) and _of_peers(n)),
    ),
    Target(
        "adjoint against forward, cases nobody tuned for",
        1.5, 1, False, "{:.2f} x",
        _worst("times_forward", lambda n: _into_memory(n) and not _of_peers(n)),
    ),
    Target("added by the projector server, C1", 5, 2, False, MS, _value("server-C1", "added_ms")),
)  # fmt: skip
