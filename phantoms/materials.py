"""Attenuation of the materials that phantoms are made of, from a bundled table
with its sources.

`mu_per_mm` is given at one documented effective energy; `substance` gives the attenuation
at every energy of a spectrum. A material that is not in the table is written
FORMULA@DENSITY, such as C8H8@1.05 (g/cm3). Energies outside the table are errors.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import TYPE_CHECKING, assert_never

from flexdt.twin.attenuation.substances import (
    Substance,
    mass_fractions,
    parse_formula,
    tables,
)
from flexdt.twin.errors import LimitError, UnknownNameError

if TYPE_CHECKING:
    from flexdt.twin.physics.predicted_beam import Physics


@dataclass(frozen=True)
class Material:
    """A homogeneous material.

    Attributes:
        name: as phantoms and files name it.
        label: its meaning.
        density_g_cm3: density.
        effective_energy_keV: where `mu_per_mm` is stated.
        points: (energy [keV], mu/rho [cm2/g]) in growing energy; an edge is two close
            energies. None for a material by formula, which has the elements' tables.
        source: provenance of the numbers.
        fractions: (symbol, mass fraction).
    """

    name: str
    label: str
    density_g_cm3: float
    effective_energy_keV: float
    points: tuple[tuple[float, float], ...]
    source: str
    fractions: tuple[tuple[str, float], ...] = ()

    @property
    def substance(self) -> Substance:
        """Its composition, for attenuation at every energy."""
        return Substance(self.name, self.fractions, self.density_g_cm3)

    @property
    def mu_per_mm(self) -> float:
        """Linear attenuation coefficient at the effective energy [1/mm]."""
        return self.mu_at(self.effective_energy_keV)

    def mu_at(self, energy_keV: float) -> float:
        """Interpolate the linear attenuation coefficient at `energy_keV` [1/mm], log-log
        between the points.

        A material without own points is interpolated in the tables of its elements.

        Args:
            energy_keV: of the photons.

        Raises:
            LimitError: the energy is outside the table.
        """
        ends = (
            tables().energy_keV
            if not self.points
            else [energy for energy, _ in self.points]
        )
        low = float(ends[0])
        high = float(ends[-1])
        if not low <= energy_keV <= high:
            raise LimitError(
                f"{self.name}: {energy_keV:g} keV is outside the table's [{low:g}, {high:g}] keV",
                {"asked": energy_keV, "allowed": [low, high], "unit": "keV"},
            )
        if not self.points:
            return self.substance.attenuation_at(energy_keV)
        after = next(i for i, p in enumerate(self.points) if p[0] >= energy_keV)
        (e0, m0), (e1, m1) = self.points[max(after - 1, 0)], self.points[after]
        part = 0.0
        if e1 != e0:
            part = math.log(energy_keV / e0) / math.log(e1 / e0)
        mass = math.exp(math.log(m0) + part * math.log(m1 / m0))
        if energy_keV == e1:
            mass = m1
        return mass * self.density_g_cm3 / 10.0


@lru_cache
def materials() -> Mapping[str, Material]:
    """Load all bundled materials from `data/materials.toml`, name -> material, in the
    file's order; it is read once.
    """
    text = (resources.files("flexdt.phantoms") / "data" / "materials.toml").read_text(
        "utf-8"
    )
    document = tomllib.loads(text)
    return {
        name: Material(
            name,
            entry["label"],
            float(entry["density_g_cm3"]),
            float(document["effective_energy_keV"]),
            tuple((float(e), float(m)) for e, m in entry["points"]),
            document["source"],
            _fractions(entry),
        )
        for name, entry in document["material"].items()
    }


def stated_keV() -> float:
    """Return the energy at which phantoms state their attenuation [keV]."""
    return next(iter(materials().values())).effective_energy_keV


def only_keV(physics: Physics) -> float | None:
    """Return the energy of all photons [keV], `stated_keV` for "mono"; None for physics
    without one energy.
    """
    match physics:
        case "mono":
            return stated_keV()
        case "ideal" | "poly":
            return None
        case _:
            assert_never(physics)


def material(name: str) -> Material:
    """Look up the material called `name`, or parse FORMULA@DENSITY [g/cm3].

    Args:
        name: of a bundled material, in lower case, or a formula such as C8H8@1.05.

    Raises:
        UnknownNameError: lists the materials there are; or an unknown element.
        LimitError: a formula that cannot be read or an impossible density.

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
    """Make the material of FORMULA@DENSITY [g/cm3], without measured points; the last 64 are
    cached.

    Raises:
        LimitError: it cannot be parsed.
    """
    substance = Substance.parse(name)
    return Material(
        name,
        f"{name.partition('@')[0].strip()}, as asked for",
        substance.density_g_cm3,
        stated_keV(),
        (),
        tables().provenance["attenuation"],
        substance.fractions,
    )


def _fractions(entry: Mapping[str, object]) -> tuple[tuple[str, float], ...]:
    """Read mass fractions (element, fraction) if stated, else compute them from the formula."""
    formula = entry.get("formula")
    fractions = entry.get("fractions")
    if isinstance(fractions, Mapping):
        return tuple((str(s), float(f)) for s, f in fractions.items())
    return tuple(mass_fractions(parse_formula(str(formula))).items())
