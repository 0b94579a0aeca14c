"""Certificates that scans of a plan will state, before there is one.

What a calibration states depends on the noise: a cause that the noise looks like stays open
and is stated. Scans of the plan are drawn (noise, strain of the phantom and offsets within their
priors), to first order, and go through the posterior that a calibration's go through.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from flexdt.twin.calibration.diagnose.table.group import Known
from flexdt.twin.calibration.diagnose.table.groups import every_family, strain
from flexdt.twin.calibration.diagnose.table.linearised import (
    Linearised,
    State,
    with_every_column,
)
from flexdt.twin.calibration.diagnose.table.posterior import Search
from flexdt.twin.calibration.fit.fit import image_slopes
from flexdt.twin.calibration.fit.forecast import Stated
from flexdt.twin.calibration.fit.problem import FitProblem, edge_factors
from flexdt.twin.geometry.conventions import FloatArray

DRAWS: Final = 39
"""Number of scans that are drawn."""
SEED: Final = 39


def foreseen(problem: FitProblem, known: Known) -> Stated:
    """Draw what scans of a plan state; the same in every call.

    The fit is linearised where a scanner and a phantom are (small offsets turn the image of
    the axis by more than it is known), what causes add at the plan.

    Args:
        problem: planned, with its positions as predicted at the start; their whitened errors
            have spread 1.
        known: statements on the phantom and the positions.

    Returns:
        `DRAWS` scans.
    """
    rng = np.random.default_rng(SEED)
    _, x = with_every_column(problem, problem.start)
    still = State(x, {}, np.zeros((*problem.seen.shape, 2)))
    table = Linearised(problem, still, known.floor)
    families = every_family(table, known)
    bases = [table.geometry]
    widths = [np.where(table.precision > 0, table.precision, np.inf) ** -0.5]
    shape: list[int] = []
    for family in families:
        if family.always and family.rows is not None:
            bases.append(family.rows[0])
            widths.append(np.full(family.rows.shape[2], family.always))
            if family.cause == strain.NAME:
                first = sum(map(len, widths[:-1]))
                shape += range(first, first + family.rows.shape[2])
    base = np.concatenate(bases, axis=1)
    spread = np.concatenate(widths)
    drawn = spread[:, None] * rng.normal(size=(len(spread), DRAWS))
    noise = (
        rng.normal(size=(len(base), DRAWS)) * np.repeat(table.weight.ravel(), 2)[:, None]
    )
    search = Search(table, families, 0.0, base @ drawn + noise)
    search.keep_shapes()
    count = table.parameters
    factor = edge_factors(problem.layout.names)
    unit = np.outer(factor[:count], factor[:count])
    precision = np.diag(1.0 / (problem.prior_sigma * factor) ** 2)
    keep = np.repeat(problem.seen.ravel(), 2)
    columns = [
        *range(count),
        *range(len(problem.layout.names))[problem.layout.strain_columns],
    ]
    sources = [*range(count), *shape[: len(columns) - count]]
    slopes = image_slopes(problem, problem.start, 0)[1]
    covariances = []
    images = []
    for number in range(DRAWS):
        search.draw(number)
        model = search.model({}, 1.0)
        posterior = search.mixture(model, search.further(model))
        mean = model.solved.mean[:count]
        wide = sum(
            p.weight * (p.covariance + np.outer(p.mean - mean, p.mean - mean))
            for p in posterior.parts
        )
        more = (np.asarray(wide) - model.solved.covariance[:count, :count]) * unit
        there = problem.start
        there[columns] += drawn[sources, number]
        rows: FloatArray = problem.jacobian(there)[keep] / factor
        told = rows.T @ rows / model.noise2
        here = np.linalg.inv(told + precision)[:count, :count]
        turned = image_slopes(problem, there, 0)[1]
        covariances.append(here + more)
        images.append(
            np.einsum("qi,ij,qj->q", turned, here, turned)
            + np.einsum("qi,ij,qj->q", slopes, more, slopes)
        )
    return Stated(np.array(covariances), np.array(images))
