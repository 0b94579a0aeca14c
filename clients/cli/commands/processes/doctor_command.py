"""`flexdt doctor`: checks this installation and advises on repairs."""

from __future__ import annotations

from pathlib import Path

import typer

from flexdt.clients.cli.options import Answer, option

MARKS = {"ok": "ok     ", "warning": "warning", "error": "ERROR  "}


def doctor(
    data: Path = option(Path("data"), "Check the directory of data sets.", metavar="DIR"),
    port: int = option(55000, "Check the twin's port."),
    projector_port: int = option(55001, "Check the projector's port."),
    viewer_port: int = option(8080, "Check the viewer's port."),
) -> Answer:
    """Check this installation: Python, packages, compiled kernels, threads, GPU, ports, disk.

    Ends with exit code 1 when something is wrong; warnings alone are fine.
    """
    from flexdt.clients.launch.doctor import examine

    ports = (("twin", port), ("projector", projector_port), ("viewer", viewer_port))
    findings = []
    for finding in examine(data, ports):
        findings.append(finding)
        advice = f" -> {finding.advice}" if finding.advice else ""
        yield f"{MARKS[finding.verdict]}  {finding.what}: {finding.found}{advice}"
    sound = all(finding.verdict != "error" for finding in findings)
    yield {"ok": sound, "findings": [vars(finding) for finding in findings]}
    if not sound:
        raise typer.Exit(1)
    yield "This installation is sound."
