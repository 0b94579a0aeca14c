"""A volume's grid against the field of view."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from flexdt.twin.findings import Finding, error, warning
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.plausibility.contradictions import PlausibilityCode

SOME_VIEWS: Final = 60
POINTS: Final = 7
"""Examined points along each axis of a grid."""
MOST_UNSEEN: Final = 0.75
"""Largest share of a grid's points outside the field of view; .21 for a square about a
circle."""
LEVEL: Final = 1e-3
"""Largest rise of the source on a circle, relative to its distance from the panel."""
BEHIND: Final = 0.25
"""Least share of the views that see a grid behind the panels of all."""
SELDOM: Final = 0.25
"""Largest share of views that see a point outside the field of view, relative to the
middle."""
FEWEST_VOXELS: Final = 4
"""Least number of voxels across a field of view."""


def grid_findings(
    cone_vec: ConeVec,
    shape: tuple[int, int],
    low: FloatArray,
    high: FloatArray,
    *,
    layers: bool = True,
) -> Iterator[Finding]:
    """Find grids outside the field of view, from `POINTS`^3 points of the grid and
    `SOME_VIEWS` views.

    Yields at most one finding: a refusal if no view sees any of it, or a warning if more
    than `MOST_UNSEEN` of its points are seen in fewer than `SELDOM` of the views (on a
    helix, of the views of the best seen point); the warning's figure is the unseen share.
    Points behind the panel count as seen only if none before it is, and one is in `BEHIND`
    of the views (a virtual panel). Nothing without views or for panels of one pixel.

    Args:
        cone_vec: n views.
        shape: detector (rows, cols).
        low, high: corners of the grid, (3,) [mm].
        layers: points above and below the panel count as unseen; False for FDK, which
            makes them NaN and warns.
    """
    if not len(cone_vec) or max(shape) < 2 or (not layers and shape[1] < 2):
        return
    some = np.unique(np.linspace(0, len(cone_vec) - 1, SOME_VIEWS).astype(int))
    views = cone_vec[some]
    parts = (np.arange(POINTS) + 0.5) / POINTS
    axes = [a + parts * (b - a) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    with np.errstate(all="ignore"):
        at = views.project_points(points, shape)
        toward = views.normal * np.sign(views.source_detector_distance)[:, None]
        depth = np.einsum("nki,ni->nk", points - views.source[:, None], toward)
        ahead = depth > 0.0
        before = depth <= np.abs(views.source_detector_distance)[:, None]
        on = (at > -0.5) & (at < np.array(shape[::-1]) - 0.5)
    on_side = np.abs(views.u[:, 2]).mean() > np.abs(views.v[:, 2]).mean()
    if layers:
        beside = on.all(axis=2)
    else:
        beside = on[..., int(on_side)]
    shown = beside & ahead
    if (shown & before).any():
        shown = shown & before
    elif (
        shown.mean(axis=0).max() < BEHIND
    ):  # a panel before the complete object is a virtual one
        shown = np.zeros_like(shown)
    times = shown.mean(axis=0)
    if not times.any() and not _crossed(at, ahead & before, shape):
        size = " x ".join(f"{b - a:.4g}" for a, b in zip(low, high, strict=True))
        middle = ", ".join(f"{(a + b) / 2:.4g}" for a, b in zip(low, high, strict=True))
        cause = f"no view sees any of the grid of {size} mm about ({middle}) mm (x, y, z)"
        remedy = "allowed: a grid in the field of view; are all lengths in mm?"
        yield error(PlausibilityCode.GRID_NOT_SEEN, cause, remedy)
        return
    if (
        np.ptp(cone_vec.source[:, 2])
        < LEVEL * np.abs(views.source_detector_distance).max()
    ):
        usual = 1.0  # a circle's views all see its middle
    else:
        usual = float(times.max())
    unseen = float((times < SELDOM * usual).mean())
    if unseen > MOST_UNSEEN:
        cause = (
            f"{100 * unseen:.3g} % of the grid lie beside the field of view, where "
            "values are not determined"
        )
        remedy = "a smaller grid, such as field_of_view gives, holds what was seen"
        yield warning(PlausibilityCode.GRID_NOT_SEEN, cause, remedy, figure=unseen)


def _crossed(at: FloatArray, ahead: FloatArray, shape: tuple[int, int]) -> bool:
    """Return whether the bounding box of points' images meets the panel in some view.

    `at`: (n, k, 2) [px]; others than `ahead`, (n, k), between source and panel, do not
    count.
    """
    far = np.array(shape[::-1]) - 0.5
    low = np.where(ahead[..., None], at, np.inf).min(axis=1)
    high = np.where(ahead[..., None], at, -np.inf).max(axis=1)
    return bool(((high > -0.5) & (low < far)).all(axis=1).any())


def voxel_findings(voxel_mm: float, view_mm: float) -> Iterator[Finding]:
    """Find voxels so large that fewer than `FEWEST_VOXELS` fit into a field of view.

    Yields (does not raise) at most one refusal, its figure the voxel size.
    `voxel_mm`: edge of a voxel [mm]; `view_mm`: width of the field of view [mm]."""
    if voxel_mm * FEWEST_VOXELS > view_mm:
        cause = f"voxels of {voxel_mm:g} mm in a field of view of {view_mm:.4g} mm across"
        remedy = f"allowed: below {view_mm / FEWEST_VOXELS:.3g} mm; is the voxel in mm?"
        yield error(PlausibilityCode.VOXEL_SIZE, cause, remedy, figure=voxel_mm)
