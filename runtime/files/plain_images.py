"""Read images of simple formats: PNG, BMP, EDF, MetaImage, NRRD, NumPy.

Each reader takes a header apart and says where the numbers are; `image_meaning` decides what
they mean. All but PNG's pixels are read without a library.
"""

from __future__ import annotations

import ast
import math
import os
import re
import struct
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
import numpy.typing as npt

from flexdt.runtime.files.image_meaning import (
    ImageHead,
    UnreadImageError,
    grey,
    identity_palette,
    quoted,
)
from flexdt.runtime.files.reading_within import opened
from flexdt.twin.dataset.provenance import Stated, Use

MAX_HEADER_BYTES: Final = 1 << 20
"""Of a header of text."""
SHORT: Final = "has fewer bytes than its header says: {held} of {needed}"


@dataclass(frozen=True)
class Stack:
    """Images that lie one behind the other as plain numbers.

    Attributes:
        head: of the file; its type is that of this machine.
        path: of the file with the numbers.
        offset: of the first number [bytes].
        stored: type of the numbers as stored.
        unpack: from the file and its bytes, of compressed ones; None for none.
        column_first: the numbers of a column are neighbors, as in Fortran's order.
        between: bytes between two images.
    """

    head: ImageHead
    path: Path
    offset: int
    stored: np.dtype[Any]
    unpack: Callable[[bytes, int], bytes] | None = None
    column_first: bool = False
    between: int = 0

    def read(self, image: int) -> npt.NDArray[Any]:
        """Read an image, (rows, cols) in this machine's byte order.

        Raises:
            UnreadImageError: there is no such image, or the file ends before it.
        """
        images, (rows, cols) = self.head.images, self.head.shape
        if not 0 <= image < images:
            raise UnreadImageError(f"holds {images} images; asked for number {image + 1}")
        size = rows * cols * self.stored.itemsize
        with opened(self.path) as file:
            if self.unpack is not None or self.column_first:
                file.seek(self.offset)
                raw = file.read()
                if self.unpack is not None:
                    raw = self.unpack(raw, size * images)
                if self.column_first and len(raw) >= size * images:
                    every = np.frombuffer(raw, self.stored, rows * cols * images)
                    found = every.reshape(cols, rows, images)[:, :, image].T
                    return found.astype(self.head.dtype)
                raw = raw[image * size : (image + 1) * size]
            else:
                file.seek(self.offset + image * (size + self.between))
                raw = file.read(size)
        if len(raw) < size:
            held = os.stat(self.path).st_size
            raise UnreadImageError(
                SHORT.format(held=held, needed=f"{self.offset} + {size * images}")
            )
        values = np.frombuffer(raw, self.stored, rows * cols).reshape(rows, cols)
        return values.astype(self.head.dtype)


def _native(stored: np.dtype[Any]) -> np.dtype[Any]:
    return stored.newbyteorder("=")


def _head_of(shape: tuple[int, ...], stored: np.dtype[Any], facts: Any = ()) -> ImageHead:
    """Make the head of (rows, cols) or (images, rows, cols).

    Raises:
        UnreadImageError: other dimensions, or numbers that are not real.
    """
    kept = shape[1:] if len(shape) == 4 and shape[0] == 1 else shape
    if len(kept) not in (2, 3) or min(kept, default=0) < 1:
        raise UnreadImageError(
            f"holds numbers of shape {tuple(shape)}; allowed: (rows, columns) or "
            "(images, rows, columns)"
        )
    if stored.kind not in "uif":
        raise UnreadImageError(f"holds {stored}; allowed: real numbers")
    images = kept[0] if len(kept) == 3 else 1
    bits = 8 * stored.itemsize
    return ImageHead(
        (int(kept[-2]), int(kept[-1])), _native(stored), bits, int(images), tuple(facts)
    )


def _text(file: BinaryIO, end: bytes, most: int = MAX_HEADER_BYTES) -> tuple[str, int]:
    """Read a header of text up to its end; the text and the offset behind it.

    Raises UnreadImageError: no such end.
    """
    head, mark, _ = file.read(most).partition(end)
    if not mark:
        raise UnreadImageError("has a header without an end")
    return head.decode("latin-1"), len(head) + len(end)


def _whole(text: str, field: str, least: int = 1) -> int:
    """Return a whole number of a header; raises UnreadImageError for another text."""
    if not re.fullmatch(r"\s*[+-]?\d{1,15}\s*", text) or int(text) < least:
        raise UnreadImageError(
            f"has {field} = {quoted(text)}; allowed: a whole number, {least} or more"
        )
    return int(text)


EDF_TYPES: Final[Mapping[str, str]] = {
    "signedbyte": "i1", "signed8": "i1", "unsignedbyte": "u1", "unsigned8": "u1",
    "signedshort": "i2", "signed16": "i2", "unsignedshort": "u2", "unsigned16": "u2",
    "unsignedshortinteger": "u2", "signedinteger": "i4", "signed32": "i4",
    "unsignedinteger": "u4", "unsigned32": "u4", "signedlong": "i4", "unsignedlong": "u4",
    "signed64": "i8", "unsigned64": "u8", "float": "f4", "floatvalue": "f4",
    "float32": "f4", "floatieee32": "f4", "double": "f8", "doublevalue": "f8",
    "float64": "f8", "floatieee64": "f8", "doubleieee64": "f8",
}  # fmt: skip
"""DataType of ESRF's data format, in lower case -> numpy's; after fabio's table."""
EDF_ORDERS: Final[Mapping[str, str]] = {"lowbytefirst": "<", "highbytefirst": ">"}


def edf_image(path: Path) -> Stack:
    """Read the header of ESRF's data format; further images behind the first have the same
    header length and size.

    Raises:
        UnreadImageError: no such header, or numbers of a kind that is not read.
    """
    with opened(path) as file:
        text, begin = _text(file, b"}\n")
        size = os.fstat(file.fileno()).st_size
    fields = {}
    for line in text.lstrip("{\r\n\t ").split(";"):
        key, equals, value = line.partition("=")
        if equals:
            fields[key.strip().lower()] = value.strip()
    kind = fields.get("datatype", "")
    if kind.lower() not in EDF_TYPES:
        raise UnreadImageError(f"has DataType = {quoted(kind)}, which is not known")
    order = fields.get("byteorder", "LowByteFirst")
    if order.lower() not in EDF_ORDERS:
        raise UnreadImageError(
            f"has ByteOrder = {quoted(order)}; allowed: LowByteFirst, HighByteFirst"
        )
    if (packing := fields.get("compression", "none").lower()) not in ("none", ""):
        raise UnreadImageError(f"is compressed by {quoted(packing)}, which is not undone")
    if (raster := fields.get("rasterconfiguration", "1")) not in ("1", ""):
        raise UnreadImageError(f"has RasterConfiguration = {quoted(raster)}; allowed: 1")
    stored = np.dtype(EDF_ORDERS[order.lower()] + EDF_TYPES[kind.lower()])
    dims = [_whole(fields.get(f"dim_{k}", "1"), f"Dim_{k}") for k in (3, 2, 1)]
    said = _whole(fields["size"], "Size", 0) if fields.get("size") else None
    needed = math.prod(dims) * stored.itemsize
    if said is not None and said != needed:
        raise UnreadImageError(f"has Size = {said}, and {needed} bytes by its dimensions")
    known = {"datatype", "byteorder", "dim_1", "dim_2", "dim_3", "size", "compression"}
    facts = _facts(fields, known | {"rasterconfiguration", "headerid", "image"})
    step = begin + needed
    images = max((size + begin - 1) // step, 1) if dims[0] == 1 else 1
    if images > 1:
        _require_headers(path, step, images)
    if size < images * step or size > images * step + 1:
        raise UnreadImageError(SHORT.format(held=size, needed=images * step))
    shape = (images, *dims[1:]) if images > 1 else tuple(dims)
    head = _head_of(shape if shape[0] > 1 else shape[1:], stored, facts)
    return Stack(head, path, begin, stored, between=begin if images > 1 else 0)


def _require_headers(path: Path, step: int, images: int) -> None:
    """Check that a header begins at every `step` bytes of a file of several EDF images.

    Raises:
        UnreadImageError: it does not.
    """
    with opened(path) as file:
        for image in range(images):
            file.seek(image * step)
            if file.read(1) != b"{":
                raise UnreadImageError(
                    f"holds images of several sizes, or {image} images and other bytes"
                )


def _facts(fields: Mapping[str, str], known: Any) -> list[Stated]:
    """List what a header of text says, and whether it was used."""
    return [
        Stated(key, quoted(value), Use.USED, "where pixels are")
        if key in known
        else Stated(key, quoted(value), Use.IGNORED, "not known to change pixels")
        for key, value in fields.items()
    ]


META_TYPES: Final[Mapping[str, str]] = {
    "MET_CHAR": "i1", "MET_UCHAR": "u1", "MET_SHORT": "i2", "MET_USHORT": "u2",
    "MET_INT": "i4", "MET_UINT": "u4", "MET_LONG": "i4", "MET_ULONG": "u4",
    "MET_LONG_LONG": "i8", "MET_ULONG_LONG": "u8", "MET_FLOAT": "f4", "MET_DOUBLE": "f8",
}  # fmt: skip
"""ElementType of MetaImage -> numpy's type."""
META_KNOWN: Final = frozenset(
    ("ObjectType", "NDims", "DimSize", "ElementType", "ElementDataFile", "BinaryData")
    + ("BinaryDataByteOrderMSB", "ElementByteOrderMSB", "CompressedData")
    + ("CompressedDataSize", "HeaderSize", "ElementNumberOfChannels")
)


def meta_image(path: Path) -> Stack:
    """Read the header of a MetaImage, .mha or .mhd with its numbers in another file.

    Rows go from the first on down, images one behind the other, as RTK writes projections.

    Raises:
        UnreadImageError: no such header, or numbers of a kind that is not read.
    """
    with opened(path) as file:
        raw = file.read(MAX_HEADER_BYTES)
    found = re.search(
        rb"^ElementDataFile[ \t]*=[ \t]*([^\r\n]*)\r?\n?", raw, re.MULTILINE
    )
    if found is None:
        raise UnreadImageError("has no ElementDataFile: no MetaImage, or a damaged one")
    lines = raw[: found.end()].decode("latin-1").splitlines()
    parts = (line.partition("=") for line in lines)
    fields = {key.strip(): value.strip() for key, _, value in parts}
    kind = fields.get("ElementType", "")
    if kind not in META_TYPES:
        raise UnreadImageError(f"has ElementType = {quoted(kind)}, which is not read")
    if fields.get("ElementNumberOfChannels", "1") != "1":
        many = quoted(fields["ElementNumberOfChannels"])
        raise UnreadImageError(f"has {many} channels a pixel; allowed: 1")
    if fields.get("BinaryData", "True").lower() != "true":
        raise UnreadImageError("holds its numbers as text, which is not read")
    order = fields.get(
        "BinaryDataByteOrderMSB", fields.get("ElementByteOrderMSB", "False")
    )
    stored = np.dtype((">" if order.lower() == "true" else "<") + META_TYPES[kind])
    sizes = [_whole(n, "DimSize") for n in fields.get("DimSize", "").split()]
    if len(sizes) != _whole(fields.get("NDims", str(len(sizes))), "NDims"):
        raise UnreadImageError(
            f"has NDims = {quoted(fields['NDims'])} and {len(sizes)} sizes"
        )
    head = _head_of(tuple(reversed(sizes)), stored, _facts(fields, META_KNOWN))
    packed = fields.get("CompressedData", "False").lower() == "true"
    at = found[1].decode("latin-1").strip()
    data, begin = (path, found.end()) if at.upper() == "LOCAL" else (_beside(path, at), 0)
    skip = _whole(fields.get("HeaderSize", "0"), "HeaderSize", -1)
    if skip == -1:
        begin = _size(data) - math.prod(sizes) * stored.itemsize
    elif data != path:
        begin = skip
    return Stack(_fitting(head, data, begin, stored, packed), data, max(begin, 0), stored,
                 _inflated if packed else None)  # fmt: skip


def _inflated(raw: bytes, most: int) -> bytes:
    """Inflate all numbers of a file, at most `most` bytes."""
    try:
        out = zlib.decompressobj(zlib.MAX_WBITS | 32).decompress(raw, most + 1)
    except zlib.error:
        raise UnreadImageError("its compressed numbers are cut off or damaged") from None
    if len(out) > most:
        raise UnreadImageError(f"inflates to more than its {most} bytes of pixels")
    return out


def _size(path: Path) -> int:
    """Return the size of a file of numbers beside its header.

    Raises:
        UnreadImageError: it is not there.
    """
    try:
        with opened(path) as file:
            return os.fstat(file.fileno()).st_size
    except OSError:
        raise UnreadImageError(
            f"has its numbers in {quoted(path.name)}, which is not there"
        ) from None


def _beside(path: Path, name: str) -> Path:
    """Return the path of a file of numbers that a header names.

    Raises:
        UnreadImageError: it is not in the same folder, or several are named.
    """
    if not name or name == "LIST" or "%" in name:
        raise UnreadImageError("has its numbers in several files; allowed: one")
    if "/" in name or "\\" in name or name in (".", ".."):
        raise UnreadImageError(
            f"has its numbers in {quoted(name)}; allowed: a file beside it"
        )
    return path.with_name(name)


def _fitting(
    head: ImageHead, data: Path, begin: int, stored: np.dtype[Any], packed: bool
) -> ImageHead:
    """Return the head if a file holds the numbers that it says; of compressed ones nothing is
    known yet.

    Raises:
        UnreadImageError: it is too short.
    """
    held = _size(data)
    rows, cols = head.shape
    needed = head.images * rows * cols * stored.itemsize
    if not packed and (begin < 0 or held < begin + needed):
        raise UnreadImageError(
            SHORT.format(held=held, needed=f"{max(begin, 0)} + {needed}")
        )
    return head


NRRD_TYPES: Final[Mapping[str, str]] = {
    **dict.fromkeys(("signed char", "int8", "int8_t"), "i1"),
    **dict.fromkeys(("uchar", "unsigned char", "uint8", "uint8_t"), "u1"),
    **dict.fromkeys(("short", "short int", "signed short", "int16", "int16_t"), "i2"),
    **dict.fromkeys(("ushort", "unsigned short", "uint16", "uint16_t"), "u2"),
    **dict.fromkeys(("int", "signed int", "int32", "int32_t"), "i4"),
    **dict.fromkeys(("uint", "unsigned int", "uint32", "uint32_t"), "u4"),
    **dict.fromkeys(("longlong", "long long", "int64", "int64_t"), "i8"),
    **dict.fromkeys(("ulonglong", "unsigned long long", "uint64", "uint64_t"), "u8"),
    "float": "f4",
    "double": "f8",
}
"""type of NRRD -> numpy's."""
NRRD_KNOWN: Final = frozenset(
    (
        "type",
        "dimension",
        "sizes",
        "encoding",
        "endian",
        "data file",
        "datafile",
        "byte skip",
    )
)


def nrrd_image(path: Path) -> Stack:
    """Read the header of an NRRD file, .nrrd or .nhdr with its numbers in another file.

    Raises:
        UnreadImageError: no such header, or numbers of a kind that is not read.
    """
    with opened(path) as file:
        raw = file.read(MAX_HEADER_BYTES)
    found = re.search(rb"\r?\n\r?\n", raw)
    text = raw[: found.start()] if found else raw
    fields = {}
    for line in text.decode("latin-1").splitlines()[1:]:
        key, colon, value = line.partition(":")
        if colon and not line.startswith("#"):
            fields[key.strip().lower()] = value.lstrip("=").strip()
    kind = fields.get("type", "")
    if kind not in NRRD_TYPES:
        raise UnreadImageError(f"has type: {quoted(kind)}, which is not read")
    encoding = fields.get("encoding", "")
    if encoding not in ("raw", "gzip", "gz"):
        raise UnreadImageError(f"has encoding: {quoted(encoding)}; allowed: raw, gzip")
    if "line skip" in fields and fields["line skip"] != "0":
        raise UnreadImageError("has a line skip, which is not read")
    stored = np.dtype((">" if fields.get("endian") == "big" else "<") + NRRD_TYPES[kind])
    sizes = [_whole(n, "sizes") for n in fields.get("sizes", "").split()]
    head = _head_of(tuple(reversed(sizes)), stored, _facts(fields, NRRD_KNOWN))
    at = fields.get("data file", fields.get("datafile"))
    if at is None and found is None:
        raise UnreadImageError("has a header without an end")
    data = path if at is None else _beside(path, at)
    begin = found.end() if at is None and found is not None else 0
    skip = _whole(fields.get("byte skip", "0"), "byte skip", -1)
    packed = encoding != "raw"
    if skip == -1:
        begin = _size(data) - math.prod(sizes) * stored.itemsize
    elif not packed:
        begin += skip
    return Stack(_fitting(head, data, begin, stored, packed), data, max(begin, 0), stored,
                 _inflated if packed else None)  # fmt: skip


def numpy_image(path: Path) -> Stack:
    """Read the header of a NumPy array, .npy; objects in it are never loaded.

    Raises:
        UnreadImageError: no such header, or numbers of a kind that is not read.
    """
    with opened(path) as file:
        start = file.read(12)
        wide = 2 if start[6:7] == b"\x01" else 4
        long = int.from_bytes(start[8 : 8 + wide], "little")
        if len(start) < 12 or long > MAX_HEADER_BYTES:
            raise UnreadImageError("is no NumPy array, or a damaged one")
        file.seek(8 + wide)
        text = file.read(long).decode("latin-1")
    try:
        said = ast.literal_eval(text.strip())
        stored, shape = np.dtype(said["descr"]), tuple(said["shape"])
        fortran = bool(said["fortran_order"])
    except (ValueError, SyntaxError, TypeError, KeyError, MemoryError, RecursionError):
        raise UnreadImageError("is no NumPy array, or a damaged one") from None
    if stored.hasobject:
        raise UnreadImageError("holds Python objects; allowed: an array of numbers")
    if not all(isinstance(n, int) and n >= 0 for n in shape):
        raise UnreadImageError("is no NumPy array, or a damaged one")
    head = _head_of(shape, stored)
    begin = 8 + wide + long
    _fitting(head, path, begin, stored, packed=False)
    return Stack(head, path, begin, stored, column_first=fortran)


def png_head(file: BinaryIO) -> tuple[ImageHead, int]:
    """Read the header of a PNG image: its head, and the number of its colors.

    Raises:
        UnreadImageError: no such header, colors from a table that is no gray ramp, or fewer
            than 8 bits.
    """
    raw = file.read(33)
    if len(raw) < 33 or raw[12:16] != b"IHDR":
        raise UnreadImageError("is no PNG image, or a damaged one")
    cols, rows, bits, kind = struct.unpack(">IIBB", raw[16:26])
    if bits not in (8, 16) or kind not in (0, 2, 3, 4, 6):
        raise UnreadImageError(f"has samples of {bits} bits; allowed: 8, 16")
    facts = []
    while True:
        start = file.read(8)
        if len(start) < 8 or start[4:] in (b"IDAT", b"IEND"):
            break
        long = int.from_bytes(start[:4], "big")
        body = file.read(min(long, 1 << 16))
        file.seek(max(long - len(body), 0) + 4, os.SEEK_CUR)
        name = start[4:].decode("latin-1")
        if name == "PLTE":
            table = np.frombuffer(body[: len(body) // 3 * 3], np.uint8).reshape(-1, 3)
            if kind == 3 and not identity_palette(table.astype(int), 255):
                raise UnreadImageError(
                    "takes its values from a table of colours (palette); allowed: grey values"
                )
        elif name == "tRNS" and kind == 3:
            raise UnreadImageError("has transparent colours; allowed: grey values")
        facts.append(
            Stated(name, f"{long} bytes", Use.IGNORED, "not known to change pixels")
        )
    head = ImageHead((rows, cols), np.dtype(f"u{bits // 8}"), bits, facts=tuple(facts))
    return head, 3 if kind in (2, 3, 6) else 1


def read_png(file: BinaryIO) -> tuple[npt.NDArray[Any], ImageHead]:
    """Read a PNG image, gray values (rows, cols), and its head.

    Raises:
        UnreadImageError: it is damaged or in color, or imagecodecs is not installed.
    """
    head, colours = png_head(file)
    try:
        import imagecodecs
    except ImportError:
        raise UnreadImageError(
            "is a PNG image, which needs imagecodecs: pip install 'flexdt[io]'"
        ) from None
    file.seek(0)
    try:
        values = np.asarray(imagecodecs.png_decode(file.read()))
    except Exception:
        raise UnreadImageError("is a damaged PNG image") from None
    rows, cols = head.shape
    samples = values.reshape(rows, cols, -1)
    return grey(samples, min(colours, samples.shape[2])), head


def read_bmp(file: BinaryIO) -> tuple[npt.NDArray[Any], ImageHead]:
    """Read an image of Windows (BMP), gray values (rows, cols), and its head.

    Raises:
        UnreadImageError: it is damaged, compressed or in color.
    """
    raw = file.read(54)
    if len(raw) < 54:
        raise UnreadImageError("is no BMP image, or a damaged one")
    begin, header, cols, rows, _, bits, packing, _, _, _, used, _ = struct.unpack(
        "<10xIIiiHHIIiiII", raw
    )
    if header < 40 or packing != 0 or bits not in (8, 24, 32):
        raise UnreadImageError(
            f"has {bits} bits a pixel and compression {packing}; allowed: 8, 24 or 32, none"
        )
    head = ImageHead((abs(rows), cols), np.dtype("u1"), 8)
    line = (cols * bits // 8 + 3) // 4 * 4
    if bits == 8:
        file.seek(14 + header)
        many = min(used or 256, 256)
        table = np.frombuffer(file.read(4 * many).ljust(4 * many, b"\0"), np.uint8)
        if not identity_palette(table.reshape(-1, 4)[:, :3].astype(int), many - 1):
            raise UnreadImageError(
                "takes its values from a table of colours (palette); allowed: grey values"
            )
    file.seek(begin)
    pixels = file.read(line * abs(rows))
    if len(pixels) < line * abs(rows):
        raise UnreadImageError(
            f"has fewer bytes than its header says: {len(pixels)} of {line * abs(rows)}"
        )
    lines = np.frombuffer(pixels, np.uint8).reshape(abs(rows), line)
    if rows > 0:  # stored from the lowest row up
        lines = lines[::-1]
    samples = lines[:, : cols * bits // 8].reshape(abs(rows), cols, bits // 8)[..., :3]
    return np.ascontiguousarray(grey(samples, 3 if bits > 8 else 1)), head
