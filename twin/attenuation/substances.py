"""Attenuation of a substance at each photon energy, from its chemical formula and density.

Mixtures add up by mass fraction. An element without a shipped table is an error.

The shipped tables: tungsten spectra by kV and attenuation by element, on one energy grid.

`docs/tools/physics_tables.py` made them; their provenance travels inside the file. They are read
once and never interpolated in energy: everything else works on the same bins.

How substances scatter X-rays: differential cross-sections of independent atoms, from tables.

Coherent (Rayleigh) scattering is Thomson's times the square of the form factor F(x), incoherent
(Compton) scattering Klein and Nishina's (Z. Phys. 52 (1929) 853) times the incoherent scattering
function S(x); x = sin(theta / 2) / lambda [1/A]. F and S are Hubbell's (J. Phys. Chem. Ref. Data 4
(1975) 471 and 8 (1979) 69) by way of EPDL97 and xraylib; `docs/tools/scattering_tables.py` made the
file. The atoms of a compound scatter independently here: the interference between neighbouring
atoms, which shapes coherent scattering below x = 0.3 in liquids, plastics and metals, is left out.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources

import numpy as np

from flexdt.twin.errors import LimitError, UnknownNameError
from flexdt.twin.geometry.conventions import FloatArray


@dataclass(frozen=True, eq=False)
class Tables:
    """All arrays are read-only.

    Attributes:
        energy_keV: (e,) centres of the bins [keV].
        kV: (k,) tube voltages of the spectra, growing.
        fluence: (k, e) photons per cm2 and mAs in each bin, 1 m from a tungsten anode, no filter.
        elements: symbol -> row of `total`.
        molar_mass: (z,) [g/mol].
        total: (z, e) mass attenuation with coherent scattering [cm2/g].
        photoelectric: symbol -> (e,) photoelectric part [cm2/g]; caesium and iodine only.
        provenance: where the numbers come from.
    """

    energy_keV: FloatArray
    kV: FloatArray
    fluence: FloatArray
    elements: Mapping[str, int]
    molar_mass: FloatArray
    total: FloatArray
    photoelectric: Mapping[str, FloatArray]
    provenance: Mapping[str, str]


@lru_cache
def tables() -> Tables:
    """The shipped tables."""
    with (
        (resources.files("flexdt.twin.attenuation") / "data" / "tables.npz").open("rb") as file,
        np.load(file, allow_pickle=False) as stored,
    ):
        arrays = {
            name: _frozen(stored[name])
            for name in ("energy_keV", "kV", "fluence", "molar_mass", "total", "photo_Cs_I")
        }
        symbols = [str(s) for s in stored["symbols"]]
        provenance: dict[str, str] = json.loads(str(stored["provenance"]))
    photo = arrays["photo_Cs_I"]
    return Tables(
        arrays["energy_keV"],
        arrays["kV"],
        arrays["fluence"],
        {symbol: row for row, symbol in enumerate(symbols)},
        arrays["molar_mass"],
        arrays["total"],
        {"Cs": photo[0], "I": photo[1]},
        provenance,
    )


def _frozen(values: FloatArray) -> FloatArray:
    out: FloatArray = np.array(values, dtype=np.float64)
    out.flags.writeable = False
    return out


_TOKEN = re.compile(r"([A-Z][a-z]?|\(|\))(\d+(?:\.\d+)?)?")
HIGHEST_DENSITY = 25.0
"""Denser than any element [g/cm3]."""


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
        if not 0.0 < self.density_g_cm3 <= HIGHEST_DENSITY:
            raise LimitError(
                f"{self.name}: density {self.density_g_cm3:g} g/cm3; allowed: above 0 and at most "
                f"{HIGHEST_DENSITY:g}",
                {"asked": self.density_g_cm3, "allowed": [0.0, HIGHEST_DENSITY]},
            )
        for symbol, part in self.fractions:
            _row(symbol)
            if not part > 0.0:
                raise LimitError(
                    f"{self.name}: mass fraction {part:g} of {symbol}; it must be positive",
                    {"asked": part, "allowed": "> 0"},
                )
        whole = sum(part for _, part in self.fractions)
        if not math.isclose(whole, 1.0, abs_tol=2e-3):
            raise LimitError(
                f"{self.name}: mass fractions add up to {whole:g}, not 1",
                {"asked": whole, "allowed": 1.0},
            )

    @classmethod
    def of(cls, name: str, formula: str, density_g_cm3: float) -> Substance:
        """A chemical compound, e.g. Substance.of("water", "H2O", 1.0).

        Raises:
            UnknownNameError: an element the table does not have.
            LimitError: a formula that cannot be read, or an impossible density.
        """
        return cls(name, tuple(mass_fractions(parse_formula(formula)).items()), density_g_cm3)

    @classmethod
    def parse(cls, text: str) -> Substance:
        """A substance written FORMULA@DENSITY [g/cm3], such as Al@2.70.

        Raises:
            UnknownNameError, LimitError: as `of`, or it is not written so.
        """
        formula, at, density = text.partition("@")
        try:
            value = float(density)
        except ValueError:
            why = (
                f": {density!r} is no density in g/cm3"
                if at
                else " is not FORMULA@DENSITY (g/cm3), such as Cu@8.96"
            )
            asked = {"asked": text, "allowed": "FORMULA@DENSITY"}
            raise LimitError(f"material {text!r}{why}", asked) from None
        return cls.of(text, formula.strip(), value)

    def mass_attenuation(self) -> FloatArray:
        """mu/rho at the energies of the tables, (e,) [cm2/g]."""
        whole = sum(part for _, part in self.fractions)
        mu = sum(part / whole * tables().total[_row(symbol)] for symbol, part in self.fractions)
        return np.asarray(mu)

    def attenuation(self) -> FloatArray:
        """Linear attenuation coefficient at the energies of the tables, (e,) [1/mm]."""
        return self.mass_attenuation() * (self.density_g_cm3 / 10.0)


def parse_formula(formula: str) -> dict[str, float]:
    """Atoms of a formula: symbol -> number. Parentheses and decimal counts are allowed.

    Raises:
        LimitError: it cannot be read; says where.
        UnknownNameError: an element the table does not have.
    """
    levels: list[dict[str, float]] = [{}]
    at = 0
    while at < len(formula):
        match = _TOKEN.match(formula, at)
        if match is None or (match[1] == "(" and match[2]):
            raise _unreadable(formula, at)
        symbol, count = match[1], 1.0 if match[2] is None else float(match[2])
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
    """Mass fractions of a compound from its numbers of atoms."""
    masses = {symbol: n * float(tables().molar_mass[_row(symbol)]) for symbol, n in atoms.items()}
    whole = sum(masses.values())
    return {symbol: mass / whole for symbol, mass in masses.items()}


def _row(symbol: str) -> int:
    elements = tables().elements
    if symbol not in elements:
        raise UnknownNameError(
            f"no element {symbol!r} in the attenuation table; it has: {', '.join(elements)}",
            {"asked": symbol, "allowed": list(elements)},
        )
    return elements[symbol]


def _unreadable(formula: str, at: int) -> LimitError:
    return LimitError(
        f"formula {formula!r} cannot be read at character {at + 1}; allowed: element symbols with "
        "counts and parentheses, such as C15H17N or Ca5(PO4)3OH",
        {"asked": formula, "at": at},
    )


RADIUS2_BARN = 0.079407877
"""Square of the classical electron radius [barn]."""
HC_KEV_A = 12.39841984
"""Photon energy times wavelength [keV A]."""
ELECTRON_KEV = 510.99895
"""Rest energy of the electron [keV]."""
AVOGADRO_BARN = 0.602214076
"""Avogadro's number times a barn [cm2/mol]."""


@dataclass(frozen=True, eq=False)
class ScatteringTables:
    """All arrays are read-only.

    Attributes:
        x: (q,) momentum transfer sin(theta / 2) / lambda [1/A]; its square root grows evenly.
        form_factor, incoherent: (92, q) F and S of an atom, by atomic number from 1.
        provenance: where the numbers come from.
    """

    x: FloatArray
    form_factor: FloatArray
    incoherent: FloatArray
    provenance: Mapping[str, str]


@lru_cache
def scattering_tables() -> ScatteringTables:
    """The shipped tables."""
    with (
        (resources.files("flexdt.twin.attenuation") / "data" / "scattering.npz").open("rb") as file,
        np.load(file, allow_pickle=False) as stored,
    ):
        names = ("x", "form_factor", "incoherent")
        arrays = [np.array(stored[name], dtype=np.float64) for name in names]
        provenance: dict[str, str] = json.loads(str(stored["provenance"]))
    for array in arrays:
        array.flags.writeable = False
    return ScatteringTables(arrays[0], arrays[1], arrays[2], provenance)


@dataclass(frozen=True, eq=False)
class CrossSections:
    """What scatter simulations need of m substances, each at its own density.

    Attributes:
        energy_keV: (e,) evenly spaced energies of `total`, `coherent` and `incoherent` [keV].
        total: (m, e) linear attenuation coefficient [1/mm], of the attenuation tables.
        coherent, incoherent: (m, e) integrals of the differential cross-sections [1/mm].
        root_step: step of the square root of x between the columns of the next three [1/A^(1/2)].
        form: (m, q) F^2 summed over the atoms in a mm times the squared electron radius [1/mm].
        shell: (m, q) S, likewise.
        cumulated: (m, q) integral of `form` over x^2, from which angles are drawn.
    """

    energy_keV: FloatArray
    total: FloatArray
    coherent: FloatArray
    incoherent: FloatArray
    root_step: float
    form: FloatArray
    shell: FloatArray
    cumulated: FloatArray


def cross_sections(substances: Sequence[Substance]) -> CrossSections:
    """Cross-sections of substances at their densities.

    Args:
        substances: m materials, at least one.

    Example:
        >>> water = cross_sections([Substance.of("water", "H2O", 1.0)])
        >>> at = int(np.searchsorted(water.energy_keV, 60.0))
        >>> round(float(water.incoherent[0, at]), 4)  # XCOM: 0.0177 1/mm
        0.0177
    """
    stored, attenuation = scattering_tables(), tables()
    energy = attenuation.energy_keV
    form, shell = np.zeros((2, len(substances), len(stored.x)))
    for m, one in enumerate(substances):
        whole = sum(part for _, part in one.fractions)
        for symbol, part in one.fractions:
            row = attenuation.elements[symbol]
            atoms = (
                part
                / whole
                / attenuation.molar_mass[row]
                * AVOGADRO_BARN
                * one.density_g_cm3
                / 10.0
            )
            form[m] += atoms * RADIUS2_BARN * stored.form_factor[row] ** 2
            shell[m] += atoms * RADIUS2_BARN * stored.incoherent[row]
    rings = np.diff(stored.x**2) * (form[:, 1:] + form[:, :-1]) / 2.0
    cumulated = np.concatenate([np.zeros((len(form), 1)), np.cumsum(rings, axis=1)], axis=1)
    # Integrals over the sphere, in w = sin(theta / 2)^(1/2): the forward peak is broad there.
    points, weights = np.polynomial.legendre.leggauss(160)
    w, dw = (points + 1.0) / 2.0, weights / 2.0
    cosine, ring = 1.0 - 2.0 * w**4, 2.0 * np.pi * 8.0 * w**3 * dw
    root_step = float(np.sqrt(stored.x[1]))
    column = np.sqrt(energy[:, None] / HC_KEV_A) * w / root_step
    index = np.arange(len(stored.x))
    k = 1.0 / (1.0 + energy[:, None] / ELECTRON_KEV * (1.0 - cosine))
    thomson = 0.5 * (1.0 + cosine**2) * ring
    klein_nishina = 0.5 * k**2 * (k + 1.0 / k - 1.0 + cosine**2) * ring
    coherent = [(np.interp(column, index, row) * thomson).sum(axis=1) for row in form]
    incoherent = [(np.interp(column, index, row) * klein_nishina).sum(axis=1) for row in shell]
    total = [one.attenuation() for one in substances]
    return CrossSections(
        energy,
        np.array(total),
        np.array(coherent),
        np.array(incoherent),
        root_step,
        form,
        shell,
        cumulated,
    )
