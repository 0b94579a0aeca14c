"""What positions are known to err by beside their noise: it always holds."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import numpy as np

from flexdt.twin.calibration.diagnose.table.group import Acts, Family, Found, Known
from flexdt.twin.calibration.diagnose.table.linearised import Linearised
from flexdt.twin.findings import Finding

NAME: Final = "positions"
WORDS: Final = "errors that measured positions are known to have"


def families(table: Linearised, known: Known) -> Iterator[Family]:
    """Make shifts that all frames have in common, and errors that follow a spot's place in
    the pixel grid.

    An error with the pixel's period, a sin(2 pi x + theta) with theta unknown, has the
    covariance a^2 cos 2 pi (x - x'): two vectors, cosine and sine, for each bead and
    coordinate. Beads that stay in one place of the grid keep the same error.
    """
    common = table.problem.common
    if common is not None and common.shape[3]:
        rows = table.rows_of(common)
        yield Family(NAME, ("common",), Acts.IMAGE, (None,), 0.0, rows[None], always=1.0)
    if known.sampling_px > 0:
        n, k = table.n, table.k
        phase = 2.0 * math.pi * table.places
        shift = np.zeros((n, k, 2, k, 4))
        at = np.arange(k)
        for i, wave in enumerate((np.cos, np.sin)):
            shift[:, at, 0, at, i] = wave(phase[..., 0])
            shift[:, at, 1, at, 2 + i] = wave(phase[..., 1])
        rows = table.rows_of(shift.reshape(n, k, 2, 4 * k))
        yield Family(
            NAME, ("grid",), Acts.IMAGE, (None,), 0.0, rows[None], always=known.sampling_px
        )  # fmt: skip


def told(found: Found) -> list[Finding]:
    """Tell nothing: these errors are known."""
    return []
