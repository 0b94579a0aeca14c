"""`flexdt reconstruct`, `export` and `import`: volumes from data sets, geometry in other
formats.

The work is in `flexdt.library.reconstruction` and `flexdt.library.datasets.exchange`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, assert_never

import typer

from flexdt.clients.cli import option_values, options
from flexdt.clients.cli.command_settings import ReconstructSettings
from flexdt.clients.cli.console import duration, note, size, warn
from flexdt.clients.cli.options import Answer, Twin, argument, option
from flexdt.clients.cli.settings_file import chosen
from flexdt.library.datasets.exchange_formats import FORMATS, exported, imported
from flexdt.library.failure import CommandError
from flexdt.runtime.files.limited_files import limited_text
from flexdt.runtime.files.whole_files import bytes_of
from flexdt.twin import long_work
from flexdt.twin.algorithms import ALGORITHMS, DEFAULT, misfit

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from flexdt.library.data_set import DataSet
    from flexdt.library.datasets.exchange import Given
    from flexdt.twin.geometry.cone_vec import ConeVec
    from flexdt.twin.geometry.offsets import Offsets


def reconstruct(
    twin: Twin,
    dataset: Path = argument(..., "DATASET"),
    out: Path = option(..., metavar="FILE", written=True),
    algorithm: str | None = option(None, among=lambda: ALGORITHMS),
    voxel: float | None = option(None, metavar="MM"),
    shape: str | None = option(None, metavar="Z,Y,X"),
    binning: int | None = option(None, min=1),
    every: int | None = option(None, min=1),
    iterations: int | None = option(None, min=1),
    weight: float | None = option(None, min=0.0),
    correction: str | None = option(None, metavar="FILE, twin or none"),
    center: str | None = option(None, metavar="X,Y,Z"),
    texts: options.Texts = False,
    rings: bool = option(False, "--rings"),
    material: str | None = option(None, metavar="MATERIALS"),
    scatter_correction: str | None = option(None, metavar="MATERIALS"),
    kv: float | None = option(None),
    png: bool = option(False, "--png"),
    preview: bool = option(False, "--preview"),
    geometry: options.Geometry = None,
    scheduler: options.Scheduler = None,
    slurm: Path | None = option(None, metavar="FILE"),
) -> Answer:
    """Reconstruct a volume from a data set.

    Layers go from the lowest up, rows along +y, columns along +x; values are attenuation in
    1/mm.

    Args:
        out: Write the volume: .tif, .nrrd, .mha, .nii.gz, .h5 or .zarr.
        algorithm: Use this algorithm; default: fdk.
        voxel: Set the voxels' edge; default: a pixel's size at the axis.
        shape: Set the number of voxels; default: the field of view.
        binning: Average so many pixels a side first.
        every: Use every n-th frame.
        iterations: Iterate so often; default: the algorithm's.
        weight: Weigh the total variation of tv by this.
        correction: Apply a report's correction, or the twin's; default: the scan's.
        center: Put the volume's center there [mm].
        rings: Correct the images for rings.
        material: Correct beam hardening of this material; sirt, sart: of several.
        scatter_correction: Subtract the scatter of an object of these, e.g. pmma,aluminium.
        kv: Take this tube voltage; default: the data set's.
        png: Write three slices beside the volume.
        preview: Make a quick, coarse FDK volume, and PNG slices.
        slurm: Submit workers to SLURM as this file says.

    Yields:
        The document of --json (shape, voxel, frames, accuracy, warnings, seconds), then
        lines: file and size, accuracy if known, files of slices. Warnings and missing
        frames are written to standard error. Raises typer.BadParameter for options that
        exclude each other.
    """
    own = {
        "algorithm": None if algorithm == DEFAULT else algorithm,
        "voxel": voxel,
        "shape": shape,
        "binning": binning,
        "every": every,
        "iterations": iterations,
        "weight": weight,
        "center": center,
        "rings": rings or None,
        "material": material,
        "scatter-correction": scatter_correction,
        "scheduler": scheduler,
        "slurm": slurm,
    }
    other = {"kv": kv, "correction": correction, "geometry": geometry}
    given = {name: value for name, value in (own | other).items() if value is not None}
    _check_together(
        given, out, [name for name in own if name in given] if preview else []
    )
    from flexdt.library.reconstruction.reconstruct import (
        VolumeRequest,
        reconstruct_dataset,
    )
    from flexdt.library.reconstruction.reconstruct import preview as quick_look

    voxels = option_values.if_given(shape, _shape)
    scattering = option_values.if_given(scatter_correction, option_values.names)
    made_of = option_values.if_given(material, option_values.names)
    center_mm = option_values.if_given(center, _center)
    # A key of the settings file is for whatever has it; an option is for this command.
    windowed = "window" in ALGORITHMS[algorithm or DEFAULT].options
    request = VolumeRequest(
        algorithm=algorithm or DEFAULT,
        voxel_mm=voxel,
        shape=voxels,
        binning=binning or 1,
        every=every or 1,
        iterations=iterations,
        weight=weight,
        window=chosen(ReconstructSettings).window if windowed else None,
        center_mm=center_mm,
        rings=rings,
        material=made_of,
        kV=kv,
        scatter_correction=scattering,
        png=png,
    )
    option_values.require_folder(out)
    parameters, report = _correction(correction, twin)
    if correction is not None and geometry is not None:
        _require_of_geometry(correction, report)
    # Workers have working directories of their own.
    shared = scheduler is not None or slurm is not None
    data = scan_of(dataset.resolve() if shared else dataset, texts, report, geometry)
    warn(data.warnings, dataset)
    if data.missing:
        note(
            f"{dataset}: warning: {len(data.missing)} frames are missing and are left out"
        )
    workers = _workers(scheduler, slurm)
    unit = _unit_of_progress(request.algorithm, shared)
    with long_work.during(f"{request.algorithm} of {dataset.name}") as advance:
        counted = long_work.in_units(advance, unit)
        if preview:
            document = quick_look(data, out, parameters=parameters, progress=counted)
        else:
            document = reconstruct_dataset(
                data,
                out,
                request,
                parameters=parameters,
                progress=counted,
                workers=workers,
                memory=chosen(ReconstructSettings).memory,
            )
    warn(document["warnings"], dataset)
    yield document
    yield from _lines_of(document, out)


def _unit_of_progress(algorithm: str, shared: bool) -> str:
    """Return what the progress of an algorithm counts; `shared` if workers do it."""
    if not ALGORITHMS[algorithm].direct:
        return "iterations"
    return "slabs" if shared else "images"


def _lines_of(document: Mapping[str, Any], out: Path) -> Iterator[str]:
    """Yield the document of a volume as lines: file and size, accuracy if known, files of
    slices.
    """
    from flexdt.twin.projection.volume import Accuracy

    z, y, x = document["shape"]
    yield (
        f"{out}: {x} x {y} x {z} voxels of {document['voxel_mm']:g} mm from "
        f"{document['frames']} frames, {size(bytes_of(out))}, "
        f"{duration(document['seconds'])}"
    )
    if document["accuracy"] is not None:
        accuracy = str(Accuracy(**document["accuracy"]))
        if not any(accuracy in warning for warning in document["warnings"]):
            yield f"  {accuracy}"
    yield from (f"  {file}" for file in document["slices"])


def _check_together(
    given: Mapping[str, object], out: Path, kept_out: Iterable[str]
) -> None:
    """Check that options go together.

    Checked in this order, the first wrong one is raised: preview, the ending of `out`,
    options without effect (`twin.algorithms.OPTIONS`), SLURM with a scheduler, and a
    correction that is no report with a geometry.

    Args:
        given: options by name.
        out: file of the volume.
        kept_out: options that a preview sets itself.

    Raises:
        typer.BadParameter: they do not; names the option, or the file with a wrong
            ending.
    """
    from flexdt.library.reconstruction.volume_files import ending, endings

    names = {name.replace("-", "_") for name in given}
    nothing = misfit(str(given.get("algorithm", DEFAULT)), names, spelled=_option)
    for wrong, why in (
        *((True, f"--{name}: --preview chooses for itself") for name in kept_out),
        (
            ending(out) not in endings(),
            f"--out: {out}: the ending must be one of {', '.join(endings())}",
        ),
        (nothing is not None, nothing[1] if nothing else ""),
        (
            {"scheduler", "slurm"} <= given.keys(),
            "--slurm: not together with --scheduler",
        ),
        (
            "geometry" in given and given.get("correction") in ("twin", "none"),
            f"--correction: {given.get('correction')} is not for a geometry from a file",
        ),
    ):
        if wrong:
            raise typer.BadParameter(why)


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _correction(named: str | None, twin: Twin) -> tuple[Offsets | None, Report | None]:
    """Read the chosen correction, and the report that it comes from.

    "none", or a twin without a calibration in force, gives zero offsets; a file gives
    offsets and report; None is for the scan's own, (None, None). The twin is only used
    for "twin".
    """
    from flexdt.twin.geometry.offsets import NOMINAL, Offsets

    match named:
        case None:
            return None, None
        case "none":
            return NOMINAL, None
        case "twin":
            with twin() as client:
                in_force = client.calibration()
            if in_force is None:
                return NOMINAL, None
            return Offsets.from_edge(in_force.parameters), None
    report = read_report(Path(named))
    return report.parameters, report


def _require_of_geometry(correction: str, report: Report | None) -> None:
    """Check that a correction comes from a report of a scan whose geometry came from a file.

    Raises typer.BadParameter: there is no report, or its geometry is the scanner's own.
    """
    if report is None or not report.of_geometry:
        raise typer.BadParameter(
            f"--correction: {correction} corrects the scanner's own geometry, not one from a "
            "file; allowed: a report of a calibration or alignment with --geometry"
        )


def scan_of(
    folder: Path, texts: bool, report: Report | None, geometry: Path | None = None
) -> DataSet:
    """Load the data set, with the geometry of a file, and the motion and the panel of a
    report.

    A report's panel becomes the data set's correction, its motion is applied if it is of
    this data set. A geometry replaces the data set's own first.

    Args:
        folder: of the data set, or of anybody's TIFFs if there is a geometry.
        texts: use the two settings texts only, not `flexdt.json`.
        report: of a calibration; None for none.
        geometry: file; None for the data set's own.
    """
    from flexdt.library.reading.folders import load_dataset

    given = None if geometry is None else read_geometry(geometry)
    data = load_dataset(folder, ignore_document=texts, geometry=given)
    if report is None:
        return data
    from flexdt.twin.geometry.panel import Panel
    from flexdt.twin.scanner.state import NamedCorrection

    panel = data.panel
    if (found := report.document.get("panel")) is not None:
        panel = Panel.from_json(found)
    data = data.with_correction(
        NamedCorrection(
            "report",
            "",
            report.parameters,
            panel=panel,
            sides_known=report.of_beads,
        )
    )
    return apply_motion(data, report)


def _workers(
    scheduler: str | None, slurm: Path | None
) -> AbstractContextManager[Executor] | None:
    """Make the workers for --scheduler or --slurm; None without either.

    `scheduler` is an address, `slurm` a file; with both the scheduler counts.

    Raises TwinError: flexdt-extensions is not installed.
    """
    from flexdt.library.optional.extras import extension

    if scheduler is None and slurm is None:
        return None
    name, asked = ("slurm", slurm) if scheduler is None else ("scheduler", scheduler)
    workers: AbstractContextManager[Executor] = extension(name, f"--{name}")(asked)
    return workers


def _center(text: str) -> tuple[float, float, float]:
    return option_values.triple(text, "center", "X,Y,Z, e.g. 0,0,-5.5")


def _shape(text: str) -> tuple[int, int, int]:
    form = "Z,Y,X, e.g. 300,400,400"
    z, y, x = map(int, option_values.numbers(text, "shape", form, 3, whole=True))
    return z, y, x


@dataclass(frozen=True)
class Report:
    """Report of `flexdt calibrate`, for its own scan and for others.

    Attributes:
        path: the file; it may hold a plain object of parameters instead.
        parameters: the correction.
        document: all of it.
    """

    path: Path
    parameters: Offsets
    document: dict[str, Any]

    @property
    def of_geometry(self) -> bool:
        """Whether its geometry is from a file."""
        return bool(self.document.get("geometry"))

    @property
    def of_beads(self) -> bool:
        """True for a report of `flexdt calibrate` with a phantom whose beads are known."""
        from flexdt.twin.calibration.unknown_markers import UNKNOWN

        return bool(self.document.get("phantom", UNKNOWN) != UNKNOWN)


def read_report(path: Path) -> Report:
    """Read a report of `flexdt calibrate`, or a plain object of parameters.

    A report's correction is its "correction". An empty one counts as none. Values are
    converted from the wire's units. Unknown parameter names raise TwinError. True and
    false count as no numbers.

    Args:
        path: of a JSON file.

    Raises:
        CommandError: not JSON, no correction in it, or a value that is not a number.
    """
    from flexdt.twin.geometry.offsets import Offsets
    from flexdt.twin.input_limits import InputLimitError
    from flexdt.twin.json_text import parse_json

    try:
        document = parse_json(limited_text(path, "json"), file=str(path))
    except InputLimitError:
        raise
    except ValueError as error:
        if path.suffix.lower() in (".html", ".htm"):
            text = f"{path} is a report for people; give that of --report NAME.json"
            raise CommandError(text) from None
        raise CommandError(f"{path}: not JSON: {error}") from None
    if isinstance(document, dict):
        content = document.get("correction", document)
    else:
        content = None
    if not isinstance(content, dict) or not content:
        raise CommandError(
            f"{path}: holds no correction (was the calibration identifiable?)"
        )
    for name, value in content.items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise CommandError(f"{path}: {name} = {value!r} is not a number")
    return Report(path, Offsets.from_edge(content), document)


def apply_motion(data: DataSet, report: Report) -> DataSet:
    """Apply the motion that a report of `flexdt calibrate --per-frame` has for the data
    set.

    Returned as it is without a motion, and if nothing moves. A report lists one motion
    for each of its data sets, distinguished by their folders; exactly one must be of this
    one.

    Args:
        data: the data set; a motion of another one is left out with a warning.
        report: of the calibration.

    Raises:
        CommandError: the report's motion is not valid.
    """
    path = report.path
    told = report.document.get("motion")
    if told is None:
        return data
    from flexdt.twin.errors import TwinError
    from flexdt.twin.geometry.motion import Motion

    folders: Any = report.document.get("datasets")
    own = data.folder and data.folder.resolve()
    try:
        moving = [m for m in told if any(c.get("moves") for c in m.values())]
        pairs = list(zip(told, folders, strict=True))
    except (AttributeError, TypeError, ValueError):
        why = f"{path}: its motion is not that of a report of flexdt calibrate"
        raise CommandError(why) from None
    here = [m for m, folder in pairs if own and Path(str(folder)).resolve() == own]
    if moving and len(here) != 1:
        note(
            f"{path}: warning: the motion in it is that of "
            f"{', '.join(map(str, folders))} and is "
            f"left out for {data.where}"
        )
    if not moving or len(here) != 1:
        return data
    try:
        return data.with_motion(Motion.from_dict(here[0]))
    except TwinError as error:
        raise CommandError(f"{path}: {error}") from None


Rows = Literal["down", "up"]


def _are_up(rows: Rows) -> bool:
    """Return whether rows are counted upwards."""
    match rows:
        case "up":
            return True
        case "down":
            return False
        case _:
            assert_never(rows)


def export(
    dataset: Path = argument(..., "DATASET"),
    format: str = option(..., among=exported),
    out: Path = option(..., metavar="FILE", written=True),
    corrected: bool = option(True, "--corrected/--nominal"),
    correction: Path | None = option(None, metavar="FILE"),
    unknown: Path | None = option(None, metavar="FILE"),
    rows: Rows = option("down"),
    texts: options.Texts = False,
) -> Answer:
    """Write a data set's geometry in another program's format; nxtomo holds its images, too.

    A geometry that the format cannot express is an error, and nothing is written:
    docs/exchange.md.

    Args:
        format: Write this program's format.
        out: Write the geometry to this file.
        corrected: Apply the correction in force, or leave it out.
        correction: Apply the correction of this calibration report instead.
        unknown: State, for CTSimU, what reconstruction does not know (TOML).
        rows: Count rows down or up; up: for images turned upside down.

    Yields:
        The document of --json (format, file, views, shape, corrected, rows), then one
        line. Warnings go to standard error; --correction with --nominal is a usage error.
    """
    if correction is not None and not corrected:
        raise typer.BadParameter("--correction and --nominal exclude each other")
    from flexdt.clients.launch.random_truth import read
    from flexdt.library.datasets.exchange import export_dataset
    from flexdt.twin.geometry.offsets import NOMINAL, Offsets

    if correction is None:
        report = None
    else:
        report = read_report(correction)
    if report:
        parameters = report.parameters
    elif corrected:
        parameters = None
    else:
        parameters = NOMINAL
    data = scan_of(dataset, texts, report)
    warn(data.warnings, dataset)
    if unknown is None:
        real = None
    else:
        real = Offsets.from_edge(read(unknown))
    written = export_dataset(
        data,
        out,
        format,
        parameters=parameters,
        real=real,
        rows_up=_are_up(rows),
    )
    height, width = written.shape or (0, 0)
    yield {
        "format": format,
        "file": str(out),
        "views": len(written),
        "shape": [height, width],
        "corrected": corrected,
        "rows": FORMATS[format].rows or rows,
    }
    what = "corrected" if corrected else "nominal"
    yield f"{out}: {len(written)} views of {width} x {height} pixels, {what}, {format}"


def describe(dataset: Path = argument(..., "DATASET")) -> Answer:
    """Show every value of a scan's or a geometry's files with its use.

    Used, contradicted (another statement was taken) or ignored, with what follows.

    Yields:
        The document of --json (name, projections, shape, complete, warnings, provenance;
        of a geometry's file views in place of projections and complete), then a line, what
        is known of sample, beam, scanner and correction, and the table. Warnings go to
        standard error.
    """
    from flexdt.library.datasets.exchange import is_geometry_file, stated_in
    from flexdt.library.datasets.scan_files import is_scan_file
    from flexdt.library.reading.foreign_files import format_of

    scan = format_of(dataset) is not None or is_scan_file(dataset)
    if is_geometry_file(dataset) and not scan:
        geometry = stated_in(dataset)
        warn(geometry.notes, dataset)
        yield {
            "name": dataset.stem,
            "views": len(geometry),
            "shape": None if geometry.shape is None else list(geometry.shape),
            "warnings": list(geometry.notes),
            "provenance": geometry.provenance.to_list(),
        }
        yield f"{dataset.name}: {len(geometry)} views"
        yield from geometry.provenance.lines
        return
    data = scan_of(dataset, False, None)
    warn(data.warnings, dataset)
    yield {
        "name": data.name,
        "projections": len(data),
        "shape": list(data.shape),
        "complete": data.complete,
        "warnings": list(data.warnings),
        "provenance": data.provenance.to_list(),
    }
    rows, columns = data.shape
    taken = len(data.present)
    count = f"{taken}" if taken == len(data) else f"{taken} of {len(data)}"
    yield f"{data.name}: {count} projections of {columns} x {rows} pixels"
    yield from (f"{name}: {said}" for name, said in data.known_facts.items())
    yield from data.provenance.lines


def guess(
    dataset: Path = argument(..., "DATASET"),
    geometry: Path | None = argument(None, "GEOMETRY"),
) -> Answer:
    """Find which flips, sense of rotation and signs of offsets fit a scan's images.

    GEOMETRY is a file, in place of the data set's own. Exit code 5 where the images do not
    decide.

    Yields:
        The document of --json (decided, names, odds, sentence), then a line for each
        convention with its odds.
    """
    from flexdt.library.reconstruction.convention import find_convention
    from flexdt.twin.errors import NotIdentifiableError

    data = scan_of(dataset, False, None, geometry)
    found = find_convention(data)
    yield {
        "decided": found.decided,
        "names": list(found.names),
        "odds": dict(found.odds),
        "sentence": str(found),
    }
    for name, odds in found.odds.items():
        yield f"{odds:8.2g}  {name}"
    if not found.decided:
        raise NotIdentifiableError(str(found))
    yield str(found)


def import_(
    file: Path = argument(..., "FILE"),
    format: str = option(..., among=imported),
    out: Path = option(..., metavar="FILE.{json,npy}", written=True),
    like: Path | None = option(None, metavar="DATASET"),
    shape: str | None = option(None, metavar="ROWS,COLS"),
    pixel: str | None = option(None, metavar="MM or U,V"),
    views: int | None = option(None, min=1),
    rows: Rows = option("down"),
    real: bool = option(False, "--real/--known"),
) -> Answer:
    """Read a geometry in another program's format and write it as a geometry file.

    `flexdt reconstruct` and `calibrate` take it with --geometry, Python with `load_geometry`.

    Args:
        format: Read this program's format.
        out: Write the geometry to this file.
        like: Take what FILE does not say from this data set.
        shape: Set the detector's shape where FILE does not say it.
        pixel: Set the pixel pitch where FILE does not say it (RTK).
        views: Set the number of projections (flexDATA).
        rows: Count rows down or up; up: v is negated.
        real: Take, of a CTSimU file, the true geometry, or the one known to reconstruction.

    Yields:
        The document of --json (format, file, out, views, shape, pixel_mm, notes), then
        one line; notes go to standard error.
    """
    given = geometry_options(like, shape, pixel, views)
    from dataclasses import replace

    from flexdt.library.datasets.exchange import import_geometry, save_geometry

    geometry = import_geometry(file, format, given, rows_up=_are_up(rows))
    if real and geometry.real is not None:
        geometry = replace(geometry, cone_vec=geometry.real, real=None, notes=())
    save_geometry(geometry, out)
    for text in geometry.notes:
        note(f"{file}: {text}")
    yield {
        "format": format,
        "file": str(file),
        "out": str(out),
        "views": len(geometry),
        "shape": None if geometry.shape is None else list(geometry.shape),
        "pixel_mm": list(geometry.pitch_mm),
        "notes": list(geometry.notes),
    }
    height, width = geometry.shape or (None, None)
    if width is None:
        size = "unknown size"
    else:
        size = f"{width} x {height} pixels"
    u, v = geometry.pitch_mm
    yield f"{out}: {len(geometry)} views of {size}, pixel {u:.6g} x {v:.6g} mm"


def read_geometry(file: Path, known: Given | None = None) -> ConeVec:
    """Load a scan's geometry from a file of any format of `ConeVec.load`.

    `known`: detector shape and pitch that it may lack.
    """
    from flexdt.twin.geometry.cone_vec import ConeVec

    if known is None:
        return ConeVec.load(file)
    return ConeVec.load(file, shape=known.shape, pixel=known.pitch_mm)


def geometry_options(
    like: Path | None, shape: str | None, pixel: str | None, views: int | None = None
) -> Given:
    """Read the options that complete a geometry's file.

    Values that no option gives are the data set's, else None. One pitch is both of
    columns and rows.

    Args:
        like: data set to take values from; the other options override it.
        shape: ROWS,COLS of the detector.
        pixel: pitch [mm], MM or U,V.
        views: number of projections.

    Raises:
        typer.BadParameter: a word of another form, or a pitch that is not above 0.
    """
    size = pitch = None
    if shape is not None:
        form = "ROWS,COLS, e.g. 760,956"
        size = option_values.numbers(shape, "shape", form, 2, whole=True)
    if pixel is not None:
        pitch = option_values.numbers(pixel, "pixel pitch", "MM or U,V", 1, 2)
    if pitch is not None and min(pitch) <= 0.0:
        raise typer.BadParameter(f"pixel pitch {pixel!r} must be above 0")
    from flexdt.library.datasets.exchange import Given
    from flexdt.library.reading.folders import load_dataset

    if like is None:
        known = Given()
    else:
        known = Given.of(load_dataset(like))
    return Given(
        known.shape if size is None else (int(size[0]), int(size[1])),
        known.pitch_mm if pitch is None else (pitch[0], pitch[-1]),
        known.views if views is None else views,
    )
