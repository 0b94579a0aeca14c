"""The way from values of the core to files, figures and other programs' objects.

Methods such as `ConeVec.load` and `Volume.save` belong to the values for the reader's sake, but the
core reads no files. They look up the module that does, by name, when they are called.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any, Protocol


class PathLike(Protocol):
    """A path as an object, such as one of `pathlib`."""

    def __fspath__(self) -> str:
        """As text."""


File = str | PathLike
"""A path, as text or as an object of `pathlib`."""


def lazy_backend(module: str) -> Any:
    """The module `flexdt.<module>`."""
    return import_module(f"flexdt.{module}")
