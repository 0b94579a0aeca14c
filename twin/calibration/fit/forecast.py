"""Forecast of the uncertainty of a fit before there are data.

It is the Cramer-Rao bound of the reprojection residuals at the planned geometry.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Final

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

MOST: Final = 0.8
"""Part of the scans whose sigmas are within the range of a forecast."""
FIRST_ORDER: Final = 0.005
"""Relative error of a sigma that is computed to first order; ranges are wider by it."""


@dataclass(frozen=True, eq=False)
class Stated:
    """What m scans state.

    Attributes:
        covariances: (m, p, p) of all columns that are parameters, edge units.
        image_variances: (m, 3) of IN_IMAGES.
    """

    covariances: FloatArray
    image_variances: FloatArray


@dataclass(frozen=True, eq=False)
class Forecast:
    """The forecast of a problem's data, with its priors.

    Attributes:
        sigmas: requested column -> standard deviation, edge units; inf: not determined.
        image_sigmas: of IN_IMAGES.
        covariance: (p, p) of the requested columns, edge units.
        spectrum: rank, condition, null and weak directions of the requested columns.
        ranges: requested column or one of IN_IMAGES -> least and largest of the sigmas that
            `MOST` of the scans state; empty for a fit alone.
    """

    sigmas: dict[str, float]
    image_sigmas: dict[str, float]
    covariance: FloatArray
    spectrum: Conditioning
    ranges: dict[str, tuple[float, float]] = field(default_factory=dict)


def forecast(
    problem: FitProblem, bound: float = BOUND, stated: Stated | None = None
) -> Forecast:
    """Predict the certificate of a fit to the data of a problem, at its start, for
    whitened residuals of spread 1.

    With nuisance parameters (priors, strain), rank and condition are of the asked ones,
    all else given.

    Args:
        problem: the planned data, with priors.
        bound: as of `identifiability`.
        stated: by scans of the plan; None: the fit alone.

    Returns:
        Sigmas of the asked parameters and those in images (infinite where not determined,
        the latter together), covariance and spectrum. Of several scans the medians of the
        sigmas, with the correlation of the mean.
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
    if stated is None:
        every = whole[None]
        felt = np.full((1, len(IN_IMAGES)), math.inf)
        if np.isfinite(whole).all():
            slopes = image_slopes(problem, problem.start, 0)[1]
            felt = np.einsum("qi,mij,qj->mq", slopes, every, slopes)
    else:
        every = stated.covariances
        felt = stated.image_variances
    sigmas = np.sqrt(np.diagonal(every[:, :count, :count], axis1=1, axis2=2))
    images = np.sqrt(np.maximum(felt, 0.0))
    middle = np.median(sigmas, axis=0)
    covariance = every.mean(axis=0)[:count, :count]
    ranges = {}
    if stated is not None:
        share = middle / np.sqrt(np.diag(covariance))
        covariance = covariance * np.outer(share, share)
        ranges = _ranges(names[:count], sigmas) | _ranges(IN_IMAGES, images)
    return Forecast(
        dict(zip(names[:count], middle.tolist(), strict=True)),
        dict(zip(IN_IMAGES, np.median(images, axis=0).tolist(), strict=True)),
        covariance,
        spec,
        ranges,
    )


def _ranges(names: Iterable[str], sigmas: FloatArray) -> dict[str, tuple[float, float]]:
    """Find between which values one more scan's sigma lies in `MOST` of all cases.

    Of m scans (m, q) and one more, each order is as likely as any other. What is nearly
    certain lies there more often, for `FIRST_ORDER`.
    """
    ordered = np.sort(sigmas, axis=0)
    cut = round((1.0 - MOST) / 2.0 * (len(sigmas) + 1))
    low = ordered[cut - 1] / (1.0 + FIRST_ORDER)
    high = ordered[-cut] * (1.0 + FIRST_ORDER)
    ends = zip(low.tolist(), high.tolist(), strict=True)
    return dict(zip(names, ends, strict=True))


def visible_beads(
    model: BeadModel, poses: Poses, shape: FloatArray, at: Offsets = NOMINAL
) -> npt.NDArray[np.bool_]:
    """Mark beads whose spots are entirely on the detector.

    `model`: the beads; `poses`: n frames; `shape`: (n, 2) detector (rows, cols) of each frame;
    `at`: geometry offsets.
    Returns (n, k) bool; False too for beads behind the source.
    """
    cone = poses.cone_vec(at)
    pixels = cone.project_points(model.beads, (1, 1))
    radius = spot_radii(model, cone)
    half = shape[:, None, ::-1] / 2
    inside = (np.abs(pixels) + radius[..., None] <= half).all(axis=2)
    return np.asarray(inside & (radius > 0))
