"""Read Zeiss's .txrm.

Signs on which CIL's ZEISSDataReader 26.0, dxchange, xrmreader and mbirjax agree: row 0 is the
lowest, column 0 the left one as seen from the source; the stage turns anticlockwise by `Angles`
[deg] seen from above; `PixelSize` [um] is that of a pixel at the axis; shifts [pixels] take an
image to higher columns and rows; counts are not divided by the reference, an image of the open
beam, and nothing is left to subtract from either.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.library.data_set import DataSet
from flexdt.library.optional.extras import package
from flexdt.library.reading.zeiss_table import ZEISS
from flexdt.runtime.files.reading_within import opened
from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.dataset.format_table import ANGLES, GEOMETRY, Ledger
from flexdt.twin.dataset.scan_settings import ScanSettings
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray, rotation_z

KINDS: Final = {3: "u1", 5: "<u2", 10: "<f4"}
"""Xradia's number of a pixel type -> type of NumPy."""
REFERENCES: Final = ("ReferenceData", "MultiReferenceData")
"""Storages with images of the open beam, `Image` or `Image1` and so on."""
NOT_APPLIED: Final = ("ImageInfo/CameraOffset", "ImageInfo/CameraFineRotation")
VOLTAGE: Final = "ImageInfo/Voltage"
SHOWN: Final = ("ImageInfo/", "ReconSettings/", "Alignment/")
"""Beginnings of the streams whose numbers the provenance shows."""
GEOMETRY_HINT: Final = ", or give it: geometry=ConeVec"


def read_zeiss(path: Path, geometry: ConeVec | None) -> DataSet:
    """Read a scan of Zeiss's into memory.

    Any error of the parser is the file's error.

    Args:
        path: the .txrm file.
        geometry: one view for each projection, in place of the file's; None for the
            file's.

    Raises:
        DatasetFormatError: it is no OLE2 file, is damaged, or lacks data.
        TwinError: the package olefile is not installed.
    """
    olefile = package("olefile", "Zeiss's .txrm")
    try:
        with opened(path) as raw:
            head = raw.read(76)
            size = os.fstat(raw.fileno()).st_size
            if (
                512 * int.from_bytes(head[44:48], "little") > size
            ):  # of these a list is made
                raise OSError("its list of sectors is longer than itself")
            with olefile.OleFileIO(raw, raise_defects=olefile.DEFECT_INCORRECT) as ole:
                streams = _Streams(ole, size, _stated(ole, path))
                return _read(streams, geometry, path.stem)
    except TwinError as error:
        said = error.message
    except Exception:  # a third party's parser on a damaged file: anything may come
        said = "it is no OLE2 file, or a damaged one"
    raise DatasetFormatError(f"{path}: {said}", {"path": str(path)})


@dataclass(frozen=True)
class _Streams:
    """An open file, its size [bytes], which bounds whatever it claims of itself, and its
    streams."""

    ole: Any
    size: int
    said: Ledger

    def values(
        self,
        name: str,
        kind: str,
        count: int = 1,
        default: float | None = None,
        hint: str = "",
    ) -> npt.NDArray[Any]:
        """Read the first numbers of a stream; the default where the stream is missing.

        Args:
            name: of the stream.
            kind: type of the numbers.
            count: of numbers.
            default: of a missing stream; None makes that an error.
            hint: added to the message.

        Raises:
            DatasetFormatError: the stream is missing without default, too short, or longer
                than the file.
        """
        there = self.ole.exists(name)
        if not there and default is not None:
            return np.full(count, default)
        wanted = count * np.dtype(kind).itemsize
        held = self.ole.get_size(name) if there else 0
        if not wanted <= held <= self.size:
            if there:
                said = f"has {held} bytes"
            else:
                said = "is missing"
            raise DatasetFormatError(
                f"{name} {said}; allowed: {wanted} to {self.size} bytes{hint}"
            )
        found = np.frombuffer(self.ole.openstream(name).read(wanted), kind)
        self.said.use(name)
        if name.startswith(SHOWN):
            ends = f"{found[0]:g}" if count == 1 else f"{found[0]:g} to {found[-1]:g}"
            self.said.shown(name, ends)
        return found

    def whole(self, name: str, default: float | None = None) -> int:
        return int(self.values(name, "<u4", default=default)[0])

    def voltage(self) -> ScanSettings | None:
        """Take the tube's voltage; settings with it alone, None without one above 0."""
        held = self.ole.get_size(VOLTAGE) if self.ole.exists(VOLTAGE) else 0
        value = float(self.values(VOLTAGE, "<f4")[0]) if 4 <= held <= self.size else 0.0
        if 0.0 < value < np.inf:
            return ScanSettings(kV=value)
        self.said.ignore(VOLTAGE, "it is no voltage above 0")
        return None

    def images(
        self, names: Sequence[str], code: int, shape: tuple[int, int]
    ) -> npt.NDArray[Any]:
        """Read images (k, rows, cols) from streams, one each.

        `names`: of the streams; `code`: of the type, DataType; `shape`: (rows, cols).
        Raises DatasetFormatError: an unknown type, or a stream of another length.
        """
        if code not in KINDS:
            raise DatasetFormatError(
                f"DataType is {code}; allowed: {', '.join(map(str, KINDS))}"
            )
        out = np.empty((len(names), *shape), KINDS[code])
        for image, name in zip(out, names, strict=True):
            image[:] = self.values(name, KINDS[code], image.size).reshape(shape)
        return out

    def lengths(self, name: str, count: int) -> FloatArray:
        """Read lengths (count,) of a stream of `ImageInfo`, without their signs, in its
        unit.

        Raises:
            DatasetFormatError: the stream is missing or too short, or one of them is 0 or
                not finite.
        """
        found = abs(
            self.values(f"ImageInfo/{name}", "<f4", count, hint=GEOMETRY_HINT).astype(
                np.float64
            )
        )
        if not np.all((found > 0) & np.isfinite(found)):
            raise DatasetFormatError(
                f"{name} is {found.min():g}; allowed: above 0{GEOMETRY_HINT}"
            )
        return found


def _read(file: _Streams, geometry: ConeVec | None, name: str) -> DataSet:
    """Read the images, reference and geometry of an open file into a data set in memory.

    Images of floats are divided by the mean reference and given as line integrals; other
    images stay counts, with the reference as flat images. Dark is zero. Fewer images than
    planned make it incomplete; counts without a reference are a warning.

    Args:
        file: its streams.
        geometry: in place of the file's, or None.
        name: of the data set.

    Raises:
        DatasetFormatError: no images were taken, more are claimed than the file can hold,
            floats have no reference, or the geometry is not supported (see `_geometry`).
    """
    sizes = "ImageHeight", "ImageWidth", "NoOfImages", "DataType"
    rows, cols, planned, code = (file.whole(f"ImageInfo/{n}") for n in sizes)
    taken = min(file.whole("ImageInfo/ImagesTaken", planned), planned)
    if not 0 < taken * rows * cols <= file.size:
        said = (
            f"{taken} images of {cols} x {rows} pixels are claimed in {file.size} bytes"
        )
        raise DatasetFormatError(said)
    if geometry is None:
        cone, doubts = _geometry(file, taken, rows)
    else:
        cone, doubts = geometry, []
        file.said.give((GEOMETRY, ANGLES), "geometry=")
    names = [f"ImageData{k // 100 + 1}/Image{k + 1}" for k in range(taken)]
    images = file.images(names, code, (rows, cols))
    flats = _reference(file, code, (rows, cols))
    if images.dtype.kind == "f":
        if flats is None:
            raise DatasetFormatError(
                f"images of floats; allowed: with {REFERENCES[0]}/Image"
            )
        # NaN and inf are rejected later with the file's name.
        with np.errstate(all="ignore"):
            images = images / np.maximum(flats.mean(axis=0), 1e-6 * flats.max())
            images = -np.log(np.maximum(images, np.finfo(np.float32).tiny))
            flats = None
    elif flats is None:
        doubts.append(
            "no reference: DataSet.from_arrays(data.counts(), data.geometry, flat=FLAT)"
        )
    dark = np.zeros((rows, cols))
    data = DataSet.from_arrays(
        images, cone, dark=dark, flat=flats, name=name, warnings=doubts
    )
    if taken < planned:
        reason = f"{taken} of {planned} images were taken"
    else:
        reason = ""
    voltage = file.voltage()
    values = file.said.finish()
    return replace(
        data,
        complete=not reason,
        reason=reason,
        warnings=(*data.warnings, *file.said.warnings),
        provenance=values,
        settings=voltage,
    )


def _stated(ole: Any, path: Path) -> Ledger:
    """Enter the streams of an open file, with their sizes; images as one.

    Args:
        ole: the file.
        path: for messages.
    """
    said = Ledger(ZEISS, str(path))
    images = 0
    for parts in ole.listdir():
        name = "/".join(parts)
        if name.startswith("ImageData"):
            images += 1
        else:
            said.state(name, f"{ole.get_size(name)} bytes")
    said.state("ImageData*", f"{images} images")
    said.use("ImageData*")
    return said


def _reference(
    file: _Streams, code: int, shape: tuple[int, int]
) -> npt.NDArray[Any] | None:
    """Read the images of the open beam, (k, rows, cols); None without any.

    The first folder of REFERENCES with images counts, `Image` to `Image999`. `code`:
    pixels' type, if not stated for these. Raises DatasetFormatError: not finite, unknown
    type, or another size.
    """
    for folder in REFERENCES:
        names = [
            n for k in range(1000) if file.ole.exists(n := f"{folder}/Image{k or ''}")
        ]
        if names:
            for name in names:
                file.said.use(name)
            images = file.images(names, file.whole(f"{folder}/DataType", code), shape)
            if not np.isfinite(images).all():
                raise DatasetFormatError(f"{names[0]} has pixels that are no numbers")
            return images
    return None


def _geometry(file: _Streams, views: int, rows: int) -> tuple[ConeVec, list[str]]:
    """Read the geometry, and list doubts about it.

    The panel's pixel is the one at the axis times the first view's magnification; image
    shifts and CenterShift move the panel. Doubts: values that are not applied
    (`NOT_APPLIED`), and a CenterShift that is.

    Args:
        file: its streams.
        views: number of images taken.
        rows: of an image.

    Returns:
        The geometry, without a shape, and the doubts as sentences.

    Raises:
        DatasetFormatError: a parallel beam, or a stage that rises by more than a quarter
            of the image's height at the axis.
    """
    if file.whole("ImageInfo/XrayGeometry", 1) != 1:
        raise DatasetFormatError(
            "XrayGeometry says a parallel beam; allowed: a cone beam"
        )
    near = file.lengths("StoRADistance", views)
    far = file.lengths("DtoRADistance", views)
    size = file.lengths("PixelSize", 1) / 1000.0
    rise = np.ptp(file.values("ImageInfo/YPosition", "<f4", views, 0.0)) / 1000.0
    if (
        rise > 0.25 * rows * size
    ):  # Shifts undo the small steps against rings, and no more.
        raise DatasetFormatError(
            f"the stage rises by YPosition; allowed: a circle{GEOMETRY_HINT}"
        )
    pixel = size * (near[:1] + far[:1]) / near[:1]
    center = file.values("ReconSettings/CenterShift", "<f4", default=0.0)
    shifts = (file.values(f"Alignment/{axis}-Shifts", "<f4", views, 0.0) for axis in "XY")
    right, up = (
        pixel * (shift + more) for shift, more in zip(shifts, (center, 0), strict=True)
    )
    angles = np.deg2rad(
        file.values("ImageInfo/Angles", "<f4", views, hint=GEOMETRY_HINT),
        dtype=np.float64,
    )
    stated = {name: file.values(name, "<f4", default=0.0)[0] for name in NOT_APPLIED}
    doubts = [
        f"{name} of {value:g} is not applied" for name, value in stated.items() if value
    ]
    for name in NOT_APPLIED:
        file.said.ignore(name, "it is not applied" if stated[name] else "it is 0")
    if center[0]:
        doubts.append(f"CenterShift of {center[0]:g} pixels is applied")
    o = np.zeros(views)
    p = np.full(views, pixel)
    place = np.stack([o, -near, o, right, far, up, p, o, o, o, o, p], axis=-1).reshape(
        -1, 4, 3
    )
    return ConeVec((place @ rotation_z(angles)).reshape(-1, 12)), doubts
