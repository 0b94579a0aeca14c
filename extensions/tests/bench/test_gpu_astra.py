"""ASTRA beside ours on a CUDA device; without one it is never touched."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

import flexdt as fx
from flexdt.twin.errors import GeometryError
from flexdt.twin.projection import Volume, forward, gpu
from flexdt_extensions.bench import device_page

FOUND = gpu.availability()
needs_gpu = pytest.mark.skipif(
    not FOUND.present, reason=f"no CUDA device: {FOUND.reason}"
)


def circle(n: int, sod: float, sdd: float, pixel: float, roll: float = 0.0) -> fx.ConeVec:
    return fx.ConeVec.circular(
        sod=sod, sdd=sdd, angles=n, shape=(5, 6), pixel=pixel, tilts=(roll, 0.0, 0.0)
    )


def test_probing_without_a_device_answers_and_touches_no_astra() -> None:
    code = (
        "import sys; from flexdt.twin.projection import gpu; "
        "from flexdt_extensions.bench import device_page; "
        "print(gpu.availability()); assert 'astra' not in sys.modules"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=100
    )
    assert done.returncode == 0, done.stderr
    assert "Availability" in done.stdout


@pytest.mark.skipif(FOUND.present, reason="this machine has a device")
def test_astra_is_refused_without_a_device() -> None:
    with pytest.raises(GeometryError, match="needs a GPU"):
        device_page.Resident(
            Volume(np.ones((3, 3, 3), np.float32), 1.0), circle(1, 9, 18, 1), (4, 4)
        )


def test_astra_geometry_is_ours() -> None:
    volume = Volume(np.ones((2, 3, 4), np.float32), (1.0, 2.0, 3.0), (10.0, 20.0, 30.0))
    space, panel = device_page.geometries(volume, circle(3, 50, 100, 1), (5, 6))
    assert (space["GridSliceCount"], space["GridRowCount"], space["GridColCount"]) == (
        2,
        3,
        4,
    )
    window = space["option"]
    assert (window["WindowMinX"], window["WindowMaxX"]) == (8.0, 12.0)
    assert (window["WindowMinZ"], window["WindowMaxZ"]) == (27.0, 33.0)
    assert panel["Vectors"].shape == (3, 12)
    assert (panel["DetectorRowCount"], panel["DetectorColCount"]) == (5, 6)


@pytest.mark.gpu
@needs_gpu
def test_device_agrees_with_astra() -> None:
    pytest.importorskip("astra")
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, 100)] * 3, indexing="ij")
    # A ball in the middle looks the same in any mirror; the blob beside it does not.
    middle = np.exp(-4 * (x * x + y * y + z * z))
    blob = np.exp(-30 * ((x - 0.4) ** 2 + (y + 0.25) ** 2 + 2 * (z - 0.15) ** 2))
    volume = Volume((middle + 2 * blob).astype(np.float32), 0.1)
    for flipped in (volume.data[::-1], volume.data[:, ::-1], volume.data[:, :, ::-1]):
        assert np.abs(flipped - volume.data).max() > 1
    geometry = circle(5, 60.0, 106.0, 0.15, roll=1.1)
    ours = forward(volume, geometry, (150, 170))
    theirs = device_page.Resident(volume, geometry, (150, 170)).run().transpose(1, 0, 2)
    # A smooth volume: interpolation and steps of voxels differ little (RTK's Joseph projector,
    # which interpolates as well, by 0.024 of the maximum and 0.00024 in the mean), mirrors do.
    assert np.abs(ours - theirs).max() < 0.03 * ours.max()
    assert np.abs(ours - theirs).mean() < 1e-3 * ours.max()
    for mirrored in (theirs[:, ::-1], theirs[:, :, ::-1]):
        assert np.abs(ours - mirrored).max() > 0.3 * ours.max()
