"""What causes leave open: the covariance of a fit, widened by likely choices of causes."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from flexdt.twin.calibration.diagnose.causes.candidates import Candidates
from flexdt.twin.calibration.diagnose.causes.cause import Choice
from flexdt.twin.calibration.fit.certificate import Rival, widened
from flexdt.twin.calibration.fit.evidence import Judged
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.fit.problem import edge_factors
from flexdt.twin.calibration.fit.residual_structure import larger
from flexdt.twin.geometry.conventions import FloatArray

LEAST_REST: Final = 1e-3
"""Part of a variance that is left where a rival explanation knows more."""
LEAST_RANK: Final = 1e-12
"""Part of a variance that is added against rounding."""


def widened_by_causes(
    fit: FitResult, candidates: Candidates, choice: Choice
) -> FitResult:
    """Add the differences between likely choices to the covariance of a fit; never
    narrows it.

    Where the images speak for a cause, the mean square is no less than that with it: how
    probable it is without them is assumed, and may be wrong.

    Args:
        fit: with the causes of `choice`, and the places of beads that it leaves open.
        candidates: all causes, judged.
        choice: the most likely one.

    Returns:
        The fit with a wider certificate; itself if the choices agree.
    """
    own, more, likely, wider = left_open(candidates, choice)
    if len(likely) == 1 and own is candidates.judged(next(iter(likely))):
        return fit
    factor = edge_factors(fit.problem.layout.names[: candidates.count])
    unit = np.outer(factor, factor)
    certificate = fit.certificate
    apart = tuple(
        Rival(
            rival.weight,
            rival.off * factor,
            _changed(certificate.covariance, rival.covariance * unit + wider),
        )
        for rival in candidates.rivals(likely, own)
    )
    return replace(fit, certificate=replace(widened(certificate, more), rivals=apart))


def left_open(
    candidates: Candidates, choice: Choice
) -> tuple[Judged, FloatArray, dict[Choice, float], FloatArray]:
    """Compute what likely choices add to the covariance of the fit with the causes of one,
    and the places of beads that it leaves open.

    Args:
        candidates: all causes, judged.
        choice: the most likely one.

    Returns:
        The model of the fit; the addition, (p, p), edge units; likely choices and their
        probabilities; and the change of the covariance of each choice, (p, p), edge units.
    """
    likely = candidates.likely(choice)
    own = candidates.fitted(candidates.with_open_places(choice))
    at = own.covariance(candidates.count)
    factor = edge_factors(candidates.problem.layout.names[: candidates.count])
    unit = np.outer(factor, factor)
    rivals = candidates.rivals(likely, own)
    square = np.array([r.covariance + np.outer(r.off, r.off) for r in rivals])
    mean = np.tensordot(list(likely.values()), square, 1)
    wide = mean
    for given in candidates.spoken_for(likely):
        wide = larger(wide, np.tensordot(given, square, 1))
    values, vectors = np.linalg.eigh((wide - at) * unit)
    more = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return own, more, likely, (wide - mean - at) * unit


def _changed(covariance: FloatArray, change: FloatArray) -> FloatArray:
    """Add a change, (p, p), to a covariance (p, p), of which at least `LEAST_REST` is left
    in every direction.
    """
    size = np.sqrt(np.diag(covariance))
    # Of exact positions it is the priors' alone and of lower rank.
    scaled = covariance / np.outer(size, size) + LEAST_RANK * np.eye(len(size))
    root = np.linalg.cholesky(scaled) * size[:, None]
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ change @ inverse.T)
    whole = root @ vectors
    return np.asarray((whole * np.maximum(1.0 + values, LEAST_REST)) @ whole.T)
