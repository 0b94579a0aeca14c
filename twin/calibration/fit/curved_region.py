"""The bend of the region of likely parameters, which a covariance does not describe.

Where priors leave directions open, the images tell others very closely. A panel 2 mm aside
moves the object's column by the magnification, of which 0.1 % is unknown: dO_x - dD_x is known
to 0.0002 mm for a given magnification, and changes by 0.002 mm with it. An ellipsoid about
the estimate does not contain the ends of such a region.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from flexdt.twin.calibration.fit.residual_structure import Residuals
from flexdt.twin.geometry.conventions import FloatArray

MOST_DIRECTIONS: Final = 10
"""Number of directions whose bends are computed, those that are most open."""
LEAST_LENGTH_SIGMAS: Final = 3.0
"""Standard deviations of the positions' noise that one sigma of a direction would move the
images by, were other columns at rest, from which its bend is computed."""


def bend_covariance(
    left: Residuals, x: FloatArray, factor: FloatArray, reported: int
) -> FloatArray:
    """Compute the covariance of the second-order term that a linear fit neglects.

    Of parameters x + sum of a_i u_i, with u_i a root of the covariance and a_i normal, the
    images differ by a_i a_j h_ij / 2 from what is linear. The fit takes it up by
    c_ij = U J' h_ij, so that c = sum of a_i a_j c_ij / 2 varies by half the sum of
    c_ij c_ij'; its mean is in the result, too. A root may be any; here it is of the
    eigenvectors in units of what the images show.

    Args:
        left: residuals at `x`, with their derivatives, covariance and noise.
        x: (p,) column values, internal units.
        factor: (p,) edge over internal units.
        reported: number of the first columns, which are returned.

    Returns:
        (reported, reported) in edge units; 0 where nothing is open.
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
    out = np.zeros_like(unit_covariance)
    mean = np.zeros(len(x))
    moved = [problem.whitened(x + step).ravel()[keep] for step in steps]
    gain = unit_covariance @ left.jacobian.T
    for i, step in enumerate(steps):
        for j in range(i + 1):
            both = problem.whitened(x + step + steps[j]).ravel()[keep]
            bend = gain @ (both - moved[i] - moved[j] + left.values)
            share = 0.5 if i == j else 1.0
            out += share * np.outer(bend, bend)
            if i == j:
                mean += 0.5 * bend
    return np.asarray((out + np.outer(mean, mean))[:reported, :reported])
