"""Open scans in files of other programs: the list of their formats.

`SCAN_FORMATS` is the only list of them; each format is read by a module of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NoReturn

from flexdt.library.data_set import DataSet
from flexdt.library.datasets.exchange_formats import FORMATS
from flexdt.library.reading.foreign_parsing import parsing
from flexdt.library.reading.hdf5_formats.dxchange_reading import (
    is_data_exchange,
    read_data_exchange,
)
from flexdt.library.reading.hdf5_formats.dxchange_table import DATA_EXCHANGE
from flexdt.library.reading.hdf5_formats.nxtomo_reading import read_nxtomo
from flexdt.library.reading.hdf5_formats.nxtomo_table import NXTOMO
from flexdt.library.reading.text_formats.nikon_reading import read_nikon
from flexdt.library.reading.text_formats.nikon_table import NIKON
from flexdt.library.reading.text_formats.phoenix_reading import read_phoenix
from flexdt.library.reading.text_formats.phoenix_table import PHOENIX
from flexdt.library.reading.text_formats.skyscan_reading import is_skyscan, read_skyscan
from flexdt.library.reading.text_formats.skyscan_table import SKYSCAN
from flexdt.library.reading.text_formats.yxlon_reading import is_yxlon, read_yxlon
from flexdt.library.reading.text_formats.yxlon_table import YXLON
from flexdt.library.reading.varian_formats.varian_reading import is_varian, read_varian
from flexdt.library.reading.varian_formats.varian_table import VARIAN
from flexdt.library.reading.zeiss_reading import read_zeiss
from flexdt.library.reading.zeiss_table import ZEISS
from flexdt.runtime.files.image_files import raw_advice
from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.dataset.format_table import FormatTable
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray


@dataclass(frozen=True)
class ScanFormat:
    """A format of whole scans: images with their geometry.

    Attributes:
        name: of the format or its maker.
        endings: of its files, in lower case.
        read: from a path and a geometry in place of the file's, or None, to the data set.
        distant: whether `read` takes distances and angles [deg] too, where the file lacks
            them; either may be None.
        table: of its fields; None where it has none yet.
        holds: whether a file with such an ending is of this format; None: every one is.
    """

    name: str
    endings: tuple[str, ...]
    read: Callable[..., DataSet]
    distant: bool = False
    table: FormatTable | None = None
    holds: Callable[[Path], bool] | None = None


SCAN_FORMATS: Final = (
    ScanFormat("Nikon", (".xtekct",), read_nikon, table=NIKON),
    ScanFormat("SkyScan", (".log",), read_skyscan, table=SKYSCAN, holds=is_skyscan),
    ScanFormat("phoenix", (".pca",), read_phoenix, table=PHOENIX),
    ScanFormat("YXLON", (".xml",), read_yxlon, table=YXLON, holds=is_yxlon),
    ScanFormat("Varian", (".xml",), read_varian, table=VARIAN, holds=is_varian),
    ScanFormat("Zeiss", (".txrm",), read_zeiss, table=ZEISS),
    ScanFormat(
        "Data Exchange",
        (".h5", ".hdf5", ".hdf"),
        read_data_exchange,
        distant=True,
        table=DATA_EXCHANGE,
        holds=is_data_exchange,
    ),
    ScanFormat(
        "NXtomo", FORMATS["nxtomo"].endings, read_nxtomo, distant=True, table=NXTOMO
    ),
)
"""In the order in which they are listed."""


def open_file(
    path: Path,
    geometry: ConeVec | None,
    distances: tuple[float, float] | None = None,
    angles: FloatArray | None = None,
) -> DataSet:
    """Open the data set in a file, by its ending, whatever its case.

    Args:
        path: of the file.
        geometry: one view for each projection, in place of the file's; None for the
            file's.
        distances: source to axis and to panel [mm]; only for formats that lack them.
        angles: of the projections [deg], for formats whose files may lack them; others do
            without.

    Raises:
        DatasetError: another kind of file, one that is damaged or lacks data, or
            distances with another format; names the formats that are allowed.
    """
    form = format_of(path)
    if form is not None:
        if distances is not None and not form.distant:
            refuse_distances(path, form.name, distances)
        more = (distances, angles) if form.distant else ()
        with parsing(path, form.name):
            return form.read(path, geometry, *more)
    advice = raw_advice(path)
    if advice:
        raise DatasetFormatError(f"{path} {advice}", {"asked": str(path)})
    listed = ", ".join(
        f"{form.name} ({', '.join(form.endings)})" for form in SCAN_FORMATS
    )
    raise DatasetFormatError(
        f"{path} is a file; allowed: a folder, {listed}; else TIFFs with a geometry, "
        "fx.read_tiffs(folder, geometry)",
        {
            "asked": str(path),
            "allowed": [one for form in SCAN_FORMATS for one in form.endings],
        },
    )


def format_of(path: Path) -> ScanFormat | None:
    """Find the format of a file by its ending (of any case) and its content.

    The first whose content it has counts, then the first that checks none. None for an
    unknown ending or other content.
    """
    forms = [form for form in SCAN_FORMATS if path.suffix.lower() in form.endings]
    for form in forms:
        if form.holds is not None and path.is_file() and form.holds(path):
            return form
    return next((form for form in forms if form.holds is None), None)


def refuse_distances(path: Path, name: str, distances: tuple[float, float]) -> NoReturn:
    """Refuse distances with a scan that states its own. `path`: of the scan; `name`: of
    its format; `distances`: source to axis and to panel [mm]. Raises DatasetFormatError:
    names those allowed.
    """
    named = ", ".join(one.name for one in SCAN_FORMATS if one.distant)
    said = f"{path}: distances with a scan of {name}"
    raise DatasetFormatError.instead(said, list(distances), f"with {named}")
