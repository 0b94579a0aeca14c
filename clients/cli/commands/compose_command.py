"""`flexdt script new`: writes a valid script from options, by `flexdt.twin.script.compose`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from flexdt.clients.cli import machines, options, values
from flexdt.clients.cli.commands.script_commands import collisions, exit_code, tell
from flexdt.clients.cli.console import duration, emit, say, size
from flexdt.clients.failure import CommandError

Kind = Literal["fly", "step", "tiled", "helical", "calibration"]
"""As `compose.Kind`, which is not imported for the help's sake."""

USUAL = "Default: 600 and 1059, or the machine's own."


def register(app: typer.Typer) -> None:
    """Add this module's command."""
    group = typer.Typer(help="Scan scripts.", no_args_is_help=True, add_completion=False)

    @group.callback()
    def scripts() -> None:
        """Scan scripts."""

    group.command("new")(new)
    app.add_typer(group, name="script")


def new(
    kind: Annotated[Kind, typer.Option("--kind", help="What kind of scan.")],
    file: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Default: standard output.")
    ] = None,
    sod: Annotated[float | None, typer.Option("--sod", metavar="MM", help=USUAL)] = None,
    sdd: Annotated[float | None, typer.Option("--sdd", metavar="MM", help=USUAL)] = None,
    height: Annotated[
        float | None,
        typer.Option("--height", metavar="MM", help="Of source and detector centre."),
    ] = None,
    frames: Annotated[int, typer.Option("--frames", help="Images of one turn, or of all.")] = 361,
    exposure: Annotated[float, typer.Option("--exposure", metavar="MS")] = 100.0,
    averages: Annotated[int, typer.Option("--averages")] = 1,
    position: Annotated[
        list[str] | None,
        typer.Option("--position", metavar="SOD[:LATERAL]", help="calibration: one for each scan."),
    ] = None,
    tiles: Annotated[
        int | None, typer.Option("--tiles", help="tiled: side by side; 2 if left out.")
    ] = None,
    turns: Annotated[
        float | None, typer.Option("--turns", help="helical: in total; 3 if left out.")
    ] = None,
    rise: Annotated[
        float | None,
        typer.Option("--rise", metavar="MM", help="helical: in total; 20 if left out."),
    ] = None,
    kv: Annotated[float | None, typer.Option("--kv", metavar="KV")] = None,
    power: Annotated[float | None, typer.Option("--power", metavar="W")] = None,
    mode: Annotated[str | None, typer.Option("--mode", metavar="NAME")] = None,
    roi: options.Roi = None,
    machine: options.MachineName = None,
    profile: options.ProfileName = None,
    json: options.Json = False,
) -> None:
    """Write a valid scan script; one that `flexdt check` would reject is not written."""
    from flexdt.twin.machine.camera import Roi
    from flexdt.twin.script import check_script
    from flexdt.twin.script.compose import ScanRequest, compose_script

    own = _own(kind, position=position, tiles=tiles, turns=turns, rise=rise)
    scanner = machines.machine(machine)
    offsets = machines.profile(profile, scanner, machine)
    request = ScanRequest(
        kind=kind,
        sod_mm=sod,
        sdd_mm=sdd,
        height_mm=height,
        frames=frames,
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
    if json:
        emit({"file": file, "text": text, "frames": plan.frames, "bytes": plan.bytes,
              "duration_s": plan.duration_s})  # fmt: skip
    elif file is None:
        say(text, end="")
    else:
        say(f"{file}: {plan.frames} frames, {size(plan.bytes)}, {duration(plan.duration_s)}")


def _own(kind: Kind, **given: Any) -> dict[str, Any]:
    """Members of a request that belong to one kind of scan.

    Raises:
        typer.BadParameter: an option of another kind was given.
    """
    kinds = {"position": "calibration", "tiles": "tiled", "turns": "helical", "rise": "helical"}
    own = {name: value for name, value in given.items() if value not in (None, [])}
    for name in own:
        if kinds[name] != kind:
            raise typer.BadParameter(f"--{name} is for --kind {kinds[name]}, not {kind}")
    if "position" in own:
        from flexdt.twin.script.compose import ScanPosition

        own["placements"] = tuple(
            ScanPosition(*values.position(word)) for word in own.pop("position")
        )
    if "rise" in own:
        own["rise_mm"] = own.pop("rise")
    return own
