"""`flexdt demo`: the main job from end to end, on this machine, with nothing prepared.

Each stage does its real work through the public client and the files, as a user would, and stops
the demonstration with a readable error when something is wrong. A stage that did not run is absent
from the document.
"""

from __future__ import annotations

import contextlib
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping
from datetime import datetime
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Final

from flexdt import long_work
from flexdt.clients.cli.boundary import NOT_IDENTIFIABLE
from flexdt.clients.cli.commands.calibrate_commands import (
    parameter_rows,
    push_correction,
    write_json,
)
from flexdt.clients.cli.commands.scan_commands import follow
from flexdt.clients.cli.console import duration, note, say, size, table
from flexdt.clients.cli.options import Answer, option
from flexdt.clients.failure import CommandError
from flexdt.clients.launch import random_truth as hidden

if TYPE_CHECKING:
    from flexdt.clients.calibration.calibrate import Outcome
    from flexdt.clients.client.client import TwinClient
    from flexdt.clients.datasets.data_set import DataSet
    from flexdt.clients.launch.processes import Servers


def demo(
    out: Path = option(Path("flexdt-demo"), "Write everything to this folder.", metavar="DIR"),
    no_viewer: bool = option(False, "Exit when the work is done, without a viewer.", "--no-viewer"),
    truth: Path | None = option(None, "Hide this misalignment, not a random one.", metavar="FILE"),
    json: bool = False,
) -> Answer:
    """Do the main job: script, scan, data set, calibration.

    Starts the servers on free ports, scans the LEGO bead phantom with the example script,
    accelerated, calibrates from the data set, and says what was done, where the files are and how
    the result compares with the hidden truth. With the viewer it stays up until Ctrl-C.
    """

    def stay(url: str) -> None:
        note(f"the lab is at {url}; Ctrl-C ends the demonstration")
        try:
            while True:
                time.sleep(3600.0)
        except KeyboardInterrupt:
            note("")

    yield run_demo(out, truth, note if json else say, None if no_viewer else stay)


SAMPLE: Final = "lego"
SCRIPT: Final = "lego-fly-360.txt"
Tell = Callable[[str], None]


def example_script() -> bytes:
    """The example script as it ships."""
    return (resources.files("flexdt.clients") / "data" / SCRIPT).read_bytes()


def run_demo(
    out: Path,
    truth_file: Path | None,
    tell: Tell,
    stay: Callable[[str], None] | None = None,
) -> dict[str, object]:
    """Run every stage there is.

    Args:
        out: folder for everything that is written, made if need be.
        truth_file: hidden misalignment; None draws one.
        tell: told what is done, line by line.
        stay: start the viewer too; called with its URL when the work is done, and the servers live
            until it returns.

    Returns:
        The document of `demo.json`.

    Raises:
        CommandError: a stage did not do what it should; the line says which and what.
    """
    from flexdt.clients.launch.processes import Servers
    from flexdt.runtime import compile_ahead

    out.mkdir(parents=True, exist_ok=True)
    data = out / "data"
    data.mkdir(exist_ok=True)
    name = f"{SAMPLE}-{datetime.now():%Y%m%d-%H%M%S}"
    with tempfile.TemporaryDirectory(prefix="flexdt-truth-") as secret:
        path = Path(secret) / "truth.toml" if truth_file is None else truth_file
        if truth_file is None:
            hidden.write(hidden.draw(), path)
        truth = hidden.read(path)
        options = {"data": data.absolute(), "truth": path.absolute(), "speed-up": "max"}
        tell("starting the servers; the very first start compiles the projector's kernels")
        with contextlib.ExitStack() as running:
            # What calibration and reconstruction need, beside the servers' start and the scan.
            compiling = running.enter_context(compile_ahead.start(compile_ahead.ANALYSIS))
            servers = Servers(options, out / "servers.log", viewer=stay is not None)
            with long_work.during("starting the servers"):
                running.enter_context(servers)
            host, port = servers.address
            tell(f"twin on {host}:{port}, projector beside it, log in {out / 'servers.log'}")
            if servers.viewer_url is not None:
                tell(f"viewer: {servers.viewer_url}")
            document = _stages(servers, compiling, name, data, truth, tell)
            write_json(out / "demo.json", document)
            tell(f"summary: {out / 'demo.json'}")
            if stay is not None and servers.viewer_url is not None:
                stay(servers.viewer_url)
    return document


def _stages(
    servers: Servers,
    compiling: subprocess.Popen[bytes],
    name: str,
    data: Path,
    truth: Mapping[str, float],
    tell: Tell,
) -> dict[str, object]:
    from flexdt.clients.client.client import TwinClient

    with TwinClient(*servers.address) as client:
        folder, seconds = scan(client, name, data, tell)
        dataset = inspect(folder, tell)
        document: dict[str, object] = {
            "dataset": str(folder),
            "frames": len(dataset.frames),
            "scan_s": round(seconds, 3),
        }
        with long_work.during("compiling the kernels of calibration and reconstruction"):
            compiling.wait()
        outcome, seconds = calibrate(dataset, tell)
        push_correction(client, outcome.correction, outcome.sources)
        tell(f"correction in force on the twin: {outcome.correction.name}")
        document |= {
            "calibration_s": round(seconds, 3),
            "calibration": outcome.document,
            "truth": dict(truth),
            "inside_95": compare(outcome, truth, tell),
            "preview": preview(dataset, outcome, data.parent / "preview.tif", tell),
        }
    return document


def scan(client: TwinClient, name: str, data: Path, tell: Tell) -> tuple[Path, float]:
    """Run the example script on the twin; returns the data set's folder and the wall time [s]."""
    client.set_sample(SAMPLE)
    made = client.submit_script(example_script(), name=name, speed_up="max")
    tell(f"{made.job}: scanning the {SAMPLE} phantom with {SCRIPT}")
    for warning in made.warnings:
        tell(f"  warning: {warning}")
    begun = time.monotonic()
    status = follow(client, made.job, own=True)
    seconds = time.monotonic() - begun
    if status.state != "done":
        message = (status.error or {}).get("message", "no reason given")
        raise CommandError(f"the scan ended as {status.state}: {message}")
    folder = data / (status.dataset or name)
    tell(
        f"{status.frames_done} frames in {duration(seconds)} "
        f"({duration(status.elapsed_s)} on the twin's clock)"
    )
    return folder, seconds


def inspect(folder: Path, tell: Tell) -> DataSet:
    """Read the data set back with the ordinary reader; it must be whole."""
    from flexdt.clients.datasets.dataset import load_dataset

    dataset = load_dataset(folder).require_complete()
    files = [p for p in folder.iterdir() if p.is_file()]
    rows, cols = dataset.shape
    tell(
        f"data set {folder}: {len(dataset.frames)} projections of {cols} x {rows}, "
        f"{len(files)} files, {size(sum(p.stat().st_size for p in files))}"
    )
    return dataset


def calibrate(dataset: DataSet, tell: Tell) -> tuple[Outcome, float]:
    """Calibrate from the data set alone; returns the outcome and the wall time [s]."""
    from flexdt.clients.calibration.calibrate import calibrate_datasets

    begun = time.monotonic()
    outcome = calibrate_datasets([dataset], SAMPLE)
    seconds = time.monotonic() - begun
    document = outcome.document
    if not document["identifiable"]:
        problems = [str(f.text) for f in outcome.calibration.findings]
        raise CommandError(["the calibration is not identifiable", *problems], NOT_IDENTIFIABLE)
    tell(
        f"calibrated in {duration(seconds)}: {document['detections']} beads seen, rms "
        f"{document['rms_px']:.4f} px"
    )
    return outcome, seconds


def preview(dataset: DataSet, outcome: Outcome, out: Path, tell: Tell) -> dict[str, object]:
    """A small volume with the calibrated geometry."""
    from flexdt.clients.reconstruction.reconstruct import preview as reconstruct

    fit = outcome.calibration.fit
    assert fit is not None
    with long_work.during("making a preview"):
        document = reconstruct(dataset, out, parameters=fit.parameters)
    tell(f"preview {out}: {duration(document['seconds'])}")
    return document


def compare(outcome: Outcome, truth: Mapping[str, float], tell: Tell) -> bool:
    """Set the calibration beside the hidden truth; a miss is called a miss."""
    from flexdt.clients.calibration.calibrate import inside_95

    rows = []
    for name, value, sigma, _, unit in parameter_rows(outcome.document):
        true = truth.get(name.strip("()"), 1.0 if name == "angle_scale" else 0.0)
        rows.append((name, f"{true:.5f}", value, sigma, unit))
    tell(table(rows, ("parameter", "truth", "calibrated", "sigma", "unit")))
    inside = inside_95(outcome, truth)
    tell(
        "the truth lies inside the joint 95 % ellipsoid"
        if inside
        else "a miss: the truth lies outside the joint 95 % ellipsoid"
    )
    return inside
