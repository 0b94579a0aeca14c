"""The twin that the command line, the environment or the settings file names, and its
client."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from flexdt.clients.cli.settings_file import configuration
from flexdt.library.failure import CommandError
from flexdt.runtime.process_settings import LOOPBACK, TWIN_PORT, Address, address

if TYPE_CHECKING:
    from flexdt.clients.client.client import TwinClient

DEFAULT_SERVER: Final = str(Address(LOOPBACK, TWIN_PORT))


def connect(server: str | None = None, token_file: str | None = None) -> TwinClient:
    """Connect to a twin and return the client, to be used as a context manager.

    Arguments that are None come from the user's `configuration`; a token file comes
    before a token. With certificates it connects by TLS. It blocks until the twin has
    answered.

    Raises typer.BadParameter: the address has another form; CommandError: token,
    certificate or configuration; OSError: nothing answers.
    """
    own = configuration()
    host, port = server_address(server or own.server or DEFAULT_SERVER)
    shown = token_file or own.token_file
    from flexdt.clients.client.client import TwinClient
    from flexdt.runtime.access import AccessError, client_tls, read_token

    try:
        if shown is None:
            token = own.token
        else:
            token = read_token(Path(shown))
        context = client_tls(None if own.tls_ca is None else Path(own.tls_ca))
    except AccessError as error:
        raise CommandError(str(error)) from None
    return TwinClient(host, port, token=token, name="flexdt", ssl=context)


def server_address(word: str) -> tuple[str, int]:
    """Read HOST:PORT, HOST, :PORT or [IPV6]:PORT as (host, port); the default port is 55000.

    HOST is 127.0.0.1 if left out; an IPv6 address without a port needs no brackets.

    Raises typer.BadParameter: no such form, or a port outside 1 to 65535.
    """
    text = word.strip()
    if text.count(":") > 1 and "[" not in text:  # an IPv6 address by itself
        text = f"[{text}]"
    if ":" not in text.rpartition("]")[2]:
        text += f":{TWIN_PORT}"
    found = address(f"{LOOPBACK}{text}" if text.startswith(":") else text)
    return found.host, found.port
