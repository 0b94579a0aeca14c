"""The operator against an explicit matrix, whose entries an independent Siddon computes, in
numpy, SciPy and what hands out memory by DLPack.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse.linalg import lsqr

from flexdt.twin.errors import GeometryError, LimitError, NotBuiltError
from flexdt.twin.projection import Operator, Volume
from flexdt.twin.reconstruction import Grid

SHAPE = (5, 6)
LIKE = Volume(np.zeros((2, 3, 4)), (1.0, 1.2, 0.9), (0.3, -0.2, 0.1))


def matrix_of(siddon, scan) -> np.ndarray:
    """(pixels, voxels), column by column."""
    columns = []
    for unit in np.eye(24).reshape(24, 2, 3, 4):
        columns.append(siddon(unit, LIKE.voxel_xyz, LIKE.center_mm, scan, SHAPE).ravel())
    return np.array(columns).T


@pytest.fixture(scope="module")
def scan(circle):
    return circle(
        5, 20, 40, 1.3, roll=0.1, pitch_tilt=0.05, yaw=-0.07, start=0.2, height=1.0
    )


@pytest.fixture(scope="module")
def matrix(siddon, scan):
    return matrix_of(siddon, scan)


@pytest.fixture(autouse=True)
def one_thread(one_thread_only):
    """Waking threads would take longer than these small projections."""


@pytest.fixture
def operator(scan):
    return Operator(scan, LIKE, SHAPE)


def test_operator_and_transpose_are_the_matrix(operator, matrix):
    rng = np.random.default_rng(1)
    x, y = rng.normal(size=(2, 3, 4)), rng.normal(size=(5, *SHAPE))
    image, spread = operator @ x, operator.T @ y
    assert image.dtype == spread.dtype == np.float32
    assert image.shape == operator.image_shape
    assert spread.shape == operator.voxel_shape
    np.testing.assert_allclose(image.ravel(), matrix @ x.ravel(), atol=1e-5)
    np.testing.assert_allclose(
        spread.ravel(), matrix.T @ y.ravel(), atol=1e-5 * np.abs(spread).max()
    )
    assert np.array_equal(operator.T.T @ LIKE.like(x), image)
    spread += 1.0  # a result belongs to the caller
    assert (
        repr(operator)
        == "<Operator: 2 x 3 x 4 voxels to 5 views of 5 x 6 pixels (rows x columns)>"
    )
    assert repr(operator.T) == repr(operator) + ".T"


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3, 1e-5])
def test_the_norm_is_the_largest_singular_value(operator, matrix, tolerance):
    wanted = np.linalg.norm(matrix, 2)
    assert wanted * (1 - tolerance) <= operator.norm(tolerance) <= wanted * (1 + 1e-6)


def test_a_norm_beyond_single_precision(operator):
    with pytest.raises(LimitError, match="tolerance is 1e-09; allowed: 1e-05 to 1"):
        operator.norm(1e-9)
    with pytest.raises(LimitError, match="tolerance is 1; "):
        operator.norm(1.0)


def test_an_operator_whose_rays_miss_the_grid(scan):
    assert Operator(scan, Grid((2, 2, 2), 1.0, (0.0, 0.0, 500.0)), SHAPE).norm() == 0.0


def test_lsqr_solves_least_squares(operator, matrix):
    data = np.random.default_rng(2).normal(size=operator.image_shape)
    wanted = np.linalg.lstsq(matrix, data.ravel(), rcond=None)[0]
    found = lsqr(operator.linear_operator(), data.ravel(), atol=1e-7, btol=1e-7)[0]
    np.testing.assert_allclose(found, wanted, atol=1e-4 * np.abs(wanted).max())


def test_derivatives_are_those_of_the_functions(operator, siddon, scan):
    """Along one direction; tests of the derivatives themselves: test_projection_gradient.py."""
    rng = np.random.default_rng(3)
    x, change = rng.uniform(size=(2, 3, 4)), rng.normal(size=(5, 12))
    weights = rng.normal(size=operator.image_shape)
    grid = (x, LIKE.voxel_xyz, LIKE.center_mm)
    high, low = (
        siddon(*grid, type(scan)(scan.rows + s * change), SHAPE) for s in (1e-6, -1e-6)
    )
    slope = (high - low) / 2e-6
    np.testing.assert_allclose(
        operator.change(x, change), slope, atol=1e-3 * np.abs(slope).max()
    )
    found = float(np.vdot(operator.gradient(LIKE.like(x), weights), change))
    assert found == pytest.approx(float(np.vdot(weights, slope)), rel=1e-3)


class Foreign:
    """An array of another library, as far as one needs to know it."""

    def __init__(self, array: np.ndarray, device: int = 1) -> None:
        self.array, self._device = array, device

    def __dlpack__(self, **options: object) -> object:
        return self.array.__dlpack__(**options)

    def __dlpack_device__(self) -> tuple[int, int]:
        return self._device, 0

    def __array_namespace__(self) -> object:
        return Foreign

    @staticmethod
    def from_dlpack(array: np.ndarray) -> Foreign:
        return Foreign(np.from_dlpack(array))


@pytest.mark.usefixtures("on_processor")
def test_arrays_of_other_libraries_come_back_as_such(operator):
    x = np.random.default_rng(4).normal(size=(2, 3, 4)).astype(np.float32)
    image = operator @ Foreign(x)
    assert isinstance(image, Foreign)
    assert np.array_equal(image.array, operator @ x)
    assert np.array_equal((operator.T @ image).array, operator.T @ image.array)
    with pytest.raises(NotBuiltError, match="memory of a device"):
        operator @ Foreign(x, device=2)


def test_grids_and_shapes_that_do_not_fit(operator, scan):
    grid = Grid((2, 3, 4), 1.0)
    assert Operator(scan, grid, SHAPE).voxel_shape == (2, 3, 4)
    carried = Operator(scan.with_shape(SHAPE), grid)
    assert carried.image_shape == (5, *SHAPE)
    with pytest.raises(GeometryError, match="this geometry is of a detector of"):
        Operator(carried.geometry, grid, (3, 3))
    with pytest.raises(GeometryError, match="shape is not known"):
        Operator(scan.rows, grid)
    with pytest.raises(GeometryError, match=r"2 x 3; allowed: 2 x 3 x 4"):
        operator @ np.zeros((2, 3))
    with pytest.raises(GeometryError, match="allowed: the operator's grid"):
        operator @ Volume(np.zeros((2, 3, 4)), 1.0)
    with pytest.raises(GeometryError, match="projections of shape 24;"):
        operator.T @ np.zeros(24)
