"""Evidence of a gap between two tiles in single frames of a turn, near a column.

The same edges pass all borders there, a few frames later, so the other borders give the
evidence of a border without a gap, and its scatter. How visible a gap would be, the same
frames show, too: behind a gap of whole columns they are themselves without these columns.
Noise fits no gap either, but a gap in noise gains nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.interpolate import PchipInterpolator
from scipy.special import log_softmax, logsumexp, softmax

from flexdt.twin.calibration.repeated_frames import ROBUST, SCATTER_FREEDOM
from flexdt.twin.calibration.without_phantom.gaps.gradient_step import (
    gradient_steps,
    scatter_of_sums,
)
from flexdt.twin.calibration.without_phantom.gaps.mirror_steps import (
    LOG_PRIOR,
    WIDTHS_PX,
    over_widths,
    trusted,
)
from flexdt.twin.calibration.without_phantom.tile_gap import (
    SIDE,
    likelihood,
    squares_by_distance,
)
from flexdt.twin.geometry.conventions import FloatArray

BLURS_PX: Final = (0.0, 1.0)
"""Standard deviations over which a gap is smeared that are tried [px]."""
EVIDENCE_SHARES: Final = np.array([0.3, 0.65, 1.0])
"""Shares of the gap's expected evidence that blurred edges may leave."""
SHOWN_COLUMNS: Final = (1, 2)
"""Whole columns that are left out, to see how visible a gap would be: sigmas of its
evidence grow linearly with its width between them, and beyond."""
EDGE_SHARE: Final = 0.2
"""Part of all places there that is compared, those with most change."""
NOISE_QUANTILE = 0.2
NOISE_QUANTILE_POWER = 0.546
"""Quantile of the changes at a border in a row, of all frames, and its share of their mean
where they are noise (chi square of 7)."""
EDGE_NOISE: Final = 4.0
"""Changes over those of noise from which they are edges: noise has one in 10 000."""
MOST_EDGES: Final = 30_000
"""Places that are compared, at most."""
CURVED_SHARE: Final = 0.25
"""Standard deviation of a width by gradients, as a share of it: a gap moves its two sides
apart, and bodies that curve there change the gradient (drawn ones by up to that)."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence of gaps at columns.

    Attributes:
        found: logarithm of the likelihood of a gap over none by width and column, (w, c).
        width: logarithm of the likelihood of the widths of a gap that is there, (w, c).
        free: `found` without what else may look like a gap, (w, c): at which column a gap is,
            if there is one.
    """

    found: FloatArray
    width: FloatArray
    free: FloatArray

    def beside(
        self,
        more: FloatArray,
        width: FloatArray | float = 0.0,
        free: FloatArray | None = None,
    ) -> Evidence:
        """Add log likelihoods (w, c) of other data; `free`: less what resembles a gap."""
        both = more if free is None else free
        return Evidence(self.found + more, self.width + width, self.free + both)

    def trusted(self) -> Evidence:
        """Return the evidence as far as frames count, to which walls look like gaps."""
        return replace(self, found=trusted(self.found))

    @property
    def ratio(self) -> FloatArray:
        """Likelihood of a gap over none at each column, for any width, (c,)."""
        return np.asarray(np.exp(np.minimum(over_widths(self.found), 600.0)))

    @property
    def effect(self) -> FloatArray:
        """Likelihood of a gap over none at each column, (c,), widths weighted by their
        squares: as a narrow gap moves the axis little, it counts little.
        """
        log_share = log_softmax(LOG_PRIOR + 2.0 * np.log(WIDTHS_PX)[:, None], axis=0)
        whole = logsumexp(self.found + log_share, axis=0)
        return np.asarray(np.exp(np.minimum(whole, 600.0)))

    @property
    def widths(self) -> FloatArray:
        """Probabilities of the widths of a gap at each column, (w, c)."""
        return np.asarray(softmax(self.width + LOG_PRIOR, axis=0))


class Differences(NamedTuple):
    """Differences of neighboring columns about borders, and those that count.

    Attributes:
        around: (m, c, 2 SIDE - 1) in m rows of frames.
        power: their sums of squares, (m, c).
        places: those that change most, (m, c).
        edges: the places whose change noise does not explain, (m, c).
        least: power from which they are places.
    """

    around: FloatArray
    power: FloatArray
    places: npt.NDArray[np.bool_]
    edges: npt.NDArray[np.bool_]
    least: float

    @classmethod
    def of(
        cls, around: FloatArray, frames: int, least: float | None = None
    ) -> Differences:
        """Select the places and edges among differences.

        Args:
            around: (m, c, 2 SIDE - 1).
            frames: number of frames, of m / frames rows each.
            least: power of places; None: of the `EDGE_SHARE`, at most `MOST_EDGES`, that
                change most.
        """
        power = np.square(around).sum(axis=2)
        if least is None:
            share = min(EDGE_SHARE, MOST_EDGES / power.size)
            least = float(np.quantile(power, 1.0 - share))
        places = power > least
        of_rows = power.reshape(frames, -1)
        noise = np.quantile(of_rows, NOISE_QUANTILE, axis=0) / NOISE_QUANTILE_POWER
        edges = places & (of_rows > EDGE_NOISE * noise).reshape(power.shape)
        return cls(around, power, places, edges, least)

    def taken(self, edges: bool, frames: int) -> Taken:
        """Take the edges, or else all places, of a number of frames."""
        row, border = np.nonzero(self.edges if edges else self.places)
        root = np.sqrt(self.power[row, border])
        return Taken(
            self.around[row, border] / root[:, None],
            row * frames // len(self.power),
            border,
        )


class Taken(NamedTuple):
    """Differences that count, each row at its own scale.

    Attributes:
        steps: of neighboring columns, of power 1, (k, 2 SIDE - 1).
        frame, border: of each, (k,).
    """

    steps: FloatArray
    frame: npt.NDArray[np.intp]
    border: npt.NDArray[np.intp]


class Compared(NamedTuple):
    """Differences, and how likely they are without a gap.

    Attributes:
        taken: those that count.
        of_distance: mean square of the difference of columns by their distance.
        without: log likelihood of each without a gap, (k,).
    """

    taken: Taken
    of_distance: PchipInterpolator
    without: FloatArray

    @classmethod
    def of(cls, taken: Taken, of_distance: PchipInterpolator) -> Compared:
        """Compute the likelihood without a gap."""
        return cls(taken, of_distance, likelihood(taken.steps, of_distance, 0.0))

    def gain(self, width: float, blur: float) -> FloatArray:
        """Compute log likelihoods of a gap over none, (k,). `width` and `blur`: of the gap
        [px]."""
        of_gap = likelihood(self.taken.steps, self.of_distance, width, blur)
        return of_gap - self.without

    def gains(self, width: float, blur: float, shape: tuple[int, int]) -> FloatArray:
        """Sum up `gain` by frame and border, in a table of that shape."""
        place = self.taken.frame * shape[1] + self.taken.border
        table = np.bincount(place, self.gain(width, blur), shape[0] * shape[1])
        return np.asarray(table.reshape(shape), dtype=np.float64)


def frame_evidence(images: FloatArray) -> Evidence:
    """Judge gaps by single frames.

    The places with most change tell whether there is a gap, and so do the edges among
    them, in which noise has no part. The larger evidence of both counts, and that of
    gradients in smooth places (`gradient_steps`) is added.

    Args:
        images: frames of columns about the axis, (n, rows, c + 2 SIDE - 1).

    Returns:
        By width and border, (w, c).
    """
    frames = len(images)
    table = (images - images.mean(axis=0)).reshape(-1, images.shape[2])
    here = Differences.of(_about_borders(table, 0), frames)
    behind = [
        Differences.of(_about_borders(table, gap), frames, here.least)
        for gap in SHOWN_COLUMNS
    ]
    of_places, of_edges = (
        _evidence_of(
            here.taken(edges, frames),
            [one.taken(edges, frames) for one in behind],
            (frames, here.power.shape[1]),
            evenly=not edges,
        )
        for edges in (False, True)
    )
    smooth = gradient_steps(here.around, _is_smooth(here), frames)
    of_smooth = evidence_of_widths(smooth.width, smooth.sigma, CURVED_SHARE)
    found = np.maximum(of_places.found, of_edges.found) + of_smooth
    return Evidence(found, of_places.width + of_smooth, found)


def _about_borders(table: FloatArray, gap: int) -> FloatArray:
    """Return differences of neighboring columns about borders, (m, c - gap, 2 SIDE - 1).

    `gap` columns, which a gap there would hide, are left out.
    """
    border = np.arange(SIDE, table.shape[1] - SIDE + 1 - gap)
    beside = np.arange(2 * SIDE)
    columns = border[:, None] + beside - SIDE + gap * (beside >= SIDE)
    return np.diff(table[:, columns], axis=2)


def _is_smooth(here: Differences) -> npt.NDArray[np.bool_]:
    """Mark (m, c) all but the places that change most across the border.

    What both sides share does not count: noise and gaps stay the same in the places left.
    """
    around = here.around
    apart = around[:, :, SIDE:] - around[:, :, SIDE - 2 :: -1]
    change = np.square(apart).sum(axis=2)
    return np.asarray(change <= np.quantile(change, 1.0 - here.places.mean()))


def _evidence_of(
    here: Taken, behind: Sequence[Taken], shape: tuple[int, int], evenly: bool
) -> Evidence:
    """Judge gaps by differences of neighboring columns, for all WIDTHS_PX; likelihoods of
    a gap are averaged over BLURS_PX.

    Args:
        here: the differences.
        behind: those with each of SHOWN_COLUMNS left out.
        shape: numbers of frames and of borders.
        evenly: as much is expected at each border; else by the number that counts.

    Returns:
        By width and border: the evidence of a gap, and of its width, which counts less
        where the model fits badly (`_trust`); zeros if no difference counts.
    """
    if not len(here.border):
        return Evidence(*np.zeros((3, len(WIDTHS_PX), shape[1])))
    count = np.bincount(here.border, minlength=shape[1]).astype(np.float64)
    passed = np.full(shape[1], count.mean()) if evenly else count
    of_distance = squares_by_distance(here.steps)
    own, *left_out = (Compared.of(one, of_distance) for one in (here, *behind))
    of_gap, of_width = [], []
    for blur in BLURS_PX:
        gains = [
            _usual_gain(own.gains(width, blur, shape), passed)
            for width in WIDTHS_PX.tolist()
        ]
        shown = _shown(gains, left_out, blur)
        found = [_found(one, z) for one, z in zip(gains, shown, strict=True)]
        trust = min(_trust(one, z, passed) for one, z in zip(gains, shown, strict=True))
        of_gap.append(np.array(found))
        of_width.append(trust * np.array([one.whole for one in gains]))
    both = np.logaddexp.reduce(of_gap, axis=0) - math.log(len(BLURS_PX))
    return Evidence(both, np.logaddexp.reduce(of_width, axis=0), both)


class Gain(NamedTuple):
    """Log likelihood of gaps of one width over none, at each border, (c,).

    Attributes:
        whole: the sum over all differences that count.
        usual: that of a border without a gap that as many pass.
        spread: its standard deviation, by the other borders and by frames.
    """

    whole: FloatArray
    usual: FloatArray
    spread: FloatArray

    @property
    def excess(self) -> FloatArray:
        """Excess over the usual, in standard deviations, (c,)."""
        return (self.whole - self.usual) / self.spread


def _usual_gain(gains: FloatArray, passed: FloatArray) -> Gain:
    """Compare each border with the others.

    Args:
        gains: in log likelihood of a gap over none, by frame and border, (n, c).
        passed: differences that count at each border, (c,); one above 0 at least.
    """
    whole = gains.sum(axis=0)
    some = passed > 0.0
    usual = float(np.median(whole[some] / passed[some])) * passed
    own = np.sqrt(np.maximum(passed, 1.0))
    between = ROBUST * float(np.median((np.abs(whole - usual) / own)[some]))
    of_frames = float(np.median((scatter_of_sums(gains) / own)[some]))
    return Gain(whole, usual, max(between, of_frames, 1e-6) * own)


def _shown(gains: Sequence[Gain], behind: Sequence[Compared], blur: float) -> FloatArray:
    """Estimate the excess of each border if there were a gap, in standard deviations.

    Args:
        gains: of WIDTHS_PX.
        behind: the differences with each of SHOWN_COLUMNS left out.
        blur: of the model of a gap [px].

    Returns:
        By width and border, (w, c), 0 or more.
    """
    places = len(gains[0].whole)
    known = [np.zeros(places)]
    for width, compared in zip(SHOWN_COLUMNS, behind, strict=True):
        null = gains[int(np.abs(WIDTHS_PX - width).argmin())]
        whole = np.bincount(compared.taken.border, compared.gain(width, blur), places)
        # A gap at the last borders would hide columns that are not there.
        whole[-width:] = whole[-width - 1]
        known.append(np.maximum((whole - null.usual) / null.spread, 0.0))
    at = (0, *SHOWN_COLUMNS)
    shares = np.array([np.interp(WIDTHS_PX, at, one) for one in np.eye(len(at))])
    return np.asarray(shares.T @ np.array(known))


def _found(gain: Gain, shown: FloatArray) -> FloatArray:
    """Compute log likelihoods of a gap over none by the excess of each border, (c,).

    Positive evidence is for a gap; it is against one as far as the excess is short of what a gap
    would show.
    `gain`: of gaps of a width; `shown`: excess behind such a gap, (c,)."""
    excess = gain.excess
    short = np.minimum(excess - EVIDENCE_SHARES[:, None] * shown, 0.0)
    of_gap = np.logaddexp.reduce(log_student(short), axis=0)
    of_none = log_student(np.maximum(excess, 0.0))
    return np.asarray(of_gap - math.log(len(EVIDENCE_SHARES)) - of_none)


def _trust(gain: Gain, shown: FloatArray, passed: FloatArray) -> float:
    """Compute the part of a gain that the scatter `shown` (c,) behind it justifies."""
    return min(float(np.median((shown / gain.spread)[passed > 0.0])), 1.0)


def log_student(deviation: FloatArray) -> FloatArray:
    """Return the logarithm of Student's density but for a constant."""
    return np.asarray(
        -(SCATTER_FREEDOM + 1.0) / 2.0 * np.log1p(np.square(deviation) / SCATTER_FREEDOM)
    )


def evidence_of_widths(
    width: FloatArray, sigma: FloatArray, share: float = 0.0
) -> FloatArray:
    """Compute log likelihood ratios (w, c) of gaps of each width to none (Student).

    From widths [px] measured at c columns; `share`: sigma that a gap adds, per width.
    """
    of_gap = np.hypot(sigma, share * WIDTHS_PX[:, None])
    left = (width - WIDTHS_PX[:, None]) / of_gap
    none = log_student(width / sigma) - np.log(sigma)
    return np.asarray(log_student(left) - np.log(of_gap) - none)
