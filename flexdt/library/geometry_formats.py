"""Geometry from and to files and other programs' objects: what the methods of `ConeVec` call.

The formats are in `flexdt.twin.exchange`, their files in `flexdt.library.datasets.exchange`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from flexdt.library.datasets.exchange import (
    FORMATS,
    Format,
    Given,
    import_geometry,
    load_geometry,
    save_geometry,
    text_of,
    write_geometry,
)
from flexdt.library.datasets.exchange_formats import OWN_ENDINGS
from flexdt.twin.errors import GeometryError
from flexdt.twin.exchange.geometry import ExchangeError, ScanGeometry
from flexdt.twin.exchange.number_tables import (
    TOMOSIPO_NAMES,
    read_json,
    read_tomosipo,
    tomosipo_arrays,
)
from flexdt.twin.geometry.cone_vec import ConeVec, Shape2, check_spread
from flexdt.twin.geometry.conventions import FloatArray, as_numbers
from flexdt.twin.plausibility import warn_of
from flexdt.twin.plausibility.scan_geometry import radian_findings
from flexdt.twin.signatures import File

OWN: Final = OWN_ENDINGS[0]
"""Ending of flexdt's own document."""


def from_astra(geometry: Any, shape: Shape2 | None) -> ConeVec:
    """See `ConeVec.from_astra`."""
    if not isinstance(geometry, Mapping):
        return check_spread(ConeVec(as_numbers("cone_vec", geometry), shape))
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
        raise GeometryError(f"ASTRA's geometry: {error}", {"asked": repr(error)}) from None
    own = check_spread(ConeVec(rows, counted))
    own.of_shape(shape)
    return own


def _circle_of_astra(geometry: Mapping[str, Any]) -> FloatArray:
    """Rows of type `cone`: our circle, with v upwards."""
    warn_of(radian_findings(geometry["ProjectionAngles"]), GeometryError, stacklevel=5)
    circle = ConeVec.circular(
        sod=float(geometry["DistanceOriginSource"]),
        sdd=float(geometry["DistanceOriginSource"]) + float(geometry["DistanceOriginDetector"]),
        angles=np.degrees(np.asarray(geometry["ProjectionAngles"], dtype=np.float64)),
        pixel=(float(geometry["DetectorSpacingX"]), float(geometry["DetectorSpacingY"])),
    )
    return ScanGeometry(circle).rows_up().cone_vec.rows


def to_astra(cone_vec: ConeVec) -> dict[str, Any]:
    """See `ConeVec.to_astra`."""
    rows, cols = cone_vec.of_shape()
    return {
        "type": "cone_vec",
        "DetectorRowCount": rows,
        "DetectorColCount": cols,
        "Vectors": cone_vec.rows.copy(),
    }


def from_tomosipo(geometry: Any) -> ConeVec:
    """See `ConeVec.from_tomosipo`."""
    if not isinstance(geometry, Mapping):
        vectors = geometry.to_vec() if hasattr(geometry, "to_vec") else geometry
        names = ("det_shape", *TOMOSIPO_NAMES[1:])
        lost = [name for name in names if not hasattr(vectors, name)]
        if lost:
            raise GeometryError(
                f"a {type(geometry).__name__} has no {', '.join(lost)}; allowed: a cone geometry "
                "of tomosipo",
                {"asked": type(geometry).__name__, "missing": lost},
            )
        found = (np.asarray(getattr(vectors, name)) for name in names)
        geometry = dict(zip(TOMOSIPO_NAMES, found, strict=True))
    arrays = {name: np.asarray(values) for name, values in geometry.items()}
    return _value(read_tomosipo(arrays, "tomosipo's geometry"))


def to_tomosipo(cone_vec: ConeVec) -> Any:
    """See `ConeVec.to_tomosipo`."""
    arrays = tomosipo_arrays(_scan(cone_vec))
    try:
        import tomosipo
    except ImportError as error:
        raise ExchangeError(
            f"tomosipo is not installed ({error}); a file for it: geometry.save('FILE.npz')"
        ) from None
    return tomosipo.cone_vec(**arrays)


def load(
    file: File,
    format: str | None,
    shape: Shape2 | None,
    pixel: float | Sequence[float] | None,
) -> ConeVec:
    """See `ConeVec.load`."""
    path = Path(file)
    pitch = None if pixel is None else _pair(pixel)
    if format is None and path.suffix.lower() == OWN:
        return _value(_json(path, Given(shape, pitch)))
    chosen = format or _format(path, [form for form in FORMATS.values() if form.read])
    return _value(import_geometry(path, chosen, Given(shape, pitch)))


def _json(path: Path, given: Given) -> ScanGeometry:
    """Our own document, or a CTSimU scenario: the document says which."""
    if "file" in read_json(text_of(path), str(path)):
        return import_geometry(path, "ctsimu", given)
    own = load_geometry(path)
    if given.shape is not None:
        own.cone_vec.with_shape(own.shape).of_shape(given.shape)
    given.check_pitch(own, path)
    return own if own.shape is not None else ScanGeometry(own.cone_vec, given.shape)


def save(cone_vec: ConeVec, file: File, format: str | None) -> None:
    """See `ConeVec.save`."""
    path = Path(file)
    if format is None and path.suffix.lower() == OWN:
        save_geometry(_scan(cone_vec), path)
    else:
        chosen = format or _format(path, [form for form in FORMATS.values() if form.write])
        write_geometry(_scan(cone_vec), path, chosen)


def _format(path: Path, among: Iterable[Format]) -> str:
    """The name of the format whose files end so; `OWN` is flexdt's."""
    by_ending = {ending: form.name for form in among for ending in form.endings if ending != OWN}
    found = by_ending.get(path.suffix.lower())
    if found is None:
        endings = [OWN, *by_ending]
        raise ExchangeError(
            f"{path.name}: the ending of a geometry file is one of {', '.join(endings)}",
            {"asked": path.suffix, "allowed": endings},
        )
    return found


def _pair(pixel: float | Sequence[float]) -> tuple[float, float]:
    try:
        along_columns, along_rows = np.broadcast_to(np.asarray(pixel, dtype=np.float64), (2,))
    except (TypeError, ValueError):
        along_columns = along_rows = math.nan
    if not (along_columns > 0 and along_rows > 0):
        raise GeometryError(
            f"pixel is {pixel!r}; allowed: one number or two above 0 [mm]",
            {"asked": repr(pixel), "allowed": "> 0"},
        )
    return float(along_columns), float(along_rows)


def _scan(cone_vec: ConeVec) -> ScanGeometry:
    return ScanGeometry(cone_vec, cone_vec.detector_shape)


def _value(geometry: ScanGeometry) -> ConeVec:
    return geometry.cone_vec.with_shape(geometry.shape)
