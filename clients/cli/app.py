"""The command tree: one module for each group of commands, put together here.

Command modules import what they need inside their functions, so building the tree costs next to
nothing. This module refuses to know what any command does.
"""

from __future__ import annotations

from typing import Annotated

import typer

from flexdt.clients.cli import (
    batch,
    bench,
    calibration,
    composing,
    demo,
    doctor,
    exchange,
    images,
    jobs,
    motion,
    phantoms,
    processes,
    reconstruction,
    scripts,
    settings,
    state,
    study,
)

GROUPS = (
    demo,
    processes,
    scripts,
    composing,
    jobs,
    state,
    motion,
    settings,
    images,
    calibration,
    reconstruction,
    exchange,
    study,
    batch,
    phantoms,
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
        add_completion=False,
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
