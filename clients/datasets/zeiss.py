"""Zeiss's .txrm: images and numbers in the streams of an OLE2 file.

Its maker does not describe it; signs are those on which CIL's ZEISSDataReader 26.0, dxchange,
xrmreader and mbirjax agree. Row 0 is the lowest, column 0 the left one as seen from the source. The
stage turns anticlockwise by `Angles` [deg] seen from above. `PixelSize` [um] is that of a pixel at
the axis. Shifts [pixels] take an image to higher columns and rows. Counts are not divided by the
reference, an image of the open beam, and nothing is left to subtract from either.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.clients.datasets.data_set import DataSet
from flexdt.clients.datasets.listed_images import log_of
from flexdt.clients.extras import package
from flexdt.runtime.files.dataset_folder import opened
from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.cone_vec import ConeVec

KINDS: Final = {3: "u1", 5: "<u2", 10: "<f4"}
"""Xradia's numbers of types of pixels."""
SIZES: Final = ("ImageHeight", "ImageWidth", "NoOfImages")
CONE: Final = 1
NOT_APPLIED: Final = ("ImageInfo/CameraOffset", "ImageInfo/CameraFineRotation")
GIVE: Final = ", or give it: geometry=ConeVec"


def open_txrm(path: Path, geometry: ConeVec | None) -> DataSet:
    """The data set in a .txrm file; a geometry replaces the one that it says.

    Raises:
        DatasetError: it is damaged or lacks what is needed; says what.
    """
    olefile = package("olefile", "Zeiss's .txrm")
    try:
        with opened(path) as raw:
            head, size = raw.read(76), os.fstat(raw.fileno()).st_size
            if 512 * int.from_bytes(head[44:48], "little") > size:  # of these a list is made
                raise OSError("its list of sectors is longer than itself")
            with olefile.OleFileIO(raw, raise_defects=olefile.DEFECT_INCORRECT) as ole:
                return _read(_Streams(ole, size), geometry, path.stem)
    except TwinError as error:
        said = error.message
    except Exception as error:  # A third party's parser on a damaged file: anything may come.
        said = f"it is no OLE2 file, or a damaged one ({error})"
    raise DatasetFormatError(f"{path}: {said}", {"path": str(path)})


@dataclass(frozen=True)
class _Streams:
    """An open file and its size [bytes], which bounds whatever it claims of itself."""

    ole: Any
    size: int

    def values(
        self, name: str, kind: str, count: int = 1, default: float | None = None, hint: str = ""
    ) -> npt.NDArray[Any]:
        """The first numbers of a stream; where there is none, the default."""
        there = self.ole.exists(name)
        if not there and default is not None:
            return np.full(count, default)
        wanted, held = count * np.dtype(kind).itemsize, self.ole.get_size(name) if there else 0
        if not wanted <= held <= self.size:
            said = f"has {held} bytes" if there else "is missing"
            raise DatasetFormatError(f"{name} {said}; allowed: {wanted} to {self.size} bytes{hint}")
        return np.frombuffer(self.ole.openstream(name).read(wanted), kind)

    def whole(self, name: str, default: float | None = None) -> int:
        return int(self.values(name, "<u4", default=default)[0])

    def kind(self, name: str) -> str:
        code = self.whole(name)
        if code not in KINDS:
            raise DatasetFormatError(f"{name} is {code}; allowed: {', '.join(map(str, KINDS))}")
        return KINDS[code]

    def images(self, names: Sequence[str], kind: str, shape: tuple[int, int]) -> npt.NDArray[Any]:
        out = np.empty((len(names), *shape), kind)
        for image, name in zip(out, names, strict=True):
            image[:] = self.values(name, kind, image.size).reshape(shape)
        return out


def _read(file: _Streams, geometry: ConeVec | None, name: str) -> DataSet:
    rows, cols, planned = map(file.whole, (f"ImageInfo/{n}" for n in SIZES))
    taken = min(file.whole("ImageInfo/ImagesTaken", planned), planned)
    kind = file.kind("ImageInfo/DataType")
    if not 0 < taken * rows * cols * np.dtype(kind).itemsize <= file.size:
        raise DatasetFormatError(
            f"{taken} images of {cols} x {rows} pixels are claimed in {file.size} bytes"
        )
    doubts: list[str] = []
    if geometry is None:
        geometry, doubts = _geometry(file, taken, rows)
    names = [f"ImageData{k // 100 + 1}/Image{k + 1}" for k in range(taken)]
    images = file.images(names, kind, (rows, cols))
    flats = _reference(file, kind, (rows, cols))
    if flats is None and kind != "<f4":
        doubts.append("no reference: DataSet.from_arrays(data.counts(), data.geometry, flat=FLAT)")
    elif flats is None:
        said = "images of floats without ReferenceData/Image do not say how bright the beam was"
        raise DatasetFormatError(said)
    elif kind == "<f4":
        images, flats = log_of(images, 0.0, flats.mean(axis=0)), None
    dark = np.zeros((rows, cols))
    data = DataSet.from_arrays(images, geometry, dark=dark, flat=flats, name=name, warnings=doubts)
    if taken < planned:
        data = replace(data, complete=False, reason=f"{taken} of {planned} images were taken")
    return data


def _reference(file: _Streams, kind: str, shape: tuple[int, int]) -> npt.NDArray[Any] | None:
    """The images of the open beam, one or several."""
    several = file.ole.exists("MultiReferenceData/Image1")
    folder = "MultiReferenceData" if several else "ReferenceData"
    wanted = (f"{folder}/Image{k if several else ''}" for k in range(1, 1 << 16 if several else 2))
    names = list(takewhile(file.ole.exists, wanted))
    if not names:
        return None
    if file.ole.exists(f"{folder}/DataType"):
        kind = file.kind(f"{folder}/DataType")
    images = file.images(names, kind, shape)
    if not np.isfinite(images).all():
        raise DatasetFormatError(f"{folder} has pixels that are no numbers; allowed: finite")
    return images


def _geometry(file: _Streams, views: int, rows: int) -> tuple[ConeVec, list[str]]:
    """The geometry, and what is doubtful about it."""
    if file.whole("ImageInfo/XrayGeometry", CONE) != CONE:
        raise DatasetFormatError("XrayGeometry says a parallel beam; allowed: a cone beam")
    near, far, angles = (
        file.values(f"ImageInfo/{name}", "<f4", views, hint=GIVE).astype(np.float64)
        for name in ("StoRADistance", "DtoRADistance", "Angles")
    )
    near, far = abs(near), abs(far)
    size = float(file.values("ImageInfo/PixelSize", "<f4", hint=GIVE)[0]) / 1000.0
    for name, value in (("StoRADistance", near), ("DtoRADistance", far), ("PixelSize", size)):
        if not np.all((value > 0) & np.isfinite(value)):
            raise DatasetFormatError(f"{name} is {np.min(value):g}; allowed: above 0{GIVE}")
    if np.ptp(file.values("ImageInfo/YPosition", "<f4", views, 0.0)) > 250.0 * rows * size:
        raise DatasetFormatError(f"the stage rises by YPosition; allowed: a circle{GIVE}")
    pixel = size * (near[0] + far[0]) / near[0]
    right, up = (
        pixel * file.values(f"Alignment/{axis}-Shifts", "<f4", views, 0.0).astype(np.float64)
        for axis in "XY"
    )
    center = float(file.values("ReconSettings/CenterShift", "<f4", default=0.0)[0])
    right = right + center * pixel
    c, s, o = np.cos(np.deg2rad(angles)), np.sin(np.deg2rad(angles)), np.zeros(views)
    source, u, v = (-s * near, -c * near, o), (c * pixel, -s * pixel, o), (o, o, o + pixel)
    detector = (c * right + s * far, c * far - s * right, up)
    doubts = [
        f"{name} of {value:g} is not applied"
        for name in NOT_APPLIED if (value := file.values(name, "<f4", default=0.0)[0]) != 0
    ]  # fmt: skip
    if center:
        doubts.append(f"CenterShift of {center:g} pixels is applied: data.align() tells its worth")
    return ConeVec(np.stack([*source, *detector, *u, *v], axis=-1)), doubts
