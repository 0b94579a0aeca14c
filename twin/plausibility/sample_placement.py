"""Where a geometry meets a sample: numbers that fit no scan, such as meters for mm."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.findings import Finding, warning
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.virtual_panel import stretches
from flexdt.twin.plausibility.contradictions import PlausibilityCode

MOST_MAGNIFIED: Final = 1000.0
"""Largest magnification for which a tube's focal spot is small enough."""
MOST_OVERSIZE: Final = 100.0
"""Largest size of a sample's shadow relative to the panel; above, units are mixed up."""
FEWEST_PIXELS: Final = 16
"""Least rows and columns of a panel; fewer are single rays through a sample."""
UNITS: Final = "are all lengths in mm?"


def placement_findings(
    cone_vec: ConeVec,
    shape: tuple[int, int],
    boxes: npt.ArrayLike,
    *,
    exposed: bool = False,
) -> Iterator[Finding]:
    """Warn if sample, source and panel do not fit each other.

    Stops at the first of: the source in a part's box, no view sees the sample, the panel
    in the sample's box (only if `exposed`). Otherwise may yield several "units" warnings:
    magnification above `MOST_MAGNIFIED`, a shadow smaller than a pixel, or one over
    `MOST_OVERSIZE` times a panel of at least `FEWEST_PIXELS` rows and columns in every
    view, all before the source. Nothing without boxes or views.

    Args:
        cone_vec: the views.
        shape: detector (rows, cols).
        boxes: low and high corner of the box around each part of the sample, (k, 2, 3)
            [mm].
        exposed: images are exposed, so that the panel is no virtual one.

    Example:
        >>> scan = ConeVec.circular(sod=0.6, sdd=1.06, angles=4, pixel=1.5e-4)
        >>> found = placement_findings(scan, (760, 956), [[[-5, -5, -5], [5, 5, 5]]])
        >>> [one.text for one in found]
        ['the source is inside the box around the sample in 4 of 4 views; are all lengths in mm?']
    """
    parts = np.asarray(boxes, dtype=np.float64)
    if not len(parts) or not len(cone_vec):
        return
    low = parts[:, 0].min(axis=0)
    high = parts[:, 1].max(axis=0)
    inside = np.zeros(len(cone_vec), bool)
    for part in parts:
        inside |= ((cone_vec.source > part[0]) & (cone_vec.source < part[1])).all(axis=1)
    if inside.any():
        count = f"{inside.sum()} of {len(inside)} views"
        cause = f"the source is inside the box around the sample in {count}"
        yield warning(
            PlausibilityCode.SOURCE_IN_THE_SAMPLE,
            cause,
            UNITS,
            figure=float(inside.mean()),
        )
        return
    toward = cone_vec.normal * np.sign(cone_vec.source_detector_distance)[:, None]
    distance = np.abs(cone_vec.source_detector_distance)
    corners = np.array(list(product(*np.stack([low, high], axis=1))))
    depths = np.einsum("nki,ni->nk", corners - cone_vec.source[:, None], toward)
    places = cone_vec.project_points(corners, shape)
    seen = _seen(places, depths > 0.0, shape)
    if not seen.any():
        cause = "the sample is outside every view: no ray that reaches the panel meets it"
        yield warning(PlausibilityCode.SAMPLE_NOT_SEEN, cause, UNITS)
        return
    cut = stretches(cone_vec, corners) > 1.0
    if exposed and cut.any():
        cause = (
            f"the panel stands before or in the box around the sample in {cut.sum()} "
            f"of {len(cut)} views: rays run through it, as through a virtual one"
        )
        yield warning(
            PlausibilityCode.PANEL_IN_THE_SAMPLE, cause, UNITS, figure=float(cut.mean())
        )
        return
    magnified = float((distance / np.maximum(depths.mean(axis=1), 1e-9)).max())
    pixel = float(np.linalg.norm(cone_vec.u, axis=1).max())
    if magnified > MOST_MAGNIFIED:
        cause = f"the magnification is {magnified:.4g}, above {MOST_MAGNIFIED:g}"
        yield warning(PlausibilityCode.UNITS, cause, UNITS, figure=magnified)
    if (largest := float((high - low).max())) * magnified < pixel:
        cause = (
            f"the sample measures {largest:.3g} mm, magnified {magnified:.3g} times less "
            f"than a pixel of {pixel:.3g} mm"
        )
        yield warning(PlausibilityCode.UNITS, cause, UNITS, figure=largest)
    ahead = (depths > 0.0).all(axis=1)
    if ahead.all() and min(shape) >= FEWEST_PIXELS:
        times = float((np.ptp(places, axis=1) / shape[::-1]).min(axis=1).min())
        if times > MOST_OVERSIZE:
            cause = f"the sample's shadow is {times:.3g} times as large as the panel in every view"
            yield warning(PlausibilityCode.UNITS, cause, UNITS, figure=times)


def _seen(
    places: FloatArray, ahead: npt.NDArray[np.bool_], shape: tuple[int, int]
) -> npt.NDArray[np.bool_]:
    """Mark the views (n,) on whose panel a box may cast a shadow.

    `places`: its 8 corners' images [px], `ahead` of the source or not. One across the
    source's plane counts as seen.
    """
    far = np.array(shape[::-1]) - 0.5
    overlap = (places.max(axis=1) > -0.5) & (places.min(axis=1) < far)
    return np.asarray(ahead.any(axis=1) & (overlap.all(axis=1) | ~ahead.all(axis=1)))
