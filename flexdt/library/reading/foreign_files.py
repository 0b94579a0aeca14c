"""Scans in files of other programs: Nikon's .xtekct, Zeiss's .txrm and NXtomo.

Nikon (as CIL's NikonDataReader 25.0 reads it, Apache-2.0;
https://github.com/TomographicImaging/CIL): images are seen from behind the panel, column 0 at the
right as seen from the source; the stage turns clockwise by `AngularStep` a view; images are counts
under an open beam of `WhiteLevel`; the axis stands `ObjectOffsetX` to the left of the line from the
source to the panel's middle.

Zeiss (signs on which CIL's ZEISSDataReader 26.0, dxchange, xrmreader and mbirjax agree): row 0 is
the lowest, column 0 the left one as seen from the source; the stage turns anticlockwise by `Angles`
[deg] seen from above; `PixelSize` [um] is that of a pixel at the axis; shifts [pixels] take an
image to higher columns and rows; counts are not divided by the reference, an image of the open
beam, and nothing is left to subtract from either.

NXtomo has a module of its own.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.library.data_set import DataSet
from flexdt.library.datasets.image_set import Arrays
from flexdt.library.extras import package
from flexdt.library.reading.listed_images import by_numbers, listed
from flexdt.library.reading.nxtomo_reading import read_nxtomo
from flexdt.runtime.files.dataset_folder import list_folder, opened
from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray

NXTOMO: Final = (".nx", ".nxs", ".h5", ".hdf5")
KINDS: Final = {3: "u1", 5: "<u2", 10: "<f4"}
"""Xradia's numbers of types of pixels."""
REFERENCES: Final = ("ReferenceData", "MultiReferenceData")
"""Storages of images of the open beam, `Image` or `Image1` and so on."""
NOT_APPLIED: Final = ("ImageInfo/CameraOffset", "ImageInfo/CameraFineRotation")
GIVE: Final = ", or give it: geometry=ConeVec"


def open_file(path: Path, geometry: ConeVec | None) -> DataSet:
    """The data set in a file; a geometry that is given replaces the file's.

    Raises:
        DatasetError: another kind of file, or one that lacks what is needed; says what.
    """
    readers = {".xtekct": _nikon, ".txrm": _zeiss, **dict.fromkeys(NXTOMO, read_nxtomo)}
    if path.suffix.lower() in readers:
        return readers[path.suffix.lower()](path, geometry)
    raise DatasetFormatError(
        f"{path} is a file; allowed: a folder, Nikon's .xtekct, Zeiss's .txrm, NXtomo "
        f"({', '.join(NXTOMO)}); else TIFFs with a geometry, fx.read_tiffs(folder, geometry)",
        {"asked": str(path), "allowed": list(readers)},
    )


def _nikon(path: Path, geometry: ConeVec | None) -> DataSet:
    said = dict(re.findall(r"^(\w+)=(.*?)\s*$", path.read_text("utf-8", "replace"), re.MULTILINE))
    views = int(_number(path, said, "Projections"))
    sod, sdd = (_number(path, said, key) for key in ("SrcToObject", "SrcToDetector"))
    across, down = (_number(path, said, f"DetectorPixelSize{axis}") for axis in "XY")
    size = [int(_number(path, said, f"DetectorPixels{axis}")) for axis in "YX"]
    top, bottom = (_number(path, said, f"CentreOfRotation{end}", 0.0) for end in ("Top", "Bottom"))
    aside = _number(path, said, "ObjectOffsetX", 0.5 * (top + bottom) * sod / sdd)
    lean = -np.rad2deg(np.arctan2(top - bottom, size[0] * down))
    tilts = _number(path, said, "ObjectRoll", lean), -_number(path, said, "ObjectTilt", 0.0)
    turn = np.deg2rad(
        _number(path, said, "InitialAngle", 0.0)
        + _number(path, said, "AngularStep") * np.arange(views)
    )
    place = np.array([[aside, -sod, 0.0], [aside, sdd - sod, 0.0], [-across, 0, 0], [0, 0, -down]])
    rows = (place @ _axis(*np.deg2rad(tilts)))[None] @ _about_z(turn)
    folder = list_folder(path.parent / said.get("InputFolderName", "").replace("\\", "/"))
    names = sorted((n for n in folder.names if n.lower().endswith((".tif", ".tiff"))),
                   key=by_numbers)  # fmt: skip
    cone = ConeVec(rows.reshape(views, 12)) if geometry is None else geometry
    data = listed(folder, cone, names, (), (), said.get("Name", ""))
    if list(data.shape) != size:
        raise DatasetFormatError(
            f"{path} says {size[1]} x {size[0]} pixels, {names[0]} has "
            f"{data.shape[1]} x {data.shape[0]}", {"asked": size, "allowed": list(data.shape)},
        )  # fmt: skip
    white = np.full((1, *data.shape), _number(path, said, "WhiteLevel"), np.float32)
    doubts = [
        f"{path.name} states {key} {said[key]}, which is not applied"
        for key in ("DetectorOffsetX", "DetectorOffsetY") if float(said.get(key, 0.0) or 0.0)
    ]  # fmt: skip
    arrays = Arrays(None, np.zeros_like(white), white)
    return replace(data, arrays=arrays, warnings=tuple(doubts))


def _number(path: Path, said: Mapping[str, str], key: str, default: float | None = None) -> float:
    text = said.get(key, "")
    try:
        if not text and default is not None:
            return default
        return float(text)
    except ValueError:
        raise DatasetFormatError(
            f"{path}: {key} is {text or 'missing'}; allowed: a number", {"missing": key}
        ) from None


def _about_z(angles: npt.ArrayLike) -> FloatArray:
    """Matrices (n, 3, 3) that turn rows of vectors about +z, anticlockwise seen from above."""
    c, s = np.cos(np.atleast_1d(angles)), np.sin(np.atleast_1d(angles))
    o, i = np.zeros_like(c), np.ones_like(c)
    return np.stack([np.stack([c, s, o], -1), np.stack([-s, c, o], -1), np.stack([o, o, i], -1)], 1)


def _axis(roll: float, tilt: float) -> FloatArray:
    """Takes rows of vectors into the frame whose z is the axis: rolled about y, tilted about x."""
    c, s = np.cos([roll, tilt]), np.sin([roll, tilt])
    rolled = np.array([[c[0], 0.0, s[0]], [0.0, 1.0, 0.0], [-s[0], 0.0, c[0]]])
    tilted = np.array([[1.0, 0.0, 0.0], [0.0, c[1], -s[1]], [0.0, s[1], c[1]]])
    return np.asarray(tilted @ rolled)


def _zeiss(path: Path, geometry: ConeVec | None) -> DataSet:
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

    def images(self, names: Sequence[str], code: int, shape: tuple[int, int]) -> npt.NDArray[Any]:
        if code not in KINDS:
            raise DatasetFormatError(f"DataType is {code}; allowed: {', '.join(map(str, KINDS))}")
        out = np.empty((len(names), *shape), KINDS[code])
        for image, name in zip(out, names, strict=True):
            image[:] = self.values(name, KINDS[code], image.size).reshape(shape)
        return out

    def lengths(self, name: str, count: int) -> FloatArray:
        """Of `ImageInfo`, without their signs."""
        found = abs(self.values(f"ImageInfo/{name}", "<f4", count, hint=GIVE).astype(np.float64))
        if not np.all((found > 0) & np.isfinite(found)):
            raise DatasetFormatError(f"{name} is {found.min():g}; allowed: above 0{GIVE}")
        return found


def _read(file: _Streams, geometry: ConeVec | None, name: str) -> DataSet:
    sizes = "ImageHeight", "ImageWidth", "NoOfImages", "DataType"
    rows, cols, planned, code = (file.whole(f"ImageInfo/{n}") for n in sizes)
    taken = min(file.whole("ImageInfo/ImagesTaken", planned), planned)
    if not 0 < taken * rows * cols <= file.size:
        said = f"{taken} images of {cols} x {rows} pixels are claimed in {file.size} bytes"
        raise DatasetFormatError(said)
    cone, doubts = _geometry(file, taken, rows) if geometry is None else (geometry, [])
    names = [f"ImageData{k // 100 + 1}/Image{k + 1}" for k in range(taken)]
    images = file.images(names, code, (rows, cols))
    flats = _reference(file, code, (rows, cols))
    if images.dtype.kind == "f":
        if flats is None:
            raise DatasetFormatError(f"images of floats; allowed: with {REFERENCES[0]}/Image")
        with np.errstate(all="ignore"):  # what is not finite is refused by its name
            images = images / np.maximum(flats.mean(axis=0), 1e-6 * flats.max())
            images, flats = -np.log(np.maximum(images, np.finfo(np.float32).tiny)), None
    elif flats is None:
        doubts.append("no reference: DataSet.from_arrays(data.counts(), data.geometry, flat=FLAT)")
    dark = np.zeros((rows, cols))
    data = DataSet.from_arrays(images, cone, dark=dark, flat=flats, name=name, warnings=doubts)
    reason = f"{taken} of {planned} images were taken" if taken < planned else ""
    return replace(data, complete=not reason, reason=reason)


def _reference(file: _Streams, code: int, shape: tuple[int, int]) -> npt.NDArray[Any] | None:
    """The images of the open beam, one or several."""
    for folder in REFERENCES:
        names = [n for k in range(1000) if file.ole.exists(n := f"{folder}/Image{k or ''}")]
        if names:
            images = file.images(names, file.whole(f"{folder}/DataType", code), shape)
            if not np.isfinite(images).all():
                raise DatasetFormatError(f"{names[0]} has pixels that are no numbers")
            return images
    return None


def _geometry(file: _Streams, views: int, rows: int) -> tuple[ConeVec, list[str]]:
    """The geometry, and what is doubtful about it."""
    if file.whole("ImageInfo/XrayGeometry", 1) != 1:
        raise DatasetFormatError("XrayGeometry says a parallel beam; allowed: a cone beam")
    near, far = file.lengths("StoRADistance", views), file.lengths("DtoRADistance", views)
    size = file.lengths("PixelSize", 1) / 1000.0
    rise = np.ptp(file.values("ImageInfo/YPosition", "<f4", views, 0.0)) / 1000.0
    if rise > 0.25 * rows * size:  # Shifts undo the small steps against rings, and no more.
        raise DatasetFormatError(f"the stage rises by YPosition; allowed: a circle{GIVE}")
    pixel = size * (near[:1] + far[:1]) / near[:1]
    center = file.values("ReconSettings/CenterShift", "<f4", default=0.0)
    shifts = (file.values(f"Alignment/{axis}-Shifts", "<f4", views, 0.0) for axis in "XY")
    right, up = (pixel * (shift + more) for shift, more in zip(shifts, (center, 0), strict=True))
    angles = np.deg2rad(file.values("ImageInfo/Angles", "<f4", views, hint=GIVE), dtype=np.float64)
    stated = {name: file.values(name, "<f4", default=0.0)[0] for name in NOT_APPLIED}
    doubts = [f"{name} of {value:g} is not applied" for name, value in stated.items() if value]
    if center[0]:
        doubts.append(f"CenterShift of {center[0]:g} pixels is applied")
    o, p = np.zeros(views), np.full(views, pixel)
    place = np.stack([o, -near, o, right, far, up, p, o, o, o, o, p], axis=-1).reshape(-1, 4, 3)
    return ConeVec((place @ _about_z(-angles)).reshape(-1, 12)), doubts
