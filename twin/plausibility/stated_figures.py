"""Comparison of a file's angles and pixel size with the given geometry."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import product
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.findings import Finding, warning
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.plausibility.contradictions import PlausibilityCode
from flexdt.twin.plausibility.scan_geometry import about_z, azimuths

ANGLE_TOLERANCE_DEG: Final = 0.1
"""Largest difference of angles by encoders [deg]."""
ANGLE_TOLERANCE_STEPS: Final = 0.2
"""The same as a share of the step between views; the larger of both counts."""
PIXEL_TOLERANCE: Final = 0.02
"""Largest relative difference of pixel sizes, some of which have two digits."""


def angle_findings(geometry: ConeVec, stated_rad: npt.ArrayLike) -> Iterator[Finding]:
    """Compare a file's angles with the geometry's, whatever their zero and sense are.

    Yields at most one warning: angles are not finite (its figure: how many), degrees and
    radians are confused, the order is another, or the angles differ; its figure is the
    largest difference [deg]. Nothing if they agree within `ANGLE_TOLERANCE_DEG` or
    `ANGLE_TOLERANCE_STEPS` steps, if their number is not the views' or below 3, if they
    are all equal, or if the geometry does not turn about z.

    Args:
        geometry: n views.
        stated_rad: (n,) [rad].
    """
    stated = np.asarray(stated_rad, dtype=np.float64).ravel()
    if len(stated) != len(geometry) or len(stated) < 3:
        return
    lost = int((~np.isfinite(stated)).sum())
    if lost:
        cause = f"{lost} of the file's {len(stated)} angles are not finite"
        remedy = "they are not compared with the geometry"
        yield warning(PlausibilityCode.ANGLES_DISAGREE, cause, remedy, figure=float(lost))
        return
    if not about_z(geometry) or np.ptp(stated) == 0.0:
        return
    own = np.asarray(azimuths(geometry))
    off = _worst(own, stated)
    step = float(np.median(np.abs(_wrapped(np.diff(own)))))
    allowed = max(math.radians(ANGLE_TOLERANCE_DEG), ANGLE_TOLERANCE_STEPS * step)
    if off <= allowed:
        return
    figure = math.degrees(off)
    for scale, words in ((math.pi / 180, "degrees"), (180 / math.pi, "radians")):
        if _worst(own, scale * stated) <= allowed:
            span = float(np.ptp(stated))
            cause = (
                f"the file's angles span {span:.4g} rad and are the geometry's as {words}"
            )
            remedy = "does the file state the right unit?"
            if words == "degrees":
                kind = PlausibilityCode.ANGLES_IN_DEGREES
            else:
                kind = PlausibilityCode.ANGLES_IN_RADIANS
            yield warning(kind, cause, remedy, figure=figure)
            return
    if _same_set(own, stated, allowed):
        cause = f"the file's angles are the geometry's in another order, up to {figure:.3g} deg off"
        remedy = "give the views in the order of the images"
        yield warning(PlausibilityCode.ORDER, cause, remedy, figure=figure)
        return
    cause = (
        f"the file's angles and those of the geometry differ by up to {figure:.3g} deg"
    )
    remedy = "is it the geometry of this scan?"
    yield warning(PlausibilityCode.ANGLES_DISAGREE, cause, remedy, figure=figure)


def pixel_findings(geometry: ConeVec, stated_mm: float) -> Iterator[Finding]:
    """Compare a file's pixel with the geometry's, on the panel or scaled to the rotation
    axis, both from the first view's columns.

    Yields at most one warning, its figure the ratio to the panel's pitch, if both differ
    by more than `PIXEL_TOLERANCE`; nothing without views or for a stated pitch that is
    not a positive number.

    Args:
        geometry: the views.
        stated_mm: pitch of the pixels [mm].
    """
    if not (math.isfinite(stated_mm) and stated_mm > 0.0) or not len(geometry):
        return
    pitch = float(np.linalg.norm(geometry.u[0]))
    beam = geometry.detector[0] - geometry.source[0]
    part = float(-geometry.source[0] @ beam / (beam @ beam))
    ratios = [stated_mm / pitch, stated_mm / (pitch * part) if part > 0.0 else math.inf]
    if min(abs(ratio - 1.0) for ratio in ratios) <= PIXEL_TOLERANCE:
        return
    cause = f"the file's pixel is {stated_mm:.4g} mm, the geometry's {pitch:.4g} mm"
    remedy = "is it the geometry of this scan, binned as its images are, and in mm?"
    yield warning(PlausibilityCode.PIXEL_SIZE_DISAGREES, cause, remedy, figure=ratios[0])


def _wrapped(angle: FloatArray) -> FloatArray:
    return np.asarray((angle + math.pi) % math.tau - math.pi)


def _worst(own: FloatArray, stated: FloatArray) -> float:
    """Compute the largest difference of angles [rad] modulo a turn, in the better sense.

    The mean difference counts as zero.
    """
    found = []
    for sense in (1.0, -1.0):
        off = own - sense * stated
        middle = math.atan2(float(np.sin(off).mean()), float(np.cos(off).mean()))
        found.append(float(np.abs(_wrapped(off - middle)).max()))
    return min(found)


def _same_set(own: FloatArray, stated: FloatArray, allowed: float) -> bool:
    """Check whether two sets of angles are equal modulo a turn in another order: the
    geometry's counted from its first or last one, the stated ones from their first, last
    or least, in either sense.

    Args:
        own: (n,) angles of the geometry [rad].
        stated: (n,) stated angles [rad].
        allowed: sorted angles may differ by twice this [rad].
    """
    for sense in (1.0, -1.0):
        turned = sense * stated
        zeros = {float(turned[0]), float(turned[-1]), float(turned.min())}
        for zero, start in product(zeros, {float(own[0]), float(own[-1])}):
            each = np.sort((own - start + allowed) % math.tau)
            other = np.sort((turned - zero + allowed) % math.tau)
            if np.abs(each - other).max() <= 2 * allowed:
                return True
    return False
