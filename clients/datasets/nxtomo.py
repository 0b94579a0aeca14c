"""Data sets to folders and to other programs' containers: what the methods of `DataSet` call.

NeXus's NXtomo (application definition 2.0) holds raw counts with image keys, in HDF5. It knows a
rotation angle and little else of a cone beam, so the rows of cone_vec stand beside it, in a group
that readers of NXtomo pass over.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from flexdt.clients.datasets.data_set import Counts, DataSet
from flexdt.clients.extras import package
from flexdt.runtime.files.dataset_folder import read_image, tiff_bytes
from flexdt.runtime.files.directory import Directory
from flexdt.twin.dataset.dataset_errors import (
    DOCUMENT,
    GEOMETRY,
    SCAN_SETTINGS,
    SCRIPT,
    XRE_SETTINGS,
    DatasetExistsError,
    DatasetFormatError,
)
from flexdt.twin.dataset.flexdt_json import CorrectionEntry
from flexdt.twin.dataset.rebuild import MATCH_MM
from flexdt.twin.dataset.scan_settings import (
    ScanSettings,
    figures_of,
    format_scan_settings,
    poses_of,
)
from flexdt.twin.dataset.xre import format_settings
from flexdt.twin.errors import GeometryError
from flexdt.twin.exchange.geometry import ScanGeometry
from flexdt.twin.exchange.number_tables import VECTOR_NAMES, geometry_text
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.projection.volume import Volume
from flexdt.twin.signatures import File


def save_data_set(data: DataSet, folder: File) -> None:
    """See `DataSet.save`."""
    path = Path(folder)
    path.mkdir(parents=True, exist_ok=True)
    if any(path.iterdir()):
        raise DatasetExistsError(
            f"{path} is not empty; allowed: a new or an empty folder", {"path": str(path)}
        )
    with Directory(path, sync=False) as out:
        for name, image in references(data):
            out.put(name, tiff_bytes(image))
        for i in data.present:
            out.put(data.frames[i].file, tiff_bytes(data.counts(i)))
        for name in (SCAN_SETTINGS, XRE_SETTINGS, SCRIPT):
            if data.folder is not None and (data.folder / name).is_file():
                out.put(name, (data.folder / name).read_bytes())
        stated = stated_settings(data) if data.folder is None else None
        if stated is not None:
            out.put(SCAN_SETTINGS, format_scan_settings(stated).encode())
            out.put(XRE_SETTINGS, format_settings(stated).encode())
        out.put(*_geometry(data))


def stated_settings(data: DataSet) -> ScanSettings | None:
    """What the scanner's texts say of a data set in memory.

    Returns:
        None where they cannot say its geometry: they know one circle in the plane of the sample's
        reference point, with equal steps and an upright panel of square pixels.
    """
    geometry, shape = data.geometry, data.shape
    try:
        poses = Poses.from_cone_vec(geometry)
    except GeometryError:
        return None
    even = np.linspace(poses.angle[0], poses.angle[-1], len(poses.angle))
    figures = figures_of(poses[:1], shape)
    said = poses_of(figures, shape, even).cone_vec().rows
    # The pitches are small: at the panel's edge they count by half its pixels.
    weights = np.repeat([1.0, 1.0, shape[1] / 2.0, shape[0] / 2.0], 3)
    if np.abs((said - geometry.rows) * weights).max() > MATCH_MM:
        return None
    exposure, camera = (getattr(data.truth, name, None) for name in ("exposure", "camera"))
    before = [name[:2] for name, _ in references(data)]
    start, last = np.degrees(even[[0, -1]]).tolist()
    return ScanSettings(
        scan_id=data.name,
        **figures.stated,
        sample_name=data.name,
        software="flexdt",
        kV=None if exposure is None else exposure.kV,
        power_W=None if exposure is None else exposure.power_W,
        exposure_ms=None if camera is None else camera.exposure_ms,
        averages=None if camera is None else float(camera.averages),
        scan_type="step scan",
        projections=len(data),
        start_angle_deg=start,
        last_angle_deg=last,
        pre_flats=before.count("io"),
        post_flats=0,
        darks=before.count("di"),
    )


def _geometry(data: DataSet) -> tuple[str, bytes]:
    """The file that says the geometry: the document as it was, or the geometry by itself."""
    files = tuple(frame.file for frame in data.frames)
    document = data.document
    moved = data.nominal is not None and not np.allclose(
        data.nominal.cone_vec().rows, data.cone_vec.rows, rtol=0.0, atol=1e-6
    )
    if document is None or moved or document.files("projection") != files:
        geometry = ScanGeometry(
            data.geometry, data.shape, name=data.name, files=files, notes=data.warnings,
            full_scale=data.full_scale,
        )  # fmt: skip
        return GEOMETRY, geometry_text(geometry).encode()
    entry = CorrectionEntry.of(data.correction)
    return DOCUMENT, document.model_copy(update={"correction": entry}).to_json().encode()


def references(data: DataSet) -> list[tuple[str, Counts]]:
    """Dark and flat images with their names; means that are no whole numbers are rounded."""
    if data.arrays is None:
        return [(path.name, read_image(path)) for path in (*data.darks, *data.flats)]
    kinds = (("di", data.arrays.darks), ("io", data.arrays.flats))
    return [
        (f"{kind}{i:06d}.tif", np.rint(image).astype(np.uint16))
        for kind, images in kinds
        for i, image in enumerate(() if images is None else images)
    ]


def to_xarray(data: DataSet) -> Any:
    """See `DataSet.to_xarray`."""
    xarray = package("xarray", "to_xarray")
    rows = data.geometry.rows
    return xarray.DataArray(
        data.line_integrals(),
        dims=("view", "row", "column"),
        name="line_integrals",
        coords={
            "angle": ("view", data.angles_deg, {"units": "deg"}),
            **{n: ("view", c, {"units": "mm"}) for n, c in zip(VECTOR_NAMES, rows.T, strict=True)},
            "file": ("view", [frame.file for frame in data.frames]),
        },
        attrs={"title": data.name, "units": "1"},
    )


def volume_to_xarray(volume: Volume) -> Any:
    """See `Volume.to_xarray`."""
    xarray = package("xarray", "to_xarray")
    places = zip("xyz", volume.centers(), strict=True)
    coords = {axis: (axis, values, {"units": "mm"}) for axis, values in places}
    attrs = {"units": "1/mm"}
    return xarray.DataArray(volume.data, coords, tuple("zyx"), "attenuation", attrs)


PROJECTION, FLAT, DARK = 0, 1, 2
KEYS: Final = {"di": DARK, "io": FLAT}
"""Image keys of what the scanner calls so."""


def save_nxtomo(data: DataSet, file: File) -> None:
    """See `DataSet.to_nxtomo`."""
    h5py = package("h5py", "to_nxtomo")
    if any(frame.shape != data.shape for frame in data.frames):
        raise DatasetFormatError(
            f"{data.where}: projections of several shapes; NXtomo has one", {"path": data.where}
        )
    path = Path(file)
    part = path.with_name(f".{path.name}.part")
    try:
        with h5py.File(part, "w") as out:
            _write(data, out)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def _write(data: DataSet, out: Any) -> None:
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
    source["type"], source["probe"] = "Fixed Tube X-ray", "x-ray"
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
        _measured(detector, name, value, "mm")
    _measured(source, "distance", -to_source, "mm")
    _measured(detector, "x_rotation_axis_pixel_position", axis_column, "px")
    _measured(detector, "y_rotation_axis_pixel_position", axis_row, "px")

    sample = _group(entry, "sample", "NXsample")
    sample["name"] = data.name if data.document is None else data.document.sample.name or data.name
    turned = np.concatenate([np.full(len(before), angles[0]), angles])
    _measured(sample, "rotation_angle", turned, "deg")

    shown = _group(entry, "data", "NXdata")
    shown.attrs["signal"] = "data"
    shown["data"] = images
    shown["image_key"] = detector["image_key"]
    shown["rotation_angle"] = sample["rotation_angle"]

    own = _group(entry, "flexdt", "NXcollection")
    _measured(own, "cone_vec", geometry.rows, "mm")


def _group(parent: Any, name: str, kind: str) -> Any:
    group = parent.create_group(name)
    group.attrs["NX_class"] = kind
    return group


def _measured(group: Any, name: str, value: Any, unit: str) -> None:
    group[name] = np.asarray(value, dtype=np.float64)
    group[name].attrs["units"] = unit
