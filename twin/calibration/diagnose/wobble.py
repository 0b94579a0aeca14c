"""A rotation axis that leans to and fro as the stage turns (wobble), by its harmonics.

A bearing leans the axis by the same angle each time the stage comes to the same angle:
columns of a lean in each frame, times cosine and sine of whole multiples of the angle. A
lean that turns with the stage once a turn is a phantom that leans, which the fit knows
already. A rival is place and angle that do the same together (runout): a wobble is named
where its likelihood exceeds theirs by far.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.calibration.fit.evidence import NAMED_LOG_ODDS
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.fit.fitted_motion import derivative
from flexdt.twin.calibration.fit.residual_structure import MOVING
from flexdt.twin.findings import Finding, error
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import UNITS, to_edge

LEANS: Final = ("axis_tilt_x", "axis_tilt_z")
MAX_REST_SHARE: Final = 0.5
"""Part of the residuals that a wobble may leave: the fit is not repeated with it."""
LEAST_SEEN: Final = 1e-3
"""Part of a lean that the geometry must leave, for it to be told."""
HARMONICS: Final = (1, 2, 3)
TIMES: Final = {1: "once", 2: "twice", 3: "three times"}
LEAST_FRAMES: Final = 12
MOST_FRAMES: Final = 720
"""Least and largest number of frames of which a wobble is looked for."""


class Wave(NamedTuple):
    """Parameters that follow a harmonic of the turn.

    Attributes:
        harmonic: times a turn.
        power: sum of squares of the residuals that they explain.
        size: the largest amplitude of all directions, internal unit.
    """

    harmonic: int
    power: float
    size: float


def wobble(fit: FitResult) -> Finding | None:
    """Name a wobble of the axis that explains the residuals of a fit: halves them.

    Args:
        fit: of one scan, whose residuals nothing else explains.

    Returns:
        An error with the lean's amplitude and harmonic; None if no lean explains them, if
        other parameters do so within odds of exp(NAMED_LOG_ODDS), for several scans, or
        for too few or too many frames.
    """
    problem = fit.problem
    frames = len(problem.seen)
    if problem.group.max() > 0 or not LEAST_FRAMES <= frames <= MOST_FRAMES:
        return None
    use = problem.seen & fit.certificate.used
    kept = np.repeat(use.ravel(), 2)
    x = fit.solution.x
    left = problem.whitened(x)[use]
    before = float(np.square(left).sum())
    basis = np.linalg.qr(problem.jacobian(x, use)[kept])[0]
    free = left.ravel() - basis @ (basis.T @ left.ravel())

    def best_of(names: Sequence[str]) -> Wave:
        """Find the harmonic at which parameters explain most together."""
        waves = [_wave(fit, use, basis, free, names, h) for h in HARMONICS]
        return max(waves, key=lambda wave: wave.power)

    lean = best_of(LEANS)
    rest = before - lean.power
    if not math.sqrt(max(rest, 0.0)) < MAX_REST_SHARE * math.sqrt(before):
        return None
    rival = best_of(MOVING)
    odds = len(free) / 2 * math.log((before - rival.power) / max(rest, 1e-300))
    if odds < NAMED_LOG_ODDS:
        return None
    after_px = fit.certificate.rms_px * math.sqrt(max(rest, 0.0) / before)
    size = f"by {to_edge(LEANS[0], lean.size):.2g} {UNITS[LEANS[0]]} "
    if lean.harmonic == 1:
        # A part of it that turns with the stage is the phantom's own lean: it is not known.
        size = ""
    return error(
        CalibrationCode.WOBBLE,
        f"the rotation axis leans to and fro {size}{TIMES[lean.harmonic]} a turn: the stage "
        f"wobbles; the residuals are {after_px:.2g} px without it",
    )


def _wave(
    fit: FitResult,
    use: npt.NDArray[np.bool_],
    basis: FloatArray,
    free: FloatArray,
    names: Sequence[str],
    harmonic: int,
) -> Wave:
    """Fit parameters that follow a harmonic of the angle to what the geometry leaves.

    Args:
        fit: gives the geometry.
        use: positions that count, (n, k).
        basis: of the geometry's columns, orthonormal, (m, c).
        free: residuals without them, (m,).
        names: of the parameters.
        harmonic: times a turn.
    """
    problem = fit.problem
    count, beads = use.shape
    turn = harmonic * np.asarray(problem.poses.angle)[:, None]
    kept = np.repeat(use.ravel(), 2)
    columns = []
    for name in names:
        slope = derivative(problem, fit.solution.x, name, use).reshape(count, 2 * beads)
        columns += [(slope * shape(turn)).ravel()[kept] for shape in (np.cos, np.sin)]
    table = np.stack(columns, axis=1)
    lengths = np.maximum(np.linalg.norm(table, axis=0), 1e-300)
    table = (table - basis @ (basis.T @ table)) / lengths
    shares = np.linalg.lstsq(table, free, rcond=LEAST_SEEN)[0]
    ellipse = (shares / lengths).reshape(len(names), 2)
    size = float(np.linalg.svd(ellipse, compute_uv=False)[0])
    return Wave(harmonic, float((table @ shares) @ free), size)
