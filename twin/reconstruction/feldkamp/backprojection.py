"""Views weighed, filtered and added to a volume: on a CUDA device or on the processor.

Both take views in parts and hand out the volume at the end; the volume stays where it is
computed until then. They give the same numbers (to 1e-5 of the maximum), and both add up what
the noise of the volume is found from, if there is a `meter`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection import Volume, gpu
from flexdt.twin.projection.cpu import threads
from flexdt.twin.reconstruction.acquisition.coverage import first_and_steps
from flexdt.twin.reconstruction.feldkamp.far_prisms import NearColumns
from flexdt.twin.reconstruction.feldkamp.fdk_views import Views
from flexdt.twin.reconstruction.feldkamp.filtering import (
    filtered,
    padded_length,
    response_of_length,
    taps,
)
from flexdt.twin.reconstruction.feldkamp.image_upload import ImageUpload
from flexdt.twin.reconstruction.feldkamp.noise import NoiseMeter

MOST_COLUMNS: Final = 65_535
"""Largest number of voxel columns along y in a device's grid."""
CHUNK: Final = 32
"""Least number of views in a chunk."""
GROUP: Final = 8
"""Least number of views that the processor weighs and filters at a time: they stay in
its caches. Fewer of those that are widened to more than twice their columns, which
take more memory."""
PIXELS: Final = 1 << 18
"""Number of pixels of a group; a chunk may hold four times as many. Calls of few rows
cost more than their work."""
STACKS: Final = 6
"""Stacks of so many images that a device holds: twice the input, and widened, of three
steps."""


def device_takes(like: Volume, shape: tuple[int, int]) -> bool:
    """Return whether a device is present and has room for the grid of `like` (at most
    `MOST_COLUMNS` voxels along y) and `STACKS` stacks of `CHUNK` images. `like`: place and size
    of the grid; its values are not read. `shape`: (rows, cols) of the images."""
    nz, ny, nx = like.shape
    need = 4 * (nz * ny * nx + STACKS * CHUNK * shape[0] * shape[1])
    return gpu.availability().present and ny <= MOST_COLUMNS and gpu.has_room(need)


class OnProcessor:
    """Back-projector on the processor, on all threads.

    Attributes:
        meter: adds up the noise meanwhile; None for nothing.
    """

    def __init__(self, like: Volume) -> None:
        """Allocate a volume of zeros with the place and size of `like`, and no noise
        meter.
        """
        nz, ny, nx = like.shape
        self._first, self._size = first_and_steps(like)
        self._data = np.zeros((ny, nx, nz), np.float32)
        self._sizes = (0, 0, 0, 0)
        self._columns = self._data
        self.meter: NoiseMeter | None = None

    def add(self, views: Views) -> None:
        """Weigh and filter views in small groups that stay in the caches, and add them to
        the volume, in place; then also to the noise meter, if there is one.

        Memory for filtered columns is kept for the next views of the same size; the meter
        overwrites it.

        Args:
            views: the next ones.
        """
        from flexdt.twin.reconstruction.kernels import fdk_kernels

        n, _, cols, rows = views.sizes
        if views.sizes != self._sizes:  # new memory costs as much as filtering
            self._sizes = views.sizes
            self._columns = fdk_kernels.room(n, cols, rows, views.few)
        views = replace(views, images=np.ascontiguousarray(views.images))
        fill_columns(views, self._columns)
        fdk_kernels.backproject(
            self._columns,
            rows,
            views.shares,
            views.table,
            *self._first,
            *self._size,
            self._data,
            threads(),
        )
        if self.meter is not None:
            self.meter.add(views, self._columns)

    def volume(self) -> Float32Array:
        """Return the sum so far, (ny, nx, nz)."""
        return self._data


def fill_columns(views: Views, columns: Float32Array) -> None:
    """Weigh and filter images on the processor.

    Args:
        views: n views, their images in C order.
        columns: (n or more, cols, rows or more) filled with the columns that are kept.
    """
    from flexdt.twin.reconstruction.kernels import fdk_kernels, truncation_kernels

    near = NearColumns.of(views)
    far = None
    if near is not None:
        far = near.far(views)
        views = views.within(near.columns, near.response)
    n, wide, _, rows = views.sizes
    on = views.beyond
    start = views.kept.start
    fitting = min(GROUP, 2 * GROUP * views.images.shape[2] // wide)
    group = max(1, fitting, PIXELS // (wide * rows))
    for first in range(0, n, group):
        some = slice(first, first + group)
        lines = filtered(_weighed(views.of(some)), views.response)
        if far is not None:
            truncation_kernels.add_bands(lines, start, far[some], on.band, on.share)
        fdk_kernels.stand_up(lines, start, columns[some])


def _weighed(views: Views) -> Float32Array:
    """Compute the images weighted for the filter, padded with zeros to its length.

    Rows are widened first where columns off the panel go into the filter.

    Args:
        views: n views.

    Returns:
        (n, rows that are needed, padded columns).
    """
    from flexdt.twin.reconstruction.kernels import fdk_kernels

    n, _, _, rows = views.sizes
    ready = np.empty((n, rows, padded_length(views.response)), np.float32)
    if views.wider:
        views.widen(ready, weighed=True)
    else:
        fdk_kernels.weigh(
            views.images, views.top, views.factors, views.across, views.up, ready
        )
    return ready


class OnDevice:
    """Back-projector on a CUDA device, for circles: images are sent, the volume comes
    back.

    Images are uploaded while the device works on earlier ones. Rows are continued,
    weighed and filtered there two at a time, by a Fourier transform in the memory of a
    block; rows too long for it are continued by the processor and convolved, a product
    for each pair of pixels.

    Attributes:
        meter: finds the noise from two more volumes on its coarse grid: of the views that
            count with a plus there, and of those with a minus.

    Raises:
        gpu.DeviceError: from each method; the device failed, and what was added is lost.
    """

    def __init__(self, like: Volume) -> None:
        """Allocate a volume of zeros on the device, with the place and size of `like`;
        other memory is allocated when views are added.

        Raises:
            gpu.DeviceError: the device fails.
        """
        nz, ny, nx = like.shape
        self._shape = (ny, nx, nz)
        self._halves: list[tuple[Any, Any]] = []
        self._filter: tuple[Any, ...] = ()
        self._room: Any = None
        self._tables: dict[tuple[int, ...], Any] = {}
        self.meter: NoiseMeter | None = None

        def prepare() -> None:
            """Allocate on the device the grid, a volume of zeros, the stream of the
            kernels and the image upload; stores all four in the object.
            """
            from numba import cuda

            self._grid = [
                cuda.to_device(np.array(numbers)) for numbers in first_and_steps(like)
            ]
            self._flat = gpu.zeros(ny * nx * nz)
            self._stream = cuda.stream()
            self._upload = ImageUpload(self._stream)

        gpu.demand(prepare)

    def add(self, views: Views) -> None:
        """Weigh and filter views, and add them to the volume on the device; does not wait
        for the last of its work.

        Views are sorted by the noise meter's sign (plus, 0, minus), if there is a meter,
        and then added to its half volumes as well. Raises gpu.DeviceError: the device
        fails.
        """
        signs = np.zeros(len(views.images), np.float32)
        if self.meter is not None:
            signs = self.meter.note(views)
        order = np.argsort(-signs, kind="stable")
        ends = int((signs > 0.0).sum()), int((signs >= 0.0).sum())
        gpu.demand(lambda: self._add(views.without_images(order), order, *ends))

    def _add(
        self, views: Views, order: npt.NDArray[np.intp], plus: int, minus: int
    ) -> None:
        """Weigh, filter and add images, in sorted order; also into both half volumes of
        the noise meter, if there is one.

        Filters by a Fourier transform where a padded row fits (`padded_power`), else by
        convolution. Does not wait for the device.

        Args:
            views: with sorted tables but images in the order of arrival.
            order: number of the image for each row of the tables.
            plus: number of first views that count with a plus in the noise.
            minus: first view of those that count with a minus.
        """
        self._upload.begin()
        length = padded_power(views)
        if length:
            ready = self._transformed(views, order, length)
        else:
            ready = self._convolved(replace(views, images=views.images[order]))
        n, _, cols, rows = views.sizes
        self._backproject(
            ready, (cols, rows), views.table, self._grid, self._flat, self._shape
        )
        if self.meter is not None:
            shape = self.meter.data.shape
            halves = zip((slice(plus), slice(minus, n)), self._both(), strict=True)
            for some, (grid, flat) in halves:
                if len(views.table[some]):
                    self._backproject(
                        ready[some], (cols, rows), views.table[some], grid, flat, shape
                    )

    def _transformed(self, views: Views, order: npt.NDArray[np.intp], length: int) -> Any:
        """Weigh and filter columns of the images by a Fourier transform on the device;
        the host does not wait.

        The filter's tables are uploaded at the first call and kept.

        Args:
            views: n views with their weights and response, sorted; images in the order of
                arrival.
            order: (n,) number of the image of each view.
            length: of the transform, a power of 2.

        Returns:
            The filtered images (n, cols, rows) on the device, ready when its stream comes
            to them, until the next call.
        """
        from flexdt.twin.reconstruction.kernels import (
            gpu_reconstruction_kernels as kernels,
        )

        upload = self._upload
        on = views.beyond
        shown = views.shown
        there = upload.images(views.images, order, shown)
        tables = [
            upload.table("factors", views.factors),
            upload.table("across", views.across),
            upload.table("up", views.up),
            upload.table("lengths", views.prism_lengths()),
        ]
        if not self._filter:
            self._filter = self._filter_tables(views, length)
        upload.hand_over()
        n, _, cols, rows = views.sizes
        ready = self._ready(n, cols, rows)
        kernels.filter_rows[(-(-rows // 2), n), kernels.THREADS, self._stream](
            there,
            views.top - shown.start,
            views.before,
            on.edge,
            *tables,
            *self._filter,
            views.kept.start,
            ready,
        )
        upload.end()
        return ready

    def _filter_tables(self, views: Views, length: int) -> tuple[Any, ...]:
        """Upload the tables that all chunks share: continuation, response in the order of
        reversed bits, the transform's factors.

        Args:
            views: with their response.
            length: of the transform, a power of 2.

        Returns `band` to `sines` of `kernels.filter_rows`, on the device, as the kernel takes
        them.
        """
        from numba import cuda

        on = views.beyond
        turn = 2.0 * np.pi * np.arange(length // 2) / length
        response = response_of_length(views.response, length) / length
        response = np.concatenate([response, response[-2:0:-1]])[bits_reversed(length)]
        tables = (on.share, on.cut, on.fade, response, np.cos(turn), np.sin(turn))
        return (
            cuda.to_device(on.band.astype(np.int32)),
            *(cuda.to_device(np.asarray(table, np.float32)) for table in tables),
        )

    def _convolved(self, views: Views) -> Any:
        """Weigh the images and filter them by a sum over taps, for rows of any length;
        the processor continues the rows.

        Args:
            views: n views, images and tables in the same order.

        Returns:
            As that of `_transformed`, (n, cols, rows) on the device.
        """
        from numba import cuda

        from flexdt.twin.reconstruction.kernels import (
            gpu_reconstruction_kernels as kernels,
        )

        n, wide, cols, rows = views.sizes
        upload = self._upload
        stream = self._stream
        lines = np.empty((n, rows, wide), np.float32)
        views.widen(lines)
        there = upload.images(lines, np.arange(n), slice(0, rows))
        tables = [
            upload.table("factors", views.factors),
            upload.table("across", views.across),
            upload.table("up", views.up),
            upload.table("taps", taps(views.response, wide, kernels.RUN)),
        ]
        upload.hand_over()

        def plane(columns: int) -> tuple[int, int, int]:
            return -(-rows // kernels.PLANE[0]), -(-columns // kernels.PLANE[1]), n

        weighted = cuda.device_array((n, wide, rows), np.float32, stream=stream)
        kernels.weigh[plane(wide), (*kernels.PLANE, 1), stream](
            there, 0, *tables[:3], weighted
        )
        ready = self._ready(n, cols, rows)
        kernels.convolve[plane(-(-cols // kernels.RUN)), (*kernels.PLANE, 1), stream](
            weighted, tables[3], views.kept.start, ready
        )
        upload.end()
        return ready

    def _ready(self, n: int, cols: int, rows: int) -> Any:
        """Reserve device memory (n, cols, rows) for filtered columns, with undefined
        content.

        All calls share one piece, so each overwrites the result before.
        """
        from numba import cuda

        if self._room is None or self._room.size < n * cols * rows:
            self._room = cuda.device_array(n * cols * rows, np.float32)
        return self._room[: n * cols * rows].reshape(n, cols, rows)

    def _backproject(
        self,
        ready: Any,
        size: tuple[int, int],
        table: FloatArray,
        grid: list[Any],
        flat: Any,
        shape: tuple[int, ...],
    ) -> None:
        """Upload the views' table and add filtered images to a volume on the device; does
        not wait.

        Args:
            ready: filtered images (n, cols, rows) on the device.
            size: (cols, rows).
            table: (n, 11) of `view_table`.
            grid: center of the first voxel and steps, on the device.
            flat: the volume's voxels, changed in place.
            shape: (ny, nx, nz).
        """
        from numba import cuda

        from flexdt.twin.reconstruction.kernels import (
            gpu_reconstruction_kernels as kernels,
        )

        ny, nx, nz = shape
        blocks = (
            -(-nz // (kernels.BLOCK[0] * kernels.RUN)),
            -(-nx // kernels.BLOCK[1]),
            ny,
        )
        views = self._tables.get(table.shape)
        if views is None:
            views = self._tables[table.shape] = cuda.device_array(table.shape, np.float64)
        # Memory given back would make the host wait for the device; the stream keeps the order.
        views.copy_to_device(np.ascontiguousarray(table), self._stream)
        kernels.backproject[blocks, (*kernels.BLOCK, 1), self._stream](
            ready.reshape(ready.size), *size, views, *grid, flat.reshape(ny, nx, nz)
        )

    def _both(self) -> list[tuple[Any, Any]]:
        """List the noise meter's grid with a volume for either sign, (grid, flat) each,
        allocated at the first use; empty without a meter.
        """
        from numba import cuda

        if self.meter is not None and not self._halves:
            places = first_and_steps(self.meter.grid)
            grid = [cuda.to_device(np.array(numbers)) for numbers in places]
            self._halves = [(grid, gpu.zeros(self.meter.data.size)) for _ in range(2)]
        return self._halves

    def volume(self) -> Float32Array:
        """Return a copy of the sum so far, (ny, nx, nz), after the device has ended its
        work.

        With a noise meter, its data is overwritten by the difference of both half
        volumes, plus less minus.

        Raises:
            gpu.DeviceError: the device fails.
        """
        from flexdt.twin.projection.kernels import layout_kernels

        out = np.empty(self._shape, np.float32)
        layout_kernels.touch(out.reshape(-1))  # while the device is still at work

        def fetch() -> None:
            """Wait for the device and copy the volume into `out`; with a noise meter,
            also write the plus less the minus volume into its data.
            """
            self._stream.synchronize()
            self._flat.copy_to_host(out.reshape(-1))
            if self.meter is not None:
                plus, minus = (flat.copy_to_host() for _, flat in self._both())
                np.subtract(plus, minus, out=self.meter.data.reshape(-1))

        gpu.demand(fetch)
        return out


def padded_power(views: Views) -> int:
    """Compute the columns of a row padded to a power of 2, enough for the filter's reach;
    0 where it exceeds `kernels.LENGTH`, which a block's memory has no room for.
    """
    from flexdt.twin.reconstruction.kernels import gpu_reconstruction_kernels as kernels

    least = max(2 * views.reach - 1, views.factors.shape[1], 2)
    length = 1 << (least - 1).bit_length()
    return length if length <= kernels.LENGTH else 0


def bits_reversed(length: int) -> npt.NDArray[np.intp]:
    """List the numbers below a power of 2 with their bits in reversed order, (length,);
    [0] for 1.
    """
    order = np.zeros(1, np.intp)
    while len(order) < length:
        order = np.concatenate([2 * order, 2 * order + 1])
    return order


Backprojector = OnProcessor | OnDevice
"""Weighs and filters views and adds them to a volume."""
