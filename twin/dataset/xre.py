"""`data settings XRE.txt`: sections of `key = value`, written and read as the scanner does.

Texts and figures of other programs stand in quotes, switches are TRUE and FALSE. What belongs to
the maker's reconstruction and has no meaning here is written as zero, so that its readers find
every key. Reading gives sections of plain texts; `XreSettings.settings` finds in them what
`scan settings.txt` would have said. It refuses to guess what an unknown key means.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Final

from flexdt.twin.dataset.errors import DatasetFormatError
from flexdt.twin.dataset.names import XRE_SETTINGS
from flexdt.twin.dataset.record import ScanRecord
from flexdt.twin.dataset.settings import MotorLine, ScanSettings, settings_of
from flexdt.twin.dataset.settings_text import EOL, MAX_CHARS, clean, parse_number, parse_roi
from flexdt.twin.dataset.xre_pois import points_of_interest

Value = str | bool | int | float
Sections = Mapping[str, Mapping[str, Value]]

_ZERO: Final = "0.000000"
_RECONSTRUCTION: Final = (
    "Interpolate", "Resolution", "Voxel size", "z_start", "z_end", "Min grey value",
    "Max grey value", "Recon mode", "ZP factor", "Filter type", "Filter level", "Min CT value",
    "Max CT value", "Spot filter", "HC", "bhc2", "Ring level", "Ring kernel", "Ring blocks",
    "Prompt scaling", "Spot kernel", "Phase mu", "Phase delta", "Edge correction factor",
    "Square recon", "Scatter", "Clipping value", "EFOV filter", "Original number of columns",
    "EFOV axis", "FilterEdgeWidth",
)  # fmt: skip


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


def sections_of(record: ScanRecord) -> dict[str, dict[str, Value]]:
    """All sections of a scan, in the scanner's order."""
    s = settings_of(record)
    return {
        "Scantype": {"name": _scan_name(record), "data format": ""},
        "Sample info": {
            "Sample name": record.sample.name,
            "Project": record.sample.project,
            "Application area": "",
            "Owner": record.sample.owner,
            "Comment": record.sample.comment,
            "Contact person": "",
            "Diameter (mm)": record.sample.diameter_mm,
            "Height (mm)": record.sample.height_mm,
        },
        "Scan info": {
            "Scan name": "",
            "scanID": record.name,
            "Operator": record.operator,
            "Acquila version": s.software or "",
            "scanner type": record.machine.scanner_type,
            "scanner S/N": record.machine.serial,
            "BatchID": "",
            "Start": _utc(record.started),
            "Stop": _utc(record.stopped),
            "Duration": _duration(record.duration_s),
            "Succeeded": record.complete,
            "Error": "No error" if record.complete else record.reason or "not finished",
            "Scanner name": record.machine.scanner_name,
        },
        "Tube settings": {
            "Tube name": record.machine.tube.name,
            "Focus mode": s.focus_mode or "",
            "Output mode": s.output_mode or "",
            "Current set value": s.target_current_uA or 0.0,
            "Current actual value": s.target_current_uA or 0.0,
            "kV set value": record.kV,
            "kV actual value": record.kV,
            "Target current set value": s.target_current_uA or 0.0,
            "Target current actual value": s.target_current_uA or 0.0,
            "Target power set value": record.power_W,
            "Target power actual value": record.power_W,
            "Vacuum level": "",
            "Filament status": s.filament_status or "",
            "Interlock": "CLOSED",
            "Defocussed": False,
            "Xray stable": True,
            "SerialNumber": "",
        },
        "Camera settings": _camera(record, s),
        "Acquisition settings": _acquisition(record, s),
        "Data set settings": _data_set(record),
        "CT-parameters IN": _ct_parameters(record, s),
        "motor positions": {name: line.value for name, line in s.motors.items()},
        "POIs": dict(points_of_interest(record)),
    }


def _scan_name(record: ScanRecord) -> str:
    return "smooth take and save" if record.smooth else "step take and save"


def _camera(record: ScanRecord, s: ScanSettings) -> dict[str, Value]:
    rows, cols = record.camera.shape
    return {
        "Camera name": record.machine.detector.model,
        "Imaging mode": record.camera.mode,
        "Exposure time (ms)": record.camera.exposure_ms,
        "Nr. of averages": record.camera.averages,
        "Nr. of frames": record.count("projection"),
        "Unbinned pixelsize (mm)": record.machine.detector.pitch_mm,
        "Binning value": float(record.camera.binning),
        "Binned pixelsize (mm)": s.binned_pixel_mm or 0.0,
        "ROI": _roi(record),
        "Columns": cols,
        "Rows": rows,
        "SerialNumber": "",
    }


def _acquisition(record: ScanRecord, s: ScanSettings) -> dict[str, Value]:
    n = record.count("projection")
    start, last = s.start_angle_deg or 0.0, s.last_angle_deg or 0.0
    turn = abs(last - start)
    rotation = next(iter(record.machine.geometry.get("angle", {"rot_obj": 1.0})))
    flat = s.motors.get(record.flat_axis)
    flat_block = next((b for b in record.blocks if b.kind == "flat"), None)
    out: dict[str, Value] = {
        "script settings set": True,
        "Vertical mode": "Cone beam",
        "Rotation mode": "Smooth" if record.smooth else "Step",
        "CTaxis": rotation,
        "Path": "",
        "File base name": "scan_",
        "projs_per_360": round((n - 1) * 360.0 / turn) + 1 if n > 1 and turn > 0 else n,
        "CT start angle": start,
        "CT stop angle": last,
        "total projections": n,
        "nr of sections": record.sections(),
        "DI_FF_frequency": 1,
        "nr DI before": s.darks or 0,
        "nr DI after": 0,
        "nr FF before": s.pre_flats or 0,
        "nr FF after": s.post_flats or 0,
        "nr pre refs": 0,
        "nr post refs": 0,
        "nr averages refs": 1,
        "time lapse pause (s)": 0.0,
        "pause before scan (s)": 0.0,
        "pause before DI (s)": 0.0,
        "pause before IO (s)": 0.0,
        "set kV": False,
        "tube kV": record.kV,
        "set power": False,
        "tube power": record.power_W,
        "set focus mode": False,
        "Focus Mode": s.focus_mode or "",
        "Keep X-ray on": True,
        "Conditioning frequency": "Once",
        "Refresh tube": False,
        "Exposure time (ms)": record.camera.exposure_ms,
        "readout time (ms)": 0.0,
        "nr of averages": record.camera.averages,
        "Imaging mode": record.camera.mode,
        "ROI": _roi(record),
        "Set sample position": False,
    }
    out |= {name: line.value for name, line in s.motors.items() if name != rotation}
    if flat is not None and flat_block is not None:
        sign = record.machine.axes[record.flat_axis].settings_sign
        away = sign * float(flat_block.positions[record.flat_axis][0])
        out |= {
            "Flat field axis": record.flat_axis,
            "Flat Field position": away,
            "Scan position": flat.value,
        }
    motor = s.motors[rotation]
    return out | {
        "Top at VC": 0.0,
        "Bottom at VC": 0.0,
        "rotation speed": motor.speed or 0.0,
        "rotation acc": motor.acceleration or 0.0,
        "vertical speed": 0.0,
        "vertical acc": 0.0,
        "Goto ref after scan": False,
        "Log tubestatus": False,
    }


def _data_set(record: ScanRecord) -> dict[str, Value]:
    rows, cols = record.camera.shape
    n = record.count("projection")
    return {
        "time": f"{record.stopped:%m/%d/%Y %I:%M:%S %p}",
        "number offset images": str(record.count("dark")),
        "number gain images": str(record.count("flat")),
        "number projections": str(n),
        "data path": "",
        "basename": "scan_",
        "import ROI": f"0;0;{cols};{rows};",
        "import binning": "1.000000",
        "import binning method": "none",
        "import use slope/offset": "False",
        "import first projection": "0",
        "import last projection": str(max(n - 1, 0)),
        "import projections": str(n),
        "import decimate value": "1",
        "X-position": "",
        "X-direction": "",
        "Y-position": "",
        "Y-direction": "",
        "Z-position": "",
        "Z-direction": "",
        "projection pixel size": "",
        "recon path": "",
        "BitsPerSample": "16",
        "Slope": "1.000000",
        "Offset": _ZERO,
    }


def _ct_parameters(record: ScanRecord, s: ScanSettings) -> dict[str, Value]:
    rows, cols = record.camera.shape
    known: dict[str, float | None] = {
        "Start angle": s.start_angle_deg,
        "Last angle": s.last_angle_deg,
        "SOD": s.sod_mm,
        "SDD": s.sdd_mm,
        "COR": s.cor_px,
        "VC": s.vc_px,
        "Direction": 0.0,
        "Pixel size": s.binned_pixel_mm,
        "bhc": 0.0,
        "Tilt": 0.0,
        "zmin": 0.0,
        "zmax": rows - 1.0,
        "x_start": 0.0,
        "x_end": cols - 1.0,
        "y_start": 0.0,
        "y_end": cols - 1.0,
    }
    known |= dict.fromkeys(_RECONSTRUCTION, 0.0)
    known |= {"Voxel size": (s.voxel_um or 0.0) / 1000.0, "HC": s.hc_px, "z_end": rows - 1.0}
    return {key: f"{0.0 if value is None else value:f}" for key, value in known.items()}


def _roi(record: ScanRecord) -> str:
    roi = record.camera.roi
    return f"{roi.left};{roi.top};{roi.right};{roi.bottom}"


def _utc(moment: datetime) -> str:
    utc = moment if moment.tzinfo is None else moment.astimezone(UTC)
    return f"{utc:%Y-%m-%d %H:%M:%S}.{utc.microsecond:06d}0 UTC"


def _duration(seconds: float) -> str:
    whole = int(seconds)
    return f"{whole // 3600:02d}:{whole // 60 % 60:02d}:{whole % 60:02d}"
