"""A wrong pixel pitch beside a panel at another distance.

Positions in pixels hang on the distance of the panel over the pitch, so a freed dD_z takes
up a wrong pitch at no cost. Three explanations are compared by their evidence: the panel
is where the machine says, it is elsewhere, or it is there and the pitch is wrong. Unless
the images exclude the pitch (scans at two distances of the panel do), the intervals
contain what it would change.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.special import softmax

from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.calibration.fit.certificate import widened
from flexdt.twin.calibration.fit.evidence import Judged, Table
from flexdt.twin.calibration.fit.fit import FitResult, RivalPitch
from flexdt.twin.calibration.fit.problem import FitProblem, edge_factor
from flexdt.twin.findings import Finding, warning
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import to_internal

DISTANCE: Final = "dD_z"
"""The parameter that takes up a wrong pitch."""
WRONG_PITCH: Final = 0.05
"""Relative standard deviation of a pitch or a distance that is wrong at all; assumed."""
WRONG_CHANCE: Final = 0.1
"""Probability of each of them, before the scan is seen; assumed."""
TOLD_SHARE: Final = 0.1
"""Probability of a wrong pitch from which it is told."""


def with_rival_pitch(
    fit: FitResult, widths: Mapping[str, float]
) -> tuple[FitResult, Finding | None]:
    """Widen the intervals by a wrong pixel pitch that the images do not exclude.

    With a rival pitch the intervals are always widened; the warning comes only if its
    probability is at least `TOLD_SHARE`.

    Args:
        fit: to be reported.
        widths: standard deviation of each offset by the scanners [mm, deg].

    Returns:
        The fit, and a warning; None where a wrong pitch is unlikely. `fit` itself without
        a rival (`rival_pitch`).
    """
    rival = rival_pitch(fit, widths)
    if rival is None:
        return fit, None
    certificate = widened(fit.certificate, rival.open_change)
    fit = replace(fit, certificate=certificate, rival_pitch=rival)
    if rival.share < TOLD_SHARE:
        return fit, None
    pixel = float(np.median(np.linalg.norm(fit.problem.poses.u, axis=1)))
    found = ", ".join(
        f"{n} {e.value:.4g} mm"
        for n, e in certificate.estimates.items()
        if _is_distance(n)
    )
    return fit, warning(
        CalibrationCode.PIXEL_PITCH,
        f"{found} is further off than the scanner's +- {widths[DISTANCE]:g} mm; pixels "
        f"{pixel * (1.0 + rival.growth):.4g} mm wide instead of {pixel:.4g} mm look alike, so the "
        "intervals contain both: measure the panel's distance, or correct the pixel size",
    )


def rival_pitch(fit: FitResult, widths: Mapping[str, float]) -> RivalPitch | None:
    """Find the pixel pitch that would explain the images in place of a freed distance.

    Compared are the distance within the scanners' prior, a distance off by `WRONG_PITCH`
    of the SDD, and a pitch off by as much.

    Args:
        fit: with the distance of the panel free, or with a wider prior than the
            scanners'.
        widths: standard deviation of each offset by the scanners [mm, deg].

    Returns:
        Relative growth of the pitch, change of each parameter and probability; None where
        no distance is free or known, or the images do not separate the columns.
    """
    problem = fit.problem
    names = problem.layout.names
    at = [i for i, name in enumerate(names) if _is_distance(name)]
    known = to_internal(DISTANCE, widths.get(DISTANCE, 0.0))
    free = [i for i in at if problem.prior_sigma[i] > known]
    if not fit.determined or not free or not known > 0.0:
        return None
    judge = _Explanations(fit)
    near = judge.with_widths(free, known)
    elsewhere = judge.with_widths(free, WRONG_PITCH * float(np.median(problem.poses.sdd)))
    wrong = judge.with_widths(free, known, WRONG_PITCH)
    if near is None or elsewhere is None or wrong is None:
        return None
    chances = np.log([1.0 - 2.0 * WRONG_CHANCE, WRONG_CHANCE, WRONG_CHANCE])
    evidence = np.array([near.evidence, elsewhere.evidence, wrong.evidence])
    share = float(softmax(evidence + chances)[2])
    count = problem.layout.parameter_count
    off = (wrong.mean - np.append(elsewhere.mean, 0.0))[:count]
    change = {
        name: float(value) * edge_factor(name)
        for name, value in zip(names[:count], off.tolist(), strict=True)
    }
    return RivalPitch(float(wrong.mean[-1]), change, share)


class _Explanations:
    """The residuals of a fit, its columns, and that of the pixel pitch."""

    def __init__(self, fit: FitResult) -> None:
        """Prepare the whitened Jacobian rows and residuals of a fit's used positions,
        with one more column for the pixel pitch, and the priors of its parameters
        (without one: mean 0).
        """
        problem = fit.problem
        x = fit.solution.x
        use = fit.solution.use
        used_rows = np.repeat(use.ravel(), 2)
        rows = np.column_stack([problem.jacobian(x, use), _pitch_column(problem, x)])
        self._noise = fit.certificate.noise
        left = problem.whitened(x).ravel()[used_rows]
        self._table = Table(rows[used_rows], left, self._noise)
        self._means = np.append(problem.prior_mean - x, 0.0)
        self._means[~np.isfinite(self._means)] = 0.0
        self._widths = problem.prior_sigma

    def with_widths(
        self, distances: list[int], width: float, pitch: float | None = None
    ) -> Judged | None:
        """Judge the residuals with some widths of the priors.

        Args:
            distances: columns of the panel's distance.
            width: standard deviation of their priors [mm].
            pitch: relative standard deviation of the pitch's prior; None: it is right and
                no column.

        Returns:
            The judged model; None if its columns are not separable.
        """
        widths = self._widths.copy()
        widths[distances] = width
        columns = np.arange(len(widths) + (pitch is not None))
        if pitch is not None:
            widths = np.append(widths, pitch)
        return self._table.judged(
            columns.tolist(), widths, self._noise, self._means[columns]
        )


def _pitch_column(problem: FitProblem, x: FloatArray) -> FloatArray:
    """Compute whitened shifts of the positions for a unit change of the logarithm of the
    pixel pitch: towards the panel's centre.

    Args:
        problem: the data.
        x: column values, internal units.

    Returns:
        (2 n k,), of unused positions as well.
    """
    predicted = problem.residuals(x)[0] - problem.origin[:, None, :]
    w = problem.whiten
    across = predicted[..., 0]
    down = predicted[..., 1]
    shifts = np.stack([w[..., 0] * across + w[..., 1] * down, w[..., 2] * down], axis=-1)
    return np.asarray(-shifts.ravel())


def _is_distance(column: str) -> bool:
    return column.split("@")[0] == DISTANCE
