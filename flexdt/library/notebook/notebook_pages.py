"""Show volumes, data sets and geometries in a notebook, with sliders: pages of HTML by
themselves.

The pages need no package and no server: the images are in them, and a slider shows one of them.
They are kept when a notebook is saved, and `save` writes them as files. `notebook_show`
shows volumes live where ipywidgets is installed.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.library.datasets.pictures import png_of, round_length
from flexdt.library.notebook.notebook_slices import AXES, grey_of, layer_of, window_of
from flexdt.runtime.files.whole_files import write_whole
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.panel_corners import panel_corners

if TYPE_CHECKING:
    from flexdt.library.datasets.image_set import ImageSet
    from flexdt.twin.geometry.cone_vec import ConeVec
    from flexdt.twin.projection import Volume

MAX_PICTURES: Final = 24
"""Pictures behind a slider; of more, so many are taken, evenly spread."""
SIDE_PX: Final = 320
"""Longest side of a picture."""
DRAWING_PX: Final = 420
"""Side of the drawing of a geometry."""
MARGIN_SHARE: Final = 0.06
"""Free margin around a geometry, as a share of the drawing's side."""
DOT_PX: Final = 2.5
"""Radius of the dot of a source's place."""
AXIS_COLOUR: Final = "#456"
ELEVATION_DEG: Final = 30.0
"""Of the eye above the plane of the turn, in the drawing of a geometry."""
NOT_DRAWN: Final = ' style="display:none"'
HIDE_DRAWN: Final = "e.style.display = i == this.value ? '' : 'none'"
"""As `hidden`, which SVG does not know."""
SHOW_CHOSEN: Final = (
    "for (const [i, e] of [...this.parentNode.querySelectorAll('[data-of]')].entries()) "
    "e.hidden = i != this.value; this.nextElementSibling.textContent = "
    "this.parentNode.querySelectorAll('[data-of]')[this.value].dataset.of"
)
"""Handler of a slider: shows the chosen picture of its row, and its name."""


@dataclass(frozen=True)
class NotebookPage:
    """A page that a notebook shows, and `save` writes.

    Attributes:
        html: the page's content, without `html` and `body`.
        title: of a file that it is saved to.
    """

    html: str
    title: str

    def _repr_html_(self) -> str:
        return self.html

    def __repr__(self) -> str:
        return f"<NotebookPage of {self.title}: {len(self.html) >> 10} kB of HTML>"

    def save(self, file: Any) -> None:
        """Write it as an HTML file that needs nothing else. Raises OSError: it cannot be
        written."""
        head = f'<!doctype html><meta charset="utf-8"><title>{escape(self.title)}</title>'
        write_whole(Path(file), f"{head}\n{self.html}\n")


def volume_page(volume: Volume, window: Sequence[float] | None = None) -> NotebookPage:
    """Show the layers of a volume along its three axes, a slider for each.

    Args:
        volume: is seen from above, from the front and from the right.
        window: attenuation of black and of white [1/mm]; None: percentiles of the volume.

    Returns:
        A page; each slider chooses among at most `MAX_PICTURES` layers and starts at the
        middle one. The line below states the window.

    Raises:
        TwinError: the window is not two growing numbers.
    """
    low, high = window_of(volume.data, window)
    data = volume.data
    centers = volume.centers()
    parts = []
    for name, axis, across in AXES:
        places = centers["xyz".index(name)]
        shown = _slider_indices(len(places))
        pictures = [
            (f"{name} = {places[i]:.4g} mm", _grey(layer_of(data, axis, i), low, high))
            for i in shown
        ]
        sizes = [volume.voxel_xyz["xyz".index(one)] for one in across]
        middle = len(pictures) // 2
        parts.append(_sliding(pictures, f"across {name}", sizes[1] / sizes[0], middle))
    caption = f"{volume!r}".strip("<>")
    return NotebookPage(
        _row(parts)
        + f"<div>{escape(caption)}; black {low:.4g}, white {high:.4g} 1/mm</div>",
        caption,
    )


def data_page(data: ImageSet) -> NotebookPage:
    """Show the projections of a data set behind a slider, and the sinogram of its middle
    row.

    At most `MAX_PICTURES` of the projections that are present, evenly spread, all in one
    gray window by percentiles. The sinogram has the rows of these, views downwards.

    Args:
        data: line integrals are shown, or counts where there is no flat image.

    Raises:
        DatasetError: an image cannot be read.
        TwinError: no projection is present.
    """
    present = data.present
    has_flat = bool(data.flats) or (
        data.arrays is not None and data.arrays.flats is not None
    )
    read = data.line_integrals if has_flat else data.counts
    chosen = [present[i] for i in _slider_indices(len(present))]
    images = [np.asarray(read(i), dtype=np.float32) for i in chosen]
    if not images:
        raise TwinError(f"{data.where}: no projections to show", {"path": data.where})
    low, high = window_of(np.stack([_small(image) for image in images]), None)
    quantity = "line integrals" if has_flat else "counts"
    pictures = [
        (f"{i}: {data.frames[i].file}", _grey(image, low, high))
        for i, image in zip(chosen, images, strict=True)
    ]
    middle = data.shape[0] // 2
    sinogram = np.stack([image[middle] for image in images])
    tall = np.repeat(sinogram, max(1, SIDE_PX // (2 * len(sinogram))), axis=0)
    parts = [
        _sliding(pictures, quantity),
        _sliding(
            [(f"row {middle}, views downwards", _grey(tall, low, high))], "sinogram"
        ),
    ]
    caption = f"{data!r}".strip("<>")
    return NotebookPage(_row(parts) + f"<div>{escape(caption)}</div>", caption)


def geometry_page(cone_vec: ConeVec) -> NotebookPage:
    """Draw source, panel and sample of each view, with one scale along all axes.

    A slider chooses among at most `MAX_PICTURES` views, from the first one on. The line
    below states the drawing's width [mm].

    Args:
        cone_vec: views in the object's frame; without a detector's shape the panel is a
            point.
    """
    drawing = _Drawing.of(cone_vec)
    shown = _slider_indices(len(cone_vec))
    pictures = [
        f'<g data-of="view {i} of {len(cone_vec)}"{"" if k == 0 else NOT_DRAWN}>'
        f"{drawing.view(cone_vec, i)}</g>"
        for k, i in enumerate(shown)
    ]
    svg = (
        f'<svg width="{DRAWING_PX}" height="{DRAWING_PX}" role="img" '
        f'aria-label="geometry of {len(cone_vec)} views">{drawing.still(cone_vec)}'
        f"{''.join(pictures)}</svg>"
    )
    handler = SHOW_CHOSEN.replace("e.hidden = i != this.value", HIDE_DRAWN)
    caption = f"{cone_vec!r}".strip("<>")
    slider = _slider(len(shown), "view", handler, 0)
    scale = (
        f"{drawing.millimetres:.4g} mm across, axes of the object [mm]; red source, orange "
        "panel, circle sample"
    )
    return NotebookPage(
        f"<div>{svg}<br>{slider}<span>view {shown[0]} of {len(cone_vec)}</span></div>"
        f"<div>{escape(caption)}; {scale}</div>",
        caption,
    )


@dataclass(frozen=True)
class _Drawing:
    """A parallel projection of the object's frame onto a square.

    Attributes:
        middle: of the drawn bodies (x, y, z) [mm].
        millimetres: along the square's side.
        radius_mm: of the circle drawn for the sample.
    """

    middle: npt.NDArray[np.float64]
    millimetres: float
    radius_mm: float

    @classmethod
    def of(cls, cone_vec: ConeVec) -> _Drawing:
        """Choose the scale at which sources, panels and sample fit into the drawing.

        The width is the diagonal of their bounding box, the origin included, with
        `MARGIN_SHARE` at both ends. The sample's radius is half the panel's width scaled
        to the axis by the nearest source; a panel without shape is 1 pixel wide.

        Args:
            cone_vec: all views.
        """
        ends = np.concatenate([cone_vec.source, cone_vec.detector, np.zeros((1, 3))])
        if cone_vec.detector_shape is not None:
            ends = np.concatenate([ends, *panel_corners(cone_vec)])
        low = ends.min(axis=0)
        high = ends.max(axis=0)
        half = np.linalg.norm(cone_vec.source, axis=1).min()
        wide = cone_vec.detector_shape or (1, 1)
        panel = 0.5 * wide[1] * float(np.linalg.norm(cone_vec.u[0]))
        reach = float(np.linalg.norm(cone_vec.source[0] - cone_vec.detector[0]))
        return cls(
            0.5 * (low + high),
            float(np.linalg.norm(high - low)) * (1.0 + 2.0 * MARGIN_SHARE),
            float(half) * panel / max(reach, 1e-9),
        )

    def point(self, place: npt.ArrayLike) -> tuple[float, float]:
        """Return the pixel (right, down) at which the oblique drawing has a place (x, y,
        z) [mm]; x points right, y and z up.
        """
        x, y, z = np.asarray(place, dtype=float) - self.middle
        slope = np.radians(ELEVATION_DEG)
        up = z * np.cos(slope) + y * np.sin(slope)
        scale = DRAWING_PX / self.millimetres
        return DRAWING_PX / 2 + scale * float(x), DRAWING_PX / 2 - scale * float(up)

    def still(self, cone_vec: ConeVec) -> str:
        """Draw the parts that all views share, as SVG: axes, places of the source, and
        the sample as a circle at the origin, with a radius of at least 2 px.

        The source is a dot in each of at most `MAX_PICTURES` views.
        """
        dots = "".join(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{DOT_PX}" fill="#d33" opacity=".6"/>'
            for x, y in (
                self.point(cone_vec.source[i]) for i in _slider_indices(len(cone_vec))
            )
        )
        x, y = self.point((0.0, 0.0, 0.0))
        radius = max(2.0, self.radius_mm * DRAWING_PX / self.millimetres)
        return (
            self.axes()
            + dots
            + (
                f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}" fill="none" stroke="#456"/>'
            )
        )

    def axes(self) -> str:
        """Draw the object's axes from its origin, each with its name and length [mm], as
        SVG.

        The length is a quarter of the drawing's width, rounded by `round_length`.
        """
        length = round_length(self.millimetres / 4)
        x0, y0 = self.point((0.0, 0.0, 0.0))
        parts = []
        for k, name in enumerate("xyz"):
            x, y = self.point(length * np.eye(3)[k])
            parts.append(
                f'<line class="axis" x1="{x0:.1f}" y1="{y0:.1f}" x2="{x:.1f}" y2="{y:.1f}" '
                f'stroke="{AXIS_COLOUR}"/><text x="{x + 3:.1f}" y="{y - 3:.1f}" '
                f'font-size="11" fill="{AXIS_COLOUR}">{name} {length:g} mm</text>'
            )
        return "".join(parts)

    def view(self, cone_vec: ConeVec, index: int) -> str:
        """Draw one view: source, central ray and panel.

        Without a panel's shape the panel is a point.

        Args:
            cone_vec: all views.
            index: of the view.

        Returns:
            SVG elements.
        """
        source, centre = (
            self.point(place[index]) for place in (cone_vec.source, cone_vec.detector)
        )
        corners = [centre]
        if cone_vec.detector_shape is not None:
            (panel,) = panel_corners(cone_vec[index : index + 1])
            corners = [self.point(corner) for corner in panel]
        outline = " ".join(f"{x:.1f},{y:.1f}" for x, y in corners)
        return (
            f'<line x1="{source[0]:.1f}" y1="{source[1]:.1f}" x2="{centre[0]:.1f}" '
            f'y2="{centre[1]:.1f}" stroke="#888" stroke-dasharray="3"/>'
            f'<polygon points="{outline}" fill="#f80" fill-opacity=".3" stroke="#f80"/>'
            f'<circle cx="{source[0]:.1f}" cy="{source[1]:.1f}" r="4" fill="#d33"/>'
        )


def _slider_indices(count: int) -> list[int]:
    """Choose `MAX_PICTURES` evenly spread indices below `count`, ascending; all of
    fewer.
    """
    if not count:
        return []
    spread = np.linspace(0, count - 1, min(count, MAX_PICTURES))
    return [int(i) for i in np.unique(spread.round())]


def _small(image: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Take every so many pixels of an image, so that no side exceeds SIDE_PX."""
    step = max(1, -(-max(image.shape) // SIDE_PX))
    return image[::step, ::step]


def _grey(image: npt.NDArray[Any], low: float, high: float) -> npt.NDArray[np.uint8]:
    return grey_of(_small(image).astype(np.float64), low, high)


def _slider(count: int, what: str, handler: str, start: int) -> str:
    """Write a slider with the values 0 to count - 1 as HTML; hidden for a single picture.

    `count`: positions; `what`: its label; `handler`: JavaScript to run when it moves; `start`:
    first position.
    """
    hidden = " hidden" if count < 2 else ""
    return (
        f'<input type="range" min="0" max="{max(count - 1, 0)}" value="{start}" '
        f'aria-label="{escape(what)}" oninput="{escape(handler)}"{hidden}>'
    )


def _sliding(
    pictures: Sequence[tuple[str, npt.NDArray[np.uint8]]],
    what: str,
    tall: float = 1.0,
    start: int = 0,
) -> str:
    """Write pictures, of which a slider shows one.

    Returns HTML with the name of the pictures, each as PNG with its longer side scaled to
    `SIDE_PX`, the slider, and below it the name of the one shown.

    Args:
        pictures: name and gray pixels (rows, columns) of each, at least one.
        what: name of the pictures.
        tall: height of a pixel over its width.
        start: index of the one that is shown at first.
    """
    drawn = []
    for k, (name, pixels) in enumerate(pictures):
        data = base64.b64encode(png_of(pixels)).decode("ascii")
        rows, cols = pixels.shape
        scale = SIDE_PX / max(rows * tall, cols)
        hidden = "" if k == start else " hidden"
        drawn.append(
            f'<img data-of="{escape(name)}" alt="{escape(f"{what}, {name}")}" '
            f'width="{max(1, round(scale * cols))}" height="{max(1, round(scale * tall * rows))}" '
            f'src="data:image/png;base64,{data}"{hidden}>'
        )
    slider = _slider(len(pictures), what, SHOW_CHOSEN, start)
    return (
        f'<div style="display:inline-block;margin-right:1em"><b>{escape(what)}</b><br>'
        f"{''.join(drawn)}<br>{slider}<span>{escape(pictures[start][0])}</span></div>"
    )


def _row(parts: Sequence[str]) -> str:
    """Write parts side by side."""
    return f"<div>{''.join(parts)}</div>"
