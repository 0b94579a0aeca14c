"""Other projectors, wrapped alike: prepared once, then timed call by call.

A peer that is not installed is listed as missing and takes no part. Their geometry is
flexdt's own cone_vec, translated here. No timing happens in this module.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from typing import Protocol

import numpy as np

from flexdt.measuring import voxel_rays
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection import Volume
from flexdt_extensions.bench import rtk_peer as rtk


class Runner(Protocol):
    """A prepared projection: run it, then get the images."""

    @abstractmethod
    def run(self) -> float | None:
        """Run the projection, the timed part. Returns seconds where its own clock is
        the right one."""

    @abstractmethod
    def images(self) -> Float32Array:
        """Return the line integrals (n, rows, cols) of the last call."""

    @abstractmethod
    def close(self) -> None:
        """Release memory and processes."""


@dataclass(frozen=True)
class Peer:
    """A projector to compare with.

    Attributes:
        name: on PyPI.
        missing: why it cannot take part, or None.
        slow: a view takes tens of seconds: called once, and only for cases of one view.
        prepare: (volume, geometry, detector shape) to a runner.
    """

    name: str
    missing: str | None
    slow: bool
    prepare: Callable[[Volume, ConeVec, tuple[int, int]], Runner]


def peers() -> list[Peer]:
    """List all peers this benchmark knows, with the reason if one is not installed."""
    return [
        Peer("itk-rtk", absent("itk-rtk"), False, joseph),
        Peer("diffdrr", absent("diffdrr"), True, DiffDrr),
    ]


def absent(package: str) -> str | None:
    """Return the reason why a package is absent ("... is not installed"), or None if it
    is installed; it is not imported.
    """
    # Asked of the installer: a look for the module itself would load itk into this process.
    try:
        metadata.distribution(package)
    except metadata.PackageNotFoundError:
        return f"{package} is not installed"
    return None


def joseph(volume: Volume, geometry: ConeVec, shape: tuple[int, int]) -> Runner:
    """Prepare RTK's Joseph projector (its fastest on the CPU), in a process of its
    own."""
    data = np.asarray(volume.data)
    place = volume.voxel_xyz, volume.center_mm
    return rtk.Rtk(rtk.joseph, data, *place, geometry.rows, shape)


class DiffDrr:
    """diffdrr's Siddon renderer in torch on the CPU, some rays at a time."""

    RAYS = 8192

    def __init__(self, volume: Volume, geometry: ConeVec, shape: tuple[int, int]) -> None:
        """Copy the volume and the rays of all views to PyTorch.

        The result is zeros until `run`.

        Args:
            volume: with attenuation [1/mm].
            geometry: views.
            shape: detector (rows, cols).
        """
        import torch
        from diffdrr.renderers import Siddon

        self._shape = (len(geometry), *shape)
        rays = voxel_rays(geometry, volume.layout, shape)
        self._render = Siddon(voxel_shift=0.0)
        self._volume = torch.from_numpy(
            np.ascontiguousarray(volume.data.transpose(2, 1, 0))
        )
        r, c = np.meshgrid(np.arange(shape[0]), np.arange(shape[1]), indexing="ij")
        first, u, v = (rays[:, i : i + 3] for i in (3, 6, 9))
        steps = (
            first[:, None] + c.reshape(-1, 1) * u[:, None] + r.reshape(-1, 1) * v[:, None]
        )
        low = np.array(volume.layout.low_mm) - (
            np.array(volume.center_mm) - np.array(volume.size_mm) / 2
        )
        source = rays[:, None, :3] + low / np.array(volume.voxel_xyz)
        self._source = torch.from_numpy(source.astype(np.float32))
        self._target = torch.from_numpy((source + steps).astype(np.float32))
        length = np.linalg.norm(steps * np.array(volume.voxel_xyz), axis=2)
        self._length = torch.from_numpy(length.astype(np.float32))
        self._result = np.zeros(self._shape, np.float32)

    def run(self) -> None:
        """Project all views into the result, `RAYS` pixels at a time and without
        gradients; see `Runner`.
        """
        import torch

        flat = self._result.reshape(self._shape[0], -1)
        with torch.no_grad():
            for view in range(self._shape[0]):
                for i in range(0, flat.shape[1], self.RAYS):
                    part = slice(i, i + self.RAYS)
                    image = self._render(
                        self._volume,
                        self._source[view][None],
                        self._target[view, part][None],
                        self._length[view, part][None, None],
                    )
                    flat[view, part] = image.numpy().reshape(-1)

    def images(self) -> Float32Array:
        """Return the last images; see `Runner`."""
        return self._result

    def close(self) -> None:
        """Do nothing; see `Runner`."""
