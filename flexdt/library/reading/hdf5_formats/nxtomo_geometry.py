"""The geometry of an NXtomo file: its cone_vec, or angles, distances, axis, flips, heights.

Signs as ESRF's nxtomo has them, where the application definition has none: z_translation is the
sample's height, flips mirror the images that are stored.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.library.datasets.nxtomo_writing import HALF_SEEN
from flexdt.library.reading.hdf5_formats.hdf5_values import (
    angles_rad,
    lengths_mm,
    said_angles,
    text_of,
    what_gives,
)
from flexdt.library.reading.hdf5_formats.nxtomo_scan import NxScan
from flexdt.library.reading.hdf5_formats.nxtomo_table import DETECTOR
from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.dataset.format_table import ANGLES, GEOMETRY, Ledger
from flexdt.twin.dataset.provenance import Part
from flexdt.twin.findings import Finding, warning
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.plausibility import PlausibilityCode, settled
from flexdt.twin.plausibility.scan_geometry import distance_findings
from flexdt.twin.plausibility.stated_figures import angle_findings, pixel_findings

LENGTHS: Final = {
    "x_pixel_size": f"{DETECTOR}/x_pixel_size",
    "y_pixel_size": f"{DETECTOR}/y_pixel_size",
    "source distance": "instrument/source/distance",
    "detector distance": f"{DETECTOR}/distance",
}
"""Length of NXtomo, distances from the sample -> its canonical place."""
ANGLE_NAME: Final = re.compile(r"(angle|theta|rotation)[^/]*$", re.IGNORECASE)
"""Names of angles in places where nobody looks for them."""
NEEDED_LENGTHS: Final = ("x_pixel_size", "source distance", "detector distance")
"""Lengths without which a geometry is undetermined."""
TRANSLATIONS: Final = ("sample/x_translation", "sample/y_translation")
FLIPS: Final = (
    f"{DETECTOR}/x_flipped",
    f"{DETECTOR}/y_flipped",
    f"{DETECTOR}/transformations/rz",
    f"{DETECTOR}/transformations/ry",
    "sample/z_translation",
)
"""Figures that are told where another geometry takes their place."""


def file_geometry(
    scan: NxScan,
    shape: tuple[int, int],
    distances: tuple[float, float] | None,
    degrees: FloatArray | None = None,
) -> tuple[ConeVec, list[str]]:
    """Take the geometry from the file's cone_vec, or from its angles, pixel, distances,
    axis, flips and heights.

    A cone_vec, at the file's root or in the entry's `flexdt`, is taken without
    assumptions or checks. The other way assumes an upright panel, with the axis in its
    middle column unless the file states it, and square pixels without `y_pixel_size`;
    signs of the distances do not matter.

    Args:
        scan: of the file.
        shape: of an image (rows, cols).
        distances: source to axis and to panel [mm], in place of the file's.
        degrees: angles of the projections [deg], where the file has none.

    Returns:
        The geometry, and a sentence on the assumptions made; none with cone_vec.

    Raises:
        DatasetFormatError: the file states too little (lists the missing quantities), in
            an unknown unit, or distances are such as no scanner has.
    """
    path = scan.path
    rows = _cone_rows(scan)
    if rows is not None:
        return ConeVec(rows), []
    angles = _angles(scan.file, scan.name, scan.projections, scan.ledger)
    if angles is None:
        angles = said_angles(degrees, scan.projections, scan.ledger)
    lengths = {
        what: scan.length(place)
        for what, place in LENGTHS.items()
        if distances is None or "size" in what
    }
    missing = [w for w, length in lengths.items() if w in NEEDED_LENGTHS and not length]
    if distances is not None:
        sod, sdd = distances
        impossible = distance_findings(sod, sdd, lengths["x_pixel_size"] or 1e-9 * sdd)
        settled(impossible, DatasetFormatError, f"{path}: distances={distances}")
        lengths |= {"source distance": sod, "detector distance": sdd - sod}
        replaced = [place for what, place in LENGTHS.items() if "distance" in what]
        scan.ledger.replaced(replaced, "distances=")
    if angles is None:
        missing.insert(0, "rotation_angle")
    pixel = lengths["x_pixel_size"]
    if missing or angles is None or pixel is None:
        raise _too_little(path, missing, _angles_elsewhere(scan.file))
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
    cone, where = _placed(scan, cone, shape)
    return cone, [
        f"{path.name} says angles, pixels and distances (source to axis {sod:g} mm, "
        f"axis to panel {beyond:g} mm): an upright panel is assumed, "
        f"and the axis in {where}; `align` or `calibrate` finds them"
    ]


def _placed(scan: NxScan, cone: ConeVec, shape: tuple[int, int]) -> tuple[ConeVec, str]:
    """Mirror, shift and raise a circle with the axis in the middle as the file states it.

    Args:
        scan: of the file.
        cone: circle with the axis in the middle column.
        shape: of an image (rows, cols).

    Returns:
        The geometry, and in which column the axis is assumed, in words.
    """
    source, detector, u, v = (np.array(part) for part in np.split(cone.rows, 4, axis=1))
    u *= -1.0 if _flipped(scan, "x", "rz") else 1.0
    v *= -1.0 if _flipped(scan, "y", "ry") else 1.0
    column, where = _axis_column(scan, shape[1])
    row = _from_middle(scan, f"{DETECTOR}/y_rotation_axis_pixel_position", shape[0])
    detector += ((shape[1] - 1) / 2 - column) * u
    if row is not None:
        detector += ((shape[0] - 1) / 2 - row) * v
    rise = _heights(scan)
    source[:, 2] -= rise
    detector[:, 2] -= rise
    rows = np.concatenate([source, detector, u, v], axis=1)
    return ConeVec(rows).with_shape(shape), where


def _flipped(scan: NxScan, axis: str, turn: str) -> bool:
    """Take whether the images are mirrored: by the detector's flip, or else by a turn of
    180 deg among its transformations. Another turn is left to the table.
    """
    place = f"{DETECTOR}/transformations/{turn}"
    stated = scan.one(f"{DETECTOR}/{axis}_flipped")
    turned = scan.members.get(place)
    by_turn = None
    if turned and turned[0].size == 1 and turned[0].dtype.kind in "iuf":
        angle = float(angles_rad(turned[0])[0]) % (2 * np.pi)
        if np.isclose(angle, np.pi) or np.isclose(angle % (2 * np.pi), 0.0):
            by_turn = bool(np.isclose(angle, np.pi))
            scan.ledger.use(place)
        else:
            scan.ledger.set_aside(
                place, f"a turn of {np.degrees(angle):g} deg: not applied"
            )
    if stated is None:
        return bool(by_turn)
    flip = _is_true(stated)
    if by_turn is not None and by_turn != flip:
        said = f"{axis}_flipped says {flip}, transformations/{turn} {by_turn}"
        scan.ledger.set_aside(place, f"{said}; {axis}_flipped is taken")
    return flip


def _is_true(dataset: Any) -> bool:
    """Return whether a dataset of one member says yes: a number but 0, or a word."""
    word = text_of(dataset).strip().lower()
    return word not in ("0", "false", "no", "off", "", "none")


def _from_middle(scan: NxScan, place: str, count: int) -> float | None:
    """Take a place of the axis in pixels from the first pixel's center; None without one.

    Values of 0 and below count from the middle, as ESRF's nxtomomill writes them.

    `scan`: of the file; `place`: of the value; `count`: of columns, or rows.
    Raises DatasetFormatError: it is beyond the panel by more than its width.
    """
    value = scan.figure(place)
    if value is None:
        return None
    middle = (count - 1) / 2
    column = middle + value if value <= 0.0 else value
    if not -count <= column <= 2 * count:
        said = f"{scan.path}: {place} is {value:g}"
        allowed = f"about the {count} pixels of the panel"
        raise DatasetFormatError.instead(said, value, allowed)
    return column


def _axis_column(scan: NxScan, columns: int) -> tuple[float, str]:
    """Choose the column of the axis, and compare it with the field of view.

    Args:
        scan: of the file.
        columns: of an image.

    Returns:
        The column, from the first one's center, and where the axis is, in words.
    """
    name = f"{DETECTOR}/x_rotation_axis_pixel_position"
    other = f"{DETECTOR}/estimated_cor_from_motor"
    middle = (columns - 1) / 2
    motor = scan.figure(other)
    column = scan.ledger.agree(
        "column of the axis",
        [
            (name, _from_middle(scan, name, columns)),
            (other, None if motor is None else middle + motor),
        ],
        0.01,
        "px",
    )
    view = scan.one(f"{DETECTOR}/field_of_view")
    half = view is not None and text_of(view).strip().lower() == "half"
    place = middle if column is None else column
    sides = sorted((place + 0.5, columns - 0.5 - place))
    if half and column is None:
        scan.ledger.set_aside(
            f"{DETECTOR}/field_of_view",
            "field_of_view is Half and no column of the axis is stated: the middle is taken; "
            "`align` finds it",
        )
    elif view is not None and half != (sides[0] < HALF_SEEN * sides[1]):
        scan.ledger.set_aside(
            f"{DETECTOR}/field_of_view",
            f"field_of_view is {text_of(view)}, and the axis stands in column {place:g} of "
            f"{columns}, which is taken",
        )
    if column is None:
        return middle, "its middle column"
    return column, f"column {column:g} of {columns}"


def _heights(scan: NxScan) -> npt.NDArray[np.float64]:
    """Take the height of the sample in each view (n,) [mm]; 0 where it stays.

    Movements of the sample along and across the beam that stay are ignored.
    """
    for place in TRANSLATIONS:
        for one in scan.members.get(place, []):
            values = np.ravel(one[()])
            if len(values) == len(scan.keys):
                values = values[scan.projections]
            if np.ptp(values) == 0.0:
                scan.ledger.ignore(place, "the same in all views")
    still = np.zeros(int(scan.projections.sum()))
    found = scan.members.get("sample/z_translation")
    if not found:
        return still
    heights = lengths_mm(found[0])
    if heights.size not in (1, len(scan.keys)):
        many = f"{heights.size} values for {len(scan.keys)} images"
        scan.ledger.set_aside(
            "sample/z_translation", f"z_translation has {many}: not used"
        )
        return still
    if heights.size == 1 or np.ptp(heights[scan.projections]) == 0.0:
        return still
    scan.ledger.use("sample/z_translation", "a helix; the object's origin is at height 0")
    return heights[scan.projections]


def _cone_rows(scan: NxScan) -> npt.NDArray[Any] | None:
    """Take the rows of the cone_vec (n, 12) at the file's root, or else in the entry's
    `flexdt`; None without either. They take the place of all other figures.
    """
    for place in ("cone_vec", "flexdt/cone_vec"):
        found = scan.members.get(place)
        if found:
            replaced_by(scan, "flexdt's cone_vec", (GEOMETRY,))
            scan.ledger.use(place)
            return np.asarray(found[0][()])
    return None


def replaced_by(
    scan: NxScan, by: str, parts: Sequence[Part] = (GEOMETRY, ANGLES)
) -> None:
    """Set aside the figures whose place another geometry takes; a flip, a turn of the
    panel or a movement of the sample among them is told.
    """
    scan.ledger.give(parts, by)
    for place in (*FLIPS, *TRANSLATIONS):
        found = scan.members.get(place, [])
        values = [np.ravel(one[()]) for one in found if one.dtype.kind in "biuf"]
        if any(np.ptp(v) > 0.0 if len(v) > 1 else v.any() for v in values if len(v)):
            words = f"{place} {text_of(found[0])}: {by} is taken for the images as stored"
            if place.endswith("_translation") and len(values[0]) == 1:
                scan.ledger.ignore(place, "one height for all images")
                continue
            scan.ledger.set_aside(place, words)


def _too_little(path: Path, missing: Sequence[str], elsewhere: str) -> DatasetFormatError:
    """Make the error for quantities that a geometry needs and the file lacks; it names the
    argument that gives them, and a place of the file that has angles.
    """
    listed = ", ".join(missing)
    there = ""
    if elsewhere and "rotation_angle" in missing:
        there = (
            f'; angles="{path.name}:{elsewhere}" takes those of another place of the file'
        )
    return DatasetFormatError(
        f"{path}: the file has no cone_vec and no {listed}; give {what_gives(missing)}{there}",
        {"missing": missing},
    )


def _angles_elsewhere(file: Any) -> str:
    """Return the first place of a file that is named as angles are; "" without one."""
    found: list[str] = []

    def look(name: str, item: Any) -> bool | None:
        if ANGLE_NAME.search(name) and getattr(item, "ndim", 0) == 1:
            found.append(f"/{name}")
        return True if found else None

    file.visititems(look)
    return found[0] if found else ""


def _angles(
    file: Any,
    name: str,
    projections: npt.NDArray[np.bool_],
    ledger: Ledger | None = None,
) -> npt.NDArray[np.float64] | None:
    """Read angles of the projections from the first place of the file that has one for
    each image.

    Places are the group with the images, the entry, and the entry's groups, in this
    order. Angles without a unit are in degrees. Others that differ are told.

    Args:
        file: open HDF5.
        name: of the group with the images.
        projections: (n,) images that are projections.
        ledger: where the use is noted; None: nowhere.

    Returns:
        The projections' angles [rad]; None without such a place.

    Raises:
        DatasetFormatError: they are in an unknown unit.
    """
    entry = file[name.split("/")[0]]
    near = file[name]
    places = (near, entry, *(one for one in entry.values() if hasattr(one, "get")))
    taken = None
    first = ""
    for place in places:
        for at in ("rotation_angle", "sample/rotation_angle"):
            found = _member(place, at)
            if found is None or found.shape != projections.shape:
                continue
            if taken is None:
                taken = angles_rad(found)[projections]
                first = found.name
                if ledger is None:
                    return taken
                ledger.use_place(found.name, "the views")
            elif ledger is not None and found.name != first:
                _compare_angles(
                    ledger, taken, first, angles_rad(found)[projections], found
                )
    return taken


def _compare_angles(
    ledger: Ledger,
    taken: npt.NDArray[np.float64],
    first: str,
    others: npt.NDArray[np.float64],
    found: Any,
) -> None:
    """Note the use of further angles: as those that were taken, or contradicted by them."""
    worst = int(np.argmax(np.abs(taken - others)))
    if np.allclose(taken, others, atol=1e-6):
        ledger.use_place(found.name, f"the views, as {first} says")
        return
    both = np.degrees([others[worst], taken[worst]])
    said = (
        f"view {worst} is at {both[0]:g} deg by {found.name}, {both[1]:g} deg by {first}"
    )
    ledger.set_place_aside(found.name, f"{said}; {first} is taken")


def stated_figures(
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
                stated = float(lengths_mm(size)[0])
            except DatasetFormatError as error:
                yield _not_compared(error)
                return
            yield from pixel_findings(geometry, stated)
            return


def _not_compared(error: DatasetFormatError) -> Finding:
    """Make the warning of a figure in an unknown unit, of its error."""
    remedy = "it is not compared with the geometry"
    return warning(PlausibilityCode.UNKNOWN_UNIT, error.message, remedy)


def _member(group: Any, name: str) -> Any:
    if hasattr(group, "get"):
        return group.get(name)
    return None
