"""Connections of browsers to the viewer's front, and which of them give way when there
are too many.

One that has not sent a complete request with the token (without one: a request of the
viewer's own site) waits in a room; so does, in a second room, a request that is being
answered. Pages and views have places, which the front counts. `runtime/waiting_room.py`
decides which connection gives way.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any, Final

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConcurrencyError
from websockets.protocol import CONNECTING, OPEN, State

from flexdt.runtime import waiting_room
from flexdt.runtime.process import tune
from flexdt.runtime.waiting_room import WaitingList, neighbourhood

ANSWERED: Final = 64
"""Largest number of requests with the token in service at a time, in addition to pages
and views."""
MAX_HELD: Final = 256 << 20
"""Largest size of unfinished messages, of all connections together [bytes]."""
FAIR_BYTES: Final = 1 << 20
"""Size up to which a connection's unfinished message is never dropped for those of
others [bytes]."""


class Admission:
    """Who is connected without a place, and the bytes that all connections hold."""

    def __init__(self) -> None:
        self.strangers = WaitingList[BrowserConnection](waiting_room.MAX_WAITING)
        self.answered = WaitingList[BrowserConnection](ANSWERED)
        self.held = 0

    def connection(self, *given: Any, **more: Any) -> BrowserConnection:
        """Make the server side of one connection, with the arguments of websockets."""
        return BrowserConnection(self, *given, **more)


class BrowserConnection(ServerConnection):
    """A connection that is cut where a newer one needs its room, or where all hold too much."""

    def __init__(self, admission: Admission, *given: Any, **more: Any) -> None:
        """Prepare a connection that counts against the limits of `admission`; nothing is
        held yet.

        Further arguments are those of websockets.
        """
        super().__init__(*given, **more)
        self._admission = admission
        self._held = 0
        """Number of bytes received since a message was last taken."""
        self.address = ""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Count the new connection among those that have sent no request, and note its
        network address.

        Socket options are set as for all servers; with too many such connections one
        gives way."""
        super().connection_made(transport)
        peer = transport.get_extra_info("peername") or ("?", 0)
        self.address = neighbourhood(str(peer[0]))
        tune(transport.get_extra_info("socket"))
        self._admission.strangers.enter(self)

    def admit(self) -> None:
        """Move the connection to those whose request is being answered."""
        self._admission.strangers.leave(self)
        self._admission.answered.enter(self)

    def seat(self) -> None:
        """Release its place in the waiting rooms: it has that of a page or of a view."""
        self._admission.answered.leave(self)

    def displace(self) -> None:
        """Close the connection at once: a newer one needs the room."""
        self.transport.abort()

    def data_received(self, data: bytes) -> None:
        """Take received bytes; abort if all connections hold too much, and this one as
        well.

        That is `MAX_HELD`, and `FAIR_BYTES`.
        """
        self._hold(self._held + len(data))
        if self._admission.held > MAX_HELD and self._held > FAIR_BYTES:
            self.transport.abort()
        else:
            super().data_received(data)

    @asynccontextmanager
    async def send_context(self, *, expected_state: State = OPEN) -> AsyncIterator[None]:
        """Write to the connection as the library does, but for an answer to a browser that
        has left meanwhile: that is no error of the library's.

        Other exceptions are passed on.

        Raises:
            ConcurrencyError: the browser has left before it was answered.
        """
        async with super().send_context(expected_state=expected_state):
            try:
                yield
            except Exception as error:
                protocol = self.protocol
                left = protocol.eof_sent or protocol.state is not CONNECTING
                if expected_state is CONNECTING and left:
                    raise ConcurrencyError("the browser left unanswered") from error
                raise

    async def recv(self, decode: bool | None = None) -> Any:
        """Receive the next message."""
        message = await super().recv(decode)
        self._hold(0)
        return message

    def connection_lost(self, exc: Exception | None) -> None:
        """Free the place of an ended connection among those that are counted, and the
        bytes it held.

        Called once, by asyncio."""
        self._hold(0)
        self._admission.strangers.leave(self)
        self._admission.answered.leave(self)
        super().connection_lost(exc)

    def _hold(self, size: int) -> None:
        self._admission.held += size - self._held
        self._held = size
