"""Packages that extras of flexdt install, and functions of its extensions."""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import find_spec
from typing import Any, Final

from flexdt.twin.errors import TwinError

DISTRIBUTION: Final = "flexdt-extensions"


def package(
    name: str, what: str = "this format", extra: str = "io", distribution: str = "flexdt"
) -> Any:
    """Import and return the package or module `name` of a distribution's extra, which
    `what` needs.

    Raises:
        TwinError: it cannot be imported; names the command that installs the extra.
    """
    try:
        return import_module(name)
    except ImportError:
        raise TwinError(
            f"{what} needs {name}, which is not installed: pip install "
            f"'{distribution}[{extra}]'",
            {"missing": name},
        ) from None


def lacking(module: str, name: str, extra: str) -> str | None:
    """Return the install hint for a missing module; None where it is installed. Imports nothing.
    `module`: as it is imported; `name`: of its distribution; `extra`: of flexdt that brings
    it."""
    if find_spec(module):
        return None
    return f"{name} is missing: pip install 'flexdt[{extra}]'"


def offered(name: str, group: str) -> Any:
    """Load the object of an entry point of an installed distribution, or return None."""
    for point in entry_points(group=group, name=name):
        return point.load()
    return None


def extension(name: str, what: str, group: str = "flexdt.extensions") -> Any:
    """Load the object of an entry point of `flexdt-extensions`.

    `what` needs it, for the message. Raises TwinError: no such one, with the command that
    installs it.
    """
    loaded = offered(name, group)
    if loaded is None:
        raise TwinError(
            f"{what} needs {DISTRIBUTION}, which is not installed: "
            "pip install ./extensions in a clone of flexdt",
            {"missing": DISTRIBUTION},
        )
    return loaded
