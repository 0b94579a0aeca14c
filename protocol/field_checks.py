"""Checks that types of the wire's fields share; each raises ValueError with
the allowed values."""

from __future__ import annotations

import re
from collections.abc import Mapping
from urllib.parse import quote

from pydantic import (
    BeforeValidator,
)

from flexdt.protocol import image
from flexdt.protocol.rpc_errors import RpcError

_CONTROL_CHARACTER = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
_CONTROL_BUT_LINE_END = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff]")
MAX_STEM = 100
"""Longest name, percent-encoded [bytes]: it becomes a file name, with a date and a suffix."""
MAX_SIDE_MM = 1e4
"""Longest side of a grid of voxels [mm]."""


def few(most: int) -> BeforeValidator:
    """Make a validator that rejects an object of more than `most` members
    before it reads any.

    Values that are no objects pass unchanged.
    """

    def check(value: object) -> object:
        """Raise ValueError for a mapping of more than `most` members; return any other value
        unchanged.
        """
        if isinstance(value, Mapping) and len(value) > most:
            raise ValueError(f"{len(value)} members; at most {most} are allowed")
        return value

    return BeforeValidator(check)


def payload(value: object) -> object:
    """Convert to bytes: base64 is decoded; bytes, bytearray, memoryview copied.

    Raises ValueError: anything else.
    """
    try:
        return bytes(image.payload(value))
    except RpcError as error:
        raise ValueError(error.message) from None


def no_truth(value: object) -> object:
    """Return a value that is not true or false, which Python accepts as numbers; raise
    ValueError for those.
    """
    if isinstance(value, bool):
        raise ValueError("a number is needed, not true or false")
    return value


def whole(value: object) -> object:
    """Convert a number without a fraction to an int; return any other value unchanged.

    JSON has one kind of number, and some languages write all of theirs as 8.0."""
    if isinstance(value, float) and value.is_integer():
        return int(value)
    return value


def encoded(name: str) -> str:
    """Percent-encode `name` for a file's name; different names differ."""
    return quote(name, safe=" ", errors="surrogatepass").replace(".", "%2E")


def line(value: str) -> str:
    """Return a text without control characters and line ends; raise ValueError for any
    other.
    """
    if _CONTROL_CHARACTER.search(value):
        raise ValueError("control characters and line ends are not allowed")
    return value


def lines(value: str) -> str:
    """Return a text without control characters except TAB and line ends; raise ValueError
    for any other.
    """
    if _CONTROL_BUT_LINE_END.search(value):
        raise ValueError("control characters but TAB and line ends are not allowed")
    return value


def plain_name(value: str) -> str:
    """Check that a name can become a file's name, and return it.

    An empty name passes.

    Raises:
        ValueError: a slash, backslash or control character, or more than `MAX_STEM` bytes
            once percent-encoded.
    """
    if "/" in value or "\\" in value or _CONTROL_CHARACTER.search(value):
        raise ValueError("a name may hold anything but /, \\ and control characters")
    if (size := len(encoded(value))) > MAX_STEM:
        raise ValueError(
            f"too long: {size} bytes percent-encoded (what is no letter, "
            f"digit, space, _, - or ~ takes 3 to 12), {MAX_STEM} allowed"
        )
    return value


def require_extent(shape: tuple[int, ...], voxel_mm: tuple[float, ...]) -> None:
    """Check that no side of a grid of `shape` (z, y, x) and `voxel_mm` (x, y, z) is too long.

    Raises:
        ValueError: a side is longer than `MAX_SIDE_MM`.
    """
    side = max(n * v for n, v in zip(reversed(shape), voxel_mm, strict=True))
    if side > MAX_SIDE_MM:
        raise ValueError(
            f"shape and voxel_mm: a side of {side:g} mm; at most {MAX_SIDE_MM:g} mm are allowed"
        )
