"""The projector on a CUDA device, used where there is one with room.

Needs the extra `gpu` (numba-cuda). Functions and results (to 1e-4 of the maximum) are those of
the processor. Probing never loads a library that ends the process without a device: the driver
is looked for first, and ASTRA is imported only after that succeeded; then one ray is projected,
because a driver that answers need not have a compiler that works. A call runs wholly on the
device or wholly on the processor. Where the device fails, now or later, one line of the log
says so and the processor computes: nothing ends for a device's sake (but for volumes that are
there alone).
"""

from __future__ import annotations

import ctypes
import logging
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import GeometryError, NotBuiltError, TwinError
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection.fan_plan import exchanged, lying
from flexdt.twin.projection.kernels.fan_types import Box

DRIVERS = {"win32": "nvcuda.dll"}
"""Name of the CUDA driver's library by platform, where it is not libcuda.so.1."""
CHUNK_BYTES = 256 * 2**20
"""Images on the device at a time."""
SPARE_BYTES = 256 * 2**20
"""Memory left free on a device for the driver and for other programs [bytes]."""
VIEWS_A_THREAD = 7 / 16
"""Views per thread of the processor from which on moving a volume to the device pays
(measured: about 7 views against 16 threads)."""
WORTH_BYTES = 64 * 2**20
"""Smallest volume that is moved to the device for single views [bytes]. For a smaller
one the processor is as fast (an H200 against 16 threads: C1, 76 MB, 1.95 and 1.8 ms)."""
MAX_SIDE_VOXELS = 2**14
"""Largest number of voxels along an axis for the slab walk. In longer boxes single
precision does not locate the ends of a ray in the box within the margin of the slab
walk."""
MIN_CLEARANCE = 1e-9
"""Least distance of a box from source and detector plane, as a share of their
distance."""
WALK_KINDS = 3
"""Number of kinds of walks: single rays, slabs, slabs with upright columns; the kinds of views
are these, and again these for panels on their side."""
LINEAR = 256
"""Threads a block in kernels that treat one number a thread."""
LOGGER = logging.getLogger("flexdt")


class DeviceError(TwinError):
    """The device failed; the processor may repeat the work."""


@dataclass(frozen=True)
class Availability:
    """Whether a device can be used, with its name or the reason why not."""

    present: bool
    reason: str


_failed: list[Availability] = []
"""The failure for which the device was given up, if any."""


def availability() -> Availability:
    """Return whether projections can run on a CUDA device; probed once, never raises.

    With NUMBA_DISABLE_CUDA=1 in the environment no device is available."""
    return _failed[0] if _failed else _probe()


@cache
def _probe() -> Availability:
    """Look for the driver, import numba's CUDA and project one ray on the device; the
    result is cached for the process.

    The simulator needs no driver.

    Returns:
        Whether a device can be used, with its name or the reason; nothing is raised. A
        failed first ray is logged.
    """
    from numba import config

    if not config.ENABLE_CUDASIM:
        try:
            ctypes.CDLL(DRIVERS.get(sys.platform, "libcuda.so.1"))
        except OSError:
            return Availability(False, "no CUDA driver on this machine")
    try:
        from numba import cuda

        if not cuda.is_available():
            return Availability(False, "numba finds no CUDA device (extra: flexdt[gpu])")
        name: Any = "numba's CUDA simulator"
        if not config.ENABLE_CUDASIM:
            name = cuda.get_current_device().name
    except Exception as error:
        # Drivers fail in many ways; each means: use the processor.
        return Availability(False, f"the CUDA driver does not answer: {error}")
    try:
        _project_one_ray()
    except Exception as error:
        LOGGER.warning("the CUDA device is not used: a first ray failed: %s", error)
        return Availability(False, f"a first ray on the CUDA device failed: {error}")
    return Availability(True, name.decode() if isinstance(name, bytes) else str(name))


def leave_after_fork() -> None:
    """Leave the device to the parent: a forked child cannot use one that its parent has
    used."""
    if _probe.cache_info().currsize and _probe().present:
        why = "the device belongs to the parent of this forked process; spawn and forkserver work"
        _failed.insert(0, Availability(False, why))


def _project_one_ray() -> None:
    """Project a ray along x through two voxels of 0.5 mm and check the result.

    It uses one kernel, because each takes seconds to compile.

    Raises Exception: any error of numba or the driver, or a wrong result.
    """
    box = Box(np.array([1, 3], np.float32), None, 0, 1, 2, 2, 1, 1, 0.5, 0.5, 0.5)
    views = np.array([[-1.0, 0.5, 0.5, 4.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0]])
    image = np.zeros((1, 1, 1), np.float32)
    project(box, upload(box.flat), views, image)
    if not np.isclose(image[0, 0, 0], 2.0, rtol=1e-5):
        raise ArithmeticError(f"found {image[0, 0, 0]} instead of 2.0")


@contextmanager
def switched_off() -> Iterator[None]:
    """Switch the device off in the context: the processor computes everything."""
    _failed.insert(0, Availability(False, "switched off"))
    try:
        yield
    finally:
        del _failed[0]


def attempt(work: Callable[[], object]) -> bool:
    """Run some work on the device and return whether it succeeded.

    If it failed, the caller computes on the processor, and a warning is logged. A device
    that lacks memory is tried again later; after the first other failure it is not used
    again in this process, and later failures are not logged.
    """
    try:
        work()
    except Exception as error:
        if "OUT_OF_MEMORY" in str(error).upper().replace(" ", "_"):
            LOGGER.warning(
                "the CUDA device lacks memory; the processor computes: %s", error
            )
        elif not _failed:
            LOGGER.warning(
                "the CUDA device failed; the processor computes from now on: %s", error
            )
            _failed.append(Availability(False, f"the CUDA device failed: {error}"))
        return False
    return True


def upload(flat: Float32Array) -> Any:
    """Copy voxels to the device, where they stay as long as the result is referenced."""
    from numba import cuda

    return cuda.to_device(flat)


def free_bytes() -> int | None:
    """Return the free memory of the device [bytes]: 0 if the query fails (which `attempt`
    logs), None in the simulator."""
    from numba import config, cuda

    if config.ENABLE_CUDASIM:
        return None
    free = [0]

    def ask() -> None:
        free[0] = int(cuda.current_context().get_memory_info().free)

    attempt(ask)
    return free[0]


def has_room(needed: int) -> bool:
    """Return whether the device takes `needed` more bytes; True if unknown."""
    free = free_bytes()
    return free is None or needed + SPARE_BYTES <= free


def usable(voxel_bytes: int, images: Float32Array, threads: int, before: int = 0) -> bool:
    """Return whether a device has room for voxels and a portion of images, and is worth
    it.

    Voxels are moved for `VIEWS_A_THREAD` views a thread at least; `before`, views already
    projected, count for those of `WORTH_BYTES`. `voxel_bytes` is 0 for voxels on the
    device.
    """
    views = len(images) + (before if voxel_bytes >= WORTH_BYTES else 0)
    if not availability().present or (voxel_bytes and views < VIEWS_A_THREAD * threads):
        return False
    if len(images):
        portion = images[_chunks(images)[0]].nbytes
    else:
        portion = 0
    return has_room(voxel_bytes + portion)


def on(device: int) -> Any:
    """Return a context with this device as current."""
    from numba import cuda

    return cuda.gpus[device]


def current_device() -> int:
    """Return the number of the current device, whose context this thread has from now on;
    0 in the simulator."""
    from numba import cuda

    return int(getattr(cuda.current_context().device, "id", 0))


def finish() -> None:
    """Wait until the device has done its work."""
    from numba import cuda

    demand(cuda.synchronize)


def zeros(count: int, kind: Any = np.float32) -> Any:
    """Create a flat array of `count` zeros of the type `kind` on the device by a kernel;
    nothing is transferred.
    """
    from numba import cuda

    from flexdt.twin.projection.kernels import gpu_kernels

    values = cuda.device_array(count, kind)
    gpu_kernels.clear[-(-count // LINEAR), LINEAR](values)
    return values


def is_there(x: object) -> bool:
    """Return whether an array of any library is on a CUDA device."""
    return hasattr(x, "copy_to_host") or hasattr(x, "__cuda_array_interface__")


def check_host(there: bool, what: str) -> None:
    """Raise NotBuiltError unless an array is in the processor's memory."""
    if not there:
        message = f"{what} is in the memory of a device"
        raise NotBuiltError.instead(message, "device", "arrays in the processor's memory")


def taken(x: Any) -> Any:
    """Convert an array on the device to numba's array that shares its memory; numba's own
    is returned unchanged.

    Raises:
        GeometryError: it is not float32 in C order.
    """
    from numba import cuda

    if hasattr(x, "copy_to_host"):
        array = x
    else:
        array = cuda.as_cuda_array(x)
    if array.dtype != np.float32 or not array.is_c_contiguous():
        message = f"an array of {array.dtype} on the device"
        raise GeometryError.instead(message, str(array.dtype), "float32 in C order")
    return array


def demand(work: Callable[[], Any]) -> Any:
    """Run some work on values on the device and return its result.

    Raises:
        DeviceError: the device failed; the failure is logged as well.
    """
    results: list[Any] = []
    if not attempt(lambda: results.append(work())):
        raise DeviceError(
            "the CUDA device failed at arrays that are on it; the log says of what"
        )
    return results[0]


def project_there(
    box: Box, voxels: Any, views: FloatArray, shape: tuple[int, ...]
) -> Any:
    """Project a volume on the device to images (n, rows, cols) there, without waiting.

    `views`: (n, 12) rays in voxels.
    """
    from numba import cuda

    images = cuda.device_array(len(views) * shape[0] * shape[1], np.float32)
    _launch(box, voxels, views, images, shape, transposed=False)
    return images.reshape(len(views), *shape)


def project(box: Box, voxels: Any, views: FloatArray, out: Float32Array) -> None:
    """Fill out (n, rows, cols) with line integrals, in portions of views.

    `voxels`: uploaded.
    """
    for part in _chunks(out):
        project_there(box, voxels, views[part], out.shape[1:]).copy_to_host(out[part])


def spread_there(
    box: Box, voxels: Any, views: FloatArray, values: Any, *, deterministic: bool = False
) -> None:
    """Apply the transpose of `project`: add values (n, rows, cols) to voxels on the
    device.

    Rays add in the order in which they arrive, so that sums differ in their last bits
    from run to run. In deterministic mode they add integers, whose sum does not depend on
    the order, for the memory of two more volumes.

    Args:
        box: the volume.
        voxels: its flat array, on the device.
        views: as in `project`.
        values: on the host, moved in portions, or on the device.
        deterministic: add integers.
    """
    from numba import cuda

    from flexdt.twin.projection.kernels import gpu_kernels

    factor = 1.0
    sums = voxels
    shape = values.shape[1:]
    if deterministic:
        factor = whole_factor(box, values)
        sums = zeros(voxels.size, np.int64)
    if is_there(values):
        flat = values.reshape(values.size)
        _launch(box, sums, views, flat, shape, transposed=True, factor=factor)
    else:
        for part in _chunks(values):
            images = cuda.to_device(values[part].reshape(-1))
            _launch(box, sums, views[part], images, shape, transposed=True, factor=factor)
    if deterministic:
        gpu_kernels.unscale[-(-voxels.size // LINEAR), LINEAR](sums, factor, voxels)


def spread(
    box: Box,
    views: FloatArray,
    values: Float32Array,
    *,
    clean: bool = False,
    deterministic: bool = False,
) -> None:
    """Apply `spread_there` to box.flat on the host, moved to the device and back.

    `clean`: box.flat holds zeros, not transferred; `deterministic`: add integers.
    """
    if clean:
        voxels = zeros(box.flat.size)
    else:
        voxels = upload(box.flat)
    spread_there(box, voxels, views, values, deterministic=deterministic)
    voxels.copy_to_host(box.flat)


def whole_factor(box: Box, values: Any) -> float:
    """Compute the power of 2 that scales images for a sum of 64-bit integers below 2^62.

    A ray adds its value times a voxel's diagonal at most. 1 for values all zero or not
    finite.
    """
    diagonal = math.hypot(box.size_x, box.size_y, box.size_z)
    if is_there(values):
        values = values.copy_to_host()
    most = float(np.abs(values).max(initial=0.0)) * diagonal * max(1, values.size)
    if 0.0 < most < math.inf:
        return 2.0 ** math.floor(62 - math.log2(most))
    return 1.0


def by_slabs(
    box: Box, views: FloatArray, shape: tuple[int, int]
) -> npt.NDArray[np.bool_]:
    """Find the views that the slab walk can project, (n,) bool.

    All rays must cross the box from side to side, rising at most one voxel for each along
    x or y.
    """
    return clear_of(box, views, shape) & (rises(views, shape) <= 1.0)


def rises(views: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Compute a bound of the voxels that rays rise for each along the faster one of x and
    y, (n,).

    Of x, y and the diagonal that the panel's middle is on, the way with the least bound
    counts. Infinity where some corner's ray goes backwards along each of them.
    """
    corners = _corners(views, shape)
    middle = corners[:, :, :2].mean(axis=1)
    diagonal = middle / (math.sqrt(2.0) * np.linalg.norm(middle, axis=1, keepdims=True))
    axes = np.broadcast_to([[1.0, 0], [-1, 0], [0, 1], [0, -1]], (len(views), 4, 2))
    ways = np.concatenate([axes, diagonal[:, None]], axis=1)
    ahead = np.matmul(ways, corners[:, :, :2].transpose(0, 2, 1))
    rise = np.broadcast_to(np.abs(corners[:, None, :, 2]), ahead.shape)
    bounds = np.divide(rise, ahead, out=np.full(ahead.shape, np.inf), where=ahead > 0.0)
    return np.asarray(bounds.max(axis=2).min(axis=1))


def clear_of(
    box: Box, views: FloatArray, shape: tuple[int, int]
) -> npt.NDArray[np.bool_]:
    """Find the views whose source is before a box and whose detector plane is behind it.

    By a share `MIN_CLEARANCE` of the distance. A box with a side of `MAX_SIDE_VOXELS`
    voxels or more, or 2^31 values, is too large for the slab walk: all are False.

    Args:
        box: the layout's voxels.
        views: (n, 12) rays in voxels.
        shape: the detector's (rows, cols).

    Returns:
        (n,) bool.
    """
    counts = (box.nx, box.ny, box.nz)
    if max(counts) >= MAX_SIDE_VOXELS or (
        box.flat is not None and box.flat.size >= 2**31
    ):
        return np.zeros(len(views), np.bool_)
    source, first, u, v = (views[:, i : i + 3] for i in (0, 3, 6, 9))
    # Where the box's corners are on the way from the source (0) to the detector's plane (1).
    normal = np.stack(
        [u[:, i - 2] * v[:, i - 1] - u[:, i - 1] * v[:, i - 2] for i in range(3)], axis=1
    )
    # The least and the largest of all corners, axis by axis.
    spans = normal * np.array(counts)
    behind = -(source * normal).sum(axis=1)
    nearest = behind + np.minimum(spans, 0.0).sum(axis=1)
    farthest = behind + np.maximum(spans, 0.0).sum(axis=1)
    depth = (first * normal).sum(axis=1)
    turned = depth < 0.0
    low = np.where(turned, -farthest, nearest)
    high = np.where(turned, -nearest, farthest)
    depth = np.abs(depth)
    return np.asarray(
        (low > MIN_CLEARANCE * depth) & (high < (1.0 - MIN_CLEARANCE) * depth)
    )


def _corners(views: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Compute corner pixels of the detector minus the source, (n, 4, 3)."""
    rows, cols = shape
    first, u, v = (views[:, None, i : i + 3] for i in (3, 6, 9))
    ends = np.array([[c, r] for c in (0.0, cols - 1.0) for r in (0.0, rows - 1.0)])
    return np.asarray(first + ends[:, :1] * u + ends[:, 1:] * v)


def _launch(*arguments: Any, **options: Any) -> None:
    launcher(*arguments, **options)()


def launcher(
    box: Box,
    voxels: Any,
    views: FloatArray,
    images: Any,
    shape: tuple[int, ...],
    *,
    transposed: bool,
    factor: float = 1.0,
) -> Callable[[], None]:
    """Choose the kernel of each view, and copy the views to the device.

    A view takes the slab walk if it is clear of the box and rises at most one voxel a
    step; the column walk if its v is also parallel to z, within `RISE`, on a device whose
    lanes meet; else ray by ray.

    One array goes there: views by kernel, each with the number of its image. Views of a
    detector on its side take its columns for rows, so that lanes are neighbors along z
    there, too.

    Args:
        box: the layout's voxels.
        voxels: of the layout, on the device.
        views: (n, 12) rays in voxels.
        images: flat, on the device.
        shape: the detector's (rows, cols).
        transposed: voxels are written and images read; otherwise the other way round.
        factor: of the written values.

    Returns:
        A function that launches the kernels and does not wait for them.
    """
    from numba import cuda

    from flexdt.twin.projection.kernels import gpu_kernels as kernels

    rows, cols = shape
    turned = lying(views, (rows, cols))
    rays = np.where(turned[:, None], exchanged(views), views)
    rise = rises(views, (rows, cols))
    slabs = clear_of(box, views, (rows, cols)) & (rise <= 1.0)
    upright = (
        kernels.LANES_MEET
        & (rays[:, 9:11] == 0.0).all(axis=1)
        & (rise <= kernels.MAX_RISE_VOXELS)
    )
    kind = WALK_KINDS * turned + slabs + (slabs & upright)
    order = np.argsort(kind, kind="stable")
    table = cuda.to_device(np.column_stack([rays, np.arange(len(views))])[order])
    if transposed:
        walks = (kernels.spread_rays, kernels.spread_slabs, kernels.spread_columns)
    else:
        walks = forward_kernels()
    kinds, counts = np.unique(kind, return_counts=True)

    def launch() -> None:
        """Launch one kernel for each kind of view, over its `counts` images; kinds tell
        the walk, and whether rows and columns are exchanged.
        """
        first = 0
        for which, count in zip(kinds, counts, strict=True):
            walk, grid, sizes = launch_sizes(int(which), int(count), (rows, cols))
            walks[walk][grid, kernels.BLOCK](
                voxels, *box[2:], table, first, int(count), images, *sizes, factor
            )
            first += int(count)

    return launch


def forward_kernels() -> tuple[Any, Any, Any]:
    """Return the forward kernels by the walk's number: single rays, slabs, upright
    columns."""
    from flexdt.twin.projection.kernels import gpu_kernels as kernels

    return kernels.project_rays, kernels.project_slabs, kernels.project_columns


def launch_sizes(
    kind: int, count: int, shape: tuple[int, int]
) -> tuple[int, tuple[int, int], tuple[int, int, int, int]]:
    """Find what a kernel is launched with for views of one kind.

    `kind`: WALK_KINDS for a panel on its side, plus the walk's number; `count`: views; `shape`:
    the detector's (rows, cols).
    Returns the walk's number, the grid of blocks, and lanes, columns and their steps in the
    image.
    """
    from flexdt.twin.projection.kernels import gpu_kernels as kernels

    rows, cols = shape
    lying_down, walk = divmod(kind, WALK_KINDS)
    sizes = (cols, rows, 1, cols) if lying_down else (rows, cols, cols, 1)
    lanes, columns, *_ = sizes
    grid = (count * -(-columns // kernels.BLOCK[1]), -(-lanes // kernels.BLOCK[0]))
    return walk, grid, sizes


def _chunks(images: Float32Array) -> list[slice]:
    """Cut views into slices whose images fit into CHUNK_BYTES."""
    count = max(1, CHUNK_BYTES // max(1, images[:1].nbytes))
    return [slice(i, i + count) for i in range(0, len(images), count)]
