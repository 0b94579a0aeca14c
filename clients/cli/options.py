"""How commands declare their options, and the options that several of them share."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from functools import wraps
from pathlib import Path
from typing import Annotated, Any

import typer

from flexdt.clients.cli.console import emit, say
from flexdt.process_settings import has_parameters

Answer = Iterator[object]
"""What most commands yield: texts, which are lines for people, and one thing that is no text, which
is the document of `--json`."""


def option(default: object, help: str = "", *flags: str, **details: Any) -> Any:
    """The default of a command's parameter that the command line offers as an option.

    Args:
        default: where the option is left out; `...` for one that must be given.
        help: one line.
        flags: as typed. They follow from the parameter's name, but a switch that is only ever on
            has to name its flag, or typer adds one that switches it off.
        details: of `typer.Option`, such as metavar, min and max.
    """
    return typer.Option(default, *flags, help=help or None, **details)


def argument(default: object, metavar: str, help: str = "") -> Any:
    """The default of a command's parameter that is a word of its own; `...` if it must be given."""
    return typer.Argument(default, metavar=metavar, help=help or None)


Json = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")]


def answering(command: Callable[..., Answer]) -> Callable[..., None]:
    """A command that yields its answer, with the option that prints its document instead."""

    @wraps(command)
    def answered(json: bool, **given: Any) -> None:
        for part in command(**given):
            if isinstance(part, str) and not json:
                say(part)
            elif json and not isinstance(part, str):
                emit(part)

    own = inspect.signature(command, eval_str=True).parameters.values()
    asked = inspect.Parameter("json", inspect.Parameter.KEYWORD_ONLY, default=False,
                              annotation=Json)  # fmt: skip
    has_parameters(answered, [*own, asked])
    return answered


MachineName = Annotated[
    str | None,
    typer.Option(
        "--machine", metavar="FILE or NAME", help="Use this machine: a shipped name or a TOML file."
    ),
]
ProfileName = Annotated[
    str | None,
    typer.Option(
        "--profile", metavar="NAME", help="Use the zero offsets of this calibration profile."
    ),
]
Free = Annotated[
    str | None,
    typer.Option("--free", metavar="P,P,...", help="Estimate these parameters; default: six."),
]
Roi = Annotated[
    tuple[int, int, int, int] | None,
    typer.Option("--roi", metavar="L T R B", help="Read these unbinned pixels, bounds included."),
]
Geometry = Annotated[
    Path | None,
    typer.Option(
        "--geometry",
        metavar="FILE",
        help="Use this geometry (flexdt import) instead of the data set's.",
    ),
]
Jobs = Annotated[
    int | None,
    typer.Option("--jobs", min=1, help="Use so many processes; default: one for each core."),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        "--scheduler", metavar="ADDRESS", help="Let the workers of this Dask scheduler do the work."
    ),
]
Texts = Annotated[
    bool, typer.Option("--texts", help="Take the geometry from the scanner's two texts alone.")
]
Push = Annotated[bool, typer.Option("--push", help="Put the correction in force on the twin.")]
