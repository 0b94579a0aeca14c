"""What is said of the errors of a volume, and values on a coarse grid between its nodes.

A volume keeps what its noise and its bias are computed from, and computes `sigma`, `bias_bound` and
`accuracy` of it when asked.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace
from typing import Protocol

import numpy as np

from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection.volume import Accuracy, Volume


class SigmaOf(Protocol):
    """What the noise in a volume is computed from."""

    @abstractmethod
    def sigma(self, grid: Volume) -> Float32Array:
        """Standard deviation at each voxel of a grid, (nz, ny, nx) [1/mm]."""


class BoundOf(Protocol):
    """What the bias of a volume is computed from."""

    @abstractmethod
    def bound(self, grid: Volume) -> Float32Array:
        """Bound at each voxel of a grid, (nz, ny, nx) [1/mm]."""

    @abstractmethod
    def accuracy(self, grid: Volume) -> Accuracy | None:
        """Of the object's even places in a grid; None where there is no object."""


def with_errors(
    volume: Volume, noise: SigmaOf | None = None, bias: BoundOf | None = None
) -> Volume:
    """Give a volume a `sigma` and a `bias_bound`, besides those it has.

    Volumes that are made of it have none: they are no fields.
    """
    found = replace(volume)
    object.__setattr__(found, "_noise", noise or getattr(volume, "_noise", None))
    object.__setattr__(found, "_bias", bias or getattr(volume, "_bias", None))
    return found


def interpolated(nodes: Volume, grid: Volume) -> Float32Array:
    """Interpolate values on a coarse grid, linearly, at the voxels of another, (nz, ny, nx)."""
    from scipy.ndimage import map_coordinates

    at = [
        np.interp(places, known, np.arange(len(known)))
        for places, known in zip(grid.centers()[::-1], nodes.centers()[::-1], strict=True)
    ]
    out = np.empty(grid.shape, np.float32)
    across = np.meshgrid(at[1], at[2], indexing="ij")
    for layer, k in enumerate(at[0]):
        map_coordinates(nodes.data, [np.full_like(across[0], k), *across], out[layer], order=1)
    return out
