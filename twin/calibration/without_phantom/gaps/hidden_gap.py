"""A gap between two tiles that both ends of rays do not reveal.

Within some columns of the axis, and where no structure that turns is seen nearer to the
axis, a gap moves both ends of all rays alike: it looks like another axis, half of its
width aside. Only single frames across the border itself reveal it (`frame_evidence.py`).
The mean over the turn tells such gaps too, where a wall or a round body is nearer to the
axis than all that turns (`mirror_steps.py`). A gap that would be visible and is not is
excluded; the width of the others stays in the column's sigma.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.ndimage import maximum_filter1d

from flexdt.twin.calibration.repeated_frames import REPORTED_ODDS
from flexdt.twin.calibration.without_phantom.conjugate_rays import (
    ConjugateRays,
    Profile,
)
from flexdt.twin.calibration.without_phantom.gaps.frame_evidence import (
    Evidence,
    evidence_of_widths,
    frame_evidence,
)
from flexdt.twin.calibration.without_phantom.gaps.mirror_steps import (
    FOOLED_CHANCE,
    LOG_PRIOR,
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
    local_sigma,
)
from flexdt.twin.geometry.conventions import Float32Array, FloatArray

CHANCE: Final = 0.05
"""Probability that a panel has a gap at one of the columns where it is hidden; assumed: most
panels are one piece, or their gaps are closed by the camera."""
OPEN_SHARE: Final = 0.5
"""Part of the width of gaps that a gap that is not excluded leaves open at least: the width
times the root of its probability covers no gap."""
LEAST_COLUMNS: Final = 14
"""Columns on each side of the axis whose borders are compared, at least."""
OUTLINE_COLUMNS: Final = 1
"""By so many columns the two sides of an outline may differ from mirror images."""
MODES_SHARE: Final = 0.3
"""Standard deviation of a width by the modes of the turn, as a share of it: it is that of a
small displacement (drawn gaps of 1 to 2 px by up to that)."""
HIDDEN_SIGMAS: Final = 2.0
"""Distance from any axis up to which both ends of rays hide gaps, in sigmas of their
smoothing."""
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
        open: whether the images do not exclude it: in some stretch of these columns their
            odds against one are below REPORTED_ODDS.
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
    if rays is not None and not _is_excluded(evidence.effect[hidden], smoothing):
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
    open_gap = not _is_excluded(evidence.effect[hidden], smoothing)
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
        _gap_at(int(columns[best]), evidence.widths[:, best], doubted[:, best])
        if total > REPORTED_ODDS
        else None,
        open_gap,
    )


def _judged_about(
    stack: FloatArray, middle: float, reach: float
) -> tuple[npt.NDArray[np.intp], Evidence] | None:
    """Judge the borders within `reach` [px] of a column by single frames (n, rows, cols).

    Returns first columns beyond the borders, (c,), and their evidence; None for too few
    columns.
    """
    half = max(float(LEAST_COLUMNS), reach) + SIDE
    low = math.floor(max(middle - half, 0.0))
    end = math.ceil(min(middle + half, stack.shape[2]))
    if end - low < 2 * SIDE + LEAST_COLUMNS:
        return None
    return np.arange(low + SIDE, end - SIDE + 1), frame_evidence(stack[:, :, low:end])


def frames_show(frames: Sequence[Float32Array], gap: Gap, about: float) -> bool:
    """Check whether single frames leave a gap, seen by rays, odds of `REPORTED_ODDS`.

    In rays what is smooth in the columns (hardening, an asymmetric object) passes for a
    gap (`FOOLED_CHANCE`), not in frames.
    `frames`: some of a turn, of `tile_gap.averaged_rows`; `about`: distance within which
    they may show it [px]. Returns True, too, where columns are too few.
    """
    stack = np.asarray(frames, dtype=np.float64)
    judged = _judged_about(stack, gap.column, 0.0)
    if judged is None:
        return True
    columns, evidence = judged
    ratio = evidence.ratio[np.abs(columns - gap.column) <= about]
    if not ratio.size:
        return True
    by_rays = CHANCE / (1.0 - CHANCE) / FOOLED_CHANCE
    return by_rays * float(ratio.mean()) > REPORTED_ODDS


def possible_gap(gap: Gap) -> HiddenGap:
    """Return a gap shown by both ends of rays but not by frames: it is not excluded."""
    return HiddenGap(gap.column, gap.column, 0.5, gap.width, None, True)


def _gap_at(column: int, share: FloatArray, doubted: FloatArray) -> Gap:
    """Make the gap at a column: mean width and standard deviation, at least that of
    `local_sigma`. `column`: first column beyond the gap; `share`: probabilities of WIDTHS_PX by
    the images, (w,); `doubted`: those of the standard deviation, (w,)."""
    width = float(share @ WIDTHS_PX)
    spread = math.sqrt(float(doubted @ np.square(WIDTHS_PX - width)))
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
    inner = HIDDEN_SIGMAS * smoothing
    if not determined.any():
        return max(inner, float(profile.last))
    return max(inner, float(profile.radii[int(determined.argmax())]))


def _of_outlines(found: FloatArray, beside: FloatArray) -> FloatArray:
    """Compute the evidence that outlines leave, turning back at both sides of the axis.

    It is the largest of `found` (w, c) about the mirrored border, 0 or more; 0 within
    `SIDE` of the axis. `beside`: borders from the axis, (c,) [px].
    """
    places = np.arange(len(beside))
    mirror = np.rint(-2.0 * beside).astype(np.intp) + places
    known = (np.abs(beside) > SIDE) & (mirror >= 0) & (mirror < len(places))
    near = maximum_filter1d(found, 2 * OUTLINE_COLUMNS + 1, axis=1, mode="nearest")
    return np.where(known, np.maximum(near[:, np.where(known, mirror, 0)], 0.0), 0.0)


def _evidence_of_rays(
    columns: npt.NDArray[np.intp], axis: float, profile: Profile
) -> FloatArray:
    """Compute log likelihood ratios of a gap of each width at each column to none, from the
    steps of both ends of rays (Student).

    `columns`: (c,) first columns beyond a gap; `axis`: column of the axis [px]; `profile`: steps
    that both ends of rays show.
    Returns (w, c).
    """
    beside = columns - 0.5 - axis
    certain = np.abs(beside) <= profile.last
    steps = [
        profile.at_certain(abs(b)) if sure else profile.at_rim(abs(b))
        for b, sure in zip(beside.tolist(), certain.tolist(), strict=True)
    ]
    width = np.array([step.width for step in steps]) * np.sign(beside)
    sigma = np.array([step.sigma for step in steps])
    return evidence_of_widths(width, sigma)


def _of_modes(columns: npt.NDArray[np.intp], steps: ModeSteps) -> FloatArray:
    """Compute the log likelihood ratios of gaps by the turn's modes.

    `columns`: (c,) first columns beyond a gap; `steps`: widths by the modes.
    Returns (w, c); 0 for columns that the modes do not judge.
    """
    judged = np.isin(columns, steps.columns)
    place = np.searchsorted(steps.columns, columns[judged])
    out = np.zeros((len(WIDTHS_PX), len(columns)))
    out[:, judged] = evidence_of_widths(
        steps.width[place], steps.sigma[place], MODES_SHARE
    )
    return out


def _is_excluded(effect: FloatArray, smoothing: float) -> bool:
    """Check whether each stretch of columns that rays hide has odds against a gap.

    Many columns that exclude one say nothing about others.
    `effect`: likelihoods (`Evidence.effect`), (c,); `smoothing` [px].
    """
    stretch = min(1 + math.floor(2.0 * HIDDEN_SIGMAS * smoothing), len(effect))
    of_stretches = np.convolve(effect, np.full(stretch, 1.0 / stretch), mode="valid")
    return float(of_stretches.max()) * REPORTED_ODDS < 1.0


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

    `columns`: first columns that are judged, (c,); `evidence`: of gaps there; `hidden`: whether
    rays do not reveal a gap there, (c,); `axis`: its column [px]; `profile`: steps that rays
    show; `of_mean`: evidence of the mean.
    Returns evidence of gaps over none and over the likeliest one that is not hidden.
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
    """Find columns (c,) beyond the last certain distance with a gap by `REPORTED_ODDS`.

    Rays and the mean (`of_mean`) count together. Others there stay open: hardly anything
    turns beyond them.
    """
    columns = np.arange(of_mean.found.shape[1])
    columns = columns[np.abs(columns - 0.5 - axis) > profile.last]
    of_rays = trusted(_evidence_of_rays(columns, axis, profile))
    shown = over_widths(of_mean.found[:, columns] + of_rays) > math.log(REPORTED_ODDS)
    return np.asarray(columns[shown])
