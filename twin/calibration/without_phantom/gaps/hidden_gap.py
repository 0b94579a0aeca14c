"""A gap between two tiles that both ends of rays do not reveal.

Within some columns of the axis, and where no structure that turns is seen nearer to the
axis, a gap moves both ends of all rays alike: it looks like another axis, half of its
width aside. Only single frames across the border itself reveal it. The same edges pass
all borders there, a few frames later, so the other borders give the evidence of a border
without a gap, its scatter, and the visibility of a gap. The mean over the turn tells such
gaps too, where a wall or a round body is nearer to the axis than all that turns
(`mirror_steps.py`). A gap that would be visible and is not is excluded; the width of the
others stays in the column's sigma.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.ndimage import maximum_filter1d
from scipy.special import softmax

from flexdt.twin.calibration.repeated_frames import ROBUST
from flexdt.twin.calibration.without_phantom.conjugate_rays import (
    ConjugateRays,
    Profile,
)
from flexdt.twin.calibration.without_phantom.gaps.gradient_step import (
    gradient_steps,
    scatter_of_sums,
)
from flexdt.twin.calibration.without_phantom.gaps.mirror_steps import (
    LOG_PRIOR,
    REPORTED_ODDS,
    WIDTHS_PX,
    MirrorSteps,
    over_widths,
    trusted,
)
from flexdt.twin.calibration.without_phantom.gaps.turn_modes import (
    ModeSteps,
    mode_steps,
)
from flexdt.twin.calibration.without_phantom.tile_gap import (
    SIDE,
    Gap,
    likelihood,
    local_sigma,
    squares_by_distance,
)
from flexdt.twin.geometry.conventions import Float32Array, FloatArray

CHANCE: Final = 0.05
"""Probability that a panel has a gap at one of the columns where it is hidden; assumed: most
panels are one piece, or their gaps are closed by the camera."""
OPEN_SHARE: Final = 0.5
"""Part of the width of gaps that a gap that is not excluded leaves open at least: the width
times the root of its probability covers no gap."""
BLURS_PX: Final = (0.0, 1.0)
"""Standard deviations over which a gap is smeared that are tried [px]."""
EVIDENCE_SHARES: Final = np.array([0.3, 0.65, 1.0])
"""Shares of the gap's expected evidence that blurred edges may leave."""
SCATTER_FREEDOM: Final = 8.0
"""Degrees of freedom of the scatter of evidence (Student): a third of the fewest borders."""
LEAST_COLUMNS: Final = 14
"""Columns on each side of the axis whose borders are compared, at least."""
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
OUTLINE_COLUMNS: Final = 1
"""By so many columns the two sides of an outline may differ from mirror images."""
CURVED_SHARE: Final = 0.25
"""Standard deviation of a width by gradients, as a share of it: a gap moves its two sides
apart, and bodies that curve there change the gradient (drawn ones by up to that)."""
MODES_SHARE: Final = 0.3
"""Standard deviation of a width by the modes of the turn, as a share of it: it is that of a
small displacement (drawn gaps of 1 to 2 px by up to that)."""
MIN_HIDDEN_PX: Final = 0.3
"""Width of gaps that are not hidden where both ends of rays determine steps to a third of
it [px]."""
SIGMAS: Final = 3.0
"""Standard deviations from which a step is significant."""


class HiddenGap(NamedTuple):
    """A possible gap near the axis.

    Attributes:
        first, last: columns at which it may begin.
        chance: probability that there is one.
        width_px: root mean square of its width, no gap included, and at least OPEN_SHARE of a
            usual gap's where it is not excluded [px].
        likely: the gap, where its odds exceed REPORTED_ODDS.
        open: whether the images do not exclude it: the odds against one are below
            REPORTED_ODDS, or a gap at one of the columns explains them better than none.
    """

    first: int
    last: int
    chance: float
    width_px: float
    likely: Gap | None
    open: bool

    @property
    def column_px(self) -> float:
        """Standard deviation that it adds to the axis column [px]."""
        return self.width_px / 2.0


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
        """Add log likelihoods (w, c) of other data.

        Args:
            more: of a gap over none.
            width: of the widths of a gap; 0: the data do not determine them.
            free: of a gap over none, without what else looks like one; None: `more`.
        """
        both = more if free is None else free
        return Evidence(self.found + more, self.width + width, self.free + both)

    def trusted(self) -> Evidence:
        """Return the evidence as far as single frames count: a wall passes for a gap to
        them (`trusted`).
        """
        return replace(self, found=trusted(self.found))

    @property
    def ratio(self) -> FloatArray:
        """Likelihood of a gap over none at each column, for any width, (c,)."""
        return np.asarray(np.exp(np.minimum(over_widths(self.found), 600.0)))

    @property
    def widths(self) -> FloatArray:
        """Probabilities of the widths of a gap at each column, (w, c)."""
        return np.asarray(softmax(self.width + LOG_PRIOR, axis=0))


def hidden_gap(
    frames: Sequence[Float32Array],
    axis: float,
    profile: Profile | None,
    smoothing: float,
    rays: ConjugateRays | None = None,
    of_mean: MirrorSteps | None = None,
) -> HiddenGap | None:
    """Judge the gaps between panel tiles that both ends of rays do not reveal: near the
    axis, and beyond what turns.

    Compared are the likelihoods by single frames, by both ends of rays and by the mean's
    symmetry, without those that outlines explain, with a prior of `CHANCE`. The modes of
    the turn are looked at where these leave a gap open.

    Args:
        frames: line integrals of `tile_gap.averaged_rows`, some of a turn.
        axis: column of the axis, to a pixel or two.
        profile: distances between both ends of rays; None: too little of the object
            turns.
        smoothing: sigma of the columns' smoothing in the profile [px].
        rays: of the turn, whose angular modes are compared; None: frames alone.
        of_mean: evidence of the mean, of WIDTHS_PX; None: none.

    Returns:
        The range of columns in which one may be hidden, its probability, its root mean
        square width (a share `OPEN_SHARE` of the usual width at least, where it is
        `open`), and the likeliest gap if its odds exceed
        `REPORTED_ODDS`; None for images of too few columns about the axis.
    """
    if profile:
        reach = _hidden_radius(profile, smoothing)
    else:
        reach = math.inf
    stack = np.asarray(frames, dtype=np.float64)
    rim = np.empty(0, dtype=np.intp)
    if of_mean is not None and profile is not None:
        rim = _shown_at_rim(of_mean, axis, profile)
    far = float(np.abs(rim - 0.5 - axis).max(initial=reach))
    judged = _judged_about(stack, axis, far)
    if judged is None:
        return None
    columns, evidence = judged
    beside = columns.astype(np.float64) - 0.5 - axis
    # An outline explains evidence of a gap; it is none against one.
    outlines = np.minimum(
        _of_outlines(evidence.found, beside), np.maximum(evidence.found, 0.0)
    )
    evidence = evidence.beside(-outlines)
    if of_mean is not None:
        evidence = evidence.trusted().beside(
            of_mean.found[:, columns], of_mean.free[:, columns], of_mean.free[:, columns]
        )
    hidden = (np.abs(beside) <= reach) | np.isin(columns, rim)
    if rays is not None and not _is_excluded(evidence.ratio[hidden]):
        steps = mode_steps(rays, axis, far)
        if steps is not None:
            of_modes = _of_modes(columns, steps)
            if of_mean is None:
                evidence = evidence.trusted()
            evidence = evidence.beside(of_modes, of_modes)
    if profile is not None:
        of_rays = _evidence_of_rays(columns, axis, profile)
        at_rim = np.abs(beside) > profile.last
        certain = np.where(at_rim, trusted(of_rays), of_rays)
        evidence = evidence.beside(certain, free=of_rays)
    if of_mean is not None and profile is not None:
        evidence = _beside_told(columns, evidence, hidden, axis, profile, of_mean)
    ratio = evidence.ratio * hidden
    odds = CHANCE / (1.0 - CHANCE) * ratio / hidden.sum()
    total = float(odds.sum())
    # Many columns that exclude a gap say nothing about one that does not.
    open_gap = total * REPORTED_ODDS > 1.0 or float(ratio.max()) > 1.0
    wide = np.square(WIDTHS_PX) + np.square(local_sigma(WIDTHS_PX))
    # Blurred and noisy edges tell that there is a gap better than how wide it is.
    doubted = 0.5 * (evidence.widths + np.exp(LOG_PRIOR))
    mean_square = float(odds @ (wide @ doubted)) / (1.0 + total)
    if open_gap:
        usual = float(wide @ np.exp(LOG_PRIOR[:, 0]))
        mean_square = max(mean_square, OPEN_SHARE**2 * usual)
    shown = columns[hidden]
    best = int(odds.argmax())
    near = hidden & (odds > odds[best] / REPORTED_ODDS)
    best = int(np.where(near, over_widths(evidence.free), -math.inf).argmax())
    return HiddenGap(
        int(shown[0]),
        int(shown[-1]),
        total / (1.0 + total),
        math.sqrt(mean_square),
        _gap_at(int(columns[best]), evidence.widths[:, best])
        if total > REPORTED_ODDS
        else None,
        open_gap,
    )


def _judged_about(
    stack: FloatArray, middle: float, reach: float
) -> tuple[npt.NDArray[np.intp], Evidence] | None:
    """Judge the borders about a column by single frames.

    Args:
        stack: line integrals, (n, rows, cols).
        middle: column.
        reach: distance from it up to which borders are judged, LEAST_COLUMNS at least [px].

    Returns:
        First columns beyond the borders, (c,), and their evidence; None for too few columns.
    """
    half = max(float(LEAST_COLUMNS), reach) + SIDE
    low = math.floor(max(middle - half, 0.0))
    end = math.ceil(min(middle + half, stack.shape[2]))
    if end - low < 2 * SIDE + LEAST_COLUMNS:
        return None
    return np.arange(low + SIDE, end - SIDE + 1), _evidence(stack[:, :, low:end])


def frames_show(frames: Sequence[Float32Array], gap: Gap, about: float) -> bool:
    """Check whether single frames favour a gap of any width near a column over none.

    Where both ends of rays differ by what is smooth in the columns (hardening, an object
    that is not symmetric), a step passes for a gap; frames do not show one.

    Args:
        frames: line integrals of `tile_gap.averaged_rows`, some of a turn.
        gap: by both ends of rays.
        about: distance from its column within which frames may show it [px].

    Returns:
        Also True where the images have too few columns about the gap to judge it.
    """
    stack = np.asarray(frames, dtype=np.float64)
    judged = _judged_about(stack, gap.column, 0.0)
    if judged is None:
        return True
    columns, evidence = judged
    found = evidence.found[:, np.abs(columns - gap.column) <= about]
    return not found.size or float(found.max()) > 0.0


def possible_gap(gap: Gap) -> HiddenGap:
    """Return a gap that both ends of rays show and single frames do not, as one that is not
    excluded.
    """
    return HiddenGap(gap.column, gap.column, 0.5, gap.width, None, True)


def _gap_at(column: int, share: FloatArray) -> Gap:
    """Make the gap at a column: mean width and standard deviation, at least that of
    `local_sigma`.

    Args:
        column: first column beyond the gap.
        share: probabilities of WIDTHS_PX, (w,).
    """
    width = float(share @ WIDTHS_PX)
    spread = math.sqrt(float(share @ np.square(WIDTHS_PX - width)))
    return Gap(column, width, max(spread, float(local_sigma(width))))


def _hidden_radius(profile: Profile, smoothing: float) -> float:
    """Find the distance from the axis up to which both ends of rays do not determine
    steps to `MIN_HIDDEN_PX` [px].

    Args:
        profile: steps that they show.
        smoothing: of the profile [px].

    Returns:
        At least twice the smoothing; the largest radius if no step is determined.
    """
    determined = np.array(
        [
            SIGMAS * profile.at(r).sigma < MIN_HIDDEN_PX
            for r in profile.radii[: profile.certain].tolist()
        ]
    )
    inner = 2.0 * smoothing
    if not determined.any():
        return max(inner, float(profile.last))
    return max(inner, float(profile.radii[int(determined.argmax())]))


def _of_outlines(found: FloatArray, beside: FloatArray) -> FloatArray:
    """Compute the evidence that outlines leave, where edges turn back at both sides of
    the axis: the largest about the mirrored border, 0 or more.

    Args:
        found: logarithm of the likelihood of a gap over none, (w, c).
        beside: of each border from the axis, even steps of a column, (c,) [px].

    Returns:
        (w, c); 0 for borders within `SIDE` of the axis or without a mirrored one.
    """
    places = np.arange(len(beside))
    mirror = np.rint(-2.0 * beside).astype(np.intp) + places
    known = (np.abs(beside) > SIDE) & (mirror >= 0) & (mirror < len(places))
    near = maximum_filter1d(found, 2 * OUTLINE_COLUMNS + 1, axis=1, mode="nearest")
    return np.where(known, np.maximum(near[:, np.where(known, mirror, 0)], 0.0), 0.0)


def _evidence_of_rays(
    columns: npt.NDArray[np.intp], axis: float, profile: Profile
) -> FloatArray:
    """Compute log likelihood ratios of a gap of each width at each column to none, from
    the steps of both ends of rays (Student).

    Args:
        columns: (c,) first columns beyond a gap.
        axis: column of the axis [px].
        profile: steps that both ends of rays show.

    Returns:
        (w, c).
    """
    beside = columns - 0.5 - axis
    certain = np.abs(beside) <= profile.last
    steps = [
        profile.beside_axis(abs(b)) if sure else profile.at_rim(abs(b))
        for b, sure in zip(beside.tolist(), certain.tolist(), strict=True)
    ]
    width = np.array([step.width for step in steps]) * np.sign(beside)
    sigma = np.array([step.sigma for step in steps])
    return _evidence_of_widths(width, sigma)


def _of_modes(columns: npt.NDArray[np.intp], steps: ModeSteps) -> FloatArray:
    """Compute the log likelihood ratios of gaps by the turn's modes.

    Args:
        columns: (c,) first columns beyond a gap.
        steps: widths by the modes.

    Returns:
        (w, c); 0 for columns that the modes do not judge.
    """
    judged = np.isin(columns, steps.columns)
    place = np.searchsorted(steps.columns, columns[judged])
    out = np.zeros((len(WIDTHS_PX), len(columns)))
    out[:, judged] = _evidence_of_widths(
        steps.width[place], steps.sigma[place], MODES_SHARE
    )
    return out


def _is_excluded(ratio: FloatArray) -> bool:
    """Check whether a gap at one of some columns has odds of `REPORTED_ODDS` against it.

    Args:
        ratio: likelihood of a gap over none at each, (c,); one at least.
    """
    odds = CHANCE / (1.0 - CHANCE) * float(ratio.mean())
    return odds * REPORTED_ODDS < 1.0 and float(ratio.max()) < 1.0


def _beside_told(
    columns: npt.NDArray[np.intp],
    evidence: Evidence,
    hidden: npt.NDArray[np.bool_],
    axis: float,
    profile: Profile,
    of_mean: MirrorSteps,
) -> Evidence:
    """Compare gaps with those where both ends of rays tell steps: the mean shows one that rays
    show, too, some columns further as well.

    Args:
        columns: first columns that are judged, (c,).
        evidence: of gaps there.
        hidden: whether rays do not reveal a gap there, (c,).
        axis: its column [px].
        profile: steps that rays show.
        of_mean: evidence of the mean.

    Returns:
        Evidence of gaps over none and over the likeliest one that is not hidden.
    """
    every = np.arange(of_mean.free.shape[1])
    told = np.abs(every - 0.5 - axis) <= profile.last
    told[columns] = False
    by_both = of_mean.free[:, told] + _evidence_of_rays(every[told], axis, profile)
    beside = ~hidden & (np.abs(columns - 0.5 - axis) <= profile.last)
    rivals = np.append(over_widths(by_both), over_widths(evidence.free[:, beside]))
    rival = max(float(rivals.max(initial=0.0)), 0.0)
    return replace(evidence, found=np.minimum(evidence.found, evidence.free - rival))


def _shown_at_rim(
    of_mean: MirrorSteps, axis: float, profile: Profile
) -> npt.NDArray[np.intp]:
    """Find the columns beyond the last distance at which both ends of rays are certain of a
    step, where they and the mean show one by `REPORTED_ODDS`.

    Others there are nobody's: hardly anything turns beyond them.

    Args:
        of_mean: evidence of the mean.
        axis: its column [px].
        profile: steps that rays show.

    Returns:
        (c,) first columns beyond a gap, perhaps none.
    """
    columns = np.arange(of_mean.found.shape[1])
    columns = columns[np.abs(columns - 0.5 - axis) > profile.last]
    of_rays = trusted(_evidence_of_rays(columns, axis, profile))
    shown = over_widths(of_mean.found[:, columns] + of_rays) > math.log(REPORTED_ODDS)
    return np.asarray(columns[shown])


def _evidence_of_widths(
    width: FloatArray, sigma: FloatArray, share: float = 0.0
) -> FloatArray:
    """Compute log likelihood ratios of a gap of each width to none from a measured width
    (Student).

    Args:
        width: measured at each column, (c,) [px].
        sigma: standard deviation of each where there is no gap, (c,) [px].
        share: standard deviation that a gap adds, as a share of its width.

    Returns:
        (w, c).
    """
    of_gap = np.hypot(sigma, share * WIDTHS_PX[:, None])
    left = (width - WIDTHS_PX[:, None]) / of_gap
    none = _log_student(width / sigma) - np.log(sigma)
    return np.asarray(_log_student(left) - np.log(of_gap) - none)


def _evidence(images: FloatArray) -> Evidence:
    """Judge gaps by single frames.

    The `EDGE_SHARE` of all places with most change (at most `MOST_EDGES`) tell whether
    there is a gap. Whether one would be visible is told by the edges among them that pass
    its border: noise shows none. The larger evidence of both counts, and that of gradients
    in smooth places (`gradient_steps`) is added.

    Args:
        images: frames of columns about the axis, (n, rows, c + 2 SIDE - 1).

    Returns:
        By width and border, (w, c).
    """
    table = (images - images.mean(axis=0)).reshape(-1, images.shape[2])
    around = np.lib.stride_tricks.sliding_window_view(
        np.diff(table, axis=1), 2 * SIDE - 1, axis=1
    )
    power = np.square(around).sum(axis=2)
    share = min(EDGE_SHARE, MOST_EDGES / power.size)
    places = power > np.quantile(power, 1.0 - share)
    of_rows = power.reshape(images.shape[0], -1)
    noise = np.quantile(of_rows, NOISE_QUANTILE, axis=0) / NOISE_QUANTILE_POWER
    edges = places & (of_rows > EDGE_NOISE * noise).reshape(power.shape)
    of_places = _evidence_of(around, power, places, len(images), evenly=True)
    of_edges = _evidence_of(around, power, edges, len(images), evenly=False)
    smooth = gradient_steps(around, _is_smooth(around, share), len(images))
    of_smooth = _evidence_of_widths(smooth.width, smooth.sigma, CURVED_SHARE)
    found = np.maximum(of_places.found, of_edges.found) + of_smooth
    return Evidence(found, of_places.width + of_smooth, found)


def _is_smooth(around: FloatArray, share: float) -> npt.NDArray[np.bool_]:
    """Mark all places but those that change most from one side of the border to the
    other.

    What both sides have in common, and the step across the border, are not looked at:
    noise and a gap in them are the same in the places that are left.

    Args:
        around: differences about each border, (m, c, 2 SIDE - 1).
        share: of the places that are left out.

    Returns:
        (m, c).
    """
    apart = around[:, :, SIDE:] - around[:, :, SIDE - 2 :: -1]
    change = np.square(apart).sum(axis=2)
    return np.asarray(change <= np.quantile(change, 1.0 - share))


def _evidence_of(
    around: FloatArray,
    power: FloatArray,
    seen: npt.NDArray[np.bool_],
    frames: int,
    evenly: bool,
) -> Evidence:
    """Judge gaps by some of the differences of neighbouring columns, for all WIDTHS_PX;
    likelihoods of a gap are averaged over BLURS_PX.

    Args:
        around: differences about each border, (m, c, 2 SIDE - 1).
        power: their sums of squares, (m, c).
        seen: those that count, (m, c).
        frames: number of frames, of m / frames rows each.
        evenly: a gap would be as visible at each border; else by the number that counts.

    Returns:
        By width and border: the evidence of a gap, and of its width, which counts less
        where the model fits badly (`Judged.trust`); zeros if no difference counts.
    """
    row, border = np.nonzero(seen)
    places = power.shape[1]
    of_frame = row * frames // len(power)
    shape = len(BLURS_PX), len(WIDTHS_PX), places
    if not len(row):
        return Evidence(*np.zeros((3, *shape[1:])))
    edges = around[row, border] / np.sqrt(power[row, border])[:, None]
    count = np.bincount(border, minlength=places).astype(np.float64)
    if evenly:
        passed = np.full(places, count.mean())
    else:
        passed = count
    of_distance = squares_by_distance(edges)
    without = likelihood(edges, of_distance, 0.0)
    judged = []
    for blur in BLURS_PX:
        for width in WIDTHS_PX.tolist():
            gain = likelihood(edges, of_distance, width, blur) - without
            of_place = np.bincount(of_frame * places + border, gain, frames * places)
            gains = np.asarray(of_place.reshape(-1, places), np.float64)
            judged.append(_beside_others(gains, passed))
    found = np.array([one.found for one in judged]).reshape(shape)
    gain = np.array([one.gain for one in judged]).reshape(shape)
    trust = np.array([one.trust for one in judged]).reshape(shape[:2]).min(axis=1)
    of_gap = np.logaddexp.reduce(found, axis=0) - math.log(len(BLURS_PX))
    of_width = np.logaddexp.reduce(gain * trust[:, None, None], axis=0)
    return Evidence(of_gap, of_width, of_gap)


class Judged(NamedTuple):
    """Evidence of single frames for gaps of one width.

    Attributes:
        found: logarithm of the likelihood of a gap over none, compared with other
            borders, (c,).
        gain: the same by the model of the differences alone, (c,).
        trust: part of that which its scatter justifies.
    """

    found: FloatArray
    gain: FloatArray
    trust: float


def _beside_others(gains: FloatArray, count: FloatArray) -> Judged:
    """Judge a gap at each border by comparison with other borders.

    Positive evidence is for a gap; it is taken as little where the model does not fit.

    Args:
        gains: in log likelihood of a gap over none, by frame and border, (n, c).
        count: edges that pass each border, (c,): so visible a gap would be there; one
            above 0 at least.

    Returns:
        Evidence and gain of each border, (c,), and how well the model fits, at most 1.
    """
    whole = gains.sum(axis=0)
    passed = np.maximum(count, 1.0)
    rate = float(np.median(whole[count > 0.0] / count[count > 0.0]))
    usual = rate * count
    own = np.sqrt(passed)
    between = ROBUST * float(np.median((np.abs(whole - usual) / own)[count > 0.0]))
    of_frames = scatter_of_sums(gains) / own
    spread = max(between, float(np.median(of_frames[count > 0.0])), 1e-6) * own
    excess = (whole - usual) / spread
    # Where the model fits, a gap gains what it loses elsewhere, and its variance is twice its
    # mean.
    lost = np.maximum(-2.0 * usual, 0.0)
    short = np.minimum(excess - EVIDENCE_SHARES[:, None] * lost / spread, 0.0)
    found = np.logaddexp.reduce(_log_student(short), axis=0) - math.log(
        len(EVIDENCE_SHARES)
    )
    found = found - _log_student(np.maximum(excess, 0.0))
    trust = float(np.median((lost / spread**2)[count > 0.0]))
    return Judged(np.asarray(found), whole, min(trust, 1.0))


def _log_student(deviation: FloatArray) -> FloatArray:
    """Return the logarithm of Student's density but for a constant."""
    return np.asarray(
        -(SCATTER_FREEDOM + 1.0) / 2.0 * np.log1p(np.square(deviation) / SCATTER_FREEDOM)
    )
