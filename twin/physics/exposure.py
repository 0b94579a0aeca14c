"""From line integrals to the camera's counts: Beer-Lambert, dark level, noise, the 14-bit clip.

`expose` turns the chord sums of one image (or of several moments within one exposure)
into the camera's counts. The model is plain on purpose and its constants are assumed;
`chain` takes its place behind the same call. Random numbers are an argument, with one
generator for each frame, so that frames made in any order have the same bytes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.machine.description import Machine

BLOCK_PIXELS = 1 << 15
"""Number of pixels in a step (they stay in the cache); part of the noise's definition."""
FEW_COUNTS = 10.0
"""Signal above dark [counts] below which a pixel is starved: its logarithm is mostly noise."""
WARNING_SHARE = 1e-3
"""Part of the pixels from which saturated or starved ones cause a warning."""
MIN_GAUSSIAN_PHOTONS = 30.0
"""Expected photons below which a Gaussian approximates a Poisson distribution badly."""

Counts = npt.NDArray[np.uint16]


@dataclass(frozen=True)
class IdealResponse:
    """Counts of the `ideal` physics: linear, of tube and detector together. All values
    but `bits` are assumed.

    Attributes:
        bits: depth; counts are clipped to [0, 2^bits - 1].
        i0_counts: open-beam signal above dark at the reference settings. It scales with
            kV * power_W * exposure_ms, and knows no distance law.
        reference: (kV, W, ms) of `i0_counts`; default: the thesis's Listing 1.
        dark_counts: level without X-rays.
        photons_per_count: detected photons per count (sets the Poisson noise).
        read_noise_counts: standard deviation of one read-out.
    """

    bits: int = 14
    i0_counts: float = 12_000.0
    reference: tuple[float, float, float] = (90.0, 50.0, 100.0)
    dark_counts: float = 100.0
    photons_per_count: float = 4.0
    read_noise_counts: float = 2.0

    @property
    def full_scale(self) -> int:
        """Largest count."""
        return (1 << self.bits) - 1


@dataclass(frozen=True)
class ExposureSettings:
    """Tube and camera during one image; `averages` read-outs are averaged into it."""

    kV: float
    power_W: float
    exposure_ms: float
    averages: int = 1
    xrays_on: bool = True

    @property
    def duration_s(self) -> float:
        """Duration of all read-outs together [s]."""
        return self.exposure_ms * self.averages / 1000.0


def ideal_response(machine: Machine) -> IdealResponse:
    """Make the ideal response of `machine`: at the machine's own voltage, power and
    exposure an open beam fills 3/4 of the detector's depth of bits. Dark level and noise
    are scaled to that depth."""
    model = IdealResponse()
    tube = machine.tube
    scale = 2.0 ** (machine.detector.bits - model.bits)
    return IdealResponse(
        bits=machine.detector.bits,
        i0_counts=model.i0_counts * scale,
        reference=(tube.kV, tube.power_W, machine.detector.exposure_ms),
        dark_counts=model.dark_counts * scale,
        read_noise_counts=model.read_noise_counts * scale,
        photons_per_count=model.photons_per_count / scale,
    )


def open_beam(model: IdealResponse, settings: ExposureSettings) -> float:
    """Compute the counts above dark of a ray that meets nothing; 0 with X-rays off.

    They are proportional to voltage, power and time.
    """
    if not settings.xrays_on:
        return 0.0
    kV, power, exposure = model.reference
    return (
        model.i0_counts
        * (settings.kV / kV)
        * (settings.power_W / power)
        * (settings.exposure_ms / exposure)
    )


def frame_rng(seed: int, index: int) -> np.random.Generator:
    """Make the generator of one image's noise, independent of every other image's.

    Args:
        seed: the scan's, >= 0.
        index: number of the image within its scan, darks and flats counted.
    """
    return np.random.default_rng([seed, index])


def expose(
    model: IdealResponse,
    line_integrals: Float32Array,
    settings: ExposureSettings,
    rng: np.random.Generator | None = None,
) -> Counts:
    """Compute the counts of one image: open beam times exp(-line integrals), dark level,
    noise, clipped to 0 and full scale.

    Args:
        model: of tube and detector.
        line_integrals: float32 (rows, cols), or (moments, rows, cols) spread evenly over
            the exposure: intensities are averaged, as a moving object blurs. Not changed.
        settings: tube and camera.
        rng: generator of this frame's noise; None for the expectation, rounded.

    Returns:
        uint16 (rows, cols).
    """
    moments = line_integrals.reshape((-1, *line_integrals.shape[-2:]))
    shape = moments.shape[1:]
    flat = moments.reshape(len(moments), -1)
    out = np.empty(flat.shape[1], dtype=np.uint16)
    open_counts = np.float32(open_beam(model, settings))
    for start in range(0, flat.shape[1], BLOCK_PIXELS):
        part = slice(start, start + BLOCK_PIXELS)
        if open_counts > 0.0:
            signal = np.exp(-flat[:, part]).sum(axis=0) * np.float32(1.0 / len(moments))
            signal *= open_counts
        else:
            signal = np.zeros_like(flat[0, part])
        if rng is not None:
            signal = _noisy(model, settings, rng, signal)
        signal += np.float32(model.dark_counts + 0.5)
        # Truncated; the half above makes it rounding.
        out[part] = np.clip(signal, 0.0, model.full_scale)
    return out.reshape(shape)


def _noisy(
    model: IdealResponse,
    settings: ExposureSettings,
    rng: np.random.Generator,
    signal: Float32Array,
) -> Float32Array:
    """Add the noise of a saved image to `signal` in place, and return it.

    Photons are drawn from Poisson's distribution where fewer than `MIN_GAUSSIAN_PHOTONS` are
    expected, else from a normal one. Read noise is normal; averaging reduces both.

    `model`: photons in a count, and read noise; `settings`: number of read-outs that are
    averaged; `rng`: source of random numbers; `signal`: expected counts above dark, (n,).
    """
    photons = np.float32(model.photons_per_count * settings.averages)
    variance = signal / photons
    if settings.xrays_on and signal.min() * photons < MIN_GAUSSIAN_PHOTONS:
        few = np.flatnonzero(signal * photons < MIN_GAUSSIAN_PHOTONS)
        signal[few] = rng.poisson(signal[few] * photons) / photons
        variance[few] = 0.0
    variance += np.float32(model.read_noise_counts**2 / settings.averages)
    signal += np.sqrt(variance) * rng.standard_normal(len(signal), dtype=np.float32)
    return signal
