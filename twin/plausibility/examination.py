"""The common check of all entry points' input."""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum
from typing import Any

import numpy as np
import numpy.typing as npt

from flexdt.twin.findings import Finding, Findings
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.plausibility.pixel_values import integral_findings, volume_findings
from flexdt.twin.plausibility.sample_placement import placement_findings
from flexdt.twin.plausibility.scan_geometry import (
    arc_findings,
    geometry_findings,
    inclination_findings,
    span_findings,
)
from flexdt.twin.plausibility.volume_grid import grid_findings

SOME_IMAGES = 9
"""Number of images whose values are examined."""
SOME_PIXELS = 1 << 14
"""Approximate number of pixels examined in each of them."""


class Operation(Enum):
    """Operation that the examined data are meant for."""

    OPEN = "open"
    PROJECT = "project"
    SIMULATE = "simulate"
    FDK = "FDK"
    ITERATE = "iterate"


def examine(
    operation: Operation,
    geometry: ConeVec | None,
    shape: tuple[int, int] | None = None,
    *,
    images: Any = None,
    volume: npt.NDArray[Any] | None = None,
    boxes: npt.ArrayLike | None = None,
    grid: FloatArray | None = None,
) -> Findings:
    """Find contradictions in the input of an operation.

    Warns and raises nothing itself; see `settled`. Without a geometry only values are
    checked. Checks whose argument is None are skipped; `boxes` and `grid` also need
    `shape`, except FDK's check of an inclined beam.

    Args:
        operation: operation to be done; it decides which checks are made.
        geometry: of the views, or None for data without any.
        shape: detector (rows, cols), or None if unknown.
        images: line integrals (n, rows, cols); about `SOME_PIXELS` pixels of
            `SOME_IMAGES` images are read.
        volume: values of voxels (nz, ny, nx) [1/mm].
        boxes: low and high corner of the box around each part of a sample, (k, 2, 3)
            [mm].
        grid: low and high corner of the volume to be computed, (2, 3) [mm].

    Returns:
        All findings, those of the geometry first; empty if there are none.

    Example:
        >>> scan = ConeVec.circular(sod=600, sdd=1059, angles=np.linspace(0, 6.28, 90), pixel=0.1)
        >>> examine(Operation.OPEN, scan, (76, 96))
        <Findings: 0 errors, 1 warnings: angles in radians>
    """
    values = Findings(_values(images, volume))
    if geometry is None:
        return values
    return Findings(_found(operation, geometry, shape, boxes, grid)).and_also(values)


def _found(
    operation: Operation,
    geometry: ConeVec,
    shape: tuple[int, int] | None,
    boxes: npt.ArrayLike | None,
    grid: FloatArray | None,
) -> Iterator[Finding]:
    """Yield the findings of all checks of a geometry; arguments as for `examine`.

    Arcs are checked only for an iterative method whose spans are fine. Placement
    needs `boxes` and `shape`, the grid check needs `grid` and `shape`;
    the panel counts as real only when simulating, layers above and below it count unless
    FDK. Inclination is checked for FDK with a `grid`, about the grid's center.
    """
    yield from geometry_findings(geometry, shape)
    spans = tuple(span_findings(geometry))
    yield from spans
    if operation is Operation.ITERATE and not spans:
        yield from arc_findings(geometry)
    if boxes is not None and shape is not None:
        exposed = operation is Operation.SIMULATE
        yield from placement_findings(geometry, shape, boxes, exposed=exposed)
    if grid is not None and shape is not None:
        layers = operation is not Operation.FDK
        yield from grid_findings(geometry, shape, grid[0], grid[1], layers=layers)
    if grid is not None and operation is Operation.FDK:
        yield from inclination_findings(geometry, grid.mean(axis=0))


def _values(images: Any, volume: npt.NDArray[Any] | None) -> Iterator[Finding]:
    """Yield the findings on a sample of line integrals, then on the volume.

    Images without views are not checked.
    """
    if images is not None and len(images):
        yield from integral_findings(some_of(images))
    if volume is not None:
        yield from volume_findings(volume)


def some_of(images: Any) -> npt.NDArray[Any]:
    """Sample rows and columns of a few images (n, rows, cols), evenly: (k, r, c).

    At most `SOME_IMAGES`, first and last among them, of roughly `SOME_PIXELS` pixels
    each.
    """
    count, rows, cols = images.shape
    some = np.unique(np.linspace(0, count - 1, SOME_IMAGES).astype(int))
    each = max(1, int((rows * cols / SOME_PIXELS) ** 0.5))
    return np.stack([np.asarray(images[int(i)])[::each, ::each] for i in some])
