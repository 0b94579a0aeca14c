"""Commands of other distributions, by the entry point group `flexdt.commands`.

The names of flexdt's own extensions are listed here with their lines of help, so that
`flexdt --help` needs neither the extensions nor a look at what is installed. An entry point is
looked up when its command is on the command line.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

from flexdt.clients.cli.options import argument

GROUP: Final = "flexdt.commands"
KNOWN: Final[Mapping[str, str]] = {
    "simulate": "Simulate a CTSimU scenario: projections, dark and flat images as TIFF.",
    "study": "Repeat an experiment of the thesis.",
    "batch": "Make a batch of scans or calibrations.",
    "bench": "Measure speed and accuracy, beside the peers that are installed.",
    "phantom design": "Choose bead places that determine the geometry best.",
}
"""Command of `flexdt-extensions` -> its line of the help page."""


def found(name: str) -> Callable[..., Any] | None:
    """The function of a command, a word or two, that an installed distribution offers."""
    from flexdt.clients.extras import offered

    function: Callable[..., Any] | None = offered(name.replace(" ", "."), GROUP)
    return function


def listed(name: str) -> Callable[..., None]:
    """A command for the help page; where it is run, its distribution is missing."""

    def command(words: list[str] | None = argument(None, "...")) -> None:
        from flexdt.clients.extras import extension

        extension(name.replace(" ", "."), f"`flexdt {name}`", GROUP)

    command.__doc__ = KNOWN[name]
    return command
