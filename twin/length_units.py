"""Units of length and angle in files that people bring."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Final

UNITS_MM: Final[Mapping[str, float]] = {
    "um": 1e-3,
    "mm": 1.0,
    "cm": 10.0,
    "m": 1000.0,
    "inch": 25.4,
}
"""Name of a unit -> its length [mm]. The wire has the same names (`LengthUnit` of the
protocol)."""
MORE_UNITS_MM: Final[Mapping[str, float]] = {
    "nm": 1e-6,
    "micron": 1e-3,
    "in": 25.4,
}
"""Further names in other programs' files."""
PREFIXES: Final[Mapping[str, str]] = {
    "nano": "n",
    "micro": "u",
    "milli": "m",
    "centi": "c",
}
"""Prefix of a unit that is written out -> its letter."""
UNITS_RAD: Final[Mapping[str, float]] = {
    "deg": math.pi / 180,
    "degree": math.pi / 180,
    "\N{DEGREE SIGN}": math.pi / 180,
    "rad": 1.0,
    "radian": 1.0,
    "mrad": 1e-3,
    "milliradian": 1e-3,
    "turn": math.tau,
    "revolution": math.tau,
}
"""Name of a unit -> its angle [rad]."""
METRE: Final = re.compile(r"(nano|micro|milli|centi|)met(?:er|re)")


def length_mm(unit: str) -> float | None:
    """Return the length of a unit as other programs write it [mm]; None if it is unknown.

    Upper and lower case, the plural, the two micro signs and units that are written out
    count alike.

    Example:
        >>> length_mm("Millimetres"), length_mm("\\u00b5m"), length_mm("pixel")
        (1.0, 0.001, None)"""
    name = _plain(unit)
    written_out = METRE.fullmatch(name)
    if written_out:
        name = f"{PREFIXES.get(written_out[1], '')}m"
    return {**UNITS_MM, **MORE_UNITS_MM}.get(name)


def angle_rad(unit: str) -> float | None:
    """Return the angle of a unit as other programs write it [rad]; None if it is unknown.

    Upper and lower case and the plural count alike.

    Example:
        >>> angle_rad("Radians"), angle_rad("gon")
        (1.0, None)"""
    return UNITS_RAD.get(_plain(unit))


def _plain(unit: str) -> str:
    """Return a unit in lower case, in the singular, with u for micro."""
    name = unit.strip().lower().replace("\N{MICRO SIGN}", "u")
    name = name.replace("\N{GREEK SMALL LETTER MU}", "u")
    if name.endswith("s"):
        return name[:-1]
    if name == "inche":
        return "inch"
    return name
