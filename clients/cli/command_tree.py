"""The command tree: each name with the function that it runs.

Command modules import what they need inside their functions, so building the tree is cheap.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import islice
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
from flexdt.clients.cli.options import Json, Server, TokenFile, completed, option

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


OWN: Final[Mapping[str, str]] = {
    "--json": "--json", "--server": "--server HOST:PORT", "--token-file": "--token-file FILE",
}  # fmt: skip
"""Options of `flexdt` itself that may also follow the command's name, as help pages show them."""


def own_first(words: Sequence[str], flags: Collection[str]) -> tuple[list[str], list[str]]:
    """The words of these options of `OWN`, and the other words."""
    first, rest = list[str](), list[str]()
    more = iter(words)
    for word in more:
        if word == "--":
            rest += [word, *more]
        elif word.partition("=")[0] not in flags:
            rest.append(word)
        else:
            first.append(word)
            first += islice(more, 1 if word in OWN and word != "--json" else 0)
    return first, rest


class InSections(TyperGroup):
    """Lists its commands in `SECTIONS`, and takes `OWN` wherever they are on the command line."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put the options of `flexdt` itself that the command heeds before its name."""
        command: Any = self
        for word in own_first(args, OWN)[1]:
            if word[:1] != "-" and hasattr(command, "commands"):
                command = command.commands.get(word)
        heeds = getattr(getattr(command, "callback", None), "heeds", ())
        first, rest = own_first(args, heeds)
        if first and first[-1] in OWN and first[-1] != "--json":
            ctx.fail(f"Option '{first[-1]}' requires an argument.")
        if command not in (None, self) and rest[0].partition("=")[0] in OWN:
            ctx.fail(f"{rest[0].partition('=')[0]} is no option of `flexdt {command.name}`")
        return list(super().parse_args(ctx, [*first, *rest]))

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
        json: Json = False,
        server: Server = None,
        token_file: TokenFile = None,
    ) -> None:
        """What these options say, `completed` commands take from the context."""

    for name, command in COMMANDS.items():
        passes = name == "up" or name in ALONE
        context: dict[str, Any] = {
            "ignore_unknown_options": name in NUMBERS_WITH_SIGN or passes,
            "allow_extra_args": passes,
        }
        if name in ALONE:
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
            _add(place, one, command)
        elif name in extension_commands.KNOWN:
            # Whatever follows the name, the answer is how to install it.
            bare = {"ignore_unknown_options": True, "help_option_names": list[str]()}
            place.command(one, context_settings=bare)(extension_commands.listed(name))


def _add(app: typer.Typer, name: str, command: Callable[..., Any], context: Any = None) -> None:
    """Add a command; its help page ends with the options of `flexdt` that it heeds."""
    complete, heeds = completed(command)
    complete.heeds = heeds  # type: ignore[attr-defined]
    also = f"Also, of flexdt itself: {', '.join(OWN[flag] for flag in heeds)}" if heeds else None
    app.command(name, context_settings=context, epilog=also)(complete)


def _version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        typer.echo(f"flexdt {version('flexdt')}")
        raise typer.Exit
