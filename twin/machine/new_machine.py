"""A short machine file from a few answers; it begins with a machine that ships."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field

from flexdt.twin.errors import LimitError
from flexdt.twin.machine.description import Component, Machine, parse_machine
from flexdt.twin.machine.fitted_machine import Range

_HOUSING_MARGIN_MM = 60.0
"""Width that a panel's housing adds to its active area [mm] (assumed)."""
_RAIL_AXIS = "D"
"""Name of the motor of a panel for which the base has none."""
_RAIL_VALUES: dict[str, object] = {
    "speed": 30.0,
    "max_speed": 50.0,
    "acceleration": 50.0,
    "max_acceleration": 100.0,
    "description": "panel away from the source (+); it is the SDD",
    "source": "assumed but for its travel",
}
"""Values of that motor."""


@dataclass(frozen=True)
class Answers:
    """Differences from the base; None is as there.

    Attributes:
        name: of the machine; one word.
        base: the machine that ships and is most like it.
        scanner: its name in the scanner's own files.
        columns, rows: of the panel, unbinned.
        pitch_mm: from column to column and from row to row.
        bits: of a pixel.
        sod_mm, sdd_mm: source-object and source-detector distance: one if it is fixed,
            else from the least to the greatest.
        min_kV, max_kV, max_W: of the tube.
        limits: axis -> travel [mm, deg].
        without: axes and components that there are not.
    """

    name: str
    base: str
    scanner: str | None = None
    columns: int | None = None
    rows: int | None = None
    pitch_mm: Range | None = None
    bits: int | None = None
    sod_mm: Range | None = None
    sdd_mm: Range | None = None
    min_kV: float | None = None
    max_kV: float | None = None
    max_W: float | None = None
    limits: Mapping[str, Range] = field(default_factory=dict)
    without: tuple[str, ...] = ()


def new_machine_text(answers: Answers) -> str:
    """Write a machine file (TOML) from answers, with only the differences from the base;
    it is parsed before it is returned.

    A range for SOD or SDD becomes the travel of the first motor that drives it, two equal
    ends a fixed distance without its motors. A panel that is fixed in the base gets a
    rail `_RAIL_AXIS` for a range of SDD. Values that are None are the base's; initial kV,
    power and homes are moved into new limits. A panel of other size gets a body that is
    wider than its active area by `_HOUSING_MARGIN_MM`.

    Args:
        answers: name, base, and the values that differ from it.

    Returns:
        The file's text.

    Raises:
        UnknownNameError: no such base, or it has no such axis.
        LimitError: a range of SOD for a base without a motor along it (of SDD likewise,
            where the panel is carried); or a range and the travel of its motor as well.
        MachineFileError: the answers do not make a machine; key, value and allowed
            values.

    Example:
        >>> text = new_machine_text(Answers("lab", "micro_ct", sod_mm=(80.0, 80.0), max_kV=90.0))
        >>> parse_machine(text).fixed["object_y"], len(text.splitlines()) < 20
        (80.0, True)
    """
    base = parse_machine(
        _lines({"base": answers.base, "name": answers.name}), "the new machine"
    )
    panel = next((part for part in base.components if part.role == "panel"), None)
    differences = _Differences(
        answers.base, base, dict(answers.limits), list(answers.without)
    )
    if answers.sod_mm is not None:
        differences.set_distance("object_y", "SOD", answers.sod_mm)
    if answers.sdd_mm is not None:
        if _takes_rail(answers.sdd_mm, base, panel):
            differences.set_rail(answers.sdd_mm)
        else:
            differences.set_distance("detector_y", "SDD", answers.sdd_mm)
    detector = _detector(answers, base)
    text = (
        f"# Made by `flexdt machine new`. What is not said here is as in {answers.base}: times,\n"
        "# rates, bodies and filters too, so compare them with your scanner.\n"
        + _lines(_head(answers, differences.without))
    )
    tables = {
        "detector": detector,
        "tube": _tube(answers, base),
        "fixed": differences.fixed,
        **differences.axis_tables(),
    }
    for title, values in tables.items():
        if any(value is not None for value in values.values()):
            text += f"\n[{title}]\n{_lines(values)}"
    if panel is not None:
        body = _panel_body(panel, base, detector, on_rail=bool(differences.rail))
        if body:
            text += f"\n[[components]]\n{_lines(body)}"
    parse_machine(text, "the new machine")
    return text


@dataclass
class _Differences:
    """Axes and distances that differ from the base, while the file is made.

    Attributes:
        base_name: of the machine that ships.
        base: that machine.
        limits: axis -> travel [mm, deg].
        without: axes and components that there are not.
        fixed: quantity -> its constant part [mm].
        rail: values of the motor `_RAIL_AXIS`; {} without one.
    """

    base_name: str
    base: Machine
    limits: dict[str, Range]
    without: list[str]
    fixed: dict[str, object] = field(default_factory=dict)
    rail: dict[str, object] = field(default_factory=dict)

    def set_distance(self, quantity: str, name: str, distance: Range) -> None:
        """Set SOD or SDD: two equal ends are a fixed distance without its motors, a range
        the travel of the first motor that drives it.

        Raises:
            LimitError: there is no motor for the range, or its travel is said as well.
        """
        motors = self.base.geometry.get(quantity, {})
        if distance[0] == distance[1]:
            self.fixed[quantity] = distance[0]
            self.without += [motor for motor in motors if motor not in self.without]
            return
        if not motors:
            raise LimitError(
                f"{self.base_name} has no motor along the {name}, so it is one number; for a range "
                "begin with another machine (flexdt machine list)",
                {"asked": list(distance), "base": self.base_name},
            )
        (motor, factor), *_ = motors.items()
        if motor in self.limits:
            raise LimitError(
                f"the {name} and the travel of {motor} are both said, and {motor} sets the "
                f"{name}; say one",
                {"asked": list(self.limits[motor]), "axis": motor},
            )
        start = self.base.fixed.get(quantity, 0.0)
        ends = sorted((d - start) / factor for d in distance)
        self.limits[motor] = (ends[0], ends[1])

    def set_rail(self, distance: Range) -> None:
        """Put the panel of a cabinet on a rail: its distance becomes a motor's reading,
        and the fixed part 0.
        """
        lower, upper = distance
        home = min(max(self.base.fixed.get("detector_y", 0.0), lower), upper)
        self.fixed["detector_y"] = 0.0
        self.rail = {"lower": lower, "upper": upper, "home": home, **_RAIL_VALUES}

    def axis_tables(self) -> dict[str, dict[str, object]]:
        """Make the tables of the rail's motor and of changed travels, homes moved into them."""
        tables: dict[str, dict[str, object]] = {}
        if self.rail:
            tables["geometry.detector_y"] = {_RAIL_AXIS: 1.0}
            tables[f"axes.{_RAIL_AXIS}"] = self.rail
        for name, (lower, upper) in self.limits.items():
            home = min(max(self.base.axis(name).home, lower), upper)
            tables[f"axes.{name}"] = {"lower": lower, "upper": upper, "home": home}
        return tables


def _takes_rail(sdd_mm: Range, base: Machine, panel: Component | None) -> bool:
    """Return whether a range of SDD needs a rail for a panel that nothing moves in the base."""
    carried = panel is None or panel.axis is not None
    driven = base.geometry.get("detector_y", {})
    return sdd_mm[0] != sdd_mm[1] and not driven and not carried


def _head(answers: Answers, without: list[str]) -> dict[str, object]:
    """Collect the values before the first table."""
    scanner = answers.scanner or answers.name
    return {
        "base": answers.base,
        "without": without or None,
        "name": answers.name,
        "scanner_name": scanner,
        "scanner_type": scanner,
        "description": f"{scanner}, described with flexdt machine new; begins with {answers.base}.",
    }


def _tube(answers: Answers, base: Machine) -> dict[str, object]:
    """Collect the values of `[tube]`, by key; None for those that stay.

    Initial voltage and power are moved into new limits.
    """
    least_kV = answers.min_kV or 0.0
    return {
        "min_kV": answers.min_kV,
        "max_kV": answers.max_kV,
        "max_W": answers.max_W,
        "kV": answers.max_kV and min(max(base.tube.kV, least_kV), answers.max_kV),
        "power_W": answers.max_W and min(base.tube.power_W, answers.max_W),
    }


def _panel_body(
    panel: Component, base: Machine, detector: Mapping[str, object], *, on_rail: bool
) -> dict[str, object]:
    """Collect the values of the panel's component: its rail, and for another active area
    a body wider than that by `_HOUSING_MARGIN_MM`; {} if it is the base's.
    """
    seen = {key: value for key, value in detector.items() if value is not None}
    if not on_rail and not seen.keys() & {"columns", "rows", "pitch_mm"}:
        return {}
    part: dict[str, object] = {
        "name": panel.name,
        "axis": _RAIL_AXIS if on_rail else None,
    }
    across, up = base.detector.model_copy(update=seen).pixels.size_mm
    if (across, up) == base.detector.pixels.size_mm:
        return part
    sides = (across + _HOUSING_MARGIN_MM, panel.size_mm[1], up + _HOUSING_MARGIN_MM)
    size_mm = [round(side, 1) for side in sides]
    return part | {"size_mm": size_mm, "source": "assumed"}


def _detector(answers: Answers, base: Machine) -> dict[str, object]:
    """Collect the values of `[detector]`, by key; None for those that stay.

    With columns or rows also a model name and the whole panel as region; row_pitch_mm
    only where it differs from pitch_mm.

    Args:
        answers: columns, rows, pitch and bits, as far as they are known.
        base: machine that the file begins with.
    """
    pitch = answers.pitch_mm
    detector = base.detector
    out: dict[str, object] = {
        "columns": answers.columns,
        "rows": answers.rows,
        "pitch_mm": pitch and pitch[0],
        "row_pitch_mm": pitch[1] if pitch and pitch[0] != pitch[1] else None,
        "bits": answers.bits,
    }
    if answers.columns is not None or answers.rows is not None:
        columns = answers.columns or detector.columns
        rows = answers.rows or detector.rows
        out |= {
            "model": f"panel {columns} x {rows}",
            "roi": [0, 0, columns - 1, rows - 1],
        }
    return out


def _lines(values: Mapping[str, object]) -> str:
    """Format values as TOML lines, each with its newline; values that are None are left
    out.
    """
    return "".join(
        f"{key} = {json.dumps(value, ensure_ascii=False)}\n".replace("\x7f", "\\u007f")
        for key, value in values.items()
        if value is not None
    )
