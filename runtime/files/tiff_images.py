"""Read TIFF: any packing, byte order, strips or tiles, and any compression, by the same rules.

tifffile finds the pages of a file and their tags, imagecodecs undoes compressions. What the
numbers mean is decided here and in `image_meaning`, after the bytes are whole again, so that
no compression has a rule of its own.
"""

from __future__ import annotations

import errno
import logging
import lzma
import math
import os
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, BinaryIO, Final

import numpy as np
import numpy.typing as npt

from flexdt.runtime.files.image_meaning import (
    NATIVE,
    ORIENTATIONS,
    TOP_LEFT,
    ImageHead,
    UnreadImageError,
    grey,
    identity_palette,
    number_type,
    turns_sides,
    unpacked,
    upright,
    whole_bytes_order,
)
from flexdt.twin.dataset.provenance import Stated, Use
from flexdt.twin.input_limits import InputLimitError, require_strips

# Our error has the reason of a damaged file; tifffile's log is for callers that set up logging.
logging.getLogger("tifffile").addHandler(logging.NullHandler())

MAGICS: Final = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
"""First bytes of TIFF and BigTIFF, in both byte orders."""
CUT_OFF: Final = "its pixels are cut off or damaged"
LAYOUT_TAGS: Final = frozenset(
    (254, 256, 257, 258, 259, 262, 266, 273, 274, 277, 278, 279, 284)
    + (317, 320, 322, 323, 324, 325, 338, 339, 347)
)
"""Tags whose values decide where pixels are and what they mean."""
DESCRIPTION_TAGS: Final = frozenset((270, 271, 272, 305, 306, 315, 316, 33432))
KINDS: Final[Mapping[int, str]] = {1: "u", 2: "i", 3: "f", 4: "u"}
"""SampleFormat -> kind of numbers; 4 is "undefined", which writers of unsigned ones put."""
REDUCED: Final = 1
"""Bit of NewSubfileType: a smaller copy of another page."""
MASK: Final = 4
"""Bit of NewSubfileType: a mask of another page."""
DESCRIPTION: Final = 270
SHAPE_WORDS: Final = 50839
"""ImageJ's own tag."""
WHITE_IS_ZERO: Final = 0
RGB: Final = 2
PALETTE: Final = 3
WITHOUT_PREDICTOR: Final = (1, 32773)
"""Compressions (none, PackBits) with which predictors are not defined."""
PHOTOMETRICS: Final[Mapping[int, str]] = {
    4: "a mask", 5: "CMYK", 6: "YCbCr", 8: "CIELab", 9: "ICCLab", 10: "ITULab",
    32803: "a colour filter array", 32844: "LogL", 32845: "LogLuv", 51177: "a depth map",
}  # fmt: skip
"""Photometric interpretations that are no gray values -> their names."""
MAX_KNOWN: Final = 16
"""Layouts of plain files that are remembered."""


@dataclass(frozen=True)
class Plain:
    """Where the pixels of an uncompressed image are, for files with the same tags.

    Attributes:
        parts: (offset, bytes) of header and tags, which another file must have as well.
        offset: of the pixels, in one piece.
        stored: their type, with its byte order.
        head: of the file.
    """

    parts: tuple[tuple[int, bytes], ...]
    offset: int
    stored: np.dtype[Any]
    head: ImageHead


_plain: dict[int, Plain] = {}
"""Size of a file -> the layout of the plain file of that size that was read last."""


def tiff_head(file: BinaryIO) -> ImageHead:
    """Read what a TIFF file says of its images.

    Raises UnreadImageError: no TIFF, or one whose images are not read.
    """
    import tifffile

    with _tidied(), tifffile.TiffFile(file, _multifile=False) as tiff:
        pages = _pages(tiff)
        return replace(_head(tiff, pages), facts=tuple(_facts(pages[0])))


def read_tiff(file: BinaryIO, image: int) -> tuple[npt.NDArray[Any], ImageHead]:
    """Read an image of a TIFF file.

    A file with the same size, header and tags as one that was read before is not parsed
    again.

    Args:
        file: open at its beginning.
        image: index of the image, 0 for the first.

    Returns:
        Gray values (rows, cols) in this machine's byte order, and the head of the file.

    Raises:
        UnreadImageError: no TIFF, or one whose images are not read.
    """
    size = os.fstat(file.fileno()).st_size
    known = _plain.get(size)
    if known is not None and image == 0:
        values = _read_like(file, size, known)
        if values is not None:
            return values, known.head
        file.seek(0)
    import tifffile

    with _tidied(), tifffile.TiffFile(file, _multifile=False) as tiff:
        pages = _pages(tiff)
        head = _head(tiff, pages)
        if not 0 <= image < head.images:
            raise UnreadImageError(
                f"holds {head.images} image{'s' if head.images > 1 else ''}; asked for "
                f"number {image + 1}"
            )
        many = _contiguous_images(tiff, pages)
        if many > 1:
            return _turned(_contiguous(file, pages[0], image), pages[0]), head
        page = pages[image]
        samples = _samples(file, tiff, page)
        values = _turned(_grey(page, samples), page)
        if values.shape != head.shape or values.dtype != head.dtype:
            first = f"{head.shape[1]} x {head.shape[0]} of {head.dtype}"
            raise UnreadImageError(
                f"image {image + 1} has {values.shape[1]} x {values.shape[0]} pixels of "
                f"{values.dtype}, the first {first}"
            )
        if image == 0:
            _remember(file, size, tiff, page, head)
        return values, head


def read_tiff_rows(
    file: BinaryIO, shape: tuple[int, int], rows: npt.NDArray[np.intp]
) -> npt.NDArray[Any] | None:
    """Read rows of a plain TIFF of a shape with the tags of one that was read before,
    (rows, cols).

    Returns:
        None for any other file; nothing of it is decoded.
    """
    known = _plain.get(os.fstat(file.fileno()).st_size)
    if known is None or known.head.shape != shape:
        return None
    for at, part in known.parts:
        file.seek(at)
        if file.read(len(part)) != part:
            return None
    cols = known.head.shape[1]
    size = cols * known.stored.itemsize
    out = np.empty((len(rows), cols), known.head.dtype)
    for k, row in enumerate(rows):
        file.seek(known.offset + int(row) * size)
        out[k] = np.frombuffer(file.read(size), known.stored)
    return out


class _tidied:  # noqa: N801
    """Turn any error of tifffile's or a codec's parser into ours, without its words."""

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        if error is None or isinstance(error, UnreadImageError | MemoryError):
            return
        if isinstance(error, OSError) and error.errno != errno.EINVAL:
            return  # no place in the file, but the disk
        if isinstance(error, Exception):
            raise UnreadImageError(CUT_OFF) from None


def _read_like(file: BinaryIO, size: int, known: Plain) -> npt.NDArray[Any] | None:
    """Read a plain file by the layout of one with the same tags; None where they differ."""
    content = np.empty(size, np.uint8)
    if file.readinto(content) != size:  # type: ignore[attr-defined]
        return None
    raw = content.data
    if any(raw[at : at + len(part)] != part for at, part in known.parts):
        return None
    rows, cols = known.head.shape
    pixels = content[known.offset : known.offset + rows * cols * known.stored.itemsize]
    values = pixels.view(known.stored).reshape(rows, cols)
    if known.stored == known.head.dtype:
        return values
    return values.astype(known.head.dtype)


def _remember(file: BinaryIO, size: int, tiff: Any, page: Any, head: ImageHead) -> None:
    """Remember the layout of a file of one plain page: gray values in one piece, upright,
    black zero.

    Its parts are the bytes of its header, its tags, and of those values beside the tags that
    say where pixels are and how many images there are: a file with the same ones has its
    pixels there, too.
    """
    code = page.tags.valueof
    bits = page.bitspersample
    plain = (
        len(tiff.pages) == head.images == 1
        and page.compression == 1
        and page.samplesperpixel == 1
        and _photometric(page) == 1
        and code(266, 1) == code(317, 1) == code(274, TOP_LEFT) == 1
        and isinstance(bits, int)
        and bits in (8, 16, 32, 64)
        and page.is_contiguous
        and code(322) is None
    )
    rows, cols = head.shape
    held = rows * cols * head.dtype.itemsize
    start = page.dataoffsets[0] if page.dataoffsets else 0
    if not plain or start + held > size or size > 2 * held:
        return
    stored = head.dtype.newbyteorder(tiff.byteorder)
    form = tiff.tiff
    long = form.tagnosize + form.tagsize * len(page.tags) + form.offsetsize
    places = [(0, form.offsetsize + 4 * (form.version // 42)), (page.offset, long)]
    places += [
        (tag.valueoffset, tag.valuebytecount)
        for tag in page.tags
        if tag.code in LAYOUT_TAGS or tag.code in (DESCRIPTION, SHAPE_WORDS)
    ]
    parts = []
    for at, length in places:
        file.seek(at)
        parts.append((at, file.read(length)))
    if len(_plain) >= MAX_KNOWN:
        _plain.pop(next(iter(_plain)))
    _plain[size] = Plain(tuple(parts), start, stored, head)


def _pages(tiff: Any) -> list[Any]:
    """List the pages that hold images themselves, without smaller copies and masks.

    Raises:
        UnreadImageError: there is none.
    """
    first = tiff.pages[0]
    many = len(tiff.pages)
    if many == 1:
        return [first]
    pages = [
        tiff.pages.get(i, cache=False, validate=False, aspage=True) for i in range(many)
    ]
    whole = [page for page in pages if not page.tags.valueof(254, 0) & (REDUCED | MASK)]
    if not whole:
        raise UnreadImageError("holds smaller copies of images alone, not the images")
    return whole


def _contiguous_images(tiff: Any, pages: Sequence[Any]) -> int:
    """Return the number of images that a file of one page says it holds one behind the other,
    as ImageJ writes large stacks; 1 without such words.

    Raises:
        UnreadImageError: it is too small for them, or they are not plain.
    """
    if len(pages) != 1:
        return 1
    page = pages[0]
    many = 1
    if tiff.is_imagej:
        said = (tiff.imagej_metadata or {}).get("images", 1)
        many = int(said) if isinstance(said, int | float) else 1
    elif tiff.is_shaped:
        described: Any = tiff.shaped_metadata or ({},)
        shape = described[0].get("shape", ())
        one = math.prod(page.shape) or 1
        many = max(math.prod(int(n) for n in shape) // one, 1) if shape else 1
    if many <= 1:
        return 1
    held = tiff.filehandle.size - page.dataoffsets[0]
    if not page.is_final or page.samplesperpixel != 1 or held < many * page.nbytes:
        raise UnreadImageError(f"says that it holds {many} images, and holds one")
    return many


def _head(tiff: Any, pages: Sequence[Any]) -> ImageHead:
    """Make the head of a file of its first page.

    Raises:
        UnreadImageError: pixels of a kind that is not read.
    """
    page = pages[0]
    if page.imagedepth != 1:
        raise UnreadImageError(f"has {page.imagedepth} layers in one image; allowed: 1")
    bits = _bits(page)
    dtype = number_type(_kind(page), bits)
    _colours(page)
    orientation = _orientation(page)
    shape = page.imagelength, page.imagewidth
    if turns_sides(orientation):
        shape = shape[::-1]
    images = len(pages) if len(pages) > 1 else _contiguous_images(tiff, pages)
    return ImageHead(shape, dtype, bits, images)


def _bits(page: Any) -> int:
    """Return the bits of a sample; raises UnreadImageError where samples differ in them."""
    said = page.bitspersample
    if isinstance(said, int):
        return said
    if len(set(said)) != 1:
        raise UnreadImageError(f"has samples of {' and '.join(map(str, said))} bits")
    return int(said[0])


def _kind(page: Any) -> str:
    """Return u, i or f; raises UnreadImageError for complex numbers."""
    said = page.tags.valueof(339, 1)
    kinds = set(said) if isinstance(said, tuple) else {said}
    if len(kinds) != 1 or not kinds <= set(KINDS):
        names = {5: "complex integers", 6: "complex numbers"}
        words = " and ".join(names.get(k, f"numbers of kind {k}") for k in sorted(kinds))
        raise UnreadImageError(f"holds {words}; allowed: real numbers")
    return KINDS[kinds.pop()]


def _orientation(page: Any) -> int:
    """Return the orientation; raises UnreadImageError for one that TIFF does not have."""
    said = page.tags.valueof(274, TOP_LEFT)
    if said not in ORIENTATIONS:
        raise UnreadImageError(f"has the orientation {said} (tag 274); allowed: 1 to 8")
    return int(said)


def _photometric(page: Any) -> int:
    """Return the photometric interpretation; 1, black is zero, where the file has none."""
    return int(page.tags.valueof(262, 1))


def _colours(page: Any) -> int:
    """Return the number of colors of a pixel, 1 for gray values, or 3.

    Raises:
        UnreadImageError: a palette that is no gray ramp, or other colors.
    """
    kind = _photometric(page)
    if kind == PALETTE:
        table = page.tags.valueof(320)
        entries = np.asarray(table if table is not None else (), dtype=np.int64)
        if not identity_palette(entries.reshape(3, -1).T, 65535):
            raise UnreadImageError(
                "takes its values from a table of colours (palette); allowed: grey values"
            )
        return 1
    if kind in PHOTOMETRICS:
        raise UnreadImageError(f"holds {PHOTOMETRICS[kind]}; allowed: grey values")
    colours = 3 if kind == RGB else 1
    if page.samplesperpixel < colours:
        raise UnreadImageError(
            f"says that it is in colour, with {page.samplesperpixel} samples a pixel"
        )
    return colours


def _grey(page: Any, samples: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Make gray values of samples (rows, cols, samples) by the page's photometry."""
    inverted = _bits(page) if _photometric(page) == WHITE_IS_ZERO else 0
    return grey(samples, _colours(page), inverted)


def _turned(values: npt.NDArray[Any], page: Any) -> npt.NDArray[Any]:
    """Turn an image as the page says."""
    return upright(values, _orientation(page))


def _contiguous(file: BinaryIO, page: Any, image: int) -> npt.NDArray[Any]:
    """Read one of several images that lie one behind the other."""
    stored = whole_bytes_order(_kind(page), _bits(page), page.parent.byteorder)
    rows, cols = page.imagelength, page.imagewidth
    size = rows * cols * stored.itemsize
    file.seek(page.dataoffsets[0] + image * size)
    raw = file.read(size)
    if len(raw) < size:
        raise UnreadImageError(CUT_OFF)
    native = np.frombuffer(raw, stored).reshape(rows, cols, 1)
    return _grey(page, native.astype(stored.newbyteorder("=")))


def _samples(file: BinaryIO, tiff: Any, page: Any) -> npt.NDArray[Any]:
    """Read the samples of a page as they are stored, (rows, cols, samples), in this machine's
    byte order.

    Raises:
        UnreadImageError: pieces that are missing, damaged, or of a compression that is not
            undone.
    """
    import tifffile

    if page.compression in tifffile.TIFF.IMAGE_COMPRESSIONS:
        return _samples_of_codec(page)
    decode = _decompressor(page)
    _check_predictor(page)
    _check_strips(page, tiff.filehandle.size)
    rows, cols, samples = page.imagelength, page.imagewidth, page.samplesperpixel
    bits, kind = _bits(page), _kind(page)
    planes = samples if page.planarconfig == 2 else 1
    inside = samples // planes
    out = np.zeros((rows, cols, samples), number_type(kind, bits))
    pieces = list(_pieces(page, planes))
    if len(pieces) > len(page.dataoffsets) or len(page.databytecounts) < len(pieces):
        raise UnreadImageError(
            f"has {len(page.dataoffsets)} pieces of pixels and needs {len(pieces)}"
        )
    for k, (plane, top, left, high, wide) in enumerate(pieces):
        row_bytes = (wide * inside * bits + 7) // 8
        used = min(high, rows - top)
        raw = _raw(file, page.dataoffsets[k], page.databytecounts[k])
        if page.tags.valueof(266, 1) == 2:
            raw = _reversed(raw)
        whole = decode(raw, high * row_bytes)
        if len(whole) < used * row_bytes:
            raise UnreadImageError(CUT_OFF)
        lines = np.frombuffer(whole, np.uint8, used * row_bytes).reshape(used, row_bytes)
        part = _numbers(lines, wide, inside, kind, bits, tiff.byteorder, page.predictor)
        across = min(wide, cols - left)
        out[top : top + used, left : left + across, plane : plane + inside] = part[
            :, :across
        ]
    return out


def _check_strips(page: Any, size: int) -> None:
    """Raise UnreadImageError for more strips, or longer ones, than a file of this size holds."""
    try:
        require_strips(page.databytecounts, size, "it")
    except InputLimitError as error:
        raise UnreadImageError(error.message.removeprefix("it ")) from None


def _check_predictor(page: Any) -> None:
    """Raise UnreadImageError for differences of pixels under a compression for which TIFF does
    not define them: readers disagree about whether they are differences."""
    if page.predictor != 1 and page.compression in WITHOUT_PREDICTOR:
        name = _compression_name(int(page.compression))
        raise UnreadImageError(
            f"says that it stores differences (predictor {int(page.predictor)}) with compression "
            f"{name}, which TIFF does not define"
        )


def _pieces(page: Any, planes: int) -> Iterator[tuple[int, int, int, int, int]]:
    """Yield (plane, row, column, rows, columns) of the strips or tiles of a page, in order."""
    rows, cols = page.imagelength, page.imagewidth
    if page.is_tiled:
        high, wide = page.tilelength, page.tilewidth
    else:
        high, wide = min(page.rowsperstrip, rows), cols
    if high < 1 or wide < 1:
        raise UnreadImageError("has strips or tiles without pixels")
    for plane in range(planes):
        for top in range(0, rows, high):
            for left in range(0, cols, wide):
                full = high if page.is_tiled else min(high, rows - top)
                yield plane, top, left, full, wide


def _raw(file: BinaryIO, offset: int, size: int) -> bytes:
    """Read a piece as stored; raises UnreadImageError where the file ends before it."""
    file.seek(offset)
    raw = file.read(size)
    if size <= 0 or len(raw) < size:
        raise UnreadImageError(CUT_OFF)
    return raw


def _reversed(raw: bytes) -> bytes:
    """Reverse the bits of each byte (FillOrder 2)."""
    digits = np.unpackbits(np.frombuffer(raw, np.uint8), bitorder="little")
    return np.packbits(digits).tobytes()


def _numbers(
    lines: npt.NDArray[np.uint8],
    wide: int,
    inside: int,
    kind: str,
    bits: int,
    order: str,
    predictor: int,
) -> npt.NDArray[Any]:
    """Make numbers of the bytes of a piece, and undo the predictor.

    Args:
        lines: (rows, bytes of a row).
        wide: pixels in a row.
        inside: samples of a pixel.
        kind, bits: of a sample.
        order: < or >.
        predictor: 1 (none), 2 (differences along a row) or 3 (of the bytes of floats).

    Returns:
        (rows, wide, inside).
    """
    shape = (len(lines), wide, inside)
    whole = bits in (8, 16, 32, 64)
    if predictor == 3 and kind == "f" and whole:
        size = bits // 8
        spread = np.add.accumulate(
            lines.reshape(len(lines), -1, inside), axis=1, dtype=np.uint8
        )
        planes = spread.reshape(len(lines), size, wide * inside)
        floats = np.ascontiguousarray(planes.transpose(0, 2, 1)).view(f">f{size}")
        return floats.reshape(shape).astype(f"f{size}")
    if kind == "u" and not whole:
        numbers = unpacked(lines, wide * inside, bits, order).reshape(shape)
    elif whole:
        stored = whole_bytes_order(kind, bits, order)
        numbers = np.ascontiguousarray(lines).view(stored).reshape(shape)
        numbers = numbers.astype(stored.newbyteorder(NATIVE))
    else:
        raise UnreadImageError(f"holds numbers of {bits} bits, which are not read")
    if predictor == 1:
        return numbers
    if predictor == 2 and kind in "ui" and whole:
        return np.add.accumulate(numbers, axis=1, dtype=numbers.dtype)
    raise UnreadImageError(
        f"stores differences of a kind (predictor {int(predictor)}) that is not undone for "
        f"numbers of {bits} bits"
    )


def _decompressor(page: Any) -> Callable[[bytes, int], bytes]:
    """Return the function that undoes a page's compression, from bytes and the number of
    bytes that they become at most.

    Raises:
        UnreadImageError: there is none, or its package is not installed.
    """
    import tifffile

    code = int(page.compression)
    own = {1: lambda raw, most: raw, 8: _inflate, 32946: _inflate, 34925: _unlzma}.get(
        code
    )
    if own is not None:
        return own
    try:
        found = tifffile.TIFF.DECOMPRESSORS[code]
    except (KeyError, ImportError, NotImplementedError):
        found = None
    name = _compression_name(code)
    if found is None:
        if _without_codecs():
            raise UnreadImageError(
                f"is compressed by {name}, which needs imagecodecs: pip install 'flexdt[io]'"
            )
        raise UnreadImageError(f"is compressed by {name}, which is not undone")
    undo: Callable[..., bytes] = found

    def decode(raw: bytes, most: int) -> bytes:
        """Undo the compression; fewer bytes than `most` are for the caller to find."""
        try:
            return bytes(undo(raw, out=most))
        except NotImplementedError:
            raise UnreadImageError(
                f"is compressed by {name}, which needs imagecodecs: pip install 'flexdt[io]'"
            ) from None
        except Exception:
            raise UnreadImageError(f"{CUT_OFF} (compression {name})") from None

    return decode


def _without_codecs() -> bool:
    """Return whether imagecodecs is missing."""
    try:
        import imagecodecs  # noqa: F401
    except ImportError:
        return True
    return False


def _compression_name(code: int) -> str:
    """Return the name of a compression, or its number."""
    import tifffile

    try:
        return str(tifffile.COMPRESSION(code).name)
    except ValueError:
        return f"number {code}"


def _inflate(raw: bytes, most: int) -> bytes:
    """Inflate a piece; raises UnreadImageError if it gives more than `most` bytes."""
    try:
        out = zlib.decompressobj().decompress(raw, most + 1)
    except zlib.error:
        raise UnreadImageError(f"{CUT_OFF} (compression DEFLATE)") from None
    if len(out) > most:
        raise UnreadImageError(f"inflates to more than its {most} bytes of pixels")
    return out


def _unlzma(raw: bytes, most: int) -> bytes:
    """Undo LZMA; raises UnreadImageError if it gives more than `most` bytes."""
    try:
        out = lzma.LZMADecompressor().decompress(raw, most + 1)
    except lzma.LZMAError:
        raise UnreadImageError(f"{CUT_OFF} (compression LZMA)") from None
    if len(out) > most:
        raise UnreadImageError(f"inflates to more than its {most} bytes of pixels")
    return out


def _samples_of_codec(page: Any) -> npt.NDArray[Any]:
    """Read the samples of a page that an image format such as JPEG compresses, (rows, cols,
    samples), by tifffile.

    Raises:
        UnreadImageError: pieces that are missing or damaged.
    """
    name = _compression_name(int(page.compression))
    if _without_codecs():
        raise UnreadImageError(
            f"is compressed by {name}, which needs imagecodecs: pip install 'flexdt[io]'"
        )
    if not all(page.databytecounts):
        raise UnreadImageError(CUT_OFF)
    try:
        values = page.asarray()
    except Exception:
        raise UnreadImageError(f"{CUT_OFF} (compression {name})") from None
    planes, _, rows, cols, inside = page.shaped
    stacked = values.reshape(planes, rows, cols, inside).transpose(1, 2, 0, 3)
    out = stacked.reshape(rows, cols, planes * inside)
    return np.ascontiguousarray(
        out.astype(number_type(_kind(page), _bits(page)), copy=False)
    )


def _facts(page: Any) -> Iterator[Stated]:
    """Yield what the tags of a page say and what becomes of it, in the file's order."""
    white = "inverted: 0 is white" if _photometric(page) == WHITE_IS_ZERO else ""
    words = {
        254: "smaller copies and masks are left out",
        262: white or "grey values",
        274: ORIENTATIONS[_orientation(page)],
        338: "left out where it is the same everywhere",
        339: "kind of numbers",
    }
    for tag in page.tags:
        value, name = str(tag.value), str(tag.name)
        short = value if len(value) <= 60 else value[:57] + "..."
        if tag.code in LAYOUT_TAGS:
            became = words.get(tag.code, "where pixels are")
            yield Stated(name, short, Use.USED, became)
        elif tag.code in (282, 283, 296):
            became = "pixels have the size that the geometry states"
            yield Stated(name, short, Use.IGNORED, became)
        elif tag.code in DESCRIPTION_TAGS:
            yield Stated(name, short, Use.IGNORED, "words about the file")
        else:
            # tifffile names the tags that are registered, by their numbers the others.
            known = not name.isdecimal()
            became = "of another program's" if known else "not known to flexdt"
            yield Stated(name, short, Use.IGNORED, became, known=known)
