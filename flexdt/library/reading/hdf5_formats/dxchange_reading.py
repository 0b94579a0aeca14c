"""Read Data Exchange, APS's and ALS's HDF5; from its definition, no beamline's file seen.

Columns are taken to run to the right as seen from the source, rows from the top, and theta to turn
the sample clockwise seen from above: the definition does not say. A cone beam needs distances,
which few files state.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.library.data_set import DataSet
from flexdt.library.datasets.nxtomo_writing import DARK, FLAT, PROJECTION
from flexdt.library.optional.hdf5_files import hdf5_file
from flexdt.library.reading.foreign_parsing import require_memory
from flexdt.library.reading.hdf5_formats.dxchange_table import DATA_EXCHANGE, INSTRUMENT
from flexdt.library.reading.hdf5_formats.hdf5_values import (
    angles_rad,
    lengths_mm,
    members_of,
    said_angles,
    text_of,
    what_gives,
)
from flexdt.library.reading.hdf5_formats.one_exposure import on_one_exposure
from flexdt.library.reading.text_formats.text_scans import compared
from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.dataset.format_table import Ledger
from flexdt.twin.errors import shape_words
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.plausibility import settled
from flexdt.twin.plausibility.scan_geometry import distance_findings

PIXELS: Final = {
    "columns": ("pixel_size_x", "x_pixel_size"),
    "rows": ("pixel_size_y", "y_pixel_size"),
}
"""Names of the pitches in the group of the detector, the winner first."""
FLATS: Final = "process/acquisition/flat_fields"


def is_data_exchange(path: Path) -> bool:
    """Return whether an HDF5 file has images at `exchange/data`; False without h5py."""
    try:
        with hdf5_file(path, "Data Exchange") as file:
            return "exchange/data" in file
    except (OSError, ValueError):  # TwinError is a ValueError
        return False


def read_data_exchange(
    path: Path,
    geometry: ConeVec | None,
    distances: tuple[float, float] | None = None,
    angles: FloatArray | None = None,
) -> DataSet:
    """Read a Data Exchange file into memory.

    In place of the file's: `geometry`, one view a projection; `distances` to axis and
    panel [mm]; `angles` [deg], where it has none. Raises DatasetFormatError: no images,
    or no possible geometry; TwinError: h5py is missing.
    """
    with hdf5_file(path, "Data Exchange") as file:
        said = Ledger(DATA_EXCHANGE, str(path))
        members: dict[str, Any] = {}
        for place, item in members_of(file):
            said.state(place, text_of(item))
            if hasattr(item, "attrs"):
                members[place] = item
        return _read(said, members, path, geometry, distances, angles)


def _read(
    said: Ledger,
    members: dict[str, Any],
    path: Path,
    geometry: ConeVec | None,
    distances: tuple[float, float] | None,
    degrees: FloatArray | None,
) -> DataSet:
    """Read images and geometry of an open file.

    Args:
        said: all values of the file.
        members: path -> dataset.
        path: for messages.
        geometry, distances, degrees: as for `read_data_exchange`.
    """
    data = members.get("exchange/data")
    if data is None or data.ndim != 3:
        given = "is missing" if data is None else f"of shape {shape_words(data.shape)}"
        allowed = "angles x rows x columns"
        raise DatasetFormatError.instead(f"{path}: exchange/data {given}", given, allowed)
    require_memory(path, "images", data.size * data.dtype.itemsize)
    said.use("exchange/data")
    kinds: dict[int, npt.NDArray[Any]] = {PROJECTION: data[()]}
    for key, place in ((FLAT, "exchange/data_white"), (DARK, "exchange/data_dark")):
        images = members.get(place)
        kinds[key] = np.empty((0, *data.shape[1:]))
        if images is not None and images.size:
            said.use(place)
            kinds[key] = images[()].reshape(-1, *images.shape[-2:])
    told = []
    if not len(kinds[FLAT]) and data.dtype.kind in "ui":
        told.append(f"{path.name}: no exchange/data_white, so counts have no integrals")
    cone = _geometry(said, members, path, data.shape, geometry, distances, degrees)
    scaled = _one_exposure(said, members, path, kinds)
    made = DataSet.from_arrays(
        scaled.views,
        cone,
        dark=kinds[DARK] if len(kinds[DARK]) else None,
        flat=scaled.flats if len(scaled.flats) else None,
        name=path.stem,
    )
    values = said.finish()
    warnings = (*made.warnings, *told, *scaled.told, *said.warnings)
    return replace(made, warnings=warnings, provenance=values)


def _one_exposure(
    said: Ledger, members: dict[str, Any], path: Path, kinds: dict[int, npt.NDArray[Any]]
) -> Any:
    """Put flat images on the exposure of the projections, where the file states both."""
    names = f"{INSTRUMENT}/detector/exposure_time", f"{FLATS}/flat_exposure_time"
    times = [_figure(said, members, name) for name in names]
    switch = f"{FLATS}/different_flat_exposure"
    other = members.get(switch)
    same = False
    if other is not None:
        said.use(switch)
        word = text_of(other).lower()
        same = word in ("same", "0", "no", "false")
    counts = {key: len(images) for key, images in kinds.items()}
    keys = np.repeat([*counts], [*counts.values()])
    factors = {}
    if times[0] and times[1] and not same:
        both = {PROJECTION: times[0], FLAT: times[1], DARK: times[0]}
        factors = {"exposure_time": np.array([both[key] for key in keys.tolist()])}
    elif same and times[1] and times[0] and times[0] != times[1]:
        said.set_aside(
            names[1],
            f"flat_exposure_time is {times[1]:g} s, exposure_time {times[0]:g} s, and "
            "different_flat_exposure says the same: flat images are taken as they are",
        )
    return on_one_exposure(kinds, keys, factors, path.name)


def _figure(said: Ledger, members: dict[str, Any], place: str) -> float | None:
    """Take one finite number; None where there is none."""
    found = members.get(place)
    if found is None or found.size != 1 or found.dtype.kind not in "iuf":
        return None
    said.use(place)
    value = float(np.ravel(found[()])[0])
    return value if np.isfinite(value) else None


def _length(said: Ledger, members: dict[str, Any], place: str) -> float | None:
    """Take one length [mm]; None where there is none."""
    found = members.get(place)
    if found is None or found.size != 1 or found.dtype.kind not in "iuf":
        return None
    said.use(place)
    return abs(float(lengths_mm(found)[0]))


def _angles(
    said: Ledger, members: dict[str, Any], path: Path, views: int
) -> FloatArray | None:
    """Take the angle of each image (n,) [rad]: theta, or else start and step."""
    theta = members.get("exchange/theta")
    rotation = "process/acquisition/rotation"
    start, step = (
        _figure(said, members, f"{rotation}/rotation_{name}")
        for name in ("start", "step")
    )
    planned = None
    if step is not None:
        planned = np.deg2rad((start or 0.0) + step * np.arange(views, dtype=np.float64))
    if theta is None:
        return planned
    found = angles_rad(theta)
    if len(found) != views:
        many = f"exchange/theta has {len(found)} angles for {views} images"
        if planned is None:
            raise DatasetFormatError.instead(f"{path}: {many}", len(found), views)
        said.set_aside("exchange/theta", f"{many}: rotation_step is taken")
        return planned
    said.use("exchange/theta")
    if planned is not None:
        off = np.degrees(found - planned)
        worst = int(np.argmax(np.abs(off)))
        if abs(off[worst]) > max(0.1, 0.2 * abs(step or 0.0)):
            said.set_aside(
                f"{rotation}/rotation_step",
                f"image {worst} is at {np.degrees(found[worst]):.5g} deg by theta and "
                f"{np.degrees(planned[worst]):.5g} deg by rotation_step; theta is taken",
            )
    return found


def _geometry(
    said: Ledger,
    members: dict[str, Any],
    path: Path,
    shape: tuple[int, ...],
    given: ConeVec | None,
    distances: tuple[float, float] | None,
    degrees: FloatArray | None,
) -> ConeVec:
    """Take the geometry of the file, or compare a given one with it.

    Raises:
        DatasetFormatError: quantities are missing (lists them), or impossible distances.
    """
    detector = f"{INSTRUMENT}/detector"
    angles = _angles(said, members, path, shape[0])
    if angles is None and given is None:
        angles = said_angles(degrees, np.ones(shape[0], bool), said)
    pitches = []
    for what, names in PIXELS.items():
        stated = [
            (f"{detector}/{name}", _length(said, members, f"{detector}/{name}"))
            for name in names
        ]
        largest = max((value or 0.0 for _, value in stated), default=0.0)
        pitches.append(said.agree(f"pitch of {what}", stated, 1e-6 * largest, "mm"))
    sod, beyond = (
        _length(said, members, f"{INSTRUMENT}/{part}/distance")
        for part in ("source", "detector")
    )
    if given is not None:
        turned = np.zeros(0) if angles is None else np.degrees(angles)
        compared(said, given, pitches[0] or 0.0, turned)
        return given
    if distances is not None:
        sod, beyond = distances[0], distances[1] - distances[0]
        places = [f"{INSTRUMENT}/{part}/distance" for part in ("source", "detector")]
        said.replaced(places, "distances=")
    quantities = {
        "theta": angles,
        "pixel_size_x": pitches[0],
        "source distance": sod,
        "detector distance": beyond,
    }
    missing = [
        name for name, value in quantities.items() if value is None or not np.any(value)
    ]
    if angles is None or pitches[0] is None or sod is None or beyond is None or missing:
        raise DatasetFormatError(
            f"{path}: the file has no {', '.join(missing)}; give {what_gives(missing)}",
            {"missing": missing},
        )
    pixel = (pitches[0], pitches[1] or pitches[0])
    impossible = distance_findings(sod, sod + beyond, pixel)
    settled(impossible, DatasetFormatError, str(path))
    said.warnings.append(
        f"{path.name}: an upright panel is assumed, the axis in its middle column, and theta "
        "clockwise seen from above; `align` finds the axis"
    )
    return ConeVec.circular(
        sod=sod,
        sdd=sod + beyond,
        angles=np.degrees(angles),
        shape=(shape[1], shape[2]),
        pixel=pixel,
    )
