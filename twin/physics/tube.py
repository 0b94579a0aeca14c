"""The tube: how many photons of each energy it emits, and how large its focal spot is.

Spectra come from the shipped tables, linear between neighboring voltages; a voltage
outside the tables is an error. The anode angle is the tables' 12 degrees; filters and
focal spot come from the machine file, whose defaults are assumed, since nothing public
states them for this tube. `Tube` is the user's description for `flexdt.simulate`; it
becomes the values that the chain works with, `TubeModel` and `ExposureSettings`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from flexdt.twin.attenuation.materials import material
from flexdt.twin.attenuation.substances import Substance, tables
from flexdt.twin.errors import LimitError, require_within
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.description import TubeSpec
from flexdt.twin.physics.exposure import ExposureSettings
from flexdt.twin.signatures import public

ALUMINIUM = Substance.parse("Al@2.70")
MIN_PHOTONS = 1e-20
"""Photons per cm2 and mAs at 1 m below which a beam counts as stopped."""


_FILTER = "tube_filter_"


@dataclass(frozen=True)
class Filter:
    """A layer in the path of the beam [mm]."""

    substance: Substance
    thickness_mm: float


@dataclass(frozen=True)
class TubeModel:
    """Properties of a tube's beam besides kV and power. All defaults are assumed.

    Attributes:
        filters: from the anode to the sample; 0.5 mm aluminium, for window and inherent
            filtration.
        spot_mm_per_W: the electron beam of microfocus tubes is widened with power so that
            the anode does not melt; about a micrometer a watt is usual.
        smallest_spot_mm: focal spot at little power (full width at half maximum).
        spot_points: from which the twin's rays start; 1 for one blur of the image.
    """

    filters: tuple[Filter, ...] = field(default_factory=lambda: (Filter(ALUMINIUM, 0.5),))
    spot_mm_per_W: float = 0.001
    smallest_spot_mm: float = 0.007
    spot_points: int = 1

    def focal_spot_mm(self, power_W: float) -> float:
        """Compute the full width at half maximum of the focal spot [mm]."""
        return max(self.smallest_spot_mm, self.spot_mm_per_W * power_W)

    def figures(self) -> dict[str, float]:
        """List spot size [mm, mm/W], the number of spot points if above 1, and each
        filter's thickness [mm], by name, for data sets; layers of one substance are added
        up, and their order is lost."""
        layers: dict[str, float] = {}
        for one in self.filters:
            name = f"{_FILTER}{one.substance.name}_mm"
            layers[name] = layers.get(name, 0.0) + one.thickness_mm
        figures = {
            "tube_spot_mm_per_W": self.spot_mm_per_W,
            "tube_smallest_spot_mm": self.smallest_spot_mm,
        }
        if self.spot_points > 1:
            figures["tube_spot_points"] = float(self.spot_points)
        return figures | layers

    @classmethod
    def of_figures(cls, figures: Mapping[str, float]) -> TubeModel:
        """Make the tube that `figures` describe; the default tube if they lack the
        smallest spot.

        Without a number of spot points it is 1.

        Args:
            figures: name -> number, as `figures` of a data set has them; others are
                ignored.

        Raises:
            UnknownNameError: a filter of an unknown substance.
        """
        if "tube_smallest_spot_mm" not in figures:
            return cls()
        layers = {
            name[len(_FILTER) : -len("_mm")]: thick
            for name, thick in figures.items()
            if name.startswith(_FILTER)
        }
        return cls(
            tuple(
                Filter(material(name).substance, thick) for name, thick in layers.items()
            ),
            figures["tube_spot_mm_per_W"],
            figures["tube_smallest_spot_mm"],
            int(figures.get("tube_spot_points", 1)),
        )


def tube_of(spec: TubeSpec) -> TubeModel:
    """Convert the tube of a machine file: its filters, focal spot and number of spot
    points.
    """
    return TubeModel(
        tuple(
            Filter(material(f.material).substance, f.thickness_mm) for f in spec.filters
        ),
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
        """(e,) bin centers [keV]."""
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
        """Return the spectrum attenuated by filters; unchanged without any."""
        depth = np.zeros_like(self.fluence)
        for one in filters:
            depth += one.substance.attenuation() * one.thickness_mm
        return Spectrum(self.fluence * np.exp(-depth))


def voltages() -> tuple[float, float]:
    """Return the least and greatest voltage with a spectrum [kV]."""
    stored = tables()
    return float(stored.kV[0]), float(stored.kV[-1])


def tube_spectrum(kV: float, tube: TubeModel | None = None) -> Spectrum:
    """Compute the spectrum that leaves the tube at `kV`, behind its filters.

    Photons a bin, per mAs and cm2 at 1 m, interpolated linearly between the tables'
    voltages.

    Args:
        kV: voltage.
        tube: with its filters; None: the default one.

    Raises:
        LimitError: a voltage outside the tables, or fewer than `MIN_PHOTONS` photons come
            through the filters.
    """
    stored = tables()
    low, high = voltages()
    require_within("the voltage of a spectrum", kV, low, high, "kV")
    after = max(1, int(np.searchsorted(stored.kV, kV)))
    before = after - 1
    part = (kV - stored.kV[before]) / (stored.kV[after] - stored.kV[before])
    bare = (1.0 - part) * stored.fluence[before] + part * stored.fluence[after]
    layers = (TubeModel() if tube is None else tube).filters
    behind = Spectrum(bare).behind(*layers)
    if not behind.photons > MIN_PHOTONS:
        names = ", ".join(
            f"{one.thickness_mm:g} mm of {one.substance.name}" for one in layers
        )
        message = f"at {kV:g} kV nothing comes through the tube's filters ({names})"
        raise LimitError.instead(message, kV, "thinner filters or a higher voltage")
    return behind


def monochromatic(energy_keV: float) -> Spectrum:
    """Make a spectrum with all photons in the bin that holds `energy_keV`.

    Its fluence there is one photon.

    Raises:
        LimitError: outside the tables.
    """
    energy = tables().energy_keV
    step = float(energy[1] - energy[0])
    low = float(energy[0]) - step / 2
    high = float(energy[-1]) + step / 2
    require_within("the energy of photons", energy_keV, low, high, "keV")
    fluence = np.zeros_like(energy)
    fluence[min(int((energy_keV - low) / step), len(fluence) - 1)] = 1.0
    return Spectrum(fluence)


@public
@dataclass(frozen=True, kw_only=True)
class Tube:
    """An X-ray tube and its settings.

    Args:
        kV: tube voltage; the spectrum is tungsten's at 12 degrees, 20 to 240 kV.
        power_W: power on the anode [W]; power_W / kV is the current [mA].
        filters: layers from the anode to the sample, (name of a material, as samples have
            it, or FORMULA@DENSITY in g/cm3, thickness [mm]) each; None for 0.5 mm of
            aluminium, () for nothing.
        spot_mm: focal spot, full width at half maximum [mm]; None: 1 um for each watt, at
            least 7 um.
        mono_keV: all photons have this energy, as many as give the spectrum's signal in
            the open beam; None for the full spectrum.

    Raises:
        LimitError: a setting that has no spectrum; the message lists the allowed values.
        UnknownNameError: a material or an element without a table.

    Example:
        >>> Tube(kV=120, power_W=30, filters=[("copper", 0.2)]).exposure(200.0).power_W
        30.0
    """

    kV: float = 90.0
    power_W: float = 50.0
    filters: Sequence[tuple[str, float] | Filter] | None = None
    spot_mm: float | None = None
    mono_keV: float | None = None

    def __post_init__(self) -> None:
        """Check voltage (the tables'), power (up to 1e6 W), spot (0 to 10 mm) and energy,
        and convert the filters' names to `Filter`s.

        Raises:
            LimitError: a value out of its range, or an unknown filter.
        """
        low, high = voltages()
        require_within("Tube: kV", self.kV, low, high, "kV")
        require_within("Tube: power_W", self.power_W, 1e-9, 1e6, "W")
        if self.spot_mm is not None:
            require_within("Tube: spot_mm", self.spot_mm, 0.0, 10.0, "mm")
        if self.mono_keV is not None:
            monochromatic(self.mono_keV)
        if self.filters is not None:
            object.__setattr__(self, "filters", tuple(map(_filter, self.filters)))

    def model(self, design: TubeModel | None = None) -> TubeModel:
        """Return filters and focal spot; those of `design`, or of the default tube, where
        this tube states none. A stated spot has this size at all powers.

        Example:
            >>> Tube(filters=(), spot_mm=0.02).model().smallest_spot_mm
            0.02
        """
        if design is None:
            given = TubeModel()
        else:
            given = design
        if self.filters is None:
            layers = given.filters
        else:
            layers = tuple(map(_filter, self.filters))
        if self.spot_mm is None:
            return TubeModel(layers, given.spot_mm_per_W, given.smallest_spot_mm)
        return TubeModel(layers, 0.0, self.spot_mm)

    def exposure(self, exposure_ms: float, averages: int = 1) -> ExposureSettings:
        """Make the exposure settings of this tube during one image.

        Example:
            >>> lit = Tube(kV=60, power_W=30).exposure(100.0, averages=4)
            >>> lit.kV, lit.power_W, lit.exposure_ms, lit.averages, lit.xrays_on
            (60.0, 30.0, 100.0, 4, True)"""
        return ExposureSettings(
            float(self.kV), float(self.power_W), float(exposure_ms), int(averages)
        )


def _filter(layer: tuple[str, float] | Filter) -> Filter:
    """Convert (material, thickness [mm]) to a filter; a filter itself is only checked.

    Raises LimitError: the thickness is not 0 to 1000 mm; UnknownNameError: an unknown material.
    """
    if not isinstance(layer, Filter):
        layer = Filter(material(layer[0]).substance, float(layer[1]))
    name = f"Tube: filter {layer.substance.name}"
    require_within(name, layer.thickness_mm, 0.0, 1e3, "mm")
    return layer
