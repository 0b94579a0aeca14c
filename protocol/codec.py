"""Bytes to plain documents and back, in JSON and in MessagePack; strict both ways.

Reading rejects whatever only one of the two forms can hold and whatever could do harm:
NaN and infinities in JSON, invalid UTF-8, lone surrogates, nesting above 200, MessagePack
extension types, and containers that declare more members than they have bytes (which
would make the decoder preallocate without limit). Framing belongs to `connection`.
"""

from __future__ import annotations

import base64
import json
import secrets
from enum import Enum

import msgpack
import numpy as np
from pydantic import BaseModel
from pydantic_core import from_json

MAX_DEPTH = 200
"""Deepest nesting of a document (the JSON parser's own limit)."""

BYTE_ORDER_MARK = b"\xef\xbb\xbf"
"""UTF-8 byte order mark; dropped before JSON, because .NET begins a stream with it."""

MIN_PIECEWISE_BYTES = 1 << 16
"""Smallest binary value that is encoded in pieces [bytes]."""
PIECE_BYTES = 3 << 16
"""Size of a piece [bytes]; a multiple of three, as base64 needs."""
_PLACEHOLDER = secrets.token_hex(16)
_NESTED_TYPES = (dict, list, msgpack.Timestamp)


class Codec(Enum):
    """The two forms a connection may speak."""

    JSON = "json"
    MSGPACK = "msgpack"


def read_json(data: bytes | bytearray | memoryview) -> object:
    """Parse one JSON document; a leading byte order mark is dropped.

    Raises ValueError: no JSON, NaN or infinity, nesting above `MAX_DEPTH`, or one name
    twice.
    """
    raw = bytes(data).removeprefix(BYTE_ORDER_MARK)
    try:
        document = from_json(raw, allow_inf_nan=False)
    except ValueError:
        _refuse_not_finite(raw)
        raise
    _UNIQUE_NAME_DECODER.decode(raw.decode())
    return document


def _refuse_not_finite(raw: bytes) -> None:
    """Raise ValueError with a sentence if a text is no JSON because of a number that is not
    finite, as Python and others write it; else do nothing.
    """
    if b"NaN" not in raw and b"Infinity" not in raw:
        return

    def refuse(name: str) -> None:
        """Raise `_NotFiniteError` for the first such number."""
        raise _NotFiniteError(
            f"{name} was recognised, which is no JSON; expected: finite numbers, and a "
            "member without a value left out"
        )

    try:
        json.loads(raw, parse_constant=refuse)
    except _NotFiniteError:
        raise
    except (ValueError, RecursionError):
        pass  # the text is wrong before that


class _NotFiniteError(ValueError):
    """A number that JSON does not have."""


def _unique(pairs: list[tuple[str, object]]) -> None:
    """Raise ValueError if an object has one name twice; `pairs` are its members, in order."""
    seen: set[str] = set()
    for name, _ in pairs:
        if name in seen:
            raise ValueError(f"an object has the name {name[:40]!r} twice")
        seen.add(name)


# The fast parser silently keeps the last of equal names. Numbers are not parsed a second time.
_UNIQUE_NAME_DECODER = json.JSONDecoder(
    object_pairs_hook=_unique, parse_int=str, parse_float=str
)


def write_json(document: object) -> bytes:
    """Encode a document as one line of ASCII JSON, with bytes as base64.

    Raises:
        ValueError, TypeError: a value that JSON cannot hold (NaN, an unknown object).
    """
    return b"".join(json_pieces(document))


def json_pieces(document: object) -> list[bytes]:
    """Encode a document as one line of ASCII JSON, in pieces; large binary values bypass
    the encoder.

    Binary values become base64: below `MIN_PIECEWISE_BYTES` within the text, larger ones
    in pieces of their own. Models, arrays, NumPy numbers, sets and mappings are converted
    by `_plain`.

    The encoder writes an unguessable mark in place of each large value; the marks are
    then replaced by the value's base64, so that the document is never copied as a whole.

    Args:
        document: plain data, with bytes where the wire has binary values; not changed.

    Returns:
        The document's parts in order, as bytes: ASCII text, and base64 of at most
        `PIECE_BYTES` of a value each.

    Raises:
        ValueError, TypeError: as `write_json`, for NaN, infinity and types that JSON
            lacks.
    """
    large: list[bytes | memoryview] = []

    def default(value: object) -> object:
        """Encode a value that JSON lacks; a large binary one goes to `large`, and a mark
        in its place.

        A value that no encoder knows raises TypeError.
        """
        if not isinstance(value, (bytes, bytearray, memoryview)):
            return _plain(value)
        if len(value) < MIN_PIECEWISE_BYTES:
            return base64.b64encode(value).decode("ascii")
        large.append(memoryview(value).cast("B"))
        return f"{_PLACEHOLDER}{len(large) - 1}"

    text = json.dumps(document, allow_nan=False, separators=(",", ":"), default=default)
    left = text.encode("ascii")
    out = list[bytes]()
    for i, value in enumerate(large):
        head, _, left = left.partition(f"{_PLACEHOLDER}{i}".encode())
        out.append(head)
        out += [
            base64.b64encode(value[at : at + PIECE_BYTES])
            for at in range(0, len(value), PIECE_BYTES)
        ]
    return [*out, left]


def read_msgpack(data: bytes | bytearray | memoryview) -> object:
    """Parse one MessagePack object, with strings as UTF-8 and binary values as bytes.

    Keys of maps must be texts or bytes.

    Args:
        data: the object, with nothing after it.

    Returns:
        Plain data: dict, list, str, bytes, numbers, None.

    Raises:
        ValueError: incomplete, followed by more bytes, nested deeper than `MAX_DEPTH`, no
            UTF-8, an extension type or a timestamp; the message names it.
    """
    size = len(data)
    # A first pass that builds nothing: every declared member must be there, or else a few bytes
    # that announce millions of members would make the second pass allocate room for them.
    walker = msgpack.Unpacker(max_buffer_size=size + 1, ext_hook=_no_extension)
    walker.feed(data)
    try:
        walker.skip()
    except msgpack.OutOfData:
        raise ValueError("the MessagePack object is not complete") from None
    except msgpack.StackError:
        raise ValueError(f"nested deeper than {MAX_DEPTH}") from None
    except Exception as error:
        raise ValueError(f"not MessagePack ({type(error).__name__})") from None
    if walker.tell() != size:
        raise ValueError(f"{size - walker.tell()} bytes follow the MessagePack object")
    try:
        document: object = msgpack.unpackb(
            data, raw=False, strict_map_key=True, ext_hook=_no_extension, timestamp=0
        )
    except UnicodeDecodeError:
        raise ValueError("a string is not valid UTF-8") from None
    except Exception as error:
        raise ValueError(str(error) or type(error).__name__) from None
    _check_depth(document)
    return document


def write_msgpack(document: object) -> bytes:
    """Encode a document as one MessagePack object; bytes stay raw, and models, arrays,
    NumPy numbers, sets and mappings are converted by `_plain`.

    Raises:
        ValueError, TypeError, OverflowError: a value that MessagePack cannot hold.
    """
    packed: bytes = msgpack.packb(document, use_bin_type=True, default=_plain)
    return packed


def _check_depth(document: object) -> None:
    """Raise ValueError for nesting deeper than `MAX_DEPTH`, or for a timestamp.

    The document counts as the first level; only maps and lists nest.

    Args:
        document: plain data that a codec has read.
    """
    level: list[object] = [document]
    for _ in range(MAX_DEPTH + 1):
        inner: list[object] = []
        for value in level:
            if isinstance(value, dict):
                inner.extend(v for v in value.values() if isinstance(v, _NESTED_TYPES))
            elif isinstance(value, list):
                inner.extend(v for v in value if isinstance(v, _NESTED_TYPES))
            elif isinstance(value, msgpack.Timestamp):
                raise ValueError("timestamps are not allowed")
        if not inner:
            return
        level = inner
    raise ValueError(f"nested deeper than {MAX_DEPTH}")


def _no_extension(code: int, data: bytes) -> object:
    """Reject a MessagePack extension type with a ValueError."""
    raise ValueError(f"extension type {code} is not allowed")


def _plain(value: object) -> object:
    """Convert a value that an encoder does not know to plain Python: models, arrays,
    NumPy numbers, sets (sorted lists) and mappings.

    A model becomes a dict of its fields, an array nested lists, a NumPy number Python's,
    a mapping a dict; members are left to the encoder.

    Raises:
        TypeError: anything else.
    """
    match value:
        case BaseModel():
            return value.model_dump(mode="python")
        case np.ndarray():
            return value.tolist()
        case np.generic():
            return value.item()
        case set() | frozenset():
            return sorted(value)
    if hasattr(value, "items"):  # MappingProxyType and other read-only mappings
        return dict(value.items())
    raise TypeError(f"a {type(value).__name__} cannot travel on the wire")
