"""`flexdt calibrate`: bead detection, identification, fit, report, and the push to a twin.

The work is `flexdt.clients.calibrate`'s; here it is asked for, shown and turned into an exit code.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flexdt.clients.cli import options, values
from flexdt.clients.cli.boundary import NOT_IDENTIFIABLE
from flexdt.clients.cli.connection import connect
from flexdt.clients.cli.console import emit, note, say, table
from flexdt.clients.failure import CommandError

if TYPE_CHECKING:
    from flexdt.clients.calibrate import Outcome


def register(app: typer.Typer) -> None:
    """Add this module's command."""
    app.command("calibrate")(calibrate)


def calibrate(
    datasets: Annotated[list[Path], typer.Argument(metavar="DATASET...")],
    phantom: Annotated[
        str, typer.Option("--phantom", metavar="NAME or FILE", help="What was scanned.")
    ],
    free: Annotated[
        str | None,
        typer.Option("--free", metavar="P,P,...", help="Parameters to estimate; default: six."),
    ] = None,
    report: Annotated[
        Path | None, typer.Option("--report", metavar="FILE.json", help="The document, as a file.")
    ] = None,
    push: Annotated[
        bool, typer.Option("--push", help="Put the correction in force on the twin.")
    ] = False,
    server: options.Server = options.DEFAULT_SERVER,
    token_file: options.TokenFile = None,
    tls_ca: options.TlsCa = None,
    json: options.Json = False,
) -> None:
    """Calibrate the geometry from scans of a bead phantom.

    A data set may be a folder of TIFFs with the two settings texts alone. Exit code 5 when the data
    cannot determine what was asked for; then nothing is pushed.
    """
    if report is not None and report.suffix.lower() != ".json":
        raise typer.BadParameter(f"{report.name}: the report's ending must be .json")
    from flexdt.clients.calibrate import calibrate_folders
    from flexdt.twin.calibration.pipeline import Request

    request = None if free is None else Request(free=values.names(free))
    outcome = calibrate_folders(datasets, phantom, request)
    document = outcome.document
    if report is not None:
        write_json(report, document)
    emit(document) if json else show(document)
    for problem in _rows(document.get("problems")):
        note(f"{problem['severity']}: {problem['text']} [{problem['code']}]")
    if not document["identifiable"]:
        raise CommandError("not identifiable: these numbers must not be used", NOT_IDENTIFIABLE)
    if push:
        with connect(server, token_file, tls_ca) as client:
            note(f"in force on the twin: {push_correction(client, outcome)}")


def push_correction(client: object, outcome: Outcome) -> str:
    """Put a calibration's correction in force; returns its name."""
    from flexdt.clients.calibrate import correction_of
    from flexdt.clients.client import TwinClient

    assert isinstance(client, TwinClient)
    wanted = correction_of(outcome)
    parameters = wanted["parameters"]
    assert isinstance(parameters, Mapping)
    applied = client.apply_calibration(
        parameters,
        str(wanted["name"]),
        comment=str(wanted["comment"]),
        source=str(wanted["source"]),
    )
    return applied.correction.name if applied.correction is not None else ""


def show(document: Mapping[str, object]) -> None:
    """A calibration's document for people."""
    say(table(parameter_rows(document), ("parameter", "value", "sigma", "unit")))
    say(
        f"{document['frames']} frames, {document['detections']} beads seen, "
        f"{document['outliers']} outliers, rms {_number(document['rms_px'], 4)} px, cost down "
        f"{_number(document['cost_reduction_pct'], 4)} %, {document['iterations']} iterations, "
        f"rank {document['rank']}, condition {_number(document['condition'], 1)}, "
        f"{_number(document['seconds'], 2)} s"
    )
    weak = document.get("weak")
    for text in weak if isinstance(weak, list | tuple) else ():
        say(f"weak: {text}")


def parameter_rows(document: Mapping[str, object]) -> list[tuple[str, str, str, str]]:
    """Estimated parameters as rows of text: name, value, sigma, unit."""
    parameters = document.get("parameters")
    if not isinstance(parameters, Mapping):
        return []
    return [
        (name, _number(p["value"], 5), _number(p["sigma"], 5), str(p["unit"]))
        for name, p in parameters.items()
    ]


def write_json(path: Path, document: Mapping[str, object]) -> None:
    """Write a document under its final name only when it is whole."""
    import json

    from flexdt.clients.cli.console import plain

    temporary = path.with_name(path.name + ".part")
    temporary.write_text(json.dumps(plain(document), indent=2) + "\n", encoding="utf-8")
    temporary.replace(path)


def _rows(value: object) -> list[Mapping[str, object]]:
    return [row for row in value if isinstance(row, Mapping)] if isinstance(value, list) else []


def _number(value: object, digits: int) -> str:
    return f"{value:.{digits}f}" if isinstance(value, int | float) else "-"
