"""`scan settings.txt` as a frozen value: the scanner's description of one scan, in its
own terms.

Positions carry the sign of the settings file (`Axis.settings_sign`), HC, VC and COR are
measured from the pixel's edge, and every field may be absent (None). `rebuild` interprets it,
`scan_settings_text` writes and reads it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from datetime import datetime
from functools import partial
from typing import Any, Final, Literal

from flexdt.twin.dataset.flexdt_json import FrameBlock, FrameKind, ScanRecord
from flexdt.twin.dataset.stated_geometry import Figures, figures_of
from flexdt.twin.machine.camera import Roi

Kind = Literal["text", "number", "count", "mm", "minutes", "whole minutes", "roi"]
"""Name of the form in which a value is written."""
_SCAN = "Scan info"
_SAMPLE = "Sample info"
_TUBE = "Tube settings"
_CAMERA = "Camera settings"
_ACQUISITION = "Acquisition settings"
_CT = "CT-parameters IN"
_ORDER = (
    "mag_obj",
    "mag_det",
    "rot_obj",
    "tra_obj",
    "tra_det",
    "tra_tube",
    "ver_tube",
    "ver_det",
)


@dataclass(frozen=True)
class MotorLine:
    """One motor's line: position, speed, acceleration [mm or deg, per second]."""

    value: float
    speed: float | None = None
    acceleration: float | None = None


@dataclass(frozen=True)
class Entry:
    """Where the scanner's two texts state a field of `ScanSettings`.

    Attributes:
        kind: how it is written in `scan settings.txt`.
        key: of its line there; empty if it shares another's.
        xre: section and key in `data settings XRE.txt`; None if it is not stated there.
        separator: between key and value in `scan settings.txt`.
    """

    kind: Kind
    key: str
    xre: tuple[str, str] | None
    separator: str


def _stated(
    kind: Kind, key: str, section: str = "", xre_key: str = "", *, separator: str = " : "
) -> Any:
    """Make a field of `ScanSettings`, None by default, whose metadata has its `Entry` in the two
    settings texts. Without `section` the XRE text has no such entry."""
    xre = (section, xre_key) if section else None
    return field(default=None, metadata={"entry": Entry(kind, key, xre, separator)})


_text, _number, _count = (partial(_stated, kind) for kind in ("text", "number", "count"))
_total = partial(_count, separator=": ")


@dataclass(frozen=True)
class ScanSettings:
    """Content of `scan settings.txt` in its order; names follow its keys, units its
    units.
    """

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
    exposure_ms: float | None = _number(
        "Exposure time (ms)", _CAMERA, "Exposure time (ms)"
    )
    averages: float | None = _number("Number of averages", _CAMERA, "Nr. of averages")
    original_pixel_mm: float | None = _number(
        "Original pixel size", _CAMERA, "Unbinned pixelsize (mm)"
    )
    mode: str | None = _text("Imaging mode", _CAMERA, "Imaging mode")
    binning: int | None = _count("Binning value", _CAMERA, "Binning value")
    binned_pixel_mm: float | None = _number(
        "Binned pixel size", _CAMERA, "Binned pixelsize (mm)"
    )
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
    preheating_minutes: int | None = _stated(
        "whole minutes", "Preheating time", separator=": "
    )
    flat_axis: str | None = _text(
        "Axis for flat field movement", _ACQUISITION, "Flat field axis"
    )

    @property
    def figures(self) -> Figures | None:
        """SOD, SDD, HC, VC, COR and binned pixel as `Figures`; None if any of them is
        None.
        """
        values = (
            self.sod_mm,
            self.sdd_mm,
            self.hc_px,
            self.vc_px,
            self.cor_px,
            self.binned_pixel_mm,
        )
        known = [v for v in values if v is not None]
        if len(known) == len(values):
            return Figures(*known)
        return None


ENTRIES: Final[Mapping[str, Entry]] = {
    f.name: f.metadata["entry"] for f in fields(ScanSettings) if "entry" in f.metadata
}
"""Field -> place where it is stated; the other fields have their own forms."""


def settings_of(record: ScanRecord) -> ScanSettings:
    """Compute the settings file's content for a scan.

    Facts that the twin does not model (vacuum, filter, batch) are empty; the target
    current is that of power over voltage [uA]. Flats before the first projection are pre,
    others post.

    Counts of flats and offset images are exposures, as the scanner counts them: a flat
    averaged over 30 exposures counts 30. Start and last angle are those of the first and
    last projection.

    Args:
        record: of the scan; its settings pose gives the printed figures.

    Returns:
        All fields are set, in the file's signs and units.
    """
    camera = record.camera
    machine = record.machine
    figures = figures_of(record.settings_pose(), camera.shape)
    angles = record.angles_deg()
    kinds = [block.kind for block in record.blocks]
    if "projection" in kinds:
        first = kinds.index("projection")
    else:
        first = len(kinds)
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
    """List the lines of the axes in the settings file, in the file's sign: virtual axes
    first, then motors in the scanner's order.

    A virtual axis has the rates of the motor that it reads. Motors that the scanner does
    not have follow by name.

    Args:
        record: of the scan.

    Returns:
        Axis -> position [mm, deg], speed and acceleration.
    """
    out: dict[str, MotorLine] = {}
    machine = record.machine
    for name, virtual in machine.virtual_axes.items():
        reading = virtual.constant + virtual.factor * record.positions[virtual.of]
        out[name] = MotorLine(
            reading, record.speeds[virtual.of], record.accelerations[virtual.of]
        )
    for name in sorted(machine.axes, key=_place):
        sign = machine.axes[name].settings_sign
        value = sign * record.positions[name] + 0.0  # no minus zero
        out[name] = MotorLine(value, record.speeds[name], record.accelerations[name])
    return out


def _place(name: str) -> tuple[int, str]:
    """Return the sort key of the scanner's own order of axes; unknown axes come last."""
    return (_ORDER.index(name) if name in _ORDER else len(_ORDER), name)


def _exposures(blocks: Sequence[FrameBlock], kind: FrameKind) -> int:
    """Count the exposures of the images of a kind: each image counts its averages."""
    return sum(len(b) * b.camera.averages for b in blocks if b.kind == kind)
