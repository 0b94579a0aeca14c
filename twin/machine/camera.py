"""Camera settings and what follows from them: binning, region of interest, image size, pitch.

Image size is always derived from mode and ROI, never a constant. ROI is (left, top, right,
bottom): inclusive, in unbinned pixels, origin top left (checked, flexray.md). Counts and noise are
in `physics.exposure`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from flexdt.twin.errors import LimitError

_MODE = re.compile(r"(?:\d+_)?HW(\d+)SW(\d+)(High|Low)", re.IGNORECASE)

FORM: Final = "HWaSWbHigh or HWaSWbLow with binning factors a, b"


@dataclass(frozen=True)
class Roi:
    """Region of interest in unbinned pixels, all four edges inclusive."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def edges(self) -> tuple[int, int, int, int]:
        """Left, top, right, bottom."""
        return self.left, self.top, self.right, self.bottom

    def __str__(self) -> str:
        return f"{self.left} {self.top} {self.right} {self.bottom}"


@dataclass(frozen=True)
class PixelGrid:
    """The unbinned pixels of a flat panel; the defaults are those of a Dexela 1512NDT."""

    columns: int = 1944
    """Literature: data sheet, thesis 2.3."""
    rows: int = 1536
    """Literature: data sheet, thesis 2.3."""
    pitch_mm: float = 0.0748
    """Literature: data sheet, thesis 2.3. From column to column."""
    row_pitch_mm: float | None = None
    """Literature: as pitch_mm. From row to row, where that differs."""

    @property
    def edges_mm(self) -> tuple[float, float]:
        """Pitch from column to column and from row to row."""
        return self.pitch_mm, self.pitch_mm if self.row_pitch_mm is None else self.row_pitch_mm

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height of the active area."""
        across, up = self.edges_mm
        return self.columns * across, self.rows * up


@dataclass(frozen=True)
class CameraSettings:
    """What the camera is set to; `frames` and `averages` are counts, exposure is in ms.

    `modes` are the detector's modes whose names do not tell their binning: (name, binning).
    """

    mode: str
    roi: Roi
    exposure_ms: float = 100.0
    averages: int = 1
    frames: int = 1
    modes: tuple[tuple[str, int], ...] = ()

    @property
    def binning(self) -> int:
        """Unbinned pixels per image pixel along each side."""
        return binning_of(self.mode, dict(self.modes))

    @property
    def shape(self) -> tuple[int, int]:
        """Image (rows, cols); a surplus that does not fill a binned pixel is cut off."""
        b, r = self.binning, self.roi
        return (r.bottom - r.top + 1) // b, (r.right - r.left + 1) // b

    @property
    def of_image(self) -> dict[str, Any]:
        """What each image is taken with, by name; the ROI as its edges."""
        return {
            "mode": self.mode,
            "exposure_ms": self.exposure_ms,
            "roi": self.roi.edges,
            "averages": self.averages,
        }

    @property
    def stated(self) -> dict[str, Any]:
        """What is set, by name: `of_image` and the number of images."""
        return {**self.of_image, "frames": self.frames}

    def facts(self, grid: PixelGrid) -> dict[str, Any]:
        """What is set and the image's `shape` and `pixel_mm`: the wire's camera."""
        return {**self.stated, "shape": self.shape, "pixel_mm": self.pixel_mm(grid)}

    def pixel_mm(self, grid: PixelGrid) -> float:
        """Binned pixel pitch from column to column [mm]."""
        return grid.pitch_mm * self.binning

    def pixels_mm(self, grid: PixelGrid) -> tuple[float, float]:
        """Binned pixel pitch from column to column and from row to row [mm]."""
        across, up = grid.edges_mm
        return across * self.binning, up * self.binning

    def roi_shift_mm(self, grid: PixelGrid) -> tuple[float, float]:
        """Shift of the image's centre from the sensor's: (columns growing, rows growing) [mm].

        For the thesis's ROI 32 8 1943 1527 that is (+1.1968, 0), as flexDATA has it.
        """
        rows, cols = self.shape
        b, r = self.binning, self.roi
        column = r.left + (cols * b - 1) / 2 - (grid.columns - 1) / 2
        row = r.top + (rows * b - 1) / 2 - (grid.rows - 1) / 2
        return column * grid.pitch_mm, row * self.pixels_mm(grid)[1] / b


def binning_of(mode: str, modes: Mapping[str, int] | None = None) -> int:
    """Binning a*b of camera mode `HWaSWb{High,Low}` (some machines prefix a number and `_`).

    Args:
        mode: its name.
        modes: binning by name, of a detector whose modes have other names.

    Raises:
        LimitError: the mode is not in `modes` and does not have that form.

    Example:
        >>> binning_of("HW2SW1High"), binning_of("2x2", {"1x1": 1, "2x2": 2})
        (2, 2)
    """
    named = {} if modes is None else modes
    if mode.strip() in named:
        return named[mode.strip()]
    match = _MODE.fullmatch(mode.strip())
    if match is None or int(match[1]) * int(match[2]) == 0:
        raise no_mode(mode, [*named, FORM])
    return int(match[1]) * int(match[2])


def no_mode(mode: str, allowed: Sequence[str]) -> LimitError:
    """The error for a camera mode that is not among those `allowed`."""
    what = f"camera mode {mode!r} does not exist; allowed: {', '.join(allowed)}"
    return LimitError(what, {"asked": mode, "allowed": list(allowed)})


def without_number(mode: str) -> str:
    """A mode's name without the number that some machines prefix, in lower case."""
    return re.sub(r"^\d+_", "", mode.strip()).lower()


def check_roi(roi: Roi, grid: PixelGrid, binning: int) -> Roi:
    """Return `roi` if it lies on the sensor and holds at least one binned pixel.

    Raises:
        LimitError: says which edge, its value and what is allowed.
    """
    for name, value in vars(roi).items():
        sides = name in ("left", "right")
        what, size = ("columns", grid.columns) if sides else ("rows", grid.rows)
        if not 0 <= value < size:
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
