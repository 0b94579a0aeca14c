"""X-ray attenuation of substances, from tables of the elements."""

from flexdt.twin.attenuation.substances import (
    Substance,
    mass_fractions,
    parse_formula,
    tables,
)

__all__ = [
    "Substance",
    "mass_fractions",
    "parse_formula",
    "tables",
]
