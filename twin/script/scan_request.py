"""The scan that a user requests, before a script is composed for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, get_args

from flexdt.twin.machine.camera import Roi

Kind = Literal["fly", "step", "tiled", "helical", "calibration"]

KINDS: Final[tuple[Kind, ...]] = get_args(Kind)

REFERENCES: Final = 10
"""Images averaged for a dark and a flat; their noise is then small beside a projection's."""


@dataclass(frozen=True)
class ScanPosition:
    """The sample's position in one scan of a calibration series: SOD and
    lateral offset [mm]."""

    sod_mm: float
    lateral_mm: float = 0.0


@dataclass(frozen=True)
class ScanRequest:
    """The scan to compose a script for, in the edge's units.

    Attributes:
        kind: fly (one smooth turn), step (stop for every image), tiled (fly scans with
            the detector side by side), helical (several turns while source and detector
            rise), calibration (one fly scan for each of `placements`).
        sod_mm, sdd_mm: source-object and source-detector distance; None is 600 and 1059
            where the machine gets there, else its home, or its only one.
        frames: images of one fly scan, of the whole for step and helical.
        exposure_ms, averages: of one image; None is the machine's exposure.
        height_mm: of source and detector center above the origin; None is the sample's,
            or as for sod_mm.
        turns, rise_mm: of a helical scan, in total.
        tiles: side by side, for tiled; neighbors share a tenth of the columns.
        placements: for calibration; None is SOD 600 and 800, or as many as the machine
            has room for.
        mode, roi: camera; None is the machine's.
        kV, power_W: tube; None is the machine's.
        darks, flats: averages of the dark and of the flat image.
        folder: the scanner's output path; the twin keeps only the file names.
    """

    kind: Kind = "fly"
    sod_mm: float | None = None
    sdd_mm: float | None = None
    frames: int = 361
    exposure_ms: float | None = None
    averages: int = 1
    height_mm: float | None = None
    turns: float = 3.0
    rise_mm: float = 20.0
    tiles: int = 2
    placements: tuple[ScanPosition, ...] | None = None
    mode: str | None = None
    roi: Roi | None = None
    kV: float | None = None
    power_W: float | None = None
    darks: int = REFERENCES
    flats: int = REFERENCES
    folder: str = "E:\\flexdt\\scan"
