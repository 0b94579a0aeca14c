"""Forecast of the uncertainty of a fit before there are data.

It is the Cramer-Rao bound of the reprojection residuals at the planned geometry.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.bead_model import BeadModel, spot_radii
from flexdt.twin.calibration.fit.certificate import Conditioning, spectrum
from flexdt.twin.calibration.fit.fit import IN_IMAGES, image_slopes
from flexdt.twin.calibration.fit.problem import FitProblem
from flexdt.twin.calibration.fit.weak_directions import BOUND
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.geometry.poses import Poses


@dataclass(frozen=True, eq=False)
class Forecast:
    """The forecast of a problem's data, with its priors.

    Attributes:
        sigmas: requested column -> standard deviation, edge units; inf: not determined.
        image_sigmas: of IN_IMAGES.
        covariance: (p, p) of the requested columns, edge units.
        spectrum: rank, condition, null and weak directions of the requested columns.
    """

    sigmas: dict[str, float]
    image_sigmas: dict[str, float]
    covariance: FloatArray
    spectrum: Conditioning


def forecast(
    problem: FitProblem, bound: float = BOUND, more: FloatArray | None = None
) -> Forecast:
    """Predict the certificate of a fit to the data of a problem, at its start, for
    whitened residuals of spread 1.

    With nuisance parameters (priors, strain), rank and condition are of the asked ones,
    all else given.

    Args:
        problem: the planned data, with priors.
        bound: as of `identifiability`.
        more: (p, p) covariance of all columns that are parameters, edge units, that a
            calibration adds to that of the fit; None: nothing.

    Returns:
        Sigmas of the asked parameters and those in images (infinite where not determined,
        the latter together), covariance and spectrum.
    """
    names = problem.layout.names
    count = problem.layout.asked
    reported = problem.layout.parameter_count
    seen = int(problem.seen.any(axis=0).sum())
    rows = np.concatenate(
        [problem.jacobian(problem.start), np.diag(1.0 / problem.prior_sigma)]
    )
    spec = spectrum(rows, names, seen, reported=count, bound=bound)
    strained = problem.layout.strain_columns
    if count < reported or strained.start < strained.stop:
        # Rank and condition say what the images tell of what was asked for, all else given.
        nuisance = {*range(count, reported), *range(strained.start, strained.stop)}
        given = [i for i in range(len(names)) if i not in nuisance]
        alone = spectrum(rows[:, given], [names[i] for i in given], seen, reported=count)
        rank = min(alone.rank, len(given) - len(spec.null))
        unit = spec.unit_covariance
        spec = replace(alone, unit_covariance=unit, rank=rank, null=spec.null)
    whole = spec.unit_covariance[:reported, :reported]
    if more is not None:
        whole = whole + more
    covariance = whole[:count, :count]
    sigmas = dict(zip(names[:count], np.sqrt(np.diag(covariance)).tolist(), strict=True))
    images = dict.fromkeys(IN_IMAGES, math.inf)
    if np.isfinite(whole).all():
        slopes = image_slopes(problem, problem.start, 0)[1]
        variance = np.einsum("qi,ij,qj->q", slopes, whole, slopes)
        images = dict(
            zip(IN_IMAGES, np.sqrt(np.maximum(variance, 0.0)).tolist(), strict=True)
        )
    return Forecast(sigmas, images, covariance, spec)


def visible_beads(
    model: BeadModel, poses: Poses, shape: FloatArray, at: Offsets = NOMINAL
) -> npt.NDArray[np.bool_]:
    """Mark beads whose spots are entirely on the detector.

    Args:
        model: the beads.
        poses: n frames.
        shape: (n, 2) detector (rows, cols) of each frame.
        at: geometry offsets.

    Returns:
        (n, k) bool; False too for beads behind the source.
    """
    cone = poses.cone_vec(at)
    pixels = cone.project_points(model.beads, (1, 1))
    radius = spot_radii(model, cone)
    half = shape[:, None, ::-1] / 2
    inside = (np.abs(pixels) + radius[..., None] <= half).all(axis=2)
    return np.asarray(inside & (radius > 0))
