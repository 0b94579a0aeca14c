"""Camera settings and what follows from them: binning, region of interest, image size, pitch.

Image size is always derived from mode and ROI, never a constant. ROI is (left, top, right,
bottom): inclusive, in unbinned pixels, origin top left (checked, flexray.md). Counts and noise are
in `physics.exposure`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from flexdt.twin.errors import LimitError

_MODE = re.compile(r"(?:\d+_)?HW(\d+)SW(\d+)(High|Low)", re.IGNORECASE)


@dataclass(frozen=True)
class Roi:
    """Region of interest in unbinned pixels, all four edges inclusive."""

    left: int
    top: int
    right: int
    bottom: int

    def __str__(self) -> str:
        return f"{self.left} {self.top} {self.right} {self.bottom}"


@dataclass(frozen=True)
class Sensor:
    """The full, unbinned sensor: (columns, rows), pitch [mm] and depth [bit]."""

    columns: int
    rows: int
    pitch_mm: float
    bits: int


@dataclass(frozen=True)
class CameraSettings:
    """What the camera is set to; `frames` and `averages` are counts, exposure is in ms."""

    mode: str
    roi: Roi
    exposure_ms: float = 100.0
    averages: int = 1
    frames: int = 1

    @property
    def binning(self) -> int:
        """Unbinned pixels per image pixel along each side."""
        return binning_of(self.mode)

    @property
    def shape(self) -> tuple[int, int]:
        """Image (rows, cols); a surplus that does not fill a binned pixel is cut off."""
        b, r = self.binning, self.roi
        return (r.bottom - r.top + 1) // b, (r.right - r.left + 1) // b

    def pixel_mm(self, sensor: Sensor) -> float:
        """Binned pixel pitch [mm]."""
        return sensor.pitch_mm * self.binning

    def roi_shift_mm(self, sensor: Sensor) -> tuple[float, float]:
        """Shift of the image's centre from the sensor's: (columns growing, rows growing) [mm].

        For the thesis's ROI 32 8 1943 1527 that is (+1.1968, 0), as flexDATA has it.
        """
        rows, cols = self.shape
        b, r = self.binning, self.roi
        column = r.left + (cols * b - 1) / 2 - (sensor.columns - 1) / 2
        row = r.top + (rows * b - 1) / 2 - (sensor.rows - 1) / 2
        return column * sensor.pitch_mm, row * sensor.pitch_mm


def binning_of(mode: str) -> int:
    """Binning a*b of camera mode `HWaSWb{High,Low}` (some machines prefix a number and `_`).

    Raises:
        LimitError: the mode does not have that form.
    """
    match = _MODE.fullmatch(mode.strip())
    if match is None or int(match[1]) * int(match[2]) == 0:
        raise LimitError(
            f"camera mode {mode!r} is not known; allowed: HWaSWbHigh or HWaSWbLow with binning "
            "factors a, b, such as HW1SW1High or HW2SW1Low",
            {"asked": mode, "allowed": "HWaSWb{High,Low}"},
        )
    return int(match[1]) * int(match[2])


def check_roi(roi: Roi, sensor: Sensor, binning: int) -> Roi:
    """Return `roi` if it lies on the sensor and holds at least one binned pixel.

    Raises:
        LimitError: says which edge, its value and what is allowed.
    """
    for name, value, size in (
        ("left", roi.left, sensor.columns),
        ("right", roi.right, sensor.columns),
        ("top", roi.top, sensor.rows),
        ("bottom", roi.bottom, sensor.rows),
    ):
        if not 0 <= value < size:
            what = "columns" if name in ("left", "right") else "rows"
            raise LimitError(
                f"ROI {roi}: {name} {value} is outside the sensor's {size} {what} "
                f"(allowed: 0 to {size - 1})",
                {"asked": str(roi), "edge": name, "allowed": [0, size - 1]},
            )
    if roi.right - roi.left + 1 < binning or roi.bottom - roi.top + 1 < binning:
        raise LimitError(
            f"ROI {roi} holds no pixel at binning {binning}: right and bottom are inclusive and "
            "must exceed left and top",
            {"asked": str(roi), "binning": binning},
        )
    return roi
