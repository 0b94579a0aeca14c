"""A data set's images as calibration wants them: detected and cut in a few threads.

Counts stay in memory while they fit the budget, so that the second look does not read the files
again. It refuses to know anything of the scan but its images.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Final, TypeVar

import numpy as np
import numpy.typing as npt

from flexdt.clients.dataset import Dataset
from flexdt.twin.calibration.detect import Detector
from flexdt.twin.calibration.frames import FrameState, Look, look_at, nothing
from flexdt.twin.calibration.windows import Windows
from flexdt.twin.conventions import Float32Array
from flexdt.twin.dataset.errors import DatasetError

THREADS: Final = 2
KEEP_BYTES: Final = 1 << 30
"""Counts kept in memory at most."""
_T = TypeVar("_T")
Counts = npt.NDArray[np.uint16]


class DatasetFrames:
    """The projections of a data set; see `flexdt.twin.calibration.frames.Frames`."""

    def __init__(
        self, dataset: Dataset, threads: int = THREADS, keep_bytes: int = KEEP_BYTES
    ) -> None:
        self._dataset = dataset
        self._threads = threads
        rows, cols = dataset.shape
        self._keep = 2 * rows * cols * len(dataset) <= keep_bytes
        self._kept: dict[int, Counts] = {}
        self._states: list[FrameState] = []
        self.unreadable: list[str] = []

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        return self._dataset.shape

    def __len__(self) -> int:
        return len(self._dataset)

    def look(self, detector: Detector) -> list[Look]:
        """Detect the beads of every frame."""
        normalise = self._dataset.normalisation

        def one(index: int) -> Look:
            counts = self._counts(index)
            if counts is None:
                return Look(nothing(self.shape), FrameState.MISSING)
            return look_at(normalise(counts), detector)

        looks = list(self._map(one, range(len(self))))
        self._states = [look.state for look in looks]
        return looks

    def windows(self, plan: Windows) -> Float32Array:
        """Cut the windows of every frame; only their pixels are normalised."""
        normalise = self._dataset.normalisation
        log_open = np.where(normalise.dead, np.float32(np.nan), normalise.log_open)
        n, k = plan.corner.shape[:2]
        side = plan.side
        rows, cols = self.shape
        out = np.full((n, k, side, side), np.nan, dtype=np.float32)

        def one(index: int) -> None:
            if self._states and self._states[index] is not FrameState.USABLE:
                return
            counts = self._counts(index)
            if counts is None:
                return
            for bead, (x, y) in enumerate(plan.corner[index].tolist()):
                left, right = max(x, 0), min(x + side, cols)
                top, bottom = max(y, 0), min(y + side, rows)
                if left >= right or top >= bottom:
                    continue
                part = (slice(top, bottom), slice(left, right))
                signal = counts[part] - normalise.dark[part]
                out[index, bead, top - y : bottom - y, left - x : right - x] = log_open[
                    part
                ] - np.log(np.maximum(signal, np.float32(0.5)))

        for _ in self._map(one, range(n)):
            pass
        return out

    def _counts(self, index: int) -> Counts | None:
        """Counts of one frame, None if its file is missing or unreadable."""
        if index in self._kept:
            return self._kept[index]
        if not self._dataset.frames[index].present:
            return None
        try:
            counts = self._dataset.counts(index)
        except DatasetError as error:
            self.unreadable.append(error.message)
            return None
        if self._keep:
            self._kept[index] = counts
        return counts

    def _map(self, work: Callable[[int], _T], items: Iterable[int]) -> Iterator[_T]:
        if self._threads <= 1:
            return map(work, items)
        with ThreadPoolExecutor(self._threads) as pool:
            return iter(list(pool.map(work, items)))
