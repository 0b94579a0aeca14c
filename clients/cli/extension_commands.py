"""Commands of other distributions, by the entry point group `flexdt.commands`.

The names of flexdt's own extensions are listed here with their lines of help, so that
`flexdt --help` needs neither the extensions nor a look at what is installed. An entry point is
looked up when its command is on the command line.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from importlib.metadata import entry_points
from typing import Any, Final

from flexdt.clients.cli.options import argument

GROUP: Final = "flexdt.commands"
DISTRIBUTION: Final = "flexdt-extensions"
KNOWN: Final[Mapping[str, str]] = {}
"""Command of `flexdt-extensions` -> its line of the help page."""


def found(name: str) -> Callable[..., Any] | None:
    """The function of a command, a word or two, that an installed distribution offers."""
    for point in entry_points(group=GROUP, name=name.replace(" ", ".")):
        function: Callable[..., Any] = point.load()
        return function
    return None


def listed(name: str) -> Callable[..., None]:
    """A command of the help page alone; where it is run, its distribution is missing."""

    def command(words: list[str] | None = argument(None, "...")) -> None:
        require(name)

    command.__doc__ = KNOWN[name]
    return command


def require(name: str) -> Callable[..., Any]:
    """The function of a command of `flexdt-extensions`.

    Raises:
        TwinError: the distribution is not installed.
    """
    function = found(name)
    if function is None:
        from flexdt.twin.errors import TwinError

        raise TwinError(
            f"`flexdt {name}` is a command of {DISTRIBUTION}, which is not installed: "
            f"pip install {DISTRIBUTION}",
            {"missing": DISTRIBUTION},
        )
    return function


def wanted(words: Iterable[str] | None) -> list[str]:
    """The commands of other distributions to load for a command line, by its first two words.

    Args:
        words: after the program's name; None for every command of `flexdt-extensions`.
    """
    if words is None:
        return list(KNOWN)
    first = list(words)[:2]
    return [" ".join(first[:count]) for count in range(1, len(first) + 1)]
