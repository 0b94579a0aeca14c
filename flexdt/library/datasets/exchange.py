"""`flexdt export` and `import` without their command line: data sets, files, geometries.

The conversions are in `flexdt.twin.exchange`; this module reads and writes the files, each under
its name only when whole. What a file does not state, such as the detector's size, is an argument.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np

from flexdt.library.datasets.image_set import Images, ImageSet
from flexdt.library.datasets.nxtomo_writing import save_nxtomo
from flexdt.library.extras import extension
from flexdt.runtime.files.whole_files import write_whole
from flexdt.twin.exchange.flexdata import flexdata_text, read_flexdata
from flexdt.twin.exchange.geometry import ExchangeError, ScanGeometry
from flexdt.twin.exchange.number_tables import (
    csv_text,
    geometry_text,
    read_csv,
    read_geometry_text,
    read_tomosipo,
    read_vectors_array,
    read_vectors_text,
    tomosipo_arrays,
    vectors_text,
)
from flexdt.twin.exchange.rtk_xml import read_rtk, rtk_text
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.signatures import File

Content = str | bytes
MAX_BYTES: Final = 256 << 20
"""Of a text; no geometry is longer."""


@dataclass(frozen=True)
class Given:
    """What a file may not say of itself.

    Attributes:
        shape: detector (rows, cols).
        pitch_mm: of a pixel along u and v [mm].
        views: number of projections.
    """

    shape: tuple[int, int] | None = None
    pitch_mm: tuple[float, float] | None = None
    views: int | None = None

    @classmethod
    def of(cls, dataset: ImageSet) -> Given:
        """The values of a data set of the same scan."""
        pitch = ScanGeometry(dataset.cone_vec).pitch_mm
        return cls(dataset.shape, pitch, len(dataset))

    def check_pitch(self, geometry: ScanGeometry, path: Path) -> None:
        """Raise ExchangeError if a file says another pitch."""
        pitch = geometry.pitch_mm
        if self.pitch_mm is not None and not np.allclose(pitch, self.pitch_mm, rtol=1e-3):
            found, asked = (f"{u:g} x {v:g}" for u, v in (pitch, self.pitch_mm))
            said = f"{path} says pixels of {found} mm, not {asked}"
            raise ExchangeError(said, {"asked": list(self.pitch_mm), "allowed": list(pitch)})


def geometry_of(dataset: ImageSet, parameters: Offsets | None = None) -> ScanGeometry:
    """A data set's geometry.

    Args:
        dataset: from `load_dataset`.
        parameters: correction; None is the one in force during the scan, if any.

    Raises:
        ExchangeError: projections of several shapes.
    """
    shapes = {frame.shape for frame in dataset.frames}
    if len(shapes) > 1:
        raise ExchangeError(
            f"{dataset.where}: projections of {len(shapes)} shapes; a geometry has one",
            {"asked": sorted(map(list, shapes))},
        )
    files = tuple(frame.file for frame in dataset.frames)
    cone_vec = dataset.corrected(parameters)
    return ScanGeometry(cone_vec, dataset.shape, name=dataset.name, files=files)


WRITERS: Final[Mapping[str, Callable[[ScanGeometry], str]]] = {
    "rtk": rtk_text,
    "flexdata": flexdata_text,
    "csv": csv_text,
}
"""Formats that are a text made of the geometry alone."""
FORMATS: Final = ("ctsimu", "rtk", "astra", "tomosipo", "flexdata", "csv")
ENDINGS: Final = {
    "ctsimu": (".json",),
    "rtk": (".xml", ".rtk"),
    "astra": (".npy", ".txt", ".geom", ".dat"),
    "tomosipo": (".npz",),
    "flexdata": (".toml",),
    "csv": (".csv",),
    "nxtomo": (".nxs", ".nx", ".h5", ".hdf5"),
}


def export_dataset(
    dataset: ImageSet,
    out: str | PathLike[str],
    format: str,
    *,
    parameters: Offsets | None = None,
    real: Offsets | None = None,
    rows_up: bool = False,
) -> ScanGeometry:
    """Write a data set's geometry in a peer's format.

    Args:
        dataset: from `load_dataset`.
        out: the file; its ending chooses where a format has several.
        format: one of `FORMATS`, or nxtomo, which holds the images as well.
        parameters: correction; None is the one in force during the scan, if any.
        real: CTSimU only: what is so and a reconstruction does not know.
        rows_up: the images are turned upside down before use: v upwards.

    Returns:
        The geometry that was written.

    Raises:
        ExchangeError: the format cannot carry it; nothing is written.
    """
    out = Path(out)
    _check_ending(out, format)
    if real is not None and format != "ctsimu":
        raise ExchangeError(f"{format} cannot tell what is so from what is known; ctsimu can")
    if rows_up and format in ("ctsimu", "flexdata", "nxtomo"):
        fixed = "upwards" if format == "flexdata" else "downwards"
        raise ExchangeError(f"{format} has rows that grow {fixed} by itself")
    geometry = geometry_of(dataset, parameters)
    if format == "nxtomo":
        whole = dataset.require_complete()
        save_nxtomo(whole if parameters is None else whole.with_correction(parameters), out)
        return geometry
    if format == "ctsimu":
        scenario = extension("ctsimu.export", "the format ctsimu")(dataset, parameters, real)
        content: Content = json.dumps(scenario, indent=1) + "\n"
    else:
        content = _content(geometry.rows_up() if rows_up else geometry, format, out)
    write_whole(out, content)
    return geometry


def _content(geometry: ScanGeometry, format: str, out: Path) -> Content:
    if format in WRITERS:
        return WRITERS[format](geometry)
    buffer = io.BytesIO()
    if format == "tomosipo":
        np.savez(buffer, **tomosipo_arrays(geometry))  # type: ignore[arg-type]
        return buffer.getvalue()
    if format != "astra":
        raise _unknown(format)
    if out.suffix.lower() != ".npy":
        return vectors_text(geometry)
    np.save(buffer, geometry.cone_vec.rows, allow_pickle=False)
    return buffer.getvalue()


def import_geometry(
    path: str | PathLike[str],
    format: str,
    given: Given | None = None,
    *,
    rows_up: bool = False,
) -> ScanGeometry:
    """Read a geometry in a peer's format.

    Args:
        path: the file.
        format: one of `FORMATS`.
        given: what the file does not say.
        rows_up: its rows are counted upwards while the images have row 0 on top: v is negated.

    Raises:
        ExchangeError: the file does not hold, or something is missing; says what.
        OSError: it cannot be read.
    """
    known = Given() if given is None else given
    path = Path(path)
    geometry = _read(path, format, known)
    if rows_up:
        if format in ("ctsimu", "flexdata"):
            raise ExchangeError(f"{format} says by itself which way its rows grow")
        geometry = geometry.rows_up()
    for what, asked, found in (
        ("rows and columns", known.shape, geometry.shape),
        ("views", known.views, len(geometry)),
    ):
        if asked is not None and found not in (None, asked):
            said = f"{path} says {found} {what}, not {asked}"
            raise ExchangeError(said, {"asked": asked, "allowed": found})
    known.check_pitch(geometry, path)
    shape = known.shape if geometry.shape is None else geometry.shape
    return replace(geometry, shape=shape, name=geometry.name or path.stem)


def _read(path: Path, format: str, given: Given) -> ScanGeometry:
    name = str(path)
    match format:
        case "ctsimu":
            read: Callable[..., ScanGeometry] = extension("ctsimu.import", "the format ctsimu")
            return read(text_of(path), name, lambda other: text_of(path.parent / other))
        case "csv":
            return read_csv(text_of(path), name)
        case "flexdata":
            return read_flexdata(text_of(path), given.views, given.shape, name)
        case "rtk":
            # Whether it is RTK's file at all is said before what such a file lacks.
            found = read_rtk(text_of(path), given.pitch_mm or (1.0, 1.0), given.shape, name)
            if given.pitch_mm is None:
                raise ExchangeError(
                    f"{path}: RTK's file does not know the pixel size; give pixel= [mm] "
                    "(--pixel or --like on the command line)"
                )
            return found
        case "tomosipo":
            return read_tomosipo(_arrays(path), name)
        case "astra" if path.suffix.lower() == ".npy":
            return ScanGeometry(read_vectors_array(_arrays(path)["array"], name), given.shape)
        case "astra":
            return ScanGeometry(read_vectors_text(text_of(path), name), given.shape)
    raise _unknown(format)


def _unknown(format: str) -> ExchangeError:
    return ExchangeError(
        f"format {format!r} is not known; there are: {', '.join(FORMATS)}",
        {"asked": format, "allowed": list(FORMATS)},
    )


def write_geometry(geometry: ScanGeometry, out: str | PathLike[str], format: str) -> None:
    """Write a geometry in a peer's format: all of `FORMATS` but CTSimU's, which needs a scan.

    Raises:
        ExchangeError: the format cannot carry it, or the file's ending is not the format's.
    """
    out = Path(out)
    _check_ending(out, format)
    if format == "ctsimu":
        raise ExchangeError("a CTSimU scenario is made of a data set: flexdt export DATASET")
    write_whole(out, _content(geometry, format, out))


def save_geometry(geometry: ScanGeometry, out: str | PathLike[str]) -> None:
    """Write a geometry file: .json (everything) or .npy (cone_vec alone).

    Raises:
        ExchangeError: another ending.
    """
    out = Path(out)
    match out.suffix.lower():
        case ".json":
            write_whole(out, geometry_text(geometry))
        case ".npy":
            write_whole(out, _content(geometry, "astra", out))
        case _:
            raise ExchangeError(f"{out.name}: a geometry file ends with .json or .npy")


def load_geometry(path: str | PathLike[str]) -> ScanGeometry:
    """Read a geometry file that `flexdt import` (or `save_geometry`) wrote.

    Raises:
        ExchangeError: it is no geometry file.
        OSError: it cannot be read.
    """
    file = Path(path)
    if file.suffix.lower() == ".npy":
        return ScanGeometry(read_vectors_array(_arrays(file)["array"], str(file)))
    return read_geometry_text(text_of(file), str(file))


def with_geometry(dataset: Images, geometry: ScanGeometry | ConeVec | File) -> Images:
    """The data set with its nominal geometry replaced; no correction is added to it.

    Args:
        dataset: from `load_dataset`.
        geometry: one row for each of its projections, or its file.

    Raises:
        ExchangeError: another number of projections, or another detector.
    """
    if not isinstance(geometry, ScanGeometry | ConeVec):
        geometry = ConeVec.load(geometry)
    if isinstance(geometry, ConeVec):
        geometry = ScanGeometry(geometry, geometry.detector_shape)
    if len(geometry) != len(dataset):
        said = f"{dataset.where} has {len(dataset)} projections, the geometry {len(geometry)} views"
        raise ExchangeError(said, {"asked": len(geometry), "allowed": len(dataset)})
    if geometry.shape not in (None, dataset.shape):
        raise ExchangeError(
            f"{dataset.where} has images of {dataset.shape}, the geometry is of {geometry.shape} "
            "(rows, columns)",
            {"asked": geometry.shape, "allowed": list(dataset.shape)},
        )
    # Its correction belongs to the geometry that is replaced.
    return replace(dataset, cone_vec=geometry.cone_vec, nominal=None, correction=None)


def _check_ending(out: Path, format: str) -> None:
    endings = ENDINGS.get(format)
    if endings is None:
        raise _unknown(format)
    if out.suffix.lower() not in endings:
        raise ExchangeError(
            f"{out.name}: a file of format {format} ends with {' or '.join(endings)}",
            {"asked": out.suffix, "allowed": list(endings)},
        )


def text_of(path: Path) -> str:
    """A file's UTF-8 text, or ExchangeError."""
    if path.stat().st_size > MAX_BYTES:
        raise ExchangeError(f"{path}: {path.stat().st_size} bytes; allowed: {MAX_BYTES}")
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise ExchangeError(f"{path} is no UTF-8 text", {"path": str(path)}) from None


def _arrays(path: Path) -> dict[str, np.ndarray[Any, np.dtype[Any]]]:
    """The arrays of an .npz, or the one of an .npy as `array`."""
    try:
        loaded = np.load(path, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            return {"array": loaded}
        with loaded:
            return {name: loaded[name] for name in loaded.files}
    except (ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ExchangeError(f"{path} is no NumPy file: {error}", {"path": str(path)}) from None
