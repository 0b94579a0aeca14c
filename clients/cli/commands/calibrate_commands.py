"""`flexdt calibrate`, `align` and `compare`: geometry from scans with and without a
bead phantom, and a check of it.

The work is in `flexdt.library.calibration`; these commands pass options to it, print the result
and choose the exit code.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import typer

from flexdt.clients.cli import option_values, options, value_completion
from flexdt.clients.cli.boundary import NOT_IDENTIFIABLE
from flexdt.clients.cli.command_settings import CalibrateSettings
from flexdt.clients.cli.commands.data_commands import (
    geometry_options,
    read_geometry,
    scan_of,
)
from flexdt.clients.cli.console import as_json, note, table, warn
from flexdt.clients.cli.options import Answer, Twin, argument, option
from flexdt.clients.cli.settings_file import chosen
from flexdt.library.failure import CommandError
from flexdt.runtime.files.whole_files import write_whole

if TYPE_CHECKING:
    from flexdt.clients.client.client import TwinClient
    from flexdt.library.calibration.calibration_options import CalibrationOptions
    from flexdt.library.data_set import DataSet
    from flexdt.library.datasets.exchange import Given
    from flexdt.twin.scanner.state import NamedCorrection

ReadingName = Literal["axis", "mount"]


def calibrate(
    twin: Twin,
    datasets: list[Path] | None = argument(None, "[DATASET...]"),
    phantom: str | None = option(
        None,
        metavar="NAME, FILE or unknown",
        proposes=value_completion.calibration_targets,
    ),
    free: options.Free = None,
    per_scan: str = option("", metavar="P,P,..."),
    per_frame: str = option("", metavar="P,P,..."),
    reading: ReadingName = option("axis"),
    report: Path | None = option(None, metavar="FILE.{html,json}", written=True),
    tracks: Path | None = option(None, metavar="FILE.json", written=True),
    geometry: list[Path] | None = option(None, metavar="FILE"),
    bead_tolerance: float | None = option(None, metavar="MM"),
    prior: list[str] | None = option(
        None, "--prior", "--exclude", metavar="P=SIGMA or CAUSE,..."
    ),
    frames: Path | None = option(None, metavar="DIR"),
    shape: str | None = option(None, metavar="ROWS,COLS"),
    pixel: str | None = option(None, metavar="MM or U,V"),
    markers: Path | None = option(None, metavar="FILE"),
    scale: str | None = option(None, metavar="A-B=MM"),
    radius: float | None = option(None, metavar="PX"),
    start: list[str] | None = option(None, metavar="P=V,..."),
    push: options.Push = False,
) -> Answer:
    """Calibrate the geometry from scans of a bead phantom or of unknown markers.

    A data set may be a folder of TIFFs with the two settings texts alone; --frames and
    --geometry are for those of any other scanner, --markers for beads marked by hand. Exit
    code 5 when the data cannot determine the parameters; then nothing is pushed.

    Args:
        phantom: Use this phantom's beads; unknown: markers anywhere.
        per_scan: Give these parameters a value in each scan.
        per_frame: Let these parameters move during the scan.
        reading: Read eq. 5.4 as the axis at O + tau, or as R (b - tau) + O.
        report: Write the report to FILE (HTML or JSON).
        tracks: Write the beads of every frame, seen, before and after.
        geometry: Start from this geometry; once for each data set, in order.
        bead_tolerance: Estimate the beads' places, too, known to this tolerance.
        prior: State how well others are known, 0 exactly; none: all. Exclude a CAUSE.
        frames: Read any scanner's TIFFs, with --geometry.
        shape: Take this detector shape where FILE does not say it.
        pixel: Take this pixel pitch where FILE does not say it (RTK).
        markers: Read where markers were seen, in pixels (CSV or npy).
        scale: Set the distance of two unknown markers.
        radius: Look for bead spots of this radius.
        start: Begin at these offsets (mm, deg).

    Yields:
        The report as document of --json, then its lines (`show`); problems go to standard
        error. Raises CommandError with NOT_IDENTIFIABLE, and usage errors before images
        are read. With --push the twin has to answer before the work begins.
    """
    if report is not None:
        option_values.require_ending(report, ".html", ".json")
    from flexdt.library.calibration.bead_tracks import write_tracks
    from flexdt.library.calibration.calibrate import calibrate_with
    from flexdt.library.calibration.calibration_report import write_report
    from flexdt.library.calibration.calibration_request import request_of
    from flexdt.library.calibration.proposed_commands import Typed, option_words
    from flexdt.library.figures import require_plots

    options: CalibrationOptions = {
        "free": None if free is None else option_values.names(free),
        "per_scan": option_values.names(per_scan),
        "per_frame": option_values.names(per_frame),
        "reading": reading,
        "bead_tolerance": bead_tolerance,
        "priors": "none" if prior == ["none"] else _read_priors(prior),
        "start": _read_assignments(start),
        "bound": chosen(CalibrateSettings).bound,
        "markers": markers,
        "scale": scale,
        "radius": radius,
    }
    folders = datasets or []
    geometries = geometry or []
    target = _require_phantom(phantom)
    own = {"shape": shape, "pixel": pixel, "push": push or None}
    _require_effect(target, options, own, len(folders), geometry=bool(geometries))
    if push:
        _require_answer(twin)
    as_json_file = report is not None and report.suffix.lower() == ".json"
    if report is not None and not as_json_file:
        require_plots()
    request_of(target, options)  # refuses impossible options before images are read
    known = geometry_options(None, shape, pixel)
    given = _load_inputs(folders, frames, markers, geometries, known)
    typed = Typed(
        tuple(map(str, folders)),
        target,
        tuple(map(str, geometries)),
        option_words(options) | _words(frames=frames, shape=shape, pixel=pixel),
        str(report) if as_json_file else None,
    )
    outcome = calibrate_with(given, target, options, typed)
    if report is not None:
        write_report(outcome, report)
    if tracks is not None:
        write_tracks(outcome, tracks)
    document: dict[str, Any] = outcome.document
    yield document
    yield from show(document)
    _report_problems(document)
    if push:
        _push(twin, outcome.correction, outcome.sources, document)


def _report_problems(document: Mapping[str, Any]) -> None:
    """Write the problems of a calibration to standard error.

    Raises:
        CommandError: it is not identifiable; names the errors' codes.
    """
    for problem in document["problems"]:
        note(f"{problem['severity']}: {problem['text']} [{problem['code']}]")
    if not document["identifiable"]:
        codes = ", ".join(
            p["code"] for p in document["problems"] if p["severity"] == "error"
        )
        raise CommandError(f"not to be used{codes and ': '}{codes}", NOT_IDENTIFIABLE)


def _require_effect(
    phantom: str,
    options: CalibrationOptions,
    own: Mapping[str, object],
    count: int,
    *,
    geometry: bool,
) -> None:
    """Check that every option has an effect, before anything is read (`RULES`).

    Args:
        phantom: its name or file.
        options: those that Python has, too.
        own: those of the command alone; None for those that are not given.
        count: number of data sets.
        geometry: whether a file of geometry is given.

    Raises:
        typer.BadParameter: one has none; says with what it has one.
    """
    from flexdt.library.calibration.calibration_options import conditions, misfit

    stated = {**options, **own, "unknown": phantom == "unknown" or None}
    given = {name for name, value in stated.items() if value not in (None, [], ())}
    holding = conditions(
        phantom,
        count,
        marked=options.get("markers") is not None,
        geometry=geometry,
        joint=not options.get("per_scan"),
    )
    found = misfit(given, holding, lambda name: f"--{name.replace('_', '-')}")
    if found is not None:
        raise typer.BadParameter(found[1])


def _words(**options: object) -> dict[str, str]:
    """Return those of the command's options that were given, as they were typed."""
    return {name: str(value) for name, value in options.items() if value is not None}


def _read_priors(given: list[str] | None) -> dict[str, float]:
    """Read P=SIGMA,... of an option that may be given several times; a cause without a figure
    is excluded, its figure is 0.
    """
    from flexdt.twin.machine.stated_causes import CAUSES

    words = [word.strip() for one in given or () for word in one.split(",")]
    return option_values.assignments(f"{w}=0" if w in CAUSES else w for w in words)


def _read_assignments(given: list[str] | None) -> dict[str, float]:
    """Read P=VALUE,... of an option that may be given several times."""
    return option_values.assignments(
        word for one in given or () for word in one.split(",")
    )


def _require_phantom(phantom: str | None) -> str:
    """Return the named phantom; none is a usage error that lists those that ship.

    Whether it exists is not checked here.
    """
    if phantom is None:
        from flexdt.phantoms import phantom_names

        raise typer.BadParameter(
            f"--phantom is missing: a phantom file, or one of {', '.join(phantom_names())}"
        )
    return phantom


def _load_inputs(
    folders: list[Path],
    frames: Path | None,
    markers: Path | None,
    geometries: list[Path],
    known: Given,
) -> list[DataSet]:
    """Load the data sets, any scanner's frames, or the geometry of markers without images.

    Frames come before markers if both are given. Markers alone give one data set without images,
    named by their file.

    Args:
        folders: data sets; none needs `frames` or `markers`.
        frames: folder of any scanner's TIFFs.
        markers: file of markers seen in the images.
        geometries: files, one for each data set; exactly one without data sets.
        known: detector shape and pitch that the files lack.

    Returns the data sets.
    Raises typer.BadParameter: options that do not go together.
    """
    if folders:
        if frames is not None:
            raise typer.BadParameter("--frames and a data set; give one")
        return _load_data_sets(folders, geometries, known)
    if len(geometries) != 1 or (frames is None and markers is None):
        raise typer.BadParameter(
            "no data set; allowed: --frames DIR or --markers FILE, and one "
            "--geometry FILE"
        )
    cone = read_geometry(geometries[0], known)
    if frames is not None:
        from flexdt.library.reading.folders import read_tiffs

        return [read_tiffs(frames, cone)]
    from flexdt.library.reading.listed_images import markers_alone

    assert markers is not None
    return [markers_alone(cone, markers.stem)]


def _load_data_sets(
    folders: list[Path], geometries: list[Path], known: Given
) -> list[DataSet]:
    """Load the data sets, each with its own geometry or that of its file.

    With files, folders of anybody's TIFFs are data sets, too. `known`: detector shape and
    pitch that files lack. Raises typer.BadParameter: another number of geometries.
    """
    from flexdt.library.reading.folders import load_dataset

    if not geometries:
        return [load_dataset(folder) for folder in folders]
    if len(geometries) != len(folders):
        raise typer.BadParameter(
            f"{len(geometries)} geometries for {len(folders)} data sets"
        )
    return [
        load_dataset(folder, geometry=read_geometry(file, known))
        for folder, file in zip(folders, geometries, strict=True)
    ]


def align(
    twin: Twin,
    dataset: Path = argument(..., "DATASET"),
    out: Path | None = option(None, metavar="FILE.json", written=True),
    per_frame: bool = option(False),
    push: options.Push = False,
    geometry: options.Geometry = None,
) -> Answer:
    """Find axis and source plane of an ordinary scan, without a phantom.

    Axis column and, if the object determines them, roll and yaw of the panel and row of the
    plane in which the source turns. Exit code 5 when the scan cannot determine the column;
    then there is no correction.

    Args:
        out: Write the report, for flexdt reconstruct --correction.
        per_frame: Find shifts of single frames (jitter) too.

    Yields:
        The report as document of --json, then tables and lines; warnings go to standard
        error. Raises CommandError with NOT_IDENTIFIABLE if the axis column is not
        determined; --out has to end with .json.
    """
    if out is not None:
        option_values.require_ending(out, ".json")
    from flexdt.library.calibration.align_dataset import align_dataset

    if push:
        _require_answer(twin)
    data = scan_of(dataset, False, None, geometry)
    found = align_dataset(data, per_frame)
    document: dict[str, Any] = found.document
    if geometry is not None:
        document["geometry"] = [str(geometry)]
    if out is not None:
        write_json(out, document)
    warn(found.warnings)
    yield document
    rows = [
        (name, _number(p["value"], 5), _number(p["sigma"], 5), p["unit"])
        for name, p in document["parameters"].items()
    ]
    yield table(rows, ("parameter", "value", "sigma", "unit"))
    yield f"{document['frames']} frames, {_number(document['seconds'], 2)} s"
    yield from motions(document)
    reasons: dict[str, list[str]] = {}
    for name, why in found.alignment.refused.items():
        reasons.setdefault(why, []).append(name)
    for why, names in reasons.items():
        yield f"not told: {', '.join(names)}: {why}"
    if not found.identifiable:
        why = found.alignment.refused["axis_column_px"]
        raise CommandError(f"not identifiable: {why}", NOT_IDENTIFIABLE)
    if push:
        _push(twin, found.correction, found.dataset.name, document)


def compare(
    dataset: Path = argument(..., "DATASET"),
    phantom: str | None = option(
        None, metavar="NAME or FILE", proposes=value_completion.bead_phantom_names
    ),
    tolerance: float = option(0.5, metavar="PX", min=0.0),
    out: Path | None = option(None, metavar="DIR"),
) -> Answer:
    """Lay virtual projections beside a data set's radiographs.

    The twin is posed from the data set's texts; residuals and difference images are given
    before and after the correction that calibration finds. Exit code 1 above the tolerance.

    Args:
        phantom: Compare with this phantom, the one that was scanned.
        tolerance: Exit with 1 where the beads' rms is above this.
        out: Write a report and difference images to this folder.

    Yields:
        The document of --json, then a table of residuals before and after. Raises
        CommandError above the tolerance, after the files are written.
    """
    from flexdt.library.comparison import (
        compare_folder,
        rows_of,
        write_comparison,
    )
    from flexdt.library.figures import require_plots

    if out is not None:
        require_plots()
    found = compare_folder(dataset, _require_phantom(phantom), tolerance)
    if out is not None:
        write_comparison(found, out)
    document: dict[str, Any] = found.document
    yield document
    rows = [
        (name, *(_number(n, 4) for n in figures)) for name, *figures in rows_of(document)
    ]
    yield table(rows, ("correction", "rms [px]", "worst bead [px]", "difference rms"))
    if not found.within:
        rms = _number(document["after"]["rms_px"], 4)
        raise CommandError(
            f"{dataset}: rms {rms} px after correction, allowed {tolerance:g} px"
        )


def _require_answer(twin: Twin) -> None:
    """Connect to the twin: report before the work, not after it, that it does not
    answer."""
    with twin():
        pass


def _push(
    twin: Twin, correction: NamedCorrection, source: str, document: Mapping[str, object]
) -> None:
    """Put a correction in force on the twin, with a note on standard error.

    A motion in `document` is not, with a warning. `source`: of the data set.
    """
    with twin() as client:
        push_correction(client, correction, source)
    note(f"in force on the twin: {correction.name}")
    if "motion" in document:
        note("warning: a twin's correction is the same in all frames, without the motion")


def push_correction(client: TwinClient, correction: NamedCorrection, source: str) -> None:
    """Put a correction in force on the twin: the parameters that differ from the nominal ones.

    Values are in the wire's units [mm, deg]; nominal offsets give an empty correction.

    Args:
        client: of the twin.
        correction: name, note and offsets.
        source: name of the data set it is from.
    """
    from flexdt.twin.geometry.offsets import NOMINAL

    nominal = NOMINAL.to_edge()
    parameters = {
        n: v for n, v in correction.parameters.to_edge().items() if v != nominal[n]
    }
    client.apply_calibration(
        parameters,
        correction.name,
        comment=correction.note,
        source=source,
        sides_known=correction.sides_known,
    )


def show(document: Mapping[str, Any]) -> Iterator[str]:
    """Yield a calibration's document as text: its use first, then images and offsets.

    Without a fit only the verdict, next steps and detected beads are shown; without a
    scale no markers. Offsets are shown only if identifiable.

    Args:
        document: of a calibration report.

    Yields:
        Lines and tables: verdict, next steps, parameters, beads left out, motion,
        markers.
    """
    yield document["verdict"]
    for line in document.get("next", ()):
        yield f"next: {line}"
    rows = [
        (
            f"{name}, scan {k}" if k else name,
            *_round_estimate(q, "value", "sigma"),
            _unit(q["unit"]),
        )
        for k, place in enumerate(document.get("image_space", ()))
        for name, q in place.items()
    ]
    if rows:
        yield table(rows, ("in the images", "value", "sigma", "unit"))
    from flexdt.library.calibration.calibrate import ranges, unseen

    if text := unseen(document.get("reliability", ())):
        yield text
    beads = f"{document['detections']} of {document['expected']} beads"
    seen = f"{document['frames']} frames, {beads} seen"
    if document["rms_px"] is None:
        yield f"{seen}: no fit, {_number(document['seconds'], 2)} s"
        return
    if document["identifiable"]:
        heads = ("parameter", "value", "sigma", "of images", "unit")
        yield table(parameter_rows(document), heads)
        others = sum(not p["asked"] for p in document["parameters"].values())
        yield (
            "of images: the part of sigma that is the images' noise; --report lists the "
            f"{others} others that are estimated along"
        )
    rms = _number(document["rms_px"], 4)
    seconds = _number(document["seconds"], 2)
    yield f"{seen}, {len(document['outliers'])} of these left out, rms {rms} px, {seconds} s"
    if picture := frames_picture(document["rms_per_frame_px"]):
        yield picture
    frames: dict[int, list[int]] = {}
    for one in document["outliers"]:
        frames.setdefault(one["marker"], []).append(one["frame"])
    for marker, left_out in sorted(frames.items()):
        yield f"left out: bead {marker} of frames {ranges(left_out)}"
    yield from motions(document)
    if "scale" in document:
        rows = [
            (m["name"], m["position_mm"], m["frames"], _number(m["rms_px"], 3))
            for m in document["markers"]
        ]
        yield table(rows, ("marker", "x, y, z [mm]", "frames", "rms [px]"))
        if document["scale"] == "free":
            free = "; give the distance of two: --scale A-B=MM"
        else:
            free = ""
        yield f"scale: {document['scale']}{free}"
    for text in document["weak"]:
        yield f"weak: {text}"


def motions(document: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each parameter that may have moved in each scan of a report: its
    range, unit and mean sigma, or that no motion was found; nothing without a motion.
    """
    for moved in document.get("motion", ()):
        for name, told in moved.items():
            if not told["moves"]:
                yield f"no motion of {name} was found"
                continue
            values = told["values"]
            sigma = sum(told["sigmas"]) / len(values)
            yield (
                f"{name} moves by {max(values) - min(values):.3g} {told['unit']} during the scan, "
                f"each frame known to {sigma:.2g}"
            )


def parameter_rows(document: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Make rows of the parameters asked for: name, value, sigma, images' part, unit.

    Digits are those that sigma leaves.
    """
    return [
        (
            name,
            *_round_estimate(p, "value", "sigma", "images"),
            _unit(p["unit"]),
        )
        for name, p in document["parameters"].items()
        if p["asked"]
    ]


LEVELS = " .:-=+*#"
"""Characters of a picture in one line, from 0 to the largest."""
MOST_MARKS = 60
"""Characters of such a picture at most."""


def frames_picture(rms_px: Sequence[float | None]) -> str:
    """Draw the residuals of frames in a line, each mark the largest of its frames; "" without
    any.
    """
    known = [0.0 if rms is None else rms for rms in rms_px]
    top = max(known, default=0.0)
    if not top > 0.0:
        return ""
    size = -(-len(known) // MOST_MARKS)
    parts = (max(known[i : i + size]) for i in range(0, len(known), size))
    marks = "".join(LEVELS[round((len(LEVELS) - 1) * part / top)] for part in parts)
    return f"residuals of frames [{marks}] up to {_number(top, 2)} px"


def write_json(path: Path, document: Mapping[str, object]) -> None:
    """Write a document; it gets its final name only when it is complete."""
    write_whole(path, as_json(document) + "\n")


def _round_estimate(estimate: Mapping[str, Any], *names: str) -> Iterator[str]:
    """Format numbers of an estimate to the digits that its sigma leaves."""
    from flexdt.library.calibration.calibrate import digits

    return (digits(estimate[name], estimate["sigma"]) for name in names)


def _unit(unit: str) -> str:
    return "" if unit == "1" else unit


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
