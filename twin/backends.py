"""Methods of core values that need files, figures or other programs.

`ConeVec.load`, `Volume.save` and `ScanPlan.check` belong to their values for the reader's sake,
but the core reads no files, draws no figures and imports nothing above it. Such a method finds
the module of the library that does the work in `BACKENDS`, the only place where the core names
it.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any, Final

BACKENDS: Final = {
    "dry-run pages": "flexdt.library.dry_run_page",
    "geometry files": "flexdt.library.geometry_formats",
    "notebook": "flexdt.library.notebook.notebook_show",
    "plots": "flexdt.library.plots",
    "scripts": "flexdt.library.scripts",
    "sharpness": "flexdt.twin.reconstruction.resolution",
    "volume files": "flexdt.library.reconstruction.volume_files",
    "xarray": "flexdt.library.xarray_forms",
}
"""Subject -> module of the library, imported when a method first needs
it."""


def backend(subject: str) -> Any:
    """Import the module that handles a subject; return the module.

    Args:
        subject: a key of `BACKENDS`; KeyError for another one.
    """
    return import_module(BACKENDS[subject])
