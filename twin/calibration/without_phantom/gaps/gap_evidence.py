"""Whether the panel has a gap: seen at a border in single frames, certified by both ends
of rays.

A wall that turns back at a column looks like a gap to single frames (`tile_gap.py`); to
both ends of the same rays (`conjugate_rays.py`) it does not. A gap is reported if a step
between their distances exceeds the scan's differences at all other distances from the
axis, or if the frames see a gap and the step there has its sign. Where no distance is
inside a step, near the axis, or only few are beyond it, the frames, the modes of the turn
and the symmetry of its mean count (`hidden_gap.py`), and gaps that they neither show nor
exclude are given too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from flexdt.twin.calibration.without_phantom.conjugate_rays import (
    ConjugateRays,
    Profile,
    Step,
)
from flexdt.twin.calibration.without_phantom.gaps.hidden_gap import (
    HiddenGap,
    frames_show,
    hidden_gap,
    possible_gap,
)
from flexdt.twin.calibration.without_phantom.gaps.mirror_steps import (
    MirrorSteps,
    mirror_steps,
)
from flexdt.twin.calibration.without_phantom.mirror_symmetry import border_room
from flexdt.twin.calibration.without_phantom.tile_gap import (
    SIDE,
    Gap,
    dead_columns,
    local_gaps,
)
from flexdt.twin.calibration.without_phantom.turn import Turn
from flexdt.twin.errors import NotIdentifiableError
from flexdt.twin.geometry.conventions import Float32Array, FloatArray

SIGMAS: Final = 3.0
"""Least width of a gap, in sigmas."""
OWN_MIRROR_PX: Final = SIDE / 2 + 1
"""Distance from the axis up to which a border is its own mirror image: what turns there
cannot be compared with the other side, and single frames certify nothing."""
ROUNDS: Final = 3
"""Number of times a gap is closed to measure its remainder."""


class GapFound(NamedTuple):
    """The gap between two tiles of a scan.

    Attributes:
        gap: the gap; None: no gap is reported.
        hidden: possible gap near the axis, which counts unless the gap is confirmed; None:
            none is possible, or both ends of rays certify the gap.
        values: parameters of the plane of symmetry by both ends of rays, the gap closed;
            None without a gap.
        widths: the gap's width and its standard deviation [px] by both ends of rays, and by
            the steps of the mean where these tell the gap.
    """

    gap: Gap | None
    hidden: HiddenGap | None
    values: FloatArray | None = None
    widths: tuple[tuple[float, float], ...] = ()


def find_gap(
    rays: ConjugateRays,
    values: FloatArray,
    turn: Turn,
    closed: Sequence[float] = (),
) -> GapFound:
    """Find the gap between two tiles of the panel, if there is one.

    A gap counts if single frames show it and both ends of rays agree, if it is a likely
    hidden one, or if both ends of rays show a significant step that the mean shows or
    single frames favor over none; others are left open. Its width is that of both
    ends of rays. The gap is marked as beside the axis if its place leaves the width to
    the prior. Hidden ones are judged only if none is closed; a likely one does not count
    if both ends of rays show another step behind it. A second gap is one that single frames
    show and the mean, or rays; not where the mean favors none.

    Args:
        rays: both ends of rays of a turn.
        values: parameters of the plane of symmetry in the order of `circular_scan.FREE`,
            (k,).
        turn: its frames.
        closed: columns of borders next to which the images are filled in.

    Returns:
        The gap and the plane behind it, None without; and the judgment of gaps that stay
        hidden, None with a gap that both ends of rays certify.

    Raises:
        NotIdentifiableError: there are two gaps.
    """
    values, sigma = rays.column(values)
    profile = rays.profile(values) if np.isfinite(sigma) else None
    axis = rays.scan.column(values, rays.row)
    frames = turn.samples
    stack = np.asarray(frames, dtype=np.float64)
    dead = dead_columns((stack - stack.mean(axis=0)).reshape(-1, rays.cols))
    of_mean = mirror_steps(turn.mean, turn.noise, rays.scan, values, dead)
    hidden = None
    if not closed:
        hidden = hidden_gap(frames, axis, profile, rays.smoothing, rays, of_mean)
    if profile is None:
        return GapFound(_by_mean(hidden, of_mean), hidden)
    seen = _shown_apart(frames, axis, closed)
    certified = [gap for gap in seen if _certified(gap, profile, axis)]
    likely = None if certified or hidden is None else hidden.likely
    gap = _measured(rays, values, [*certified, likely], profile.best(), axis)
    if gap is None:
        return GapFound(None, hidden)
    by_rays_alone = not certified and likely is None
    about = 2.0 * rays.smoothing
    told = of_mean.told(gap.column, about)
    if by_rays_alone and not (told or frames_show(frames, gap, about)):
        return GapFound(None, possible_gap(gap))
    closed_rays, behind = _closed(rays, values, gap.column, gap.width)
    far = _far_from(gap, seen, about, axis)
    second, step = _left_behind(closed_rays, behind, far, of_mean, about)
    _require_one(gap, second)
    if likely is not None and step is not None:
        return GapFound(None, hidden)
    _require_one(gap, step)
    by_mean = [of_mean.width(gap.column, about)] if told else []
    fitted = told or bool(np.isfinite(profile.at(_from_axis(gap, axis)).sigma))
    near = _from_axis(gap, axis) <= 2.0 * border_room(rays.cols)
    gap = gap._replace(beside_axis=near or not fitted)
    widths = ((gap.width, gap.sigma), *by_mean)
    return GapFound(
        contradicted(gap, by_mean), None if likely is None else hidden, behind, widths
    )


def _shown_apart(
    frames: Sequence[Float32Array], axis: float, closed: Sequence[float]
) -> list[Gap]:
    """List the gaps that single frames show away from their own mirror images
    (`OWN_MIRROR_PX`)."""
    shown = local_gaps(frames, axis, closed)
    return [gap for gap in shown if _from_axis(gap, axis) > OWN_MIRROR_PX]


def _from_axis(gap: Gap, axis: float) -> float:
    """Return the distance of a gap's border from the axis [px]."""
    return abs(gap.column - 0.5 - axis)


def contradicted(gap: Gap, widths: Sequence[tuple[float, float]]) -> Gap:
    """Raise the sigma of a gap's width as far as other measurements contradict it.

    `widths`: each with its standard deviation [px].
    """
    apart = [
        abs(gap.width - width) / math.hypot(gap.sigma, sigma) for width, sigma in widths
    ]
    return gap._replace(sigma=gap.sigma * max([1.0, *apart]))


def _by_mean(hidden: HiddenGap | None, of_mean: MirrorSteps) -> Gap | None:
    """Give a likely gap where nothing that turns is seen from both ends, if the mean shows it;
    the mean tells its width, too.
    """
    if hidden is None or hidden.likely is None:
        return None
    return hidden.likely if of_mean.told(hidden.likely.column, 0.0) else None


def _measured(
    rays: ConjugateRays,
    values: FloatArray,
    known: Sequence[Gap | None],
    step: Step,
    axis: float,
) -> Gap | None:
    """Measure the width of a gap by both ends of rays: of the first one known, or else of a
    significant step.

    Args:
        rays: of a turn.
        values: parameters of the geometry.
        known: gaps by single frames, the best first; None: none.
        step: the most significant one of both ends of rays.
        axis: column of the rotation axis [px].

    Returns None if nothing is known, or if the width is below `SIGMAS`; a gap whose width both
    ends of rays do not determine is returned as it is known. One from a step has at least the
    step's sigma.
    """
    first = next((gap for gap in known if gap is not None), None)
    if first is not None:
        gap = _refined(rays, values, first)
    elif step.significant:
        at_step = _from_step(step, axis)
        # A wall that turns back there makes the first estimate surer than it is.
        gap = _refined(rays, values, at_step._replace(sigma=math.inf))
        if not math.isfinite(gap.sigma):
            gap = at_step
        # The column is not known to the pixel.
        gap = gap._replace(sigma=max(gap.sigma, at_step.sigma))
    else:
        return None
    return gap if gap == first or gap.width >= SIGMAS * gap.sigma else None


def _far_from(gap: Gap, seen: Sequence[Gap], about: float, axis: float) -> list[Gap]:
    """Select gaps not as far (by `about` px) from the axis as another."""
    own = _from_axis(gap, axis)
    return [one for one in seen if abs(_from_axis(one, axis) - own) > about]


def _left_behind(
    closed: ConjugateRays,
    values: FloatArray,
    far: Sequence[Gap],
    of_mean: MirrorSteps,
    about: float,
) -> tuple[Gap | None, Gap | None]:
    """Find what looks like another gap once one is closed.

    Args:
        closed: both ends of rays, the gap closed.
        values: parameters of the plane.
        far: gaps that single frames show, away from the closed one.
        of_mean: steps of the mean; what it denies is none.
        about: distance within which these count [px].

    Returns:
        One that single frames show and both ends of rays, or the mean, certify, and one by a
        significant step alone; None each without.
    """
    second = None
    by_step = None
    profile = closed.profile(values)
    if profile is not None:
        axis = closed.scan.column(values, closed.row)
        second = next((one for one in far if _certified(one, profile, axis)), None)
        step = profile.best()
        by_step = _from_step(step, axis) if step.significant else None
    if second is not None and of_mean.denied(second.column, about):
        second = None
    if by_step is not None and of_mean.denied(by_step.column, about):
        by_step = None
    if second is None:
        second = next((one for one in far if of_mean.told(one.column, about)), None)
    return second, by_step


def _certified(gap: Gap, profile: Profile, axis: float) -> bool:
    """Check whether both ends of rays agree with a gap that single frames show: a step of its
    sign, beyond `SIGMAS`. `gap`: column and width [px]; `profile`: steps that both ends of rays
    show; `axis`: its column [px]."""
    beside = gap.column - 0.5 - axis
    step = profile.at(abs(beside))
    return step.width * float(np.sign(beside)) > SIGMAS * step.sigma


def _from_step(step: Step, axis: float) -> Gap:
    """Return the gap on the side of the axis that the sign of a step implies."""
    side = float(np.sign(step.width))
    return Gap(round(axis + side * step.radius + 0.5), abs(step.width), step.sigma)


def _closed(
    rays: ConjugateRays, values: FloatArray, column: int, width: float
) -> tuple[ConjugateRays, FloatArray]:
    """Close a gap, and find the axis again; parameters stay where it is not found."""
    closed = rays.closed(column, width)
    moved, sigma = closed.column(values)
    return closed, moved if np.isfinite(sigma) else values


def _refined(rays: ConjugateRays, values: FloatArray, gap: Gap) -> Gap:
    """Correct the width of a gap by the step that is left when it is closed, in `ROUNDS`
    rounds.

    Args:
        rays: seen from both ends.
        values: parameters of the geometry.
        gap: first estimate.

    Returns:
        The gap with width (0 or more) and sigma [px] of the last round that could be read
        and was no less sure than the one before; `gap` itself if none was.
    """
    for _ in range(ROUNDS):
        closed, again = _closed(rays, values, gap.column, gap.width)
        beside = gap.column - 0.5 - rays.scan.column(again, rays.row)
        profile = closed.profile(again)
        if profile:
            left = profile.at(abs(beside))
        else:
            left = None
        if left is None or left.sigma > gap.sigma:
            return gap
        width = max(gap.width + float(np.sign(beside)) * left.width, 0.0)
        gap = gap._replace(width=width, sigma=left.sigma)
    return gap


def _require_one(gap: Gap, other: Gap | None) -> None:
    """Check that there is no other gap.

    Args:
        gap: the one that is closed.
        other: another one; None: none.

    Raises NotIdentifiableError: there is another; names the columns of both.
    """
    if other is None:
        return
    both = sorted((gap.column, other.column))
    raise NotIdentifiableError(
        f"from columns {both[0]} and {both[1]} on everything appears nearer, as behind two "
        "gaps between tiles of the panel, of which one can be found; calibrate with "
        "a phantom, and give that correction"
    )
