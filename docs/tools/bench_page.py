"""The kept benchmark, from the document that `flexdt bench --out DIR` or
`tests/studies/further_bench.py` writes; the site renders it as a page of the evidence
shelf.

    flexdt bench --out out/bench
    python docs/tools/bench_page.py out/bench/bench.json

What the benchmark did not run this time stays as it was, in docs/images/bench.json. `--page
FILE` also puts the figures between a page's marks; `--out DIR` writes bench.md and bench.svg
instead.

Targets are ratios to itk-rtk's Joseph projector and FDK in the same run, shares of the maximum,
milliseconds, or ratios of the adjoint to the forward. LEAP cannot be installed from PyPI, so
its target is judged by a derived figure, and says so.
"""

from __future__ import annotations

import argparse
import json
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

Document = dict[str, Any]

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
        """Judge a figure: "goal met", else "minimum met", else "**missed**"; a
        figure on the bar meets it.
        """
        for bar, words in (
            (self.wanted, "goal met"),
            (self.accepted, "minimum met"),
        ):
            if bar is not None and (value >= bar if self.more else value <= bar):
                return words
        return "**missed**"


def target_table(document: Mapping[str, Any]) -> list[str]:
    """Make the table of targets as lines of Markdown: bars, figure, its origin and
    verdict.

    Args:
        document: of a benchmark, with `cases`.

    Returns:
        Head and a row for each of `TARGETS` ("not measured" without a figure), then an
        empty line.
    """
    entries = {entry["name"]: entry for entry in document["cases"]}
    lines = [
        "| target | minimum | goal | measured | |",
        "|---|---|---|---|---|",
    ]
    for target in TARGETS:
        both = (target.accepted, target.wanted)
        bars = " | ".join("" if bar is None else target.form.format(bar) for bar in both)
        figure_and_origin = target.find(entries)
        if figure_and_origin is None:
            lines.append(f"| {target.what} | {bars} | not measured | |")
        else:
            value, where = figure_and_origin
            measured = target.form.format(value) + (f" ({where})" if where else "")
            lines.append(
                f"| {target.what} | {bars} | {measured} | {target.verdict(value)} |"
            )
    return [*lines, ""]


def _ratio(name: str, peer: str = "itk-rtk") -> Callable[[Entries], Found]:
    """Make the function that finds a case's ratio to a peer in the entries; None where it
    was not measured.
    """

    def find(entries: Entries) -> Found:
        value = entries.get(name, {}).get("ratio", {}).get(peer)
        return None if value is None else (value, "")

    return find


def _leap(name: str) -> Callable[[Entries], Found]:
    """Make the function that derives a case's ratio to LEAP: that to itk-rtk times
    `LEAP_TO_RTK`, with a note of the derivation; None where that was not measured.
    """
    leap, rtk = LEAP_TO_RTK[name]

    def find(entries: Entries) -> Found:
        ratio = _ratio(name)(entries)
        where = f"derived: our ratio to itk-rtk, times {leap} / {rtk} ms"
        return None if ratio is None else (ratio[0] * leap / rtk, where)

    return find


def _value(name: str, key: str) -> Callable[[Entries], Found]:
    """Make the function that finds a case's figure of a name; None where it was not
    measured.
    """

    def find(entries: Entries) -> Found:
        value = entries.get(name, {}).get(key)
        return None if value is None else (value, "")

    return find


def _worst(key: str, chosen: Callable[[str], bool]) -> Callable[[Entries], Found]:
    """Make the function that finds the largest figure of a name among cases, with the
    case's name; None without any.

    Args:
        key: name of the figure.
        chosen: returns whether a case, by its name, takes part. The case FDK never does.
    """

    def find(entries: Entries) -> Found:
        """Find the largest figure of `key` among the chosen cases, with the case's name."""
        values = [
            (entry[key], f"worst: {name}")
            for name, entry in entries.items()
            if chosen(name) and entry.get(key) is not None and name != "FDK"
        ]
        return max(values, default=None)

    return find


def _of_peers(name: str) -> bool:
    """Return whether a case is one of C1, C2 and C3, or an adjoint of one, that peers
    run, too.
    """
    return (
        name.removeprefix("adjoint-").startswith(("C1", "C2", "C3"))
        and "x1000" not in name
    )


def _into_memory(name: str) -> bool:
    return name.startswith("adjoint-") and not name.endswith("-new")


TIMES = "{:.1f} x"
SHARE = "{:.0e}"
MS = "{:.1f} ms"
TARGETS = (
    Target("C1, level", 10, 20, True, TIMES, _ratio("C1")),
    Target("C2, level", 8, 15, True, TIMES, _ratio("C2")),
    Target("C3, level", 15, 25, True, TIMES, _ratio("C3")),
    Target("C1, 36 views", 12, 25, True, TIMES, _ratio("C1x36")),
    Target("C2, 10 views", 8, 18, True, TIMES, _ratio("C2x10")),
    Target("C1, 36 views, against the best LEAP", 5, None, True, TIMES, _leap("C1x36")),
    Target("C2, 10 views, against the best LEAP", 5, None, True, TIMES, _leap("C2x10")),
    *(
        Target(
            f"{name}, tilted, {kind}",
            accepted,
            wanted,
            True,
            TIMES,
            _ratio(f"{name}-tilt"),
        )
        for kind, accepted, wanted in (("any processor", 2.5, 4), ("with AVX-512", 4, 8))
        for name in ("C1", "C2", "C3")
    ),
    Target("mean error, all cases", 1e-6, 3e-7, False, SHARE, _worst("mean_error", bool)),
    Target(
        "worst error, all cases", 1e-5, 3e-6, False, SHARE, _worst("worst_error", bool)
    ),
    Target(
        "bead phantom on C1's detector",
        5,
        2,
        False,
        MS,
        _value("scene-C1", "ms_per_view"),
    ),
    Target(
        "bead phantom on C3's detector",
        15,
        6,
        False,
        MS,
        _value("scene-C3", "ms_per_view"),
    ),
    Target("FDK", 5, 10, True, TIMES, _ratio("FDK")),
    Target(
        "adjoint against forward, C1 to C3",
        1.5,
        1,
        False,
        "{:.2f} x",
        _worst("times_forward", lambda n: _into_memory(n) and _of_peers(n)),
    ),
    Target(
        "adjoint against forward, cases nobody tuned for",
        1.5,
        1,
        False,
        "{:.2f} x",
        _worst("times_forward", lambda n: _into_memory(n) and not _of_peers(n)),
    ),
    Target(
        "added by the projector server, C1",
        5,
        2,
        False,
        MS,
        _value("server-C1", "added_ms"),
    ),
)


SHOWN = (
    ("times_forward", "{:.2f} x forward"),
    ("dot_product_error", "dot product {:.0e}"),
    ("added_ms", "+ {:.1f} ms over the direct call"),
)
"""Further figures of an entry, and how to print them."""


def tables(document: dict[str, Any]) -> str:
    """Make the Markdown of a benchmark document: machine, cases of another run, targets,
    cases and growth.
    """
    return "\n".join(
        [
            *_machine(document["machine"]),
            *_runs(document["cases"]),
            *target_table(document),
            *_cases(document["cases"]),
            *_growth(document),
        ]
    )


BEGIN = "<!-- figures -->"
END = "<!-- end of figures -->"


def into_page(page: str, document: dict[str, Any], picture: str) -> str:
    """Return a Markdown page with the text between its two marks replaced by the tables
    and the picture.

    Args:
        page: its text.
        document: of a benchmark.
        picture: path of the picture, from the page.

    Raises:
        ValueError: the page lacks a mark.
    """
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"the page lacks the marks {BEGIN} and {END}")
    figures = f"{tables(document)}\n\n![ratios and growth]({picture})"
    return f"{before}{begin}\n{figures}\n{end}{after}"


def _machine(machine: dict[str, Any]) -> list[str]:
    """Describe the machine of a run in one line of Markdown, and an empty one: processor,
    threads, read speed of the memory (if measured), load at start, numba, and the peers.
    """
    read = machine.get("memory_read", {})
    memory = "".join(
        f", {read[key]:.0f} GB/s read by {words}"
        for key, words in (("one_thread_GB_s", "one thread"), ("all_threads_GB_s", "all"))
        if key in read
    )
    took_part = ", ".join(
        f"{name}: {version}" for name, version in machine["peers"].items()
    )
    return [
        f"{machine['cpu']}, {machine['threads']} threads{memory}; load at start "
        f"{machine['load_at_start']:.1f}; numba {machine['numba']}. Peers: "
        f"{took_part or 'none'}.",
        "",
    ]


def _runs(cases: Sequence[dict[str, Any]]) -> list[str]:
    """Name the cases of another run than most, as a line of Markdown and an empty one; []
    if all are of one run.
    """
    runs = Counter(case.get("measured") for case in cases)
    if len(runs) < 2:
        return []
    most = runs.most_common(1)[0][0]
    others = (case["name"] for case in cases if case.get("measured") != most)
    return [f"These cases come from a different run: {', '.join(others)}.", ""]


def _cases(cases: Sequence[dict[str, Any]]) -> list[str]:
    """Make the table of cases as lines of Markdown, and an empty one.

    A column each for name, milliseconds a view (mean, median), errors, peers'
    milliseconds, ratios (of medians), load, and further figures of `SHOWN`; figures that
    a case lacks are left out.
    """
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
            f"{value:.1f}"
            + (f" ({case['median_ratio'][n]:.1f})" if "median_ratio" in case else "")
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
    """List milliseconds against rays, voxels and threads, one line of Markdown for each
    series; [] without growth.
    """
    lines = []
    for key, points in document.get("growth", {}).items():
        for series in dict.fromkeys(p["series"] for p in points):
            row = ", ".join(
                f"{p['x']:,}: {p['ms']:.2f}" for p in points if p["series"] == series
            )
            lines.append(f"- ms against {key}, {series}: {row}")
    return lines


def merged(old: Document, new: Document) -> Document:
    """Merge two runs: cases and growth that `new` did not measure are those of `old`.

    Cases are in the order of `old`, further ones last. The machine's figures are the new
    run's where it has them, with the peers of both; each case keeps its own load.
    """
    fresh = {entry["name"]: entry for entry in new["cases"]}
    cases = [fresh.pop(entry["name"], entry) for entry in old["cases"]]
    machine = {**old["machine"], **new["machine"]}
    return {
        "machine": {
            **machine,
            "peers": {**old["machine"]["peers"], **new["machine"]["peers"]},
        },
        "cases": [*cases, *fresh.values()],
        "growth": {**old["growth"], **new["growth"]},
    }


WIDTH = 900
PANEL = 300
MARGIN = 60
COLOURS = ("#1b6ca8", "#d1495b", "#2e933c", "#8f5db7")


def figure(document: dict[str, Any]) -> str:
    """Draw a benchmark document as the text of an SVG: bars of the ratios, then a panel
    for each growth that was measured.
    """
    panels = [_bars(document["cases"])]
    names = {"rays": "rays", "voxels": "voxels a side", "threads": "threads"}
    for key, label in names.items():
        points = document.get("growth", {}).get(key, [])
        if points:
            panels.append(_lines(points, label))
    height = PANEL * len(panels)
    body = "".join(
        f'<g transform="translate(0 {i * PANEL})">{panel}</g>'
        for i, panel in enumerate(panels)
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" '
        f'font-family="sans-serif" font-size="12"><rect width="{WIDTH}" height="{height}" '
        f'fill="white"/>{body}</svg>\n'
    )


def _text(x: float, y: float, text: str, anchor: str = "middle") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def _bars(cases: Sequence[dict[str, Any]]) -> str:
    """Draw how many times faster we are than the first peer of each case, one bar a case
    that has one, as SVG; a sentence without any.
    """
    bars = [(c["name"], *next(iter(c["ratio"].items()))) for c in cases if c["ratio"]]
    if not bars:
        return _text(WIDTH / 2, PANEL / 2, "no peer took part")
    top = max(ratio for _, _, ratio in bars)
    step = (WIDTH - 2 * MARGIN) / len(bars)
    parts = [_text(WIDTH / 2, 20, "times faster than the peer named above each bar")]
    for i, (name, peer, ratio) in enumerate(bars):
        x = MARGIN + i * step
        h = (PANEL - 110) * ratio / top
        y = PANEL - 40 - h
        parts.append(
            f'<rect x="{x + 0.15 * step:.1f}" y="{y:.1f}" width="{0.7 * step:.1f}" '
            f'height="{h:.1f}" fill="{COLOURS[0]}"/>'
        )
        first, *rest = name.rsplit("-", 1) if len(name) > 9 else [name]
        for line, part in enumerate((first, *rest)):
            parts.append(_text(x + step / 2, PANEL - 22 + 14 * line, part))
        parts.append(_text(x + step / 2, y - 18, peer))
        parts.append(_text(x + step / 2, y - 4, f"{ratio:.1f}"))
    return "".join(parts)


def _lines(points: Sequence[dict[str, Any]], label: str) -> str:
    """Draw milliseconds against the work, a line for each series, both axes logarithmic,
    as SVG.

    Figures are below the points of the first series, above those of the second, and
    beside those of others.

    Args:
        points: with the keys x, ms and series.
        label: of the work.
    """
    xs = [math.log10(p["x"]) for p in points]
    ys = [math.log10(p["ms"]) for p in points]
    x0, x1, y0, y1 = min(xs), max(xs), min(ys), max(ys)

    def at(x: float, y: float) -> tuple[float, float]:
        """Convert logarithms of work and milliseconds to the pixel (right, down) of the
        panel.
        """
        return (
            MARGIN + (x - x0) / max(x1 - x0, 1e-9) * (WIDTH - 2 * MARGIN),
            PANEL - 65 - (y - y0) / max(y1 - y0, 1e-9) * (PANEL - 145),
        )

    parts = [_text(WIDTH / 2, 20, f"ms a view against {label} (C1; logarithmic)")]
    for i, series in enumerate(dict.fromkeys(p["series"] for p in points)):
        its_points = [p for p in points if p["series"] == series]
        places = [at(math.log10(p["x"]), math.log10(p["ms"])) for p in its_points]
        colour = COLOURS[i % len(COLOURS)]
        line = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
        parts.append(f'<polyline points="{line}" fill="none" stroke="{colour}"/>')
        for (x, y), p in zip(places, its_points, strict=True):
            parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{colour}"/>')
            figure_of = f"{p['ms']:.3g}"
            if i < 2:
                parts.append(_text(x, y + (-8 if i else 18), figure_of))
            else:
                parts.append(_text(x + 8, y + 4, figure_of, "start"))
            if i == 0:
                parts.append(_text(x, PANEL - 22, f"{p['x']:,}"))
        parts.append(
            f'<text x="{MARGIN + 130 * i}" y="38" fill="{colour}">{escape(series)}</text>'
        )
    return "".join(parts)


def renew(folder: Path, document: Document, page: Path | None = None) -> None:
    """Merge a document into the kept one, if there is one, write both files, and draw it.

    Args:
        folder: of the pages, must exist; the kept document (bench.json) and its picture
            (bench.svg) are in `images/` there, which is made.
        document: of a new run.
        page: gets the figures between its marks, too.
    """
    picture = folder / "images" / "bench.svg"
    picture.parent.mkdir(exist_ok=True)
    stored = picture.with_suffix(".json")
    if stored.exists():
        document = merged(json.loads(stored.read_text("utf-8")), document)
    stored.write_text(json.dumps(document, indent=1) + "\n", "utf-8")
    picture.write_text(figure(document), "utf-8")
    if page is not None:
        page.write_text(
            into_page(page.read_text("utf-8"), document, "images/bench.svg"), "utf-8"
        )


def main() -> None:
    """Read a benchmark document, and renew the kept one, its picture and the figures of
    --page, in that page's folder or `docs`; with --out write bench.md and bench.svg there
    instead.
    """
    parser = argparse.ArgumentParser(description="Tables and figure of a benchmark.")
    parser.add_argument("document", type=Path, help="bench.json")
    parser.add_argument(
        "--page", type=Path, help="put the figures between this page's marks, too"
    )
    parser.add_argument(
        "--out", type=Path, help="write bench.md and bench.svg here instead"
    )
    options = parser.parse_args()
    document = json.loads(options.document.read_text("utf-8"))
    if options.out is None:
        renew(
            options.page.parent if options.page else Path("docs"), document, options.page
        )
    else:
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "bench.svg").write_text(figure(document), "utf-8")
        (options.out / "bench.md").write_text(tables(document) + "\n", "utf-8")


if __name__ == "__main__":
    main()
