"""The project's own geometry file: one JSON document with the cone_vec of every view.

Besides what all formats carry it stores the real geometry separately from the one that
reconstruction knows. Files of another version are errors.
"""

from __future__ import annotations

import json
from typing import Any, Final

import numpy as np

from flexdt.twin.exchange.geometry import ExchangeError, ScanGeometry
from flexdt.twin.exchange.number_tables import check_size, cone_vec_of
from flexdt.twin.geometry.cone_vec import ConeVec

KIND: Final = "flexdt geometry"
SCHEMA: Final = 1


def geometry_text(geometry: ScanGeometry) -> str:
    """As text: one line a view."""
    rows, cols = geometry.shape if geometry.shape is not None else (None, None)
    head = {
        "kind": KIND,
        "schema": SCHEMA,
        "name": geometry.name,
        "detector": {"rows": rows, "columns": cols},
        "notes": list(geometry.notes),
        "files": list(geometry.files),
        **({} if geometry.full_scale is None else {"full_scale": geometry.full_scale}),
    }
    parts = [f" {json.dumps(k)}: {json.dumps(v, ensure_ascii=False)}" for k, v in head.items()]
    parts.append(_rows("cone_vec", geometry.cone_vec))
    if geometry.real is not None:
        parts.append(_rows("real_cone_vec", geometry.real))
    return "{\n" + ",\n".join(parts) + "\n}\n"


def _rows(name: str, cone_vec: ConeVec) -> str:
    lines = ",\n  ".join(json.dumps(row) for row in cone_vec.rows.tolist())
    return f' "{name}": [\n  {lines}\n ]'


def read_geometry_text(text: str, file: str = "<geometry>") -> ScanGeometry:
    """Read a geometry file.

    Raises:
        ExchangeError: names file and key.
    """
    document = read_json(text, file)
    if document.get("kind") != KIND or document.get("schema") != SCHEMA:
        raise ExchangeError(
            f"{file}: kind {document.get('kind')!r}, schema {document.get('schema')!r}; this "
            f"version reads {KIND!r}, schema {SCHEMA}",
            {"allowed": [KIND, SCHEMA]},
        )
    detector = document.get("detector")
    sizes = [detector.get(k) if isinstance(detector, dict) else None for k in ("rows", "columns")]
    shape = None
    if any(size is not None for size in sizes):
        if not all(type(size) is int and size > 0 for size in sizes):
            raise ExchangeError(f"{file}: detector: rows and columns must be whole numbers above 0")
        shape = (int(sizes[0]), int(sizes[1]))  # type: ignore[arg-type]
    full_scale = document.get("full_scale")
    if full_scale is not None and type(full_scale) is not int:
        raise ExchangeError(f"{file}: full_scale must be a whole number")
    real = document.get("real_cone_vec")
    return ScanGeometry(
        _cone_vec(document.get("cone_vec"), "cone_vec", file),
        shape,
        None if real is None else _cone_vec(real, "real_cone_vec", file),
        str(document.get("name") or ""),
        _texts(document.get("files"), "files", file),
        _texts(document.get("notes"), "notes", file),
        full_scale,
    )


def read_json(text: str, file: str, kind: type[dict[str, Any]] = dict) -> dict[str, Any]:
    """A JSON object; it and those inside it are of this kind.

    Raises:
        ExchangeError: not one.
    """
    check_size(text, file)
    try:
        document = json.loads(text, object_pairs_hook=kind)
    except (ValueError, RecursionError) as error:
        raise ExchangeError(f"{file} is not valid JSON: {error}", {"path": file}) from None
    if not isinstance(document, dict):
        raise ExchangeError(f"{file}: not a JSON object", {"path": file})
    return document


def _cone_vec(value: object, name: str, file: str) -> ConeVec:
    try:
        rows = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        rows = np.zeros(0)
    if rows.ndim != 2 or rows.shape[1:] != (12,):
        raise ExchangeError(f"{file}: {name} must be rows of twelve numbers", {"path": name})
    return cone_vec_of(rows, f"{file}: {name}")


def _texts(value: object, name: str, file: str) -> tuple[str, ...]:
    if value is None:
        return ()
    if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
        raise ExchangeError(f"{file}: {name} must be a list of texts", {"path": name})
    return tuple(value)
