"""One connection without a socket: bytes in, messages out; messages in, bytes out.

The first byte decides for the connection's whole life: 0x00 (the high byte of a length below
16 MiB) means length-prefixed MessagePack, anything else JSON lines. A message that is too long or
broken comes out as `Malformed`; a JSON connection recovers at the next newline, a MessagePack
connection at the end of the frame. The caller owns the network. No received bytes make a method
block or raise; only the end of the stream may be an error (`receive_end`).

Received bytes are kept in this order:

    _buffer:  | whole messages ... | the beginning of one |     _edge is the end of the whole ones
    _large:   a message of which more than 64 KiB have come without its end, as a list of pieces
    _after:   what has come after that one, still undivided

A growing `bytearray` is copied again and again, which is why a large message is kept in pieces.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import chain
from typing import Final

from flexdt.protocol import codec as codecs
from flexdt.protocol.codec import Codec
from flexdt.protocol.messages import Encoded, Malformed, Message, Response, from_plain, to_plain
from flexdt.protocol.rpc_errors import Code, ProtocolError, RpcError, parse_error, too_large

MAX_FRAME: Final = 2**24 - 1
"""Largest MessagePack frame [bytes]: its length's first byte must be zero."""

MAX_ANSWER: Final[Mapping[Codec, int]] = {Codec.JSON: 64 << 20, Codec.MSGPACK: MAX_FRAME}
"""Largest answer [bytes] of a method that can tell its size before it makes the answer."""

_HTTP: Final = re.compile(
    rb"(?:GET|HEAD|POST|PUT|DELETE|CONNECT|OPTIONS|TRACE|PATCH|PRI) \S{0,8192} HTTP/"
)


class Prepared:
    """A message that is encoded at most once per codec, for events to many connections."""

    def __init__(self, message: Message) -> None:
        self.message = message
        self._pieces: dict[Codec, list[bytes]] = {}

    def encoded(self, codec: Codec) -> list[bytes]:
        """The message's bytes, framing included, in pieces."""
        if codec not in self._pieces:
            pieces = _FRAMERS[codec](_BODIES[codec](self.message))
            small = sum(map(len, pieces)) <= A_PIECE
            self._pieces[codec] = [b"".join(pieces)] if small else pieces
        return self._pieces[codec]


Raw = bytes | tuple[bytes, ...]
"""A message's bytes; a large message is a tuple of the pieces in which it was received."""
A_PIECE: Final = 1 << 16
"""An incomplete message of more than this size [bytes] is kept in pieces."""


class _Large:
    """A large message that is being received.

    Attributes:
        left: bytes still missing [MessagePack]; None: up to the next newline [JSON].
        ended: whether its end has come.
        refused: whether it is too long; its pieces are discarded.
        reported: whether `next_raw` has returned the error for that.
    """

    def __init__(self, pieces: list[bytes], left: int | None) -> None:
        self.pieces, self.left = pieces, left
        self.size = sum(map(len, pieces))
        self.ended = self.refused = self.reported = False

    def add(self, data: bytes, most: int) -> bytes:
        """Take the bytes that belong to this message; returns the rest."""
        if self.left is None:
            end = data.find(b"\n")
            self.ended = end >= 0
            mine, rest = (data, b"") if end < 0 else (data[:end], data[end + 1 :])
        else:
            mine, rest = data[: self.left], data[self.left :]
            self.left -= len(mine)
            self.ended = not self.left
        self.pieces.append(mine)
        self.size += len(mine)
        self.refused = self.refused or self.size > most
        if self.refused:
            self.pieces.clear()
        return rest

    @property
    def due(self) -> bool:
        """Whether `next_raw` must return it, or the error that it is too long."""
        return self.ended or (self.refused and not self.reported)


class Connection:
    """Protocol state of one connection, the same for both ends.

    Args:
        codec: of this connection; None (a server) takes it from the first byte received.
        max_message: largest line or frame accepted [bytes].
        max_batch: most messages in one batch.
    """

    def __init__(
        self, codec: Codec | None = None, *, max_message: int = MAX_FRAME, max_batch: int = 1000
    ) -> None:
        self.codec = codec
        self.max_message = max_message
        self.max_batch = max_batch
        self.closed = False
        self._buffer = bytearray()
        self._scanned = 0
        """Bytes of the first message that have been searched for its end in vain."""
        self._edge = 0
        """End of the last whole message in the buffer."""
        self._judged = 0
        """End of the messages that `overtake` has examined."""
        self.waiting = 0
        """Whole messages in the buffer; an empty line counts."""
        self._large: _Large | None = None
        """Follows everything in the buffer."""
        self._after = bytearray()
        """Follows the large message."""

    @property
    def pending(self) -> int:
        """Bytes held of messages that have not been taken out."""
        large = 0 if self._large is None or self._large.refused else self._large.size
        return len(self._buffer) + large + len(self._after)

    @property
    def whole(self) -> bool:
        """Whether `next_raw` has something to return."""
        return self._edge > 0 or (self._large is not None and self._large.due)

    @property
    def mid_message(self) -> bool:
        """Whether a message has begun and not ended."""
        large = self._large is not None and not self._large.ended
        return len(self._buffer) > self._edge or large

    def receive_data(self, data: bytes | bytearray | memoryview) -> list[Message]:
        """Take bytes from the peer; return the messages they complete, in order."""
        self.feed(data)
        out: list[Message] = []
        while (raw := self.next_raw()) is not None:
            out.append(raw if isinstance(raw, Malformed) else self.decode(raw))
        return out

    def receive_end(self) -> None:
        """The peer has ended the stream; nothing is received after this.

        Raises:
            ProtocolError: it ended inside a message, so that message is lost.
        """
        inside, held = self.mid_message and not self.closed, self.pending
        self._end()
        if inside:
            raise ProtocolError(f"the stream ended inside a message, of which {held} bytes came")

    def feed(self, data: bytes | bytearray | memoryview) -> None:
        """Take bytes from the peer without decoding them: see `next_raw`."""
        if self.closed or not data:
            return
        if self.codec is None:
            self.codec = Codec.MSGPACK if data[0] == 0 else Codec.JSON
        if self._large is not None:
            self._feed_large(bytes(data))
            return
        new, most = len(self._buffer), A_PIECE
        self._buffer += data
        if self.codec is Codec.JSON:
            most = min(A_PIECE, self.max_message)
            self.waiting += self._buffer.count(b"\n", new)
            end = self._buffer.rfind(b"\n", new)
            self._edge = end + 1 if end >= 0 else self._edge
        else:
            self._edge = self._walk(self._edge if self._edge > 1 else 0)  # 1: see `_walk`
        if len(self._buffer) - self._edge > most:
            self._begin_large()

    def _begin_large(self) -> None:
        """Move the incomplete message at the end of the buffer into `_large`."""
        begun, left = bytes(memoryview(self._buffer)[self._edge :]), None
        if self.codec is Codec.MSGPACK:
            (size,) = struct.unpack_from(">I", begun)
            if self._edge == 1 or size > self.max_message:
                return  # refused unread: see `_next_frame`
            begun, left = begun[4:], 4 + int(size) - len(begun)
        del self._buffer[self._edge :]
        self._large = _Large([begun], left)
        if self._large.size > self.max_message:
            self._large.add(b"", self.max_message)

    def _feed_large(self, data: bytes) -> None:
        large = self._large
        assert large is not None
        if large.ended:
            self._after += data
            return
        self._after += large.add(data, self.max_message)
        self._look_at_large(large)

    def _look_at_large(self, large: _Large) -> None:
        if large.ended and large.reported:
            self._end_large()
        elif large.ended:
            self.waiting += 1

    def _end_large(self) -> None:
        """The large message has been taken out: divide what came after it."""
        self._large = None
        after, self._after = self._after, bytearray()
        self.feed(after)

    def next_raw(self) -> Raw | Malformed | None:
        """The next message's bytes for `decode`, or an error found before that; None: no more."""
        if self.closed:
            return None
        found = self._next_frame() if self.codec is Codec.MSGPACK else self._next_line()
        large = self._large
        if found is not None or large is None or not large.due:
            return found
        if not large.ended:
            large.reported = True
            return self._oversize("a line", f"at least {large.size}")
        self.waiting -= 1
        self._end_large()
        if large.refused:
            return self._oversize("a line", large.size)
        if self.codec is Codec.JSON and _HTTP.match(large.pieces[0]):
            return self._http()
        return tuple(large.pieces)

    def decode(self, raw: Raw) -> Message:
        """The message in the bytes that `next_raw` returned."""
        raw = raw if isinstance(raw, bytes) else b"".join(raw)
        read = codecs.read_msgpack if self.codec is Codec.MSGPACK else codecs.read_json
        try:
            document = read(raw)
        except (ValueError, RecursionError, MemoryError) as error:
            return Malformed(parse_error(str(error) or type(error).__name__))
        return from_plain(document, self.max_batch)

    @property
    def unjudged(self) -> bool:
        """Whether there are messages that `overtake` has not examined."""
        return self._judged < self._edge and not self.closed

    def overtake(
        self, names: Collection[bytes], wanted: Callable[[bytes], bool], most: int = 32
    ) -> list[bytes]:
        """Take urgent messages out of their turn.

        Every whole message is examined once: first its bytes are searched for `names`, which is
        fast, and only a message with a match is passed to `wanted`, which may decode it.

        Args:
            names: of the methods looked for, as bytes.
            wanted: whether the message with these bytes is to be taken out.
            most: messages passed to `wanted` in one call; `unjudged` tells whether there are more.

        Returns:
            The bytes of the messages taken out, in order.
        """
        start, out = self._judged, list[bytes]()
        if not self.unjudged or _HTTP.match(self._buffer):  # a browser's request ends it
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

    def holds(self, name: bytes) -> bool:
        """Whether a whole message that `overtake` has not judged yet contains these bytes."""
        return self.unjudged and self._buffer.find(name, self._judged, self._edge) >= 0

    def _end_of(self, data: bytes, at: int) -> int:
        """End of the whole message that begins at `at`."""
        if self.codec is Codec.JSON:
            return data.index(b"\n", at) + 1
        (size,) = struct.unpack_from(">I", data, at)
        return min(at + 4 + int(size), len(data))

    def _taken(self, count: int) -> None:
        """Remove the first `count` bytes of the buffer."""
        del self._buffer[:count]
        self._edge = max(0, self._edge - count)
        self._judged = max(0, self._judged - count)
        self._scanned = 0

    def _end(self) -> None:
        """Close the connection and discard everything received."""
        self.closed = True
        self._taken(len(self._buffer))
        self._large, self._after = None, bytearray()
        self.waiting = 0

    def _walk(self, at: int) -> int:
        """End of the last whole frame, starting at the frame at `at`.

        Stops at a frame that is too long. If that is the first one, the result is 1 instead of 0,
        so that `whole` is true and `next_raw` reports it.
        """
        buffer, size = self._buffer, len(self._buffer)
        while size - at >= 4:
            (length,) = struct.unpack_from(">I", buffer, at)
            if length > self.max_message:
                return max(at, 1)
            if size - at - 4 < length:
                break
            at += 4 + length
            self.waiting += 1
        return at

    def send(self, message: Message | Prepared) -> bytes:
        """The bytes of a message, framing included; JSON until the peer's first byte is known.

        Raises:
            ValueError, TypeError: the message holds a value that cannot be encoded.
            RpcError: -32008, a MessagePack frame of 16 MiB or more.
        """
        pieces = self.pieces(message)
        return pieces[0] if len(pieces) == 1 else b"".join(pieces)

    def pieces(self, message: Message | Prepared) -> list[bytes]:
        """As `send`, in pieces, so that large values are not copied."""
        if isinstance(message, Prepared):
            return message.encoded(self.codec or Codec.JSON)
        return self.framed(self.body(message))

    def body(self, message: Message) -> list[bytes]:
        """As `pieces`, without framing."""
        return _BODIES[self.codec or Codec.JSON](message)

    def batch(self, bodies: Sequence[Sequence[bytes]]) -> list[bytes]:
        """Several messages in one document, without framing.

        Args:
            bodies: of the messages, at most 65 535.
        """
        if self.codec is Codec.MSGPACK:
            return [_array_head(len(bodies)), *chain.from_iterable(bodies)]
        out = [b"["]
        for i, body in enumerate(bodies):
            out += [b","] * (i > 0) + list(body)
        return [*out, b"]"]

    def framed(self, body: Sequence[bytes]) -> list[bytes]:
        """A body with its framing.

        Raises:
            RpcError: -32008, a MessagePack frame of 16 MiB or more.
        """
        return _FRAMERS[self.codec or Codec.JSON](body)

    def _next_line(self) -> bytes | Malformed | None:
        buffer = self._buffer
        while True:
            end = buffer.find(b"\n", self._scanned)
            if end < 0:
                self._scanned = len(buffer)
                return None
            self.waiting -= 1
            if end > self.max_message:
                self._taken(end + 1)
                return self._oversize("a line", end)
            line = bytes(memoryview(buffer)[:end])
            self._taken(end + 1)
            if not line.strip(b" \t\r"):
                continue
            if _HTTP.match(line):
                return self._http()
            return line

    def _http(self) -> Malformed:
        """Close the connection: a web page can make a browser post lines to a loopback port."""
        self._end()
        error = RpcError(Code.INVALID_REQUEST, "this is a JSON-RPC server, not an HTTP one")
        return Malformed(error, fatal=True)

    def _next_frame(self) -> bytes | Malformed | None:
        buffer = self._buffer
        if len(buffer) < 4:
            return None
        (size,) = struct.unpack_from(">I", buffer)
        if size > MAX_FRAME:
            self._end()
            return Malformed(too_large("a frame", size, MAX_FRAME), fatal=True)
        if size > self.max_message:
            begun = bytes(memoryview(buffer)[4:])
            self._taken(len(buffer))
            self._large = _Large([], size)
            self._large.refused = self._large.reported = True
            self._feed_large(begun)
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


def encoded(result: object, codec: Codec) -> Encoded:
    """A result that is encoded before its answer is made.

    Raises:
        ValueError, TypeError, OverflowError: it holds a value that cannot be encoded.
    """
    pieces = codecs.json_pieces(result) if codec is Codec.JSON else [codecs.write_msgpack(result)]
    return Encoded(tuple(pieces))


def _json(message: Message) -> list[bytes]:
    match message:
        case Response(id, Encoded(pieces)):
            return [b'{"jsonrpc":"2.0","id":%b,"result":' % codecs.write_json(id), *pieces, b"}"]
    return codecs.json_pieces(to_plain(message))


def _msgpack(message: Message) -> list[bytes]:
    match message:
        case Response(id, Encoded(pieces)):
            head = {"jsonrpc": "2.0", "id": id, "result": None}
            return [codecs.write_msgpack(head)[:-1], *pieces]  # nil is one byte
    return [codecs.write_msgpack(to_plain(message))]


def _array_head(count: int) -> bytes:
    return bytes([0x90 | count]) if count < 16 else struct.pack(">BH", 0xDC, count)


def frame_head(size: int) -> bytes:
    """The length in front of a MessagePack frame of so many bytes.

    Raises:
        RpcError: -32008, 16 MiB or more.
    """
    if size > MAX_FRAME:
        raise too_large("a MessagePack frame", size, MAX_FRAME)
    return struct.pack(">I", size)


_BODIES: Final[Mapping[Codec, Callable[[Message], list[bytes]]]] = {
    Codec.JSON: _json,
    Codec.MSGPACK: _msgpack,
}
_FRAMERS: Final[Mapping[Codec, Callable[[Sequence[bytes]], list[bytes]]]] = {
    Codec.JSON: lambda body: [*body, b"\n"],
    Codec.MSGPACK: lambda body: [frame_head(sum(map(len, body))), *body],
}
