"""Other projectors, wrapped alike: prepared once, then timed call by call.

A peer that is not installed, or wants a GPU that is not there, says so and takes no part. Their
geometry is flexdt's own cone_vec, translated here. No timing happens in this module.
"""

from __future__ import annotations

import importlib.util
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from flexdt.twin.conventions import Float32Array, FloatArray
from flexdt.twin.geometry import ConeVec
from flexdt.twin.projection import Volume, gpu, gpu_astra
from flexdt.twin.projection.operators import voxel_rays


class Runner(Protocol):
    """A prepared projection: run it, then ask for the images."""

    @abstractmethod
    def run(self) -> None:
        """Project; this is what is timed."""

    @abstractmethod
    def images(self) -> Float32Array:
        """Line integrals (n, rows, cols) of the last call."""


@dataclass(frozen=True)
class Peer:
    """A projector to compare with.

    Attributes:
        name: on PyPI.
        missing: why it cannot take part, or None.
        slow: a view takes tens of seconds: one call, and only where one view is asked for.
        prepare: (volume, geometry, detector shape) to a runner.
    """

    name: str
    missing: str | None
    slow: bool
    prepare: Callable[[Volume, ConeVec, tuple[int, int]], Runner]


def peers() -> list[Peer]:
    """All peers this benchmark knows, installed or not."""
    return [
        Peer("itk-rtk", _absent("itk.RTK", "itk-rtk"), False, Joseph),
        Peer("diffdrr", _absent("diffdrr.renderers", "diffdrr"), True, DiffDrr),
        Peer("astra-toolbox", _astra_missing(), False, Astra),
    ]


def _absent(module: str, package: str) -> str | None:
    try:
        found = importlib.util.find_spec(module.split(".")[0]) is not None
        if found and module == "itk.RTK":
            found = importlib.util.find_spec("itk.Configuration.RTKConfig") is not None
    except (ImportError, ValueError):
        found = False
    return None if found else f"{package} is not installed"


def _astra_missing() -> str | None:
    absent = _absent("astra", "astra-toolbox")
    found = gpu.availability()
    return absent or (None if found.present else f"its projector needs a GPU: {found.reason}")


# RTK turns about y, with the source on +z: its (x, y, z) is our (x, z, -y).
TO_RTK = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])


def rtk_geometry(rows: FloatArray) -> Any:
    """RTK's geometry object of cone_vec rows."""
    import itk
    from itk import RTK as rtk

    geometry = rtk.ThreeDCircularProjectionGeometry.New()
    for row in rows:
        source, centre, u, v = (TO_RTK @ row[i : i + 3] for i in (0, 3, 6, 9))
        vectors = [
            itk.Vector[itk.D, 3]([float(x) for x in part])
            for part in (source, centre, u / np.linalg.norm(u), v / np.linalg.norm(v))
        ]
        if not geometry.AddProjection(*vectors):
            raise ValueError("RTK refuses this view")
    return geometry


def rtk_volume(volume: Volume) -> Any:
    """A volume as an ITK image in RTK's axes."""
    import itk

    image = itk.image_from_array(np.ascontiguousarray(volume.data.transpose(1, 0, 2)[::-1]))
    x, y, z = volume.voxel_xyz
    nz, ny, nx = volume.shape
    centre = TO_RTK @ np.array(volume.center_mm)
    image.SetSpacing([x, z, y])
    half = np.array([(nx - 1) * x, (nz - 1) * z, (ny - 1) * y]) / 2
    image.SetOrigin([float(c) for c in centre - half])
    return image


def rtk_stack(images: Float32Array, rows: FloatArray) -> Any:
    """Projections as an ITK image, pixel (0, 0) first."""
    import itk

    stack = itk.image_from_array(images)
    u, v = (float(np.linalg.norm(rows[0, i : i + 3])) for i in (6, 9))
    height, width = images.shape[1:]
    stack.SetSpacing([u, v, 1.0])
    stack.SetOrigin([-(width - 1) / 2 * u, -(height - 1) / 2 * v, 0.0])
    return stack


class Joseph:
    """RTK's Joseph projector (its fastest on the CPU)."""

    def __init__(self, volume: Volume, geometry: ConeVec, shape: tuple[int, int]) -> None:
        import itk
        from itk import RTK as rtk

        kind = itk.Image[itk.F, 3]
        self._keep = (
            rtk_stack(np.zeros((len(geometry), *shape), np.float32), geometry.rows),
            rtk_volume(volume),
            rtk_geometry(geometry.rows),
        )
        self._filter = rtk.JosephForwardProjectionImageFilter[kind, kind].New()
        self._filter.SetInput(0, self._keep[0])
        self._filter.SetInput(1, self._keep[1])
        self._filter.SetGeometry(self._keep[2])
        self._filter.InPlaceOff()

    def run(self) -> None:
        """See `Runner`."""
        self._filter.Modified()
        self._filter.Update()

    def images(self) -> Float32Array:
        """See `Runner`."""
        import itk

        return np.asarray(itk.array_from_image(self._filter.GetOutput()), dtype=np.float32)


class DiffDrr:
    """diffdrr's Siddon renderer in torch on the CPU, some rays at a time."""

    RAYS = 8192

    def __init__(self, volume: Volume, geometry: ConeVec, shape: tuple[int, int]) -> None:
        import torch
        from diffdrr.renderers import Siddon

        self._shape = (len(geometry), *shape)
        rays = voxel_rays(geometry, volume.layout, shape)
        self._render = Siddon(voxel_shift=0.0)
        self._volume = torch.from_numpy(np.ascontiguousarray(volume.data.transpose(2, 1, 0)))
        r, c = np.meshgrid(np.arange(shape[0]), np.arange(shape[1]), indexing="ij")
        first, u, v = (rays[:, i : i + 3] for i in (3, 6, 9))
        steps = first[:, None] + c.reshape(-1, 1) * u[:, None] + r.reshape(-1, 1) * v[:, None]
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
        """See `Runner`."""
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
        """See `Runner`."""
        return self._result


class Astra:
    """ASTRA's cone_vec projector on a CUDA device."""

    def __init__(self, volume: Volume, geometry: ConeVec, shape: tuple[int, int]) -> None:
        self._arguments = (volume, geometry, shape)
        self._result = np.zeros((0, *shape), np.float32)

    def run(self) -> None:
        """See `Runner`."""
        self._result = gpu_astra.project(*self._arguments)

    def images(self) -> Float32Array:
        """See `Runner`."""
        return self._result
