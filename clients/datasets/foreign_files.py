"""Scans in files of other programs: Nikon's .xtekct and NXtomo here, Zeiss's in `zeiss`.

Nikon (as CIL's NikonDataReader 25.0 reads it, Apache-2.0; https://github.com/TomographicImaging/CIL):
images are seen from behind the panel, column 0 at the right as seen from the source; the stage
turns clockwise by `AngularStep` a view; images are counts under an open beam of `WhiteLevel`; the
axis stands `ObjectOffsetX` to the left of the line from the source to the panel's middle.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.clients.datasets.data_set import Arrays, DataSet
from flexdt.clients.datasets.listed_images import by_numbers, listed
from flexdt.clients.datasets.zeiss import open_txrm
from flexdt.clients.extras import package
from flexdt.runtime.files.dataset_folder import list_folder
from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray

NXTOMO: Final = (".nx", ".nxs", ".h5", ".hdf5")


def open_file(path: Path, geometry: ConeVec | None) -> DataSet:
    """The data set in a file.

    Raises:
        DatasetError: another kind of file, or one that lacks what is needed; says what.
    """
    suffix = path.suffix.lower()
    if suffix == ".xtekct":
        return _nikon(path)
    if suffix == ".txrm":
        return open_txrm(path, geometry)
    if suffix in NXTOMO:
        return _nxtomo(path, geometry)
    raise DatasetFormatError(
        f"{path} is a file; allowed: a folder, Nikon's .xtekct, Zeiss's .txrm, NXtomo "
        f"({', '.join(NXTOMO)}); else TIFFs with a geometry, fx.read_tiffs(folder, geometry)",
        {"asked": str(path), "allowed": [".xtekct", ".txrm", *NXTOMO]},
    )


def _nikon(path: Path) -> DataSet:
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
    data = listed(folder, ConeVec(rows.reshape(views, 12)), names, (), (), said.get("Name", ""))
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


def _nxtomo(path: Path, geometry: ConeVec | None) -> DataSet:
    h5py = package("h5py", "NXtomo")
    try:
        with h5py.File(path) as file:
            found: list[Any] = []
            file.visititems(
                lambda _, item: found.append(item) if "image_key" in getattr(item, "keys", set)()
                and "data" in item else None
            )  # fmt: skip
            if not found:
                raise DatasetFormatError(
                    f"{path}: no group has data and image_key; allowed: NXtomo", {"path": str(path)}
                )
            images, keys = found[0]["data"][:], found[0]["image_key"][:]
            rows = [item[:] for name, item in file.items() if name == "cone_vec"] or [
                entry["flexdt/cone_vec"][:] for entry in file.values() if "flexdt/cone_vec" in entry
            ]
    except OSError as error:
        raise DatasetFormatError(f"{path} is no HDF5 file: {error}", {"path": str(path)}) from None
    if geometry is None:
        if not rows:
            raise DatasetFormatError(
                f"{path}: NXtomo says no geometry of a cone beam; give it: geometry=ConeVec",
                {"missing": "geometry"},
            )
        geometry = ConeVec(rows[0])
    several = [images[keys == key] if (keys == key).any() else None for key in (2, 1)]
    lost = int((keys == 3).sum())
    data = DataSet.from_arrays(
        images[keys == 0], geometry, dark=several[0], flat=several[1], name=path.stem
    )
    doubts = [f"{lost} images are marked as invalid and left out"] if lost else []
    return replace(data, warnings=(*data.warnings, *doubts))
