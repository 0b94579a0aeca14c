"""Units of length in files that people bring."""

from __future__ import annotations

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
