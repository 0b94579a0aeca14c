"""`flexdt demo`: the main job from end to end, with servers of its own.

Each stage does its real work through the public client and the files, as a user would, and
stops the demonstration with a readable error when something is wrong. A stage that did not run
is absent from the document.
"""

from __future__ import annotations

import contextlib
import logging
import shlex
import shutil
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from datetime import datetime
from functools import partial
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from flexdt.clients.cli.boundary import NOT_IDENTIFIABLE
from flexdt.clients.cli.commands.calibrate_commands import (
    parameter_rows,
    push_correction,
    write_json,
)
from flexdt.clients.cli.commands.job_commands import follow
from flexdt.clients.cli.console import duration, note, say, size, table
from flexdt.clients.cli.options import Answer, option
from flexdt.clients.launch import random_truth as hidden
from flexdt.library.failure import CommandError
from flexdt.twin import long_work

if TYPE_CHECKING:
    import numpy.typing as npt

    from flexdt.clients.client.client import TwinClient
    from flexdt.clients.launch.processes import Servers
    from flexdt.library.calibration.calibrate import Outcome
    from flexdt.library.data_set import DataSet

SAMPLE: Final = "lego"
SCRIPT: Final = "lego-fly-180.txt"
PROGRAM: Final = "flexdt"
"""Name of the command, where it is on the path."""
CALIBRATION: Final = "calibration.json"
PICTURE: Final = "demo.png"
PICTURE_ROWS: Final = 380
"""Height of the images in the picture [pixels]."""
PICTURE_VOXEL_MM: Final = 0.1
PICTURE_MARGIN: Final = 30
"""Voxels of air beside the phantom in the picture."""
PICTURE_BINNING: Final = 2
"""Of the images that its volumes take: a pixel is 0.17 mm at the axis then."""
PICTURE_GAP: Final = 8
"""Distance of the images in the picture [pixels]."""
STAY_S: Final = 3600.0
"""Longest sleep while the lab stays up; Ctrl-C ends it at once."""
Tell = Callable[[str], None]
"""Called with each line of progress."""


def demo(
    out: Path = option(Path("flexdt-demo"), metavar="DIR"),
    no_viewer: bool = option(False, "--no-viewer"),
    truth: Path | None = option(None, metavar="FILE"),
    json: bool = False,
) -> Answer:
    """Do the main job: script, scan, data set, calibration.

    Starts the servers on free ports, scans the LEGO bead phantom with the example script,
    accelerated, calibrates from the data set, and prints the steps, where the files are and
    how the result compares with the hidden truth. With the viewer it stays up until Ctrl-C.

    Args:
        out: Write everything to this folder.
        no_viewer: Exit when the work is done, without a viewer.
        truth: Hide this misalignment, not a random one.

    Yields:
        The document of `demo.json`, once all is done; lines of progress are printed, with
        --json to standard error.
    """

    def stay(url: str) -> None:
        """Print the lab's address, and wait until Ctrl-C; returns then.

        It never returns otherwise.
        """
        note(f"the lab is at {url}; Ctrl-C ends the demonstration")
        try:
            while True:
                time.sleep(STAY_S)
        except KeyboardInterrupt:
            note("")

    yield run_demo(out, truth, note if json else say, None if no_viewer else stay)


def run_demo(
    out: Path,
    truth_file: Path | None,
    tell: Tell,
    stay: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Run all stages.

    The servers run meanwhile; kernels compile at the same time. `demo.json` and the
    calibration are written into `out`. A drawn misalignment is kept outside `out` and
    deleted at the end. `out/data` holds the scan; servers end in any case.

    Args:
        out: folder for all files, made if need be.
        truth_file: hidden misalignment; None draws one.
        tell: called with each line of progress.
        stay: start the viewer too; called with its URL when the work is done, and the
            servers live until it returns.

    Returns:
        The document of `demo.json`.

    Raises:
        CommandError: a stage failed; the line names it and the reason.
    """
    from flexdt.clients.client.client import TwinClient
    from flexdt.runtime.kernels import compile_ahead

    data = out / "data"
    data.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as running:
        if not sys.stderr.isatty():
            # Stages are told one by one; lines in place of bars would bury them.
            running.enter_context(_quiet("flexdt.progress"))
        path = truth_file or running.enter_context(_drawn_truth())
        truth = hidden.read(path)
        tell(
            "starting the servers; a new installation compiles what the first image needs"
        )
        # Kernels of calibration and reconstruction compile during the servers' start and the
        # scan, in one process: each more costs some seconds of its own.
        compiling = running.enter_context(compile_ahead.start(*compile_ahead.ANALYSIS))
        options = {"data": data.absolute(), "truth": path.absolute(), "speed-up": "max"}
        servers = running.enter_context(
            _running_servers(options, out, tell, viewer=stay is not None)
        )
        with TwinClient(*servers.address) as client:
            document = _main_job(
                client, partial(compile_ahead.failure_of, compiling), truth, out, tell
            )
        write_json(out / "demo.json", document)
        write_json(out / CALIBRATION, document["calibration"])
        _print_summary(document, out, tell)
        if stay is not None and servers.viewer_url is not None:
            stay(servers.viewer_url)
    return document


@contextlib.contextmanager
def _quiet(name: str) -> Iterator[None]:
    """Keep a logger from warnings within the context."""
    log = logging.getLogger(name)
    before = log.level
    log.setLevel(logging.ERROR)
    try:
        yield
    finally:
        log.setLevel(before)


@contextlib.contextmanager
def _drawn_truth() -> Iterator[Path]:
    """Write a random hidden misalignment to a temporary file outside the folder of the
    results; deleted at the end.

    Yields the path of the TOML file."""
    with tempfile.TemporaryDirectory(prefix="flexdt-truth-") as secret:
        path = Path(secret) / "truth.toml"
        hidden.write(hidden.draw(), path)
        yield path


@contextlib.contextmanager
def _running_servers(
    options: Mapping[str, object], out: Path, tell: Tell, *, viewer: bool
) -> Iterator[Servers]:
    """Start servers on free ports and print their addresses; end them on leaving.

    Yields them, running. A failed start raises ServersError. The log is `servers.log` in
    `out`.

    Args:
        options: of the servers.
        out: folder of their log.
        tell: prints a line.
        viewer: start a viewer, too.
    """
    from flexdt.clients.launch.processes import Servers

    log = out / "servers.log"
    servers = Servers(options, log, viewer=viewer)
    with contextlib.ExitStack() as running:
        with long_work.during("starting the servers"):
            running.enter_context(servers)
        host, port = servers.address
        tell(f"twin on {host}:{port}, projector beside it, log in {log}")
        if servers.viewer_url is not None:
            tell(f"viewer: {servers.viewer_url}")
        yield servers


def _main_job(
    client: TwinClient,
    compiled: Callable[[], str],
    truth: Mapping[str, float],
    out: Path,
    tell: Tell,
) -> dict[str, Any]:
    """Scan, calibrate, put the correction in force and draw the picture.

    Only the hidden truth is compared, after the correction is in force. The picture is
    written into `out`.

    Args:
        client: connected to the twin.
        compiled: returns once the kernels of calibration and reconstruction are compiled,
            "" or a sentence on what failed.
        truth: hidden misalignment, to compare with.
        out: folder for all files.
        tell: called with each line of progress.

    Returns:
        The document of `demo.json`.
    """
    dataset, seconds = _scan(client, out / "data", tell)
    with long_work.during("compiling the kernels of calibration and reconstruction"):
        failure = compiled()
    if failure:
        tell(failure)
    begun = time.monotonic()
    outcome = _calibrate(dataset, tell)
    document: dict[str, Any] = {
        "dataset": str(dataset.folder),
        "frames": len(dataset.frames),
        "scan_s": round(seconds, 3),
        "calibration_s": round(time.monotonic() - begun, 3),
        "calibration": outcome.document,
        "truth": dict(truth),
    }
    push_correction(client, outcome.correction, outcome.sources)
    tell(f"correction in force on the twin: {outcome.correction.name}")
    document["inside_95"] = _compare_with_truth(outcome, truth, tell)
    document["picture"] = str(_draw_picture(dataset, outcome, out / PICTURE))
    return document


def _scan(client: TwinClient, data: Path, tell: Tell) -> tuple[DataSet, float]:
    """Run the example script on the twin and read the data set back with the ordinary
    reader.

    Its name has the date and time; the twin's clock runs as fast as possible. It puts the
    example's sample on the stage first. Warnings are printed; a pause by an error ends
    the wait.

    Args:
        client: connected to the twin.
        data: the twin's data directory.
        tell: called with each line of progress.

    Returns:
        The data set, which is complete, and the wall time of the scan [s].

    Raises:
        CommandError: the scan did not end as done.
    """
    from flexdt.library.reading.folders import load_dataset

    client.set_sample(SAMPLE)
    script = (resources.files("flexdt.clients") / "data" / SCRIPT).read_bytes()
    name = f"{SAMPLE}-{datetime.now():%Y%m%d-%H%M%S}"
    made = client.submit_script(script, name=name, speed_up="max")
    tell(f"{made.job}: scanning the {SAMPLE} phantom with {SCRIPT}")
    for warning in made.warnings:
        tell(f"  warning: {warning}")
    begun = time.monotonic()
    status = follow(client, made.job, own=True)
    seconds = time.monotonic() - begun
    if status.state != "done":
        message = (status.error or {}).get("message", "no reason given")
        raise CommandError(f"the scan ended as {status.state}: {message}")
    tell(
        f"{status.frames_done} frames in {duration(seconds)} "
        f"({duration(status.elapsed_s)} on the twin's clock)"
    )
    folder = data / (status.dataset or name)
    dataset = load_dataset(folder).require_complete()
    files = [p for p in folder.iterdir() if p.is_file()]
    rows, cols = dataset.shape
    tell(
        f"data set {folder}: {len(dataset.frames)} projections of {cols} x {rows}, "
        f"{len(files)} files, {size(sum(p.stat().st_size for p in files))}"
    )
    return dataset, seconds


def _calibrate(dataset: DataSet, tell: Tell) -> Outcome[DataSet]:
    """Calibrate from the data set alone.

    The phantom is the example's; the progress line has the time, beads seen and rms.
    Returns the outcome, identifiable; its problems are in the error.

    Args:
        dataset: of the example scan.
        tell: called with each line of progress.

    Raises:
        CommandError: the calibration is not identifiable.
    """
    from flexdt.library.calibration.calibrate import calibrate_datasets

    begun = time.monotonic()
    outcome = calibrate_datasets([dataset], SAMPLE)
    document = outcome.document
    if not document["identifiable"]:
        problems = [str(f.text) for f in outcome.calibration.findings]
        raise CommandError(
            ["the calibration is not identifiable", *problems], NOT_IDENTIFIABLE
        )
    tell(
        f"calibrated in {duration(time.monotonic() - begun)}: "
        f"{document['detections']} beads seen, rms {document['rms_px']:.4f} px"
    )
    return outcome


def _draw_picture(dataset: DataSet, outcome: Outcome[DataSet], out: Path) -> Path:
    """Draw the layer of one bead with the nominal and the calibrated geometry beside the
    phantom, at one scale and in one window.

    Both volumes are FDK of the same images, binned, with Hann's window. Each is `PICTURE_ROWS`
    rows high, by nearest pixels, with white gaps of `PICTURE_GAP` columns.

    Args:
        dataset: the scan, without a correction in force.
        outcome: its calibration, with a fit.
        out: file of the PNG.

    Returns:
        `out`.
    """
    import numpy as np

    from flexdt.library.datasets.labelled_pictures import labelled
    from flexdt.library.datasets.pictures import png_of, windowed
    from flexdt.twin.dataset.normalise import binned_mean
    from flexdt.twin.projection import Grid
    from flexdt.twin.reconstruction import fdk
    from flexdt.twin.reconstruction.acquisition.rectify import rows_needed, window

    fit = outcome.calibration.fit
    assert fit is not None
    truth = outcome.phantom.volume(PICTURE_VOXEL_MM, oversample=1)
    rows, cols = (n + 2 * PICTURE_MARGIN for n in truth.shape[1:])
    layer = int(np.argmin(np.abs(truth.centers()[2] - outcome.phantom.beads[0, 2])))
    z = float(truth.centers()[2][layer])
    grid = Grid((1, rows, cols), PICTURE_VOXEL_MM, (0.0, 0.0, z)).blank()
    frames = dataset.present
    geometries = [
        dataset.corrected(parameters)[np.array(frames)]
        for parameters in (None, fit.parameters)
    ]
    parts = [rows_needed(geometry, dataset.shape, grid) for geometry in geometries]
    first = max(0, min(part[0] for part in parts))
    last = min(dataset.shape[0], max(part[1] for part in parts))
    with long_work.during("drawing the picture"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the picture shows what they say
        images = np.stack(
            [
                binned_mean(dataset.line_integrals(i)[first:last], PICTURE_BINNING)
                for i in frames
            ]
        )
        sides = (first, last), (0, dataset.shape[1])
        nominal, calibrated = (
            fdk(
                images,
                window(geometry, dataset.shape, *sides).binned(
                    PICTURE_BINNING, (last - first, dataset.shape[1])
                ),
                grid,
                window="hann",
                errors=False,
            ).data[0]
            for geometry in geometries
        )
    known = np.pad(truth.data[layer], PICTURE_MARGIN)
    plastic = float(np.median(known[known > 0.0]))
    ends = np.array([-0.3 * plastic, 3.0 * plastic])  # beads are far beyond
    gap = np.full((1, PICTURE_GAP), 255, np.uint8)
    drawn: list[npt.NDArray[np.uint8]] = []
    for image, title in (
        (nominal, "nominal geometry"),
        (calibrated, "calibrated from its own images"),
        (known, "the phantom"),
    ):
        picture = windowed(_scaled_to(image[::-1]), like=ends)
        named = labelled(picture, title, PICTURE_VOXEL_MM * rows / PICTURE_ROWS)
        drawn += [named, np.repeat(gap, len(named), axis=0)]
    out.write_bytes(png_of(np.hstack(drawn[:-1])))
    return out


def _scaled_to(image: npt.NDArray[Any], rows: int = PICTURE_ROWS) -> npt.NDArray[Any]:
    """Resize an image (rows, cols) to `rows` rows in proportion, by its nearest pixels."""
    import numpy as np

    places = (np.arange(rows) * image.shape[0]) // rows
    cols = round(rows * image.shape[1] / image.shape[0])
    across = (np.arange(cols) * image.shape[1]) // cols
    return np.asarray(image)[np.ix_(places, across)]


def _print_summary(document: dict[str, Any], out: Path, tell: Tell) -> None:
    """Print the verdict, the files and the next commands.

    The next commands are to reconstruct and to open the lab; all paths are quoted. The
    program's name is `PROGRAM` if it is on the path, else that of this process.

    Args:
        document: of the demonstration.
        out: folder of its files.
        tell: prints a line.
    """
    if shutil.which(PROGRAM):
        program = PROGRAM
    else:
        program = sys.argv[0]
    dataset = shlex.quote(document["dataset"])
    folder = shlex.quote(str(out))
    tell(f"verdict: {document['calibration']['verdict']}")
    tell(
        f"picture: {document['picture']} (a layer: nominal geometry, calibrated, the phantom)"
    )
    tell(f"summary: {out / 'demo.json'}")
    tell("next:")
    tell(
        f"  {program} reconstruct {dataset} --correction {folder}/{CALIBRATION} "
        "--binning 4 --png "
        f"--out {folder}/volume.nrrd"
    )
    tell(f"  {program} up --data {folder}/data   # the lab in the browser, until Ctrl-C")


def _limit_of(estimate: Mapping[str, Any]) -> str:
    """Say what most of an estimate's sigma comes from: the images, or what was assumed
    before them, which may well be righter than its sigma says.
    """
    parts = {"the images": estimate["images"], **estimate["priors"]}
    most = max(parts, key=lambda name: parts[name])
    return f"prior of {most}" if most in _offsets() else most


def _offsets() -> frozenset[str]:
    """Names of the offsets that have priors."""
    from flexdt.twin.geometry.offsets import MEANINGS

    return frozenset(MEANINGS)


def _compare_with_truth(
    outcome: Outcome[DataSet], truth: Mapping[str, float], tell: Tell
) -> bool:
    """Compare the calibration with the hidden truth; a miss is called a miss.

    A table is printed, with what limits each sigma, then one line with inside or miss. A
    parameter that the truth lacks counts as 0 (angle_scale as 1). Only the calibration's
    parameters are in the table.

    Args:
        outcome: of the calibration.
        truth: parameter -> value [mm, deg].
        tell: called with each line of progress.

    Returns:
        Whether the truth is inside the joint 95 % region.
    """
    from flexdt.library.calibration.calibrate import inside_95
    from flexdt.twin.geometry.offsets import MEANINGS

    rows = []
    for shown, value, sigma, _, unit in parameter_rows(outcome.document):
        name = shown.strip("()")
        true = truth.get(name, 1.0 if name == "angle_scale" else 0.0)
        limit = _limit_of(outcome.document["parameters"][shown])  # type: ignore[index]
        rows.append((shown, f"{true:.5f}", value, sigma, limit, unit, MEANINGS[name]))
    heads = ("parameter", "truth", "calibrated", "sigma", "limited by", "unit", "meaning")
    tell(table(rows, heads))
    inside = inside_95(outcome, truth)
    if inside:
        tell("the truth lies inside the joint 95 % region")
    else:
        tell("a miss: the truth lies outside the joint 95 % region")
    return inside
