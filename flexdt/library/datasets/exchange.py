"""`flexdt export` and `import` without their command line: data sets, files, geometries.

The conversions are in `flexdt.twin.exchange`; this module reads and writes the files,
each under its name only when complete. Values that a file does not state, such as the
detector's size, are arguments.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path

import numpy as np

from flexdt.library.datasets.exchange_formats import (
    FORMATS,
    NPY,
    OWN_ENDINGS,
    Content,
    Format,
    exported,
    imported,
)
from flexdt.library.datasets.geometry_content import Given, arrays_of, text_of
from flexdt.library.datasets.image_set import Images, ImageSet
from flexdt.runtime.files.whole_files import write_whole
from flexdt.twin.dataset.provenance import Part
from flexdt.twin.errors import GeometryError, shape_words
from flexdt.twin.exchange.geometry import ExchangeError, ScanGeometry
from flexdt.twin.exchange.number_tables import (
    geometry_text,
    read_geometry_text,
    read_json,
    read_vectors_array,
)
from flexdt.twin.geometry.cone_vec import ConeVec, Shape2
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.plausibility import Operation, examine, settled
from flexdt.twin.signatures import File

__all__ = [
    "FORMATS",
    "ExchangeError",
    "Format",
    "Given",
    "ScanGeometry",
    "export_dataset",
    "format_of_ending",
    "geometry_of",
    "import_geometry",
    "is_geometry_file",
    "load_geometry",
    "load_stated",
    "save_geometry",
    "stated_in",
    "text_of",
    "with_geometry",
    "write_geometry",
]


def geometry_of(dataset: ImageSet, parameters: Offsets | None = None) -> ScanGeometry:
    """Return a data set's geometry, with its name and the files of its projections.

    Args:
        dataset: from `load_dataset`.
        parameters: correction; None: the correction in force during the scan, if any.

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


def export_dataset(
    dataset: ImageSet,
    out: str | PathLike[str],
    format: str,
    *,
    parameters: Offsets | None = None,
    real: Offsets | None = None,
    rows_up: bool = False,
) -> ScanGeometry:
    """Write a data set's geometry in a peer's format; the file appears only when
    complete.

    Args:
        dataset: from `load_dataset`.
        out: the file; its ending chooses where a format has several.
        format: one of `FORMATS`; nxtomo holds the images as well.
        parameters: correction; None is the one in force during the scan, if any.
        real: true offsets that a reconstruction does not know, for formats with a place
            for them (CTSimU).
        rows_up: the images are turned upside down before use: v upwards.

    Returns:
        The geometry that was written.

    Raises:
        ExchangeError: an unknown format or another ending, `real` or `rows_up` with a
            format that has no place for it, or a geometry that the format cannot carry;
            nothing is written.
    """
    out = Path(out)
    form = _to_write(out, format, exported())
    if real is not None and not form.states_unknown:
        able = " and ".join(name for name, one in FORMATS.items() if one.states_unknown)
        raise ExchangeError(
            f"{format} cannot tell what is so from what is known; {able} can"
        )
    if rows_up and form.rows is not None:
        raise ExchangeError(f"{format} has rows that grow {form.rows}wards by itself")
    geometry = geometry_of(dataset, parameters)
    if form.export is not None:
        form.export(dataset, out, parameters, real)
    else:
        write_whole(out, _content(geometry.rows_up() if rows_up else geometry, form, out))
    return geometry


def _content(geometry: ScanGeometry, form: Format, out: Path) -> Content:
    """Return the content of a geometry's file in a format, text or bytes; nothing is
    written.

    Raises:
        ExchangeError: the format needs a data set, or cannot carry the geometry.
    """
    if form.write is None:
        raise ExchangeError(
            f"a file of format {form.name} is made of a data set: "
            f"flexdt export DATASET --format {form.name}"
        )
    return form.write(geometry, out)


def import_geometry(
    path: str | PathLike[str],
    format: str,
    given: Given | None = None,
    *,
    rows_up: bool = False,
) -> ScanGeometry:
    """Read a geometry in a peer's format.

    Shape, views and pitch must agree with the given ones. Without a name it gets the
    file's stem; doubts about the geometry become notes.

    Args:
        path: the file.
        format: one of `FORMATS` that is read (`Format.read`).
        given: values that the file does not state.
        rows_up: its rows are counted upwards while the images have row 0 on top: v is
            negated.

    Raises:
        ExchangeError: an unknown format, an invalid file, one that lacks something or
            contradicts the given values, `rows_up` with a format that states its rows, or
            a geometry that no scanner has.
        OSError: it cannot be read.
    """
    known = Given() if given is None else given
    path = Path(path)
    form = _known(format, imported())
    assert form.read is not None
    geometry = form.read(path, known)
    if rows_up:
        if form.rows is not None:
            raise ExchangeError(f"{format} says by itself which way its rows grow")
        geometry = geometry.rows_up()
    for quantity, stated, read in (
        ("rows and columns", known.shape, geometry.shape),
        ("views", known.views, len(geometry)),
    ):
        if stated is not None and read not in (None, stated):
            message = f"{path} says {read} {quantity}, not {stated}"
            raise ExchangeError(message, {"asked": stated, "allowed": read})
    known.check_pitch(geometry, path)
    if geometry.shape is None:
        shape = known.shape
    else:
        shape = geometry.shape
    return _with_doubts(
        replace(geometry, shape=shape, name=geometry.name or path.stem), path
    )


def _with_doubts(geometry: ScanGeometry, path: Path) -> ScanGeometry:
    """Return the geometry with the doubts about it added to its notes; itself without doubts.

    Raises ExchangeError: no scanner has such a geometry.
    """
    findings = examine(Operation.OPEN, geometry.cone_vec, geometry.shape)
    doubts = settled(findings, ExchangeError, str(path))
    if doubts:
        return replace(geometry, notes=(*geometry.notes, *doubts))
    return geometry


def _known(format: str, allowed: Iterable[str]) -> Format:
    """Return the format of a name.

    Raises:
        ExchangeError: the name is not among the allowed ones; lists them.
    """
    names = [*allowed]
    if format not in names:
        raise ExchangeError(
            f"format {format!r} is not known; there are: {', '.join(names)}",
            {"asked": format, "allowed": names},
        )
    return FORMATS[format]


def _to_write(out: Path, format: str, allowed: Iterable[str]) -> Format:
    """Return the format of a name, for a file with this ending (in either case).

    `out`: file to write; `format`: name; `allowed`: names of formats.
    Raises ExchangeError: another name, or the file's ending is not the format's.
    """
    form = _known(format, allowed)
    if out.suffix.lower() not in form.endings:
        raise ExchangeError(
            f"{out.name}: a file of format {format} ends with {' or '.join(form.endings)}",
            {"asked": out.suffix, "allowed": list(form.endings)},
        )
    return form


def write_geometry(geometry: ScanGeometry, out: str | PathLike[str], format: str) -> None:
    """Write a geometry in a peer's format; some formats are made of a data set
    (`export_dataset`).

    Raises:
        ExchangeError: the format cannot carry it, or the file's ending is not the format's.
    """
    out = Path(out)
    form = _to_write(out, format, exported())
    write_whole(out, _content(geometry, form, out))


def save_geometry(geometry: ScanGeometry, out: str | PathLike[str]) -> None:
    """Write a geometry file: .json (everything) or .npy (cone_vec alone).

    The file appears only when complete, in place of one of this name.

    Raises:
        ExchangeError: another ending.
    """
    out = Path(out)
    ending = out.suffix.lower()
    if ending not in OWN_ENDINGS:
        raise ExchangeError(
            f"{out.name}: a geometry file ends with {' or '.join(OWN_ENDINGS)}"
        )
    if ending == NPY:
        write_whole(out, _content(geometry, FORMATS["astra"], out))
    else:
        write_whole(out, geometry_text(geometry))


def load_geometry(path: str | PathLike[str]) -> ScanGeometry:
    """Read a geometry file that `flexdt import` (or `save_geometry`) wrote.

    Raises:
        ExchangeError: it is no geometry file.
        OSError: it cannot be read.
    """
    file = Path(path)
    if file.suffix.lower() == NPY:
        geometry = read_vectors_array(arrays_of(file)["array"], str(file))
    else:
        geometry = read_geometry_text(text_of(file), str(file))
    return _with_doubts(geometry, file)


def load_stated(
    file: File,
    format: str | None = None,
    shape: Shape2 | None = None,
    pixel: float | Sequence[float] | None = None,
) -> ScanGeometry:
    """Read a geometry from a file, with what became of the file's values, and what is new to
    a user as notes.

    Args:
        file: its path.
        format: name of `FORMATS`; None: that of the file's ending, where .json is
            flexdt's own document or a CTSimU scenario.
        shape: detector (rows, cols), for formats that lack it; others must agree.
        pixel: its edge, or edges along columns and rows [mm], likewise.

    Raises:
        ExchangeError: an unknown format or ending, an invalid file, or one that
            contradicts shape or pixel.
    """
    path = Path(file)
    pitch = None if pixel is None else _pair(pixel)
    # Numbers of a damaged file may have any size; what they contradict is found by checks.
    with np.errstate(all="ignore"):
        if format is None and path.suffix.lower() == OWN_ENDINGS[0]:
            return _json(path, Given(shape, pitch))
        chosen = format or format_of_ending(
            path, [form for form in FORMATS.values() if form.read]
        )
        return import_geometry(path, chosen, Given(shape, pitch))


def is_geometry_file(path: Path) -> bool:
    """Return whether a file has the ending of a geometry that is read."""
    endings = {end for one in FORMATS.values() if one.read for end in one.endings}
    return path.is_file() and path.suffix.lower() in {*endings, *OWN_ENDINGS}


def stated_in(path: Path) -> ScanGeometry:
    """Read a geometry's file for what it states; a pixel that it cannot know is 1 mm.

    Raises:
        ExchangeError: as `load_stated`.
    """
    ending = path.suffix.lower()
    bare = any(one.no_pixel and ending in one.endings for one in FORMATS.values())
    return load_stated(path, pixel=1.0 if bare else None)


def _json(path: Path, given: Given) -> ScanGeometry:
    """Read our own document, or a CTSimU scenario, by its content.

    A document with a "file" section is a scenario. Notes that our own document keeps are left
    out: they were told when it was written.

    `path`: file; `given`: shape and pitch, which must agree with the file's or complete it.
    Raises ExchangeError: the file is neither; GeometryError: it contradicts `given`.
    """
    document = read_json(text_of(path), str(path))
    if "file" in document:
        return import_geometry(path, "ctsimu", given)
    stored = load_geometry(path)
    kept = document.get("notes") or ()
    stored = replace(stored, notes=tuple(n for n in stored.notes if n not in kept))
    if given.shape is not None:
        stored.cone_vec.with_shape(stored.shape).of_shape(given.shape)
    given.check_pitch(stored, path)
    return stored if stored.shape is not None else replace(stored, shape=given.shape)


def format_of_ending(path: Path, among: Iterable[Format]) -> str:
    """Return the name of the format with a file's ending, in either case; .json is flexdt's own
    document, which callers read first, and matches none.

    Args:
        path: file.
        among: the formats.

    Raises:
        ExchangeError: no format has this ending; the message lists all.
    """
    by_ending = {
        ending: form.name
        for form in among
        for ending in form.endings
        if ending != OWN_ENDINGS[0]
    }
    name = by_ending.get(path.suffix.lower())
    if name is None:
        endings = [OWN_ENDINGS[0], *by_ending]
        raise ExchangeError(
            f"{path.name}: the ending of a geometry file is one of {', '.join(endings)}",
            {"asked": path.suffix, "allowed": endings},
        )
    return name


def _pair(pixel: float | Sequence[float]) -> tuple[float, float]:
    """Convert one pixel edge, or two along columns and rows, to two floats [mm].

    Raises:
        GeometryError: anything but one or two numbers above 0.
    """
    try:
        along_columns, along_rows = np.broadcast_to(
            np.asarray(pixel, dtype=np.float64), (2,)
        )
    except (TypeError, ValueError):
        along_columns = along_rows = math.nan
    if not (along_columns > 0 and along_rows > 0):
        raise GeometryError(
            f"pixel is {pixel!r}; allowed: one number or two above 0 [mm]",
            {"asked": repr(pixel), "allowed": "> 0"},
        )
    return float(along_columns), float(along_rows)


def with_geometry(dataset: Images, geometry: ScanGeometry | ConeVec | File) -> Images:
    """Return the data set with its nominal geometry replaced and no correction in force.

    The geometry may lack a shape; then only the number of views is compared. Motor
    positions and images stay.

    Args:
        dataset: from `load_dataset`.
        geometry: one row for each of its projections, or its file.

    Raises:
        ExchangeError: another number of projections, or another detector.
    """
    if not isinstance(geometry, ScanGeometry | ConeVec):
        geometry = load_stated(geometry)
    if isinstance(geometry, ConeVec):
        geometry = ScanGeometry(geometry, geometry.detector_shape)
    if len(geometry) != len(dataset):
        message = (
            f"{dataset.where} has {len(dataset)} projections, the geometry "
            f"{len(geometry)} views"
        )
        raise ExchangeError(message, {"asked": len(geometry), "allowed": len(dataset)})
    if geometry.shape not in (None, dataset.shape):
        raise ExchangeError(
            f"{dataset.where} has images of {shape_words(dataset.shape)}, the geometry is of "
            f"{shape_words(geometry.shape)} "
            "(rows, columns)",
            {"asked": geometry.shape, "allowed": list(dataset.shape)},
        )
    # Its correction belongs to the geometry that is replaced.
    values = dataset.provenance.replaced((Part.GEOMETRY, Part.ANGLES), "geometry=")
    return replace(
        dataset,
        cone_vec=geometry.cone_vec,
        nominal=None,
        correction=None,
        provenance=values.and_also(geometry.provenance),
        warnings=(*dataset.warnings, *geometry.notes),
    )
