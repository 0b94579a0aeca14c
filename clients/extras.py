"""Packages that extras of flexdt install."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from flexdt.twin.errors import TwinError


def package(
    name: str, what: str = "this format", extra: str = "io", distribution: str = "flexdt"
) -> Any:
    """The package or module `name` of a distribution's extra, which `what` needs.

    Raises:
        TwinError: it is not installed.
    """
    try:
        return import_module(name)
    except ImportError:
        raise TwinError(
            f"{what} needs {name}, which is not installed: pip install '{distribution}[{extra}]'",
            {"missing": name},
        ) from None
