"""`flexdt commission`: a machine, its zero offsets and their drift from past scans."""

from __future__ import annotations

from pathlib import Path

from flexdt.clients.cli.commands.script_files import read_log_file
from flexdt.clients.cli.console import table
from flexdt.clients.cli.options import Answer, argument, option
from flexdt.library.failure import CommandError


def commission(
    folders: list[Path] = argument(..., "FOLDER..."),
    traffic: Path | None = option(None, metavar="FILE"),
    out: Path = option(..., metavar="DIR"),
) -> Answer:
    """Fit a machine, its zero offsets and their drift to past scans, and report contradictions.

    Args:
        folders: Past scans.
        traffic: Read this recording of `flexdt follow --record` too.
        out: Write machine, profile and report to this folder.

    Yields:
        The document of --json, a table of each part of the report, and the files written.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise CommandError(f"{out} is there; allowed: a new or an empty folder")
    from flexdt.library.commission import MACHINE_FILE, write_commission
    from flexdt.library.commission import commission as commissioned
    from flexdt.library.report_page import cell_text

    found = commissioned(folders, traffic, read_log_file)
    write_commission(found, out)
    yield found.document(out)
    for title, (head, rows) in found.tables(out).items():
        yield f"{title}\n{table(([cell_text(x) for x in row] for row in rows), head)}\n"
    yield f"{out}: machine.toml, profile.toml, commission.json and report.html written"
    if refused := found.findings.errors:
        raise CommandError(f"{out / MACHINE_FILE}: {refused[0].text}")
