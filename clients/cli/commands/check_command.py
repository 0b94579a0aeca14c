"""`flexdt check`: parse, plan and check a script without a server, or compare it with
its log."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

import typer

from flexdt.clients.cli import options, value_completion
from flexdt.clients.cli.boundary import INVALID
from flexdt.clients.cli.commands.script_files import (
    ScriptFile,
    exit_code,
    read_log_file,
    tell,
)
from flexdt.clients.cli.console import speaks, table
from flexdt.clients.cli.options import Answer, option
from flexdt.library import machines
from flexdt.library.failure import CommandError
from flexdt.runtime.files.limited_files import limited_bytes

if TYPE_CHECKING:
    from flexdt.twin.script import CheckReport

MAX_STEPS: Final = 8
"""Steps of a plan that are listed unasked: with the summary, a screen of 25 lines."""


def check(
    script: ScriptFile,
    machine: options.MachineName = None,
    profile: options.ProfileName = None,
    sample: str | None = option(
        None, metavar="NAME or FILE", proposes=value_completion.sample_names
    ),
    html: Path | None = option(None, metavar="FILE", written=True),
    against: Path | None = option(None, metavar="LOG"),
    json: bool = False,
) -> Answer:
    """Parse, plan and check a script, without a server.

    Exit code 0 with warnings alone, 1 for an invalid script, 3 for a collision or limit.

    Args:
        sample: Check truncation, collisions and exposure of this sample.
        html: Write the report to this file as one page.
        against: Compare with the log of this script, line by line.

    Yields:
        The report as document of --json, then its tables as lines; problems go to
        standard error, without --json only. With --against, those of `compare`. Ends by
        typer.Exit.
    """
    if against is not None:
        yield from compare(script, against, machine, html)
        return
    from flexdt.library.dry_run_page import html_report
    from flexdt.library.scripts import collisions, size_of, with_exposures
    from flexdt.phantoms.samples import as_phantom
    from flexdt.twin.script import check_script

    data = limited_bytes(script, "script")
    scanner = machines.machine(machine)
    if sample is None:
        phantom = None
    else:
        phantom = as_phantom(sample)
    report = check_script(
        data,
        scanner,
        machines.profile(profile, scanner, machine),
        sample=size_of(phantom),
        collision=collisions(phantom) if scanner.components else None,
    )
    report = with_exposures(report, phantom)
    if html is not None:
        html.write_text(html_report(report, script.name), encoding="utf-8")
    yield report.to_dict()
    if not json:
        tell(report.problems, str(script))
    yield from show(report, str(script))
    raise typer.Exit(exit_code(report))


def compare(script: Path, log: Path, machine: str | None, html: Path | None) -> Answer:
    """Compare each line of an executed script with its prediction, the greatest errors
    first.

    Problems of the log are written to standard error. A script that is a log itself is
    not compared line by line. `against` replaces plan and check.

    Args:
        script: file of the script, or the log itself.
        log: file of the executed script.
        machine: description; None for the default.
        html: file for a report; None for none.

    Returns:
        Document and lines of the answer.

    Raises:
        CommandError: the log is not of this script; the message names the first line that
            differs.
    """
    from flexdt.library.dry_run_page import against_html
    from flexdt.twin.script import parse_script
    from flexdt.twin.script.dry_run_report import against_summary
    from flexdt.twin.script.log_fit import LogComparison, first_difference
    from flexdt.twin.script.parse import is_log

    known = machines.machine(machine)
    lines = read_log_file(log, known)
    data = limited_bytes(script, "script")
    if not is_log(data):
        different = first_difference(parse_script(data).commands, lines)
        if different is not None:
            raise CommandError(
                f"{script}: {different}; {log} is not a log of it", INVALID
            )
    found = LogComparison.of(lines, known)
    tell(found.problems, str(log))
    if html is not None:
        html.write_text(against_html(found, script.name), encoding="utf-8")
    yield found.to_dict()
    yield table(found.table(), found.HEADER) + "\n"
    yield table([(f"{label}:", value) for label, value in against_summary(found)])


def show(report: CheckReport, file: str) -> Answer:
    """Yield the plan and the figures of a check.

    Yields the table of steps, or their number where they are more than `MAX_STEPS` and
    `--verbose` is not given, the summary, and "ok" or "not ok". Times are in [s]; a cell
    without an assumed time is empty.

    Args:
        report: of the check.
        file: name of the script, for the last line.
    """
    from flexdt.twin.script.dry_run_report import between, summary
    from flexdt.twin.script.planning.time_ranges import step_range

    timing = report.plan.machine.timing
    steps = [
        (
            s.line,
            f"{s.start_s:.2f}",
            f"{s.duration_s:.2f}",
            between(step_range(s, timing)),
            f"{s.assumed_s:.2f}" if s.assumed_s else "",
            s.what,
        )
        for s in report.plan.steps
    ]
    if len(steps) > MAX_STEPS and not speaks():
        yield f"{len(steps)} steps, of lines {steps[0][0]} to {steps[-1][0]}: -v lists them\n"
    elif steps:
        head = (
            "line",
            "start [s]",
            "takes [s]",
            "90 % within [s]",
            "assumed [s]",
            "what",
        )
        yield table(steps, head) + "\n"
    yield table([(f"{label}:", value) for label, value in summary(report)])
    doubts = len(report.problems.warnings)
    told = f", {doubts} warning{'s' * (doubts > 1)}" if report.ok and doubts else ""
    yield f"{file}: {'ok' if report.ok else 'not ok'}{told}"
