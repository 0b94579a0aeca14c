"""A connected client for a command: address and token from the options.

It refuses to catch anything: a refused connection is the error boundary's business.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from flexdt.clients.cli import values

if TYPE_CHECKING:
    from flexdt.clients.client import TwinClient


def connect(server: str, token_file: str | None) -> TwinClient:
    """A client for the twin at HOST:PORT, to be used as a context manager.

    Raises:
        typer.BadParameter: no such address.
        OSError: no such token file, or no connection.
    """
    host, port = values.server(server)
    token = None if token_file is None else read_token(Path(token_file))

    from flexdt.clients.client import TwinClient

    return TwinClient(host, port, token=token)


def read_token(path: Path) -> str:
    """The token in a file: its first line, blanks around it dropped."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return lines[0].strip() if lines else ""
