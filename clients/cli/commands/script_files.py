"""Scripts and their logs as arguments of commands: read them and print their problems."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flexdt.clients.cli.boundary import INVALID, verdict
from flexdt.clients.cli.console import note
from flexdt.library.failure import CommandError
from flexdt.runtime.files.limited_files import limited_bytes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from flexdt.twin.findings import Finding
    from flexdt.twin.machine.description import Machine
    from flexdt.twin.script import CheckReport
    from flexdt.twin.script.executed_log import Executed

ScriptFile = Annotated[
    Path, typer.Argument(metavar="SCRIPT", help="Acquila scan script.")
]


def read_log_file(log: Path, machine: Machine) -> tuple[Executed, ...]:
    """Read the lines of an executed script, or of one in a recording of `flexdt follow`; print
    its problems to standard error.

    Recordings are recognized by their first time stamp. Warnings are printed and do not stop
    the reading. The executed script of a recording is worked out by replaying it. Any
    problem that is an error raises, after all are printed.

    Args:
        log: file.
        machine: of the script, to read a recording.

    Raises:
        CommandError: it is no log, or a line of it does not hold.
    """
    from flexdt.clients.following.recording import STAMP
    from flexdt.twin.script.executed_log import COLUMNS, read_log
    from flexdt.twin.script.parse import is_log

    data = limited_bytes(log, "log")
    if STAMP.match(data):
        from flexdt.clients.following.session import executed_script

        data = executed_script(data, machine)
    if not is_log(data):
        raise CommandError(
            f"{log}: no line of an executed script in it; {COLUMNS}", INVALID
        )
    lines, problems = read_log(data)
    tell(problems, str(log))
    if problems.errors:
        raise CommandError(f"{log}: the log does not hold; nothing was done", INVALID)
    return lines


def tell(problems: Sequence[Finding], file: str) -> None:
    """Print problems with their places to standard error."""
    for p in problems:
        place = ":".join([file, *(str(n) for n in (p.line, p.column) if p.line)])
        note(f"{place}: {p.severity}: {p.message} [{p.code}]")


def exit_code(report: CheckReport) -> int:
    """Determine the exit code of a check."""
    return verdict(p.code for p in report.errors)
