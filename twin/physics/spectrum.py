"""The tube: how many photons of each energy it sends, and how large its focal spot is.

Spectra come from the shipped tables, linear between neighbouring voltages. The anode angle is the
tables' 12 degrees; filter and focal spot are assumed, since nothing public states them for this
tube. It refuses voltages outside the tables.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from flexdt.twin.conventions import FloatArray
from flexdt.twin.errors import LimitError
from flexdt.twin.physics.attenuation import Substance
from flexdt.twin.physics.tables import tables

ALUMINIUM = Substance("aluminium", (("Al", 1.0),), 2.70)


@dataclass(frozen=True)
class Filter:
    """A layer the whole beam goes through [mm]."""

    substance: Substance
    thickness_mm: float


@dataclass(frozen=True)
class Tube:
    """What the beam of a tube depends on besides kV and power. All values are assumed.

    Attributes:
        filters: from the anode to the sample; 0.5 mm aluminium stands for window and inherent
            filtration.
        spot_mm_per_W: the electron beam of microfocus tubes is widened with power so that the
            anode does not melt; about a micrometre a watt is usual.
        smallest_spot_mm: focal spot at little power (full width at half maximum).
    """

    filters: tuple[Filter, ...] = field(default_factory=lambda: (Filter(ALUMINIUM, 0.5),))
    spot_mm_per_W: float = 0.001
    smallest_spot_mm: float = 0.007

    def focal_spot_mm(self, power_W: float) -> float:
        """Full width at half maximum of the focal spot [mm]."""
        return max(self.smallest_spot_mm, self.spot_mm_per_W * power_W)


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Photons by energy.

    Attributes:
        fluence: (e,) photons per cm2 and mAs in each bin of the tables, at 1 m.
    """

    fluence: FloatArray

    @property
    def energy_keV(self) -> FloatArray:
        """(e,) centres of the bins [keV]."""
        return tables().energy_keV

    @property
    def photons(self) -> float:
        """Photons per cm2 and mAs at 1 m."""
        return float(self.fluence.sum())

    @property
    def mean_keV(self) -> float:
        """Mean energy of a photon [keV]."""
        return float(self.fluence @ self.energy_keV / self.fluence.sum())

    def behind(self, *filters: Filter) -> Spectrum:
        """The spectrum behind filters."""
        depth = np.zeros_like(self.fluence)
        for one in filters:
            depth += one.substance.attenuation() * one.thickness_mm
        return Spectrum(self.fluence * np.exp(-depth))


def voltages() -> tuple[float, float]:
    """Least and greatest voltage that there are spectra for [kV]."""
    stored = tables()
    return float(stored.kV[0]), float(stored.kV[-1])


def tube_spectrum(kV: float, tube: Tube | None = None) -> Spectrum:
    """What leaves the tube at `kV`, behind its filters.

    Raises:
        LimitError: the tables do not reach.
    """
    stored = tables()
    low, high = voltages()
    if not low <= kV <= high:
        raise LimitError(
            f"no spectrum for {kV:g} kV; the tables reach from {low:g} to {high:g} kV",
            {"asked": kV, "allowed": [low, high], "unit": "kV"},
        )
    after = max(1, int(np.searchsorted(stored.kV, kV)))
    before = after - 1
    part = (kV - stored.kV[before]) / (stored.kV[after] - stored.kV[before])
    bare = (1.0 - part) * stored.fluence[before] + part * stored.fluence[after]
    return Spectrum(bare).behind(*(Tube() if tube is None else tube).filters)


def monochromatic(energy_keV: float, photons: float = 1.0) -> Spectrum:
    """All photons in the bin that holds `energy_keV`.

    Raises:
        LimitError: outside the tables.
    """
    energy = tables().energy_keV
    step = float(energy[1] - energy[0])
    low, high = float(energy[0]) - step / 2, float(energy[-1]) + step / 2
    if not low <= energy_keV < high:
        raise LimitError(
            f"no bin for {energy_keV:g} keV; the tables reach from {low:g} to {high:g} keV",
            {"asked": energy_keV, "allowed": [low, high], "unit": "keV"},
        )
    fluence = np.zeros_like(energy)
    fluence[int((energy_keV - low) / step)] = photons
    return Spectrum(fluence)
