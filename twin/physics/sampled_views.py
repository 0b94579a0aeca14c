"""Views from several points of the focal spot, and the rays that a pixel on an edge needs."""

from __future__ import annotations

import numpy as np

from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.physics.blur import FWHM
from flexdt.twin.projection.pixel_areas import FEWEST_NEEDED, Need
from flexdt.twin.rays_a_pixel import Rays

NOISE_SHARE = 1.0
"""Error of a pixel on an edge, at most, as a part of the noise of the exposure in an open
pixel."""
LARGEST_ERROR = 0.1
"""Largest permitted error of a pixel on an edge, however noisy the exposure."""


def spot_views(rows: FloatArray, spot_mm: float, points: int) -> FloatArray:
    """Sample a Gaussian focal spot: views (n, 12) become (n * points, 12), those of one
    view in a row, whose mean has the spot's blur at every depth. Only the source is
    moved, along u and v. A spiral, so that no two points are behind one another.

    Args:
        rows: cone_vec rows.
        spot_mm: full width at half maximum [mm].
        points: from each view, at least 3.
    """
    k = (np.arange(points) + points // 2) % points  # the innermost in the middle
    turn = np.pi * (3.0 - np.sqrt(5.0)) * k
    radius = np.sqrt(-2.0 * np.log1p(-(k + 0.5) / points))
    places = radius * np.array([np.cos(turn), np.sin(turn)])
    places -= places.mean(axis=1, keepdims=True)
    places = np.linalg.solve(np.linalg.cholesky(np.cov(places, bias=True)), places)
    edges = rows[:, 6:].reshape(-1, 2, 3)
    edges = edges / np.linalg.norm(edges, axis=2, keepdims=True) * (spot_mm / FWHM)
    out = np.repeat(rows[:, None], points, axis=1)
    out[:, :, :3] += np.einsum("ak,nax->nkx", places, edges)
    return out.reshape(-1, 12)


def edges_needed(
    rays: Rays, noise: float, blur_px: float, points: int = 1
) -> Need | None:
    """Say what pixels on edges need; None for one ray a pixel.

    `rays`: a side; "auto": an error below the noise; others as `permitted_error`.
    """
    if rays == 1:
        return None
    if rays != "auto":
        return Need(FEWEST_NEEDED, counts=True, rays=rays)
    return Need(permitted_error(noise, blur_px, points), counts=True)


def permitted_error(noise: float, blur_px: float, points: int = 1) -> float:
    """Compute the error that an edge may have, as a part of the open beam's signal
    (sigma).

    `NOISE_SHARE` of `noise`, relative too, times the root of the points that average it:
    over 2 sqrt(pi) sigmas of the blur, and of the spot.
    """
    averaged = max(1.0, 2.0 * np.sqrt(np.pi) * blur_px) * points
    error = min(NOISE_SHARE * noise * np.sqrt(averaged), LARGEST_ERROR)
    # Two digits: geometries that differ in the last ones have the same rays, and bytes.
    return float(f"{error:.2g}")
