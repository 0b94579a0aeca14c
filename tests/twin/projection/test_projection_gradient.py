"""Derivatives with respect to the geometry, against finite differences of a double-precision
Siddon that shares nothing with the kernels, and against formulas.
"""

from __future__ import annotations

import numpy as np
import pytest

from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import Volume, forward, geometry_change, geometry_gradient

SHAPE = (6, 7)
STEP_MM = 1e-6


def volume_of(rng) -> Volume:
    """Random voxels, a third of them empty, of unequal edges, off the origin."""
    data = rng.uniform(0.1, 1.0, (5, 6, 7)) * (rng.uniform(size=(5, 6, 7)) < 0.7)
    return Volume(
        data.astype(np.float32), (0.5, 0.7, 0.6), tuple(rng.normal(size=3) * 0.5)
    )


def tilted(rng, circle):
    roll, pitch, yaw = rng.normal(size=3) * 0.3
    return circle(
        2, 25, 45, 0.9, roll=roll, pitch_tilt=pitch, yaw=yaw, start=rng.uniform(0, 6)
    )


def off_centre(rng, circle):
    rows = circle(2, 22, 40, 0.9, start=rng.uniform(0, 6)).rows.copy()
    rows[:, :6] += rng.normal(size=(2, 6))
    return ConeVec(rows)


def helical(rng, circle):
    rows = circle(2, 22, 40, 0.9, start=rng.uniform(0, 6)).rows.copy()
    rows[:, [2, 5]] += rng.uniform(-2, 2, (2, 1))
    return ConeVec(rows)


def any_numbers(rng, circle):
    """Nothing at a right angle, columns and rows of unequal step."""
    return ConeVec(circle(2, 20, 40, 1.0).rows + rng.normal(size=(2, 12)) * 0.2)


def source_inside(rng, circle):
    return ConeVec.from_vectors(
        rng.uniform(-0.3, 0.3, (2, 3)), (0.2, 9.0, 0.1), (1, 0.1, 0.02), (0.1, 0, -1)
    )


def pixels_inside(rng, circle):
    centre = rng.uniform(-0.3, 0.3, (2, 3))
    return ConeVec.from_vectors((0.4, -9, 0.3), centre, (0.2, 0.03, 0), (0, 0.01, -0.2))


def differences(siddon, volume, cone_vec, pixels):
    """Central differences of the reference, (n, pixels, 12) [1/mm]."""
    slopes = []
    for k in range(12):
        step = np.zeros(12)
        step[k] = STEP_MM
        high, low = (
            siddon(
                volume.data, volume.voxel_xyz, volume.center_mm, ConeVec(rows), SHAPE, pixels
            )
            for rows in (cone_vec.rows + step, cone_vec.rows - step)
        )  # fmt: skip
        slopes.append((high - low) / (2 * STEP_MM))
    return np.stack(slopes, axis=-1)


@pytest.mark.parametrize(
    "kind", [tilted, off_centre, helical, any_numbers, source_inside, pixels_inside]
)
def test_derivatives_are_those_of_the_reference(kind, siddon, circle):
    rng = np.random.default_rng(len(kind.__name__))
    for _ in range(2):
        volume, cone_vec = volume_of(rng), kind(rng, circle)
        every = [(r, c) for r in range(SHAPE[0]) for c in range(SHAPE[1])]
        pixels = [every[i] for i in rng.choice(len(every), 12, replace=False)]
        wanted = differences(siddon, volume, cone_vec, pixels)
        assert np.abs(wanted).max() > 0.01
        scale = np.abs(wanted).max(axis=(0, 1))
        at = tuple(np.array(pixels).T)
        for k in range(12):
            found = geometry_change(volume, cone_vec, np.eye(12)[k], SHAPE)[:, *at]
            assert np.abs(found - wanted[..., k]).max() < 1e-6 * scale[k]
        weights = np.zeros((len(cone_vec), *SHAPE), np.float32)
        weights[:, *at] = rng.normal(size=(len(cone_vec), len(pixels)))
        found = geometry_gradient(volume, cone_vec, weights)
        np.testing.assert_allclose(
            found,
            np.einsum("np,npk->nk", weights[:, *at], wanted),
            atol=1e-6 * scale.max() * 12,
        )


def test_an_oblique_ray_through_a_slab():
    """p = mu T sqrt(x^2 + y^2 + z^2) / |y| for a ray (x, y, z) through a slab of thickness T."""
    slab = Volume(np.full((8, 3, 8), 0.03, np.float32), (5.0, 0.5, 5.0))
    source, pixel = np.array([0.31, -40.0, 0.17]), np.array([9.0, 35.0, -6.0])
    view = ConeVec.from_vectors(source, pixel, (1, 0, 0), (0, 0, -1))
    found = geometry_gradient(slab, view, np.ones((1, 1, 1), np.float32))[0]
    d = pixel - source
    length, path = np.linalg.norm(d), 0.03 * 1.5
    wanted = path / d[1] * (d / length - np.array([0, length / d[1], 0]))
    np.testing.assert_allclose(found[3:6], wanted, rtol=1e-6)
    np.testing.assert_allclose(found[0:3], -wanted, rtol=1e-6)
    assert not found[6:].any()  # a single pixel is the detector's centre


def test_gradient_and_change_are_transposes(circle):
    rng = np.random.default_rng(5)
    volume, cone_vec = volume_of(rng), tilted(rng, circle)
    weights = rng.normal(size=(2, 40, 33)).astype(np.float32)
    change = rng.normal(size=(2, 12))
    one = float(np.vdot(weights, geometry_change(volume, cone_vec, change, (40, 33))))
    other = float(np.vdot(change, geometry_gradient(volume, cone_vec, weights)))
    assert one == pytest.approx(other, rel=1e-5)


def test_the_number_of_threads_does_not_matter(circle):
    import numba

    rng = np.random.default_rng(6)
    volume, cone_vec = volume_of(rng), tilted(rng, circle)
    weights = rng.normal(size=(2, 12, 33)).astype(np.float32)
    before = numba.get_num_threads()
    found = []
    for count in {1, before}:
        numba.set_num_threads(count)
        found.append(geometry_gradient(volume, cone_vec, weights))
    numba.set_num_threads(before)
    assert np.array_equal(found[0], found[-1])


def test_nothing_there_and_shapes_that_do_not_fit(circle):
    cone_vec, empty = circle(2, 20, 40, 1.0), Volume(np.zeros((3, 3, 3)), 1.0)
    weights = np.ones((2, *SHAPE), np.float32)
    assert not geometry_gradient(empty, cone_vec, weights).any()
    assert not geometry_change(empty, cone_vec, np.ones(12), SHAPE).any()
    assert not forward(empty, cone_vec, SHAPE).any()
    with pytest.raises(GeometryError, match="2 x rows x cols"):
        geometry_gradient(empty, cone_vec, weights[:1])
    with pytest.raises(GeometryError, match="3 x 12; allowed: 2 x 12 or 12"):
        geometry_change(empty, cone_vec, np.ones((3, 12)), SHAPE)
