"""`scan settings.txt` as a frozen value: what the scanner prints about one scan, in its own terms.

Positions carry the sign of the settings file (`Axis.settings_sign`), HC, VC and COR are measured
from the pixel's edge, and every field may be absent (None). `rebuild` interprets it.

It is written as the scanner writes it and read as scanners have written it: the fields of
`ScanSettings` drive both directions, their order, keys and number formats are those of the real
files. Reading is tolerant where real files vary (`:` or `=`, `value;`, decimal commas, missing
lines, any case) and strict where a wrong number would do harm: a figure that is not a finite number
is an error with its line.

`Figures` are SOD, SDD, HC, VC and COR, and poses come back from them. HC and VC are the piercing
point's column and row, COR the rotation axis's column, in binned pixels from the region's corner,
measured from the pixel's EDGE: half a pixel more than the integer-centre coordinates used
everywhere else. This module is the only place that adds or takes that half.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from datetime import datetime
from functools import partial
from typing import Any, Final, Literal

import numpy as np

from flexdt.twin.dataset.dataset_errors import SCAN_SETTINGS, DatasetFormatError
from flexdt.twin.dataset.flexdt_json import FrameBlock, FrameKind, ScanRecord
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.machine.camera import Roi

EDGE = 0.5
"""Edge-measured coordinate of the centre of pixel 0."""


@dataclass(frozen=True)
class Figures:
    """A geometry as the settings texts state it.

    Attributes:
        sod_mm, sdd_mm: source-object and source-detector distance along the beam.
        hc_px, vc_px: piercing point (column, row) from the edge, binned pixels.
        cor_px: column of the rotation axis at the height of the focal spot, from the edge.
        pixel_mm: binned pixel pitch.
    """

    sod_mm: float
    sdd_mm: float
    hc_px: float
    vc_px: float
    cor_px: float
    pixel_mm: float

    @property
    def magnification(self) -> float:
        """SDD / SOD."""
        return self.sdd_mm / self.sod_mm

    @property
    def stated(self) -> dict[str, Any]:
        """The members of `ScanSettings` that say it."""
        numbers = {name: value for name, value in vars(self).items() if name != "pixel_mm"}
        return {
            **numbers, "binned_pixel_mm": self.pixel_mm, "voxel_um": self.voxel_um,
            "magnification": self.magnification,
        }  # fmt: skip

    @property
    def voxel_um(self) -> float:
        """pixel * SOD / SDD [um] (the thesis prints the ratio upside down)."""
        return 1000.0 * self.pixel_mm * self.sod_mm / self.sdd_mm


def figures_of(pose: Poses, shape: tuple[int, int]) -> Figures:
    """The figures of one pose (n = 1) on an image of `shape` (rows, cols)."""
    cone = pose.cone_vec()
    hc, vc = (cone.piercing_points(shape)[0] + EDGE).tolist()
    height = float(pose.source[0, 2] - pose.axis[0, 2])
    on_axis = np.array([0.0, 0.0, height]) - pose.mount[0]
    cor = float(cone.project_points(on_axis, shape)[0, 0, 0] + EDGE)
    pixel = float(np.linalg.norm(pose.u[0]))
    return Figures(float(pose.sod[0]), float(pose.sdd[0]), hc, vc, cor, pixel)


def poses_of(
    figures: Figures,
    shape: tuple[int, int],
    angles: FloatArray,
    *,
    source_x: float = 0.0,
    source_z: float = 0.0,
    axis_z: float = 0.0,
) -> Poses:
    """Poses that have these figures, with an upright detector; the inverse of `figures_of`.

    The figures leave open where the scanner's origin lies and how high the sample stands, so those
    are arguments.

    Args:
        figures: as printed.
        shape: image (rows, cols).
        angles: stage angle of each frame, (n,) [rad].
        source_x, source_z: focal spot [mm], world.
        axis_z: height of the sample's reference point [mm], world.
    """
    f, (rows, cols) = figures, shape
    axis_x = source_x + (f.cor_px - f.hc_px) * f.pixel_mm * f.sod_mm / f.sdd_mm
    detector_x = source_x + (cols / 2.0 - f.hc_px) * f.pixel_mm
    detector_z = source_z - (rows / 2.0 - f.vc_px) * f.pixel_mm
    return Poses.upright(
        [source_x, 0.0, source_z],
        [axis_x, f.sod_mm, axis_z],
        [detector_x, f.sdd_mm, detector_z],
        f.pixel_mm,
        angles,
    )


@dataclass(frozen=True)
class MotorLine:
    """One motor's line: position, speed, acceleration [mm or deg, per second]."""

    value: float
    speed: float | None = None
    acceleration: float | None = None


Kind = Literal["text", "number", "count", "mm", "minutes", "whole minutes", "roi"]
"""How a value is written."""


@dataclass(frozen=True)
class Entry:
    """Where the scanner's two texts state a field of `ScanSettings`.

    Attributes:
        kind: how it is written in `scan settings.txt`.
        key: of its line there; empty if it shares another's.
        xre: section and key in `data settings XRE.txt`; None where that does not say it.
        separator: between key and value in `scan settings.txt`.
    """

    kind: Kind
    key: str
    xre: tuple[str, str] | None
    separator: str


def _stated(
    kind: Kind, key: str, section: str = "", xre_key: str = "", *, separator: str = " : "
) -> Any:
    xre = (section, xre_key) if section else None
    return field(default=None, metadata={"entry": Entry(kind, key, xre, separator)})


_text, _number, _count = (partial(_stated, kind) for kind in ("text", "number", "count"))
_total = partial(_count, separator=": ")
_SCAN, _SAMPLE, _TUBE = "Scan info", "Sample info", "Tube settings"
_CAMERA, _ACQUISITION, _CT = "Camera settings", "Acquisition settings", "CT-parameters IN"


@dataclass(frozen=True)
class ScanSettings:
    """Everything `scan settings.txt` says, in its order; names follow its keys, units its units."""

    scan_id: str | None = _text("ScanID", _SCAN, "scanID")
    batch_id: str | None = _text("BatchID")
    project: str | None = _text("Project")
    started: datetime | None = None
    stopped: datetime | None = None
    duration_minutes: float | None = _stated("minutes", "SCAN DURATION")
    cor_px: float | None = _number("COR", _CT, "COR")
    vc_px: float | None = _number("VC", _CT, "VC")
    hc_px: float | None = _number("HC", _CT, "HC")
    sdd_mm: float | None = _number("SDD", _CT, "SDD")
    sod_mm: float | None = _number("SOD", _CT, "SOD")
    voxel_um: float | None = _number("Voxel size")
    magnification: float | None = _number("Magnification")
    operator: str | None = _text("Operator", _SCAN, "Operator")
    sample_name: str | None = _text("Sample name", _SAMPLE, "Sample name")
    sample_owner: str | None = _text("Sample owner", _SAMPLE, "Owner")
    application_area: str | None = _text("Application area")
    sample_size_mm: float | None = _stated("mm", "Sample size", _SAMPLE, "Diameter (mm)")
    comment: str | None = _text("Comment", _SAMPLE, "Comment")
    scanner_name: str | None = _text("Scanner name", _SCAN, "Scanner name")
    scanner_type: str | None = _text("Scanner type", _SCAN, "scanner type")
    serial: str | None = _text("", _SCAN, "scanner S/N")
    software: str | None = _text("Acquila version", _SCAN, "Acquila version")
    tube: str | None = _text("X-ray tube", _TUBE, "Tube name")
    kV: float | None = _number("Tube voltage", _TUBE, "kV set value")
    power_W: float | None = _number("Tube power", _TUBE, "Target power set value")
    vacuum: str | None = _text("Vacuum level")
    filter: str | None = _text("Filter")
    focus_mode: str | None = _text("Focus mode")
    target_current_uA: float | None = _number("Target current")
    filament_status: str | None = _text("Filament status")
    filament_mode: str | None = _text("Filament mode")
    output_mode: str | None = _text("Output mode")
    camera: str | None = _text("Camera", _CAMERA, "Camera name")
    exposure_ms: float | None = _number("Exposure time (ms)", _CAMERA, "Exposure time (ms)")
    averages: float | None = _number("Number of averages", _CAMERA, "Nr. of averages")
    original_pixel_mm: float | None = _number(
        "Original pixel size", _CAMERA, "Unbinned pixelsize (mm)"
    )
    mode: str | None = _text("Imaging mode", _CAMERA, "Imaging mode")
    binning: int | None = _count("Binning value", _CAMERA, "Binning value")
    binned_pixel_mm: float | None = _number("Binned pixel size", _CAMERA, "Binned pixelsize (mm)")
    roi: Roi | None = field(
        default=None, metadata={"entry": Entry("roi", "ROI (LTRB)", None, " : ")}
    )
    motors: Mapping[str, MotorLine] = field(default_factory=dict)
    cancelled: bool = False
    scan_type: str | None = None
    projections: int | None = _total("# projections", _ACQUISITION, "total projections")
    start_angle_deg: float | None = _number("Start angle", _CT, "Start angle")
    last_angle_deg: float | None = _number("Last angle", _CT, "Last angle")
    pre_flats: int | None = _total("# pre flat fields", _ACQUISITION, "nr FF before")
    post_flats: int | None = _total("# post flat fields", _ACQUISITION, "nr FF after")
    darks: int | None = _total("# offset images", _ACQUISITION, "nr DI before")
    reference_every: int | None = None
    preheating_minutes: int | None = _stated("whole minutes", "Preheating time", separator=": ")
    flat_axis: str | None = _text("Axis for flat field movement", _ACQUISITION, "Flat field axis")

    @property
    def figures(self) -> Figures | None:
        """SOD, SDD, HC, VC, COR and pixel, if all are there."""
        values = (
            self.sod_mm, self.sdd_mm, self.hc_px, self.vc_px, self.cor_px, self.binned_pixel_mm,
        )  # fmt: skip
        known = [v for v in values if v is not None]
        return Figures(*known) if len(known) == len(values) else None


ENTRIES: Final[Mapping[str, Entry]] = {
    f.name: f.metadata["entry"] for f in fields(ScanSettings) if "entry" in f.metadata
}
"""Field -> where it is stated; the other fields have forms of their own."""


def settings_of(record: ScanRecord) -> ScanSettings:
    """The settings file's content for a scan.

    Counts of flats and offset images are exposures, as the scanner counts them: a flat averaged
    over 30 exposures counts 30. Start and last angle are those of the first and last projection.
    """
    camera, machine = record.camera, record.machine
    figures = figures_of(record.settings_pose(), camera.shape)
    angles = record.angles_deg()
    kinds = [block.kind for block in record.blocks]
    first = kinds.index("projection") if "projection" in kinds else len(kinds)
    sample = record.sample
    return ScanSettings(
        scan_id=record.name,
        batch_id="",
        project=sample.project,
        started=record.started.replace(microsecond=0, tzinfo=None),
        stopped=record.stopped.replace(microsecond=0, tzinfo=None),
        duration_minutes=float(round(record.duration_s / 60.0)),
        **figures.stated,
        operator=record.operator,
        sample_name=sample.name,
        sample_owner=sample.owner,
        application_area="",
        sample_size_mm=sample.diameter_mm,
        comment=sample.comment,
        scanner_name=machine.scanner_name,
        scanner_type=machine.scanner_type,
        serial=machine.serial,
        software=f"flexdt {record.version}".strip(),
        tube=machine.tube.name,
        kV=record.kV,
        power_W=record.power_W,
        vacuum="",
        filter="",
        focus_mode="Microfocus",
        target_current_uA=1000.0 * record.power_W / record.kV if record.kV else 0.0,
        filament_status="OK",
        filament_mode="",
        output_mode="Target power",
        camera=machine.detector.model,
        exposure_ms=camera.exposure_ms,
        averages=float(camera.averages),
        original_pixel_mm=machine.detector.pitch_mm,
        mode=camera.mode,
        binning=camera.binning,
        roi=camera.roi,
        motors=motor_lines(record),
        cancelled=not record.complete,
        scan_type="smooth scan" if record.smooth else "step scan",
        projections=record.count("projection"),
        start_angle_deg=float(angles[0]) if len(angles) else 0.0,
        last_angle_deg=float(angles[-1]) if len(angles) else 0.0,
        pre_flats=_exposures(record.blocks[:first], "flat"),
        post_flats=_exposures(record.blocks[first:], "flat"),
        darks=_exposures(record.blocks, "dark"),
        reference_every=0,
        preheating_minutes=0,
        flat_axis=record.flat_axis,
    )


def motor_lines(record: ScanRecord) -> dict[str, MotorLine]:
    """Axis -> its line, virtual axes first, in the settings file's sign."""
    out: dict[str, MotorLine] = {}
    machine = record.machine
    for name, virtual in machine.virtual_axes.items():
        reading = virtual.constant + virtual.factor * record.positions[virtual.of]
        out[name] = MotorLine(reading, record.speeds[virtual.of], record.accelerations[virtual.of])
    for name in sorted(machine.axes, key=_place):
        sign = machine.axes[name].settings_sign
        value = sign * record.positions[name] + 0.0  # no minus zero
        out[name] = MotorLine(value, record.speeds[name], record.accelerations[name])
    return out


_ORDER = ("mag_obj", "mag_det", "rot_obj", "tra_obj", "tra_det", "tra_tube", "ver_tube", "ver_det")


def _place(name: str) -> tuple[int, str]:
    """The order of the scanner's own files; axes they do not have come last."""
    return (_ORDER.index(name) if name in _ORDER else len(_ORDER), name)


def _exposures(blocks: Sequence[FrameBlock], kind: FrameKind) -> int:
    return sum(len(b) * b.camera.averages for b in blocks if b.kind == kind)


EOL: Final = "\r\n"
CANCELLED: Final = "SCRIPT CANCELLED!"

_CONTROL: Final = re.compile(r"[\x00-\x1f\x7f\x85\u2028\u2029]+")


def clean(text: str) -> str:
    """One line of text: control characters and line breaks become blanks, ends are stripped."""
    return _CONTROL.sub(" ", text).strip()


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


_KINDS: Final[Mapping[Kind, tuple[Callable[[Any], str], Callable[[str], object]]]] = {
    "text": (clean, lambda t: t.strip().rstrip(";").strip()),
    "number": (lambda v: f"{v:f}", parse_number),
    "count": (lambda v: f"{v:d}", _whole),
    "mm": (lambda v: f"{v:f} mm", parse_number),
    "minutes": (lambda v: f"{v:.0f} minutes", parse_number),
    "whole minutes": (lambda v: f"{v:d} minutes", _whole),
    "roi": (lambda v: f"{v.left},{v.top},{v.right},{v.bottom}", parse_roi),
}
"""How a value is written and read; reading may raise ValueError."""
_START: Final = "START"
_STOP: Final = "STOP"
_SERIAL: Final = "Scanner S/N"
_BEFORE: Final[Mapping[str, tuple[str, ...]]] = {
    **dict.fromkeys(
        ("stopped", "duration_minutes", "operator", "camera", "motors", "cancelled"), ("",)
    ),
    "tube": ("", ""),
    "scan_type": ("Script summary:", ""),
}
"""Lines that come before a field's own, also where that is absent."""
_BY_KEY: Final = {entry.key.lower(): field for field, entry in ENTRIES.items() if entry.key}
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
                head = "Scanner type : " if s.scanner_type is None else out.pop()
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
    hour = moment.hour % 12 if moment.hour % 12 else 12
    half = "AM" if moment.hour < 12 else "PM"
    return (
        f"date: {moment.month}/{moment.day}/{moment.year:04d}; "
        f"time: {hour}:{moment.minute:02d}:{moment.second:02d} {half}"
    )


def _motor(name: str, motor: MotorLine) -> str:
    said = {name: motor.value, "speed": motor.speed, "acceleration": motor.acceleration}
    return " ; ".join(f"{key} : {value:f}" for key, value in said.items() if value is not None)


def parse_scan_settings(text: str, file: str = SCAN_SETTINGS) -> ScanSettings:
    """Read `scan settings.txt`.

    Args:
        text: its content.
        file: name for error messages.

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


def _read_field(field: str, value: str, values: dict[str, Any]) -> None:
    if field == "scanner_type" and _SERIAL in value:
        value, serial = value.split(_SERIAL, 1)
        values.setdefault("serial", serial.strip().lstrip(":=").strip())
    kind = ENTRIES[field].kind
    if kind == "text" or value.rstrip("; ") != "":
        values.setdefault(field, _KINDS[kind][1](value))


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
