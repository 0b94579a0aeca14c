"""`scan settings.txt`, written as the scanner writes it and read as scanners have written it.

One table drives both directions: the order, keys and number formats of the real files. Reading is
tolerant where real files vary (`:` or `=`, `value;`, decimal commas, missing lines, any case) and
strict where a wrong number would do harm: a figure that is not a finite number is an error with its
line.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Final

from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.dataset.file_names import SCAN_SETTINGS
from flexdt.twin.dataset.record import ScanRecord
from flexdt.twin.dataset.scan_settings import MotorLine, ScanSettings, settings_of
from flexdt.twin.machine.camera import Roi

EOL: Final = "\r\n"
CANCELLED: Final = "SCRIPT CANCELLED!"
SUMMARY: Final = "Script summary:"
MAX_CHARS: Final = 16 << 20

_CONTROL: Final = re.compile(r"[\x00-\x1f\x7f\x85\u2028\u2029]+")


def clean(text: str) -> str:
    """One line of text: control characters and line breaks become blanks, ends are stripped."""
    return _CONTROL.sub(" ", text).strip()


@dataclass(frozen=True)
class _Kind:
    """How a value is written and read; reading may raise ValueError."""

    write: Callable[[Any], str]
    read: Callable[[str], object]


def parse_number(text: str) -> float:
    """A finite number as scanners print it: `1.5`, `1,5`, `1.5;`, `1.5 mm`, `874.6E-9`.

    Raises:
        ValueError: it is none.
    """
    word = text.strip().rstrip(";").strip().split(" ")[0]
    if word.count(",") == 1 and "." not in word:
        word = word.replace(",", ".")
    value = float(word)
    if not math.isfinite(value) or "_" in word:
        raise ValueError(text)
    return value


def _whole(text: str) -> int:
    value = parse_number(text)
    if value != int(value):
        raise ValueError(text)
    return int(value)


def parse_roi(text: str) -> Roi:
    """Four whole numbers, left, top, right, bottom, separated by anything.

    Raises:
        ValueError: there are not four.
    """
    words = re.findall(r"-?\d+(?:\.0*)?", text)
    if len(words) != 4:
        raise ValueError(text)
    left, top, right, bottom = (int(float(w)) for w in words)
    return Roi(left, top, right, bottom)


_TEXT = _Kind(clean, lambda t: t.strip().rstrip(";").strip())
_NUMBER = _Kind(lambda v: f"{v:f}", parse_number)
_COUNT = _Kind(lambda v: f"{v:d}", _whole)
_MM = _Kind(lambda v: f"{v:f} mm", parse_number)
_MINUTES = _Kind(lambda v: f"{v:.0f} minutes", parse_number)
_WHOLE_MINUTES = _Kind(lambda v: f"{v:d} minutes", _whole)
_ROI = _Kind(lambda v: f"{v.left},{v.top},{v.right},{v.bottom}", parse_roi)


@dataclass(frozen=True)
class _Line:
    """`key`, separator, value of ScanSettings.`field`."""

    key: str
    field: str
    kind: _Kind
    separator: str = " : "


_BLANK: Final = ""
_START: Final = "START"
_STOP: Final = "STOP"
_MOTORS: Final = "<motors>"
_TYPE: Final = "<scan type>"
_CANCEL: Final = "<cancelled>"
_SERIAL: Final = "Scanner S/N"

_LAYOUT: Final[tuple[_Line | str, ...]] = (
    _Line("ScanID", "scan_id", _TEXT),
    _Line("BatchID", "batch_id", _TEXT),
    _Line("Project", "project", _TEXT),
    _START,
    _BLANK,
    _STOP,
    _BLANK,
    _Line("SCAN DURATION", "duration_minutes", _MINUTES),
    _Line("COR", "cor_px", _NUMBER),
    _Line("VC", "vc_px", _NUMBER),
    _Line("HC", "hc_px", _NUMBER),
    _Line("SDD", "sdd_mm", _NUMBER),
    _Line("SOD", "sod_mm", _NUMBER),
    _Line("Voxel size", "voxel_um", _NUMBER),
    _Line("Magnification", "magnification", _NUMBER),
    _BLANK,
    _Line("Operator", "operator", _TEXT),
    _Line("Sample name", "sample_name", _TEXT),
    _Line("Sample owner", "sample_owner", _TEXT),
    _Line("Application area", "application_area", _TEXT),
    _Line("Sample size", "sample_size_mm", _MM),
    _Line("Comment", "comment", _TEXT),
    _Line("Scanner name", "scanner_name", _TEXT),
    _Line("Scanner type", "scanner_type", _TEXT),
    _Line("Acquila version", "software", _TEXT),
    _BLANK,
    _BLANK,
    _Line("X-ray tube", "tube", _TEXT),
    _Line("Tube voltage", "kV", _NUMBER),
    _Line("Tube power", "power_W", _NUMBER),
    _Line("Vacuum level", "vacuum", _TEXT),
    _Line("Filter", "filter", _TEXT),
    _Line("Focus mode", "focus_mode", _TEXT),
    _Line("Target current", "target_current_uA", _NUMBER),
    _Line("Filament status", "filament_status", _TEXT),
    _Line("Filament mode", "filament_mode", _TEXT),
    _Line("Output mode", "output_mode", _TEXT),
    _BLANK,
    _Line("Camera", "camera", _TEXT),
    _Line("Exposure time (ms)", "exposure_ms", _NUMBER),
    _Line("Number of averages", "averages", _NUMBER),
    _Line("Original pixel size", "original_pixel_mm", _NUMBER),
    _Line("Imaging mode", "mode", _TEXT),
    _Line("Binning value", "binning", _COUNT),
    _Line("Binned pixel size", "binned_pixel_mm", _NUMBER),
    _Line("ROI (LTRB)", "roi", _ROI),
    _BLANK,
    _MOTORS,
    _BLANK,
    _CANCEL,
    SUMMARY,
    _BLANK,
    _TYPE,
    _Line("# projections", "projections", _COUNT, ": "),
    _Line("Start angle", "start_angle_deg", _NUMBER),
    _Line("Last angle", "last_angle_deg", _NUMBER),
    _Line("# pre flat fields", "pre_flats", _COUNT, ": "),
    _Line("# post flat fields", "post_flats", _COUNT, ": "),
    _Line("# offset images", "darks", _COUNT, ": "),
    _Line("Preheating time", "preheating_minutes", _WHOLE_MINUTES, ": "),
    _Line("Axis for flat field movement", "flat_axis", _TEXT),
)
_BY_KEY: Final[Mapping[str, _Line]] = {
    line.key.lower(): line for line in _LAYOUT if isinstance(line, _Line)
}
_MOTOR_WORD: Final = re.compile(r"[A-Za-z][A-Za-z0-9_ ]*")
_EVERY: Final = re.compile(r"reference images every\s+(\d+)\s+projections", re.IGNORECASE)
_DATE: Final = re.compile(r"date\s*[:=]\s*(?P<date>[^;]*);\s*time\s*[:=]\s*(?P<time>.*)", re.I)
_DATE_FORMATS: Final = (
    "%m/%d/%Y %I:%M:%S %p", "%m/%d/%Y %H:%M:%S", "%d-%m-%Y %H:%M:%S", "%Y-%m-%d %H:%M:%S",
)  # fmt: skip


def format_scan_settings(scan: ScanRecord | ScanSettings) -> str:
    """The text of `scan settings.txt` (CRLF) for a scan; absent fields leave their line out."""
    s = settings_of(scan) if isinstance(scan, ScanRecord) else scan
    out: list[str] = []
    for line in _LAYOUT:
        match line:
            case _Line():
                out += _written(line, s)
            case "START":
                out += [] if s.started is None else [_START, _date(s.started)]
            case "STOP":
                out += [] if s.stopped is None else [_STOP, _date(s.stopped)]
            case "<motors>":
                out += [_motor(name, motor) for name, motor in s.motors.items()]
            case "<cancelled>":
                out += [CANCELLED] if s.cancelled else []
            case "<scan type>":
                out += [] if s.scan_type is None else ["scan type:", clean(s.scan_type)]
            case _:
                out.append(line)
    return EOL.join(out) + EOL


def _written(line: _Line, s: ScanSettings) -> list[str]:
    value = getattr(s, line.field)
    out = [] if value is None else [f"{line.key}{line.separator}{line.kind.write(value)}"]
    if line.field == "scanner_type" and s.serial is not None:
        # The scanner itself runs these two together.
        out = [f"{out[0] if out else 'Scanner type : '}{_SERIAL} : {clean(s.serial)}"]
    if line.field == "darks" and s.reference_every is not None:
        out.append(f"Reference images every {s.reference_every:d} projections")
    return out


def _date(moment: datetime) -> str:
    hour = moment.hour % 12 if moment.hour % 12 else 12
    half = "AM" if moment.hour < 12 else "PM"
    return (
        f"date: {moment.month}/{moment.day}/{moment.year:04d}; "
        f"time: {hour}:{moment.minute:02d}:{moment.second:02d} {half}"
    )


def _motor(name: str, motor: MotorLine) -> str:
    parts = [f"{name} : {motor.value:f}"]
    if motor.speed is not None:
        parts.append(f"speed : {motor.speed:f}")
    if motor.acceleration is not None:
        parts.append(f"acceleration : {motor.acceleration:f}")
    return " ; ".join(parts)


def parse_scan_settings(text: str, file: str = SCAN_SETTINGS) -> ScanSettings:
    """Read `scan settings.txt`.

    Args:
        text: its content.
        file: name for error messages.

    Raises:
        DatasetFormatError: a figure is not a number, or it is no settings file at all; names
            file, line and value.
    """
    if len(text) > MAX_CHARS:
        raise DatasetFormatError(
            f"{file}: {len(text)} characters is no settings file; allowed: {MAX_CHARS}",
            {"path": file, "asked": len(text), "allowed": MAX_CHARS},
        )
    values: dict[str, Any] = {}
    motors: dict[str, MotorLine] = {}
    lines = [line.strip() for line in text.splitlines()]
    for number, line in enumerate(lines, start=1):
        try:
            _read_line(line, lines[number:], values, motors)
        except ValueError as error:
            raise DatasetFormatError(
                f"{file}, line {number}: cannot read {line[:120]!r}: {error}",
                {"path": file, "line": number, "asked": line[:200]},
            ) from None
    if not values and not motors:
        raise DatasetFormatError(
            f"{file} holds no line of a settings file (`key : value`)", {"path": file}
        )
    return ScanSettings(**values, motors=motors)


def _read_line(
    line: str, rest: list[str], values: dict[str, Any], motors: dict[str, MotorLine]
) -> None:
    upper = line.upper()
    if upper in (_START, _STOP):
        following = next((other for other in rest if other), "")
        moment = _moment(following)
        if moment is not None:
            values.setdefault("started" if upper == _START else "stopped", moment)
        return
    if upper.startswith("SCRIPT CANCELLED"):
        values["cancelled"] = True
        return
    every = _EVERY.match(line)
    if every is not None:
        values.setdefault("reference_every", int(every[1]))
        return
    key, value = _split(line)
    if key == "scan type":
        found = value if value else next((other for other in rest if other), "")
        if _split(found)[0] not in _BY_KEY:
            values.setdefault("scan_type", found)
    elif key is not None and key in _BY_KEY:
        _read_field(_BY_KEY[key], value, values)
    elif key is not None and _is_motor(key, value):
        motors.setdefault(line[: len(key)].strip(), _read_motor(value))


def _split(line: str) -> tuple[str | None, str]:
    """(lower-cased key, value) at the first `:` or `=`; (None, line) without one."""
    at = min((i for i in (line.find(":"), line.find("=")) if i >= 0), default=-1)
    if at < 0:
        return None, line
    return line[:at].strip().lower(), line[at + 1 :].strip()


def _read_field(line: _Line, value: str, values: dict[str, Any]) -> None:
    if line.field == "scanner_type" and _SERIAL in value:
        value, serial = value.split(_SERIAL, 1)
        values.setdefault("serial", serial.strip().lstrip(":=").strip())
    if line.kind is _TEXT or value.rstrip("; ") != "":
        values.setdefault(line.field, line.kind.read(value))


def _is_motor(key: str, value: str) -> bool:
    """A line with a speed is a motor; so is a bare number behind a name with an underscore."""
    if _MOTOR_WORD.fullmatch(key) is None:
        return False
    if re.search(r";\s*speed\s*[:=]", value, re.IGNORECASE):
        return True
    return "_" in key and re.fullmatch(r"[-+]?[\d.,]+(?:[eE][-+]?\d+)?;?", value) is not None


def _read_motor(value: str) -> MotorLine:
    first, *others = value.split(";")
    named = dict(_split(part.strip()) for part in others)
    return MotorLine(
        parse_number(first),
        parse_number(named["speed"]) if "speed" in named else None,
        parse_number(named["acceleration"]) if "acceleration" in named else None,
    )


def _moment(line: str) -> datetime | None:
    """A date line's moment; None if it has another form (dates never decide anything)."""
    found = _DATE.match(line)
    if found is None:
        return None
    text = f"{found['date'].strip()} {found['time'].strip()}"
    for form in _DATE_FORMATS:
        try:
            return datetime.strptime(text, form)
        except ValueError:
            continue
    return None
