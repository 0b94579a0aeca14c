"""Read image files of any format that flexdt knows, told by their first bytes.

`IMAGE_FORMATS` is the only list of them. Whatever the format, an image comes out as gray
values with row 0 on top and column 0 at the left, or not at all, with the cause.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final, TypeVar

import numpy as np
import numpy.typing as npt

from flexdt.message_words import reason_of
from flexdt.runtime.files import plain_images, tiff_images
from flexdt.runtime.files.image_meaning import ImageHead, UnreadImageError
from flexdt.runtime.files.reading_within import opened
from flexdt.twin.dataset.dataset_errors import DatasetFormatError, DatasetMissingError

__all__ = [
    "IMAGE_ENDINGS",
    "IMAGE_FORMATS",
    "ImageHead",
    "image_head",
    "read_pixels",
]

_T = TypeVar("_T")
Pixels = tuple[npt.NDArray[Any], ImageHead]


@dataclass(frozen=True)
class ImageFormat:
    """A format of image files.

    Attributes:
        name: of the format.
        endings: usual ones of its files, in lower case.
        begins: first bytes of each of its files, one of these.
        head: from an open file and its path, what it says of its images.
        read: from these and the index of an image, its pixels.
    """

    name: str
    endings: tuple[str, ...]
    begins: tuple[bytes, ...]
    head: Callable[[BinaryIO, Path], ImageHead]
    read: Callable[[BinaryIO, Path, int], Pixels]


def _tiff_head(file: BinaryIO, path: Path) -> ImageHead:
    return tiff_images.tiff_head(file)


def _tiff(file: BinaryIO, path: Path, image: int) -> Pixels:
    return tiff_images.read_tiff(file, image)


def _png_head(file: BinaryIO, path: Path) -> ImageHead:
    return plain_images.png_head(file)[0]


def _bmp_head(file: BinaryIO, path: Path) -> ImageHead:
    return plain_images.read_bmp(file)[1]


def _single(
    read: Callable[[BinaryIO], Pixels],
) -> Callable[[BinaryIO, Path, int], Pixels]:
    """Return the reader of a format whose files hold one image."""

    def read_first(file: BinaryIO, path: Path, image: int) -> Pixels:
        """Read the image; raises UnreadImageError for any but the first."""
        if image != 0:
            raise UnreadImageError(f"holds 1 image; asked for number {image + 1}")
        return read(file)

    return read_first


def _stack(
    layout: Callable[[Path], plain_images.Stack],
) -> tuple[
    Callable[[BinaryIO, Path], ImageHead], Callable[[BinaryIO, Path, int], Pixels]
]:
    """Return head and reader of a format of plain numbers behind a header."""

    def read(file: BinaryIO, path: Path, image: int) -> Pixels:
        """Read an image of the file, and its head."""
        found = layout(path)
        return found.read(image), found.head

    return lambda file, path: layout(path).head, read


IMAGE_FORMATS: Final = (
    ImageFormat("TIFF", (".tif", ".tiff"), tiff_images.MAGICS, _tiff_head, _tiff),
    ImageFormat(
        "PNG",
        (".png",),
        (b"\x89PNG\r\n\x1a\n",),
        _png_head,
        _single(plain_images.read_png),
    ),
    ImageFormat("BMP", (".bmp",), (b"BM",), _bmp_head, _single(plain_images.read_bmp)),
    ImageFormat("EDF", (".edf",), (b"{",), *_stack(plain_images.edf_image)),
    ImageFormat(
        "MetaImage",
        (".mhd", ".mha"),
        (b"ObjectType", b"NDims", b"Comment", b"ObjectSubType"),
        *_stack(plain_images.meta_image),
    ),
    ImageFormat(
        "NRRD", (".nhdr", ".nrrd"), (b"NRRD000",), *_stack(plain_images.nrrd_image)
    ),
    ImageFormat("NumPy", (".npy",), (b"\x93NUMPY",), *_stack(plain_images.numpy_image)),
)
"""In the order in which they are listed."""
IMAGE_ENDINGS: Final = tuple(end for form in IMAGE_FORMATS for end in form.endings)
OTHER_FORMATS: Final = {
    b"\xff\xd8\xff": "a JPEG image",
    b"GIF8": "a GIF image",
    b"\x89HDF": "an HDF5 file",
    b"\0\0\0\x0cjP": "a JPEG 2000 image",
    b"SIMPLE  =": "a FITS file",
    b"PK\x03\x04": "an archive (zip)",
    b"\x1f\x8b": "a file compressed by gzip",
    b"\xd0\xcf\x11\xe0": "a compound document, as Zeiss's .txrm",
    b"%PDF": "a PDF document",
}
"""First bytes of formats that are named and not read -> the words for them."""
RAW_ENDINGS: Final = (".raw", ".bin", ".dat", ".img", ".vol")
"""Usual endings of files of numbers without a header."""
RAW_ADVICE: Final = (
    "has {size} bytes and is not known by the first of them: for raw numbers write a text beside "
    "it, scan.mhd: "
    "'NDims = 3', 'DimSize = COLUMNS ROWS IMAGES', 'ElementType = MET_USHORT', "
    "'ElementDataFile = {name}', and open that; or fx.DataSet.from_arrays("
    "np.fromfile('{name}', np.uint16).reshape(IMAGES, ROWS, COLUMNS), GEOMETRY)"
)
"""How to read a file of numbers without a header."""
RAW_FOLDER_ADVICE: Final = (
    "{many} files of numbers without a header, of {size} bytes each (ROWS x COLUMNS x 2 of "
    "uint16): fx.DataSet.from_arrays(np.stack([np.fromfile(path, np.uint16)"
    ".reshape(ROWS, COLUMNS) for path in sorted(Path({folder!r}).glob({pattern!r}), "
    "key=lambda path: (len(path.name), path))]), GEOMETRY)"
)
"""How to read a folder of such files, of an image each."""
MOST_BEGIN: Final = 16
"""First bytes that are looked at."""


def image_head(path: Path) -> ImageHead:
    """Read what a file says of its images, without their pixels.

    Raises:
        DatasetMissingError: it is not there.
        DatasetFormatError: it holds no image that is read; names path and reason.
    """
    return _answered(path, lambda form, file: form.head(file, path))


def read_pixels(path: Path, image: int = 0) -> Pixels:
    """Read an image of a file, gray values (rows, cols) in this machine's byte order, and its
    head.

    Args:
        path: of the file.
        image: index of the image in the file.

    Raises:
        DatasetMissingError: it is not there.
        DatasetFormatError: it holds no image that is read; names path and reason.
    """
    return _answered(path, lambda form, file: form.read(file, path, image))


def read_rows(
    path: Path, shape: tuple[int, int], rows: npt.NDArray[np.intp]
) -> npt.NDArray[Any]:
    """Read some rows of the only image of a file, (rows, cols).

    Of plain TIFFs with the tags of the last no other row is read. Raises DatasetError: as
    `read_pixels`, or another `shape`.
    """
    with opened(path) as file:
        some = tiff_images.read_tiff_rows(file, shape, rows)
    if some is not None:
        return some
    values, _ = read_pixels(path)
    if values.shape != shape:
        raise DatasetFormatError(f"{path} has another shape", {"path": str(path)})
    return values[rows]


def _answered(path: Path, ask: Callable[[ImageFormat, BinaryIO], _T]) -> _T:
    """Return the answer of the format of a file.

    Raises:
        DatasetMissingError: it is not there.
        DatasetFormatError: another format, or any error of its reader.
    """
    known = _KNOWN_BY_ENDING.get(path.suffix.lower())
    try:
        with opened(path) as file:
            begin = file.read(MOST_BEGIN)
            form = next((f for f in IMAGE_FORMATS if begin.startswith(f.begins)), None)
            if form is None:
                raise UnreadImageError(raw_advice(path) or _no_image(begin, known))
            file.seek(0)
            return ask(form, file)
    except UnreadImageError as error:
        reason = str(error)
        if reason.startswith("its "):
            name = next((f.name for f in IMAGE_FORMATS if begin.startswith(f.begins)), "")
            reason = f"is not a readable {name} image: {reason}"
        raise DatasetFormatError(f"{path} {reason}", {"path": str(path)}) from None
    except FileNotFoundError:
        raise DatasetMissingError(f"{path} is missing", {"path": str(path)}) from None
    except OSError as error:
        reason = reason_of(error)
        raise DatasetFormatError(
            f"cannot read {path}: {reason}", {"path": str(path)}
        ) from None
    except MemoryError:
        said = f"{path} takes more memory than there is"
        raise DatasetFormatError(said, {"path": str(path)}) from None
    except Exception:  # a third party's parser raises anything on a damaged file
        said = f"{path} is no readable image: its bytes are cut off or damaged"
        raise DatasetFormatError(said, {"path": str(path)}) from None


def raw_advice(path: Path) -> str:
    """Say how raw numbers are read; "" for a file whose ending does not mean them."""
    if path.suffix.lower() not in RAW_ENDINGS:
        return ""
    size = path.stat().st_size if path.is_file() else 0
    return RAW_ADVICE.format(name=path.name, size=size)


def raw_folder_advice(paths: Sequence[Path]) -> str:
    """Say how the raw files of a folder are read; "" unless there are several of one size,
    an image each.

    Args:
        paths: of the files of a folder, sorted.
    """
    raw = [path for path in paths if path.suffix.lower() in RAW_ENDINGS]
    sizes = [path.stat().st_size for path in raw]
    usual = max(set(sizes), key=sizes.count, default=0)
    if sizes.count(usual) < 2:
        return raw_advice(raw[0]) and f"{raw[0].name} {raw_advice(raw[0])}" if raw else ""
    some = [path for path, size in zip(raw, sizes, strict=True) if size == usual]
    first, last = min(p.name for p in some), max(p.name for p in some)
    alike = next((i for i, (a, b) in enumerate(zip(first, last)) if a != b), 0)  # noqa: B905
    begin = first[:alike].rstrip("0123456789")
    return RAW_FOLDER_ADVICE.format(
        many=len(some),
        size=usual,
        folder=str(some[0].parent),
        pattern=f"{begin}*{some[0].suffix}",
    )


def _no_image(begin: bytes, known: str | None) -> str:
    """Explain first bytes that no format has.

    Args:
        begin: of the file.
        known: name of the format that its ending means; None for another ending.
    """
    allowed = ", ".join(form.name for form in IMAGE_FORMATS)
    if not begin:
        return "is empty"
    if not any(begin):
        return "is no image: it begins with zeros, as a file that was never written"
    for start, name in OTHER_FORMATS.items():
        if begin.startswith(start):
            return f"is {name}; allowed: {allowed}"
    if known is not None:
        return f"is no {known} file: it begins with other bytes"
    return f"is no image of a known format; allowed: {allowed}"


_KNOWN_BY_ENDING: Final = {
    end: form.name for form in IMAGE_FORMATS for end in form.endings
}


def is_image_name(name: str) -> bool:
    """Return whether a file's ending, in either case, is that of an image format."""
    return name.lower().endswith(IMAGE_ENDINGS)


def as_counts(
    path: Path, values: npt.NDArray[Any], head: ImageHead
) -> npt.NDArray[np.uint16]:
    """Return an image as counts, uint16.

    Raises:
        DatasetFormatError: values that are no whole numbers from 0 to 65535.
    """
    if values.dtype == np.uint16:
        return values
    facts = {"path": str(path), "asked": str(values.dtype), "allowed": "uint16"}
    if values.dtype.kind not in "ui":
        raise DatasetFormatError(
            f"{path} holds {values.dtype} numbers; allowed: uint16, or other whole numbers from "
            "0 to 65535",
            facts,
        )
    if values.size and head.dtype != np.uint8:
        low, high = int(values.min()), int(values.max())
        if low < 0 or high > np.iinfo(np.uint16).max:
            raise DatasetFormatError(
                f"{path} holds counts from {low} to {high}; allowed: 0 to 65535", facts
            )
    return values.astype(np.uint16)
