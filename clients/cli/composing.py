"""`flexdt script new`: a valid script for a wish, written by `flexdt.twin.script.compose`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from flexdt.clients.cli import machines, options, values
from flexdt.clients.cli.console import duration, emit, note, say, size
from flexdt.clients.failure import CommandError

if TYPE_CHECKING:
    from flexdt.twin.script.compose import Placement


Kind = Literal["fly", "step", "tiled", "helical", "calibration"]
"""As `compose.Kind`, which is not imported for the help's sake."""


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
    sod: Annotated[float, typer.Option("--sod", metavar="MM")] = 600.0,
    sdd: Annotated[float, typer.Option("--sdd", metavar="MM")] = 1059.0,
    height: Annotated[
        float, typer.Option("--height", metavar="MM", help="Of source and detector centre.")
    ] = 20.0,
    frames: Annotated[int, typer.Option("--frames", help="Images of one turn, or of all.")] = 361,
    exposure: Annotated[float, typer.Option("--exposure", metavar="MS")] = 100.0,
    averages: Annotated[int, typer.Option("--averages")] = 1,
    position: Annotated[
        list[str] | None,
        typer.Option("--position", metavar="SOD[:LATERAL]", help="calibration: one for each scan."),
    ] = None,
    tiles: Annotated[int, typer.Option("--tiles", help="tiled: side by side.")] = 2,
    turns: Annotated[float, typer.Option("--turns", help="helical: in total.")] = 3.0,
    rise: Annotated[float, typer.Option("--rise", metavar="MM", help="helical: in total.")] = 20.0,
    kv: Annotated[float | None, typer.Option("--kv", metavar="KV")] = None,
    power: Annotated[float | None, typer.Option("--power", metavar="W")] = None,
    mode: Annotated[str | None, typer.Option("--mode", metavar="HWaSWbHigh")] = None,
    roi: Annotated[str | None, typer.Option("--roi", metavar="'L T R B'")] = None,
    machine: options.MachineName = None,
    profile: options.ProfileName = None,
    json: options.Json = False,
) -> None:
    """Write a valid script for a wish."""
    from flexdt.twin.camera import Roi
    from flexdt.twin.script import parse_script, plan_script
    from flexdt.twin.script.compose import Wish, compose_script

    scanner = machines.machine(machine)
    offsets = machines.profile(profile, scanner)
    wish = Wish(
        kind=kind,
        sod_mm=sod,
        sdd_mm=sdd,
        height_mm=height,
        frames=frames,
        exposure_ms=exposure,
        averages=averages,
        turns=turns,
        rise_mm=rise,
        tiles=tiles,
        kV=kv,
        power_W=power,
        mode=mode,
        roi=None if roi is None else Roi(*_edges(roi)),
    )
    if position:
        wish = replace(wish, placements=tuple(_placement(word) for word in position))
    text = compose_script(wish, scanner, offsets)
    plan = plan_script(parse_script(text), scanner, offsets)
    for problem in plan.problems:
        note(f"{file or 'script'}:{problem.line}: {problem.severity}: {problem.message}")
    if not plan.ok:
        raise CommandError("the wish gives a script that does not hold; nothing was written")
    if file is not None:
        file.write_bytes(text.encode("utf-8"))
    if json:
        emit({"file": file, "text": text, "frames": plan.frames, "bytes": plan.bytes,
              "duration_s": plan.duration_s})  # fmt: skip
    elif file is None:
        typer.echo(text, nl=False)
    else:
        say(f"{file}: {plan.frames} frames, {size(plan.bytes)}, {duration(plan.duration_s)}")


def _placement(word: str) -> Placement:
    from flexdt.twin.script.compose import Placement

    sod, _, lateral = word.partition(":")
    return Placement(
        values.number(sod, "the SOD of --position"),
        values.number(lateral, "the lateral of --position") if lateral else 0.0,
    )


def _edges(text: str) -> tuple[int, int, int, int]:
    try:
        left, top, right, bottom = (int(word) for word in text.replace(",", " ").split())
    except ValueError:
        raise typer.BadParameter(f"ROI {text!r} is not 'LEFT TOP RIGHT BOTTOM'") from None
    return left, top, right, bottom
