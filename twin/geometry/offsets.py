"""The seventeen geometric offsets of the thesis and their extension, as one frozen value.

Each is true minus nominal and is added to nominal (`angle_scale` multiplies and is 1 when
the angles are right). Names are the thesis's, in Unity's axes: x traversal, y vertical, z
magnification. Internally they are in mm and rad; `from_edge` and `to_edge` convert from
and to the mm and degrees of wire, files and command line. A hidden misalignment ("truth")
and a calibration's correction have the same type.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Final

from flexdt.twin.errors import GeometryError, UnknownNameError

_IN_DEG: Final = (
    "alpha",
    "det_roll",
    "det_pitch",
    "det_yaw",
    "axis_tilt_x",
    "axis_tilt_z",
)
MAX_TILT_DEG: Final = 45.0
"""Largest plausible tilt [deg] (assumed)."""
ANGLE_SCALE_RANGE: Final = (0.5, 2.0)
"""Plausible range of `angle_scale` (assumed)."""


@dataclass(frozen=True)
class Offsets:
    """Geometric offsets [mm, rad; angle_scale dimensionless]. The default is "as nominal"."""

    dO_x: float = 0.0
    dO_y: float = 0.0
    dO_z: float = 0.0
    alpha: float = 0.0
    tau_x: float = 0.0
    tau_z: float = 0.0
    dD_x: float = 0.0
    dD_y: float = 0.0
    dD_z: float = 0.0
    dS_x: float = 0.0
    dS_y: float = 0.0
    det_roll: float = 0.0
    det_pitch: float = 0.0
    det_yaw: float = 0.0
    axis_tilt_x: float = 0.0
    axis_tilt_z: float = 0.0
    angle_scale: float = 1.0

    @classmethod
    def from_edge(cls, values: Mapping[str, float]) -> Offsets:
        """Build from edge units (mm, deg, 1); missing names keep their nominal value.

        Raises:
            UnknownNameError: a name that is not one of `NAMES`.
        """
        for name in values:
            if name not in UNITS:
                message = f"unknown parameter {name!r}; allowed"
                raise UnknownNameError.among(message, name, NAMES)
        return cls(**{name: to_internal(name, value) for name, value in values.items()})

    def to_edge(self) -> dict[str, float]:
        """Return all seventeen values in edge units (mm, deg, 1), by name."""
        return {f.name: to_edge(f.name, getattr(self, f.name)) for f in fields(self)}


UNITS: Final[Mapping[str, str]] = {
    f.name: "deg" if f.name in _IN_DEG else "1" if f.name == "angle_scale" else "mm"
    for f in fields(Offsets)
}
"""Every parameter's name, in the order of the interface, with its unit at the edge."""

NAMES: Final[tuple[str, ...]] = tuple(UNITS)

MEANINGS: Final[Mapping[str, str]] = {
    "dO_x": "sample with axis, to the right",
    "dO_y": "sample with axis, upwards",
    "dO_z": "sample with axis, along the beam",
    "alpha": "sample, turned",
    "tau_x": "axis within the sample, to the right",
    "tau_z": "axis within the sample, along the beam",
    "dD_x": "panel, to the right",
    "dD_y": "panel, upwards",
    "dD_z": "panel, along the beam",
    "dS_x": "source, to the right",
    "dS_y": "source, upwards",
    "det_roll": "panel roll",
    "det_pitch": "panel pitch",
    "det_yaw": "panel yaw",
    "axis_tilt_x": "axis tilt about x",
    "axis_tilt_z": "axis tilt about the beam",
    "angle_scale": "turn per degree of rot_obj",
}
"""Meaning of every parameter in words, for tables that people read."""

NOMINAL: Final = Offsets()
"""No offset at all."""


def require_plausible(parameters: Offsets, reach_mm: float) -> None:
    """Check that offsets are within a real scanner's range, to find slips (limits
    assumed).

    Shifts are within `reach_mm`, tilts `MAX_TILT_DEG`, angle_scale `ANGLE_SCALE_RANGE`;
    `alpha` is free. NaN is outside.

    Raises:
        GeometryError: names the first offset out of its range.
    """
    ranges = {
        "mm": (-reach_mm, reach_mm),
        "deg": (-MAX_TILT_DEG, MAX_TILT_DEG),
        "1": ANGLE_SCALE_RANGE,
    }
    for name, value in parameters.to_edge().items():
        low, high = ranges[UNITS[name]]
        if name != "alpha" and not low <= value <= high:
            unit = ""
            if UNITS[name] != "1":
                unit = f" {UNITS[name]}"
            message = f"{name} {value:g}{unit}; allowed: {low:g} to {high:g}"
            raise GeometryError(
                message, {"check": name, "asked": value, "allowed": [low, high]}
            )


def to_internal(name: str, value: float) -> float:
    """Convert one offset from its edge unit to the internal one: degrees to rad, others
    unchanged.

    KeyError for a name that is not in `NAMES`.

    Example:
        >>> round(to_internal("det_roll", 180.0), 6), to_internal("dS_x", 2.0)
        (3.141593, 2.0)"""
    if UNITS[name] == "deg":
        return math.radians(value)
    return float(value)


def to_edge(name: str, value: float) -> float:
    """Convert one offset from its internal unit to that of the edge: rad to degrees,
    others unchanged.

    KeyError for a name that is not in `NAMES`.

    Example:
        >>> round(to_edge("det_roll", to_internal("det_roll", 0.5)), 9)
        0.5"""
    if UNITS[name] == "deg":
        return math.degrees(value)
    return float(value)
