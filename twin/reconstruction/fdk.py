"""Filtered backprojection for cone beams on a circle (Feldkamp, Davis and Kress 1984) or a helix.

The panel may be moved to any side and turned about the vertical: distances and angles come from
each row of the geometry. Tilted panels are resampled upright first. Views may come in parts, so
neither all images nor, slab by slab, the whole volume need fit into memory.

Weights, filter and backprojection run on a CUDA device if it has room for the volume, else on the
processor. Both take views in parts and hand out the volume at the end; the volume stays where it is
computed until then. They give the same numbers (to 1e-5 of the maximum).

Detector rows are filtered by the ramp filter as sampled in space, with the usual windows, and
padded to twice their length, so that the convolution does not wrap.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from flexdt.twin.errors import GeometryError, UnknownNameError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection import Grid, Volume, as_volume, gpu
from flexdt.twin.projection.cpu import threads
from flexdt.twin.projection.volume import cut
from flexdt.twin.reconstruction.coverage import Sharing, first_and_steps, normalise_coverage
from flexdt.twin.reconstruction.noise import NoiseMeter, with_errors
from flexdt.twin.reconstruction.rectify import (
    FINER,
    is_upright,
    leans,
    on_its_side,
    rectified,
    rows_needed,
    swapped,
    upright,
)
from flexdt.twin.reconstruction.rectify import window as window_of
from flexdt.twin.reconstruction.trajectory import (
    Circle,
    axis_between,
    circle_of,
    columns_beyond,
    narrow_overlap,
    no_fdk,
    redundancy,
)
from flexdt.twin.reconstruction.truncation import Truncation

MOST_COLUMNS = 65_535
"""Voxel columns along y that a device's grid can hold."""
CHUNK = 32
"""Views worked on at a time, at least."""
GROUP: Final = 8
"""Views that the processor weighs and filters at a time, at least: they stay in its caches."""
PIXELS: Final = 1 << 18
"""Of a group; a chunk may hold four times as many. Calls of few rows cost more than their work."""
FEW_ROWS: Final = 5
"""Of a panel that is done voxels beside one another at a time. The panel decides, not the rows that
a grid needs: slabs are the whole volume's to the bit."""
STACKS: Final = 6
"""Stacks of so many images that a device holds: twice what came, and made wider, of three steps."""
MOST_ASIDE: Final = 0.1
"""By how much of its width the panel may go sideways between the views: jitter, not tiles."""


@dataclass(frozen=True, eq=False)
class Views:
    """Some views on their way to a volume.

    They are multiplied by factors / length of the ray to the pixel, and filtered along rows.

    Attributes:
        images: (n, rows of the panel, cols).
        top: the first row that is needed.
        factors: float64 (n, cols).
        across, up: squares of the ray's horizontal and vertical parts, (n, cols) and (n, rows that
            are needed) [mm^2].
        response: of the filter.
        kept: columns whose filtered values are needed.
        shares, table: of `fdk_kernels.backproject`.
        few: whether the panel has few rows.
    """

    images: Float32Array
    top: int
    factors: FloatArray
    across: FloatArray
    up: FloatArray
    response: Float32Array
    kept: slice
    shares: Float32Array
    table: FloatArray
    few: bool

    @property
    def sizes(self) -> tuple[int, int, int, int]:
        """Views, columns before and after the filter, rows."""
        n, wide = self.factors.shape
        return n, wide, self.kept.stop - self.kept.start, self.up.shape[1]


def device_takes(like: Volume, shape: tuple[int, int]) -> bool:
    """Whether there is a device that has room for the grid of `like` and images of (rows, cols)."""
    nz, ny, nx = like.shape
    need = 4 * (nz * ny * nx + STACKS * CHUNK * shape[0] * shape[1])
    return gpu.availability().present and ny <= MOST_COLUMNS and gpu.has_room(need)


class OnProcessor:
    """On the processor, all threads."""

    def __init__(self, like: Volume) -> None:
        nz, ny, nx = like.shape
        self._first, self._size = first_and_steps(like)
        self._data = np.zeros((ny, nx, nz), np.float32)
        self._sizes, self._columns = (0, 0, 0, 0), self._data
        self.meter: NoiseMeter | None = None

    def add(self, views: Views) -> None:
        """Weigh and filter views, and add them to the volume."""
        from flexdt.twin.reconstruction import fdk_kernels

        n, wide, cols, rows = views.sizes
        if views.sizes != self._sizes:  # new memory costs as much as filtering
            self._sizes, self._columns = views.sizes, fdk_kernels.room(n, cols, rows, views.few)
        images, group = np.ascontiguousarray(views.images), max(GROUP, PIXELS // (wide * rows))
        for first in range(0, n, group):
            some = slice(first, first + group)
            ready = np.empty((len(images[some]), rows, wide), np.float32)
            fdk_kernels.weigh(
                images[some], views.top, views.factors[some], views.across[some], views.up[some],
                ready,
            )  # fmt: skip
            lines = filtered(ready, views.response)
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


class OnDevice:
    """On a CUDA device, circles only: images go there, and the volume comes back.

    Images are copied into one of two page-locked buffers while the device works on the other. The
    filter is a plain convolution with the taps of its response, a product for each pair of pixels
    of a row, without a library for Fourier transforms there.

    Raises:
        gpu.DeviceError: from each method; the device failed, and what was added is lost.
    """

    def __init__(self, like: Volume) -> None:
        nz, ny, nx = like.shape
        self._shape, self._turn = (ny, nx, nz), 0
        self._buffers: dict[int, tuple[Any, Any]] = {}

        def prepare() -> None:
            from numba import cuda

            self._grid = [cuda.to_device(np.array(numbers)) for numbers in first_and_steps(like)]
            self._flat, self._stream = gpu.zeros(ny * nx * nz), cuda.stream()

        gpu.demand(prepare)

    def add(self, views: Views) -> None:
        """See `OnProcessor`."""
        gpu.demand(lambda: self._add(views))

    def _add(self, views: Views) -> None:
        """Weigh, filter and add images."""
        from numba import cuda

        from flexdt.twin.reconstruction import gpu_reconstruction_kernels as kernels

        there = self._moved(views.images)
        n, wide, cols, rows = views.sizes
        (ny, nx, nz), stream = self._shape, self._stream

        def small(values: FloatArray, kind: type = np.float32) -> Any:
            return cuda.to_device(np.ascontiguousarray(values, dtype=kind), stream)

        def plane(columns: int) -> tuple[int, int, int]:
            return -(-rows // kernels.PLANE[0]), -(-columns // kernels.PLANE[1]), n

        weighted = cuda.device_array((n, wide, rows), np.float32, stream=stream)
        kernels.weigh[plane(wide), (*kernels.PLANE, 1), stream](
            there, views.top, small(views.factors), small(views.across), small(views.up), weighted
        )  # fmt: skip
        ready = cuda.device_array((n, cols, rows), np.float32, stream=stream)
        kernels.convolve[plane(-(-cols // kernels.RUN)), (*kernels.PLANE, 1), stream](
            weighted, small(_taps(views.response, wide, kernels.RUN)), views.kept.start, ready
        )
        blocks = (-(-nz // (kernels.BLOCK[0] * kernels.RUN)), -(-nx // kernels.BLOCK[1]), ny)
        kernels.backproject[blocks, (*kernels.BLOCK, 1), stream](
            ready.reshape(ready.size), cols, rows, small(views.table, np.float64), *self._grid,
            self._flat.reshape(ny, nx, nz),
        )  # fmt: skip

    def _moved(self, images: Float32Array) -> Any:
        """Images on the device, by page-locked memory, from where copies are not waited for."""
        from numba import cuda

        self._turn = 1 - self._turn
        buffer, copied = self._buffers.get(self._turn, (None, None))
        if copied is not None:
            copied.synchronize()
        if buffer is None or len(buffer) < len(images):
            buffer = cuda.pinned_array(images.shape, np.float32)
        part = buffer[: len(images)]
        np.copyto(part, images)
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

        gpu.demand(fetch)
        return out


def _taps(response: Float32Array, wide: int, more: int) -> FloatArray:
    """The filter as it is in space: of the distance in columns, (wide + more,)."""
    from scipy import fft

    length = fft.next_fast_len(2 * wide, real=True)
    taps = np.fft.irfft(response.astype(np.float64), length)[:wide]
    return np.pad(taps, (0, more))


Backprojector = OnProcessor | OnDevice
"""What weighs and filters views and adds them to a volume."""
Window = Callable[[FloatArray], FloatArray]

WINDOWS: Final[Mapping[str, Window]] = {
    "ram-lak": lambda f: np.ones_like(f),
    "shepp-logan": lambda f: np.sinc(f / 2.0),
    "cosine": lambda f: np.cos(np.pi / 2.0 * f),
    "hamming": lambda f: 0.54 + 0.46 * np.cos(np.pi * f),
    "hann": lambda f: 0.5 + 0.5 * np.cos(np.pi * f),
}
"""Name -> factor at a frequency given as part of the highest."""


def ramp(cols: int, pitch_mm: float, window: str = "ram-lak") -> Float32Array:
    """Frequency response for rows of `cols` pixels, (padded / 2 + 1,), times the pitch [1/mm].

    Raises:
        UnknownNameError: lists the windows.
    """
    from scipy import fft

    if window not in WINDOWS:
        raise UnknownNameError.among(f"unknown filter {window!r}; there are", window, WINDOWS)
    length = fft.next_fast_len(2 * cols, real=True)
    n = np.minimum(np.arange(length), length - np.arange(length))
    kernel = np.zeros(length)
    odd = n % 2 == 1
    kernel[odd] = -1.0 / (np.pi * n[odd] * pitch_mm) ** 2
    kernel[0] = 0.25 / pitch_mm**2
    response = np.fft.rfft(kernel).real * pitch_mm
    shape = WINDOWS[window](np.linspace(0.0, 1.0, len(response)))
    return np.asarray(response * shape, dtype=np.float32)


def filtered(rows: Float32Array, response: Float32Array) -> Float32Array:
    """Rows (..., cols), zero beyond their ends, convolved with the filter of `response`."""
    from scipy import fft

    from flexdt.twin.reconstruction import fdk_kernels

    cols = rows.shape[-1]
    length = fft.next_fast_len(2 * cols, real=True)
    spectrum = fft.rfft(rows, length, axis=-1, workers=-1)
    fdk_kernels.respond(spectrum.view(np.float32).reshape(-1, len(response), 2), response)
    back: Float32Array = fft.irfft(spectrum, length, axis=-1, workers=-1)[..., :cols]
    return back


Progress = Callable[[float], None]
"""Called with the fraction done, from 0 to 1."""


def fdk_parts(
    parts: Callable[[], Iterable[Float32Array]],
    cone_vec: ConeVec,
    shape: tuple[int, int],
    like: Volume | Grid,
    window: str = "ram-lak",
    progress: Progress | None = None,
    truncation: Truncation | None = None,
    target: Backprojector | None = None,
    *,
    outside: bool = False,
    errors: bool = False,
) -> Volume:
    """As `fdk`, with the views coming in parts, in order, and without warnings.

    Args:
        parts: gives float32 (k, rows, cols) arrays of line integrals, together one image a view;
            called once more where a device fails on the way, and for each slab of a volume that it
            has no room for.
        cone_vec: of all views.
        shape: detector (rows, cols).
        like: the grid, or a volume on it.
        window: of the ramp filter.
        progress: called with the fraction done.
        truncation: what lies beyond the panel's edges (`truncation_of`); None for nothing.
        target: adds the views up, and may be looked at meanwhile; None for one of its own.
        outside: of an object wider than the panel keep what the continued rows say of voxels that
            are not seen from all sides, instead of NaN.
        errors: give the volume its `sigma` (circles, on the processor).
    """
    like = as_volume(like)

    def onto(target: Backprojector, part: Volume, tell: Progress | None) -> Volume:
        return _fdk(
            parts(), cone_vec, shape, target, part, window, tell, truncation, outside, errors
        )

    if target is None and not circle_of(cone_vec).rise:
        slabs = _slabs(like, shape)
        with suppress(gpu.DeviceError):
            if len(slabs) == 1:
                return onto(OnDevice(like), like, progress)
            if slabs:
                nz, ny, nx = like.shape
                data = np.empty((ny, nx, nz), np.float32).transpose(2, 0, 1)
                for k, (first, last) in enumerate(slabs):
                    slab, tell = _layers(like, first, last), _share(progress, k, len(slabs))
                    data[first:last] = onto(OnDevice(slab), slab, tell).data
                return replace(like, data=data)
    return onto(target or OnProcessor(like), like, progress)


def _slabs(like: Volume, shape: tuple[int, int]) -> list[tuple[int, int]]:
    """Layers (first, last) of the slabs that a device has room for one by one; none without one."""
    count, layers = 1, like.shape[0]
    while not device_takes(_layers(like, 0, -(-layers // count)), shape):
        if count >= layers or not gpu.availability().present:
            return []
        count = min(2 * count, layers)
    return cut(layers, count)


def _layers(like: Volume, first: int, last: int) -> Volume:
    """The grid of layers first <= z < last."""
    x, y, z = like.center_mm
    middle = z + ((first + last) / 2 - like.shape[0] / 2) * like.voxel_xyz[2]
    data = np.broadcast_to(np.zeros((), np.float32), (last - first, *like.shape[1:]))
    return replace(like, data=data, center_mm=(x, y, middle))


def _share(progress: Progress | None, k: int, count: int) -> Progress | None:
    """What to tell of the k-th of several equal parts."""
    return None if progress is None else lambda part: progress((k + part) / count)


def _check_steady(circle: Circle, level: ConeVec, shape: tuple[int, int]) -> None:
    """Check that all views see the axis at about one column: redundancy is weighed by columns.

    Raises:
        GeometryError: the panel goes sideways during the scan, as in a tiled one.
    """
    columns = level.project_points([[*circle.centre, 0.0]], shape)[:, 0, 0]
    moved = float(np.ptp(columns))
    if not moved <= MOST_ASIDE * shape[1]:
        most = MOST_ASIDE * shape[1]
        said = f"the panel moves {moved:.1f} columns sideways between the views (a tiled scan?)"
        raise no_fdk(f"{said}; FDK takes {most:.1f} at most", moved, most)


def _fdk(
    parts: Iterable[Float32Array],
    cone_vec: ConeVec,
    shape: tuple[int, int],
    target: Backprojector,
    like: Volume,
    window: str,
    progress: Progress | None,
    truncation: Truncation | None,
    outside: bool,
    errors: bool,
) -> Volume:
    shape = cone_vec.of_shape(shape)
    circle = circle_of(cone_vec)
    if on_its_side(cone_vec):
        parts = (part.transpose(0, 2, 1) for part in parts)
        cone_vec, shape = swapped(cone_vec), (shape[1], shape[0])
    if shape[1] < 2:
        raise GeometryError.instead("rows of 1 pixel, which cannot be filtered", 1, "2 or more")
    tilted, seen = not is_upright(cone_vec), shape
    if leans(cone_vec):
        shape = (shape[0], round(FINER * shape[1]))
    level = panels = upright(cone_vec, shape[1] / seen[1]) if tilted else cone_vec
    _check_steady(circle, level, shape)
    if narrow_overlap(circle, level, shape[1]):
        level = panels = axis_between(circle, level, shape)
    beyond = truncation is not None and truncation.beyond
    weights = redundancy(circle, level, shape[1], beyond=beyond)
    # Columns off the panel whose filtered values are needed, and those that go into the filter.
    near = columns_beyond(circle, level, shape[1])
    far = (0, 0) if truncation is None else truncation.columns(level, shape[1])
    before, after = (max(pair) for pair in zip(near, far, strict=True))
    wide = shape[1] + before + after
    kept = slice(before - near[0], wide - after + near[1])
    weights = np.pad(weights, ((0, 0), (before, after)), "edge")
    # Only rows in the grid's shadow matter: the filter runs along rows.
    first, last = rows_needed(level, shape, like)
    backed = window_of(level, shape, (first, last), (-near[0], shape[1] + near[1]))
    level = window_of(level, shape, (first, last), (-before, shape[1] + after))
    table = view_table(backed, (last - first, kept.stop - kept.start))
    few = shape[0] <= FEW_ROWS and not circle.rise
    sharing = Sharing.of(circle, panels, shape, like) if circle.rise else None
    if sharing is not None:
        table = np.hstack([table, sharing.columns()])
    # Pitches may change from view to view: one filter, and factors for what it scales with.
    pitch = np.linalg.norm(level.u, axis=1)
    response = ramp(wide, float(pitch[0]), window)
    weights = weights * (pitch[0] / pitch)[:, None]
    meter = None
    if errors and sharing is None and isinstance(target, OnProcessor):
        panel = slice(before, before + shape[1])
        meter = target.meter = NoiseMeter(like, circle, table, panel)
    done = 0
    for part in parts:
        views = slice(done, done + len(part))
        if part.shape[1:] != seen or views.stop > len(cone_vec):
            said = f"projections of shape {part.shape} after {done} views"
            raise GeometryError.instead(said, list(part.shape), f"{len(cone_vec)} views of {seen}")
        images, top = part, first
        if panels is not cone_vec:
            images = rectified(part, cone_vec[views], panels[views], shape[1])
        if before or after:
            rows = np.arange(first, last).clip(0, shape[0] - 1)
            images, top = np.pad(images[:, rows], ((0, 0), (0, 0), (before, after))), 0
        if truncation is not None:
            panel = slice(before, before + shape[1])
            truncation.continue_rows(images, level[views], first, panel)
        shape_needed = last - first, wide
        weighing = _weighing(shape_needed, level[views], circle, views, weights[views])
        shares = np.zeros((len(part), 0, 0), np.float32)
        if sharing is not None:
            shares = sharing.table(views, (first, last))
        target.add(Views(images, top, *weighing, response, kept, shares, table[views], few))
        done = views.stop
        if progress is not None:
            progress(done / len(cone_vec))
    if done != len(cone_vec):
        raise GeometryError.instead(
            f"{done} projections", done, f"one for each of {len(cone_vec)} views"
        )
    data = target.volume()
    if sharing is None:
        own = near[0], near[0] + shape[1] - 1
        cut_off, rays = truncation is not None and not outside, weights[:, kept]
        normalise_coverage(data, like, circle, table, rays, last - first, own, cut_off=cut_off)
        if meter is not None:
            normalise_coverage(
                meter.data, meter.grid, circle, table, rays, last - first, own, cut_off=cut_off
            )
    else:
        z = like.centers()[2]
        data[:, :, (z < sharing.whole[0]) | (z > sharing.whole[1])] = np.nan
    volume = replace(like, data=data.transpose(2, 0, 1))
    return volume if meter is None else with_errors(volume, meter.found())


def _weighing(
    shape: tuple[int, int], cone_vec: ConeVec, circle: Circle, views: slice, weights: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The weights that FDK applies before the filter: factors, across and up of `Views`.

    The cosine is that of the ray with the line from source to axis. Exact fan-beam inversion for a
    panel at any angle to that line then needs the distance along the panel's normal only.
    """
    rows, cols = shape
    source, u, v = cone_vec.source, cone_vec.u, cone_vec.v
    panel = cone_vec.detector - source
    inward = circle.centre - source[:, :2]
    radius = np.linalg.norm(inward, axis=1)
    depth = np.abs((panel * cone_vec.normal).sum(axis=1))
    c, r = np.arange(cols) - (cols - 1) / 2, np.arange(rows) - (rows - 1) / 2
    x = panel[:, None, :2] + c[:, None] * u[:, None, :2]
    z = panel[:, 2, None] + r * v[:, 2, None]
    along = (x * (inward / radius[:, None])[:, None]).sum(axis=2)
    factors = weights * along * (circle.step[views] * depth * radius)[:, None]
    return factors, (x * x).sum(axis=2), z * z


def view_table(cone_vec: ConeVec, shape: tuple[int, int]) -> FloatArray:
    """What the kernel needs of upright views, (n, 11); see `fdk_kernels.backproject`."""
    rows, cols = shape
    pitch_u = np.linalg.norm(cone_vec.u, axis=1)
    pitch_v = np.linalg.norm(cone_vec.v, axis=1)
    u = cone_vec.u[:, :2] / pitch_u[:, None]
    offset = cone_vec.detector - cone_vec.source
    normal = np.column_stack([-u[:, 1], u[:, 0]])
    depth = (offset[:, :2] * normal).sum(axis=1)
    normal *= np.sign(depth)[:, None]
    depth = np.abs(depth)
    foot_c = (cols - 1) / 2 - (offset[:, :2] * u).sum(axis=1) / pitch_u
    foot_r = (rows - 1) / 2 + offset[:, 2] / pitch_v
    return np.ascontiguousarray(
        np.column_stack(
            [cone_vec.source, normal, u, depth / pitch_u, foot_c, depth / pitch_v, foot_r]
        )
    )
