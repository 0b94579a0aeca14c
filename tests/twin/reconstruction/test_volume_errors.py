"""Values between the nodes of a coarse grid are those of SciPy's spline of first order."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from flexdt.twin.projection import Volume
from flexdt.twin.reconstruction.volume_errors import interpolated


def by_scipy(nodes: Volume, grid: Volume) -> np.ndarray:
    """Every voxel on its own, in double precision."""
    at = [
        np.interp(places, known, np.arange(len(known)))
        for places, known in zip(grid.centers()[::-1], nodes.centers()[::-1], strict=True)
    ]
    return map_coordinates(
        nodes.data.astype(float), np.meshgrid(*at, indexing="ij"), order=1
    )


@pytest.mark.parametrize("seed", range(20))
def test_interpolation_is_that_of_scipy(seed: int) -> None:
    random = np.random.default_rng(seed)
    data = random.random(tuple(random.integers(1, 9, 3)), dtype=np.float32)
    if seed % 2:
        data[random.random(data.shape) < 0.1] = (
            np.nan
        )  # layers that some sides do not see
    center = tuple(random.uniform(-1, 1, 3))
    nodes = Volume(data, float(random.uniform(0.5, 3)), center_mm=center)
    grid = Volume(
        np.zeros(tuple(random.integers(1, 40, 3)), np.float32),
        float(random.uniform(0.1, 1)),
    )
    found, wanted = interpolated(nodes, grid), by_scipy(nodes, grid)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(wanted))
    # Three interpolations of values up to 1, each rounded to single precision.
    np.testing.assert_allclose(found, wanted, rtol=0, atol=6 * np.finfo(np.float32).eps)
