"""Attenuation of a substance at each photon energy, from its chemical formula and density.

Mixtures add up by mass fraction. An element without a shipped table is an error. `tables`
has the shipped attenuation by element, and tungsten spectra by kV, on one energy grid;
`docs/tools/physics_tables.py` made them, and their provenance travels inside the file.
They are read once; spectra work on their bins, and one energy by itself is interpolated
between edges.
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

from flexdt.twin.backends import backend
from flexdt.twin.errors import LimitError, UnknownNameError
from flexdt.twin.geometry.conventions import FloatArray

_TOKEN = re.compile(r"([A-Z][a-z]?|\(|\))(\d+(?:\.\d+)?)?")
MAX_DENSITY_G_CM3 = 25.0
"""Largest density that is accepted [g/cm3]; denser than any element."""
ABSORPTION_EXPONENT = -2.7
"""Exponent of an element's attenuation over energy where absorption outweighs scattering."""


@dataclass(frozen=True, eq=False)
class Tables:
    """The shipped tables; all arrays are read-only.

    Attributes:
        energy_keV: (e,) centres of the bins [keV].
        kV: (k,) tube voltages of the spectra, growing.
        fluence: (k, e) photons per cm2 and mAs in each bin, 1 m from a tungsten anode, no
            filter.
        elements: symbol -> row of `total`.
        molar_mass: (z,) [g/mol].
        total: (z, e) mass attenuation with coherent scattering [cm2/g].
        edges_keV: (z, n) absorption edges above 5 keV, growing, NaN where there are
            fewer.
        provenance: where the numbers come from.
    """

    energy_keV: FloatArray
    kV: FloatArray
    fluence: FloatArray
    elements: Mapping[str, int]
    molar_mass: FloatArray
    total: FloatArray
    edges_keV: FloatArray
    provenance: Mapping[str, str]


@lru_cache
def tables() -> Tables:
    """Load the shipped tables: energies [keV], tube spectra by kV, and molar mass,
    attenuation and edges by element, with their provenance.

    Later calls return the same value; its arrays are read-only.
    """
    arrays, provenance = stored_arrays("tables.npz")
    symbols = [str(s) for s in arrays["symbols"]]
    return Tables(
        arrays["energy_keV"],
        arrays["kV"],
        arrays["fluence"],
        {symbol: row for row, symbol in enumerate(symbols)},
        arrays["molar_mass"],
        arrays["total"],
        arrays["edges_keV"],
        provenance,
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

        The density is above 0 and at most `MAX_DENSITY_G_CM3`; each fraction is above 0;
        their sum may be off 1 by 0.002.

        Raises:
            LimitError: a value is not allowed.
            UnknownNameError: an element without tables.
        """
        if not 0.0 < (density := self.density_g_cm3) <= MAX_DENSITY_G_CM3:
            message = f"{self.name}: density {density:g} g/cm3"
            raise LimitError.instead(
                message, density, f"above 0 and at most {MAX_DENSITY_G_CM3:g}"
            )
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

    @property
    def parts(self) -> list[tuple[int, float]]:
        """Rows of its elements in the tables and mass fractions, which add up to 1 exactly."""
        total = sum(part for _, part in self.fractions)
        return [(_row(symbol), part / total) for symbol, part in self.fractions]

    @classmethod
    def of(cls, name: str, formula: str, density_g_cm3: float) -> Substance:
        """Make a chemical compound from formula and density, e.g. Substance.of("water",
        "H2O", 1.0).

        Raises:
            UnknownNameError: an element the table does not have.
            LimitError: a formula that cannot be read, or an impossible density.
        """
        return cls(
            name, tuple(mass_fractions(parse_formula(formula)).items()), density_g_cm3
        )

    @classmethod
    def parse(cls, text: str) -> Substance:
        """Parse a substance written FORMULA@DENSITY [g/cm3], such as Al@2.70.

        Spaces around the formula are ignored; the substance's name is the whole text.

        Raises:
            UnknownNameError: as `of`.
            LimitError: as `of`, or the density is missing or no number.
        """
        formula, _, density = text.partition("@")
        try:
            value = float(density)
        except ValueError:
            allowed = "FORMULA@DENSITY (g/cm3), such as Cu@8.96"
            raise LimitError.instead(f"material {text!r}", text, allowed) from None
        return cls.of(text, formula.strip(), value)

    @classmethod
    def called(cls, text: str) -> Substance:
        """Look up a substance by the name of a sample's material, such as aluminium; a
        text with @ is parsed as FORMULA@DENSITY.

        The text with @ is the substance's name then.

        Raises:
            UnknownNameError: lists the materials there are; or an element without a
                table.
            LimitError: as `parse`.

        Example:
            >>> Substance.called("copper").density_g_cm3, Substance.called("Al@2.70").name
            (8.96, 'Al@2.70')
        """
        if "@" in text:
            return cls.parse(text)
        substance: Substance = backend("materials").material(text).substance
        return substance

    def mass_attenuation(self) -> FloatArray:
        """Compute mu/rho at the energies of the tables, (e,) [cm2/g]."""
        return np.asarray(sum(part * tables().total[row] for row, part in self.parts))

    def attenuation(self) -> FloatArray:
        """Compute the linear attenuation coefficient at the energies of the
        tables, (e,) [1/mm]."""
        return self.mass_attenuation() * (self.density_g_cm3 / 10.0)

    def attenuation_at(self, energy_keV: float) -> float:
        """Interpolate the linear attenuation coefficient at one energy [1/mm], within the
        same absorption edges.
        """
        mu = sum(part * _mass_at(row, energy_keV) for row, part in self.parts)
        return float(mu * self.density_g_cm3 / 10.0)


def _mass_at(row: int, energy_keV: float) -> float:
    """Interpolate mu/rho of an element log-log from the two nearest bins that no
    absorption edge separates from the energy.

    With one such bin the slope is `ABSORPTION_EXPONENT`; without any the nearest bin is
    used, with that slope. Energies beyond the bins are extrapolated.

    Args:
        row: of the element in the tables.
        energy_keV: photon energy.

    Returns:
        mu/rho [cm2/g].
    """
    bins = tables().energy_keV
    edges = tables().edges_keV[row]
    total = tables().total[row]
    alike = np.searchsorted(edges, bins, "right") == np.searchsorted(
        edges, energy_keV, "right"
    )
    away = np.abs(bins - energy_keV)
    near, far = np.argsort(np.where(alike, away, np.inf) if alike.any() else away)[:2]
    slope = ABSORPTION_EXPONENT  # if there is only one bin between two edges
    if alike[near] and alike[far]:
        slope = math.log(total[far] / total[near]) / math.log(bins[far] / bins[near])
    return float(total[near] * (energy_keV / bins[near]) ** slope)


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
    """Compute the mass fractions of a compound's elements from its numbers of atoms.

    Args:
        atoms: symbol -> number of atoms, above 0.

    Returns:
        symbol -> fraction, in the same order; they add up to 1.

    Raises:
        UnknownNameError: the tables lack an element.
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
