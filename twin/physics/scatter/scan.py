"""The scatter of a whole scan: some views are simulated, those between them interpolated.

Scatter changes slowly from view to view, so a scan of hundreds of views needs some tens of
simulations. The views in between are interpolated linearly along the way of source and panel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from flexdt.twin.errors import LimitError
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.physics.chain import Chain, Expected, flux_of, mAs, weights_of
from flexdt.twin.physics.exposure import ExposureSettings
from flexdt.twin.physics.scatter.simulation import (
    Beam,
    Object,
    ScatterImage,
    ScatterSettings,
    scatter_image,
    spread_out,
)


@dataclass(frozen=True, eq=False)
class Scattered:
    """Scatter of one view, in units of the local open beam.

    Attributes:
        signal: float32 (rows, cols), of the open beam's signal.
        variance: float32 (rows, cols), of the open beam's variance.
    """

    signal: Float32Array
    variance: Float32Array

    def added_to(
        self, expected: Expected, chain: Chain, view: FloatArray, exposure: ExposureSettings
    ) -> Expected:
        """The expected electrons of primary radiation and scatter together."""
        if not exposure.xrays_on:
            return expected
        signal, noise = weights_of(chain, exposure.kV)
        flux = flux_of(view, self.signal.shape) * np.float32(mAs(exposure))
        mean = expected.mean_e + self.signal * flux * np.float32(signal.sum())
        variance = expected.variance_e + self.variance * flux * np.float32(noise.sum())
        return Expected(mean.astype(np.float32), variance.astype(np.float32))


@dataclass(frozen=True, eq=False)
class ScanScatter:
    """Scatter of the views of a scan.

    Attributes:
        settings: how it was simulated.
        images: of the simulated views.
        simulated: (k,) their indices, growing.
        way: (n,) how far source and panel have come at each view [rad].
    """

    settings: ScatterSettings
    images: tuple[ScatterImage, ...]
    simulated: tuple[int, ...]
    way: FloatArray

    def __len__(self) -> int:
        return len(self.way)

    def __getitem__(self, index: int) -> Scattered:
        """Scatter of a view at every pixel; never negative, though splines may overshoot."""
        return Scattered(self.signal(index), self._spread_out(index, "spread"))

    def signal(self, index: int) -> Float32Array:
        """`Scattered.signal` of a view alone."""
        return self._spread_out(index, "mean")

    def error(self, index: int) -> Float32Array:
        """Standard error of a view's scatter, float32 (rows, cols), of the open beam's signal.

        That of the Monte Carlo alone: interpolation between nodes and views comes on top.
        """
        squares = self._at(index, self._stack["error"] ** 2, 2)
        return spread_out(np.sqrt(squares), self.images[0].shape)

    @property
    def nodes(self) -> FloatArray:
        """Scatter of the simulated views at the nodes, (k, v, u)."""
        return self._stack["mean"]

    @cached_property
    def _stack(self) -> dict[str, FloatArray]:
        names = ("mean", "error", "spread")
        return {name: np.array([getattr(one, name) for one in self.images]) for name in names}

    def _spread_out(self, index: int, name: str) -> Float32Array:
        values = spread_out(self._at(index, self._stack[name]), self.images[0].shape)
        return np.maximum(values, np.float32(0.0))

    def _at(self, index: int, values: FloatArray, power: int = 1) -> FloatArray:
        if not -len(self) <= index < len(self):
            raise IndexError(f"view {index} of {len(self)}")
        place, known = self.way[index], self.way[list(self.simulated)]
        after = min(int(np.searchsorted(known, place)), len(known) - 1)
        before = max(after - 1, 0)
        span = known[after] - known[before]
        part = 1.0 if span <= 0.0 else min(max((place - known[before]) / span, 0.0), 1.0)
        return np.asarray((1.0 - part) ** power * values[before] + part**power * values[after])


def scan_scatter(
    thing: Object,
    views: FloatArray,
    shape: tuple[int, int],
    beam: Beam,
    settings: ScatterSettings | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ScanScatter:
    """Simulate the scatter of a scan.

    Args:
        thing: the object's voxels, in the frame of `views`.
        views: (n, 12) cone_vec rows [mm].
        shape: the panel's (rows, cols).
        beam: spectrum and panel.
        settings: how; default: Monte Carlo.
        progress: called with the views simulated and to simulate.

    Raises:
        GeometryError: the source lies beside or inside the object's box in a view.
        LimitError: no views.
    """
    wanted = ScatterSettings() if settings is None else settings
    rows = np.asarray(views, dtype=np.float64)
    if not len(rows):
        raise LimitError("no views to simulate scatter for", {"asked": 0, "allowed": "> 0"})
    way = _way(rows)
    simulated = _simulated(way, np.radians(wanted.step_deg))
    images = []
    for k, i in enumerate(simulated):
        images.append(scatter_image(thing, rows[i], shape, beam, wanted, i))
        if progress is not None:
            progress(k + 1, len(simulated))
    return ScanScatter(wanted, tuple(images), tuple(simulated), way)


def _way(rows: FloatArray) -> FloatArray:
    """How far source and panel have come at each view, relative to their distances, (n,) [rad]."""
    source, centre, frame = rows[:, 0:3], rows[:, 3:6], rows[:, 6:12]
    scales = (
        np.linalg.norm(source, axis=1).min(),
        np.linalg.norm(centre - source, axis=1).min(),
        np.linalg.norm(frame[:, :3], axis=1).min(),
    )
    steps = [
        np.linalg.norm(np.diff(part, axis=0), axis=1) / scale
        for part, scale in zip((source, centre, frame), scales, strict=True)
    ]
    return np.concatenate([[0.0], np.cumsum(np.max(steps, axis=0))])


def _simulated(way: FloatArray, step: float) -> Sequence[int]:
    """Indices of the views to simulate: first, last, and no way longer than `step` between two of
    them unless it is a single stride from one view to the next."""
    chosen = [0]
    for i in range(1, len(way)):
        if i == len(way) - 1 or way[i + 1] - way[chosen[-1]] > step:
            chosen.append(i)
    return chosen
