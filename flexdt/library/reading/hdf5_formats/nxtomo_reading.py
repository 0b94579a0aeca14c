"""Read NeXus's NXtomo; flexdt's additions are in `nxtomo_writing`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.library.data_set import DataSet
from flexdt.library.datasets.nxtomo_writing import DARK, FLAT, INVALID, PROJECTION
from flexdt.library.optional.hdf5_files import hdf5_file
from flexdt.library.reading.foreign_parsing import require_memory
from flexdt.library.reading.hdf5_formats.nxtomo_geometry import (
    file_geometry,
    replaced_by,
    stated_figures,
)
from flexdt.library.reading.hdf5_formats.nxtomo_scan import NxScan, scan_of
from flexdt.library.reading.hdf5_formats.nxtomo_table import DETECTOR
from flexdt.library.reading.hdf5_formats.one_exposure import on_one_exposure
from flexdt.twin.dataset.dataset_errors import DatasetFormatError, DatasetMissingError
from flexdt.twin.errors import shape_words
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.plausibility import settled

KNOWN_KEYS: Final = (PROJECTION, FLAT, DARK, INVALID)
MOST_DEFLATED: Final = 2000
"""Bytes of images for each byte of the file; of zeros alone there are more."""
SMALL_BYTES: Final = 1 << 30
"""Images of which it does not matter how far they were deflated."""


def read_nxtomo(
    path: Path,
    geometry: ConeVec | None,
    distances: tuple[float, float] | None = None,
    angles: FloatArray | None = None,
) -> DataSet:
    """Read an NXtomo file into memory.

    In place of its own: `geometry`, one view a projection; else `distances` to axis and
    panel [mm], unless it has cone_vec; `angles` [deg], where it has none. Raises
    DatasetMissingError; DatasetFormatError: no NXtomo, images or geometry, or
    contradictions; TwinError: h5py is missing.
    """
    try:
        with hdf5_file(path, "NXtomo") as file:
            return _read(file, path, geometry, distances, angles)
    except FileNotFoundError:
        raise DatasetMissingError(f"{path} is missing", {"path": str(path)}) from None
    except OSError:
        raise DatasetFormatError(
            f"{path} is no HDF5 file, or a damaged one", {"path": str(path)}
        ) from None


def _read(
    file: Any,
    path: Path,
    geometry: ConeVec | None,
    distances: tuple[float, float] | None,
    angles: FloatArray | None,
) -> DataSet:
    """Read the images of an open file, and their geometry.

    Invalid images and those with unknown keys are left out, with a doubt. Counts are put
    on one exposure and one current of the source.

    Args:
        file: open.
        path: for messages.
        geometry, distances, angles: as for `read_nxtomo`.

    Returns:
        The data set in memory, with its doubts as warnings.

    Raises:
        DatasetFormatError: no image is a projection, the geometry is missing, or the
            file's angles or pixel contradict it.
    """
    name, doubts = _entry(file, path)
    group = file[name]
    data, keys = _images_of(group, path)
    lost = int((keys == INVALID).sum())
    if lost:
        doubts.append(f"{lost} images are marked as invalid and left out")
    others = sorted(set(keys.tolist()) - set(KNOWN_KEYS))
    if others:
        many = int(np.isin(keys, others).sum())
        doubts.append(
            f"{many} images of the keys {', '.join(map(str, others))} are left out"
        )
    scan = scan_of(file, name, path, keys)
    images = data[:]
    kinds = {key: _some(images, keys == key) for key in (PROJECTION, DARK, FLAT)}
    if not len(kinds[FLAT]) and images.dtype.kind in "ui":
        doubts.append(
            f"{path.name}: no image has the key of a flat image, {FLAT}; counts have no line "
            "integrals without one"
        )
    if not len(kinds[PROJECTION]):
        raise DatasetFormatError(
            f"{path}: no image has the key of a projection, {PROJECTION}",
            {"path": str(path)},
        )
    given = geometry
    if given is None:
        given, told = file_geometry(scan, data.shape[1:], distances, angles)
        doubts += told
    else:
        replaced_by(scan, "geometry=")
    views, flats, told = _one_exposure(scan, kinds)
    doubts += told
    darks = kinds[DARK]
    made = DataSet.from_arrays(
        views,
        given,
        dark=darks if len(darks) else None,
        flat=flats if len(flats) else None,
        name=path.stem,
    )
    doubts += settled(
        stated_figures(file, name, given, scan.projections),
        DatasetFormatError,
        path.name,
    )
    values = scan.ledger.finish()
    all_told = (*made.warnings, *doubts, *scan.ledger.warnings)
    return replace(made, warnings=all_told, provenance=values)


def _some(images: npt.NDArray[Any], chosen: npt.NDArray[np.bool_]) -> npt.NDArray[Any]:
    """Return the chosen images; those that follow each other are not copied."""
    at = np.flatnonzero(chosen)
    if len(at) and at[-1] - at[0] + 1 == len(at):
        return images[at[0] : at[-1] + 1]
    return images[chosen]


def _one_exposure(
    scan: NxScan, kinds: dict[int, npt.NDArray[Any]]
) -> tuple[npt.NDArray[Any], npt.NDArray[Any], list[str]]:
    """Put projections and flat images on one exposure and one current of the source.

    Args:
        scan: whose count_time and control state them.
        kinds: image key -> images.

    Returns:
        Projections, flat images, and doubts.
    """
    factors = {}
    told = []
    for place in (f"{DETECTOR}/count_time", "control/data"):
        values = scan.of_images(place)
        if values is None:
            continue
        lit = values[np.isin(scan.keys, (PROJECTION, FLAT))]
        if not (np.isfinite(lit).all() and (lit > 0.0).all()):
            said = f"{place} has values that are not above 0: it is not used"
            scan.ledger.set_aside(place, said)
            continue
        factors["control" if place.startswith("control") else "count_time"] = values
        dark = values[scan.keys == DARK]
        if (
            place.endswith("count_time")
            and len(dark)
            and not np.allclose(dark, np.median(lit[: len(lit)]))
        ):
            told.append(
                f"{scan.path.name}: count_time of the dark images is {dark[0]:g} s, of the "
                f"others {np.median(lit):g} s; they are subtracted as they are"
            )
    made = on_one_exposure(kinds, scan.keys, factors, scan.path.name)
    return made.views, made.flats, [*told, *made.told]


def _entry(file: Any, path: Path) -> tuple[str, list[str]]:
    """Find the first group of a file that holds images and their keys.

    Further scans in the file are a doubt that names up to five.

    Returns:
        Its name, and doubts about it.

    Raises:
        DatasetFormatError: there is no group, or its images are a broken link.
    """
    found: list[str] = []
    lost: list[str] = []

    def look(name: str, item: Any) -> None:
        """Append an HDF5 group with images and keys to `found`, and its links that lead nowhere
        to `lost`.
        """
        if "image_key" not in getattr(item, "keys", tuple)():
            return
        for part in ("data", "image_key"):
            link = item.get(part, getlink=True) if part in item.keys() else None  # noqa: SIM118
            if link is not None and item.get(part) is None:
                target = getattr(link, "filename", "") or getattr(link, "path", "")
                lost.append(f"{name}/{part} is a link to {target}, which is not there")
        if item.get("data") is not None and item.get("image_key") is not None:
            found.append(name)

    file.visititems(look)
    if not found:
        if lost:
            why = lost[0]
        else:
            why = "no group has data and image_key; allowed: NXtomo"
        raise DatasetFormatError(f"{path}: {why}", {"path": str(path)})
    entries = list(dict.fromkeys(name.split("/")[0] for name in found))
    told = []
    if len(entries) > 1:
        more = ", ".join(entries[1:6])
        told.append(
            f"{path.name} holds {len(entries)} scans: {entries[0]} is read, not {more}"
        )
    return found[0], told


def _images_of(group: Any, path: Path) -> tuple[Any, npt.NDArray[Any]]:
    """Return the images as an unread dataset of HDF5, and their keys (n,).

    Files with the images of a virtual or external dataset must be there. The others must
    not unfold to more than `MOST_DEFLATED` times the bytes that are stored, unless they
    are at most `SMALL_BYTES`.

    Args:
        group: with `data` and `image_key`.
        path: of the file, for messages.

    Raises:
        DatasetFormatError: images and keys do not fit each other, or images are missing,
            exceed the memory, or are larger than the stored bytes allow.
    """
    data = group["data"]
    keys = np.asarray(group["image_key"])
    if data.ndim != 3 or keys.ndim != 1:
        sizes = shape_words(data.shape), shape_words(keys.shape)
        said = f"{path}: data of shape {sizes[0]}, image_key of {sizes[1]}"
        raise DatasetFormatError.instead(said, list(data.shape), "n x rows x cols and n")
    if len(keys) != len(data):
        if len(keys) in data.shape:
            turned = " (sinograms? give them as images)"
        else:
            turned = ""
        said = f"{path}: {len(data)} images and {len(keys)} image keys{turned}"
        raise DatasetFormatError.instead(
            said, len(keys), f"one for each of {len(data)} images"
        )
    size = data.size * data.dtype.itemsize
    held = path.stat().st_size
    gone = [name for name in _sources(data) if not (path.parent / name).exists()]
    if gone:
        said = f"{path}: its images lie in {', '.join(gone[:3])}, which is not there"
        raise DatasetFormatError(said, {"path": str(path), "missing": gone[:100]})
    require_memory(path, "images", size)
    if not data.is_virtual and not data.external:
        stored = data.id.get_storage_size()
        if not stored or size > max(SMALL_BYTES, MOST_DEFLATED * min(stored, held)):
            said = (
                f"{path} claims images of {size / 2**30:.4g} GiB and holds {stored} bytes"
            )
            raise DatasetFormatError.instead(said, size, "images that were recorded")
    return data, keys


def _sources(data: Any) -> Iterator[str]:
    """Yield the names of the other files that hold the images of a virtual or external
    dataset, each once in each kind; none if it holds them itself.
    """
    if data.is_virtual:
        yield from dict.fromkeys(
            s.file_name for s in data.virtual_sources() if s.file_name != "."
        )
    if data.external:
        yield from dict.fromkeys(str(name) for name, *_ in data.external)
