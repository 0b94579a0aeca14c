"""How substances scatter X-rays: differential cross-sections of independent atoms, from tables.

Coherent (Rayleigh) scattering is Thomson's times the square of the form factor F(x),
incoherent (Compton) scattering Klein and Nishina's (Z. Phys. 52 (1929) 853) times the
incoherent scattering function S(x); x = sin(theta / 2) / lambda [1/A]. F and S are
Hubbell's (J. Phys. Chem. Ref. Data 4 (1975) 471 and 8 (1979) 69) by way of EPDL97 and
xraylib; `docs/tools/scattering_tables.py` made the file. The atoms of a compound scatter
independently here: the interference between neighboring atoms, which shapes coherent
scattering below x = 0.3 in liquids, plastics and metals, is left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np

from flexdt.twin.attenuation.substances import Substance, stored_arrays, tables
from flexdt.twin.geometry.conventions import FloatArray

RADIUS2_BARN = 0.079407877
"""Square of the classical electron radius [barn]."""
HC_KEV_A = 12.39841984
"""Photon energy times wavelength [keV A]."""
ELECTRON_KEV = 510.99895
"""Rest energy of the electron [keV]."""
AVOGADRO_BARN = 0.602214076
"""Avogadro's number times a barn [cm2/mol]."""


@dataclass(frozen=True, eq=False)
class CrossSections:
    """Cross-sections of m substances, each at its own density, for scatter simulations.

    Attributes:
        energy_keV: (e,) evenly spaced energies of `total`, `coherent` and `incoherent`
            [keV].
        total: (m, e) linear attenuation coefficient [1/mm], of the attenuation tables.
        coherent, incoherent: (m, e) integrals of the differential cross-sections [1/mm].
        root_step: step of the square root of x between the columns of the next three
            [1/A^(1/2)].
        form: (m, q) F^2 summed over the atoms in a mm times the squared electron radius
            [1/mm].
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


@cache
def _scattering() -> dict[str, FloatArray]:
    return stored_arrays("scattering.npz")[0]


@lru_cache(maxsize=16)
def cross_sections(substances: tuple[Substance, ...]) -> CrossSections:
    """Compute the cross-sections of substances at their densities; the arrays are
    read-only.

    Coherent and incoherent ones are integrals over the sphere: the Thomson or Klein-Nishina
    cross-section times the squared form factor or incoherent function of the atoms. Total
    ones are those of `Substance.attenuation`.

    Results of the last 16 calls are kept.

    Args:
        substances: m materials, at least one.

    Returns:
        Total, coherent and incoherent cross-sections [1/mm] (m, e) at the e energies of the
        tables; form factors and shells (m, q) over the momentum transfer, whose root has
        equal steps, and the cumulated form factors (m, q), 0 at first.

    Example:
        >>> water = cross_sections((Substance.of("water", "H2O", 1.0),))
        >>> at = int(np.searchsorted(water.energy_keV, 60.0))
        >>> round(float(water.incoherent[0, at]), 4)  # XCOM: 0.0177 1/mm
        0.0177
    """
    energy = tables().energy_keV
    stored = _scattering()
    # Of an atom by atomic number from 1, (92, q), at (q,) values of x whose root grows evenly.
    x, form_factor, function = (
        stored[name] for name in ("x", "form_factor", "incoherent")
    )
    form, shell = np.zeros((2, len(substances), len(x)))
    for m, one in enumerate(substances):
        for row, part in one.parts:
            atoms = part / tables().molar_mass[row] * AVOGADRO_BARN
            atoms = atoms * one.density_g_cm3 / 10.0
            form[m] += atoms * RADIUS2_BARN * form_factor[row] ** 2
            shell[m] += atoms * RADIUS2_BARN * function[row]
    rings = np.diff(x**2) * (form[:, 1:] + form[:, :-1]) / 2.0
    cumulated = np.concatenate(
        [np.zeros((len(form), 1)), np.cumsum(rings, axis=1)], axis=1
    )
    # Integrals over the sphere, in w = sin(theta / 2)^(1/2): the forward peak is broad there.
    points, weights = np.polynomial.legendre.leggauss(160)
    w = (points + 1.0) / 2.0
    dw = weights / 2.0
    cosine = 1.0 - 2.0 * w**4
    ring = 2.0 * np.pi * 8.0 * w**3 * dw
    root_step = float(np.sqrt(x[1]))
    column = np.sqrt(energy[:, None] / HC_KEV_A) * w / root_step
    index = np.arange(len(x))
    k = 1.0 / (1.0 + energy[:, None] / ELECTRON_KEV * (1.0 - cosine))
    thomson = 0.5 * (1.0 + cosine**2) * ring
    klein_nishina = 0.5 * k**2 * (k + 1.0 / k - 1.0 + cosine**2) * ring
    coherent = [(np.interp(column, index, row) * thomson).sum(axis=1) for row in form]
    incoherent = [
        (np.interp(column, index, row) * klein_nishina).sum(axis=1) for row in shell
    ]
    total = [one.attenuation() for one in substances]
    arrays = (
        np.array(total),
        np.array(coherent),
        np.array(incoherent),
        form,
        shell,
        cumulated,
    )
    for array in arrays:  # shared by all callers
        array.flags.writeable = False
    return CrossSections(energy, *arrays[:3], root_step, *arrays[3:])
