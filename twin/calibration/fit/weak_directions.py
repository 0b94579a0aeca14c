"""Directions of parameter space that the data do not determine, by name and with advice.

A direction is a combination of parameters; its text names the parameters that trade
against each other and the data that would separate them. `certificate` decides which
directions are null or weak.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import UNITS
from flexdt.twin.geometry.told_lengths import TOLD_UNITS

TOLERANCE = {"mm": 0.2, "deg": 0.2, "1": 5e-4}
"""Unit -> standard deviation above which a parameter counts as weak: the thesis calls a
calibration successful below 0.2 (mm, deg); for angle_scale, 0.2 deg in a turn."""

BOUND = 5.0
"""Standard deviation [mm, deg] beyond which a parameter is not determined, 25 tolerances. For
angle_scale it is 5 deg in a turn."""

MAX_SHOWN = 3
"""Largest number of columns named after the first."""
_OBJECT = {"dO_x", "dO_y", "dO_z"}
_DETECTOR = {"dD_x", "dD_y", "dD_z"}
_SOURCE = {"dS_x", "dS_y"}
_TAU = {"tau_x", "tau_z"}
_AXIS_TILTS = {"axis_tilt_x", "axis_tilt_z"}
_PANEL_TILTS = {"det_pitch", "det_yaw"}
_TURNS = {"det_roll", *_AXIS_TILTS}

_Names = frozenset[str]
_ADVICE: Final[Sequence[tuple[Callable[[_Names, _Names], object], str]]] = (
    (
        lambda s, _: s & _SOURCE and s & _OBJECT and s & _DETECTOR,
        "a common shift of source, object and detector changes no image: hold the source",
    ),
    (
        lambda s, of_scans: s & _DETECTOR and of_scans & _OBJECT,
        "turning stages and detector together about the source changes (nearly) no image: "
        "give the detector a prior, or let the scans share dO_x, dO_y and dO_z",
    ),
    (
        lambda s, _: s & _TURNS and len(s & (_TURNS | _PANEL_TILTS)) > 1,
        "turning detector and axis together changes little: add placements at several "
        "lateral positions and another SOD, or hold the axis tilts",
    ),
    (
        lambda s, _: s & _DETECTOR and s & _OBJECT,
        "add a placement at another SOD (lateral moves alone hardly help)",
    ),
    (
        lambda s, _: s & _PANEL_TILTS,
        "add a placement at another SOD or a larger phantom: a tilt shows as perspective",
    ),
    (
        lambda s, _: s & _AXIS_TILTS and s & _OBJECT,
        "use beads further apart in height",
    ),
    (lambda s, _: "angle_scale" in s, "spread the frames over a whole turn"),
    (
        lambda s, _: "alpha" in s and s & _TAU,
        "use beads that do not lie on one line parallel to the axis",
    ),
    (
        lambda s, _: "dO_z" in s,
        "use a phantom with beads further apart, or more frames",
    ),
    (lambda s, _: s & _TAU, "spread the frames over a whole turn"),
)
"""Test of a direction's parameters, and of those with a value in each scan -> advice on data
that would determine it; the first that holds counts."""


@dataclass(frozen=True)
class Direction:
    """A combination of parameters that the data leave open, or nearly so.

    Attributes:
        parts: (column, change in edge units), largest share first; the first change is 1 by
            convention.
        sigma: standard deviation along the direction, in units of the first part; inf if null.
        advice: data that would determine it.
    """

    parts: tuple[tuple[str, float], ...]
    sigma: float
    advice: str

    @property
    def names(self) -> tuple[str, ...]:
        """The columns involved."""
        return tuple(name for name, _ in self.parts)

    @property
    def text(self) -> str:
        """One line for a report: a parameter against those it trades with, its sigma
        ("not determined at all" if it is not finite), and the advice; at most `MAX_SHOWN`
        others are named, the rest counted.
        """
        first, *rest = self.parts
        against = ", ".join(f"{n} ({c:+.3g} {unit_of(n)})" for n, c in rest[:MAX_SHOWN])
        if len(rest) > MAX_SHOWN:
            against += f" and {len(rest) - MAX_SHOWN} more"
        if rest:
            head = f"{first[0]} against {against}"
        else:
            head = first[0]
        if not np.isfinite(self.sigma):
            size = "not determined at all"
        else:
            size = f"sigma {self.sigma:.3g} {unit_of(first[0])}"
        if rest:
            per = f" per 1 {unit_of(first[0])}"
        else:
            per = ""
        return f"{head}{per}: {size}: {self.advice}"


def unit_of(column: str) -> str:
    """Return the edge unit of a column; bead coordinates are in mm."""
    return {**UNITS, **TOLD_UNITS}.get(column.split("@")[0], "mm")


def tolerance_of(column: str) -> float:
    """Return the standard deviation above which a column counts as weak, edge unit."""
    return TOLERANCE[unit_of(column)]


def advise(names: Sequence[str], beads: int) -> str:
    """Advise on data that would determine a direction: one sentence, of the first case
    that holds; a general one if none does.

    Args:
        names: its columns; the group (@NUMBER) matters in one case alone.
        beads: number of beads seen.
    """
    if beads < 2:
        return (
            "one bead alone fixes neither the scale nor the angle: use two or more beads"
        )
    if any(n.startswith("bead ") for n in names):
        return "measure the beads' positions, or give their tolerance as a prior"
    involved = frozenset(n.split("@")[0] for n in names)
    of_scans = frozenset(n.split("@")[0] for n in names if "@" in n)
    for concerns, advice in _ADVICE:
        if concerns(involved, of_scans):
            return advice
    return "add frames, beads or a placement at another SOD, or hold one of them"


def null_directions(
    basis: FloatArray, scale: FloatArray, names: Sequence[str], beads: int
) -> tuple[Direction, ...]:
    """Name the null space, spanned by `basis` (columns, r) of scaled columns."""
    return tuple(
        weak_direction(vector, scale, names, np.inf, beads) for vector in _sparse(basis).T
    )


def weak_direction(
    vector: FloatArray, scale: FloatArray, names: Sequence[str], sigma: float, beads: int
) -> Direction:
    """Name one direction of the column-scaled parameter space.

    Columns below a tenth of the largest share are left out. The one most uncertain
    relative to its tolerance leads, with factor 1; other factors are changes relative to
    it.

    Args:
        vector: (columns,) direction.
        scale: (columns,) column norms per edge unit: change = vector * sigma / scale.
        sigma: along the vector, scaled units; inf where it is not determined.
        beads: number of beads seen, from which the advice follows.

    Returns:
        With sigma in the lead's edge unit, and advice.
    """
    order = np.argsort(-np.abs(vector))
    involved = [int(i) for i in order if abs(vector[i]) > 0.1 * abs(vector[order[0]])]
    # The parameter that is most uncertain leads; prefer geometry over beads, detector over
    # stage.
    change = vector / scale
    lead = max(involved, key=lambda i: abs(change[i]) / tolerance_of(names[i]))
    rest = [i for i in involved if i != lead]
    parts = (
        (names[lead], 1.0),
        *((names[i], float(change[i] / change[lead])) for i in rest),
    )
    if np.isfinite(sigma):
        size = float(abs(change[lead]) * sigma)
    else:
        size = np.inf
    return Direction(parts, size, advise([n for n, _ in parts], beads))


def _sparse(basis: FloatArray) -> FloatArray:
    """Transform a basis so that each vector lacks the others' leading parameter (reduced
    echelon form, with pivots), of unit length.

    Args:
        basis: (columns, r), of rank r.

    Returns:
        A new basis (columns, r) of the same space, no longer orthogonal.
    """
    m = basis.T.copy()
    r = len(m)
    for i in range(r):
        rest = np.abs(m[i:])
        row, col = np.unravel_index(int(np.argmax(rest)), rest.shape)
        m[[i, i + int(row)]] = m[[i + int(row), i]]
        m[i] /= m[i, col]
        for j in range(r):
            if j != i:
                m[j] -= m[j, col] * m[i]
    out: FloatArray = (m / np.linalg.norm(m, axis=1, keepdims=True)).T
    return out
