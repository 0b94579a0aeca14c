"""`flexdt expose`, `check`, `run`, `script new` and `job`: scans predicted, checked and run.

Scripts are checked without a server, run on a twin, and written from options by
`flexdt.twin.script.compose`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import typer

from flexdt.clients.cli import options
from flexdt.clients.cli.boundary import (
    INTERRUPTED,
    INVALID,
    WIRE_EXIT_CODES,
    positions,
    verdict,
    wire_code,
)
from flexdt.clients.cli.commands.scanner_commands import warn_of_exposure
from flexdt.clients.cli.console import ProgressBar, duration, note, size, table, warn
from flexdt.clients.cli.options import Answer, Twin, argument, option
from flexdt.clients.cli.settings_file import ScriptNewSettings, chosen
from flexdt.library import machines
from flexdt.library.failure import CommandError
from flexdt.runtime import process_settings

if TYPE_CHECKING:
    from collections.abc import Sequence

    from flexdt.clients.client.client import TwinClient
    from flexdt.library.expose import Forecast, Measured, Transmission
    from flexdt.protocol.state_model import JobStatus
    from flexdt.twin.machine.description import Machine
    from flexdt.twin.script import CheckReport, ScriptProblem
    from flexdt.twin.script.executed_log import Executed

ScriptFile = Annotated[Path, typer.Argument(metavar="SCRIPT", help="Acquila scan script.")]


def check(
    script: ScriptFile,
    machine: options.MachineName = None,
    profile: options.ProfileName = None,
    sample: str | None = option(None, metavar="NAME or FILE"),
    html: Path | None = option(None, metavar="FILE"),
    against: Path | None = option(None, metavar="LOG"),
    json: bool = False,
) -> Answer:
    """Parse, plan and check a script, without a server.

    Exit code 0 with warnings alone, 1 for an invalid script, 3 for a collision or limit.

    Args:
        sample: Check truncation, collisions and exposure of this sample.
        html: Write the report to this file as one page.
        against: Compare with the log of this script, line by line.
    """
    if against is not None:
        yield from compare(script, against, machine, html)
        return
    from flexdt.library.scripts import collisions, size_of
    from flexdt.phantoms.samples import as_phantom
    from flexdt.twin.script import check_script, html_report
    from flexdt.twin.script.problems import in_order

    data = script.read_bytes()
    scanner = machines.machine(machine)
    phantom = None if sample is None else as_phantom(sample)
    report = check_script(
        data,
        scanner,
        machines.profile(profile, scanner, machine),
        sample=size_of(phantom),
        collision=collisions(phantom) if scanner.components else None,
    )
    if phantom is not None and not report.errors:
        from flexdt.phantoms.exposure_forecast import exposure_problems

        more = exposure_problems(report.plan, phantom)
        report = replace(report, problems=in_order((*report.problems, *more)))
    if html is not None:
        html.write_text(html_report(report, script.name), encoding="utf-8")
    yield report.to_dict()
    if not json:
        tell(report.problems, str(script))
    yield from show(report, str(script))
    raise typer.Exit(exit_code(report))


def compare(script: Path, log: Path, machine: str | None, html: Path | None) -> Answer:
    """Each line of an executed script beside its prediction, the greatest errors first.

    Raises:
        CommandError: the log is not of this script; the message names the first line that differs.
    """
    from flexdt.twin.script import parse_script
    from flexdt.twin.script.dry_run_report import against_html, against_summary
    from flexdt.twin.script.log_fit import LogComparison, first_difference
    from flexdt.twin.script.parse import is_log

    known = machines.machine(machine)
    lines = read_log_file(log, known)
    data = script.read_bytes()
    if not is_log(data):
        different = first_difference(parse_script(data).commands, lines)
        if different is not None:
            raise CommandError(f"{script}: {different}; {log} is not a log of it", INVALID)
    found = LogComparison.of(lines, known)
    tell(found.problems, str(log))
    if html is not None:
        html.write_text(against_html(found, script.name), encoding="utf-8")
    yield found.to_dict()
    yield table(found.table(), found.HEADER) + "\n"
    yield table([(f"{label}:", value) for label, value in against_summary(found)])


def read_log_file(log: Path, machine: Machine) -> tuple[Executed, ...]:
    """The lines of an executed script, or of one in a recording of `flexdt follow`.

    What is worth knowing about them goes to standard error.

    Raises:
        CommandError: it is no log, or a line of it does not hold.
    """
    from flexdt.clients.following.session import STAMP
    from flexdt.twin.script.executed_log import COLUMNS, read_log
    from flexdt.twin.script.parse import is_log

    data = log.read_bytes()
    if STAMP.match(data):
        from flexdt.clients.following.session import executed_script

        data = executed_script(data, machine)
    if not is_log(data):
        raise CommandError(f"{log}: no line of an executed script in it; {COLUMNS}", INVALID)
    lines, problems = read_log(data)
    tell(problems, str(log))
    if any(p.severity == "error" for p in problems):
        raise CommandError(f"{log}: the log does not hold; nothing was done", INVALID)
    return lines


def exit_code(report: CheckReport) -> int:
    """Exit code of a check."""
    return verdict(p.code for p in report.problems if p.severity == "error")


def tell(problems: Sequence[ScriptProblem], file: str) -> None:
    """Problems with their places, to standard error."""
    for p in problems:
        place = ":".join([file, *(str(n) for n in (p.line, p.column) if p.line)])
        note(f"{place}: {p.severity}: {p.message} [{p.code}]")


def show(report: CheckReport, file: str) -> Answer:
    """The plan and the figures of a check."""
    from flexdt.twin.script.dry_run_report import between, summary
    from flexdt.twin.script.planning.time_ranges import step_range

    timing = report.plan.machine.timing
    steps = [
        (s.line, f"{s.start_s:.2f}", f"{s.duration_s:.2f}", between(step_range(s, timing)),
         f"{s.assumed_s:.2f}" if s.assumed_s else "", s.what)
        for s in report.plan.steps
    ]  # fmt: skip
    if steps:
        head = ("line", "start [s]", "takes [s]", "90 %", "of it commands", "what")
        yield table(steps, head) + "\n"
    yield table([(f"{label}:", value) for label, value in summary(report)])
    yield f"{file}: {'ok' if report.ok else 'not ok'}"


def run(
    twin: Twin,
    script: ScriptFile,
    out: str | None = option(None, metavar="NAME"),
    sample: str | None = option(None, metavar="NAME"),
    speed_up: Any = option(None, metavar="X or max", parser=process_settings.speed_up),
    detach: bool = option(False, "--detach"),
) -> Answer:
    """Run a script on the twin and wait for the data set.

    Ctrl-C leaves the scan running; `flexdt job` steers it.

    Args:
        out: Give the data set this name.
        sample: Put this sample on the stage first.
        speed_up: Let the twin's time run X times as fast as yours.
        detach: Return once the script is submitted.
    """
    from flexdt.protocol.rpc_errors import RpcError

    data = script.read_bytes()
    with twin() as client:
        if sample is not None:
            client.set_sample(sample)
        began = client.state().time
        try:
            made = client.submit_script(data, name=out, speed_up=speed_up)
        except RpcError as error:
            places = positions(error.data, str(script))
            if not places:
                raise
            for place in places:
                note(place)
            raise CommandError(
                f"{script} was refused; nothing was started", wire_code(error)
            ) from None
        warn(made.warnings, script)
        if detach:
            yield made
            yield f"{made.job} submitted; `flexdt job status {made.job}`"
            return
        last = follow(client, made.job)
        seen = client.state().image
    if seen is not None and (seen.time or 0.0) >= began:
        warn_of_exposure(seen)
    yield last
    yield describe(last)
    if last.state != "done":
        message = (last.error or {}).get("message", "the data set is incomplete")
        raise CommandError(f"{last.job} {last.state}: {message}", failure_code(last))


def failure_code(status: JobStatus) -> int:
    """Exit code of a job that did not end well."""
    return WIRE_EXIT_CODES.get((status.error or {}).get("code"), INVALID)


def follow(client: TwinClient, job: str, *, own: bool = False) -> JobStatus:
    """Show a job's progress until it ends; returns its last status.

    Args:
        client: connected to the twin.
        job: which one.
        own: no other client steers the job, so Ctrl-C and a pause because of an error end the wait.

    Raises:
        CommandError: Ctrl-C; the job goes on, and the message says how to steer it.
    """
    shown = ""

    def show(status: JobStatus) -> None:
        nonlocal shown
        text = f"{job}: {status.state}" if status.state != "running" else None
        bar.update(status.frames_done, status.frames_total or None, text)
        reason = str(status.error.get("message", "")) if status.error else ""
        if status.state == "paused" and reason and reason != shown:
            shown = reason
            if own:
                raise CommandError(f"{job} is paused: {reason}", failure_code(status))
            note(f"{job} is paused: {reason}; `flexdt job resume {job}` goes on")

    try:
        with ProgressBar(f"{job}: scanning") as bar:
            return client.wait_job(job, show)
    except KeyboardInterrupt:
        if own:
            raise
        raise CommandError(
            f"detached; {job} goes on: `flexdt job status {job}`, `flexdt job abort {job}`",
            INTERRUPTED,
        ) from None


Kind = Literal["fly", "step", "tiled", "helical", "calibration"]
"""As `compose.Kind`, which is not imported for the help's sake."""


def new(
    kind: Kind = option(...),
    file: Path | None = option(None, "--out", metavar="FILE"),
    sod: float | None = option(None, metavar="MM"),
    sdd: float | None = option(None, metavar="MM"),
    frames: int = option(361),
    exposure: float | None = option(None, metavar="MS"),
    averages: int = option(1),
    position: list[str] | None = option(None, metavar="SOD[:LATERAL]"),
    tiles: int | None = option(None),
    turns: float | None = option(None),
    rise: float | None = option(None, metavar="MM"),
    kv: float | None = option(None, metavar="KV"),
    power: float | None = option(None, metavar="W"),
    mode: str | None = option(None, metavar="NAME"),
    roi: options.Roi = None,
    machine: options.MachineName = None,
    profile: options.ProfileName = None,
) -> Answer:
    """Write a valid scan script; one that `flexdt check` would reject is not written.

    Args:
        kind: Write a script of this kind.
        file: Write to this file; default: standard output.
        sod: Set this distance; default: 600 and 1059, or the machine's.
        sdd: Set this distance; default: 600 and 1059, or the machine's.
        frames: Take so many images in a turn, or in all.
        exposure: Expose each image so long; default: 100, or as near as the camera gets.
        averages: Average so many read-outs in an image.
        position: Put a calibration scan there; once for each scan.
        tiles: Put so many tiles side by side; default: 2.
        turns: Make so many turns of a helix; default: 3.
        rise: Let a helix rise by so much; default: 20.
        kv: Set the tube's voltage.
        power: Set the tube's power.
        mode: Set the camera's mode.
    """
    from flexdt.library.scripts import collisions
    from flexdt.twin.machine.camera import Roi
    from flexdt.twin.script import check_script
    from flexdt.twin.script.compose import compose_script
    from flexdt.twin.script.scan_request import ScanRequest

    own = _own(kind, position=position, tiles=tiles, turns=turns, rise=rise)
    scanner = machines.machine(machine)
    offsets = machines.profile(profile, scanner, machine)
    request = ScanRequest(
        kind=kind,
        sod_mm=sod,
        sdd_mm=sdd,
        height_mm=chosen(ScriptNewSettings).height,
        frames=frames,
        exposure_ms=exposure,
        averages=averages,
        kV=kv,
        power_W=power,
        mode=mode,
        roi=None if roi is None else Roi(*roi),
    )
    text = compose_script(replace(request, **own), scanner, offsets)
    report = check_script(
        text, scanner, offsets, collision=collisions(None) if scanner.components else None
    )
    plan = report.plan
    tell(report.problems, str(file or "script"))
    if not report.ok:
        raise CommandError(
            "these options give an invalid script; nothing was written", exit_code(report)
        )
    if file is not None:
        file.write_bytes(text.encode("utf-8"))
    yield {"file": file, "text": text, "frames": plan.frames, "bytes": plan.bytes,
           "duration_s": plan.duration_s}  # fmt: skip
    if file is None:
        yield text.removesuffix("\n")
    else:
        yield f"{file}: {plan.frames} frames, {size(plan.bytes)}, {duration(plan.duration_s)}"


def _own(kind: Kind, **given: Any) -> dict[str, Any]:
    """Members of a request that belong to one kind of scan.

    Raises:
        typer.BadParameter: an option of another kind was given.
    """
    kinds = {"position": "calibration", "tiles": "tiled", "turns": "helical", "rise": "helical"}
    own = {name: value for name, value in given.items() if value not in (None, [])}
    for name in own:
        if kinds[name] != kind:
            raise typer.BadParameter(f"--{name} is for --kind {kinds[name]}, not {kind}")
    if "position" in own:
        from flexdt.twin.script.scan_request import ScanPosition

        own["placements"] = tuple(
            ScanPosition(*options.position(word)) for word in own.pop("position")
        )
    if "rise" in own:
        own["rise_mm"] = own.pop("rise")
    return own


Job = Annotated[
    str | None, typer.Argument(metavar="JOB", help="As in `job list`; the current one if left out.")
]


def list_jobs(twin: Twin) -> Answer:
    """List all jobs, oldest first."""
    with twin() as client:
        found = client.jobs()
    yield found
    rows = [(j.job, j.state, f"{j.frames_done}/{j.frames_total}", j.dataset or j.name)
            for j in found.jobs]  # fmt: skip
    yield table(rows, ("job", "state", "frames", "data set")) if rows else "no jobs yet"


def _on_job(does: str, method: str) -> Callable[..., Answer]:
    """A command that does something with one job and shows how the job is then."""

    def command(twin: Twin, job: Job = None) -> Answer:
        with twin() as client:
            status: JobStatus = getattr(client, method)(job)
        warn(status.warnings)
        yield status
        yield describe(status)

    command.__doc__ = does
    return command


def describe(status: JobStatus) -> str:
    """A job in one line."""
    text = f"{status.job}: {status.state}, {status.frames_done} of {status.frames_total} frames"
    if status.line is not None:
        text += f", line {status.line}"
    if status.what:
        text += f" ({status.what})"
    if status.remaining_s is not None and status.state in ("queued", "running", "paused"):
        text += f", {duration(status.remaining_s)} left on the twin's clock"
    if status.error:
        text += f"; {status.error.get('message', status.error)}"
    if status.dataset:
        text += f"; data set {status.dataset}"
    return text


JOB_COMMANDS: Final = {
    "list": list_jobs,
    "status": _on_job("Show how far a job is.", "job_status"),
    "pause": _on_job("Pause a job; a frame under exposure is taken again.", "pause_job"),
    "resume": _on_job("Return to the pose of the pause and go on.", "resume_job"),
    "step": _on_job("Run a paused job for one step.", "step_job"),
    "abort": _on_job("End a job; its data set stays, marked incomplete.", "abort_job"),
}
"""Commands of the group by name."""


BEST = 5
"""Proposed settings that are shown."""


def expose(
    dataset: Path | None = argument(None, "[DATASET]"),
    sample: str = option("lego", metavar="NAME or FILE"),
    material: str | None = option(None, metavar="M"),
    kV: list[float] | None = option(None, "--kV", "--kv"),
    power: float | None = option(None, metavar="W"),
    filter: str = option("", metavar="MATERIAL:MM"),
    exposure: float | None = option(None, metavar="MS"),
    averages: int = option(1),
    mode: str | None = option(None, metavar="NAME"),
    roi: options.Roi = None,
    frames: int = option(361),
    sod: float = option(600.0, metavar="MM"),
    sdd: float = option(1059.0, metavar="MM"),
    detail: str = option("void:0.5", metavar="MATERIAL:MM"),
    machine: options.MachineName = None,
) -> Answer:
    """Predict transmission, contrast to noise, dose and the best voltage and filter.

    Args:
        dataset: Measure a scan's radiographs instead.
        sample: Predict the scan of this sample.
        material: Fill a mesh file with this material.
        kV: Try this voltage; repeat it for more, and the best is chosen.
        power: Set the tube's power.
        filter: Put this filter beside the machine's own.
        exposure: Expose each image so long.
        averages: Average so many read-outs in an image.
        mode: Set the camera's mode.
        frames: Take so many images of the scan.
        sod: Set the distance from source to axis.
        sdd: Set the distance from source to panel.
        detail: See this detail; void:MM for less of the sample.
    """
    from flexdt.library import expose as of
    from flexdt.library.reading.folders import load_dataset
    from flexdt.twin.machine.camera import Roi

    if dataset is not None:
        data = load_dataset(dataset)
        warn(data.warnings, dataset)
        measured = of.exposure_of(data)
        yield asdict(measured)
        yield from _seen(measured)
        return
    forecast = of.expose(
        sample,
        kV=kV or None,
        power_W=power,
        filter=filter,
        exposure_ms=exposure,
        averages=averages,
        mode=mode,
        roi=None if roi is None else Roi(*roi),
        images=frames,
        sod=sod,
        sdd=sdd,
        detail=detail,
        machine=machines.machine(machine),
        material=material,
    )
    warn(forecast.assumed)
    yield asdict(forecast)
    yield from _told(forecast)


def _seen(found: Forecast | Measured) -> Answer:
    seen: Transmission = found.transmission
    yield (f"transmission: least {seen.least:.3g}, 1 % below {seen.p1:.3g}, "
           f"5 % below {seen.p5:.3g}, half below {seen.median:.3g}")  # fmt: skip
    full = "unknown" if found.saturated is None else f"{100 * found.saturated:.3g} % of the pixels"
    yield f"saturated {full}, starved {100 * found.starved:.3g} %"


def _told(forecast: Forecast) -> Answer:
    yield from _seen(forecast)
    asked = forecast.asked
    yield f"{forecast.detail} on the darkest ray: contrast {asked.cnr:.3g} times the noise"
    yield (f"air kerma on the axis {asked.kerma_mGy:.3g} mGy; {forecast.images} images, at least "
           f"{duration(forecast.seconds)}, {size(forecast.bytes)}")  # fmt: skip
    rows = [
        (f"{s.kV:g}", s.filter or "-", f"{s.averages} x {s.exposure_ms:.4g}", f"{s.cnr:.3g}",
         f"{s.kerma_mGy:.3g}")
        for s in forecast.best[:BEST]
    ]  # fmt: skip
    yield f"best of {len(forecast.best)} settings of the same power and time:"
    yield table(rows, ("kV", "filter", "ms", "contrast/noise", "mGy"))
