"""`flexdt bench`: runs the project's own benchmarks, which are a separate program."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flexdt.clients.cli import option_values, options
from flexdt.clients.cli.commands.processes.process_commands import become


def bench(
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR", help="bench.json.")] = None,
    only: Annotated[
        str | None, typer.Option("--only", metavar="NAME,NAME,...", help="These cases only.")
    ] = None,
    no_peers: Annotated[
        bool, typer.Option("--no-peers", help="Do not run other projectors.")
    ] = False,
    quick: Annotated[bool, typer.Option("--quick", help="C1 and C1-tilt alone.")] = False,
    list_: Annotated[bool, typer.Option("--list", help="Name the cases, measure nothing.")] = False,
    device: Annotated[
        bool, typer.Option("--device", help="A CUDA device and its targets, beside ASTRA.")
    ] = False,
    json: options.Json = False,
) -> None:
    """Measure speed and accuracy, beside the peers that are installed."""
    given = {"out": out, "no-peers": no_peers, "quick": quick, "list": list_, "json": json}
    given["device"] = device
    names = [] if only is None else ["--only", *option_values.names(only)]
    become("flexdt.server.bench", given, names)
