"""Upload images to a CUDA device through page-locked memory while it works on earlier ones.

All cores copy a portion into page-locked memory, from where the device fetches it by itself.
Two portions take turns, small enough that page-locking them costs little.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import Float32Array, FloatArray

PORTION_BYTES: Final = 24 * 2**20
"""Page-locked memory of each of the two portions [bytes], at least one image."""


class ImageUpload:
    """Upload images and small tables on a stream of their own.

    Args:
        stream: of the kernels that read the uploaded data.
    """

    def __init__(self, stream: Any) -> None:
        """Prepare uploads for kernels that run in `stream`: a stream of its own and two
        host buffers in turn, allocated at their first use. Uploads nothing.
        """
        from numba import cuda

        self._reader = stream
        self._writer = cuda.stream()
        self._turn = 0
        self._portions: list[Any] = [None, None]
        self._fetched: list[Any] = [None, None]
        self._rooms: dict[str, list[Any]] = {}
        self._shaped: dict[tuple[Any, ...], Any] = {}
        self._read: list[Any] = [None, None]
        self._handed = cuda.event()
        self._chunk = 0

    def begin(self) -> None:
        """Begin the next chunk of views, in the memory of the chunk before the last."""
        self._chunk = 1 - self._chunk
        if self._read[self._chunk] is not None:
            self._read[self._chunk].wait(self._writer)

    def images(
        self, images: Float32Array, order: npt.NDArray[np.intp], rows: slice
    ) -> Any:
        """Upload some rows of images in portions, without waiting for the last.

        The caller's images may be changed after the return. The result is valid in the
        reader's stream after `hand_over`, until the chunk after the next begins.

        Args:
            images: (n, rows, cols).
            order: number of the image for each place, (k,).
            rows: rows to upload.

        Returns:
            (k, rows.stop - rows.start, cols) on the device.
        """
        from flexdt.twin.reconstruction.kernels import fdk_kernels

        images = np.ascontiguousarray(images)
        n = len(order)
        cols = images.shape[2]
        count = rows.stop - rows.start
        there = self._room("images", (n, count, cols))
        each = max(1, PORTION_BYTES // max(1, 4 * count * cols))
        for first in range(0, n, each):
            some = slice(first, min(first + each, n))
            size = (some.stop - first, count, cols)
            portion = self._portion(math.prod(size)).reshape(size)
            fdk_kernels.copy_rows(images, order[some], rows.start, portion)
            self._fetch(portion, self._room("images", (n, count, cols), some))
        return there

    def table(self, name: str, values: FloatArray | Float32Array) -> Any:
        """Upload a table as single precision, without waiting.

        Tables of one name share memory, which the chunk after the next overwrites.
        """
        there = self._room(name, values.shape)
        portion = self._portion(values.size).reshape(values.shape)
        np.copyto(portion, values, casting="same_kind")
        self._fetch(portion, there)
        return there

    def hand_over(self) -> None:
        """Let the kernels launched from now on wait for the uploads so far; the host does
        not wait."""
        self._handed.record(self._writer)
        self._handed.wait(self._reader)

    def end(self) -> None:
        """Record the launch of the chunk's last kernel: its memory may be refilled."""
        self._read[self._chunk] = _recorded(self._read[self._chunk], self._reader)

    def _room(self, name: str, shape: tuple[int, ...], some: slice = slice(None)) -> Any:
        """Return float32 device memory for the array `name` of this chunk.

        It is kept for later chunks, apart for each of two that alternate, and replaced
        where too small, which loses the content. Its views are kept, too: each takes
        numba longer to make than a small copy.

        Args:
            name: of the array.
            shape: of the array.
            some: part of the first axis.
        """
        from numba import cuda

        count = math.prod(shape)
        pair = self._rooms.setdefault(name, [None, None])
        if pair[self._chunk] is None or pair[self._chunk].size < count:
            pair[self._chunk] = cuda.device_array(count, np.float32)
            self._shaped = {
                key: view
                for key, view in self._shaped.items()
                if key[:2] != (name, self._chunk)
            }
        key = (name, self._chunk, shape, some.start, some.stop)
        if key not in self._shaped:
            self._shaped[key] = pair[self._chunk][:count].reshape(shape)[some]
        return self._shaped[key]

    def _portion(self, count: int) -> Any:
        """Return page-locked memory, after waiting until the device has fetched its
        earlier content; two portions take turns.

        Args:
            count: float32 numbers needed; a portion has at least `PORTION_BYTES`.

        Returns:
            (count,) float32.
        """
        from numba import cuda

        self._turn = 1 - self._turn
        if self._fetched[self._turn] is not None:
            self._fetched[self._turn].synchronize()
        portion = self._portions[self._turn]
        if portion is None or portion.size < count:
            size = max(count, PORTION_BYTES // 4)
            portion = self._portions[self._turn] = cuda.pinned_array(size, np.float32)
        return portion[:count]

    def _fetch(self, portion: Any, there: Any) -> None:
        """Start the copy of a host portion to the device on the upload's stream, and
        record its end for this turn's portion; does not wait."""
        there.copy_to_device(portion, self._writer)
        self._fetched[self._turn] = _recorded(self._fetched[self._turn], self._writer)


def _recorded(event: Any, stream: Any) -> Any:
    """Record how far a stream has got, in an event or, where it is None, a new one."""
    from numba import cuda

    if event is None:
        event = cuda.event()
    event.record(stream)
    return event
