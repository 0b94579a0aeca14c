"""The bend of the region of likely parameters, which a covariance does not describe.

Where priors leave directions open, the images tell others very closely. A panel 2 mm aside
moves the object's column by the magnification, of which 0.1 % is unknown: dO_x - dD_x is known
to 0.0002 mm for a given magnification, and changes by 0.002 mm with it. An ellipsoid about
the estimate does not contain the ends of such a region.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.fit.problem import FitProblem
from flexdt.twin.geometry.conventions import FloatArray

MOST_DIRECTIONS: Final = 10
"""Number of directions whose bends are computed, those that are most open."""
LEAST_LENGTH_SIGMAS: Final = 3.0
"""Standard deviations of the positions' noise that one sigma of a direction would move the
images by, were other columns at rest, from which its bend is computed."""


def bend_covariance(
    problem: FitProblem,
    x: FloatArray,
    rows: FloatArray,
    keep: npt.NDArray[np.bool_],
    factor: FloatArray,
    unit_covariance: FloatArray,
    noise: float,
) -> FloatArray:
    """Compute the covariance of the second-order term that a linear fit neglects.

    Of parameters x + sum of a_i u_i, with u_i a root of the covariance and a_i normal, the
    images differ by a_i a_j h_ij / 2 from what is linear. The fit takes it up by
    c_ij = U J' h_ij, so that c = sum of a_i a_j c_ij / 2 varies by half the sum of
    c_ij c_ij'; its mean is in the result, too. A root may be any; here it is of the
    eigenvectors in units of what the images show.

    Args:
        problem: the data.
        x: (p,) column values, internal units.
        rows: (m, p) whitened Jacobian of the used coordinates, edge units.
        keep: (2 n k,) coordinates that are used.
        factor: (p,) edge over internal units.
        unit_covariance: (p, p) in edge units, of unit noise, priors included.
        noise: standard deviation of the whitened residuals.

    Returns:
        (p, p) in edge units; 0 where nothing is open.
    """
    size = np.linalg.norm(rows, axis=0)
    size = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(unit_covariance * np.outer(size, size))
    values = values[-MOST_DIRECTIONS:]
    vectors = vectors[:, -MOST_DIRECTIONS:]
    long = values > LEAST_LENGTH_SIGMAS**2
    root = noise * np.sqrt(values[long]) * vectors[:, long] / size[:, None]
    steps = (root / factor[:, None]).T
    out = np.zeros_like(unit_covariance)
    mean = np.zeros(len(x))
    here = problem.whitened(x).ravel()[keep]
    moved = [problem.whitened(x + step).ravel()[keep] for step in steps]
    gain = unit_covariance @ rows.T
    for i, step in enumerate(steps):
        for j in range(i + 1):
            both = problem.whitened(x + step + steps[j]).ravel()[keep]
            bend = gain @ (both - moved[i] - moved[j] + here)
            share = 0.5 if i == j else 1.0
            out += share * np.outer(bend, bend)
            if i == j:
                mean += 0.5 * bend
    return out + np.outer(mean, mean)
