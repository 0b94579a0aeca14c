"""Told: a told length (a way, a place, the phantom's scale) is quite another."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from flexdt.twin.calibration.diagnose.table.group import (
    LOG_CHANCE,
    Acts,
    Family,
    Found,
    Known,
)
from flexdt.twin.calibration.diagnose.table.linearised import Linearised
from flexdt.twin.findings import Finding
from flexdt.twin.geometry.told_lengths import PANEL_TRAVEL, PHANTOM, TRAVEL

NAME: Final = "told"
WORDS: Final = "a told length that is quite another"
WIDEST: Final = 5e-2
"""Largest standard deviation of a told length over the told one; of a place over the SOD."""


def told_columns(table: Linearised) -> list[str]:
    """List the columns of told lengths that may be quite others: ways, the places of three or
    more scans, and the phantom's scale beside one of them.

    Without a way nothing in the images tells the phantom's scale.
    """
    names = table.problem.layout.names[: table.parameters]
    lengths = [n for n in names if n in (*TRAVEL, *PANEL_TRAVEL)]
    if len(table.scans) > 2:
        lengths += [n for n in names if n.split("@")[0] == "place_z"]
    if lengths and PHANTOM in names:
        lengths.append(PHANTOM)
    return lengths


def families(table: Linearised, known: Known) -> Iterator[Family]:
    """Make each told length once more, with a width of its own."""
    sod = float(np.median(table.problem.poses.sod))
    for name in told_columns(table):
        column = np.array([table.problem.layout.names.index(name)])
        widest = WIDEST * (sod if name.startswith("place") else 1.0)
        yield Family(
            NAME, (f"told {name}",), Acts.COLUMNS, (column,), LOG_CHANCE,
            table.columns[None][:, :, column], widest=widest,
        )  # fmt: skip


def told(found: Found) -> list[Finding]:
    """Tell nothing: what is told is compared with the images elsewhere."""
    return []
