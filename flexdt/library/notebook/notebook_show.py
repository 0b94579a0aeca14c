"""Show values in a notebook: live where ipywidgets is installed, else as a page of HTML."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from flexdt.library.extras import lacking, package
from flexdt.library.notebook.notebook_pages import (
    NotebookPage,
    geometry_page,
    volume_page,
)
from flexdt.library.notebook.notebook_widgets import volume_widgets
from flexdt.runtime.progress_bars import in_notebook

if TYPE_CHECKING:
    from flexdt.twin.geometry.cone_vec import ConeVec
    from flexdt.twin.projection import Volume


def show_volume(volume: Volume, window: Sequence[float] | None = None) -> Any:
    """Return widgets, in a notebook with ipywidgets, else a page of the volume; see
    `Volume.show`.
    """
    if in_notebook() and lacking("ipywidgets", "ipywidgets", "notebook") is None:
        widgets = package("ipywidgets", "a volume with live sliders", "notebook")
        return volume_widgets(widgets, volume, window)
    return volume_page(volume, window)


def show_geometry(cone_vec: ConeVec) -> NotebookPage:
    """Return the page of a geometry; see `ConeVec.show`."""
    return geometry_page(cone_vec)
