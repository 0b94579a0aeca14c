"""What FDK must know of a scan: its circle, the angle each view stands for, and its redundancy.

Any flat panel on a circle about an axis parallel to z: full turns (the last view may repeat the
first), short scans with Parker's weights, a detector moved to one side, and helices of a turn or
more. Other trajectories are an error; iterative methods take those.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray

FLATNESS = 0.03
"""Largest deviation of the sources from a horizontal circle, relative to its radius."""
TAPER = 4.0
"""Width of the weights' transition, over how much further the detector reaches to one side."""
UNSEEN = 3e-3
"""Parker's weight of an opposite ray below which it counts as not seen; see `redundancy`."""
NARROWEST = 24
"""Least width of that transition [columns]."""
MOST_COLUMNS = 8
"""A panel moved to one side is continued to at most so many times its columns."""
LEVEL = 1e-3
"""Rise over a scan, relative to the radius, up to which it is a circle."""
UNSTEADY = 0.05
"""Largest deviation of a helix from a steady rise, relative to the rise in a turn."""
MOST_UNEVEN = 4.0
"""Largest step between neighbouring views, relative to the usual one, within a full turn."""


@dataclass(frozen=True, eq=False)
class Circle:
    """A scan on a circle or a helix.

    Attributes:
        centre: (x, y) of the rotation axis [mm].
        radius: from the axis to the source [mm].
        azimuth: (n,) unwrapped angle of the source about the axis, growing with the scan [rad].
        sense: +1 when the sources run counter-clockwise seen from above, else -1.
        step: (n,) angle each view stands for [rad]; they add up to the span, or to whole turns.
        span: angle covered [rad].
        full: whether the views close whole turns, or are a helix.
        rise: of a helix in a turn, negative downwards [mm]; 0 for a circle.
    """

    centre: FloatArray
    radius: float
    azimuth: FloatArray
    sense: float
    step: FloatArray
    span: float
    full: bool
    rise: float = 0.0

    @property
    def progress(self) -> FloatArray:
        """(n,) angle since the scan's first view [rad]."""
        run = self.sense * self.azimuth
        return np.asarray(run - run.min())


def circle_of(cone_vec: ConeVec) -> Circle:
    """The circle or the helix on which the sources of a scan lie.

    Raises:
        GeometryError: fewer than three views, or neither about an axis along z.
    """
    s = cone_vec.source
    if len(s) < 3:
        raise GeometryError(
            f"{len(s)} views; FDK needs a circle of at least 3", {"asked": len(s), "allowed": 3}
        )
    # x^2 + y^2 = 2 a x + 2 b y + c, least squares
    rows = np.column_stack([2.0 * s[:, :2], np.ones(len(s))])
    (a, b, c), _, rank, _ = np.linalg.lstsq(rows, (s[:, :2] ** 2).sum(axis=1), rcond=None)
    if rank < 3:
        raise GeometryError("the sources of all views lie on a line; FDK needs a circle")
    radius = float(np.sqrt(c + a * a + b * b))
    out = np.linalg.norm(s[:, :2] - (a, b), axis=1) - radius
    azimuth = _unwrapped(np.arctan2(s[:, 1] - b, s[:, 0] - a))
    sense = 1.0 if azimuth[-1] >= azimuth[0] else -1.0
    rise = _rise(sense * azimuth, s[:, 2], radius)
    worst = float(np.abs(out).max())
    if not rise:
        worst = max(worst, float(np.abs(s[:, 2] - s[:, 2].mean()).max()))
    if worst > FLATNESS * radius:
        raise GeometryError(
            f"the sources leave a horizontal circle of radius {radius:.4g} mm by {worst:.4g} mm; "
            "FDK needs a circle, or a helix that rises steadily for a turn or more; the iterative "
            "methods (sirt, sart, cgls, em) take any trajectory",
            {"asked": worst, "allowed": FLATNESS * radius},
        )
    order = np.argsort(sense * azimuth, kind="stable")
    run = (sense * azimuth)[order]
    gaps = np.diff(run)
    usual = float(np.median(gaps[gaps > 1e-9])) if (gaps > 1e-9).any() else 0.0
    span = float(run[-1] - run[0])
    turns = round(span / (2 * np.pi)) if span > np.pi else 0
    # The ends of a helix need not meet: the first and the last view stand for whole steps.
    closing = usual if rise else _closing_gap(span, turns, usual)
    inner = np.zeros(len(run))
    inner[:-1] += gaps / 2
    inner[1:] += gaps / 2
    full = closing is not None
    if closing is not None:
        inner[[0, -1]] += closing / 2
        span += closing
    step = np.empty(len(run))
    step[order] = inner
    return Circle(np.array([a, b]), radius, azimuth, sense, step, span, full, rise)


def _rise(run: FloatArray, height: FloatArray, radius: float) -> float:
    """Of the sources in a turn, where they rise steadily for a turn or more; else 0 [mm]."""
    span = float(np.ptp(run))
    if span * len(run) / (len(run) - 1) < 2 * np.pi - 1e-6:
        return 0.0
    slope, level = np.polyfit(run, height, 1)
    uneven = float(np.abs(height - level - slope * run).max())
    steady = uneven <= UNSTEADY * 2 * np.pi * abs(slope)
    return 2 * np.pi * float(slope) if steady and abs(slope) * span > LEVEL * radius else 0.0


def _unwrapped(azimuth: FloatArray) -> FloatArray:
    """Angles without jumps [rad]; those of views in no order lie within one turn."""
    run = np.unwrap(azimuth)
    steps = np.diff(run)
    if (steps >= -1e-9).all() or (steps <= 1e-9).all():
        return np.asarray(run)
    around = np.sort(azimuth % (2 * np.pi))
    gaps = np.diff(around, append=around[0] + 2 * np.pi)
    first = around[(int(gaps.argmax()) + 1) % len(around)]  # behind the widest gap
    return np.asarray((azimuth - first + 1e-12) % (2 * np.pi))


def _closing_gap(span: float, turns: int, usual: float) -> float | None:
    """From the last view on to the first, if the views close whole turns, else None.

    Zero when the last view repeats the first.
    """
    for whole in {turns, turns + 1} - {0}:
        gap = whole * 2 * np.pi - span
        if -0.25 * usual <= gap <= MOST_UNEVEN * usual:
            return max(gap, 0.0)
    return None


def redundancy(circle: Circle, cone_vec: ConeVec, cols: int, *, beyond: bool = False) -> FloatArray:
    """Weights (n, cols) of rays so that every line counts once, with its opposite or alone.

    Over whole turns every ray and its opposite share (1/2 each); with a detector moved to one
    side the rays near its near edge hand over smoothly to their opposites, and those beyond count
    alone. Turns beyond the first divide it further. Short scans get Parker's weights, widened to
    the span there is, and the handing over where an object lies `beyond` the near edge.

    Raises:
        GeometryError: less than half a turn plus the fan's opening.
    """
    fan = fan_angles(circle, cone_vec, cols)
    low, high = reach(fan)
    if min(low, high) <= 0:
        raise GeometryError(
            "the shadow of the rotation axis does not fall on the detector; FDK needs it to",
            {"fan_deg": np.rad2deg([-low, high]).tolist()},
        )
    turns, shared, widest = 1.0, np.full_like(fan, 0.5), float(np.abs(fan).max())
    if circle.full:
        # The turns of a helix share each voxel in the backprojection.
        turns = 1.0 if circle.rise else circle.span / (2 * np.pi)
    elif circle.span < np.pi + 2 * widest - 1e-6 or circle.span > 2 * np.pi:
        raise GeometryError(
            f"the views span {np.rad2deg(circle.span):.4g} deg; FDK needs whole turns, or between "
            f"{np.rad2deg(np.pi + 2 * widest):.4g} (half a turn and the fan) and 360 deg",
            {
                "asked": float(np.rad2deg(circle.span)),
                "allowed": [float(np.rad2deg(np.pi + 2 * widest)), 360.0],
            },
        )
    else:
        shared = parker(circle.progress[:, None], circle.sense * fan, circle.span)
    column = (low + high) / cols
    if abs(high - low) <= column or not (circle.full or beyond):
        return shared / turns
    overlap = min(low, high)
    taper = min(overlap, max(TAPER * abs(high - low), NARROWEST * column))
    side = fan if high > low else -fan
    alone = np.sin(np.pi / 2 * np.clip((np.abs(side) - (overlap - taper)) / taper, 0.0, 1.0)) ** 2
    # Off the near edge a ray counts, as what continues the panel, where its opposite was not seen.
    opposite = np.where(side > 0, shared, 1.0 - shared)
    seen = np.clip(opposite / UNSEEN, 0.0, 1.0)
    weight = np.where(side > 0, seen, 1.0 - seen)
    return np.asarray(((1.0 - alone) * shared + alone * weight) / turns)


def reach(fan: FloatArray) -> tuple[float, float]:
    """Fan angles (n, cols) that all views have on the clockwise side and on the other [rad]."""
    return -float(fan.min(axis=1).max()), float(fan.max(axis=1).min())


def columns_beyond(circle: Circle, cone_vec: ConeVec, cols: int) -> tuple[int, int]:
    """Columns before the first and after the last in which a panel moved to one side is continued.

    The filter's response to what the panel saw goes on beyond its near edge. Voxels whose shadow
    falls there need it, out to where the panel ends on the other side.
    """
    widest = max(reach(fan_angles(circle, cone_vec, cols)))
    source = cone_vec.source[:, :2]
    inward, panel = circle.centre - source, cone_vec.detector[:, :2] - source
    ends = []
    for angle in (-widest, widest):
        c, s = np.cos(angle), np.sin(angle)
        ray = inward @ np.array([[c, s], [-s, c]])
        ends.append(-_cross(ray, panel) / _cross(ray, cone_vec.u[:, :2]) + (cols - 1) / 2)
    before, after = -float(np.min(ends)), float(np.max(ends)) - (cols - 1)
    first, last = np.clip(np.ceil([before - 0.5, after - 0.5]), 0, MOST_COLUMNS * cols)
    return int(first), int(last)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def parker(progress: FloatArray, fan: FloatArray, span: float) -> FloatArray:
    """Parker's weights (1982) for a span of at least pi plus the fan (Silver 2000).

    A ray (progress b, fan angle g) and its opposite (b + pi + 2 g, -g) add up to 1.

    Args:
        progress: angle since the first view [rad].
        fan: angle of the ray from the central one, in the sense of the progress [rad].
        span: angle covered [rad].
    """
    half = (span - np.pi) / 2.0
    with np.errstate(divide="ignore", invalid="ignore"):
        rising = np.sin(np.pi / 4 * progress / (half - fan)) ** 2
        falling = np.sin(np.pi / 4 * (span - progress) / (half + fan)) ** 2
    weight = np.where(progress < 2 * (half - fan), rising, 1.0)
    weight = np.where(progress > np.pi - 2 * fan, falling, weight)
    return np.asarray(np.clip(np.nan_to_num(weight), 0.0, 1.0))


def fan_angles(circle: Circle, cone_vec: ConeVec, cols: int) -> FloatArray:
    """Horizontal angle of each column's ray from the line source to axis, (n, cols) [rad],
    positive counter-clockwise seen from above.
    """
    source = cone_vec.source[:, :2]
    inward = circle.centre - source
    offset = np.arange(cols) - (cols - 1) / 2
    ray = (cone_vec.detector[:, :2] - source)[:, None] + offset[:, None] * cone_vec.u[:, None, :2]
    cross = inward[:, None, 0] * ray[..., 1] - inward[:, None, 1] * ray[..., 0]
    dot = (inward[:, None] * ray).sum(axis=-1)
    return np.asarray(np.arctan2(cross, dot))
