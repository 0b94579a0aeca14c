"""The flat panel: light, charge, noise, blur, fixed pattern and the converter, with provenance.

A pixel collects electrons in proportion to the energy its scintillator absorbs. `Panel` holds the
constants, and says of each default whether it is measured, from the literature or assumed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from flexdt.twin.attenuation.substances import Substance
from flexdt.twin.attenuation.tables import tables
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.machine.description import DetectorSpec
from flexdt.twin.physics.scintillator import deposited
from flexdt.twin.physics.spectrum import Filter


@dataclass(frozen=True)
class Panel:
    """A CsI(Tl) panel; the defaults are for a Dexela 1512NDT. What stands below each says
    where it comes from.

    Attributes:
        columns, rows, pitch_mm, bits: of the sensor, unbinned.
        row_pitch_mm: from row to row where that is not `pitch_mm`.
        scintillator: FORMULA@DENSITY, without gaps.
        scintillator_mm, packing: its thickness, and the part of it that is not gaps.
        swank: statistical factor of the light from one photon (1: always the same).
        electrons_per_keV: charge for each absorbed keV.
        full_well_e: of one unbinned pixel, for modes ending in High and Low.
        read_noise_e: of one read-out of an image pixel, for High and Low.
        offset_counts: level without charge.
        dark_e_per_s: charge without X-rays, each unbinned pixel.
        blur_mm: standard deviation of the light's spread in the scintillator.
        gain_sigma, offset_sigma_counts: fixed pattern, each unbinned pixel.
        dead_fraction: unbinned pixels that give nothing.
        lag_fraction, lag_s: part of the charge left for later frames, and how fast it fades.
        long_lag_fraction, long_lag_s: part of the charge that traps take from its own frame, and
            the time constant with which they give it back.
        serial: seed of the fixed pattern: another panel has another one.
        response: measured: energy of a photon and what it leaves on average [keV], instead of what
            is computed for the scintillator.
    """

    columns: int = 1944
    """Literature: data sheet, thesis 2.3."""
    rows: int = 1536
    """Literature: data sheet, thesis 2.3."""
    pitch_mm: float = 0.0748
    """Literature: data sheet, thesis 2.3."""
    bits: int = 14
    """Literature: thesis 2.3."""
    scintillator: str = "CsI@4.51"
    """Literature: data sheet."""
    scintillator_mm: float = 0.15
    """Assumed: a usual thickness for this family."""
    packing: float = 0.8
    """Assumed: usual for columnar CsI."""
    swank: float = 0.9
    """Assumed: usual for CsI(Tl)."""
    electrons_per_keV: float = 16.0
    """Assumed: between 10 and 25 for CsI(Tl) on CMOS."""
    full_well_e: tuple[float, float] = (1.6e6, 0.5e6)
    """Literature: Konstantinidis et al., NIM A 689 (2012) 12, the same sensor family."""
    read_noise_e: tuple[float, float] = (360.0, 165.0)
    """Literature: Konstantinidis et al., NIM A 689 (2012) 12, the same family."""
    offset_counts: float = 100.0
    """Assumed."""
    dark_e_per_s: float = 2000.0
    """Assumed."""
    blur_mm: float = 0.06
    """Assumed: half of the contrast at 3 line pairs a mm."""
    gain_sigma: float = 0.01
    """Assumed."""
    offset_sigma_counts: float = 1.0
    """Assumed."""
    dead_fraction: float = 1e-5
    """Assumed."""
    lag_fraction: float = 0.002
    """Assumed."""
    lag_s: float = 0.5
    """Assumed."""
    long_lag_fraction: float = 0.0
    """Assumed: none on CMOS; 0.001 to 0.004 of amorphous silicon (literature)."""
    long_lag_s: float = 10.0
    """Assumed: between the 3 and 20 s of amorphous silicon (literature)."""
    serial: int = 1512
    """Assumed."""
    row_pitch_mm: float | None = None
    """Literature: as pitch_mm."""
    response: tuple[tuple[float, float], ...] = ()
    """Assumed: computed for the scintillator."""

    @property
    def full_scale(self) -> int:
        """Largest count."""
        return (1 << self.bits) - 1

    def blur_px(self, camera: CameraSettings) -> tuple[float, float]:
        """Standard deviation of the light's spread along and across the rows [image pixels]."""
        row = self.pitch_mm if self.row_pitch_mm is None else self.row_pitch_mm
        sigma = self.blur_mm / camera.binning
        return sigma / self.pitch_mm, sigma / row

    def electrons_per_count(self, camera: CameraSettings) -> float:
        """Conversion gain: the unbinned pixel's full well fills the converter's depth."""
        return self.full_well_e[_well(camera)] / 2.0**self.bits

    def read_noise(self, camera: CameraSettings) -> float:
        """Standard deviation of one read-out of an image pixel [electrons].

        Pixels binned on the panel are read once; so are, assumed, those binned later.
        """
        return self.read_noise_e[_well(camera)]

    def charge_of_photons(self) -> tuple[FloatArray, FloatArray]:
        """Mean charge of a photon of each energy [electrons], and what it adds to the variance of
        a signal of many [electrons^2], (e,) both.

        The number of photons is Poisson's, each leaves a spread energy and that a spread charge.
        """
        full = Substance.parse(self.scintillator)
        layer = replace(full, density_g_cm3=full.density_g_cm3 * self.packing)
        part, square = deposited(Filter(layer, self.scintillator_mm))
        energy = tables().energy_keV
        if self.response:
            # What one photon leaves is spread as computed, for want of another measurement.
            spread, points = square / part, np.array([(0.0, 0.0), *self.response])
            part = np.interp(energy, *points.T) / energy
            square = part * np.maximum(spread, part)
        charge = energy * self.electrons_per_keV
        mean = part * charge
        return mean, square * charge**2 / self.swank + mean


def _well(camera: CameraSettings) -> int:
    """0 for modes of high full well, 1 for low ("High" means the full well: assumed)."""
    return 1 if camera.mode.strip().lower().endswith("low") else 0


def panel_of(spec: DetectorSpec) -> Panel:
    """The panel of a machine: its own size, pitch and depth, all else as for the default."""
    return Panel(
        columns=spec.columns, rows=spec.rows, pitch_mm=spec.pitch_mm, bits=spec.bits,
        row_pitch_mm=spec.row_pitch_mm, long_lag_fraction=spec.long_lag_fraction,
        long_lag_s=spec.long_lag_s, response=spec.response,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Pattern:
    """Fixed pattern of the image pixels: gain (mean 1), offset [counts], dead (True gives 0)."""

    gain: Float32Array
    offset: Float32Array
    dead: npt.NDArray[np.bool_]


@lru_cache(maxsize=8)
def pattern(panel: Panel, binning: int, roi: tuple[int, int, int, int]) -> Pattern:
    """The fixed pattern that image pixels of a mode and region of interest show.

    The unbinned pattern belongs to the panel, so every mode and region sees the same panel. An
    image pixel is dead when more than half of its pixels are.

    Args:
        panel: the detector.
        binning: unbinned pixels per image pixel along each side.
        roi: left, top, right, bottom, inclusive, unbinned.
    """
    rng = np.random.default_rng([panel.serial])
    shape = (panel.rows, panel.columns)
    gain = 1.0 + panel.gain_sigma * rng.standard_normal(shape, dtype=np.float32)
    offset = panel.offset_sigma_counts * rng.standard_normal(shape, dtype=np.float32)
    alive = rng.random(shape, dtype=np.float32) >= panel.dead_fraction
    b = binning
    left, top, right, bottom = roi
    rows, cols = (bottom - top + 1) // b, (right - left + 1) // b

    def blocks(values: npt.NDArray[np.float32]) -> Float32Array:
        part = values[top : top + rows * b, left : left + cols * b]
        mean: Float32Array = part.reshape(rows, b, cols, b).mean(axis=(1, 3), dtype=np.float32)
        return mean

    living = blocks(alive.astype(np.float32))
    made = Pattern(blocks(gain * alive), blocks(offset), living < 0.5)
    for array in (made.gain, made.offset, made.dead):
        array.flags.writeable = False
    return made
