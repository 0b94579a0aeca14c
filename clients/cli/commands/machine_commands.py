"""`flexdt machine`: machines as data, shown, checked, new, and fitted to logs of scripts."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from flexdt.clients.cli import option_values
from flexdt.clients.cli.commands.script_files import read_log_file, tell
from flexdt.clients.cli.console import table
from flexdt.clients.cli.options import Answer, argument, option
from flexdt.clients.cli.settings_file import MachineNewSettings, chosen
from flexdt.library import machines

if TYPE_CHECKING:
    from flexdt.twin.machine.description import Axis, Machine

COMMENTS: Final = "as the file's comments say"
"""Source of a value whose source is no value of the file."""
USUAL_BASE: Final = "xyzr_cabinet"
"""Machine that a new one begins with."""
NameOrFile = Annotated[str, typer.Argument(metavar="NAME or FILE", help="Shipped, or TOML.")]


def list_machines() -> Answer:
    """List the machines that ship."""
    from flexdt.twin.machine.description import builtin_machine, builtin_machines

    found = [builtin_machine(name) for name in builtin_machines()]
    yield {"machines": [{"name": m.name, "description": m.description} for m in found]}
    yield table([(m.name, m.description) for m in found], ("name", "what it is"))


def show(name: NameOrFile) -> Answer:
    """Print a machine's axes, distances, bodies and times, and where each value comes from."""
    found = machines.machine(name)
    yield found.model_dump(mode="json", by_alias=True)
    yield f"{found.name}: {found.description}\n"
    yield _axes({n: (a, a.source or COMMENTS) for n, a in found.axes.items()})
    yield "\n" + _places(found)
    panel, tube = found.detector, found.tube
    yield (f"\npanel: {panel.model}, {panel.columns} x {panel.rows} of {panel.pitch_mm:g} mm, "
           f"{panel.bits} bits, mode {panel.mode}")  # fmt: skip
    yield (f"tube: {tube.min_kV:g} to {tube.max_kV:g} kV, at most {tube.max_W:g} W; at start "
           f"{tube.kV:g} kV, {tube.power_W:g} W\n")  # fmt: skip
    yield _bodies(found)
    yield "\n" + _times(found)


def check(name: NameOrFile) -> Answer:
    """Check a machine file: every value, its zero offsets, and whether it can stand at home."""
    from flexdt.twin.collision.home_check import check_home

    found = machines.machine(name)
    check_home(found, machines.profile(None, found, name), name)
    yield {"ok": True, "axes": len(found.axes), "components": len(found.components)}
    yield f"{name}: ok ({len(found.axes)} axes, {len(found.components)} components)\n"
    yield _places(found)
    if not found.components:
        yield "\nno components: nothing is checked for collisions"


def new(
    name: str = argument(..., "NAME"),
    out: Path = option(..., metavar="FILE"),
    base: str | None = option(None, metavar="NAME"),
    detector: str | None = option(None, metavar="COLUMNSxROWS"),
    pitch: str | None = option(None, metavar="MM[xMM]"),
    bits: int | None = option(None),
    sod: str | None = option(None, metavar="MM or MM:MM"),
    sdd: str | None = option(None, metavar="MM or MM:MM"),
    kv: str | None = option(None, metavar="KV or KV:KV"),
    power: float | None = option(None, metavar="W"),
    limit: list[str] | None = option(None, metavar="AXIS=LOWER:UPPER"),
    without: list[str] | None = option(None, metavar="AXIS"),
) -> Answer:
    """Write a short file for a machine of your own; asks for what is not said, on a terminal.

    Args:
        name: One word.
        out: Write the machine to this file.
        base: Begin with this machine, the most similar.
        detector: Set the detector's unbinned columns and rows.
        pitch: Set the pitch of columns, and of rows.
        bits: Set the bits of a pixel.
        sod: Set source to axis, or least:most.
        sdd: Set source to panel, or least:most.
        kv: Set the largest voltage, or least:most.
        power: Set the largest power.
        limit: Set an axis's travel so.
        without: Leave out this axis.
    """
    from flexdt.twin.collision.home_check import check_home
    from flexdt.twin.machine.description import builtin_machine, builtin_machines, parse_machine
    from flexdt.twin.machine.kinematics import place
    from flexdt.twin.machine.new_machine import Answers, new_machine_text

    base = _asked(f"Most like which of {', '.join(builtin_machines())}", base, USUAL_BASE)
    base = base or USUAL_BASE
    like = builtin_machine(base)
    panel = like.detector
    usual = [
        ":".join(f"{end:g}" for end in dict.fromkeys((at.least, at.most)))
        for at in (place(like, "object_y"), place(like, "detector_y"))
    ]
    size = _asked("Panel, columns x rows", detector, f"{panel.columns}x{panel.rows}")
    pitch = _asked("Pixel, mm", pitch, f"{panel.pitch_mm:g}")
    sod = _asked("SOD, mm: one if fixed, or least:greatest", sod, usual[0])
    sdd = _asked("SDD, mm: one if fixed, or least:greatest", sdd, usual[1])
    kv = _asked(
        "Tube, kV: at most, or least:most", kv, f"{like.tube.min_kV:g}:{like.tube.max_kV:g}"
    )
    volts = None if kv is None else option_values.span(kv, "--kv")
    pixels = None if size is None else _pair(size, "--detector", whole=True)
    lines = [word.partition("=") for word in limit or []]
    answers = Answers(
        name=name,
        base=base,
        scanner=chosen(MachineNewSettings).scanner,
        columns=None if pixels is None else int(pixels[0]),
        rows=None if pixels is None else int(pixels[1]),
        pitch_mm=None if pitch is None else _pair(pitch, "--pitch"),
        bits=bits,
        sod_mm=None if sod is None else option_values.span(sod, "--sod"),
        sdd_mm=None if sdd is None else option_values.span(sdd, "--sdd"),
        min_kV=volts[0] if volts is not None and ":" in str(kv) else None,
        max_kV=None if volts is None else volts[1],
        max_W=None if power is None else option_values.number(f"{power}", "--power"),
        limits={axis: option_values.span(ends, f"--limit {axis}") for axis, _, ends in lines},
        without=tuple(without or ()),
    )
    text = new_machine_text(answers)
    made = parse_machine(text, str(out))
    check_home(made, machines.profile(None, made, str(out)), str(out))
    out.write_text(text, encoding="utf-8")
    least = f", the tube's least voltage ({made.tube.min_kV:g} kV) included"
    yield {"file": str(out), "text": text}
    yield (
        f"{out}: {len(text.splitlines())} lines; everything else as in {base}"
        f"{least if answers.min_kV is None else ''}; see: flexdt machine show {out}"
    )


def _asked(question: str, given: str | None, usual: str) -> str | None:
    """What was given, else what a person at a terminal answers; None for what is usual."""
    if given is not None or not sys.stdin.isatty():
        return given
    answer: str = typer.prompt(question, default=usual, err=True)
    return None if answer == usual else answer


def _pair(word: str, what: str, *, whole: bool = False) -> tuple[float, float]:
    form = "of the form NUMBERxNUMBER"
    found = option_values.numbers(word, f"{what}:", form, 1, 2, by="x", whole=whole)
    return found[0], found[-1]


def fit(
    logs: list[Path] = argument(..., "LOG..."),
    out: Path = option(..., metavar="FILE"),
    base: str = option(machines.DEFAULT_MACHINE, metavar="FILE or NAME"),
) -> Answer:
    """Fit a machine to executed scripts: limits, rates and the times of its commands.

    Args:
        logs: Logs, or recordings of follow; oldest first.
        out: Write the machine to this file.
        base: Take what the logs do not tell from this machine.
    """
    from flexdt.twin.machine.description import builtin_machine_text
    from flexdt.twin.machine.fitted_machine import fitted_text
    from flexdt.twin.script.log_fit import fit_machine, unlike

    machine = machines.machine(base)
    text = Path(base).read_text("utf-8") if machines.is_file(base) else builtin_machine_text(base)
    commands = [read_log_file(log, machine) for log in logs]
    names = ", ".join(log.name for log in logs).encode("utf-8", "replace").decode()
    source = f"measured: {names} ({sum(map(len, commands))} lines)"
    found = fit_machine(commands, machine, source)
    for log, told in zip(logs, commands, strict=True):
        tell(unlike(told, machine), str(log))
    made = fitted_text(
        text, found.machine, found.axes, lambda text, _: machines.parsed(text, str(out))
    )
    out.write_text(made, encoding="utf-8")
    yield found.to_dict()
    yield _axes({n: (found.machine.axes[n], found.machine.axes[n].source) for n in found.axes})
    yield "\n" + _times(found.machine)
    lines = found.lines
    yield (
        f"\n{len(lines.rows)} lines, {lines.total_real_s:.2f} s; absolute errors sum to "
        f"{lines.sum_abs_error_s:.2f} s, {found.cross_validated_s:.2f} s with each time predicted "
        "from the others of its kind"
    )
    if len(logs) == 1:
        yield ("one log does not show how a scan differs from the next: ranges may be too narrow")
    yield (f"{out}: written, everything else as in {base}")


def _axes(axes: dict[str, tuple[Axis, str]]) -> str:
    rows = [
        (name, *(f"{v:g}" for v in (a.lower, a.upper, a.max_speed, a.max_acceleration)), a.unit,
         source)
        for name, (a, source) in axes.items()
    ]  # fmt: skip
    return table(rows, ("axis", "lower", "upper", "max /s", "max /s2", "unit", "source"))


def _places(machine: Machine) -> str:
    from flexdt.twin.machine.kinematics import places

    rows = [(p.name, p.total, f"{p.least:g}", f"{p.most:g}", f"{p.home:g}")
            for p in places(machine)]  # fmt: skip
    return table(rows, ("without zero offsets", "is", "from", "to", "at home"))


def _bodies(machine: Machine) -> str:
    rows = [
        (c.name, c.role, " + ".join(reversed(machine.chain(c))) or "nothing",
         " x ".join(f"{side:g}" for side in c.size_mm),
         "; ".join(filter(None, (c.mesh and f"mesh {c.mesh}", c.source))) or COMMENTS)
        for c in machine.components
    ]  # fmt: skip
    return table(rows, ("body", "role", "moved by", "size [mm]", "source"))


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
