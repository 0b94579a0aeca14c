"""Tables of FDK beside the same numbers worked out pixel by pixel: angles, weights, voxels
without a value.
"""

from __future__ import annotations

import numpy as np
import pytest
from circular_scans import circle

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.reconstruction.acquisition.coverage import LostVoxels
from flexdt.twin.reconstruction.acquisition.trajectory import (
    circle_of,
    fan_angles,
    panel_reach,
    reach,
    redundancy,
)
from flexdt.twin.reconstruction.feldkamp.fdk_plan import weighing


def drawn(rng: np.random.Generator) -> tuple[ConeVec, tuple[int, int]]:
    """Draw a scan with a panel anywhere, and its (rows, cols)."""
    shape = int(rng.integers(2, 6)), int(rng.integers(2, 40))
    scan = circle(
        int(rng.integers(5, 20)),
        pixel=float(rng.choice([rng.uniform(0.2, 40.0), 200.0])),
        aside=float(rng.uniform(-300.0, 300.0)),
        yaw=float(rng.uniform(-1.4, 1.4)),
        sdd=float(rng.uniform(100.0, 1200.0)),
    )
    return scan, shape


def pixels(scan: ConeVec, shape: tuple[int, int]) -> np.ndarray:
    """Centres of pixels minus the source, (n, rows, cols, 3) [mm]."""
    rows, cols = shape
    c = np.arange(cols) - (cols - 1) / 2
    r = np.arange(rows) - (rows - 1) / 2
    middle = (scan.detector - scan.source)[:, None, None]
    across = c[None, None, :, None] * scan.u[:, None, None]
    return middle + across + r[None, :, None, None] * scan.v[:, None, None]


@pytest.mark.parametrize("seed", range(40))
def test_fan_angles_and_weights_are_those_of_the_pixels(seed) -> None:
    rng = np.random.default_rng(seed)
    scan, shape = drawn(rng)
    about = circle_of(scan)
    ray = pixels(scan, shape)
    inward = about.centre - scan.source[:, :2]
    turn = (inward[:, 0] - 1j * inward[:, 1])[:, None]
    fan = fan_angles(about, scan, shape[1])
    right = np.angle((ray[:, 0, :, 0] + 1j * ray[:, 0, :, 1]) * turn)
    np.testing.assert_allclose(fan, right, atol=1e-12)
    assert panel_reach(about, scan, shape[1]) == reach(fan)
    views = slice(1, 4)
    weights = rng.uniform(0.0, 1.0, (3, shape[1]))
    factors, across, up = weighing(shape, scan[views], about, views, weights)
    flat = np.linalg.norm(ray[views, 0, :, :2], axis=2)
    np.testing.assert_allclose(across, flat**2, rtol=1e-12)
    np.testing.assert_allclose(up, ray[views, :, 0, 2] ** 2, atol=1e-9)
    depth = np.abs(np.einsum("ni,ni->n", ray[views, 0, 0], scan.normal[views]))
    known = (
        flat * np.cos(fan[views]) * (depth * about.radius * about.step[views])[:, None]
    )
    np.testing.assert_allclose(factors, weights * known, rtol=1e-9, atol=1e-9)


def test_rays_of_a_centred_panel_in_a_full_turn_count_half() -> None:
    scan = circle(30)
    assert np.array_equal(redundancy(circle_of(scan), scan, 64), np.full((30, 64), 0.5))


@pytest.mark.parametrize("seed", range(5))
def test_lost_voxels_are_those_of_a_count_layer_by_layer(seed) -> None:
    rng = np.random.default_rng(seed)
    nz, ny, nx = rng.integers(1, 14, 3)
    data = rng.random((ny, nx, nz), np.float32).transpose(2, 0, 1)
    data[rng.random(data.shape) < rng.choice([0.0, 0.3, 0.9])] = np.nan
    data[rng.random(nz) < 0.4] = np.nan
    layers = [[np.isnan(v) for line in layer[::4] for v in line[::4]] for layer in data]
    held = [layer for layer in layers if not all(layer)]
    lost = len(layers) - len(held)
    right = LostVoxels(len(layers), lost, sum(map(len, held)), sum(map(sum, held)))
    assert LostVoxels.of(data) == right
