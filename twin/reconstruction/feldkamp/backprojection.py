"""Views weighed, filtered and added to a volume: on a CUDA device or on the processor.

Both take views in parts and hand out the volume at the end; the volume stays where it is computed
until then. They give the same numbers (to 1e-5 of the maximum), and both add up what the noise of
the volume is found from, if there is a `meter`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import numpy as np

from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection import Volume, gpu
from flexdt.twin.projection.cpu import threads
from flexdt.twin.reconstruction.acquisition.coverage import first_and_steps
from flexdt.twin.reconstruction.feldkamp.fdk_views import Views
from flexdt.twin.reconstruction.feldkamp.filtering import filtered, taps
from flexdt.twin.reconstruction.feldkamp.noise import NoiseMeter

MOST_COLUMNS: Final = 65_535
"""Voxel columns along y that a device's grid can hold."""
CHUNK: Final = 32
"""Views worked on at a time, at least."""
GROUP: Final = 8
"""Views that the processor weighs and filters at a time, at least: they stay in its caches. Fewer
of those that are widened to more than twice their columns, which take more memory."""
PIXELS: Final = 1 << 18
"""Of a group; a chunk may hold four times as many. Calls of few rows cost more than their work."""
STACKS: Final = 6
"""Stacks of so many images that a device holds: twice what came, and made wider, of three steps."""


def device_takes(like: Volume, shape: tuple[int, int]) -> bool:
    """Whether there is a device that has room for the grid of `like` and images of (rows, cols)."""
    nz, ny, nx = like.shape
    need = 4 * (nz * ny * nx + STACKS * CHUNK * shape[0] * shape[1])
    return gpu.availability().present and ny <= MOST_COLUMNS and gpu.has_room(need)


class OnProcessor:
    """On the processor, all threads.

    Attributes:
        meter: adds up the noise meanwhile; None for nothing.
    """

    def __init__(self, like: Volume) -> None:
        nz, ny, nx = like.shape
        self._first, self._size = first_and_steps(like)
        self._data = np.zeros((ny, nx, nz), np.float32)
        self._sizes, self._columns = (0, 0, 0, 0), self._data
        self.meter: NoiseMeter | None = None

    def add(self, views: Views) -> None:
        """Weigh and filter views, and add them to the volume."""
        from flexdt.twin.reconstruction.kernels import fdk_kernels

        n, wide, cols, rows = views.sizes
        if views.sizes != self._sizes:  # new memory costs as much as filtering
            self._sizes, self._columns = views.sizes, fdk_kernels.room(n, cols, rows, views.few)
        views = replace(views, images=np.ascontiguousarray(views.images))
        fitting = min(GROUP, 2 * GROUP * views.images.shape[2] // wide)
        group = max(1, fitting, PIXELS // (wide * rows))
        for first in range(0, n, group):
            some = slice(first, first + group)
            lines = filtered(_weighed(views.of(some)), views.response)
            fdk_kernels.stand_up(lines, views.kept.start, self._columns[some])
        fdk_kernels.backproject(
            self._columns, rows, views.shares, views.table, *self._first, *self._size, self._data,
            threads(),
        )  # fmt: skip
        if self.meter is not None:
            self.meter.add(views, self._columns)

    def volume(self) -> Float32Array:
        """What has been added up, (ny, nx, nz)."""
        return self._data


def _weighed(views: Views) -> Float32Array:
    """Rows that go into the filter, with their weights, (n, rows, cols)."""
    from flexdt.twin.reconstruction.kernels import fdk_kernels

    n, wide, _, rows = views.sizes
    ready = np.empty((n, rows, wide), np.float32)
    images, top = views.images, views.top
    if views.wider:
        views.widen(ready)
        images, top = ready, 0
    fdk_kernels.weigh(images, top, views.factors, views.across, views.up, ready)
    return ready


class OnDevice:
    """On a CUDA device, circles only: images go there, and the volume comes back.

    Images are copied, or widened by all cores, into one of two page-locked buffers while the device
    works on the other. The filter is a plain convolution with the taps of its response, a product
    for each pair of pixels of a row, without a library for Fourier transforms there.

    Attributes:
        meter: finds the noise from two more volumes on its coarse grid: of the views that count
            with a plus there, and of those with a minus.

    Raises:
        gpu.DeviceError: from each method; the device failed, and what was added is lost.
    """

    def __init__(self, like: Volume) -> None:
        nz, ny, nx = like.shape
        self._shape, self._turn = (ny, nx, nz), 0
        self._buffers: dict[int, tuple[Any, Any]] = {}
        self._halves: list[tuple[Any, Any]] = []
        self.meter: NoiseMeter | None = None

        def prepare() -> None:
            from numba import cuda

            self._grid = [cuda.to_device(np.array(numbers)) for numbers in first_and_steps(like)]
            self._flat, self._stream = gpu.zeros(ny * nx * nz), cuda.stream()

        gpu.demand(prepare)

    def add(self, views: Views) -> None:
        """See `OnProcessor`."""
        ends = len(views.images), len(views.images)
        if self.meter is not None:
            signs = self.meter.note(views)
            views = views.of(np.argsort(-signs, kind="stable"))
            ends = int((signs > 0.0).sum()), int((signs >= 0.0).sum())
        gpu.demand(lambda: self._add(views, *ends))

    def _add(self, views: Views, plus: int, minus: int) -> None:
        """Weigh, filter and add images; the first `plus` count so in the noise, those from `minus`
        on with a minus."""
        ready = self._filtered(views)
        n, _, cols, rows = views.sizes
        self._backproject(ready, (cols, rows), views.table, self._grid, self._flat, self._shape)
        if self.meter is not None:
            shape = self.meter.data.shape
            halves = zip((slice(plus), slice(minus, n)), self._both(), strict=True)
            for some, (grid, flat) in halves:
                if len(views.table[some]):
                    self._backproject(
                        ready[some], (cols, rows), views.table[some], grid, flat, shape
                    )

    def _filtered(self, views: Views) -> Any:
        """Columns of the images on the device, weighed and filtered, (n, cols, rows)."""
        from numba import cuda

        from flexdt.twin.reconstruction.kernels import gpu_reconstruction_kernels as kernels

        there, top = self._moved(views), 0 if views.wider else views.top
        n, wide, cols, rows = views.sizes
        stream = self._stream

        def small(values: FloatArray) -> Any:
            return cuda.to_device(np.ascontiguousarray(values, dtype=np.float32), stream)

        def plane(columns: int) -> tuple[int, int, int]:
            return -(-rows // kernels.PLANE[0]), -(-columns // kernels.PLANE[1]), n

        weighted = cuda.device_array((n, wide, rows), np.float32, stream=stream)
        kernels.weigh[plane(wide), (*kernels.PLANE, 1), stream](
            there, top, small(views.factors), small(views.across), small(views.up), weighted
        )  # fmt: skip
        ready = cuda.device_array((n, cols, rows), np.float32, stream=stream)
        kernels.convolve[plane(-(-cols // kernels.RUN)), (*kernels.PLANE, 1), stream](
            weighted, small(taps(views.response, wide, kernels.RUN)), views.kept.start, ready
        )
        return ready

    def _backproject(
        self,
        ready: Any,
        size: tuple[int, int],
        table: FloatArray,
        grid: list[Any],
        flat: Any,
        shape: tuple[int, ...],
    ) -> None:
        """Add filtered columns of images of `size` (cols, rows) to a volume (ny, nx, nz)."""
        from numba import cuda

        from flexdt.twin.reconstruction.kernels import gpu_reconstruction_kernels as kernels

        ny, nx, nz = shape
        blocks = (-(-nz // (kernels.BLOCK[0] * kernels.RUN)), -(-nx // kernels.BLOCK[1]), ny)
        views = cuda.to_device(np.ascontiguousarray(table), self._stream)
        kernels.backproject[blocks, (*kernels.BLOCK, 1), self._stream](
            ready.reshape(ready.size), *size, views, *grid, flat.reshape(ny, nx, nz)
        )

    def _both(self) -> list[tuple[Any, Any]]:
        """The meter's grid with a volume for either sign, (grid, flat) each."""
        from numba import cuda

        if self.meter is not None and not self._halves:
            places = first_and_steps(self.meter.grid)
            grid = [cuda.to_device(np.array(numbers)) for numbers in places]
            self._halves = [(grid, gpu.zeros(self.meter.data.size)) for _ in range(2)]
        return self._halves

    def _moved(self, views: Views) -> Any:
        """Images on the device, by page-locked memory, from where copies are not waited for."""
        from numba import cuda

        n, wide, _, rows = views.sizes
        shape = (rows, wide) if views.wider else views.images.shape[1:]
        self._turn = 1 - self._turn
        buffer, copied = self._buffers.get(self._turn, (None, None))
        if copied is not None:
            copied.synchronize()
        if buffer is None or len(buffer) < n:
            buffer = cuda.pinned_array((n, *shape), np.float32)
        part = buffer[:n]
        if views.wider:
            views.widen(part)
        else:
            np.copyto(part, views.images)
        there, copied = cuda.to_device(part, self._stream), cuda.event()
        copied.record(self._stream)
        self._buffers[self._turn] = buffer, copied
        return there

    def volume(self) -> Float32Array:
        """See `OnProcessor`."""
        out = np.empty(self._shape, np.float32)

        def fetch() -> None:
            self._stream.synchronize()
            self._flat.copy_to_host(out.reshape(-1))
            if self.meter is not None:
                plus, minus = (flat.copy_to_host() for _, flat in self._both())
                np.subtract(plus, minus, out=self.meter.data.reshape(-1))

        gpu.demand(fetch)
        return out


Backprojector = OnProcessor | OnDevice
"""What weighs and filters views and adds them to a volume."""
