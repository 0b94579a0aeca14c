"""From nominal poses to line integrals: the one path on which the true geometry is used.

Adds the hidden truth, transforms into the sample's frame, makes sure that the projector has the
sample, and requests the projection. Images are the only results that depend on the truth.
"""

from __future__ import annotations

import asyncio
from typing import Protocol

import numpy as np
import numpy.typing as npt

from flexdt.phantoms import Phantom
from flexdt.phantoms.channels import Channel, channels, scatter_object
from flexdt.server.imaging.truth import TrueGeometry
from flexdt.server.storage.stored_samples import SampleStore
from flexdt.twin.geometry.cone_vec import ConeVec, check_cone_vec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.machine.camera import CameraSettings, Sensor
from flexdt.twin.physics.scatter.simulation import Object
from flexdt.twin.projection import Volume
from flexdt.twin.projection.analytic_solids import Scene
from flexdt.twin.scanner.state import Sample


class Projector(Protocol):
    """The part of the projector's client that projections need."""

    async def put_scene(self, name: str, scene: Scene) -> object:
        """Name an analytic scene."""

    async def put_volume(self, name: str, volume: Volume) -> object:
        """Name a volume."""

    async def project(self, name: str, cone_vec: ConeVec, shape: tuple[int, int]) -> Float32Array:
        """Line integrals, float32 (n, rows, cols)."""


class Imaging:
    """Line integrals of the sample on the stage.

    Args:
        projector: computes them.
        truth: hidden misalignment.
        samples: what may stand on the stage.
        sensor: the detector.
    """

    def __init__(
        self, projector: Projector, truth: TrueGeometry, samples: SampleStore, sensor: Sensor
    ) -> None:
        self._projector, self._truth, self._samples, self._sensor = (
            projector,
            truth,
            samples,
            sensor,
        )
        self._known: dict[str, Phantom] = {}
        self._taken_apart: dict[str, tuple[Phantom, tuple[Channel, ...]]] = {}
        self._scatterer: tuple[Phantom, Object] | None = None
        self._sending = asyncio.Lock()

    async def line_integrals(
        self,
        sample: Sample,
        poses: Poses,
        camera: CameraSettings,
        *,
        times: npt.ArrayLike | None = None,
    ) -> Float32Array:
        """Images of `sample` at n nominal poses, `times` (n,) [s] after the scan's start.

        Returns:
            float32 (n, rows, cols), dimensionless; zeros for an empty stage.

        Raises:
            ProjectorUnavailable: the projector does not answer.
            GeometryError: a geometry no scanner can have.
        """
        if not sample.name:
            return np.zeros((len(poses), *camera.shape), dtype=np.float32)
        volume = await self._volume(sample)
        cone = self._truth.cone_vec(poses, sample.offset, times)
        check_cone_vec(cone, camera.pixels_mm(self._sensor))
        return await self._projector.project(volume, cone, camera.shape)

    async def path_lengths(
        self,
        sample: Sample,
        poses: Poses,
        camera: CameraSettings,
        *,
        times: npt.ArrayLike | None = None,
    ) -> tuple[tuple[Channel, ...], Float32Array, FloatArray]:
        """Paths through each material of `sample` at n nominal poses.

        Returns:
            The materials (m), float32 (m, n, rows, cols) [mm], and the true geometry (n, 12), which
            must not leave the server.

        Raises:
            As `line_integrals`.
        """
        cone = self._truth.cone_vec(poses, sample.offset, times)
        check_cone_vec(cone, camera.pixels_mm(self._sensor))
        channels = await self._channels(sample) if sample.name else ()
        out = np.empty((len(channels), len(poses), *camera.shape), dtype=np.float32)
        for i in range(len(channels)):
            out[i] = await self._projector.project(_channel_name(sample, i), cone, camera.shape)
        return channels, out, cone.rows

    async def scatterer(self, sample: Sample, voxels: int) -> Object:
        """The materials of `sample` on a grid of about so many voxels, made once."""
        channels = await self._channels(sample)
        phantom = self._taken_apart[_channel_name(sample, 0)][0]
        if self._scatterer is None or self._scatterer[0] is not phantom:
            size = phantom.size_mm
            thing = await asyncio.to_thread(scatter_object, channels, size, voxels)
            self._scatterer = phantom, thing
            return thing
        return self._scatterer[1]

    async def _channels(self, sample: Sample) -> tuple[Channel, ...]:
        """The sample's materials, known to the projector one by one."""
        async with self._sending:
            phantom = await asyncio.to_thread(self._samples.load, sample.name, sample.material)
            name = _channel_name(sample, 0)
            known = self._taken_apart.get(name)
            if known is not None and known[0] is phantom:
                return known[1]
            found = await asyncio.to_thread(channels, phantom)
            for i, channel in enumerate(found):
                if isinstance(channel.body, Scene):
                    await self._projector.put_scene(_channel_name(sample, i), channel.body)
                elif isinstance(channel.body, Volume):
                    await self._projector.put_volume(_channel_name(sample, i), channel.body)
            self._taken_apart[name] = (phantom, found)
        return found

    async def _volume(self, sample: Sample) -> str:
        """The projector's name for the sample, sent there if it is new or has changed."""
        name = _name(sample)
        async with self._sending:
            phantom = await asyncio.to_thread(self._samples.load, sample.name, sample.material)
            if self._known.get(name) is not phantom:
                if phantom.is_analytic:
                    await self._projector.put_scene(name, phantom.scene)
                else:
                    volume = await asyncio.to_thread(phantom.volume)
                    await self._projector.put_volume(name, volume)
                self._known[name] = phantom
        return name


def _name(sample: Sample) -> str:
    return sample.name if sample.material is None else f"{sample.name} of {sample.material}"


def _channel_name(sample: Sample, index: int) -> str:
    return f"{_name(sample)}, material {index}"
