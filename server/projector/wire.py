"""Length-prefixed frames over an asyncio transport without needless copies, for both ends.

Received frames land in memory of their own, so arrays made of them stay valid; large payloads go
out slice by slice, so the transport never buffers more than a slice.
"""

from __future__ import annotations

import asyncio
import socket
import struct
from collections.abc import Callable
from typing import Final, cast

import numpy as np

from flexdt.protocol import MAX_FRAME, Message, RpcError
from flexdt.protocol.msgpack_frames import pack
from flexdt.protocol.rpc_errors import too_large
from flexdt.server.network.shell_parts import Deadlines
from flexdt.server.runtime.socket_options import tune

SLICE: Final = 1 << 18
"""Bytes handed to the transport at a time."""
LAST_WORD_S: Final = 1.0
"""How long a dismissed peer may go on sending."""


class FrameLink(asyncio.BufferedProtocol):
    """One connection.

    Args:
        on_frame: called with each frame's body.
        on_broken: called when the peer announces a frame that is too large; then it is over.
        on_lost: called once when the connection has ended.
        on_made: called when the connection stands.
        max_frame: largest frame received [bytes].
        send_timeout_s: a peer that takes nothing for so long is cut off; None: never.
        frame_timeout_s: a frame begun must be complete after this; None: never.
    """

    def __init__(
        self,
        on_frame: Callable[[FrameLink, memoryview], None],
        on_broken: Callable[[FrameLink, RpcError], None],
        on_lost: Callable[[FrameLink], None],
        on_made: Callable[[FrameLink], None] = lambda link: None,
        max_frame: int = MAX_FRAME,
        send_timeout_s: float | None = None,
        frame_timeout_s: float | None = None,
    ) -> None:
        self._on_frame, self._on_broken = on_frame, on_broken
        self._on_lost, self._on_made = on_lost, on_made
        self._max_frame = max_frame
        self._head = memoryview(bytearray(4))
        self._body: memoryview | None = None
        self._filled = 0
        self._over = False
        self._writable = asyncio.Event()
        self._writable.set()
        self._sending = asyncio.Lock()
        self._send_timeout_s, self._frame_timeout_s = send_timeout_s, frame_timeout_s
        self.deadlines = Deadlines(lambda what, seconds: self.transport.abort())
        self.lost = False
        self.peer = "?"

    # -- the transport's calls ---------------------------------------------------------------

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Tune the socket."""
        self.transport = cast(asyncio.Transport, transport)
        self.transport.set_write_buffer_limits(high=SLICE // 2)
        sock = self.transport.get_extra_info("socket")
        tune(sock)
        if sock.family in (socket.AF_INET, socket.AF_INET6):
            host, port = self.transport.get_extra_info("peername")[:2]
            self.peer = f"{host}:{port}"
        self._on_made(self)

    def get_buffer(self, sizehint: int) -> memoryview:
        """Where the next bytes go: the length, or the frame's own memory."""
        if self._over:
            return memoryview(bytearray(SLICE))
        target = self._head if self._body is None else self._body
        return target[self._filled :]

    def buffer_updated(self, count: int) -> None:
        """Bytes have arrived."""
        if self._over:
            return
        self._filled += count
        self.deadlines.start("frame", self._frame_timeout_s)
        if self._body is None:
            if self._filled == 4:
                self._begin(struct.unpack(">I", self._head)[0])
        elif self._filled == len(self._body):
            body, self._body, self._filled = self._body, None, 0
            self.deadlines.stop("frame")
            self._on_frame(self, body)

    def _begin(self, size: int) -> None:
        self._filled = 0
        if size > self._max_frame:
            self._over = True
            self._on_broken(self, too_large("a frame", size, self._max_frame))
        elif size == 0:
            self.deadlines.stop("frame")
            self._on_frame(self, memoryview(b""))
        else:
            # np.empty instead of bytearray: no zeros are written first.
            self._body = np.empty(size, np.uint8).data

    def eof_received(self) -> bool:
        """Close the connection when the peer has closed its side."""
        return False

    def connection_lost(self, exc: Exception | None) -> None:
        """The connection has ended."""
        self.lost = True
        self.deadlines.clear()
        self._writable.set()
        self._on_lost(self)

    def pause_writing(self) -> None:
        """The peer reads too slowly."""
        self._writable.clear()
        self.deadlines.start("send", self._send_timeout_s)

    def resume_writing(self) -> None:
        """The peer reads again."""
        self.deadlines.stop("send")
        self._writable.set()

    @property
    def mid_frame(self) -> bool:
        """Whether a frame has begun and not ended."""
        return self._body is not None or self._filled > 0

    # -- for the owner -----------------------------------------------------------------------

    async def send(self, message: Message) -> None:
        """Send a message; returns when the transport has taken it.

        Raises:
            ConnectionResetError: the connection has ended.
            RpcError, ValueError, TypeError: the message cannot be encoded.
        """
        head, payload = pack(message)
        async with self._sending:
            self._write(head)
            if payload is not None:
                await self._send_payload(payload)
            await self._writable.wait()

    def dismiss(self, message: Message) -> None:
        """Send a last message and end the connection; what still comes in is thrown away.

        Closing at once with bytes unread would reset the connection and lose the message.
        """
        self._over = True
        if self.lost or self.transport.is_closing():
            return
        head, _ = pack(message)
        self._write(head)
        if self.transport.can_write_eof():
            self.transport.write_eof()
            self.deadlines.start("end", LAST_WORD_S)
        else:
            self.transport.close()

    async def _send_payload(self, payload: memoryview) -> None:
        try:
            for start in range(0, len(payload), SLICE):
                await self._writable.wait()
                self._write(payload[start : start + SLICE])
        except asyncio.CancelledError:
            self.transport.abort()  # half a frame has gone out: the stream cannot go on
            raise

    def _write(self, data: bytes | memoryview) -> None:
        if self.lost or self.transport.is_closing():
            raise ConnectionResetError(f"the connection to {self.peer} has ended")
        self.transport.write(data)
