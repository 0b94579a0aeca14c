"""A scan's trajectory for FDK: its circle, the arc of each view, and its redundancy.

Any flat panel on a circle about an axis parallel to z: any number of turns and parts of turns
with any gaps, as long as the views see every line through the object, a detector moved to one
side, and helices of a turn or more. Other trajectories are an error; iterative methods take
those.

What the views cover decides, not the order in which they are listed. Those of a circle are
sorted by their angle on it, whatever the turn, and each stands for the arc to halfway to its
neighbors. A step much wider than the usual one is a gap, which the opposite views make up for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray

MAX_CIRCLE_DEVIATION = 0.03
"""Largest deviation of the sources from a horizontal circle, relative to its radius."""
TAPER_REACHES = 4.0
"""Width of the weights' transition, relative to the detector's additional reach on one
side."""
MIN_TAPER_COLS = 24
"""Least width of that transition [columns]."""
MIN_CONFIDENCE = 3e-3
"""Confidence in the rays at the panel's near edge, relative to that in their opposites. It
decides only where an opposite ray was hardly seen: next to a gap of the angles."""
MAX_PANEL_WIDTHS = 8
"""Largest width to which a panel moved to one side is continued, over its columns."""
MAX_CIRCLE_RISE = 1e-3
"""Largest rise over a circular scan, relative to the radius."""
MAX_HELIX_DEVIATION = 0.05
"""Largest deviation of a helix from a steady rise, relative to the rise in a turn."""
GAP_STEPS = 3.0
RANDOM_GAP_STEPS = 8.0
"""Steps between neighboring views, relative to the usual one, from which on they are
gaps. The first holds where the views behind cover all of them, as in a scan that left
some out; else the second, as for random views."""
GAP_RAMP_RAD = 0.35
"""Angle over which the confidence in views falls towards a gap; a fan of as much on
either side is wide, so that views behind a gap that cover it do so for any panel
[rad]."""
TURN = 2 * np.pi
MAX_KEPT_CIRCLES = 16
"""Number of circles that are remembered."""


@dataclass(frozen=True, eq=False)
class Circle:
    """A scan on a circle or a helix.

    Attributes:
        centre: (x, y) of the rotation axis [mm].
        radius: from the axis to the source [mm].
        angle: (n,) along it [rad]: on a circle the azimuth of the source about the axis,
            from 0 to 2 pi; on a helix since its lowest view.
        step: (n,) arc of each view [rad].
        gaps: (k, 2) first and last angle of the arcs without views [rad]; the last may
            exceed 2 pi. A helix has no gaps.
        rise: of a helix in a turn [mm]; 0 for a circle.
    """

    centre: FloatArray
    radius: float
    angle: FloatArray
    step: FloatArray
    gaps: FloatArray
    rise: float = 0.0

    @property
    def full(self) -> bool:
        """True if the views see the object from all around."""
        return not len(self.gaps)

    def from_gap(self, angle: FloatArray) -> FloatArray:
        """Compute the distance of angles to the nearest edge of an arc without views
        ("gap").

        Args:
            angle: of any shape [rad], taken modulo a turn.

        Returns:
            [rad], of the same shape: 0 within a gap, infinite on a full circle.
        """
        if self.full:
            return np.full_like(angle, np.inf)
        first, last = self.gaps.T
        arc = (
            np.append(first[1:], first[0] + TURN) - last
        )  # that the views cover behind each gap
        at = np.concatenate([first, last, last + arc / 2])
        value = np.concatenate([np.zeros(2 * len(arc)), arc / 2])
        return np.asarray(np.interp(angle, at, value, period=TURN))


def no_fdk(why: str, asked: object, allowed: object) -> GeometryError:
    """Make (do not raise) the error that FDK cannot use a trajectory, with an advice."""
    what_can = "the iterative methods (sirt, sart, cgls, em) take any trajectory"
    return GeometryError(f"{why}; {what_can}", {"asked": asked, "allowed": allowed})


def circle_of(cone_vec: ConeVec) -> Circle:
    """Fit a helix about z, or else a circle, to a scan's sources.

    The center is fitted by least squares in x and y. A helix is recognized by a steady
    rise over a turn or more (`_helix`); else the sources must keep to a horizontal
    circle. Both may deviate from the radius by `MAX_CIRCLE_DEVIATION` of it. "Gaps" are
    arcs without views.

    Args:
        cone_vec: n views.

    Returns:
        Center, radius, and each view's angle and step of angle; for a circle its gaps,
        for a helix its rise.

    Raises:
        GeometryError: fewer than three views, sources on a line, or neither a circle nor
            a helix.
    """
    return _circle_of(cone_vec.source.tobytes())


@lru_cache(MAX_KEPT_CIRCLES)
def _circle_of(sources: bytes) -> Circle:
    """Fit the circle of sources, once for the many geometries that differ in their panels.

    Args:
        sources: bytes of float64 (n, 3) [mm].

    Raises:
        GeometryError: see `circle_of`.
    """
    s = np.frombuffer(sources).reshape(-1, 3)
    if len(s) < 3:
        raise GeometryError.instead(
            f"{len(s)} views", len(s), "for FDK a circle of at least 3"
        )
    # x^2 + y^2 = 2 a x + 2 b y + c, least squares
    rows = np.column_stack([2.0 * s[:, :2], np.ones(len(s))])
    (a, b, c), _, rank, _ = np.linalg.lstsq(rows, (s[:, :2] ** 2).sum(axis=1), rcond=None)
    if rank < 3:
        raise GeometryError("the sources of all views lie on a line; FDK needs a circle")
    centre = np.array([a, b])
    radius = float(np.sqrt(c + a * a + b * b))
    azimuth = np.arctan2(s[:, 1] - b, s[:, 0] - a)
    helix = _helix(azimuth, s[:, 2], centre, radius)
    worst = float(np.abs(np.linalg.norm(s[:, :2] - centre, axis=1) - radius).max())
    if helix is None:
        worst = max(worst, float(np.abs(s[:, 2] - s[:, 2].mean()).max()))
    if worst > MAX_CIRCLE_DEVIATION * radius:
        raise no_fdk(
            f"the sources leave a horizontal circle of radius {radius:.4g} mm "
            f"by {worst:.4g} mm; FDK needs a circle, or a helix that rises steadily for "
            "a turn or more and has no gap of angles",
            worst,
            MAX_CIRCLE_DEVIATION * radius,
        )
    return helix or _turn(azimuth % TURN, centre, radius)


def distinct_angles(circle: Circle) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Find the first views of different angles, (k,) by angle, and which each view
    repeats, (n,).

    Angles are equal to 1e-9 rad; on a circle modulo a turn, on a helix not.
    """
    if circle.rise:
        angle = circle.angle.round(9)
    else:
        angle = _on_circle(circle.angle)
    _, first, same = np.unique(angle, return_index=True, return_inverse=True)
    return first, same


def _on_circle(angle: FloatArray) -> FloatArray:
    """Round angles so that those of one place are equal: slightly below zero is zero."""
    return np.asarray(angle.round(9) % round(TURN, 9))


def mean_image(
    image: Callable[[int], npt.NDArray[np.generic]], views: npt.NDArray[np.intp]
) -> Float32Array:
    """Average some views' images, summed as float32 in the given order, (rows, cols).

    A single image may share its memory with the given one.

    `image`: gives a view's image by its number; `views`: numbers, at least one.
    """
    total = np.asarray(image(int(views[0])), np.float32)
    if len(views) == 1:
        return total
    for view in views[1:].tolist():
        total = total + np.asarray(image(view), np.float32)
    return np.asarray(total / len(views), np.float32)


def _turn(azimuth: FloatArray, centre: FloatArray, radius: float) -> Circle:
    """Make a circle from its sources' angles, with steps and gaps.

    A gap is an arc without views, wider than `GAP_STEPS` usual steps or a third of a turn; if
    the gaps leave lines unseen, as for random angles, it must be wider than `RANDOM_GAP_STEPS`.

    `azimuth`: (n,) from 0 to 2 pi [rad]; `centre`: (2,) [mm]; `radius`: [mm].
    Returns the circle; a view's step is half the way to its neighbor on either side, views at
    one angle share it equally, and gaps belong to no view.
    """
    at, same = np.unique(_on_circle(azimuth), return_inverse=True)
    # From each place to the next one; views at one place share what it stands for.
    ahead = np.diff(at, append=at[0] + TURN)
    # The widest may be the gap of a short scan, so that it does not say what is usual. A step
    # of more than a third of the circle is a gap even of few views: three even ones just reach
    # it.
    usual = _usual(np.delete(ahead, ahead.argmax()))
    for most in (GAP_STEPS, RANDOM_GAP_STEPS):
        open_ = (ahead > most * usual) | (ahead > TURN / 3 + 1e-6)
        gaps = np.column_stack([at, at + ahead])[open_]
        if _unseen(gaps, GAP_RAMP_RAD) <= 0.0:
            break
    ahead_half = np.where(open_, 0.0, ahead / 2)
    step = (ahead_half + np.roll(ahead_half, 1)) / np.bincount(same)
    return Circle(centre, radius, azimuth, step[same], gaps)


def _usual(steps: FloatArray) -> float:
    """Find the usual of steps (k,) [rad], a full turn without any.

    Narrower ones make up a third of the total: repeated turns do not matter.
    """
    ordered = np.sort(steps)
    covered = np.cumsum(ordered)
    if len(steps):
        return float(ordered[int(np.searchsorted(covered, covered[-1] / 3))])
    return TURN


def _helix(
    azimuth: FloatArray, height: FloatArray, centre: FloatArray, radius: float
) -> Circle | None:
    """Fit a helix that rises steadily for a turn or more without a gap.

    Args:
        azimuth: (n,) of the sources [rad].
        height: (n,) [mm].
        centre: (2,) [mm].
        radius: [mm].

    Returns:
        The helix, its angles counted from its lowest view and growing with height. None
        if the rise is at most `MAX_CIRCLE_RISE` of the radius, spans less than a turn,
        deviates by more than `MAX_HELIX_DEVIATION` of a turn's rise, or has an arc
        without views.
    """
    if np.ptp(height) <= MAX_CIRCLE_RISE * radius:
        return None
    order = np.argsort(height, kind="stable")
    run = np.empty(len(order))
    run[order] = np.unwrap(azimuth[order])
    span = float(np.ptp(run))
    if span * len(run) / (len(run) - 1) < TURN - 1e-6:
        return None
    slope, level = np.polyfit(run, height, 1)
    if np.abs(height - level - slope * run).max() > MAX_HELIX_DEVIATION * TURN * abs(
        slope
    ):
        return None
    # The ends of a helix need not meet: the first and the last view stand for whole steps.
    run *= np.sign(slope)
    order = np.argsort(run, kind="stable")
    gaps = np.diff(run[order])
    usual = _usual(gaps)
    if gaps.max() > RANDOM_GAP_STEPS * usual:
        return None
    ahead = np.concatenate([[usual], gaps, [usual]]) / 2
    step = np.empty(len(run))
    step[order] = ahead[:-1] + ahead[1:]
    rise = TURN * abs(float(slope))
    return Circle(centre, radius, run - run.min(), step, np.zeros((0, 2)), rise)


def redundancy(
    circle: Circle, cone_vec: ConeVec, cols: int, *, beyond: bool = False
) -> FloatArray:
    """Compute weights of rays so that a line and its opposite together count once.

    A ray and its opposite share by the confidence in each (Noo et al., Phys. Med. Biol.
    47 (2002) 2525), which falls smoothly to nothing towards a gap of the angles, and
    towards the near edge of a panel moved to one side by more than a column; with gaps
    the latter only if an object reaches `beyond` the near edge. In a full turn of a
    centered panel each counts 1/2.

    Args:
        circle: of the sources.
        cone_vec: n upright views.
        cols: columns of the panel.
        beyond: the object reaches beyond the panel's near edge.

    Returns:
        (n, cols) between 0 and 1.

    Raises:
        GeometryError: the axis is off the panel, or some lines are not seen from either
            side.
    """
    ends = _end_angles(circle, cone_vec, cols)
    low, high = reach(ends)
    if min(low, high) <= 0:
        raise GeometryError(
            "the shadow of the rotation axis does not fall on the detector, or within half a "
            "column of its edge; FDK needs it to",
            {"fan_deg": np.rad2deg([-low, high]).tolist()},
        )
    _check_covered(circle, float(np.abs(ends).max()))
    column = (low + high) / cols
    aside = abs(high - low) > column and (circle.full or beyond)
    if circle.full and not aside:
        return np.full((len(cone_vec), cols), 0.5)
    fan = fan_angles(circle, cone_vec, cols)
    overlap = min(low, high)
    least = 0.0 if circle.full else MIN_CONFIDENCE
    # +1 where only the ray itself falls on the panel, -1 its opposite
    alone = np.zeros_like(fan)
    if aside:
        taper = min(
            overlap, max(TAPER_REACHES * abs(high - low), MIN_TAPER_COLS * column)
        )
        side = fan if high > low else -fan
        past = np.clip((np.abs(side) - (overlap - taper)) / taper, 0.0, 1.0)
        alone = np.sign(side) * (1 - least) * np.sin(np.pi / 2 * past) ** 2
    angle = circle.angle[:, None]
    own = (1.0 + alone) * _confidence(circle, angle)
    other = (1.0 - alone) * _confidence(circle, angle + np.pi + 2 * fan)
    return np.asarray(own / (own + other))


def narrow_overlap(circle: Circle, cone_vec: ConeVec, cols: int) -> bool:
    """Return whether a panel moved aside sees few columns beyond the axis: fewer than twice
    `MIN_TAPER_COLS` on its near side. False for a panel centered within a column. `circle`: of
    the sources; `cone_vec`: n upright views; `cols`: columns of the panel."""
    low, high = panel_reach(circle, cone_vec, cols)
    column = (low + high) / cols
    return abs(high - low) > column and min(low, high) < 2 * MIN_TAPER_COLS * column


def axis_between(circle: Circle, cone_vec: ConeVec, shape: tuple[int, int]) -> ConeVec:
    """Move panels along rows, a quarter of a column at most: the axis is on or between
    columns.

    The weights' contribution to the filtered rows is odd about the axis, and cancels only
    where a ray and its opposite are sampled alike. Each view moves by its own amount.
    """
    axis = np.array([[*circle.centre, 0.0]])
    at = cone_vec.project_points(axis, shape)[:, 0, 0]
    moved = np.round(2.0 * at) / 2.0 - at
    return ConeVec.from_vectors(
        cone_vec.source,
        cone_vec.detector - moved[:, None] * cone_vec.u,
        cone_vec.u,
        cone_vec.v,
    )


def _confidence(circle: Circle, angle: FloatArray) -> FloatArray:
    """Compute the confidence in views at angles [rad]: 1, and 1e-12 in an arc without
    views.

    It falls over `GAP_RAMP_RAD`.
    """
    from_gap = circle.from_gap(angle)
    return np.asarray(
        np.sin(np.pi / 2 * np.minimum(from_gap / GAP_RAMP_RAD, 1.0)) ** 2 + 1e-12
    )


def _check_covered(circle: Circle, widest: float) -> None:
    """Check that the lines which arcs without views ("gaps") leave out, up to an angle of
    the fan, are seen from the opposite side.

    Args:
        circle: with its gaps.
        widest: largest fan angle [rad].

    Raises:
        GeometryError: some are not; names the first three arcs and the span that is
            needed.
    """
    if _unseen(circle.gaps, widest) > 1e-6:
        covered = TURN - float(np.diff(circle.gaps).sum())
        span, need = np.rad2deg([covered, np.pi + 2 * widest])
        # The source stands on -y at angle 0; a turn begins there.
        begins = (np.rad2deg(circle.gaps[:3, 0]) + 90.0) % 360.0
        wide = np.rad2deg(np.diff(circle.gaps[:3])[:, 0])
        listed = ", ".join(
            f"{first:.4g} to {first + width:.4g}"
            for first, width in zip(begins, wide, strict=True)
        )
        why = (
            f"the views span {span:.4g} deg of the circle, and with the gap at {listed} "
            f"deg they do not see every line: FDK needs {need:.4g} deg (half a turn and "
            "the fan) without a gap, or gaps that have views on the other side"
        )
        raise no_fdk(why, float(span), [float(need), 360.0])


def _unseen(gaps: FloatArray, widest: float) -> float:
    """Compute the largest overlap [rad] of an arc without views with the opposite of
    another.

    `gaps`: (k, 2) angles; `widest`: fan angle to either side [rad]. 0 or less if every
    line is seen from its other side.
    """
    width = np.diff(gaps)[:, 0]
    middle = gaps.mean(axis=1)
    apart = np.abs(
        (middle[:, None] - middle) % TURN - np.pi
    )  # of a gap and what is behind another
    return float(((width[:, None] + width) / 2 + 2 * widest - apart).max(initial=-TURN))


def reach(fan: FloatArray) -> tuple[float, float]:
    """Compute how far all fans (n, cols) reach [rad], clockwise and not, both
    positive.
    """
    return -float(fan.min(axis=1).max()), float(fan.max(axis=1).min())


def columns_beyond(circle: Circle, cone_vec: ConeVec, cols: int) -> tuple[int, int]:
    """Count the columns before the first and after the last by which a shifted panel is
    continued, so that its sides reach equally far from the axis.

    The filter's response to the panel's signal continues beyond its near edge. Voxels
    whose shadow falls there need it, as far out as the panel ends on the other side. At
    most `MAX_PANEL_WIDTHS` panels.

    Args:
        circle: of the sources.
        cone_vec: n upright views.
        cols: columns of the panel.

    Returns:
        (before, after), each 0 for a centered panel.
    """
    widest = max(panel_reach(circle, cone_vec, cols))
    source = cone_vec.source[:, :2]
    inward = circle.centre - source
    panel = cone_vec.detector[:, :2] - source
    ends = []
    for angle in (-widest, widest):
        c = np.cos(angle)
        s = np.sin(angle)
        ray = inward @ np.array([[c, s], [-s, c]])
        ends.append(-_cross(ray, panel) / _cross(ray, cone_vec.u[:, :2]) + (cols - 1) / 2)
    before = -float(np.min(ends))
    after = float(np.max(ends)) - (cols - 1)
    # Rounded first: sources in another order differ in the last bits, which must not decide.
    needed = np.ceil(np.round([before - 0.5, after - 0.5], 6))
    first, last = np.clip(needed, 0, MAX_PANEL_WIDTHS * cols)
    return int(first), int(last)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def fan_angles(circle: Circle, cone_vec: ConeVec, cols: int) -> FloatArray:
    """Compute each column's horizontal angle from the line to the axis, (n, cols)
    [rad].
    """
    return _angles_at(circle, cone_vec, np.arange(float(cols)) - (cols - 1) / 2)


def panel_reach(circle: Circle, cone_vec: ConeVec, cols: int) -> tuple[float, float]:
    """Compute `reach` of a panel from the few columns that hold its ends."""
    return reach(_end_angles(circle, cone_vec, cols))


def _end_angles(circle: Circle, cone_vec: ConeVec, cols: int) -> FloatArray:
    """Compute the fan angles among which the smallest and the largest of each view are, (n,
    columns) [rad]: those of the outermost columns, or of all.
    """
    ends = _angles_at(circle, cone_vec, np.array([-(cols - 1) / 2, (cols - 1) / 2]))
    # Columns between two that lie on the axis's side of the source have angles between theirs.
    if np.abs(ends).max() < np.pi / 2:
        return ends
    return fan_angles(circle, cone_vec, cols)


def _angles_at(circle: Circle, cone_vec: ConeVec, offset: FloatArray) -> FloatArray:
    """Compute `fan_angles` of columns at distances `offset` (k,) from the panel's middle
    [columns], (n, k) [rad].
    """
    inward_x, inward_y = (circle.centre - cone_vec.source[:, :2]).T[:, :, None]
    middle_x, middle_y = (cone_vec.detector - cone_vec.source).T[:2, :, None]
    step_x, step_y = cone_vec.u.T[:2, :, None]
    x = middle_x + offset * step_x
    y = middle_y + offset * step_y
    return np.asarray(
        np.arctan2(inward_x * y - inward_y * x, inward_x * x + inward_y * y)
    )
