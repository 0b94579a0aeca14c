"""How commands declare their options, and the options that several share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flexdt.clients.cli.twin_connection import DEFAULT_SERVER
from flexdt.clients.cli.value_completion import machine_names, profile_names

if TYPE_CHECKING:
    from flexdt.clients.client.client import TwinClient

Answer = Iterator[object]
"""Answer of most commands: texts, which are lines for people, and one object that is
no text, the document of `--json`."""
Json = Annotated[
    bool, typer.Option("--json", help="Print one JSON document and nothing else.")
]
Verbose = Annotated[
    bool | None,
    typer.Option(
        "--verbose/--quiet",
        "-v/-q",
        help="Say what takes time and what libraries log; or show no progress.",
    ),
]
Proposer = Callable[[str], list[str]]
"""Gives the values that begin with the part of a word that was typed."""
Twin = Callable[[], "TwinClient"]
"""Connects to the twin that the command line names, for use as `with twin() as client`."""
Server = Annotated[
    str | None,
    typer.Option(
        metavar="HOST:PORT",
        help=f"Talk to the twin there; default: {DEFAULT_SERVER}, or configured.",
    ),
]
TokenFile = Annotated[
    str | None, typer.Option(metavar="FILE", help="Show the twin the token in this file.")
]
MachineName = Annotated[
    str | None,
    typer.Option(
        "--machine",
        metavar="FILE or NAME",
        help="Use this machine: a shipped name or a TOML file.",
        autocompletion=machine_names,
    ),
]
ProfileName = Annotated[
    str | None,
    typer.Option(
        "--profile",
        metavar="FILE or NAME",
        help="Use the zero offsets of this profile: a shipped name or a TOML file.",
        autocompletion=profile_names,
    ),
]
Free = Annotated[
    str | None,
    typer.Option(
        "--free", metavar="P,P,...", help="Estimate these parameters; default: six."
    ),
]
Roi = Annotated[
    tuple[int, int, int, int] | None,
    typer.Option(
        "--roi", metavar="L T R B", help="Read these unbinned pixels, bounds included."
    ),
]
Geometry = Annotated[
    Path | None,
    typer.Option(
        "--geometry",
        metavar="FILE",
        help="Use this geometry instead of the data set's, or for anybody's TIFFs.",
    ),
]
Jobs = Annotated[
    int | None,
    typer.Option(
        "--jobs", min=1, help="Use so many processes; default: one for each core."
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        "--scheduler",
        metavar="ADDRESS",
        help="Let the workers of this Dask scheduler do the work.",
    ),
]
Texts = Annotated[
    bool,
    typer.Option("--texts", help="Take the geometry from the scanner's two texts alone."),
]
Push = Annotated[
    bool, typer.Option("--push", help="Put the correction in force on the twin.")
]


def option(
    default: object,
    *words: str,
    among: Callable[[], Iterable[str]] | None = None,
    proposes: Proposer | None = None,
    written: bool = False,
    **details: Any,
) -> Any:
    """Make the default of a command's parameter that is an option of the command line.

    Args:
        default: `...` for one that must be given.
        words: flags, of which a switch that is only ever on needs one, and one line of
            help; None is the docstring's.
        among: gives allowed words when the command line is built.
        proposes: gives values that a shell completes.
        written: a path to write to, tried before the command begins.
        details: of `typer.Option`.
    """
    flags = [word for word in words if word.startswith("-")]
    help = next((word for word in words if not word.startswith("-")), None)
    made = typer.Option(default, *flags, help=help, autocompletion=proposes, **details)
    made.among = among
    made.written = written
    return made


def argument(
    default: object, metavar: str, help: str = "", proposes: Proposer | None = None
) -> Any:
    """Make the default of a command's parameter that is a word of its own."""
    return typer.Argument(
        default, metavar=metavar, help=help or None, autocompletion=proposes
    )
