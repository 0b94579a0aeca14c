"""A connected client for a command: address and token from the options.

It refuses to catch anything: a refused connection is the error boundary's business.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from flexdt.clients.cli import values
from flexdt.clients.failure import CommandError

if TYPE_CHECKING:
    import ssl

    from flexdt.clients.client import TwinClient


def connect(server: str, token_file: str | None, tls_ca: str | None = None) -> TwinClient:
    """A client for the twin at HOST:PORT, to be used as a context manager.

    Raises:
        typer.BadParameter: no such address.
        CommandError: the certificate file holds no certificate.
        OSError: no such token or certificate file, or no connection.
    """
    host, port = values.server(server)
    token = None if token_file is None else read_token(Path(token_file))
    context = None if tls_ca is None else trusting(Path(tls_ca))

    from flexdt.clients.client import TwinClient

    return TwinClient(host, port, token=token, name="flexdt", ssl=context)


def trusting(certificate: Path) -> ssl.SSLContext:
    """A TLS context that trusts the certificates in a file (PEM) and checks the server's name."""
    import ssl

    text = certificate.read_text(encoding="ascii", errors="replace")
    try:
        return ssl.create_default_context(cadata=text)
    except (ssl.SSLError, ValueError):
        raise CommandError(f"{certificate}: no certificate (PEM)") from None


def read_token(path: Path) -> str:
    """The token in a file: its first line, blanks around it dropped."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return lines[0].strip() if lines else ""
