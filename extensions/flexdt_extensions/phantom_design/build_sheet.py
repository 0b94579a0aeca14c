"""Building instructions of a designed phantom: a drawing and a list of steps for each brick of a
stack, or for each height at which a block holds beads."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from flexdt.clients.figures import COLOURS, DPI, blank, svg
from flexdt_extensions.phantom_design.seats import tubes_at

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from flexdt.phantoms.bricks import Brickwork

SCALE = 12.0
"""Pixels per millimetre."""
MARGIN_MM = 5.5
BRICK, HOLE, TUBE, LINE = "#f2d16b", "#fffaf0", "#e3b93f", "#7a6420"
BEAD = COLOURS[1]


@dataclass(frozen=True)
class Drawing:
    """One drawing of the instructions.

    Attributes:
        title: what it shows.
        figure: to scale, x to the right and y down [mm] from the middle.
        steps: what to do, one line each.
    """

    title: str
    figure: Figure
    steps: tuple[str, ...]

    def svg(self) -> str:
        """As an SVG element."""
        return svg(self.figure)

    def png(self) -> bytes:
        """As a PNG file."""
        file = io.BytesIO()
        self.figure.savefig(file, format="png", dpi=DPI)
        return file.getvalue()


def brick_drawings(
    work: Brickwork, beads: npt.NDArray[np.float64], radius: float
) -> Iterator[Drawing]:
    """One drawing for each brick, seen from below, lowest brick first.

    Args:
        work: the stack.
        beads: centres (k, 3) in the object's frame [mm].
        radius: of a bead [mm].
    """
    v = work.measures
    wide, deep, _ = work.size_mm
    owner = np.floor((beads[:, 2] - work.floor(0)) / v["brick_height_mm"]).astype(int)
    for brick in range(work.bricks):
        # Seen from below with +x to the right, the source's side (-y) is at the top.
        axes = _sheet(wide, deep, top="towards the source", bottom="towards the detector")
        _rectangle(axes, wide - 2 * v["wall_mm"], deep - 2 * v["wall_mm"], HOLE)
        for x, y in tubes_at(work).tolist():
            _disc(axes, x, y, v["tube_outer_diameter_mm"] / 2, TUBE)
            _disc(axes, x, y, v["tube_inner_diameter_mm"] / 2, HOLE)
        steps = []
        for k in np.flatnonzero(owner == brick):
            x, y, z = beads[k].tolist()
            _bead(axes, x, y, radius, int(k) + 1)
            edge = "towards the source" if y < 0 else "away from the source"
            side = "left" if x < 0 else "right"
            steps.append(
                f"bead {k + 1}: centre {wide / 2 - abs(x):.2f} mm from the {side} outer face, "
                f"{deep / 2 - abs(y):.2f} mm from the outer face {edge}, "
                f"{z - work.floor(brick):.2f} mm above the brick's lower edge"
            )
        lowest = " (lowest)" if brick == 0 else ""
        yield Drawing(
            f"Brick {brick + 1} of {work.bricks}{lowest}, seen from below",
            axes.get_figure(root=True),  # type: ignore[arg-type]
            tuple(steps) or ("no bead in this brick",),
        )


def level_drawings(
    size: Sequence[float], beads: npt.NDArray[np.float64], radius: float
) -> Iterator[Drawing]:
    """One drawing for each height at which a block holds beads, seen from above, lowest first.

    Args:
        size: of the block along x, y and z [mm].
        beads: centres (k, 3) in the object's frame [mm].
        radius: of a bead [mm].
    """
    wide, deep, tall = size
    for z in sorted({round(float(b), 3) for b in beads[:, 2]}):
        axes = _sheet(wide, deep, top="towards the detector", bottom="towards the source")
        steps = []
        for k in np.flatnonzero(np.isclose(beads[:, 2], z, atol=6e-4)):
            x, y, _ = beads[k].tolist()
            _bead(axes, x, -y, radius, int(k) + 1)
            steps.append(
                f"bead {k + 1}: x = {x:+.2f} mm, y = {y:+.2f} mm from the axis; interrupt the "
                f"print {z + tall / 2:.2f} mm above the lowest face and press the bead in"
            )
        yield Drawing(
            f"{z + tall / 2:.2f} mm above the lowest face, seen from above",
            axes.get_figure(root=True),  # type: ignore[arg-type]
            tuple(steps),
        )


def _sheet(wide: float, deep: float, top: str, bottom: str) -> Axes:
    """The outline of a brick or block, its edges named, on axes that fill a figure."""
    w, h = wide + 2 * MARGIN_MM, deep + 2 * MARGIN_MM
    figure = blank(w * SCALE, h * SCALE)
    figure.set_layout_engine("none")
    axes = figure.add_axes((0, 0, 1, 1), xlim=(-w / 2, w / 2), ylim=(h / 2, -h / 2))
    axes.set_axis_off()
    _rectangle(axes, wide, deep, BRICK)
    _label(axes, 0, -deep / 2 - 3.0, f"edge {top}")
    _label(axes, 0, deep / 2 + 3.0, f"edge {bottom}")
    _label(axes, -wide / 2 - 2.8, 0, "left", 1.3)
    _label(axes, wide / 2 + 2.8, 0, "right", 1.3)
    return axes


def _rectangle(axes: Axes, wide: float, deep: float, fill: str) -> None:
    from matplotlib.patches import Rectangle

    axes.add_patch(Rectangle((-wide / 2, -deep / 2), wide, deep, fc=fill, ec=LINE))


def _disc(axes: Axes, x: float, y: float, radius: float, fill: str, above: int = 1) -> None:
    from matplotlib.patches import Circle

    axes.add_patch(Circle((x, y), radius, fc=fill, ec=LINE, zorder=above))


def _bead(axes: Axes, x: float, y: float, radius: float, number: int) -> None:
    reach = 2.2 * radius
    axes.plot([x - reach, x + reach], [y, y], color=LINE, lw=1.0)
    axes.plot([x, x], [y - reach, y + reach], color=LINE, lw=1.0)
    _disc(axes, x, y, radius, BEAD, above=3)  # over the cross
    _label(axes, x, y, str(number), 1.3)


def _label(axes: Axes, x: float, y: float, text: str, size_mm: float = 1.5) -> None:
    axes.text(x, y, text, ha="center", va="center", size=size_mm * SCALE, zorder=4)
