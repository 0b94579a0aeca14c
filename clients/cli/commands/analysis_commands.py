"""`flexdt machine` and `flexdt phantom`: machines and phantoms as data, new ones, fitted machines.

A phantom file is JSON and may be named wherever `--phantom` is. `flexdt commission` makes a machine
from a laboratory's past scans.
"""

from __future__ import annotations

import json as json_text
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from flexdt.clients.cli import options
from flexdt.clients.cli.commands.scan_commands import read_log_file, tell
from flexdt.clients.cli.console import note, table
from flexdt.clients.cli.options import Answer, argument, option
from flexdt.clients.cli.settings_file import MachineNewSettings, PhantomMakeSettings, chosen
from flexdt.library import machines
from flexdt.library.failure import CommandError

if TYPE_CHECKING:
    from flexdt.phantoms import Phantom
    from flexdt.twin.machine.description import Axis, Machine

T = TypeVar("T")
_COMMENTS = "as the file's comments say"
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
    yield _axes({n: (a, a.source or _COMMENTS) for n, a in found.axes.items()})
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

    def asked(question: str, given: str | None, usual: str) -> str | None:
        if given is not None or not sys.stdin.isatty():
            return given
        answer: str = typer.prompt(question, default=usual, err=True)
        return None if answer == usual else answer

    base = asked(f"Most like which of {', '.join(builtin_machines())}", base, "xyzr_cabinet")
    base = base or "xyzr_cabinet"
    like = builtin_machine(base)
    panel = like.detector
    usual = [
        ":".join(f"{end:g}" for end in dict.fromkeys((at.least, at.most)))
        for at in (place(like, "object_y"), place(like, "detector_y"))
    ]
    size = asked("Panel, columns x rows", detector, f"{panel.columns}x{panel.rows}")
    pitch = asked("Pixel, mm", pitch, f"{panel.pitch_mm:g}")
    sod = asked("SOD, mm: one if fixed, or least:greatest", sod, usual[0])
    sdd = asked("SDD, mm: one if fixed, or least:greatest", sdd, usual[1])
    kv = asked("Tube, kV: at most, or least:most", kv, f"{like.tube.min_kV:g}:{like.tube.max_kV:g}")
    volts = None if kv is None else options.span(kv, "--kv")
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
        sod_mm=None if sod is None else options.span(sod, "--sod"),
        sdd_mm=None if sdd is None else options.span(sdd, "--sdd"),
        min_kV=volts[0] if volts is not None and ":" in str(kv) else None,
        max_kV=None if volts is None else volts[1],
        max_W=None if power is None else options.number(f"{power}", "--power"),
        limits={axis: options.span(ends, f"--limit {axis}") for axis, _, ends in lines},
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


def _pair(word: str, what: str, *, whole: bool = False) -> tuple[float, float]:
    form = "of the form NUMBERxNUMBER"
    found = options.numbers(word, f"{what}:", form, 1, 2, by="x", whole=whole)
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
         "; ".join(filter(None, (c.mesh and f"mesh {c.mesh}", c.source))) or _COMMENTS)
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


def list_phantoms() -> Answer:
    """List the phantoms that ship."""
    from flexdt.phantoms import load_phantom, phantom_names

    found = {name: load_phantom(name) for name in phantom_names()}
    yield {"phantoms": [_summary(name, p) for name, p in found.items()]}
    rows = [
        (name, " x ".join(f"{s:g}" for s in p.size_mm), len(p.beads), p.description)
        for name, p in found.items()
    ]
    yield table(rows, ("name", "size [mm]", "beads", "what it is"))
    yield "\nCuboids take a number of beads: normal-7 has seven."


def make(
    file: Path = argument(..., "FILE.json"),
    like: str | None = option(None, metavar="NAME"),
    size: str | None = option(None, metavar="W,B,H"),
    beads: int = option(5, metavar="K"),
    radius: float = option(2.0, metavar="MM"),
    body: str = option("abs", metavar="MATERIAL"),
    mesh: Path | None = option(None, metavar="FILE"),
    unit: str | None = option(None),
    stl: Path | None = option(None, metavar="FILE.stl"),
) -> Answer:
    """Write a new phantom: a bead cuboid of your own size, or a mesh.

    Args:
        file: Where to write it.
        like: Begin with this cuboid of `phantom list`.
        size: Set width, breadth and height [mm].
        beads: Put so many beads on a spiral.
        radius: Set the beads' radius.
        body: Make the body of this material.
        mesh: Fill this mesh: STL, OBJ, PLY, GLB or OFF.
        unit: Read the mesh in this unit; default: mm, for GLB m.
        stl: Write its surfaces, too, to print it.
    """
    if sum(given is not None for given in (like, size, mesh)) != 1:
        raise typer.BadParameter("give one of --like NAME, --size W,B,H or --mesh FILE")
    options.require_folder(file, stl)
    from flexdt.phantoms import bead_phantom, mesh_phantom

    if mesh is not None:
        made = mesh_phantom(mesh, unit=unit, material=body, name=file.stem)
    else:
        made = bead_phantom(
            like if like is not None else _size(size or ""),
            beads,
            bead_radius_mm=radius,
            body_material=body,
            bead_material=chosen(PhantomMakeSettings).bead,
        )
    file.write_text(json_text.dumps(made.to_dict()), encoding="utf-8")
    if stl is not None:
        made.mesh().export(stl, file_type="stl")
    for line in made.assumed:
        note(f"assumed: {line}")
    yield {"file": str(file), "stl": stl, **_summary(made.name, made)}
    yield f"{file}: {made.description}"


def _size(text: str) -> tuple[float, float, float]:
    return options.triple(text, "size", "W,B,H, e.g. 20,40,60")


def _summary(name: str, phantom: Phantom) -> dict[str, object]:
    return {
        "name": name,
        "size_mm": list(phantom.size_mm),
        "beads": len(phantom.beads),
        "bead_radius_mm": phantom.bead_radius_mm.tolist(),
        "description": phantom.description,
        "assumed": list(phantom.assumed),
    }


def commission(
    folders: list[Path] = argument(..., "FOLDER..."),
    traffic: Path | None = option(None, metavar="FILE"),
    out: Path = option(..., metavar="DIR"),
) -> Answer:
    """Fit a machine, its zero offsets and their drift to past scans, and say what disagrees.

    Args:
        folders: Past scans.
        traffic: Read this recording of `flexdt follow --record` too.
        out: Write machine, profile and report to this folder.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise CommandError(f"{out} is there; allowed: a new or an empty folder")
    from flexdt.library.commission import commission as commissioned
    from flexdt.library.commission import write_commission
    from flexdt.library.figures import cell_text

    found = commissioned(folders, traffic, read_log_file)
    write_commission(found, out)
    yield found.document(out)
    for title, (head, rows) in found.tables(out).items():
        yield f"{title}\n{table(([cell_text(x) for x in row] for row in rows), head)}\n"
    yield f"{out}: machine.toml, profile.toml, commission.json and report.html written"
