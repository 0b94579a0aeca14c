"""`data settings XRE.txt`: sections of `key = value`, written as the scanner does.

Texts and figures of other programs stand in quotes, switches are TRUE and FALSE. `xre_reading`
reads it.
"""

from __future__ import annotations

import string
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib import resources
from typing import Any, Final

import numpy as np

from flexdt.twin.dataset.flexdt_json import ScanRecord
from flexdt.twin.dataset.scan_settings import ENTRIES, ScanSettings, settings_of
from flexdt.twin.dataset.scan_settings_text import EOL, clean
from flexdt.twin.geometry.conventions import BEAM, RIGHT, UP, FloatArray, stage_rotation

Value = str | bool | int | float
Sections = Mapping[str, Mapping[str, Value]]
# `[POIs]` are places in the scanner's world, as it prints them. That world has x across, y
# along the beam and z up, with the origin at the focal spot's foot: the same directions as
# here. A detector's entry is its top left corner with pixels per mm along rows and columns.
# Hardware that the twin does not model has no entry.
_NOWHERE: Final = (0.0, 0.0, 0.0)
_TALL_MM: Final = 2000.0
"""Height of the sample when the record has none [mm]."""


def format_xre(record: ScanRecord) -> str:
    """Format `data settings XRE.txt` (CRLF) for a scan: `data/texts/xre.txt`, filled in.

    Values of the maker's reconstruction and of hardware the twin does not model are zero
    or empty there, so that readers find every key. The flat's position is there only if
    the flat's axis has a motor line.

    Args:
        record: of the scan.
    """
    s = settings_of(record)
    camera = record.camera
    rotation = next(iter(record.machine.geometry.get("angle", {"rot_obj": 1.0})))
    motors: dict[str, Value] = {name: line.value for name, line in s.motors.items()}
    # Both are written also where there are none.
    absent = {name: motors.get(name, 0.0) for name in ("mag_tube", "tra_tube")}
    moved = {name: value for name, value in motors.items() if name != rotation} | absent
    flat = next((b for b in record.blocks if b.kind == "flat"), None)
    if (
        flat is not None and record.flat_axis in motors
    ):  # where it took the sample for the flats
        sign = record.machine.axes[record.flat_axis].settings_sign
        moved |= {
            "Flat field axis": record.flat_axis,
            "Flat Field position": sign * float(flat.positions[record.flat_axis][0]),
            "Scan position": motors[record.flat_axis],
        }
    images = record.count("projection")
    seconds = int(record.duration_s)
    turn = abs((s.last_angle_deg or 0.0) - (s.start_angle_deg or 0.0))
    values = {
        "scan_type": f"{'smooth' if record.smooth else 'step'} take and save",
        "rotation_mode": "Smooth" if record.smooth else "Step",
        "rotation": rotation,
        "turning": s.motors[rotation],
        "start": _utc(record.started),
        "stop": _utc(record.stopped),
        "duration": f"{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}",
        "error": "No error" if record.complete else record.reason or "not finished",
        "binning": float(camera.binning),
        "roi": ";".join(map(str, camera.roi.edges)),
        "bottom": camera.shape[0] - 1.0,
        "right": camera.shape[1] - 1.0,
        "voxel_mm": (s.voxel_um or 0.0) / 1000.0,
        "last": max(images - 1, 0),
        "per_turn": round((images - 1) * 360.0 / turn) + 1
        if images > 1 and turn > 0
        else images,
        "sections": record.sections(),
        "darks": record.count("dark"),
        "flats": record.count("flat"),
        "motors": motors,
        "moved": moved,
        "places": points_of_interest(record),
    }
    template = resources.files("flexdt.twin") / "data" / "texts" / "xre.txt"
    lines = template.read_text(encoding="utf-8").splitlines(keepends=False)
    return (
        EOL.join(_Filled().format(line, record=record, s=s, **values) for line in lines)
        + EOL
    )


class _Filled(string.Formatter):
    """Formatter of values for this file; mappings become lines."""

    def format_field(self, value: Any, format_spec: str) -> str:
        """Format a value: by its format specification, if given; a mapping as lines `key
        = value`; else by its type (`_written`).
        """
        if format_spec:
            return format(value, format_spec)
        if isinstance(value, Mapping):
            return _lines(value)
        return _written(value)


def format_settings(settings: ScanSettings) -> str:
    """Format the fields of settings that `data settings XRE.txt` has a place for, as
    sections; None are left out.
    """
    sections: dict[str, dict[str, Value]] = {}
    for field, entry in ENTRIES.items():
        value = getattr(settings, field)
        if entry.xre is not None and value is not None:
            section, key = entry.xre
            sections.setdefault(section, {})[key] = value
    return format_sections(sections)


def format_sections(sections: Sections) -> str:
    """Format sections as text with CRLF: `[name]`, a line an entry, an empty line."""
    blocks = [
        f"[{clean(name)}]{EOL}{_lines(entries)}" for name, entries in sections.items()
    ]
    return (EOL + EOL).join(block.strip() for block in blocks) + EOL


def _lines(entries: Mapping[str, Value]) -> str:
    """Format entries as lines `key = value`, without a line end after the last."""
    return EOL.join(f"{key} = {_written(value)}" for key, value in entries.items())


def _utc(moment: datetime) -> str:
    """Format a moment in UTC with seven decimals of seconds; without a zone it is taken as UTC."""
    if moment.tzinfo is None:
        utc = moment
    else:
        utc = moment.astimezone(UTC)
    return f"{utc:%Y-%m-%d %H:%M:%S}.{utc.microsecond:06d}0 UTC"


def points_of_interest(record: ScanRecord) -> Mapping[str, str]:
    """Compute the entries of the XRE file's points of interest at the settings file's
    moment.

    Positions [mm] in the world frame; an entry has place and three axes.

    Args:
        record: of the scan.

    Returns:
        Name -> entry: COT (axis at the source's height), HCVC (piercing point), image,
        object, TMV, the sample, projCOT (axis on the panel), world, and the tube.
    """
    pose = record.settings_pose()
    source = pose.source[0]
    axis = pose.axis[0]
    rows, cols = record.camera.shape
    u, v = pose.u[0], pose.v[0]
    corner = pose.detector[0] - u * cols / 2.0 - v * rows / 2.0
    right, down = (
        u / float(u @ u),
        v / float(v @ v),
    )  # pixels per mm along rows and columns
    at_source_height = np.array([axis[0], axis[1], source[2]])
    towards_source = np.cross(down, right)
    towards_source /= float(np.linalg.norm(towards_source))
    foot = np.array([source[0], pose.detector[0, 1], source[2]])
    stretch = float(pose.sdd[0] / pose.sod[0])
    projected = source + (at_source_height - source) * stretch
    object_x, object_y, _ = stage_rotation(float(pose.angle[0])).T
    return {
        "COT": _entry(at_source_height, object_x, -object_y, UP),
        "HCVC": _entry(foot, _NOWHERE, _NOWHERE, _NOWHERE),
        "image": _entry(corner, right, down, towards_source),
        "object": _entry(axis, object_x, object_y, UP),
        "TMV": _entry(at_source_height, RIGHT, BEAM, UP, height=0.0, safe=False),
        f"{_word(record.sample.name)}$ample": _entry(
            at_source_height,
            object_x,
            object_y,
            UP,
            radius=record.sample.diameter_mm / 2.0,
            height=record.sample.height_mm or _TALL_MM,
            track=True,
        ),
        "projCOT": _entry(projected, _NOWHERE, _NOWHERE, _NOWHERE),
        "world": _entry(_NOWHERE, RIGHT, BEAM, UP),
        record.machine.tube.name: _entry(source, RIGHT, BEAM, UP),
    }


def _entry(
    place: Sequence[float] | FloatArray,
    x: Sequence[float] | FloatArray,
    y: Sequence[float] | FloatArray,
    z: Sequence[float] | FloatArray,
    *,
    radius: float = 0.0,
    height: float = -1.0,
    track: bool = False,
    safe: bool = True,
) -> str:
    """Format one place with its axes, radius and height, as a text of the XRE file.

    Vectors are (3,) [mm], world frame; the range is infinite; height -1: none.
    """
    return (
        f"WC{_triple(place)}dirX{_triple(x)}dirY{_triple(y)}dirZ{_triple(z)}radius[{radius:f}]"
        f"height[{height:f}]track[{str(track).upper()}]safe range?[{str(safe).upper()}]"
        "minimal[-Inf;-Inf;-Inf]maximal[Inf;Inf;Inf]"
    )


def _word(name: str) -> str:
    """Remove from a name the characters that would end a key."""
    return "".join(c for c in name if c.isprintable() and c not in '=:[]"')


def _triple(vector: Sequence[float] | FloatArray) -> str:
    """Format a vector as "[x;y;z]" with up to four decimals, without trailing zeros and
    minus zero."""
    texts = [f"{value:.4f}".rstrip("0").rstrip(".") for value in vector]
    return f"[{';'.join('0' if text in ('-0', '') else text for text in texts)}]"


def _written(value: Value) -> str:
    """Format one value by its type: TRUE or FALSE, whole number, six decimals, or quoted
    text.

    A text is reduced to one line; quotes and backslashes in it are escaped.
    """
    match value:
        case bool():
            return "TRUE" if value else "FALSE"
        case int():
            return f"{value:d}"
        case float():
            return f"{value:f}"
        case str():
            escaped = clean(value).replace("\\", "\\\\").replace('"', '\\"')
            return f'"{escaped}"'
