"""Write NeXus's NXtomo (application definition 2.0).

It holds raw counts with image keys, in HDF5. NXtomo has a rotation angle and little else
of a cone beam, so a further group, which its readers skip, holds the rows of cone_vec.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from flexdt.library.datasets.image_set import ImageSet, references
from flexdt.library.optional.extras import package
from flexdt.runtime.files.whole_files import require_bytes, whole_file
from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.physics.tube import tube_spectrum, voltages
from flexdt.twin.signatures import File

PROJECTION = 0
FLAT = 1
DARK = 2
"""Image keys of NXtomo."""
INVALID: Final = 3
HALF_SEEN: Final = 0.5
"""Ratio of the panel's parts on both sides of the rotation axis (shorter over longer)
below which the field of view is half: the views of a full turn complete each other."""
KEYS: Final = {"di": DARK, "io": FLAT}
"""Beginning of the scanner's file names -> image key."""
BYTES_A_PIXEL: Final = 2
"""Of counts, uint16."""


def save_nxtomo(data: ImageSet, file: File) -> None:
    """Write a data set to an NXtomo file; see `DataSet.to_nxtomo`.

    The file appears only when complete.

    Raises:
        DatasetFormatError: projections of several shapes.
        TwinError: h5py is not installed, or the disk has too little room.
        DatasetError: a projection cannot be read.
    """
    h5py = package("h5py", "to_nxtomo")
    if any(frame.shape != data.shape for frame in data.frames):
        raise DatasetFormatError(
            f"{data.where}: projections of several shapes; NXtomo has one",
            {"path": data.where},
        )
    images = len(references(data)) + len(data)
    require_bytes(Path(file), images * data.shape[0] * data.shape[1] * BYTES_A_PIXEL)
    with whole_file(Path(file)) as part, h5py.File(part, "w") as out:
        _write(data, out)


def _write(data: ImageSet, out: Any) -> None:
    """Write a data set into an open HDF5 file: counts, keys, angles, exposure and
    cone_vec.

    Dark and flat images come first; their angles are that of the first view. Pixel sizes,
    distances and the axis's place are those of the first view, too.

    Args:
        data: with all its images.
        out: root of the file.
    """
    geometry = data.geometry
    before = references(data)
    count = len(before) + len(data)
    angles = data.angles_deg
    out.attrs.update(NX_class="NXroot", default="entry")
    entry = _group(out, "entry", "NXentry")
    entry.attrs["default"] = "data"
    entry["definition"] = "NXtomo"
    entry["title"] = data.name
    if data.document is not None:
        entry["start_time"] = data.document.started.isoformat()

    instrument = _group(entry, "instrument", "NXinstrument")
    source = _group(instrument, "source", "NXsource")
    source["type"] = "Fixed Tube X-ray"
    source["probe"] = "x-ray"
    detector = _group(instrument, "detector", "NXdetector")
    images = detector.create_dataset("data", (count, *data.shape), "u2")
    keys = [*(KEYS[name[:2]] for name, _ in before), *[PROJECTION] * len(data)]
    detector["image_key"] = np.array(keys, dtype=np.int32)
    for i, (_, image) in enumerate(before):
        images[i] = image
    for i in range(len(data)):
        images[len(before) + i] = data.counts(i)
    to_source = float(np.linalg.norm(geometry.source[0]))
    axis_column, axis_row = geometry.project_points(np.zeros((1, 3)), data.shape)[0, 0]
    lengths = {
        "x_pixel_size": float(np.linalg.norm(geometry.u[0])),
        "y_pixel_size": float(np.linalg.norm(geometry.v[0])),
        "distance": abs(float(geometry.source_detector_distance[0])) - to_source,
    }
    for name, value in lengths.items():
        _write_quantity(detector, name, value, "mm")
    _write_quantity(source, "distance", -to_source, "mm")
    detector["field_of_view"] = _field_of_view(axis_column, data.shape[1])
    _write_exposure(data, keys, entry, instrument)
    _write_quantity(detector, "x_rotation_axis_pixel_position", axis_column, "px")
    _write_quantity(detector, "y_rotation_axis_pixel_position", axis_row, "px")

    sample = _group(entry, "sample", "NXsample")
    sample["name"] = (
        data.name if data.document is None else data.document.sample.name or data.name
    )
    turned = np.concatenate([np.full(len(before), angles[0]), angles])
    _write_quantity(sample, "rotation_angle", turned, "deg")

    shown = _group(entry, "data", "NXdata")
    shown.attrs["signal"] = "data"
    shown["data"] = images
    shown["image_key"] = detector["image_key"]
    shown["rotation_angle"] = sample["rotation_angle"]

    collection = _group(entry, "flexdt", "NXcollection")
    _write_quantity(collection, "cone_vec", geometry.rows, "mm")


def _field_of_view(axis_column: float, columns: int) -> str:
    """Return NXtomo's `Full`, or `Half` where the smaller side of the rotation axis has
    less than `HALF_SEEN` times the columns of the larger.
    """
    left = axis_column + 0.5
    right = columns - 0.5 - axis_column
    if min(left, right) < HALF_SEEN * max(left, right):
        return "Half"
    return "Full"


def _write_exposure(data: ImageSet, keys: list[int], entry: Any, instrument: Any) -> None:
    """Write tube and exposure, as far as they are known: count_time, energies, and the
    current of each image as its monitor (`control`).

    Without a voltage only count_time is written. The source's energy is the voltage;
    `incident_energy` is the mean of flexdt's own spectrum, where its tables have the
    voltage. The current of dark images is 0.

    Args:
        data: the data set.
        keys: image key of each image.
        entry: group of the scan.
        instrument: group in it.
    """
    kV, power_W, exposure_ms = _exposure_of(data)
    count = len(keys)
    if exposure_ms is not None:
        _write_quantity(
            instrument["detector"],
            "count_time",
            np.full(count, exposure_ms / 1000.0),
            "s",
        )
    if kV is None:
        return
    source = instrument["source"]
    _write_quantity(source, "voltage", kV, "kV")
    _write_quantity(source, "energy", kV, "keV")
    least, most = voltages()
    if least <= kV <= most:
        beam = _group(instrument, "beam", "NXbeam")
        _write_quantity(beam, "incident_energy", tube_spectrum(kV).mean_keV, "keV")
        beam["incident_energy"].attrs["description"] = (
            f"mean of flexdt's spectrum of a tungsten anode at {kV:g} kV"
        )
    if power_W is not None:
        current_A = power_W / kV / 1000.0
        _write_quantity(source, "power", power_W, "W")
        _write_quantity(source, "current", current_A, "A")
        control = _group(entry, "control", "NXmonitor")
        lit = np.where(np.array(keys) == DARK, 0.0, current_A)
        _write_quantity(control, "data", lit, "A")
        control["data"].attrs["description"] = "current of the tube; there is no monitor"


def _exposure_of(data: ImageSet) -> tuple[float | None, float | None, float | None]:
    """Return voltage [kV], power [W] and exposure of one image [ms] as the settings or the
    simulation state them; None where unknown.

    The settings come first.
    """
    if data.settings is not None:
        return data.settings.kV, data.settings.power_W, data.settings.exposure_ms
    if data.truth is None:
        exposure = None
    else:
        exposure = data.truth.exposure
    if exposure is None:
        return None, None, None
    return exposure.kV, exposure.power_W, exposure.exposure_ms


def _group(parent: Any, name: str, kind: str) -> Any:
    group = parent.create_group(name)
    group.attrs["NX_class"] = kind
    return group


def _write_quantity(group: Any, name: str, value: Any, unit: str) -> None:
    group[name] = np.asarray(value, dtype=np.float64)
    group[name].attrs["units"] = unit
