"""What a reconstruction needs of a geometry: axis column, in-plane angle and magnification.

Offsets that trade against each other (a detector aside and an object aside) leave the images as
they are. So these quantities are known far better than the offsets of which they are functions,
and their sigmas need the whole covariance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

import numpy as np
from scipy.special import stdtrit

from flexdt.twin.calibration.fit.certificate import Estimate
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.fit.problem import edge_factor
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses

UNITS: Final[Mapping[str, str]] = {"axis_column": "px", "axis_angle": "deg", "magnification": "1"}
"""axis_column: where the image of the rotation axis crosses the detector's middle row. axis_angle:
of that image against the detector's columns, positive where its upper end leans to the right.
magnification: of a short line parallel to the detector's rows, on the axis at the object's
reference height."""


def image_quantities(fit: FitResult) -> tuple[dict[str, Estimate], ...]:
    """The quantities UNITS describes, in the first frame of each group of frames.

    Args:
        fit: whose estimates are all determined.

    Returns:
        One dictionary for each group. Sigmas follow from the fit's covariance to first order.
    """
    names = list(fit.certificate.estimates)
    factor = np.array([edge_factor(n) for n in names])
    x = fit.solution.x
    t = float(stdtrit(fit.certificate.dof, 0.975))
    out = []
    for group in range(len(fit.group_parameters)):
        here = _at(fit, x, group)
        slopes = []
        for i in range(len(names)):
            step = np.zeros_like(x)
            step[i] = 1e-4 / factor[i]
            ends = _at(fit, x + step, group), _at(fit, x - step, group)
            slopes.append((ends[0] - ends[1]) / 2e-4)
        rows = np.array(slopes).T
        sigma = np.sqrt(np.maximum(np.einsum("qi,ij,qj->q", rows, fit.covariance, rows), 0.0))
        out.append(
            {
                name: Estimate(v, s, v - t * s, v + t * s, unit)
                for (name, unit), v, s in zip(
                    UNITS.items(), here.tolist(), sigma.tolist(), strict=True
                )
            }
        )
    return tuple(out)


def _at(fit: FitResult, x: FloatArray, group: int) -> FloatArray:
    problem = fit.problem
    frame = int(np.flatnonzero(problem.group == group)[0])
    offsets = problem.parameters(x)[group]
    return axis_in_image(problem.poses[frame : frame + 1], offsets, problem.origin[frame])


def axis_in_image(pose: Poses, offsets: Offsets, middle: FloatArray) -> FloatArray:
    """The values of UNITS, in its order, of one pose; `middle` is the detector's centre (column,
    row) [px]."""
    cone = pose.cone_vec(offsets)
    # In the object's frame the axis is vertical and passes through tau (`Poses.cone_vec`).
    foot = np.array([offsets.tau_x, offsets.tau_z, 0.0])
    pixel = float(np.linalg.norm(cone.u[0]))
    along = cone.u[0] / pixel
    points = np.array([foot + [0, 0, 5.0], foot - [0, 0, 5.0], foot + along, foot - along])
    up, down, right, left = cone.project_points(points, (1, 1))[0]
    column = down[0] - down[1] * (up[0] - down[0]) / (up[1] - down[1])
    angle = math.degrees(math.atan2(up[0] - down[0], down[1] - up[1]))
    return np.array([column + middle[0], angle, float(np.linalg.norm(right - left)) / 2 * pixel])
