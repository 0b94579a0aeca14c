"""Show values in a notebook: live where ipywidgets is installed, else as a page of HTML."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from flexdt.library.datasets.pictures import png_of
from flexdt.library.notebook.notebook_pages import (
    NotebookPage,
    geometry_page,
    volume_page,
)
from flexdt.library.notebook.notebook_slices import AXES, grey_of, layer_of, window_of
from flexdt.library.optional.extras import lacking, package
from flexdt.runtime.progress import in_notebook

if TYPE_CHECKING:
    from flexdt.twin.geometry.cone_vec import ConeVec
    from flexdt.twin.projection import Volume

WIDTH_PX: Final = 240
"""Width of a picture."""
WINDOW_REACH_WIDTHS: Final = 0.5
"""Reach of the window's slider beyond the window, on each side, as a share of its width."""


@dataclass(frozen=True, repr=False)
class LivePage(NotebookPage):
    """A page that is shown as live widgets where there is a program behind them, and as
    itself in a saved notebook, on a site and in print.

    Attributes:
        widgets: of ipywidgets.
    """

    widgets: Any = None

    def _repr_mimebundle_(self, **wanted: Any) -> dict[str, Any]:
        """Give the widgets and the page in one output; its viewer takes what it can."""
        live = self.widgets._repr_mimebundle_(**wanted)
        views = live[0] if isinstance(live, tuple) else live
        plain = {"text/html": self.html, "text/plain": repr(self)}
        return {**(views or {}), **plain}


def show_volume(volume: Volume, window: Sequence[float] | None = None) -> NotebookPage:
    """Return a page of the volume, in a notebook with ipywidgets together with live
    widgets; see `Volume.show`.
    """
    page = volume_page(volume, window)
    if in_notebook() and lacking("ipywidgets", "ipywidgets", "notebook") is None:
        widgets = package("ipywidgets", "a volume with live sliders", "notebook")
        live = volume_widgets(widgets, volume, window)
        return LivePage(page.html, page.title, live)
    return page


def show_geometry(cone_vec: ConeVec) -> NotebookPage:
    """Return the page of a geometry; see `ConeVec.show`."""
    return geometry_page(cone_vec)


def volume_widgets(
    widgets: Any, volume: Volume, window: Sequence[float] | None = None
) -> Any:
    """Make three linked slices of a volume: a slider for each axis, and one for the
    window.

    They begin at the middle of each axis, and are drawn again when a slider has moved
    (that of the window when it is released). White lines mark the two other slices.

    Args:
        widgets: the package ipywidgets.
        volume: is seen from above, from the front and from the right.
        window: attenuation of black and of white at first [1/mm]; its slider reaches
            `WINDOW_REACH_WIDTHS` times the width beyond both. None: percentiles of the
            volume.

    Returns:
        A box of widgets, which a notebook shows.

    Raises:
        TwinError: the window is not two growing numbers.
    """
    low, high = window_of(volume.data, window)
    beyond = WINDOW_REACH_WIDTHS * (high - low)
    chosen = widgets.FloatRangeSlider(
        value=(low, high),
        min=low - beyond,
        max=high + beyond,
        step=(high - low) / 200.0,
        description="1/mm",
        readout_format=".4f",
        continuous_update=False,
    )
    sliders = {}
    pictures = {}
    for name, axis, _ in AXES:
        count = volume.shape[axis]
        sliders[name] = widgets.IntSlider(
            value=count // 2, min=0, max=count - 1, description=name
        )
        pictures[name] = widgets.Image(format="png", width=WIDTH_PX)

    def draw(_: object = None) -> None:
        """Draw the three slices in the gray window, each with white lines at the two
        others; the argument is ignored.
        """
        black, white = chosen.value
        places = {name: slider.value for name, slider in sliders.items()}
        for name, axis, across in AXES:
            layer = layer_of(volume.data, axis, places[name])
            pixels = np.repeat(grey_of(layer, black, white)[:, :, None], 3, axis=2)
            right = across[0]
            up = across[1]
            pixels[:, places[right], 0] = 255
            pixels[len(pixels) - 1 - places[up], :, 0] = 255
            pictures[name].value = png_of(pixels)

    for control in (chosen, *sliders.values()):
        control.observe(draw, names="value")
    draw()
    columns = [widgets.VBox([pictures[name], sliders[name]]) for name, _, _ in AXES]
    return widgets.VBox([widgets.HBox(columns), chosen])
