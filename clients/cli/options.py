"""Options that several commands share, declared once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flexdt.clients.cli import values

Server = Annotated[
    str, typer.Option("--server", metavar="HOST:PORT", help="Where the twin listens.")
]
TokenFile = Annotated[
    str | None,
    typer.Option("--token-file", metavar="FILE", help="File with the session's token."),
]
TlsCa = Annotated[
    str | None,
    typer.Option("--tls-ca", metavar="FILE", help="Speak TLS; trust this certificate."),
]
Json = Annotated[
    bool, typer.Option("--json", help="One JSON document on standard output, nothing else.")
]
MachineName = Annotated[
    str | None,
    typer.Option("--machine", metavar="FILE or NAME", help="Machine description (TOML)."),
]
ProfileName = Annotated[
    str | None,
    typer.Option("--profile", metavar="NAME", help="Calibration profile: zero offsets."),
]
Roi = Annotated[
    tuple[int, int, int, int] | None,
    typer.Option("--roi", metavar="L T R B", help="Unbinned pixels, inclusive."),
]
Geometry = Annotated[
    Path | None,
    typer.Option(
        "--geometry", metavar="FILE", help="Instead of the data set's: see flexdt import."
    ),
]
SpeedUp = Annotated[
    str | None,
    typer.Option("--speed-up", metavar="X or max", help="Twin seconds per second of yours."),
]
Jobs = Annotated[int | None, typer.Option("--jobs", min=1, help="Processes; one for each core.")]
Scheduler = Annotated[
    str | None, typer.Option("--scheduler", metavar="ADDRESS", help="A dask scheduler.")
]
Texts = Annotated[
    bool, typer.Option("--texts", help="Geometry from the scanner's two texts alone.")
]
DEFAULT_SERVER = values.DEFAULT_SERVER
