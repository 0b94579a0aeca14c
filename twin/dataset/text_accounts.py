"""What became of each line of the scanner's texts, once the geometry is rebuilt from them."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Final

from flexdt.twin.dataset.format_table import Ledger
from flexdt.twin.dataset.provenance import Provenance
from flexdt.twin.dataset.scan_settings import ENTRIES, ScanSettings

SAME: Final = 1e-4
"""Relative difference of two printed figures that is none: they have six decimals."""
PHYSICAL: Final = "mag_det_phys"
"""The detector's physical place, which comes before mag_det."""
FIGURES: Final = (
    "sod_mm", "sdd_mm", "cor_px", "hc_px", "vc_px", "binned_pixel_mm", "projections",
    "start_angle_deg", "last_angle_deg", "kV", "mode", "scanner_name",
)  # fmt: skip
"""Fields that both texts state and that the geometry or the images follow from."""


def account(
    said: Ledger, settings: ScanSettings, motors: Collection[str]
) -> tuple[Provenance, list[str]]:
    """Explain the lines of a text whose figures were used.

    Args:
        said: of the text, with all of its lines.
        settings: that were read from it.
        motors: of the machine; motors of the table that it has not are named.

    Returns:
        The values with their uses, and what a user should know.
    """
    _compare(said, settings)
    prefix = "" if said.stated("motor positions/rot_obj") is None else "motor positions/"
    for name in settings.motors:
        if name in motors:
            said.use(f"{prefix}{name}", "the geometry")
        elif said.table.field(f"{prefix}{name}") is not None and name != PHYSICAL:
            why = "no motor of the machine" if motors else "the scanner is not known"
            said.ignore(f"{prefix}{name}", why)
    said.use_all()
    return said.finish(), said.warnings


def _compare(said: Ledger, settings: ScanSettings) -> None:
    """Set Voxel size and Magnification aside where SOD, SDD and the pixel say otherwise."""
    figures = settings.figures
    if figures is None:
        return
    for name, stated, follows in (
        ("Voxel size", settings.voxel_um, figures.voxel_um),
        ("Magnification", settings.magnification, figures.magnification),
    ):
        if stated is not None and not math.isclose(stated, follows, rel_tol=SAME):
            why = f"{name} is {stated:.6g}, SOD, SDD and Binned pixel size give {follows:.6g}"
            said.set_aside(name, f"{why}, which is taken")


def account_beside(
    said: Ledger, settings: ScanSettings, taken: ScanSettings, winner: str
) -> tuple[Provenance, list[str]]:
    """Explain the lines of a text that stands beside the one that was taken; figures that
    differ are told.

    Args:
        said: of the text, with all of its lines.
        settings: that were read from it.
        taken: those of the other text.
        winner: name of that text.
    """
    for name in FIGURES:
        entry = ENTRIES[name]
        ours, theirs = getattr(settings, name), getattr(taken, name)
        if entry.xre is None or ours is None or theirs is None or _same(ours, theirs):
            continue
        place = "/".join(entry.xre)
        said.set_aside(
            place, f"{place} is {ours}, {winner} says {theirs}, which is taken"
        )
    _compare_motors(said, settings, taken, winner)
    said.use_all()
    return said.finish(), said.warnings


def _compare_motors(
    said: Ledger, settings: ScanSettings, taken: ScanSettings, winner: str
) -> None:
    """Set motors aside that the other text has elsewhere."""
    theirs: Mapping[str, float] = {n: line.value for n, line in taken.motors.items()}
    for name, line in settings.motors.items():
        if name in theirs and not _same(line.value, theirs[name]):
            why = f"{name} is at {line.value:g}, {winner} says {theirs[name]:g}"
            said.set_aside(f"motor positions/{name}", f"{why}, which is taken")


def _same(one: object, other: object) -> bool:
    """Return whether two printed values are one."""
    if isinstance(one, int | float) and isinstance(other, int | float):
        return math.isclose(one, other, rel_tol=SAME, abs_tol=SAME)
    return one == other
