"""A rotation axis that leans to and fro as the stage turns (wobble), by its harmonics.

A bearing leans the axis by the same angle each time the stage comes to the same angle:
columns of a lean in each frame, times cosine and sine of whole multiples of the angle. A
lean that turns with the stage once a turn is a phantom that leans, which the fit knows
already. A rival is any other parameter that does the same at the same multiple (runout),
or the two together: a wobble is named where its likelihood exceeds theirs.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.diagnose import Finding, error
from flexdt.twin.calibration.diagnose.causes import NAMED_LOG_ODDS
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.fit.fitted_motion import derivative
from flexdt.twin.calibration.fit.residual_structure import MOVING
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import UNITS, to_edge

LEANS: Final = ("axis_tilt_x", "axis_tilt_z")
HARMONICS: Final = (1, 2, 3)
TIMES: Final = {1: "once", 2: "twice", 3: "three times"}
MIN_FRAMES: Final = 12
MOST_FRAMES: Final = 720
"""Frames from and up to which a wobble is looked for."""


class Wave(NamedTuple):
    """A parameter that follows a harmonic of the turn.

    Attributes:
        name: of the parameter.
        harmonic: times a turn.
        power: sum of squares of the residuals that it explains.
        size: its amplitude, internal unit.
    """

    name: str
    harmonic: int
    power: float
    size: float


def wobble(fit: FitResult, limit_px: float) -> Finding | None:
    """Name a wobble of the axis that explains the residuals of a fit.

    Args:
        fit: of one scan, whose residuals nothing else explains.
        limit_px: residual up to which they are explained.

    Returns:
        An error with the lean's amplitude and harmonic; None if no lean explains them, if
        another parameter does so within odds of exp(NAMED_LOG_ODDS), for several scans, or
        for too few or too many frames.
    """
    problem = fit.problem
    frames = len(problem.seen)
    if problem.group.max() > 0 or not MIN_FRAMES <= frames <= MOST_FRAMES:
        return None
    use = problem.seen & fit.certificate.used
    kept = np.repeat(use.ravel(), 2)
    x = fit.solution.x
    left = problem.whitened(x)[use]
    before = float(np.square(left).sum())
    basis = np.linalg.qr(problem.jacobian(x, use)[kept])[0]
    free = left.ravel() - basis @ (basis.T @ left.ravel())
    waves = [
        _wave(fit, use, basis, free, name, harmonic)
        for name in (*LEANS, *MOVING)
        for harmonic in HARMONICS
    ]
    lean = max((w for w in waves if w.name in LEANS), key=lambda w: w.power)
    rival = max((w for w in waves if w.name not in LEANS), key=lambda w: w.power)
    rest = before - lean.power
    after_px = fit.certificate.rms_px * math.sqrt(max(rest, 0.0) / before)
    if not after_px < limit_px:
        return None
    odds = len(free) / 2 * math.log((before - rival.power) / max(rest, 1e-300))
    if odds < NAMED_LOG_ODDS:
        return None
    size = abs(float(to_edge(lean.name, lean.size)))
    return error(
        "wobble",
        f"the rotation axis leans to and fro by {size:.2g} {UNITS[lean.name]} "
        f"{TIMES[lean.harmonic]} a turn ({lean.name}): the stage wobbles; the residuals "
        f"are {after_px:.2g} px without it",
    )


def _wave(
    fit: FitResult,
    use: npt.NDArray[np.bool_],
    basis: FloatArray,
    free: FloatArray,
    name: str,
    harmonic: int,
) -> Wave:
    """Fit a parameter that follows a harmonic of the angle to what the geometry leaves.

    Args:
        fit: gives the geometry.
        use: positions that count, (n, k).
        basis: of the geometry's columns, orthonormal, (m, c).
        free: residuals without them, (m,).
        name: of the parameter.
        harmonic: times a turn.
    """
    problem = fit.problem
    count, beads = use.shape
    slope = derivative(problem, fit, name, use).reshape(count, 2 * beads)
    turn = harmonic * np.asarray(problem.poses.angle)[:, None]
    kept = np.repeat(use.ravel(), 2)
    columns = np.stack(
        [(slope * shape(turn)).ravel()[kept] for shape in (np.cos, np.sin)], axis=1
    )
    columns = columns - basis @ (basis.T @ columns)
    sizes, _, _, _ = np.linalg.lstsq(columns, free, rcond=1e-6)
    explained = columns @ sizes
    return Wave(name, harmonic, float(explained @ free), float(np.linalg.norm(sizes)))
