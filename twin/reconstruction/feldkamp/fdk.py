"""Filtered backprojection for cone beams on a circle (Feldkamp, Davis and Kress 1984) or a
helix.

The panel may be moved to any side and turned about the vertical: distances and angles come from
each row of the geometry. Tilted panels are resampled upright first. Views may come in parts, so
neither all images nor, slab by slab, the whole volume need fit into memory.

The steps stand in `fdk_plan` (panels, weights, filter), `truncation` (what goes on beyond the
panel's edges), `backprojection` (on a CUDA device if it has room for the volume, else on the
processor) and `coverage` (voxels that some views do not see).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from flexdt.twin.algorithms import PLAIN
from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection import Grid, Volume, as_volume, gpu
from flexdt.twin.projection.volume import cut
from flexdt.twin.reconstruction.acquisition.trajectory import circle_of
from flexdt.twin.reconstruction.acquisition.truncation import Truncation
from flexdt.twin.reconstruction.feldkamp.backprojection import (
    Backprojector,
    OnDevice,
    OnProcessor,
    device_takes,
)
from flexdt.twin.reconstruction.feldkamp.fdk_plan import FdkPlan, plan_fdk
from flexdt.twin.reconstruction.feldkamp.noise import (
    NoiseMeter,
    NoiseOfSlabs,
    NoiseOfViews,
)
from flexdt.twin.reconstruction.feldkamp.slabs import layers
from flexdt.twin.reconstruction.volume_errors import with_errors

Progress = Callable[[float], None]
"""Called with the fraction done, from 0 to 1."""


@dataclass(frozen=True, eq=False)
class Task:
    """A reconstruction, apart from its grid.

    Attributes:
        parts: gives float32 (k, rows, cols) arrays of line integrals, one image a view.
        cone_vec: of all views.
        shape: detector (rows, cols).
        window: of the ramp filter.
        truncation: object beyond the panel's edges; None for nothing.
        outside: keep voxels that only continued rows show from all sides.
        errors: find the noise.
    """

    parts: Callable[[], Iterable[Float32Array]]
    cone_vec: ConeVec
    shape: tuple[int, int]
    window: str
    truncation: Truncation | None
    outside: bool
    errors: bool

    def onto(
        self, target: Backprojector, like: Volume, progress: Progress | None
    ) -> tuple[Float32Array, NoiseOfViews | None]:
        """Reconstruct into one grid: plan, add all views, scale voxels that some views do not
        see.

        `target`: adds the views to a volume; gets a new noise meter if noise is measured.
        `like`: place and size of the grid. `progress`: called with the share of the views that
        is done.
        Returns values (nz, ny, nx), and their noise; None without `errors`, in a helix, or where
        it cannot be measured.
        Raises GeometryError: see `plan_fdk`; or images that do not fit; gpu.DeviceError: the
        target is a device, and failed.
        """
        plan = plan_fdk(self.cone_vec, self.shape, like, self.window, self.truncation)
        meter = None
        if self.errors and plan.sharing is None:
            meter = target.meter = NoiseMeter(like, plan.circle, plan.table)
        _add_all(plan, self.parts(), target, progress)
        data = target.volume()
        plan.cover(data, like, outside=self.outside)
        if meter is None:
            return data.transpose(2, 0, 1), None
        plan.cover(meter.data, meter.grid, outside=self.outside)
        plan.cover(meter.halves.factors, meter.halves.grid, outside=self.outside)
        return data.transpose(2, 0, 1), meter.found()


def fdk_parts(
    parts: Callable[[], Iterable[Float32Array]],
    cone_vec: ConeVec,
    shape: tuple[int, int],
    like: Volume | Grid,
    window: str = PLAIN,
    progress: Progress | None = None,
    truncation: Truncation | None = None,
    target: Backprojector | None = None,
    *,
    outside: bool = False,
    errors: bool = False,
) -> Volume:
    """Reconstruct as `fdk` from views in parts, in order, without warnings.

    A circle goes to a device with room unless a target is given; if that fails, from the
    beginning on the processor. `parts` gives line integrals (k, rows, cols), and may be
    called again. `outside` keeps what continued rows give where not all sides are seen.
    Raises GeometryError: `plan_fdk`, or other images; UnknownNameError: no such window.
    """
    like = as_volume(like)
    task = Task(parts, cone_vec, shape, window, truncation, outside, errors)
    if target is None and not circle_of(cone_vec).rise:
        with suppress(gpu.DeviceError):
            if slabs := _slabs(like, shape):
                return _on_device(task, like, slabs, progress)
    data, noise = task.onto(target or OnProcessor(like), like, progress)
    return with_errors(replace(like, data=data), noise)


def _on_device(
    task: Task, like: Volume, slabs: list[tuple[int, int]], progress: Progress | None
) -> Volume:
    """Reconstruct on a device, slab by slab; the images are read once a slab.

    Args:
        task: images, geometry and settings.
        like: place and size of the grid.
        slabs: first layer of each, and the one after its last.
        progress: called with the share that is done.

    Returns:
        The volume, with noise where it was measured in every slab, else without any.

    Raises:
        gpu.DeviceError: the device fails.
    """
    if len(slabs) == 1:
        data, noise = task.onto(OnDevice(like), like, progress)
        return with_errors(replace(like, data=data), noise)
    nz, ny, nx = like.shape
    data = np.empty((ny, nx, nz), np.float32).transpose(2, 0, 1)
    noises: list[NoiseOfViews] = []
    for k, (first, last) in enumerate(slabs):
        slab = layers(like, first, last)
        tell = _share(progress, k, len(slabs))
        data[first:last], noise = task.onto(OnDevice(slab), slab, tell)
        noises += [] if noise is None else [noise]
    volume = replace(like, data=data)
    if len(noises) < len(slabs):
        return volume
    return with_errors(volume, NoiseOfSlabs(tuple(slabs), tuple(noises)))


def _add_all(
    plan: FdkPlan,
    parts: Iterable[Float32Array],
    target: Backprojector,
    progress: Progress | None,
) -> None:
    """Add the images of all views, (k, rows, cols) a part, to a volume.

    `progress` gets the share done. Raises GeometryError: another shape or number of
    images; gpu.DeviceError: the device failed.
    """
    done = 0
    for part in parts:
        target.add(plan.views_of(part, done))
        done += len(part)
        if progress is not None:
            progress(done / plan.count)
    if done != plan.count:
        given = f"{done} projections"
        raise GeometryError.instead(given, done, f"one for each of {plan.count} views")


def _slabs(like: Volume, shape: tuple[int, int]) -> list[tuple[int, int]]:
    """List layers (first, last) of slabs that fit the device, doubling their number.

    Empty without a device, or if not even one layer of the grid fits.
    """
    count = 1
    most = like.shape[0]
    while not device_takes(layers(like, 0, -(-most // count)), shape):
        if count >= most or not gpu.availability().present:
            return []
        count = min(2 * count, most)
    return cut(most, count)


def _share(progress: Progress | None, k: int, count: int) -> Progress | None:
    """Map progress of the k-th (from 0) of several equal parts to progress of all; None
    without progress.
    """
    if progress is None:
        return None
    return lambda part: progress((k + part) / count)
