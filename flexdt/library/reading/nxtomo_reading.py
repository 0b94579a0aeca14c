"""Read NeXus's NXtomo; `nxtomo_writing` says what flexdt adds to it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from flexdt.library.data_set import DataSet
from flexdt.library.datasets.nxtomo_writing import DARK, FLAT, INVALID, PROJECTION
from flexdt.library.extras import package
from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.geometry.cone_vec import ConeVec


def read_nxtomo(path: Path, geometry: ConeVec | None) -> DataSet:
    """Read an NXtomo file into memory.

    Args:
        path: the file.
        geometry: one view for each projection; None: the rows of cone_vec in the file.

    Raises:
        DatasetFormatError: no HDF5, no NXtomo, or no geometry.
    """
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
    several = [images[keys == key] if (keys == key).any() else None for key in (DARK, FLAT)]
    lost = int((keys == INVALID).sum())
    data = DataSet.from_arrays(
        images[keys == PROJECTION], geometry, dark=several[0], flat=several[1], name=path.stem
    )
    doubts = [f"{lost} images are marked as invalid and left out"] if lost else []
    return replace(data, warnings=(*data.warnings, *doubts))
