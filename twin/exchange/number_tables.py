"""Geometry as plain numbers: csv, ASTRA's text, tomosipo's arrays, the project's own JSON file.

Numbers are written so that reading gives the same float64. A table of another size is an error
that names the number of values found. The JSON document stores the real geometry separately
from the one that reconstruction knows; files of another version are errors.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Final

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, PositiveInt, ValidationError

from flexdt.message_words import problem_words
from flexdt.twin.dataset.format_table import Ledger, series
from flexdt.twin.dataset.provenance import Provenance
from flexdt.twin.errors import TwinError
from flexdt.twin.exchange.geometry import ExchangeError, ScanGeometry
from flexdt.twin.exchange.geometry_tables import ASTRA, CSV, OWN, TOMOSIPO
from flexdt.twin.exchange.view_arrays import stated
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.json_text import parse_json

VECTOR_NAMES: Final = tuple(
    f"{part}_{axis}" for part in ("source", "detector", "u", "v") for axis in "xyz"
)
TOMOSIPO_NAMES: Final = ("shape", "src_pos", "det_pos", "det_v", "det_u")
_SHAPE = re.compile(r"^\s*#\s*detector rows (\d+), columns (\d+)\s*$", re.MULTILINE)
LONGEST_SHOWN: Final = 200
"""Characters of an unknown key's value that are kept."""
KIND: Final = "flexdt geometry"
SCHEMA: Final = 1
Rows = list[Annotated[list[float], Field(min_length=12, max_length=12)]]
Texts = Annotated[tuple[str, ...], Field(strict=False)]


def vectors_text(geometry: ScanGeometry) -> str:
    """Format a geometry as ASTRA's cone_vec text, a line of twelve numbers for each view, in
    full precision. Shape and files are not in it."""
    return "".join(
        " ".join(map(repr, row)) + "\n" for row in geometry.cone_vec.rows.tolist()
    )


def read_vectors_text(text: str, file: str = "<text>") -> ScanGeometry:
    """Read a line of twelve numbers for each view, between blanks, commas or semicolons;
    # begins a comment, which is told.

    Empty lines are skipped; at least one view must be there.

    Raises:
        ExchangeError: another number of them, or one that is no finite number; names the
            line or view.
    """
    rows = []
    comments: list[str] = []
    for number, line in enumerate(text.splitlines(), 1):
        content, mark, comment = line.partition("#")
        comments += [comment.strip()] if mark and comment.strip() else []
        if content.strip():
            words = re.split(r"[\s,;]+", content.strip(" \t,;"))
            rows.append(_numbers(words, file, number))
    return _vectors(rows, file, comments)


def _vectors(
    rows: npt.ArrayLike, file: str, comments: Sequence[str] = ()
) -> ScanGeometry:
    """Make the geometry of ASTRA's vectors, with what its file states."""
    cone = cone_vec_of(rows, file)
    said = Ledger(ASTRA, file, error=ExchangeError)
    said.state("vectors", f"{len(cone)} x 12 numbers")
    said.use("vectors")
    _comment(said, comments)
    return ScanGeometry(cone).accounted(said)


def _comment(said: Ledger, comments: Sequence[str]) -> None:
    """Enter the comments of a file as one value."""
    if comments:
        said.state("comment", "; ".join(dict.fromkeys(comments)))


def read_vectors_array(
    array: npt.NDArray[np.generic], file: str = "<array>"
) -> ScanGeometry:
    """Read ASTRA's cone_vec from an array (n, 12) of integers or floats.

    Raises ExchangeError: the shape or type is different.
    """
    if array.ndim != 2 or array.shape[1] != 12 or not _real(array):
        message = f"{file}: an array of {array.dtype}"
        raise ExchangeError.of_shape(message, array.shape, ("n", 12), ", numbers")
    return _vectors(array, file)


def csv_text(geometry: ScanGeometry) -> str:
    """Format a geometry as CSV with a header, one line a view: frame, file, stage angle
    [deg], then the twelve numbers [mm].

    A comment with the detector's shape comes first if that is known; files are empty if
    unknown. Numbers are in full precision.

    Raises:
        GeometryError: a stage angle cannot be determined, since u is vertical.
    """
    out = io.StringIO()
    write = csv.writer(out, lineterminator="\n")
    if geometry.shape is not None:
        out.write("# detector rows {}, columns {}\n".format(*geometry.shape))
    write.writerow(("frame", "file", "angle_deg", *VECTOR_NAMES))
    angles = np.degrees(Poses.from_cone_vec(geometry.cone_vec).angle).tolist()
    files = geometry.files or [""] * len(geometry)
    for i, row in enumerate(geometry.cone_vec.rows.tolist()):
        write.writerow((i, files[i], repr(angles[i]), *map(repr, row)))
    return out.getvalue()


def read_csv(text: str, file: str = "<csv>") -> ScanGeometry:
    """Parse a table whose header names the twelve numbers, in any order; other columns
    are told.

    Empty lines and lines that begin with # are skipped. A `file` column gives file names
    if no row leaves it empty. Without a comment of the shape that is None.

    Args:
        text: of the table; a comment may state the detector's shape.
        file: for messages.

    Raises:
        ExchangeError: names the line and what is missing.
    """
    shape = _SHAPE.search(text)
    lines = [
        (number, next(csv.reader([line])))
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.startswith("#")
    ]
    if lines:
        header = [name.strip() for name in lines[0][1]]
    else:
        header = []
    lost = [name for name in VECTOR_NAMES if name not in header]
    if lost:
        problem = f"{file}: the header lacks {', '.join(lost)}"
        raise ExchangeError.instead(problem, header, VECTOR_NAMES, missing=lost)
    at = [header.index(name) for name in VECTOR_NAMES]
    rows = []
    files = []
    for number, cells in lines[1:]:
        if len(cells) != len(header):
            problem = f"{file}:{number}: {len(cells)} cells"
            raise ExchangeError.instead(problem, len(cells), len(header), line=number)
        rows.append(_numbers([cells[i] for i in at], file, number))
        files.append(cells[header.index("file")] if "file" in header else "")
    geometry = ScanGeometry(
        cone_vec_of(rows, file),
        (int(shape[1]), int(shape[2])) if shape else None,
        files=tuple(files) if all(files) else (),
    )
    said = Ledger(CSV, file, error=ExchangeError)
    if shape:
        said.state("# detector rows, columns", f"{shape[1]}, {shape[2]}")
    for i, name in enumerate(header):
        said.state(name, series([cells[i] for _, cells in lines[1:]]))
    said.use_all()
    comments = [
        line[1:].strip()
        for line in text.splitlines()
        if line.startswith("#") and not _SHAPE.match(line)
    ]
    _comment(said, comments)
    return geometry.accounted(said)


def tomosipo_arrays(geometry: ScanGeometry) -> dict[str, npt.NDArray[np.generic]]:
    """Convert a geometry to the arguments of `ts.cone_vec`.

    The names are those of `TOMOSIPO_NAMES`; the shape is (rows, columns).

    `geometry`: with the detector's shape.
    Returns name -> array: shape (2,), and vectors (n, 3) as z, y, x [mm].
    Raises ExchangeError: the detector's shape is unknown.
    """
    if geometry.shape is None:
        raise ExchangeError(
            "tomosipo's cone_vec needs the detector's shape, which is unknown"
        )
    c = geometry.cone_vec
    parts = (c.source, c.detector, c.v, c.u)
    vectors = [np.ascontiguousarray(part[:, ::-1]) for part in parts]
    arrays = [np.array(geometry.shape, dtype=np.int64), *vectors]
    return dict(zip(TOMOSIPO_NAMES, arrays, strict=True))


def read_tomosipo(
    arrays: Mapping[str, npt.NDArray[np.generic]], file: str = "<npz>"
) -> ScanGeometry:
    """Convert the arguments of `ts.cone_vec`, as in `tomosipo_arrays`, to a geometry.

    Its arrays are in the order z, y, x; the result has x, y, z.

    Args:
        arrays: name -> array.
        file: for messages.

    Raises:
        ExchangeError: one is missing or has another shape.
    """
    lost = [name for name in TOMOSIPO_NAMES if name not in arrays]
    if lost:
        problem = f"{file} lacks {', '.join(lost)}"
        raise ExchangeError.instead(problem, list(arrays), TOMOSIPO_NAMES, missing=lost)
    vectors = [arrays[name] for name in TOMOSIPO_NAMES[1:]]
    shape = arrays["shape"]
    for name, array in zip(TOMOSIPO_NAMES[1:], vectors, strict=True):
        if array.ndim != 2 or array.shape != (len(vectors[0]), 3) or not _real(array):
            message = f"{file}: {name}"
            like = " like the others"
            raise ExchangeError.of_shape(message, array.shape, ("n", 3), like)
    if (
        shape.shape != (2,)
        or not np.issubdtype(shape.dtype, np.integer)
        or shape.min() < 1
    ):
        raise ExchangeError(f"{file}: shape must be two whole numbers (rows, columns)")
    source, detector, v, u = (np.asarray(a, dtype=np.float64)[:, ::-1] for a in vectors)
    rows = np.concatenate([source, detector, u, v], axis=1)
    said = stated(TOMOSIPO, arrays, file)
    said.use_all()
    cone = cone_vec_of(rows, file)
    return ScanGeometry(cone, (int(shape[0]), int(shape[1]))).accounted(said)


def cone_vec_of(numbers: npt.ArrayLike, file: str) -> ConeVec:
    """Check rows read from a file, and make a geometry from them.

    Args:
        numbers: (n, 12) [mm].
        file: for messages.

    Raises:
        ExchangeError: there are no rows, a number is not finite, or u and v span no
            panel; the first invalid view is named.
    """
    rows = np.asarray(numbers, dtype=np.float64).reshape(-1, 12)
    if not len(rows):
        raise ExchangeError(f"{file} holds no view")
    with np.errstate(all="ignore"):  # numbers of a damaged file may have any size
        area = np.linalg.norm(np.cross(rows[:, 6:9], rows[:, 9:12]), axis=1)
    for wrong, problem in (
        (~np.isfinite(rows).all(axis=1), "a number is not finite"),
        (~(area > 0.0), "u and v span no panel"),
    ):
        if wrong.any():
            view = int(np.argmax(wrong))
            raise ExchangeError(f"{file}: in view {view} {problem}", {"row": view})
    return ConeVec(rows)


def _numbers(words: Sequence[str], file: str, line: int) -> list[float]:
    """Parse the twelve numbers of a row; infinity and NaN pass here.

    Args:
        words: the cells.
        file: for messages.
        line: number of the line, for messages.

    Raises ExchangeError: another number of cells, or one that is no number; names file and line.
    """
    where: dict[str, object] = {"line": line, "path": file}
    try:
        numbers = [float(word) for word in words]
    except ValueError as error:
        word = str(error).partition(": ")[2][:42]
        raise ExchangeError(f"{file}:{line}: {word} is no number", where) from None
    if len(numbers) != 12:
        problem = f"{file}:{line}: {len(numbers)} numbers"
        raise ExchangeError.instead(problem, len(numbers), 12, **where)
    return numbers


def _real(array: npt.NDArray[np.generic]) -> bool:
    """Return whether an array has floats or integers; truth values and complex numbers
    are neither.
    """
    return np.issubdtype(array.dtype, np.floating) or np.issubdtype(
        array.dtype, np.integer
    )


class _Panel(BaseModel):
    model_config = ConfigDict(strict=True)
    rows: PositiveInt | None = None
    columns: PositiveInt | None = None


class _Document(BaseModel):
    model_config = ConfigDict(strict=True)
    name: str = ""
    detector: _Panel = _Panel()
    cone_vec: Rows
    real_cone_vec: Rows | None = None
    files: Texts = ()
    notes: Texts = ()
    full_scale: int | None = None
    kV: Annotated[float, Field(gt=0.0, allow_inf_nan=False)] | None = None
    provenance: list[dict[str, str | bool]] = []


def geometry_text(geometry: ScanGeometry) -> str:
    """Format a geometry as this project's JSON file, one line a view, with a final newline.

    It has kind, schema, name, detector size (null if unknown), notes, files, `cone_vec`,
    and `full_scale`, `kV`, `provenance` and `real_cone_vec` where known.
    """
    if geometry.shape is not None:
        rows, cols = geometry.shape
    else:
        rows, cols = (None, None)
    head = {
        "kind": KIND,
        "schema": SCHEMA,
        "name": geometry.name,
        "detector": {"rows": rows, "columns": cols},
        "notes": list(geometry.notes),
        "files": list(geometry.files),
        **({} if geometry.full_scale is None else {"full_scale": geometry.full_scale}),
        **({} if geometry.kV is None else {"kV": geometry.kV}),
        **({"provenance": geometry.provenance.to_list()} if geometry.provenance else {}),
    }
    parts = [
        f" {json.dumps(k)}: {json.dumps(v, ensure_ascii=False)}" for k, v in head.items()
    ]
    parts.append(_rows("cone_vec", geometry.cone_vec))
    if geometry.real is not None:
        parts.append(_rows("real_cone_vec", geometry.real))
    return "{\n" + ",\n".join(parts) + "\n}\n"


def _rows(name: str, cone_vec: ConeVec) -> str:
    """Format the rows of a geometry as the JSON member `name`, one line a view."""
    lines = ",\n  ".join(json.dumps(row) for row in cone_vec.rows.tolist())
    return f' "{name}": [\n  {lines}\n ]'


def read_geometry_text(text: str, file: str = "<geometry>") -> ScanGeometry:
    """Parse and validate the project's JSON file of a geometry.

    Keys that are null count as absent, unknown keys are told; of rows and columns both
    or neither is given.

    Args:
        text: of the file.
        file: for messages.

    Raises:
        ExchangeError: another kind or schema, or a wrong value; names file and key.
    """
    document = read_json(text, file)
    if (form := (document.get("kind"), document.get("schema"))) != (KIND, SCHEMA):
        message = f"{file}: kind {form[0]!r}, schema {form[1]!r}"
        raise ExchangeError.instead(message, list(form), f"{KIND!r}, schema {SCHEMA}")
    try:
        content = _Document.model_validate(
            {k: v for k, v in document.items() if v is not None}
        )
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise ExchangeError(
            f"{file}: {where}: {problem_words(first)}", {"path": where}
        ) from None
    rows = content.detector.rows
    columns = content.detector.columns
    real = content.real_cone_vec
    if (rows is None) != (columns is None):
        raise ExchangeError(
            f"{file}: detector: rows and columns are stated together or not at all; "
            f"{'rows' if rows is None else 'columns'} is missing"
        )
    geometry = ScanGeometry(
        cone_vec_of(content.cone_vec, f"{file}: cone_vec"),
        None if rows is None or columns is None else (rows, columns),
        None if real is None else cone_vec_of(real, f"{file}: real_cone_vec"),
        content.name,
        content.files,
        content.notes,
        content.full_scale,
        _provenance(content.provenance, file),
        content.kV,
    )
    return _with_unknown(geometry, document, file)


def _with_unknown(
    geometry: ScanGeometry, document: Mapping[str, Any], file: str
) -> ScanGeometry:
    """Return the geometry with the keys of its document that are not flexdt's, told."""
    said = Ledger(OWN, file, error=ExchangeError)
    panel = document.get("detector")
    inner = panel if isinstance(panel, dict) else {}
    for name, value in (*document.items(), *((f"detector/{k}", inner[k]) for k in inner)):
        if OWN.field(name) is None and name != "detector":
            said.state(name, json.dumps(value)[:LONGEST_SHOWN])
    return geometry.accounted(said)


def _provenance(members: list[dict[str, str | bool]], file: str) -> Provenance:
    """Make the provenance of its JSON form.

    Raises:
        ExchangeError: a member is missing, or a use has another name; names the file.
    """
    try:
        return Provenance.from_list(members)
    except (KeyError, ValueError) as error:
        said = f"{file}: provenance: {error}"
        raise ExchangeError(said, {"path": "provenance"}) from None


def read_json(text: str, file: str, kind: type[dict[str, Any]] = dict) -> dict[str, Any]:
    """Parse a JSON object; it and all objects inside it become of type `kind`.

    A byte order mark is removed.

    Args:
        text: of the file.
        file: for messages.
        kind: dict, or a class of it.

    Raises ExchangeError: the text is not a JSON object.
    """
    try:
        document = parse_json(text, kind, file=file)
    except TwinError as error:
        raise ExchangeError(error.message, error.data) from None
    except ValueError as error:
        raise ExchangeError(
            f"{file} is not valid JSON: {error}", {"path": file}
        ) from None
    if not isinstance(document, dict):
        raise ExchangeError(f"{file}: not a JSON object", {"path": file})
    return document
