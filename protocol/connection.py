"""One connection without a socket: bytes in, messages out; messages in, bytes out.

The first byte decides for the connection's whole life: 0x00 (the high byte of a length below
16 MiB) means length-prefixed MessagePack, anything else JSON lines. What is too long or broken
comes out as `Malformed`; a JSON connection recovers at the next newline, a MessagePack connection
at the end of the frame. The caller owns the network; no method here blocks or raises on input.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Collection, Mapping
from typing import Final

from flexdt.protocol.codec import Codec, read_json, read_msgpack, write_json, write_msgpack
from flexdt.protocol.errors import Code, RpcError, parse_error, too_large
from flexdt.protocol.messages import (
    Batch,
    Encoded,
    Malformed,
    Message,
    Response,
    from_plain,
    to_plain,
)

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
        """Bytes of the first message in which no end has been found."""
        self._edge = 0
        """End of the last whole message in the buffer."""
        self._judged = 0
        """Up to where `overtake` has looked."""
        self.waiting = 0
        """Whole messages in the buffer; an empty line counts."""
        self._skip_line = False
        self._skip_bytes = 0

    @property
    def pending(self) -> int:
        """Bytes held of messages that have not been taken."""
        return len(self._buffer)

    @property
    def whole(self) -> bool:
        """Whether `next_raw` has something to give."""
        return self._edge > 0 or len(self._buffer) > self.max_message

    @property
    def mid_message(self) -> bool:
        """Whether a message has begun and not ended."""
        return len(self._buffer) > self._edge or self._skip_line or self._skip_bytes > 0

    def receive_data(self, data: bytes | bytearray | memoryview) -> list[Message]:
        """Take bytes from the peer; return the messages they complete, in order."""
        self.feed(data)
        out: list[Message] = []
        while (raw := self.next_raw()) is not None:
            out.append(raw if isinstance(raw, Malformed) else self.decode(raw))
        return out

    def feed(self, data: bytes | bytearray | memoryview) -> None:
        """Take bytes from the peer and decode nothing yet: see `next_raw`."""
        if self.closed or not data:
            return
        if self.codec is None:
            self.codec = Codec.MSGPACK if data[0] == 0 else Codec.JSON
        self._buffer += data
        self._drop_skipped()
        if self.codec is Codec.JSON:
            new = max(self._edge, len(self._buffer) - len(data))
            self.waiting += self._buffer.count(b"\n", new)
            end = self._buffer.rfind(b"\n", new)
            self._edge = end + 1 if end >= 0 else self._edge
        else:
            self._edge = self._walk(self._edge if self._edge > 1 else 0)  # 1: see `_walk`

    def next_raw(self) -> bytes | Malformed | None:
        """The next message's bytes for `decode`, or what is wrong with it unread; None: no more."""
        if self.closed:
            return None
        return self._next_frame() if self.codec is Codec.MSGPACK else self._next_line()

    def decode(self, raw: bytes) -> Message:
        """The message that `next_raw` gave."""
        read = read_msgpack if self.codec is Codec.MSGPACK else read_json
        try:
            document = read(raw)
        except (ValueError, RecursionError, MemoryError) as error:
            return Malformed(parse_error(str(error) or type(error).__name__))
        return from_plain(document, self.max_batch)

    @property
    def unjudged(self) -> bool:
        """Whether `overtake` has not yet looked at everything."""
        return self._judged < self._edge and not self.closed

    def overtake(
        self, names: Collection[bytes], wanted: Callable[[bytes], bool], most: int = 32
    ) -> list[bytes]:
        """Take messages that hold one of `names` and are `wanted` out of their turn.

        Args:
            names: looked for in the bytes of whole messages, each of which is looked at once.
            wanted: judges a message's bytes.
            most: messages judged in one call; `unjudged` says whether there are more.
        """
        start, out = self._judged, list[bytes]()
        if not self.unjudged or _HTTP.match(self._buffer):  # nothing of a browser's is read
            return out
        region = bytes(memoryview(self._buffer)[start : self._edge])
        kept: list[bytes] = []
        at = judged = 0
        if not any(name in region for name in names):
            self._judged = self._edge
            return out
        head, tail = (4, 0) if self.codec is Codec.MSGPACK else (0, 1)
        while at < len(region) and judged < most:
            end = self._end_of(region, at)
            piece = region[at:end]
            at = end
            if any(name in piece for name in names):
                judged += 1
                body = piece[head : len(piece) - tail]
                if len(body) <= self.max_message and wanted(body):
                    out.append(body)
                    continue
            kept.append(piece)
        self._judged = start + at
        self.waiting -= len(out)
        if out:
            rest = b"".join(kept)
            self._buffer[start : start + at] = rest
            self._edge -= at - len(rest)
            self._judged -= at - len(rest)
            self._scanned = 0
        return out

    def _end_of(self, data: bytes, at: int) -> int:
        """Where the whole message at `at` ends."""
        if self.codec is Codec.JSON:
            return data.index(b"\n", at) + 1
        (size,) = struct.unpack_from(">I", data, at)
        return min(at + 4 + int(size), len(data))

    def _drop_skipped(self) -> None:
        """Throw away what belongs to a message that was refused."""
        if self._skip_line:
            end = self._buffer.find(b"\n")
            self._skip_line = end < 0
            self._taken(len(self._buffer) if end < 0 else end + 1)
        elif self._skip_bytes:
            step = min(self._skip_bytes, len(self._buffer))
            self._skip_bytes -= step
            self._taken(step)

    def _taken(self, count: int) -> None:
        """The first `count` bytes are done with."""
        del self._buffer[:count]
        self._edge = max(0, self._edge - count)
        self._judged = max(0, self._judged - count)
        self._scanned = 0

    def _end(self) -> None:
        """The connection cannot go on."""
        self.closed = True
        self._taken(len(self._buffer))
        self.waiting = 0

    def _walk(self, at: int) -> int:
        """End of the last whole frame, from the one at `at` on; one too long ends nothing."""
        buffer, size = self._buffer, len(self._buffer)
        while size - at >= 4:
            (length,) = struct.unpack_from(">I", buffer, at)
            if length > self.max_message:
                return max(at, 1)  # `next_raw` must have a look at it
            if size - at - 4 < length:
                break
            at += 4 + length
            self.waiting += 1
        return at

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

    def _next_line(self) -> bytes | Malformed | None:
        buffer = self._buffer
        while True:
            end = buffer.find(b"\n", self._scanned)
            if end < 0:
                self._scanned = size = len(buffer)
                if size <= self.max_message:
                    return None
                self._skip_line = True
                self._taken(size)
                return self._oversize("a line", f"at least {size}")
            self.waiting -= 1
            if end > self.max_message:
                self._taken(end + 1)
                return self._oversize("a line", end)
            line = bytes(memoryview(buffer)[:end])
            self._taken(end + 1)
            if not line.strip(b" \t\r"):
                continue
            if _HTTP.match(line):
                # A browser can be made to post lines to a loopback port; its first line gives it
                # away.
                self._end()
                error = RpcError(Code.INVALID_REQUEST, "this is a JSON-RPC server, not an HTTP one")
                return Malformed(error, fatal=True)
            return line

    def _next_frame(self) -> bytes | Malformed | None:
        buffer = self._buffer
        if len(buffer) < 4:
            return None
        (size,) = struct.unpack_from(">I", buffer)
        if size > MAX_FRAME:
            self._end()
            return Malformed(too_large("a frame", size, MAX_FRAME), fatal=True)
        if size > self.max_message:
            self._skip_bytes = size
            self._taken(4)
            self._drop_skipped()
            self._edge = self._walk(0)
            return self._oversize("a frame", size)
        if len(buffer) - 4 < size:
            return None
        body = bytes(memoryview(buffer)[4 : 4 + size])
        self._taken(4 + size)
        self.waiting -= 1
        if not self._edge:
            self._edge = self._walk(0)
        return body

    def _oversize(self, what: str, size: int | str) -> Malformed:
        return Malformed(too_large(what, size, self.max_message))


def _json_line(message: Message) -> bytes:
    return _json(message) + b"\n"


def _json(message: Message) -> bytes:
    match message:
        case Response(id, Encoded(data)):
            return b'{"jsonrpc":"2.0","id":%b,"result":%b}' % (write_json(id), data)
        case Batch(items) if _encoded(items):
            return b"[%b]" % b",".join(map(_json, items))
    return write_json(to_plain(message))


def _encoded(items: tuple[Message, ...]) -> bool:
    return any(isinstance(i, Response) and isinstance(i.result, Encoded) for i in items)


def frame(payload: bytes) -> bytes:
    """A MessagePack object with its length in front.

    Raises:
        RpcError: -32008, 16 MiB or more.
    """
    if len(payload) > MAX_FRAME:
        raise too_large("a MessagePack frame", len(payload), MAX_FRAME)
    return struct.pack(">I", len(payload)) + payload


def _msgpack_frame(message: Message) -> bytes:
    return frame(_msgpack(message))


def _msgpack(message: Message) -> bytes:
    match message:
        case Response(id, Encoded(data)):
            head = {"jsonrpc": "2.0", "id": id, "result": None}
            return write_msgpack(head)[:-1] + data  # nil is one byte
        case Batch(items) if _encoded(items):
            count = len(items)
            start = bytes([0x90 | count]) if count < 16 else struct.pack(">BH", 0xDC, count)
            return start + b"".join(map(_msgpack, items))
    return write_msgpack(to_plain(message))


_FRAMERS: Final[Mapping[Codec, Callable[[Message], bytes]]] = {
    Codec.JSON: _json_line,
    Codec.MSGPACK: _msgpack_frame,
}
