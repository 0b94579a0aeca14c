"""What the numbers of an image file mean, whatever its format: one rule for each question.

A reader of a format takes samples and statements out of a file; the functions here make gray
values of them, row 0 on top and column 0 at the left, or refuse with the cause.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.dataset.provenance import Stated
from flexdt.twin.input_limits import LIMITS

MAX_IMAGE_BYTES: Final = LIMITS["tiff"].decoded_bytes
"""Largest image [bytes]; that of our largest detector has 6 MB."""
TOP_LEFT: Final = 1
"""Orientation of an image whose first row is on top, first column at the left."""
ORIENTATIONS: Final[Mapping[int, str]] = {
    1: "as stored",
    2: "left and right exchanged",
    3: "turned by 180 degrees",
    4: "upside down",
    5: "rows and columns exchanged",
    6: "turned by 90 degrees to the right",
    7: "rows and columns exchanged and turned by 180 degrees",
    8: "turned by 90 degrees to the left",
}
"""Orientation of TIFF (tag 274, also Exif's) -> how the stored image is to be shown."""


class UnreadImageError(Exception):
    """An image that is not read, and why: the end of a sentence that begins with its path."""


def quoted(text: str) -> str:
    """Return a file's text for a message: 40 characters, unprintable ones as ?."""
    kept = "".join(c if c.isprintable() else "?" for c in text.strip()[:40])
    return kept or "nothing"


@dataclass(frozen=True)
class ImageHead:
    """What a file says of its images before any pixel is read.

    Attributes:
        shape: (rows, cols) of each image, upright.
        dtype: of its gray values, in this machine's byte order.
        bits: of a sample in the file, 12 where two pixels share three bytes.
        images: number of images of this shape in the file.
        facts: statements of the file, in its order.
    """

    shape: tuple[int, int]
    dtype: np.dtype[Any]
    bits: int
    images: int = 1
    facts: tuple[Stated, ...] = ()

    def __post_init__(self) -> None:
        """Check the size of one image before memory is taken for it."""
        rows, cols = self.shape
        size = rows * cols * self.dtype.itemsize
        if rows < 1 or cols < 1:
            raise UnreadImageError(f"claims {cols} x {rows} pixels; allowed: 1 or more")
        if size > MAX_IMAGE_BYTES:
            raise UnreadImageError(
                f"claims {cols} x {rows} pixels, {size} bytes; allowed: {MAX_IMAGE_BYTES} bytes"
            )

    @property
    def counts(self) -> bool:
        """Whether every value that it can hold, negative ones aside, is a count of uint16."""
        return (self.dtype.kind == "u" and self.bits <= 16) or self.dtype.str[1:] in (
            "i1",
            "i2",
        )


def number_type(kind: str, bits: int) -> np.dtype[Any]:
    """Return the type of this machine that holds samples: u (unsigned), i or f, of some bits.

    Raises:
        UnreadImageError: there is none.
    """
    sizes = (16, 32, 64) if kind == "f" else (8, 16, 32, 64)
    fits = [size for size in sizes if bits == size or (kind == "u" and bits < size)]
    names = {"u": "unsigned integers", "i": "integers", "f": "floating-point numbers"}
    if not fits or bits < 1 or (kind == "u" and 32 < bits < 64):
        raise UnreadImageError(f"holds {names[kind]} of {bits} bits, which are not read")
    return np.dtype(f"{kind}{fits[0] // 8}")


def whole_bytes_order(kind: str, bits: int, order: str) -> np.dtype[Any]:
    """Return the type of samples of 8, 16, 32 or 64 bits as they are stored, < or > for their
    byte order."""
    return np.dtype(f"{order}{kind}{bits // 8}")


def unpacked(
    raw: npt.NDArray[np.uint8], per_row: int, bits: int, order: str
) -> npt.NDArray[Any]:
    """Unpack unsigned samples of any number of bits; each row begins with a byte.

    Samples of whole bytes are in the file's order, the others most significant bit first, as
    TIFF says.

    Args:
        raw: bytes (rows, bytes of a row).
        per_row: samples in a row.
        bits: of a sample, 1 to 32.
        order: < or >, of samples of whole bytes.

    Returns:
        (rows, per_row).
    """
    dtype = number_type("u", bits)
    if bits % 8 == 0:
        parts = raw[:, : per_row * bits // 8].reshape(len(raw), per_row, bits // 8)
        places = range(bits // 8) if order == "<" else range(bits // 8 - 1, -1, -1)
        out = np.zeros((len(raw), per_row), dtype)
        for byte, place in enumerate(places):
            out |= parts[..., byte].astype(dtype) << dtype.type(8 * place)
        return out
    digits = np.unpackbits(raw, axis=1, count=per_row * bits)
    digits = digits.reshape(len(raw), per_row, bits)
    out = np.zeros((len(raw), per_row), dtype)
    for bit in range(bits):
        out <<= dtype.type(1)
        out |= digits[..., bit]
    return out


def grey(samples: npt.NDArray[Any], colours: int, inverted: int = 0) -> npt.NDArray[Any]:
    """Make gray values of the samples of an image.

    Three colors are one gray value where they are equal in every pixel. A sample beyond the
    colors (opacity) is left out where it is the same in every pixel.

    Args:
        samples: (rows, cols, samples).
        colours: 1 or 3, of these the first.
        inverted: bits of unsigned samples of which 0 is white; 0: none.

    Returns:
        (rows, cols); white is the largest value.

    Raises:
        UnreadImageError: colors, or an opacity that changes from pixel to pixel.
    """
    for k in range(colours, samples.shape[2]):
        beyond = samples[..., k]
        if (beyond != beyond[0, 0]).any():
            raise UnreadImageError(
                f"has {samples.shape[2]} samples a pixel, and the one after the "
                f"{'grey value' if colours == 1 else 'colours'} changes from pixel to pixel; "
                "allowed: one that is the same everywhere, as an opaque image has"
            )
    values = samples[..., 0]
    if any((samples[..., k] != values).any() for k in range(1, colours)):
        raise UnreadImageError(
            "is in colour: red, green and blue differ; allowed: grey values"
        )
    if inverted:
        if values.dtype.kind != "u":
            raise UnreadImageError(
                f"says that 0 is white (MinIsWhite) of {values.dtype} values, which have no "
                "black; allowed: unsigned integers"
            )
        values = values.dtype.type(((1 << inverted) - 1) & (2**64 - 1)) - values
    return values


def upright(image: npt.NDArray[Any], orientation: int) -> npt.NDArray[Any]:
    """Turn an image as stored, (rows, cols), into the one to be shown.

    Args:
        image: whose first index is the stored row.
        orientation: of `ORIENTATIONS`.

    Returns:
        Contiguous array; that of exchanged rows and columns has the other shape.
    """
    turned = {
        1: lambda a: a,
        2: lambda a: a[:, ::-1],
        3: lambda a: a[::-1, ::-1],
        4: lambda a: a[::-1],
        5: lambda a: a.T,
        6: lambda a: a[::-1].T,
        7: lambda a: a[::-1, ::-1].T,
        8: lambda a: a[:, ::-1].T,
    }[orientation](image)
    return np.ascontiguousarray(turned)


def turns_sides(orientation: int) -> bool:
    """Return whether the image to be shown has the stored rows as its columns."""
    return orientation > 4


def identity_palette(colours: npt.NDArray[Any], top: int) -> bool:
    """Return whether a palette maps each value to the gray of that value.

    Args:
        colours: (entries, 3), of which `top` is white.
        top: largest component.
    """
    entries = len(colours)
    if entries < 2:
        return False
    # Some writers shift entries instead of scaling them: white is then 255 * 256.
    steps = (top / (entries - 1), (top + 1) / entries)
    ramps = [np.rint(np.arange(entries) * step).astype(np.int64) for step in steps]
    return any((np.abs(colours - ramp[:, None]) <= 0).all() for ramp in ramps)


NATIVE: Final = "<" if sys.byteorder == "little" else ">"
"""Byte order of this machine."""
