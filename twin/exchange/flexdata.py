"""flexDATA's `geometry.toml`: one circle, steps of equal angle, everything else standing still.

Its detector has rows that grow upwards, so a geometry written here belongs to images turned upside
down, which flexDATA's reader does by itself. Source, panel and axis may stand anywhere and the
panel may be tilted in any way. The format has no list of angles and no skew pixels, so uneven
angles, more than one circle and panels with skew pixels are errors.
"""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from flexdt.twin.exchange import geometry as g
from flexdt.twin.exchange.geometry import ExchangeError, ScanGeometry
from flexdt.twin.exchange.number_tables import cone_vec_of
from flexdt.twin.geometry.conventions import FloatArray, rotation_x, rotation_y, rotation_z

VERSION: Final = "0.1.0"
ROUNDED_MM: Final = 1e-4
"""How far any number of a view may lie beside what the format states: scripts of step scans write
angles with six decimals, which is some 1e-5 mm."""
UNSUPPORTED: Final = ("axs_roll", "axs_pitch", "vol_rot")
"""Numbers of the format that must be zero to be read: see the documentation."""
_LISTS: Final = {"vol_tra": 3, "vol_rot": 3, "det_sample": 2, "ang_range": 2, "vol_sample": 3}


def flexdata_text(geometry: ScanGeometry) -> str:
    """The TOML, for images turned upside down.

    Args:
        geometry: of the images as they are.

    Raises:
        ExchangeError: a geometry that the format cannot state.
    """
    up = geometry.rows_up()
    pitch_u, pitch_v = g.require_panel(up.cone_vec, "flexDATA")
    circle = g.circle_of(up.cone_vec, "flexDATA", ROUNDED_MM)
    first, last = _equal_steps(circle)
    source, detector = circle.source, circle.detector
    if source[1] >= 0.0 or detector[1] - source[1] <= 0.0:
        raise ExchangeError("flexDATA: the source must stand before axis and detector")
    axes = np.stack(
        [circle.u / pitch_u, np.cross(circle.v / pitch_v, circle.u / pitch_u), circle.v / pitch_v],
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


def _equal_steps(circle: g.CircularScan) -> tuple[float, float]:
    """First and last angle [rad].

    Raises:
        ExchangeError: the steps between them are not equal.
    """
    angle = circle.angle
    first, last = float(angle[0]), float(angle[-1])
    if len(angle) > 1:
        reach = float(np.linalg.norm(circle.source) + np.linalg.norm(circle.detector))
        miss = np.abs(np.linspace(first, last, len(angle)) - angle)
        if miss.max() * reach > ROUNDED_MM:
            view = int(np.argmax(miss))
            raise ExchangeError(
                f"flexDATA's geometry.toml has no list of angles, only first and last; view {view} "
                f"lies {math.degrees(miss[view]):.3g} deg, up to {miss[view] * reach:.3g} mm, "
                f"beside equal steps (allowed: {ROUNDED_MM:g} mm)",
                {"row": view, "asked": math.degrees(miss[view])},
            )
    return first, last


def _angles(axes: FloatArray) -> tuple[float, float, float]:
    """Roll about y, then yaw about the turned z, then pitch about the turned x [rad]."""
    yaw = math.asin(max(-1.0, min(1.0, axes[1, 0])))
    if math.hypot(axes[0, 0], axes[2, 0]) < 1e-9:
        raise ExchangeError(
            "flexDATA: the panel's rows run along the beam; its angles are not determined"
        )
    roll = math.atan2(-axes[2, 0], axes[0, 0])
    return roll, yaw, math.atan2(-axes[1, 2], axes[1, 1])


def read_flexdata(
    text: str, views: int | None = None, shape: tuple[int, int] | None = None, file: str = "<toml>"
) -> ScanGeometry:
    """Read a `geometry.toml`; the result is for images as they are, with row 0 on top.

    Args:
        text: the file.
        views: number of projections, where the file does not say it (only ours do).
        shape: detector (rows, cols), likewise.
        file: for messages.

    Raises:
        ExchangeError: not such a file, or something of it that is not understood.
    """
    records = _records(text, file)
    get = _Getter(records, file)
    for name in UNSUPPORTED:
        if any(get.list_of(name) if name in _LISTS else [get.number(name, 0.0)]):
            raise ExchangeError(
                f"{file}: {name} is not zero: flexDATA tilts source and detector orbits about "
                "different points then, which is not imitated",
                {"path": name, "allowed": 0},
            )
    count = records.get("proj_count", views) if views is None else views
    if not isinstance(count, int) or count < 1:
        raise ExchangeError(f"{file} does not say how many views there are; it must be given")
    if shape is None and "det_rows" in records and "det_cols" in records:
        shape = (int(get.number("det_rows")), int(get.number("det_cols")))
    sod = get.number("src2obj", None if "src2det" not in records else math.nan)
    odd = get.number("det2obj", None if "src2det" not in records else math.nan)
    if "src2det" in records:
        sdd = get.number("src2det")
        sod, odd = (sdd - odd if math.isnan(sod) else sod), (sdd - sod if math.isnan(odd) else odd)
    if math.isnan(sod) or math.isnan(odd):
        raise ExchangeError(f"{file}: two of src2obj, det2obj and src2det are needed")
    roll, yaw, pitch = (math.radians(get.number(f"det_{n}", 0.0)) for n in ("roll", "yaw", "pitch"))
    axes = rotation_y(roll) @ rotation_z(yaw) @ rotation_x(pitch)
    axis = get.number("axs_tan", 0.0)
    sample, moved = get.list_of("det_sample", 1.0), get.list_of("vol_tra")
    pixel = get.number("det_pixel")
    first, last = get.list_of("ang_range")
    angles = np.linspace(first, last, count)
    circle = g.CircularScan(
        np.radians(angles),
        np.array([-moved[1], -moved[2]]),
        np.array([get.number("src_tan", 0.0) - axis, -sod, get.number("src_ort", 0.0)]),
        np.array([get.number("det_tan", 0.0) - axis, odd, get.number("det_ort", 0.0)]),
        axes[:, 0] * pixel * sample[1],
        axes[:, 2] * pixel * sample[0],
    )
    rows = circle.cone_vec().rows - np.array([0, 0, moved[0]] * 2 + [0.0] * 6)
    notes = () if records.get("flextoml_version") == VERSION else (
        f"flextoml_version is {records.get('flextoml_version')!r}; this reads {VERSION}",
    )  # fmt: skip
    return ScanGeometry(cone_vec_of(rows, file), shape, notes=notes).rows_up()


def _records(text: str, file: str) -> Mapping[str, Any]:
    # flexDATA writes tuples, which are no TOML, and repairs them itself on reading.
    repaired = re.sub(r"[()]", lambda m: "[" if m[0] == "(" else "]", text.lstrip("\ufeff"))
    try:
        return tomllib.loads(repaired)
    except tomllib.TOMLDecodeError as error:
        raise ExchangeError(f"{file} is not valid TOML: {error}", {"path": file}) from None


class _Getter:
    """Numbers of the file by name."""

    def __init__(self, records: Mapping[str, Any], file: str) -> None:
        self._records, self._file = records, file

    def number(self, name: str, default: float | None = None) -> float:
        value = self._records.get(name, default)
        if isinstance(value, list) and len(value) == 1:
            value = value[0]
        if isinstance(value, bool) or not isinstance(value, int | float):
            said = "is missing" if value is None else f"= {str(value)[:40]} is no number"
            raise ExchangeError(f"{self._file}: {name} {said}", {"path": name})
        if not math.isfinite(value) and value is not default:
            raise ExchangeError(f"{self._file}: {name} is not finite", {"path": name})
        return float(value)

    def list_of(self, name: str, default: float = 0.0) -> list[float]:
        value = self._records.get(name)
        count = _LISTS[name]
        if value is None and name != "ang_range":
            return [default] * count
        given = value if isinstance(value, list) else []
        sound = all(isinstance(v, int | float) and math.isfinite(v) for v in given)
        if not sound or len(given) != count:
            raise ExchangeError(f"{self._file}: {name} must be {count} numbers", {"path": name})
        return [float(v) for v in given]
