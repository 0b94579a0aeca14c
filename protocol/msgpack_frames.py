"""MessagePack frames with a large payload, packed and unpacked without copying it.

A message whose last member is (nested) `data` of many bytes is written as a small head and the
payload's own memory; read back, `data` is a view into the received frame. The bytes on the wire
are an ordinary frame.
"""

from __future__ import annotations

from typing import Any, Final

from flexdt.protocol.codec import read_msgpack, write_msgpack
from flexdt.protocol.connection import frame_head
from flexdt.protocol.messages import Malformed, Message, from_plain, to_plain
from flexdt.protocol.rpc_errors import parse_error

SMALL: Final = 2**16 - 1
"""Payloads up to this size [bytes] are simply copied (and have a shorter header)."""

_EMPTY: Final = b"\xc4\x00"
_BIN32: Final = b"\xc6"
_MARK: Final = b"\xa4data\xc6"
_WINDOWS: Final = (4096, 2**20)
_ATTEMPTS: Final = 4


def pack(message: Message) -> tuple[bytes, memoryview | None]:
    """The bytes of a frame: length and head, and the payload that follows (or None).

    Raises:
        RpcError: -32008, a frame of 16 MiB or more.
        ValueError, TypeError, OverflowError: something that MessagePack cannot hold.
    """
    document = to_plain(message)
    inner = _innermost(document)
    payload = None if inner is None else _large(inner.get("data"))
    if inner is None or payload is None:
        head = write_msgpack(document)
        return frame_head(len(head)) + head, None
    data, inner["data"] = inner["data"], b""
    try:
        head = write_msgpack(document)
    finally:
        inner["data"] = data
    size = payload.nbytes
    head = head[: -len(_EMPTY)] + _BIN32 + size.to_bytes(4, "big")
    return frame_head(len(head) + size) + head, payload


def unpack(body: memoryview) -> Message:
    """The message of a frame's body; a large last `data` is a view into `body`."""
    try:
        document = _split(body) if len(body) > SMALL else None
        return from_plain(read_msgpack(body) if document is None else document)
    except ValueError as error:
        return Malformed(parse_error(str(error)))


def _large(data: object) -> memoryview | None:
    if not isinstance(data, (bytes, bytearray, memoryview)):
        return None
    view = memoryview(data)
    return view if view.nbytes > SMALL else None


def _split(body: memoryview) -> object | None:
    """The document with `data` a view of `body`, or None if it has no such last member.

    The head of the frame is searched for `data` with a 32-bit length that reaches exactly to the
    end of the frame. The same bytes may occur inside another value, so each candidate is decoded
    without its payload before it is believed; a few attempts are enough for honest messages and
    bound the work for others.
    """
    attempts = 0
    for window in _WINDOWS:
        head = bytes(body[:window])
        at = head.find(_MARK)
        while 0 <= at <= len(head) - len(_MARK) - 4 and attempts < _ATTEMPTS:
            start = at + len(_MARK) + 4
            if start + int.from_bytes(head[start - 4 : start], "big") == len(body):
                attempts += 1
                document = _with_payload(head[: start - 5], body[start:])
                if document is not None:
                    return document
            at = head.find(_MARK, at + 1)
    return None


def _with_payload(head: bytes, payload: memoryview) -> object | None:
    """The document of `head` with `payload` as its last `data`, if that is what it lacks."""
    try:
        document = read_msgpack(head + _EMPTY)
    except ValueError:
        return None  # the mark was inside something else
    inner = _innermost(document)
    if inner is None or inner["data"] != b"":
        return None
    inner["data"] = payload
    return document


def _innermost(document: object) -> dict[str, Any] | None:
    """The last nested map whose last member is `data`."""
    while isinstance(document, dict) and document:
        key = next(reversed(document))
        if key == "data":
            return document
        document = document[key]
    return None
