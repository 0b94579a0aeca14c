"""What a scintillator keeps, beside photons followed one by one."""

from __future__ import annotations

import numpy as np
import pytest

from flexdt.twin.attenuation.scattering import cross_sections
from flexdt.twin.attenuation.substances import Substance, tables
from flexdt.twin.physics.scintillator import K_SHELL, deposited, through
from flexdt.twin.physics.tube import Filter

CSI = Substance.of("CsI", "CsI", 4.51)
GOS = Substance.of("GOS", "Gd2O2S", 7.34)


def followed(
    screen: Filter, keV: float, rng: np.random.Generator, number: int = 200_000
) -> np.ndarray:
    """Part of the energy kept, mean and mean square: K and Compton photons fly once more."""
    sections, energy = cross_sections((screen.substance,)), tables().energy_keV

    def at(values: np.ndarray, e: np.ndarray | float) -> np.ndarray:
        return np.interp(e, energy, values)

    total, compton, coherent = (
        sections.total[0],
        sections.incoherent[0],
        sections.coherent[0],
    )
    photo = total - compton - coherent
    stopping = float(at(photo + compton, keV))
    stopped = -np.expm1(-stopping * screen.thickness_mm)
    depth = (
        -np.log1p(-rng.random(number) * stopped) / stopping
    )  # all interact, of `stopped`
    electron = rng.random(len(depth)) * at(photo + compton, keV) < at(photo, keV)
    kept = np.where(electron, keV, 0.0)

    def leaves(e: np.ndarray, mu: np.ndarray) -> np.ndarray:
        cosine = rng.uniform(-1, 1, len(e))
        way = np.where(cosine > 0, screen.thickness_mm - depth, depth) / np.abs(cosine)
        return rng.exponential(1.0, len(e)) > at(mu, e) * way

    parts = dict(screen.substance.fractions)
    alone = {
        s: Substance(s, ((s, 1.0),), x * screen.substance.density_g_cm3).attenuation()
        for s, x in parts.items()
    }
    choice = rng.random(len(depth)) * sum(at(mu, keV) for mu in alone.values())
    for symbol, mu in alone.items():
        mine = (choice >= 0) & (choice < at(mu, keV)) & electron
        choice = choice - at(mu, keV)
        if symbol not in K_SHELL or keV < K_SHELL[symbol][0]:
            continue
        _, share, fluorescence, lines = K_SHELL[symbol]
        shines = mine & (rng.random(len(depth)) < share * fluorescence)
        line = np.where(rng.random(len(depth)) < 0.81, *lines)
        kept -= np.where(shines & leaves(line, photo + compton), line, 0.0)
    k = np.empty(0)
    while len(k) < len(depth):  # Klein and Nishina by rejection
        cosine = rng.uniform(-1, 1, number)
        one = 1.0 / (1.0 + keV / 511.0 * (1.0 - cosine))
        k = np.append(
            k, one[rng.random(number) * 2 < one**2 * (one + 1 / one - 1 + cosine**2)]
        )
    rest = keV * k[: len(depth)]
    kept += np.where(~electron, keV - np.where(leaves(rest, photo), rest, 0.0), 0.0)
    return np.array([np.mean(kept / keV), np.mean((kept / keV) ** 2)]) * float(stopped)


@pytest.mark.parametrize("keV", [25.25, 34.25, 40.25, 60.25, 110.25, 180.25])
@pytest.mark.parametrize(
    "screen", [Filter(CSI, 0.2), Filter(GOS, 0.5)], ids=["CsI", "GOS"]
)
def test_the_energy_kept_is_that_of_photons_followed_one_by_one(
    screen: Filter, keV: float
) -> None:
    rng = np.random.default_rng(3)
    ours = [np.interp(keV, tables().energy_keV, one) for one in deposited(screen)]
    assert ours == pytest.approx(followed(screen, keV, rng), rel=0.012)


def test_a_thick_screen_keeps_all_but_what_escapes_through_its_front() -> None:
    part = deposited(Filter(GOS, 50.0)).mean
    assert part.max() < 1.0 + 1e-12
    assert part[tables().energy_keV < 50].min() > 0.96
    assert deposited(Filter(GOS, 0.0)).mean.max() == 0.0


def test_what_gets_through_a_slab_is_the_exponential_integral() -> None:
    special = pytest.importorskip("scipy.special")
    random = np.random.default_rng(2)
    paths = np.concatenate([[0.0, 1e-9], 10 ** random.uniform(-8, 3, 500)])
    np.testing.assert_allclose(through(paths), special.expn(2, paths), atol=2e-6)
