"""Slips: beads move against the others while the scan is made: one, or all above a height."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.calibration.diagnose.table.group import (
    LOG_CHANCE,
    NEVER,
    Acts,
    Family,
    Found,
    Known,
)
from flexdt.twin.calibration.diagnose.table.linearised import Linearised
from flexdt.twin.findings import Finding, error
from flexdt.twin.geometry.conventions import FloatArray

NAME: Final = "slips"
WORDS: Final = "beads that move against each other"
LEAST_FRAMES: Final = 8
LEAST_BEADS: Final = 4
LEAST_SIDE: Final = 4
"""Frames on either side of a slip that show the beads."""
MOST_WAVES: Final = 12
"""Half waves in a scan, of an uneven course."""
NEAR: Final = 2
"""Frames about a slip of the last table that are looked at one by one."""
MOST_JUMPS: Final = 30
"""Frames before which a slip is looked for."""
KINDS: Final = 2
LEAST_PART: Final = 0.1
"""Part of the largest way below which another bead's is not told."""


class Slips(NamedTuple):
    """What a group is: the beads that move together, and the frame of a slip, -1 of a course."""

    beads: tuple[int, ...]
    scan: int
    at: int


def families(table: Linearised, known: Known) -> Iterator[Family]:
    """Make, of each bead and of all beads above each height, one step of their place, and
    waves that make any course.
    """
    if known.bead_tolerance_mm == 0 or table.k < LEAST_BEADS:
        return
    pieces = [(b,) for b in range(table.k)]
    pieces += [tuple(some.tolist()) for some in table.upper_beads]
    slopes = np.concatenate([table.bead_slopes, table.upper_slopes])
    chance = LOG_CHANCE - math.log(KINDS * len(pieces))
    for number, frames in enumerate(table.scans):
        count = len(frames)
        if count < LEAST_FRAMES:
            continue
        waves = np.arange(min(MOST_WAVES, count - 1) + 1)
        place = (np.arange(count) + 0.5) / count
        course = np.cos(np.pi * place[:, None] * waves) / np.maximum(waves, 1)
        yield Family(
            NAME,
            tuple(f"beads {p} move {number}" for p in pieces),
            Acts.IMAGE,
            tuple(Slips(p, number, -1) for p in pieces),
            chance,
            slopes=slopes,
            courses=_along_axes(table.n, frames, course[None]),
        )
        last = count - LEAST_SIDE
        many = min(last - LEAST_SIDE + 1, MOST_JUMPS)
        jumps = np.linspace(LEAST_SIDE, last, many).round().astype(int)
        first = [int(np.searchsorted(frames, s.at)) for s in table.state.found
                 if isinstance(s, Slips) and s.at >= 0 and s.scan == number]  # fmt: skip
        near = [at + step for at in first for step in range(-NEAR, NEAR + 1)]
        jumps = np.unique(np.clip([*jumps, *near], LEAST_SIDE, last))
        each = [(piece, int(frames[at])) for at in jumps for piece in pieces]
        steps = np.arange(count) >= jumps[:, None]
        # Beads that are seen on one side alone are elsewhere, whenever that happened.
        shown = np.stack(
            [1.0 * table.weight[frames][:, p].any(axis=1) for p in pieces], axis=1
        )
        sides = np.minimum(steps @ shown, ~steps @ shown) >= LEAST_SIDE
        chances = np.where(sides, chance - math.log(2 * len(jumps)), NEVER).ravel()
        # Only what is elsewhere weighs less: the rest is where the phantom's file has it.
        for after in (True, False):
            yield Family(
                NAME,
                tuple(
                    f"beads {p} slip {'at' if after else 'until'} {f}" for p, f in each
                ),
                Acts.IMAGE,
                tuple(Slips(piece, number, at) for piece, at in each),
                chances,
                slopes=slopes,
                courses=_along_axes(table.n, frames, steps[:, :, None] == after),
            )


def _along_axes(
    n: int, frames: npt.NDArray[np.intp], course: FloatArray | npt.NDArray[np.bool_]
) -> FloatArray:
    """Make a place's courses (g, frames, m) along three axes, (g, 3, n, 3 m).

    They are 0 in other scans' frames.
    """
    g, _, m = course.shape
    out = np.zeros((g, 3, n, 3 * m))
    for axis in range(3):
        out[:, axis, frames, axis::3] = course
    return out


def told(found: Found) -> list[Finding]:
    """Tell which beads move against the others, from which frame and how far: an error."""
    seen = found.of(NAME)
    if not seen:
        return []
    courses: dict[int, FloatArray] = {}
    frames: dict[int, set[int]] = {}
    for one in seen:
        place = one.place
        assert isinstance(place, Slips)
        assert one.courses is not None
        for bead in place.beads:
            courses[bead] = courses.get(bead, 0.0) + one.courses
            frames.setdefault(bead, set()).add(place.at)
    far = {
        bead: float(np.linalg.norm(course - course[:, :1], axis=0).max())
        for bead, course in courses.items()
    }
    most = max(far.values())
    alike: dict[int, list[int]] = {}
    for bead in sorted(far):
        if far[bead] > LEAST_PART * most:
            first = min(frames[bead]) if len(frames[bead]) == 1 else -1
            alike.setdefault(first, []).append(bead)
    parts = []
    for at, beads in sorted(alike.items()):
        which = f"bead{'s' * (len(beads) > 1)} {', '.join(map(str, beads))}"
        how = "unevenly" if at < 0 else f"from frame {at} on"
        size = max(far[bead] for bead in beads)
        parts.append(f"{which} move{'s' * (len(beads) == 1)} by {size:.2g} mm {how}")
    return [
        error(
            CalibrationCode.BEADS_MOVED,
            f"{'; '.join(parts)}, against the others: fix the phantom, and scan it again",
        )
    ]
