"""The tube: how many photons of each energy it emits, and how large its focal spot is.

Spectra come from the shipped tables, linear between neighbouring voltages; a voltage outside the
tables is an error. The anode angle is the tables' 12 degrees; filters and focal spot come from the
machine file, whose defaults are assumed, since nothing public states them for this tube.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from flexdt.twin.attenuation.substances import Substance
from flexdt.twin.attenuation.tables import tables
from flexdt.twin.errors import LimitError
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.description import TubeSpec

ALUMINIUM = Substance.parse("Al@2.70")
NOTHING = 1e-20
"""Photons per cm2 and mAs at 1 m, below which no exposure sees one."""


_FILTER = "tube_filter_"


@dataclass(frozen=True)
class Filter:
    """A layer the whole beam goes through [mm]."""

    substance: Substance
    thickness_mm: float


@dataclass(frozen=True)
class TubeModel:
    """What the beam of a tube depends on besides kV and power. All defaults are assumed.

    Attributes:
        filters: from the anode to the sample; 0.5 mm aluminium stands for window and inherent
            filtration.
        spot_mm_per_W: the electron beam of microfocus tubes is widened with power so that the
            anode does not melt; about a micrometre a watt is usual.
        smallest_spot_mm: focal spot at little power (full width at half maximum).
        spot_points: from which the twin's rays start; 1 for one blur of the whole image.
    """

    filters: tuple[Filter, ...] = field(default_factory=lambda: (Filter(ALUMINIUM, 0.5),))
    spot_mm_per_W: float = 0.001
    smallest_spot_mm: float = 0.007
    spot_points: int = 1

    def focal_spot_mm(self, power_W: float) -> float:
        """Full width at half maximum of the focal spot [mm]."""
        return max(self.smallest_spot_mm, self.spot_mm_per_W * power_W)

    def figures(self) -> dict[str, float]:
        """By name, for data sets; equal filters are one."""
        layers: dict[str, float] = {}
        for one in self.filters:
            name = f"{_FILTER}{one.substance.name}_mm"
            layers[name] = layers.get(name, 0.0) + one.thickness_mm
        return {
            "tube_spot_mm_per_W": self.spot_mm_per_W,
            "tube_smallest_spot_mm": self.smallest_spot_mm,
            **({"tube_spot_points": float(self.spot_points)} if self.spot_points > 1 else {}),
            **layers,
        }

    @classmethod
    def of_figures(cls, figures: Mapping[str, float]) -> TubeModel:
        """The tube that `figures` describe; the default tube where they do not."""
        if "tube_smallest_spot_mm" not in figures:
            return cls()
        layers = {
            name[len(_FILTER) : -len("_mm")]: thick
            for name, thick in figures.items()
            if name.startswith(_FILTER)
        }
        return cls(
            tuple(Filter(Substance.parse(name), thick) for name, thick in layers.items()),
            figures["tube_spot_mm_per_W"],
            figures["tube_smallest_spot_mm"],
            int(figures.get("tube_spot_points", 1)),
        )


def tube_of(spec: TubeSpec) -> TubeModel:
    """The tube of a machine file."""
    return TubeModel(
        tuple(Filter(Substance.parse(f.material), f.thickness_mm) for f in spec.filters),
        spec.spot_mm_per_W,
        spec.smallest_spot_mm,
        spec.spot_points,
    )


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


def tube_spectrum(kV: float, tube: TubeModel | None = None) -> Spectrum:
    """What leaves the tube at `kV`, behind its filters.

    Raises:
        LimitError: the tables do not reach, or nothing comes through the filters.
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
    layers = (TubeModel() if tube is None else tube).filters
    behind = Spectrum(bare).behind(*layers)
    if not behind.photons > NOTHING:
        names = ", ".join(f"{one.thickness_mm:g} mm of {one.substance.name}" for one in layers)
        raise LimitError(
            f"at {kV:g} kV nothing comes through the tube's filters ({names})",
            {"asked": kV, "allowed": "thinner filters or a higher voltage"},
        )
    return behind


def monochromatic(energy_keV: float) -> Spectrum:
    """All photons in the bin that holds `energy_keV`.

    Raises:
        LimitError: outside the tables.
    """
    energy = tables().energy_keV
    step = float(energy[1] - energy[0])
    low, high = float(energy[0]) - step / 2, float(energy[-1]) + step / 2
    if not low <= energy_keV <= high:
        raise LimitError(
            f"no bin for {energy_keV:g} keV; the tables reach from {low:g} to {high:g} keV",
            {"asked": energy_keV, "allowed": [low, high], "unit": "keV"},
        )
    fluence = np.zeros_like(energy)
    fluence[min(int((energy_keV - low) / step), len(fluence) - 1)] = 1.0
    return Spectrum(fluence)
