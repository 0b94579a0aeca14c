"""The command tree: each name with the function that it runs.

Command modules import what they need inside their functions, so building the tree is cheap.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import typer
from typer.core import TyperGroup

from flexdt.clients.cli import extension_commands
from flexdt.clients.cli.commands.data_sets import (
    calibrate_commands,
    exchange_commands,
    expose_command,
    reconstruct_command,
)
from flexdt.clients.cli.commands.processes import (
    demo_command,
    doctor_command,
    process_commands,
)
from flexdt.clients.cli.commands.scanner import (
    follow_command,
    job_command,
    machine_command,
    motion_commands,
    phantom_command,
    sample_command,
    script_commands,
    snap_command,
    state_commands,
)
from flexdt.clients.cli.options import answering, option

COMMANDS: Final[Mapping[str, Callable[..., object]]] = {
    "demo": demo_command.demo,
    "up": process_commands.up,
    "twin": process_commands.twin,
    "projector": process_commands.projector,
    "viewer": process_commands.viewer,
    "gateway": process_commands.gateway,
    "check": script_commands.check,
    "run": script_commands.run,
    "state": state_commands.state,
    "tube": state_commands.tube,
    "camera": state_commands.camera,
    "clock": state_commands.clock,
    "move": motion_commands.move,
    "jog": motion_commands.jog,
    "stop": motion_commands.stop,
    "estop": motion_commands.estop,
    "reset": motion_commands.reset,
    "sample": sample_command.sample,
    "snap": snap_command.snap,
    "calibrate": calibrate_commands.calibrate,
    "align": calibrate_commands.align,
    "compare": calibrate_commands.compare,
    "expose": expose_command.expose,
    "reconstruct": reconstruct_command.reconstruct,
    "export": exchange_commands.export,
    "import": exchange_commands.import_,
    "follow": follow_command.follow,
    "doctor": doctor_command.doctor,
}
"""Name -> what it runs."""
GROUPS: Final[Mapping[str, tuple[str, Mapping[str, Callable[..., object]]]]] = {
    "script": ("Scan scripts.", {"new": script_commands.new}),
    "job": ("Jobs: scripts and trajectories being run.", job_command.COMMANDS),
    "phantom": (
        "Phantoms: objects to scan.",
        {
            "list": phantom_command.list_phantoms,
            "make": phantom_command.make,
        },
    ),
    "machine": (
        "Machines as data, and from their logs.",
        {
            "list": machine_command.list_machines,
            "show": machine_command.show,
            "check": machine_command.check,
            "new": machine_command.new,
            "fit": machine_command.fit,
        },
    ),
}
"""Name -> what its commands are about, and the commands."""
NUMBERS_WITH_SIGN: Final = ("jog", "clock")
"""Commands whose arguments may begin with a minus."""
ALONE: Final = ("twin", "projector", "viewer", "gateway")
"""Commands that pass their words on to a process, `--help` among them."""
SECTIONS: Final[Mapping[str, tuple[str, ...]]] = {
    "Scanner": ("state", "move", "jog", "stop", "estop", "reset", "tube", "camera", "clock",
                "sample", "snap"),
    "Scans": ("script", "check", "expose", "run", "job", "follow"),
    "Data": ("calibrate", "align", "compare", "reconstruct", "export", "import", "simulate"),
    "Analysis": ("phantom", "machine", "study", "batch", "bench"),
    "Processes": ("up", *ALONE, "demo", "doctor"),
}  # fmt: skip
"""Sections of the help page; commands in none of them are listed under Extensions."""


class InSections(TyperGroup):
    """Lists its commands in `SECTIONS`."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the sections of the help page."""
        found = {name: self.get_command(ctx, name) for name in self.list_commands(ctx)}
        named = {name for names in SECTIONS.values() for name in names}
        others = tuple(name for name in found if name not in named)
        room = formatter.width - 6 - max(map(len, found))
        for title, names in {**SECTIONS, "Extensions": others}.items():
            rows = [(name, command.get_short_help_str(room))
                    for name in names if (command := found.get(name)) is not None]  # fmt: skip
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)


def build(words: Sequence[str] | None = None) -> typer.Typer:
    """The whole command line.

    Args:
        words: of the command line, after the program's name: of other distributions' commands the
            one that is named is loaded, the others are listed. None loads all.
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
            False, "Print the version and exit.", "--version", callback=_version, is_eager=True
        ),
    ) -> None:
        pass

    for name, command in COMMANDS.items():
        passes = name == "up" or name in ALONE
        context: dict[str, Any] = {
            "ignore_unknown_options": name in NUMBERS_WITH_SIGN or passes,
            "allow_extra_args": passes,
        }
        if name in ALONE:
            context["help_option_names"] = []
        app.command(name, context_settings=context)(_complete(command))
    groups = {}
    for name, (about, commands) in GROUPS.items():
        groups[name] = typer.Typer(help=about, no_args_is_help=True, add_completion=False)
        for one, command in commands.items():
            groups[name].command(one)(_complete(command))
        app.add_typer(groups[name], name=name)
    _add_others(app, groups, words)
    return app


def _add_others(
    app: typer.Typer, groups: Mapping[str, typer.Typer], words: Sequence[str] | None
) -> None:
    """Add other distributions' commands, which take no name of ours."""
    if words is None:
        asked = [*extension_commands.KNOWN]
    else:
        first, second = [*words, "", ""][:2]
        asked = [f"{first} {second}" if first in GROUPS else first]
    ours = {*COMMANDS, *(f"{group} {one}" for group, (_, more) in GROUPS.items() for one in more)}
    asked = [name for name in asked if name not in ours and name and name.split()[-1][0] != "-"]
    for name in dict.fromkeys([*extension_commands.KNOWN, *asked]):
        command = extension_commands.found(name) if name in asked else None
        group, _, one = name.rpartition(" ")
        place = groups[group] if group else app
        if command is not None:
            place.command(one)(_complete(command))
        elif name in extension_commands.KNOWN:
            # Whatever follows the name, the answer is how to install it.
            bare = {"ignore_unknown_options": True, "help_option_names": list[str]()}
            place.command(one, context_settings=bare)(extension_commands.listed(name))


def _complete(command: Callable[..., Any]) -> Callable[..., object]:
    """A command as typer takes it: with --json, if it yields its answer."""
    return answering(command) if inspect.isgeneratorfunction(inspect.unwrap(command)) else command


def _version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        typer.echo(f"flexdt {version('flexdt')}")
        raise typer.Exit
