"""`scan settings.txt` as text: written as the scanner writes it, read as scanners have written
it.

The fields of `ScanSettings` drive both directions, their order, keys and number formats are
those of the real files. Reading is tolerant where real files vary (`:` or `=`, `value;`,
decimal commas, missing lines, any case) and strict where a wrong number would do harm: a figure
that is not a finite number is an error with its line.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from datetime import datetime
from typing import Any, Final

from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.dataset.file_names import SCAN_SETTINGS
from flexdt.twin.dataset.flexdt_json import ScanRecord
from flexdt.twin.dataset.format_table import Ledger
from flexdt.twin.dataset.scan_settings import (
    ENTRIES,
    Kind,
    MotorLine,
    ScanSettings,
    settings_of,
)
from flexdt.twin.machine.camera import Roi

EOL: Final = "\r\n"
CANCELLED: Final = "SCRIPT CANCELLED!"
MOST_SHOWN: Final = 60
"""Characters of a line without a key that stand for one."""

_CONTROL: Final = re.compile(r"[\x00-\x1f\x7f\x85\u2028\u2029]+")
_START: Final = "START"
_STOP: Final = "STOP"
_SERIAL: Final = "Scanner S/N"
_BEFORE: Final[Mapping[str, tuple[str, ...]]] = {
    **dict.fromkeys(
        ("stopped", "duration_minutes", "operator", "camera", "motors", "cancelled"),
        ("",),
    ),
    "tube": ("", ""),
    "scan_type": ("Script summary:", ""),
}
"""Field -> lines written before its own, even if that is absent."""
_BY_KEY: Final = {
    entry.key.lower(): field for field, entry in ENTRIES.items() if entry.key
}
_MOTOR_WORD: Final = re.compile(r"[A-Za-z][A-Za-z0-9_ ]*")
_EVERY: Final = re.compile(r"reference images every\s+(\d+)\s+projections", re.IGNORECASE)
_DATE: Final = re.compile(
    r"date\s*[:=]\s*(?P<date>[^;]*);\s*time\s*[:=]\s*(?P<time>.*)", re.I
)
_DATE_FORMATS: Final = (
    "%m/%d/%Y %I:%M:%S %p",
    "%m/%d/%Y %H:%M:%S",
    "%d-%m-%Y %H:%M:%S",
    "%Y-%m-%d %H:%M:%S",
)


def clean(text: str) -> str:
    """Reduce text to one line: control characters become blanks, ends are stripped."""
    return _CONTROL.sub(" ", text).strip()


def parse_number(text: str) -> float:
    """Read a finite number as scanners write: `1.5`, `1,5`, `1.5;`, `1.5 mm`, `874.6E-9`.

    One comma without a point is the decimal sign; all after a space is dropped. Raises
    ValueError.
    """
    word = text.strip().rstrip(";").strip().split(" ")[0]
    if word.count(",") == 1 and "." not in word:
        word = word.replace(",", ".")
    value = float(word)
    if not math.isfinite(value) or "_" in word:
        raise ValueError(text)
    return value


def _whole(text: str) -> int:
    """Parse a whole number, which may be written with decimals; raise ValueError
    otherwise.
    """
    value = parse_number(text)
    if value != int(value):
        raise ValueError(text)
    return int(value)


def parse_roi(text: str) -> Roi:
    """Read four whole numbers, left, top, right, bottom, with any separators.

    Decimals that are zero are allowed; order and sensor are not checked. Raises
    ValueError: not exactly four.
    """
    words = re.findall(r"-?\d+(?:\.0*)?", text)
    if len(words) != 4:
        raise ValueError(text)
    left, top, right, bottom = (int(float(w)) for w in words)
    return Roi(left, top, right, bottom)


_KINDS: Final[Mapping[Kind, tuple[Callable[[Any], str], Callable[[str], object]]]] = {
    "text": (clean, lambda t: t.strip().rstrip(";").strip()),
    "number": (lambda v: f"{v:f}", parse_number),
    "count": (lambda v: f"{v:d}", _whole),
    "mm": (lambda v: f"{v:f} mm", parse_number),
    "minutes": (lambda v: f"{v:.0f} minutes", parse_number),
    "whole minutes": (lambda v: f"{v:d} minutes", _whole),
    "roi": (lambda v: f"{v.left},{v.top},{v.right},{v.bottom}", parse_roi),
}
"""Form -> functions that write and read a value; reading may raise ValueError."""


def format_scan_settings(scan: ScanRecord | ScanSettings) -> str:
    """Format `scan settings.txt` (CRLF) for a scan.

    Lines are in the order of the fields, with the scanner's headings, which are there
    even where their field is not. The serial number is on the scanner type's line.

    Args:
        scan: a record, or the settings themselves; fields that are None have no line.

    Returns:
        The text, with a CRLF at its end.
    """
    if isinstance(scan, ScanRecord):
        s = settings_of(scan)
    else:
        s = scan
    out: list[str] = []
    for name in (f.name for f in fields(ScanSettings)):
        out += _BEFORE.get(name, ())
        value = getattr(s, name)
        if value is None:
            continue
        entry = ENTRIES.get(name)
        match name:
            case "started":
                out += [_START, _date(value)]
            case "stopped":
                out += [_STOP, _date(value)]
            case "serial":  # The scanner itself runs this and the type together.
                head = "Scanner type : "
                if s.scanner_type is not None:
                    head = out.pop()
                out.append(f"{head}{_SERIAL} : {clean(value)}")
            case "motors":
                out += [_motor(axis, line) for axis, line in value.items()]
            case "cancelled":
                out += [CANCELLED] if value else []
            case "scan_type":
                out += ["scan type:", clean(value)]
            case "reference_every":
                out.append(f"Reference images every {value:d} projections")
            case _ if entry is not None:
                out.append(f"{entry.key}{entry.separator}{_KINDS[entry.kind][0](value)}")
    return EOL.join(out) + EOL


def _date(moment: datetime) -> str:
    """Format a moment as the scanner does: "date: month/day/year; time: h:mm:ss AM" (12
    hours, AM or PM), without a zone.
    """
    hour = 12
    if moment.hour % 12:
        hour = moment.hour % 12
    half = "AM" if moment.hour < 12 else "PM"
    return (
        f"date: {moment.month}/{moment.day}/{moment.year:04d}; "
        f"time: {hour}:{moment.minute:02d}:{moment.second:02d} {half}"
    )


def _motor(name: str, motor: MotorLine) -> str:
    """Format a motor's line: position and, each if not None, speed and acceleration, with
    six decimals.
    """
    numbers = {
        name: motor.value,
        "speed": motor.speed,
        "acceleration": motor.acceleration,
    }
    return " ; ".join(
        f"{key} : {value:f}" for key, value in numbers.items() if value is not None
    )


def parse_scan_settings(
    text: str, file: str = SCAN_SETTINGS, said: Ledger | None = None
) -> ScanSettings:
    """Read `scan settings.txt`.

    Fields that are not there are None. Of a field given twice the first value counts.

    Args:
        text: its content.
        file: name for error messages.
        said: where every line is entered, unknown ones too; None: nowhere.

    Raises:
        DatasetFormatError: a figure is not a number, or it is no settings file at all; names
            file, line and value.
    """
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
    if said is not None:
        _enter(said, lines)
    return ScanSettings(**values, motors=motors)


def _enter(said: Ledger, lines: Sequence[str]) -> None:
    """Enter the lines of a text in a ledger; a date or a scan type in a line of its own
    belongs to the heading before it.
    """
    heading = ""
    for line in filter(None, lines):
        key, value = _split(line)
        if heading:
            said.state(heading, line)
            heading = ""
        elif line.upper() in (_START, _STOP):
            heading = line.upper()
        elif key == "scan type" and not value:
            heading = "scan type"
        elif every := _EVERY.match(line):
            said.state("Reference images every", every[1])
        elif line.upper().startswith("SCRIPT CANCELLED"):
            said.state(CANCELLED, line)
        elif key is None:
            said.state(line[:MOST_SHOWN], "")
        else:
            said.state(line[: len(key)].strip(), value)


def _read_line(
    line: str, rest: list[str], values: dict[str, Any], motors: dict[str, MotorLine]
) -> None:
    """Read one line into `values` or `motors`; lines without anything known are skipped.

    START and STOP take the next line that is not empty as their date; one that cannot be
    read is skipped. A scan type may be on the next such line, unless that has a known
    key. "script cancelled" sets that field.

    Args:
        line: without its end.
        rest: the lines after it, where a date or a scan type may follow.
        values: field of `ScanSettings` -> value; the first one given is kept.
        motors: axis -> its line; likewise.

    Raises:
        ValueError: a figure is not a number.
    """
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
        if value:
            scan_type = value
        else:
            scan_type = next((other for other in rest if other), "")
        if _split(scan_type)[0] not in _BY_KEY:
            values.setdefault("scan_type", scan_type)
    elif key is not None and key in _BY_KEY:
        _read_field(_BY_KEY[key], value, values)
    elif key is not None and _is_motor(key, value):
        motors.setdefault(line[: len(key)].strip(), _read_motor(value))


def _split(line: str) -> tuple[str | None, str]:
    """Split at the first `:` or `=` into (lower-cased key, value); (None, line) without
    one.
    """
    at = min((i for i in (line.find(":"), line.find("=")) if i >= 0), default=-1)
    if at < 0:
        return None, line
    return line[:at].strip().lower(), line[at + 1 :].strip()


def _read_field(field: str, value: str, values: dict[str, Any]) -> None:
    """Read a value into `values[field]`, unless it is there; a serial number behind the scanner
    type goes to `serial`.

    An empty value is skipped unless the field is a text.
    Raises ValueError: the value is not of the field's form.
    """
    if field == "scanner_type" and _SERIAL in value:
        value, serial = value.split(_SERIAL, 1)
        values.setdefault("serial", serial.strip().lstrip(":=").strip())
    kind = ENTRIES[field].kind
    if kind == "text" or value.rstrip("; ") != "":
        values.setdefault(field, _KINDS[kind][1](value))


def _is_motor(key: str, value: str) -> bool:
    """Return whether a line describes a motor.

    Its key must be of letters, digits, `_` and blanks (`_MOTOR_WORD`). Its value must
    have a speed, or, for a key with an underscore, be a bare number.
    """
    if _MOTOR_WORD.fullmatch(key) is None:
        return False
    if re.search(r";\s*speed\s*[:=]", value, re.IGNORECASE):
        return True
    return (
        "_" in key and re.fullmatch(r"[-+]?[\d.,]+(?:[eE][-+]?\d+)?;?", value) is not None
    )


def _read_motor(value: str) -> MotorLine:
    """Parse a motor's line: position and, where given, speed and acceleration (else
    None); ValueError for no number.
    """
    first, *others = value.split(";")
    named = dict(_split(part.strip()) for part in others)
    return MotorLine(
        parse_number(first),
        parse_number(named["speed"]) if "speed" in named else None,
        parse_number(named["acceleration"]) if "acceleration" in named else None,
    )


def _moment(line: str) -> datetime | None:
    """Parse a line "date: ...; time: ..." by the first of `_DATE_FORMATS` that fits,
    without a zone; None if none does.
    """
    match = _DATE.match(line)
    if match is None:
        return None
    text = f"{match['date'].strip()} {match['time'].strip()}"
    for form in _DATE_FORMATS:
        try:
            return datetime.strptime(text, form)
        except ValueError:
            continue
    return None
