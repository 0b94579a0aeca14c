"""From images to a geometry with its uncertainty report: detect, identify, fit, measure again, fit,
diagnose.

Several scans may be given; they are identified one by one and fitted together. The result lists
what is wrong with the data, and offers numbers only where they can be trusted.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from flexdt.twin.calibration.bead_model import BeadModel, BeadPhantom, bead_model, spot_radii
from flexdt.twin.calibration.detect.background import Lag, lag_of, without_lag
from flexdt.twin.calibration.detect.detection import SpotFinder
from flexdt.twin.calibration.detect.refine import FEW_WINDOWS, Refined, contrast_of, measure_beads
from flexdt.twin.calibration.detect.windows import mended, plan_windows
from flexdt.twin.calibration.diagnose import Finding, error, warning
from flexdt.twin.calibration.diagnose.data import (
    WIDE_GATE_PX,
    explain_identification,
    judge_emptiness,
    judge_frames,
)
from flexdt.twin.calibration.diagnose.fitted import (
    MISFIT_PX,
    OF_MOTION,
    OF_RESIDUALS,
    explain_residuals,
    judge_body,
    judge_first_size,
    judge_lag,
    judge_offsets,
    judge_places,
    judge_size,
)
from flexdt.twin.calibration.diagnose.fixed_parameters import (
    DOUBT_SIGMAS,
    doubtful,
    held_distance,
    judge_exact,
    judge_held,
    judge_priors,
    loosened,
    narrow_priors,
)
from flexdt.twin.calibration.fit.certificate import widened
from flexdt.twin.calibration.fit.fit import FitResult, Solver, estimate_geometry, with_start
from flexdt.twin.calibration.fit.fitted_motion import (
    MotionFit,
    aware,
    estimate_motion,
    follow_motion,
)
from flexdt.twin.calibration.fit.priors import ASSUMED, FIXED, require_widths
from flexdt.twin.calibration.fit.problem import (
    SIX,
    Reading,
    from_printed_reading,
    require_names,
    require_tolerance,
    to_printed_reading,
)
from flexdt.twin.calibration.fit.weak_directions import BOUND
from flexdt.twin.calibration.frame_source import (
    FrameSpots,
    FrameState,
    Scan,
    nothing,
    without_repeats,
)
from flexdt.twin.calibration.identify import Identification, Search, attempt, identified
from flexdt.twin.errors import GeometryError, TwinError
from flexdt.twin.geometry.motion import Motion, require_movable
from flexdt.twin.geometry.offsets import NAMES, NOMINAL, Offsets
from flexdt.twin.geometry.panel import Panel, PanelModel
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.projection.analytic_solids import Scene

MEASURED = Solver(floor_px=0.3)
"""Positions of a second measurement are never taken to be better than a third of their sigma: in
images without noise, what is off by a thousandth of a pixel is no outlier."""
CLOSE_PX = 0.02
"""A measurement is repeated if the fit moved a prediction by more."""
FAR_PX = 0.5
"""The same for a draft."""
ANYWHERE = 1e3
"""A prior [mm, deg] so wide that the images alone say where its parameter is."""
OF_FRAME = ("dO_y", "alpha", "tau_x", "tau_z")
"""With beads that may be anywhere, these only say in which frame of the object they are."""
OTHER_BEADS, BLURRED_FIRST = 1.0 / 6.0, 0.4
"""Deviation of the first radii from which beads are others; and if blur is to be measured yet."""
AS_GOOD = 1.2
"""A fit whose residuals are at most so many times as large explains the data as well."""


@dataclass(frozen=True)
class CalibrationRequest:
    """What to estimate and how.

    Attributes:
        free: parameters to estimate.
        per_scan: those with a value of their own in every scan.
        reading: of eq. 5.4.
        start: offsets to begin with, and the centre of every prior; what is neither free nor has a
            prior stays there.
        bead_tolerance_mm: > 0: bead positions are unknowns with this prior. 0: they are where the
            phantom says. None: unknowns only if the residuals ask for it.
        second_look: measure again where the first fit predicts the beads.
        priors: standard deviations [mm, deg, 1] in place of the scans' own; 0 is exactly known. The
            scans' apply to what is not free, these to anything.
        bound: sigma [mm, deg] beyond which the result is not identifiable.
        known_sizes: the beads' radii are known; else they were taken from the spots.
        misfit_px: residual above which a fit is not to be used unless explained.
        per_frame: those that may also differ from frame to frame, see `fit.fitted_motion`.

    Raises:
        UnknownNameError: a name that is no parameter, or cannot differ from frame to frame.
        TwinError: nothing is free, the tolerance or a prior is none, one of `per_scan` is not free,
            or something is free that is exactly known.
    """

    free: tuple[str, ...] = SIX
    per_scan: tuple[str, ...] = ()
    reading: Reading = Reading.AXIS_AT_O_PLUS_TAU
    start: Offsets = NOMINAL
    bead_tolerance_mm: float | None = None
    second_look: bool = True
    priors: Mapping[str, float] = field(default_factory=dict)
    bound: float = BOUND
    known_sizes: bool = True
    misfit_px: float = MISFIT_PX
    per_frame: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "per_frame", tuple(dict.fromkeys(require_movable(self.per_frame))))
        require_names((*self.free, *self.per_scan))
        if not self.free:
            raise TwinError("no parameter is free: there is nothing to estimate", {"asked": []})
        for name in self.per_scan:
            if name not in self.free:
                raise TwinError(
                    f"{name} is to have a value in each scan but is not free; free are "
                    + ", ".join(self.free),
                    {"asked": name, "allowed": list(self.free)},
                )
        if self.bead_tolerance_mm is not None:
            require_tolerance(self.bead_tolerance_mm)
        for name, width in require_widths(self.priors).items():
            if width == 0 and name in self.free:
                raise TwinError(f"{name} is free, and its prior is 0: exactly known; choose one")
        if not self.bound > 0:
            raise TwinError(f"bound {self.bound:g}; allowed: a sigma above 0 [mm, deg]")


@dataclass(frozen=True, eq=False)
class Calibration:
    """The outcome.

    Attributes:
        fit: the last fit made, with its certificate; None if it never came to one.
        identifications: of each scan, as far as it came.
        findings: what is wrong with the data, worst first.
        looks: detections and state of every frame of each scan.
        measured: positions of the second measurement of each scan; empty without one.
        scans: what was calibrated, with the motion found in their poses.
        model: the phantom's beads.
        motion: what was found to move; None if it was not asked for.
        lags: of the camera in each scan, taken out of what was measured.
    """

    fit: FitResult | None
    identifications: tuple[Identification, ...]
    findings: tuple[Finding, ...]
    looks: tuple[tuple[FrameSpots, ...], ...]
    measured: tuple[Refined, ...]
    scans: tuple[Scan, ...]
    model: BeadModel
    motion: MotionFit | None = None
    lags: tuple[Lag, ...] = ()

    @property
    def motions(self) -> tuple[Motion, ...]:
        """The motion of each scan; empty if it was not asked for."""
        return () if self.motion is None else self.motion.motions

    @property
    def panel(self) -> Panel | None:
        """Distortion and lag of the panel, where either was found."""
        panel = None if self.fit is None else self.fit.panel
        if not (seen := [lag.part for lag in self.lags if lag.seen]):
            return panel
        return replace(panel or Panel.flat(self.scans[0].frames.shape), lag=float(np.mean(seen)))

    @property
    def errors(self) -> tuple[Finding, ...]:
        """Findings that forbid using the numbers."""
        return tuple(f for f in self.findings if f.forbids)

    @property
    def identifiable(self) -> bool:
        """There is a fit, it determines every parameter, and nothing forbids using it."""
        return self.fit is not None and self.fit.identifiable and not self.errors

    @property
    def detections(self) -> int:
        """Spots found in all frames."""
        return sum(len(look.detections) for looks in self.looks for look in looks)


def calibrate(
    scans: Sequence[Scan],
    phantom: BeadPhantom | BeadModel,
    request: CalibrationRequest | None = None,
    *,
    scene: Scene | None = None,
    detector: SpotFinder | None = None,
) -> Calibration:
    """Calibrate from images.

    Args:
        scans: one or more scans of the same phantom.
        phantom: its beads.
        request: what to estimate; None is the thesis's six parameters.
        scene: the phantom's solids, so that its body can be subtracted; None is the phantom's own
            if it has one.
        detector: what spots to look for; None: from the phantom's beads and the geometry.

    Raises:
        TwinError: a scan has no frames, or the same images as another.
        GeometryError: rows counted upwards, or columns from right to left.
    """
    want = CalibrationRequest() if request is None else request
    model = bead_model(phantom)
    solids = getattr(phantom, "scene", None) if scene is None else scene
    for scan in scans:
        if len(scan.poses) != len(scan.frames) or len(scan.frames) == 0:
            raise TwinError(
                f"{scan.name}: {len(scan.frames)} frames and {len(scan.poses)} poses; allowed: as "
                "many of both, at least one"
            )
        _require_seen_from_the_source(scan)
    sought = [detector or detector_for(model, scan.poses) for scan in scans]
    looks = tuple(
        without_repeats(scan.frames.look(how)) for scan, how in zip(scans, sought, strict=True)
    )
    _require_different(scans, looks)
    state = Calibration(None, (), (), looks, (), tuple(scans), model)
    findings = [
        f
        for scan, some, how in zip(scans, looks, sought, strict=True)
        for f in judge_frames(scan.name, some, how)
    ]
    if any(f.forbids for f in findings):
        more = judge_emptiness(scans, looks, model) if detector is None else []
        return replace(state, findings=_sorted([*more, *findings]))
    identifications, told = _identified(state, want)
    findings += told
    state = replace(state, identifications=tuple(identifications), findings=_sorted(findings))
    if state.errors:
        return state
    asked, want = want, _freed(want, SIX)
    fit = _fit(state, want)
    if not fit.identifiable:
        want = asked
        fit = _fit(state, want)
    if want.per_frame:
        state, fit = _with_motion(state, want, fit)
    iterations = fit.iterations
    sized = zip(state.scans, identifications, looks, strict=True) if want.known_sizes else ()
    for g, (scan, found_, some) in enumerate(sized):
        radii = spot_radii(model, scan.poses.cone_vec(fit.group_parameters[g]))
        # What is blurred is wider, and the second measurement knows by how much.
        allowed = BLURRED_FIRST if want.second_look else OTHER_BEADS
        findings += _given(judge_first_size(found_, some, radii, allowed))
    if any(f.forbids for f in findings):
        return replace(state, fit=fit, findings=_sorted(findings))
    if want.second_look:
        state, fit, repeats = _second_look(state, want, fit, solids)
        iterations += repeats
        if want.known_sizes:
            findings += _sizes(state, fit)
        findings += _given(judge_body(state.measured))
        findings += [judge_lag(lag) for lag in state.lags if lag.seen]
        if want.per_frame:
            state, fit = _with_motion(state, want, fit)
    implausible = judge_offsets(fit)
    if implausible is not None:  # Nothing else that such a fit shows has a meaning.
        return replace(state, fit=fit, findings=_sorted([*findings, implausible]))
    fit, explained = _explain(state, want, fit)
    if not any(f.forbids and f.code != "misfit" for f in explained):
        # Of what moves, or turns otherwise than is said, all frames are elsewhere.
        findings += _given(judge_places(fit, looks))
    if any(f.code == "bead_displaced" for f in explained):  # the other spots are that bead's
        findings = [f for f in findings if f.code != "extra_spots"]
    wide = fit
    fit, explained = _with_held(state, asked, want, wide, explained)
    narrower = list(fit.values) != list(wide.values)
    if state.motion is not None and narrower and not any(f.forbids for f in explained):
        # Motion took up what is held now, or the other way round.
        state, fit = _with_motion(state, asked, fit)
        fit, told = _explain(state, asked, fit)
        explained = [*told, *(f for f in explained if f.code not in OF_RESIDUALS)]
    if state.motion is not None:
        state, unsettled = _settled(state, want, fit)
        findings += unsettled
        # A deviation in every frame takes up part of what its beads share, and the rest looks
        # shared, too: the sigmas stay wide, but nothing vibrates.
        explained = [f for f in explained if f.code != "vibration"]
    return replace(
        state,
        fit=with_start(fit, want.start, iterations),
        findings=_sorted([*findings, *explained]),
    )


def _identified(
    state: Calibration, want: CalibrationRequest
) -> tuple[list[Identification], list[Finding]]:
    """Which spot is which bead, scan by scan until one tells nothing, and what is wrong with it."""
    out: list[Identification] = []
    findings: list[Finding] = []
    for scan, some in zip(state.scans, state.looks, strict=True):
        unseen = nothing(scan.frames.shape)
        detections = [
            unseen if look.state is FrameState.REPEATED else look.detections for look in some
        ]
        if scan.index is not None:
            out.append(identified(scan.index, detections, want.start))
            continue
        seek = partial(attempt, detections, state.model, scan.poses, start=want.start)
        found = seek()
        told = explain_identification(found, detections, state.model, scan.poses, scan.name)
        if want.per_frame and told is not None and told.code in OF_MOTION:
            # It may move, so its spots may be far from where one geometry has them.
            found = seek(search=Search(gate_px=WIDE_GATE_PX)) or found
            told = None
        findings += _given(told)
        if found is None:
            break
        out.append(found)
    return out, findings


def detector_for(model: BeadModel, poses: Poses) -> SpotFinder:
    """A detector for the sizes the beads' spots can have at a rough geometry."""
    low = float(model.bead_radius_mm.min() * poses.pixels_per_mm.min())
    high = float(model.bead_radius_mm.max() * poses.pixels_per_mm.max())
    sizes = model.bead_radius_mm
    same = math.inf if sizes.max() > 1.2 * sizes.min() else 1.6
    return SpotFinder(radius_px=(0.65 * low, 1.5 * high), same=same)


def _require_seen_from_the_source(scan: Scan) -> None:
    """Refuse rows that are counted upwards and columns that are counted from right to left."""
    p = scan.poses
    beam = ((p.detector - p.source) * np.cross(p.u, p.v)).sum(axis=1)
    for wrong, what, way in (
        (p.v[:, 2] > 0.0, "rows upwards (v points up)", "top to bottom"),
        (beam < 0.0, "columns from right to left, seen from the source", "left to right"),
    ):
        if wrong.any():
            raise GeometryError(
                f"{scan.name}: the geometry counts {what} in view {int(np.argmax(wrong))}; "
                "allowed: row 0 on top, column 0 on the left. Negate this vector, and flip the "
                f"images {way} if they are counted so, too (docs/exchange.md, rows up or down)",
                {"asked": what, "allowed": "row 0 on top, column 0 on the left"},
            )


def _require_different(scans: Sequence[Scan], looks: Sequence[Sequence[FrameSpots]]) -> None:
    """The same images twice would count as twice the evidence, also some of them: no two images
    have the same noise, so none has all its spots where another has them, to the last digit."""
    known: dict[bytes, int] = {}
    for j, some in enumerate(looks):
        shadows = [look.detections.centers.tobytes() for look in some if len(look.detections)]
        for i, again in Counter(known[s] for s in shadows if s in known).items():
            raise TwinError(
                f"scans {i + 1} and {j + 1} ({scans[i].name}, {scans[j].name}) hold the same "
                f"images ({again} of {len(some)} frames); give each image once",
                {"asked": [scans[i].name, scans[j].name], "frames": again},
            )
        known |= dict.fromkeys(shadows, j)


def _explain(
    state: Calibration, want: CalibrationRequest, fit: FitResult
) -> tuple[FitResult, list[Finding]]:
    return explain_residuals(
        fit,
        free_beads=want.bead_tolerance_mm is not None,
        refit=lambda **changes: _refit(state, want, fit, **changes),
        loose=lambda: _loose(state, want, fit),
        sigmas_known=bool(state.measured),
        misfit_px=want.misfit_px,
    )


def _with_held(
    state: Calibration,
    asked: CalibrationRequest,
    want: CalibrationRequest,
    wide: FitResult,
    explained: list[Finding],
) -> tuple[FitResult, list[Finding]]:
    """The fit that was asked for, if what it holds is where the data have it.

    All six main parameters are free first (`want`, and `wide` is its fit); where the data cannot
    tell six apart, each is freed by itself. Then the priors of what else may be off are compared
    with what the images say of them, and widened where they are a little too narrow.

    Returns:
        The fit with those parameters held that are to be held, and the findings that go with it.
    """
    at = from_printed_reading(asked.start, asked.reading).to_edge()
    known = _priors(state.scans, asked)
    six = {n: at[n] for n in SIX if n not in asked.free and n not in known}
    fit, trials = wide, [(wide, explained)]
    if set(want.free) - set(asked.free):
        fit = _refit(state, asked, wide, start=_held_start(state, asked, wide))
    if not set(six) <= set(wide.values):
        trials = []
        for name in six:
            single = _freed(asked, (name,))
            trials.append(_explain(state, single, _refit(state, single, fit)))
    for freed, found in trials:
        off = judge_held(freed, six)
        if off is not None:
            return fit, [*found, off]
    errors = {f.code for f in explained if f.forbids}
    stated = _stated(state.scans, asked)
    defined = OF_FRAME if (asked.bead_tolerance_mm or 0.0) >= ANYWHERE else ()
    widths = {
        n: w for n, w in {**FIXED, **ASSUMED}.items() if stated.get(n) == 0 and n not in defined
    }
    exact = {n: at[n] for n in widths}
    usual = replace(asked, priors={**asked.priors, **widths})
    loose = _loose(state, usual, fit)
    priors = judge_priors(loose, exact)
    if priors.finding is not None and errors <= OF_RESIDUALS | {"misfit"}:
        wider = replace(usual, priors=loosened({**usual.priors, **_priors(state.scans, usual)}))
        left = _explain(state, wider, loose)[1]
        moved = [f for f in explained if f.code == "bead_tolerance" and loose.bead_prior_mm]
        return fit, [*(f for f in left if f.code != "misfit"), *moved, priors.finding]
    narrow = [narrow_priors(priors)] if priors.factor > 1.0 else []
    if narrow:
        asked = replace(asked, priors=loosened({**asked.priors, **known}, priors.factor))
    if narrow or fit is not wide:
        fit, explained = _explain(
            state, asked,
            _refit(state, asked, fit, start=_held_start(state, asked, fit)),
        )  # fmt: skip
    if max(held_distance(wide, six).values(), default=0.0) > DOUBT_SIGMAS:
        doubt = {n: wide.values.get(n, v) - v for n, v in fit.values.items()}
        fit = replace(fit, certificate=widened(fit.certificate, doubt))

    def without(name: str) -> FitResult:
        alone = replace(asked, priors={**asked.priors, name: ANYWHERE}, bound=math.inf)
        return _refit(state, alone, fit)

    if exact:
        unchecked = judge_exact(fit, _refit(state, usual, fit), exact)
        narrow += [] if unchecked is None else [unchecked]
    return doubtful(fit, priors, without), [*explained, *narrow]


def _loose(state: Calibration, want: CalibrationRequest, wide: FitResult) -> FitResult:
    """The fit with loosened priors, to compare them with. Beads that were freed because of the
    residuals stay free only if loose priors do not explain the residuals as well."""
    wide_priors = loosened({**want.priors, **_priors(state.scans, want)})
    loose = replace(want, priors=wide_priors, bound=math.inf)
    out = _refit(state, loose, wide)
    freed = wide.bead_prior_mm if want.bead_tolerance_mm is None else 0.0
    if freed > 0 and out.certificate.rms_px > AS_GOOD * wide.certificate.rms_px:
        out = _refit(state, loose, wide, bead_tolerance_mm=freed)
    return out


def _priors(scans: Sequence[Scan], want: CalibrationRequest) -> dict[str, float]:
    """Every prior of the fit."""
    return {n: w for n, w in _stated(scans, want).items() if w > 0}


def _stated(scans: Sequence[Scan], want: CalibrationRequest) -> dict[str, float]:
    """The widest of the scans' priors for what is not free, and those of the request; 0: exact."""
    out: dict[str, float] = {n: w for n, w in FIXED.items() if n not in want.free}
    for scan in scans:
        for name, width in scan.priors.items():
            if name not in want.free:
                out[name] = max(out.get(name, 0.0), width)
    return out | {n: w for n, w in want.priors.items() if w > 0 or n not in want.free}


def _freed(want: CalibrationRequest, names: Sequence[str]) -> CalibrationRequest:
    """The request with more parameters free, and without their priors."""
    priors = {n: w for n, w in want.priors.items() if n in want.free or n not in names}
    return replace(want, free=tuple(dict.fromkeys((*want.free, *names))), priors=priors)


def _held_start(state: Calibration, want: CalibrationRequest, fit: FitResult) -> list[Offsets]:
    """The geometry of a fit with what `want` holds exactly put back to where it is fixed."""
    held = from_printed_reading(want.start, want.reading)
    known = {*want.free, *_priors(state.scans, want)}
    values = {n: getattr(held, n) for n in NAMES if n not in known}
    return [
        to_printed_reading(replace(from_printed_reading(p, want.reading), **values), want.reading)
        for p in fit.group_parameters
    ]


def _start(state: Calibration, want: CalibrationRequest) -> list[Offsets]:
    """Start of each scan: what the identification found, as far as it is free."""
    out = []
    for found in state.identifications:
        values = {n: getattr(found.parameters, n) for n in SIX if n in want.free}
        out.append(replace(want.start, **values))
    shared = [n for n in want.free if n not in want.per_scan]
    return [replace(p, **{n: getattr(out[0], n) for n in shared}) for p in out]


def _fit(
    state: Calibration,
    want: CalibrationRequest,
    start: Sequence[Offsets] | None = None,
    bead_tolerance_mm: float | None = None,
    panel: PanelModel | None = None,
) -> FitResult:
    """The fit to the best positions there are: of the second measurement, else of the first."""
    tolerance = want.bead_tolerance_mm if bead_tolerance_mm is None else bead_tolerance_mm
    seen = state.measured or state.identifications
    # Spots that were found by us in the first measurement count alike.
    weighed = bool(state.measured) or all(scan.index is not None for scan in state.scans)
    frames = [len(scan.poses) for scan in state.scans]
    sizes = np.array([scan.frames.shape for scan in state.scans], dtype=np.float64)
    fit = estimate_geometry(
        np.concatenate([s.tracks for s in seen]),
        state.model,
        Poses.concatenate([s.poses for s in state.scans]),
        want.free,
        shape=np.repeat(sizes, frames, axis=0),
        covariances=np.concatenate([s.covariances for s in seen]) if weighed else None,
        groups=np.repeat(np.arange(len(frames)), frames),
        per_group=want.per_scan,
        free_beads=tolerance is not None and tolerance > 0,
        bead_tolerance_mm=tolerance,
        start=_start(state, want) if start is None else start,
        reading=want.reading,
        sampling_px=max((m.sampling_px for m in state.measured), default=0.0),
        solver=MEASURED if weighed else None,
        priors=_priors(state.scans, want),
        prior_centre=want.start,
        bound=want.bound,
        centre=np.concatenate([s.bias for s in seen]),
        panel=panel,
    )
    return fit if state.motion is None else aware(fit, state.motion)


def _second_look(
    state: Calibration, want: CalibrationRequest, fit: FitResult, solids: Scene | None
) -> tuple[Calibration, FitResult, int]:
    """Measure in windows and fit again; once more if the first fit was far off.

    With few frames the first fit is rough, so that a draft comes before the measurement.
    """
    iterations = 0
    lags = [Lag() for _ in state.scans]
    windows = sum(len(s.frames) for s in state.scans) * len(state.model)
    draft = windows <= FEW_WINDOWS
    for _ in range(4):
        measured = []
        worst = 0.0
        plans = []
        for g, scan in enumerate(state.scans):
            cone = scan.poses.cone_vec(fit.group_parameters[g])
            model = BeadModel(fit.beads, state.model.bead_radius_mm)
            plan = plan_windows(model, cone, scan.frames.shape)
            contrast = contrast_of([look.detections.contrast for look in state.looks[g]])
            images = scan.frames.windows(plan)
            if not state.measured:
                lags[g] = lag_of(images, scan.frames, plan)
            if lags[g].seen:
                images = without_lag(scan.frames, plan, lags[g])
            images[[look.state is not FrameState.USABLE for look in state.looks[g]]] = np.nan
            images = mended(images, plan)
            measured.append(measure_beads(images, plan, cone, model, contrast, solids, draft=draft))
            plans.append(plan)
        state = replace(state, measured=tuple(measured), lags=tuple(lags))
        fit = _fit(state, want, fit.group_parameters)
        iterations += fit.iterations
        for g, (scan, plan) in enumerate(zip(state.scans, plans, strict=True)):
            now = scan.poses.cone_vec(fit.group_parameters[g]).project_points(
                fit.beads, scan.frames.shape
            )
            shift = np.linalg.norm(now - plan.predicted, axis=2)[plan.share > 0.5]
            worst = max(worst, float(shift.max()) if shift.size else 0.0)
        if worst < CLOSE_PX and not draft:
            break
        draft = draft and worst > FAR_PX
    return state, fit, iterations


def _with_motion(
    state: Calibration, want: CalibrationRequest, fit: FitResult
) -> tuple[Calibration, FitResult]:
    """The scans with their motion in the poses, and the fit to them."""
    still = [s.poses for s in state.scans]
    if state.motions:
        still = [m.applied(p, -1.0) for p, m in zip(still, state.motions, strict=True)]

    def moved(motion: MotionFit) -> Calibration:
        scans = tuple(
            replace(s, poses=m.applied(p))
            for s, p, m in zip(state.scans, still, motion.motions, strict=True)
        )
        return replace(state, scans=scans, motion=motion)

    fit, found = follow_motion(
        fit, want.per_frame, lambda motion: _refit(moved(motion), want, fit), state.motion
    )
    return moved(found), fit


def _settled(
    state: Calibration, want: CalibrationRequest, fit: FitResult
) -> tuple[Calibration, list[Finding]]:
    """The motion with sigmas that contain what the last fit would make of it."""
    held = state.motion
    assert held is not None
    again = estimate_motion(fit, want.per_frame, held, search=False)
    off = [b.values - a.values for a, b in zip(held.motions, again.motions, strict=True)]
    motions = tuple(
        replace(a, sigma=np.hypot(b.sigma, d))
        for a, b, d in zip(held.motions, again.motions, off, strict=True)
    )
    worst = max(
        float(np.nan_to_num(np.abs(d) / np.maximum(b.sigma, 1e-300)).max(initial=0.0))
        for b, d in zip(again.motions, off, strict=True)
    )
    out = []
    if worst > 1.0:
        out.append(
            warning(
                "motion_unsettled",
                f"the motion differs by up to {worst:.1f} sigma from what the last fit would make "
                "of it; its sigmas contain that",
            )
        )
    wide = [
        f"{n} to {e.sigma:.2g} {e.unit}"
        for n, e in fit.certificate.estimates.items()
        if fit.identifiable and e.asked and e.unit != "1" and e.sigma > want.bound
    ]
    if wide:
        out.append(
            error(
                "motion_hides",
                f"as {', '.join(want.per_frame)} may differ from frame to frame, "
                f"{', '.join(wide)} is all that can be said; allowed: {want.bound:g}",
            )
        )
    return replace(state, motion=replace(held, motions=motions)), out


def _refit(
    state: Calibration,
    want: CalibrationRequest,
    fit: FitResult,
    *,
    extra: tuple[str, ...] = (),
    motion: MotionFit | None = None,
    bead_tolerance_mm: float | None = None,
    start: Sequence[Offsets] | None = None,
    panel: PanelModel | None = None,
) -> FitResult:
    """The last fit with something else free: more parameters, the beads, the panel's distortion; or
    with a motion. A distortion that was found stays."""
    if motion is not None:
        scans = zip(state.scans, motion.motions, strict=True)
        moved = tuple(replace(s, poses=m.applied(s.poses)) for s, m in scans)
        state = replace(state, scans=moved)
    begin = fit.group_parameters if start is None else start
    freed = replace(want, free=tuple(dict.fromkeys((*want.free, *extra))))
    return _fit(state, freed, begin, bead_tolerance_mm, panel or fit.problem.panel)


def _sizes(state: Calibration, fit: FitResult) -> list[Finding]:
    """What the beads' size says; by the first measurement where the second could not tell."""
    out = []
    for g, scan in enumerate(state.scans):
        radii = spot_radii(state.model, scan.poses.cone_vec(fit.group_parameters[g]))
        if np.isfinite(state.measured[g].size):
            out += _given(judge_size(state.measured[g], float(np.median(radii))))
        else:
            first = state.identifications[g], state.looks[g], radii
            out += _given(judge_first_size(*first, OTHER_BEADS))
    return out


def _given(finding: Finding | None) -> list[Finding]:
    return [] if finding is None else [finding]


def _sorted(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    return tuple(sorted(findings, key=lambda f: not f.forbids))


__all__ = ["Calibration", "CalibrationRequest", "FrameState", "Scan", "calibrate", "detector_for"]
