"""A short machine file from a few answers; it begins with a machine that ships."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field

from flexdt.twin.errors import LimitError
from flexdt.twin.machine.description import Machine, parse_machine
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
    fixed: dict[str, float] = {}
    rail: dict[str, object] = {}
    without = list(answers.without)
    limits = dict(answers.limits)
    for quantity, distance_name, distance in (
        ("object_y", "SOD", answers.sod_mm),
        ("detector_y", "SDD", answers.sdd_mm),
    ):
        if distance is None:
            continue
        motors = base.geometry.get(quantity, {})
        if distance[0] == distance[1]:
            fixed[quantity] = distance[0]
            without += [motor for motor in motors if motor not in without]
        elif motors:
            (motor, factor), *_ = motors.items()
            if motor in limits:
                raise LimitError(
                    f"the {distance_name} and the travel of {motor} are both said, and "
                    f"{motor} sets the {distance_name}; say one",
                    {"asked": list(limits[motor]), "axis": motor},
                )
            ends = sorted((d - base.fixed.get(quantity, 0.0)) / factor for d in distance)
            limits[motor] = (ends[0], ends[1])
        elif quantity == "detector_y" and panel is not None and panel.axis is None:
            # A cabinet whose panel runs on a rail: the fixed distance is a motor's reading now.
            fixed[quantity] = 0.0
            home = min(max(base.fixed.get(quantity, 0.0), distance[0]), distance[1])
            rail = {
                "lower": distance[0],
                "upper": distance[1],
                "home": home,
                **_RAIL_VALUES,
            }
        else:
            raise LimitError(
                f"{answers.base} has no motor along the {distance_name}, so it is one number; for "
                "a range "
                "begin with another machine (flexdt machine list)",
                {"asked": list(distance), "base": answers.base},
            )
    scanner = answers.scanner or answers.name
    head = {
        "base": answers.base,
        "without": without or None,
        "name": answers.name,
        "scanner_name": scanner,
        "scanner_type": scanner,
        "description": f"{scanner}, described with flexdt machine new; begins with {answers.base}.",
    }
    tables: dict[str, dict[str, object]] = {
        "detector": _detector(answers, base),
        "tube": {
            "min_kV": answers.min_kV,
            "max_kV": answers.max_kV,
            "max_W": answers.max_W,
            "kV": answers.max_kV
            and min(max(base.tube.kV, answers.min_kV or 0.0), answers.max_kV),
            "power_W": answers.max_W and min(base.tube.power_W, answers.max_W),
        },
        "fixed": dict(fixed),
    }
    if rail:
        tables |= {"geometry.detector_y": {_RAIL_AXIS: 1.0}, f"axes.{_RAIL_AXIS}": rail}
    for name, (lower, upper) in limits.items():
        home = min(max(base.axis(name).home, lower), upper)
        tables[f"axes.{name}"] = {"lower": lower, "upper": upper, "home": home}
    text = (
        f"# Made by `flexdt machine new`. What is not said here is as in {answers.base}: "
        "times,\n"
        "# rates, bodies and filters too, so compare them with your scanner.\n"
        + _lines(head)
    )
    for title, values in tables.items():
        if any(value is not None for value in values.values()):
            text += f"\n[{title}]\n{_lines(values)}"
    seen = {key: value for key, value in tables["detector"].items() if value is not None}
    if panel is not None and (rail or seen.keys() & {"columns", "rows", "pitch_mm"}):
        part: dict[str, object] = {
            "name": panel.name,
            "axis": _RAIL_AXIS if rail else None,
        }
        across, up = base.detector.model_copy(update=seen).pixels.size_mm
        if (across, up) != base.detector.pixels.size_mm:
            sides = (
                across + _HOUSING_MARGIN_MM,
                panel.size_mm[1],
                up + _HOUSING_MARGIN_MM,
            )
            part |= {"size_mm": [round(side, 1) for side in sides], "source": "assumed"}
        text += f"\n[[components]]\n{_lines(part)}"
    parse_machine(text, "the new machine")
    return text


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
