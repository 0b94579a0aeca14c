"""A cause of residuals, what is known of it before a scan, and what a fit has found."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

from flexdt.twin.calibration.fit.evidence import LOG_CHANCE, NAMED_LOG_ODDS
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.fit.problem import Strain
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.panel import Border

SHAPES: Final = ("stretch", "shear")
"""The causes of a phantom of another shape."""
MOTION_OF: Final = "motion of "
APART: Final = " between scans"
"""End of the name of a motion from scan to scan."""
REPEATING: Final = "errors of spots"
"""The cause that each bead's spots have errors of their own, smooth in the angle."""
TOLD: Final = "told "
"""Begin of the cause that a told length is quite another."""
RIVALS: Final = (MOTION_OF, REPEATING, TOLD, "priors")
"""Causes that only compete: they are followed elsewhere."""


@dataclass(frozen=True)
class Cause:
    """A cause that a scan may have.

    Attributes:
        name: of the cause.
        columns: of the table that it adds; empty for the widths of the priors.
        widths: of its columns that are tried.
        chance: logarithm of its probability before the scan is seen.
        always: width that it has where it is not chosen; 0: its columns are left out.
    """

    name: str
    columns: tuple[int, ...]
    widths: tuple[float, ...]
    chance: float = LOG_CHANCE
    always: float = 0.0


Choice = tuple[float, ...]
"""Width of each cause of a table; 0: not chosen."""


@dataclass(frozen=True)
class Found:
    """The causes of a fit.

    Attributes:
        odds: logarithm of the odds of each cause, by name; borders by their place.
        applied: names of causes that are columns of the fit.
        open: names of causes that the data neither show nor exclude.
        strain: of the phantom, (9,) and its covariance (9, 9); None: it is not judged.
        beside_motion: the fit with causes that are likely where something moves, too, and
            those causes; None where that is not so.
    """

    odds: dict[str, float] = field(default_factory=dict)
    applied: tuple[str, ...] = ()
    open: tuple[str, ...] = ()
    strain: tuple[FloatArray, FloatArray] | None = None
    beside_motion: tuple[FitResult, Found] | None = None

    def named(self, name: str) -> bool:
        """Check whether a cause of the fit is beyond doubt."""
        return name in self.applied and self.odds.get(name, -math.inf) > NAMED_LOG_ODDS


@dataclass(frozen=True, eq=False)
class Known:
    """Statements on the phantom and the positions.

    Attributes:
        strain: priors of the phantom's stretches and shears, 0: it has its stated shape.
        bead_tolerance_mm: of the request; None: unknown, 0: beads are at their stated
            places.
        floor: least standard deviation of whitened residuals.
        arc: part of a step that the object turns in an exposure, by the script, 0: it is
            at rest; None: not stated.
        arc_left: standard deviation of the squared share of a step of which the positions
            are not those of the middle of an exposure, by the spots' smear; None: the arc was
            not measured.
        limits: largest standard deviation of causes (`stated_causes`), 0: excluded.
    """

    strain: Strain
    bead_tolerance_mm: float | None
    floor: float
    arc: float | None = None
    arc_left: float | None = None
    limits: Mapping[str, float] = field(default_factory=dict)


Refit = Callable[..., FitResult]
"""Fits again with more parameters free: options of `fits_of_scans.refit_scans`."""


def border_name(border: Border) -> str:
    """Name the cause that a tile begins at a border."""
    return f"tile from {('column', 'row')[border.axis]} {border.at:.0f}"


def with_pick(choice: Choice, i: int, pick: float) -> Choice:
    """Return a choice with another width of one cause."""
    return (*choice[:i], pick, *choice[i + 1 :])
