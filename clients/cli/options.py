"""How commands declare their options, the options that several share, and the twin's connection.

`--json`, `--server` and `--token-file` are options of `flexdt` itself, which commands get as
arguments: what yields answers `--json`, and a parameter `twin: Twin` connects to the server.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from flexdt.clients.cli import option_values
from flexdt.clients.cli.console import emit, say
from flexdt.clients.cli.settings_file import configuration
from flexdt.clients.failure import CommandError
from flexdt.process_settings import has_parameters

if TYPE_CHECKING:
    from flexdt.clients.client.client import TwinClient

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


Twin = Callable[[], "TwinClient"]
"""Connects to the twin that the command line names, for use as `with twin() as client`."""
Server = Annotated[
    str | None,
    typer.Option(
        metavar="HOST:PORT",
        help=f"Talk to the twin there; default: {option_values.DEFAULT_SERVER}, or configured.",
    ),
]
TokenFile = Annotated[
    str | None, typer.Option(metavar="FILE", help="Show the twin the token in this file.")
]
GIVEN: Final = ("context", "twin", "json")
"""Parameters of commands that are no options of theirs."""


def completed(command: Callable[..., Any]) -> tuple[Callable[..., None], tuple[str, ...]]:
    """A command as typer takes it, and the options of `flexdt` that it heeds."""
    own = inspect.signature(command, eval_str=True).parameters
    yields = inspect.isgeneratorfunction(inspect.unwrap(command))
    if not yields and "context" in own:  # it passes its words on
        return command, ()

    @wraps(command)
    def complete(context: typer.Context, **given: Any) -> None:
        root = context.find_root().params
        if "context" in own:
            given["context"] = context
        if "twin" in own:
            given["twin"] = partial(connect, root["server"], root["token_file"])
        if "json" in own:
            given["json"] = root["json"]
        answer = command(**given)
        for part in answer if yields else ():
            if isinstance(part, str) and not root["json"]:
                say(part)
            elif root["json"] and not isinstance(part, str):
                emit(part)

    context = inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
    has_parameters(complete, [context, *(p for name, p in own.items() if name not in GIVEN)])
    heeds = ("--json",) if yields or "json" in own else ()
    return complete, (*heeds, "--server", "--token-file") if "twin" in own else heeds


def connect(server: str | None = None, token_file: str | None = None) -> TwinClient:
    """A client for a twin, to be used as a context manager.

    What is None is taken from the user's configuration, see `configuration`.

    Args:
        server: HOST:PORT, see `option_values.server`; 127.0.0.1:55000 if nothing says otherwise.
        token_file: file whose first line is the session's token; shows none by default.

    Raises:
        typer.BadParameter: the address has another form.
        CommandError: the token or certificate file cannot be read or holds none, or the
            configuration is wrong.
        OSError: nothing answers.
    """
    own = configuration()
    host, port = option_values.server(server or own.server or option_values.DEFAULT_SERVER)
    shown = token_file or own.token_file
    from flexdt.clients.client.client import TwinClient
    from flexdt.runtime.access import AccessError, client_tls, read_token

    try:
        token = own.token if shown is None else read_token(Path(shown))
        context = client_tls(None if own.tls_ca is None else Path(own.tls_ca))
    except AccessError as error:
        raise CommandError(str(error)) from None
    return TwinClient(host, port, token=token, name="flexdt", ssl=context)


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
