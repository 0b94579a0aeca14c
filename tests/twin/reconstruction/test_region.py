"""A fine region in coarse surroundings, beside an explicit matrix of both grids."""

from __future__ import annotations

import numpy as np
import pytest
from circular_scans import circle, lengths

from flexdt.twin.errors import GeometryError
from flexdt.twin.projection import Volume
from flexdt.twin.reconstruction import Grid, cgls, sart, sirt
from flexdt.twin.reconstruction.linear_system import LinearSystem

SCAN, SHAPE = circle(9, pixel=2.1), (7, 11)
FINE, COARSE = (
    Grid((3, 4, 5), 1.5, (2.0, -1.0, 0.5)),
    Grid((4, 6, 5), 3.1, (1.0, 0.0, 0.0)),
)


class Lattice:
    """A grid of oblong voxels, as `lengths` takes it."""

    def __init__(self, volume: Volume) -> None:
        self.volume = volume

    def blank(self) -> Volume:
        return self.volume


@pytest.fixture(scope="module")
def both():
    """The surroundings' grid by hand, and the matrix of the region and all around it."""
    # 7.5 x 6 x 4.5 mm hold 2, 2 and 1 voxels of 3.1 mm; from the region's faces on, out to
    # COARSE.
    counts, edges = (5, 8, 5), (3.75, 3.0, 4.5)
    low = (-1.75 - 2 * 3.75, -4.0 - 2 * 3.0, -1.75 - 1 * 4.5)
    counts = tuple(
        1 + int(np.ceil((c + h - lo) / e - 1)) for c, h, lo, e in zip(
            COARSE.center_mm, (7.75, 9.3, 6.2), low, edges, strict=True)
    )  # fmt: skip
    centre = tuple(lo + n * e / 2 for lo, n, e in zip(low, counts, edges, strict=True))
    outer = Volume(np.zeros(counts[::-1], np.float32), edges, centre)
    x, y, z = outer.centers()
    inside = (
        (abs(z - 0.5) < 2.25)[:, None, None]
        & (abs(y + 1.0) < 3.0)[None, :, None]
        & (abs(x - 2.0) < 3.75)[None, None, :]
    )
    fine = lengths(SCAN, SHAPE, FINE)
    rest = lengths(SCAN, SHAPE, Lattice(outer))[:, ~inside.ravel()]
    return np.concatenate([fine, rest], axis=1), outer, inside


@pytest.fixture(scope="module")
def images(both):
    truth = np.random.default_rng(3).uniform(0.0, 0.05, both[0].shape[1])
    return (both[0] @ truth).reshape(len(SCAN), *SHAPE).astype(np.float32), truth


def test_grids_fill_space_once(both, images):
    _, outer, inside = both
    system = LinearSystem.of(images[0], SCAN, FINE, 1, surroundings=COARSE)
    assert system.outer.shape == outer.shape
    np.testing.assert_allclose(system.outer.center_mm, outer.center_mm)
    np.testing.assert_allclose(system.outer.voxel_xyz, outer.voxel_xyz)
    np.testing.assert_array_equal(system.outside, ~inside)
    assert inside.sum() == 4
    rng = np.random.default_rng(0)
    x = rng.normal(size=system.first(None).shape).astype(np.float32)
    y = rng.normal(size=images[0].shape).astype(np.float32)
    assert np.vdot(system.project(x), y) == pytest.approx(
        np.vdot(x, system.spread(y)), rel=1e-4
    )


def by_hand(matrix, data, iterations, parts=((slice(None)),), relaxation=1.0):
    """SIRT's step on one part of the rays after another."""
    x = np.zeros(matrix.shape[1])
    for _ in range(iterations):
        for part in parts:
            a, b = matrix[part], data[part]
            rows, columns = a.sum(axis=1), a.sum(axis=0)
            r, c = (
                np.divide(1, s, out=np.zeros_like(s), where=s > 1e-6 * s.max())
                for s in (rows, columns)
            )
            x += relaxation * c * (a.T @ (r * (b - a @ x)))
    return x[:60].reshape(FINE.shape)


def test_sirt_and_sart_are_those_of_the_explicit_matrix(both, images):
    data = images[0].ravel().astype(float)
    found = sirt(images[0], SCAN, FINE, iterations=15, surroundings=COARSE)
    assert found.shape == FINE.shape
    assert found.center_mm == FINE.center_mm
    wanted = by_hand(both[0], data, 15)
    np.testing.assert_allclose(found.data, wanted, atol=1e-5 * np.abs(wanted).max())
    view = np.arange(len(data)).reshape(len(SCAN), -1)
    parts = [view[k::3].ravel() for k in (0, 2, 1)]
    some = sart(images[0], SCAN, FINE, iterations=4, subsets=3, surroundings=COARSE)
    wanted = by_hand(both[0], data, 4, parts, 0.7)
    np.testing.assert_allclose(some.data, wanted, atol=1e-5 * np.abs(wanted).max())


def test_cgls_is_that_of_the_explicit_matrix(both, images):
    matrix, b = both[0], images[0].ravel().astype(float)
    x, rest = np.zeros(matrix.shape[1]), b.copy()
    gradient = direction = matrix.T @ rest
    for _ in range(6):
        image = matrix @ direction
        size = (gradient @ gradient) / (image @ image)
        x, rest = x + size * direction, rest - size * image
        new = matrix.T @ rest
        direction = new + (new @ new) / (gradient @ gradient) * direction
        gradient = new
    found = cgls(images[0], SCAN, FINE, iterations=6, surroundings=COARSE).data
    wanted = x[:60].reshape(FINE.shape)
    np.testing.assert_allclose(found, wanted, atol=1e-5 * np.abs(wanted).max())


def test_first_guesses_and_what_is_refused(images):
    few = sirt(images[0], SCAN, FINE, iterations=3, surroundings=COARSE)
    more = sirt(images[0], SCAN, FINE, iterations=1, start=few, surroundings=COARSE)
    assert np.abs(more.data - few.data).max() > 0.0
    for wrong in (FINE, Grid((1, 1, 1), 1.0, FINE.center_mm)):
        with pytest.raises(GeometryError, match="reaches beyond"):
            sirt(images[0], SCAN, FINE, surroundings=wrong)
    with pytest.raises(GeometryError, match="surroundings"):
        sirt(images[0], SCAN, FINE, surroundings=3)
    thin = Grid((1, 4, 5), 0.002, FINE.center_mm)
    with pytest.raises(GeometryError, match="none larger than the region"):
        sirt(images[0], SCAN, thin, surroundings=COARSE)
    images = images[0].copy()
    images[0, 0, 0] = np.nan
    with pytest.raises(GeometryError, match="not finite"):
        sirt(images, SCAN, FINE, surroundings=COARSE)
