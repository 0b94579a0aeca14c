"""Read NeXus's NXtomo; flexdt's additions are in `nxtomo_writing`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.library.data_set import DataSet
from flexdt.library.datasets.nxtomo_writing import DARK, FLAT, INVALID, PROJECTION
from flexdt.library.extras import package
from flexdt.library.reading.foreign_parsing import require_memory
from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.findings import Finding, warning
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.length_units import UNITS_RAD, angle_rad, length_mm
from flexdt.twin.plausibility import PlausibilityCode, settled
from flexdt.twin.plausibility.scan_geometry import distance_findings
from flexdt.twin.plausibility.stated_figures import angle_findings, pixel_findings

KNOWN_KEYS: Final = (PROJECTION, FLAT, DARK, INVALID)
MOST_DEFLATED: Final = 2000
"""Bytes of images for each byte of the file; of zeros alone there are more."""
KNOWN_LENGTHS: Final = "m, cm, mm, um, nm, inch"
"""Units of length that the message of an unknown one lists."""
KNOWN_ANGLES: Final = ", ".join(UNITS_RAD)
SMALL_BYTES: Final = 1 << 30
"""Images of which it does not matter how far they were deflated."""


def read_nxtomo(
    path: Path, geometry: ConeVec | None, distances: tuple[float, float] | None = None
) -> DataSet:
    """Read an NXtomo file into memory; the file is closed again.

    Args:
        path: the file.
        geometry: one view for each projection; None: the rows of cone_vec in the file, or
            its angles, pixels and distances.
        distances: source to axis and to panel [mm], in place of the file's; ignored where
            `geometry` or the file's cone_vec is used.

    Raises:
        DatasetFormatError: no HDF5, no NXtomo, missing images, no geometry, or one that
            the file's own figures contradict.
        TwinError: the package h5py is not installed.
    """
    h5py = package("h5py", "NXtomo")
    try:
        with h5py.File(path) as file:
            return _read(file, path, geometry, distances)
    except OSError as error:
        raise DatasetFormatError(
            f"{path} is no HDF5 file: {error}", {"path": str(path)}
        ) from None


def _read(
    file: Any, path: Path, geometry: ConeVec | None, distances: tuple[float, float] | None
) -> DataSet:
    """Read the images of an open file, and their geometry.

    Invalid images and those with unknown keys are left out, with a doubt.

    Args:
        file: open.
        path: for messages.
        geometry, distances: as for `read_nxtomo`.

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
    images = data[:]
    several = [
        images[keys == key] if (keys == key).any() else None for key in (DARK, FLAT)
    ]
    if several[1] is None and images.dtype.kind in "ui":
        doubts.append(
            f"{path.name}: no image has the key of a flat image, {FLAT}; counts have no line "
            "integrals without one"
        )
    projections = keys == PROJECTION
    if not projections.any():
        raise DatasetFormatError(
            f"{path}: no image has the key of a projection, {PROJECTION}",
            {"path": str(path)},
        )
    given = geometry
    if given is None:
        given, told = _geometry(file, name, path, projections, data.shape[1:], distances)
        doubts += told
    made = DataSet.from_arrays(
        images[projections], given, dark=several[0], flat=several[1], name=path.stem
    )
    doubts += settled(
        _stated_figures(file, name, given, projections), DatasetFormatError, path.name
    )
    return replace(made, warnings=(*made.warnings, *doubts))


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
        said = f"{path}: data of shape {data.shape}, image_key {keys.shape}"
        raise DatasetFormatError.instead(
            said, list(data.shape), "(n, rows, cols) and (n,)"
        )
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


def _geometry(
    file: Any,
    name: str,
    path: Path,
    projections: npt.NDArray[np.bool_],
    shape: tuple[int, int],
    distances: tuple[float, float] | None,
) -> tuple[ConeVec, list[str]]:
    """Take the geometry from the file's cone_vec, or from its angles, pixel and
    distances.

    A cone_vec, at the file's root or in the entry's `flexdt`, is taken without
    assumptions or checks. The other way assumes an upright panel with the axis in its
    middle column, and square pixels without `y_pixel_size`; signs of the distances do not
    matter.

    Args:
        file: with the entry.
        name: of the group that holds the images.
        path: for messages.
        projections: which images are projections.
        shape: of an image (rows, cols).
        distances: source to axis and to panel [mm], in place of the file's.

    Returns:
        The geometry, and a sentence on the assumptions made; none with cone_vec.

    Raises:
        DatasetFormatError: the file states too little (lists the missing quantities), in
            an unknown unit, or distances are such as no scanner has.
    """
    rows = _cone_rows(file, file[name.split("/")[0]])
    if rows is not None:
        return ConeVec(rows), []
    angles = _angles(file, name, projections)
    lengths = {
        what: _length(file, name, *places)
        for what, places in LENGTHS.items()
        if distances is None or "size" in what
    }
    missing = [w for w, length in lengths.items() if w in NEEDED_LENGTHS and not length]
    if distances is not None:
        sod, sdd = distances
        impossible = distance_findings(sod, sdd, lengths["x_pixel_size"] or 1e-9 * sdd)
        settled(impossible, DatasetFormatError, f"{path}: distances={distances}")
        lengths |= {"source distance": sod, "detector distance": sdd - sod}
    if angles is None:
        missing.insert(0, "rotation_angle")
    pixel = lengths["x_pixel_size"]
    if missing or angles is None or pixel is None:
        raise _too_little(path, missing)
    sod, beyond = (
        abs(lengths[what] or 0.0) for what in ("source distance", "detector distance")
    )
    cone = ConeVec.circular(
        sod=sod,
        sdd=sod + beyond,
        angles=np.degrees(angles),
        shape=shape,
        pixel=(pixel, lengths["y_pixel_size"] or pixel),
    )
    return cone, [
        f"{path.name} says angles, pixels and distances (source to axis {sod:g} mm, "
        f"axis to panel {beyond:g} mm): an upright panel is assumed, "
        "and the axis in its middle column; `align` or `calibrate` finds them"
    ]


def _cone_rows(file: Any, entry: Any) -> npt.NDArray[Any] | None:
    """Read the rows of the cone_vec (n, 12) at the file's root, or else in the entry's
    `flexdt`; None without either.
    """
    for group, place in ((file, "cone_vec"), (entry, "flexdt/cone_vec")):
        found = _member(group, place)
        if found is not None:
            return np.asarray(found[:])
    return None


def _too_little(path: Path, missing: Sequence[str]) -> DatasetFormatError:
    """Make the error for quantities that a geometry needs and the file lacks; it names the
    argument that gives them.
    """
    way = "geometry=fx.ConeVec.circular(sod=..., sdd=..., angles=..., pixel=...)"
    if {*missing} <= {"source distance", "detector distance"}:
        way = "distances=(SOD_MM, SDD_MM), from the source to the axis and to the panel"
    return DatasetFormatError(
        f"{path}: the file has no cone_vec and no {', '.join(missing)}; give {way}",
        {"missing": missing},
    )


LENGTHS: Final[Mapping[str, tuple[str, ...]]] = {
    "x_pixel_size": ("instrument/detector/x_pixel_size", "x_pixel_size"),
    "y_pixel_size": ("instrument/detector/y_pixel_size", "y_pixel_size"),
    "source distance": ("instrument/source/distance", "source/distance"),
    "detector distance": ("instrument/detector/distance", "distance"),
}
"""Length of NXtomo, distances from the sample -> its places in a file, from the entry or
the group."""

NEEDED_LENGTHS: Final = ("x_pixel_size", "source distance", "detector distance")
"""Lengths without which a geometry is undetermined."""


def _angles(
    file: Any, name: str, projections: npt.NDArray[np.bool_]
) -> npt.NDArray[np.float64] | None:
    """Read angles of the projections from the first place of the file that has one for
    each image.

    Places are the group with the images, the entry, and the entry's groups, in this
    order. Angles without a unit are in degrees.

    Args:
        file: open HDF5.
        name: of the group with the images.
        projections: (n,) images that are projections.

    Returns:
        The projections' angles [rad]; None without such a place.

    Raises:
        DatasetFormatError: they are in an unknown unit.
    """
    entry = file[name.split("/")[0]]
    near = file[name]
    places = (near, entry, *(one for one in entry.values() if hasattr(one, "get")))
    for place in places:
        for at in ("rotation_angle", "sample/rotation_angle"):
            angles = _member(place, at)
            if angles is not None and angles.shape == projections.shape:
                values = np.asarray(angles, dtype=np.float64)[projections]
                return values * _scale(angles, "deg", angle_rad, KNOWN_ANGLES)
    return None


def _length(file: Any, name: str, *members: str) -> float | None:
    """Read a length from the first of some places that has one number.

    All names are looked up in the entry, then in the group. A length without unit is in
    metres; its sign is kept.

    Args:
        file: open HDF5.
        name: of the group with the images.
        members: names in the entry, or in the group.

    Returns:
        Length [mm]; None without such a place.

    Raises:
        DatasetFormatError: it is in an unknown unit.
    """
    entry = file[name.split("/")[0]]
    near = file[name]
    for place in (entry, near):
        for member in members:
            found = _member(place, member)
            if getattr(found, "size", 0) == 1:
                scale = _scale(found, "m", length_mm, KNOWN_LENGTHS)
                return float(np.ravel(found)[0]) * scale
    return None


def _member(group: Any, name: str) -> Any:
    """Return a member of a group; None if there is no such member or no group."""
    if hasattr(group, "get"):
        return group.get(name)
    return None


def _stated_figures(
    file: Any, name: str, geometry: ConeVec, projections: npt.NDArray[np.bool_]
) -> Iterator[Finding]:
    """Compare the angles and the pixel that the file states with the geometry.

    Only the first pixel size found counts (next to the images, then at the entry and its
    groups). A value in an unknown unit is a finding, too.

    Args:
        file: open.
        name: of the group that holds the images.
        geometry: in use.
        projections: (n,) which images are projections.

    Returns:
        Findings of differences.
    """
    try:
        turn = _angles(file, name, projections)
    except DatasetFormatError as error:
        yield _not_compared(error)
    else:
        if turn is not None:
            yield from angle_findings(geometry, turn)
    entry = file[name.split("/")[0]]
    near = file[name]
    places = (near, entry, *(one for one in entry.values() if hasattr(one, "get")))
    for place in (near, *(_member(p, "instrument/detector") for p in places)):
        if place is None:
            size = None
        else:
            size = _member(place, "x_pixel_size")
        if size is not None and size.size == 1:
            try:
                scale = _scale(size, "m", length_mm, KNOWN_LENGTHS)
            except DatasetFormatError as error:
                yield _not_compared(error)
                return
            yield from pixel_findings(geometry, float(np.ravel(size)[0]) * scale)
            return


def _not_compared(error: DatasetFormatError) -> Finding:
    """Make the warning of a figure in an unknown unit, of its error."""
    remedy = "it is not compared with the geometry"
    return warning(PlausibilityCode.UNKNOWN_UNIT, error.message, remedy)


def _scale(
    dataset: Any, usual: str, known: Callable[[str], float | None], names: str
) -> float:
    """Return the size of the unit that a dataset of HDF5 states.

    Args:
        dataset: with or without a unit.
        usual: unit of one without.
        known: gives the size of a unit, None of an unknown one.
        names: of known units, for the message.

    Raises:
        DatasetFormatError: the unit is unknown.
    """
    unit = _unit(dataset, usual)
    scale = known(unit)
    if scale is None:
        problem = f"{dataset.name} is in {unit[:40]!r}"
        raise DatasetFormatError.instead(problem, unit[:40], names)
    return scale


def _unit(dataset: Any, usual: str) -> str:
    """Return the unit that a dataset's attribute states, as a text or an array of one, or
    the usual one without any.
    """
    said = np.ravel(dataset.attrs.get("units", usual))[:1].tolist()
    first = said[0] if said else usual
    if isinstance(first, bytes):
        first = first.decode("utf-8", "replace")
    return str(first).strip() or usual
