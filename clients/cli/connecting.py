"""The options of every command that talks to a twin, and the connection that they describe.

What a command leaves out comes from environment variables, then from the user's configuration file.
The file is TOML: `$XDG_CONFIG_HOME/flexdt/config.toml`, `~/.config/flexdt/config.toml` where that
variable is not set, or the one that FLEXDT_CONFIG names. Options of commands override both.

    server = "scanner-room:55000"     # FLEXDT_SERVER
    token_file = "~/.flexdt-token"    # FLEXDT_TOKEN_FILE; or token = "...", FLEXDT_TOKEN
    tls_ca = "~/scanner-room.pem"     # FLEXDT_TLS_CA
    data = "~/scans"                  # FLEXDT_DATA: of `flexdt up` and `flexdt twin`

    [twin]                            # also [up], [projector], [viewer], [gateway]
    http_port = 9101                  # any option of `flexdt twin --help`
"""

from __future__ import annotations

import inspect
import os
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeVar

import typer

from flexdt.clients.cli import option_values
from flexdt.clients.failure import CommandError
from flexdt.process_settings import (
    GatewaySettings,
    ProjectorSettings,
    TwinSettings,
    UpSettings,
    ViewerSettings,
    has_parameters,
)

if TYPE_CHECKING:
    import ssl

    from flexdt.clients.client.client import TwinClient

_R = TypeVar("_R")

PREFIX: Final = "FLEXDT_"
PATHS: Final = ("token_file", "tls_ca", "data")


@dataclass(frozen=True, kw_only=True)
class Configuration:
    """Defaults of commands; None where neither file nor environment says anything.

    Attributes:
        server: HOST:PORT of the twin.
        token: shown to it.
        token_file: file whose first line is the token.
        tls_ca: certificates (PEM) to trust; speaks TLS.
        data: directory that a twin started here writes to.
        processes: options of processes started here, by the names of their settings.
    """

    server: str | None = None
    token: str | None = None
    token_file: str | None = None
    tls_ca: str | None = None
    data: str | None = None
    processes: Mapping[str, Mapping[str, object]] = field(default_factory=dict)


TABLES: Final = {
    kind.command: kind
    for kind in (UpSettings, TwinSettings, ProjectorSettings, ViewerSettings, GatewaySettings)
}
"""Tables of the file, and what their keys are."""
KEYS: Final = tuple(f.name for f in fields(Configuration) if f.name != "processes")


def config_file(environ: Mapping[str, str]) -> Path:
    """Where the configuration file is, or would be."""
    named = environ.get(f"{PREFIX}CONFIG")
    if named:
        return Path(named).expanduser()
    base = environ.get("XDG_CONFIG_HOME")
    return (Path(base) if base else Path("~/.config").expanduser()) / "flexdt" / "config.toml"


def configuration(environ: Mapping[str, str] | None = None) -> Configuration:
    """The defaults in force.

    Args:
        environ: the environment; this process's if left out.

    Raises:
        CommandError: the file is not TOML, or a key or value does not hold; names file and key.
    """
    env = os.environ if environ is None else environ
    path = config_file(env)
    found = _of_file(path, required=bool(env.get(f"{PREFIX}CONFIG")))
    own = {key: env[name] for key in KEYS if (name := f"{PREFIX}{key.upper()}") in env}
    if {"token", "token_file"} & set(own):  # one stands for both
        found.pop("token", None)
        found.pop("token_file", None)
    found |= own
    if "token" in found and "token_file" in found:
        where = "FLEXDT_TOKEN and FLEXDT_TOKEN_FILE" if own else f"{path}: token and token_file"
        raise CommandError(f"{where} are both set; allowed: one of them")
    processes = {name: found.pop(name) for name in TABLES if name in found}
    given = {key: value for key, value in found.items() if value}
    for key in PATHS:
        if key in given:
            given[key] = str(Path(given[key]).expanduser())
    return Configuration(**given, processes=processes)


def _of_file(path: Path, *, required: bool) -> dict[str, Any]:
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        if required:
            raise CommandError(f"{path}: no such file (FLEXDT_CONFIG names it)") from None
        return {}
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or "not UTF-8 text"
        raise CommandError(f"{path}: {why}") from None
    except tomllib.TOMLDecodeError as error:
        raise CommandError(f"{path}: not valid TOML: {error}") from None
    for key, value in document.items():
        if key in TABLES and isinstance(value, dict):
            allowed = [f.name for f in fields(TABLES[key])]
            for name in value:
                if name not in allowed:
                    what = f"{path}: [{key}] unknown key {name!r}; allowed"
                    raise CommandError(f"{what}: {', '.join(allowed)}")
            continue
        if key not in KEYS:
            allowed = [*KEYS, *(f"[{name}]" for name in TABLES)]
            raise CommandError(f"{path}: unknown key {key!r}; allowed: {', '.join(allowed)}")
        if not isinstance(value, str) or not value:
            raise CommandError(f"{path}: {key} is {value!r}; allowed: a text that is not empty")
    return dict(document)


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
CONNECTION: Final = tuple(
    inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=kind)
    for name, kind in (("server", Server), ("token_file", TokenFile))
)
"""Arguments of `connect` as options."""


def on_twin(command: Callable[..., _R]) -> Callable[..., _R]:
    """Give a command the connection options in place of its first parameter, a `Twin`.

    Typer builds the command line from the signature of what this returns. The command itself
    decides when to connect.
    """

    @wraps(command)
    def with_connection(**given: Any) -> _R:
        address = {p.name: given.pop(p.name) for p in CONNECTION}
        return command(partial(connect, **address), **given)

    _, *own = inspect.signature(command, eval_str=True).parameters.values()
    has_parameters(with_connection, [*own, *CONNECTION])
    return with_connection


def connect(server: str | None = None, token_file: str | None = None) -> TwinClient:
    """A client for a twin, to be used as a context manager.

    What is None is taken from the user's configuration, see `configuration`.

    Args:
        server: HOST:PORT, see `option_values.server`; 127.0.0.1:55000 if nothing says otherwise.
        token_file: file whose first line is the session's token; shows none by default.

    Raises:
        typer.BadParameter: the address has another form.
        CommandError: the certificate file holds no certificate, or the configuration is wrong.
        OSError: the token or certificate file cannot be read, or nothing answers.
    """
    own = configuration()
    host, port = option_values.server(server or own.server or option_values.DEFAULT_SERVER)
    shown = token_file or own.token_file
    token = own.token if shown is None else _first_line(Path(shown))
    context = None if own.tls_ca is None else _trusting(Path(own.tls_ca))

    from flexdt.clients.client.client import TwinClient

    return TwinClient(host, port, token=token, name="flexdt", ssl=context)


def _trusting(certificate: Path) -> ssl.SSLContext:
    """A TLS context that trusts a file's certificates and checks the server's name."""
    import ssl

    text = certificate.read_text(encoding="ascii", errors="replace")
    try:
        return ssl.create_default_context(cadata=text)
    except (ssl.SSLError, ValueError):
        raise CommandError(f"{certificate}: no certificate (PEM)") from None


def _first_line(path: Path) -> str:
    lines = path.read_text(encoding="utf-8").splitlines()
    return lines[0].strip() if lines else ""
