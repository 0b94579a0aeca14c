"""Two materials in the loop, beside an explicit matrix and a plain sum over all energies."""

from __future__ import annotations

import numpy as np
import pytest
from circular_scans import circle, lengths

from flexdt.twin.attenuation.substances import Substance
from flexdt.twin.errors import GeometryError, LimitError
from flexdt.twin.physics.chain import Chain, weights_of
from flexdt.twin.physics.detector import Detector
from flexdt.twin.reconstruction import Grid, Polychromatic, hardening, sart, sirt

KV, KEV = 90.0, 60.0
PMMA, STEEL = Substance.of("pmma", "C5H8O2", 1.18), Substance.of("steel", "Fe", 7.87)
GRID, SCAN, SHAPE = Grid((2, 12, 10), 3.0), circle(24, pixel=2.4), (4, 24)
BOTH = Polychromatic.of((PMMA, STEEL), KV, KEV)


def polychromatic(paths: np.ndarray) -> np.ndarray:
    """Line integrals (j,) behind paths (j, 2) [mm], summed over all energies."""
    weights, _ = weights_of(Chain(Detector()), KV)
    mu = np.array([PMMA.attenuation(), STEEL.attenuation()])
    return -np.log(np.exp(-paths @ mu) @ weights / weights.sum())


@pytest.fixture(scope="module")
def drawn():
    """A block of PMMA with two pins of steel: densities, what is measured, and the truth."""
    _, y, x = np.indices(GRID.shape)
    pmma = (abs(y - 5.5) < 5) & (abs(x - 4.5) < 4)
    steel = pmma & (y == 5) & ((x == 2) | (x == 7))
    thick = np.stack([pmma & ~steel, steel]).reshape(2, -1).astype(float)
    matrix = lengths(SCAN, SHAPE, GRID)
    paths = matrix @ thick.T
    images = polychromatic(paths).reshape(len(SCAN), *SHAPE).astype(np.float32)
    return matrix, images, (BOTH.mu @ thick).reshape(GRID.shape), paths


def test_line_integrals_are_the_sum_over_the_spectrum(drawn):
    _, images, _, paths = drawn
    seen, more = BOTH.line_integrals(paths.T.astype(np.float32))
    np.testing.assert_allclose(seen, images.ravel(), atol=4e-4)
    there = images.ravel() > 0.01
    np.testing.assert_allclose((more * seen)[there], (paths @ BOTH.mu)[there], rtol=1e-4)
    air, limit = BOTH.line_integrals(np.zeros((2, 3), np.float32))
    assert not air.any()
    thin = BOTH.line_integrals(np.array([[0.06], [0.0]], np.float32))[1]
    assert limit == pytest.approx(float(thin[0]), rel=0.01)
    seen, more = BOTH.line_integrals(
        np.array([[-1e6, 1e6, -5.0], [1e6, 1e6, 1.0]], np.float32)
    )
    assert np.isfinite(seen).all()
    assert (more > 0.0).all()  # a step in the wrong direction diverges


@pytest.mark.slow
def test_it_finds_the_truth_of_one_energy(drawn):
    """Where one material's correction, or none, does not."""
    _, images, truth, _ = drawn
    options = {"iterations": 150, "subsets": 4, "nonnegative": True}
    two = sart(images, SCAN, GRID, hardening=BOTH, **options).data
    one = sart(hardening(PMMA, KV, KEV)(images), SCAN, GRID, **options).data
    none = sart(images, SCAN, GRID, **options).data
    pmma = truth == truth[truth > 0].min()
    errors = [
        float(np.abs(v - truth)[pmma].mean()) / BOTH.mu[0] for v in (two, one, none)
    ]
    assert errors[0] < 0.02
    assert errors[1] > 0.2
    assert errors[2] > 0.4
    assert np.abs(two - truth).max() < 0.1 * BOTH.mu[0]


def test_iterations_are_those_of_the_explicit_matrix(drawn):
    matrix, images, _, _ = drawn
    with np.errstate(divide="ignore"):
        r, c = 1 / matrix.sum(axis=1), 1 / matrix.sum(axis=0)
    r[~np.isfinite(r)] = 0.0
    x = np.zeros(matrix.shape[1])
    for _ in range(12):
        dense = x > np.sqrt(BOTH.mu.prod())
        paths = np.stack([matrix @ (x * ~dense), matrix @ (x * dense)], 1) / BOTH.mu
        seen = polychromatic(paths)
        more = np.divide(
            paths @ BOTH.mu,
            seen,
            out=np.full(len(seen), more_of_air()),
            where=seen > 1e-9,
        )
        x += c * (matrix.T @ (r * more * (images.ravel() - seen)))
    found = sirt(images, SCAN, GRID, iterations=12, hardening=BOTH).data.ravel()
    np.testing.assert_allclose(found, x, atol=2e-3 * x.max())


def more_of_air() -> float:
    weights, _ = weights_of(Chain(Detector()), KV)
    return BOTH.mu[0] / float(PMMA.attenuation() @ weights / weights.sum())


def test_noise_ends_it_and_what_is_refused(drawn):
    _, images, truth, _ = drawn
    variances = np.full(images.shape, 1e-2)
    noisy = images + np.random.default_rng(1).normal(0.0, 0.1, images.shape)
    steps = []
    sart(noisy, SCAN, GRID, iterations=50, subsets=3, hardening=BOTH, variances=variances,
         start=GRID.blank().like(0.9 * truth), watch=steps.append)  # fmt: skip
    assert 1 < len(steps) < 50
    assert steps[-1].residual < 0.11
    with pytest.raises(LimitError, match="attenuate alike"):
        Polychromatic.of((PMMA, PMMA), KV, KEV)
    with pytest.raises(LimitError, match="no material"):
        Polychromatic.of((), KV, KEV)

    with pytest.raises(GeometryError, match="hardening"):
        sirt(images, SCAN, GRID, hardening="pmma,steel")
    for wrong in (np.nan, 0.0, 1e6):
        with pytest.raises(LimitError, match="energy_keV is"):
            Polychromatic.of((PMMA, STEEL), KV, wrong)
    with pytest.raises(GeometryError, match="a Substance"):
        Polychromatic.of(("pmma", "steel"), KV, KEV)


@pytest.mark.parametrize("energy", [30.0, 85.0])
@pytest.mark.daily(1)
def test_metal_that_looks_thin_at_first_is_found(energy):
    """At low energies metal attenuates several times as much as it seems to before it is
    known."""
    scan, grid, shape = circle(24, pixel=0.9), Grid((1, 12, 12), 0.5), (1, 24)
    both = Polychromatic.of((STEEL, PMMA), KV, energy)
    truth = np.zeros(grid.shape)
    truth[0, 3:9, 3:9] = both.mu[1]
    truth[0, 5, 4:8] = both.mu[0]
    matrix = lengths(scan, shape, grid)
    steel = truth.ravel() == both.mu[0]
    pmma = truth.ravel() == both.mu[1]
    images = polychromatic(matrix @ np.stack([pmma, steel], 1)).reshape(len(scan), *shape)
    options = {"iterations": 25, "relaxation": 1.5, "nonnegative": True}
    found = sart(images, scan, grid, hardening=both, **options).data
    np.testing.assert_allclose(found, truth, atol=0.02 * both.mu[0])
