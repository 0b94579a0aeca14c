"""Camera settings and derived values: binning, region of interest, image size, pitch.

Image size is always derived from mode and ROI, never a constant. ROI is (left, top,
right, bottom): inclusive, in unbinned pixels, origin top left (checked, flexray.md).
Counts and noise are in `physics.exposure`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from flexdt.twin.errors import LimitError

_MODE = re.compile(r"(?:\d+_)?HW(\d+)SW(\d+)(High|Low)", re.IGNORECASE)

MODE_FORM: Final = "HWaSWbHigh or HWaSWbLow with binning factors a, b"
"""Form of camera mode names, for error messages."""


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
        """Format as "left top right bottom"."""
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
        """Unbinned pitch [mm] from column to column and from row to row."""
        return (
            self.pitch_mm,
            self.pitch_mm if self.row_pitch_mm is None else self.row_pitch_mm,
        )

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height [mm]: unbinned columns and rows times their pitch."""
        across, up = self.edges_mm
        return self.columns * across, self.rows * up


@dataclass(frozen=True)
class CameraSettings:
    """Settings of the camera; `frames` and `averages` are counts, exposure is in ms.

    `modes` are the detector's modes whose names do not contain their binning: (name,
    binning).
    """

    mode: str
    roi: Roi
    exposure_ms: float = 100.0
    averages: int = 1
    frames: int = 1
    modes: tuple[tuple[str, int], ...] = ()

    @property
    def binning(self) -> int:
        """Unbinned pixels per image pixel and side."""
        return binning_of(self.mode, dict(self.modes))

    @property
    def shape(self) -> tuple[int, int]:
        """Image shape (rows, cols); a rest that does not fill a binned pixel is cut off."""
        b = self.binning
        r = self.roi
        return (r.bottom - r.top + 1) // b, (r.right - r.left + 1) // b

    @property
    def of_image(self) -> dict[str, Any]:
        """Settings of an image, by name: mode, exposure_ms, roi (its four edges),
        averages; without the number of frames.
        """
        return {
            "mode": self.mode,
            "exposure_ms": self.exposure_ms,
            "roi": self.roi.edges,
            "averages": self.averages,
        }

    @property
    def stated(self) -> dict[str, Any]:
        """All settings, by name: `of_image` and the number of frames."""
        return {**self.of_image, "frames": self.frames}

    def facts(self, grid: PixelGrid) -> dict[str, Any]:
        """Return the wire's camera: `stated`, and the image's `shape` and `pixel_mm`."""
        return {**self.stated, "shape": self.shape, "pixel_mm": self.pixel_mm(grid)}

    def pixel_mm(self, grid: PixelGrid) -> float:
        """Return the binned pixel pitch from column to column [mm]."""
        return grid.pitch_mm * self.binning

    def pixels_mm(self, grid: PixelGrid) -> tuple[float, float]:
        """Return the binned pitch from column to column and from row to row [mm]."""
        across, up = grid.edges_mm
        return across * self.binning, up * self.binning

    def roi_shift_mm(self, grid: PixelGrid) -> tuple[float, float]:
        """Compute the shift [mm] of the image's center from the sensor's, (columns,
        rows).

        For the thesis's ROI 32 8 1943 1527 that is (+1.1968, 0), as flexDATA has it.
        Whole binned pixels count.
        """
        rows, cols = self.shape
        b = self.binning
        r = self.roi
        column = r.left + (cols * b - 1) / 2 - (grid.columns - 1) / 2
        row = r.top + (rows * b - 1) / 2 - (grid.rows - 1) / 2
        return column * grid.pitch_mm, row * self.pixels_mm(grid)[1] / b


def binning_of(mode: str, modes: Mapping[str, int] | None = None) -> int:
    """Return the binning a*b of a camera mode: by its name in `modes`, else parsed from
    `HWaSWb{High,Low}`, which may have a prefix `N_`.

    Spaces around the name are ignored, and case outside `modes`.

    Args:
        mode: its name.
        modes: binning by name, of a detector whose modes have other names; None: there
            are none.

    Returns:
        Unbinned pixels along each side of an image pixel.

    Raises:
        LimitError: the mode is not in `modes` and does not have that form, or a factor is
            0; the allowed ones are listed.

    Example:
        >>> binning_of("HW2SW1High"), binning_of("2x2", {"1x1": 1, "2x2": 2})
        (2, 2)
    """
    named = {} if modes is None else modes
    if mode.strip() in named:
        return named[mode.strip()]
    match = _MODE.fullmatch(mode.strip())
    if match is None or int(match[1]) * int(match[2]) == 0:
        raise no_mode(mode, [*named, MODE_FORM])
    return int(match[1]) * int(match[2])


def no_mode(mode: str, allowed: Sequence[str]) -> LimitError:
    """Make the error for a camera mode that is not among those `allowed`; returned, not
    raised.

    Its data has `asked` and `allowed`."""
    message = f"camera mode {mode!r} does not exist; allowed: {', '.join(allowed)}"
    return LimitError(message, {"asked": mode, "allowed": list(allowed)})


def without_number(mode: str) -> str:
    """Return a mode's name in lower case, without the number that some machines prefix."""
    return re.sub(r"^\d+_", "", mode.strip()).lower()


def check_roi(roi: Roi, grid: PixelGrid, binning: int) -> Roi:
    """Check that `roi` is on the sensor and holds at least one binned pixel; return it.

    Edges are inclusive and within 0 to size - 1; the first edge outside, of left, top,
    right, bottom, is named.

    Args:
        roi: region of interest, unbinned pixels.
        grid: pixels of the sensor.
        binning: unbinned pixels along each side of an image pixel.

    Returns:
        `roi`, unchanged.

    Raises:
        LimitError: an edge outside, with its name, value and the allowed ones; or fewer
            columns or rows than `binning`.
    """
    for name, value in vars(roi).items():
        sides = name in ("left", "right")
        if sides:
            noun = "columns"
            size = grid.columns
        else:
            noun = "rows"
            size = grid.rows
        if not 0 <= value < size:
            raise LimitError(
                f"ROI {roi}: {name} {value} is outside the sensor's {size} {noun} "
                f"(allowed: 0 to {size - 1})",
                {"asked": str(roi), "edge": name, "allowed": [0, size - 1]},
            )
    if roi.right - roi.left + 1 < binning or roi.bottom - roi.top + 1 < binning:
        raise LimitError(
            f"ROI {roi} holds no pixel at binning {binning}: right and bottom are "
            "inclusive and must exceed left and top",
            {"asked": str(roi), "binning": binning},
        )
    return roi
