"""Objects of the benchmark's reconstructions: four kinds of images on an upright panel's
circle.

Images of zeros would hide all costs that depend on the object. Path lengths are closed
forms: tall cylinders, whose chord depends on the column alone, times the ratio of a ray's
length to that of its horizontal part.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray

ATTENUATION: Final = 0.02
"""Attenuation of all objects [1/mm]."""
COMPLETE_RADIUS: Final = 0.6
"""Radius of a completely seen object, over that of the field of view."""
CUT_OFF_RADIUS: Final = 1.5
"""Radius of an object that the panel cuts off, over that of the field of view."""
ROD_RADIUS: Final = 0.1
"""Radius of the holder, whose axis is at the edge of the field of view, over its radius."""
NOISE_COUNT: Final = 32
"""Number of noise images that are drawn; more views repeat them."""


def field_mm(scan: ConeVec, shape: tuple[int, int]) -> float:
    """Compute the radius about the z axis that the first view of a circle sees on both
    sides [mm], to the centers of the outer columns.
    """
    ends = (np.array([0.0, shape[1] - 1.0]) - (shape[1] - 1) / 2)[:, None]
    ray = (scan.detector[0] + ends * scan.u[0] - scan.source[0])[:, :2]
    source = scan.source[0, :2]
    missed = source[0] * ray[:, 1] - source[1] * ray[:, 0]
    return float(np.abs(missed / np.linalg.norm(ray, axis=1)).min())


def cylinders(
    scan: ConeVec, shape: tuple[int, int], parts: list[tuple[float, float]]
) -> Float32Array:
    """Compute line integrals of upright cylinders, (n, rows, cols).

    Each attenuates by `ATTENUATION`; overlapping ones add up.

    Args:
        scan: a circle with upright panels.
        shape: (rows, cols).
        parts: (x, radius) of each, in the plane y = 0 [mm].
    """
    cols = shape[1]
    across = (np.arange(cols) - (cols - 1) / 2)[:, None]
    flat = np.zeros((len(scan), cols))
    for view in range(len(scan)):
        ray = (scan.detector[view] + across * scan.u[view] - scan.source[view])[:, :2]
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        for x, radius in parts:
            to = np.array([x, 0.0]) - scan.source[view, :2]
            missed = to[0] * ray[:, 1] - to[1] * ray[:, 0]
            flat[view] += (
                2.0 * ATTENUATION * np.sqrt(np.maximum(radius**2 - missed**2, 0.0))
            )
    return (flat[:, None] * _longer(scan, shape)).astype(np.float32)


def _longer(scan: ConeVec, shape: tuple[int, int]) -> FloatArray:
    """Compute the length of the first view's rays over that of their horizontal part,
    (rows, cols).
    """
    r, c = (np.arange(size) - (size - 1) / 2 for size in shape)
    ray = scan.detector[0] + c[None, :, None] * scan.u[0] + r[:, None, None] * scan.v[0]
    ray = ray - scan.source[0]
    length = np.linalg.norm(ray, axis=2) / np.linalg.norm(ray[..., :2], axis=2)
    return np.asarray(length)


def whole(scan: ConeVec, shape: tuple[int, int]) -> Float32Array:
    """Compute the images of an object that is complete in all views."""
    return cylinders(scan, shape, [(0.0, COMPLETE_RADIUS * field_mm(scan, shape))])


def cut_off(scan: ConeVec, shape: tuple[int, int]) -> Float32Array:
    """Compute the images of an object that extends beyond both sides of the panel in
    all views."""
    return cylinders(scan, shape, [(0.0, CUT_OFF_RADIUS * field_mm(scan, shape))])


def holder(scan: ConeVec, shape: tuple[int, int]) -> Float32Array:
    """Compute the images (views, rows, cols) of a cylinder on the axis, seen whole, and a
    rod that the panel's edge cuts off in some views.
    """
    field = field_mm(scan, shape)
    return cylinders(
        scan, shape, [(0.0, COMPLETE_RADIUS * field), (field, ROD_RADIUS * field)]
    )


def noise(scan: ConeVec, shape: tuple[int, int]) -> Float32Array:
    """Draw images (n, rows, cols) of random numbers from 0 to 1, always the same;
    `NOISE_COUNT` of them are repeated.
    """
    drawn = np.random.default_rng(0).random(
        (min(NOISE_COUNT, len(scan)), *shape), dtype=np.float32
    )
    return drawn[np.arange(len(scan)) % len(drawn)]


KINDS: Final[Mapping[str, Callable[[ConeVec, tuple[int, int]], Float32Array]]] = {
    "whole": whole,
    "cut-off": cut_off,
    "holder": holder,
    "noise": noise,
}
"""Name -> line integrals (n, rows, cols) of a circle and a panel of (rows, cols). The
others are compared with the first."""
