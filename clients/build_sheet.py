"""Building instructions of a designed phantom: one picture per brick or level, and a page of them.

A picture is a list of plain marks, drawn once as SVG for the page and once as PNG. It refuses to
know why the beads are where they are.
"""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from flexdt.clients.figures import COLOURS

if TYPE_CHECKING:
    from flexdt.phantoms.bricks import Brickwork

SCALE = 12.0
"""SVG units, and PNG pixels, per millimetre."""
MARGIN_MM = 5.5
BRICK, HOLE, TUBE, LINE, TEXT = "#f2d16b", "#fffaf0", "#e3b93f", "#7a6420", "#222222"
BEAD = COLOURS[1]


@dataclass(frozen=True)
class Rect:
    """A filled rectangle about (x, y)."""

    x: float
    y: float
    w: float
    h: float
    fill: str


@dataclass(frozen=True)
class Disc:
    """A filled circle."""

    x: float
    y: float
    r: float
    fill: str


@dataclass(frozen=True)
class Label:
    """Text centred on (x, y); size in mm."""

    x: float
    y: float
    text: str
    size: float = 1.5


@dataclass(frozen=True)
class Line:
    """A thin line."""

    x0: float
    y0: float
    x1: float
    y1: float


Mark = Rect | Disc | Label | Line


@dataclass(frozen=True)
class Picture:
    """Marks [mm, x right, y down] on a sheet of some size about the origin.

    Attributes:
        title: what it shows.
        width, height: [mm].
        marks: in drawing order.
        steps: what to do, one line each.
    """

    title: str
    width: float
    height: float
    marks: tuple[Mark, ...]
    steps: tuple[str, ...]

    def svg(self) -> str:
        """As an SVG element."""
        parts = [_svg(mark, self.width / 2.0, self.height / 2.0) for mark in self.marks]
        w, h = self.width * SCALE, self.height * SCALE
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {w:g} {h:g}" width="{w:g}" '
            f'role="img" aria-label="{html.escape(self.title)}" font-family="sans-serif">'
            f'<rect width="{w:g}" height="{h:g}" fill="#ffffff"/>{"".join(parts)}</svg>'
        )

    def png(self) -> bytes:
        """As a PNG file."""
        import cv2

        h, w = round(self.height * SCALE), round(self.width * SCALE)
        image = np.full((h, w, 3), 255, dtype=np.uint8)
        for mark in self.marks:
            _paint(image, mark, self.width / 2.0, self.height / 2.0)
        done, data = cv2.imencode(".png", image)
        assert done
        return bytes(data)


def brick_pictures(work: Brickwork, beads: npt.NDArray[np.float64], radius: float) -> list[Picture]:
    """One picture for each brick, seen from below, lowest brick first."""
    v = work.measures
    wide, deep, _ = work.size_mm
    owner = np.floor((beads[:, 2] - work.floor(0)) / v["brick_height_mm"]).astype(int)
    inner = (wide - 2 * v["wall_mm"], deep - 2 * v["wall_mm"])
    out = []
    for brick in range(work.bricks):
        marks: list[Mark] = [Rect(0, 0, wide, deep, BRICK), Rect(0, 0, *inner, HOLE)]
        for x, y in work.tubes_at().tolist():
            marks.append(Disc(x, y, v["tube_outer_diameter_mm"] / 2, TUBE))
            marks.append(Disc(x, y, v["tube_inner_diameter_mm"] / 2, HOLE))
        steps = []
        for k in np.flatnonzero(owner == brick):
            x, y, z = beads[k].tolist()
            up = z - work.floor(brick)
            # Seen from below with +x to the right, the source's side (-y) is at the top.
            marks += _bead(x, y, radius, f"{k + 1}")
            edge = "towards the source" if y < 0 else "away from the source"
            side = "left" if x < 0 else "right"
            steps.append(
                f"bead {k + 1}: centre {wide / 2 - abs(x):.2f} mm from the {side} outer face, "
                f"{deep / 2 - abs(y):.2f} mm from the outer face {edge}, {up:.2f} mm above "
                f"the brick's lower edge"
            )
        marks += _edges(wide, deep)
        out.append(
            Picture(
                f"Brick {brick + 1} of {work.bricks}{' (lowest)' if brick == 0 else ''}, seen from "
                "below",
                wide + 2 * MARGIN_MM,
                deep + 2 * MARGIN_MM,
                tuple(marks),
                tuple(steps) if steps else ("no bead in this brick",),
            )
        )
    return out


def level_pictures(
    size: Sequence[float], beads: npt.NDArray[np.float64], radius: float
) -> list[Picture]:
    """One picture for each height at which a block holds beads, seen from above, lowest first."""
    wide, deep, tall = size
    out = []
    for z in sorted({round(float(b), 3) for b in beads[:, 2]}):
        marks: list[Mark] = [Rect(0, 0, wide, deep, BRICK)]
        steps = []
        for k in np.flatnonzero(np.isclose(beads[:, 2], z, atol=6e-4)):
            x, y, _ = beads[k].tolist()
            marks += _bead(x, -y, radius, f"{k + 1}")
            steps.append(
                f"bead {k + 1}: x = {x:+.2f} mm, y = {y:+.2f} mm from the axis; interrupt the "
                f"print {z + tall / 2:.2f} mm above the lowest face and press the bead in"
            )
        marks += _edges(wide, deep, above=True)
        out.append(
            Picture(
                f"{z + tall / 2:.2f} mm above the lowest face, seen from above",
                wide + 2 * MARGIN_MM,
                deep + 2 * MARGIN_MM,
                tuple(marks),
                tuple(steps),
            )
        )
    return out


def page(
    title: str,
    lead: Iterable[str],
    table: Sequence[Sequence[str]],
    header: Sequence[str],
    pictures: Sequence[Picture],
    notes: Mapping[str, str],
) -> str:
    """The instruction as one HTML file without any other."""
    e = html.escape
    head = "".join(f"<th>{e(word)}</th>" for word in header)
    rows = "".join(
        "<tr>" + "".join(f"<td>{e(cell)}</td>" for cell in row) + "</tr>" for row in table
    )
    figures = "".join(
        f"<section><h2>{e(p.title)}</h2>{p.svg()}<ul>"
        + "".join(f"<li>{e(step)}</li>" for step in p.steps)
        + "</ul></section>"
        for p in pictures
    )
    facts = "".join(f"<dt>{e(k)}</dt><dd>{e(v)}</dd>" for k, v in notes.items())
    paragraphs = "".join(f"<p>{e(line)}</p>" for line in lead)
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{e(title)}</title>'
        f"<style>{_STYLE}</style><h1>{e(title)}</h1>{paragraphs}"
        f"<table><tr>{head}</tr>{rows}</table><main>{figures}</main><dl>{facts}</dl></html>\n"
    )


_STYLE = """
body{font:15px/1.5 system-ui,sans-serif;max-width:70rem;margin:2rem auto;padding:0 1rem;color:#222}
main{display:grid;grid-template-columns:repeat(auto-fill,minmax(26rem,1fr));gap:1rem}
section{border:1px solid #ddd;border-radius:6px;padding:0 1rem}
h2{font-size:1rem}svg{max-width:100%;height:auto}
table{border-collapse:collapse;margin:1rem 0}td,th{border:1px solid #ddd;padding:.2rem .7rem}
td{text-align:right;font-variant-numeric:tabular-nums}td:first-child{text-align:left}
dt{font-weight:600}
"""


def _bead(x: float, y: float, radius: float, name: str) -> list[Mark]:
    return [
        Line(x - 2.2 * radius, y, x + 2.2 * radius, y),
        Line(x, y - 2.2 * radius, x, y + 2.2 * radius),
        Disc(x, y, radius, BEAD),
        Label(x, y, name, 1.3),
    ]


def _edges(wide: float, deep: float, above: bool = False) -> list[Mark]:
    source, away = "edge towards the source", "edge towards the detector"
    top, bottom = (away, source) if above else (source, away)
    return [
        Label(0, -deep / 2 - 3.0, top),
        Label(0, deep / 2 + 3.0, bottom),
        Label(-wide / 2 - 2.8, 0, "left", 1.3),
        Label(wide / 2 + 2.8, 0, "right", 1.3),
    ]


def _svg(mark: Mark, dx: float, dy: float) -> str:
    s = SCALE
    match mark:
        case Rect(x, y, w, h, fill):
            left, top = (x - w / 2 + dx) * s, (y - h / 2 + dy) * s
            return (
                f'<rect x="{left:.1f}" y="{top:.1f}" width="{w * s:.1f}" height="{h * s:.1f}" '
                f'fill="{fill}" stroke="{LINE}"/>'
            )
        case Disc(x, y, r, fill):
            return (
                f'<circle cx="{(x + dx) * s:.1f}" cy="{(y + dy) * s:.1f}" r="{r * s:.1f}" '
                f'fill="{fill}" stroke="{LINE}"/>'
            )
        case Line(x0, y0, x1, y1):
            return (
                f'<line x1="{(x0 + dx) * s:.1f}" y1="{(y0 + dy) * s:.1f}" '
                f'x2="{(x1 + dx) * s:.1f}" y2="{(y1 + dy) * s:.1f}" stroke="{LINE}"/>'
            )
        case Label(x, y, text, size):
            return (
                f'<text x="{(x + dx) * s:.1f}" y="{(y + dy) * s:.1f}" font-size="{size * s:.1f}" '
                f'fill="{TEXT}" text-anchor="middle" dominant-baseline="central">'
                f"{html.escape(text)}</text>"
            )


def _paint(image: npt.NDArray[np.uint8], mark: Mark, dx: float, dy: float) -> None:
    import cv2

    def at(x: float, y: float) -> tuple[int, int]:
        return round((x + dx) * SCALE), round((y + dy) * SCALE)

    line = _bgr(LINE)
    match mark:
        case Rect(x, y, w, h, fill):
            corners = at(x - w / 2, y - h / 2), at(x + w / 2, y + h / 2)
            cv2.rectangle(image, *corners, _bgr(fill), -1)
            cv2.rectangle(image, *corners, line, 1, cv2.LINE_AA)
        case Disc(x, y, r, fill):
            cv2.circle(image, at(x, y), round(r * SCALE), _bgr(fill), -1, cv2.LINE_AA)
            cv2.circle(image, at(x, y), round(r * SCALE), line, 1, cv2.LINE_AA)
        case Line(x0, y0, x1, y1):
            cv2.line(image, at(x0, y0), at(x1, y1), line, 1, cv2.LINE_AA)
        case Label(x, y, text, size):
            scale, font = size * SCALE / 30.0, cv2.FONT_HERSHEY_SIMPLEX
            (w, h), _ = cv2.getTextSize(text, font, scale, 1)
            px, py = at(x, y)
            cv2.putText(
                image, text, (px - w // 2, py + h // 2), font, scale, _bgr(TEXT), 1, cv2.LINE_AA
            )


def _bgr(colour: str) -> tuple[int, int, int]:
    return int(colour[5:7], 16), int(colour[3:5], 16), int(colour[1:3], 16)
