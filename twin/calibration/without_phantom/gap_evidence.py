"""Whether the panel has a gap: seen at a border in single frames, certified by both ends
of rays.

A wall that turns back at a column looks like a gap to single frames (`tile_gap.py`); to
both ends of the same rays (`conjugate_rays.py`) it does not. A gap is reported if a step
between their distances exceeds the scan's differences at all other distances from the
axis, or if the frames see a gap and the step there has its sign. Near the axis, where no
distance is inside a step, the frames count alone (`hidden_gap.py`), and gaps that they
neither show nor exclude are given too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from flexdt.twin.calibration.without_phantom.conjugate_rays import (
    ConjugateRays,
    Profile,
    Step,
)
from flexdt.twin.calibration.without_phantom.hidden_gap import HiddenGap, hidden_gap
from flexdt.twin.calibration.without_phantom.tile_gap import Gap, local_gaps
from flexdt.twin.errors import NotIdentifiableError
from flexdt.twin.geometry.conventions import Float32Array, FloatArray

SIGMAS: Final = 3.0
"""Least width of a gap, in sigmas."""
ROUNDS: Final = 3
"""Number of times a gap is closed to measure its remainder."""


class GapFound(NamedTuple):
    """The gap between two tiles of a scan.

    Attributes:
        gap: the gap; None: no gap is reported.
        hidden: possible gap near the axis; None: none is possible, or a gap is reported.
    """

    gap: Gap | None
    hidden: HiddenGap | None


def find_gap(
    rays: ConjugateRays,
    values: FloatArray,
    frames: Sequence[Float32Array],
    closed: Sequence[float] = (),
) -> GapFound:
    """Find the gap between two tiles of the panel, if there is one.

    A gap counts if single frames show it and both ends of rays agree, if it is a likely
    hidden one, or if both ends of rays show a significant step. Its width is that of both
    ends of rays. The gap is marked as beside the axis if its place leaves the width to
    the prior. Hidden ones are judged only if none is closed.

    Args:
        rays: both ends of rays of a turn.
        values: parameters of the plane of symmetry in the order of `circular_scan.FREE`,
            (k,).
        frames: line integrals of `tile_gap.averaged_rows`, some of the turn.
        closed: columns of borders next to which the images are filled in.

    Returns:
        The gap, None without; and the judgement of gaps that stay hidden, None with a
        gap.

    Raises:
        NotIdentifiableError: there are two gaps.
    """
    values, sigma = rays.column(values)
    if np.isfinite(sigma):
        profile = rays.profile(values)
    else:
        profile = None
    axis = rays.scan.column(values, rays.row)
    if closed:
        hidden = None
    else:
        hidden = hidden_gap(frames, axis, profile, rays.smoothing)
    if profile is None:
        return GapFound(None, hidden)
    seen = local_gaps(frames, axis, closed)
    certified = [gap for gap in seen if _certified(gap, profile, axis, rays.smoothing)]
    if not certified and hidden is not None and hidden.likely is not None:
        certified = [hidden.likely]
    step = profile.best()
    if not certified and not step.significant:
        return GapFound(None, hidden)
    if certified:
        first = certified[0]
    else:
        first = _from_step(step, axis)
    gap = _refined(rays, values, first)
    if not certified:  # the column is not known to the pixel
        gap = gap._replace(sigma=max(gap.sigma, first.sigma))
    if not certified and gap.width < SIGMAS * gap.sigma:
        return GapFound(None, hidden)
    others = [
        one
        for one in seen
        if abs(one.column - first.column) > 2.0 * rays.smoothing
        and not _refuted(one, profile, axis)
    ]
    _require_one(rays, values, gap, others)
    inside = profile.at(abs(gap.column - 0.5 - axis))
    return GapFound(gap._replace(beside_axis=not np.isfinite(inside.sigma)), None)


def _certified(gap: Gap, profile: Profile, axis: float, smoothing: float) -> bool:
    """Check whether both ends of rays agree with a gap that single frames show: a step
    (beyond `SIGMAS`) of its sign, or, within two smoothings of the axis, no step and too
    little precision to see one.

    Args:
        gap: column and width [px].
        profile: steps that both ends of rays show.
        axis: its column [px].
        smoothing: of the profile [px].
    """
    beside = gap.column - 0.5 - axis
    step = profile.at(abs(beside))
    if abs(step.width) > SIGMAS * step.sigma:
        return bool(np.sign(step.width) == np.sign(beside))
    return bool(abs(beside) < 2.0 * smoothing and SIGMAS * step.sigma > gap.width)


def _refuted(gap: Gap, profile: Profile, axis: float) -> bool:
    """Check whether both ends of rays leave less than half of the width of a gap that
    single frames show, with `SIGMAS` to spare.

    Args:
        gap: column and width [px].
        profile: steps that both ends of rays show.
        axis: its column [px].
    """
    beside = gap.column - 0.5 - axis
    step = profile.at(abs(beside))
    return step.width * float(np.sign(beside)) + SIGMAS * step.sigma < gap.width / 2


def _from_step(step: Step, axis: float) -> Gap:
    """Return the gap on the side of the axis that the sign of a step implies."""
    side = float(np.sign(step.width))
    return Gap(round(axis + side * step.radius + 0.5), abs(step.width), step.sigma)


def _closed(
    rays: ConjugateRays, values: FloatArray, column: int, width: float
) -> tuple[ConjugateRays, FloatArray]:
    """Close a gap, and find the axis again."""
    closed = rays.closed(column, width)
    return closed, closed.column(values)[0]


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


def _require_one(
    rays: ConjugateRays, values: FloatArray, gap: Gap, others: Sequence[Gap]
) -> None:
    """Check that no other gap between panel tiles is left when one is closed.

    Args:
        rays: both ends of rays of a turn.
        values: parameters of the plane.
        gap: to close.
        others: further gaps seen in frames; any is one too many.

    Raises:
        NotIdentifiableError: there is another gap; names the columns of two.
    """
    closed, again = _closed(rays, values, gap.column, gap.width)
    profile = closed.profile(again)
    step = profile.best() if profile else None
    columns = [one.column for one in others]
    if step is not None and step.significant:
        axis = rays.scan.column(again, rays.row)
        columns.append(_from_step(step, axis).column)
    if columns:
        both = sorted((gap.column, columns[0]))
        raise NotIdentifiableError(
            f"from columns {both[0]} and {both[1]} on everything appears nearer, as behind two "
            "gaps between tiles of the panel, of which one can be found; calibrate with "
            "a phantom, "
            "and give that correction"
        )
