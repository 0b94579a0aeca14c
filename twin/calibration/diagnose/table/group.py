"""Groups of columns that a cause adds to the geometry's, and what makes them."""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.fit.priors import (
    LOG_CHANCE,
    NAMED_LOG_ODDS,
    OPEN_LOG_ODDS,
)
from flexdt.twin.calibration.fit.problem import Strain
from flexdt.twin.geometry.conventions import FloatArray

NEVER: Final = -1e6
"""Logarithm of the odds of a group that is no answer by itself."""

__all__ = [
    "LOG_CHANCE",
    "NAMED_LOG_ODDS",
    "NEVER",
    "OPEN_LOG_ODDS",
    "Acts",
    "Family",
    "Found",
    "Known",
    "Seen",
]


class Acts(enum.Enum):
    """On what the weights of a group act, so that the table can be made again with them."""

    COLUMNS = "columns of the fit"
    FRAMES = "parameters of single frames"
    IMAGE = "places in the image"


@dataclass(frozen=True)
class Pitch:
    """A pixel pitch that a freed distance of the panel may hide.

    Attributes:
        share: probability that it is wrong.
        sigma: standard deviation of it over the told one, with that probability.
        distance_mm: standard deviation of the distance by the scanners.
    """

    share: float
    sigma: float
    distance_mm: float


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
        sampling_px: standard deviation of errors that follow a spot's place in the pixel grid.
        limits: largest standard deviation of causes (`stated_causes`), 0: excluded.
        exact: parameters that are stated to be exactly known.
        asked: parameters that may differ from frame to frame.
        pitch: of the pixels, that a freed distance hides; None: there is none.
    """

    strain: Strain
    bead_tolerance_mm: float | None
    floor: float
    arc: float | None = None
    arc_left: float | None = None
    sampling_px: float = 0.0
    limits: Mapping[str, float] = field(default_factory=dict)
    exact: frozenset[str] = frozenset()
    asked: tuple[str, ...] = ()
    pitch: Pitch | None = None


@dataclass(frozen=True, eq=False)
class Family:
    """Groups of one cause that have the same number of columns.

    Columns are either rows of the table, or slopes of frames times courses over the frames.

    Attributes:
        cause: name of the cause.
        names: of the g groups.
        acts: what their weights change.
        places: of each group, what it is about: columns of the fit for `Acts.COLUMNS`, the
            (parameter, factor) pairs for `Acts.FRAMES`, numbers for sentences for
            `Acts.IMAGE`.
        chance: logarithm of the odds of each group before the scan is seen, (g,) or of all.
        rows: (g, 2 n k, c) of the table; None with slopes.
        slopes: (p, s) numbers of slopes of the table; None with rows.
        courses: (m, s, n, c) of each slope over the frames: the g = m p groups are each course
            with each of the slopes, in this order.
        widest: largest width of a weight [its own unit], (g,) or of all.
        always: width that always holds, so that the group is no question; 0: it is one.
        root: (q, c) what each weight does to the q places of `Acts.COLUMNS`, where these do not
            change by themselves; None: each is one.
    """

    cause: str
    names: tuple[str, ...]
    acts: Acts
    places: tuple[object, ...]
    chance: float | FloatArray
    rows: FloatArray | None = None
    slopes: npt.NDArray[np.intp] | None = None
    courses: FloatArray | None = None
    widest: float | FloatArray = math.inf
    always: float = 0.0
    root: FloatArray | None = None

    @property
    def chances(self) -> FloatArray:
        """Logarithm of the odds of each group before the scan is seen, (g,)."""
        return np.broadcast_to(np.asarray(self.chance), len(self.names))

    @property
    def reach(self) -> FloatArray:
        """Root mean square over its frames of each group's course, of weights that are normal
        with a width of 1, (g,); 1e-150 at least.
        """
        assert self.courses is not None
        assert self.slopes is not None
        square = (self.courses[:, 0] ** 2).sum(axis=2)
        frames = np.maximum((square > 0).sum(axis=1), 1)
        size = np.sqrt(square.sum(axis=1) / frames) + 1e-150
        return np.repeat(size, len(self.slopes))

    def at_places(self, weights: FloatArray) -> FloatArray:
        """Return what weights, (c, ...), do to the places of `Acts.COLUMNS`, (q, ...)."""
        return weights if self.root is None else np.asarray(self.root @ weights)


@dataclass(frozen=True, eq=False)
class Seen:
    """A group that is there.

    Attributes:
        name: of the group.
        cause: of its family.
        place: what it is about, see `Family`.
        odds: logarithm of the odds that it is there.
        weights: in the group's own unit.
        courses: (s, n) of its slopes over the frames; None of rows.
        effect_px: root mean square of the shift of the positions that it makes, less what the
            geometry would take up of it [px].
    """

    name: str
    cause: str
    place: object
    odds: float
    weights: FloatArray
    courses: FloatArray | None
    effect_px: float

    @property
    def place_number(self) -> int | None:
        """The number that ends its name, such as a bead's; None without one."""
        last = self.name.split(" ")[-1]
        return int(last) if last.isdigit() else None


@dataclass(frozen=True, eq=False)
class Found:
    """What a table has found, for sentences.

    Attributes:
        fit: with the groups that are there.
        seen: those groups, in the order of their effect.
        open: words on causes that are neither shown nor excluded.
        strain: of the phantom, (10,) in the order of STRAINS, and its covariance; None: its
            shape is exact.
        known: with what the table was made.
        movers: probability of each set of what moves, where motion is followed.
    """

    fit: FitResult
    seen: tuple[Seen, ...]
    open: tuple[str, ...]
    strain: tuple[FloatArray, FloatArray] | None
    known: Known
    movers: Mapping[frozenset[str], float] = field(default_factory=dict)

    def of(self, cause: str) -> list[Seen]:
        """List the groups of a cause that are there, beyond doubt."""
        return [s for s in self.seen if s.cause == cause and s.odds > NAMED_LOG_ODDS]
