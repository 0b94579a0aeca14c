"""RTK's circular geometry as XML: nine numbers per view, any source and any flat panel.

RTK turns about its y with the source on +z: its (x, y, z) is our (x, z, -y). Nine numbers
describe every view of a flat panel with orthogonal rows and columns; the file has neither pixel
size nor shape, which belong to the images (spacing, and an origin of -(n - 1) / 2 pixels). Its
projection matrices state the same views a second time: both must agree, and either is enough. A
detector whose rows grow downwards has its u x v away from the source, which RTK writes with
negative distances. Curved detectors are not supported.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Final
from xml.etree import ElementTree

import numpy as np

from flexdt.twin.dataset.format_table import Ledger, as_number, series
from flexdt.twin.errors import TwinError
from flexdt.twin.exchange.geometry import ExchangeError, ScanGeometry, require_panel
from flexdt.twin.exchange.geometry_tables import RTK
from flexdt.twin.exchange.number_tables import cone_vec_of
from flexdt.twin.geometry.conventions import (
    FloatArray,
    rotation_x,
    rotation_y,
    rotation_z,
)
from flexdt.twin.input_limits import require_bytes, require_parts
from flexdt.twin.plausibility import settled
from flexdt.twin.plausibility.scan_geometry import distance_findings

TO_RTK: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Matrix from our (x, y, z) to RTK's; a rotation, no mirror."""
ROUNDING_TOLERANCE: Final = 1e-9
"""Largest relative difference of distances that counts as rounding."""
MAX_DISAGREEMENT_PX: Final = 0.05
"""Largest distance of the places where a view's matrix and its numbers put a point [px]."""
PROBE_SHARE: Final = 0.1
"""Distance of these points from the isocentre, relative to that of the source."""
MAX_SKEW: Final = 1e-4
"""Largest relative error of a matrix of rows and columns at a right angle, of one scale."""
VERSION: Final = "3"
NAMES: Final = (
    "GantryAngle",
    "OutOfPlaneAngle",
    "InPlaneAngle",
    "SourceToIsocenterDistance",
    "SourceToDetectorDistance",
    "SourceOffsetX",
    "SourceOffsetY",
    "ProjectionOffsetX",
    "ProjectionOffsetY",
)
"""Names of the nine numbers: angles [deg], then lengths [mm]."""
MATRIX: Final = "Matrix"
"""Element of a view's projection matrix."""
_ROOT = "RTKThreeDCircularGeometry"


def rtk_text(geometry: ScanGeometry) -> str:
    """Format a geometry as RTK's XML, with nine numbers and a projection matrix for each
    view.

    The panel's pixel size and shape are not in it.

    Args:
        geometry: of a flat panel with rectangular pixels.

    Raises:
        ExchangeError: nine numbers cannot express a view.
    """
    require_panel(geometry.cone_vec, "RTK")
    lines = [
        '<?xml version="1.0"?>',
        "<!DOCTYPE RTKGEOMETRY>",
        f'<{_ROOT} version="{VERSION}">',
    ]
    for view, row in enumerate(geometry.cone_vec.rows):
        values = parameters_of(row, view)
        lines.append("  <Projection>")
        lines += [f"    <{n}>{v!r}</{n}>" for n, v in zip(NAMES, values, strict=True)]
        lines.append("    <Matrix>")
        lines += ["      " + " ".join(map(repr, r)) for r in matrix_of(values).tolist()]
        lines += ["    </Matrix>", "  </Projection>"]
    return "\n".join([*lines, f"</{_ROOT}>", ""])


def parameters_of(row: FloatArray, view: int = 0) -> tuple[float, ...]:
    """Compute the nine numbers of one cone_vec row: three angles [deg], then six lengths
    [mm], in the order of `NAMES`.

    The gantry angle is from 0 to below 360; a panel whose normal is RTK's y has an
    in-plane angle of 0. Lengths of u and v do not enter.

    Args:
        row: (12,) [mm].
        view: its index, for the message.

    Raises:
        ExchangeError: the source is in the panel's plane.
    """
    source, centre, u, v = (TO_RTK @ row[i : i + 3] for i in (0, 3, 6, 9))
    u, v = u / np.linalg.norm(u), v / np.linalg.norm(v)
    normal = np.cross(u, v)
    # The panel's axes are the columns of Ry(gantry) Rx(out of plane) Rz(in plane).
    out = math.asin(max(-1.0, min(1.0, -normal[1])))
    if math.hypot(normal[0], normal[2]) > 1e-9:
        gantry = math.atan2(normal[0], normal[2])
        turn = math.atan2(u[1], v[1])
    else:  # the panel is horizontal: only the sum of the two other angles counts
        gantry = math.atan2(-u[2], u[0])
        turn = 0.0
    axes = rotation_y(gantry) @ rotation_x(out) @ rotation_z(turn)
    s, d = axes.T @ source, axes.T @ centre
    if abs(s[2] - d[2]) < 1e-6:
        raise ExchangeError(
            f"view {view}: the source lies in the panel's plane", {"row": view}
        )
    angles = (math.degrees(gantry) % 360.0, math.degrees(out), math.degrees(turn))
    lengths = (s[2], s[2] - d[2], s[0], s[1], d[0], d[1])
    return (*angles, *(float(x) for x in lengths))


def matrix_of(values: tuple[float, ...]) -> FloatArray:
    """Compute RTK's projection matrix (3, 4), which maps RTK's (x, y, z, 1) to the panel
    [mm].

    Args:
        values: the nine numbers of a view, in the order of `NAMES` [deg, mm].
    """
    gantry, out, turn = (math.radians(a) for a in values[:3])
    sid, sdd, sx, sy, px, py = values[3:]
    project = np.array(
        [
            [-sdd, 0.0, sx - px, sx * sdd - (sx - px) * sid],
            [0.0, -sdd, sy - py, sy * sdd - (sy - py) * sid],
            [0.0, 0.0, 1.0, -sid],
        ]
    )
    turned = np.eye(4)
    turned[:3, :3] = (rotation_y(gantry) @ rotation_x(out) @ rotation_z(turn)).T
    product: FloatArray = project @ turned
    return product


def read_rtk(
    text: str,
    pitch_mm: tuple[float, float],
    shape: tuple[int, int] | None = None,
    file: str = "<xml>",
) -> ScanGeometry:
    """Read RTK's XML.

    Numbers before the views hold for all. A view without numbers has those of its matrix.
    Distances are refused only if those of every view are such as no scanner has.

    Args:
        text: the file.
        pitch_mm: of a pixel along u and v [mm], which the file does not know.
        shape: detector (rows, cols), which it does not know either.
        file: for messages.

    Raises:
        ExchangeError: no such XML, another version, a number that is not finite, a
            parallel view, a matrix that contradicts the numbers of its view, a number that
            a view states twice, or a curved detector.
    """
    try:
        require_bytes("xml", len(text), file)
        require_parts("xml", text.count("<"), file)
    except TwinError as error:
        raise ExchangeError(error.message, error.data) from None
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ExchangeError(f"{file} is not valid XML: {error}", {"path": file}) from None
    if root.tag != _ROOT or root.get("version") != VERSION:
        problem = f"{file}: {root.tag} version {root.get('version')}"
        raise ExchangeError.instead(problem, root.tag, f"{_ROOT} version {VERSION}")
    said = Ledger(RTK, file, error=ExchangeError)
    said.state_all((f"@{name}", value) for name, value in root.attrib.items())
    common: dict[str, str] = {}  # numbers before the views hold for all
    each: dict[str, list[str]] = {}
    rows: list[FloatArray] = []
    stated: list[tuple[float, float]] = []
    twice: list[tuple[str, FloatArray, tuple[float, ...]]] = []
    for element in root:
        if element.tag != "Projection":
            _take(element, common, file)
            continue
        where = f"{file}: view {len(rows)}"
        own = {f"Projection@{name}": value for name, value in element.attrib.items()}
        for entry in element:
            _take(entry, own, file)
        for name, text_of in own.items():
            each.setdefault(name, []).append(text_of)
        values = common | own
        numbers = tuple(_number(name, values, file) for name in NAMES)
        matrix = _matrix(own.get(MATRIX), where)
        distances = numbers[3], numbers[4]
        if matrix is not None and not any(numbers):
            distances, row = view_of_matrix(matrix, pitch_mm, where)
        elif numbers[4] == 0.0:
            problem = f"{where} is parallel (no source-detector distance)"
            raise ExchangeError.instead(problem, 0.0, "a cone beam", row=len(rows))
        else:
            row = row_of(numbers, pitch_mm)
            if matrix is not None:
                twice.append((where, matrix, numbers))
        rows.append(row)
        stated.append(distances)
    _require_distances(stated, file)
    for where, matrix, numbers in twice:
        _require_agreement(matrix, numbers, pitch_mm, where)
    _account(said, common, each)
    return ScanGeometry(cone_vec_of(rows, file), shape).accounted(said)


def _account(
    said: Ledger, common: Mapping[str, str], each: Mapping[str, Sequence[str]]
) -> None:
    """Enter the numbers of all views and of each in a ledger, and compare them.

    Args:
        said: of the file.
        common: name -> text of what stands before the views.
        each: name -> texts of the views that state it.
    """
    for name, value in common.items():
        said.state(name, value, f"all views/{name}")
    for name, values in each.items():
        shown = series(values) if name != MATRIX else f"{len(values)} matrices"
        said.state(name, shown)
    said.use_all()
    for name, value in common.items():
        others = [one for one in each.get(name, ()) if as_number(one) != as_number(value)]
        if others and RTK.field(name) is not None:
            both = (
                f"{name} is {value} for all views and {others[0]} in one, which is taken"
            )
            said.set_place_aside(f"all views/{name}", both)


def _require_distances(stated: list[tuple[float, float]], file: str) -> None:
    """Check the distances of source to isocentre and to detector, as the file has them.

    One view with possible distances is enough; no views pass.

    Negative ones are those of a panel whose rows grow downwards.

    Raises:
        ExchangeError: those of all views are such as no scanner has.
    """
    if not stated:
        return
    pairs = np.array(stated)
    sod, sdd = (pairs * np.sign(pairs[:, 1:])).T
    if ((sod <= 0.0) | (sod > sdd * (1 + ROUNDING_TOLERANCE))).all():
        names = ("SourceToIsocenterDistance", "SourceToDetectorDistance")
        first, second = (float(one) for one in pairs[0])
        if first * second < 0.0:
            problem = f"{file}: {names[0]} is {first:g} mm and {names[1]} {second:g} mm"
            allowed = f"0 < {names[0]} <= {names[1]}, or both with the other sign"
            raise ExchangeError.instead(problem, [first, second], allowed)
        impossible = distance_findings(float(sod[0]), float(sdd[0]), 0.1 * sdd[0], names)
        settled(impossible, ExchangeError, file)


def row_of(values: tuple[float, ...], pitch_mm: tuple[float, float]) -> FloatArray:
    """Compute a cone_vec row (12,) [mm] from nine numbers; the inverse of `parameters_of`.

    u and v are orthogonal, of length `pitch_mm`.

    Args:
        values: in the order of `NAMES` [deg, mm].
        pitch_mm: of a pixel along u and v.
    """
    gantry, out, turn = (math.radians(a) for a in values[:3])
    sid, sdd, sx, sy, px, py = values[3:]
    axes = TO_RTK.T @ rotation_y(gantry) @ rotation_x(out) @ rotation_z(turn)
    source = axes @ [sx, sy, sid]
    centre = axes @ [px, py, sid - sdd]
    return np.concatenate(
        [source, centre, axes[:, 0] * pitch_mm[0], axes[:, 1] * pitch_mm[1]]
    )


def view_of_matrix(
    matrix: FloatArray, pitch_mm: tuple[float, float], where: str
) -> tuple[tuple[float, float], FloatArray]:
    """Compute the distances and the cone_vec row of a projection matrix; the inverse of
    `matrix_of`, whatever factor the matrix has.

    Args:
        matrix: (3, 4), from RTK's (x, y, z, 1) to the panel [mm].
        pitch_mm: of a pixel along u and v.
        where: file and view, for messages.

    Returns:
        Distances of the source to isocentre and to detector [mm], and the row (12,) [mm].

    Raises:
        ExchangeError: the matrix is singular or parallel, or is that of no flat panel with
            rows and columns at a right angle.
    """
    with np.errstate(all="ignore"):
        sign = np.sign(np.linalg.det(matrix[:, :3]))
        scaled = matrix * (sign / np.linalg.norm(matrix[2, :3]))
        normal = scaled[2, :3]
        offsets = scaled[:2, :3] @ normal
        across, down = scaled[:2, :3] - offsets[:, None] * normal
        squares = across @ across, down @ down
        skew = max(abs(across @ down), abs(squares[0] - squares[1]))
        flat = np.isfinite(scaled).all() and squares[0] > 0.0
    if not flat or skew > MAX_SKEW * squares[0]:
        problem = f"{where}: its Matrix is that of no cone beam on a flat panel"
        allowed = "rows and columns at a right angle, of one scale in mm"
        raise ExchangeError.instead(problem, matrix.tolist(), allowed, path=MATRIX)
    source = -np.linalg.solve(scaled[:, :3], scaled[:, 3])
    sdd = math.copysign(math.sqrt(squares[0]), source @ normal)
    u = across / -sdd
    v = np.cross(normal, u)
    sx, sy, sid = (float(source @ axis) for axis in (u, v, normal))
    px, py = sx - offsets[0], sy - offsets[1]
    centre = px * u + py * v + (sid - sdd) * normal
    parts = (source, centre, u * pitch_mm[0], v * pitch_mm[1])
    row = np.concatenate([TO_RTK.T @ part for part in parts])
    return (sid, sdd), row


def _matrix(text: str | None, where: str) -> FloatArray | None:
    """Return the projection matrix (3, 4) of a view, or None if it has none.

    `text`: of its element; `where`: file and view, for messages.
    Raises ExchangeError: it has not twelve finite numbers.
    """
    if text is None:
        return None
    values = np.array([as_number(part) for part in text.split()])
    if values.shape != (12,) or not np.isfinite(values).all():
        problem = f"{where}: its Matrix is {' '.join(text.split())[:60]!r}"
        raise ExchangeError.instead(problem, text[:60], "12 finite numbers", path=MATRIX)
    return values.reshape(3, 4)


def _require_agreement(
    matrix: FloatArray,
    numbers: tuple[float, ...],
    pitch_mm: tuple[float, float],
    where: str,
) -> None:
    """Check that the matrix of a view puts points around the isocentre where its numbers
    do.

    Args:
        matrix: (3, 4), as the file states it.
        numbers: nine, in the order of `NAMES` [deg, mm].
        pitch_mm: of a pixel along u and v.
        where: file and view, for messages.

    Raises:
        ExchangeError: places differ by more than `MAX_DISAGREEMENT_PX`.
    """
    apart = PROBE_SHARE * abs(numbers[3])
    steps = np.hstack([np.zeros((3, 1)), np.eye(3), -np.eye(3)]) * apart
    points = np.vstack([steps, np.ones(7)])
    with np.errstate(all="ignore"):
        stated, expected = (
            one[:2] / one[2] for one in (matrix @ points, matrix_of(numbers) @ points)
        )
        off = np.abs(stated - expected) / np.array(pitch_mm)[:, None]
    if not off.max() <= MAX_DISAGREEMENT_PX and np.isfinite(expected).all():
        far = float(np.nan_to_num(off, nan=np.inf).max())
        problem = (
            f"{where}: its Matrix puts points {far:.3g} px from where its numbers do; "
            "was one of them changed alone?"
        )
        allowed = f"{MAX_DISAGREEMENT_PX:g} px, or numbers or a Matrix alone"
        raise ExchangeError.instead(problem, far, allowed, path=MATRIX)


def _take(entry: ElementTree.Element, values: dict[str, str], file: str) -> None:
    """Put the text of an XML element, and of its attributes and members, into `values`.

    Raises:
        ExchangeError: the view states it a second time, differently.
    """
    for name, text in _texts(entry, entry.tag):
        if not _same(values.setdefault(name, text), text):
            problem = f"{file}: {name} is {values[name][:40]} and {text[:40]}"
            raise ExchangeError.instead(problem, text[:40], "one value", path=name)


def _texts(entry: ElementTree.Element, path: str) -> Iterator[tuple[str, str]]:
    """Yield (path, text) of an element, of its attributes and of all below it.

    Members of one tag are numbered from the second on: `Note/p`, `Note/p[2]`.
    """
    if not len(entry):
        yield path, (entry.text or "").strip()
    for name, value in entry.attrib.items():
        yield f"{path}@{name}", value
    count: Counter[str] = Counter()
    for member in entry:
        count[member.tag] += 1
        number = count[member.tag]
        which = f"[{number}]" if number > 1 else ""
        yield from _texts(member, f"{path}/{member.tag}{which}")


def _same(first: str, second: str) -> bool:
    """Check whether two texts are the same, or the same number written twice."""
    return first == second or as_number(first) == as_number(second)


def _number(name: str, values: Mapping[str, str], file: str) -> float:
    """Return one of the nine numbers of a view; 0 where it is not stated, as RTK does.

    Raises:
        ExchangeError: it is not finite.
    """
    text = values.get(name, "0")
    value = as_number(text)
    if not math.isfinite(value):
        problem = f"{file}: {name} is {text[:40]!r}"
        raise ExchangeError.instead(problem, text[:40], "a finite number", path=name)
    return value
