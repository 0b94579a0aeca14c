"""Errors of a volume, and interpolation between the nodes of a coarse grid.

A volume keeps the sources of its noise and bias, and computes `sigma`, `bias_bound` and
`accuracy` from them on access.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace
from functools import lru_cache
from typing import Protocol

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection.volume import Accuracy, Volume, Width

Neighbours = tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], Float32Array]
"""For each place on an axis its lower node, its upper node, and the upper one's
weight."""


class SigmaOf(Protocol):
    """Source of the noise in a volume."""

    @abstractmethod
    def sigma(self, grid: Volume) -> Float32Array:
        """Compute the standard deviation at each voxel of a grid, (nz, ny, nx) [1/mm]."""


class BoundOf(Protocol):
    """Source of the bias of a volume."""

    @abstractmethod
    def bound(self, grid: Volume) -> Float32Array | None:
        """Compute the bound at each voxel of a grid, (nz, ny, nx) [1/mm]; None if
        unknown.
        """

    @abstractmethod
    def accuracy(self, grid: Volume, width: Width | None) -> Accuracy | None:
        """Compute the accuracy of uniform regions in a grid, with the measured width of its
        edges across the axis; None if unknown."""

    @abstractmethod
    def doubling(self) -> tuple[str, float]:
        """Return the known error that doubles edges most, of `CAUSES`, and by how much at the
        axis [mm]; "" and 0 without one."""


def with_errors(
    volume: Volume, noise: SigmaOf | None = None, bias: BoundOf | None = None
) -> Volume:
    """Return a copy of a volume (data shared) with sources of its `sigma` and
    `bias_bound`.

    None leaves that of the volume. Derived volumes have none.
    """
    found = replace(volume)
    object.__setattr__(found, "_noise", noise or getattr(volume, "_noise", None))
    object.__setattr__(found, "_bias", bias or getattr(volume, "_bias", None))
    return found


def interpolated(nodes: Volume, grid: Volume) -> Float32Array:
    """Interpolate values on a coarse grid, trilinearly, at the voxels of another.

    Voxels beyond the outermost nodes have the value of the nearest. Axes are interpolated
    one after the other, so that a voxel costs two multiplications.

    Args:
        nodes: coarse values.
        grid: place and size; its values are not used.

    Returns:
        New array (nz, ny, nx).
    """
    z, y, x = (
        _neighbours(places, known)
        for places, known in zip(grid.centers()[::-1], nodes.centers()[::-1], strict=True)
    )

    @lru_cache(2)  # a layer lies between two planes of nodes
    def plane(k: int) -> Float32Array:
        across = _between(nodes.data[k].T, x).T
        return _between(across, y)

    out = np.empty(grid.shape, np.float32)
    for layer, lower, upper, weight in zip(out, *z, strict=True):
        np.multiply(plane(lower), 1.0 - weight, out=layer)
        layer += weight * plane(upper)
    return out


def _neighbours(places: FloatArray, known: FloatArray) -> Neighbours:
    """Find known places (m,), increasing, about others (n,), for linear interpolation.

    Returns lower, upper index, the upper's share; outside: the outermost.
    """
    at = np.interp(places, known, np.arange(len(known)))
    lower = np.minimum(at.astype(np.int64), max(len(known) - 2, 0))
    upper = np.minimum(lower + 1, len(known) - 1)
    return lower, upper, (at - lower).astype(np.float32)


def _between(values: Float32Array, along: Neighbours) -> Float32Array:
    """Interpolate linearly along the first of two axes.

    `values`: (m, k); `along`: neighbors of n places, from `_neighbours`.
    Returns (n, k)."""
    lower, upper, weight = along
    found: Float32Array = values[lower] * (1.0 - weight)[:, None]
    found += values[upper] * weight[:, None]
    return found
