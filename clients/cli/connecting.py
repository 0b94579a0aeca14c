"""The options of every command that talks to a twin, and the connection that they describe."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from flexdt.clients.cli import values
from flexdt.clients.cli.configuration import configuration
from flexdt.clients.failure import CommandError

if TYPE_CHECKING:
    import ssl

    from flexdt.clients.client.client import TwinClient

Twin = Callable[[], "TwinClient"]
"""Connects to the twin that the command line names, for use as `with twin() as client`."""
Server = Annotated[
    str | None,
    typer.Option(
        "--server",
        metavar="HOST:PORT",
        help=f"Where the twin listens; default: {values.DEFAULT_SERVER}, or configured.",
    ),
]
TokenFile = Annotated[
    str | None,
    typer.Option("--token-file", metavar="FILE", help="File with the session's token."),
]
TlsCa = Annotated[
    str | None,
    typer.Option("--tls-ca", metavar="FILE", help="Speak TLS; trust this certificate."),
]
CONNECTION: Final[dict[str, tuple[Any, str | None]]] = {
    "server": (Server, None),
    "token_file": (TokenFile, None),
    "tls_ca": (TlsCa, None),
}
"""Arguments of `connect`: the option and its default."""


def on_twin(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the connection options in the place of its keyword-only parameter `twin`.

    Typer builds the command line from the signature of what this returns. The command itself
    receives `twin`, a `Twin`, and decides when to connect.
    """

    @wraps(command)
    def with_connection(**given: Any) -> None:
        address = {name: given.pop(name) for name in CONNECTION}
        command(**given, twin=partial(connect, **address))

    shown: dict[str, tuple[Any, Any]] = {}
    for name, parameter in inspect.signature(command, eval_str=True).parameters.items():
        one = {name: (parameter.annotation, parameter.default)}
        shown |= CONNECTION if name == "twin" else one
    only = inspect.Parameter.KEYWORD_ONLY
    signature = inspect.Signature(
        [
            inspect.Parameter(name, only, default=default, annotation=kind)
            for name, (kind, default) in shown.items()
        ]
    )
    with_connection.__signature__ = signature  # type: ignore[attr-defined]
    with_connection.__annotations__ = {name: kind for name, (kind, _) in shown.items()}
    return with_connection


def connect(
    server: str | None = None, token_file: str | None = None, tls_ca: str | None = None
) -> TwinClient:
    """A client for a twin, to be used as a context manager.

    What is None is taken from the user's configuration, see `configuration`.

    Args:
        server: HOST:PORT, as `values.server` reads it; 127.0.0.1:55000 if nothing says otherwise.
        token_file: file whose first line is the session's token; shows none by default.
        tls_ca: file of the certificates (PEM) to trust; speaks without TLS by default.

    Raises:
        typer.BadParameter: the address has another form.
        CommandError: the certificate file holds no certificate, or the configuration is wrong.
        OSError: the token or certificate file cannot be read, or nothing answers.
    """
    own = configuration()
    host, port = values.server(server or own.server or values.DEFAULT_SERVER)
    shown = token_file or own.token_file
    token = own.token if shown is None else _first_line(Path(shown))
    trusted = tls_ca or own.tls_ca
    context = None if trusted is None else _trusting(Path(trusted))

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
