"""Bend: the phantom is bent, twisted or warped, smoothly over its own size.

A bend leaves the mean of the beads where it is, and their mean turn about the axis: what it does
beside that is tau, dO and alpha (see `strain`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.calibration.diagnose.table.group import (
    LOG_CHANCE,
    Acts,
    Family,
    Found,
    Known,
)
from flexdt.twin.calibration.diagnose.table.groups.bead_places import MOST_STRAINED
from flexdt.twin.calibration.diagnose.table.groups.strain import WIDEST
from flexdt.twin.calibration.diagnose.table.linearised import Linearised
from flexdt.twin.findings import Finding, warning
from flexdt.twin.geometry.conventions import FloatArray

NAME: Final = "bend"
WORDS: Final = "a bent phantom"
KINDS: Final = 1 + 1 + 3
"""Of bends, equally likely: everywhere, of a rod, and a twist about each axis."""
ROUNDING: Final = 1e-9
"""Part of a displacement's variance that keeps the displacements of near beads apart."""


def families(table: Linearised, known: Known) -> Iterator[Family]:
    """Make a phantom's bend: beads are displaced together, as they are near each other.

    The displacement is a normal process in space that is the same everywhere and in every
    direction; or, of a rod, one that changes along the phantom's length alone; or a twist about
    some line. Weights are root mean squares of slopes; what is an affine map
    alone is `strain`.
    """
    if known.bead_tolerance_mm == 0 or table.k <= MOST_STRAINED:
        return
    model = table.problem.model
    columns = table.problem.layout.bead_columns
    places = np.arange(columns.start, columns.stop)
    for name, fields in _kinds(model):
        root = _without_place(model, fields)
        yield Family(
            NAME, (name,), Acts.COLUMNS, (places,), LOG_CHANCE - math.log(KINDS),
            (table.columns[:, columns] @ root)[None], widest=WIDEST, root=root,
        )  # fmt: skip


def _kinds(model: BeadModel) -> Iterator[tuple[str, npt.NDArray[np.floating]]]:
    """Yield each bend's name and displacements, (3 k, c)."""
    axes = np.eye(3)
    yield NAME, np.kron(_smooth(model.beads), axes)
    long = int(np.argmax(np.ptp(model.beads, axis=0)))
    yield f"{NAME} of a rod", np.kron(_smooth(model.beads[:, [long]]), axes)
    for i, axis in enumerate(axes):
        yield f"twist about {'xyz'[i]}", _twist(model, axis)


def _without_place(model: BeadModel, fields: npt.NDArray[np.floating]) -> FloatArray:
    """Take what moves all beads together, and turns them about the axis, out of displacements
    (3 k, c).
    """
    turned = np.cross([0.0, 0.0, 1.0], model.about_middle)
    whole = np.column_stack([np.tile(np.eye(3), (len(model), 1)), turned.ravel()])
    basis, _ = np.linalg.qr(whole)
    return np.asarray(fields - basis @ (basis.T @ fields))


def _smooth(beads: FloatArray) -> FloatArray:
    """Compute a root of the covariance of the beads' displacements along an axis [mm^2] by
    slopes of 1 rms, (k, k): normal in their distance, of a length that is the phantom's size.
    """
    size = float(np.ptp(beads, axis=0).max())
    apart2 = ((beads[:, None] - beads) ** 2).sum(axis=2)
    kernel = np.exp(-0.5 * apart2 / size**2) + ROUNDING * np.eye(len(beads))
    return np.asarray(size * np.linalg.cholesky(kernel))


def _twist(model: BeadModel, axis: FloatArray) -> FloatArray:
    """Compute displacements of the beads [mm] by a twist about an axis through their middle,
    (3 k, 1): slopes of 1 at their usual distance. About another line it is this and a shear.
    """
    beads = model.about_middle
    field = (beads @ axis)[:, None] * np.cross(axis, beads) / model.reach
    return np.asarray(field.reshape(-1, 1))


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
