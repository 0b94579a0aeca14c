"""The options of a calibration, as a request and as where to look for beads."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

from flexdt.library.calibration.calibration_options import CalibrationOptions
from flexdt.twin.calibration.fit.priors import exact
from flexdt.twin.calibration.fit.problem import SIX, Reading
from flexdt.twin.calibration.request import CalibrationRequest
from flexdt.twin.calibration.unknown_markers import UNKNOWN
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.machine.stated_causes import require_causes

READINGS: Final[Mapping[str, Reading]] = {
    "axis": Reading.AXIS_AT_O_PLUS_TAU,
    "mount": Reading.MOUNT_SHIFT,
}
_IN_REQUEST: Final[Mapping[str, tuple[str, Callable[[Any], object]]]] = {
    "per_scan": ("per_scan", tuple),
    "per_frame": ("per_frame", tuple),
    "reading": ("reading", READINGS.__getitem__),
    "bead_tolerance": ("bead_tolerance_mm", float),
    "start": ("start", Offsets.from_edge),
    "bound": ("bound", float),
}
"""Option -> attribute of the request, and how it is made of the option's value."""
OF_DETECTION: Final[Mapping[str, str]] = {
    "markers": "markers",
    "scale": "scale",
    "radius": "radius_px",
}
"""Option -> argument of `calibrate_datasets`, for the options of bead detection."""


def request_of(phantom: object, options: CalibrationOptions) -> CalibrationRequest:
    """Make the request of a calibration, the defaults filled in.

    Options that are None are left out, and those of `OF_DETECTION` ignored. By default an
    unknown phantom frees dO_x alone, others the thesis's six; priors "none" makes the
    other offsets exact.

    Args:
        phantom: as of `flexdt.calibrate`.
        options: of the user.

    Raises:
        UnknownNameError, TwinError: as `CalibrationRequest`.
    """
    given = {name: value for name, value in options.items() if value is not None}
    free: Any = given.get("free", ("dO_x",) if phantom == UNKNOWN else SIX)
    priors: Any = given.get("priors", {})
    made: dict[str, Any] = {
        attribute: make(given[name])
        for name, (attribute, make) in _IN_REQUEST.items()
        if name in given
    }
    stated: dict[str, float] = exact(tuple(free)) if priors == "none" else {**priors}
    excluded: Any = given.get("exclude", ())
    return CalibrationRequest(
        free=tuple(free),
        priors=stated | dict.fromkeys(require_causes(excluded), 0.0),
        **made,
    )


def detection_of(options: CalibrationOptions) -> dict[str, Any]:
    """Return the arguments of `calibrate_datasets` that locate the beads."""
    return {argument: options.get(name) for name, argument in OF_DETECTION.items()}
