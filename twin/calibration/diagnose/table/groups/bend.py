"""Bend: the phantom is bent, twisted or warped, smoothly over its own size."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.calibration.diagnose.table.group import (
    LOG_CHANCE,
    Acts,
    Family,
    Found,
    Known,
)
from flexdt.twin.calibration.diagnose.table.groups import strain
from flexdt.twin.calibration.diagnose.table.groups.bead_places import MOST_STRAINED
from flexdt.twin.calibration.diagnose.table.groups.strain import WIDEST
from flexdt.twin.calibration.diagnose.table.linearised import Linearised
from flexdt.twin.findings import Finding, warning
from flexdt.twin.geometry.conventions import FloatArray

NAME: Final = "bend"
WORDS: Final = "a bent phantom"
KINDS: Final = 3 + 2
"""Of bends, equally likely: everywhere, along an axis, and a twist about each."""
OFF_ITS_FILE: Final = frozenset({strain.NAME, NAME})
"""Causes of a phantom that is shown not to be as its file says: it may be bent besides."""
ROUNDING: Final = 1e-9
"""Part of a displacement's variance that keeps the displacements of near beads apart."""


def families(table: Linearised, known: Known) -> Iterator[Family]:
    """Make a phantom's bend: beads are displaced together, as they are near each other.

    The displacement is a normal process in space that is the same everywhere and in every
    direction, or along one axis across the phantom's length; or a twist about some line. None
    of them is about a point of the phantom that is known, so that its place is as open as its
    bend is large. Weights are root mean squares of slopes; what is an affine map alone is
    `strain`.
    """
    if known.bead_tolerance_mm == 0 or table.k <= MOST_STRAINED:
        return
    stated = max(known.strain)
    first = table.problem.layout.bead_columns.start
    columns = first + np.arange(3 * table.k)
    beads = table.problem.model.beads
    smooth = _smooth(beads)
    every = np.asarray(np.kron(smooth, np.eye(3)), dtype=np.float64)
    yield _family(table, stated, (NAME,), [columns], every)
    across = np.argsort(np.ptp(beads, axis=0))[:2]  # Bodies bend across their length.
    along = tuple(f"{NAME} along {'xyz'[i]}" for i in across)
    yield _family(
        table, stated, along, [columns.reshape(-1, 3)[:, i] for i in across], smooth
    )
    for axis in "xyz":
        yield _family(
            table, stated, (f"twist about {axis}",), [columns], _twist(beads, axis)
        )


def _family(
    table: Linearised,
    stated: float,
    names: tuple[str, ...],
    places: Sequence[npt.NDArray[np.intp]],
    root: FloatArray,
) -> Family:
    """Make groups that displace beads' coordinates by a root, (q, c)."""
    rows = np.stack([table.columns[:, own] @ root for own in places])
    chance = LOG_CHANCE - math.log(KINDS * len(names))
    return Family(
        NAME, names, Acts.COLUMNS, tuple(places), chance, rows, widest=WIDEST,
        narrowest=stated, beside=OFF_ITS_FILE, root=root,
    )  # fmt: skip


def _smooth(beads: FloatArray) -> FloatArray:
    """Compute a root of the covariance of the beads' displacements along an axis [mm^2] by
    slopes of 1 rms, (k, k): normal in their distance, of a length that is the phantom's size.
    """
    size = float(np.ptp(beads, axis=0).max())
    apart2 = ((beads[:, None] - beads) ** 2).sum(axis=2)
    kernel = np.exp(-0.5 * apart2 / size**2) + ROUNDING * np.eye(len(beads))
    return np.asarray(size * np.linalg.cholesky(kernel))


def _twist(beads: FloatArray, axis: str) -> FloatArray:
    """Compute displacements of the beads [mm] by a twist about an axis, and by where its line
    and its rest are, which are like beads, (3 k, 5): slopes of 1 at their usual distance.
    """
    along = np.eye(3)["xyz".index(axis)]
    usual = math.sqrt(float((beads**2).sum(axis=1).mean()))
    aside = np.delete(np.eye(3), "xyz".index(axis), axis=0)
    at = beads @ along
    fields = [
        at[:, None] * np.cross(along, beads) / usual,
        *(at[:, None] * one for one in aside),
        *(usual * np.ones_like(beads) * one for one in aside),
    ]
    return np.stack([field.ravel() for field in fields], axis=1)


def told(found: Found) -> list[Finding]:
    """Tell how far the beads of a bent phantom are off their model."""
    if not found.of(NAME):
        return []
    moved = np.linalg.norm(found.fit.beads - found.fit.problem.model.beads, axis=1)
    return [
        warning(
            CalibrationCode.PHANTOM_STRAINED,
            f"the phantom is bent: its beads lie {1000 * float(moved.max()):.0f} um off their "
            "file. Its shape was fitted, and its place (tau) is as uncertain; measure it, or "
            "take another",
        )
    ]
