"""One radiograph without noise: what the X-rays of a pose do to the panel.

The twin server and `flexdt.simulate` both make images with these functions, so a simulated data set
and a scan of the twin differ in nothing but their geometry.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from flexdt.twin.errors import LimitError
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

MOST_RAYS: Final = 16


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


def check_rays(rays: int) -> None:
    """Check a number of rays along each side of a pixel.

    Raises:
        LimitError: says what is allowed.
    """
    if not isinstance(rays, int | np.integer) or rays not in range(1, MOST_RAYS + 1):
        raise LimitError(
            f"rays is {rays}; allowed: 1 to {MOST_RAYS} along each side of a pixel",
            {"asked": rays, "allowed": [1, MOST_RAYS]},
        )


def within_pixels(rows: FloatArray, rays: int) -> FloatArray:
    """Views through a point in each of rays x rays parts of the pixels of each view, (n * rays^2,
    12): no two in one row or column, so that edges along them come out in rays^2 steps."""
    j, i = np.divmod(np.arange(rays**2)[:, None], rays)
    across = (i + (j + 0.5) / rays) / rays - 0.5
    down = (j + (rays - i - 0.5) / rays) / rays - 0.5
    out = np.repeat(rows[:, None], rays**2, axis=1)
    out[:, :, 3:6] += across * rows[:, None, 6:9] + down * rows[:, None, 9:12]
    return out.reshape(-1, 12)
