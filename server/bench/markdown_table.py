"""The benchmark's document as Markdown tables, for docs/performance.md."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

from flexdt.server.bench.projector_targets import target_table

SHOWN = (
    ("times_forward", "{:.2f} x forward"),
    ("dot_product_error", "dot product {:.0e}"),
    ("added_ms", "+ {:.1f} ms over the direct call"),
)
"""Further figures of an entry, and how to print them."""


def tables(document: dict[str, Any]) -> str:
    """Machine, targets, cases and growth as Markdown."""
    return "\n".join(
        [
            *_machine(document["machine"]),
            *_runs(document["cases"]),
            *target_table(document),
            *_cases(document["cases"]),
            *_growth(document),
        ]
    )


BEGIN, END = "<!-- figures -->", "<!-- end of figures -->"


def into_page(page: str, document: dict[str, Any], picture: str) -> str:
    """A Markdown page with what stands between its two marks replaced by the figures.

    Raises:
        ValueError: the page has no marks.
    """
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"the page lacks the marks {BEGIN} and {END}")
    figures = f"{tables(document)}\n\n![ratios and growth]({picture})"
    return f"{before}{begin}\n{figures}\n{end}{after}"


def _machine(machine: dict[str, Any]) -> list[str]:
    read = machine.get("memory_read", {})
    memory = "".join(
        f", {read[key]:.0f} GB/s read by {words}"
        for key, words in (("one_thread_GB_s", "one thread"), ("all_threads_GB_s", "all"))
        if key in read
    )
    took_part = ", ".join(f"{name}: {what}" for name, what in machine["peers"].items())
    return [
        f"{machine['cpu']}, {machine['threads']} threads{memory}; load at start "
        f"{machine['load_at_start']:.1f}; numba {machine['numba']}. Peers: {took_part or 'none'}.",
        "",
    ]


def _runs(cases: Sequence[dict[str, Any]]) -> list[str]:
    """Which cases are of another run than most."""
    runs = Counter(case.get("measured") for case in cases)
    if len(runs) < 2:
        return []
    most = runs.most_common(1)[0][0]
    others = (case["name"] for case in cases if case.get("measured") != most)
    return [f"Of another run than the rest: {', '.join(others)}.", ""]


def _cases(cases: Sequence[dict[str, Any]]) -> list[str]:
    lines = [
        "| case | ms a view (median) | mean / worst error | peers, ms | ratio (of medians) "
        "| load | |",
        "|---|---|---|---|---|---|---|",
    ]
    for case in cases:
        time = f"{case['ms_per_view']:.2f}"
        if "median_ms_per_view" in case:
            time += f" ({case['median_ms_per_view']:.2f})"
        accuracy = ""
        if case["mean_error"] is not None:
            shown = (case["mean_error"], case["worst_error"])
            accuracy = " / ".join(f"{error:.1e}" for error in shown if error is not None)
        peers = ", ".join(f"{n} {p['ms_per_view']:.1f}" for n, p in case["peers"].items())
        ratio = ", ".join(
            f"{value:.1f}" + (f" ({case['median_ratio'][n]:.1f})" if "median_ratio" in case else "")
            for n, value in case["ratio"].items()
        )
        load = "" if case.get("load") is None else f"{case['load']:.1f}"
        more = [case.get("what", "")]
        more += [text.format(case[key]) for key, text in SHOWN if key in case]
        lines.append(
            f"| {case['name']} | {time} | {accuracy} | {peers} | {ratio} | {load} "
            f"| {'; '.join(more)} |"
        )
    return [*lines, ""]


def _growth(document: dict[str, Any]) -> list[str]:
    lines = []
    for key, points in document.get("growth", {}).items():
        for series in dict.fromkeys(p["series"] for p in points):
            row = ", ".join(f"{p['x']:,}: {p['ms']:.2f}" for p in points if p["series"] == series)
            lines.append(f"- ms against {key}, {series}: {row}")
    return lines
