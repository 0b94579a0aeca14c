"""The command tree: one module for each group of commands, assembled here.

Command modules import what they need inside their functions, so building the tree is cheap.
"""

from __future__ import annotations

from typing import Annotated

import typer

from flexdt.clients.cli.commands import batch_command as batch
from flexdt.clients.cli.commands import bench_command as bench
from flexdt.clients.cli.commands import calibrate_command as calibration
from flexdt.clients.cli.commands import demo_command as demo
from flexdt.clients.cli.commands import doctor_command as doctor
from flexdt.clients.cli.commands import exchange_command as exchange
from flexdt.clients.cli.commands import expose_command as exposing
from flexdt.clients.cli.commands import follow_command as following
from flexdt.clients.cli.commands import job_command as jobs
from flexdt.clients.cli.commands import machine_command as machines
from flexdt.clients.cli.commands import motion_commands as motion
from flexdt.clients.cli.commands import phantom_command as phantoms
from flexdt.clients.cli.commands import process_commands as processes
from flexdt.clients.cli.commands import reconstruct_command as reconstruction
from flexdt.clients.cli.commands import script_commands as scripts
from flexdt.clients.cli.commands import snap_command as images
from flexdt.clients.cli.commands import state_command as state
from flexdt.clients.cli.commands import study_command as study

GROUPS = (
    demo,
    processes,
    scripts,
    jobs,
    state,
    motion,
    images,
    calibration,
    exposing,
    reconstruction,
    exchange,
    study,
    batch,
    phantoms,
    machines,
    following,
    bench,
    doctor,
)
"""Modules with a `register(app)` each, in the order of the help page."""


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
