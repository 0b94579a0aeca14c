"""`data settings XRE.txt`: sections of `key = value`, written and read as the scanner does.

Texts and figures of other programs stand in quotes, switches are TRUE and FALSE. Reading returns
sections of plain texts; `XreSettings.settings` extracts the values that `scan settings.txt` would
hold. Unknown keys are kept without interpretation.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import resources
from typing import Any, Final

import numpy as np

from flexdt.twin.dataset.dataset_errors import XRE_SETTINGS, DatasetFormatError
from flexdt.twin.dataset.record import ScanRecord
from flexdt.twin.dataset.scan_settings import ENTRIES, MotorLine, ScanSettings, settings_of
from flexdt.twin.dataset.scan_settings_text import EOL, clean, parse_number, parse_roi
from flexdt.twin.geometry.conventions import BEAM, RIGHT, UP, FloatArray, stage_rotation
from flexdt.twin.geometry.poses import Poses

# The content of `data settings XRE.txt`, section by section, in the scanner's order.
#
# Values of the maker's reconstruction and of hardware the twin does not model are written as zero
# or empty, so that readers find every key.
#
# `[POIs]` are places in the scanner's world, as it prints them. That world has x across, y along
# the beam and z up, with the origin at the focal spot's foot: the same directions as here. A
# detector's entry is its top left corner with pixels per mm along rows and columns. Hardware that
# the twin does not model has no entry.

_NOWHERE: Final = (0.0, 0.0, 0.0)
_TALL_MM: Final = 2000.0
"""Height of the sample where the scanner was told none."""


def points_of_interest(record: ScanRecord) -> Mapping[str, str]:
    """Name -> entry: axis, piercing point, image, sample, source at the settings file's moment."""
    pose = record.settings_pose()
    source, axis = pose.source[0], pose.axis[0]
    rows, cols = record.camera.shape
    corner, right, down = _panel(pose, rows, cols)
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


def _panel(pose: Poses, rows: int, cols: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Top left corner [mm] and directions of columns and rows [pixels per mm] of the image."""
    u, v = pose.u[0], pose.v[0]
    corner = pose.detector[0] - u * cols / 2.0 - v * rows / 2.0
    return corner, u / float(u @ u), v / float(v @ v)


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
    return (
        f"WC{_triple(place)}dirX{_triple(x)}dirY{_triple(y)}dirZ{_triple(z)}radius[{radius:f}]"
        f"height[{height:f}]track[{str(track).upper()}]safe range?[{str(safe).upper()}]"
        "minimal[-Inf;-Inf;-Inf]maximal[Inf;Inf;Inf]"
    )


def _word(name: str) -> str:
    """A name as part of a key: what would end the key is left out."""
    return "".join(c for c in name if c.isprintable() and c not in '=:[]"')


def _triple(vector: Sequence[float] | FloatArray) -> str:
    return "[" + ";".join(_short(float(v)) for v in vector) + "]"


def _short(value: float) -> str:
    """Four decimals at most, without trailing zeros and minus zero."""
    text = f"{value:.4f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text


Value = str | bool | int | float
Sections = Mapping[str, Mapping[str, Value]]


def stated_sections(settings: ScanSettings) -> dict[str, dict[str, Value]]:
    """Section -> key -> value, as far as `scan settings.txt` says it."""
    sections: dict[str, dict[str, Value]] = {}
    for field, entry in ENTRIES.items():
        value = getattr(settings, field)
        if entry.xre is not None and value is not None:
            section, key = entry.xre
            sections.setdefault(section, {})[key] = value
    return sections


def sections_of(record: ScanRecord) -> dict[str, dict[str, Value]]:
    """All sections of a scan, in the scanner's order."""
    s = settings_of(record)
    template = resources.files("flexdt.twin") / "data" / "texts" / "xre.toml"
    sections: dict[str, dict[str, Value]] = tomllib.loads(template.read_text(encoding="utf-8"))
    motors = {name: line.value for name, line in s.motors.items()}
    rotation = next(iter(record.machine.geometry.get("angle", {"rot_obj": 1.0})))
    stated = stated_sections(s)
    del stated["Acquisition settings"]["Flat field axis"]  # `_flat_field` puts it in its place
    further: dict[str, dict[str, Value]] = {
        "Scantype": {"name": "smooth take and save" if record.smooth else "step take and save"},
        "Sample info": {"Project": record.sample.project, "Height (mm)": record.sample.height_mm},
        "Scan info": _scan(record),
        "Tube settings": _tube(record, s),
        "Camera settings": _camera(record),
        "Acquisition settings": _acquisition(record, s, rotation),
        "Data set settings": _data_set(record),
        "CT-parameters IN": _ct_parameters(record, s, stated["CT-parameters IN"]),
    }
    for name, entries in further.items():
        sections[name] |= stated.get(name, {}) | entries
    moved = {name: value for name, value in motors.items() if name != rotation}
    last = sections.pop("Acquisition settings, last part") | {
        "rotation speed": s.motors[rotation].speed or 0.0,
        "rotation acc": s.motors[rotation].acceleration or 0.0,
    }
    sections["Acquisition settings"] |= {
        **moved,
        # Both are written also where there are none.
        **{absent: motors.get(absent, 0.0) for absent in ("mag_tube", "tra_tube")},
        **_flat_field(record, s),
        **last,
    }
    return sections | {"motor positions": dict(motors), "POIs": dict(points_of_interest(record))}


def _scan(record: ScanRecord) -> dict[str, Value]:
    return {
        "Start": _utc(record.started),
        "Stop": _utc(record.stopped),
        "Duration": _duration(record.duration_s),
        "Succeeded": record.complete,
        "Error": "No error" if record.complete else record.reason or "not finished",
    }


def _tube(record: ScanRecord, s: ScanSettings) -> dict[str, Value]:
    current = s.target_current_uA or 0.0
    return {
        "Focus mode": s.focus_mode or "",
        "Output mode": s.output_mode or "",
        "Filament status": s.filament_status or "",
        **dict.fromkeys(("Current set value", "Current actual value"), current),
        **dict.fromkeys(("Target current set value", "Target current actual value"), current),
        "kV actual value": record.kV,
        "Target power actual value": record.power_W,
    }


def _camera(record: ScanRecord) -> dict[str, Value]:
    rows, cols = record.camera.shape
    return {
        "Nr. of averages": record.camera.averages,
        "Nr. of frames": record.count("projection"),
        "Binning value": float(record.camera.binning),
        "ROI": ";".join(map(str, record.camera.roi.edges)),
        "Columns": cols,
        "Rows": rows,
    }


def _acquisition(record: ScanRecord, s: ScanSettings, rotation: str) -> dict[str, Value]:
    n = record.count("projection")
    start, last = s.start_angle_deg or 0.0, s.last_angle_deg or 0.0
    turn = abs(last - start)
    return {
        "Rotation mode": "Smooth" if record.smooth else "Step",
        "CTaxis": rotation,
        "projs_per_360": round((n - 1) * 360.0 / turn) + 1 if n > 1 and turn > 0 else n,
        "CT start angle": start,
        "CT stop angle": last,
        "nr of sections": record.sections(),
        "tube kV": record.kV,
        "tube power": record.power_W,
        "Focus Mode": s.focus_mode or "",
        "Exposure time (ms)": record.camera.exposure_ms,
        "nr of averages": record.camera.averages,
        "Imaging mode": record.camera.mode,
        "ROI": ";".join(map(str, record.camera.roi.edges)),
    }


def _flat_field(record: ScanRecord, s: ScanSettings) -> dict[str, Value]:
    """Where the sample went for the flat field, if an axis took it there."""
    flat = s.motors.get(record.flat_axis)
    block = next((b for b in record.blocks if b.kind == "flat"), None)
    if flat is None or block is None:
        return {}
    sign = record.machine.axes[record.flat_axis].settings_sign
    return {
        "Flat field axis": record.flat_axis,
        "Flat Field position": sign * float(block.positions[record.flat_axis][0]),
        "Scan position": flat.value,
    }


def _data_set(record: ScanRecord) -> dict[str, Value]:
    rows, cols = record.camera.shape
    n = record.count("projection")
    return {
        "time": f"{record.stopped:%m/%d/%Y %I:%M:%S %p}",
        "number offset images": str(record.count("dark")),
        "number gain images": str(record.count("flat")),
        "number projections": str(n),
        "import ROI": f"0;0;{cols};{rows};",
        "import last projection": str(max(n - 1, 0)),
        "import projections": str(n),
    }


def _ct_parameters(
    record: ScanRecord, s: ScanSettings, stated: Mapping[str, Value]
) -> dict[str, Value]:
    rows, cols = record.camera.shape
    values = {
        **stated,
        "Pixel size": s.binned_pixel_mm,
        "Voxel size": (s.voxel_um or 0.0) / 1000.0,
        "zmax": rows - 1.0,
        "z_end": rows - 1.0,
        "x_end": cols - 1.0,
        "y_end": cols - 1.0,
    }
    return {key: f"{value:f}" for key, value in values.items()}


def _utc(moment: datetime) -> str:
    utc = moment if moment.tzinfo is None else moment.astimezone(UTC)
    return f"{utc:%Y-%m-%d %H:%M:%S}.{utc.microsecond:06d}0 UTC"


def _duration(seconds: float) -> str:
    whole = int(seconds)
    return f"{whole // 3600:02d}:{whole // 60 % 60:02d}:{whole % 60:02d}"


@dataclass(frozen=True)
class XreSettings:
    """The file's content: section -> key -> text without quotes."""

    sections: Mapping[str, Mapping[str, str]]

    def text(self, section: str, key: str) -> str | None:
        """A value's text, any case of section and key; None where it is absent or empty."""
        return next((v for k, v in self._entries(section) if k.lower() == key.lower() and v), None)

    def number(self, section: str, key: str) -> float | None:
        """A value as a number; None where it is absent.

        Raises:
            DatasetFormatError: it is there and is no number.
        """
        text = self.text(section, key)
        if text is None:
            return None
        try:
            return parse_number(text)
        except ValueError:
            raise _wrong(section, key, text, "a number") from None

    @property
    def settings(self) -> ScanSettings:
        """What `scan settings.txt` would say, as far as this file says it.

        Raises:
            DatasetFormatError: a figure is no number.
        """
        roi = self.text("Camera settings", "ROI")
        motors = {
            name: MotorLine(value)
            for name, _ in self._entries("motor positions")
            if (value := self.number("motor positions", name)) is not None
        }
        succeeded = self.text("Scan info", "Succeeded")
        values: dict[str, Any] = {}
        for field, entry in ENTRIES.items():
            if entry.xre is not None and entry.kind == "text":
                values[field] = self.text(*entry.xre)
            elif entry.xre is not None:
                number = self.number(*entry.xre)
                whole = entry.kind == "count"
                values[field] = round(number) if whole and number is not None else number
        smooth = (self.text("Acquisition settings", "Rotation mode") or "").lower() == "smooth"
        try:
            values["roi"] = None if roi is None else parse_roi(roi)
        except ValueError:
            raise _wrong("Camera settings", "ROI", str(roi), "four whole numbers") from None
        return ScanSettings(
            **values,
            motors=motors,
            cancelled=succeeded is not None and succeeded.upper() == "FALSE",
            scan_type="smooth scan" if smooth else None,
        )

    @property
    def one_circle(self) -> bool:
        """Whether one pose and one angle rule describe the whole scan (True if it does not say)."""
        sections = self.number("Acquisition settings", "nr of sections")
        return sections is None or sections <= 1.0

    def _entries(self, section: str) -> list[tuple[str, str]]:
        return [
            entry
            for name, entries in self.sections.items()
            if name.lower() == section.lower()
            for entry in entries.items()
        ]


def _wrong(section: str, key: str, text: str, allowed: str) -> DatasetFormatError:
    said = f"{XRE_SETTINGS}: [{section}] {key} is {text[:80]!r}"
    where = {"path": XRE_SETTINGS, "section": section, "key": key}
    return DatasetFormatError.instead(said, text[:200], allowed, **where)


def format_xre(record: ScanRecord) -> str:
    """The text of `data settings XRE.txt` (CRLF) for a scan."""
    return format_sections(sections_of(record))


def format_settings(settings: ScanSettings) -> str:
    """The text of `data settings XRE.txt` as far as `XreSettings.settings` would read it."""
    return format_sections(stated_sections(settings))


def format_sections(sections: Sections) -> str:
    """Sections as text: quoted texts, TRUE and FALSE, `%d` and `%f` numbers."""
    blocks = [
        EOL.join([f"[{clean(name)}]", *(f"{k} = {_written(v)}" for k, v in entries.items())])
        for name, entries in sections.items()
    ]
    return (EOL + EOL).join(blocks) + EOL


def parse_xre(text: str, file: str = XRE_SETTINGS) -> XreSettings:
    """Read `data settings XRE.txt`; of a key given twice in a section the first counts.

    Raises:
        DatasetFormatError: there is no `[section]` in it.
    """
    sections: dict[str, dict[str, str]] = {}
    current: dict[str, str] | None = None
    for raw in text.splitlines():
        line = raw.strip()
        header = re.fullmatch(r"\[([^\]]+)\]", line)
        if header is not None:
            current = sections.setdefault(header[1].strip(), {})
            continue
        found = re.fullmatch(r"([^=:]+?)\s*[=:]\s*(.*)", line)
        if current is not None and found is not None:
            current.setdefault(found[1], _unquoted(found[2]))
    if not sections:
        raise DatasetFormatError(f"{file} holds no [section]", {"path": file})
    return XreSettings(sections)


def _written(value: Value) -> str:
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


def _unquoted(text: str) -> str:
    value = text.strip()
    if len(value) >= 2 and value[0] == '"' and value[-1] == '"':
        return re.sub(r'\\([\\"])', r"\1", value[1:-1])
    return value.rstrip(";").strip()
