"""Attenuation of the materials phantoms are made of, from a bundled table with its provenance.

`mu_per_mm` is stated at one documented effective energy; `mu_at` interpolates the table for anyone
who needs a spectrum. It refuses to extrapolate and to guess the material of an unknown name.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources

from flexdt.twin.errors import LimitError, UnknownNameError


@dataclass(frozen=True)
class Material:
    """A homogeneous material.

    Attributes:
        name: as phantoms and files name it.
        label: what it stands for.
        density_g_cm3: density.
        effective_energy_keV: where `mu_per_mm` is stated.
        points: (energy [keV], mu/rho [cm2/g]) in growing energy; an edge is two close energies.
        source: provenance of the numbers.
    """

    name: str
    label: str
    density_g_cm3: float
    effective_energy_keV: float
    points: tuple[tuple[float, float], ...]
    source: str

    @property
    def mu_per_mm(self) -> float:
        """Linear attenuation coefficient at the effective energy [1/mm]."""
        return self.mu_at(self.effective_energy_keV)

    def mu_at(self, energy_keV: float) -> float:
        """Linear attenuation coefficient at `energy_keV` [1/mm], log-log between the points.

        Raises:
            LimitError: the energy lies outside the table.
        """
        low, high = self.points[0][0], self.points[-1][0]
        if not low <= energy_keV <= high:
            raise LimitError(
                f"{self.name}: {energy_keV:g} keV is outside the table's [{low:g}, {high:g}] keV",
                {"asked": energy_keV, "allowed": [low, high], "unit": "keV"},
            )
        after = next(i for i, p in enumerate(self.points) if p[0] >= energy_keV)
        (e0, m0), (e1, m1) = self.points[max(after - 1, 0)], self.points[after]
        part = 0.0 if e1 == e0 else math.log(energy_keV / e0) / math.log(e1 / e0)
        mass = math.exp(math.log(m0) + part * math.log(m1 / m0))
        if energy_keV == e1:
            mass = m1
        return mass * self.density_g_cm3 / 10.0


@lru_cache
def materials() -> Mapping[str, Material]:
    """All bundled materials by name."""
    text = (resources.files("flexdt.phantoms") / "data" / "materials.toml").read_text("utf-8")
    document = tomllib.loads(text)
    return {
        name: Material(
            name,
            entry["label"],
            float(entry["density_g_cm3"]),
            float(document["effective_energy_keV"]),
            tuple((float(e), float(m)) for e, m in entry["points"]),
            document["source"],
        )
        for name, entry in document["material"].items()
    }


def material(name: str) -> Material:
    """The material called `name`.

    Raises:
        UnknownNameError: lists the materials there are.
    """
    table = materials()
    if name not in table:
        raise UnknownNameError(
            f"unknown material {name!r}; there are: {', '.join(table)}",
            {"asked": name, "allowed": list(table)},
        )
    return table[name]
