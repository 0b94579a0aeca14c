"""The command tree: one module for each group of commands, assembled here.

Command modules import what they need inside their functions, so building the tree is cheap.
"""

from __future__ import annotations

from typing import Annotated

import typer

from flexdt.clients.cli.commands.data_sets import (
    batch_command,
    calibrate_commands,
    exchange_commands,
    expose_command,
    reconstruct_command,
    simulate_command,
    study_command,
)
from flexdt.clients.cli.commands.processes import (
    bench_command,
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

GROUPS = (
    demo_command,
    process_commands,  # up, twin, projector, viewer, gateway
    script_commands,  # check, run, script
    job_command,
    state_commands,  # state, tube, camera, clock
    motion_commands,  # move, jog, stop, estop, reset
    sample_command,
    snap_command,
    calibrate_commands,  # calibrate, align, compare
    expose_command,
    simulate_command,
    reconstruct_command,
    exchange_commands,  # export, import
    study_command,
    batch_command,
    phantom_command,
    machine_command,
    follow_command,
    bench_command,
    doctor_command,
)
"""Modules with a `register(app)` each, in the order of the help page.

A module of one command or group bears its name; the others have their commands beside them.
"""


def build() -> typer.Typer:
    """The whole command line."""
    app = typer.Typer(
        name="flexdt",
        help="Digital twin of the FleX-ray laboratory X-ray CT scanner.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )

    @app.callback()
    def root(
        version: Annotated[
            bool,
            typer.Option(
                "--version", help="Print the version and leave.", callback=_version, is_eager=True
            ),
        ] = False,
    ) -> None:
        pass

    for group in GROUPS:
        group.register(app)
    return app


def _version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        typer.echo(f"flexdt {version('flexdt')}")
        raise typer.Exit
