"""Attenuation of a substance at each photon energy, from its composition and density.

Mixtures add up by mass fraction. An element without a shipped table is an error. `tables` has
what ships: tube spectra by kV on one grid of energies, and the attenuation of the elements
between nodes, straight lines on logarithmic axes (xraydb's Elam tables within 1e-4, edges
included), so one energy by itself is as exact as the bins of a spectrum.
`docs/tools/physics_tables.py` made both files, whose provenance travels inside them.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources

import numpy as np

from flexdt.twin.errors import LimitError, UnknownNameError
from flexdt.twin.geometry.conventions import FloatArray

_TOKEN = re.compile(r"([A-Z][a-z]?|\(|\))(\d+(?:\.\d+)?)?")
MAX_DENSITY_G_CM3 = 25.0
"""Largest density that is accepted [g/cm3]; denser than any element."""
MAX_PACKING = 3.5
"""Largest density of a compound over that of its elements side by side, liquid or solid; the
densest at ordinary pressure have 3.0 (cubic boron nitride), 2.9 (stishovite), 2.4 (water)."""


@dataclass(frozen=True, eq=False)
class Tables:
    """The shipped tables; all arrays are read-only.

    Attributes:
        energy_keV: (e,) centers of the bins of spectra [keV].
        kV: (k,) tube voltages of the spectra, growing.
        fluence: (k, e) photons per cm2 and mAs in each bin, 1 m from a tungsten anode, no
            filter.
        elements: symbol -> row of `total`.
        molar_mass: (z,) [g/mol].
        packed_g_cm3: (z,) density of the element as a solid, of gases as a liquid.
        nodes: of each element logarithms of energies [keV] and mass attenuation with
            coherent scattering [cm2/g], (2, n); an absorption edge has two nodes.
        total: (z, e) mass attenuation at the bins [cm2/g].
        provenance: where the numbers come from.
    """

    energy_keV: FloatArray
    kV: FloatArray
    fluence: FloatArray
    elements: Mapping[str, int]
    molar_mass: FloatArray
    packed_g_cm3: FloatArray
    nodes: tuple[FloatArray, ...]
    total: FloatArray
    provenance: Mapping[str, str]

    @property
    def range_keV(self) -> tuple[float, float]:
        """Lowest and highest energy of the elements' attenuation [keV]."""
        logs = self.nodes[0][0]
        return round(math.exp(logs[0]), 3), round(math.exp(logs[-1]), 3)


@lru_cache
def tables() -> Tables:
    """Load the shipped tables: energies [keV], tube spectra by kV, and molar mass, density
    and attenuation by element, with their provenance.

    Later calls return the same value; its arrays are read-only.
    """
    spectra, of_spectra = stored_arrays("spectra.npz")
    elements, of_elements = stored_arrays("elements.npz")
    logs = np.log([elements["node_keV"], elements["node_cm2_g"]])
    ends = np.cumsum(elements["node_counts"]).astype(int)[:-1]
    nodes = tuple(np.split(logs, ends, axis=1))
    bins = np.log(spectra["energy_keV"])
    total = np.exp([np.interp(bins, *of_one) for of_one in nodes])
    logs.flags.writeable = total.flags.writeable = False
    return Tables(
        spectra["energy_keV"],
        spectra["kV"],
        spectra["fluence"],
        {str(symbol): row for row, symbol in enumerate(elements["symbols"])},
        elements["molar_mass"],
        elements["packed_g_cm3"],
        nodes,
        total,
        {**of_spectra, **of_elements},
    )


def stored_arrays(file: str) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Load the arrays of a file of this package by name, read-only, numbers as float64;
    texts stay texts.

    The entry "provenance" is parsed as JSON and is not among the arrays.

    Args:
        file: its name in the package's folder `data`.

    Returns:
        (name -> array, provenance).
    """
    with (
        (resources.files("flexdt.twin.attenuation") / "data" / file).open(
            "rb"
        ) as content,
        np.load(content, allow_pickle=False) as stored,
    ):
        arrays = {
            name: stored[name].astype(np.float64)
            if stored[name].dtype.kind in "iuf"
            else stored[name]
            for name in stored.files
        }
    for array in arrays.values():
        array.flags.writeable = False
    return arrays, json.loads(str(arrays.pop("provenance")))


@dataclass(frozen=True)
class Substance:
    """A homogeneous substance.

    Attributes:
        name: for people and for channels of path lengths.
        fractions: (symbol, mass fraction), adding up to 1.
        density_g_cm3: density.
    """

    name: str
    fractions: tuple[tuple[str, float], ...]
    density_g_cm3: float

    def __post_init__(self) -> None:
        """Check density, mass fractions and elements.

        The density is above 0, and at most `MAX_DENSITY_G_CM3` and `MAX_PACKING` times
        that of the packed elements; each fraction is above 0; their sum may be off 1 by
        0.002.

        Raises:
            LimitError: a value is not allowed.
            UnknownNameError: an element without tables.
        """
        for symbol, part in self.fractions:
            _row(symbol)
            if not part > 0.0:
                message = f"{self.name}: mass fraction {part:g} of {symbol}"
                raise LimitError.instead(message, part, "above 0")
        total = sum(part for _, part in self.fractions)
        if not math.isclose(total, 1.0, abs_tol=2e-3):
            raise LimitError.instead(
                f"{self.name}: mass fractions add up to {total:g}", total, 1.0
            )
        density = self.density_g_cm3
        most = min(MAX_PACKING * self.packed_g_cm3, MAX_DENSITY_G_CM3)
        if not 0.0 < density <= most:
            made_of = ", ".join(f"{s} {100 * w:.3g} %" for s, w in self.fractions)
            message = f"{self.name}: density {density:g} g/cm3 of {made_of}"
            raise LimitError.instead(message, density, f"above 0 and at most {most:.3g}")

    @property
    def packed_g_cm3(self) -> float:
        """Density of its elements side by side, as solids or liquids [g/cm3]."""
        volume = sum(part / tables().packed_g_cm3[row] for row, part in self.parts)
        return float(1.0 / volume)

    @property
    def parts(self) -> list[tuple[int, float]]:
        """Rows of its elements in the tables and mass fractions, which add up to 1 exactly."""
        total = sum(part for _, part in self.fractions)
        return [(_row(symbol), part / total) for symbol, part in self.fractions]

    @classmethod
    def of(cls, name: str, formula: str, density_g_cm3: float) -> Substance:
        """Make a chemical compound from formula and density, e.g. Substance.of("water", "H2O",
        1.0). Raises UnknownNameError: an element the table does not have; LimitError: a formula
        that cannot be read, or an impossible density."""
        return cls(
            name, tuple(mass_fractions(parse_formula(formula)).items()), density_g_cm3
        )

    @classmethod
    def parse(cls, text: str) -> Substance:
        """Parse a substance written FORMULA@DENSITY [g/cm3], such as Al@2.70.

        Spaces around the formula are ignored; the substance's name is the whole text.

        Raises UnknownNameError: as `of`; LimitError: as `of`, or the density is missing or no
        number.
        """
        formula, _, density = text.partition("@")
        try:
            value = float(density)
        except ValueError:
            allowed = "FORMULA@DENSITY (g/cm3), such as Cu@8.96"
            raise LimitError.instead(f"material {text!r}", text, allowed) from None
        return cls.of(text, formula.strip(), value)

    def mass_attenuation(self) -> FloatArray:
        """Compute mu/rho at the energies of the tables, (e,) [cm2/g]."""
        return np.asarray(sum(part * tables().total[row] for row, part in self.parts))

    def attenuation(self) -> FloatArray:
        """Compute attenuation at the tables' energies, (e,) [1/mm]."""
        return self.mass_attenuation() * (self.density_g_cm3 / 10.0)

    def attenuation_at(self, energy_keV: float) -> float:
        """Compute the linear attenuation coefficient at one energy [1/mm].

        Raises:
            LimitError: the energy is outside the elements' tables.
        """
        low, high = tables().range_keV
        if not low <= energy_keV <= high:
            message = f"{self.name}: {energy_keV:g} keV is outside the tables"
            raise LimitError.instead(message, energy_keV, f"[{low:g}, {high:g}] keV")
        at = math.log(energy_keV)
        nodes = tables().nodes
        mu = sum(part * math.exp(np.interp(at, *nodes[row])) for row, part in self.parts)
        return float(mu * self.density_g_cm3 / 10.0)


def parse_formula(formula: str) -> dict[str, float]:
    """Parse a chemical formula to symbol -> number of atoms; parentheses and decimal
    counts are allowed.

    Repeated elements are added up. An element or group without a count counts once. Counts
    must be above 0, parentheses closed and the formula not empty.

    Args:
        formula: such as CaSO4(H2O)2.

    Raises:
        LimitError: it cannot be read; names the character, counted from 1.
        UnknownNameError: an element the table does not have.
    """
    levels: list[dict[str, float]] = [{}]
    at = 0
    while at < len(formula):
        match = _TOKEN.match(formula, at)
        if match is None or (match[1] == "(" and match[2]):
            raise _unreadable(formula, at)
        symbol = match[1]
        if match[2] is None:
            count = 1.0
        else:
            count = float(match[2])
        if symbol == "(":
            levels.append({})
        elif symbol == ")":
            if len(levels) == 1:
                raise _unreadable(formula, at)
            for inner, n in levels.pop().items():
                levels[-1][inner] = levels[-1].get(inner, 0.0) + n * count
        else:
            _row(symbol)
            levels[-1][symbol] = levels[-1].get(symbol, 0.0) + count
        at = match.end()
    if len(levels) != 1 or not levels[0] or not all(n > 0 for n in levels[0].values()):
        raise _unreadable(formula, at)
    return levels[0]


def mass_fractions(atoms: Mapping[str, float]) -> dict[str, float]:
    """Compute the mass fractions of a compound from its elements' numbers of atoms.

    They add up to 1. Raises UnknownNameError: the tables lack an element.
    """
    masses = {
        symbol: n * float(tables().molar_mass[_row(symbol)])
        for symbol, n in atoms.items()
    }
    total = sum(masses.values())
    return {symbol: mass / total for symbol, mass in masses.items()}


def _row(symbol: str) -> int:
    """Return an element's row of the tables, by its symbol (case matters).

    Raises:
        UnknownNameError: the tables lack the element.
    """
    elements = tables().elements
    if symbol not in elements:
        message = f"no element {symbol!r} in the attenuation table; it has"
        raise UnknownNameError.among(message, symbol, elements)
    return elements[symbol]


def _unreadable(formula: str, at: int) -> LimitError:
    """Make, but not raise, the error for a formula that cannot be parsed at character `at`.

    `at` counts from 0; the message counts from 1.
    """
    allowed = (
        "element symbols with counts and parentheses, such as C15H17N or Ca5(PO4)3OH"
    )
    message = f"formula {formula!r} cannot be read at character {at + 1}"
    return LimitError.instead(message, formula, allowed, at=at)
