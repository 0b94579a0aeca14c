"""The flat panel: light, charge, noise, blur, fixed pattern and the converter, with provenance.

A pixel collects electrons in proportion to the energy its scintillator absorbs.
`Detector` holds the figures, and labels each default as measured, from the literature or
assumed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from flexdt.twin.attenuation.substances import Substance, tables
from flexdt.twin.errors import LimitError, require_within
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.machine.camera import CameraSettings, PixelGrid, Roi
from flexdt.twin.machine.description import DetectorSpec
from flexdt.twin.physics.scintillator import deposited
from flexdt.twin.physics.tube import Filter
from flexdt.twin.signatures import public

FULL_WELL_E = 1.6e6, 0.5e6
"""Full well of a pixel in modes ending in High and Low [electrons].

Konstantinidis et al., NIM A 689 (2012) 12, the same sensor family.
"""
LOW_READ_NOISE = 165.0 / 360.0
"""Read noise of modes ending in Low, as a part of that of High: the same paper."""
DARK_E_PER_S = 2000.0
"""Dark charge of an unbinned pixel [electrons/s] (assumed)."""
CAMERA_MODE = "HW1SW1High"
"""Camera mode that reads out unbinned pixels."""
EXPOSURES_MS = 1e-6, 1e7
"""Shortest and longest exposure of one read-out [ms]."""
USUAL_MS = 100.0
"""Exposure of a `Detector` that states none, if no tube determines the brightness
of its images [ms]."""
_OPTIONAL_FIGURES = {"pixel_mm", "exposure_ms", "electrons_per_count", "dark_e_per_s"}
_BOUNDS = {
    "pixel_mm": (1e-6, 100.0),
    "exposure_ms": EXPOSURES_MS,
    "averages": (1, 1_000_000),
    "bits": (1, 16),
    "electrons_per_count": (1e-18, 1e18),
    "electrons_per_keV": (1e-6, 1e6),
    "scintillator_mm": (1e-6, 100.0),
    "packing": (1e-3, 1.0),
    "swank": (1e-3, 1.0),
    "read_noise_e": (0.0, 1e9),
    "offset_counts": (0.0, 65535.0),
    "dark_e_per_s": (0.0, 1e18),
    "blur_mm": (0.0, 10.0),
    "gain_sigma": (0.0, 1.0),
    "offset_sigma_counts": (0.0, 65535.0),
    "dead_fraction": (0.0, 1.0),
    "serial": (0, 2**63 - 1),
    "lag_fraction": (0.0, 1.0),
    "lag_s": (1e-6, 1e7),
    "long_lag_fraction": (0.0, 1.0),
    "long_lag_s": (1e-6, 1e7),
}
"""Smallest and largest allowed value of each figure."""


@public
@dataclass(frozen=True, kw_only=True)
class Detector:
    """A flat panel with a scintillator, of any make; the defaults are the twin's, a
    Dexela 1512NDT with CsI(Tl). The text below each field has its origin.

    The number and size of the pixels come from the geometry in `simulate`.

    Args:
        pixel_mm: pitch of the pixels [mm]; None for the geometry's. Another pitch than
            the geometry's is an error.
        exposure_ms: of one read-out [ms]; None: `flexdt.simulate` chooses it so that the
            brightest pixel of the open beam reaches 80 % of the largest count.
        averages: read-outs averaged into an image.
        bits: depth, 1 to 16; counts end at 2^bits - 1.
        electrons_per_count: conversion gain; a pixel saturates at 2^bits times that.
            None: so that a pixel of 14 bits holds as much charge for its area as the
            twin's.
        electrons_per_keV: charge for each keV that the scintillator keeps.
        scintillator: FORMULA@DENSITY [g/cm3] without gaps, such as Gd2O2S@7.34.
        scintillator_mm: its thickness [mm]; packing: the part of it that is not gaps.
        swank: statistical factor of the light from one photon (1: always the same).
        read_noise_e: standard deviation of one read-out of an image pixel [electrons].
        offset_counts: level without charge [counts].
        dark_e_per_s: charge of an unbinned pixel without X-rays [electrons/s]; None: as
            much for its area as the twin's.
        blur_mm: standard deviation of the point spread in the scintillator [mm].
        gain_sigma, offset_sigma_counts: fixed pattern of gain (relative) and offset
            [counts], each unbinned pixel.
        dead_fraction: unbinned pixels that give nothing.
        serial: seed of the fixed pattern: another panel has another one.
        pixels: of the panel, unbinned; `simulate` takes the geometry's.
        lag_fraction, lag_s: part of the charge left for later images of a scan on the
            scanner, and how fast it fades [s]; `simulate` has none.
        long_lag_fraction, long_lag_s: part of the charge that traps take from its own
            image there, and the time constant with which they give it back [s].
        response: measured: energy of a photon and what it leaves on average [keV],
            instead of what is computed for the scintillator.

    Raises:
        LimitError: a figure that no detector has; the message lists the allowed values.
        UnknownNameError: a scintillator of an element without a table.

    Example:
        >>> Detector(bits=16, electrons_per_count=20).full_scale
        65535
    """

    pixel_mm: float | None = None
    """Assumed: as the geometry has it."""
    exposure_ms: float | None = None
    """Assumed."""
    averages: int = 1
    """Assumed."""
    bits: int = 14
    """Literature: thesis 2.3."""
    electrons_per_count: float | None = None
    """Literature: FULL_WELL_E over the converter's depth."""
    electrons_per_keV: float = 16.0
    """Assumed: between 10 and 25 for CsI(Tl) on CMOS."""
    scintillator: str = "CsI@4.51"
    """Literature: data sheet."""
    scintillator_mm: float = 0.15
    """Assumed: a usual thickness for this family."""
    packing: float = 0.8
    """Assumed: usual for columnar CsI."""
    swank: float = 0.9
    """Assumed: usual for CsI(Tl)."""
    read_noise_e: float = 360.0
    """Literature: Konstantinidis et al., NIM A 689 (2012) 12, the same family."""
    offset_counts: float = 100.0
    """Assumed."""
    dark_e_per_s: float | None = None
    """Assumed: DARK_E_PER_S."""
    blur_mm: float = 0.06
    """Assumed: half of the contrast at 3 line pairs a mm."""
    gain_sigma: float = 0.01
    """Assumed."""
    offset_sigma_counts: float = 1.0
    """Assumed."""
    dead_fraction: float = 1e-5
    """Assumed."""
    serial: int = 1512
    """Assumed."""
    pixels: Annotated[PixelGrid, "or its JSON"] = field(default_factory=PixelGrid)
    """Literature: see `PixelGrid`."""
    lag_fraction: float = 0.002
    """Assumed."""
    lag_s: float = 0.5
    """Assumed."""
    long_lag_fraction: float = 0.0
    """Assumed: none on CMOS; 0.001 to 0.004 of amorphous silicon (literature)."""
    long_lag_s: float = 10.0
    """Assumed: between the 3 and 20 s of amorphous silicon (literature)."""
    response: tuple[tuple[float, float], ...] = ()
    """Assumed: computed for the scintillator."""

    def __post_init__(self) -> None:
        """Check the figures' ranges (`_BOUNDS`), and convert a mapping of pixels to
        `PixelGrid`, the response to pairs of floats, and bits, averages and serial to
        whole numbers.

        Figures of `_OPTIONAL_FIGURES` may be None.

        Raises:
            LimitError: a figure out of its range, or an unknown scintillator.
        """
        for name, (low, high) in _BOUNDS.items():
            value = getattr(self, name)
            if value is not None or name not in _OPTIONAL_FIGURES:
                require_within(f"Detector: {name}", value, low, high)
        if isinstance(self.pixels, Mapping):
            object.__setattr__(self, "pixels", PixelGrid(**self.pixels))
        response = tuple((float(energy), float(left)) for energy, left in self.response)
        object.__setattr__(self, "response", response)
        Substance.parse(self.scintillator)
        for name in ("bits", "averages", "serial"):
            object.__setattr__(self, name, int(getattr(self, name)))

    @classmethod
    def ideal(cls, **figures: Any) -> Detector:
        """Make a detector whose only noise is that of the X-rays: every photon leaves all
        of its energy, and there is no blur, pattern, dark charge, dead pixel or read
        noise; `figures` replace fields (`response=()`: that of its scintillator).

        Example:
            >>> mean, _ = Detector.ideal(bits=16).charge_of_photons()
            >>> bool(np.allclose(mean, tables().energy_keV * 16.0))
            True
        """
        nothing = dict.fromkeys(
            (
                "read_noise_e",
                "dark_e_per_s",
                "blur_mm",
                "gain_sigma",
                "offset_sigma_counts",
                "dead_fraction",
            ),
            0.0,
        )
        cls(**figures)  # so that a mistake is told beside what was given alone
        all_of_it = ((0.1, 0.1), (1e4, 1e4))
        return cls(**{"swank": 1.0, "response": all_of_it, **nothing, **figures})

    def of_pixels(self, pixels: PixelGrid) -> Detector:
        """Return this detector with the pixels of a geometry.

        Where it states none, electrons per count and dark charge become those of the
        pixel's area.

        Args:
            pixels: number of columns and rows, and pitch [mm].

        Raises:
            LimitError: the detector's `pixel_mm` differs from the pitch by more than 1e-6
                of it.

        Example:
            >>> Detector(electrons_per_count=20).of_pixels(PixelGrid(200, 100, 0.1)).pixels.size_mm
            (20.0, 10.0)
        """
        pitch = pixels.pitch_mm
        if self.pixel_mm is not None and abs(self.pixel_mm - pitch) > 1e-6 * pitch:
            message = (
                f"the detector's pixel_mm is {self.pixel_mm:g} mm, "
                f"the geometry's {pitch:g} mm"
            )
            raise LimitError.instead(message, self.pixel_mm, pitch, unit="mm")
        across, up = pixels.edges_mm
        # In pixels of the twin as it is usually read out, binned 2 x.
        area = across * up / (2 * PixelGrid.pitch_mm) ** 2
        gain = self.electrons_per_count
        if gain is None:
            gain = FULL_WELL_E[0] * area / 2.0**self.bits
        dark = self.dark_e_per_s
        if dark is None:
            dark = 4.0 * DARK_E_PER_S * area
        return replace(self, pixels=pixels, electrons_per_count=gain, dark_e_per_s=dark)

    def camera(self, shape: tuple[int, int]) -> CameraSettings:
        """Make camera settings that read out all of (rows, cols) pixels, unbinned; the
        exposure is the detector's, or `USUAL_MS` where it states none.

        Example:
            >>> Detector(exposure_ms=50).camera((100, 200)).roi
            Roi(left=0, top=0, right=199, bottom=99)"""
        roi = Roi(0, 0, shape[1] - 1, shape[0] - 1)
        if self.exposure_ms is None:
            time = USUAL_MS
        else:
            time = float(self.exposure_ms)
        return CameraSettings(CAMERA_MODE, roi, time, self.averages)

    @property
    def full_scale(self) -> int:
        """Largest count."""
        return (1 << self.bits) - 1

    def blur_px(self, camera: CameraSettings) -> tuple[float, float]:
        """Compute the standard deviation of the light's spread along and across the
        rows [image pixels].

        Example:
            >>> panel = Detector(blur_mm=0.3, pixels=PixelGrid(4, 4, 0.1))
            >>> [round(sigma, 6) for sigma in panel.blur_px(panel.camera((4, 4)))]
            [3.0, 3.0]"""
        across, up = self.pixels.edges_mm
        sigma = self.blur_mm / camera.binning
        return sigma / across, sigma / up

    def gain(self, camera: CameraSettings) -> float:
        """Compute the electrons in each count.

        That of the detector where it states one. Else the unbinned pixel's full well of
        the camera's mode (high or low) fills the converter's depth, and is in proportion
        to the pixel's area.

        Example:
            >>> panel = Detector(electrons_per_count=20)
            >>> panel.gain(panel.camera((4, 4)))
            20"""
        if self.electrons_per_count is not None:
            return self.electrons_per_count
        across, up = self.pixels.edges_mm
        area = across * up / PixelGrid.pitch_mm**2
        return FULL_WELL_E[_is_low(camera)] * area / 2.0**self.bits

    def read_noise(self, camera: CameraSettings) -> float:
        """Compute the standard deviation of one read-out of an image pixel [electrons].

        Pixels binned on the panel are read once; so are, assumed, those binned later.

        Example:
            >>> panel = Detector(read_noise_e=200.0)
            >>> panel.read_noise(panel.camera((4, 4)))
            200.0"""
        return self.read_noise_e * (LOW_READ_NOISE if _is_low(camera) else 1.0)

    def dark_charge(self, camera: CameraSettings) -> float:
        """Compute the charge of an image pixel without X-rays [electrons/s]: that of an
        unbinned pixel, stated or `DARK_E_PER_S`, times the binned pixels.

        Example:
            >>> panel = Detector(dark_e_per_s=100.0)
            >>> panel.dark_charge(panel.camera((4, 4)))
            100.0"""
        if self.dark_e_per_s is None:
            each = DARK_E_PER_S
        else:
            each = self.dark_e_per_s
        return each * camera.binning**2

    def figures(self) -> dict[str, float]:
        """List its figures by name, for data sets; without the camera's settings.

        Full well, read noise and dark charge are those in force. Long lag is left out if
        it is zero; text and None are left out. The scintillator is named by a figure of
        1.

        Example:
            >>> Detector(bits=12).figures()["bits"]
            12.0
        """
        left_out = {
            "pixel_mm",
            "exposure_ms",
            "averages",
            "electrons_per_count",
            "read_noise_e",
        }
        if (
            self.long_lag_fraction == 0.0
        ):  # as before there was any, so that older scans go on
            left_out |= {"long_lag_fraction", "long_lag_s"}
        held = {
            name: float(value)
            for name, value in {**vars(self.pixels), **vars(self)}.items()
            if isinstance(value, int | float) and name not in left_out
        }
        for well in ("High", "Low"):
            camera = replace(self.camera((1, 1)), mode=f"HW1SW1{well}")
            held[f"full_well_e_{well.lower()}"] = self.gain(camera) * 2.0**self.bits
            held[f"read_noise_e_{well.lower()}"] = self.read_noise(camera)
        held["dark_e_per_s"] = self.dark_charge(camera)
        held[f"scintillator_{self.scintillator}"] = 1.0
        return held | {
            f"response_{energy:g}_keV": float(left) for energy, left in self.response
        }

    def charge_of_photons(self) -> tuple[FloatArray, FloatArray]:
        """Compute the mean charge of a photon of each energy [electrons], and its
        contribution to the variance of a signal of many [electrons^2], (e,) both.

        The number of photons is Poisson's, each leaves a spread energy and that a spread
        charge. The mean energy is the stated response, interpolated from (0, 0) on, or
        else the scintillator's computed one.

        Example:
            >>> charge, variance = Detector().charge_of_photons()
            >>> charge.shape == variance.shape, bool((charge >= 0).all())
            (True, True)
        """
        full = Substance.parse(self.scintillator)
        layer = replace(full, density_g_cm3=full.density_g_cm3 * self.packing)
        part, square = deposited(Filter(layer, self.scintillator_mm))
        energy = tables().energy_keV
        if self.response:
            # The spread of one photon's energy is the computed one, for want of a measurement.
            spread = square / part
            points = np.array([(0.0, 0.0), *self.response])
            part = np.interp(energy, *points.T) / energy
            square = part * np.maximum(spread, part)
        charge = energy * self.electrons_per_keV
        mean = part * charge
        return mean, square * charge**2 / self.swank + mean


def _is_low(camera: CameraSettings) -> bool:
    """Return whether a mode has the low full well ("High" means the full well: assumed)."""
    return camera.mode.strip().lower().endswith("low")


def detector_of(spec: DetectorSpec) -> Detector:
    """Make the detector model of a machine: pixels, bits, lag and response as in its
    file, other figures by default.
    """
    return Detector(
        pixels=spec.pixels,
        bits=spec.bits,
        long_lag_fraction=spec.long_lag_fraction,
        long_lag_s=spec.long_lag_s,
        response=spec.response,
    )


@dataclass(frozen=True, eq=False)
class Pattern:
    """Fixed pattern of the image pixels: gain (mean 1), offset [counts], dead
    (True gives 0)."""

    gain: Float32Array
    offset: Float32Array
    dead: npt.NDArray[np.bool_]


@lru_cache(maxsize=8)
def pattern(panel: Detector, binning: int, roi: tuple[int, int, int, int]) -> Pattern:
    """Draw the fixed pattern that image pixels of a mode and region of interest show.

    The unbinned pattern belongs to the panel, so every mode and region sees the same
    panel. An image pixel is dead when more than half of its pixels are.

    Args:
        panel: the detector.
        binning: unbinned pixels per image pixel along each side.
        roi: left, top, right, bottom, inclusive, unbinned.

    Returns:
        Gain, offset [counts] and dead pixels, (rows, cols) each, read-only; the last 8
        are kept. The seed is the panel's serial number.
    """
    rng = np.random.default_rng([panel.serial])
    shape = (panel.pixels.rows, panel.pixels.columns)
    gain = 1.0 + panel.gain_sigma * rng.standard_normal(shape, dtype=np.float32)
    offset = panel.offset_sigma_counts * rng.standard_normal(shape, dtype=np.float32)
    alive = rng.random(shape, dtype=np.float32) >= panel.dead_fraction
    b = binning
    left, top, right, bottom = roi
    rows = (bottom - top + 1) // b
    cols = (right - left + 1) // b

    def blocks(values: npt.NDArray[np.float32]) -> Float32Array:
        """Average the b x b unbinned panel pixels of each image pixel, (rows, cols)."""
        part = values[top : top + rows * b, left : left + cols * b]
        mean: Float32Array = part.reshape(rows, b, cols, b).mean(
            axis=(1, 3), dtype=np.float32
        )
        return mean

    living = blocks(alive.astype(np.float32))
    drawn = Pattern(blocks(gain * alive), blocks(offset), living < 0.5)
    for array in (drawn.gain, drawn.offset, drawn.dead):
        array.flags.writeable = False
    return drawn
