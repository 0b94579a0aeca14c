"""The images of a data set as calibration needs them: detected and cut into windows by threads.

Counts stay in memory while they fit the budget, so that the second measurement does not read
the files again.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Final, TypeVar

import numpy as np

from flexdt.library.datasets.image_set import Counts, ImageSet
from flexdt.twin.calibration.detect.detection import SpotFinder
from flexdt.twin.calibration.detect.windows import Windows, overlap
from flexdt.twin.calibration.frame_source import FrameSpots, FrameState, look_at, nothing
from flexdt.twin.dataset.dataset_errors import DatasetError
from flexdt.twin.dataset.normalise import MIN_COUNTS
from flexdt.twin.geometry.conventions import Float32Array

FRAME_THREADS: Final = 2
MAX_KEPT_BYTES: Final = 1 << 30
"""Counts kept in memory at most."""
_T = TypeVar("_T")


class DatasetFrames:
    """The projections of a data set; see `flexdt.twin.calibration.frame_source.Frames`.

    Args:
        dataset: the projections.
        seen: called for each frame that has been looked at.
    """

    def __init__(
        self, dataset: ImageSet, seen: Callable[[], object] = lambda: None
    ) -> None:
        """Take a data set, whose counts are kept after the first reading if all need at
        most `MAX_KEPT_BYTES`, and a function that is called after each frame of each
        pass.
        """
        self._dataset = dataset
        self._seen = seen
        rows, cols = dataset.shape
        self._keep = 2 * rows * cols * len(dataset) <= MAX_KEPT_BYTES
        self._kept: dict[int, Counts] = {}
        self._unreadable: dict[int, str] = {}

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        return self._dataset.shape

    def __len__(self) -> int:
        return len(self._dataset)

    def look(self, detector: SpotFinder) -> list[FrameSpots]:
        """Detect the beads of every frame in its normalized image, in threads.

        Returns:
            The spots of each frame, in order; a frame that is missing or unreadable has
            none, the state MISSING and the reason ("" if it is missing).
        """
        normalise = self._dataset.normalisation

        def one(index: int) -> FrameSpots:
            """Search one frame for spots; a frame that is missing or cannot be read is
            marked so, with the reason.
            """
            counts = self._counts(index)
            if counts is None:
                why = self._unreadable.get(index, "")
                return FrameSpots(nothing(self.shape), FrameState.MISSING, why)
            return look_at(normalise(counts), detector)

        return self._each(one)

    def windows(self, plan: Windows) -> Float32Array:
        """Cut the windows of every frame, in threads; only their pixels are normalized.

        Args:
            plan: corners and side of the windows.

        Returns:
            float32 (n, k, side, side), line integrals; NaN outside images, in dead pixels
            and in frames that are missing or cannot be read.
        """
        normalise = self._dataset.normalisation
        log_open = np.where(normalise.dead, np.float32(np.nan), normalise.log_open)
        n, k = plan.corner.shape[:2]
        out = np.full((n, k, plan.side, plan.side), np.nan, dtype=np.float32)

        def one(index: int) -> None:
            """Fill the windows of one frame in `out` with line integrals; they stay as
            they are if it cannot be read. Counts below `MIN_COUNTS` count as that.
            """
            counts = self._counts(index)
            if counts is None:
                return
            for bead in range(k):
                inside, there = overlap(plan, index, bead)
                signal = np.maximum(
                    counts[there] - normalise.dark[there], np.float32(MIN_COUNTS)
                )
                out[index, bead][inside] = log_open[there] - np.log(signal)

        self._each(one)
        return out

    def _counts(self, index: int) -> Counts | None:
        """Return the counts of one frame; None if its file is missing or unreadable.

        Keeps the counts where all fit, and the reason of an unreadable frame.
        """
        if index in self._kept:
            return self._kept[index]
        if not self._dataset.frames[index].present:
            return None
        try:
            counts = self._dataset.counts(index)
        except DatasetError as error:
            self._unreadable[index] = error.message
            return None
        if self._keep:
            self._kept[index] = counts
        return counts

    def _each(self, work: Callable[[int], _T]) -> list[_T]:
        """Do work on every frame in `FRAME_THREADS` threads, and report each frame in
        order; returns the results in order.
        """
        results = []
        with ThreadPoolExecutor(FRAME_THREADS) as pool:
            for one in pool.map(work, range(len(self))):
                results.append(one)
                self._seen()
        return results
