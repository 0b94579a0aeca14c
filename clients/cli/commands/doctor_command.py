"""`flexdt doctor`: this installation checked."""

from __future__ import annotations

from typing import Final

import typer

from flexdt.clients.cli.options import Answer
from flexdt.clients.cli.settings_file import chosen
from flexdt.runtime.process_settings import TwinSettings, UpSettings

MARKS: Final = {"ok": "ok     ", "warning": "warning", "error": "ERROR  "}
"""Verdict on a finding -> the word before it, padded."""


def doctor() -> Answer:
    """Check this installation: Python, packages, compiled kernels, threads, GPU, ports, disk.

    Ports and data directory are those that `flexdt up` would use. Ends with exit code 1 when
    something is wrong; warnings alone are fine.

    Yields:
        A line for each finding as it comes, the document of --json, and a verdict if
        nothing is wrong.
    """
    from flexdt.clients.launch.doctor import examine

    up = chosen(UpSettings)
    ports = (
        ("twin", up.port),
        ("projector", up.projector_port),
        ("viewer", up.viewer_port),
    )
    findings = []
    for finding in examine(up.data or TwinSettings.data, ports):
        findings.append(finding)
        if finding.advice:
            advice = f" -> {finding.advice}"
        else:
            advice = ""
        yield f"{MARKS[finding.verdict]}  {finding.what}: {finding.found}{advice}"
    sound = all(finding.verdict != "error" for finding in findings)
    yield {"ok": sound, "findings": [vars(finding) for finding in findings]}
    if not sound:
        raise typer.Exit(1)
    yield "This installation is sound."
