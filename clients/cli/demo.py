"""`flexdt demo`: the main job from end to end, on this machine, with nothing prepared."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flexdt.clients.cli import options
from flexdt.clients.cli.console import emit, note, say


def register(app: typer.Typer) -> None:
    """Add this module's command."""
    app.command("demo")(demo)


def demo(
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Where everything is written.")
    ] = Path("flexdt-demo"),
    no_viewer: Annotated[
        bool, typer.Option("--no-viewer", help="Leave when the work is done.")
    ] = False,
    truth: Annotated[
        Path | None,
        typer.Option("--truth", metavar="FILE", help="Hidden misalignment; random if left out."),
    ] = None,
    json: options.Json = False,
) -> None:
    """Scan the LEGO bead phantom from script to data set.

    Starts the servers on free ports, runs the example script accelerated, and says what was done,
    where the files are and how the result compares with the hidden truth.
    """
    from flexdt.clients.demo.run import run_demo

    document = run_demo(out, truth, tell=note if json else say)
    if json:
        emit(document)
