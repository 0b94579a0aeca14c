"""The quick way to a plain TIFF: one uncompressed uint16 image whose pixels lie in one piece.

That is what the scanner and the twin write, and decoding it is one read; a general decoder spends
longer on the tags. Whatever else a file is, even slightly, the answer is None and the general
decoder has to be asked. It refuses to report errors.
"""

from __future__ import annotations

import struct
from os import PathLike
from typing import Final

import numpy as np
import numpy.typing as npt

COLS: Final = 256
ROWS: Final = 257
BITS: Final = 258
COMPRESSION: Final = 259
PHOTOMETRIC: Final = 262
OFFSETS: Final = 273
SAMPLES: Final = 277
LENGTHS: Final = 279
PREDICTOR: Final = 317
TILES: Final = 322
KIND: Final = 339
_CODE: Final = {3: ("H", 2), 4: ("I", 4)}
"""struct code and bytes of the tag types SHORT and LONG."""


def read_plain(path: str | PathLike[str]) -> npt.NDArray[np.uint16] | None:
    """Pixels of a plain TIFF, (rows, cols), or None if the file is not that plain."""
    try:
        with open(path, "rb") as file:
            data = file.read()
    except OSError:
        return None
    try:
        return _pixels(data)
    except (struct.error, ValueError, IndexError, KeyError):
        return None


def _pixels(data: bytes) -> npt.NDArray[np.uint16] | None:
    order = {b"II": "<", b"MM": ">"}.get(data[:2])
    if order is None or struct.unpack_from(order + "H", data, 2)[0] != 42:
        return None
    (start,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + "H", data, start)
    if struct.unpack_from(order + "I", data, start + 2 + 12 * count)[0] != 0:
        return None  # more than one image
    tags: dict[int, tuple[int, ...]] = {}
    for i in range(count):
        at = start + 2 + 12 * i
        tag, kind, number = struct.unpack_from(order + "HHI", data, at)
        if kind not in _CODE or number > len(data):
            continue
        code, size = _CODE[kind]
        place = at + 8 if size * number <= 4 else struct.unpack_from(order + "I", data, at + 8)[0]
        if tag in (OFFSETS, LENGTHS) or number == 1:
            tags[tag] = struct.unpack_from(f"{order}{number}{code}", data, place)
    plain = (
        tags[BITS] == (16,)
        and tags.get(COMPRESSION, (1,)) == (1,)
        and tags.get(SAMPLES, (1,)) == (1,)
        and tags.get(KIND, (1,)) == (1,)
        and tags.get(PREDICTOR, (1,)) == (1,)
        and tags.get(PHOTOMETRIC, (1,)) == (1,)
        and TILES not in tags
    )
    rows, cols = tags[ROWS][0], tags[COLS][0]
    offsets, lengths = tags[OFFSETS], tags[LENGTHS]
    together = all(
        a + n == b for a, n, b in zip(offsets[:-1], lengths[:-1], offsets[1:], strict=True)
    )
    size = 2 * rows * cols
    if not plain or not together or sum(lengths) != size or offsets[0] + size > len(data):
        return None
    image = np.frombuffer(data, dtype=order + "u2", count=rows * cols, offset=offsets[0])
    return image.reshape(rows, cols).astype(np.uint16, copy=False)
