"""The bend of the region of likely parameters, which a covariance does not describe.

Where priors leave directions open, the images tell others very closely. A panel 2 mm aside
moves the object's column by the magnification, of which 0.1 % is unknown: dO_x - dD_x is known
to 0.0002 mm for a given magnification, and changes by 0.002 mm with it. An ellipsoid about
the estimate does not contain the ends of such a region.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from flexdt.twin.calibration.fit.residual_structure import Residuals
from flexdt.twin.geometry.conventions import FloatArray

MOST_DIRECTIONS: Final = 10
"""Number of directions whose bends are computed, those that are most open."""
LEAST_LENGTH_SIGMAS: Final = 3.0
"""Standard deviations of the positions' noise that one sigma of a direction would move the
images by, were other columns at rest, from which its bend is computed."""
ROUNDING: Final = 1e-14
"""Least share of a column's variance that the directions leave, below which it is rounding."""


@dataclass(frozen=True, eq=False)
class Bend:
    """Curvature of the region of likely parameters, in its k most open directions.

    Attributes:
        directions: (p, k) change of the p reported columns by one standard deviation of each
            direction, edge units.
        second: (k, k, p) second derivatives of the columns along the region, edge units.
    """

    directions: FloatArray
    second: FloatArray

    @classmethod
    def none(cls, reported: int) -> Bend:
        """Return that of a region of `reported` columns without a bend."""
        return cls(np.zeros((reported, 0)), np.zeros((0, 0, reported)))

    def distance2(
        self, off: FloatArray, at: Sequence[int], covariance: FloatArray
    ) -> float:
        """Compute the squared distance of a point from the estimate in the bent region.

        A point is where the estimate is, plus D a + sum of second_ij a_i a_j / 2, with
        a = N(0, 1) along the directions D, plus what is left of the covariance. The distance
        is that of the likeliest a; without a bend it is Mahalanobis'.

        Args:
            off: (m,) point minus estimate in the given columns, edge units.
            at: (m,) indices of the given columns.
            covariance: (m, m) of the given columns without the bend.
        """
        from scipy.optimize import least_squares

        if not len(self.second):
            return float(off @ np.linalg.solve(covariance, off))
        size = np.sqrt(np.diag(covariance))
        root = np.linalg.cholesky(covariance / np.outer(size, size)) * size[:, None]
        # Where the covariance is narrower than the directions, they are shortened.
        along, lengths, turn = np.linalg.svd(
            np.linalg.solve(root, self.directions[at]), full_matrices=False
        )
        shorter = (turn.T * 1.0 / np.maximum(lengths, 1.0)) @ turn
        lengths = np.minimum(lengths, 1.0)
        directions = root @ (along * lengths) @ turn
        second = np.einsum("ki,lj,klp->ijp", shorter, shorter, self.second[:, :, at])
        # What the covariance holds beside the directions, which may be almost nothing.
        rest = np.eye(len(off)) - (along * lengths**2) @ along.T
        values, vectors = np.linalg.eigh(rest)
        values = np.maximum(values, ROUNDING)
        whiten = (vectors / np.sqrt(values)).T @ np.linalg.inv(root)

        def whitened(a: FloatArray) -> FloatArray:
            bend = 0.5 * np.einsum("i,j,ijp->p", a, a, second)
            return np.concatenate([a, whiten @ (off - directions @ a - bend)])

        def slope(a: FloatArray) -> FloatArray:
            along = directions + np.einsum("j,ijp->pi", a, second)
            return np.concatenate([np.eye(len(a)), -whiten @ along])

        begin = directions.T @ np.linalg.solve(covariance, off)
        found = least_squares(whitened, begin, slope)
        return float(2.0 * found.cost)


def bend_of(left: Residuals, x: FloatArray, factor: FloatArray, reported: int) -> Bend:
    """Compute the second-order term of the region that a linear fit neglects.

    Of parameters x + sum of a_i u_i, with u_i a root of the covariance and a_i normal, the
    images differ by a_i a_j h_ij / 2 from what is linear. The fit takes it up by
    c_ij = -U J' h_ij. A root may be any; here it is of the eigenvectors in units of what the
    images show.

    Args:
        left: residuals at `x`, with their derivatives, covariance and noise.
        x: (p,) column values, internal units.
        factor: (p,) edge over internal units.
        reported: number of the first columns, which are returned.

    Returns:
        The bend of the reported columns; without directions where nothing is open.
    """
    problem = left.problem
    keep = left.keep
    unit_covariance = left.unit_covariance
    size = np.linalg.norm(left.jacobian, axis=0)
    size = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(unit_covariance * np.outer(size, size))
    values = values[-MOST_DIRECTIONS:]
    vectors = vectors[:, -MOST_DIRECTIONS:]
    long = values > LEAST_LENGTH_SIGMAS**2
    root = left.noise * np.sqrt(values[long]) * vectors[:, long] / size[:, None]
    steps = (root / factor[:, None]).T
    moved = [problem.whitened(x + step).ravel()[keep] for step in steps]
    gain = (unit_covariance @ left.jacobian.T)[:reported]
    second = np.zeros((len(steps), len(steps), reported))
    for i, step in enumerate(steps):
        for j in range(i + 1):
            # A mixed difference over one sigma of each: the bend within the region that is
            # stated, rather than a derivative at its middle.
            both = problem.whitened(x + step + steps[j]).ravel()[keep]
            bend = gain @ (both - moved[i] - moved[j] + left.values)
            second[i, j] = bend
            second[j, i] = bend
    return Bend(root[:reported], second)
