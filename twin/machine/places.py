"""Where a machine's motors put source, sample and detector: what each distance is the sum of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from flexdt.twin.machine.description import Machine

_NAMES: Final = {
    "object_y": "SOD",
    "detector_y": "SDD",
    "source_x": "source to the right",
    "source_z": "source up",
    "object_x": "sample to the right",
    "object_z": "sample up",
    "detector_x": "detector to the right",
    "detector_z": "detector up",
    "angle": "turntable",
    "mount_x": "stage on the turntable, x",
    "mount_y": "stage on the turntable, y",
}


@dataclass(frozen=True)
class Place:
    """One quantity of `[geometry]`, without zero offsets.

    Attributes:
        name: in words.
        total: what it is the sum of, such as "900 + D".
        least, most, home: its ends over the travel of its motors, and at home [mm, deg].
    """

    name: str
    total: str
    least: float
    most: float
    home: float


def places(machine: Machine) -> list[Place]:
    """SOD, SDD and what else motors move or the file fixes.

    Example:
        >>> from flexdt.twin.machine.description import builtin_machine
        >>> places(builtin_machine("xyzr_cabinet"))[0]
        Place(name='SOD', total='Z', least=20.0, most=850.0, home=400.0)
    """
    return [
        place(machine, quantity)
        for quantity in _NAMES
        if machine.geometry.get(quantity) or quantity in (*machine.fixed, "object_y", "detector_y")
    ]


def place(machine: Machine, quantity: str) -> Place:
    """One of them by its name in the machine file."""
    fixed = machine.fixed.get(quantity, 0.0) + (
        machine.sample_height_mm if quantity == "object_z" else 0.0
    )
    words = [f"{fixed:g}"] if fixed else []
    ends, home = [fixed, fixed], fixed
    for motor, factor in machine.geometry.get(quantity, {}).items():
        axis = machine.axes[motor]
        both = sorted((factor * axis.lower, factor * axis.upper))
        ends = [a + b for a, b in zip(ends, both, strict=True)]
        home += factor * axis.home
        times = "" if abs(factor) == 1.0 else f"{abs(factor):g} "
        sign = "- " if factor < 0 else "+ " if words else ""
        words.append(f"{sign}{times}{motor}")
    return Place(_NAMES[quantity], " ".join(words) or "0", ends[0], ends[1], home)
