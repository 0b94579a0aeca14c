"""The content of `data settings XRE.txt`, section by section, in the scanner's order.

Values of the maker's reconstruction and of hardware the twin does not model are written as zero or
empty, so that readers find every key. `xre` formats the sections.

`[POIs]` are places in the scanner's world, as it prints them. That world has x across, y along the
beam and z up, with the origin at the focal spot's foot: the same directions as here. A detector's
entry is its top left corner with pixels per mm along rows and columns. Hardware that the twin does
not model has no entry.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Final

import numpy as np

from flexdt.twin.dataset.record import ScanRecord
from flexdt.twin.dataset.scan_settings import ScanSettings, settings_of
from flexdt.twin.geometry.conventions import BEAM, RIGHT, UP, FloatArray, stage_rotation
from flexdt.twin.geometry.poses import Poses

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

_ZERO: Final = "0.000000"
_RECONSTRUCTION: Final = (
    "Interpolate", "Resolution", "Voxel size", "z_start", "z_end", "Min grey value",
    "Max grey value", "Recon mode", "ZP factor", "Filter type", "Filter level", "Min CT value",
    "Max CT value", "Spot filter", "HC", "bhc2", "Ring level", "Ring kernel", "Ring blocks",
    "Prompt scaling", "Spot kernel", "Phase mu", "Phase delta", "Edge correction factor",
    "Square recon", "Scatter", "Clipping value", "EFOV filter", "Original number of columns",
    "EFOV axis", "FilterEdgeWidth",
)  # fmt: skip


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
    for absent in ("mag_tube", "tra_tube"):  # the scanner writes both, also where there is none
        out.setdefault(absent, 0.0)
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
