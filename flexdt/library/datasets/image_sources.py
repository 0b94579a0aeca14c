"""Find and read images and numbers that a user names: by path, pattern, array or number."""

from __future__ import annotations

import fnmatch
import glob
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.library.datasets.scan_options import Said
from flexdt.library.optional.extras import package
from flexdt.library.optional.hdf5_files import hdf5_file
from flexdt.runtime.files.dataset_folder import list_folder, read_values
from flexdt.runtime.files.image_files import ImageHead, image_head
from flexdt.runtime.files.image_meaning import MAX_IMAGE_BYTES
from flexdt.twin.dataset.dataset_errors import DatasetFormatError, DatasetMissingError
from flexdt.twin.errors import TwinError, shape_words
from flexdt.twin.length_units import UNITS_RAD, angle_rad

HDF5_MARK: Final = b"\x89HDF"
MAX_NUMBERS: Final = 1 << 22
"""Numbers of a text file or data set of angles."""
MAX_TEXT_BYTES: Final = 64 << 20


@dataclass(frozen=True, eq=False)
class Reference:
    """Dark or flat images: files of one image each, or an array.

    Attributes:
        files: of the images.
        images: (k, rows, cols), or (1, 1, 1) where one number is meant; None for files.
        named: all files that were named, those whose images are an array, too.
    """

    files: tuple[Path, ...] = ()
    images: npt.NDArray[Any] | None = None
    named: tuple[Path, ...] = ()

    @classmethod
    def of_files(cls, paths: Sequence[Path]) -> Reference:
        """Make a reference of files of one image or more."""
        return _together([_of_file(path) for path in paths])

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self.files) or self.images is not None

    def of_shape(self, shape: tuple[int, int], what: str) -> npt.NDArray[Any] | None:
        """Return the images (k, rows, cols) that are no files, or None.

        Raises:
            DatasetFormatError: they have another shape.
        """
        if self.images is None:
            return None
        if self.images.shape == (1, 1, 1):
            return np.broadcast_to(self.images, (1, *shape))
        if self.images.shape[1:] != shape:
            raise DatasetFormatError.instead(
                f"{what} images of shape {shape_words(self.images.shape[1:])}",
                list(self.images.shape[1:]),
                f"{shape_words(shape)}, as the projections",
            )
        return self.images

    def read(self, shape: tuple[int, int], what: str) -> npt.NDArray[Any] | None:
        """Return all images, those of files too, (k, rows, cols); None without any."""
        if self.files:
            return np.stack([read_values(path, shape) for path in self.files])
        return self.of_shape(shape, what)


def reference(what: str, said: Said | None, folder: Path | None = None) -> Reference:
    """Find the dark or flat images that a user means.

    Args:
        what: the word for them: dark, flat, open_beam.
        said: number, array, path, pattern, or several paths; None or an empty text: none.
        folder: in which patterns and names are looked up first; None: the working directory
            alone.

    Raises:
        DatasetMissingError: no such file.
        DatasetFormatError: it holds no images.
    """
    if said is None or (isinstance(said, str) and not said):
        return Reference()
    if isinstance(said, str | PathLike):
        return _of_path(what, said, folder)
    if (
        isinstance(said, Sequence)
        and said
        and all(isinstance(s, str | PathLike) for s in said)
    ):
        return _together([_of_path(what, one, folder) for one in said])  # type: ignore[arg-type]
    values = np.asarray(said)
    if values.dtype.kind not in "buif":
        raise DatasetFormatError.instead(
            f"{what} is {said!r:.60}", str(values.dtype), "a number, an array or a path"
        )
    return Reference(images=_stacked(what, values))


def _stacked(what: str, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a number or images as (k, rows, cols)."""
    if values.ndim > 3 or values.ndim == 1 or 0 in values.shape:
        raise DatasetFormatError.instead(
            f"{what} of shape {shape_words(values.shape)}",
            list(values.shape),
            "a number, rows x cols or k x rows x cols",
        )
    if not np.isfinite(values).all():
        many = int((~np.isfinite(values)).sum())
        said = f"{what} images: {many} of {values.size} values are not finite"
        raise DatasetFormatError.instead(said, many, "finite")
    return values.reshape((1,) * (3 - values.ndim) + values.shape)


def _together(parts: Sequence[Reference]) -> Reference:
    """Join references, as files where all are."""
    named = tuple(path for part in parts for path in part.named)
    if all(part.images is None for part in parts):
        return Reference(named, None, named)
    images = []
    for part in parts:
        images += [read_values(path)[None] for path in part.files]
        if part.images is not None:
            images.append(part.images)
    shapes = {image.shape[1:] for image in images}
    if len(shapes) > 1:
        raise DatasetFormatError.instead(
            f"images of {len(shapes)} shapes", sorted(map(list, shapes)), "one"
        )
    return Reference(images=np.concatenate(images), named=named)


def _of_path(what: str, said: str | PathLike[str], folder: Path | None) -> Reference:
    """Find the images of a path, pattern or number as typed."""
    text = str(said)
    number = _number(text)
    if number is not None:
        return Reference(images=np.full((1, 1, 1), number))
    paths = named_paths(text, folder)
    if not paths and (place := hdf5_place(text, folder)) is not None:
        return Reference(images=_stacked(what, hdf5_numbers(*place)[0]))
    if not paths:
        there = f" in {folder}" if folder is not None else ""
        raise DatasetMissingError(
            f"{what} is {text!r}: there is no such file{there}, and no name matches it; allowed: "
            "a number, a path, a pattern such as 'flat*', FILE.h5:/PATH",
            {"asked": text, "missing": [text]},
        )
    return Reference.of_files(paths)


def _of_file(path: Path) -> Reference:
    """Return the images of one file."""
    head = _head(path)
    if head.images == 1:
        return Reference((path,), None, (path,))
    require_size(path, head)
    images = np.stack([read_values(path, head.shape, i) for i in range(head.images)])
    return Reference(images=images, named=(path,))


def _head(path: Path) -> ImageHead:
    """Read the head of an image file; of HDF5 the message says how to name its images."""
    try:
        return image_head(path)
    except DatasetFormatError as error:
        if "is an HDF5 file" not in error.message:
            raise
        inside = ", ".join(hdf5_images(path)) or "no images"
        raise DatasetFormatError(
            f"{path} is an HDF5 file with {inside}; allowed: one of them, {path.name}:/PATH",
            {"path": str(path)},
        ) from None


def require_size(path: Path, head: ImageHead) -> None:
    """Check that all images of a file together are not beyond what one image may be, times 64.

    Raises:
        DatasetFormatError: they are.
    """
    size = head.images * math.prod(head.shape) * head.dtype.itemsize
    if size > 64 * MAX_IMAGE_BYTES:
        raise DatasetFormatError.instead(
            f"{path} claims images of {size} bytes", size, f"{64 * MAX_IMAGE_BYTES} bytes"
        )


def _number(text: str) -> float | None:
    """Return the finite number that a text is, or None."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def named_paths(text: str, folder: Path | None) -> list[Path]:
    """List the files that a pattern or a path names, those in the folder before others.

    Names match in either case; they are sorted.
    """
    if folder is not None:
        names = sorted(list_folder(folder).names)
        found = matching(names, text)
        if found:
            return [folder / name for name in found]
        if (folder / text).is_file():
            return [folder / text]
    path = Path(text).expanduser()
    if path.is_file():
        return [path]
    if any(mark in text for mark in "*?["):
        return [p for p in map(Path, sorted(glob.glob(str(path)))) if p.is_file()]
    return []


def matching(names: Iterable[str], pattern: str) -> list[str]:
    """List the file names that match a pattern, in either case."""
    fits = re.compile(fnmatch.translate(pattern), re.IGNORECASE).match
    return [name for name in names if fits(name)]


def hdf5_place(text: str, folder: Path | None = None) -> tuple[Path, str] | None:
    """Return file and path of FILE.h5:/PATH; None for any other text."""
    name, colon, inside = text.rpartition(":")
    if not colon or not inside.startswith("/"):
        return None
    for path in (
        *((folder / name,) if folder is not None else ()),
        Path(name).expanduser(),
    ):
        if path.is_file():
            with path.open("rb") as file:
                return (path, inside) if file.read(4) == HDF5_MARK else None
    return None


def hdf5_numbers(path: Path, inside: str) -> tuple[npt.NDArray[Any], str]:
    """Read a data set of numbers of an HDF5 file, and the unit that it states ("" for none).

    Raises:
        DatasetFormatError: there is no such data set, or it holds no numbers.
        TwinError: h5py is not installed.
    """
    try:
        with hdf5_file(path, f"{path.name}:{inside}") as file:
            found = file.get(inside)
            if not hasattr(found, "dtype"):
                allowed = ", ".join(_numbers_in(file)) or "none, it holds no numbers"
                raise DatasetFormatError(
                    f"{path} has no data set {inside}; there are: {allowed}",
                    {"path": str(path), "asked": inside},
                )
            if found.dtype.kind not in "buif":
                raise DatasetFormatError.instead(
                    f"{path}:{inside} holds {found.dtype}", str(found.dtype), "numbers"
                )
            if found.size * found.dtype.itemsize > 64 * MAX_IMAGE_BYTES:
                raise DatasetFormatError.instead(
                    f"{path}:{inside} claims {found.size} numbers", found.size, "fewer"
                )
            return np.asarray(found[()]), _unit(found)
    except TwinError:
        raise
    except Exception:  # a damaged file: anything may come
        raise DatasetFormatError(
            f"{path}:{inside} cannot be read: no HDF5 file, or a damaged one",
            {"path": str(path)},
        ) from None


def _unit(found: Any) -> str:
    """Return the attribute `units` of a data set as text."""
    unit = found.attrs.get("units", "")
    if isinstance(unit, np.ndarray):
        unit = unit.flat[0] if unit.size else ""
    if isinstance(unit, bytes):
        unit = unit.decode("latin-1")
    return str(unit)


def _numbers_in(file: Any, least: int = 1) -> list[str]:
    """List up to eight data sets of numbers of an open HDF5 file, of `least` dimensions."""
    names: list[str] = []

    def look(name: str, item: Any) -> bool | None:
        if getattr(getattr(item, "dtype", None), "kind", "") in "uif" and getattr(
            item, "ndim", 0
        ) >= max(least, 1):
            names.append(f"/{name}")
        return True if len(names) >= 8 else None

    file.visititems(look)
    return names


def hdf5_images(path: Path) -> list[str]:
    """List up to eight data sets of an HDF5 file that may be images; [] of a damaged file."""
    package("h5py", f"the HDF5 file {path.name}")
    try:
        with hdf5_file(path, f"the HDF5 file {path.name}") as file:
            return _numbers_in(file, 2)
    except Exception:  # a damaged file: anything may come
        return []


def angles_deg(said: Any, folder: Path | None = None) -> npt.NDArray[np.float64]:
    """Read stage angles that a user names, (n,) [deg].

    Args:
        said: (n,) [deg], the path of a text file with one number a line, or FILE.h5:/PATH,
            whose unit is degrees where it states none.
        folder: in which files are looked up first.

    Raises:
        DatasetMissingError: no such file.
        DatasetFormatError: no angles, or in an unknown unit.
    """
    if isinstance(said, str | PathLike):
        values, scale, where = _angles_of_file(str(said), folder)
    else:
        values, scale, where = np.asarray(said), 1.0, "angles"
    if values.dtype.kind not in "uif" or values.squeeze().ndim > 1 or not values.size:
        raise DatasetFormatError.instead(
            f"{where} of shape {shape_words(values.shape)}",
            list(values.shape),
            "numbers (n,) [deg]",
        )
    angles = scale * np.atleast_1d(values.squeeze()).astype(np.float64)
    if not np.isfinite(angles).all():
        first = int(np.flatnonzero(~np.isfinite(angles))[0])
        raise DatasetFormatError.instead(
            f"{where}: number {first + 1} of {len(angles)} is {angles[first]}",
            first,
            "finite",
        )
    return angles


def _angles_of_file(
    text: str, folder: Path | None
) -> tuple[npt.NDArray[Any], float, str]:
    """Read the numbers of a file of angles; with them the degrees of their unit and their place."""
    if (place := hdf5_place(text, folder)) is not None:
        values, unit = hdf5_numbers(*place)
        scale = angle_rad(unit) if unit else math.radians(1.0)
        if scale is None:
            raise DatasetFormatError.instead(
                f"{text} is in {unit!r}", unit, ", ".join(UNITS_RAD)
            )
        return values, math.degrees(scale), text
    paths = named_paths(text, folder)
    if len(paths) != 1:
        raise DatasetMissingError(
            f"angles are {text!r}: there is no such file; allowed: a text file with a number a "
            "line, FILE.h5:/PATH",
            {"asked": text, "missing": [text]},
        )
    if paths[0].suffix.lower() == ".npy":
        return read_values_of_npy(paths[0]), 1.0, text
    return _numbers_of_text(paths[0]), 1.0, text


def read_values_of_npy(path: Path) -> npt.NDArray[Any]:
    """Read a NumPy array of numbers; objects in it are never loaded.

    Raises:
        DatasetFormatError: it is none.
    """
    try:
        return np.asarray(np.load(path, allow_pickle=False))
    except Exception:  # a damaged file: anything may come
        raise DatasetFormatError(
            f"{path} is no NumPy array of numbers, or a damaged one", {"path": str(path)}
        ) from None


def _numbers_of_text(path: Path) -> npt.NDArray[np.float64]:
    """Read a text of numbers, one a line; empty lines and those that begin with # are left
    out, and so are titles above the first number.

    Raises:
        DatasetFormatError: a line that is no number; names it.
    """
    if path.stat().st_size > MAX_TEXT_BYTES:
        raise DatasetFormatError(f"{path} is no text of angles: it is too large")
    numbers: list[float] = []
    text = path.read_bytes().decode("utf-8-sig", "replace")
    for at, line in enumerate(text.splitlines(), 1):
        word = line.split("#")[0].strip().rstrip(",;")
        if not word:
            continue
        if "," in word and "." not in word and word.count(",") == 1:
            word = word.replace(",", ".")
        value = _number(word)
        if value is None and not numbers and at <= 3:
            continue  # a title
        if value is None:
            raise DatasetFormatError(
                f"{path}: line {at} is {word[:40]!r}; allowed: one number a line, the angle of a "
                "view in degrees",
                {"path": str(path), "line": at},
            )
        numbers.append(value)
    if not numbers:
        raise DatasetFormatError(f"{path} holds no numbers", {"path": str(path)})
    return np.array(numbers)
