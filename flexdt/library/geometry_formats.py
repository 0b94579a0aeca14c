"""Read and write geometries as files and other programs' objects, for methods of `ConeVec`.

The formats are in `flexdt.twin.exchange`, their files in `flexdt.library.datasets.exchange`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import numpy as np

from flexdt.library.datasets.exchange import (
    FORMATS,
    format_of_ending,
    load_stated,
    save_geometry,
    write_geometry,
)
from flexdt.library.datasets.exchange_formats import OWN_ENDINGS
from flexdt.twin.caller_warnings import warn_caller
from flexdt.twin.errors import GeometryError
from flexdt.twin.exchange.cil_arrays import ORIGIN, PANEL, POSES, cil_arrays
from flexdt.twin.exchange.geometry import ExchangeError, ScanGeometry
from flexdt.twin.exchange.leap_arrays import leap_arrays
from flexdt.twin.exchange.number_tables import (
    TOMOSIPO_NAMES,
    read_tomosipo,
    tomosipo_arrays,
)
from flexdt.twin.exchange.tigre_arrays import ANGLES, tigre_arrays
from flexdt.twin.geometry.cone_vec import ConeVec, Shape2, check_spread
from flexdt.twin.geometry.conventions import FloatArray, as_numbers
from flexdt.twin.plausibility import warn_of
from flexdt.twin.plausibility.scan_geometry import geometry_findings, radian_findings
from flexdt.twin.projection.volume import Grid, Volume
from flexdt.twin.signatures import File

OWN_ENDING: Final = OWN_ENDINGS[0]
"""File ending of flexdt's own document."""
MAX_CUBE_DIFFERENCE: Final = 1e-6
"""Relative difference of a voxel's edges up to which it is a cube."""


def from_astra(geometry: Any, shape: Shape2 | None) -> ConeVec:
    """Convert a geometry of ASTRA; see `ConeVec.from_astra`.

    Rows are checked for pixels with rays of their own, and for distances that no scanner
    has. Angles of `cone` are [rad]; those that look like degrees give a warning.

    Args:
        geometry: ASTRA's dictionary (`cone` or `cone_vec`), or rows (n, 12).
        shape: detector (rows, cols), where ASTRA's is missing or to be checked.

    Raises:
        GeometryError: another type, an incomplete geometry, or another shape than
            `shape`.
    """
    if not isinstance(geometry, Mapping):
        return _plausible(check_spread(ConeVec(as_numbers("cone_vec", geometry), shape)))
    try:
        kind = geometry["type"]
        counted = (geometry["DetectorRowCount"], geometry["DetectorColCount"])
        if kind == "cone":
            rows = _circle_of_astra(geometry)
        elif kind == "cone_vec":
            rows = np.asarray(geometry["Vectors"], dtype=np.float64)
        else:
            raise GeometryError(
                f"ASTRA's geometry of type {kind!r}; allowed: cone, cone_vec",
                {"asked": str(kind), "allowed": ["cone", "cone_vec"]},
            )
    except KeyError as error:
        raise GeometryError(
            f"ASTRA's geometry lacks {error}", {"asked": sorted(map(str, geometry))}
        ) from None
    except (TypeError, ValueError) as error:
        if isinstance(error, GeometryError):
            raise
        raise GeometryError(
            f"ASTRA's geometry: {error}", {"asked": repr(error)}
        ) from None
    cone_vec = check_spread(ConeVec(rows, counted))
    cone_vec.of_shape(shape)
    return _plausible(cone_vec)


def _plausible(cone_vec: ConeVec) -> ConeVec:
    """Return a geometry of another program; warns of pixels of another unit. Raises
    GeometryError: no scanner has such distances."""
    warn_of(geometry_findings(cone_vec, cone_vec.detector_shape), GeometryError)
    return cone_vec


def _circle_of_astra(geometry: Mapping[str, Any]) -> FloatArray:
    """Convert ASTRA's type `cone` (angles in radians) to rows (n, 12) of our circle, with
    v upwards; warns of angles that look like degrees.
    """
    warn_of(radian_findings(geometry["ProjectionAngles"]), GeometryError)
    circle = ConeVec.circular(
        sod=float(geometry["DistanceOriginSource"]),
        sdd=float(geometry["DistanceOriginSource"])
        + float(geometry["DistanceOriginDetector"]),
        angles=np.degrees(np.asarray(geometry["ProjectionAngles"], dtype=np.float64)),
        pixel=(float(geometry["DetectorSpacingX"]), float(geometry["DetectorSpacingY"])),
    )
    return ScanGeometry(circle).rows_up().cone_vec.rows


def to_astra(cone_vec: ConeVec) -> dict[str, Any]:
    """Convert to ASTRA's dictionary of type cone_vec, with a copy of the vectors; see
    `ConeVec.to_astra`.

    Raises:
        GeometryError: the geometry has no panel shape.
    """
    rows, cols = cone_vec.of_shape()
    return {
        "type": "cone_vec",
        "DetectorRowCount": rows,
        "DetectorColCount": cols,
        "Vectors": cone_vec.rows.copy(),
    }


def from_tomosipo(geometry: Any) -> ConeVec:
    """Convert a cone geometry of tomosipo, or its arrays by name; see `ConeVec.from_tomosipo`.

    Other geometries of tomosipo are converted by their `to_vec`. Pixels that look like another
    unit are a warning.

    Raises:
        GeometryError: no cone geometry (the message names what it lacks), or impossible
            distances or pixels.
    """
    if not isinstance(geometry, Mapping):
        if hasattr(geometry, "to_vec"):
            vectors = geometry.to_vec()
        else:
            vectors = geometry
        names = ("det_shape", *TOMOSIPO_NAMES[1:])
        lost = [name for name in names if not hasattr(vectors, name)]
        if lost:
            raise GeometryError(
                f"a {type(geometry).__name__} has no {', '.join(lost)}; "
                "allowed: a cone geometry of tomosipo",
                {"asked": type(geometry).__name__, "missing": lost},
            )
        stored = (np.asarray(getattr(vectors, name)) for name in names)
        geometry = dict(zip(TOMOSIPO_NAMES, stored, strict=True))
    arrays = {name: np.asarray(values) for name, values in geometry.items()}
    return _plausible(_value(read_tomosipo(arrays, "tomosipo's geometry")))


def to_tomosipo(cone_vec: ConeVec) -> Any:
    """Make a cone geometry of tomosipo; see `ConeVec.to_tomosipo`."""
    arrays = tomosipo_arrays(_scan(cone_vec))
    return _peer("tomosipo", "tomosipo", ".npz").cone_vec(**arrays)


def to_cil(cone_vec: ConeVec) -> Any:
    """Make an acquisition geometry of CIL, which must be installed; see `ConeVec.to_cil`."""
    arrays = cil_arrays(_scan(cone_vec))
    framework = _peer("cil.framework", "CIL", ".cil")
    geometry = framework.AcquisitionGeometry.create_Cone3D_Flex(
        *(arrays[name] for name in POSES)
    )
    counts, sizes = (arrays[name].tolist() for name in PANEL[:2])
    geometry.set_panel(counts, sizes, origin=ORIGIN)
    return geometry


def to_tigre(cone_vec: ConeVec, like: object) -> tuple[Any, FloatArray]:
    """Make TIGRE's geometry and angles; see `ConeVec.to_tigre`.

    Args:
        cone_vec: the geometry.
        like: grid or volume whose voxels it gets; None for no volume.

    Returns:
        TIGRE's geometry, and angles [rad].

    Raises:
        ExchangeError: TIGRE is not installed, or cannot express the geometry.
    """
    arrays = tigre_arrays(_scan(cone_vec))
    angles = np.asarray(arrays.pop(ANGLES), dtype=np.float64)
    geometry = _peer("tigre", "TIGRE", ".tigre").geometry(mode="cone")
    for name, values in arrays.items():
        setattr(geometry, name, values)
    if like is not None:
        blank = _voxels(like)
        edges = np.array(blank.voxel_xyz[::-1])
        geometry.nVoxel = np.array(blank.shape)
        geometry.dVoxel = edges
        geometry.sVoxel = geometry.nVoxel * edges
        # TIGRE moves the volume; a scan that moves it by itself does so in every view.
        geometry.offOrigin = geometry.offOrigin + np.array(blank.center_mm[::-1])
    return geometry, angles


def to_leap(cone_vec: ConeVec, like: object, rows_up: bool) -> Any:
    """Make a model of LEAP; see `ConeVec.to_leap`.

    Args:
        cone_vec: the geometry.
        like: grid or volume whose voxels it gets; None for LEAP's default volume.
        rows_up: count rows upwards.

    Raises:
        ExchangeError: LEAP is not installed, voxels are no cubes (within
            `MAX_CUBE_DIFFERENCE`), or LEAP refuses the geometry or the volume.
    """
    scan = _scan(cone_vec)
    arrays = leap_arrays(scan.rows_up() if rows_up else scan)
    model = _peer("leapctype", "LEAP", ".leap").tomographicModels()
    *numbers, a, b, c, d = arrays.values()
    poses = (np.ascontiguousarray(part, dtype=np.float32) for part in (a, b, c, d))
    if not model.set_modularbeam(*(number.item() for number in numbers), *poses):
        raise ExchangeError("LEAP refuses the geometry; it has printed why")
    if like is None:
        model.set_default_volume()
        return model
    blank = _voxels(like)
    x, y, z = blank.voxel_xyz
    if max(x, y, z) - min(x, y, z) > MAX_CUBE_DIFFERENCE * x:
        message = f"LEAP: voxels of {x:g} x {y:g} x {z:g} mm"
        raise ExchangeError.instead(message, [x, y, z], "cubes, in a modular beam")
    if not model.set_volume(*blank.shape[::-1], x, z, *blank.center_mm):
        raise ExchangeError("LEAP refuses the volume; it has printed why")
    return model


def _voxels(like: object) -> Volume:
    """Return the volume, or one of zeros on the grid.

    Raises:
        GeometryError: `like` is neither.
    """
    if isinstance(like, Volume):
        return like
    if isinstance(like, Grid):
        return like.blank()
    kind = type(like).__name__
    raise GeometryError.instead(f"like: a {kind}", kind, "a Grid or a Volume")


def _peer(module: str, name: str, ending: str) -> Any:
    """Import another program's module.

    Raises:
        ExchangeError: it cannot be imported; names a file ending in `ending` that it
            reads.
    """
    try:
        return import_module(module)
    except (ImportError, OSError) as error:
        raise ExchangeError(
            f"{name} cannot be imported ({error}); a file for it: geometry.save('FILE{ending}')"
        ) from None


def load(
    file: File,
    format: str | None,
    shape: Shape2 | None,
    pixel: float | Sequence[float] | None,
) -> ConeVec:
    """Read a geometry from a file, with warnings; see `ConeVec.load`."""
    stated = load_stated(file, format, shape, pixel)
    for note in stated.notes:
        warn_caller(note)
    return _value(stated)


def save(cone_vec: ConeVec, file: File, format: str | None) -> None:
    """Write a geometry to a file; see `ConeVec.save`.

    `format`: of `FORMATS`; None: by the file's ending. Raises ExchangeError: an unknown
    format, or one that cannot carry the geometry.
    """
    path = Path(file)
    if format is None and path.suffix.lower() == OWN_ENDING:
        save_geometry(_scan(cone_vec), path)
    else:
        chosen = format or format_of_ending(
            path, [form for form in FORMATS.values() if form.write]
        )
        write_geometry(_scan(cone_vec), path, chosen)


def _scan(cone_vec: ConeVec) -> ScanGeometry:
    return ScanGeometry(cone_vec, cone_vec.detector_shape)


def _value(geometry: ScanGeometry) -> ConeVec:
    return geometry.cone_vec.with_shape(geometry.shape)
