"""Read Varian's XIM images; from documentation, no file seen.

As pylinac, TIGRE and RTK have it: whole numbers of 4 bytes, least first. Of a compressed image the
first row and one pixel are plain; each further pixel is its step from the plane through its left,
upper and upper left neighbors, where the left one of a row's first pixel is the last of the row
above. A table has the bytes of each step: 1, 2 or 4, in two bits, the lowest first.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.runtime.files.reading_within import opened
from flexdt.twin.dataset.dataset_errors import DatasetFormatError

MAGIC: Final = b"VMS.XI"
STEPS: Final = ("i1", "<i2", "<i4")
"""Types of the steps, by the two bits of the table."""
PLAIN: Final = {1: "<i1", 2: "<i2", 4: "<i4", 8: "<i8"}
"""Bytes of a pixel of an image that is not compressed -> type."""
MOST_PROPERTIES: Final = 10_000
NUMBER, DOUBLE, TEXT, DOUBLES, NUMBERS = 0, 1, 2, 4, 5
"""Kinds of a property."""


@dataclass(frozen=True)
class XimImage:
    """An image of Varian's.

    Attributes:
        pixels: counts (rows, cols), int64, as they are stored; (0, 0) for none.
        properties: name -> number or text; lists as text.
    """

    pixels: npt.NDArray[np.int64]
    properties: dict[str, float | str]


@dataclass
class _Bytes:
    """Bytes of a file, and how far they are read."""

    path: Path
    raw: bytes
    at: int = 0

    def take(self, count: int) -> bytes:
        """Take some bytes; raises DatasetFormatError where there are fewer."""
        if not 0 <= count <= len(self.raw) - self.at:
            self.refuse(f"it ends after {len(self.raw)} bytes or is damaged")
        self.at += count
        return self.raw[self.at - count : self.at]

    def whole(self) -> int:
        """Take a whole number of 4 bytes."""
        return int(struct.unpack("<i", self.take(4))[0])

    def refuse(self, why: str) -> Any:
        """Raise the error of the file."""
        said = f"{self.path} is no readable XIM image: {why}"
        raise DatasetFormatError(said, {"path": str(self.path)})


def read_xim(path: Path) -> XimImage:
    """Read an image and its properties.

    Raises:
        DatasetFormatError: another format, or one that is damaged.
        OSError: it cannot be read.
    """
    with opened(path) as raw:
        file = _Bytes(path, raw.read())
    if not file.raw.startswith(MAGIC):
        file.refuse("it begins with other bytes")
    file.take(8)
    _, cols, rows, _, size, packed = (file.whole() for _ in range(6))
    if not 0 <= rows * cols <= len(file.raw) or min(rows, cols) < 0:
        file.refuse(f"{cols} x {rows} pixels are claimed in {len(file.raw)} bytes")
    pixels = _packed(file, rows, cols) if packed else _plain(file, rows, cols, size)
    file.take(4 * file.whole())  # a histogram
    return XimImage(pixels, _properties(file))


def _plain(file: _Bytes, rows: int, cols: int, size: int) -> npt.NDArray[np.int64]:
    """Read pixels that are not compressed."""
    values = file.take(file.whole())
    if size not in PLAIN or len(values) != rows * cols * size:
        file.refuse(f"{len(values)} bytes of {cols} x {rows} pixels of {size}")
    return np.frombuffer(values, PLAIN[size]).reshape(rows, cols).astype(np.int64)


def _packed(file: _Bytes, rows: int, cols: int) -> npt.NDArray[np.int64]:
    """Read compressed pixels; see the module."""
    table = np.frombuffer(file.take(file.whole()), np.uint8)
    values = np.frombuffer(file.take(file.whole()), np.uint8)
    file.take(4)  # bytes before compression
    if not rows * cols:
        return np.zeros((0, 0), np.int64)
    start, count = 4 * (cols + 1), rows * cols - cols - 1
    codes = (table[:, None] >> np.array([0, 2, 4, 6], np.uint8) & 3).ravel()[:count]
    widths = np.left_shift(1, codes, dtype=np.int64)
    if count < 0 or len(codes) < count or start + widths.sum() > len(values):
        file.refuse("it has fewer steps than pixels")
    if (codes == len(STEPS)).any():
        file.refuse("a step has none of 1, 2 and 4 bytes")
    first = values[:start].view("<i4").astype(np.int64)
    begins = start + np.cumsum(widths) - widths
    steps = np.empty(count + 1, np.int64)
    steps[0] = first[cols] - first[0]
    for code, kind in enumerate(STEPS):
        these = np.flatnonzero(codes == code)
        parts = values[begins[these][:, None] + np.arange(1 << code)]
        steps[1 + these] = np.ascontiguousarray(parts).view(kind).ravel()
    rises = np.cumsum(steps).reshape(rows - 1, cols)
    every = np.cumsum(np.concatenate([first[None, :cols], rises]), axis=0)
    return every.astype(np.int32).astype(np.int64)  # sums of the maker wrap, too


def _properties(file: _Bytes) -> dict[str, float | str]:
    """Read the properties behind an image."""
    found: dict[str, float | str] = {}
    count = file.whole()
    if not 0 <= count <= MOST_PROPERTIES:
        file.refuse(f"{count} properties are claimed")
    for _ in range(count):
        name = file.take(file.whole()).rstrip(b"\0").decode("utf-8", "replace")
        kind = file.whole()
        if kind == NUMBER:
            found[name] = float(file.whole())
        elif kind == DOUBLE:
            found[name] = float(struct.unpack("<d", file.take(8))[0])
        elif kind == TEXT:
            text = file.take(file.whole()).rstrip(b"\0")
            found[name] = text.decode("utf-8", "replace")
        elif kind in (DOUBLES, NUMBERS):
            values = file.take(file.whole())
            of = "<f8" if kind == DOUBLES else "<i4"
            whole = len(values) // np.dtype(of).itemsize * np.dtype(of).itemsize
            numbers = np.frombuffer(values[:whole], of)
            found[name] = " ".join(f"{one:g}" for one in numbers.tolist())
        else:
            file.refuse(
                f"its property {name[:40]} is of kind {kind}; allowed: 0 to 2, 4, 5"
            )
    return found
