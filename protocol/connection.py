"""One connection without a socket: bytes in, messages out; messages in, bytes out.

The first byte determines the codec of the connection: 0x00 (the high byte of a length
below 16 MiB) means length-prefixed MessagePack, anything else JSON lines. A message that
is too long or broken comes out as `Malformed`; a JSON connection recovers at the next
newline, a MessagePack connection at the end of the frame. The caller owns the network. No
received bytes make a method block or raise; only the end of the stream may be an error
(`receive_end`). Other framings that are common (a length before JSON, UTF-16, NUL at a
message's end, documents of many lines) are recognized, and refused by a sentence in JSON.

Received bytes are divided into complete messages at once; these wait, still as bytes, in
a queue.

`pack` and `unpack` are for callers that read and write MessagePack frames themselves: a
message whose last member is (nested) `data` of many bytes is written as a small head and
the payload's own memory; read back, `data` is a view into the received frame. The bytes
on the wire are an ordinary frame.
"""

from __future__ import annotations

import re
import struct
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from itertools import chain, islice
from typing import Any, Final, TypeGuard, assert_never

from flexdt.protocol import codec as codecs
from flexdt.protocol.codec import Codec
from flexdt.protocol.messages import (
    Encoded,
    Malformed,
    Message,
    Response,
    from_plain,
    to_plain,
)
from flexdt.protocol.rpc_errors import (
    Code,
    ProtocolError,
    RpcError,
    parse_error,
    too_large,
)

MAX_FRAME: Final = 2**24 - 1
"""Largest MessagePack frame [bytes]: its length's first byte must be zero."""

MAX_ANSWER: Final[Mapping[Codec, int]] = {Codec.JSON: 64 << 20, Codec.MSGPACK: MAX_FRAME}
"""Largest answer [bytes] of a method that knows its size in advance."""

MAX_OVERTAKING_BYTES: Final = 1 << 16
"""Larger messages are sent in pieces and do not overtake others [bytes]."""

MAX_EXAMINED_BYTES: Final = 1 << 20
"""Larger received messages are not examined before their turn [bytes]."""

MAX_COPIED_BYTES: Final = 2**16 - 1
"""Payloads up to this size are copied into the head and have a shorter header [bytes]."""

_EMPTY_BIN: Final = b"\xc4\x00"
_BIN32: Final = b"\xc6"
_DATA_BIN32: Final = b"\xa4data\xc6"
_HEAD_WINDOWS_BYTES: Final = (4096, 2**20)
_MAX_SPLIT_ATTEMPTS: Final = 4

_size = struct.Struct(">I").unpack_from
_HTTP: Final = re.compile(
    rb"[!#$%&'*+.^_`|~0-9A-Za-z-]+ [^ ]* HTTP/|host[ \t]*:", re.IGNORECASE
)
"""Start of a line of an HTTP request: TOKEN SP TARGET SP HTTP/, or the field `Host`.

RFC 9112, 3 and 3.2. A browser sends methods of any name, and always a Host; no JSON
begins so.
"""
_HTTP_MARKS: Final = b" http/", b"host"
"""Lower-case bytes of which received data holds one if a line may match `_HTTP`."""


_EXPECTED: Final = (
    "expected: each document on one line of UTF-8 JSON, ended by a line feed (\\n), or "
    "MessagePack after a length of 4 bytes"
)
_LENGTH_BEFORE_JSON: Final = f"a length before JSON was recognised; {_EXPECTED}"
_WIDE_TEXT: Final = f"UTF-16 or UTF-32 was recognised; {_EXPECTED}"
_NUL: Final = f"a NUL byte was recognised, which no JSON text holds; {_EXPECTED}"
_MANY_LINES: Final = f"JSON printed over several lines was recognised; {_EXPECTED}"
_OPENED: Final = b"{", b"["
"""Lines with which a document printed over several lines begins."""


class Prepared:
    """A message that is encoded at most once per codec, for events to many connections."""

    def __init__(self, message: Message) -> None:
        """Take a message, which is encoded at the first use with each codec."""
        self.message = message
        self._pieces: dict[Codec, list[bytes]] = {}

    def encoded(self, codec: Codec) -> list[bytes]:
        """Return the message's bytes, framing included; encoded at the first call for
        each codec and kept.

        One piece up to `MAX_OVERTAKING_BYTES`, several for a larger message.
        """
        if codec not in self._pieces:
            pieces = _framed(codec, _body(codec, self.message))
            small = sum(map(len, pieces)) <= MAX_OVERTAKING_BYTES
            # Joined once, not at each of the connections.
            self._pieces[codec] = [b"".join(pieces)] if small else pieces
        return self._pieces[codec]


class Connection:
    """Protocol state of one connection, the same for both ends.

    Args:
        codec: of this connection; None (a server) takes it from the first byte received.
        max_message: largest line or frame accepted [bytes].
        max_batch: largest number of messages in one batch.
    """

    def __init__(
        self,
        codec: Codec | None = None,
        *,
        max_message: int = MAX_FRAME,
        max_batch: int = 1000,
    ) -> None:
        """Make an open connection that has received nothing.

        Args:
            codec: None: the first byte received decides it.
            max_message: largest line or frame accepted [bytes].
            max_batch: largest number of messages in one batch.
        """
        self.codec = codec
        self.max_message = max_message
        self.max_batch = max_batch
        self.closed = False
        self._ready = deque[bytes | Malformed]()
        """Complete messages that `overtake` has examined, and errors found in dividing."""
        self._new = deque[bytes | Malformed]()
        """The messages after these, not examined yet."""
        self._fed = 0
        """Number of messages in `_new` before the last `feed`."""
        self._suspect = False
        """Whether `_new` may contain an urgent name that `overtake` has still to reach."""
        self._held = 0
        """Bytes in `_ready` and `_new`."""
        self._begun = bytearray()
        """The received part of an incomplete message."""
        self._skip = 0
        """Bytes of a rejected frame still to be skipped, or 1 for the rest of a rejected
        line."""
        self._opening = codec is None
        """Whether the codec was just derived, so that its first frame may be no frame."""
        self._many_lines = False
        """Whether the lines of a document that was refused at its first line go on."""
        self._line_before = b""
        """The last of them."""
        self._broken = False
        """Whether a fatal error waits in the queue, so that further bytes are ignored."""

    @property
    def pending(self) -> int:
        """Bytes held of messages that have not been taken out, framing included."""
        return self.pending_whole + len(self._begun)

    @property
    def pending_whole(self) -> int:
        """Bytes of complete messages that wait to be taken out, framing included."""
        # Counted with the bodies, so that a flood of empty messages fills the allowance, too.
        framing = 1 if self.codec is Codec.JSON else 4
        return self._held + framing * self.waiting

    @property
    def waiting(self) -> int:
        """Number of complete messages that wait."""
        return len(self._ready) + len(self._new)

    @property
    def whole(self) -> bool:
        """Whether a complete message waits, so that `next_raw` returns something."""
        return bool(self._ready or self._new)

    @property
    def mid_message(self) -> bool:
        """Whether a message has begun and not ended."""
        return bool(self._begun) or self._skip > 0

    def receive_data(self, data: bytes | bytearray | memoryview) -> list[Message]:
        """Receive bytes and decode the messages that they complete, in order.

        Malformed ones are in the list as `Malformed`; an incomplete message waits for
        more bytes.
        """
        self.feed(data)
        out: list[Message] = []
        while (raw := self.next_raw()) is not None:
            out.append(raw if isinstance(raw, Malformed) else self.decode(raw))
        return out

    def receive_end(self) -> None:
        """End reception: the peer has ended the stream; messages not taken are dropped.

        Raises ProtocolError: it ended inside a message.
        """
        inside = self.mid_message and not self.closed
        held = self.pending
        self._end()
        if inside:
            raise ProtocolError(
                f"the stream ended inside a message, of which {held} bytes came"
            )

    def feed(self, data: bytes | bytearray | memoryview) -> None:
        """Divide received bytes into complete messages, which wait undecoded for
        `next_raw`.

        The first byte decides the codec if none was given: 0 begins a MessagePack frame,
        any other JSON lines. Lines and frames above `max_message` become `Malformed` in
        the queue. After a fatal error, and once closed, bytes are ignored.

        Args:
            data: any part of the stream, also an empty one.
        """
        # From here `holds` searches: each message once, not all that wait at each chunk.
        self._fed = len(self._new)
        if self.closed or self._broken or not data:
            return
        if self.codec is None:
            if data[0] == 0:
                self.codec = Codec.MSGPACK
            else:
                self.codec = Codec.JSON
        match self.codec:
            case Codec.JSON:
                self._feed_lines(bytes(data))
            case Codec.MSGPACK:
                self._feed_frames(data)
            case _:
                assert_never(self.codec)

    def _feed_lines(self, data: bytes) -> None:
        """Divide received bytes into JSON lines; a chunk of many short lines is split at
        once.

        A chunk that is longer than `max_message`, has one line end or none, or may hold
        HTTP or a foreign framing is divided by `_feed_each_line`. Blank lines are
        dropped; the rest after the last line end waits.

        Args:
            data: received bytes, any part of the stream.
        """
        first = data.find(b"\n") + 1
        last = data.rfind(b"\n") + 1
        plain = not (self._many_lines or _may_hold_http(data) or _may_be_foreign(data))
        if first == last or len(data) > self.max_message or not plain:
            self._feed_each_line(data)
            return
        # Of many short lines only the first, which may have begun before, can be one to refuse.
        self._feed_each_line(data[:first])
        if self._many_lines:
            self._feed_each_line(data[first:])
        elif not self._broken:
            # Split and filtered in C: a loop over ten thousand lines would hold up all
            # connections.
            lines = [*filter(bytes.strip, data[first : last - 1].split(b"\n"))]
            self._new.extend(lines)
            self._held += sum(map(len, lines))
            self._begun += data[last:]

    def _feed_each_line(self, data: bytes) -> None:
        """Divide JSON lines one by one; queue an error for HTTP (fatal), for lines that
        are too long, and for foreign framings (UTF-16: fatal).

        Blank lines are dropped; an incomplete line is kept. A line is refused as soon as
        it is longer than `max_message` or has a NUL, and the rest of it is skipped up to
        its end. After a fatal error the rest of `data` is dropped.

        Args:
            data: received bytes, any part of the stream.
        """
        *ends, rest = data.split(b"\n")
        for end in ends:
            line = bytes(self._begun) + end
            self._begun.clear()
            if self._skip:  # the rest of a line that was refused
                self._skip = 0
            elif b"\0" in line[: self.max_message]:
                if self._refuse_nul(line):
                    return
            elif len(line) > self.max_message:
                self._refuse(too_large("a line", len(line), self.max_message))
            elif _HTTP.match(line):
                # A web page can make a browser post lines to a loopback port.
                why = "this is a JSON-RPC server, not an HTTP one"
                self._refuse(RpcError(Code.INVALID_REQUEST, why), fatal=True)
                return
            elif self._goes_on(line):
                pass
            elif line.strip():
                self._new.append(line)
                self._held += len(line)
        if not self._skip:
            self._begun += rest
        # Before its end has come: a sender of such texts never sends one.
        if b"\0" in rest and not self._skip and b"\0" in self._begun[: self.max_message]:
            self._skip = 1
            if self._refuse_nul(bytes(self._begun)):
                return
        # Before its end has come, or a line without one would fill the memory.
        if (came := len(self._begun)) > self.max_message:
            self._skip = 1
            self._refuse(too_large("a line", f"at least {came}", self.max_message))

    def _refuse_nul(self, line: bytes) -> bool:
        """Queue the error about a line, or its beginning, that has a NUL.

        Only the bytes up to the NUL decide, however the line was cut.

        Returns:
            Whether it is fatal: in UTF-16 and UTF-32 every line has NULs.
        """
        before = line[: line.index(b"\0")]
        wide = before in (b"\xff\xfe", b"\xfe\xff") or (
            before.removeprefix(b"\xff\xfe") in _OPENED
        )
        # A length in little-endian order has high bytes of zero.
        length = 1 <= len(before) <= 3 and not before.startswith(_OPENED)
        why = _NUL
        if wide:
            why = _WIDE_TEXT
        elif length:
            why = _LENGTH_BEFORE_JSON
        self._refuse(parse_error(why), fatal=wide)
        return wide

    def _goes_on(self, line: bytes) -> bool:
        """Refuse a document over several lines at its first line, and return whether
        `line` is part of such a document.

        Of its other lines those are dropped that are indented, a member or brackets, and
        cannot be a message; any other ends it, so that no request is lost.
        """
        opens = line.rstrip(b"\r").removeprefix(codecs.BYTE_ORDER_MARK) in _OPENED
        # No object begins right behind an object's end or within one without a name.
        begins = opens and self._line_before in (b"{", b"}", b"]")
        self._line_before = line.rstrip()
        if self._many_lines and not begins:
            text = line.strip()
            brackets = not text.strip(b"{}[],")
            inner = line.startswith((b" ", b"\t", b'"')) and not text.startswith(_OPENED)
            self._many_lines = brackets or inner
            return self._many_lines
        if opens:
            self._new.append(Malformed(parse_error(_MANY_LINES)))
            self._many_lines = True
        return opens

    def _feed_frames(self, data: bytes | bytearray | memoryview) -> None:
        """Divide MessagePack frames; queue an error for one that is too long, and skip
        its rest.

        An incomplete frame waits for more bytes. A first frame that begins as JSON does
        is a fatal error, which is told in JSON. A frame above `max_message` is refused
        and skipped; a length above `MAX_FRAME` is a fatal error, as the stream has no
        known next frame then, and the rest of `data` is dropped.

        Args:
            data: received bytes, any part of the stream.
        """
        skipped = min(self._skip, len(data))
        self._skip -= skipped
        begun = self._begun
        at = 0
        # A view, so that the chunk is copied once.
        begun += memoryview(data)[skipped:]
        if self._opening and len(begun) >= 5:
            self._opening = False
            if (why := _foreign_opening(begun)) is not None:
                self.codec = Codec.JSON
                self._refuse(parse_error(why), fatal=True)
                return
        held: bytes | bytearray = begun
        while (available := len(held)) - at >= 4:
            (size,) = _size(held, at)
            end = at + 4 + size
            if size <= self.max_message:
                if end > available:
                    break
                if held is begun:  # once, because bytes are cut faster
                    held = bytes(begun)
                self._new.append(bytes(held[at + 4 : end]))
                self._held += size
            elif size <= MAX_FRAME:
                self._new.append(Malformed(too_large("a frame", size, self.max_message)))
                # The rest of it is counted, not kept.
                self._skip = max(0, end - available)
            else:
                self._refuse(too_large("a frame", size, MAX_FRAME), fatal=True)
                return
            at = min(end, available)
        # Once for all frames, because each cut moves the bytes behind it.
        del begun[:at]

    def _refuse(self, error: RpcError, *, fatal: bool = False) -> None:
        """Queue `error` in place of the message that it is about, and drop that message."""
        self._new.append(Malformed(error, fatal=fatal))
        self._broken = fatal
        self._begun.clear()

    def next_raw(self) -> bytes | Malformed | None:
        """Take the next message's bytes, or an error, out of the queue.

        After a fatal error nothing follows.
        """
        if not self.whole:
            return None
        raw = (self._ready or self._new).popleft()
        if not isinstance(raw, Malformed):
            self._held -= len(raw)
        elif raw.fatal:
            self._end()
        return raw

    def decode(self, raw: bytes) -> Message:
        """Decode bytes from `next_raw` with the connection's codec; never raises.

        Bytes that cannot be parsed, nest too deep or need too much memory become
        `Malformed` with a parse error, other invalid messages `Malformed` as `from_plain`
        makes it.
        """
        match self.codec:
            case Codec.MSGPACK:
                read = codecs.read_msgpack
            case Codec.JSON | None:
                read = codecs.read_json
            case _:
                assert_never(self.codec)
        try:
            document = read(raw)
        except (ValueError, RecursionError, MemoryError) as error:
            return Malformed(parse_error(str(error) or type(error).__name__))
        return from_plain(document, self.max_batch)

    @property
    def unjudged(self) -> bool:
        """Whether there are messages that `overtake` has not examined."""
        return bool(self._new)

    def overtake(
        self,
        names: tuple[bytes, ...],
        wanted: Callable[[bytes], bool],
        most: int = 32,
    ) -> list[bytes]:
        """Take urgent messages out of the queue before their turn, in order.

        Messages up to `MAX_EXAMINED_BYTES` are examined once: only one that `may_name`
        one of `names` is passed to `wanted`, which decides and may decode it. Others keep
        their place. `most`: passed to `wanted` in one call; `unjudged` is then true if
        more remain.
        """
        out = list[bytes]()
        looked = 0
        if not self._suspect:
            # One search for all of them: usually there is no name, and none is looked at alone.
            self._suspect = self._may_name(_joined(self._new), names)
        if not self._suspect:
            self._ready += self._new
            self._new.clear()
        while self._new and looked < most:
            message = self._new.popleft()
            if _examined(message) and self._may_name(message, names):
                looked += 1
                if wanted(message):
                    out.append(message)
                    self._held -= len(message)
                    continue
            self._ready.append(message)
        # The search is not repeated for what remains of it.
        self._suspect = bool(self._new)
        return out

    def holds(self, name: bytes) -> bool:
        """Return whether a message completed by the last `feed` may contain `name`."""
        return self._may_name(_joined(islice(self._new, self._fed, None)), (name,))

    def withdraw(self, message: bytes) -> bool:
        """Take a message that `overtake` left in the queue out of it, by identity.

        Returns:
            Whether it was still there.
        """
        for at, ready in enumerate(self._ready):
            if ready is message:
                del self._ready[at]
                self._held -= len(message)
                return True
        return False

    def _may_name(self, raw: bytes, names: tuple[bytes, ...]) -> bool:
        return may_name(self.codec or Codec.JSON, raw, names)

    def _end(self) -> None:
        """Mark the connection as closed and discard all bytes and messages not taken out yet."""
        self.closed = True
        self._ready.clear()
        self._new.clear()
        self._begun.clear()
        self._held = self._skip = 0

    def send(self, message: Message | Prepared) -> bytes:
        """Encode and frame a message. Raises ValueError, TypeError, RpcError."""
        pieces = self.pieces(message)
        if len(pieces) == 1:
            return pieces[0]
        return b"".join(pieces)

    def pieces(self, message: Message | Prepared) -> list[bytes]:
        """Encode like `send`, in pieces, so that large values are not copied."""
        if isinstance(message, Prepared):
            return message.encoded(self.codec or Codec.JSON)
        return self.framed(self.body(message))

    def body(self, message: Message) -> list[bytes]:
        """Encode like `pieces`, without framing."""
        return _body(self.codec or Codec.JSON, message)

    def batch(self, bodies: Sequence[Sequence[bytes]]) -> list[bytes]:
        """Join encoded messages into one batch document, without framing.

        Without a codec it is JSON. No body gives an empty array.

        Args:
            bodies: bodies of the messages, from `body`; at most 65 535.

        Returns:
            The document in pieces, in order.
        """
        match self.codec:
            case Codec.MSGPACK:
                return [_array_head(len(bodies)), *chain.from_iterable(bodies)]
            case Codec.JSON | None:
                out = [b"["]
                for i, body in enumerate(bodies):
                    out += [b","] * (i > 0) + list(body)
                return [*out, b"]"]
            case _:
                assert_never(self.codec)

    def framed(self, body: Sequence[bytes]) -> list[bytes]:
        """Add framing to an encoded body: a newline for JSON (also without a codec), a
        length for MessagePack.

        Raises:
            RpcError: -32008, a MessagePack frame of 16 MiB or more.
        """
        return _framed(self.codec or Codec.JSON, body)


def _may_hold_http(data: bytes) -> bool:
    """Return whether each line must be checked for the head of an HTTP request."""
    # Two searches in C spare nearly all chunks the expression at each of their lines.
    lower = data.lower()
    return any(mark in lower for mark in _HTTP_MARKS)


def _may_be_foreign(data: bytes) -> bool:
    """Return whether each line must be checked for a framing that is not ours."""
    return b"\0" in data or any(
        opened + end in data for opened in _OPENED for end in (b"\n", b"\r\n")
    )


def _foreign_opening(begun: bytes | bytearray) -> str | None:
    """Recognise a connection's first five bytes, which begin with 0, if they are no frame.

    A frame holds a map or an array; none of their heads is 0 or the ASCII bracket of JSON.

    Returns the sentence about it; None for a frame.
    """
    (size,) = _size(begun, 0)
    if begun[4:5] in _OPENED and size >= 2:
        return _LENGTH_BEFORE_JSON
    utf_16 = begun[0] == begun[2] == begun[4] == 0 and begun[1:2] in _OPENED
    utf_32 = not any(begun[:3]) and begun[3:4] in _OPENED and begun[4] == 0
    return _WIDE_TEXT if utf_16 or utf_32 else None


def may_name(codec: Codec, raw: bytes, names: tuple[bytes, ...]) -> bool:
    """Return whether a document may contain one of the names; False is certain.

    JSON may escape characters.
    """
    if any(name in raw for name in names):
        return True
    return codec is Codec.JSON and _escape_of(names).search(raw) is not None


@cache
def _escape_of(names: tuple[bytes, ...]) -> re.Pattern[bytes]:
    """Make the expression of a JSON escape of any character of `names`."""
    digits = "|".join(sorted({f"{character:02x}" for character in b"".join(names)}))
    return re.compile(rf"\\u00(?:(?i:{digits}))".encode())


def _joined(messages: Iterable[bytes | Malformed]) -> bytes:
    """Join the messages to be examined into one piece for a search (10^4 take a millisecond)."""
    return b"\n".join(filter(_examined, messages))


def _examined(message: bytes | Malformed) -> TypeGuard[bytes]:
    """Return whether this is a message short enough to be examined while others wait."""
    return isinstance(message, bytes) and len(message) <= MAX_EXAMINED_BYTES


def encoded(result: object, codec: Codec) -> Encoded:
    """Encode a result ahead of its answer, in the connection's codec.

    Raises:
        ValueError, TypeError, OverflowError: it holds a value that cannot be encoded.
    """
    return Encoded(tuple(_pieces(codec, result)))


def _body(codec: Codec, message: Message) -> list[bytes]:
    """Encode a message without framing; an `Encoded` result of this codec as it is.

    Raises ValueError, TypeError, OverflowError.
    """
    match message:
        case Response(id, Encoded(pieces)):
            return _around(codec, id, pieces)
    return _pieces(codec, to_plain(message))


def _around(codec: Codec, id: object, pieces: Sequence[bytes]) -> list[bytes]:
    """Put the answer to the request `id` around a result that is encoded already."""
    match codec:
        case Codec.JSON:
            head = b'{"jsonrpc":"2.0","id":%b,"result":' % codecs.write_json(id)
            return [head, *pieces, b"}"]
        case Codec.MSGPACK:
            answer = {"jsonrpc": "2.0", "id": id, "result": None}
            return [codecs.write_msgpack(answer)[:-1], *pieces]  # nil is one byte
        case _:
            assert_never(codec)


def _pieces(codec: Codec, document: object) -> list[bytes]:
    """Encode a document: JSON in pieces, MessagePack as one piece; no framing."""
    match codec:
        case Codec.JSON:
            return codecs.json_pieces(document)
        case Codec.MSGPACK:
            return [codecs.write_msgpack(document)]
        case _:
            assert_never(codec)


def _framed(codec: Codec, body: Sequence[bytes]) -> list[bytes]:
    """Add the newline of JSON lines, or the length of a MessagePack frame."""
    match codec:
        case Codec.JSON:
            return [*body, b"\n"]
        case Codec.MSGPACK:
            return [frame_head(sum(map(len, body))), *body]
        case _:
            assert_never(codec)


def answer_bytes(size: int, codec: Codec) -> int:
    """Return how many bytes of an answer binary data of `size` bytes take: in JSON they
    are base64.
    """
    match codec:
        case Codec.JSON:
            return size * 4 // 3
        case Codec.MSGPACK:
            return size
        case _:
            assert_never(codec)


def _array_head(count: int) -> bytes:
    """Return the MessagePack header of an array of `count` items."""
    if count < 16:
        return bytes([0x90 | count])
    return struct.pack(">BH", 0xDC, count)


def frame_head(size: int) -> bytes:
    """Return the length prefix of a MessagePack frame of `size` bytes.

    Raises RpcError: -32008, 16 MiB or more."""
    if size > MAX_FRAME:
        raise too_large("a MessagePack frame", size, MAX_FRAME)
    return struct.pack(">I", size)


def pack(message: Message) -> tuple[bytes, memoryview | None]:
    """Encode a message as a frame: its length and head, and the payload that follows without a
    copy.

    Large is above `MAX_COPIED_BYTES`. Only `data` as the last member at each level counts. The
    message is the same afterwards.

    Args:
        message: its innermost `data` may be bytes of any size.

    Returns the first bytes of the frame, and a large `data` as a view; None where the first
    bytes are the whole frame.
    Raises RpcError: -32008, a frame of 16 MiB or more; ValueError, TypeError, OverflowError:
    something that MessagePack cannot hold.
    """
    document = to_plain(message)
    inner = _innermost(document)
    payload = None
    if inner is not None:
        payload = _large(inner.get("data"))
    if inner is None or payload is None:
        head = codecs.write_msgpack(document)
        return frame_head(len(head)) + head, None
    # Encoded empty; as the last member it ends the head, and its type and length are put in
    # place of the empty ones. The payload itself is never copied.
    data, inner["data"] = inner["data"], b""
    try:
        head = codecs.write_msgpack(document)
    finally:
        inner["data"] = data
    size = payload.nbytes
    head = head[: -len(_EMPTY_BIN)] + _BIN32 + size.to_bytes(4, "big")
    return frame_head(len(head) + size) + head, payload


def unpack(body: memoryview) -> Message:
    """Decode a frame's body to a message, or `Malformed`.

    In a body above `MAX_COPIED_BYTES` whose last member is a large `data`, that becomes a
    view, without a copy.
    """
    try:
        document = None
        if len(body) > MAX_COPIED_BYTES:
            document = _split(body)
        return from_plain(codecs.read_msgpack(body) if document is None else document)
    except ValueError as error:
        return Malformed(parse_error(str(error)))


def _large(data: object) -> memoryview | None:
    """Return a view of `data` if it is binary and larger than `MAX_COPIED_BYTES`, else None.

    No copy is made.
    """
    if not isinstance(data, (bytes, bytearray, memoryview)):
        return None
    view = memoryview(data)
    if view.nbytes > MAX_COPIED_BYTES:
        return view
    return None


def _split(body: memoryview) -> object | None:
    """Decode a frame with a large `data` as a view of `body`, without a copy.

    `data` is searched for with a 32-bit length to the frame's end. The same bytes may
    occur inside another value, so each candidate is decoded without its payload first,
    `_MAX_SPLIT_ATTEMPTS` at most, as frames may be hostile. Returns None without one: the
    caller then decodes the whole frame.
    """
    attempts = 0
    for window in _HEAD_WINDOWS_BYTES:
        head = bytes(body[:window])
        at = head.find(_DATA_BIN32)
        while (
            0 <= at <= len(head) - len(_DATA_BIN32) - 4 and attempts < _MAX_SPLIT_ATTEMPTS
        ):
            start = at + len(_DATA_BIN32) + 4
            if start + int.from_bytes(head[start - 4 : start], "big") == len(body):
                attempts += 1
                document = _with_payload(head[: start - 5], body[start:])
                if document is not None:
                    return document
            at = head.find(_DATA_BIN32, at + 1)
    return None


def _with_payload(head: bytes, payload: memoryview) -> object | None:
    """Decode a frame's head and put `payload` in place of its last `data`.

    `head` ends with the type byte. None if it is no MessagePack, or `data` is not its
    last member.
    """
    try:
        document = codecs.read_msgpack(head + _EMPTY_BIN)
    except ValueError:
        return None  # the mark was inside something else
    inner = _innermost(document)
    if inner is None or inner["data"] != b"":
        return None
    inner["data"] = payload
    return document


def _innermost(document: object) -> dict[str, Any] | None:
    """Follow the last members of nested maps; return the first map whose last member is
    `data`. None where an empty map or another value comes first."""
    while isinstance(document, dict) and document:
        key = next(reversed(document))
        if key == "data":
            return document
        document = document[key]
    return None
