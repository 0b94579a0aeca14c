"""The asyncio shell: sockets around `protocol.Connection`, an application behind it.

Requests of one connection are handled in order, one at a time, so that `axes.move` with
wait and then `projection.get` show the end of the motion; urgent ones (stop, E-stop,
abort, ping) overtake. Received messages wait as bytes and are decoded when their turn
comes: one request of one connection in each turn of the loop (`turns`). Messages that may
name an urgent method, in whatever spelling, are decoded as they arrive. A client that does
not read costs only its own connection: state events keep the newest value per slot, ordered
events have a bounded queue, and a client that stays stuck is disconnected. This module does
not know the meaning of methods, except that `session.hello` brings the token and that an
E-stop comes first.

A client takes one of `max_clients` places when it has shown the token, or with its first
request where there is none. Until then, and while all places are taken, it is in a
`WaitingList`: there it may call hello, and urgent methods once it has shown the token where
there is one, but nothing else.
"""

from __future__ import annotations

import asyncio
import logging
import ssl as tls
import time
from collections.abc import Coroutine, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, TypeVar, cast

from flexdt.protocol import (
    METHODS,
    AnyMethod,
    Codec,
    Connection,
    Correlation,
    Prepared,
    Role,
    find,
)
from flexdt.protocol import messages as m
from flexdt.protocol import rpc_errors as errors
from flexdt.protocol.connection import MAX_ANSWER
from flexdt.protocol.fields import Params
from flexdt.protocol.method import parse_params, require_compatible
from flexdt.protocol.methods.session_messages import Hello
from flexdt.protocol.rpc_errors import ProtocolError, RpcError
from flexdt.runtime import descriptors, waiting_room
from flexdt.runtime.access import ConnectionLimits, check_bind
from flexdt.runtime.log import Sparing, log
from flexdt.runtime.process import ListeningServer, tune
from flexdt.runtime.waiting_room import Guesses, WaitingList, neighbourhood
from flexdt.server.network import admission, batches, deadlines, loop_turns, outbox
from flexdt.server.network import shell_parts as parts

READ_AHEAD_BYTES = 512 << 10
"""Bytes of complete messages that may wait for one connection; then reading pauses."""
BUFFER_BYTES: Final = 1 << 15
"""Bytes taken from one connection before others have their turn: 8 192 empty
frames, a few ms."""
MAX_INLINE_BYTES = 32 << 10
"""Bytes of a message above which it is read in another process."""
MAX_LIGHT_VALUES = 1024
"""Values of a message above `MAX_INLINE_BYTES` up to which it is read here if it may be
urgent: 1 MiB takes 2 to 18 ms."""
ESTOP = "safety.estop"
"""Method that is served before everything else."""
ESTOP_BYTES = ESTOP.encode()
Given = Mapping[str, object] | list[object] | Params | RpcError | None
"""Parameters as they came, or as they were validated apart."""
MAX_URGENT_IN_SERVICE = 8
"""Largest number of urgent requests of one connection in service; E-stops four
times as many."""
LOOK_S = 0.001
"""Time for which one turn of the loop searches for urgent requests other than E-stops [s]."""
RESERVED_PLACES = 16
"""Number of clients beyond `max_clients` whose urgent requests are served."""
MAX_STRANGE_MESSAGES = 10
"""Number of messages without the token after which a connection is closed."""
HELLO = "session.hello"


@dataclass(eq=False, repr=False)
class TcpServer(ListeningServer):
    """A listening server; made by `serve`."""

    open: parts.Open
    limits: ConnectionLimits
    token: str | None
    methods: Mapping[str, AnyMethod]
    observe: parts.Observe = parts.unobserved
    read: parts.Read | None = None

    def __post_init__(self) -> None:
        """Begin without connections and with empty waiting rooms; nothing listens yet.

        There are fewer places where the process may have few descriptors.
        """
        self.links: set[_Link] = set()
        wanted = self.limits.max_clients, waiting_room.MAX_WAITING
        clients, waiting = descriptors.fitted(
            *wanted, RESERVED_PLACES, descriptors.limit()
        )
        if (clients, waiting) != wanted:
            self.limits = replace(self.limits, max_clients=clients)
            log("few descriptors", logging.WARNING, clients=clients, waiting=waiting)
        self.waiting = WaitingList[_Link](waiting)
        self.reserved = WaitingList[_Link](RESERVED_PLACES)
        self.lines = Sparing()
        self.guesses = Guesses(self.lines)
        self.turns = loop_turns.LoopTurns()
        self.urgent = tuple(x.name.encode() for x in self.methods.values() if x.urgent)
        self._unexamined: dict[_Link, None] = {}  # in the order in which they came
        self._examination_due = False
        self.opened = 0

    def connection(self) -> _Link:
        """Make the protocol of one connection, whatever carries its bytes."""
        return _Link(self)

    def look_soon(self, link: _Link) -> None:
        """Schedule a search for a connection's urgent requests in the loop's next round.

        A connection is in the list once.
        """
        self._unexamined[link] = None
        if not self._examination_due:
            self._examination_due = True
            asyncio.get_running_loop().call_soon(self._start_urgent)

    def _start_urgent(self) -> None:
        """Let listed connections start their urgent requests, for up to `LOOK_S`.

        At least one connection is examined at each call. The rest is scheduled for the
        loop's next round, also if one raises.
        """
        until = time.perf_counter() + LOOK_S
        try:
            while self._unexamined:
                link = next(iter(self._unexamined))
                del self._unexamined[link]
                link.overtake()  # may want another look
                if time.perf_counter() > until:
                    break
        finally:
            self._examination_due = bool(self._unexamined)
            if self._examination_due:
                asyncio.get_running_loop().call_soon(self._start_urgent)

    async def close(self) -> None:
        """Stop listening, abort every connection (waiting ones too), and wait until all
        are gone.

        Messages that are not sent are lost.
        """
        if self.server is not None:
            self.server.close()
        links = {*self.links, *self.waiting.guests, *self.reserved.guests}
        for link in links:
            link.end()
        await asyncio.gather(*(link.gone.wait() for link in links))


async def serve(
    open: parts.Open,
    host: str = "127.0.0.1",
    port: int = 0,
    *,
    limits: ConnectionLimits | None = None,
    token: str | None = None,
    ssl: tls.SSLContext | None = None,
    methods: Mapping[str, AnyMethod] = METHODS,
    observe: parts.Observe = parts.unobserved,
    read: parts.Read | None = None,
) -> TcpServer:
    """Listen on `host`:`port` (0: any free port) and serve an application.

    Args:
        open: begins a session of the application with a connection.
        host, port: address to listen on.
        limits: of connections; None for the defaults.
        token: that clients must bring; None for none.
        ssl: for TLS; None for plain TCP.
        methods: there are, by name.
        observe: called for every answer.
        read: reads large messages; None: they are read in the loop, which then waits
            for it.

    Raises:
        AccessError: the address can be reached by others and there is no token.
        OSError: the address is taken or not ours.

    Returns:
        The listening server.
    """
    check_bind(host, token)
    limits = limits or ConnectionLimits()
    server = TcpServer(open, limits, token, methods, observe, read)
    await server.listen(server.connection, host, port, ssl)
    return server


_Result = TypeVar("_Result")
_Read = m.Message | parts.Frozen | tuple[parts.Frozen, ...]
"""A message as it is served: decoded, or read in another process (a tuple is a batch)."""
_Left = _Read | batches.Split | None
"""The part of a message that has been read early and waits for its turn."""


@dataclass(frozen=True)
class _Early:
    """A large message that is read before its turn.

    Attributes:
        raw: its bytes in the queue, held here so that no other message has their
            identity.
        task: of reading it, and of serving what is urgent in it.
    """

    raw: bytes
    task: asyncio.Task[_Left]


class _Link(asyncio.BufferedProtocol):
    """One connection."""

    def __init__(self, server: TcpServer) -> None:
        """Make the state of a connection that is not made yet; admitted already if no token
        is needed.
        """
        self.server = server
        self.limits = server.limits
        self.wire = Connection(
            max_message=self.limits.max_message, max_batch=self.limits.max_batch
        )
        self.name = self.address = ""
        self.number = self.served = 0
        self.calls: Correlation[None] = Correlation(Role.SERVER)
        self.read = memoryview(bytearray(BUFFER_BYTES))
        self.gone = asyncio.Event()
        self.session: parts.Session | None = None
        self.let_in = server.token is None
        self.arrived = asyncio.Event()
        self.estop_came = (
            False  # and is, maybe, among the messages that have not been examined
        )
        self.ended = False
        self.broken = 0
        self.token_check = admission.TokenCheck(
            server.token,
            lambda: self.loop.call_soon(self.close, "wrong tokens"),
            server.guesses,
        )
        self.allowance = 0.0
        self.allowance_at = 0.0
        self.out = outbox.Outbox(self)
        self.split: dict[int, batches.Split] = {}
        """Batches whose urgent items have been begun; the others wait in the
        queue, by identity."""
        self.early: dict[int, _Early] = {}
        """Large messages that are read before their turn while they wait in the queue, by
        identity."""
        self.reading_early = asyncio.Lock()
        self.worker: asyncio.Task[None] | None = None
        self.tasks: set[asyncio.Task[Any]] = set()
        self.deadlines = deadlines.Deadlines(
            lambda what, seconds: self.abort(f"no {what} within {seconds:g} s")
        )

    # -- the transport's calls ---------------------------------------------------------------

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Register a new connection in the waiting room and start serving it.

        The connection is numbered and named "HOST:PORT#NUMBER"; its socket is tuned,
        and its write buffer counts as full above 64 KiB. Without a token on the server,
        the application's session is opened at once; else a deadline (`hello_timeout_s`)
        for the client's hello starts. The waiting room may end an older connection. A
        failure of the serving task aborts the connection.

        Args:
            transport: of the connection.
        """
        self.transport = cast(asyncio.Transport, transport)
        self.loop = asyncio.get_running_loop()
        self.server.opened += 1
        peer = self.transport.get_extra_info("peername") or ("?", 0)
        self.number = self.server.opened
        self.name = f"{peer[0]}:{peer[1]}#{self.number}"
        # As without TLS, where asyncio's own limit is eight times as high: beyond it events
        # wait in `out`, where newer ones replace them.
        self.transport.set_write_buffer_limits(high=64 * 1024)
        tune(self.transport.get_extra_info("socket"))
        self.address = neighbourhood(str(peer[0]))
        self.server.waiting.enter(self)
        if self.let_in:
            self._admit()
        else:
            self.deadlines.start("hello", self.limits.hello_timeout_s)
        self.worker = self.loop.create_task(self._serve_messages())
        # Nobody awaits it: without this a connection whose loop has failed stays, and is
        # silent.
        self.worker.add_done_callback(self._crashed)

    def _take_place(self) -> bool:
        """Give the connection a place if one is free; return whether it has one of its
        own.

        Else it gets a reserved one, for urgent requests alone, where a new connection may
        displace an older one. It leaves the waiting room.
        """
        server = self.server
        if self in server.links:
            return True
        server.waiting.leave(self)
        if len(server.links) < self.limits.max_clients:
            server.links.add(self)
            server.reserved.leave(self)
            return True
        if self not in server.reserved.guests:
            server.reserved.enter(self)
        return False

    def _no_place(self) -> RpcError:
        """Make the error for a server with too many clients."""
        return errors.busy("too many clients", {"allowed": self.limits.max_clients})

    def get_buffer(self, sizehint: int) -> memoryview:
        """Return the buffer for the next bytes."""
        return self.read

    def buffer_updated(self, nbytes: int) -> None:
        """Process the bytes in the buffer."""
        # A copy, because the next bytes go into the same buffer.
        self.data_received(bytes(self.read[:nbytes]))

    def data_received(self, data: bytes) -> None:
        """Divide received bytes into messages; start E-stops at once, other urgent
        requests soon.

        The deadline `message_timeout_s` runs while a message is incomplete, and stops
        while reading pauses. Reading pauses while too many messages or bytes wait
        (`_full`). The serving task is woken for whole messages, and for an incomplete
        one, which may be too long already.

        Args:
            data: any part of the stream.
        """
        before = self.wire.waiting
        self.wire.feed(data)
        if self.wire.waiting > before:  # before an E-stop is taken out
            self.deadlines.stop("message")
        if self.wire.holds(ESTOP_BYTES):
            self.estop_came = True
            self.overtake()
        # All connections share `LOOK_S` a turn for urgent requests other than E-stops.
        elif self.wire.unjudged:
            self.server.look_soon(self)
        if self.wire.whole:
            self.arrived.set()
        if self.wire.mid_message:
            self.deadlines.start("message", self.limits.message_timeout_s)
            self.arrived.set()  # a line too long is refused before its end
        if self._full:
            # The kernel's buffers fill up, and TCP holds the sender back.
            self.transport.pause_reading()
            self.deadlines.stop("message")  # the rest comes when we read again

    def overtake(self) -> None:
        """Start the urgent requests among the received messages, wherever in the queue
        they are.

        Nothing before admission or after the end, or if all has been examined. If not
        all was examined now it goes on: at the loop's next turn if an E-stop may be
        among it, else in the server's order.
        """
        if self.gone.is_set() or not self.let_in:
            return
        found: list[Coroutine[object, object, None]] = []

        def wanted(raw: bytes) -> bool:
            """Decode a message and start it if it is urgent; return whether to take it
            out of the queue.

            Ordinary messages, and those beyond `MAX_URGENT_IN_SERVICE` in service (four
            times as many for E-stops), wait for their turn. Of a batch with other items
            the urgent ones are started; it stays in the queue, for the others. So does a
            message above `MAX_INLINE_BYTES` that is not light; `_read_early` reads it.

            Args:
                raw: the message as received.
            """
            served = len(self.tasks) + len(found)
            if len(raw) > MAX_INLINE_BYTES and not self._light(raw):
                if served < MAX_URGENT_IN_SERVICE * 4:
                    self._start_early(raw)
                return False
            message = self.wire.decode(raw)
            lane = self._lane(message)
            if lane == loop_turns.ORDINARY or served >= MAX_URGENT_IN_SERVICE * (
                4 if lane == loop_turns.FIRST else 1
            ):
                return False
            if isinstance(message, m.Batch) and not all(map(self._urgent, message.items)):
                # By identity, as batches may have equal bytes; `Split` keeps these alive, and
                # so their id.
                split = self.split[id(raw)] = batches.Split(
                    raw, self._batch(message.items)
                )
                found.append(self._begin(split))
                return False  # its other items stay in the queue
            found.append(self._serve(message, urgent=True))
            return True

        if self.wire.unjudged:
            self.wire.overtake(self.server.urgent, wanted)
            for work in found:
                self._start(work)
            self.estop_came = self.estop_came and self.wire.unjudged
            # At once, whatever other connections have: an E-stop may be behind what one look
            # takes.
            if self.estop_came:
                self.loop.call_soon(self.overtake)
            elif self.wire.unjudged:
                self.server.look_soon(self)

    def eof_received(self) -> bool:
        """Note the client's end of stream; what was received is still answered.

        Replies may take `end_timeout_s`. The deadline of an incomplete message ends.
        Returns whether the transport stays open for them: not under TLS.
        """
        self.ended = True
        self.arrived.set()
        self.deadlines.stop("message")
        self.deadlines.start("end", self.limits.end_timeout_s)
        # asyncio's TLS transports cannot stay half open.
        return self.transport.get_extra_info("ssl_object") is None

    def connection_lost(self, exc: Exception | None) -> None:
        """Cancel the work of an ended connection, give back its place and close its
        session.

        Queued messages are dropped, deadlines end, and who waits for the end (`gone`)
        is woken. An error of the session's close is logged.

        Args:
            exc: the reason, not used.
        """
        self.deadlines.clear()
        for task in (*self.tasks, *([self.worker] if self.worker else [])):
            task.cancel()
        self.out.lost()
        self.server.links.discard(self)
        self.server.waiting.leave(self)
        self.server.reserved.leave(self)
        if self.session is not None:
            session = self.session
            self.session = None
            try:
                session.close()
            except Exception:
                self.log("close failed", logging.ERROR, error=True)
        self.gone.set()

    def pause_writing(self) -> None:
        """Queue messages of a slow client; after `send_timeout_s` it is cut off."""
        self.out.pause()
        self.deadlines.start("send", self.limits.send_timeout_s)

    def resume_writing(self) -> None:
        """Send the queue: the client reads again."""
        self.deadlines.stop("send")
        self.out.resume()

    # -- the application's calls (Peer) ------------------------------------------------------

    @property
    def codec(self) -> Codec:
        """Codec; JSON until the first byte."""
        return self.wire.codec or Codec.JSON

    def post(self, message: m.Message | Prepared, slot: str | None = None) -> None:
        """See `Peer.post`."""
        self.out.event(message, slot)

    def close(self, reason: str) -> None:
        """End the connection after what was written has been sent, at most `send_timeout_s`;
        log why.
        """
        self.log("closing", reason=reason)
        # This waits until all has been sent, for ever if the client does not read.
        self.transport.close()
        self.deadlines.start("send", self.limits.send_timeout_s)

    def end(self) -> None:
        """Abort the connection: the server ends."""
        self.transport.abort()

    def displace(self) -> None:
        """End the connection for a newer one; an admitted client is sent the reason,
        others are not.

        The connection is aborted, so that the reason may be lost, if the client is not
        admitted or does not read what was sent.
        """
        if self.let_in:
            self.out.reply(m.Failure(None, self._no_place()))
        if self.let_in and not self.transport.get_write_buffer_size():
            self.close("displaced by a newer connection")
        else:  # a client that does not read would stay until a time-out
            self.end()

    def log(
        self,
        event: str,
        level: int = logging.INFO,
        *,
        error: bool = False,
        **facts: object,
    ) -> None:
        """Log a line about this connection, unless there were too many of its kind.

        Before admission that is a kind of its own.
        """
        kind = event
        if not self.let_in:
            kind = f"{event}, no token"
        self.server.lines.log(
            event, level, kind=kind, error=error, client=self.name, **facts
        )

    def abort(self, reason: str) -> None:
        """Abort the connection and log the reason."""
        self.log("cut off", logging.WARNING, reason=reason)
        self.transport.abort()

    # -- requests ----------------------------------------------------------------------------

    def _admit(self) -> None:
        """Admit the connection and open the application's session; abort it if that
        fails.

        The time limit for hello ends, reading is resumed if little waits, and
        messages that came before are examined for urgent ones.
        """
        self.let_in = True
        self.loop.call_soon(self.overtake)  # earlier messages were not examined
        self.deadlines.stop("hello")
        self._relax()
        try:
            self.session = self.server.open(self)
        except Exception:
            self.log("open failed", logging.ERROR, error=True)
            self.abort("the application did not open a session")

    def _lane(self, message: _Read) -> int:
        """Determine the lane of a message: an E-stop's, an urgent one, the ordinary.

        Before admission, and for unknown methods and answers, the ordinary.

        Args:
            message: a call or a batch (a tuple where another process has read it), which
                has the lane of its most urgent item.

        Returns:
            A lane of `loop_turns`.
        """
        name = ""
        match message:
            case m.Batch(items):
                return min(map(self._lane, items), default=loop_turns.ORDINARY)
            case tuple():
                return min(map(self._lane, message), default=loop_turns.ORDINARY)
            case parts.Frozen(method=method):
                name = method
            case m.Request(method=method) | m.Notification(method=method):
                name = method
        known = self.server.methods.get(name)
        if not self.let_in or known is None or not known.urgent:
            return loop_turns.ORDINARY
        if name == ESTOP:
            return loop_turns.FIRST
        return loop_turns.URGENT

    def _urgent(self, message: _Read) -> bool:
        """Return whether a message is not ordinary."""
        return self._lane(message) != loop_turns.ORDINARY

    async def _serve_messages(self) -> None:
        """Serve the connection's messages in order, one in each turn; close after its
        stream has ended.

        Before admission its turns are urgent. A malformed message is answered with its
        error; one that leaves the stream unreadable also ends the connection at once. A
        batch whose urgent items have been started is answered after them. At the
        stream's end all answers, those of urgent requests too, are sent before it
        closes.
        """
        while True:
            while self.wire.whole:
                await self.server.turns.take(
                    self, loop_turns.ORDINARY if self.let_in else loop_turns.URGENT
                )
                raw = self.wire.next_raw()
                self._relax()
                if isinstance(raw, m.Malformed) and raw.fatal:
                    self.out.reply(raw.reply)
                    self.close(raw.error.message)
                    return
                if isinstance(raw, m.Malformed):
                    await self._serve(raw)
                elif (split := self.split.pop(id(raw), None)) is not None:
                    await self._finish(split)
                elif (early := self.early.pop(id(raw), None)) is not None:
                    await self._serve_left(await early.task)
                elif raw is not None:
                    await self._serve(await self._decode(raw))
            if self.ended:
                self._answer_the_end()
                # Urgent requests are served beside this loop; they are answered as well.
                while self.tasks:
                    await asyncio.wait(set(self.tasks))
                await self.out.flushed()
                self.transport.close()
                return
            # Nothing was awaited since the queue was seen empty: no arrival is lost.
            self.arrived.clear()
            await self.arrived.wait()

    def _answer_the_end(self) -> None:
        """Send a parse error without id if the client has ended its stream inside a
        message.

        Nothing if it ended between messages."""
        try:
            self.wire.receive_end()
        except ProtocolError as error:
            self.out.reply(m.Failure(None, errors.parse_error(str(error))))

    def _light(self, raw: bytes) -> bool:
        """Return whether a large message decodes quickly: JSON of few values."""
        return (
            self.codec is Codec.JSON
            and sum(map(raw.count, (b",", b"[", b"{"))) <= MAX_LIGHT_VALUES
        )

    def _start_early(self, raw: bytes) -> None:
        """Begin to read a large message before its turn, as it may be urgent."""
        task = self._start(self._read_early(raw))
        self.early[id(raw)] = _Early(raw, task)

    async def _read_early(self, raw: bytes) -> _Left:
        """Read a large message before its turn, and serve what is urgent in it.

        A connection's messages are read one after the other, so that others have their
        turn between them.

        Args:
            raw: the message, which waits in the queue.

        Returns:
            The part of it to be served in its turn: an ordinary message, a batch whose
            urgent items have been served; None if it has been served, and has left the
            queue.
        """
        async with self.reading_early:
            message = await self._decode(raw, urgent=True)
        if not self._urgent(message):
            return message
        if isinstance(message, m.Batch | tuple):
            items = message if isinstance(message, tuple) else message.items
            split = batches.Split(raw, self._batch(items))
            await self._begin(split)
            return split
        if not self.wire.withdraw(raw):
            return message  # its turn has come
        del self.early[id(raw)]
        self._relax()
        await self._serve(message, urgent=True)
        return None

    async def _serve_left(self, left: _Left) -> None:
        """Serve in its turn the part that `_read_early` has left of a message."""
        match left:
            case batches.Split():
                await self._finish(left)
            case None:
                pass
            case _:
                await self._serve(left)

    async def _finish(self, split: batches.Split) -> None:
        """Serve the other items of a batch whose urgent ones have been begun, and answer it."""
        # Its answers go out together, so that those begun earlier have to be there.
        await split.urgent_done.wait()
        await self._answer_batch(split.batch, waits=False)

    async def _decode(self, raw: bytes, *, urgent: bool = False) -> _Read:
        """Decode a message, a large one in another process; errors become `Malformed`, nothing
        is raised.

        Before admission a large one is refused unread. A failure of the other process is logged.

        Args:
            raw: bytes of one message.
            urgent: whether it may be urgent.

        Returns the message; `Frozen` calls (a tuple for a batch) from the other process.
        """
        read = self.server.read
        if not self.let_in and len(raw) > MAX_INLINE_BYTES:
            return m.Malformed(errors.not_authorised())
        if read is None or len(raw) <= MAX_INLINE_BYTES:
            return self.wire.decode(raw)
        try:
            return await read(raw, self.wire, urgent)
        except RpcError as error:
            return m.Malformed(error)
        except Exception:
            self.log("a message was not read", logging.ERROR, error=True)
            return m.Malformed(errors.internal())

    async def _serve(self, message: _Read, *, urgent: bool = False) -> None:
        """Answer one message or batch and send the answer; waits while the client reads
        too slowly.

        A notification has no answer.

        Args:
            message: decoded, or read in another process (a tuple is a batch).
            urgent: whether it was taken out of the queue before its turn; then it waits
                for a turn of its own lane, as do the items of a batch.
        """
        match message:
            case m.Batch(items):
                await self._answer_batch(self._batch(items), waits=urgent)
            case tuple():
                await self._answer_batch(self._batch(message), waits=urgent)
            case _:
                if urgent:
                    await self._turn(message)
                answer = await self._answer(message)
                if answer is not None:
                    await self._send(self.out.encode(answer))

    def _batch(self, items: Sequence[m.Single | parts.Frozen]) -> batches.Batch:
        return batches.Batch(items, self._lane, MAX_ANSWER[self.codec])

    async def _begin(self, split: batches.Split) -> None:
        """Serve a batch's urgent items, each in a turn of its own.

        `urgent_done` is set at the end, even after an error. The others follow when the
        batch's turn comes."""
        try:
            await self._serve_items(split.batch, waits=True, urgent_alone=True)
        finally:
            split.urgent_done.set()

    async def _answer_batch(self, batch: batches.Batch, *, waits: bool) -> None:
        """Serve the remaining items of a batch and send all its answers together. Nothing is
        sent for a batch of notifications. `batch`: whose items are served; `waits`: whether the
        first item waits for a turn, too."""
        await self._serve_items(batch, waits=waits)
        if bodies := batch.bodies():
            await self._send(self.wire.batch(bodies))

    async def _serve_items(
        self, batch: batches.Batch, *, waits: bool, urgent_alone: bool = False
    ) -> None:
        """Serve the remaining items of a batch, each in a turn of its own, and keep their
        answers.

        Once the answers are too large, ordinary items are answered with that error unserved.

        `batch`: whose items are served; `waits`: whether the first item waits for a turn, too;
        `urgent_alone`: whether only urgent items are served.
        """
        while (item := batch.next_item(urgent_alone=urgent_alone)) is not None:
            if waits:
                await self._turn(item)
            waits = True
            full = batch.full and not self._urgent(item)
            batch.keep(
                await self._answer(item, batch.too_large if full else None),
                self.out.encode,
            )

    async def _send(self, body: list[bytes]) -> None:
        self.out.send(body)
        await self.out.room()

    async def _turn(self, message: m.Message | parts.Frozen) -> None:
        """Wait for a turn in the message's lane."""
        await self.server.turns.take(self, self._lane(message))

    async def _answer(
        self, message: m.Message | parts.Frozen, refused: RpcError | None = None
    ) -> m.Response | m.Failure | None:
        """Answer one message and count it; a violation of the protocol ends the
        connection.

        A violation (such as an id that is in use) is answered with an error without id.
        A malformed message is answered with its error and counted as broken. Answers of
        the client have no effect.

        Args:
            message: decoded, or read in another process.
            refused: error to answer with instead of serving it.

        Returns:
            The answer; None for a notification or an answer of the client.
        """
        item = message.thawed() if isinstance(message, parts.Frozen) else message
        try:
            self.calls.receive(item.message if isinstance(item, parts.Call) else item)
        except ProtocolError as error:
            # Later, so that the answer with the reason is written before.
            self.loop.call_soon(self.close, str(error))
            return m.Failure(None, errors.invalid_request(str(error)))
        match item:
            case m.Request(id, name, params) | parts.Call(id, name, params, True):
                answer = await self._call(
                    id, name, params if refused is None else refused
                )
                self._count(broken=False)
                return self.calls.answer(answer)
            case m.Notification(name, params) | parts.Call(_, name, params, False):
                await self._call(None, name, params if refused is None else refused)
                self._count(broken=False)
            case m.Malformed() as malformed:
                self._count(broken=True)
                return self.calls.answer(malformed.reply)
        return None

    def _count(self, *, broken: bool) -> None:
        """Count broken messages in a row, and close the connection after too many.

        A good message of an admitted client resets the count; of a client that is not
        admitted every message counts. The limit is `malformed` for an admitted client,
        `MAX_STRANGE_MESSAGES` for another.
        """
        if broken or not self.let_in:
            self.broken = self.broken + 1
        else:
            self.broken = 0
        limit = self.limits.malformed if self.let_in else MAX_STRANGE_MESSAGES
        if self.broken >= limit:
            what = (
                "broken messages in a row" if self.let_in else "messages without a token"
            )
            self.loop.call_soon(self.close, f"{self.broken} {what}")

    async def _call(self, id: m.Id, name: str, given: Given) -> m.Response | m.Failure:
        """Serve a call by `_handle`, and count and log it under a trace of its own.

        The trace is the connection's number and that of the call. Returns the answer,
        also for a notification.

        Args:
            id: of the request; None for a notification.
            name: of the method.
            given: parameters, or the error in them.
        """
        self.served += 1
        trace = f"{self.number}.{self.served}"
        return await parts.answered(
            self._handle(id, name, given, trace),
            name,
            trace=trace,
            client=self.name,
            known=self.server.methods,
            observe=self.server.observe,
        )

    async def _handle(
        self, id: m.Id, name: str, given: Given, trace: str
    ) -> m.Response | m.Failure:
        """Check admission, rate, place and parameters of a call, and have the session
        handle it.

        In that order. Before admission only hello is allowed. Urgent calls need neither
        rate nor place; hello needs no place. A hello with the right token opens the
        session, and then reaches it as well. Unexpected errors are logged; the answer
        has the trace.

        Args:
            id: of the request; None for a notification.
            name: of the method.
            given: parameters, or the error in them.
            trace: id of the call in the log.

        Returns:
            The result, or any failure as an answer.
        """
        try:
            if not self.let_in and name != HELLO:
                raise errors.not_authorised()
            method = find(name, self.server.methods)
            if not method.urgent:
                self._check_rate()
            seated = self.let_in and self._take_place()
            if not (seated or method.urgent or name == HELLO):
                raise self._no_place()
            if isinstance(given, RpcError):
                raise given
            if isinstance(given, Params):
                params = given
            else:
                params = parse_params(method, given)
            if isinstance(params, Hello):
                await self._check_token(params)
            if self.session is None:
                raise errors.not_authorised()
            return m.Response(id, await self.session.handle(method, params))
        except RpcError as error:
            return m.Failure(id, error)
        except Exception:
            self.log("handler failed", logging.ERROR, error=True, method=name[:100])
            # A person needs the id to find the traceback.
            return m.Failure(id, errors.internal(trace))

    async def _check_token(self, hello: Hello) -> None:
        """Check token and protocol version of a hello, and admit the connection.

        Nothing is checked (the version neither) if the server has no token. An admitted
        one keeps its place. Raises as `TokenCheck.check` and `require_compatible`.
        """
        if self.server.token is None:
            return
        await self.token_check.check(hello.token, self.name, self.address)
        require_compatible(hello.protocol)  # before the session opens
        if not self.let_in:
            self._admit()
            self._take_place()

    def _check_rate(self) -> None:
        """Count a request against the client's rate `requests_per_s`; nothing if that is
        None.

        The allowance grows with time, up to one second's requests; a refused one does
        not count.

        Raises:
            RpcError: -32003, more requests than that.
        """
        rate = self.limits.requests_per_s
        if rate is None:
            return
        now = self.loop.time()
        self.allowance = min(rate, self.allowance + (now - self.allowance_at) * rate)
        self.allowance_at = now
        if self.allowance < 1.0:
            raise errors.busy(
                f"more than {rate:g} requests/s", {"allowed": rate, "unit": "1/s"}
            )
        self.allowance -= 1.0

    @property
    def _load(self) -> int:
        """Number of waiting requests and of urgent ones in service."""
        return self.wire.waiting + len(self.tasks)

    @property
    def _full(self) -> bool:
        """Whether reading pauses, as `max_waiting` messages or too many bytes wait.

        Of an admitted client only whole messages count: an incomplete one may be urgent.
        """
        if self.let_in:
            ahead, limit_bytes = self.wire.pending_whole, READ_AHEAD_BYTES
        else:
            ahead, limit_bytes = self.wire.pending, MAX_INLINE_BYTES
        return self._load >= self.limits.max_waiting or ahead > limit_bytes

    def _relax(self) -> None:
        """Resume reading once messages that wait, urgent ones in service included, and
        bytes of whole messages are at most half of their limits: of bytes,
        `READ_AHEAD_BYTES`, before admission too."""
        ahead = self.wire.pending_whole
        # Half of what stops it, so that reading does not stop and go with each message.
        if self._load <= self.limits.max_waiting // 2 and ahead <= READ_AHEAD_BYTES // 2:
            self.transport.resume_reading()

    def _done(self, task: asyncio.Task[Any]) -> None:
        """Remove an ended task, report a crash, and resume reading."""
        self.tasks.discard(task)
        self._crashed(task)
        if not self.gone.is_set():
            self._relax()

    def _crashed(self, task: asyncio.Task[None]) -> None:
        """Log the failure of a task and abort the connection; nothing if it succeeded or was
        canceled. Handlers' failures are answered before that."""
        if not task.cancelled() and (error := task.exception()) is not None:
            self.log("connection failed", logging.ERROR, error_type=repr(error))
            self.transport.abort()

    def _start(self, work: Coroutine[object, object, _Result]) -> asyncio.Task[_Result]:
        """Run work as a task of the connection, and return it."""
        task = self.loop.create_task(work)
        # asyncio itself refers to tasks weakly; this keeps it until it is done.
        self.tasks.add(task)
        task.add_done_callback(self._done)
        return task
