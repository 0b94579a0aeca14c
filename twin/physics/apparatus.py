"""Tube and detector as a user states them for `flexdt.simulate`: any figures, no machine file.

`Tube` holds settings and design in one value, `Detector` one panel of square pixels. Both become
the values that the chain works with: `TubeModel`, `Panel`, `CameraSettings`, `ExposureSettings`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

from flexdt.twin.attenuation.substances import Substance
from flexdt.twin.errors import LimitError, require_within
from flexdt.twin.machine.camera import CameraSettings, Roi
from flexdt.twin.physics.exposure import ExposureSettings
from flexdt.twin.physics.panel import Panel
from flexdt.twin.physics.spectrum import Filter, TubeModel, monochromatic, voltages

CAMERA_MODE = "HW1SW1High"
"""Of a `Detector`: its pixels are those of the image."""
USUAL_MS = 100.0
"""Exposure of a `Detector` that states none, where no tube says how bright its images are [ms]."""
TWINS_PIXEL_MM = 2 * Panel.pitch_mm
"""The twin's pixels as it is usually read out, binned 2 x."""
TWINS_GAIN = Panel.full_well_e[0] / 2**Panel.bits
"""Electrons in each of its counts."""


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


@dataclass(frozen=True, kw_only=True)
class Detector:
    """A flat panel with a scintillator, of any make; the defaults are the twin's panel.

    How many pixels it has and how large they are is the geometry's to say.

    Args:
        pixel_mm: pitch of the pixels [mm]; None for the geometry's. Another pitch than the
            geometry's is an error.
        exposure_ms: of one read-out [ms]; None: `flexdt.simulate` chooses it so that the brightest
            pixel of the open beam reaches 80 % of the largest count.
        averages: read-outs averaged into an image.
        bits: depth, 1 to 16; counts end at 2^bits - 1.
        electrons_per_count: conversion gain; a pixel saturates at 2^bits times that. None: so that
            a pixel of 14 bits holds as much charge for its area as the twin's.
        electrons_per_keV: charge for each keV that the scintillator keeps.
        scintillator: FORMULA@DENSITY [g/cm3], such as Gd2O2S@7.34.
        scintillator_mm: its thickness [mm]; packing: the part of it that is not gaps.
        swank: statistical factor of the light from one photon (1: always the same).
        read_noise_e: standard deviation of one read-out [electrons].
        offset_counts: level without charge [counts].
        dark_e_per_s: charge without X-rays [electrons/s]; None: as much for its area as the twin's.
        blur_mm: standard deviation of the point spread in the scintillator [mm].
        gain_sigma, offset_sigma_counts: fixed pattern of gain (relative) and offset [counts].
        dead_fraction: pixels that give nothing.
        serial: seed of the fixed pattern.

    Raises:
        LimitError: a figure that no detector has; says what is allowed.
        UnknownNameError: a scintillator of an element without a table.

    Example:
        >>> panel = Detector(bits=16, electrons_per_count=20).panel((100, 200), 0.1)
        >>> panel.full_scale, panel.full_well_e[0]
        (65535, 1310720.0)
    """

    pixel_mm: float | None = None
    exposure_ms: float | None = None
    averages: int = 1
    bits: int = Panel.bits
    electrons_per_count: float | None = None
    electrons_per_keV: float = Panel.electrons_per_keV
    scintillator: str = Panel.scintillator
    scintillator_mm: float = Panel.scintillator_mm
    packing: float = Panel.packing
    swank: float = Panel.swank
    read_noise_e: float = Panel.read_noise_e[0]
    offset_counts: float = Panel.offset_counts
    dark_e_per_s: float | None = None
    blur_mm: float = Panel.blur_mm
    gain_sigma: float = Panel.gain_sigma
    offset_sigma_counts: float = Panel.offset_sigma_counts
    dead_fraction: float = Panel.dead_fraction
    serial: int = Panel.serial

    def __post_init__(self) -> None:
        for name, (low, high) in _BOUNDS.items():
            value = getattr(self, name)
            if value is not None:
                require_within(f"Detector: {name}", value, low, high)
        Substance.parse(self.scintillator)
        for name in ("bits", "averages", "serial"):
            if getattr(self, name) != int(getattr(self, name)):
                raise LimitError(
                    f"Detector: {name} is {getattr(self, name)}; allowed: a whole number",
                    {"asked": getattr(self, name), "allowed": "a whole number"},
                )

    @classmethod
    def ideal(cls, **figures: float) -> Detector:
        """A detector whose only noise is that of the X-rays: no blur, pattern, dark charge,
        dead pixels or read noise; `figures` replace fields.

        Example:
            >>> Detector.ideal(bits=16).blur_mm
            0.0
        """
        nothing = dict.fromkeys(
            ("read_noise_e", "dark_e_per_s", "blur_mm", "gain_sigma", "offset_sigma_counts",
             "dead_fraction"),
            0.0,
        )  # fmt: skip
        known = {f.name for f in fields(cls)}
        if unknown := sorted(set(figures) - known):
            raise LimitError(
                f"a Detector has no {', '.join(unknown)}; allowed: {', '.join(sorted(known))}",
                {"asked": unknown, "allowed": sorted(known)},
            )
        return cls(**{**nothing, **figures})  # type: ignore[arg-type]

    def panel(self, shape: tuple[int, int], pixel_mm: float, row_mm: float | None = None) -> Panel:
        """This detector as a panel of (rows, cols) pixels of `pixel_mm`, read out whole; `row_mm`
        is from row to row where that differs.

        Raises:
            LimitError: the detector states another pitch.

        Example:
            >>> Detector(bits=12).panel((100, 200), 0.1).full_scale
            4095
        """
        if self.pixel_mm is not None and abs(self.pixel_mm - pixel_mm) > 1e-6 * pixel_mm:
            raise LimitError(
                f"the detector's pixel_mm is {self.pixel_mm:g} mm, the geometry's {pixel_mm:g} mm",
                {"asked": self.pixel_mm, "allowed": pixel_mm, "unit": "mm"},
            )
        area = pixel_mm * (pixel_mm if row_mm is None else row_mm) / TWINS_PIXEL_MM**2
        gain, dark = self.electrons_per_count, self.dark_e_per_s
        full_well = 2.0 ** int(self.bits) * (
            TWINS_GAIN * area * 2.0 ** (Panel.bits - int(self.bits)) if gain is None else gain
        )
        alike = {name: getattr(self, name) for name in _OF_PANEL}
        return Panel(
            **alike,
            columns=shape[1],
            rows=shape[0],
            pitch_mm=pixel_mm,
            row_pitch_mm=row_mm,
            bits=int(self.bits),
            full_well_e=(full_well, full_well),
            read_noise_e=(self.read_noise_e, self.read_noise_e),
            dark_e_per_s=4.0 * Panel.dark_e_per_s * area if dark is None else dark,
            lag_fraction=0.0,
            serial=int(self.serial),
        )

    def camera(self, shape: tuple[int, int]) -> CameraSettings:
        """Settings that read out all of (rows, cols) pixels.

        Example:
            >>> Detector(exposure_ms=50).camera((100, 200)).roi
            Roi(left=0, top=0, right=199, bottom=99)
        """
        roi = Roi(0, 0, shape[1] - 1, shape[0] - 1)
        time = USUAL_MS if self.exposure_ms is None else float(self.exposure_ms)
        return CameraSettings(CAMERA_MODE, roi, time, int(self.averages))


_OF_PANEL = ("scintillator", "scintillator_mm", "packing", "swank", "electrons_per_keV",
             "offset_counts", "blur_mm", "gain_sigma", "offset_sigma_counts",
             "dead_fraction")  # fmt: skip
"""What a `Detector` states as a `Panel` does."""
_BOUNDS = {
    "pixel_mm": (1e-6, 100.0),
    "exposure_ms": (1e-6, 1e7),
    "averages": (1, 1_000_000),
    "bits": (1, 16),
    "electrons_per_count": (1e-6, 1e9),
    "electrons_per_keV": (1e-6, 1e6),
    "scintillator_mm": (1e-6, 100.0),
    "packing": (1e-3, 1.0),
    "swank": (1e-3, 1.0),
    "read_noise_e": (0.0, 1e9),
    "offset_counts": (0.0, 65535.0),
    "dark_e_per_s": (0.0, 1e12),
    "blur_mm": (0.0, 10.0),
    "gain_sigma": (0.0, 1.0),
    "offset_sigma_counts": (0.0, 65535.0),
    "dead_fraction": (0.0, 1.0),
    "serial": (0, 2**63 - 1),
}


def _filter(layer: tuple[str, float] | Filter) -> Filter:
    if isinstance(layer, Filter):
        return layer
    material, thickness_mm = layer
    return Filter(Substance.parse(material), float(thickness_mm))
