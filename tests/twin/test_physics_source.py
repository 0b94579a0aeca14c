"""Spectra and attenuation against figures that other packages and tables state."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flexdt.twin.attenuation.substances import (
    Substance,
    mass_fractions,
    parse_formula,
    tables,
)
from flexdt.twin.errors import LimitError, UnknownNameError
from flexdt.twin.physics.tube import (
    ALUMINIUM,
    Filter,
    Spectrum,
    TubeModel,
    monochromatic,
    tube_spectrum,
)


@pytest.mark.parametrize(
    ("formula", "density", "values"),
    [  # mu/rho [cm2/g] at 30, 60, 90 keV: published figures, rounded as they are there
        ("C15H17N", 1.05, (0.268, 0.188, 0.168)),
        ("Al", 2.7, (1.128, 0.278, 0.183)),
        ("Fe", 7.8, (8.18, 1.205, 0.460)),
        ("CsI", 4.51, (9.05, 7.92, 2.69)),
    ],
)
def test_attenuation_of_known_substances(formula, density, values):
    substance = Substance.of("x", formula, density)
    found = np.interp(
        [30.0, 60.0, 90.0], tables().energy_keV, substance.mass_attenuation()
    )
    np.testing.assert_allclose(found, values, rtol=4e-3)
    np.testing.assert_allclose(
        substance.attenuation(), substance.mass_attenuation() * density / 10.0
    )


def test_formulas():
    assert parse_formula("Ca5(PO4)3OH") == {"Ca": 5, "P": 3, "O": 13, "H": 1}
    assert parse_formula("C0.5O") == {"C": 0.5, "O": 1}
    water = mass_fractions({"H": 2, "O": 1})
    assert water["H"] == pytest.approx(2 * 1.008 / 18.015, rel=1e-3)


@pytest.mark.parametrize(
    "formula", ["", "h2o", "H2O)", "(H2O", "C-1", "H2 O", "2H", "()", "C0"]
)
def test_formulas_that_cannot_be_read(formula):
    with pytest.raises(LimitError, match="formula"):
        parse_formula(formula)


def test_unknown_element_lists_the_known_ones():
    with pytest.raises(UnknownNameError, match="Xx") as caught:
        parse_formula("H2Xx")
    assert "Fe" in caught.value.data["allowed"]


def test_impossible_substances():
    with pytest.raises(LimitError, match="density"):
        Substance.of("x", "H2O", 0.0)
    with pytest.raises(LimitError, match="add up"):
        Substance("x", (("H", 0.5),), 1.0)


def half_value_layer(spectrum: Spectrum) -> float:
    """mm of aluminium that halve the air kerma, weighted with mu_en of air ~ E x mu_en/rho."""
    # mu_en/rho of dry air [cm2/g], NIST
    energy = [5, 6, 8, 10, 15, 20, 30, 40, 50, 60, 80, 100]
    absorbed = [39.3, 22.7, 9.45, 4.742, 1.334, 0.5389, 0.1537, 0.06833, 0.04098, 0.03041, 0.02407,
                0.02325]  # fmt: skip
    e = spectrum.energy_keV
    weight = e * np.exp(np.interp(np.log(e), np.log(energy), np.log(absorbed)))
    whole = spectrum.fluence @ weight
    low, high = 0.0, 20.0
    for _ in range(60):
        middle = (low + high) / 2
        kerma = spectrum.behind(Filter(ALUMINIUM, middle)).fluence @ weight
        low, high = (middle, high) if kerma > whole / 2 else (low, middle)
    return low


def test_spectrum_at_90_kv():
    # spekpy 2.5.4 for 90 kV, 12 degrees, 0.5 mm Al: mean 39.5 keV, 3.37e8 photons/cm2/mAs at 1
    # m, first half-value layer 0.98 mm Al
    spectrum = tube_spectrum(90.0)
    assert spectrum.mean_keV == pytest.approx(39.5, abs=0.15)
    assert spectrum.photons == pytest.approx(3.37e8, rel=0.01)
    assert half_value_layer(spectrum) == pytest.approx(0.98, rel=0.03)
    assert spectrum.fluence[spectrum.energy_keV > 90.0].sum() == 0.0
    # characteristic lines of tungsten stand out
    at = np.argmin(np.abs(spectrum.energy_keV - 59.25))
    assert spectrum.fluence[at] > 2 * spectrum.fluence[at + 4]


@pytest.mark.parametrize(
    ("formula", "energy_keV", "mass"),
    [  # Elam, Ravel and Sieber (2002) by xraydb, total with coherent scattering [cm2/g]
        ("Cu", 50.0, 2.613), ("Fe", 60.0, 1.205), ("Pb", 100.0, 5.553), ("Al", 20.0, 3.442),
    ],
)  # fmt: skip
def test_one_energy_is_not_that_of_a_bin(
    formula: str, energy_keV: float, mass: float
) -> None:
    found = 10.0 * Substance.of(formula, formula, 1.0).attenuation_at(energy_keV)
    assert found == pytest.approx(mass, rel=2e-3)


def test_one_energy_is_on_its_own_side_of_an_edge() -> None:
    xraydb = pytest.importorskip("xraydb")
    random = np.random.default_rng(3)
    for symbol in ("Gd", "W", "I", "Pb", "U", "Mo", "Fe", "C", "Ba"):
        edges = [
            e.energy / 1e3 for e in xraydb.xray_edges(symbol).values() if e.energy > 15e3
        ]
        near = [e + d for e in edges for d in (-0.2, -0.01, 0.01, 0.2)]
        for energy in (*near, *random.uniform(20.0, 235.0, 40)):
            found = 10.0 * Substance.of(symbol, symbol, 1.0).attenuation_at(energy)
            assert found == pytest.approx(xraydb.mu_elam(symbol, energy * 1e3), rel=5e-4)


def test_voltages_between_the_tables():
    between, low, high = (tube_spectrum(kV) for kV in (67.5, 67.0, 68.0))
    np.testing.assert_allclose(
        between.fluence, (low.fluence + high.fluence) / 2, rtol=1e-9
    )
    with pytest.raises(LimitError, match="is 250;"):
        tube_spectrum(250.0)
    with pytest.raises(LimitError):
        monochromatic(1.0)


def test_filters_harden():
    soft, hard = (
        tube_spectrum(90.0, TubeModel(filters=(Filter(ALUMINIUM, t),)))
        for t in (0.5, 2.0)
    )
    assert hard.mean_keV > soft.mean_keV + 5
    assert hard.photons < soft.photons
    mono = monochromatic(50.2)
    assert mono.behind(Filter(ALUMINIUM, 3.0)).photons == pytest.approx(
        math.exp(
            -3.0 * float(np.interp(50.25, mono.energy_keV, ALUMINIUM.attenuation()))
        ),
        rel=1e-6,
    )


def test_attenuation_equals_its_source():
    xraydb = pytest.importorskip("xraydb")
    energy = tables().energy_keV
    for formula, density in (("Fe", 7.8), ("H2O", 1.0), ("C8H8", 1.05), ("WC", 15.6)):
        ours = Substance.of("it", formula, density).attenuation()
        theirs = xraydb.material_mu(formula, energy * 1e3, density) / 10
        np.testing.assert_allclose(ours, theirs, rtol=1e-4)


def test_spectra_equal_their_source():
    spekpy = pytest.importorskip("spekpy")  # 164 MB: not among what `make test` installs
    tube = spekpy.Spek(kvp=83.0, th=12, dk=0.5, physics="kqp", targ="W", z=100, mas=1)
    tube.filter("Al", 0.5)
    assert tube_spectrum(83.0).photons == pytest.approx(tube.get_flu(), rel=0.01)
