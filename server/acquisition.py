"""Batches of a plan's frames made whole: positions to line integrals to counts to files.

Projection is awaited, counts and files are made in worker threads, so neither waits for the other.
A frame depends on the plan, the sample, the truth and the scan's seed only. It refuses to know when
frames are due (see `runner`) and how files are written (see `dataset_writer`).
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from flexdt.server.imaging import Imaging
from flexdt.twin.conventions import Float32Array
from flexdt.twin.exposure import DetectorModel, ExposureSettings, expose, frame_rng
from flexdt.twin.kinematics import poses
from flexdt.twin.script import Exposure, ScanPlan
from flexdt.twin.state import Sample

Put = Callable[[str, npt.NDArray[np.uint16]], object]
"""Stores one image under a name; called from worker threads."""

Shown = Callable[[Exposure, Float32Array], None]
"""Told of the last projection of each batch: the frame and its line integrals (rows, cols)."""


@dataclass(frozen=True)
class Acquisition:
    """What all frames of one scan share.

    Attributes:
        plan: the scan.
        imaging: projects.
        sample: on the stage when the scan began.
        model: the detector.
        seed: of the noise; None for none.
        put: stores an image.
        moments: poses averaged within the exposure of a frame taken in motion.
        shown: told of images for watchers.
    """

    plan: ScanPlan
    imaging: Imaging
    sample: Sample
    model: DetectorModel
    seed: int | None
    put: Put
    moments: int = 1
    shown: Shown | None = None

    async def produce(self, batch: Sequence[Exposure]) -> None:
        """Make and store frames that share camera settings.

        Raises:
            ProjectorUnavailable: nothing of the batch was stored.
            DatasetWriteError: not all of it was stored; storing again is allowed.
        """
        integrals: list[Float32Array]
        if batch[0].xrays_on:
            integrals = await self._integrals(batch)
        else:
            blank = np.zeros(batch[0].camera.shape, dtype=np.float32)
            integrals = [blank] * len(batch)
        await asyncio.to_thread(self._store, batch, integrals)
        if self.shown is not None and batch[-1].xrays_on:
            last = integrals[-1]
            self.shown(batch[-1], last if last.ndim == 2 else last[len(last) // 2])

    async def _integrals(self, batch: Sequence[Exposure]) -> list[Float32Array]:
        if self.moments > 1:
            return [await self._project([e]) for e in batch]
        return list(await self._project(batch))

    async def _project(self, batch: Sequence[Exposure]) -> Float32Array:
        """One view a frame, or several of one frame that is taken in motion."""
        frame = batch[0]
        if self.moments > 1 and frame.moving:
            positions = {n: table[frame.index] for n, table in self._moments.items()}
        else:
            axes = self.plan.machine.axes
            positions = {n: np.array([e.positions[n] for e in batch]) for n in axes}
        nominal = poses(self.plan.machine, self.plan.profile, frame.camera, positions)
        return await self.imaging.line_integrals(self.sample, nominal, frame.camera)

    @cached_property
    def _numbers(self) -> Mapping[str, int]:
        """File -> number of the image among all that are saved."""
        files = [e.file for e in self.plan.exposures if e.file is not None]
        return {file: i for i, file in enumerate(files)}

    @cached_property
    def _moments(self) -> Mapping[str, npt.NDArray[np.float64]]:
        """Axis -> (images, moments) positions within each exposure."""
        return self.plan.subframe_positions(self.moments)

    def _store(self, batch: Sequence[Exposure], integrals: Sequence[Float32Array]) -> None:
        for frame, integral in zip(batch, integrals, strict=True):
            assert frame.file is not None
            rng = None if self.seed is None else frame_rng(self.seed, self._numbers[frame.file])
            self.put(frame.file, expose(self.model, integral, settings_of(frame), rng))


def settings_of(frame: Exposure) -> ExposureSettings:
    """Tube and camera during a frame."""
    return ExposureSettings(
        frame.kV, frame.power_W, frame.exposure_ms, frame.averages, frame.xrays_on
    )
