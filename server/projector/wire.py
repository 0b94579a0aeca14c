"""Length-prefixed frames over an asyncio transport without needless copies, for both ends.

Received frames land in memory of their own, so arrays made of them stay valid; large
payloads go out slice by slice, so the transport never buffers more than a slice.

`ProjectorLink` is a client's end of one connection. Several requests may be open at once;
results that come in parts are put together. When the connection ends, every open request
fails with `LinkLost` and the link cannot be used again: `ProjectorClient` makes a new
one. A server that is silent while a request is open, also a health request, counts as
lost.
"""

from __future__ import annotations

import asyncio
import logging
import math
import socket
import ssl as tls
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Self, cast

import numpy as np
import numpy.typing as npt

from flexdt.protocol import (
    MAX_FRAME,
    Answered,
    Code,
    Correlation,
    Role,
    image,
    parse_result,
)
from flexdt.protocol import connection as frames
from flexdt.protocol import messages as m
from flexdt.protocol.connection import pack
from flexdt.protocol.projector import Array
from flexdt.protocol.rpc_errors import ProtocolError, RpcError, parse_error, too_large
from flexdt.runtime.log import current, log
from flexdt.runtime.process import tune
from flexdt.server.network.deadlines import Deadlines

SILENT_S: Final = 10.0
"""Silence after which a projector that owes an answer counts as lost [s]."""
ASK_AGAIN_S: Final = 3.0
"""Time after which its health is requested, which it answers also while it computes [s]."""
SLICE_BYTES: Final = 1 << 18
"""Largest number of bytes given to the transport at a time."""
MAX_LAST_WORD_S: Final = 1.0
"""Time for which a dismissed peer may go on sending [s]."""


@dataclass(eq=False, repr=False)
class FrameLink(asyncio.BufferedProtocol):
    """One connection.

    Attributes:
        on_frame: called with each frame's body.
        on_broken: called when the peer announces a frame that is too large, or ends the
            stream inside one; then it is over.
        on_lost: called once when the connection has ended.
        on_made: called when the connection is made.
        max_frame: largest frame received [bytes].
        send_timeout_s: a peer that takes nothing for so long is cut off; None: never.
        frame_timeout_s: a frame begun must be complete after this; None: never.
    """

    on_frame: Callable[[FrameLink, memoryview], None]
    on_broken: Callable[[FrameLink, RpcError], None]
    on_lost: Callable[[FrameLink], None]
    on_made: Callable[[FrameLink], None] = lambda link: None
    max_frame: int = MAX_FRAME
    send_timeout_s: float | None = None
    frame_timeout_s: float | None = None

    def __post_init__(self) -> None:
        """Begin at the head of a frame, unconnected; a deadline that passes aborts the
        connection.
        """
        self._head = memoryview(bytearray(4))
        self._body: memoryview | None = None
        self._filled = 0
        self._over = False
        self._writable = asyncio.Event()
        self._writable.set()
        self._sending = asyncio.Lock()
        self.deadlines = Deadlines(lambda what, seconds: self.transport.abort())
        self.lost = False
        self.peer = "?"
        self.heard = 0.0
        """Time of the last received bytes, by the loop's clock [s]."""

    # -- the transport's calls ---------------------------------------------------------------

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Tune the socket, note the peer's address (TCP only; else it stays "?"), and call
        `on_made`.
        """
        self.transport = cast(asyncio.Transport, transport)
        self.transport.set_write_buffer_limits(high=SLICE_BYTES // 2)
        sock = self.transport.get_extra_info("socket")
        tune(sock)
        if sock.family in (socket.AF_INET, socket.AF_INET6):
            host, port = self.transport.get_extra_info("peername")[:2]
            self.peer = f"{host}:{port}"
        self.on_made(self)

    def get_buffer(self, sizehint: int) -> memoryview:
        """Return the memory for the next bytes: of the length, or of the frame's body.

        At the end it is memory to be ignored.
        """
        if self._over:
            return memoryview(bytearray(SLICE_BYTES))
        if self._body is None:
            target = self._head
        else:
            target = self._body
        return target[self._filled :]

    def buffer_updated(self, count: int) -> None:
        """Count received bytes, restart the frame's deadline, and pass a complete frame
        to `on_frame`.

        The first four bytes are the length; bytes after the end of the stream are
        ignored.

        Args:
            count: number of bytes written into the buffer of `get_buffer`.
        """
        if self._over:
            return
        self._filled += count
        self.heard = asyncio.get_running_loop().time()
        self.deadlines.start("frame", self.frame_timeout_s)
        if self._body is None:
            if self._filled == 4:
                self._begin(struct.unpack(">I", self._head)[0])
        elif self._filled == len(self._body):
            body = self._body
            self._body = None
            self._filled = 0
            self.deadlines.stop("frame")
            self.on_frame(self, body)

    def _begin(self, size: int) -> None:
        """Reserve memory for a frame whose length has come; pass an empty frame to
        `on_frame`, and the error of one above `max_frame` to `on_broken`.

        After one that is too large, nothing more is read.

        Args:
            size: of the frame, from its head [bytes].
        """
        self._filled = 0
        if size > self.max_frame:
            self._over = True
            self.on_broken(self, too_large("a frame", size, self.max_frame))
        elif size == 0:
            self.deadlines.stop("frame")
            self.on_frame(self, memoryview(b""))
        else:
            # np.empty instead of bytearray: no zeros are written first.
            self._body = np.empty(size, np.uint8).data

    def eof_received(self) -> bool:
        """Let the transport close when the peer has closed its side; inside a frame call
        `on_broken` first.

        Returns False: the transport closes."""
        if self.mid_frame and not self._over:
            self._over = True
            self.on_broken(self, parse_error("the stream ended inside a frame"))
        return False

    def connection_lost(self, exc: Exception | None) -> None:
        """Note the end of the connection, wake whoever waits, call `on_lost`."""
        self.lost = True
        self.deadlines.clear()
        self._writable.set()
        self.on_lost(self)

    def pause_writing(self) -> None:
        """Pause sending, as the peer reads too slowly; after `send_timeout_s` the connection
        is aborted."""
        self._writable.clear()
        self.deadlines.start("send", self.send_timeout_s)

    def resume_writing(self) -> None:
        """Resume sending: the peer reads again."""
        self.deadlines.stop("send")
        self._writable.set()

    @property
    def mid_frame(self) -> bool:
        """Whether a frame has begun and not ended."""
        return self._body is not None or self._filled > 0

    # -- for the owner -----------------------------------------------------------------------

    async def send(self, message: m.Message) -> None:
        """Send a message; return when the transport has taken it.

        Messages are sent one at a time; large payloads are not copied.
        Raises ConnectionResetError: the connection has ended; RpcError, ValueError, TypeError:
        the message cannot be encoded.
        """
        head, payload = pack(message)
        async with self._sending:
            self._write(head)
            if payload is not None:
                await self._send_payload(payload)
            await self._writable.wait()

    def dismiss(self, message: m.Message) -> None:
        """Send a last message and end the connection; bytes that still arrive are
        dropped.

        It is closed `MAX_LAST_WORD_S` later at most, as closing with bytes unread would
        reset it and lose the message; with TLS at once.
        """
        self._over = True
        if self.lost or self.transport.is_closing():
            return
        head, _ = pack(message)
        self._write(head)
        if self.transport.can_write_eof():
            self.transport.write_eof()
            self.deadlines.start("end", MAX_LAST_WORD_S)
        else:
            self.transport.close()

    async def _send_payload(self, payload: memoryview) -> None:
        """Send a payload in slices of `SLICE_BYTES`, each once the transport takes it.

        If it is canceled, the connection is aborted, as half a frame has gone out.
        """
        try:
            for start in range(0, len(payload), SLICE_BYTES):
                await self._writable.wait()
                self._write(payload[start : start + SLICE_BYTES])
        except asyncio.CancelledError:
            self.transport.abort()  # half a frame has gone out: the stream cannot go on
            raise

    def _write(self, data: bytes | memoryview) -> None:
        """Write to the transport; raise ConnectionResetError if the connection has ended."""
        if self.lost or self.transport.is_closing():
            raise ConnectionResetError(f"the connection to {self.peer} has ended")
        self.transport.write(data)


class LinkLost(ConnectionError):
    """The connection ended while a request was open."""


@dataclass
class _Pending:
    """A request that waits for its answer, and the array that its parts go into."""

    answer: asyncio.Future[Answered[_Pending]]
    shape: tuple[int, ...] | None
    dtype: npt.DTypeLike = np.float32
    parts: npt.NDArray[Any] | None = None

    def part(self, params: Mapping[str, object]) -> None:
        """Copy a part (from index `start`) into the result's flat array, which
        the first part makes.

        The part is ignored if no array was requested or `start` is no whole number.
        """
        start = params.get("start")
        data = params.get("data")
        if self.shape is None or not isinstance(start, int):
            return
        if self.parts is None:
            self.parts = np.empty(math.prod(self.shape), self.dtype)
        values = np.frombuffer(image.payload(data), self.dtype)
        self.parts[start : start + len(values)] = values


class ProjectorLink:
    """An open connection; made by `connect`."""

    def __init__(self) -> None:
        """Make an unconnected link without open calls."""
        self._calls: Correlation[_Pending] = Correlation(Role.CLIENT)
        self._notes: set[asyncio.Future[Any]] = set()
        self._closed = False
        self.link = FrameLink(
            self._frame, self._broken, self._lost, send_timeout_s=SILENT_S
        )

    @classmethod
    async def connect(
        cls, host: str, port: int, ssl: tls.SSLContext | None = None
    ) -> Self:
        """Connect to a server; nothing is sent yet.

        `host` and `port`: its address. `ssl`: TLS context of a client; None for a plain
        connection. Raises OSError: no server answers."""
        link = cls()
        loop = asyncio.get_running_loop()
        await loop.create_connection(lambda: link.link, host, port, ssl=ssl)
        return link

    @property
    def lost(self) -> bool:
        """Whether it ended."""
        return self.link.lost

    def close(self) -> None:
        """Abort the connection at once; open requests fail with `LinkLost`."""
        self._closed = True
        self.link.transport.abort()
        self._lost(self.link)

    async def ask(self, method: str, params: Mapping[str, object]) -> object:
        """Send a request and wait for its result.

        Raises:
            RpcError: the answer is an error.
            LinkLost: the connection has ended.
        """
        return (await self._request(method, params, None))[0]

    async def ask_array(
        self,
        method: str,
        params: Mapping[str, object],
        shape: tuple[int, ...],
        dtype: npt.DTypeLike = np.float32,
        *,
        most: bool = False,
    ) -> npt.NDArray[Any]:
        """Request an array, which comes in one piece or in parts.

        Args:
            method: its name on the wire.
            params: its parameters.
            shape: of the array.
            dtype: of its values.
            most: whether it is flat, and `shape` is the largest that it may have.

        Returns the array, read-only.
        Raises RpcError: the answer is an error; -32603, it is no such array; LinkLost: the
        connection has ended.
        """
        answer, parts = await self._request(method, params, shape, dtype)
        if isinstance(answer, Mapping) and answer.get("data") is not None:
            array = np.asarray(image.decode(answer))
            fits = array.ndim == 1 and array.size <= math.prod(shape)
            if (fits if most else array.shape == shape) and array.dtype == dtype:
                return array
        elif parts is not None:
            told = tuple(parse_result(Array, answer).shape)
            fits = len(told) == 1 and math.prod(told) <= parts.size
            if fits if most else told == shape:
                parts.setflags(write=False)
                return np.asarray(parts[: math.prod(told)].reshape(told))
        raise RpcError(
            Code.INTERNAL, f"the projector's answer to {method} is no {shape} array"
        )

    async def _request(
        self,
        method: str,
        params: Mapping[str, object],
        shape: tuple[int, ...] | None,
        dtype: npt.DTypeLike = np.float32,
    ) -> tuple[object, npt.NDArray[Any] | None]:
        """Send a request and wait for its answer and parts; cancel it if this is canceled.

        Only a request that may have been sent can still be answered; such answers are
        ignored.

        Args:
            method: its name on the wire.
            params: its parameters.
            shape: of the array that comes in parts; None for none.
            dtype: of its values.

        Returns:
            The result, and the array of its parts, or None.

        Raises:
            LinkLost: the connection ended.
            RpcError: the answer is an error.
        """
        pending = _Pending(asyncio.get_running_loop().create_future(), shape, dtype)
        request = self._calls.request(method, params, pending, current()[:100])
        sent = False
        try:
            await self.link.send(request)
            sent = True
            await self._until_answered(pending.answer)
            return (await pending.answer).result(), pending.parts
        except ConnectionResetError:
            raise LinkLost("the connection ended") from None
        except asyncio.CancelledError:
            sent = True  # perhaps, so the answer may come
            if not self.lost:
                cancel = m.Notification("cancel", {"request": request.id})
                self._keep(asyncio.ensure_future(self.link.send(cancel)))
            raise
        finally:
            self._calls.abandon(request, sent=sent)

    async def _until_answered(self, answer: asyncio.Future[Any]) -> None:
        """Wait until `answer` is done, and close the connection if nothing at all comes
        for `SILENT_S`.

        Every `ASK_AGAIN_S` the projector's health is requested, one request at a time, so
        a busy projector is not silent. Closing fails the answer.
        """
        loop = asyncio.get_running_loop()
        asked_at = loop.time()
        while not (await asyncio.wait([answer], timeout=ASK_AGAIN_S))[0]:
            if loop.time() - max(asked_at, self.link.heard) > SILENT_S:
                self.close()
            if not self._notes:
                self._keep(asyncio.ensure_future(self.ask("health", {})))

    def _keep(self, note: asyncio.Future[Any]) -> None:
        """Keep a reference to a future until it is done."""
        self._notes.add(note)
        note.add_done_callback(self._noted)

    def _noted(self, note: asyncio.Future[Any]) -> None:
        """Drop a future that is done, and retrieve its exception."""
        self._notes.discard(note)
        if not note.cancelled():
            note.exception()  # a connection that has ended needs no cancellation

    def _frame(self, link: FrameLink, body: memoryview) -> None:
        """Pass the answers and parts of a frame to their requests; close the connection
        on a violation of the protocol.

        Answers to abandoned requests and parts of unknown ones are ignored.
        """
        try:
            received = self._calls.receive(frames.unpack(body))
        except ProtocolError:
            self.close()
            return
        for item in received:
            match item:
                case Answered(pending) if not pending.answer.done():
                    pending.answer.set_result(item)
                case m.Notification("part", params) if isinstance(params, Mapping):
                    if (waiter := self._calls.waiter(params.get("request"))) is not None:
                        waiter.part(params)

    def _broken(self, link: FrameLink, error: RpcError) -> None:
        """Abort a connection that breaks the protocol."""
        link.transport.abort()

    def _lost(self, link: FrameLink) -> None:
        """Fail all open requests with `LinkLost`; a violation of the protocol is logged
        and named in the error.

        An end inside a frame is a violation too, unless the link was closed here; it is
        logged as a warning, others as errors.
        """
        if link.mid_frame and not self._closed:
            self._calls.violate(ProtocolError("the stream ended inside a frame"))
        why = "the connection ended"
        if self._calls.violation is not None:
            why = f"the projector broke the protocol: {self._calls.violation}"
            # The stream of a projector that was killed while it sent ends inside a frame, too.
            log(why, logging.WARNING if link.mid_frame else logging.ERROR)
        for pending in self._calls.waiting():
            if not pending.answer.done():
                pending.answer.set_exception(LinkLost(why))
