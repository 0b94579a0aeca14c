"""The event loop of a server process: it measures its turns and logs asyncio's complaints.

Every request, an E-stop too, waits for the turn of the loop under way. The time from where the loop
wakes up to where it polls its sockets again is therefore measured for every turn. It includes the
time that another thread holds the interpreter while the loop has work to do.

How servers listen and the options of their sockets are here, too: no delay of small messages, and
dead peers noticed in a minute.
"""

from __future__ import annotations

import asyncio
import logging
import selectors
import socket
import ssl as tls
from collections.abc import Callable
from time import perf_counter
from typing import Any, Final

from flexdt.runtime.log import Sparing
from flexdt.runtime.metrics import Histogram

BACKLOG = 1024
"""Connections that the system keeps until they are accepted. Beyond them it drops a client's first
packet, which is sent again after a whole second: six seconds of 10 000 connections a minute fit."""
TLS_HANDSHAKE_S = 10.0


class Holds:
    """How long turns of the loop took [s]."""

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """Start counting anew."""
        self.turns = Histogram()
        self._worst = 0.0
        self._begun = False

    def observe(self, seconds: float) -> None:
        """A turn has ended; the one in which counting began does not count."""
        if not self._begun:
            self._begun = True
            return
        self.turns.observe(seconds)
        self._worst = max(self._worst, seconds)

    def worst(self) -> float:
        """The longest since the last call; reading it resets it."""
        worst, self._worst = self._worst, 0.0
        return worst


class _Watched(selectors.DefaultSelector):
    """Measures the time between two polls of the sockets."""

    def __init__(self, holds: Holds) -> None:
        super().__init__()
        self._holds = holds
        self._woke: float | None = None

    def select(self, timeout: float | None = None) -> Any:
        """Poll as the base class does."""
        now = perf_counter()
        if self._woke is not None:
            self._holds.observe(now - self._woke)
        events = super().select(timeout)
        # A look that does not wait takes no time, unless another thread has the interpreter.
        self._woke = now if timeout is not None and timeout <= 0.0 else perf_counter()
        return events


class ServerLoop(asyncio.SelectorEventLoop):
    """asyncio's loop with its turns measured; its complaints go to the log at a limited rate.

    Without the limit a process that has run out of descriptors would flood its log, since every
    connection that cannot be accepted is an error.
    """

    def __init__(self) -> None:
        self.holds = Holds()
        super().__init__(_Watched(self.holds))
        lines = Sparing(burst=1)

        def complain(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
            what, error = str(context.get("message")), context.get("exception")
            kind = f"{what} {type(error).__name__}"
            if error is None or isinstance(error, OSError):
                lines.log("event loop", logging.WARNING, kind=kind,
                          message=what, reason=str(error))  # fmt: skip
                return
            try:
                raise error
            except BaseException:
                lines.log("event loop", logging.ERROR, kind=kind, error=True, message=what)

        self.set_exception_handler(complain)


class ListeningServer:
    """A server that listens; `port` holds once it does."""

    server: asyncio.Server | None = None

    @property
    def port(self) -> int:
        """The port it listens on."""
        assert self.server is not None
        return int(self.server.sockets[0].getsockname()[1])

    async def listen(
        self,
        made: Callable[[], asyncio.BaseProtocol],
        host: str,
        port: int,
        ssl: tls.SSLContext | None = None,
        *,
        serving: bool = True,
    ) -> None:
        """Accept connections.

        Args:
            made: makes the protocol of a connection.
            host, port: where; port 0 is any free one.
            ssl: for TLS.
            serving: False lets connections wait until `serve`.

        Raises:
            OSError: the address is taken or not ours.
        """
        self.server = await asyncio.get_running_loop().create_server(
            made, host, port, ssl=ssl, backlog=1,
            ssl_handshake_timeout=None if ssl is None else TLS_HANDSHAKE_S, start_serving=serving,
        )  # fmt: skip
        one_at_a_time(self.server)

    async def serve(self) -> None:
        """Take the connections that `listen` let wait."""
        assert self.server is not None
        await self.server.start_serving()
        one_at_a_time(self.server)


def one_at_a_time(server: asyncio.Server) -> None:
    """For a server made with `backlog=1`: let the system keep as many connections as usual.

    asyncio tries to accept `backlog` connections in one go, and when descriptors run out it
    schedules a new attempt for each that failed, so that attempts multiply a hundredfold every
    second. With one at a time there is a single attempt. New connections also alternate with
    requests that way.
    """
    for listening in server.sockets:
        with listening.dup() as same:
            same.listen(BACKLOG)


IDLE_S: Final = 30
INTERVAL_S: Final = 10
PROBES: Final = 3


def tune(sock: socket.socket | None) -> None:
    """No Nagle delay; keep-alive probes after 30 s of silence, given up after three of them.

    A peer whose machine or network has died is thus gone after a minute instead of two hours, and
    with it whatever it held (control of the twin, memory of an upload). Harmless on sockets that
    are not TCP, and where the platform lacks an option.
    """
    if sock is None or sock.family not in (socket.AF_INET, socket.AF_INET6):
        return
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (
        ("TCP_KEEPIDLE", IDLE_S),
        ("TCP_KEEPINTVL", INTERVAL_S),
        ("TCP_KEEPCNT", PROBES),
        ("TCP_USER_TIMEOUT", 1000 * (IDLE_S + PROBES * INTERVAL_S)),
    ):
        option = getattr(socket, name, None)
        if option is not None:
            sock.setsockopt(socket.IPPROTO_TCP, option, value)
