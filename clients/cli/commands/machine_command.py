"""`flexdt machine {list,show,check,fit}`: machines as data, and one fitted to executed scripts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flexdt.clients.cli import machines, options
from flexdt.clients.cli.commands.script_commands import read_log_file, tell
from flexdt.clients.cli.console import emit, say, table

if TYPE_CHECKING:
    from flexdt.twin.machine.description import Axis, Machine

NameOrFile = Annotated[str, typer.Argument(metavar="NAME or FILE", help="Shipped, or TOML.")]


def register(app: typer.Typer) -> None:
    """Add this module's commands."""
    group = typer.Typer(
        help="Machines as data, and from their logs.", no_args_is_help=True, add_completion=False
    )
    group.command("list")(list_machines)
    group.command("show")(show)
    group.command("check")(check)
    group.command("fit")(fit)
    app.add_typer(group, name="machine")


def list_machines(json: options.Json = False) -> None:
    """List the machines that ship."""
    from flexdt.twin.machine.description import builtin_machine, builtin_machines

    found = [builtin_machine(name) for name in builtin_machines()]
    if json:
        emit({"machines": [{"name": m.name, "description": m.description} for m in found]})
        return
    say(table([(m.name, m.description) for m in found], ("name", "what it is")))


def show(name: NameOrFile, json: options.Json = False) -> None:
    """Print a machine's axes and times, and where each value comes from."""
    found = machines.machine(name)
    if json:
        emit(found.model_dump(mode="json", by_alias=True))
        return
    say(f"{found.name}: {found.description}\n")
    say(_axes({n: (a, a.source or "as the file's comments say") for n, a in found.axes.items()}))
    say("\n" + _times(found))


def check(name: NameOrFile) -> None:
    """Check a machine file: every value, and the zero offsets that it names as its own."""
    found = machines.machine(name)
    machines.profile(None, found, name)
    say(f"{name}: ok ({len(found.axes)} axes, {len(found.components)} components)")


def fit(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="Logs, oldest first.")],
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="The machine file to write.")],
    base: Annotated[
        str,
        typer.Option("--base", metavar="FILE or NAME", help="What the logs do not tell."),
    ] = machines.DEFAULT_MACHINE,
    json: options.Json = False,
) -> None:
    """Fit a machine to executed scripts: limits, rates and the times of its commands."""
    from flexdt.twin.machine.description import builtin_machine_text
    from flexdt.twin.machine.fitted_file import fitted_text
    from flexdt.twin.script.planning.log_fit import fit_machine, unlike

    machine = machines.machine(base)
    text = Path(base).read_text("utf-8") if machines.is_file(base) else builtin_machine_text(base)
    commands = [read_log_file(log) for log in logs]
    names = ", ".join(log.name for log in logs).encode("utf-8", "replace").decode()
    source = f"measured: {names} ({sum(map(len, commands))} lines)"
    found = fit_machine(commands, machine, source)
    for log, lines in zip(logs, commands, strict=True):
        tell(unlike(lines, machine), str(log))
    out.write_text(fitted_text(text, found.machine, found.axes), encoding="utf-8")
    if json:
        emit(found.to_dict())
        return
    say(_axes({n: (found.machine.axes[n], found.machine.axes[n].source) for n in found.axes}))
    say("\n" + _times(found.machine))
    made = found.lines
    say(
        f"\n{len(made.rows)} lines, {made.total_real_s:.2f} s; absolute errors sum to "
        f"{made.sum_abs_error_s:.2f} s, {found.cross_validated_s:.2f} s with each time predicted "
        "from the others of its kind"
    )
    if len(logs) == 1:
        say("one log does not show how a scan differs from the next: ranges may be too narrow")
    say(f"{out}: written, everything else as in {base}")


def _axes(axes: dict[str, tuple[Axis, str]]) -> str:
    rows = [
        (
            name,
            f"{a.lower:g}",
            f"{a.upper:g}",
            f"{a.max_speed:g}",
            f"{a.max_acceleration:g}",
            a.unit,
            source,
        )
        for name, (a, source) in axes.items()
    ]
    return table(rows, ("axis", "lower", "upper", "max /s", "max /s2", "unit", "source"))


def _times(machine: Machine) -> str:
    timing = machine.timing
    rows = []
    for kind in timing.kinds:
        found = timing.spread.get(kind)
        spread = ("", "", "assumed")
        if found is not None:
            spread = (f"{found.p5_s:.3f}", f"{found.p95_s:.3f}", f"measured, log, n = {found.n}")
        rows.append((kind, f"{timing.seconds(kind):.3f}", *spread))
    if timing.spread:
        rows.append(("all together", "", "", f"+-{100 * timing.drift:.0f} %", "log; for totals"))
    return table(rows, ("time of a", "median [s]", "5 %", "95 %", f"source ({timing.source})"))
