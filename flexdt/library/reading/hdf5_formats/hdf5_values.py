"""Values of HDF5 files: each with its path, as a text, and in a known unit."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.dataset.format_table import Ledger
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.length_units import UNITS_RAD, angle_rad, length_mm

KNOWN_LENGTHS: Final = "m, cm, mm, um, nm, inch"
"""Units of length that the message of an unknown one lists."""
KNOWN_ANGLES: Final = ", ".join(UNITS_RAD)
STRUCTURE: Final = (
    "nx_class units signal default axes interpretation target definition version "
    "nexus_version hdf5_version h5py_version file_name file_time file_update_time creator "
    "axis primary long_name description empty iscalar class dimension_list "
    "reference_list name "
)
"""Attributes, in lower case, that say how a file is built, or describe a value in words."""
SAID_ANGLES: Final = "angles="
"""Field under which angles of the caller stand that a reader took."""
ANGLES: Final = ("rotation_angle", "theta")
"""Names of the angles of projections."""
SHOWN_VALUES: Final = 100_000
"""Members of an array of one dimension whose first and last are shown."""


def members_of(group: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield path and dataset of everything below a group, and the attributes that say
    more than how the file is built, as PATH@NAME with their value.

    A dataset is yielded once, at its first path; of a link that leads nowhere the target,
    as a text.

    Args:
        group: of an open file.
        prefix: of the paths, ending with a slash if it is not empty.
    """
    yield from _members(group, prefix, set())


def _members(group: Any, prefix: str, seen: set[Any]) -> Iterator[tuple[str, Any]]:
    """Yield what `members_of` yields; `seen` are the objects that were yielded."""
    yield from _attributes(group, prefix.rstrip("/"))
    for name in group:
        try:
            item = group.get(name)
        except (OSError, RuntimeError, KeyError):
            item = None
        path = f"{prefix}{name}"
        if item is None:
            link = group.get(name, getlink=True)
            target = getattr(link, "filename", "") or getattr(link, "path", "")
            yield path, f"a link to {target}, which is not there"
            continue
        if item.id in seen:
            continue
        seen.add(item.id)
        if hasattr(item, "keys"):
            yield from _members(item, f"{path}/", seen)
        else:
            yield path, item
            yield from _attributes(item, path)


def _attributes(item: Any, path: str) -> Iterator[tuple[str, Any]]:
    """Yield the attributes of an object that are not of `STRUCTURE`."""
    for name in item.attrs:
        if name.lower() not in STRUCTURE.split():
            yield f"{path}@{name}", item.attrs[name]


def text_of(value: Any) -> str:
    """Return a value as text, with its unit; of an array its shape, and its ends if it
    has one dimension.
    """
    unit = unit_of(value, "") if hasattr(value, "attrs") else ""
    mark = f" {unit}" if unit else ""
    size = int(getattr(value, "size", 1) or 0)
    shape = getattr(value, "shape", ())
    if size != 1:
        ends = ""
        if len(shape) == 1 and 0 < size <= SHOWN_VALUES:
            ends = f": {plain(value[0])} to {plain(value[size - 1])}"
        words = " x ".join(map(str, shape))
        return f"{words or 0} of {value.dtype}{ends}{mark}"
    try:
        member = np.ravel(value[()] if hasattr(value, "attrs") else value)[0]
    except (TypeError, ValueError, OSError, IndexError):
        return "?"
    return f"{plain(member)}{mark}"


def plain(member: Any) -> str:
    """Return a member of an array as text; bytes are decoded."""
    if isinstance(member, bytes):
        return member.decode("utf-8", "replace")
    if isinstance(member, np.generic):
        member = member.item()
    if isinstance(member, bytes):
        return member.decode("utf-8", "replace")
    return f"{member:.10g}" if isinstance(member, float) else str(member)


def unit_of(dataset: Any, usual: str) -> str:
    """Return the unit that a dataset's attribute states, as a text or an array of one, or
    the usual one without any.
    """
    said = np.ravel(dataset.attrs.get("units", usual))[:1].tolist()
    first = said[0] if said else usual
    return plain(first).strip() or usual


def _scale(
    dataset: Any, usual: str, known: Callable[[str], float | None], names: str
) -> float:
    """Return the size of the unit that a dataset states (`usual`: without one).

    `names`: of known ones, for the message. Raises DatasetFormatError: the unit is
    unknown.
    """
    unit = unit_of(dataset, usual)
    scale = known(unit)
    if scale is None:
        problem = f"{dataset.name} is in {unit[:40]!r}"
        raise DatasetFormatError.instead(problem, unit[:40], names)
    return scale


def lengths_mm(dataset: Any, usual: str = "m") -> npt.NDArray[np.float64]:
    """Read lengths (n,) [mm] of a dataset; raises DatasetFormatError for an unknown unit."""
    scale = _scale(dataset, usual, length_mm, KNOWN_LENGTHS)
    return np.ravel(np.asarray(dataset[()], dtype=np.float64)) * scale


def angles_rad(dataset: Any, usual: str = "deg") -> npt.NDArray[np.float64]:
    """Read angles (n,) [rad] of a dataset; raises DatasetFormatError for an unknown unit."""
    scale = _scale(dataset, usual, angle_rad, KNOWN_ANGLES)
    return np.ravel(np.asarray(dataset[()], dtype=np.float64)) * scale


def said_angles(
    degrees: FloatArray | None, projections: npt.NDArray[np.bool_], ledger: Ledger
) -> FloatArray | None:
    """Return the angles [rad] that the caller says in place of those that a file lacks.

    Args:
        degrees: of each projection, or of each image of the file [deg]; None: none are
            said.
        projections: which images of the file are some, (n,).
        ledger: of the file, in which they are entered as used.

    Raises:
        DatasetFormatError: another number of angles.
    """
    if degrees is None:
        return None
    many = int(np.count_nonzero(projections))
    if len(degrees) == len(projections):
        degrees = degrees[projections]
    if len(degrees) != many:
        said = f"{ledger.path}: {len(degrees)} angles for {many} projections"
        allowed = f"{many}, or {len(projections)} of all images"
        raise DatasetFormatError.instead(said, len(degrees), allowed)
    ledger.state(SAID_ANGLES, f"{many} angles")
    ledger.use(SAID_ANGLES, "the views, of which the file has no angles")
    return np.deg2rad(degrees)


def what_gives(missing: Sequence[str]) -> str:
    """Name the arguments that give quantities which a file lacks."""
    ways = []
    if any("distance" in one for one in missing):
        ways.append(
            "distances=(SOD_MM, SDD_MM), from the source to the axis and to the panel"
        )
    if any(one in ANGLES for one in missing):
        ways.append("angles=DEGREES, one for each projection")
    if all("distance" in one or one in ANGLES for one in missing):
        return " and ".join(ways)
    return "geometry=fx.ConeVec.circular(sod=..., sdd=..., angles=..., pixel=...)"
