"""`flexdt script new`: a scan script written from options."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Literal

import typer

from flexdt.clients.cli import option_values, options, value_completion
from flexdt.clients.cli.command_settings import ScriptNewSettings
from flexdt.clients.cli.commands.script_files import exit_code, tell
from flexdt.clients.cli.console import duration, size
from flexdt.clients.cli.options import Answer, option
from flexdt.clients.cli.settings_file import chosen
from flexdt.library import machines
from flexdt.library.failure import CommandError

Kind = Literal["fly", "step", "tiled", "helical", "calibration"]
"""Kinds of `compose.Kind`, which is not imported to keep the help fast."""
FRAMES: Final = 361
USUAL_FRAMES: Final[Mapping[Kind, int]] = {"calibration": 91}
"""Kind of script -> images of a turn, where that is not `FRAMES`: a phantom limits a calibration,
not its images."""


def new(
    kind: Kind = option(...),
    file: Path | None = option(None, "--out", metavar="FILE", written=True),
    sod: float | None = option(None, metavar="MM"),
    sdd: float | None = option(None, metavar="MM"),
    frames: int | None = option(None),
    exposure: float | None = option(None, metavar="MS"),
    averages: int = option(1),
    position: list[str] | None = option(None, metavar="SOD[:LATERAL]"),
    tiles: int | None = option(None),
    turns: float | None = option(None),
    rise: float | None = option(None, metavar="MM"),
    kv: float | None = option(None, metavar="KV"),
    power: float | None = option(None, metavar="W"),
    mode: str | None = option(None, metavar="NAME", proposes=value_completion.mode_names),
    roi: options.Roi = None,
    machine: options.MachineName = None,
    profile: options.ProfileName = None,
) -> Answer:
    """Write a valid scan script; one that `flexdt check` would reject is not written.

    Args:
        kind: Write a script of this kind.
        file: Write to this file; default: standard output.
        sod: Set this distance; default: 600 and 1059, or the machine's.
        sdd: Set this distance; default: 600 and 1059, or the machine's.
        frames: Take so many images in a turn, or in all; default: 361, or 91 of a phantom.
        exposure: Expose each image so long; default: 100, or as near as the camera gets.
        averages: Average so many read-outs in an image.
        position: Put a calibration scan there; once for each scan.
        tiles: Put so many tiles side by side; default: 2.
        turns: Make so many turns of a helix; default: 3.
        rise: Let a helix rise by so much; default: 20.
        kv: Set the tube's voltage.
        power: Set the tube's power.
        mode: Set the camera's mode.

    Yields:
        The document of --json (file, text, frames, bytes, duration_s), then a line, or
        without a file the script itself. Problems go to standard error; raises
        CommandError if the script is invalid, and a usage error for options of another
        kind of scan.
    """
    from flexdt.library.scripts import collisions
    from flexdt.twin.machine.camera import Roi
    from flexdt.twin.script import check_script
    from flexdt.twin.script.compose import compose_script
    from flexdt.twin.script.scan_request import ScanRequest

    own = _kind_members(kind, position=position, tiles=tiles, turns=turns, rise=rise)
    scanner = machines.machine(machine)
    offsets = machines.profile(profile, scanner, machine)
    request = ScanRequest(
        kind=kind,
        sod_mm=sod,
        sdd_mm=sdd,
        height_mm=chosen(ScriptNewSettings).height,
        frames=USUAL_FRAMES.get(kind, FRAMES) if frames is None else frames,
        exposure_ms=exposure,
        averages=averages,
        kV=kv,
        power_W=power,
        mode=mode,
        roi=None if roi is None else Roi(*roi),
    )
    text = compose_script(replace(request, **own), scanner, offsets)
    report = check_script(
        text, scanner, offsets, collision=collisions(None) if scanner.components else None
    )
    plan = report.plan
    tell(report.problems, str(file or "script"))
    if not report.ok:
        raise CommandError(
            "these options give an invalid script; nothing was written", exit_code(report)
        )
    if file is not None:
        file.write_bytes(text.encode("utf-8"))
    yield {
        "file": file,
        "text": text,
        "frames": plan.frames,
        "bytes": plan.bytes,
        "duration_s": plan.duration_s,
    }
    if file is None:
        yield text.removesuffix("\n")
    else:
        yield f"{file}: {plan.frames} frames, {size(plan.bytes)}, {duration(plan.duration_s)}"


def _kind_members(kind: Kind, **given: Any) -> dict[str, Any]:
    """Collect members of a request that belong to one kind of scan.

    A position becomes a placement, `rise` the member `rise_mm`. The first option of
    another kind raises.

    Args:
        kind: of the scan.
        given: options by name; those left out are None or empty.

    Returns:
        Member -> value, as `ScanRequest` has them.

    Raises:
        typer.BadParameter: an option of another kind was given.
    """
    kinds = {
        "position": "calibration",
        "tiles": "tiled",
        "turns": "helical",
        "rise": "helical",
    }
    own = {name: value for name, value in given.items() if value not in (None, [])}
    for name in own:
        if kinds[name] != kind:
            raise typer.BadParameter(f"--{name} is for --kind {kinds[name]}, not {kind}")
    if "position" in own:
        from flexdt.twin.script.scan_request import ScanPosition

        own["placements"] = tuple(
            ScanPosition(*option_values.position(word)) for word in own.pop("position")
        )
    if "rise" in own:
        own["rise_mm"] = own.pop("rise")
    return own
