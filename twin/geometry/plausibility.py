"""Doubts where a geometry meets a sample: numbers that fit no scan, such as metres for mm."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray

MOST_MAGNIFIED: Final = 1000.0
"""No tube has a focal spot that is worth more."""
UNITS: Final = "; are all lengths in mm?"


def geometry_doubts(
    cone_vec: ConeVec, shape: tuple[int, int], boxes: npt.ArrayLike
) -> Iterator[str]:
    """What is doubtful about the views of a sample.

    Args:
        cone_vec: the views.
        shape: detector (rows, cols).
        boxes: low and high corner of the box around each part of the sample, (k, 2, 3) [mm].

    Example:
        >>> scan = ConeVec.circular(sod=0.6, sdd=1.06, angles=4, pixel=1.5e-4)
        >>> list(geometry_doubts(scan, (760, 956), [[[-5, -5, -5], [5, 5, 5]]]))
        ['the source is inside the box around the sample in 4 of 4 views; are all lengths in mm?']
    """
    parts = np.asarray(boxes, dtype=np.float64)
    if not len(parts) or not len(cone_vec):
        return
    low, high = parts[:, 0].min(axis=0), parts[:, 1].max(axis=0)
    inside = np.zeros(len(cone_vec), bool)
    for part in parts:
        inside |= ((cone_vec.source > part[0]) & (cone_vec.source < part[1])).all(axis=1)
    if inside.any():
        count = f"{inside.sum()} of {len(inside)} views"
        yield f"the source is inside the box around the sample in {count}{UNITS}"
        return
    toward = cone_vec.normal * np.sign(cone_vec.source_detector_distance)[:, None]
    distance = np.abs(cone_vec.source_detector_distance)
    corners = np.array(list(product(*np.stack([low, high], axis=1))))
    depths = np.einsum("nki,ni->nk", corners - cone_vec.source[:, None], toward)
    if not _seen(cone_vec.project_points(corners, shape), depths > 0.0, shape).any():
        yield f"the sample is outside every view: no ray that reaches the panel meets it{UNITS}"
        return
    magnified = float((distance / np.maximum(depths.mean(axis=1), 1e-9)).max())
    pixel = float(np.linalg.norm(cone_vec.u, axis=1).max())
    if magnified > MOST_MAGNIFIED:
        yield f"the magnification is {magnified:.4g}, above {MOST_MAGNIFIED:g}{UNITS}"
    if (largest := float((high - low).max())) * magnified < pixel:
        yield (
            f"the sample measures {largest:.3g} mm, magnified {magnified:.3g} times less than a "
            f"pixel of {pixel:.3g} mm{UNITS}"
        )


def _seen(
    places: FloatArray, ahead: npt.NDArray[np.bool_], shape: tuple[int, int]
) -> npt.NDArray[np.bool_]:
    """Views on whose panel a box may cast a shadow, (n,), from its corners' images (n, 8, 2).

    A box that the source's plane crosses may be anywhere.
    """
    far = np.array(shape[::-1]) - 0.5
    overlap = (places.max(axis=1) > -0.5) & (places.min(axis=1) < far)
    return np.asarray(ahead.any(axis=1) & (overlap.all(axis=1) | ~ahead.all(axis=1)))
