"""Images as TIFF bytes, and names for the folders they go to."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from datetime import datetime

import numpy as np
import numpy.typing as npt

from flexdt.runtime.files.directory import Directory
from flexdt.twin.dataset.file_names import plain_name


def tiff_bytes(image: npt.NDArray[np.uint16]) -> bytes:
    """One uint16 image (rows, cols) as a baseline TIFF: little-endian, one strip, no metadata.

    The pixels begin at byte 8 and the tags follow them, as the scanner writes its files: some of
    its readers look for pixels there without reading the tags.
    """
    rows, cols = image.shape
    pixels = image.astype("<u2", copy=False).tobytes()
    at = 8 + len(pixels)
    software = b"flexdt\0\0"
    short, long, rational, text = 3, 4, 5, 2
    tags = (
        (256, long, 1, cols),
        (257, long, 1, rows),
        (258, short, 1, 16),  # bits
        (259, short, 1, 1),  # not compressed
        (262, short, 1, 1),  # black is zero
        (273, long, 1, 8),  # where the pixels begin
        (277, short, 1, 1),  # one sample a pixel
        (278, long, 1, rows),  # in one strip
        (279, long, 1, len(pixels)),
        (282, rational, 1, at + len(software)),
        (283, rational, 1, at + len(software)),
        (296, short, 1, 1),  # no unit
        (305, text, 7, at),
    )
    entries = b"".join(struct.pack("<HHII", *tag) for tag in tags)
    beside = software + struct.pack("<II", 1, 1)
    head = struct.pack("<2sHI", b"II", 42, at + len(beside))
    return b"".join((head, pixels, beside, struct.pack("<H", len(tags)), entries, bytes(4)))


def free_name(root: Directory, wish: str) -> str:
    """`wish`, or `wish-2`, `wish-3`... whichever nothing in `root` has yet.

    Raises:
        DatasetNameError: `wish` is not plain.
    """
    plain_name(wish, "data set")
    candidates: Iterable[str] = (wish if n == 1 else f"{wish}-{n}" for n in range(1, 1_000_000))
    return next(n for n in candidates if root.stat(n) is None)


def dated_name(moment: datetime, number: int = 1) -> str:
    """A name as the scanner gives them: 201106_001."""
    return f"{moment:%y%m%d}_{number:03d}"
