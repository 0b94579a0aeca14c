"""`data settings XRE.txt`: sections of `key = value`, written and read as the scanner does.

Texts and figures of other programs stand in quotes, switches are TRUE and FALSE. Reading returns
sections of plain texts; `XreSettings.settings` extracts the values that `scan settings.txt` would
hold. Unknown keys are kept without interpretation.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.dataset.file_names import XRE_SETTINGS
from flexdt.twin.dataset.record import ScanRecord
from flexdt.twin.dataset.scan_settings import MotorLine, ScanSettings
from flexdt.twin.dataset.scan_settings_text import EOL, MAX_CHARS, clean, parse_number, parse_roi
from flexdt.twin.dataset.xre_sections import Sections, Value, sections_of


@dataclass(frozen=True)
class XreSettings:
    """The file's content: section -> key -> text without quotes."""

    sections: Mapping[str, Mapping[str, str]]

    def text(self, section: str, key: str) -> str | None:
        """A value's text, any case of section and key; None where it is absent or empty."""
        wanted = section.lower(), key.lower()
        for name, entries in self.sections.items():
            if name.lower() == wanted[0]:
                for other, value in entries.items():
                    if other.lower() == wanted[1] and value != "":
                        return value
        return None

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
            raise DatasetFormatError(
                f"{XRE_SETTINGS}: [{section}] {key} is {text[:80]!r}; allowed: a number",
                {"path": XRE_SETTINGS, "section": section, "key": key, "asked": text[:200]},
            ) from None

    @property
    def settings(self) -> ScanSettings:
        """What `scan settings.txt` would say, as far as this file says it.

        Raises:
            DatasetFormatError: a figure is no number.
        """
        roi = self.text("Camera settings", "ROI")
        motors = {
            name: MotorLine(value)
            for name in self._keys("motor positions")
            if (value := self.number("motor positions", name)) is not None
        }
        succeeded = self.text("Scan info", "Succeeded")
        values: dict[str, Any] = {field: self.text(section, key) for field, section, key in _TEXTS}
        values |= {field: self.number(section, key) for field, section, key in _NUMBERS}
        for field, section, key in _COUNTS:
            number = self.number(section, key)
            values[field] = None if number is None else round(number)
        smooth = (self.text("Acquisition settings", "Rotation mode") or "").lower() == "smooth"
        try:
            values["roi"] = None if roi is None else parse_roi(roi)
        except ValueError:
            raise DatasetFormatError(
                f"{XRE_SETTINGS}: [Camera settings] ROI is {roi!r}; allowed: four whole numbers",
                {"path": XRE_SETTINGS, "key": "ROI", "asked": roi},
            ) from None
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

    def _keys(self, section: str) -> list[str]:
        return [
            key
            for name, entries in self.sections.items()
            if name.lower() == section.lower()
            for key in entries
        ]


_TEXTS: Final = (
    ("scan_id", "Scan info", "scanID"),
    ("operator", "Scan info", "Operator"),
    ("sample_name", "Sample info", "Sample name"),
    ("sample_owner", "Sample info", "Owner"),
    ("comment", "Sample info", "Comment"),
    ("scanner_name", "Scan info", "Scanner name"),
    ("scanner_type", "Scan info", "scanner type"),
    ("serial", "Scan info", "scanner S/N"),
    ("software", "Scan info", "Acquila version"),
    ("tube", "Tube settings", "Tube name"),
    ("camera", "Camera settings", "Camera name"),
    ("mode", "Camera settings", "Imaging mode"),
    ("flat_axis", "Acquisition settings", "Flat field axis"),
)
_NUMBERS: Final = (
    ("sod_mm", "CT-parameters IN", "SOD"),
    ("sdd_mm", "CT-parameters IN", "SDD"),
    ("cor_px", "CT-parameters IN", "COR"),
    ("vc_px", "CT-parameters IN", "VC"),
    ("hc_px", "CT-parameters IN", "HC"),
    ("start_angle_deg", "CT-parameters IN", "Start angle"),
    ("last_angle_deg", "CT-parameters IN", "Last angle"),
    ("kV", "Tube settings", "kV set value"),
    ("power_W", "Tube settings", "Target power set value"),
    ("exposure_ms", "Camera settings", "Exposure time (ms)"),
    ("averages", "Camera settings", "Nr. of averages"),
    ("original_pixel_mm", "Camera settings", "Unbinned pixelsize (mm)"),
    ("binned_pixel_mm", "Camera settings", "Binned pixelsize (mm)"),
    ("sample_size_mm", "Sample info", "Diameter (mm)"),
)
_COUNTS: Final = (
    ("binning", "Camera settings", "Binning value"),
    ("projections", "Acquisition settings", "total projections"),
    ("darks", "Acquisition settings", "nr DI before"),
    ("pre_flats", "Acquisition settings", "nr FF before"),
    ("post_flats", "Acquisition settings", "nr FF after"),
)


def format_xre(record: ScanRecord) -> str:
    """The text of `data settings XRE.txt` (CRLF) for a scan."""
    return format_sections(sections_of(record))


def format_settings(settings: ScanSettings) -> str:
    """The text of `data settings XRE.txt` as far as `XreSettings.settings` would read it."""
    sections: dict[str, dict[str, Value]] = {}
    for field, section, key in (*_TEXTS, *_NUMBERS, *_COUNTS):
        value = getattr(settings, field)
        if value is not None:
            sections.setdefault(section, {})[key] = value
    return format_sections(sections)


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
    if len(text) > MAX_CHARS:
        raise DatasetFormatError(
            f"{file}: {len(text)} characters is no settings file; allowed: {MAX_CHARS}",
            {"path": file, "asked": len(text), "allowed": MAX_CHARS},
        )
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
