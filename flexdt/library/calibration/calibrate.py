"""`flexdt calibrate` without its command line: data sets in, JSON documents out.

The functions return plain values in the JSON shapes of docs/calibration.md, and the full
outcome.

A verdict states in a sentence how a calibration may be used; the commands after it would
determine more.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from itertools import groupby
from os import PathLike
from pathlib import Path
from typing import Any, Final, Generic

import numpy as np

from flexdt.library.calibration.calibration_options import (
    CalibrationOptions,
    conditions,
    misfit,
)
from flexdt.library.calibration.calibration_request import detection_of, request_of
from flexdt.library.calibration.dataset_frames import DatasetFrames
from flexdt.library.calibration.exposure_share import exposure_share
from flexdt.library.calibration.markers import (
    Mark,
    Scale,
    calibrate_known,
    calibrate_unknown,
    read_markers,
    seen_alone,
)
from flexdt.library.calibration.one_blas_thread import one_blas_thread
from flexdt.library.calibration.proposed_commands import (
    IN_MEMORY,
    VALUE,
    Typed,
    angle_commands,
    option_words,
    settling_commands,
)
from flexdt.library.calibration.square_pixels import squared
from flexdt.library.datasets.image_set import Images, Images_co, ImageSet
from flexdt.library.datasets.notebook_html import emphasised, values_table
from flexdt.phantoms import Phantom, load_phantom, phantom_names
from flexdt.phantoms.files.phantom_files import read_phantom_file
from flexdt.twin import long_work
from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.detect.detection import SpotFinder
from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.calibration.fit.certificate import Estimate
from flexdt.twin.calibration.fit.fit import FitResult, image_quantities
from flexdt.twin.calibration.fit.priors import STRAIN, prior_widths
from flexdt.twin.calibration.fit.problem import SIX, from_printed_reading
from flexdt.twin.calibration.fit.told_ways import told_motions
from flexdt.twin.calibration.pipeline import (
    Calibration,
    CalibrationRequest,
    Scan,
    calibrate,
)
from flexdt.twin.calibration.unknown_markers import UNKNOWN
from flexdt.twin.errors import TwinError, UnknownNameError
from flexdt.twin.findings import Finding, Findings, error, warning
from flexdt.twin.geometry.offsets import NAMES, Offsets
from flexdt.twin.geometry.told_lengths import PHANTOM, TOLD_SOURCES
from flexdt.twin.projection.analytic_solids import Scene
from flexdt.twin.scanner.state import NamedCorrection


@dataclass(frozen=True, eq=False, repr=False)
class Outcome(Generic[Images_co]):
    """A calibration of data sets.

    Attributes:
        calibration: the calibration with all its details.
        document: the JSON of `flexdt calibrate`.
        datasets: the calibrated data sets, with the estimated motion.
        phantom: the phantom that was scanned.
    """

    calibration: Calibration
    document: dict[str, object]
    datasets: tuple[Images_co, ...]
    phantom: Phantom

    def __repr__(self) -> str:
        """Format the phantom's name with the number of requested parameters, of frames, the
        rms [px] and the verdict; or just "not identifiable".
        """
        d = self.document
        if not self.calibration.identifiable:
            return f"<Calibration with {self.phantom.name!r}: not identifiable>"
        requested = sum(bool(p["asked"]) for p in self.parameters.values())
        return (
            f"<Calibration with {self.phantom.name!r}: {requested} parameters from "
            f"{d['frames']} frames, rms {d['rms_px']:.4f} px. {self.verdict}>"
        )

    def _repr_html_(self) -> str:
        """Make HTML of the verdict and a table of the requested parameters with value, sigma
        and unit.
        """
        heads = ("parameter", "value", "sigma", "unit")
        rows = (
            (name, *_digits(estimate["value"], estimate["sigma"]), estimate["unit"])
            for name, estimate in self.parameters.items()
            if estimate["asked"]
        )
        return emphasised(self.verdict) + values_table(heads, rows)

    @property
    def verdict(self) -> str:
        """How it may be used, in words."""
        return str(self.document["verdict"])

    @property
    def parameters(self) -> Mapping[str, Mapping[str, object]]:
        """Name -> {value, sigma, low, high, unit, images, priors, prior, asked} [mm, deg], as
        `Estimate` describes them; parameters with a prior that were not requested come last."""
        estimates: Mapping[str, Mapping[str, object]] = self.document["parameters"]  # type: ignore[assignment]
        return estimates

    @property
    def parts(self) -> Iterator[tuple[Images_co, slice]]:
        """Each data set, in order, with the slice of its frames among those of all."""
        first = 0
        for dataset in self.datasets:
            yield dataset, slice(first, first + len(dataset))
            first += len(dataset)

    @property
    def sources(self) -> str:
        """The data sets' names."""
        return ", ".join(d.name for d in self.datasets)

    @property
    def correction(self) -> NamedCorrection:
        """The correction, for `DataSet.with_correction` and `calibration.apply`.

        It is named by the present time (UTC), with parameters and the panel's distortion
        and lag, if any.

        Raises:
            TwinError: the calibration is not identifiable, or has no fit.
        """
        result = self.calibration
        if not result.identifiable or result.fit is None:
            raise TwinError(
                f"this calibration offers no correction. {self.document['verdict']}"
            )
        now = datetime.now(UTC)
        rms = result.fit.certificate.rms_px
        return NamedCorrection(
            f"calibration {now:%Y-%m-%d %H:%M:%S}",
            now.isoformat(timespec="seconds"),
            result.fit.parameters,
            f"{self.phantom.name}, {len(result.scans)} scan(s), rms {rms:.4f} px",
            result.panel,
            sides_known=self.phantom.name != UNKNOWN,
        )


def _digits(value: object, sigma: object) -> tuple[str, str]:
    """Format value and sigma, both to sigma's second digit; "-" for a value that is no
    number.

    Where sigma is no number, 0, negative or infinite, the value has five digits.
    """
    if isinstance(sigma, float | int) and 0.0 < sigma < math.inf:
        form = f".{max(0, 1 - math.floor(math.log10(sigma)))}f"
        forms = (form, form)
    else:
        forms = (".5g", ".2g")
    shown, spread = (
        format(number, form) if isinstance(number, float | int) else "-"
        for number, form in zip((value, sigma), forms, strict=True)
    )
    return shown, spread


def calibrate_with(
    datasets: Sequence[Images],
    phantom: str | Phantom,
    options: CalibrationOptions,
    typed: Typed | None = None,
) -> Outcome[Images]:
    """Calibrate from data sets with a user's options; see `calibrate_datasets`."""
    request = request_of(phantom, options)
    if typed is None:
        typed = typed_words(datasets, phantom, options)
    return calibrate_datasets(
        datasets, phantom, request, typed=typed, **detection_of(options)
    )


def typed_words(
    datasets: Sequence[ImageSet], phantom: str | Phantom, options: CalibrationOptions
) -> Typed:
    """Return the words of the command that calibrates data sets so."""
    if isinstance(phantom, str):
        named = phantom
    elif phantom.name in phantom_names():
        named = phantom.name
    else:
        named = VALUE
    return Typed(
        tuple(IN_MEMORY if d.folder is None else str(d.folder) for d in datasets),
        named,
        options=option_words(options),
    )


@one_blas_thread()
def calibrate_datasets(
    datasets: Sequence[Images],
    phantom: str | Phantom,
    request: CalibrationRequest | None = None,
    *,
    markers: str | PathLike[str] | Sequence[Mark] | None = None,
    scale: Scale | str | None = None,
    radius_px: float | None = None,
    typed: Typed | None = None,
) -> Outcome[Images]:
    """Calibrate from data sets; TIFFs and the two settings texts are enough for one.

    Pixels that are not square are resampled, unless markers are given. With markers only
    the frames in which one was marked are used. A motion that was found is added to the
    data sets.

    Args:
        datasets: of the same phantom.
        phantom: a phantom, its name, the path of a phantom file, or UNKNOWN: markers of
            unknown positions, in one data set.
        request: the parameters to estimate; None is the thesis's six parameters, or dO_x
            for unknown markers.
        markers: their pixels in one data set, or a file of them (see `read_markers`);
            None: they are detected in the images.
        scale: a known distance of two unknown markers, or its text (see `Scale.of`).
        radius_px: of their spots; spots of 0.65 to 1.5 times of it are taken; None: any
            that `SpotFinder` accepts.
        typed: the words of the command, for those that are proposed; default: those of
            the data sets' folders.

    Returns:
        Calibration, the document of `flexdt calibrate` with the commands to run next, the
        data sets as used, and the phantom.

    Raises:
        TwinError: no data sets, an option that would have no effect (`RULES`), a radius out
            of range, a phantom without beads, a request of unknown parameters, or invalid
            markers.
    """
    start = time.perf_counter()
    if isinstance(scale, str):
        scale = Scale.of(scale)
    if not datasets:
        raise TwinError("no data sets; allowed: one or more", {"asked": 0, "allowed": 1})
    unknown = phantom == UNKNOWN
    want = request or CalibrationRequest(free=("dO_x",) if unknown else SIX)
    located = {"markers": markers, "scale": scale, "radius": radius_px}
    _require_effect(len(datasets), unknown, want, **located)
    if markers is None:
        datasets = [squared(d) for d in datasets]
    saturated = [finding for d in datasets if (finding := saturation(d)) is not None]
    sought = _spots_of_radius(radius_px)
    marked = None
    if markers is not None:
        marked = read_markers(markers, len(datasets[0]))
        datasets, marked = seen_alone(datasets[0], marked)
    marker_document: dict[str, object] = {}
    if unknown:
        images = DatasetFrames(datasets[0]) if marked is None else None
        result, marker_document = calibrate_unknown(
            datasets[0], images, marked, want, scale, sought
        )
        target = _phantom_of(result.model)
    else:
        target = find_phantom(phantom)
        if marked is not None:
            result = calibrate_known(datasets[0], marked, target, want)
        else:
            result = _calibrate_images(datasets, target, want, sought, saturated)
    result = replace(result, findings=explained_by(saturated, result.findings))
    result = with_undetermined(result)
    seconds = time.perf_counter() - start
    if typed is None:
        typed = typed_words(datasets, phantom, {"free": want.free} if request else {})
    document = calibration_document(result, seconds) | marker_document
    return _outcome(result, document, datasets, target, typed)


def _spots_of_radius(radius_px: float | None) -> SpotFinder | None:
    """Make what finds spots of 0.65 to 1.5 times a radius [px]; None for None.

    Raises:
        TwinError: a radius that `SpotFinder` does not look for.
    """
    if radius_px is None:
        return None
    low, high = SpotFinder().radius_px
    if not low <= radius_px <= high:
        allowed = f"{low:g} to {high:g}"
        raise TwinError.instead(f"radius {radius_px:g} px", float(radius_px), allowed)
    return SpotFinder((0.65 * radius_px, 1.5 * radius_px))


def _require_effect(
    count: int, unknown: bool, request: CalibrationRequest, **located: object
) -> None:
    """Check that every option of a calibration has an effect (`RULES`).

    Args:
        count: number of data sets.
        unknown: whether the positions of markers are to be found.
        request: of the user.
        **located: options that say where beads are; None for those that are not given.

    Raises:
        TwinError: one has none; says with what it has one.
    """
    stated: dict[str, object] = {
        **located,
        "unknown": unknown or None,
        "bead_tolerance": request.bead_tolerance_mm,
        "per_scan": request.per_scan or None,
    }
    given = {name for name, value in stated.items() if value is not None}
    holding = conditions(
        UNKNOWN if unknown else "", count, marked=located["markers"] is not None
    )
    found = misfit(given, holding)
    if found is not None:
        option, sentence = found
        raise TwinError(sentence, {"asked": option, "data_sets": count})


def _phantom_of(model: BeadModel) -> Phantom:
    """Make the phantom of markers whose positions were found; its size includes their
    radii.
    """
    radii = model.bead_radius_mm
    size = tuple((np.ptp(model.beads, axis=0) + 2 * radii.max()).tolist())
    about = "markers of unknown positions"
    return Phantom(UNKNOWN, about, Scene(()), size, model.beads, radii)


def _calibrate_images(
    datasets: Sequence[ImageSet],
    phantom: Phantom,
    request: CalibrationRequest,
    detector: SpotFinder | None,
    saturated: Sequence[Finding],
) -> Calibration:
    """Calibrate from the beads that are detected in the images of data sets; announces
    the work.

    Args:
        datasets: of the phantom.
        phantom: whose beads are detected.
        request: the parameters to estimate.
        detector: finds spots; None for the default.
        saturated: findings on saturated images, which explain an error.
    """
    passes = long_work.Passes(sum(map(len, datasets)))
    scans = [
        Scan(
            DatasetFrames(d, passes.step),
            d.poses,
            d.name,
            prior_widths(d.machine, d.profile),
            arc=exposure_share(d),
        )
        for d in datasets
    ]
    with (
        long_work.during("calibrating") as passes.report,
        saturation_named(saturated),
    ):
        return calibrate(scans, phantom, request, detector=detector)


def _outcome(
    result: Calibration,
    document: dict[str, object],
    datasets: Sequence[Images],
    phantom: Phantom,
    typed: Typed,
) -> Outcome[Images]:
    """Add the found motion to the data sets, and to the document the commands to run next,
    the motion and where all comes from.

    Args:
        result: of the calibration.
        document: of the result; changed.
        datasets: as calibrated.
        phantom: that was scanned.
        typed: the words of the command.
    """
    following = next_commands(result, typed)
    for finding in result.findings.warnings:
        following += angle_commands(finding, typed)
    document["next"] = following
    document["geometry"] = list(typed.geometry)
    motions = result.motions
    if not motions and result.fit is not None:
        motions = told_motions(result.fit)
    if result.identifiable and motions:
        document["motion"] = [m.to_dict() for m in motions]
        datasets = [d.with_motion(m) for d, m in zip(datasets, motions, strict=True)]
    document["datasets"] = [d.where for d in datasets]
    document["phantom"] = phantom.name
    document["dataset_warnings"] = [w for d in datasets for w in d.warnings]
    return Outcome(result, document, tuple(datasets), phantom)


@contextmanager
def saturation_named(saturated: Sequence[Finding]) -> Iterator[None]:
    """Prefix the block's TwinError with the findings on saturated images.

    Raises:
        TwinError: the error, also as it was without such findings.
    """
    try:
        yield
    except TwinError as error:
        if not saturated:
            raise
        causes = "; ".join(finding.text for finding in saturated)
        raise TwinError(f"{causes} ({error})", error.data) from error


def explained_by(saturated: Sequence[Finding], findings: Findings) -> Findings:
    """List findings on saturation first, without those that it falsifies."""
    return Findings(saturated).and_also(findings.unexplained_by(saturated))


def with_undetermined(result: Calibration) -> Calibration:
    """Add the error UNDETERMINED, with the weak directions, to a calibration without
    errors that is not identifiable; others are returned as they are.
    """
    if result.identifiable or result.errors:
        return result
    weak = () if result.fit is None else result.fit.certificate.weak
    return result.with_findings(
        error(CalibrationCode.UNDETERMINED, "; ".join(weak) or "there is no fit")
    )


def saturation(dataset: ImageSet) -> Finding | None:
    """Return a warning if the open beam saturates the detector, else None.

    At least 1 % of every fourth row and column of the flat image reaches 99.9 % of full
    scale. None without machine or flat images. The subtracted body then differs from the
    images'.
    """
    if dataset.machine is None or not dataset.flats:
        return None
    full = (1 << dataset.machine.detector.bits) - 1
    share = float(np.mean(dataset.flat[::4, ::4] >= 0.999 * full))
    if share < 0.01:
        return None
    return warning(
        CalibrationCode.SATURATED,
        f"{dataset.name}: {100 * share:.0f} % of the flat field is saturated: "
        "lower the exposure or the power",
    )


def find_phantom(phantom: str | Phantom) -> Phantom:
    """Return a phantom that has beads, by value, name or file.

    A name that does not ship is read as a file if there is one. A phantom itself is only
    checked.

    Raises:
        TwinError: there is no such phantom, or it has no beads.
    """
    if isinstance(phantom, Phantom):
        target = phantom
    else:
        try:
            target = load_phantom(phantom)
        except UnknownNameError:
            path = Path(phantom)
            if not path.is_file() and not path.suffix and len(path.parts) == 1:
                raise  # a name, and none that ships
            target = read_phantom_file(Path(phantom))
    if len(target.beads) == 0:
        raise TwinError(
            f"phantom {target.name!r} has no beads to calibrate with; `flexdt align`, or "
            "`data.align()`, finds the axis of its scan without any",
            {"asked": target.name},
        )
    return target


NUMBERS: Final = ("value", "sigma", "low", "high", "images")
"""Members of an estimate that are null where they must not be used."""


def calibration_document(result: Calibration, seconds: float) -> dict[str, object]:
    """Make the JSON of `flexdt calibrate`.

    Args:
        result: of the calibration.
        seconds: the calibration took [s].

    Returns:
        verdict, identifiable, parameters, weak directions, findings and the rest of
        docs/calibration.md; numbers are null where they must not be used.
    """
    fit = result.fit
    frames = sum(len(s.frames) for s in result.scans)
    if fit is not None and result.identifiable:
        seen = image_quantities(fit)
    else:
        seen = ()
    document: dict[str, object] = {
        "verdict": verdict_of(result, seen),
        "identifiable": result.identifiable,
        "parameters": {},
        "rank": None,
        "condition": None,
        "weak": [],
        "rms_px": None,
        "cost_reduction_pct": None,
        "iterations": None,
        "frames": frames,
        "detections": result.detections,
        "expected": frames * len(result.model),
        "outliers": [],
        "seconds": round(seconds, 4),
        "problems": [f.to_dict() for f in result.findings],
    }
    if fit is not None:
        document |= _fit_members(result, fit)
        if result.identifiable:
            document |= _use_members(result, fit, seen)
    return document


def _fit_members(result: Calibration, fit: FitResult) -> dict[str, object]:
    """Return the document's members about a fit, which stand whatever its use: estimates,
    certificate, residuals and outliers.

    Estimates have no numbers if there is an error other than `UNDETERMINED`, and none of
    a parameter that is not determined.

    Args:
        result: of the calibration.
        fit: its fit.
    """
    certificate = fit.certificate
    off = np.hypot(*np.moveaxis(certificate.residuals_px, 2, 0))
    offered = not result.errors.without(CalibrationCode.UNDETERMINED)
    return {
        "parameters": {
            name: _estimate_member(e, offered)
            for name, e in certificate.estimates.items()
        },
        "rank": certificate.spectrum.rank,
        "condition": _finite(certificate.spectrum.condition),
        "weak": list(certificate.weak),
        "held": dict(certificate.held),
        "rms_px": _finite(certificate.rms_px),
        "cost_reduction_pct": _finite(fit.cost_reduction_pct),
        "iterations": fit.iterations,
        "outliers": [
            {"frame": o.frame, "marker": o.bead, "px": _finite(off[o.frame, o.bead])}
            for o in certificate.outliers
        ],
        "noise": _finite(certificate.noise),
        "enlargement": certificate.enlargement,
        "reading": fit.reading.value,
        "correlation": [
            [_finite(v) for v in row] for row in certificate.correlation.tolist()
        ],
        "covariance": [
            [_finite(v) for v in row] for row in certificate.covariance.tolist()
        ],
        "degrees_of_freedom": certificate.dof,
        "beads_per_frame": certificate.beads_per_frame.tolist(),
        "rms_per_bead_px": [_finite(v) for v in certificate.rms_per_bead.tolist()],
        "rms_per_frame_px": [_finite(v) for v in certificate.rms_per_frame.tolist()],
    }


def _estimate_member(estimate: Estimate, offered: bool) -> dict[str, object]:
    """Return an estimate as JSON, without `NUMBERS` and priors unless the calibration's
    numbers are `offered` and this one's sigma is finite.
    """
    if offered and math.isfinite(estimate.sigma):
        return asdict(estimate)
    return asdict(estimate) | dict.fromkeys(NUMBERS) | {"priors": {}}


def _use_members(
    result: Calibration, fit: FitResult, seen: Sequence[Mapping[str, Estimate]]
) -> dict[str, object]:
    """Return the document's members of an identifiable calibration: correction, panel if
    there is one, limits, and what the images show.

    Args:
        result: of the calibration.
        fit: its fit.
        seen: its `image_quantities`, of each group of frames.
    """
    panel = {} if result.panel is None else {"panel": result.panel.to_json()}
    return {
        "correction": fit.parameters.to_edge(),
        **panel,
        "limited": fit.certificate.limited,
        "image_space": [
            {
                n: {"value": e.value, "sigma": e.sigma, "unit": e.unit}
                for n, e in some.items()
            }
            for some in seen
        ],
        "reliability": [asdict(one) for one in result.reliability],
    }


def unseen(causes: Sequence[Mapping[str, Any]]) -> str:
    """Write which cause could shift the axis most without being seen, and which could change
    lengths most; "" without causes.

    Args:
        causes: the document's "reliability".
    """
    if not causes:
        return ""
    axis = max(causes, key=lambda c: c["axis_px"])
    lengths = max(causes, key=lambda c: c["lengths"])
    parts = (
        (axis, f"shift the axis by {axis['axis_px']:.2g} px"),
        (lengths, f"change lengths by {100 * lengths['lengths']:.2g} %"),
    )
    return "Too small to be seen: " + "; ".join(
        f"{cause['cause']} (spots move by {cause['size_px']:.2g} px) could {effect}"
        for cause, effect in parts
    )


def inside_95(outcome: Outcome[ImageSet], truth: Mapping[str, float]) -> bool:
    """Return whether a truth is in the joint 95 % region of the estimated parameters.

    Args:
        outcome: of a calibration.
        truth: offset -> value in edge units [mm, deg]; offsets that it leaves out are
            nominal, and lengths as told. alpha is compared modulo a turn. A parameter of
            several scans is compared in each.

    Returns:
        False also where nothing is identifiable, or where a parameter that was neither
        estimated nor had a prior differs from the value that was assumed.
    """
    fit = outcome.calibration.fit
    if fit is None or not outcome.calibration.identifiable:
        return False
    true = from_printed_reading(Offsets.from_edge(truth), fit.reading).to_edge()
    values = {}
    for name, estimate in fit.certificate.estimates.items():
        base = name.split("@")[0]
        values[name] = true.get(base, 0.0)  # lengths are as told
        if base == "alpha":
            # Whole turns of the start angle are the same geometry.
            off = math.remainder(true[base] - estimate.value, 360.0)
            values[name] = estimate.value + off
    estimated = {n.split("@")[0] for n in values}
    assumed = fit.parameters.to_edge()
    stated = Offsets.from_edge(truth).to_edge()
    rest = all(abs(stated[n] - assumed[n]) < 1e-9 for n in NAMES if n not in estimated)
    return rest and bool(fit.certificate.inside_95(values))


def _finite(value: float) -> float | None:
    if np.isfinite(value):
        return float(value)
    return None


SHARP_PX: Final = 0.25
"""Largest sigma of the axis column with which a volume is as sharp as its voxels [px]; assumed:
a column that is off by d makes an edge d pixels wider."""
SECOND_SOD_RATIO: Final = 0.7
"""Source-object distance of a second placement over the first's: nearer, where offsets
act differently."""


SPOILT: Final[Mapping[CalibrationCode, str]] = {
    CalibrationCode.SATURATED: "the flat field is saturated",
    CalibrationCode.ROWS_IN_TURN: "volumes are twisted, because rows are read in turn",
    CalibrationCode.DRIFT: "something drifts or jumps, and the geometry is that of the mean",
    CalibrationCode.VIBRATION: "something shakes, and the geometry is that of the mean",
    CalibrationCode.WOBBLE: "the axis wobbles, and the geometry is that of the mean",
    CalibrationCode.ANGLES_WRONG: "angles err, and the geometry is that of their mean",
}
"""Finding beside which the images are not to be reconstructed -> why, in words."""
LEAST_SCALE_SHARE: Final = 0.3
"""Part of it that the phantom's scale has, from which that is told."""
LEAST_LENGTH_PART: Final = 1e-6
"""Relative standard deviation of lengths from which it is told."""


def verdict_of(result: Calibration, seen: Sequence[Mapping[str, Estimate]]) -> str:
    """Return one sentence on use, and two on the limits of the calibration.

    If it is not to be used, one sentence with the first error, weak direction or lack of
    a fit. Sharp is an axis known to `SHARP_PX`. With a finding of `SPOILT` the images are
    not to be reconstructed, sharp or not. The second sentence is about the least certain
    requested length, the third about lengths in volumes; each is left out if there is none.

    Args:
        result: of a calibration.
        seen: its `image_quantities`, of each group of frames; empty where it must not be
            used.
    """
    if not result.identifiable or result.fit is None:
        weak = () if result.fit is None else result.fit.certificate.weak
        why = [f.text for f in result.errors] or list(weak) or ["there is no fit"]
        stop = "" if why[0].endswith("?") else "."
        return f"Not to be used: {why[0]}{stop}"
    column = _column(seen)
    if column.sigma <= SHARP_PX:
        use = "Safe to reconstruct"
    else:
        use = "Too uncertain for a sharp volume"
    if result.findings.of(CalibrationCode.PANEL_DISTORTED):
        use += " with this correction, which undoes the panel's distortion"
    spoilt = [why for code, why in SPOILT.items() if result.findings.of(code)]
    if spoilt:
        use = f"Geometry to be used, images not to be reconstructed ({'; '.join(spoilt)})"
    first = f"{use}: the rotation axis is known to {rounded_up(column.sigma)} px."
    lengths = {
        n: e
        for n, e in result.fit.certificate.estimates.items()
        if e.asked and e.unit == "mm" and math.isfinite(e.sigma)
    }
    third = _lengths_in_volumes(result, seen)
    if not lengths:
        return f"{first}{third}"
    name, widest = max(lengths.items(), key=lambda item: item[1].sigma)
    second = f" Absolute position: to {widest.sigma:.2g} mm ({name})"
    if _by_priors(widest):
        second += f", limited by what is not known of {', '.join(widest.priors)}"
    return f"{first}{second}.{third}"


def _lengths_in_volumes(
    result: Calibration, seen: Sequence[Mapping[str, Estimate]]
) -> str:
    """Write how well lengths in a volume are known, and which part of that is the phantom's
    scale; "" where nothing limits them.
    """
    assert result.fit is not None
    part = max(q["magnification"].sigma / q["magnification"].value for q in seen)
    scale = result.fit.certificate.estimates.get(PHANTOM)
    if not LEAST_LENGTH_PART < part < math.inf:
        return ""
    text = f" Lengths in volumes: to {100.0 * part:.2g} %"
    own = 0.0 if scale is None else scale.priors.get(TOLD_SOURCES[PHANTOM], 0.0)
    if scale is not None and own > LEAST_SCALE_SHARE * part:
        assumed = result.model.stated is None and scale.prior == STRAIN
        known = "assumed" if assumed else "stated"
        text += f", of this {100.0 * own:.2g} % is the phantom's {known} scale"
    return f"{text}."


def _column(seen: Sequence[Mapping[str, Estimate]]) -> Estimate:
    """Return the axis column of the group of frames that determines it least."""
    return max((q["axis_column"] for q in seen), key=lambda e: e.sigma)


def _is_sharp(fit: FitResult) -> bool:
    return _column(image_quantities(fit)).sigma <= SHARP_PX


def next_commands(result: Calibration, typed: Typed) -> list[str]:
    """List commands that would determine more, or settle an error; most useful first.

    With an error other than UNDETERMINED, those that settle the first one. Else
    "reconstruct" if the geometry is sharp, and two scans at different SOD unless it is
    sharp and not limited by priors; if it is not sharp and something moves, those that
    follow the motion alone.

    Args:
        result: of the calibration.
        typed: the calibration as words of its command.
    """
    if result.fit is None:
        estimates = {}
    else:
        estimates = result.fit.certificate.estimates
    # Names of several scans end in @SCAN.
    asked = [name for name, e in estimates.items() if e.asked]
    free = list(dict.fromkeys(name.split("@")[0] for name in asked))
    if result.errors and result.errors[0].code is not CalibrationCode.UNDETERMINED:
        return list(settling_commands(result.errors[0], typed, free))
    limited = any(_by_priors(estimates[name]) for name in asked)
    sharp = result.fit is not None and result.identifiable and _is_sharp(result.fit)
    for moving in result.findings:
        if moving.advice.per_frame:
            follow = list(settling_commands(moving, typed, free))
            return [*follow, typed.use()] if sharp else follow
    distances = np.concatenate([scan.poses.sod for scan in result.scans])
    placed = distances.min() <= math.sqrt(SECOND_SOD_RATIO) * distances.max()
    if sharp and (placed or not limited):
        return [typed.use()]
    sod = float(result.scans[0].poses.sod.mean())
    both = typed.command(data=("PLACE-1", "PLACE-2"))
    if typed.geometry:
        # Scripts are for the machine that a data set names.
        closer = [
            f"{both}  # scan the phantom at SOD {SECOND_SOD_RATIO * sod:.0f} mm, too"
        ]
    else:
        places = f"--position {sod:.0f} --position {SECOND_SOD_RATIO * sod:.0f}"
        closer = [
            f"flexdt script new --kind calibration {places} --out two-places.txt",
            both,
        ]
    if not sharp:
        return closer
    why = "for the absolute position, which volumes do not need"
    return [
        typed.use(),
        *(f"{line}{'; ' if '  # ' in line else '  # '}{why}" for line in closer),
    ]


def _by_priors(estimate: Estimate) -> bool:
    return bool(estimate.priors) and estimate.sigma**2 > 2 * estimate.images**2


def digits(value: float | None, sigma: float | None) -> str:
    """Format a value to the digits that its sigma leaves."""
    if value is None or sigma is None or not sigma > 0:
        return "-"
    return f"{value:.{min(max(1 - math.floor(math.log10(sigma)), 0), 9)}f}"


def rounded_up(sigma: float) -> str:
    """Format a sigma rounded up to one digit: 0.012 is 0.02; "0" unless it is positive."""
    if not sigma > 0:
        return "0"
    place = math.floor(math.log10(sigma))
    return f"{math.ceil(sigma / 10.0**place) * 10.0**place:.1g}"


def ranges(numbers: Iterable[int]) -> str:
    """Format numbers in growing order as ranges of successive ones: "2, 5-9, 12"; "" for
    none.
    """
    runs = [
        [n for _, n in run]
        for _, run in groupby(enumerate(sorted(numbers)), lambda pair: pair[1] - pair[0])
    ]
    return ", ".join(str(r[0]) if len(r) == 1 else f"{r[0]}-{r[-1]}" for r in runs)
