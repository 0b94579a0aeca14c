"""`fx.project` against chords worked out by hand, for each kind of sample."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose

import flexdt as fx

SCAN = fx.ConeVec.circular(sod=600, sdd=1000, angles=3, shape=(15, 17), pixel=0.7)
AT = np.array([2.0, 1.0, -1.0])
RADIUS = 3.0


def chords() -> np.ndarray:  # type: ignore[type-arg]
    """Length of each ray inside the ball: 2 sqrt(r^2 - d^2), d its distance from the centre."""
    pixels = SCAN.pixel_centers()
    source = SCAN.source[:, None, None, :]
    way = pixels - source
    way /= np.linalg.norm(way, axis=-1, keepdims=True)
    gap = np.linalg.norm(np.cross(AT - source, way), axis=-1)
    return 2.0 * np.sqrt(np.clip(RADIUS**2 - gap**2, 0.0, None))


def test_a_ball_of_solids_and_a_list_of_two() -> None:
    ball = {"kind": "sphere", "center": AT.tolist(), "radius": RADIUS, "material": "pmma"}
    mu = fx.phantoms.material("pmma").mu_per_mm
    assert_allclose(fx.project(ball, SCAN), mu * chords(), atol=1e-5)
    assert_allclose(fx.project([ball, ball], SCAN), 2 * mu * chords(), atol=1e-5)


def test_a_mesh_of_a_box_turned_out_of_the_middle() -> None:
    """A box along the beam: the path of the middle ray is its depth."""
    mesh = trimesh.creation.box((4.0, 6.0, 3.0))
    mu = fx.phantoms.material("aluminium").mu_per_mm
    images = fx.project(mesh, SCAN[:1], material="aluminium")
    assert images[0, 7, 8] == pytest.approx(6.0 * mu, rel=1e-4)
    assert images[0, 0, 0] == 0.0


def test_volumes_and_arrays_are_the_projector() -> None:
    values = np.random.default_rng(5).random((6, 5, 4)).astype(np.float32)
    volume = fx.Volume(values, 0.8)
    assert_allclose(fx.project(volume, SCAN), fx.forward(volume, SCAN))
    assert_allclose(
        fx.project(values, SCAN, voxel_mm=0.8), fx.forward(volume, SCAN), atol=1e-6
    )


def test_what_cannot_be_projected_is_said() -> None:
    with pytest.raises(fx.TwinError, match="voxel_mm"):
        fx.project(np.ones((3, 3, 3)), SCAN)
    with pytest.raises(fx.TwinError, match="shape is not known"):
        fx.project("lego", SCAN.with_shape(None))


def test_phantoms_have_short_names() -> None:
    assert len(fx.phantoms.lego().beads) > 0
    assert fx.phantoms.beads("tall", 3).name == "tall-3"
    assert fx.phantoms.shepp_logan().is_analytic
    for name in ("lego", "beads", "shepp_logan", "from_mesh"):
        assert callable(getattr(fx.phantoms, name))
