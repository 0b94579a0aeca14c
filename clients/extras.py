"""Packages of the extra `io`."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from flexdt.twin.errors import TwinError


def package(name: str, what: str = "this format") -> Any:
    """The package `name` of the extra `io`, which `what` needs.

    Raises:
        TwinError: it is not installed.
    """
    try:
        return import_module(name)
    except ImportError:
        raise TwinError(
            f"{what} needs {name}, which is not installed: pip install 'flexdt[io]'",
            {"missing": name},
        ) from None
