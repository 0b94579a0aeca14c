"""`flexdt commission`: a machine, its zero offsets and their drift from past scans; and its
former name for executed scripts alone, `flexdt machine fit`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from flexdt.clients.cli.commands.script_files import read_log_file, tell
from flexdt.clients.cli.console import note, table
from flexdt.clients.cli.options import Answer, argument, option
from flexdt.library import machines
from flexdt.library.failure import CommandError

if TYPE_CHECKING:
    from flexdt.library.commission import Table
    from flexdt.twin.script.log_fit import Fit


def commission(
    scans: list[Path] = argument(..., "SCAN..."),
    base: str | None = option(None, metavar="FILE or NAME"),
    traffic: Path | None = option(None, metavar="FILE", hidden=True),
    out: Path = option(..., metavar="DIR"),
) -> Answer:
    """Fit a machine, its zero offsets and their drift to past scans, and report contradictions.

    Args:
        scans: Folders, executed scripts, recordings of follow; oldest first.
        base: Take what scans do not tell from this machine, not the one that they name.
        traffic: Deprecated: one more of `scans`.
        out: Write machine, profile and report to this folder.

    Yields:
        The document of --json, a table of each part of the report, and the files written.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise CommandError(f"{out} is there; allowed: a new or an empty folder")
    from flexdt.library.commission import MACHINE_FILE, write_commission
    from flexdt.library.commission import commission as commissioned

    if traffic is not None:
        note("warning: --traffic is deprecated: a recording is one more SCAN")
        scans = [*scans, traffic]
    found = commissioned(scans, read_log_file, base)
    write_commission(found, out)
    yield found.document(out)
    yield from _report(found.tables(out))
    if found.fit is not None:
        yield from _accuracy(found.fit, sum(bool(s.log) for s in found.scans))
    yield f"{out}: machine.toml, profile.toml, commission.json and report.html written"
    if refused := found.findings.errors:
        raise CommandError(f"{out / MACHINE_FILE}: {refused[0].text}")


def fit(
    logs: list[Path] = argument(..., "LOG..."),
    out: Path = option(..., metavar="FILE", written=True),
    base: str = option(machines.DEFAULT_MACHINE, metavar="FILE or NAME"),
) -> Answer:
    """Fit a machine to executed scripts. Deprecated: `flexdt commission` does it.

    Args:
        logs: Logs, or recordings of follow; oldest first.
        out: Write the machine to this file.
        base: Take values that are not in the logs from this machine.

    Yields:
        The fit as document of --json, then tables of axes and times, and lines. Commands
        unlike the base machine are noted on standard error.
    """
    from flexdt.library.commission import Base, fit_scans
    from flexdt.twin.commissioning import PastScan
    from flexdt.twin.script.log_fit import unlike

    note(
        "warning: `flexdt machine fit` is deprecated: `flexdt commission LOG... "
        f"--base {base} --out DIR` writes DIR/machine.toml"
    )
    start = Base.of(base)
    scans = [PastScan(str(log), log=read_log_file(log, start.machine)) for log in logs]
    fitted = fit_scans(scans, start, str(out))
    if fitted.fit is None:
        raise CommandError("no line of the logs can be read, so there is nothing to fit")
    for scan in scans:
        tell(unlike(scan.log, start.machine), scan.name)
    out.write_text(fitted.text, encoding="utf-8")
    yield fitted.fit.to_dict()
    yield from _report(fitted.tables())
    yield from _accuracy(fitted.fit, len(logs))
    yield f"{out}: written, everything else as in {base}"


def _report(tables: Mapping[str, Table]) -> Iterator[str]:
    """Format tables of a report, each below its title."""
    from flexdt.library.report_page import cell_text

    for title, (head, rows) in tables.items():
        yield f"{title}\n{table(([cell_text(x) for x in row] for row in rows), head)}\n"


def _accuracy(fit: Fit, logs: int) -> Iterator[str]:
    """Say how well a fit predicts its own lines, and what one log cannot show."""
    lines = fit.lines
    yield (
        f"{len(lines.rows)} lines, {lines.total_real_s:.2f} s; absolute errors sum to "
        f"{lines.sum_abs_error_s:.2f} s, {fit.cross_validated_s:.2f} s with each time "
        "predicted from the others of its kind; all times together drift by up to "
        f"{100 * fit.machine.timing.drift:.0f} %"
    )
    if logs == 1:
        yield (
            "one log does not show how a scan differs from the next: ranges may be too narrow"
        )
