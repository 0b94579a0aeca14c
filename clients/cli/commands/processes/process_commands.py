"""`flexdt up`, `twin`, `projector`, `viewer`, `gateway`: become the process in question.

The servers are programs of their own (`python -m flexdt.server...`); this process turns into one,
so signals and exit codes are the server's. Their options come from `flexdt.process_settings`.
"""

from __future__ import annotations

import inspect
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import Annotated, Any

import typer

from flexdt.clients.cli import option_values
from flexdt.clients.cli.connecting import configuration
from flexdt.process_settings import (
    LARGEST_PORT,
    Address,
    GatewaySettings,
    ProcessSettings,
    ProjectorSettings,
    TwinSettings,
    UpSettings,
    ViewerSettings,
    address,
    addresses,
    has_parameters,
    parameters,
    words,
)

Command = Callable[..., None]


def with_options(settings: type[ProcessSettings], **other: Any) -> Callable[[Command], Command]:
    """Give a command the options of a process, as the signature that typer reads.

    Args:
        settings: of the process.
        other: name -> annotation of options of the command alone; one that the process has too
            replaces it. Their default is None.
    """
    hidden = {f.name for f in fields(settings) if not f.metadata["public"]}
    own = {name: p for name, p in parameters(settings).items() if name not in hidden}
    for name, annotation in other.items():
        own[name] = inspect.Parameter(
            name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation
        )

    def decorate(command: Command) -> Command:
        has_parameters(command, own.values())
        return command

    return decorate


Data = Annotated[
    str | None,
    typer.Option(
        "--data",
        metavar="DIR",
        help="Data directory: all that is written; default: data, or configured.",
    ),
]


def _data(given: str | None) -> str:
    """The data directory: the option's, the configuration's, or `data`."""
    return given or configuration().data or str(TwinSettings().data)


@with_options(UpSettings, data=Data)
def up(data: str | None, **given: object) -> None:
    """Start projector, twin and viewer; Ctrl-C stops all.

    They run as processes under one supervisor, which restarts a dead one. Prints one
    JSON `ready` line with the addresses once everything listens.
    """
    _check(given)
    become("flexdt.clients.launch.up", {**given, "data": _data(data)})


@with_options(
    TwinSettings,
    data=Data,
    projector=Annotated[
        Address | None,
        typer.Option(
            "--projector",
            metavar="HOST:PORT",
            parser=address,
            help="Where the projector listens; 127.0.0.1:55001 if left out.",
        ),
    ],
    projector_port=Annotated[
        int | None,
        typer.Option(min=1, max=LARGEST_PORT, help="As --projector 127.0.0.1:PORT."),
    ],
)
def twin(
    projector: Address | None,
    projector_port: int | None,
    projectors: str | None,
    data: str | None,
    **given: object,
) -> None:
    """Run the twin server alone."""
    if projector is not None and projector_port is not None:
        raise typer.BadParameter("give --projector or --projector-port, not both")
    further = list(addresses(projectors))
    if projector is not None:
        first = projector
    elif projector_port is None and further:
        first = further.pop(0)
    else:
        default = TwinSettings().projector
        first = Address(default.host, projector_port or default.port)
    given |= {"projector": first, "projectors": ",".join(map(str, further)) or None}
    _check(given)
    become("flexdt.server.twin.main", {**given, "data": _data(data)})


@with_options(ProjectorSettings)
def projector(**given: object) -> None:
    """Run the projector server alone."""
    _check(given)
    become("flexdt.server.projector.main", given)


@with_options(ViewerSettings)
def viewer(**given: Any) -> None:
    """Run the viewer, the lab in the browser, alone."""
    _check(given)
    become("flexdt.clients.viewer.main", given)


@with_options(GatewaySettings)
def gateway(**given: Any) -> None:
    """Serve the scanner software's own ZeroMQ interface (Acquila) for a running twin.

    Programs written for the scanner connect to it as they do to the scanner.
    """
    become("flexdt.clients.gateway.main", given)


def _check(given: Mapping[str, Any]) -> None:
    """Usage errors that no single option can have."""
    if (given["tls_cert"] is None) != (given["tls_key"] is None):
        raise typer.BadParameter("--tls-cert and --tls-key go together")
    if "speed_up" in given:
        option_values.speed_up(given["speed_up"])


def become(module: str, given: Mapping[str, object], more: Sequence[str] = ()) -> None:
    """Replace this process by `python -m module` with the options `given` and `more` words."""
    sys.stdout.flush()
    sys.stderr.flush()
    os.execv(sys.executable, [sys.executable, "-P", "-m", module, *words(given), *more])
