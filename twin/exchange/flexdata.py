"""flexDATA's `geometry.toml`: one circle, steps of equal angle, everything else standing still.

Its detector has rows that grow upwards, so a geometry written here belongs to images turned
upside down, which flexDATA's reader does by itself. Source, panel and axis may stand anywhere
and the panel may be tilted in any way. The format has no list of angles and no skew pixels, so
uneven angles, more than one circle and panels with skew pixels are errors.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from flexdt.twin.dataset.format_table import Ledger
from flexdt.twin.errors import TwinError
from flexdt.twin.exchange import geometry as g
from flexdt.twin.exchange.geometry import ExchangeError, ScanGeometry
from flexdt.twin.exchange.geometry_tables import FLEXDATA
from flexdt.twin.exchange.number_tables import cone_vec_of
from flexdt.twin.geometry.conventions import (
    FloatArray,
    rotation_x,
    rotation_y,
    rotation_z,
)
from flexdt.twin.input_limits import parse_toml
from flexdt.twin.plausibility import settled
from flexdt.twin.plausibility.scan_geometry import distance_findings

VERSION: Final = "0.1.0"
ROUNDED_MM: Final = 1e-4
"""Largest deviation of any number of a view from the format's value [mm]. Scripts of
step scans write angles with six decimals, which is some 1e-5 mm."""
SAME_DISTANCE: Final = 1e-6
"""Relative difference of two statements of a distance that is none."""
_NUMBERS: Final[Mapping[str, Any]] = {
    **dict.fromkeys(("src2obj", "det2obj", "src2det"), math.nan),
    **dict.fromkeys(("det_rows", "det_cols", "det_pixel"), math.nan),
    "ang_range": (math.nan, math.nan),
    "det_sample": (1.0, 1.0),
    "vol_tra": (0.0, 0.0, 0.0),
    "vol_rot": (0.0, 0.0, 0.0),
    **dict.fromkeys(("src_tan", "src_ort", "det_tan", "det_ort", "axs_tan"), 0.0),
    **dict.fromkeys(("axs_roll", "axs_pitch", "det_roll", "det_yaw", "det_pitch"), 0.0),
}
"""Name -> default values, as many as a file must give."""


def flexdata_text(geometry: ScanGeometry) -> str:
    """Write the TOML file of a geometry, for images turned upside down.

    Only a known shape gives det_rows and det_cols.

    Args:
        geometry: of the images before they are turned.

    Raises:
        ExchangeError: skew pixels or several sizes, no circle, unequal angle steps (each
            beyond `ROUNDED_MM` at source and panel), or a source that is not before axis
            and panel.
    """
    up = geometry.rows_up()
    pitch_u, pitch_v = g.require_panel(up.cone_vec, "flexDATA")
    circle = g.circle_of(up.cone_vec, "flexDATA", ROUNDED_MM)
    source = circle.source
    detector = circle.detector
    first, last = float(circle.angle[0]), float(circle.angle[-1])
    reach = float(np.linalg.norm(source) + np.linalg.norm(detector))
    beside = np.abs(np.linspace(first, last, len(circle.angle)) - circle.angle) * reach
    message = (
        "flexDATA's geometry.toml has no list of angles, only first and last; "
        "the distance [mm]"
    )
    g.require_each(f"{message} from equal steps", beside, ROUNDED_MM)
    if source[1] >= 0.0 or detector[1] - source[1] <= 0.0:
        raise ExchangeError("flexDATA: the source must stand before axis and detector")
    axes = np.stack(
        [
            circle.u / pitch_u,
            np.cross(circle.v / pitch_v, circle.u / pitch_u),
            circle.v / pitch_v,
        ],
        axis=1,
    )
    roll, yaw, pitch = _angles(axes)
    sod = float(-source[1])
    values: dict[str, object] = {
        "src2obj": sod,
        "det2obj": float(detector[1]),
        "det_pixel": pitch_u,
        "img_pixel": pitch_u * sod / (sod + float(detector[1])),
        "unit": "mm",
        "axs_tan": 0.0,
        "vol_rot": [0.0, 0.0, 0.0],
        "vol_tra": [0.0, -float(circle.center[0]) + 0.0, -float(circle.center[1]) + 0.0],
        "det_sample": [pitch_v / pitch_u, 1.0],
        "vol_sample": [1.0, 1.0, 1.0],
        "ang_range": [math.degrees(first), math.degrees(last)],
        "src_ort": float(source[2]),
        "src_tan": float(source[0]),
        "det_ort": float(detector[2]),
        "det_tan": float(detector[0]),
        "det_roll": math.degrees(roll),
        "det_pitch": math.degrees(pitch),
        "det_yaw": math.degrees(yaw),
        "axs_roll": 0.0,
        "axs_pitch": 0.0,
        "flextoml_version": VERSION,
        "proj_count": len(geometry),
    }
    if geometry.shape is not None:
        values["det_rows"], values["det_cols"] = geometry.shape
    return "".join(f"{name} = {json.dumps(value)}\n" for name, value in values.items())


def _angles(axes: FloatArray) -> tuple[float, float, float]:
    """Compute a panel's roll about y, yaw about the turned z and pitch about the turned x [rad],
    in this order.

    `axes`: (3, 3); columns are the panel's x, y and z.
    Returns roll, yaw, pitch.
    Raises ExchangeError: the rows run along the beam.
    """
    yaw = math.asin(max(-1.0, min(1.0, axes[1, 0])))
    if math.hypot(axes[0, 0], axes[2, 0]) < 1e-9:
        raise ExchangeError(
            "flexDATA: the panel's rows run along the beam; its angles are not determined"
        )
    roll = math.atan2(-axes[2, 0], axes[0, 0])
    return roll, yaw, math.atan2(-axes[1, 2], axes[1, 1])


def read_flexdata(
    text: str,
    views: int | None = None,
    shape: tuple[int, int] | None = None,
    file: str = "<toml>",
) -> ScanGeometry:
    """Read a `geometry.toml`; the result is for images as they are, with row 0 on top.

    `views` and `shape`, if given, count before the file's. Of the three distances two are
    needed; src2det counts only for one that is missing. Parentheses are read as brackets,
    since flexDATA writes tuples. Another version of the format is a note of the result,
    not an error.

    Args:
        text: the file.
        views: number of projections, if not in the file (only ours state it).
        shape: detector (rows, cols), if not in the file.
        file: for messages.

    Raises:
        ExchangeError: not such a file, a leaning axis or a turned volume, no number
            of views, or distances that are not a scanner's.
    """
    # flexDATA writes tuples, which are no TOML, and repairs them itself on reading.
    repaired = text.lstrip("\ufeff").translate(str.maketrans("()", "[]"))
    try:
        records = parse_toml(repaired, file)
    except TwinError as error:
        raise ExchangeError(error.message, error.data) from None
    except ValueError as error:
        raise ExchangeError(
            f"{file} is not valid TOML: {error}", {"path": file}
        ) from None
    numbers = {name: _values(name, records, file) for name in _NUMBERS}
    if views is None:
        count = records.get("proj_count", views)
    else:
        count = views
    if not isinstance(count, int) or count < 1:
        raise ExchangeError(
            f"{file} does not say how many views there are; it must be given"
        )
    if shape is None and "det_rows" in records and "det_cols" in records:
        shape = (int(numbers["det_rows"]), int(numbers["det_cols"]))
    sod, odd, sdd = (float(numbers[name]) for name in ("src2obj", "det2obj", "src2det"))
    both = {"src2obj and det2obj": sod + odd, "src2det": sdd}
    sod, odd = (
        (sdd - odd if math.isnan(sod) else sod),
        (sdd - sod if math.isnan(odd) else odd),
    )
    if math.isnan(sod) or math.isnan(odd):
        raise ExchangeError(f"{file}: two of src2obj, det2obj and src2det are needed")
    given = distance_findings(
        sod, sod + odd, numbers["det_pixel"], ("src2obj", "src2det")
    )
    settled(given, ExchangeError, file)
    roll, yaw, pitch = (
        math.radians(numbers[f"det_{name}"]) for name in ("roll", "yaw", "pitch")
    )
    axes = rotation_y(roll) @ rotation_z(yaw) @ rotation_x(pitch)
    axis = numbers["axs_tan"]
    moved = numbers["vol_tra"]
    sample = numbers["det_sample"]
    circle = g.CircularScan(
        np.radians(np.linspace(numbers["ang_range"][0], numbers["ang_range"][1], count)),
        np.array([-moved[1], -moved[2]]),
        np.array([numbers["src_tan"] - axis, -sod, numbers["src_ort"]]),
        np.array([numbers["det_tan"] - axis, odd, numbers["det_ort"]]),
        axes[:, 0] * numbers["det_pixel"] * sample[1],
        axes[:, 2] * numbers["det_pixel"] * sample[0],
    )
    rows = circle.cone_vec().rows - np.array([0, 0, moved[0]] * 2 + [0.0] * 6)
    version = records.get("flextoml_version")
    note = f"flextoml_version is {version!r}; this reads {VERSION}"
    notes = () if version == VERSION else (note,)
    geometry = ScanGeometry(cone_vec_of(rows, file), shape, notes=notes).rows_up()
    said = Ledger(FLEXDATA, file, error=ExchangeError)
    for name, value in records.items():
        zeros = isinstance(value, list) and not any(value)
        said.state(name, "0" if zeros else str(value))
    said.use_all()
    first, other = both.values()
    if abs(first - other) > SAME_DISTANCE * abs(other):
        why = f"src2obj and det2obj say {first:.6g} mm, src2det {other:.6g} mm"
        said.set_aside("src2det", f"{why}; the former are taken")
    return geometry.accounted(said)


def _values(name: str, records: Mapping[str, Any], file: str) -> FloatArray:
    """Read one of `_NUMBERS` from a file, or its default if absent.

    A value that is wrong is an error if the file states it, or if it is pixel or angle
    range.

    Args:
        name: of the value.
        records: content of the file.
        file: for messages.

    Returns:
        float64 in the default's shape; NaN for a value that the file does not state and
        that has no default.

    Raises:
        ExchangeError: a wrong number of values, or one that is not finite.
    """
    usual = np.array(_NUMBERS[name])
    given = records.get(name, usual.tolist())
    if isinstance(given, list):
        each = given
    else:
        each = [given]
    try:
        known = len(each) == usual.size and all(type(v) in (int, float) for v in each)
        if known:
            values = np.reshape([float(v) for v in each], usual.shape)
        else:
            values = usual * math.nan
    except OverflowError:
        values = usual * math.nan
    if (name in records or name in ("det_pixel", "ang_range")) and not np.isfinite(
        values
    ).all():
        raise ExchangeError(
            f"{file}: {name} must be {usual.size} finite numbers", {"path": name}
        )
    return values
