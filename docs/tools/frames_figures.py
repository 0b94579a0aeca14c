"""The drawings of docs/conventions.md, made from the code's own conventions.

    python docs/tools/frames_figures.py [--out docs/images]

Every arrow, angle and pixel is computed by `flexdt.twin`; nothing is drawn from memory, so a
sign that changes in the code changes the drawing (`tests/docs` compares the two).
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

import numpy as np

from flexdt.twin.geometry.conventions import from_unity, stage_rotation
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.machine.kinematics import poses

INK = "#1f2933"
SOURCE = "#b36b00"
SAMPLE = "#14507f"
PANEL = "#9b2226"
WORLD = "#3a7d44"
FONT = 'font-family="DejaVu Sans, Verdana, sans-serif"'


class Sheet:
    """An SVG in the making: points are mm of the drawing's own plane, x right, y up."""

    def __init__(
        self, width: int, height: int, origin: tuple[float, float], scale: float
    ) -> None:
        self.width = width
        self.height = height
        self.origin = origin
        self.scale = scale
        self.parts: list[str] = []

    def at(self, point: np.ndarray) -> tuple[float, float]:
        """Convert a place (x, y) to the pixel (right, down) of the drawing."""
        return (
            self.origin[0] + self.scale * float(point[0]),
            self.origin[1] - self.scale * float(point[1]),
        )

    def line(
        self,
        a: np.ndarray,
        b: np.ndarray,
        colour: str,
        width: float = 1.5,
        more: str = "",
    ) -> None:
        """Draw a line from a to b, in places of the drawing; `more` is put among the
        element's attributes.
        """
        (x0, y0), (x1, y1) = self.at(a), self.at(b)
        self.parts.append(
            f'<line x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}" stroke="{colour}" '
            f'stroke-width="{width}" {more}/>'
        )

    def arrow(self, a: np.ndarray, b: np.ndarray, colour: str, label: str) -> None:
        """Draw an arrow from a to b with a label beyond its tip; beside it if it points
        to the right.
        """
        self.line(a, b, colour, 2.2, f'marker-end="url(#{colour[1:]})"')
        way = (b - a) / np.linalg.norm(b - a)
        where = "start" if way[0] > 0.8 else "middle"
        self.text(
            b + way * (8 if where == "start" else 16) / self.scale,
            label,
            colour,
            13,
            where,
        )

    def text(
        self,
        at: np.ndarray,
        words: str,
        colour: str = INK,
        size: int = 13,
        where: str = "middle",
    ) -> None:
        """Write words at a place, with the anchor `where` (start, middle, end) of SVG."""
        x, y = self.at(at)
        self.parts.append(
            f'<text x="{x:.1f}" y="{y + 4:.1f}" fill="{colour}" font-size="{size}" {FONT} '
            f'text-anchor="{where}">{words}</text>'
        )

    def dot(self, at: np.ndarray, colour: str, radius: float) -> None:
        """Draw a filled circle; `radius` in pixels."""
        x, y = self.at(at)
        self.parts.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius}" fill="{colour}"/>'
        )

    def ring(self, at: np.ndarray, colour: str, radius: float) -> None:
        """Draw an empty circle; `radius` in pixels."""
        x, y = self.at(at)
        self.parts.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius}" fill="none" stroke="{colour}" '
            f'stroke-width="1.5"/>'
        )

    def svg(self, title: str) -> str:
        """Return the drawing as the text of an SVG, with a title, arrow heads in each
        color and a white ground.
        """
        heads = "".join(
            f'<marker id="{c[1:]}" viewBox="0 0 10 10" refX="8" refY="5" markerWidth="6" '
            'markerHeight="6" orient="auto-start-reverse">'
            f'<path d="M0 0L10 5L0 10z" fill="{c}"/></marker>'
            for c in (INK, SOURCE, SAMPLE, PANEL, WORLD)
        )
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width} {self.height}" '
            f'width="{self.width}" role="img"><title>{title}</title><defs>{heads}</defs>'
            f'<rect width="{self.width}" height="{self.height}" fill="#ffffff"/>'
            + "\n".join(self.parts)
            + "</svg>\n"
        )


def stand(angle_deg: float) -> Poses:
    """Return the default scanner's poses (one), at a stage angle and 600 mm from the
    source.
    """
    machine = builtin_machine()
    profile = builtin_profile(machine.default_profile)
    where = {"ver_tube": 26.3, "ver_det": 20.0, "rot_obj": angle_deg, "mag_obj": 600.0}
    return poses(machine, profile, machine.detector.camera, where)


def from_above() -> str:
    """Draw source, panel, the world's and the object's frame seen from above, as SVG:
    stage at 30 deg, with the axes at 0 deg dashed, its sense of rotation, SOD and SDD.
    """
    pose = stand(30.0)
    start = stand(0.0)
    sheet = Sheet(640, 640, (300.0, 590.0), 0.48)
    source = pose.source[0, :2]
    axis = pose.axis[0, :2]
    panel = pose.detector[0, :2]
    u = pose.u[0] / np.linalg.norm(pose.u[0])
    half = 956 / 2 * float(np.linalg.norm(pose.u[0]))
    ends = panel - half * u[:2], panel + half * u[:2]
    for end in ends:
        sheet.line(source, end, "#d8dee6", 1.2)
    sheet.line(source, panel, "#d8dee6", 1.2, 'stroke-dasharray="5 4"')
    sheet.line(*ends, PANEL, 7.0)
    sheet.text(panel + [0, 38], "detector: columns grow along u", PANEL)
    sheet.arrow(panel + [0, -22], panel + 170 * u[:2] + [0, -22], PANEL, "u")
    sheet.dot(source, SOURCE, 6)
    sheet.text(source + [-30, 0], "focal spot", SOURCE, where="end")
    sheet.ring(axis, SAMPLE, 70)
    turn = stage_rotation(pose.angle[0])
    for direction, name in (((1.0, 0.0, 0.0), "x object"), ((0.0, 1.0, 0.0), "y object")):
        sheet.arrow(axis, axis + 190 * (turn @ np.array(direction))[:2], SAMPLE, name)
        before = axis + 190 * (stage_rotation(start.angle[0]) @ np.array(direction))[:2]
        sheet.line(axis, before, SAMPLE, 1.0, 'stroke-dasharray="3 4"')
    # The way a point of the sample takes while rot_obj grows to 30 deg.
    way = [
        axis + 160 * (stage_rotation(np.radians(a)) @ [0.0, 1.0, 0.0])[:2]
        for a in range(0, 31, 5)
    ]
    for a, b in itertools.pairwise(way[:-1]):
        sheet.line(a, b, SAMPLE, 2.0)
    sheet.line(way[-2], way[-1], SAMPLE, 2.0, f'marker-end="url(#{SAMPLE[1:]})"')
    sheet.text(axis + [170, 150], "rot_obj +30 deg: clockwise", SAMPLE, where="start")
    corner = np.array([340.0, 40.0])
    sheet.arrow(corner, corner + [120, 0], WORLD, "+x")
    sheet.arrow(corner, corner + [0, 120], WORLD, "+y")
    sheet.text(corner + [62, -42], "world (+z towards you)", WORLD)
    sheet.line(
        source + [-210, 0],
        axis + [-210 - axis[0] + source[0], 0],
        INK,
        1.0,
        f'marker-end="url(#{INK[1:]})" marker-start="url(#{INK[1:]})"',
    )
    sheet.text(
        (source + axis) / 2 + [-225, 0], f"SOD {pose.sod[0]:.0f}", INK, where="end"
    )
    sheet.line(
        source + [-420, 0],
        panel + [-420 - panel[0] + source[0], 0],
        INK,
        1.0,
        f'marker-end="url(#{INK[1:]})" marker-start="url(#{INK[1:]})"',
    )
    sheet.text(
        (source + panel) / 2 + [-435, 0], f"SDD {pose.sdd[0]:.0f}", INK, where="end"
    )
    return sheet.svg("World and object frame from above at rot_obj = 30 deg")


def detector() -> str:
    """Draw the panel seen from the source, with the pixels at which points of the object
    are seen at 0 deg, as SVG.
    """
    pose = stand(0.0)
    rows, cols = builtin_machine().detector.camera.shape
    cone = pose.cone_vec()
    sheet = Sheet(640, 470, (60.0, 36.0), 0.52)

    def place(pixel: np.ndarray) -> np.ndarray:
        return np.array([pixel[0], -pixel[1]])

    corners = [place(np.array(c)) for c in ((0, 0), (cols, 0), (cols, rows), (0, rows))]
    for a, b in zip(corners, corners[1:] + corners[:1], strict=True):
        sheet.line(a, b, PANEL, 1.5)
    sheet.arrow(place(np.array([50, 40])), place(np.array([190, 40])), PANEL, "u: column")
    sheet.arrow(place(np.array([50, 40])), place(np.array([50, 200])), PANEL, "v: row")
    sheet.dot(place(np.array([0, 0])), PANEL, 5)
    sheet.text(place(np.array([0, -22])), "frame[0, 0]", PANEL, where="start")
    points = np.array([[0, 0, 0], [20, 0, 0], [0, 0, 20], [0, 150, 0]], dtype=float)
    pixels = cone.project_points(points, (rows, cols))[0]
    middle = place(pixels[0])
    for pixel, name, colour in zip(
        pixels[1:3], ("+20 mm x", "+20 mm z"), (WORLD, WORLD), strict=True
    ):
        sheet.arrow(middle, place(pixel), colour, name)
    sheet.dot(middle, SAMPLE, 5)
    sheet.text(middle + [14, -26], "object's origin", SAMPLE, where="start")
    pitch = np.linalg.norm(pose.u[0])
    words = f"{cols} x {rows} pixels of {pitch:.4f} mm, seen from the source"
    sheet.text(place(np.array([cols / 2, rows + 34])), words)
    return sheet.svg("The image seen from the source")


def unity() -> str:
    """Draw the thesis's axes (left-handed) beside ours, each with its meaning, as SVG."""
    sheet = Sheet(640, 250, (110.0, 190.0), 1.0)
    slant = np.array([0.6, 0.45])

    def flat(vector: np.ndarray) -> np.ndarray:
        return np.array([vector[0], vector[2]]) + vector[1] * slant

    for i, (title, convert) in enumerate(
        (("Unity (thesis): left-handed", True), ("flexdt: right-handed", False))
    ):
        base = np.array([i * 310.0, 0.0])
        for name, axis in zip("xyz", np.eye(3), strict=True):
            world = from_unity(axis) if convert else axis
            meaning = ("traversal", "magnification", "height")[
                int(np.argmax(np.abs(world)))
            ]
            colour = (PANEL, WORLD, SAMPLE)["xyz".index(name)]
            tip = base + 100 * flat(world)
            sheet.arrow(base, tip, colour, "")
            sheet.text(
                tip + 100 * flat(world) * 0.1 + [6, 6],
                f"{name}: {meaning}",
                colour,
                where="start",
            )
        sheet.text(base + [40, -40], title, INK, 14)
    return sheet.svg("The thesis's axes beside ours")


FIGURES = {
    "frames-from-above.svg": from_above,
    "frames-detector.svg": detector,
    "frames-unity.svg": unity,
}


def main() -> None:
    """Write every figure of `FIGURES` into the folder --out, and print its path."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "images")
    out = parser.parse_args().out
    for name, draw in FIGURES.items():
        (out / name).write_text(draw(), encoding="utf-8")
        print(out / name)


if __name__ == "__main__":
    main()
