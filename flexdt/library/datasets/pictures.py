"""An image as a picture for people: windowed to 8 bit and encoded as PNG.

Percentiles of the image become black and white; values beyond them are clipped.
"""

from __future__ import annotations

import math
import struct
import zlib
from typing import Any, Final

import numpy as np
import numpy.typing as npt

PERCENTILES: Final = (0.5, 99.5)
"""Percentiles of an image that become black and white."""


MARKS: Final = (
    (1, (255, 48, 48), "red", "saturated"),
    (2, (48, 112, 255), "blue", "starved: hardly a count above dark"),
    (4, (255, 200, 0), "yellow", "edge at which the sample is cut off"),
)
"""Bits of a pixel's mark, each with its color (red, green, blue), the colour's name and
the mark's meaning."""
PNG_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
PNG_GREY = 0
PNG_COLOUR = 2
"""Colour types of a PNG: gray, and red, green and blue."""
PNG_FILTER_UP: Final = 2
"""Filter type of a row that holds differences from the row above."""
PNG_EFFORT: Final = 3
"""Of zlib, 0 to 9: more takes longer and saves a few per cent."""
BAND_DIVISOR: Final = 100
"""Marks on the edge are drawn 1 / BAND_DIVISOR of the picture wide, to be visible."""


def round_length(most: float) -> float:
    """Choose the greatest 1, 2 or 5 times a power of ten up to `most`, for a scale.

    Example:
        >>> round_length(37.0), round_length(0.7)
        (20.0, 0.5)"""
    power = 10.0 ** math.floor(math.log10(most))
    return next(step * power for step in (5.0, 2.0, 1.0) if step * power <= most)


def windowed(
    image: npt.NDArray[Any], like: npt.NDArray[Any] | None = None
) -> npt.NDArray[np.uint8]:
    """Convert an image to 8 bits, with the `PERCENTILES` of its finite values black and white.

    Args:
        image: any shape; NaN becomes black.
        like: image whose percentiles are taken instead.

    Returns uint8; all 0 where the percentiles are equal or no value is finite.
    """
    seen = image if like is None else like
    seen = seen[np.isfinite(seen)]
    low, high = np.percentile(seen, PERCENTILES) if seen.size else (0.0, 0.0)
    if high <= low:
        return np.zeros(image.shape, dtype=np.uint8)
    scaled = (np.nan_to_num(image.astype(np.float64), nan=low) - low) * (
        255.0 / (high - low)
    )
    return np.asarray(np.clip(np.rint(scaled), 0, 255), dtype=np.uint8)


def coloured(
    grey: npt.NDArray[np.uint8], marks: npt.NDArray[np.generic]
) -> npt.NDArray[np.uint8]:
    """Draw the marked pixels of a gray picture in color, (rows, cols, 3).

    Later `MARKS` (bits) lie over earlier ones; those of outermost pixels (bit 4) are a
    band.
    """
    picture = np.repeat(grey[:, :, None], 3, axis=2)
    values = np.asarray(marks, dtype=np.uint8)
    for bit, colour, *_ in MARKS:
        there = (values & bit) > 0
        if bit == 4:
            there = _inward(there)
        picture[there] = colour
    return picture


def _inward(edge: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Widen marks of the outermost pixels into the picture, to a band of 1 /
    `BAND_DIVISOR` of the longer side, at least 2 pixels; returns a copy.
    """
    wide = max(2, max(edge.shape) // BAND_DIVISOR)
    out = edge.copy()
    out[:wide] |= edge[0]
    out[-wide:] |= edge[-1]
    out[:, :wide] |= edge[:, :1]
    out[:, -wide:] |= edge[:, -1:]
    return out


def legend(marks: npt.NDArray[np.generic]) -> list[str]:
    """List the meanings of the colors that occur in a picture of marks, with their share
    of the pixels (but for the band at the edges); [] without marks.

    Args:
        marks: (rows, cols) of bits, see `MARKS`.
    """
    values = np.asarray(marks, dtype=np.uint8)
    lines = []
    for bit, _, name, meaning in MARKS:
        part = float(np.mean((values & bit) > 0))
        if part > 0:
            lines.append(
                f"{name}: {meaning}"
                + ("" if bit == 4 else f" ({part:.2%} of the pixels)")
            )
    return lines


def png(
    image: npt.NDArray[Any],
    *,
    dark_is_dense: bool = False,
    marks: npt.NDArray[np.generic] | None = None,
    like: npt.NDArray[Any] | None = None,
) -> bytes:
    """Encode an image (rows, cols) as PNG, with percentiles (of `like`) as black and
    white.

    `dark_is_dense`: the negative; `marks`: as `MARKS`; unless all are zero the picture is
    in color. Raises ValueError: no image, or no pixels.
    """
    if image.ndim != 2 or image.size == 0:
        raise ValueError(f"an image has rows and columns, got shape {image.shape}")
    shown = windowed(image, like)
    if dark_is_dense:
        shown = 255 - shown
    if marks is not None and np.any(marks):
        shown = coloured(shown, marks)
    return png_of(shown)


def png_of(pixels: npt.NDArray[np.uint8]) -> bytes:
    """Encode 8-bit pixels as PNG, without loss.

    Args:
        pixels: (rows, cols) gray, or (rows, cols, 3) red first.

    Source:
        ISO/IEC 15948: chunks IHDR, IDAT, IEND; each row is stored as its difference from
        the row above (filter type 2), which deflates well.
    """
    rows, cols = pixels.shape[:2]
    colours = PNG_COLOUR if pixels.ndim == 3 else PNG_GREY
    flat = np.ascontiguousarray(pixels).reshape(rows, -1)
    lines = np.empty((rows, flat.shape[1] + 1), np.uint8)
    lines[:, 0] = PNG_FILTER_UP
    lines[0, 1:] = flat[0]
    np.subtract(flat[1:], flat[:-1], out=lines[1:, 1:])
    head = struct.pack(">IIBBBBB", cols, rows, 8, colours, 0, 0, 0)
    body = zlib.compress(lines.tobytes(), PNG_EFFORT)
    chunks = (b"IHDR", head), (b"IDAT", body), (b"IEND", b"")
    return PNG_SIGNATURE + b"".join(_chunk(*chunk) for chunk in chunks)


def _chunk(name: bytes, content: bytes) -> bytes:
    """Write a chunk of a PNG: length, name, content, checksum."""
    named = name + content
    return struct.pack(">I", len(content)) + named + struct.pack(">I", zlib.crc32(named))
