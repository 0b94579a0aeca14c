"""The command tree: each name with the function that it runs.

Command modules import their dependencies inside their functions, so building the tree is
cheap.

`run` runs one command line: the command tree, the error boundary, an exit code.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import islice
from typing import Any, Final

import typer
from typer.core import TyperGroup
from typer.main import get_command

from flexdt.clients.cli.boundary import DONE, INTERRUPTED, USAGE, describe
from flexdt.clients.cli.commands import calibrate_commands as geometry
from flexdt.clients.cli.commands import check_command as checking
from flexdt.clients.cli.commands import commission_command as commissioning
from flexdt.clients.cli.commands import data_commands as data
from flexdt.clients.cli.commands import demo_command as demonstration
from flexdt.clients.cli.commands import doctor_command as installation
from flexdt.clients.cli.commands import expose_command as exposure
from flexdt.clients.cli.commands import follow_command as following
from flexdt.clients.cli.commands import job_commands as jobs
from flexdt.clients.cli.commands import machine_commands as machines
from flexdt.clients.cli.commands import new_machine_command as new_machine
from flexdt.clients.cli.commands import phantom_commands as phantoms
from flexdt.clients.cli.commands import process_commands as processes
from flexdt.clients.cli.commands import scanner_commands as scanner
from flexdt.clients.cli.commands import script_commands as scripts
from flexdt.clients.cli.completed_commands import completed
from flexdt.clients.cli.console import (
    COMPLETION_VARIABLE,
    PROCESS_COMMANDS,
    SERVERS,
    hush,
    note,
    printable,
    speak,
)
from flexdt.clients.cli.options import Json, Server, TokenFile, Verbose, argument, option

COMMANDS: Final[Mapping[str, Callable[..., object]]] = {
    name.strip("_"): getattr(module, name)
    for module, names in (
        (demonstration, "demo"),
        (processes, "up twin projector viewer gateway"),
        (installation, "doctor"),
        (checking, "check"),
        (jobs, "run"),
        (exposure, "expose"),
        (scanner, "state tube camera clock move jog stop estop reset sample snap"),
        (geometry, "calibrate align compare"),
        (data, "reconstruct describe export import_"),
        (following, "follow"),
        (commissioning, "commission"),
    )
    for name in names.split()
}
"""Name -> function of a command."""
GROUPS: Final[Mapping[str, tuple[str, Mapping[str, Callable[..., object]]]]] = {
    "script": ("Scan scripts.", {"new": scripts.new}),
    "job": ("Jobs: scripts and trajectories being run.", jobs.JOB_COMMANDS),
    "delete": (
        "What a twin keeps, deleted.",
        {"sample": scanner.delete_sample, "correction": scanner.delete_correction},
    ),
    "geometry": ("The geometry of images.", {"guess": data.guess}),
    "phantom": (
        "Phantoms: objects to scan.",
        {"list": phantoms.list_phantoms, "make": phantoms.make},
    ),
    "kernels": (
        "Compiled kernels, and where they are kept.",
        {
            "compile": installation.compile,
            "share": installation.share,
            "delete": installation.delete,
        },
    ),
    "machine": (
        "Machines as data, and from their logs.",
        {
            "list": machines.list_machines,
            "show": machines.show,
            "check": machines.check,
            "new": new_machine.new,
            "fit": commissioning.fit,
        },
    ),
}
"""Name -> subject of a group's commands, and the commands."""
GROUP: Final = "flexdt.commands"
"""Entry points that add other distributions' commands."""
KNOWN: Final[Mapping[str, str]] = {
    "simulate": "Simulate a CTSimU scenario: projections, dark and flat images as TIFF.",
    "study": "Repeat an experiment of the thesis.",
    "batch": "Make a batch of scans or calibrations.",
    "bench": "Measure speed and accuracy, beside the peers that are installed.",
    "evidence": "Compare real, public data with their published answers.",
    "job watch": "End a scan of beads once its calibration is sure enough.",
    "phantom design": "Choose bead places that determine the geometry best.",
}
"""Command of `flexdt-extensions` -> its line of the help page, which imports no other
distribution: an entry point is looked up when its command is on the command line."""
NUMBERS_WITH_SIGN: Final = ("jog", "clock")
"""Commands whose arguments may begin with a minus."""
SECTIONS: Final[Mapping[str, tuple[str, ...]]] = {
    "Scanner": (
        "state",
        "move",
        "jog",
        "stop",
        "estop",
        "reset",
        "tube",
        "camera",
        "clock",
        "sample",
        "delete",
        "snap",
    ),
    "Scans": ("script", "check", "expose", "run", "job", "follow"),
    "Data": (
        "calibrate",
        "align",
        "compare",
        "describe",
        "geometry",
        "reconstruct",
        "export",
        "import",
        "simulate",
    ),
    "Analysis": (
        "phantom",
        "machine",
        "commission",
        "study",
        "batch",
        "bench",
        "evidence",
    ),
    "Processes": (*SERVERS, "demo", "doctor", "kernels"),
}
"""Sections of the help page; commands in none of them are listed under Extensions."""


COMMON: Final[Mapping[str, str]] = {
    "--json": "--json",
    "--server": "--server HOST:PORT",
    "--token-file": "--token-file FILE",
    "--quiet": "--quiet",
    "-q": "-q",
    "--verbose": "--verbose",
    "-v": "-v",
}
"""Options of `flexdt` itself that may also follow the command's name, as help pages show
them."""
OPTIONS_WITH_VALUE: Final = ("--server", "--token-file")
"""Options of `COMMON` that a value follows."""


def own_first(
    words: Sequence[str], flags: Collection[str]
) -> tuple[list[str], list[str]]:
    """Split words into options of `flexdt` itself, of `flags`, and the others, in order.

    A value is in the same word (`--name=value`) or the next; a missing last one is not
    noticed. After `--` none is an option.
    """
    first = list[str]()
    rest = list[str]()
    more = iter(words)
    for word in more:
        if word == "--":
            rest += [word, *more]
        elif word.partition("=")[0] not in flags:
            rest.append(word)
        else:
            first.append(word)
            first += islice(more, 1 if word in OPTIONS_WITH_VALUE else 0)
    return first, rest


class InSections(TyperGroup):
    """Lists its commands in `SECTIONS`, and takes `COMMON` anywhere on the command line."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the command line, with the options of `flexdt` itself that a command heeds put
        before its name.

        Fails with a usage error for an option that the command does not heed, or one
        without a value. Unknown commands are left to typer. Returns the words that
        remain.
        """
        command: Any = self
        for word in own_first(args, COMMON)[1]:
            if word[:1] != "-" and hasattr(command, "commands"):
                command = command.commands.get(word)
        heeds = getattr(getattr(command, "callback", None), "heeds", ())
        first, rest = own_first(args, heeds)
        if first and first[-1] in OPTIONS_WITH_VALUE:
            ctx.fail(f"Option '{first[-1]}' requires an argument.")
        if command not in (None, self) and rest[0].partition("=")[0] in COMMON:
            ctx.fail(
                f"{rest[0].partition('=')[0]} is no option of `flexdt {command.name}`"
            )
        return list(super().parse_args(ctx, [*first, *rest]))

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the commands to the help page, section by section; extensions' commands
        come last.

        Commands that no section names are the extensions'; names that are absent and
        empty sections are left out. A command in several sections is shown in each. The
        text is cut to the formatter's width.
        """
        found = {name: self.get_command(ctx, name) for name in self.list_commands(ctx)}
        named = {name for names in SECTIONS.values() for name in names}
        others = tuple(name for name in found if name not in named)
        room = formatter.width - 6 - max(map(len, found))
        for title, names in {**SECTIONS, "Extensions": others}.items():
            rows = [
                (name, command.get_short_help_str(room))
                for name in names
                if (command := found.get(name)) is not None
            ]
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)


def build(words: Sequence[str] | None = None) -> typer.Typer:
    """Build the command line with all its commands.

    Returns an app of typer, not run yet. Processes' commands pass unknown options on;
    their own help is switched off where the process prints it.

    Args:
        words: of the command line, after the program's name. Of other distributions'
            commands only the named one is loaded, the others are listed. None loads all.
    """
    app = typer.Typer(
        name="flexdt",
        help="Digital twin of the FleX-ray laboratory X-ray CT scanner.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        cls=InSections,
        context_settings={"help_option_names": ["-h", "--help"]},
    )

    @app.callback()
    def root(
        version: bool = option(
            False,
            "Print the version and exit.",
            "--version",
            callback=_version,
            is_eager=True,
        ),
        json: Json = False,
        server: Server = None,
        token_file: TokenFile = None,
        verbose: Verbose = None,
    ) -> None:
        """Take the options before a command."""
        speak(quiet=verbose is False, verbose=verbose is True)

    for name, command in COMMANDS.items():
        passes = name in SERVERS
        context: dict[str, Any] = {
            "ignore_unknown_options": name in NUMBERS_WITH_SIGN or passes,
            "allow_extra_args": passes,
        }
        if name in PROCESS_COMMANDS:
            context["help_option_names"] = []
        _add(app, name, command, context)
    groups = {}
    for name, (about, commands) in GROUPS.items():
        groups[name] = typer.Typer(help=about, no_args_is_help=True, add_completion=False)
        for one, command in commands.items():
            _add(groups[name], one, command)
        app.add_typer(groups[name], name=name)
    _add_others(app, groups, words)
    return app


def found(name: str) -> Callable[..., Any] | None:
    """Load an installed distribution's function for a command of a word or two.

    None if there is none.
    """
    from flexdt.library.optional.extras import offered

    function: Callable[..., Any] | None = offered(name.replace(" ", "."), GROUP)
    return function


def listed(name: str) -> Callable[..., None]:
    """Make the placeholder of a command whose extension is not installed: it takes any
    words, and raises the error that names the package to install.

    The name must be in `KNOWN`, whose line is the placeholder's help.
    """

    def command(words: list[str] | None = argument(None, "...")) -> None:
        from flexdt.library.optional.extras import extension

        extension(name.replace(" ", "."), f"`flexdt {name}`", GROUP)

    command.__doc__ = KNOWN[name]
    return command


def _add_others(
    app: typer.Typer, groups: Mapping[str, typer.Typer], words: Sequence[str] | None
) -> None:
    """Add other distributions' commands, which take no name of ours.

    One that is known but not installed gets a placeholder that explains how to install it. An
    unknown command is not added. All known ones are on the help page.

    Args:
        app: the command line.
        groups: its groups of commands, by name.
        words: of the command line; only the named command is loaded, None loads all known
            ones.
    """
    if words is None:
        asked = [*KNOWN]
    else:
        first, second = [*own_first(words, COMMON)[1], "", ""][:2]
        asked = [f"{first} {second}" if first in GROUPS else first]
    ours = {
        *COMMANDS,
        *(f"{group} {one}" for group, (_, more) in GROUPS.items() for one in more),
    }
    asked = [
        name for name in asked if name not in ours and name and name.split()[-1][0] != "-"
    ]
    for name in dict.fromkeys([*KNOWN, *asked]):
        command = found(name) if name in asked else None
        group, _, one = name.rpartition(" ")
        place = groups[group] if group else app
        if command is not None:
            _add(place, one, command)
        elif name in KNOWN:
            # Whatever follows the name, the answer is how to install it.
            bare = {"ignore_unknown_options": True, "help_option_names": list[str]()}
            place.command(one, context_settings=bare)(listed(name))


def _add(
    app: typer.Typer, name: str, command: Callable[..., Any], context: Any = None
) -> None:
    """Add a command to `app`; its help page ends with the options of `flexdt` itself that
    it heeds, if any.

    The function gets the list of these options as `heeds`.
    """
    complete, heeds = completed(command)
    complete.heeds = heeds  # type: ignore[attr-defined]
    if heeds:
        also = f"Also, of flexdt itself: {', '.join(COMMON[flag] for flag in heeds)}"
    else:
        also = None
    app.command(name, context_settings=context, epilog=also)(complete)


def _version(asked: bool) -> None:
    """Print flexdt's version and exit, if requested; else do nothing."""
    if asked:
        from importlib.metadata import version

        typer.echo(f"flexdt {version('flexdt')}")
        raise typer.Exit


REMOVED_COMMANDS = ("backup", "restore")


def run(argv: Sequence[str]) -> int:
    """Run one command line and return its exit code; INTERRUPTED by Ctrl-C."""
    try:
        return _run(argv)
    except (KeyboardInterrupt, typer.Abort):
        note("flexdt: interrupted")
        return INTERRUPTED


def _run(argv: Sequence[str]) -> int:
    """Run one command line as `run`; Ctrl-C is not handled here.

    Errors are printed by `describe`, with a traceback first if FLEXDT_TRACEBACK is set.
    Removed commands give USAGE. A reader of our output that has gone is no error. A
    request for completions, by the environment, prints these. Only typer's Abort and
    KeyboardInterrupt are raised.

    Args:
        argv: words after the program's name.

    Returns:
        The exit code.
    """
    printable()
    if argv and argv[0] in REMOVED_COMMANDS:
        note(
            f"flexdt {argv[0]}: has been removed; the data directory of a stopped twin is an "
            "ordinary folder: `tar -cf ARCHIVE.tar DIR` copies it, `tar -xf ARCHIVE.tar` unpacks it"
        )
        return USAGE
    completing = COMPLETION_VARIABLE in os.environ  # a shell requests completions
    command = get_command(build(None if completing else argv))
    if completing:
        command.main(list(argv), prog_name="flexdt")
    try:
        # Not `main`, which takes a reader of our output that has gone for a failure.
        with command.make_context("flexdt", _spread(argv)) as context:
            command.invoke(context)
        return DONE
    except typer.Abort:
        raise
    except typer.Exit as leave:
        return leave.exit_code
    except (
        BrokenPipeError
    ):  # a closed pipe at the help page; `say` handles that of results
        hush(sys.stdout)
        return DONE
    except Exception as error:
        if os.environ.get("FLEXDT_TRACEBACK"):
            traceback.print_exc()
        lines, code = describe(error, argv)
        for line in lines:
            note(line)
        return code


def _spread(argv: Sequence[str]) -> list[str]:
    """Split `--roi 'L T R B'` (or with commas) into the words of `--roi L T R B`."""
    out: list[str] = []
    for word in argv:
        whole = out[-1:] == ["--roi"]
        out += word.replace(",", " ").split() if whole else [word]
    return out
