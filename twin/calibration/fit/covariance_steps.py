"""How the covariance of a fit shrinks as its frames come in."""

from __future__ import annotations

import numpy as np

from flexdt.twin.calibration.fit.fit import LEAST_NOISE, FitResult
from flexdt.twin.calibration.fit.problem import edge_factor
from flexdt.twin.geometry.conventions import FloatArray


def covariance_by_step(fit: FitResult, count: int) -> list[tuple[int, FloatArray | None]]:
    """What the first frames of a fit would know by themselves, with the noise of all.

    Args:
        fit: of n frames.
        count: of steps, evenly spread; 0 gives none.

    Returns:
        (frames, covariance (p, p) of the reported columns in edge units; None where they do not
        determine it), the last with all frames.
    """
    problem = fit.problem
    n, k = problem.seen.shape
    noise = max(LEAST_NOISE, fit.certificate.noise)
    rows = problem.jacobian(fit.solution.x, fit.solution.use)
    rows = np.where(np.repeat(fit.solution.use.ravel(), 2)[:, None], rows, 0.0)
    parts = rows.reshape(n, 2 * k, -1)
    factor = np.array([edge_factor(name) for name in problem.layout.names])
    reported = problem.layout.parameter_count
    out: list[tuple[int, FloatArray | None]] = []
    for frames in np.unique(np.ceil(n * np.arange(1, count + 1) / max(count, 1)).astype(int)):
        some = parts[:frames].reshape(frames * 2 * k, -1)
        told = np.einsum("mi,mj->ij", some, some) + np.diag(problem.prior_weight(noise))
        scale = np.sqrt(np.diag(told))
        matrix = None
        if (scale > 0).all():
            values, vectors = np.linalg.eigh(told / np.outer(scale, scale))
            if values[0] > 1e-12:
                inverse = (vectors / values) @ vectors.T / np.outer(scale, scale)
                matrix = (noise**2 * inverse * np.outer(factor, factor))[:reported, :reported]
        out.append((int(frames), matrix))
    return out
