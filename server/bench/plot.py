"""The benchmark's figures as one SVG file: bars of ratios, lines of growth. No plotting library."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import Any

WIDTH, PANEL, MARGIN = 900, 300, 60
COLOURS = ("#1b6ca8", "#d1495b", "#2e933c", "#8f5db7")


def figure(document: dict[str, Any]) -> str:
    """SVG text of a benchmark document."""
    panels = [_bars(document["cases"])]
    names = {"rays": "rays", "voxels": "voxels a side", "threads": "threads"}
    for key, label in names.items():
        points = document.get("growth", {}).get(key, [])
        if points:
            panels.append(_lines(points, label))
    height = PANEL * len(panels)
    body = "".join(
        f'<g transform="translate(0 {i * PANEL})">{panel}</g>' for i, panel in enumerate(panels)
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" '
        f'font-family="sans-serif" font-size="12"><rect width="{WIDTH}" height="{height}" '
        f'fill="white"/>{body}</svg>\n'
    )


def _text(x: float, y: float, text: str, anchor: str = "middle") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def _bars(cases: Sequence[dict[str, Any]]) -> str:
    """Times faster than the first peer, one bar a case."""
    bars = [(c["name"], *next(iter(c["ratio"].items()))) for c in cases if c["ratio"]]
    if not bars:
        return _text(WIDTH / 2, PANEL / 2, "no peer took part")
    top = max(ratio for _, _, ratio in bars)
    step = (WIDTH - 2 * MARGIN) / len(bars)
    parts = [_text(WIDTH / 2, 20, "times faster than the peer named above each bar")]
    for i, (name, peer, ratio) in enumerate(bars):
        x, h = MARGIN + i * step, (PANEL - 110) * ratio / top
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
    """Milliseconds against the work, both logarithmic; figures above, below or beside a line."""
    xs = [math.log10(p["x"]) for p in points]
    ys = [math.log10(p["ms"]) for p in points]
    x0, x1, y0, y1 = min(xs), max(xs), min(ys), max(ys)

    def at(x: float, y: float) -> tuple[float, float]:
        return (
            MARGIN + (x - x0) / max(x1 - x0, 1e-9) * (WIDTH - 2 * MARGIN),
            PANEL - 65 - (y - y0) / max(y1 - y0, 1e-9) * (PANEL - 145),
        )

    parts = [_text(WIDTH / 2, 20, f"ms a view against {label} (C1; logarithmic)")]
    for i, series in enumerate(dict.fromkeys(p["series"] for p in points)):
        own = [p for p in points if p["series"] == series]
        places = [at(math.log10(p["x"]), math.log10(p["ms"])) for p in own]
        colour = COLOURS[i % len(COLOURS)]
        line = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
        parts.append(f'<polyline points="{line}" fill="none" stroke="{colour}"/>')
        for (x, y), p in zip(places, own, strict=True):
            parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{colour}"/>')
            figure_of = f"{p['ms']:.3g}"
            if i < 2:
                parts.append(_text(x, y + (-8 if i else 18), figure_of))
            else:
                parts.append(_text(x + 8, y + 4, figure_of, "start"))
            if i == 0:
                parts.append(_text(x, PANEL - 22, f"{p['x']:,}"))
        parts.append(f'<text x="{MARGIN + 130 * i}" y="38" fill="{colour}">{escape(series)}</text>')
    return "".join(parts)
