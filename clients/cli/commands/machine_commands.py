"""`flexdt machine`: machines as data, shown and checked."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Final

import typer

from flexdt.clients.cli import value_completion
from flexdt.clients.cli.console import table
from flexdt.clients.cli.options import Answer
from flexdt.library import machines

if TYPE_CHECKING:
    from flexdt.twin.machine.description import Axis, Machine

COMMENTS: Final = "as the file's comments say"
"""Source of a value whose source is no value of the file."""
NameOrFile = Annotated[
    str,
    typer.Argument(
        metavar="NAME or FILE",
        help="Shipped, or TOML.",
        autocompletion=value_completion.machine_names,
    ),
]


def list_machines() -> Answer:
    """List the machines that ship.

    Yields:
        Names and descriptions, as document of --json and as a table.
    """
    from flexdt.twin.machine.description import builtin_machine, builtin_machines

    found = [builtin_machine(name) for name in builtin_machines()]
    yield {"machines": [{"name": m.name, "description": m.description} for m in found]}
    yield table([(m.name, m.description) for m in found], ("name", "what it is"))


def show(name: NameOrFile) -> Answer:
    """Print a machine's axes, distances, bodies and times, and where each value comes from.

    Yields:
        The machine as document of --json, then tables of axes, distances, panel, tube,
        bodies and times.
    """
    found = machines.machine(name)
    yield found.model_dump(mode="json", by_alias=True)
    yield f"{found.name}: {found.description}\n"
    yield _axes({n: (a, a.source or COMMENTS) for n, a in found.axes.items()})
    yield "\n" + _places(found)
    panel = found.detector
    tube = found.tube
    yield (
        f"\npanel: {panel.model}, {panel.columns} x {panel.rows} of {panel.pitch_mm:g} mm, "
        f"{panel.bits} bits, mode {panel.mode}"
    )
    yield (
        f"tube: {tube.min_kV:g} to {tube.max_kV:g} kV, at most {tube.max_W:g} W; at start "
        f"{tube.kV:g} kV, {tube.power_W:g} W\n"
    )
    yield _bodies(found)
    yield "\n" + _times(found)


def check(name: NameOrFile) -> Answer:
    """Check a machine file: every value, its zero offsets, and whether it can stand at home.

    Yields:
        Counts of axes and components, as document of --json and as a line, the table of
        distances, and a note where nothing is checked for collisions.
    """
    from flexdt.twin.collision.home_check import check_home

    found = machines.machine(name)
    check_home(found, machines.profile(None, found, name), name)
    yield {"ok": True, "axes": len(found.axes), "components": len(found.components)}
    yield f"{name}: ok ({len(found.axes)} axes, {len(found.components)} components)\n"
    yield _places(found)
    if not found.components:
        yield "\nno components: nothing is checked for collisions"


def _axes(axes: dict[str, tuple[Axis, str]]) -> str:
    """Make the table of axes: limits, maximum speed and acceleration, unit, and the
    figures' source.

    `axes` is name -> (axis, source); the table has a row for each, in that order.
    """
    rows = [
        (
            name,
            *(f"{v:g}" for v in (a.lower, a.upper, a.max_speed, a.max_acceleration)),
            a.unit,
            source,
        )
        for name, (a, source) in axes.items()
    ]
    return table(rows, ("axis", "lower", "upper", "max /s", "max /s2", "unit", "source"))


def _places(machine: Machine) -> str:
    """Make the table of distances along the beam without zero offsets: their sum, ends
    and value at home [mm].

    Without places the table is empty.
    """
    from flexdt.twin.machine.kinematics import places

    rows = [
        (p.name, p.total, f"{p.least:g}", f"{p.most:g}", f"{p.home:g}")
        for p in places(machine)
    ]
    return table(rows, ("without zero offsets", "is", "from", "to", "at home"))


def _bodies(machine: Machine) -> str:
    """Make the table of bodies: name, role, axes that move it ("nothing" without any),
    size [mm], mesh and source.

    Sizes are "x by y by z"; a body without mesh and source has the file's comments as
    source.
    """
    rows = [
        (
            c.name,
            c.role,
            " + ".join(reversed(machine.chain(c))) or "nothing",
            " x ".join(f"{side:g}" for side in c.size_mm),
            "; ".join(filter(None, (c.mesh and f"mesh {c.mesh}", c.source))) or COMMENTS,
        )
        for c in machine.components
    ]
    return table(rows, ("body", "role", "moved by", "size [mm]", "source"))


def _times(machine: Machine) -> str:
    """Make the table of the twin's times [s] by kind: median, 5 and 95 % where measured
    (else "assumed").

    A last row states the drift common to all times in %, if any was measured.
    """
    timing = machine.timing
    rows = []
    for kind in timing.kinds:
        found = timing.spread.get(kind)
        spread = ("", "", "assumed")
        if found is not None:
            spread = (
                f"{found.p5_s:.3f}",
                f"{found.p95_s:.3f}",
                f"measured, log, n = {found.n}",
            )
        rows.append((kind, f"{timing.seconds(kind):.3f}", *spread))
    if timing.spread:
        rows.append(
            ("all together", "", "", f"+-{100 * timing.drift:.0f} %", "log; for totals")
        )
    return table(
        rows, ("time of a", "median [s]", "5 %", "95 %", f"source ({timing.source})")
    )
