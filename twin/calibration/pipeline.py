"""From images to a geometry with its uncertainty report: detect, identify, fit, measure again,
fit, diagnose.

Several scans may be given; they are identified one by one and fitted together. The result
lists the faults of the data, and offers numbers only where they can be trusted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from flexdt.twin import long_work
from flexdt.twin.calibration.bead_model import (
    BeadModel,
    BeadPhantom,
    bead_model,
    with_contrast,
)
from flexdt.twin.calibration.detect.bead_contrast import detector_for
from flexdt.twin.calibration.detect.detection import SpotFinder
from flexdt.twin.calibration.diagnose import (
    OF_MOTION,
    CalibrationCode,
    listed,
)
from flexdt.twin.calibration.diagnose.data import judge_frames
from flexdt.twin.calibration.diagnose.fixed_parameters import judge_offsets
from flexdt.twin.calibration.diagnose.frame_places import judge_places
from flexdt.twin.calibration.diagnose.measured_spots import (
    beside_missing_light,
    judge_body,
    judge_first_sizes,
    judge_lag,
    judge_missing_light,
    judge_sizes,
    judge_smear,
)
from flexdt.twin.calibration.fit.fit import FitResult, with_start
from flexdt.twin.calibration.fit.problem import SIX, usual_step
from flexdt.twin.calibration.fits_of_scans import fit_scans, refit_scans
from flexdt.twin.calibration.fixed_check import check_fixed, explain
from flexdt.twin.calibration.frame_source import (
    FrameState,
    Scan,
    require_different,
    require_frames_that_move,
    require_scans,
    without_repeats,
)
from flexdt.twin.calibration.identified_scans import identify_scans
from flexdt.twin.calibration.outcome import Calibration
from flexdt.twin.calibration.recognise.recognised import judge_emptiness
from flexdt.twin.calibration.recognise.rivals import asked_of, with_rivals
from flexdt.twin.calibration.request import (
    CalibrationRequest,
    with_free,
    with_stated,
)
from flexdt.twin.calibration.second_measurement import measure_again
from flexdt.twin.findings import Finding, Findings
from flexdt.twin.projection.analytic_solids import Scene

__all__ = [
    "Calibration",
    "CalibrationRequest",
    "FrameState",
    "Scan",
    "calibrate",
    "detector_for",
]


@dataclass(frozen=True, eq=False)
class Fitted:
    """A calibration under way: the last fit and its request.

    Attributes:
        state: scans, measurements and findings.
        request: with all six main parameters free, where the data separate them.
        fit: the last fit.
        iterations: of all fits so far.
    """

    state: Calibration
    request: CalibrationRequest
    fit: FitResult
    iterations: int

    @property
    def outcome(self) -> Calibration:
        """The outcome so far."""
        return replace(self.state, fit=self.fit)

    def with_findings(self, *more: Finding) -> Fitted:
        """Add findings."""
        return replace(self, state=self.state.with_findings(*more))


def calibrate(
    scans: Sequence[Scan],
    phantom: BeadPhantom | BeadModel,
    request: CalibrationRequest | None = None,
    *,
    scene: Scene | None = None,
    detector: SpotFinder | None = None,
) -> Calibration:
    """Calibrate from images: detect, identify, fit, measure again, fit again and
    diagnose.

    Stops at the first stage with an error, at a fit that determines nothing (singular), at
    spots without light, and at offsets that are implausible; the outcome then holds the fit
    so far and its findings.

    Args:
        scans: one or more scans of the same phantom.
        phantom: its beads.
        request: the parameters to estimate; None is the thesis's six parameters.
        scene: the phantom's solids, so that its body can be subtracted; None is the
            phantom's own if it has one.
        detector: settings of the detection; None: from the phantom's beads and the
            geometry.

    Returns:
        Fit and findings; without a fit if an error ended it earlier.

    Raises:
        TwinError: a scan has no frames, or the same images as another.
        GeometryError: rows counted upwards, or columns from right to left.
    """
    if request is None:
        asked = CalibrationRequest()
    else:
        asked = request
    if scene is None:
        solids = getattr(phantom, "scene", None)
    else:
        solids = scene
    require_scans(scans)
    if asked.per_frame:
        require_frames_that_move(scans)
    model = with_contrast(bead_model(phantom), solids)
    asked = with_stated(asked, model)
    with long_work.during("finding the beads"):
        state = _detected(scans, model, detector)
        if state.errors:
            return state
        state = identify_scans(state, asked)
        if state.errors:
            return state
    if state.findings.of(CalibrationCode.PHANTOM_LEANS):
        solids = None  # They stand as the file has them.
    asked = asked_of(state, asked)
    with long_work.during("fitting"):
        fitted = _first_fit(state, asked)
    if fitted.state.errors or fitted.fit.certificate.spectrum.singular:
        return fitted.outcome  # Nothing that such a geometry predicts has a meaning.
    if asked.second_look:
        with long_work.during("measuring the beads again"):
            fitted = _second_fit(fitted, solids)
        if not fitted.state.measured or any(
            light.seen and light.dark > 0.0 for light in fitted.state.missing_light
        ):
            return fitted.outcome  # Residuals tell no cause where spots lost their light.
    implausible = judge_offsets(fitted.fit)
    if implausible is not None:  # Nothing else that such a fit shows has a meaning.
        return fitted.with_findings(implausible).outcome
    with long_work.during("looking for causes of the residuals"):
        return _diagnosed(fitted, asked)


def _detected(
    scans: Sequence[Scan], model: BeadModel, detector: SpotFinder | None
) -> Calibration:
    """Detect spots in all frames, mark repeated frames, and judge the frames.

    If a finding forbids using them and no settings were given, other spot sizes are looked for,
    which may add findings.

    Args:
        scans: the scans.
        model: the beads.
        detector: settings; None: from beads and geometry.

    Returns the state with spots and findings.
    Raises TwinError: scans share images.
    """
    sought = [detector or detector_for(model, scan.poses) for scan in scans]
    looks = tuple(
        without_repeats(scan.frames.look(how))
        for scan, how in zip(scans, sought, strict=True)
    )
    require_different(scans, looks)
    findings = [
        finding
        for scan, some, how in zip(scans, looks, sought, strict=True)
        for finding in judge_frames(scan, some, how)
    ]
    if detector is None and any(finding.forbids for finding in findings):
        findings = [*judge_emptiness(scans, looks, model), *findings]
    state = Calibration(None, (), Findings(), looks, (), tuple(scans), model)
    return state.with_findings(*findings)


def _first_fit(state: Calibration, asked: CalibrationRequest) -> Fitted:
    """Fit to the detected spots: with all six main parameters free if they are determined, else
    with the requested ones.

    The motion of single frames, if requested, is put into the poses, so that spots are looked
    for where they are. Adds findings on bead sizes if these are known and the fit is not
    singular.

    `state`: scans with identified spots; `asked`: the caller's request.
    Returns state, the request that was fitted, the fit and its number of iterations.
    """
    request = with_free(asked, SIX)
    fit = fit_scans(state, request)
    if not fit.determined:
        request = asked
        fit = fit_scans(state, request)
    if request.per_frame and request.second_look:
        better, _ = explain(state, request, fit)
        state = state.moved(better.motions)
        fit = refit_scans(state, request, fit)
    if request.known_sizes and not fit.certificate.spectrum.singular:
        state = state.with_findings(*judge_first_sizes(state, request, fit))
    return Fitted(state, request, fit, fit.iterations)


def _second_fit(fitted: Fitted, solids: Scene | None) -> Fitted:
    """Measure the spots a second time, fit to them, and judge sizes (if known), body, lag and
    missing light.

    Args:
        fitted: the first fit.
        solids: bodies of the phantom besides its beads; None if unknown.

    Returns:
        As `fitted`, with the new fit, findings and the sum of iterations. If nothing
        could be measured, nothing is judged: the state and fit that `measure_again`
        returned.
    """
    request = fitted.request
    state, fit, iterations = measure_again(fitted.state, request, fitted.fit, solids)
    if not state.measured:
        return Fitted(state, request, fit, fitted.iterations + iterations)
    if request.known_sizes:
        state = state.with_findings(*judge_sizes(state, fit))
    state = state.with_findings(*listed(judge_body(state.measured)))
    state = state.with_findings(*(judge_lag(lag) for lag in state.lags if lag.seen))
    missing = [light for light in state.missing_light if light.seen]
    state = state.with_findings(*map(judge_missing_light, missing))
    for scan, measured in zip(state.scans, state.measured, strict=True):
        step = usual_step(scan.poses.angle)
        state = state.with_findings(*listed(judge_smear(measured.smear, step)))
    return Fitted(state, request, fit, fitted.iterations + iterations)


def _diagnosed(fitted: Fitted, asked: CalibrationRequest) -> Calibration:
    """Explain the residuals, check the parameters that were not estimated, and add findings.

    A motion that is requested is put into the poses at the end. Where light is missing, it is a
    rival of a phantom of another shape.

    `fitted`: the last fit; `asked`: the caller's request, whose fixed parameters are checked.
    Returns the calibration, its fit relative to the caller's start and with the iterations of
    all fits.
    """
    state, request, fit = fitted.state, fitted.request, fitted.fit
    if state.motions:
        state = state.moved(())
        fit = refit_scans(state, request, fit)
    fit, explained = explain(state, request, fit)
    state = _judged_places(state, fit, explained)
    fit, explained = check_fixed(state, asked, request, fit, explained)
    if any(light.seen for light in state.missing_light):
        explained = [beside_missing_light(f) for f in explained]
    fit = with_rivals(state, asked, with_start(fit, asked.start, fitted.iterations))
    return replace(state.moved(fit.motions), fit=fit).with_findings(*explained)


def _judged_places(
    state: Calibration, fit: FitResult, explained: Sequence[Finding]
) -> Calibration:
    """Judge places of spots without a bead, unless another finding than a misfit forbids using
    the fit. `state`: the calibration. `fit`: its fit. `explained`: findings on the residuals;
    not added. Returns the state with at most one further finding a scan, and without
    `extra_spots` where a displaced bead explains them."""
    told = Findings(explained)
    if not told.errors.without(CalibrationCode.MISFIT) and not told.of(*OF_MOTION):
        # Of what moves, or turns otherwise than is said, all frames are elsewhere.
        state = state.with_findings(*judge_places(fit, state.looks))
    # Spots beside the phantom's are those of a bead that is displaced.
    return replace(state, findings=state.findings.unexplained_by(explained))
