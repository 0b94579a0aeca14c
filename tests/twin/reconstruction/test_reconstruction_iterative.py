"""Iterative methods: residuals, exactness on small problems solved by linear algebra,
geometry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from circular_scans import MU, ball, circle, measure

from flexdt.twin.errors import GeometryError, LimitError
from flexdt.twin.projection import Volume, forward, gpu
from flexdt.twin.reconstruction import Grid, cgls, em, fdk, sart, sirt, tv
from flexdt.twin.reconstruction.linear_system import LinearSystem

SCAN = circle(45, pixel=1.4)
SHAPE = (52, 56)
LIKE = Grid((40, 40, 40), 0.8).blank()


@pytest.fixture(scope="module")
def images():
    return ball(SCAN, SHAPE)


@pytest.mark.parametrize(
    ("method", "options"),
    [(sirt, {"iterations": 40}), (sart, {"iterations": 5}), (cgls, {"iterations": 10}),
     (em, {"iterations": 25})],
)  # fmt: skip
@pytest.mark.daily(3)
def test_a_ball_comes_back_and_residuals_fall(images, method, options):
    steps = []
    volume = method(images, SCAN, LIKE, watch=steps.append, **options)
    found, centre = measure(volume)
    assert found == pytest.approx(1.0, abs=0.03)
    assert np.abs(centre).max() < 0.1
    residuals = np.array([s.residual for s in steps])
    assert [s.iteration for s in steps] == list(range(1, options["iterations"] + 1))
    assert residuals[-1] < 0.2 * residuals[0]
    if method in (sirt, cgls):
        assert (np.diff(residuals) < 0).all()


def test_cgls_solves_least_squares():
    like = Grid((3, 3, 3), 4.0).blank()
    scan = circle(7, pixel=3.0)
    columns = []
    for i in range(27):
        unit = np.zeros(27, np.float32)
        unit[i] = 1.0
        columns.append(forward(Volume(unit.reshape(3, 3, 3), 4.0), scan, (9, 9)).ravel())
    matrix = np.array(columns, np.float64).T
    data = np.random.default_rng(1).normal(size=(7, 9, 9)).astype(np.float32)
    wanted = np.linalg.lstsq(matrix, data.ravel().astype(float), rcond=None)[0]
    # Far more iterations than unknowns, and a residual as large as the data: rounding of
    # gradients must not add up. 27 sums of some 60 lengths, each rounded by 2^-24, times a
    # condition of 3.4.
    rounding = 60 * 2.0**-24 * np.linalg.cond(matrix)
    got = cgls(data, scan, like, iterations=60).data.ravel()
    np.testing.assert_allclose(got, wanted, rtol=0, atol=rounding * np.abs(wanted).max())
    # SIRT by its own definition, with the explicit matrix
    with np.errstate(divide="ignore"):
        r, c = 1 / matrix.sum(axis=1), 1 / matrix.sum(axis=0)
    r[~np.isfinite(r)] = 0.0
    x = np.zeros(27)
    for _ in range(6):
        x += c * (matrix.T @ (r * (data.ravel() - matrix @ x)))
    np.testing.assert_allclose(
        sirt(data, scan, like, iterations=6).data.ravel(), x, atol=1e-3 * np.abs(x).max()
    )


@pytest.mark.parametrize("seed", range(4))
def test_cgls_stays_at_least_squares_however_the_transpose_rounds(seed, monkeypatch):
    """As on a device, whose sums differ at every call: far beyond convergence, nothing
    grows."""
    draw = np.random.default_rng(seed)
    like, scan = Grid((3, 3, 3), 4.0).blank(), circle(7, pixel=3.0)
    unit = np.eye(27, dtype=np.float32).reshape(27, 3, 3, 3)
    matrix = np.array(
        [forward(Volume(u, 4.0), scan, (9, 9)).ravel() for u in unit], float
    ).T
    data = draw.normal(size=(7, 9, 9)).astype(np.float32)
    wanted = np.linalg.lstsq(matrix, data.ravel().astype(float), rcond=None)[0]

    def spread(system, y, views=None):
        sums = matrix.T @ y.ravel()
        off = 4 * 2.0**-24 * draw.uniform(-1, 1, 27) * (matrix.T @ np.abs(y.ravel()))
        return (sums + off).astype(np.float32).reshape(3, 3, 3)

    monkeypatch.setattr(LinearSystem, "spread", spread)
    monkeypatch.setattr(gpu, "availability", lambda: gpu.Availability(False, "not asked"))
    got = cgls(data, scan, like, iterations=60).data.ravel()
    rounding = 60 * 2.0**-24 * np.linalg.cond(matrix)
    np.testing.assert_allclose(got, wanted, rtol=0, atol=rounding * np.abs(wanted).max())


@pytest.mark.slow
@pytest.mark.campaign
def test_weights_solve_weighted_least_squares():
    """Beside the explicit matrix, with and without ordered subsets."""
    rng = np.random.default_rng(4)
    like, scan, shape = Grid((3, 3, 3), 4.0).blank(), circle(8, pixel=3.0), (9, 9)
    unit = np.eye(27, dtype=np.float32).reshape(27, 3, 3, 3)
    matrix = np.array(
        [forward(Volume(u, 4.0), scan, shape).ravel() for u in unit], float
    ).T
    true = rng.uniform(0.01, 0.05, 27)
    variances = 10.0 ** rng.uniform(-4, -1, matrix.shape[0])
    data = matrix @ true + rng.normal(0.0, np.sqrt(variances))
    root = 1.0 / np.sqrt(variances)
    wanted = np.linalg.lstsq(root[:, None] * matrix, root * data, rcond=None)[0]
    even = np.linalg.lstsq(matrix, data, rcond=None)[0]
    images, given = (a.reshape(8, *shape).astype(np.float32) for a in (data, variances))
    # Smaller variances, of the same ratios: or it would end at the noise, before the solution.
    found = sirt(images, scan, like, iterations=3000, variances=0.01 * given).data.ravel()
    assert np.abs(found - wanted).max() < 0.02 * np.abs(even - wanted).max()
    exact = (matrix @ true).reshape(8, *shape).astype(np.float32)
    subsets = sart(exact, scan, like, iterations=300, subsets=4, variances=1e-9 * given)
    np.testing.assert_allclose(subsets.data.ravel(), true, atol=2e-4)


@pytest.mark.parametrize("method", [sirt, sart])
@pytest.mark.slow
def test_weighted_iterations_end_at_the_noise(images, method):
    rng = np.random.default_rng(5)
    variances = 10.0 ** rng.uniform(-5, -3, images.shape)
    noisy = (images + rng.normal(0.0, np.sqrt(variances))).astype(np.float32)
    steps = []
    found = method(
        noisy, SCAN, LIKE, iterations=200, variances=variances, watch=steps.append
    )
    assert 2 < len(steps) < 200

    def left(volume):
        return float(((noisy - forward(volume, SCAN, SHAPE)) ** 2 / variances).mean())

    assert left(found) <= 1.0
    assert (
        method is sart
        or left(method(noisy, SCAN, LIKE, iterations=len(steps) - 2, variances=variances))
        > 1.0
    )
    for wrong in (variances[1:], 0.0 * variances, -variances):
        with pytest.raises(GeometryError, match="above 0 for each line integral"):
            method(noisy, SCAN, LIKE, variances=wrong)


def test_any_trajectory_will_do():
    rows = SCAN.rows.copy()
    rows[:, [2, 5]] += np.linspace(-12, 12, len(rows))[:, None]  # a helix
    helix = circle(45, pixel=1.4, tilt=0.02).rows * 0 + rows
    volume = cgls(ball_at(helix), helix, LIKE, iterations=10)
    found, centre = measure(volume)
    assert found == pytest.approx(1.0, abs=0.03)
    assert np.abs(centre).max() < 0.1


def ball_at(rows):
    from flexdt.twin.geometry.cone_vec import ConeVec

    return ball(ConeVec(rows), SHAPE)


def test_start_and_positivity(images):
    few = sirt(images, SCAN, LIKE, iterations=3)
    more = sirt(images, SCAN, LIKE, iterations=2, start=few)
    np.testing.assert_allclose(
        more.data, sirt(images, SCAN, LIKE, iterations=5).data, atol=1e-6
    )
    noisy = images + np.random.default_rng(0).normal(0, 0.05, images.shape).astype(
        np.float32
    )
    assert sirt(noisy, SCAN, LIKE, iterations=3).data.min() < -1e-4
    assert sirt(noisy, SCAN, LIKE, iterations=3, nonnegative=True).data.min() == 0.0
    positive = em(noisy, SCAN, LIKE, iterations=3).data
    assert positive.min() >= 0.0
    assert positive.max() < 3 * MU


def test_what_they_refuse(images):
    with pytest.raises(LimitError, match="iterations"):
        sirt(images, SCAN, LIKE, iterations=0)
    with pytest.raises(LimitError, match="subsets"):
        sart(images, SCAN, LIKE, subsets=0)
    with pytest.raises(GeometryError):
        cgls(images[:3], SCAN, LIKE)
    with pytest.raises(GeometryError, match="first guess"):
        sirt(images, SCAN, LIKE, start=Grid((2, 2, 2), 1.0).blank())
    for other in (
        replace(LIKE, voxel_mm=2.0 * LIKE.voxel_xyz[0]), replace(LIKE, center_mm=(0.0, 0.0, 3.0)),
    ):  # fmt: skip
        with pytest.raises(GeometryError, match="first guess"):
            cgls(images, SCAN, LIKE, start=other)


@pytest.mark.parametrize("method", [sirt, sart, cgls, em, tv, fdk])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_images_that_are_not_finite_are_refused(images, method, bad):
    images = np.array(images)
    images[1, 2, 3] = bad
    with pytest.raises(GeometryError, match="not finite"):
        method(images, SCAN, LIKE)
