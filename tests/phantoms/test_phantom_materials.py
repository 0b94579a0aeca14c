"""Attenuation against values of the NIST tables, typed in by hand, and against xraydb."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest

from flexdt.phantoms import material, materials
from flexdt.phantoms.exposure_forecast import FILTERS
from flexdt.twin.attenuation.materials import density_findings
from flexdt.twin.attenuation.substances import Substance
from flexdt.twin.errors import LimitError, UnknownNameError
from flexdt.twin.plausibility import PlausibilityWarning

# NIST X-Ray Mass Attenuation Coefficients (Hubbell and Seltzer), mu/rho [cm2/g] by keV.
NIST = {
    "steel": {10: 170.6, 20: 25.68, 30: 8.176, 40: 3.629, 50: 1.958, 60: 1.205, 80: 0.5952,
              100: 0.3717, 150: 0.1964, 200: 0.1460},
    "aluminium": {10: 26.23, 20: 3.441, 30: 1.128, 40: 0.5685, 50: 0.3681, 60: 0.2778,
                  80: 0.2018, 100: 0.1704, 150: 0.1378, 200: 0.1223},
    "copper": {10: 215.9, 20: 33.79, 30: 10.92, 40: 4.862, 50: 2.613, 60: 1.593, 80: 0.7630,
               100: 0.4584, 150: 0.2217, 200: 0.1559},
    "water": {10: 5.329, 20: 0.8096, 30: 0.3756, 40: 0.2683, 50: 0.2269, 60: 0.2059,
              80: 0.1837, 100: 0.1707, 150: 0.1505, 200: 0.1370},
    "pmma": {40: 0.2350, 50: 0.2074, 60: 0.1924},
    "bone": {40: 0.6655, 50: 0.4242, 60: 0.3148},
    "air": {40: 0.2485, 50: 0.2080, 60: 0.1875},
}  # fmt: skip
# Handbook densities [g/cm3]: minerals, plastics, salts, metals, liquids and foams.
RIGHT = [
    "SiO2@2.65", "NaCl@2.165", "CaCO3@2.71", "Al2O3@3.98", "MgO@3.58", "ZrO2@5.68",
    "Fe2O3@5.24", "C2F4@2.2", "C2H4@0.95", "C8H8@1.05", "C6H11NO@1.14", "C16H14O3@1.2",
    "CsI@4.51", "Gd2O2S@7.32", "BaSO4@4.5", "Ca5(PO4)3OH@3.16", "H2O@0.917", "C2H6O@0.789",
    "C12H22O11@1.59", "LiF@2.64", "C@3.51", "C@1.7", "Au@19.3", "Pb@11.34", "Hg@13.53",
    "LiH@0.78", "Be@1.85", "W@19.25", "Os@22.59", "BN@3.45", "SiO2@4.29", "C8H8@0.015",
    "Al@0.3", "Fe@7.15", "N@0.00117", "Ar@0.00166", "Xe@0.0055", "Zr@6.52", "Ti6Al@4.4",
    "CaF2@3.18", "Y3Al5O12@4.56",
]  # fmt: skip


@pytest.mark.parametrize("name", NIST)
def test_materials_agree_with_nist(name: str) -> None:
    """Elam's tables and NIST's (XCOM) are two evaluations, which agree to 1 %."""
    m = material(name)
    for energy, expected in NIST[name].items():
        found = m.mu_at(energy) * 10 / m.density_g_cm3
        near = 2e-3 if energy in (40, 50, 60) else 1e-2
        assert found == pytest.approx(expected, rel=near), energy


@pytest.mark.parametrize("name", materials())
def test_materials_agree_with_xraydb_at_any_energy(name: str) -> None:
    xraydb = pytest.importorskip("xraydb")
    m = material(name)
    random = np.random.default_rng(len(name))
    edges = [
        edge.energy / 1e3
        for symbol, _ in m.fractions
        for edge in xraydb.xray_edges(symbol).values()
        if edge.energy > 2e3
    ]
    about = [e * (1 + d) for e in edges for d in (-1e-2, -1e-3, 1e-3, 1e-2)]
    for energy in (
        *random.uniform(5.0, 240.0, 30),
        *random.uniform(2.0, 20.0, 10),
        *about,
    ):
        theirs = sum(w * xraydb.mu_elam(s, energy * 1e3) for s, w in m.fractions)
        expected = theirs * m.density_g_cm3 / 10
        assert m.mu_at(energy) == pytest.approx(expected, rel=5e-4), energy


@pytest.mark.parametrize("energy", [3.0, 25.0, 69.4, 69.6, 120.0, 500.0])
def test_a_name_and_its_formula_are_one_material(energy: float) -> None:
    for name, formula in (
        ("water", "H2O@1"),
        ("pmma", "C5H8O2@1.19"),
        ("steel", "Fe@7.8"),
    ):
        assert material(name).mu_at(energy) == material(formula).mu_at(energy)


def test_all_materials_of_the_contract_are_there_and_labelled() -> None:
    wanted = {"abs", "pmma", "steel", "aluminium", "water", "air", "tungsten-carbide", "bone",
              "copper"}  # fmt: skip
    assert wanted <= set(materials())
    for m in materials().values():
        assert m.effective_energy_keV == 50.0
        assert m.mu_per_mm == m.mu_at(50.0)
        assert "literature" in m.source
        assert "Elam" in m.source
        assert sum(w for _, w in m.fractions) == pytest.approx(1.0, abs=2e-3)


def test_proposed_filters_are_of_the_list() -> None:
    assert {f.partition(":")[0] for f in FILTERS} - {""} <= set(materials())


@pytest.mark.parametrize("text", [*materials(), *RIGHT])
def test_a_right_density_is_taken_without_a_word(text: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert list(density_findings(material(text).substance)) == []


@pytest.mark.parametrize("text", RIGHT)
def test_a_density_wrong_by_orders_of_magnitude_is_noticed(text: str) -> None:
    """Gases may be compressed tenfold, and foams are a fortieth of their solid."""
    formula, _, density = text.partition("@")
    gas = float(density) < 0.01
    foam = text in ("C8H8@0.015", "Al@0.3")
    for factor in (1e-4, 1e-3, 10.0, 100.0, 1e3, 1e4):
        if (gas and factor < 1e3) or (foam and factor in (10.0, 100.0)):
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            with pytest.raises((LimitError, PlausibilityWarning), match="density"):
                material(f"{formula}@{factor * float(density) * 1.0001:.9g}")


def test_a_refused_density_says_how_the_formula_was_read() -> None:
    with pytest.raises(
        LimitError, match=r"density 8\.9 g/cm3 of C 42\.9 %, O 57\.1 %; allowed"
    ):
        material("CO@8.9")  # cobalt is Co
    for density in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(LimitError, match="density"):
            Substance.of("water", "H2O", density)


def test_energies_outside_the_tables_are_refused() -> None:
    with pytest.raises(
        LimitError,
        match=r"water: 0\.5 keV is outside the tables; allowed: \[1, 800\] keV",
    ):
        material("water").mu_at(0.5)
    with pytest.raises(LimitError, match="nan keV"):
        material("water").mu_at(math.nan)
    with pytest.raises(UnknownNameError, match="there are: abs"):
        material("ABS plastic")
