"""One radiograph without noise: what the X-rays of a pose do to the panel.

The twin server and `flexdt.simulate` both make images with these functions, so a simulated data set
and a scan of the twin differ in nothing but their geometry.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.physics.chain import (
    Chain,
    Expected,
    expected_signal,
    flux_of,
    open_electrons,
)
from flexdt.twin.physics.exposure import ExposureSettings
from flexdt.twin.physics.scatter.simulation import Scattered


@dataclass(frozen=True, eq=False)
class Radiograph:
    """What the X-rays of one pose do to the panel, without noise.

    Attributes:
        integrals: (rows, cols), or (moments, rows, cols): what a logarithm of the flat-corrected
            image would show.
        expected: electrons with the tube on; None in ideal physics.
    """

    integrals: Float32Array
    expected: Expected | None = None

    @property
    def shown(self) -> Float32Array:
        """Line integrals (rows, cols) of the middle moment, for display."""
        values = self.integrals
        return values if values.ndim == 2 else values[len(values) // 2]


def radiographs(
    chain: Chain,
    paths_mm: Float32Array,
    views: FloatArray,
    exposures: Sequence[ExposureSettings],
    moments: int = 1,
    scatter: Sequence[Scattered] = (),
) -> list[Radiograph]:
    """Images of several exposures, taken as if X-rays were on.

    Args:
        chain: tube, materials, panel.
        paths_mm: float32 (m, n * moments, rows, cols), one channel a material [mm].
        views: (n * moments, 12) their cone_vec rows [mm].
        exposures: tube and time of each of the n images.
        moments: views spread over each exposure.
        scatter: of each image; none if left out.
    """
    made = []
    for i, given in enumerate(exposures):
        exposure = replace(given, xrays_on=True)
        part = slice(i * moments, (i + 1) * moments)
        view = views[i * moments + moments // 2]
        expected = expected_signal(chain, paths_mm[:, part], view, exposure)
        if scatter:
            expected = scatter[i].added_to(expected, chain, view, exposure)
        made.append(Radiograph(_as_line_integrals(chain, expected, view, exposure), expected))
    return made


def _as_line_integrals(
    chain: Chain, expected: Expected, view: FloatArray, exposure: ExposureSettings
) -> Float32Array:
    """-log of the signal over the open beam's."""
    area = open_electrons(chain, exposure, 100.0)  # electrons for a cm2 at 1 m
    least = np.float32(1e-6)
    lines = np.log(np.maximum(np.float32(area) * flux_of(view, expected.mean_e.shape), least))
    lines -= np.log(np.maximum(expected.mean_e, least))
    return np.asarray(lines, dtype=np.float32)
