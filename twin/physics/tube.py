"""The X-ray tube as a user states it for `flexdt.simulate`: settings and design in one value.

It becomes the values that the chain works with: `TubeModel` and `ExposureSettings`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from flexdt.twin.attenuation.substances import Substance
from flexdt.twin.errors import require_within
from flexdt.twin.physics.exposure import ExposureSettings
from flexdt.twin.physics.spectrum import Filter, TubeModel, monochromatic, voltages
from flexdt.twin.signatures import public


@public
@dataclass(frozen=True, kw_only=True)
class Tube:
    """An X-ray tube and its settings.

    Args:
        kV: tube voltage; the spectrum is tungsten's at 12 degrees, 20 to 240 kV.
        power_W: power on the anode [W]; power_W / kV is the current [mA].
        filters: layers from the anode to the sample, (FORMULA@DENSITY in g/cm3, thickness [mm])
            each; None for 0.5 mm of aluminium, () for nothing.
        spot_mm: focal spot, full width at half maximum [mm]; None: 1 um for each watt, at least
            7 um.
        mono_keV: all photons have this energy, as many as give the spectrum's signal in the open
            beam; None for the whole spectrum.

    Raises:
        LimitError: a setting that has no spectrum; says what is allowed.
        UnknownNameError: an element without a table.

    Example:
        >>> Tube(kV=120, power_W=30, filters=[("Cu@8.96", 0.2)]).exposure(200.0).power_W
        30.0
    """

    kV: float = 90.0
    power_W: float = 50.0
    filters: Sequence[tuple[str, float] | Filter] | None = None
    spot_mm: float | None = None
    mono_keV: float | None = None

    def __post_init__(self) -> None:
        low, high = voltages()
        require_within("Tube: kV", self.kV, low, high, "kV")
        require_within("Tube: power_W", self.power_W, 1e-9, 1e6, "W")
        if self.spot_mm is not None:
            require_within("Tube: spot_mm", self.spot_mm, 0.0, 10.0, "mm")
        if self.mono_keV is not None:
            monochromatic(self.mono_keV)
        if self.filters is not None:
            layers = tuple(_filter(one) for one in self.filters)
            object.__setattr__(self, "filters", layers)
            for one in layers:
                name = f"Tube: filter {one.substance.name}"
                require_within(name, one.thickness_mm, 0.0, 1e3, "mm")

    def model(self, design: TubeModel | None = None) -> TubeModel:
        """Filters and focal spot; those of `design` where this tube states none.

        Example:
            >>> Tube(filters=(), spot_mm=0.02).model().smallest_spot_mm
            0.02
        """
        given = TubeModel() if design is None else design
        layers = given.filters if self.filters is None else tuple(map(_filter, self.filters))
        if self.spot_mm is None:
            return TubeModel(layers, given.spot_mm_per_W, given.smallest_spot_mm)
        return TubeModel(layers, 0.0, self.spot_mm)

    def exposure(self, exposure_ms: float, averages: int = 1) -> ExposureSettings:
        """This tube during one image.

        Example:
            >>> Tube(kV=60, power_W=30).exposure(100.0, averages=4)
            ExposureSettings(kV=60.0, power_W=30.0, exposure_ms=100.0, averages=4, xrays_on=True)
        """
        return ExposureSettings(
            float(self.kV), float(self.power_W), float(exposure_ms), int(averages)
        )


def _filter(layer: tuple[str, float] | Filter) -> Filter:
    if isinstance(layer, Filter):
        return layer
    material, thickness_mm = layer
    require_within(f"Tube: filter {material}", thickness_mm, 0.0, 1e3, "mm")
    return Filter(Substance.parse(material), float(thickness_mm))
