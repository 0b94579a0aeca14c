"""Complete processing of batches of a plan's frames: positions, line integrals, counts,
files.

Projection is awaited, counts and files are made in worker threads, so neither waits for the
other. A frame depends on the plan, the sample, the truth and the scan's seed only. When frames
are due is decided in `runner`; `dataset_writer` writes the files.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from flexdt.server.imaging.radiography import MAX_MEMORY_S, Before, Radiography
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.machine.kinematics import motor_poses
from flexdt.twin.physics.chain import Radiograph
from flexdt.twin.physics.exposure import ExposureSettings, frame_rng
from flexdt.twin.physics.readout import trapped_after
from flexdt.twin.scanner.state import Sample
from flexdt.twin.script import Exposure, ScanPlan

Put = Callable[[str, npt.NDArray[np.uint16]], object]
"""Stores one image under a name; called from worker threads."""

FrameListener = Callable[[Exposure, Radiograph], None]
"""Called with the last projection of each batch: the frame and its image."""

MEMORY_FRAMES = 2
"""Number of earlier frames that a frame may depend on."""
KEPT_IMAGES = 16
"""Number of images kept for later frames."""


@dataclass(frozen=True)
class Acquisition:
    """The common data of all frames of one scan.

    Attributes:
        plan: the scan.
        radiography: how images are made.
        sample: on the stage when the scan began.
        seed: of the noise; None for no noise.
        put: stores an image.
        moments: poses averaged within the exposure of a frame taken in motion.
        shown: called with images for watchers.
        ensure_same: raises if the sample has changed; called after each projection.
    """

    plan: ScanPlan
    radiography: Radiography
    sample: Sample
    seed: int | None
    put: Put
    moments: int = 1
    shown: FrameListener | None = None
    ensure_same: Callable[[], None] = lambda: None
    _recent: dict[int, Radiograph] = field(default_factory=dict, init=False)
    """Index -> image that later frames may need."""
    _charges: dict[int, Float32Array] = field(default_factory=dict, init=False)
    """Frame index -> charge in the panel's traps at its start."""
    _charge_lock: asyncio.Lock = field(default_factory=asyncio.Lock, init=False)

    async def produce(self, batch: Sequence[Exposure]) -> None:
        """Project, expose and store a batch of frames, and pass the last one to `shown`.

        Files are written in a worker thread. A batch with X-rays off is dark, and not shown.

        `batch`: frames with files that share camera settings and X-rays on or off.
        Raises ProjectorUnavailable: nothing of the batch was stored; DatasetWriteError: not all
        of it was stored; storing again is allowed; Exception: as `ensure_same`; nothing was
        stored.
        """
        if batch[0].xrays_on:
            images = await self._radiographs(batch)
        else:
            images = [self.radiography.dark(batch[0].camera)] * len(batch)
        before = [await self._earlier_images(frame) for frame in batch]
        trapped = [await self._trapped_charge(frame) for frame in batch]
        await _ended(asyncio.to_thread(self._store, batch, images, before, trapped))
        if self.shown is not None and batch[-1].xrays_on:
            self.shown(batch[-1], images[-1])

    async def _radiographs(self, batch: Sequence[Exposure]) -> list[Radiograph]:
        """Project a batch of frames; the last `KEPT_IMAGES` are remembered for a panel
        with lag or traps.

        Args:
            batch: frames that share camera settings; with `moments` above 1 each is
                projected alone.

        Returns:
            One radiograph for each frame, before noise.
        """
        if self.moments > 1:
            images = [(await self._project([e]))[0] for e in batch]
        else:
            images = await self._project(batch)
        if self.radiography.remembers:
            for frame, image in zip(batch, images, strict=True):
                self._recent[frame.index] = image
            while len(self._recent) > KEPT_IMAGES:
                del self._recent[next(iter(self._recent))]
        return images

    async def _earlier_images(self, frame: Exposure) -> Before:
        """Collect the images of earlier frames whose afterglow is still on the panel.

        These are among the last `MEMORY_FRAMES`, with X-rays on and the same camera settings,
        less than `MAX_MEMORY_S` before. Missing images are projected again, so that a frame does
        not depend on which were made before it.
        `frame`: that is being made.
        Returns pairs of image and time from its end to the frame's start [s], oldest first;
        empty for a panel without lag.
        """
        if not self.radiography.remembers:
            return ()
        found = []
        for index in range(max(0, frame.index - MEMORY_FRAMES), frame.index):
            earlier = self.plan.exposures[index]
            gap = frame.start_s - earlier.start_s - earlier.duration_s
            if earlier.xrays_on and earlier.camera == frame.camera and gap < MAX_MEMORY_S:
                found.append((await self._image(earlier), gap))
        return found

    async def _image(self, frame: Exposure) -> Radiograph:
        """Return the image of a frame with X-rays on: the remembered one, else project it
        again.
        """
        image = self._recent.get(frame.index)
        if image is None:
            return (await self._radiographs([frame]))[0]
        return image

    async def _trapped_charge(self, frame: Exposure) -> Float32Array | None:
        """Compute the charge in the panel's traps at a frame's start, from all frames
        before it in the plan.

        Between frames charge decays by the plan's times. It is the same wherever a scan
        was interrupted, and zero after a change of the camera's settings. Charges of the
        last `KEPT_IMAGES` frames are remembered; missing images are projected again.

        Args:
            frame: that is being made.

        Returns:
            Charge (rows, cols), float32; None for a panel without traps.
        """
        if not self.radiography.traps:
            return None
        async with self._charge_lock:
            at = max((i for i in self._charges if i <= frame.index), default=0)
            charge = self._charges.get(
                at, np.zeros(self.plan.exposures[at].camera.shape, "f4")
            )
            for index in range(at, frame.index):
                now, later = self.plan.exposures[index : index + 2]
                if now.camera != later.camera:
                    charge = np.zeros(later.camera.shape, np.float32)
                else:
                    lit = None
                    if now.xrays_on:
                        lit = (await self._image(now)).expected
                    gap = later.start_s - now.start_s - now.duration_s
                    charge = trapped_after(
                        self.radiography.panel,
                        charge,
                        lit,
                        settings_of(now),
                        max(gap, 0.0),
                    )
                self._charges[index + 1] = charge
                self._charges.pop(index + 1 - KEPT_IMAGES, None)
            return charge

    async def _project(self, batch: Sequence[Exposure]) -> list[Radiograph]:
        """Project one view a frame, or several views of one frame taken in motion.

        Without noise and trapped charge; as if X-rays were on.

        Args:
            batch: frames that share camera settings; one alone if it is taken in motion
                and `moments` is above 1.

        Returns:
            One radiograph for each frame.

        Raises:
            Exception: as `ensure_same`, if the sample has changed since the scan began.
        """
        frame = batch[0]
        if self.moments > 1 and frame.moving:
            positions = {n: table[frame.index] for n, table in self._moments.items()}
        else:
            axes = self.plan.machine.axes
            positions = {n: np.array([e.positions[n] for e in batch]) for n in axes}
        nominal = motor_poses(
            self.plan.machine, self.plan.profile, frame.camera, positions
        )
        exposures = [settings_of(e) for e in batch]
        images = await self.radiography.take(
            self.sample, nominal, frame.camera, exposures
        )
        self.ensure_same()  # of the projected sample, not of the earlier one
        return images

    @cached_property
    def _numbers(self) -> Mapping[str, int]:
        """File -> number of the image among all saved ones."""
        files = [e.file for e in self.plan.exposures if e.file is not None]
        return {file: i for i, file in enumerate(files)}

    @cached_property
    def _moments(self) -> Mapping[str, npt.NDArray[np.float64]]:
        """Axis -> (images, moments) positions within each exposure [mm, deg]."""
        return self.plan.subframe_positions(self.moments)

    def _store(
        self,
        batch: Sequence[Exposure],
        images: Sequence[Radiograph],
        before: Sequence[Before],
        trapped: Sequence[Float32Array | None],
    ) -> None:
        """Convert the images of a batch to counts and write each frame's file.

        Noise depends on the seed (None: none) and the frame's number. `before`: earlier
        frames; `trapped`: charge in traps (rows, cols). Raises DatasetWriteError: as
        `put`.
        """
        for frame, image, earlier, traps in zip(
            batch, images, before, trapped, strict=True
        ):
            assert frame.file is not None
            rng = None
            if self.seed is not None:
                rng = frame_rng(self.seed, self._numbers[frame.file])
            settings = settings_of(frame)
            counts = self.radiography.counts(
                image, frame.camera, settings, rng, earlier, traps
            )
            self.put(frame.file, counts)


async def _ended(work: Coroutine[Any, Any, None]) -> None:
    """Wait until work in a thread has ended, also where the wait is canceled meanwhile.

    A thread cannot be canceled: after this it writes nothing more.
    """
    task = asyncio.ensure_future(work)
    try:
        await asyncio.shield(task)
    except asyncio.CancelledError:
        await asyncio.wait({task})
        raise


def settings_of(frame: Exposure) -> ExposureSettings:
    """Return the settings of tube and camera during a frame."""
    return ExposureSettings(
        frame.kV, frame.power_W, frame.exposure_ms, frame.averages, frame.xrays_on
    )
