"""`flexdt up`, and its aliases `twin`, `projector`, `viewer` and `gateway`.

The servers are programs of their own (`python -m flexdt.server...`); this process becomes one,
so signals and exit codes are the server's. Their options come from
`flexdt.runtime.process_settings`: the settings file's first, then those of the command line.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import Annotated, Any, Final, Literal, NoReturn

import typer

from flexdt.clients.cli import value_completion
from flexdt.clients.cli.console import COMPLETION_VARIABLE
from flexdt.clients.cli.settings_file import TABLES, settings_of
from flexdt.runtime.process_settings import UpSettings
from flexdt.runtime.settings import (
    Settings,
    described,
    has_parameters,
    parameters,
    words,
)

MODULES: Final = {
    "up": "flexdt.clients.launch.up",
    "twin": "flexdt.server.twin.main",
    "projector": "flexdt.server.projector.main",
    "viewer": "flexdt.clients.viewer.main",
    "gateway": "flexdt.clients.gateway.main",
}
"""Process -> module of its program."""
COMPLETED: Final = {
    "machine": value_completion.machine_names,
    "profile": value_completion.profile_names,
    "sample": value_completion.sample_names,
}
"""Option of `up` -> function that gives the values that a shell completes."""
WRITERS: Final = ("up", "twin")
"""Processes that write the data folder; viewer and gateway read it."""
WRITER_OPTIONS: Final = ("machine", "profile", "sample", "data")
READER_OPTIONS: Final = ("machine",)
"""Options whose values are checked before a process starts, of writers and of readers."""
Only = Annotated[
    Literal["twin", "projector", "viewer", "gateway"] | None,
    typer.Option(
        "--only", help="Run this process alone; its options: flexdt PROCESS --help."
    ),
]


def up(context: typer.Context, only: str | None, **given: object) -> None:
    """Start the processes of `flexdt up`, or one of them; the help is that of its settings."""
    start(only or "up", [*words(given), *context.args])


def _declared(settings: type[Settings]) -> list[inspect.Parameter]:
    """List the options of a process as parameters, each with the function that proposes
    its values to a shell, if any.
    """
    own = [*parameters(settings).values()]
    for p in own:
        [declared] = p.annotation.__metadata__
        declared.autocompletion = COMPLETED.get(p.name)
    return own


def _public() -> list[inspect.Parameter]:
    """List the options that `up` shows; one left out is None, so that the settings file can set
    it. Switches keep False."""
    public = {f.name for f in fields(UpSettings) if f.metadata["public"]}
    own = [p for p in _declared(UpSettings) if p.name in public]
    return [p if p.default is False else p.replace(default=None) for p in own]


up.__doc__ = described(UpSettings)[0]
has_parameters(
    up,
    [
        inspect.Parameter(
            "context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context
        ),
        inspect.Parameter(
            "only", inspect.Parameter.KEYWORD_ONLY, default=None, annotation=Only
        ),
        *_public(),
    ],
)


def alone(name: str) -> Callable[..., None]:
    """Make the command that starts one process with the words that follow it.

    The process reads them itself; its options are declared here for shells that complete.
    Options are declared only while a shell completes words.
    """

    def command(context: typer.Context, **_: object) -> None:
        start(name, context.args)

    command.__doc__ = described(TABLES[name])[0]
    own = inspect.signature(command, eval_str=True).parameters["context"]
    completing = COMPLETION_VARIABLE in os.environ
    has_parameters(command, [own, *(_declared(TABLES[name]) if completing else ())])
    return command


twin = alone("twin")
projector = alone("projector")
viewer = alone("viewer")
gateway = alone("gateway")


def start(name: str, more: Sequence[str]) -> None:
    """Run a process in this interpreter, with the settings file's options, then `more`.

    It ends by typer.Exit. Raises typer.BadParameter and TwinError for wrong options,
    before it begins.
    """
    settings = settings_of(TABLES[name], more)
    if settings is not None:
        given = {f.name: getattr(settings, f.name) for f in fields(settings)}
        _check(given, WRITER_OPTIONS if name in WRITERS else READER_OPTIONS)
        become(MODULES[name], given)


def _check(given: Mapping[str, Any], named: Sequence[str]) -> None:
    """Refuse options that need or exclude each other, then what `require_startable` refuses
    of those in `named`."""
    if (given.get("tls_cert") is None) != (given.get("tls_key") is None):
        raise typer.BadParameter("--tls-cert and --tls-key go together")
    if given.get("projector") is not None and given["projector_port"] is not None:
        raise typer.BadParameter("give --projector or --projector-port, not both")
    from flexdt.clients.launch.start_checks import require_startable

    require_startable(**{name: given[name] for name in named if name in given})


def become(
    module: str, given: Mapping[str, object], more: Sequence[str] = ()
) -> NoReturn:
    """Run `python -m module` in this process, with the options `given` and `more` words.

    A new interpreter would not react to Ctrl-C before it had loaded the module.

    Raises:
        typer.Exit: the process's exit code.
    """
    from importlib import import_module

    raise typer.Exit(import_module(module).main([*words(given), *more]))
