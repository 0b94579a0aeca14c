"""Calibration while the frames arrive: the estimate after each frame, and the angle to take
next.

The first frames are identified together as soon as that is possible. From then on each frame is
assigned by prediction, and the fit continues from its last result. Sampling stops when every
requested sigma is below its tolerance; until then the next angle is the one with the largest
expected gain (thesis 7.7). The state is a value: `feed` returns a new one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration import (
    SIX,
    BeadModel,
    BeadPhantom,
    FitResult,
    bead_model,
    build_problem,
    edge_factors,
    estimate_geometry,
    visible_beads,
)
from flexdt.twin.calibration.detect.detection import Detections
from flexdt.twin.calibration.fit.priors import require_widths
from flexdt.twin.calibration.fit.problem import require_names
from flexdt.twin.calibration.identify import assign, attempt, identified
from flexdt.twin.errors import TwinError, UnknownNameError
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.geometry.poses import Poses

FIRST_FRAMES = 3
"""Number of frames before the first identification is tried."""
GATE_SIGMAS = 6.0
GATE_PX = 3.0
"""Largest distance of a spot from its bead's prediction [px], plus GATE_SIGMAS of
that."""


@dataclass(frozen=True, eq=False)
class Online:
    """State of an online calibration after some frames.

    Attributes:
        model, free, start, priors: of the calibration; see `estimate_geometry`.
        poses: nominal pose of each frame so far, or None before the first.
        detections: of each frame so far.
        tracks, covariances, bias: assigned positions, (n, k, ...).
        fit: the present estimate, None until the beads could be distinguished.
        updates: number of renewals of the fit.
    """

    model: BeadModel
    free: tuple[str, ...]
    start: Offsets
    poses: Poses | None
    detections: tuple[Detections, ...]
    tracks: FloatArray
    covariances: FloatArray
    bias: FloatArray
    fit: FitResult | None
    updates: int
    priors: Mapping[str, float]

    def sigmas(self) -> dict[str, float]:
        """Return the standard deviation of every parameter, edge units; inf where not
        determined."""
        if self.fit is None or not self.fit.identifiable:
            return dict.fromkeys(self.free, math.inf)
        return self.fit.sigmas

    def done(self, tolerance: Mapping[str, float]) -> bool:
        """Check that every named parameter's sigma is at most its tolerance (edge units).

        Raises:
            UnknownNameError: a name that is not estimated.
            TwinError: no tolerance is given: there is nothing to wait for.
        """
        require_estimated(self.free, tolerance)
        now = self.sigmas()
        return all(now[name] <= limit for name, limit in tolerance.items())


def require_estimated(free: Sequence[str], tolerance: Mapping[str, float]) -> None:
    """Check that there is at least one tolerance, and that each is for an estimated
    parameter.

    Args:
        free: names of the estimated parameters.
        tolerance: parameter -> sigma.

    Raises:
        TwinError: no tolerance.
        UnknownNameError: a parameter that is not estimated.
    """
    if not tolerance:
        raise TwinError(
            "no tolerance given; allowed: parameter -> sigma", {"allowed": list(free)}
        )
    for name in tolerance:
        if name not in free:
            raise UnknownNameError.among(
                f"{name!r} is not estimated here; allowed", name, free
            )


def begin(
    phantom: BeadPhantom | BeadModel,
    free: Sequence[str] = SIX,
    start: Offsets = NOMINAL,
    priors: Mapping[str, float] | None = None,
) -> Online:
    """Begin an online calibration, before its first frame.

    Args:
        phantom: the scanned one.
        free: parameters to estimate.
        start: offsets to begin with, on which the priors are centered.
        priors: standard deviations of other offsets [mm, deg, 1]; see `fit.priors`. None:
            they are exactly known, and sigmas are those of the images' noise alone, which
            more frames can lower.
    """
    require_names(free)
    widths = require_widths(priors or {})
    model = bead_model(phantom)
    k = len(model)
    return Online(
        model,
        tuple(free),
        start,
        None,
        (),
        np.zeros((0, k, 2)),
        np.zeros((0, k, 2, 2)),
        np.zeros((0, k)),
        None,
        0,
        widths,
    )


def feed(state: Online, pose: Poses, detections: Detections) -> Online:
    """Add one more frame, and renew the fit if the beads are known.

    Until there is an identifiable fit, all frames are searched for a distinction of the
    beads. Then spots are assigned to the beads where the fit predicts them, within
    GATE_PX and GATE_SIGMAS sigmas of the prediction.

    Args:
        state: before the frame; not changed.
        pose: nominal pose of the frame (one).
        detections: spots found in it.

    Returns:
        The state with this frame.

    Raises:
        TwinError: `pose` is not one frame.
    """
    if len(pose) != 1:
        raise TwinError(f"one frame at a time: got {len(pose)} poses")
    if state.poses is None:
        poses = pose
    else:
        poses = Poses.concatenate([state.poses, pose])
    seen = (*state.detections, detections)
    grown = replace(state, poses=poses, detections=seen)
    if state.fit is None or not state.fit.identifiable:
        return _first(grown)
    fit = state.fit
    cone = pose.cone_vec(fit.parameters)
    predicted = cone.project_points(fit.beads, detections.shape)
    gate = GATE_PX + GATE_SIGMAS * _prediction_sigma(state, pose)
    points = detections.centers[None]
    index = assign(predicted, points, np.array([len(detections)]), gate)
    found = identified(index, [detections], fit.parameters)
    tracks, covariances, bias = (
        np.concatenate([getattr(state, name), getattr(found, name)])
        for name in ("tracks", "covariances", "bias")
    )
    return _renew(
        replace(grown, tracks=tracks, covariances=covariances, bias=bias), fit.parameters
    )


def _first(state: Online) -> Online:
    """Search all frames so far for a distinction of the beads, and make the first fit
    from it.

    Returns:
        The state with tracks and fit; unchanged with fewer than `FIRST_FRAMES` frames or
        6 spots, and if the result is ambiguous, explains less than 60 % of the spots, or
        has more than 1 px rms.
    """
    assert state.poses is not None
    if len(state.detections) < FIRST_FRAMES or sum(len(d) for d in state.detections) < 6:
        return state
    found = attempt(state.detections, state.model, state.poses, start=state.start)
    if found is None or found.ambiguous or found.explained < 0.6 or found.rms_px > 1.0:
        return state
    values = {n: getattr(found.parameters, n) for n in SIX if n in state.free}
    return _renew(
        replace(
            state, tracks=found.tracks, covariances=found.covariances, bias=found.bias
        ),
        replace(state.start, **values),
    )


def _renew(state: Online, start: Offsets) -> Online:
    """Fit the geometry to all frames so far, from `start`; return the state with the fit
    and one update more. The priors are about the state's own start.
    """
    assert state.poses is not None
    shapes = np.array([d.shape for d in state.detections], dtype=np.float64)
    fit = estimate_geometry(
        state.tracks,
        state.model,
        state.poses,
        state.free,
        shape=shapes,
        covariances=state.covariances,
        start=start,
        centre=state.bias,
        priors=state.priors,
        prior_centre=state.start,
    )
    return replace(state, fit=fit, updates=state.updates + 1)


def _prediction_sigma(state: Online, pose: Poses) -> float:
    """Compute the standard deviation of a predicted place [px], from the parameters'
    covariance.

    The largest over all rows of the prediction; the fit must exist.
    """
    assert state.fit is not None
    rows = _rows(state, pose)
    spread = np.einsum("ij,jk,ik->i", rows, state.fit.covariance, rows)
    return float(np.sqrt(max(float(spread.max()), 0.0)))


def _rows(state: Online, poses: Poses) -> FloatArray:
    """Compute d(pixels)/d(parameters), in edge units, of all beads in some poses at the
    present fit, (2 n k, p). The state must have a fit.
    """
    assert state.fit is not None
    shape = state.detections[-1].shape
    n = len(poses)
    k = len(state.model)
    problem = build_problem(
        np.zeros((n, k, 2)),
        state.model,
        poses,
        free=state.free,
        shape=shape,
        start=state.fit.parameters,
        priors=state.priors,
    )
    factor = edge_factors(problem.layout.names)
    return np.asarray(problem.jacobian(problem.start) / factor)


@dataclass(frozen=True)
class NextAngle:
    """Where to look next.

    Attributes:
        angle: nominal stage angle [rad].
        sigmas: predicted sigma of every parameter after that frame, edge units.
    """

    angle: float
    sigmas: dict[str, float]


def next_angle(
    state: Online, pose: Poses, candidates: npt.ArrayLike, tolerance: Mapping[str, float]
) -> NextAngle:
    """Choose the angle whose frame would make the worst sigma, in units of its tolerance,
    smallest.

    A new spot counts with the noise of those in the fit (`_noise_px`), a bead that would
    not be visible with none; spots that would overlap count in full.

    Args:
        state: with an estimate.
        pose: nominal pose (one); its angle is replaced by each candidate.
        candidates: (m,) nominal stage angles to choose from [rad].
        tolerance: wanted sigma of each parameter that matters, edge units.

    Returns:
        The angle [rad], and each parameter's sigma after it, edge units.

    Raises:
        TwinError: there is no estimate yet, no candidate, or no tolerance.
        UnknownNameError: a tolerance for a parameter that is not estimated.
    """
    require_estimated(state.free, tolerance)
    fit = state.fit
    if fit is None or not fit.identifiable:
        raise TwinError(
            "no estimate yet: feed more frames at angles spread over the turn"
        )
    angles = np.atleast_1d(np.asarray(candidates, dtype=np.float64))
    if len(angles) == 0:
        raise TwinError("no candidate angles given")
    names = list(fit.values)
    information = np.linalg.inv(fit.covariance)
    k = len(state.model)
    trial = replace(pose[np.zeros(len(angles), dtype=np.intp)], angle=angles)
    rows = _rows(state, trial).reshape(len(angles), 2 * k, len(names))
    sizes = np.array([state.detections[-1].shape] * len(angles), dtype=np.float64)
    visible = visible_beads(state.model, trial, sizes, fit.parameters)
    rows = rows * np.repeat(visible, 2, axis=1)[..., None]
    # A new position is worth as much as those already in the fit turned out to be.
    noise = _noise_px(fit)
    covariances = np.linalg.inv(information + np.swapaxes(rows, 1, 2) @ rows / noise**2)
    sigmas = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    worst = [sigmas[:, names.index(n)] / limit for n, limit in tolerance.items()]
    best = int(np.argmin(np.max(worst, axis=0)))
    return NextAngle(
        float(angles[best]), dict(zip(names, sigmas[best].tolist(), strict=True))
    )


def _noise_px(fit: FitResult) -> float:
    """Estimate the typical standard deviation of a used position [px], at least 1e-4.

    It is the median of the stated ones, times the fit's noise factor (1 if that is not
    finite) and the root of its enlargement.
    """
    whiten = fit.problem.whiten[fit.certificate.used]
    stated = float(np.median(1.0 / np.sqrt(whiten[:, 0] * whiten[:, 2])))
    if math.isfinite(fit.certificate.noise):
        noise = fit.certificate.noise
    else:
        noise = 1.0
    return max(stated * noise * math.sqrt(fit.certificate.enlargement), 1e-4)
