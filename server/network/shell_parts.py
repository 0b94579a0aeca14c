"""What the TCP shells of twin and projector are made of, and their interface to an application.

The shells differ in how they read and write: lines or frames in order for the twin, frames side by
side and without copies for the projector.

Connections without a place wait in a `Room`: those that have not shown the token yet, and clients
that came when all places were taken. A newcomer always gets in, so that it can say hello or stop
the scanner; what it displaces belongs to the address that has most there.

Each connection has a send queue, its outbox. Messages go straight to the transport while the client
keeps up. Otherwise state-like events keep the newest value per slot and ordered ones a bounded
queue. Sending never blocks; a caller that has to wait for a slow client awaits `room`.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import math
import pickle
from collections import Counter, OrderedDict, deque
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from pydantic import BaseModel

from flexdt.protocol import AnyMethod, Codec, Connection, Prepared, RpcError
from flexdt.protocol import messages as m
from flexdt.protocol.fields import Params
from flexdt.protocol.rpc_errors import internal, not_authorised
from flexdt.runtime.access import ConnectionLimits, token_matches
from flexdt.runtime.log import LOGGER, Sparing, log, traced

WRONG_TOKENS = 3
"""Wrong tokens after which a connection is closed."""
WAITING = 512
"""Connections that may wait for a hello: where one address opens 167 a second, each of them still
has 3 s for it."""


class Guest(Protocol):
    """A connection that may be in a room."""

    address: str
    """Where it comes from, as `neighbourhood` has it."""
    gone: asyncio.Event
    """Whether it has ended."""

    def end(self) -> None:
        """Cut the connection off."""

    def displace(self) -> None:
        """Say that there is no place, and close the connection."""


class Room:
    """Connections without a place, in the order in which they came.

    Where it is full, the oldest connection of the address that has most goes. A newcomer thus
    always gets in, and an address with many connections displaces its own.

    Args:
        most: connections.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self.guests: dict[Guest, None] = {}

    def enter(self, guest: Guest) -> None:
        """Let a connection in; cuts off another one if need be."""
        self.guests[guest] = None
        if len(self.guests) > self._most:
            [(crowd, _)] = Counter(g.address for g in self.guests).most_common(1)
            oldest = next(g for g in self.guests if g.address == crowd)
            self.leave(oldest)
            oldest.displace()

    def leave(self, guest: Guest) -> None:
        """A connection has a place now, or has ended; it need not be here."""
        self.guests.pop(guest, None)


def neighbourhood(host: str) -> str:
    """The address for a share: an IPv4 address, or the 64 bits of an IPv6 network (one owner's)."""
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return host
    if address.version == 4:
        return str(address)
    return str(address.ipv4_mapped or ipaddress.ip_network((address, 64), strict=False))


class Deadlines:
    """Named timeouts of a connection.

    Args:
        on_timeout: called with the name and the seconds of one that has run out.
    """

    def __init__(self, on_timeout: Callable[[str, float], object]) -> None:
        self._on_timeout = on_timeout
        self._timers: dict[str, asyncio.TimerHandle] = {}

    def start(self, name: str, seconds: float | None) -> None:
        """Start a timeout unless it is running; None seconds: there is none."""
        if seconds is not None and name not in self._timers:
            self._timers[name] = asyncio.get_running_loop().call_later(
                seconds, self._on_timeout, name, seconds
            )

    def stop(self, name: str) -> None:
        """Cancel a timeout if it is running."""
        timer = self._timers.pop(name, None)
        if timer is not None:
            timer.cancel()

    def clear(self) -> None:
        """Cancel all."""
        for timer in self._timers.values():
            timer.cancel()


class TokenCheck:
    """The token that a connection has to show.

    Args:
        token: of the server; None where it has none.
        close: ends the connection after too many wrong tokens.
        lines: of the log.
    """

    def __init__(self, token: str | None, close: Callable[[], object], lines: Sparing) -> None:
        self._token, self._close, self._lines = token, close, lines
        self._wrong = 0

    async def check(self, given: str | None, client: str) -> None:
        """Compare a token; each wrong one is answered later than the one before.

        Raises:
            RpcError: -32004, it is not the server's.
        """
        if self._token is None or token_matches(given, self._token):
            return
        self._wrong += 1
        self._lines.log("wrong token", logging.WARNING, client=client, count=self._wrong)
        await asyncio.sleep(0.2 * self._wrong)
        if self._wrong >= WRONG_TOKENS:
            self._close()
        raise not_authorised()


async def answered(
    work: Awaitable[m.Response | m.Failure],
    method: str,
    *,
    trace: str,
    client: str,
    known: Collection[str],
    observe: Observe,
) -> m.Response | m.Failure:
    """Await the answer to a request, count it, and log it at the level `debug`.

    Args:
        work: makes the answer.
        method: requested.
        trace: id of the request in the logs.
        client: that sent it.
        known: methods; others are counted together.
        observe: counts.
    """
    clock = asyncio.get_running_loop().time
    begun = clock()
    with traced(trace):
        answer = await work
    taken = clock() - begun
    code = answer.error.code if isinstance(answer, m.Failure) else None
    observe(method if method in known else "unknown", taken, code)
    if LOGGER.isEnabledFor(logging.DEBUG):
        log("request", logging.DEBUG, trace=trace, client=client, method=method[:100],
            ms=round(1000 * taken, 3), code=code)  # fmt: skip
    return answer


Observe = Callable[[str, float, int | None], None]
"""Called for every answered request: method, seconds, error code or None."""


def unobserved(method: str, seconds: float, code: int | None) -> None:
    """An `Observe` that takes no notice."""


@dataclass(frozen=True)
class Call:
    """A request that another process has read: its validated parameters, or the error in them.

    Attributes:
        answered: whether it wants an answer (a notification does not).
    """

    id: m.Id
    method: str
    params: Params | RpcError
    answered: bool

    @property
    def message(self) -> m.Request | m.Notification:
        """The message as it concerns the order of requests and answers: without parameters."""
        return m.Request(self.id, self.method) if self.answered else m.Notification(self.method)


@dataclass(frozen=True)
class Frozen:
    """One message that another process has read, pickled by it.

    Attributes:
        data: to be thawed when its turn comes.
        method: that it calls; empty where it calls none.
    """

    data: bytes
    method: str

    def thawed(self) -> m.Single | Call:
        """The message."""
        message: m.Single | Call = pickle.loads(self.data)
        return message


Read = Callable[[bytes, Connection], Awaitable[Frozen | tuple[Frozen, ...]]]
"""Reads a large message of a connection apart from the loop: one message, or those of a batch.

Raises `RpcError` where that takes too much.
"""


class Session(Protocol):
    """The application's state of one connection."""

    async def handle(self, method: AnyMethod, params: Params) -> object:
        """Answer a call: a result model or plain data, or raise `RpcError`."""

    def close(self) -> None:
        """Called once when the connection has ended."""


class Peer(Protocol):
    """A connection as the application sees it."""

    name: str

    @property
    def codec(self) -> Codec:
        """The codec of the connection."""

    def post(self, message: m.Message | Prepared, slot: str | None = None) -> None:
        """Send an event: the newest of its `slot`, or (None) in order with all others."""

    def close(self, reason: str) -> None:
        """End the connection after what is queued has gone out."""


Open = Callable[[Peer], Session]
"""Opens the application's state of a connection that has been made (and let in)."""


FIRST, URGENT, ORDINARY = range(3)
"""Lanes by priority: E-stop; stop, abort and ping; everything else."""


class LoopTurns:
    """One turn is given in each turn of the loop; within a lane, connections alternate.

    Between two requests the loop polls its sockets, so an E-stop is received after at most one
    request of another connection, however many are queued.
    """

    def __init__(self) -> None:
        self._lanes: tuple[_Lane, ...] = (OrderedDict(), OrderedDict(), OrderedDict())
        self._due = False

    async def take(self, who: object, lane: int) -> None:
        """Wait for a turn of the connection `who` in a lane; lower lanes go first."""
        loop = asyncio.get_running_loop()
        turn = loop.create_future()
        self._lanes[lane].setdefault(who, deque()).append(turn)
        if not self._due:
            self._due = True
            loop.call_soon(self._give)
        await turn

    def _give(self) -> None:
        self._due = False
        for lane in self._lanes:
            while lane:
                who, waiting = lane.popitem(last=False)
                turn = waiting.popleft()
                if waiting:
                    lane[who] = waiting
                if not turn.done():  # cancelled: its connection is gone
                    turn.set_result(None)
                    if any(self._lanes):
                        self._due = True
                        asyncio.get_running_loop().call_soon(self._give)
                    return


_Lane = OrderedDict[object, deque[asyncio.Future[None]]]


A_WRITE = 1 << 18
"""Bytes given to the transport at a time, since it copies what it cannot send at once."""


class SendTarget(Protocol):
    """A connection as its send queue sees it."""

    wire: Connection
    limits: ConnectionLimits
    transport: asyncio.Transport

    def abort(self, reason: str) -> None:
        """Abort the connection."""

    def log(
        self, event: str, level: int = logging.INFO, *, error: bool = False, **facts: object
    ) -> None:
        """Write a line about the connection."""


class Outbox:
    """The send queue: replies and ordered events in order, then the newest value of each slot."""

    def __init__(self, link: SendTarget) -> None:
        self.link = link
        self.ready = asyncio.Event()
        self.ready.set()
        self.over = False
        self.queue: deque[bytes] = deque()
        self.unsent = 0
        self.slots: dict[str, m.Message | Prepared] = {}

    def reply(self, message: m.Response | m.Failure) -> None:
        """Send or queue an answer."""
        self.send(self.encode(message))

    def send(self, body: Sequence[bytes]) -> None:
        """Send or queue what `encode` has made, or several of them as a batch."""
        wire = self.link.wire
        try:
            pieces = wire.framed(body)
        except RpcError as error:  # `encode` has seen to it that this is a batch
            pieces = wire.framed(wire.body(m.Failure(None, error)))
        self._put_all(pieces)

    def encode(self, message: m.Response | m.Failure) -> list[bytes]:
        """The body of an answer, or of why it cannot be sent."""
        wire = self.link.wire
        try:
            body = wire.body(message)
            wire.framed(body)
        except RpcError as error:
            return wire.body(m.Failure(message.id, error))
        except (ValueError, TypeError, OverflowError):
            where = _not_finite(m.to_plain(message))
            self.link.log("reply not sent", logging.ERROR, error=True, where=where)
            return wire.body(m.Failure(message.id, internal()))
        return body

    def event(self, message: m.Message | Prepared, slot: str | None) -> None:
        """Send an event now, or keep it: newest of its slot, or (None) in order."""
        if self.over or self.link.transport.is_closing():
            return
        if slot is not None and not self.ready.is_set():
            self.slots[slot] = message
            return
        if len(self.queue) >= self.link.limits.max_events:
            self.over = True
            self.link.abort(f"{len(self.queue)} events unread")
            return
        self._put_event(message)

    def _put_event(self, message: m.Message | Prepared) -> None:
        try:
            self._put_all(self.link.wire.pieces(message))
        except (RpcError, ValueError, TypeError, OverflowError):
            self.link.log("event not sent", logging.ERROR, error=True)

    def _put_all(self, pieces: Sequence[bytes]) -> None:
        if sum(map(len, pieces)) <= A_WRITE:
            self._put(b"".join(pieces))
            return
        for piece in pieces:
            for at in range(0, len(piece), A_WRITE):
                self._put(piece[at : at + A_WRITE])

    def _put(self, data: bytes) -> None:
        if self.over or self.link.transport.is_closing():
            return  # asyncio would complain of every write to a connection that is gone
        if self.ready.is_set():
            self.link.transport.write(data)
        else:
            self.queue.append(data)
            self.unsent += len(data)

    def pause(self) -> None:
        """The transport is full."""
        self.ready.clear()

    def resume(self) -> None:
        """The transport takes more."""
        self.ready.set()
        while self.queue and self.ready.is_set():
            data = self.queue.popleft()
            self.unsent -= len(data)
            if not self.link.transport.is_closing():
                self.link.transport.write(data)
        while self.slots and self.ready.is_set():
            slot = next(iter(self.slots))
            self._put_event(self.slots.pop(slot))

    async def room(self) -> None:
        """Wait until the client has taken enough of its replies."""
        while self.unsent > self.link.limits.max_unsent and not self.over:
            await self.ready.wait()

    async def flushed(self) -> None:
        """Wait until all has been handed to the transport."""
        while (self.queue or self.slots) and not self.over:
            await self.ready.wait()

    def lost(self) -> None:
        """Drop the queue: the connection has ended."""
        self.over = True
        self.queue.clear()
        self.slots.clear()
        self.ready.set()


def _not_finite(value: object, path: str = "$") -> str | None:
    """Path of the first number that JSON cannot represent, for the log."""
    match value:
        case float():
            return None if math.isfinite(value) else f"{path}: {value}"
        case BaseModel():
            return _not_finite(value.model_dump(), path)
        case Mapping():
            inner = [(f"{path}.{key}", v) for key, v in value.items()]
        case list() | tuple():
            inner = [(f"{path}[{i}]", v) for i, v in enumerate(value)]
        case _:
            return None
    return next((found for p, v in inner if (found := _not_finite(v, p))), None)
