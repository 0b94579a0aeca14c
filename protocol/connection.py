"""One connection without a socket: bytes in, messages out; messages in, bytes out.

The first byte decides for the connection's whole life: 0x00 (the high byte of a length below
16 MiB) means length-prefixed MessagePack, anything else JSON lines. What is too long or broken
comes out as `Malformed`; a JSON connection recovers at the next newline, a MessagePack connection
at the end of the frame. The caller owns the network; no method here blocks or raises on input.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Mapping
from typing import Final

from flexdt.protocol.codec import Codec, read_json, read_msgpack, write_json, write_msgpack
from flexdt.protocol.errors import Code, RpcError, parse_error, too_large
from flexdt.protocol.messages import Malformed, Message, from_plain, to_plain

MAX_FRAME: Final = 2**24 - 1
"""Largest MessagePack frame [bytes]: its length's first byte must be zero."""

_HTTP: Final = re.compile(
    rb"(?:GET|HEAD|POST|PUT|DELETE|CONNECT|OPTIONS|TRACE|PATCH|PRI) \S{0,8192} HTTP/"
)


class Prepared:
    """A message encoded at most once per codec: for events that go to many connections."""

    def __init__(self, message: Message) -> None:
        self.message = message
        self._bytes: dict[Codec, bytes] = {}

    def encoded(self, codec: Codec) -> bytes:
        """The message's bytes, framing included."""
        if codec not in self._bytes:
            self._bytes[codec] = _FRAMERS[codec](self.message)
        return self._bytes[codec]


class Connection:
    """Protocol state of one connection, the same for both ends.

    Args:
        codec: what to speak; None (a server) takes it from the first byte received.
        max_message: largest line or frame accepted [bytes].
        max_batch: most messages in one batch.
    """

    def __init__(
        self,
        codec: Codec | None = None,
        *,
        max_message: int = MAX_FRAME,
        max_batch: int = 1000,
    ) -> None:
        self.codec = codec
        self.max_message = max_message
        self.max_batch = max_batch
        self.closed = False
        self._buffer = bytearray()
        self._scanned = 0
        self._skip_line = False
        self._skip_bytes = 0

    @property
    def pending(self) -> int:
        """Bytes held of a message that is not complete."""
        return len(self._buffer)

    @property
    def mid_message(self) -> bool:
        """Whether a message has begun and not ended."""
        return bool(self._buffer) or self._skip_line or self._skip_bytes > 0

    def receive_data(self, data: bytes | bytearray | memoryview) -> list[Message]:
        """Take bytes from the peer; return the messages they complete, in order."""
        if self.closed or not data:
            return []
        if self.codec is None:
            self.codec = Codec.MSGPACK if data[0] == 0 else Codec.JSON
        self._buffer += data
        return self._frames() if self.codec is Codec.MSGPACK else self._lines()

    def send(self, message: Message | Prepared) -> bytes:
        """The bytes of a message, framing included; JSON until the peer has said otherwise.

        Raises:
            ValueError, TypeError: the message holds something that cannot travel.
            RpcError: -32008, a MessagePack frame of 16 MiB or more.
        """
        codec = self.codec or Codec.JSON
        if isinstance(message, Prepared):
            return message.encoded(codec)
        return _FRAMERS[codec](message)

    def _lines(self) -> list[Message]:
        out: list[Message] = []
        start = 0
        buffer = self._buffer
        while not self.closed:
            end = buffer.find(b"\n", max(start, self._scanned))
            if end < 0:
                break
            line = memoryview(buffer)[start:end]
            if self._skip_line:
                self._skip_line = False
            elif len(line) > self.max_message:
                out.append(self._oversize("a line", len(line)))
            else:
                out.extend(self._line(bytes(line)))
            line.release()
            start = end + 1
        del buffer[:start]
        if self._skip_line or self.closed:
            buffer.clear()
        elif len(buffer) > self.max_message:
            out.append(self._oversize("a line", f"at least {len(buffer)}"))
            buffer.clear()
            self._skip_line = True
        self._scanned = len(buffer)
        return out

    def _line(self, line: bytes) -> list[Message]:
        if not line.strip(b" \t\r"):
            return []
        if _HTTP.match(line):
            # A browser can be made to post lines to a loopback port; its first line gives it away.
            self.closed = True
            error = RpcError(Code.INVALID_REQUEST, "this is a JSON-RPC server, not an HTTP one")
            return [Malformed(error, fatal=True)]
        return [self._decode(read_json, line)]

    def _frames(self) -> list[Message]:
        out: list[Message] = []
        start = 0
        buffer = self._buffer
        while not self.closed:
            if self._skip_bytes:
                step = min(self._skip_bytes, len(buffer) - start)
                start += step
                self._skip_bytes -= step
            if self._skip_bytes or len(buffer) - start < 4:
                break
            (size,) = struct.unpack_from(">I", buffer, start)
            if size > MAX_FRAME:
                self.closed = True
                out.append(Malformed(too_large("a frame", size, MAX_FRAME), fatal=True))
                break
            if size > self.max_message:
                out.append(self._oversize("a frame", size))
                start += 4
                self._skip_bytes = size
                continue
            if len(buffer) - start - 4 < size:
                break
            out.append(self._decode(read_msgpack, bytes(memoryview(buffer)[start + 4 :][:size])))
            start += 4 + size
        del buffer[:start]
        if self.closed:
            buffer.clear()
        return out

    def _decode(self, read: Callable[[bytes], object], data: bytes) -> Message:
        try:
            document = read(data)
        except (ValueError, RecursionError, MemoryError) as error:
            return Malformed(parse_error(str(error) or type(error).__name__))
        return from_plain(document, self.max_batch)

    def _oversize(self, what: str, size: int | str) -> Malformed:
        return Malformed(too_large(what, size, self.max_message))


def _json_line(message: Message) -> bytes:
    return write_json(to_plain(message)) + b"\n"


def frame(payload: bytes) -> bytes:
    """A MessagePack object with its length in front.

    Raises:
        RpcError: -32008, 16 MiB or more.
    """
    if len(payload) > MAX_FRAME:
        raise too_large("a MessagePack frame", len(payload), MAX_FRAME)
    return struct.pack(">I", len(payload)) + payload


def _msgpack_frame(message: Message) -> bytes:
    return frame(write_msgpack(to_plain(message)))


_FRAMERS: Final[Mapping[Codec, Callable[[Message], bytes]]] = {
    Codec.JSON: _json_line,
    Codec.MSGPACK: _msgpack_frame,
}
