"""Attenuation against values of the NIST tables, typed in by hand."""

from __future__ import annotations

from itertools import pairwise

import pytest

from flexdt.phantoms import Material, material, materials
from flexdt.twin.attenuation.substances import tables
from flexdt.twin.errors import LimitError, UnknownNameError

# NIST X-Ray Mass Attenuation Coefficients, mu/rho [cm2/g] at (40, 50, 60) keV.
NIST = {
    "steel": (3.629, 1.958, 1.205),
    "aluminium": (0.5685, 0.3681, 0.2778),
    "copper": (4.862, 2.613, 1.593),
    "water": (0.2683, 0.2269, 0.2059),
    "pmma": (0.2350, 0.2074, 0.1924),
    "bone": (0.6655, 0.4242, 0.3148),
    "air": (0.2485, 0.2080, 0.1875),
}


@pytest.mark.parametrize("name", NIST)
def test_the_table_agrees_with_nist(name: str) -> None:
    m = material(name)
    for energy, expected in zip((40.0, 50.0, 60.0), NIST[name], strict=True):
        assert m.mu_at(energy) * 10 / m.density_g_cm3 == pytest.approx(expected, rel=2e-3)


def test_all_materials_of_the_contract_are_there_and_labelled() -> None:
    wanted = {"abs", "pmma", "steel", "aluminium", "water", "air", "tungsten-carbide", "bone",
              "copper"}  # fmt: skip
    assert wanted <= set(materials())
    for m in materials().values():
        assert m.effective_energy_keV == 50.0
        assert m.mu_per_mm == pytest.approx(m.mu_at(50.0))
        assert "literature" in m.source
        energies = [e for e, _ in m.points]
        assert energies == sorted(set(energies))


def edges_keV(m: Material) -> list[float]:
    """The absorption edges of its elements within its table [keV]."""
    every = [tables().edges_keV[tables().elements[symbol]] for symbol, _ in m.fractions]
    return [e for row in every for e in row.tolist() if 20.0 < e < 100.0]


@pytest.mark.parametrize("name", materials())
def test_the_points_are_those_of_the_composition(name: str) -> None:
    m = material(name)
    assert [m.points[0][0], m.points[-1][0]] == [20.0, 100.0]
    made_of = m.substance
    for energy, mass in m.points:
        expected = made_of.attenuation_at(energy) * 10.0 / m.density_g_cm3
        assert mass == pytest.approx(expected, rel=1e-3), energy


@pytest.mark.parametrize("name", materials())
def test_attenuation_falls_with_energy_but_for_the_edges_of_elements(name: str) -> None:
    m = material(name)
    for low, high in pairwise(range(20, 101)):
        if not any(low <= edge <= high for edge in edges_keV(m)):
            assert m.mu_at(low) > m.mu_at(high), low
    for edge in edges_keV(m):
        below = max(e for e, _ in m.points if e <= edge)
        above = min(e for e, _ in m.points if e > edge)
        assert above - below <= 1.0, f"two close points about {edge:g} keV"
        assert m.mu_at(above) > m.mu_at(below)


def test_tungsten_has_its_edge() -> None:
    wc = material("tungsten-carbide")
    assert len(edges_keV(wc)) == 1
    assert wc.mu_at(70.0) > 4 * wc.mu_at(69.0)


def test_between_the_points_it_follows_nist_45_keV() -> None:
    # Iron at 45 keV by log-log between NIST's 40 and 50 keV.
    expected = 3.629 * (1.958 / 3.629) ** (0.5278)  # ln(45/40) / ln(50/40) = 0.5278
    assert material("steel").mu_at(45.0) == pytest.approx(expected * 0.78, rel=1e-3)


def test_no_extrapolation_and_no_guessing() -> None:
    with pytest.raises(
        LimitError, match=r"10 keV is outside the table's \[20, 100\] keV"
    ):
        material("water").mu_at(10.0)
    with pytest.raises(UnknownNameError, match="there are: abs"):
        material("ABS plastic")
