"""Every cause that a table knows, one module each; a new one is its file and a row here."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Final, NamedTuple

from flexdt.twin.calibration.diagnose.table.group import Family, Found, Known
from flexdt.twin.calibration.diagnose.table.groups import (
    angle_scale,
    arc,
    beads,
    growth,
    motion,
    panel,
    positions,
    rows,
    slips,
    spots,
    strain,
    tiles,
    wobble,
)
from flexdt.twin.calibration.diagnose.table.linearised import Linearised
from flexdt.twin.findings import Finding


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
        strain, beads, slips, arc, rows, panel, tiles, motion, growth, wobble,
        angle_scale, spots, positions,
    )
)  # fmt: skip
"""Every cause, in the order in which findings are told."""


def every_family(table: Linearised, known: Known) -> list[Family]:
    """Make the groups of every cause at a table."""
    return [family for cause in CAUSES for family in cause.families(table, known)]
