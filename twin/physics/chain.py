"""The whole chain for one image: path lengths through materials to the counts that are saved.

There are two steps, so that the second can depend on earlier frames: `radiographs` are free of
noise and depend on geometry, tube and sample; `read_out` adds lag, noise, blur, fixed pattern and
conversion. Random numbers are an argument. Scattered radiation is `flexdt.twin.physics.scatter`'s.
The twin server and `flexdt.simulate` both make images with these functions, so a simulated data set
and a scan of the twin differ in nothing but their geometry.

The blur has the requested variance, however narrow it is. From 0.7 pixels on its kernel is a
Gaussian at the pixels' centres, whose modulation is a Gaussian's up to the Nyquist frequency.
Samples of a narrower one would lose variance: there it is the discrete Gaussian exp(-t) I_n(t),
whose modulation is exp(-2 t sin^2(pi f)) and so more than a Gaussian's at high frequencies.

Noise of the X-rays is blurred as light is that spreads before pixels collect it: its spectrum is
that of light and aperture together, folded back at the Nyquist frequency.

Image quality before a scan (what a ray's pixel will read, its noise, the dose on the axis) comes
from exact sums over the spectrum for a few rays, where whole images have effective energies. The
noise is that of one saved image: quanta, whose noise the scintillator's light spreads over the
neighbours, read-out and rounding; structure that a flat image corrects is no noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.attenuation.scattering import ELECTRON_KEV, cross_sections
from flexdt.twin.attenuation.substances import Substance
from flexdt.twin.errors import LimitError
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.physics.detector import Detector, pattern
from flexdt.twin.physics.effective import EffectiveBeam, effective_beam
from flexdt.twin.physics.exposure import FEW, Counts, ExposureSettings
from flexdt.twin.physics.tube import TubeModel, monochromatic, tube_spectrum

FWHM = 2.3548200450309493
"""Full width at half maximum of a Gaussian of standard deviation 1."""
SAMPLED = 0.7
"""Standard deviation from which samples of a Gaussian have its variance [pixels]."""
NARROWEST = 0.02
"""Standard deviation below which nothing is done [pixels]."""
WIDEST = 1000.0
"""Standard deviation of a blur at most [pixels]."""
MOST_RAYS = 16
"""Along each side of a pixel."""
FREQUENCIES, FOLDS = 512, 20
"""Samples of a noise spectrum at least, and spectra on either side that are folded into it."""


def kernel(sigma_px: float) -> Float32Array:
    """Weights of the blur, (2 r + 1,), adding up to 1."""
    from scipy.special import ive

    t = sigma_px * sigma_px
    reach = max(1, int(np.ceil(4.0 * sigma_px + 1.0)))
    n = np.arange(-reach, reach + 1)
    weights = np.exp(n * n / (-2.0 * t)) if sigma_px >= SAMPLED else ive(np.abs(n), t)
    return np.asarray(weights / weights.sum(), dtype=np.float32)


@lru_cache(maxsize=16)
def noise_kernel(sigma_px: float) -> Float32Array:
    """Weights that give white noise of the pixels' photons the spectrum it has where light spreads
    with `sigma_px` before pixels collect it, (2 r + 1,); see `noise_spectrum`."""
    reach = int(np.ceil(4.0 * sigma_px + 3.0))
    frequency = np.fft.fftfreq(max(FREQUENCIES, 4 * reach)).astype(np.float64)
    modulation = np.sqrt(noise_spectrum(frequency, sigma_px))
    weights = np.fft.ifft(modulation).real
    return np.asarray(weights[np.arange(-reach, reach + 1)], dtype=np.float32)


def noise_spectrum(frequency: FloatArray, sigma_px: float) -> FloatArray:
    """Noise power of a flat image by frequency [cycles a pixel], 1 at none: light's and aperture's
    modulation squared, with all that is folded back."""
    f = frequency[..., None] + np.arange(-FOLDS, FOLDS + 1)
    return np.asarray((np.sinc(f) ** 2 * np.exp(-((2.0 * np.pi * f * sigma_px) ** 2))).sum(axis=-1))


def blurred(
    image: Float32Array,
    sigma_px: float,
    across_px: float | None = None,
    *,
    weights: Callable[[float], Float32Array] = kernel,
) -> Float32Array:
    """`image` (rows, cols) blurred along its rows and, by default alike, across them; edges go on
    as their last pixel."""
    across = sigma_px if across_px is None else across_px
    if not (widest := max(sigma_px, across)) <= WIDEST:
        said = f"a blur of {widest:.3g} pixels (standard deviation)"
        cure = "a smaller focal spot, less power, less magnification or larger pixels"
        raise LimitError.instead(said, widest, f"{WIDEST:g}, by {cure}")
    if widest < NARROWEST:
        return image
    import cv2

    u, v = weights(sigma_px), weights(across)
    out = cv2.sepFilter2D(image, cv2.CV_32F, u, v, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(out, dtype=np.float32)


REFERENCE_MM = 1000.0
"""Distance at which the tables state the fluence."""


@dataclass(frozen=True)
class Chain:
    """Tube, sample's materials and panel.

    Attributes:
        panel: the detector.
        tube: the source.
        substances: of the sample, in the order of the path lengths.
        thickest_mm: longest path through each [mm]; effective energies hold up to there.
        mono_keV: all photons have this energy, as many as give the spectrum's open-beam signal;
            None for the whole spectrum.
    """

    panel: Detector
    tube: TubeModel = field(default_factory=TubeModel)
    substances: tuple[Substance, ...] = ()
    thickest_mm: tuple[float, ...] = ()
    mono_keV: float | None = None


@dataclass(frozen=True, eq=False)
class Expected:
    """What one read-out holds on average: electrons and their variance, float32 (rows, cols)."""

    mean_e: Float32Array
    variance_e: Float32Array


@lru_cache(maxsize=32)
def beam_of(chain: Chain, kV: float) -> EffectiveBeam:
    """Effective energies of the chain at a voltage.

    Weights are electrons and their variance per cm2 of pixel and mAs at 1 m.
    """
    signal, noise = weights_of(chain, kV)
    beam = effective_beam(signal, noise, chain.substances, chain.thickest_mm)
    if chain.mono_keV is None:
        return beam
    mu = [s.attenuation_at(chain.mono_keV) for s in chain.substances]
    return replace(beam, mu=np.reshape(mu, (len(mu), 1)))


def weights_of(chain: Chain, kV: float) -> tuple[FloatArray, FloatArray]:
    """What each energy adds to an open pixel's electrons and to their variance, (e,) both.

    Per cm2 of pixel and mAs, 1 m from the source. The variance is that of a compound Poisson
    process: photons are counted, each gives a spread amount of charge.
    """
    charge, variance = chain.panel.charge_of_photons()
    fluence = tube_spectrum(kV, chain.tube).fluence
    if chain.mono_keV is not None:
        one = monochromatic(chain.mono_keV).fluence
        fluence = one * float((fluence @ charge) / (one @ charge))
    return fluence * charge, fluence * variance


def mAs(exposure: ExposureSettings) -> float:
    """Charge through the tube in one read-out [mAs]: W / kV is mA."""
    if not exposure.xrays_on:
        return 0.0
    return exposure.power_W / exposure.kV * exposure.exposure_ms / 1000.0


def expected_signal(
    chain: Chain,
    paths_mm: Float32Array,
    view: npt.ArrayLike,
    exposure: ExposureSettings,
) -> Expected:
    """Noise-free charge of one image.

    Args:
        chain: tube, materials, panel.
        paths_mm: float32 (m, rows, cols), or (m, moments, rows, cols) spread evenly over the
            exposure; one channel a substance [mm].
        view: the cone_vec row (12,) of the image [mm]; distances give flux and focal-spot blur.
        exposure: tube and time.

    Returns:
        Electrons of one read-out.
    """
    shape = (int(paths_mm.shape[-2]), int(paths_mm.shape[-1]))
    if not exposure.xrays_on:
        dark = np.zeros(shape, np.float32)
        return Expected(dark, dark)
    row = np.asarray(view, dtype=np.float64)
    count = paths_mm.shape[1] if paths_mm.ndim == 4 else 1
    moments = paths_mm.reshape(len(chain.substances), count, *shape)
    mean, variance = beam_of(chain, exposure.kV).transmit(moments)
    one, spread = mean.mean(axis=0), variance.mean(axis=0)
    spot = spot_blur_px(row, chain.tube.focal_spot_mm(exposure.power_W))
    across = spot * float(np.linalg.norm(row[6:9]) / np.linalg.norm(row[9:12]))
    flux = flux_of(row, shape) * np.float32(mAs(exposure))
    return Expected(blurred(one, spot, across) * flux, blurred(spread, spot, across) * flux)


def read_out(
    panel: Detector,
    expected: Expected,
    camera: CameraSettings,
    exposure: ExposureSettings,
    rng: np.random.Generator | None = None,
    before: Sequence[tuple[Float32Array, float]] = (),
    trapped: Float32Array | None = None,
) -> Counts:
    """The image that is saved.

    Args:
        panel: the detector.
        expected: from `expected_signal`.
        camera: mode and region of interest.
        exposure: time and averages.
        rng: generator of this frame's noise; None for the expectation.
        before: noise-free electrons of earlier frames, each with the time [s] from its end to
            this frame's start: what they leave behind is added.
        trapped: electrons in traps at the frame's start, from `trapped_after`; None without long
            lag. What they give back meanwhile is added, what they take is lost.

    Returns:
        uint16 (rows, cols).

    Raises:
        LimitError: the signal has not the camera's shape, as one of another panel has not.
    """
    shape = (int(expected.mean_e.shape[0]), int(expected.mean_e.shape[1]))
    if shape != camera.shape:
        what = "signal and camera of different panels or modes: pixels (rows, columns)"
        raise LimitError.of_shape(what, shape, camera.shape)
    charge = expected.mean_e.copy()
    variance = expected.variance_e
    for earlier, gap_s in before:
        left = panel.lag_fraction * np.exp(-max(gap_s, 0.0) / panel.lag_s)
        charge += np.float32(left) * earlier
    averages = exposure.averages
    if trapped is not None:
        given = -np.expm1(-exposure.duration_s / panel.long_lag_s) / averages
        charge += np.float32(given) * trapped
        charge -= np.float32(panel.long_lag_fraction) * expected.mean_e
    blur = panel.blur_px(camera)
    noise = None if rng is None else _quantum_noise(charge, variance, averages, rng)
    charge = blurred(charge, *blur)
    if noise is not None:
        charge = charge + blurred(noise, *blur, weights=noise_kernel)
    fixed = pattern(panel, camera.binning, camera.roi.edges)
    charge = charge * fixed.gain
    charge += np.float32(panel.dark_charge(camera) * exposure.exposure_ms / 1000.0)
    per_count = panel.gain(camera)
    if rng is not None:
        electronic = np.float32(panel.read_noise(camera) / np.sqrt(averages))
        charge += electronic * rng.standard_normal(shape, dtype=np.float32)
    counts = charge * np.float32(1.0 / per_count)
    counts += fixed.offset + np.float32(panel.offset_counts)
    np.rint(counts, out=counts)
    np.clip(counts, 0.0, panel.full_scale, out=counts)
    counts[fixed.dead] = 0.0
    return counts.astype(np.uint16)


def trapped_after(
    panel: Detector,
    trapped: Float32Array,
    expected: Expected | None,
    exposure: ExposureSettings,
    gap_s: float,
) -> Float32Array:
    """Electrons in traps when the next frame starts, (rows, cols).

    Args:
        panel: the detector.
        trapped: at the frame's start, (rows, cols).
        expected: what falls on the panel in the frame; None in the dark.
        exposure: of the frame.
        gap_s: from its end to the next frame's start.
    """
    left = trapped * np.float32(np.exp(-(exposure.duration_s + gap_s) / panel.long_lag_s))
    if expected is not None:
        taken = panel.long_lag_fraction * exposure.averages * np.exp(-gap_s / panel.long_lag_s)
        left += np.float32(taken) * expected.mean_e
    return left


def _quantum_noise(
    mean: Float32Array, variance: Float32Array, averages: int, rng: np.random.Generator
) -> Float32Array:
    """One draw of what the charge has more than its mean, of variance / averages.

    Gaussian where many quanta come; where few do, whole quanta of the size that gives the variance.
    """
    out = rng.standard_normal(mean.shape, dtype=np.float32)
    out *= np.sqrt(variance * np.float32(1.0 / averages))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        quanta = mean * mean * np.float32(averages) / variance
    few = np.flatnonzero((quanta < FEW).ravel() & (quanta > 0.0).ravel())
    if len(few):
        each = mean.ravel()[few] / quanta.ravel()[few]
        out.ravel()[few] = (rng.poisson(quanta.ravel()[few]) - quanta.ravel()[few]) * each
    return np.asarray(out)


def spot_blur_px(view: FloatArray, spot_mm: float, towards_mm: float = 0.0) -> float:
    """Standard deviation of the focal spot's image at the magnification of what stands on the
    rotation axis, or `towards_mm` nearer to the source [pixels]."""
    source, centre, u, v = view[0:3], view[3:6], view[6:9], view[9:12]
    normal = np.cross(u, v)
    to_axis, to_panel = float(-source @ normal), float((centre - source) @ normal)
    near = to_axis - towards_mm * float(np.linalg.norm(normal))
    magnification = to_panel / (max(near, 1e-3 * to_axis) or 1e-300)
    return max(0.0, magnification - 1.0) * spot_mm / FWHM / float(np.linalg.norm(u))


def spot_views(rows: FloatArray, spot_mm: float, points: int) -> FloatArray:
    """Views (n, 12) from so many points of a Gaussian focal spot, (n * points, 12): their mean has
    the spot's blur at every depth. A spiral, so that no two points lie behind one another.

    Args:
        rows: cone_vec rows.
        spot_mm: full width at half maximum.
        points: from each view, at least 3.
    """
    k = (np.arange(points) + points // 2) % points  # the innermost in the middle
    turn = np.pi * (3.0 - np.sqrt(5.0)) * k
    radius = np.sqrt(-2.0 * np.log1p(-(k + 0.5) / points))
    places = radius * np.array([np.cos(turn), np.sin(turn)])
    places -= places.mean(axis=1, keepdims=True)
    places = np.linalg.solve(np.linalg.cholesky(np.cov(places, bias=True)), places)
    edges = rows[:, 6:].reshape(-1, 2, 3)
    edges = edges / np.linalg.norm(edges, axis=2, keepdims=True) * (spot_mm / FWHM)
    out = np.repeat(rows[:, None], points, axis=1)
    out[:, :, :3] += np.einsum("ak,nax->nkx", places, edges)
    return out.reshape(-1, 12)


def without_spot(chain: Chain) -> Chain:
    """The chain for views from `spot_views`, whose mean has the spot's blur already."""
    return replace(chain, tube=replace(chain.tube, spot_mm_per_W=0.0, smallest_spot_mm=0.0))


def flux_of(view: npt.ArrayLike, shape: tuple[int, int]) -> Float32Array:
    """`flux_map` of a cone_vec row (12,): open pixel's share of the charge at 1 m, per cm2."""
    row = np.asarray(view, dtype=np.float64)
    away, u, v = row[0:3] - row[3:6], row[6:9], row[9:12]
    pixel_u, pixel_v = float(np.linalg.norm(u)), float(np.linalg.norm(v))
    normal = np.cross(u, v) / (pixel_u * pixel_v)
    feet = float(away @ u) / pixel_u, float(away @ v) / pixel_v
    # Rounded, so that equal views share a map.
    key = (round(x, 6) for x in (abs(float(away @ normal)), *feet))
    return flux_map(*key, round(pixel_u, 12), round(pixel_v, 12), shape)


@lru_cache(maxsize=16)
def flux_map(
    distance: float, foot_u: float, foot_v: float, pixel_u: float, pixel_v: float,
    shape: tuple[int, int],
) -> Float32Array:  # fmt: skip
    """Pixel area [cm2] times inverse square of the distance relative to 1 m, times the obliquity.

    Args:
        distance: from the source to the panel's plane [mm].
        foot_u, foot_v: foot point of the source, from the panel's centre along u and v [mm].
        pixel_u, pixel_v: pitch [mm].
        shape: (rows, cols).
    """
    rows, cols = shape
    y = (np.arange(rows) - (rows - 1) / 2) * pixel_v - foot_v
    x = (np.arange(cols) - (cols - 1) / 2) * pixel_u - foot_u
    squared = distance**2 + x[None, :] ** 2 + y[:, None] ** 2
    area = pixel_u * pixel_v / 100.0
    flux = area * REFERENCE_MM**2 * distance / squared**1.5
    out: Float32Array = flux.astype(np.float32)
    out.flags.writeable = False
    return out


@dataclass(frozen=True, eq=False)
class Scattered:
    """Scatter of one view, in units of the local open beam.

    Attributes:
        signal: float32 (rows, cols), of the open beam's signal.
        variance: float32 (rows, cols), of the open beam's variance.
    """

    signal: Float32Array
    variance: Float32Array

    def added_to(
        self, expected: Expected, chain: Chain, view: FloatArray, exposure: ExposureSettings
    ) -> Expected:
        """The expected electrons of primary radiation and scatter together."""
        signal, noise = weights_of(chain, exposure.kV)
        flux = flux_of(view, self.signal.shape) * np.float32(mAs(exposure))
        mean = expected.mean_e + self.signal * flux * np.float32(signal.sum())
        variance = expected.variance_e + self.variance * flux * np.float32(noise.sum())
        return Expected(mean.astype(np.float32), variance.astype(np.float32))


@dataclass(frozen=True, eq=False)
class Radiograph:
    """What the X-rays of one pose do to the panel, without noise.

    Attributes:
        integrals: (rows, cols), or (moments, rows, cols): what a logarithm of the flat-corrected
            image would show.
        expected: electrons with the tube on; None in ideal physics.
    """

    integrals: Float32Array
    expected: Expected | None = None

    @property
    def shown(self) -> Float32Array:
        """Line integrals (rows, cols) of the middle moment, for display."""
        values = self.integrals
        return values if values.ndim == 2 else values[len(values) // 2]


def radiographs(
    chain: Chain,
    paths_mm: Float32Array,
    views: FloatArray,
    exposures: Sequence[ExposureSettings],
    moments: int = 1,
    scatter: Sequence[Scattered] = (),
) -> list[Radiograph]:
    """Images of several exposures, taken as if X-rays were on.

    Args:
        chain: tube, materials, panel.
        paths_mm: float32 (m, n * moments, rows, cols), one channel a material [mm].
        views: (n * moments, 12) their cone_vec rows [mm].
        exposures: tube and time of each of the n images.
        moments: views spread over each exposure.
        scatter: of each image; none if left out.
    """
    made = []
    for i, given in enumerate(exposures):
        exposure = replace(given, xrays_on=True)
        part = slice(i * moments, (i + 1) * moments)
        view = views[i * moments + moments // 2]
        expected = expected_signal(chain, paths_mm[:, part], view, exposure)
        if scatter:
            expected = scatter[i].added_to(expected, chain, view, exposure)
        made.append(Radiograph(_as_line_integrals(chain, expected, view, exposure), expected))
    return made


def _as_line_integrals(
    chain: Chain, expected: Expected, view: FloatArray, exposure: ExposureSettings
) -> Float32Array:
    """-log of the signal over the open beam's."""
    area = np.float32(weights_of(chain, exposure.kV)[0].sum() * mAs(exposure))
    least = np.float32(1e-6)
    lines = np.log(np.maximum(area * flux_of(view, expected.mean_e.shape), least))
    lines -= np.log(np.maximum(expected.mean_e, least))
    return np.asarray(lines, dtype=np.float32)


def check_rays(rays: int) -> None:
    """Check a number of rays along each side of a pixel.

    Raises:
        LimitError: says what is allowed.
    """
    if not isinstance(rays, int | np.integer) or rays not in range(1, MOST_RAYS + 1):
        allowed = f"1 to {MOST_RAYS} along each side of a pixel"
        raise LimitError.instead(f"rays is {rays}", rays, allowed)


def within_pixels(rows: FloatArray, rays: int) -> FloatArray:
    """Views through a point in each of rays x rays parts of the pixels of each view, (n * rays^2,
    12): no two in one row or column, so that edges along them come out in rays^2 steps."""
    j, i = np.divmod(np.arange(rays**2)[:, None], rays)
    across = (i + (j + 0.5) / rays) / rays - 0.5
    down = (j + (rays - i - 0.5) / rays) / rays - 0.5
    out = np.repeat(rows[:, None], rays**2, axis=1)
    out[:, :, 3:6] += across * rows[:, None, 6:9] + down * rows[:, None, 9:12]
    return out.reshape(-1, 12)


AIR: Final = Substance(
    "air", (("N", 0.755268), ("O", 0.231781), ("Ar", 0.012827), ("C", 0.000124)), 1.20479e-3
)
"""Dry air near sea level, composition and density of NIST's tables."""
GRAY_PER_KEV_PER_G: Final = 1.602176634e-13


@dataclass(frozen=True)
class PixelValue:
    """A pixel of one saved image.

    Attributes:
        signal: mean counts above the dark level.
        noise: their standard deviation [counts].
    """

    signal: float
    noise: float


def pixel_reading(
    chain: Chain,
    camera: CameraSettings,
    exposure: ExposureSettings,
    flux: float,
    paths_mm: Sequence[float] = (),
    detail: tuple[Substance, float] | None = None,
) -> PixelValue:
    """What a pixel reads behind materials, in surroundings that are like it.

    Args:
        chain: tube, materials, panel.
        camera: its mode says how pixels are binned and read.
        exposure: tube, time and averages.
        flux: the pixel's share of the charge at 1 m, see `chain.flux_map` [cm2].
        paths_mm: path through each of the chain's substances [mm]; nothing if left out.
        detail: one more substance and the path through it [mm].

    Example:
        >>> from flexdt.twin.machine.camera import Roi
        >>> from flexdt.twin.physics.detector import Detector
        >>> from flexdt.twin.physics.tube import TubeModel
        >>> aluminium = Substance.of("aluminium", "Al", 2.7)
        >>> chain = Chain(Detector(), TubeModel(), (aluminium,), (50.0,))
        >>> camera = CameraSettings("HW2SW1High", Roi(32, 8, 1943, 1527))
        >>> behind = [pixel_reading(chain, camera, ExposureSettings(90.0, 50.0, 100.0), 2e-4, [x])
        ...           for x in (0.0, 20.0)]
        >>> behind[0].signal > 5 * behind[1].signal, behind[0].noise > behind[1].noise
        (True, True)
    """
    layers = list(zip(chain.substances, paths_mm, strict=True)) if paths_mm else []
    if detail is not None:
        layers.append(detail)
    signal, noise = weights_of(chain, exposure.kV)
    depth = np.zeros_like(signal)
    for substance, path in layers:
        depth += substance.attenuation() * path
    through = np.exp(-depth)
    scale, panel = mAs(exposure) * flux, chain.panel
    sigmas = panel.blur_px(camera)
    kept = math.prod(float((noise_kernel(s).astype(np.float64) ** 2).sum()) for s in sigmas)
    kept = kept if max(sigmas) >= NARROWEST else 1.0
    quanta = float(noise @ through) * scale * kept
    per_count = panel.gain(camera)
    variance = (quanta + panel.read_noise(camera) ** 2) / exposure.averages / per_count**2
    return PixelValue(float(signal @ through) * scale / per_count, math.sqrt(variance + 1.0 / 12.0))


def contrast_to_noise(background: PixelValue, detail: PixelValue) -> float:
    """Difference of two readings over the background's noise, of one pixel of one image."""
    return abs(background.signal - detail.signal) / background.noise


def air_kerma_mGy(chain: Chain, exposure: ExposureSettings, distance_mm: float) -> float:
    """Air kerma of one image at a distance from the source, nothing in between [mGy].

    The energy that photons give to electrons of air: all of it in photoelectric absorption, the
    electron's mean share (Klein and Nishina) in Compton scattering. Bremsstrahlung of those
    electrons, below 0.1 % here, is left in.

    Args:
        chain: its tube counts.
        exposure: tube, time and averages.
        distance_mm: source to the point [mm].
    """
    spectrum = tube_spectrum(exposure.kV, chain.tube)
    fluence = spectrum.fluence * mAs(exposure) * exposure.averages * (1000.0 / distance_mm) ** 2
    released = float(fluence @ (spectrum.energy_keV * mass_energy_transfer(AIR)))
    return 1e3 * released * GRAY_PER_KEV_PER_G


@lru_cache
def mass_energy_transfer(substance: Substance) -> FloatArray:
    """Mass energy-transfer coefficient at the tables' energies, (e,) [cm2/g].

    Without fluorescence that escapes, so for light elements only.
    """
    parts = cross_sections((substance,))
    scattered = parts.coherent[0] + parts.incoherent[0]
    per_mm = np.maximum(parts.total[0] - scattered, 0.0)
    per_mm = per_mm + parts.incoherent[0] * compton_share(parts.energy_keV)
    return np.asarray(10.0 * per_mm / substance.density_g_cm3)


def compton_share(energy_keV: npt.ArrayLike) -> FloatArray:
    """Mean part of a photon's energy that a free electron takes in Compton scattering, (e,)."""
    cosine, weight = np.polynomial.legendre.leggauss(64)
    alpha = np.atleast_1d(np.asarray(energy_keV, dtype=np.float64))[:, None] / ELECTRON_KEV
    left = 1.0 / (1.0 + alpha * (1.0 - cosine))
    section = left**2 * (left + 1.0 / left - (1.0 - cosine**2)) * weight
    return np.asarray((section * (1.0 - left)).sum(axis=1) / section.sum(axis=1))
