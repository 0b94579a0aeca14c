"""Every cause that a table knows, one module each; a new one is its file and a row here."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from flexdt.twin.calibration.diagnose.table.group import Family, Found, Known
from flexdt.twin.calibration.diagnose.table.groups import (
    angle_scale,
    arc,
    bead_places,
    bend,
    growth,
    moving,
    panel_shape,
    positions,
    rows,
    slips,
    spots,
    strain,
    tiles,
    told,
    wobble,
)
from flexdt.twin.calibration.diagnose.table.linearised import Linearised
from flexdt.twin.findings import Finding
from flexdt.twin.machine.stated_causes import TOLD_RIVALS


class Cause(NamedTuple):
    """A cause, as its module states it.

    Attributes:
        name: of the cause.
        words: what it is, in words.
        families: makes its groups at a table; none where it cannot be.
        told: its findings, of what was found.
    """

    name: str
    words: str
    families: Callable[[Linearised, Known], Iterable[Family]]
    told: Callable[[Found], list[Finding]]


CAUSES: Final = tuple(
    Cause(module.NAME, module.WORDS, module.families, module.told)
    for module in (
        strain, bend, bead_places, slips, arc, rows, panel_shape, tiles, moving, growth, wobble,
        angle_scale, spots, told, positions,
    )
)  # fmt: skip
"""Every cause, in the order in which findings are told."""


STATED: Final = (
    (tiles.NAME, "", "gap"),
    (panel_shape.NAME, "", "distortion"),
    (strain.NAME, "", "shape"),
    (bend.NAME, "", "shape"),
    (bead_places.NAME, "", "beads"),
    (arc.NAME, "", "arc"),
    (rows.NAME, "", "rows"),
    (angle_scale.NAME, "", "angles"),
    (moving.NAME, "alpha", "angles"),
    (moving.NAME, "", "motion"),
    (growth.NAME, "", "motion"),
    (spots.NAME, "", "spots"),
    (told.NAME, "", TOLD_RIVALS),
)
"""Cause, begin of its groups' names, and the name by which its size is stated (`stated_causes`);
the first counts."""
SAME_UNIT: Final = ("gap", "distortion", "shape", "beads")
"""Stated causes of which a group's weights have the stated unit."""
OF_FRAMES: Final = {"angles": math.radians(1.0), "motion": 1.0}
"""Stated causes of which a group's weights make courses over the frames -> the stated unit in that
of the courses."""


def every_family(table: Linearised, known: Known) -> list[Family]:
    """Make the groups of every cause at a table, none wider than it is stated to be."""
    return [
        limited
        for cause in CAUSES
        for family in cause.families(table, known)
        if (limited := _limited(family, known)) is not None
    ]


def _limited(family: Family, known: Known) -> Family | None:
    """Return a family that is no wider than stated; None for one that is excluded. Of a size
    that is stated in another unit than its weights', only 0 is one; a course over the frames
    has the root mean square that is stated.
    """
    name = next(
        (
            stated
            for cause, begin, stated in STATED
            if family.cause == cause and all(n.startswith(begin) for n in family.names)
        ),
        "",
    )
    limit = known.limits.get(name)
    if limit is None or family.always:
        return family
    if limit == 0.0:
        return None
    if name in OF_FRAMES and family.cause != growth.NAME:
        widest = limit * OF_FRAMES[name] / family.reach
    elif name in SAME_UNIT:
        widest = np.full(len(family.names), limit)
    else:
        return family
    return replace(family, widest=np.minimum(family.widest, widest))
