"""Part of a photon's energy that a scintillator of any material keeps.

Photons interact along a straight line. A photoelectric one leaves its energy, less that
of a K photon that escapes; a Compton one leaves that of the electron, and of the
scattered photon if it is absorbed on its way out. K photons and scattered ones go into
all directions alike and interact one more time or escape through front or back. Coherent
scattering is left out: it goes forward and takes no energy.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np

from flexdt.twin.attenuation.scattering import ELECTRON_KEV, cross_sections
from flexdt.twin.attenuation.substances import Substance, tables
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.physics.tube import Filter

K_SHELL: Final = {
    "I": (33.169, 0.817, 0.884, (28.5, 32.4)),
    "Cs": (35.985, 0.813, 0.898, (30.85, 35.1)),
    "Gd": (50.239, 0.795, 0.935, (42.75, 48.8)),
}
"""Edge [keV], part of the absorption above it (the edge's jump in the tables),
fluorescence yield (Krause, J. Phys. Chem. Ref. Data 8 (1979) 307), energies of K-alpha
and K-beta [keV]. Of other elements no fluorescence escapes here."""
K_ALPHA_SHARE: Final = 0.81
"""Part of K-alpha among K photons."""
MAX_FREE_PATHS: Final = 50.0
"""Mean free paths behind which nothing is left."""
SLICES: Final = 60
"""Number of slices of the layer, in each of which as many photons are stopped."""


class Deposited(NamedTuple):
    """Energy that a layer keeps of a photon, by energy of the tables.

    Attributes:
        mean: (e,) part of the energy that is kept on average; photons that pass keep
            nothing there.
        square: (e,) mean square of that part; mean^2 / square is Swank's factor of the
            deposit.
    """

    mean: FloatArray
    square: FloatArray


@lru_cache(maxsize=64)
def deposited(screen: Filter) -> Deposited:
    """Compute the part of a photon's energy that a layer keeps.

    K fluorescence and Compton-scattered photons that leave the layer take their energy
    along. Zero for no thickness. The last 64 are kept, read-only.

    Args:
        screen: the layer.

    Returns:
        Mean and mean square of the kept part of the energy, (e,) each, 0 to 1, for the
        energies of the tables.

    Example:
        >>> csi = Filter(Substance.of("CsI", "CsI", 4.51), 0.2)
        >>> part = deposited(csi).mean
        >>> [round(float(part[np.searchsorted(tables().energy_keV, keV)]), 2) for keV in (30, 60)]
        [0.52, 0.41]
    """
    substance = screen.substance
    thick = screen.thickness_mm
    if thick <= 0.0:
        return Deposited(*np.zeros((2, len(tables().energy_keV))))
    sections = cross_sections((substance,))
    energy = tables().energy_keV
    total = sections.total[0]
    compton = sections.incoherent[0]
    stopping = total - sections.coherent[0]
    photo = stopping - compton
    stopped = -np.expm1(-stopping * thick)
    share = (
        np.arange(SLICES) + 0.5
    ) / SLICES  # slices in which as many photons are stopped
    depth = -np.log1p(-share * stopped[:, None]) / stopping[:, None]  # (e, slice)
    here = np.broadcast_to((stopped / stopping / SLICES)[:, None], depth.shape)

    def escaping(mu: FloatArray) -> FloatArray:
        """Compute the part of isotropically emitted photons that escapes through both
        faces, (e, slice)."""
        back = through(mu[..., None] * depth)
        return np.asarray((back + through(mu[..., None] * (thick - depth))) / 2.0)

    mean = photo * energy * here.sum(axis=1)
    square = mean * energy
    for symbol, part in substance.fractions:
        edge, jump, fluorescence, lines = K_SHELL.get(
            symbol, (np.inf, 0.0, 0.0, (0.0, 0.0))
        )
        element = Substance(symbol, ((symbol, 1.0),), part * substance.density_g_cm3)
        amount = (
            jump * fluorescence * photo * element.attenuation() / total * (energy > edge)
        )
        for line, often in zip(lines, (K_ALPHA_SHARE, 1.0 - K_ALPHA_SHARE), strict=True):
            lost = escaping(np.interp([line], energy, stopping))
            escapes = amount * often * (here * lost).sum(axis=1)
            mean -= escapes * line
            square -= escapes * line * (2.0 * energy - line)
    cosine, weight = np.polynomial.legendre.leggauss(12)
    k = 1.0 / (1.0 + energy[:, None] / ELECTRON_KEV * (1.0 - cosine))
    ring = k**2 * (k + 1.0 / k - 1.0 + cosine**2) * weight  # Klein and Nishina
    ring /= ring.sum(axis=1)[:, None]
    for j in range(len(cosine)):
        lost = (here * escaping(np.interp(energy * k[:, j], energy, photo))).sum(axis=1)
        met = compton * energy * ring[:, j]
        mean += met * (here.sum(axis=1) - k[:, j] * lost)
        square += met * energy * (here.sum(axis=1) - k[:, j] * (2.0 - k[:, j]) * lost)
    result = Deposited(mean / energy, square / energy**2)
    for array in result:
        array.flags.writeable = False
    return result


@lru_cache
def _slab() -> tuple[FloatArray, FloatArray]:
    """Tabulate the exponential integral E_2: 0 and growing mean free paths, and values."""
    nodes, weight = np.polynomial.legendre.leggauss(32)
    root = (nodes + 1.0) / 2.0
    cosine = root**4  # whose steps are small where the path is long
    paths = np.concatenate([[0.0], np.geomspace(1e-7, MAX_FREE_PATHS, 6000)])
    values = np.exp(-paths[:, None] / cosine) @ (2.0 * root**3 * weight)
    return paths, values


def through(free_paths: FloatArray) -> FloatArray:
    """Compute the part of photons, emitted into a half-space in all directions alike, that
    gets through a slab: E_2 of its mean free paths, within 2e-6.

    By a table: `scipy.special` would take 25 MB and a quarter of a check's time.

    Args:
        free_paths: (...) >= 0.
    """
    return np.interp(free_paths, *_slab(), right=0.0)
