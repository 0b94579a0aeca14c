"""Wobble: the rotation axis leans to and fro as the stage turns."""

from __future__ import annotations

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
from flexdt.twin.calibration.diagnose.table.linearised import LEANS, PER_FRAME, Linearised
from flexdt.twin.findings import Finding, warning
from flexdt.twin.geometry.offsets import UNITS, to_edge

NAME: Final = "wobble"
WORDS: Final = "an axis that leans to and fro"
HARMONICS: Final = (1, 2, 3)
LEAST_FRAMES: Final = 12


def families(table: Linearised, known: Known) -> Iterator[Family]:
    """Make leans along and across the beam that follow harmonics of the turn."""
    turn = table.problem.poses.angle[:, None] * np.array(HARMONICS)
    waves = np.concatenate([np.cos(turn), np.sin(turn)], axis=1)
    count = waves.shape[1]
    for number, frames in enumerate(table.scans):
        if len(frames) < LEAST_FRAMES:
            continue
        courses = np.zeros((1, 2, table.n, 2 * count))
        courses[0, 0, frames, :count] = waves[frames]
        courses[0, 1, frames, count:] = waves[frames]
        yield Family(
            NAME,
            (f"wobble {number}",),
            Acts.IMAGE,
            (number,),
            LOG_CHANCE,
            slopes=np.array([[PER_FRAME.index(name) for name in LEANS]]),
            courses=courses,
        )


TIMES: Final = {1: "once", 2: "twice", 3: "three times"}


def told(found: Found) -> list[Finding]:
    """Tell the lean's amplitude and harmonic."""
    seen = found.of(NAME)
    if not seen:
        return []
    weights = seen[0].weights.reshape(2, 2, len(HARMONICS))
    sizes = np.linalg.svd(weights.transpose(2, 0, 1), compute_uv=False)[:, 0]
    best = int(np.argmax(sizes))
    harmonic = HARMONICS[best]
    size = f"by {to_edge(LEANS[0], float(sizes[best])):.2g} {UNITS[LEANS[0]]} "
    if harmonic == 1:
        # A part of it that turns with the stage is the phantom's own lean: it is not known.
        size = ""
    return [
        warning(
            CalibrationCode.WOBBLE,
            f"the rotation axis leans to and fro {size}{TIMES[harmonic]} a turn: the stage "
            f"wobbles, which moves the images by {seen[0].effect_px:.2g} px rms; the geometry is "
            "that of the mean axis",
        )
    ]
