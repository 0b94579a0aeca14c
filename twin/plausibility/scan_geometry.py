"""Checks of a scan's geometry alone: distances, units, and coverage of angles for a
method.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.findings import ERROR, WARNING, Finding, error, warning
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray, cross
from flexdt.twin.plausibility.contradictions import PlausibilityCode

SOME_VIEWS: Final = 16
"""Number of views whose panels are examined."""
WIDEST_DEG: Final = 120.0
"""Largest angle under which a source sees a panel [deg]."""
MOST_PITCH: Final = 0.5
"""Largest pixel pitch relative to the distance of source and panel."""
RADIANS_SPAN: Final = 4 * math.pi * 1.01
"""Largest span of angles given in radians, two turns; as degrees it is a few degrees
[rad]."""
RADIANS_VIEWS: Final = 8
"""Number of views from which on so narrow a span is doubtful."""
MOST_TURNS: Final = 20.0
"""Number of turns of a circular scan above which degrees were given as radians."""
FEW_A_TURN: Final = 12.0
"""Views a turn below which several turns of equal steps are degrees given as radians."""
GOLDEN: Final = (math.pi * (3 - math.sqrt(5)), math.pi * (math.sqrt(5) - 1))
"""Steps of golden ratio between views, whose turns overlap by intention [rad]."""
MISSING_DEG: Final = (12.0, 30.0)
"""Gaps of directions from which an arc is limited, for even views and for others
[deg]."""
TIMES_USUAL: Final = (8.0, 5.0)
"""Least size of the same gaps, in usual steps."""
UNSEEN_DEG: Final = 20.0
"""Least angle between all beams and a plane from which a trajectory leaves that plane
out [deg]."""
SPARSE_VIEWS: Final = 10.0
"""Over the number of views: sine of the same angle that few views leave by chance."""
PROBES: Final = 500
"""Number of planes that are compared with the beams."""
INCLINED_DEG: Final = (10.0, 20.0)
"""Inclinations of the beam to the plane of rotation at which FDK warns and refuses
[deg]."""
FDK_TOO: Final = "an iterative method (sirt, cgls, tv) takes any trajectory"


def distance_findings(
    sod: float,
    sdd: float,
    pixel: npt.ArrayLike,
    names: tuple[str, str] = ("SOD", "SDD"),
    of_pixel: str = "the pixel",
) -> Iterator[Finding]:
    """Find distances and pixels that no scanner has.

    Yields (does not raise) at most one refusal: distances that are not finite with 0 <
    SOD <= SDD, pitches that are not finite and positive, or pitches above `MOST_PITCH`
    times SDD.

    Args:
        sod, sdd: source to axis and to panel [mm].
        pixel: one pitch or several [mm].
        names: of the distances in the file or dictionary.
        of_pixel: name of the pixel there.
    """
    pitches = np.atleast_1d(np.asarray(pixel, dtype=np.float64))
    if not (math.isfinite(sod) and math.isfinite(sdd) and 0.0 < sod <= sdd):
        cause = f"{names[0]} is {sod:g} mm and {names[1]} {sdd:g} mm"
        allowed = f"allowed: 0 < {names[0]} <= {names[1]}"
        yield error(PlausibilityCode.IMPOSSIBLE_DISTANCES, cause, allowed, figure=sod)
        return
    if not (np.isfinite(pitches).all() and (pitches > 0.0).all()):
        cause = f"{of_pixel} is {' x '.join(f'{p:g}' for p in pitches)} mm"
        yield error(
            PlausibilityCode.IMPOSSIBLE_DISTANCES,
            cause,
            "allowed: above 0",
            figure=float(pitches[0]),
        )
        return
    if float(pitches.max()) > MOST_PITCH * sdd:
        cause = f"{names[1]} is {sdd:g} mm with pixels of {pitches.max():g} mm"
        allowed = f"allowed: pixels below {MOST_PITCH:g} times {names[1]}; are all lengths in mm?"
        yield error(PlausibilityCode.IMPOSSIBLE_DISTANCES, cause, allowed, figure=sdd)


def geometry_findings(
    cone_vec: ConeVec, shape: tuple[int, int] | None
) -> Iterator[Finding]:
    """Find rows of a geometry that no scanner has.

    Yields at most one finding: pixels above `MOST_PITCH` times their distance or a source
    that stands still (refusals), or a panel seen under more than `WIDEST_DEG` along its
    diagonal (a warning, from up to `SOME_VIEWS` views, needs `shape`). Nothing without
    views.

    Args:
        cone_vec: n views.
        shape: detector (rows, cols), or None to skip the check of the angle.
    """
    if not len(cone_vec):
        return
    normal = cross(cone_vec.u, cone_vec.v)
    with np.errstate(all="ignore"):
        beam = np.einsum("ni,ni->n", cone_vec.detector - cone_vec.source, normal)
        distance = np.nan_to_num(
            np.abs(beam) / np.sqrt(np.einsum("ni,ni->n", normal, normal))
        )
    edges = (np.einsum("ni,ni->n", edge, edge) for edge in (cone_vec.u, cone_vec.v))
    pitch = np.sqrt(np.maximum(*edges))
    worst = int(np.argmax(pitch - MOST_PITCH * distance))
    if pitch[worst] > MOST_PITCH * distance[worst]:
        cause = (
            f"view {worst}: the panel is {distance[worst]:.3g} mm from the source, its pixels "
            f"measure {pitch[worst]:.3g} mm"
        )
        allowed = f"allowed: pixels below {MOST_PITCH:g} times the distance; are all lengths in mm?"
        figure = float(pitch[worst] / max(distance[worst], 1e-300))
        yield error(PlausibilityCode.IMPOSSIBLE_DISTANCES, cause, allowed, figure=figure)
        return
    if _still_source(cone_vec, distance):
        cause = "the source stands still while the panel turns about it: SOD is 0"
        allowed = "allowed: a source before the axis"
        yield error(PlausibilityCode.IMPOSSIBLE_DISTANCES, cause, allowed)
        return
    if shape is None:
        return
    ends = cone_vec[:: -(-len(cone_vec) // SOME_VIEWS)].rays(shape)
    across = (shape[1] - 1) * ends[:, 6:9]
    first = ends[:, 3:6] + 0.5 * (shape[0] - 1) * ends[:, 9:12]
    last = first + across
    lengths = np.linalg.norm(first, axis=1) * np.linalg.norm(last, axis=1)
    cosine = np.einsum("ni,ni->n", first, last) / np.maximum(lengths, 1e-300)
    fan = float(np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0))).max())
    if fan > WIDEST_DEG:
        wide = float(np.linalg.norm(across, axis=1).max())
        cause = (
            f"the source sees the panel of {wide:.4g} mm under {fan:.3g} deg, pixels of "
            f"{pitch.max():.3g} mm at {distance.min():.4g} mm"
        )
        yield warning(PlausibilityCode.UNITS, cause, "are all lengths in mm?", figure=fan)


def _still_source(cone_vec: ConeVec, distance: FloatArray) -> bool:
    """Return whether all views (3 at least) have one source, with beams more than 120 deg
    apart.

    Args:
        cone_vec: n views.
        distance: of source and panel, (n,) [mm]; 1e-9 of the largest counts as no motion.
    """
    if len(cone_vec) < 3:
        return False
    # Two views tell most scans, at a tenth of the time.
    source = cone_vec.source
    most = 1e-9 * distance.max()
    if float(np.abs(source[len(source) // 2] - source[0]).max()) > most:
        return False
    if float(np.ptp(source, axis=0).max()) > most:
        return False
    beam = cone_vec.detector - cone_vec.source
    unit = beam / np.linalg.norm(beam, axis=1, keepdims=True)
    return bool((unit @ unit[0]).min() < -0.5)


def radian_findings(angles: npt.ArrayLike) -> Iterator[Finding]:
    """Find degrees in angles of a circular scan that are to be radians.

    Yields at most one warning, its figure the span [rad]: more than `MOST_TURNS` turns,
    or fewer than `FEW_A_TURN` views a turn with a span that is round in degrees. Nothing
    for fewer than `RADIANS_VIEWS` or not finite angles, less than 2.5 turns, or steps of
    the golden ratio (`GOLDEN`).

    Args:
        angles: (n,) in any order.

    Example:
        >>> [str(one.code) for one in radian_findings(np.arange(0, 360, 2))]
        ['angles in degrees']
        >>> list(radian_findings(np.deg2rad(np.arange(0, 360, 2))))
        []
    """
    given = np.asarray(angles, dtype=np.float64).ravel()
    if len(given) < RADIANS_VIEWS or not np.isfinite(given).all():
        return
    span = float(np.ptp(given))
    turns = span / math.tau
    if turns < 2.5:
        return
    steps = np.diff(np.sort(given))
    usual = float(np.median(steps))
    if any(abs(usual / step - 1.0) < 1e-4 for step in GOLDEN):
        return
    few = len(given) / turns < FEW_A_TURN and _round_degrees(span, usual)
    if turns > MOST_TURNS or few:
        cause = f"the angles span {span:.4g} rad, {turns:.3g} turns of {len(given)} views"
        remedy = "were degrees given? ASTRA's are radians: np.deg2rad(angles)"
        yield warning(PlausibilityCode.ANGLES_IN_DEGREES, cause, remedy, figure=span)


def _round_degrees(span: float, step: float) -> bool:
    """Return whether a span [deg], or with a step more, is a multiple of 5."""
    return any(
        abs(whole / 5.0 - round(whole / 5.0)) < 2e-3 and whole > 0
        for whole in (span, span + step)
    )


def arc_deg(cone_vec: ConeVec) -> float:
    """Compute the arc that the views of a circular scan cover [deg]: the full turn
    without its widest gap between neighboring directions of beams (0 for one view)."""
    return _arc_of(azimuths(cone_vec))


def _arc_of(azimuth: FloatArray) -> float:
    """Compute the arc that directions cover [deg]; see `arc_deg`."""
    at = np.sort(azimuth % math.tau)
    gaps = np.diff(at, append=at[0] + math.tau)
    return float(np.rad2deg(math.tau - gaps.max()))


def azimuths(cone_vec: ConeVec) -> FloatArray:
    """Compute the direction of each view's beam about z, (n,) [rad]."""
    beam = cone_vec.detector - cone_vec.source
    return np.asarray(np.arctan2(beam[:, 1], beam[:, 0]))


def about_z(cone_vec: ConeVec) -> bool:
    """Return whether the views turn about z, as on a circle or helix: inclinations of the
    central beams to the horizontal differ by less than 0.2 rad, and none is nearly
    vertical (within 3 deg).
    """
    beam = cone_vec.detector - cone_vec.source
    level = np.hypot(beam[:, 0], beam[:, 1])
    if not (level > 0.05 * np.linalg.norm(beam, axis=1)).all():
        return False
    return float(np.ptp(np.arctan2(beam[:, 2], level))) < 0.2


def span_findings(cone_vec: ConeVec) -> Iterator[Finding]:
    """Warn of radians given as degrees: `RADIANS_VIEWS` views or more about z within less
    than `RADIANS_SPAN` degrees.

    Yields at most one finding, its figure the span [deg]; nothing for a span of 0.
    """
    if len(cone_vec) < RADIANS_VIEWS:
        return
    azimuth = azimuths(cone_vec)
    # More views never cover less: some of them tell most scans.
    if _arc_of(azimuth[:: len(azimuth) // RADIANS_VIEWS]) >= RADIANS_SPAN:
        return
    span = _arc_of(azimuth)
    if 0.0 < span < RADIANS_SPAN and about_z(cone_vec):
        cause = f"{len(cone_vec)} views span {span:.4g} deg"
        remedy = (
            f"were radians given as degrees? np.rad2deg makes them {np.rad2deg(span):.4g}"
        )
        yield warning(PlausibilityCode.ANGLES_IN_RADIANS, cause, remedy, figure=span)


def arc_findings(cone_vec: ConeVec) -> Iterator[Finding]:
    """Warn if the views leave out an arc of directions, for a method that takes any
    trajectory.

    The widest gap, less the mean of the others, must exceed one of `MISSING_DEG`, and the
    gap as many `TIMES_USUAL` that mean. Yields at most one finding, its figure the gap
    [deg]. Opposite directions count as one. Views that do not turn about z leave out a
    plane if all beams are more than `UNSEEN_DEG` from it, its figure that angle [deg].
    Nothing for fewer than 3 views, or directions about z.
    """
    if len(cone_vec) < 3:
        return
    if not about_z(cone_vec):
        yield from _plane_findings(cone_vec)
        return
    at = np.unique((azimuths(cone_vec) % math.pi).round(6) % round(math.pi, 6))
    if len(at) < 3:
        return
    gaps = np.rad2deg(np.diff(at, append=at[0] + math.pi))
    widest = float(gaps.max())
    usual = (180.0 - widest) / (len(gaps) - 1)
    limited = any(
        widest - usual > least and widest > times * usual
        for least, times in zip(MISSING_DEG, TIMES_USUAL, strict=True)
    )
    if limited:
        cause = (
            f"the views leave out {widest:.3g} of 180 deg of directions: edges along those are "
            "blurred or missing, and values off"
        )
        remedy = (
            "views over half a turn and the fan are needed for a volume that is right"
        )
        yield warning(PlausibilityCode.LIMITED_ARC, cause, remedy, figure=widest)


def _plane_findings(cone_vec: ConeVec) -> Iterator[Finding]:
    """Warn if all beams of a trajectory of any form leave out a plane.

    Yields at most one finding, its figure the angle between that plane and the nearest
    beam [deg]; nothing for so few views that they would leave it out by chance.

    Args:
        cone_vec: 3 views or more.
    """
    beams = cone_vec.detector - cone_vec.source
    beams = beams / np.linalg.norm(beams, axis=1, keepdims=True)
    sines = np.abs(_normals(PROBES) @ beams.T).min(axis=1)
    unseen = float(sines.max())
    by_chance = SPARSE_VIEWS / len(cone_vec)
    if unseen <= max(math.sin(math.radians(UNSEEN_DEG)), by_chance):
        return
    apart = math.degrees(math.asin(min(unseen, 1.0)))
    cause = (
        f"the beams of all views are {apart:.3g} deg or more from some planes: edges along "
        "those are blurred or missing, and values off"
    )
    remedy = "views from more sides are needed for a volume that is right"
    yield warning(PlausibilityCode.LIMITED_ARC, cause, remedy, figure=apart)


def _normals(count: int) -> FloatArray:
    """Return directions spread evenly over half a sphere, (count, 3)."""
    height = (np.arange(count) + 0.5) / count
    turn = GOLDEN[0] * np.arange(count)
    level = np.sqrt(1.0 - height**2)
    return np.stack([level * np.cos(turn), level * np.sin(turn), height], axis=1)


def inclination_findings(cone_vec: ConeVec, centre: npt.ArrayLike) -> Iterator[Finding]:
    """Find laminography: a beam inclined to the plane of rotation, where FDK is wrong.

    Yields at most one finding, a warning above 10 deg or a refusal above 20 deg
    (`INCLINED_DEG`); its figure is the smallest inclination of any view's beam to the
    panel's center or to the grid's. Nothing for fewer than 3 views, a scan that is not
    about z or whose source rises, or if grid and panel are on different sides of the
    plane.

    Args:
        cone_vec: views of a circle about z.
        centre: of the grid, (3,) [mm].
    """
    if (
        len(cone_vec) < 3
        or not about_z(cone_vec)
        or np.ptp(cone_vec.source[:, 2])
        > 1e-3 * (np.abs(cone_vec.source_detector_distance).max())
    ):
        return
    beam = cone_vec.detector - cone_vec.source
    towards = np.asarray(centre, dtype=np.float64) - cone_vec.source
    angles = [
        np.rad2deg(np.arctan2(ray[:, 2], np.hypot(ray[:, 0], ray[:, 1])))
        for ray in (beam, towards)
    ]
    if np.sign(angles[0].mean()) != np.sign(angles[1].mean()):
        return
    inclined = float(min(np.abs(one).min() for one in angles))
    if inclined > INCLINED_DEG[0]:
        cause = (
            f"the beam is inclined by {inclined:.3g} deg to the plane in which the "
            "source turns (laminography), where FDK is wrong"
        )
        refused = inclined > INCLINED_DEG[1]
        if refused:
            severity = ERROR
        else:
            severity = WARNING
        yield Finding(
            PlausibilityCode.LAMINOGRAPHY, severity, cause, FDK_TOO, figure=inclined
        )
