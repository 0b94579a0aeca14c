"""Growth: the phantom grows or shrinks while the scan is made."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import numpy as np

from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.calibration.diagnose.table.group import (
    LOG_CHANCE,
    Acts,
    Family,
    Found,
    Known,
)
from flexdt.twin.calibration.diagnose.table.linearised import Linearised
from flexdt.twin.findings import Finding, warning

NAME: Final = "growth"
WORDS: Final = "a phantom that grows or shrinks"
MOST_WAVES: Final = 6
"""Half waves in a scan."""
WIDEST: Final = 5e-3
"""Largest standard deviation of a growth: plastics expand by 1e-4 a kelvin, of which a cabinet may
change by 20, and cured resin shrinks by 0.2 % in two days."""


def families(table: Linearised, known: Known) -> Iterator[Family]:
    """Make a growth over each scan: evenly, and as half waves that fade with their number; none
    where what looks alike is followed from frame to frame, as no geometry of a frame grows.

    It grows about the point where it is held, somewhere in it: the middle of its beads moves along
    by as much of their distance to the middle.
    """
    if "dO_z" in known.asked:
        return
    size_mm = table.problem.model.reach / math.sqrt(3.0)
    scale = np.array([1.0, size_mm, size_mm, size_mm])
    for number, frames in enumerate(table.scans):
        if len(frames) < 3:
            continue
        place = (np.arange(len(frames)) + 0.5) / len(frames)
        waves = np.arange(1, min(len(frames) - 1, MOST_WAVES) + 1)
        for how, course in (
            ("evenly", (place - 0.5)[:, None]),
            ("in waves", np.cos(math.pi * place[:, None] * waves) / waves),
        ):
            each = (
                scale[:, None, None, None] * course[:, None] * np.eye(4)[:, None, :, None]
            )
            courses = np.zeros((1, 4, table.n, 4 * course.shape[1]))
            courses[0][:, frames] = each.reshape(4, len(frames), -1)
            yield Family(
                NAME,
                (f"grows {how} {number}",),
                Acts.IMAGE,
                ((how, number),),
                LOG_CHANCE - math.log(2),
                slopes=np.array([[table.growth_slope, *table.place_slopes]]),
                courses=courses,
                widest=WIDEST,
            )


def told(found: Found) -> list[Finding]:
    """Tell by how much the phantom grows over the scan [%]."""
    seen = found.of(NAME)
    if not seen:
        return []
    course = sum(s.courses[0] for s in seen if s.courses is not None)
    size = 100 * float(np.ptp(course))
    return [
        warning(
            CalibrationCode.DRIFT,
            f"the phantom grows or shrinks by {size:.2g} % during the scan (or the object moves "
            "along the beam, which looks alike): the geometry is that of its mean size; let it "
            "come to the room's temperature, and scan it again, or --per-frame dO_z follows it",
            per_frame=("dO_z",),
        )
    ]
