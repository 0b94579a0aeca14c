"""The files of a data set's folder: their names, a listing, and readers with typed errors.

Images are written as TIFF bytes by `tiff_bytes`.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.message_words import nearest_name, reason_of
from flexdt.runtime.files.directory import Directory
from flexdt.runtime.files.image_files import Pixels, as_counts, read_pixels
from flexdt.runtime.files.reading_within import opened, within
from flexdt.twin.dataset import dataset_errors as ds
from flexdt.twin.dataset.file_names import (
    DOCUMENT,
    GEOMETRY,
    SCAN_SETTINGS,
    XRE_SETTINGS,
    plain_name,
)
from flexdt.twin.dataset.flexdt_json import DatasetDocument, ScanRecord, parse_document
from flexdt.twin.dataset.scan_settings_text import format_scan_settings
from flexdt.twin.dataset.xre import format_xre
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.input_limits import LIMITS

Shape = tuple[int, int]
MAX_TEXT_BYTES: Final = LIMITS[DOCUMENT].file_bytes
"""Largest text file of a data set [bytes]."""
BLANK_SAMPLE_BYTES: Final = 4096
"""Bytes in the middle of an image's file that are examined first for other values than 0."""
_IMAGE: Final = re.compile(r"(di|io|scan)[_-]?(\d+)\.tiff?", re.IGNORECASE)


@dataclass(frozen=True)
class Frame:
    """One projection: index in the scan, file name, its folder (None in memory), whether it
    exists, (rows, cols)."""

    index: int
    file: str
    folder: Path | None
    present: bool
    shape: Shape

    @property
    def path(self) -> Path | None:
        """Path of its file; None in memory."""
        # Made when it is asked for: it is a third of the time to open a long scan.
        return None if self.folder is None else self.folder / self.file


@dataclass(frozen=True, eq=False)
class Folder:
    """Listing of a folder; `names` are its regular files."""

    path: Path
    names: frozenset[str]

    @cached_property
    def in_order(self) -> tuple[str, ...]:
        """The names, sorted."""
        return tuple(sorted(self.names))

    @property
    def document(self) -> str | None:
        """Name of flexdt.json, if it is there."""
        if DOCUMENT in self.names:
            return DOCUMENT
        return None

    @property
    def geometry(self) -> str | None:
        """Name of geometry.json, if it is there."""
        if GEOMETRY in self.names:
            return GEOMETRY
        return None

    @property
    def scan_settings(self) -> str | None:
        """Name of `scan settings.txt`, any case, if it is there."""
        return self._find(SCAN_SETTINGS)

    @property
    def xre_settings(self) -> str | None:
        """Name of `data settings XRE.txt`, any case, if it is there."""
        return self._find(XRE_SETTINGS)

    @cached_property
    def darks(self) -> tuple[str, ...]:
        """Names of dark images by number."""
        return tuple(self._images("di").values())

    @cached_property
    def flats(self) -> tuple[str, ...]:
        """Names of flat images by number."""
        return tuple(self._images("io").values())

    @cached_property
    def projections(self) -> dict[int, str]:
        """Number -> name of the projections that exist, in order."""
        return self._images("scan")

    @property
    def last_index(self) -> int:
        """Number of the last projection that exists, -1 if there is none."""
        return max(self.projections, default=-1)

    def projection_name(self, index: int) -> str:
        """Return the name that projection `index` has, or would have."""
        return self.projections.get(index, f"scan_{index:06d}.tif")

    def frames(self, files: Sequence[str], shapes: Sequence[Shape]) -> tuple[Frame, ...]:
        """Make frames of these names and shapes (rows, cols), numbered from 0; each has
        its path, and whether the listing has its file.
        """
        return tuple(
            Frame(i, name, self.path, name in self.names, shape)
            for i, (name, shape) in enumerate(zip(files, shapes, strict=True))
        )

    def paths(self, files: Sequence[str]) -> tuple[Path, ...]:
        """List the paths of those of `files` that exist."""
        return tuple(self.path / name for name in files if name in self.names)

    def lost(self, files: Sequence[str]) -> str:
        """Describe which of `files` are missing: the first five and how many more; "" if
        none is.
        """
        lost = [name for name in files if name not in self.names]
        if not lost:
            return ""
        more = ""
        if len(lost) > 5:
            more = f" and {len(lost) - 5} more"
        return f"{', '.join(lost[:5])}{more} {'is' if len(lost) == 1 else 'are'} missing"

    def _find(self, wanted: str) -> str | None:
        """Find a name regardless of case."""
        plain = wanted.lower()
        if wanted in self.names:
            return wanted
        return next((n for n in self.in_order if n.lower() == plain), None)

    @cached_property
    def duplicate(self) -> tuple[str, str] | None:
        """Two images of one kind and number, or None."""
        return next((two for _, two in self._numbered.values() if two is not None), None)

    def _images(self, prefix: str) -> dict[int, str]:
        return self._numbered[prefix][0]

    @cached_property
    def _numbered(self) -> dict[str, tuple[dict[int, str], tuple[str, str] | None]]:
        """Image names by prefix ("di", "io", "scan") and number; other names are ignored.

        Prefix -> (number -> first name of that number, ascending; and the first pair of
        names with one number, or None).
        """
        found: dict[str, dict[int, str]] = {prefix: {} for prefix in ("di", "io", "scan")}
        twice: dict[str, tuple[str, str]] = {}
        for name in self.in_order:
            match = _IMAGE.fullmatch(name)
            if match is None:
                continue
            prefix = match[1].lower()
            number = int(match[2])
            first = found[prefix].setdefault(number, name)
            if first != name:
                twice.setdefault(prefix, (first, name))
        return {
            prefix: (dict(sorted(images.items())), twice.get(prefix))
            for prefix, images in found.items()
        }


def list_folder(path: Path) -> Folder:
    """List the files of a folder, without its folders; where reading is `confined`, links
    are left out, too.

    Args:
        path: of the folder.

    Raises:
        DatasetMissingError: there is no such folder, or it cannot be read.
    """
    inside = within(path)
    try:
        with os.scandir(path) if inside is None else inside.entries() as entries:
            links = inside is None
            names = frozenset(e.name for e in entries if e.is_file(follow_symlinks=links))
    except OSError as error:
        near = _near_folder(path) if inside is None else ""
        message = f"cannot read folder {path}: {reason_of(error)}{near}"
        raise ds.DatasetMissingError(message, {"path": str(path)}) from None
    return Folder(path, names)


def _near_folder(path: Path) -> str:
    """Suggest the folder beside `path` whose name is most like its own; "" if none is."""
    try:
        beside = sorted(entry.name for entry in path.parent.iterdir() if entry.is_dir())
    except OSError:
        return ""
    near = nearest_name(path.name, [name for name in beside if name != path.name])
    return "" if near is None else f"; did you mean {str(path.with_name(near))!r}?"


def read_text(path: Path, most: int = MAX_TEXT_BYTES) -> str:
    """Read a text file as UTF-8, else as the scanners' Western European code page.

    A byte order mark is removed; bytes that neither has become a replacement character.

    Args:
        path: of the file.
        most: largest size [bytes].

    Raises:
        DatasetFormatError: it cannot be read or has more than `most` bytes.
    """
    try:
        with opened(path) as file:
            size = os.fstat(file.fileno()).st_size
            if size > most:
                message = f"{path} has {size} bytes"
                raise ds.DatasetFormatError.instead(message, size, most, path=str(path))
            raw = file.read()
    except OSError as error:
        message = f"cannot read {path}: {reason_of(error)}"
        raise ds.DatasetFormatError(message, {"path": str(path)}) from None
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("cp1252", errors="replace")


def put_texts(files: Directory, record: ScanRecord) -> None:
    """Write the texts of a data set: the scanner's two, then flexdt.json."""
    files.put(SCAN_SETTINGS, format_scan_settings(record).encode("utf-8"))
    files.put(XRE_SETTINGS, format_xre(record).encode("utf-8"))
    files.put(DOCUMENT, DatasetDocument.of(record).to_json().encode("utf-8"))


def read_document(folder: Directory) -> DatasetDocument:
    """Read the flexdt.json of a data set in a data directory.

    The file must be UTF-8; a byte order mark is removed.

    Raises:
        FileNotFoundError: there is none.
        DatasetFormatError: it cannot be read, or is no such document.
    """
    path = folder.path / DOCUMENT
    try:
        text = folder.read(DOCUMENT).decode("utf-8-sig")
    except FileNotFoundError:
        raise
    except (OSError, UnicodeDecodeError) as error:
        reason = reason_of(error, "it is no UTF-8 text")
        raise ds.DatasetFormatError(
            f"cannot read {path}: {reason}", {"path": str(path)}
        ) from None
    return parse_document(text, str(path))


def read_image(
    path: Path, shape: tuple[int, int] | None = None, image: int | None = None
) -> npt.NDArray[np.uint16]:
    """Read an image of counts, uint16 (rows, cols); other whole numbers are counts, too, where
    they are from 0 to 65535. Arguments and errors as those of `read_values`."""
    values, head = _read(path, shape, image)
    return as_counts(path, values, head)


def read_values(
    path: Path, shape: tuple[int, int] | None = None, image: int | None = None
) -> npt.NDArray[Any]:
    """Read an image of real numbers of any kind, gray values with row 0 on top.

    Args:
        path: of the file, of any of `IMAGE_FORMATS`.
        shape: (rows, cols) that the image must have; None: any.
        image: index of the image in the file; None: its only one.

    Returns:
        (rows, cols), in this machine's byte order.

    Raises:
        DatasetMissingError: it is not there.
        DatasetFormatError: it is no such image, or cannot be decoded; names path and
            reason.
    """
    return _read(path, shape, image)[0]


def _read(path: Path, shape: tuple[int, int] | None, image: int | None) -> Pixels:
    """Read an image and the head of its file; see `read_values`."""
    values, head = read_pixels(path, image or 0)
    if image is None and head.images > 1:
        raise ds.DatasetFormatError(
            f"{path} holds {head.images} images; allowed: one. All of them: "
            "fx.read_tiffs(FILE, geometry)",
            {"path": str(path), "asked": head.images, "allowed": 1},
        )
    if shape is not None and values.shape != shape:
        raise ds.DatasetFormatError(
            f"{path} has {values.shape[1]} x {values.shape[0]} pixels, "
            f"the data set has {shape[1]} x {shape[0]}",
            {"path": str(path), "asked": list(values.shape), "allowed": list(shape)},
        )
    return values, head


def blank_images(folder: Folder, names: Sequence[str]) -> tuple[str, ...]:
    """List those of the images that are there and all zeros, in order; () if the last one
    that is there is not.

    A stopped scan leaves such images if the files were made in advance."""
    present = [name for name in names if name in folder.names]
    if not present or not _blank(folder.path / present[-1]):
        return ()
    return tuple(name for name in present if _blank(folder.path / name))


def _blank(path: Path) -> bool:
    """Return whether all pixels of an image are zero; False if it cannot be read.

    For a large file a sample of `BLANK_SAMPLE_BYTES` from its middle decides if it has a
    byte other than 0.
    """
    try:
        with opened(path) as file:
            size = os.fstat(file.fileno()).st_size
            file.seek(size // 2)
            if size > 4 * BLANK_SAMPLE_BYTES and any(file.read(BLANK_SAMPLE_BYTES)):
                return False
        return not read_values(path).any()
    except (OSError, ds.DatasetError):
        return False  # the reader gets the error


def mean_image(paths: Sequence[Path], shape: tuple[int, int]) -> Float32Array:
    """Average one or more images of real numbers, (rows, cols) float32; raises as
    `read_values`.
    """
    total = np.zeros(shape, dtype=np.float64)
    for path in paths:
        total += read_values(path, shape)
    return (total / len(paths)).astype(np.float32)


def tiff_bytes(image: npt.NDArray[np.uint16]) -> bytes:
    """Encode one uint16 image (rows, cols) as a baseline TIFF: little-endian, one
    strip, no metadata.

    Other types are converted to uint16 without a check.

    The pixels begin at byte 8 and the tags follow them, as the scanner writes its files:
    some of its readers look for pixels there without reading the tags.

    Args:
        image: (rows, cols).

    Returns:
        The file's content.
    """
    rows, cols = image.shape
    pixels = image.astype("<u2", copy=False).tobytes()
    at = 8 + len(pixels)
    software = b"flexdt\0\0"
    short = 3
    long = 4
    rational = 5
    text = 2
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
    trailer = software + struct.pack("<II", 1, 1)
    head = struct.pack("<2sHI", b"II", 42, at + len(trailer))
    return b"".join(
        (head, pixels, trailer, struct.pack("<H", len(tags)), entries, bytes(4))
    )


def free_name(root: Directory, wanted: str) -> str:
    """Find the first of `wanted`, `wanted-2`, `wanted-3`... that is no entry of `root`; it is
    not reserved.

    Raises DatasetNameError: `wanted` is not plain.
    """
    plain_name(wanted, "data set")
    candidates: Iterable[str] = (
        wanted if n == 1 else f"{wanted}-{n}" for n in range(1, 1_000_000)
    )
    return next(n for n in candidates if root.stat(n) is None)


def dated_name(moment: datetime, number: int = 1) -> str:
    """Format a name like 201106_001."""
    return f"{moment:%y%m%d}_{number:03d}"
