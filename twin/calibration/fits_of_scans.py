"""Fits to the measurements of the scans, with the free parameters of a request."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flexdt.twin.calibration.diagnose.fixed_parameters import (
    loosened,
)
from flexdt.twin.calibration.fit.certificate import POSITION_SPREAD_PX
from flexdt.twin.calibration.fit.fit import FitResult, Solver, estimate_geometry
from flexdt.twin.calibration.fit.problem import (
    SIX,
    Strain,
)
from flexdt.twin.calibration.outcome import Calibration
from flexdt.twin.calibration.request import CalibrationRequest, priors_of, strain_prior
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.panel import PanelModel
from flexdt.twin.geometry.poses import Poses

MEASURED = Solver(floor_px=0.3, spread_px=1.0)
"""Positions of a second measurement are never taken to be better than a third of their
sigma: in images without noise, positions off by a thousandth of a pixel are no outliers."""
FOUND = Solver(spread_px=POSITION_SPREAD_PX)
"""Positions of a first measurement have no sigma of their own."""


def fit_with_loose_priors(
    state: Calibration, request: CalibrationRequest, wide: FitResult
) -> FitResult:
    """Fit with loosened priors and no bound, to compare priors with images.

    Beads that were freed because of the residuals (not by the request) stay free only if
    loose priors do not explain the residuals as well.

    Args:
        state: the scans and their measurements.
        request: free parameters and priors.
        wide: the last fit, perhaps with freed beads.
    """
    wide_priors = loosened(
        {**request.priors, **priors_of(state.scans, request, state.model)}
    )
    loose = replace(request, priors=wide_priors, bound=math.inf)
    out = refit_scans(state, loose, wide)
    if request.bead_tolerance_mm is None:
        freed = wide.bead_prior_mm
    else:
        freed = 0.0
    if freed > 0 and _beads_explain_more(wide, out):
        out = refit_scans(state, loose, wide, bead_tolerance_mm=freed)
    return out


def _beads_explain_more(freed: FitResult, loose: FitResult) -> bool:
    """Check whether free beads explain residuals better than loose priors.

    Their columns have a price (Schwarz, Annals of Statistics 6 (1978) 461).
    """
    count = 2 * int(loose.certificate.used.sum())
    columns = 3 * len(freed.problem.model)
    gain = count * math.log(loose.certificate.rms_px / freed.certificate.rms_px)
    return gain > 0.5 * columns * math.log(count)


def _start(state: Calibration, request: CalibrationRequest) -> list[Offsets]:
    """List the offsets from which each scan's fit starts: the request's, with the free
    parameters at their identified values; those that all scans share are the first
    scan's.
    """
    out = []
    for found in state.identifications:
        values = {n: getattr(found.parameters, n) for n in SIX if n in request.free}
        out.append(replace(request.start, **values))
    shared = [n for n in request.free if n not in request.per_scan]
    return [replace(p, **{n: getattr(out[0], n) for n in shared}) for p in out]


def fit_scans(
    state: Calibration,
    request: CalibrationRequest,
    start: Sequence[Offsets] | None = None,
    bead_tolerance_mm: float | None = None,
    panel: PanelModel | None = None,
    strain: Strain | None = None,
    arc: bool = False,
    rows: bool = False,
) -> FitResult:
    """Fit to the best positions: of the second measurement, else of the first.

    Positions of a first measurement count alike (`FOUND`), unless all spots were given
    with their beads.

    Args:
        state: the scans and their measurements.
        request: the free parameters.
        start: offsets of each scan; None: from the identification.
        bead_tolerance_mm: prior of the beads' places, which are free if it is above 0;
            None: the request's.
        panel: distortion to estimate; None: no distortion.
        strain: prior of the phantom's strains; None: the usual one.
        arc: whether an exposure lasts a part of the step.
        rows: whether a part of the step passes from a frame's first row to its last.
    """
    if bead_tolerance_mm is None:
        tolerance = request.bead_tolerance_mm
    else:
        tolerance = bead_tolerance_mm
    seen = state.measured or state.identifications
    weighed = positions_weighed(state)
    frames = [len(scan.poses) for scan in state.scans]
    sizes = np.array([scan.frames.shape for scan in state.scans], dtype=np.float64)
    return estimate_geometry(
        np.concatenate([s.tracks for s in seen]),
        state.model,
        Poses.concatenate([s.poses for s in state.scans]),
        request.free,
        shape=np.repeat(sizes, frames, axis=0),
        covariances=np.concatenate([s.covariances for s in seen]) if weighed else None,
        groups=np.repeat(np.arange(len(frames)), frames),
        per_group=request.per_scan,
        free_beads=tolerance is not None and tolerance > 0,
        bead_tolerance_mm=tolerance,
        start=_start(state, request) if start is None else start,
        reading=request.reading,
        sampling_px=max((m.sampling_px for m in state.measured), default=0.0),
        common_px=_common(state),
        solver=MEASURED if weighed else FOUND,
        priors=priors_of(state.scans, request, state.model),
        prior_centre=request.start,
        bound=request.bound,
        centre=np.concatenate([s.bias for s in seen]),
        panel=panel,
        strain=strain_prior(state.model, request) if strain is None else strain,
        arc=arc,
        rows=rows,
    )


def _common(state: Calibration) -> FloatArray | None:
    """Join the common shifts of the scans' positions, each scan with columns of its own, (n,
    k, 2, c); None without a second measurement.
    """
    if not state.measured:
        return None
    parts = [m.common for m in state.measured]
    before = np.cumsum([0, *(part.shape[3] for part in parts)])
    wide = [
        np.pad(part, ((0, 0), (0, 0), (0, 0), (int(left), int(before[-1] - right))))
        for part, left, right in zip(parts, before[:-1], before[1:], strict=True)
    ]
    return np.concatenate(wide)


def refit_scans(
    state: Calibration,
    request: CalibrationRequest,
    fit: FitResult,
    *,
    extra: tuple[str, ...] = (),
    bead_tolerance_mm: float | None = None,
    start: Sequence[Offsets] | None = None,
    panel: PanelModel | None = None,
    strain: Strain | None = None,
    arc: bool | None = None,
    rows: bool | None = None,
) -> FitResult:
    """Fit again with more parameters free, or with causes of the residuals; see
    `fit_scans`.

    `extra` parameters are free besides the request's. None is the last fit's `start` (one
    each scan), `panel`, `strain`, `arc` (of an exposure) and `rows` (read one after
    another); for `bead_tolerance_mm` it is the request's, not the last fit's.
    """
    begin = fit.group_parameters if start is None else start
    freed = replace(request, free=tuple(dict.fromkeys((*request.free, *extra))))
    columns = fit.problem.layout
    return fit_scans(
        state,
        freed,
        begin,
        bead_tolerance_mm,
        panel or fit.problem.panel,
        fit.strain_prior if strain is None else strain,
        columns.arc_column >= 0 if arc is None else arc,
        columns.rows_column >= 0 if rows is None else rows,
    )


def positions_weighed(state: Calibration) -> bool:
    """Check whether positions have sigmas of their own, which first measurements lack."""
    return bool(state.measured) or all(scan.index is not None for scan in state.scans)
