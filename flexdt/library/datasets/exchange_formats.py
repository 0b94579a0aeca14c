"""Formats of other programs for geometry: names, endings, and the functions that write and
read.

`FORMATS` lists them once. The command line takes its choices from it before it imports
anything heavy, so each function has its own imports.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

if TYPE_CHECKING:
    from flexdt.library.datasets.geometry_content import Given
    from flexdt.library.datasets.image_set import ImageSet
    from flexdt.twin.exchange.geometry import ScanGeometry
    from flexdt.twin.geometry.offsets import Offsets

Content = str | bytes
NPY: Final = ".npy"
OWN_ENDINGS: Final = (".json", NPY)
"""Of flexdt's own geometry files: everything, or cone_vec alone."""


@dataclass(frozen=True)
class Format:
    """One program's format.

    Attributes:
        name: of the format, as `--format` takes it.
        endings: of its files, in lower case.
        write: from a geometry and the path to the file's content; None: it takes a data set.
        export: writes a data set (dataset, path, correction, true offsets unknown to a
            reconstruction); None: its geometry is written.
        read: from a path and values that its file does not state to a geometry; None: it
            is not read.
        rows: where the format fixes it, the way in which rows are counted.
        no_pixel: its files do not know the pixel's size.
        states_unknown: it separates true offsets from those that a reconstruction knows.
    """

    name: str
    endings: tuple[str, ...]
    write: Callable[[ScanGeometry, Path], Content] | None = None
    export: Callable[[ImageSet, Path, Offsets | None, Offsets | None], None] | None = None
    read: Callable[[Path, Given], ScanGeometry] | None = None
    rows: Literal["down", "up"] | None = None
    states_unknown: bool = False
    no_pixel: bool = False


def exported() -> tuple[str, ...]:
    """Names of the formats that a data set is written in."""
    return tuple(name for name, form in FORMATS.items() if form.export or form.write)


def imported() -> tuple[str, ...]:
    """Names of the formats that are read."""
    return tuple(name for name, form in FORMATS.items() if form.read)


def _export_ctsimu(
    dataset: ImageSet, out: Path, parameters: Offsets | None, real: Offsets | None
) -> None:
    """Write a data set's geometry as a CTSimU scenario; `real` adds the deviations from the
    known one.

    Raises TwinError: flexdt-extensions is not installed."""
    from flexdt.library.optional.extras import extension
    from flexdt.runtime.files.whole_files import write_whole

    scenario = extension("ctsimu.export", "the format ctsimu")(dataset, parameters, real)
    write_whole(out, json.dumps(scenario, indent=1) + "\n")


def _read_ctsimu(path: Path, given: Given) -> ScanGeometry:
    """Read the geometry of a CTSimU scenario, with the files that it names.

    Raises TwinError: flexdt-extensions is not installed; ExchangeError: the file is no scenario.
    """
    from flexdt.library.datasets.geometry_content import text_of
    from flexdt.library.optional.extras import extension

    read: Callable[..., ScanGeometry] = extension("ctsimu.import", "the format ctsimu")
    return read(text_of(path), str(path), lambda other: text_of(path.parent / other))


def _write_rtk(geometry: ScanGeometry, out: Path) -> Content:
    from flexdt.twin.exchange.rtk_xml import rtk_text

    return rtk_text(geometry)


def _read_rtk(path: Path, given: Given) -> ScanGeometry:
    """Read a geometry of RTK, with the pitch and shape of `given`.

    The pitch [mm] is not in RTK's file.

    Raises:
        ExchangeError: the file is invalid, or no pitch is given (checked after the file).
    """
    from flexdt.library.datasets.geometry_content import text_of
    from flexdt.twin.exchange.geometry import ExchangeError
    from flexdt.twin.exchange.rtk_xml import read_rtk

    # That it is no file of RTK is reported before a missing pitch or shape.
    geometry = read_rtk(
        text_of(path), given.pitch_mm or (1.0, 1.0), given.shape, str(path)
    )
    if given.pitch_mm is None:
        raise ExchangeError(
            f"{path}: RTK's file does not know the pixel size; give pixel= [mm] "
            "(--pixel or --like on the command line)"
        )
    return geometry


def _write_astra(geometry: ScanGeometry, out: Path) -> Content:
    """Return ASTRA's vectors (n, 12) as text, or as the bytes of an .npy file if `out`
    ends in .npy; `out` is not written.
    """
    import numpy as np

    from flexdt.twin.exchange.number_tables import vectors_text

    if out.suffix.lower() != NPY:
        return vectors_text(geometry)
    buffer = io.BytesIO()
    np.save(buffer, geometry.cone_vec.rows, allow_pickle=False)
    return buffer.getvalue()


def _read_astra(path: Path, given: Given) -> ScanGeometry:
    """Read ASTRA's vectors from a file that ends in .npy, or else from text; the panel's
    shape is that of `given`.

    Raises:
        ExchangeError: the file has no rows of twelve numbers.
    """
    from flexdt.library.datasets.geometry_content import arrays_of, text_of
    from flexdt.twin.exchange.number_tables import read_vectors_array, read_vectors_text

    if path.suffix.lower() == NPY:
        geometry = read_vectors_array(arrays_of(path)["array"], str(path))
    else:
        geometry = read_vectors_text(text_of(path), str(path))
    return replace(geometry, shape=given.shape)


def _write_tomosipo(geometry: ScanGeometry, out: Path) -> Content:
    from flexdt.twin.exchange.number_tables import tomosipo_arrays

    return _array_file(tomosipo_arrays(geometry))


def _read_tomosipo(path: Path, given: Given) -> ScanGeometry:
    """Read tomosipo's vectors from an .npz file; `given` is ignored."""
    from flexdt.library.datasets.geometry_content import arrays_of
    from flexdt.twin.exchange.number_tables import read_tomosipo

    return read_tomosipo(arrays_of(path), str(path))


def _array_file(arrays: Mapping[str, Any]) -> bytes:
    """Return arrays as the bytes of an uncompressed .npz file."""
    import numpy as np

    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def _write_cil(geometry: ScanGeometry, out: Path) -> Content:
    from flexdt.twin.exchange.cil_arrays import cil_arrays

    return _array_file(cil_arrays(geometry))


def _read_cil(path: Path, given: Given) -> ScanGeometry:
    """Read CIL's arrays from an .npz file; `given` is ignored."""
    from flexdt.library.datasets.geometry_content import arrays_of
    from flexdt.twin.exchange.cil_arrays import read_cil

    return read_cil(arrays_of(path), str(path))


def _write_tigre(geometry: ScanGeometry, out: Path) -> Content:
    from flexdt.twin.exchange.tigre_arrays import tigre_arrays

    return _array_file(tigre_arrays(geometry))


def _read_tigre(path: Path, given: Given) -> ScanGeometry:
    """Read TIGRE's arrays from an .npz file; `given` is ignored."""
    from flexdt.library.datasets.geometry_content import arrays_of
    from flexdt.twin.exchange.tigre_arrays import read_tigre

    return read_tigre(arrays_of(path), str(path))


def _write_leap(geometry: ScanGeometry, out: Path) -> Content:
    from flexdt.twin.exchange.leap_arrays import leap_arrays

    return _array_file(leap_arrays(geometry))


def _read_leap(path: Path, given: Given) -> ScanGeometry:
    """Read LEAP's arrays from an .npz file; `given` is ignored."""
    from flexdt.library.datasets.geometry_content import arrays_of
    from flexdt.twin.exchange.leap_arrays import read_leap

    return read_leap(arrays_of(path), str(path))


def _write_flexdata(geometry: ScanGeometry, out: Path) -> Content:
    from flexdt.twin.exchange.flexdata import flexdata_text

    return flexdata_text(geometry)


def _read_flexdata(path: Path, given: Given) -> ScanGeometry:
    """Read flexdata's text; number of views and shape are those of `given`."""
    from flexdt.library.datasets.geometry_content import text_of
    from flexdt.twin.exchange.flexdata import read_flexdata

    return read_flexdata(text_of(path), given.views, given.shape, str(path))


def _write_csv(geometry: ScanGeometry, out: Path) -> Content:
    from flexdt.twin.exchange.number_tables import csv_text

    return csv_text(geometry)


def _read_csv(path: Path, given: Given) -> ScanGeometry:
    """Read a table of vectors, one view a line; `given` is ignored."""
    from flexdt.library.datasets.geometry_content import text_of
    from flexdt.twin.exchange.number_tables import read_csv

    return read_csv(text_of(path), str(path))


def _export_nxtomo(
    dataset: ImageSet, out: Path, parameters: Offsets | None, real: Offsets | None
) -> None:
    """Write a complete data set as NXtomo, with other offsets if `parameters` are given; `real`
    is ignored. Raises DatasetMissingError: the data set is incomplete."""
    from flexdt.library.datasets.nxtomo_writing import save_nxtomo

    whole = dataset.require_complete()
    save_nxtomo(whole if parameters is None else whole.with_correction(parameters), out)


FORMATS: Final[Mapping[str, Format]] = {
    form.name: form
    for form in (
        Format(
            "ctsimu",
            (".json",),
            export=_export_ctsimu,
            read=_read_ctsimu,
            rows="down",
            states_unknown=True,
        ),
        Format("rtk", (".xml", ".rtk"), _write_rtk, read=_read_rtk, no_pixel=True),
        Format("astra", (NPY, ".txt", ".geom", ".dat"), _write_astra, read=_read_astra),
        Format("tomosipo", (".npz",), _write_tomosipo, read=_read_tomosipo),
        Format("cil", (".cil",), _write_cil, read=_read_cil),
        Format("tigre", (".tigre",), _write_tigre, read=_read_tigre),
        Format("leap", (".leap",), _write_leap, read=_read_leap),
        Format("flexdata", (".toml",), _write_flexdata, read=_read_flexdata, rows="up"),
        Format("csv", (".csv",), _write_csv, read=_read_csv),
        Format(
            "nxtomo", (".nxs", ".nx", ".h5", ".hdf5"), export=_export_nxtomo, rows="down"
        ),
    )
}
"""Name -> format, in the order of listings."""
