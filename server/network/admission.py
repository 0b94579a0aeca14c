"""The token that a connection has to show; those without a place wait in a `runtime` room."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from flexdt.protocol.rpc_errors import not_authorised
from flexdt.runtime.access import token_matches
from flexdt.runtime.waiting_room import Guesses

MAX_WRONG_TOKENS = 3
"""Number of wrong tokens after which a connection is closed."""


class TokenCheck:
    """Checks the token of one connection.

    Args:
        token: of the server; None where it has none.
        close: ends the connection after too many wrong tokens.
        guesses: at the server's port.
    """

    def __init__(
        self, token: str | None, close: Callable[[], object], guesses: Guesses
    ) -> None:
        """Begin without a wrong token."""
        self._token = token
        self._close = close
        self._guesses = guesses
        self._wrong = 0

    async def check(self, given: str | None, client: str, host: str) -> None:
        """Compare a token with the server's; a wrong one is answered late, and too many
        close.

        Nothing is checked if the server has no token. Each wrong token is logged and
        delays its answer by more than the last one of its address. The connection is
        closed at the `MAX_WRONG_TOKENS`-th wrong one and at each later one; right ones do not
        reset the count.

        Args:
            given: by the client; None for none.
            client: name of the connection, for the log.
            host: its IP address.

        Raises:
            RpcError: -32004, it is not the server's.
        """
        if self._token is None or token_matches(given, self._token):
            return
        self._wrong += 1
        await asyncio.sleep(self._guesses.wrong(client, host))
        if self._wrong >= MAX_WRONG_TOKENS:
            self._close()
        raise not_authorised()
