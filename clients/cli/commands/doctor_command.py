"""`flexdt doctor`, `flexdt kernels`: this installation checked, its kernels made and kept."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import typer

from flexdt.clients.cli.console import note
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


def compile() -> Answer:
    """Compile what is missing, and say where compiled kernels are kept.

    Yields:
        As `_described`.
    """
    from flexdt.runtime.kernels import compile_ahead, kernel_files
    from flexdt.twin.errors import TwinError

    compile_ahead.compile_ahead(list(compile_ahead.GROUPS), note)
    folder = kernel_files.kept_in()
    if folder is None:
        from flexdt.twin.errors import TwinError

        raise TwinError(
            "compiled kernels cannot be kept: no folder can be written; set FLEXDT_CACHE to one"
        )
    yield from _described(folder)


def share() -> Answer:
    """Compile what is missing, and keep it in this installation, for all its users.

    Yields:
        As `_described`.
    """
    from flexdt.runtime.kernels import compile_ahead, kernel_files

    compile_ahead.compile_ahead(list(compile_ahead.GROUPS), note)
    yield from _described(kernel_files.publish())


def delete() -> Answer:
    """Delete all compiled kernels that this user may delete.

    Yields:
        The document of --json and a line with the folders.
    """
    from flexdt.runtime.kernels import kernel_files

    deleted = kernel_files.clear(kernel_files.places())
    yield {"deleted": [str(folder) for folder in deleted]}
    if deleted:
        yield f"Deleted the kernels in {', '.join(map(str, deleted))}."
    else:
        yield "No compiled kernels are kept."


def _described(folder: Path) -> Answer:
    """Yield the document of --json, and a line with folder, number and size of its kernels."""
    from flexdt.runtime.kernels import kernel_files

    kept = kernel_files.items(folder)
    size_bytes = sum(path.stat().st_size for path in kept)
    yield {"folder": str(folder), "kernels": len(kept), "bytes": size_bytes}
    yield f"{len(kept)} compiled kernels ({size_bytes / 1e6:.1f} MB) in {folder}"
