"""A data set's images as calibration needs them: detected and cut into windows by a few threads.

Counts stay in memory while they fit the budget, so that the second measurement does not read the
files again.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Final, TypeVar

import numpy as np
import numpy.typing as npt

from flexdt.clients.datasets.data_set import DataSet
from flexdt.twin.calibration.detect.detection import SpotFinder, coarseness, coarser
from flexdt.twin.calibration.detect.windows import Windows
from flexdt.twin.calibration.frame_source import FrameSpots, FrameState, look_in_parts, nothing
from flexdt.twin.dataset.dataset_errors import DatasetError
from flexdt.twin.dataset.normalise import MIN_COUNTS, LineIntegrals
from flexdt.twin.geometry.conventions import Float32Array

THREADS: Final = 2
KEEP_BYTES: Final = 1 << 30
"""Counts kept in memory at most."""
_T = TypeVar("_T")
Counts = npt.NDArray[np.uint16]


@dataclass(frozen=True, eq=False)
class _Light:
    """Counts to line integrals, of parts of an image and of coarse pixels.

    Attributes:
        normalise: the data set's normalisation.
        factor: coarse pixels are factor x factor.
        alive: 1 where a pixel sees the beam, or None if all do.
        dark, log_open: of coarse pixels, dead ones left out.
        source: flat index of the pixel whose value each one takes, or None if its own.
    """

    normalise: LineIntegrals
    factor: int
    alive: Float32Array | None
    dark: Float32Array
    log_open: Float32Array
    source: npt.NDArray[np.intp] | None

    @classmethod
    def of(cls, normalise: LineIntegrals, factor: int) -> _Light:
        opened = np.where(normalise.dead, np.float32(0.0), np.exp(normalise.log_open))
        alive: Float32Array | None = None
        source: npt.NDArray[np.intp] | None = None
        dark = normalise.dark
        if len(normalise.nearest):
            alive = (~normalise.dead).astype(np.float32)
            dark = dark * alive
            source = np.arange(dark.size).reshape(dark.shape)
            source[normalise.dead] = normalise.nearest
        few = np.float32(1e-3)
        log_open = np.log(np.maximum(coarser(opened, factor), few))
        return cls(normalise, factor, alive, coarser(dark, factor), log_open, source)

    def coarse(self, counts: Counts) -> Float32Array:
        """Line integrals of coarse pixels."""
        bright = counts.astype(np.float32)
        if self.alive is not None:
            bright *= self.alive
        signal = coarser(bright, self.factor) - self.dark
        lowest = np.minimum(np.float32(MIN_COUNTS), np.exp(self.log_open))
        return np.asarray(self.log_open - np.log(np.maximum(signal, lowest)), dtype=np.float32)

    def part(self, counts: Counts, rows: slice, cols: slice) -> Float32Array:
        """Line integrals of some rows and columns, finite."""
        n = self.normalise
        if self.source is None:
            seen, dark, log_open = counts[rows, cols], n.dark[rows, cols], n.log_open[rows, cols]
        else:
            places = self.source[rows, cols]
            seen = counts.reshape(-1)[places]
            dark, log_open = n.dark.reshape(-1)[places], n.log_open.reshape(-1)[places]
        signal = np.subtract(seen, dark, dtype=np.float32)
        np.maximum(signal, np.float32(MIN_COUNTS), out=signal)
        return np.asarray(log_open - np.log(signal), dtype=np.float32)


class DatasetFrames:
    """The projections of a data set; see `flexdt.twin.calibration.frame_source.Frames`."""

    def __init__(self, dataset: DataSet) -> None:
        self._dataset = dataset
        rows, cols = dataset.shape
        self._keep = 2 * rows * cols * len(dataset) <= KEEP_BYTES
        self._kept: dict[int, Counts] = {}
        self._states: list[FrameState] = []
        self.unreadable: list[str] = []

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        return self._dataset.shape

    def __len__(self) -> int:
        return len(self._dataset)

    def preload(self) -> None:
        """Read all counts now, whatever they take."""
        self._keep = True
        self._each(self._counts)

    def look(self, detector: SpotFinder) -> list[FrameSpots]:
        """Detect the beads of every frame; only what may hold one is normalised."""
        factor = coarseness(detector)
        light = _Light.of(self._dataset.normalisation, factor)

        def one(index: int) -> FrameSpots:
            counts = self._counts(index)
            if counts is None:
                return FrameSpots(nothing(self.shape), FrameState.MISSING)
            return look_in_parts(
                light.coarse(counts), factor, self.shape, partial(light.part, counts), detector
            )

        looks = self._each(one)
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
                signal = np.maximum(counts[part] - normalise.dark[part], np.float32(0.5))
                window = out[index, bead, top - y : bottom - y, left - x : right - x]
                np.subtract(log_open[part], np.log(signal), out=window)

        self._each(one)
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

    def _each(self, work: Callable[[int], _T]) -> list[_T]:
        with ThreadPoolExecutor(THREADS) as pool:
            return list(pool.map(work, range(len(self))))
