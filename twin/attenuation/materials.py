"""Materials by name: composition and density, from which attenuation at every energy follows.

`data/materials.toml` is the one list: of phantoms and uploads, of the tube's filters, of the
page's colors. A material that is not in it is written FORMULA@DENSITY, such as C8H8@1.05
(g/cm3). `mu_per_mm` is stated at one documented effective energy.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib import resources
from typing import Final

from flexdt.twin.attenuation.substances import (
    Substance,
    mass_fractions,
    parse_formula,
    tables,
)
from flexdt.twin.errors import UnknownNameError
from flexdt.twin.findings import Finding, warning
from flexdt.twin.plausibility.contradictions import PlausibilityCode, warn_of

FOAM_SHARE: Final = 0.01
"""Density over that of the packed elements which hardly a foam falls below and hardly a gas
exceeds: foams of metals have 0.03 and more (Ashby et al., Metal Foams, 2000), of polystyrene
0.015; air has 0.001, at 10 bar 0.01."""
PERMANENT_GASES: Final = frozenset(
    ("He", "N", "O", "F", "Ne", "Cl", "Ar", "Kr", "Xe", "Rn")
)
"""Elements whose mixtures with one another are gases at room temperature."""
TRACE: Final = 0.01
"""Mass fraction of other elements in what still counts as such a mixture: air has carbon."""


@dataclass(frozen=True)
class Material:
    """A homogeneous material.

    Attributes:
        name: as phantoms and files name it.
        label: its meaning.
        substance: composition and density, for attenuation at every energy.
        effective_energy_keV: where `mu_per_mm` is stated.
        source: provenance of the numbers.
        color: (r, g, b) in the page, 0 to 255; None for one without a color of its own.
    """

    name: str
    label: str
    substance: Substance
    effective_energy_keV: float
    source: str
    color: tuple[int, int, int] | None = None

    @property
    def density_g_cm3(self) -> float:
        """Its density."""
        return self.substance.density_g_cm3

    @property
    def fractions(self) -> tuple[tuple[str, float], ...]:
        """Pairs (symbol, mass fraction)."""
        return self.substance.fractions

    @cached_property
    def mu_per_mm(self) -> float:
        """Attenuation at the effective energy [1/mm]."""
        return self.mu_at(self.effective_energy_keV)

    def mu_at(self, energy_keV: float) -> float:
        """Compute the linear attenuation coefficient at `energy_keV` [1/mm], from the
        tables of the elements.

        Args:
            energy_keV: of the photons.

        Raises:
            LimitError: the energy is outside the tables.
        """
        return self.substance.attenuation_at(energy_keV)


@lru_cache
def materials() -> Mapping[str, Material]:
    """Load all materials that have a name, from `data/materials.toml`, name -> material, in
    the file's order; it is read once.

    Raises:
        LimitError: a density that the composition does not allow.
    """
    folder = resources.files("flexdt.twin.attenuation") / "data"
    document = tomllib.loads((folder / "materials.toml").read_text("utf-8"))
    energy = float(document["effective_energy_keV"])
    source = f"{document['source']}; {tables().provenance['attenuation']}"
    return {
        name: Material(
            name,
            entry["label"],
            Substance(name, _fractions(entry), float(entry["density_g_cm3"])),
            energy,
            source,
            tuple(entry["color"]) if "color" in entry else None,
        )
        for name, entry in document["material"].items()
    }


def stated_keV() -> float:
    """Return the energy of phantoms' attenuation [keV]."""
    return next(iter(materials().values())).effective_energy_keV


def material(name: str) -> Material:
    """Look up the material called `name`, or parse FORMULA@DENSITY [g/cm3].

    Warns of a doubtful density.

    Raises:
        UnknownNameError: of a material or element.
        LimitError: formula or density is not valid.

    Example:
        >>> material("steel").name, material("Al@2.70").name
        ('steel', 'Al@2.70')
    """
    table = materials()
    if name in table:
        return table[name]
    if "@" in name:
        return _by_formula(name)
    raise UnknownNameError(
        f"unknown material {name!r}; "
        f"there are: {', '.join(table)}, and FORMULA@DENSITY such as C8H8@1.05 (g/cm3)",
        {"asked": name, "allowed": [*table, "FORMULA@DENSITY"]},
    )


@lru_cache(maxsize=64)
def _by_formula(name: str) -> Material:
    """Make the material of FORMULA@DENSITY [g/cm3]; the last 64 are cached.

    Raises:
        LimitError: it cannot be parsed, or the density is not possible.
    """
    substance = Substance.parse(name)
    warn_of(density_findings(substance))
    label = f"{name.partition('@')[0].strip()}, as asked for"
    return Material(
        name, label, substance, stated_keV(), tables().provenance["attenuation"]
    )


def density_findings(substance: Substance) -> Iterator[Finding]:
    """Compare a density with what its elements have when packed (`FOAM_SHARE`).

    Yields a warning for a gas as dense as a liquid, and for anything else as thin as a
    gas; its figure is the share of the packed density.
    """
    share = substance.density_g_cm3 / substance.packed_g_cm3
    others = sum(w for symbol, w in substance.fractions if symbol not in PERMANENT_GASES)
    named = f"{substance.name}: density {substance.density_g_cm3:g} g/cm3"
    packed = f"{share:.2g} of what its elements have side by side as liquids or solids"
    if others > TRACE and share < FOAM_SHARE:
        remedy = "a gas, a smoke or an aerogel? Densities are in g/cm3"
        yield warning(
            PlausibilityCode.DENSITY, f"{named} is {packed}", remedy, figure=share
        )
    if others <= TRACE and share > FOAM_SHARE:
        remedy = "liquid? These elements are gases in a laboratory (air: 0.0012 g/cm3)"
        yield warning(
            PlausibilityCode.DENSITY, f"{named} is {packed}", remedy, figure=share
        )


def _fractions(entry: Mapping[str, object]) -> tuple[tuple[str, float], ...]:
    """Read mass fractions (element, fraction) if stated, else compute them from the formula."""
    fractions = entry.get("fractions")
    if isinstance(fractions, Mapping):
        return tuple((str(s), float(f)) for s, f in fractions.items())
    return tuple(mass_fractions(parse_formula(str(entry.get("formula")))).items())
