"""Data sets of images that are named one by one."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final

from flexdt.clients.datasets.data_set import DataSet
from flexdt.runtime.files.dataset_folder import Folder, read_image
from flexdt.twin.dataset.dataset_errors import DatasetFormatError, DatasetMissingError
from flexdt.twin.geometry.cone_vec import ConeVec

NO_DARK: Final = "no dark image"


def by_numbers(name: str) -> list[tuple[int, str]]:
    """Order of names in which 10 comes after 9."""
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]


def listed(
    content: Folder,
    geometry: ConeVec,
    names: Sequence[str],
    darks: Sequence[str],
    flats: Sequence[str],
    name: str = "",
) -> DataSet:
    """The data set of images named one by one, (rows, cols) as the first that is there.

    Raises:
        DatasetError: none is there, or the geometry has another number of views or another shape.
    """
    there = [n for n in names if n in content.names]
    if not there:
        raise DatasetMissingError(
            f"{content.path}: no projections ({', '.join(names[:1]) or 'none is listed'} ...)",
            {"path": str(content.path), "missing": list(names[:100])},
        )
    if len(names) != len(geometry):
        raise DatasetFormatError(
            f"{content.path}: {len(names)} projections and {len(geometry)} views; allowed: as many "
            "of both",
            {"path": str(content.path), "asked": len(geometry), "allowed": len(names)},
        )
    rows, cols = read_image(content.path / there[0]).shape
    geometry = geometry.with_shape(geometry.of_shape((rows, cols)))
    lost = content.lost(names)
    return DataSet(
        name or content.path.name,
        content.frames(names, [(rows, cols)] * len(names)),
        (rows, cols),
        geometry,
        None,
        content.path,
        content.paths(darks),
        content.paths(flats),
        complete=not lost,
        reason=lost,
        warnings=tuple(doubts(darks)),
    )


def doubts(darks: Sequence[str]) -> list[str]:
    """What to say of a data set with these dark images."""
    return [] if darks else [f"{NO_DARK} (di000000.tif): zero is taken"]
