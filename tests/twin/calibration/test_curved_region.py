"""The bent region of likely parameters, by products of normal numbers in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import chdtri

from flexdt.twin.calibration.fit.curved_region import Bend

NOISE = 1e-4
"""Standard deviation of the third column, beside products of order 1."""


def product(seen: int) -> tuple[Bend, np.ndarray, np.ndarray]:
    """Two normal numbers and their product, of which the first `seen` and the last column are
    given: a panel aside, a magnification, and by how much both move an axis.

    Returns:
        The bend, the covariance of the given columns, 2000 points of them.
    """
    rng = np.random.default_rng(3)
    directions = np.array([[2.0, 0.0], [0.0, 1e-3], [0.0, 0.0]])
    second = np.zeros((2, 2, 3))
    second[0, 1, 2] = second[1, 0, 2] = 1.0
    bend = Bend(directions, second)
    a = rng.normal(size=(2000, 2))
    third = a[:, 0] * a[:, 1] + NOISE * rng.normal(size=2000)
    points = np.column_stack([2.0 * a[:, 0], 1e-3 * a[:, 1], third])
    spread = np.diag([2.0, 1e-3, NOISE]) ** 2
    at = [*range(seen), 2]
    return bend, spread[np.ix_(at, at)], points[:, at]


@pytest.mark.parametrize("seen", [1, 2])
def test_products_are_inside_as_often_as_stated(seen: int) -> None:
    """Also where the second factor, a magnification say, is no given column."""
    bend, covariance, points = product(seen)
    at = [*range(seen), 2]
    squares = np.array([bend.distance2(point, at, covariance) for point in points])
    for share in (0.5, 0.9, 0.95, 0.99):
        inside = np.mean(squares < chdtri(len(at), 1 - share))
        assert inside == pytest.approx(share, abs=4 * np.sqrt(share * (1 - share) / 2000))


def test_the_covariance_of_a_product_has_too_thin_tails() -> None:
    """What stood here before: a tenth of the points that it excludes at 1 in 10 000."""
    bend, covariance, points = product(2)
    widened = covariance + np.diag([0.0, 0.0, 1.0])
    flat = np.einsum("np,pq,nq->n", points, np.linalg.inv(widened), points)
    limit = chdtri(3, 1 - 0.9999)
    bent = [bend.distance2(point, [0, 1, 2], covariance) for point in points]
    assert np.mean(flat > limit) > 10 * 1e-4
    assert np.mean(np.array(bent) > limit) < 10 * 1e-4


def test_without_a_bend_it_is_the_distance_of_mahalanobis() -> None:
    rng = np.random.default_rng(4)
    root = rng.normal(size=(4, 4))
    covariance = root @ root.T
    off = rng.normal(size=4)
    expected = off @ np.linalg.solve(covariance, off)
    assert Bend.none(4).distance2(off, range(4), covariance) == pytest.approx(expected)
    straight = Bend(root[:, :2], np.zeros((2, 2, 4)))
    assert straight.distance2(off, range(4), covariance) == pytest.approx(
        expected, rel=1e-6
    )


def test_directions_that_are_longer_than_the_covariance_are_shortened() -> None:
    covariance = np.diag([1.0, 4.0])
    longer = Bend(np.array([[1.5], [0.0]]), np.zeros((1, 1, 2)))
    off = np.array([0.7, -3.0])
    expected = 0.7**2 + 3.0**2 / 4.0
    assert longer.distance2(off, [0, 1], covariance) == pytest.approx(expected, rel=1e-6)
