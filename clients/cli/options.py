"""How commands declare their options, the options that several share, their values, and the twin's
connection.

`--json`, `--server` and `--token-file` are options of `flexdt` itself, which commands get as
arguments: what yields answers `--json`, and a parameter `twin: Twin` connects to the server.

Words of the command line that do not hold (AXIS=VALUE, HOST:PORT, lists) become usage errors (exit
code 2) that quote the word and state what is allowed. The twin, not this module, knows the names of
the axes.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Iterator
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import typer

from flexdt.clients.cli.console import emit, say
from flexdt.clients.cli.settings_file import configuration
from flexdt.library.failure import CommandError
from flexdt.runtime.process_settings import LOOPBACK, address, described, has_parameters

if TYPE_CHECKING:
    from flexdt.clients.client.client import TwinClient

DEFAULT_SERVER = "127.0.0.1:55000"
DEFAULT_PORT = 55000

Answer = Iterator[object]
"""What most commands yield: texts, which are lines for people, and one thing that is no text, which
is the document of `--json`."""


def option(
    default: object, *words: str, among: Callable[[], Iterable[str]] | None = None, **details: Any
) -> Any:
    """The default of a command's parameter that the command line offers as an option.

    Args:
        default: where the option is left out; `...` for one that must be given.
        words: flags as typed, and one line of help. Flags follow from the parameter's name, but a
            switch that is only ever on has to name its flag, or typer adds one that switches it
            off. The help is that of the command's docstring (`Args:`) if it is not given here.
        among: gives the words that are allowed. It is called when the command line is built, so
            that each list has one home, and imports nothing heavy.
        details: of `typer.Option`, such as metavar, min and max.
    """
    flags = [word for word in words if word.startswith("-")]
    help = next((word for word in words if not word.startswith("-")), None)
    made = typer.Option(default, *flags, help=help, **details)
    made.among = among
    return made


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
        help=f"Talk to the twin there; default: {DEFAULT_SERVER}, or configured.",
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

    about, helps = described(command)
    for name, parameter in own.items():
        if getattr(parameter.default, "help", "") is None:
            parameter.default.help = helps.get(name)

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

    complete.__doc__ = about
    context = inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
    offered = (_with_choices(p) for name, p in own.items() if name not in GIVEN)
    has_parameters(complete, [context, *offered])
    heeds = ("--json",) if yields or "json" in own else ()
    return complete, (*heeds, "--server", "--token-file") if "twin" in own else heeds


def _with_choices(parameter: inspect.Parameter) -> inspect.Parameter:
    """The parameter with the words that its option is among as its type."""
    among = getattr(parameter.default, "among", None)
    if among is None:
        return parameter
    choices: Any = Literal[tuple(among())]
    optional = parameter.default.default is None
    return parameter.replace(annotation=choices | None if optional else choices)


def connect(server: str | None = None, token_file: str | None = None) -> TwinClient:
    """A client for a twin, to be used as a context manager.

    What is None is taken from the user's configuration, see `configuration`.

    Args:
        server: HOST:PORT, see `server_address`; 127.0.0.1:55000 if nothing says otherwise.
        token_file: file whose first line is the session's token; shows none by default.

    Raises:
        typer.BadParameter: the address has another form.
        CommandError: the token or certificate file cannot be read or holds none, or the
            configuration is wrong.
        OSError: nothing answers.
    """
    own = configuration()
    host, port = server_address(server or own.server or DEFAULT_SERVER)
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


def number(word: str, what: str) -> float:
    """A finite number, negative ones and exponents included.

    Raises:
        typer.BadParameter: not a finite number.
    """
    try:
        value = float(word)
    except ValueError:
        raise typer.BadParameter(f"{what}: {word!r} is not a number") from None
    if not math.isfinite(value):
        raise typer.BadParameter(f"{what}: {word!r} is not finite")
    return value


def assignments(words: Iterable[str]) -> dict[str, float]:
    """AXIS=VALUE words to axis -> value, in order.

    Raises:
        typer.BadParameter: a word of another form, or an axis given twice.
    """
    out: dict[str, float] = {}
    for word in words:
        name, equals, value = word.partition("=")
        name = name.strip()
        if not equals or not name or not value.strip():
            raise typer.BadParameter(f"{word!r} is not of the form AXIS=VALUE, e.g. tra_obj=-12.5")
        if name in out:
            raise typer.BadParameter(f"{name} is given twice")
        out[name] = number(value, f"the value of {name}")
    return out


def span(word: str, what: str) -> tuple[float, float]:
    """LOWER:UPPER, or one number for both.

    Raises:
        typer.BadParameter: neither, or the lower is above the upper.
    """
    ends = [number(part, what) for part in word.split(":")]
    if len(ends) > 2 or ends[0] > ends[-1]:
        raise typer.BadParameter(f"{what}: {word!r} is not of the form VALUE or LOWER:UPPER")
    return ends[0], ends[-1]


def server_address(word: str) -> tuple[str, int]:
    """HOST:PORT, HOST, :PORT or [IPV6]:PORT to (host, port); the default port is 55000.

    Raises:
        typer.BadParameter: no such form, or a port outside 1 to 65535.
    """
    text = word.strip()
    if text.count(":") > 1 and "[" not in text:  # an IPv6 address by itself
        text = f"[{text}]"
    if ":" not in text.rpartition("]")[2]:
        text += f":{DEFAULT_PORT}"
    found = address(f"{LOOPBACK}{text}" if text.startswith(":") else text)
    return found.host, found.port


def numbers(
    word: str, what: str, form: str, *counts: int, by: str = ",", whole: bool = False
) -> list[float]:
    """A list of finite numbers.

    Args:
        word: from the command line.
        what: is listed, for errors.
        form: of the list with an example, for errors: `X,Y,Z, e.g. 0,0,-5.5`.
        counts: how many there may be.
        by: what separates them.
        whole: they are whole and above 0.

    Raises:
        typer.BadParameter: another count, or a part that is no such number.
    """
    parts = [part.strip() for part in word.lower().split(by)]
    if len(parts) not in counts or (whole and not all(p.isdecimal() and int(p) for p in parts)):
        raise typer.BadParameter(f"{what} {word!r} is not {form}")
    return [number(part, what) for part in parts]


def triple(word: str, what: str, form: str) -> tuple[float, float, float]:
    """Three of `numbers`."""
    x, y, z = numbers(word, what, form, 3)
    return x, y, z


def position(word: str) -> tuple[float, float]:
    """SOD[:LATERAL] to (SOD, lateral) [mm]; lateral is 0 if left out.

    Raises:
        typer.BadParameter: not numbers.
    """
    sod, _, lateral = word.partition(":")
    return (
        number(sod, "the SOD of --position"),
        number(lateral, "the lateral of --position") if lateral else 0.0,
    )


def names(word: str) -> tuple[str, ...]:
    """A comma-separated list of names, blanks dropped."""
    return tuple(part.strip() for part in word.split(",") if part.strip())


def require_ending(file: Path, *allowed: str) -> None:
    """Check a file's ending.

    Raises:
        typer.BadParameter: another one.
    """
    if file.suffix.lower() not in allowed:
        raise typer.BadParameter(f"{file.name}: the ending must be {' or '.join(allowed)}")


def require_folder(*files: Path | None) -> None:
    """Check that files can be written where they are to be.

    Raises:
        CommandError: a folder does not exist.
    """
    for file in files:
        if file is not None and not file.absolute().parent.is_dir():
            raise CommandError(f"{file}: the folder does not exist")
