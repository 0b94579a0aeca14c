"""`flexdt up`, its aliases `twin`, `projector`, `viewer` and `gateway`, `doctor` and `demo`.

The servers are programs of their own (`python -m flexdt.server...`); this process becomes one,
so signals and exit codes are the server's. Their options come from
`flexdt.runtime.process_settings`: the settings file's first, then those of the command line.

`demo` does the main job from end to end with such processes. Each stage does its real work through
the public client and the files, as a user would, and stops the demonstration with a readable error
when something is wrong. A stage that did not run is absent from the document.
"""

from __future__ import annotations

import contextlib
import inspect
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from datetime import datetime
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, NoReturn

import typer

from flexdt.clients.cli.boundary import NOT_IDENTIFIABLE
from flexdt.clients.cli.commands.calibrate_commands import (
    parameter_rows,
    push_correction,
    write_json,
)
from flexdt.clients.cli.commands.scan_commands import follow
from flexdt.clients.cli.console import duration, note, say, size, table
from flexdt.clients.cli.options import Answer, option
from flexdt.clients.cli.settings_file import TABLES, chosen, settings_of
from flexdt.clients.launch import random_truth as hidden
from flexdt.library.failure import CommandError
from flexdt.runtime.process_settings import UpSettings, has_parameters, parameters, words
from flexdt.twin import long_work

if TYPE_CHECKING:
    from flexdt.clients.client.client import TwinClient
    from flexdt.library.calibration.calibrate import Outcome
    from flexdt.library.data_set import DataSet

MODULES: Final = {
    "up": "flexdt.clients.launch.up",
    "twin": "flexdt.server.twin.main",
    "projector": "flexdt.server.projector.main",
    "viewer": "flexdt.clients.viewer.main",
    "gateway": "flexdt.clients.gateway.main",
}
"""Process -> its program."""
Only = Annotated[
    Literal["twin", "projector", "viewer", "gateway"] | None,
    typer.Option("--only", help="Run this process alone; its options: flexdt PROCESS --help."),
]


def up(context: typer.Context, only: str | None, **given: object) -> None:
    """Start projector, twin and viewer; Ctrl-C stops all.

    They run as processes under one supervisor, which restarts a dead one. Prints one
    JSON `ready` line with the addresses once everything listens. `flexdt twin --help` and its like
    list further options, which `up` takes, too.
    """
    start(only or "up", [*words(given), *context.args])


def _public() -> list[inspect.Parameter]:
    """What `up` lists: left out it is None, so that the settings file can say it."""
    public = {f.name for f in fields(UpSettings) if f.metadata["public"]}
    own = [p for name, p in parameters(UpSettings).items() if name in public]
    return [p if p.default is False else p.replace(default=None) for p in own]


has_parameters(up, [
    inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context),
    inspect.Parameter("only", inspect.Parameter.KEYWORD_ONLY, default=None, annotation=Only),
    *_public(),
])  # fmt: skip


def alone(name: str, about: str) -> Callable[[typer.Context], None]:
    """The command that runs one process with the words that follow it."""

    def command(context: typer.Context) -> None:
        start(name, context.args)

    command.__doc__ = about
    has_parameters(command, inspect.signature(command, eval_str=True).parameters.values())
    return command


twin = alone("twin", "Run the twin server alone.")
projector = alone("projector", "Run the projector server alone.")
viewer = alone("viewer", "Run the viewer, the lab in the browser, alone.")
gateway = alone(
    "gateway",
    "Serve the scanner software's own ZeroMQ interface (Acquila) for a running twin.\n\n"
    "Programs written for the scanner connect to it as they do to the scanner.",
)


def start(name: str, more: Sequence[str]) -> None:
    """Become a process, with the settings file's options and then those of `more` words."""
    settings = settings_of(TABLES[name], more)
    if settings is not None:
        given = {f.name: getattr(settings, f.name) for f in fields(settings)}
        _check(given)
        become(MODULES[name], given)


def _check(given: Mapping[str, Any]) -> None:
    """Usage errors that no single option can have."""
    if (given.get("tls_cert") is None) != (given.get("tls_key") is None):
        raise typer.BadParameter("--tls-cert and --tls-key go together")
    if given.get("projector") is not None and given["projector_port"] is not None:
        raise typer.BadParameter("give --projector or --projector-port, not both")
    if given.get("machine") is not None:  # found before any process starts
        from flexdt.library.machines import machine

        machine(given["machine"])


def become(module: str, given: Mapping[str, object], more: Sequence[str] = ()) -> NoReturn:
    """Be the process that `python -m module` is, with the options `given` and `more` words.

    In this interpreter: a new one would not hear of Ctrl-C before it had loaded the module.

    Raises:
        typer.Exit: the process's exit code.
    """
    from importlib import import_module

    raise typer.Exit(import_module(module).main([*words(given), *more]))


MARKS = {"ok": "ok     ", "warning": "warning", "error": "ERROR  "}


def doctor() -> Answer:
    """Check this installation: Python, packages, compiled kernels, threads, GPU, ports, disk.

    Ports and data directory are those that `flexdt up` would use. Ends with exit code 1 when
    something is wrong; warnings alone are fine.
    """
    from flexdt.clients.launch.doctor import examine

    up = chosen(UpSettings)
    ports = (("twin", up.port), ("projector", up.projector_port), ("viewer", up.viewer_port))
    findings = []
    for finding in examine(up.data or Path("data"), ports):
        findings.append(finding)
        advice = f" -> {finding.advice}" if finding.advice else ""
        yield f"{MARKS[finding.verdict]}  {finding.what}: {finding.found}{advice}"
    sound = all(finding.verdict != "error" for finding in findings)
    yield {"ok": sound, "findings": [vars(finding) for finding in findings]}
    if not sound:
        raise typer.Exit(1)
    yield "This installation is sound."


SAMPLE: Final = "lego"
SCRIPT: Final = "lego-fly-360.txt"
Tell = Callable[[str], None]


def demo(
    out: Path = option(Path("flexdt-demo"), metavar="DIR"),
    no_viewer: bool = option(False, "--no-viewer"),
    truth: Path | None = option(None, metavar="FILE"),
    json: bool = False,
) -> Answer:
    """Do the main job: script, scan, data set, calibration.

    Starts the servers on free ports, scans the LEGO bead phantom with the example script,
    accelerated, calibrates from the data set, and says what was done, where the files are and how
    the result compares with the hidden truth. With the viewer it stays up until Ctrl-C.

    Args:
        out: Write everything to this folder.
        no_viewer: Exit when the work is done, without a viewer.
        truth: Hide this misalignment, not a random one.
    """

    def stay(url: str) -> None:
        note(f"the lab is at {url}; Ctrl-C ends the demonstration")
        try:
            while True:
                time.sleep(3600.0)
        except KeyboardInterrupt:
            note("")

    yield run_demo(out, truth, note if json else say, None if no_viewer else stay)


def run_demo(
    out: Path, truth_file: Path | None, tell: Tell, stay: Callable[[str], None] | None = None
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
    from flexdt.clients.client.client import TwinClient
    from flexdt.clients.launch.processes import Servers
    from flexdt.runtime import compile_ahead

    data = out / "data"
    data.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as running:
        path = truth_file
        if path is None:
            secret = tempfile.TemporaryDirectory(prefix="flexdt-truth-")
            path = Path(running.enter_context(secret)) / "truth.toml"
            hidden.write(hidden.draw(), path)
        truth = hidden.read(path)
        options = {"data": data.absolute(), "truth": path.absolute(), "speed-up": "max"}
        tell("starting the servers; the very first start compiles the projector's kernels")
        # What calibration and reconstruction need, beside the servers' start and the scan.
        compiling = running.enter_context(compile_ahead.start(compile_ahead.ANALYSIS))
        servers = Servers(options, out / "servers.log", viewer=stay is not None)
        with long_work.during("starting the servers"):
            running.enter_context(servers)
        host, port = servers.address
        tell(f"twin on {host}:{port}, projector beside it, log in {out / 'servers.log'}")
        if servers.viewer_url is not None:
            tell(f"viewer: {servers.viewer_url}")
        with TwinClient(host, port) as client:
            dataset, seconds = _scanned(client, data, tell)
            with long_work.during("compiling the kernels of calibration and reconstruction"):
                compiling.wait()
            begun = time.monotonic()
            outcome = _calibrated(dataset, tell)
            document = {
                "dataset": str(dataset.folder),
                "frames": len(dataset.frames),
                "scan_s": round(seconds, 3),
                "calibration_s": round(time.monotonic() - begun, 3),
                "calibration": outcome.document,
                "truth": dict(truth),
            }
            push_correction(client, outcome.correction, outcome.sources)
            tell(f"correction in force on the twin: {outcome.correction.name}")
            document["inside_95"] = _compared(outcome, truth, tell)
            document["preview"] = _previewed(dataset, outcome, out / "preview.tif", tell)
        write_json(out / "demo.json", document)
        tell(f"summary: {out / 'demo.json'}")
        if stay is not None and servers.viewer_url is not None:
            stay(servers.viewer_url)
    return document


def _scanned(client: TwinClient, data: Path, tell: Tell) -> tuple[DataSet, float]:
    """Run the example script on the twin and read the data set back with the ordinary reader; it
    must be whole. Returns it and the wall time of the scan [s]."""
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


def _calibrated(dataset: DataSet, tell: Tell) -> Outcome[DataSet]:
    """Calibrate from the data set alone."""
    from flexdt.library.calibration.calibrate import calibrate_datasets

    begun = time.monotonic()
    outcome = calibrate_datasets([dataset], SAMPLE)
    document = outcome.document
    if not document["identifiable"]:
        problems = [str(f.text) for f in outcome.calibration.findings]
        raise CommandError(["the calibration is not identifiable", *problems], NOT_IDENTIFIABLE)
    tell(
        f"calibrated in {duration(time.monotonic() - begun)}: {document['detections']} beads seen, "
        f"rms {document['rms_px']:.4f} px"
    )
    return outcome


def _previewed(
    dataset: DataSet, outcome: Outcome[DataSet], out: Path, tell: Tell
) -> dict[str, object]:
    """A small volume with the calibrated geometry."""
    from flexdt.library.reconstruction.reconstruct import preview

    fit = outcome.calibration.fit
    assert fit is not None
    with long_work.during("making a preview"):
        document = preview(dataset, out, parameters=fit.parameters)
    tell(f"preview {out}: {duration(document['seconds'])}")
    return document


def _compared(outcome: Outcome[DataSet], truth: Mapping[str, float], tell: Tell) -> bool:
    """Set the calibration beside the hidden truth; a miss is called a miss."""
    from flexdt.library.calibration.calibrate import inside_95

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
