"""One command line run: the command tree, the error boundary, an exit code."""

from __future__ import annotations

import os
import traceback
from collections.abc import Sequence

import typer
from typer.main import get_command

from flexdt.clients.cli.boundary import DONE, INTERRUPTED, USAGE, describe
from flexdt.clients.cli.command_tree import build
from flexdt.clients.cli.console import hush, note, printable

RETIRED = ("backup", "restore")
COMPLETING = "_FLEXDT_COMPLETE"


def run(argv: Sequence[str]) -> int:
    """Run one command line.

    Args:
        argv: words after the program's name.

    Returns:
        The exit code.
    """
    printable()
    if argv and argv[0] in RETIRED:
        note(
            f"flexdt {argv[0]}: has been removed; the data directory of a stopped twin is an "
            "ordinary folder: `tar -cf ARCHIVE.tar DIR` copies it, `tar -xf ARCHIVE.tar` unpacks it"
        )
        return USAGE
    completing = COMPLETING in os.environ  # a shell asks what could come next
    command = get_command(build(None if completing else argv))
    if completing:
        command.main(list(argv), prog_name="flexdt")
    try:
        # Not `main`, which takes a reader of our output that has gone for a failure.
        with command.make_context("flexdt", _spread(argv)) as context:
            command.invoke(context)
        return DONE
    except (KeyboardInterrupt, typer.Abort):
        note("flexdt: interrupted")
        return INTERRUPTED
    except typer.Exit as leave:
        return leave.exit_code
    except BrokenPipeError:  # the help page's; results are `say`'s
        hush()
        return DONE
    except Exception as error:
        if os.environ.get("FLEXDT_TRACEBACK"):
            traceback.print_exc()
        lines, code = describe(error)
        for line in lines:
            note(line)
        return code


def _spread(argv: Sequence[str]) -> list[str]:
    """`--roi 'L T R B'` (or with commas) as the four words that `--roi L T R B` has."""
    out: list[str] = []
    for word in argv:
        whole = out[-1:] == ["--roi"]
        out += word.replace(",", " ").split() if whole else [word]
    return out
