"""The chain for one image: path lengths through materials to the electrons that are expected.

There are two steps, so that the second can depend on earlier frames: `radiographs` are
free of noise and depend on geometry, tube and sample; `readout.read_out` adds the panel's
effects. Scattered radiation is `flexdt.twin.physics.scatter`'s. The twin server and
`flexdt.simulate` both make images with these functions, so a simulated data set and a
scan of the twin differ in nothing but their geometry.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from flexdt.twin.attenuation.substances import Substance
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.physics.blur import blurred, spot_blur_px
from flexdt.twin.physics.detector import Detector
from flexdt.twin.physics.effective import EffectiveBeam, effective_beam
from flexdt.twin.physics.exposure import ExposureSettings
from flexdt.twin.physics.readout import Expected
from flexdt.twin.physics.tube import TubeModel, monochromatic, tube_spectrum
from flexdt.twin.projection.pixel_areas import Within

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
        mono_keV: all photons have this energy, as many as give the spectrum's open-beam
            signal; None for the full spectrum.
    """

    panel: Detector
    tube: TubeModel = field(default_factory=TubeModel)
    substances: tuple[Substance, ...] = ()
    thickest_mm: tuple[float, ...] = ()
    mono_keV: float | None = None


@lru_cache(maxsize=32)
def beam_of(chain: Chain, kV: float) -> EffectiveBeam:
    """Compute the effective energies of the chain at a voltage [kV]; the last 32 are
    kept.

    Weights are electrons and their variance per cm2 of pixel and mAs at 1 m. With
    `mono_keV` the weights are those of the full spectrum, and all attenuation is that of
    this one energy."""
    signal, noise = weights_of(chain, kV)
    beam = effective_beam(signal, noise, chain.substances, chain.thickest_mm)
    if chain.mono_keV is None:
        return beam
    mu = [s.attenuation_at(chain.mono_keV) for s in chain.substances]
    return replace(beam, mu=np.reshape(mu, (len(mu), 1)))


def weights_of(chain: Chain, kV: float) -> tuple[FloatArray, FloatArray]:
    """Compute each energy's part in an open pixel's electrons and their variance, (e,)
    both.

    Per cm2 of pixel and mAs, 1 m from the source; a compound Poisson process. With
    `mono_keV` all photons have this energy, as many as give the full spectrum's signal.
    """
    charge, variance = chain.panel.charge_of_photons()
    fluence = tube_spectrum(kV, chain.tube).fluence
    if chain.mono_keV is not None:
        one = monochromatic(chain.mono_keV).fluence
        fluence = one * float((fluence @ charge) / (one @ charge))
    return fluence * charge, fluence * variance


def mAs(exposure: ExposureSettings) -> float:
    """Compute the charge through the tube in one read-out [mAs]: W / kV is mA."""
    if not exposure.xrays_on:
        return 0.0
    return exposure.power_W / exposure.kV * exposure.exposure_ms / 1000.0


@dataclass(frozen=True, eq=False)
class PixelPaths:
    """Paths along several rays of some pixels, of which the signals are averaged.

    Attributes:
        within: the pixels, of images (moments, rows, cols).
        paths_mm: float32 (m, rays), one channel a substance [mm].
    """

    within: Within
    paths_mm: Float32Array

    def of_views(self, first: int, last: int, pixels: int) -> PixelPaths:
        """Take the pixels of views `first` to `last` - 1, of `pixels` each."""
        within, rays = self.within.of_range(first * pixels, last * pixels)
        return PixelPaths(within, self.paths_mm[:, rays])


def transmitted(
    beam: EffectiveBeam, paths_mm: Float32Array, areas: PixelPaths | None = None
) -> tuple[Float32Array, Float32Array]:
    """Compute the signal behind path lengths [mm], and its variance, (..., rows, cols).

    `paths_mm`: (m, ..., rows, cols), to the pixels' centers. `areas`: pixels with several
    rays, whose mean is taken. Units are those of `EffectiveBeam.transmit`.
    """
    mean, variance = beam.transmit(paths_mm)
    if areas is not None and len(areas.within.pixels):
        several = beam.transmit(areas.paths_mm)
        for whole, rays in zip((mean, variance), several, strict=True):
            whole.reshape(-1)[areas.within.pixels] = areas.within.means(rays)
    return mean, variance


def expected_signal(
    chain: Chain,
    paths_mm: Float32Array,
    view: npt.ArrayLike,
    exposure: ExposureSettings,
    areas: PixelPaths | None = None,
) -> Expected:
    """Compute the noise-free charge of one image: attenuation averaged over the pixels'
    areas and over the moments, focal-spot blur of the rotation axis, then flux.

    Args:
        chain: tube, materials, panel.
        paths_mm: float32 (m, rows, cols), or (m, moments, rows, cols) spread evenly over
            the exposure; one channel a substance [mm].
        view: the cone_vec row (12,) of the image [mm]; distances give flux and focal-spot
            blur.
        exposure: tube and time; with X-rays off all is 0.
        areas: pixels whose signal is the mean of several rays'; the other pixels have that
            of their center.

    Returns:
        Electrons of one read-out and their variance, float32 (rows, cols) each.
    """
    shape = (int(paths_mm.shape[-2]), int(paths_mm.shape[-1]))
    if not exposure.xrays_on:
        dark = np.zeros(shape, np.float32)
        return Expected(dark, dark)
    row = np.asarray(view, dtype=np.float64)
    if paths_mm.ndim == 4:
        count = paths_mm.shape[1]
    else:
        count = 1
    moments = paths_mm.reshape(len(chain.substances), count, *shape)
    mean, variance = transmitted(beam_of(chain, exposure.kV), moments, areas)
    one = mean.mean(axis=0)
    spread = variance.mean(axis=0)
    spot = spot_blur_px(row, chain.tube.focal_spot_mm(exposure.power_W))
    across = spot * float(np.linalg.norm(row[6:9]) / np.linalg.norm(row[9:12]))
    flux = flux_of(row, shape) * np.float32(mAs(exposure))
    return Expected(
        blurred(one, spot, across) * flux, blurred(spread, spot, across) * flux
    )


def open_noise(chain: Chain, view: npt.ArrayLike, exposure: ExposureSettings) -> float:
    """Compute the noise of a pixel of the open beam at the panel's center, relative to
    its signal (standard deviation); infinite without a signal.

    `chain`: tube and panel; its materials are not used. `view`: cone_vec row (12,) [mm].
    `exposure`: as if X-rays were on.
    """
    signal, variance = weights_of(chain, exposure.kV)
    charge = float(flux_of(view, (1, 1))[0, 0]) * mAs(replace(exposure, xrays_on=True))
    mean = float(signal.sum()) * charge
    if mean <= 0.0:
        return math.inf
    return math.sqrt(float(variance.sum()) * charge / exposure.averages) / mean


def without_spot(chain: Chain) -> Chain:
    """Remove the spot's blur from a chain, for views from `spot_views`, whose mean has it."""
    return replace(
        chain, tube=replace(chain.tube, spot_mm_per_W=0.0, smallest_spot_mm=0.0)
    )


def flux_of(view: npt.ArrayLike, shape: tuple[int, int]) -> Float32Array:
    """Compute the open pixels' share of the charge at 1 m, per cm2; see `flux_map`, which
    caches it.

    Distances are rounded to 1e-6 mm, so that nearly equal views share a cached map.

    Args:
        view: cone_vec row (12,) [mm].
        shape: the panel's (rows, cols).

    Returns:
        (rows, cols).
    """
    return flux_map(*_panel_from_source(view), shape)


def brightest_flux(view: npt.ArrayLike, shape: tuple[int, int]) -> float:
    """Compute the largest value of `flux_of` alone, at the pixel nearest to the source's
    foot point; a map of a whole panel takes 20 MB."""
    distance, foot_u, foot_v, pixel_u, pixel_v = _panel_from_source(view)
    rows, cols = shape
    y = np.abs((np.arange(rows) - (rows - 1) / 2) * pixel_v - foot_v).min()
    x = np.abs((np.arange(cols) - (cols - 1) / 2) * pixel_u - foot_u).min()
    # The panel of one pixel whose centre is as far from the foot point.
    return float(flux_map(distance, x, y, pixel_u, pixel_v, (1, 1))[0, 0])


def _panel_from_source(view: npt.ArrayLike) -> tuple[float, float, float, float, float]:
    """Describe the panel of a cone_vec row as the source sees it: distance of its plane,
    the source's foot point from its center along u and v, and both pitches [mm]."""
    row = np.asarray(view, dtype=np.float64)
    away = row[0:3] - row[3:6]
    u = row[6:9]
    v = row[9:12]
    pixel_u = float(np.linalg.norm(u))
    pixel_v = float(np.linalg.norm(v))
    normal = np.cross(u, v) / (pixel_u * pixel_v)
    feet = float(away @ u) / pixel_u, float(away @ v) / pixel_v
    # Rounded, so that equal views share a map.
    distance, foot_u, foot_v = (round(x, 6) for x in (abs(float(away @ normal)), *feet))
    return distance, foot_u, foot_v, round(pixel_u, 12), round(pixel_v, 12)


@lru_cache(maxsize=16)
def flux_map(
    distance: float,
    foot_u: float,
    foot_v: float,
    pixel_u: float,
    pixel_v: float,
    shape: tuple[int, int],
) -> Float32Array:
    """Compute pixel area [cm2] times the inverse square of the distance to 1 m, times
    obliquity.

    From a source `distance` [mm] before its foot point, (`foot_u`, `foot_v`) from the
    panel's center; pixels have the pitch `pixel_u`, `pixel_v` [mm]. Returns (rows, cols),
    read-only; the last 16 are kept.
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
        self,
        expected: Expected,
        chain: Chain,
        view: FloatArray,
        exposure: ExposureSettings,
    ) -> Expected:
        """Add the scatter to the expected electrons of primary radiation; `expected` is not
        changed.

        `expected`: electrons without scatter; `chain`: tube and panel; `view`: cone_vec row
        (12,) [mm]; `exposure`: tube and time."""
        signal, noise = weights_of(chain, exposure.kV)
        flux = flux_of(view, self.signal.shape) * np.float32(mAs(exposure))
        mean = expected.mean_e + self.signal * flux * np.float32(signal.sum())
        variance = expected.variance_e + self.variance * flux * np.float32(noise.sum())
        return Expected(mean.astype(np.float32), variance.astype(np.float32))


@dataclass(frozen=True, eq=False)
class Radiograph:
    """The noise-free effect of the X-rays of one pose on the panel.

    Attributes:
        integrals: (rows, cols), or (moments, rows, cols): line integrals of the
            flat-corrected image.
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
    areas: PixelPaths | None = None,
) -> list[Radiograph]:
    """Compute the images of n exposures, as if X-rays were on: line integrals and
    electrons.

    Distances, flux and blur of an exposure are those of its middle view.

    Args:
        paths_mm: float32 (m, n * moments, rows, cols), one channel a material [mm].
        views: (n * moments, 12) their cone_vec rows [mm].
        moments: views spread over each exposure.
        scatter: of each image; none if left out.
        areas: pixels, of all views, whose signal is the mean of several rays'.
    """
    images = []
    for i, given in enumerate(exposures):
        exposure = replace(given, xrays_on=True)
        part = slice(i * moments, (i + 1) * moments)
        view = views[i * moments + moments // 2]
        own = None
        if areas is not None:
            size = int(np.prod(paths_mm.shape[2:]))
            own = areas.of_views(part.start, part.stop, size)
        expected = expected_signal(chain, paths_mm[:, part], view, exposure, own)
        if scatter:
            expected = scatter[i].added_to(expected, chain, view, exposure)
        images.append(
            Radiograph(_as_line_integrals(chain, expected, view, exposure), expected)
        )
    return images


def _as_line_integrals(
    chain: Chain, expected: Expected, view: FloatArray, exposure: ExposureSettings
) -> Float32Array:
    """Compute -log of the expected signal over the open beam's, both taken as at least 1e-6
    electrons.

    `chain`: tube and detector; `expected`: the image; `view`: cone_vec row (12,); `exposure`:
    tube and time. Returns (rows, cols)."""
    area = np.float32(weights_of(chain, exposure.kV)[0].sum() * mAs(exposure))
    least = np.float32(1e-6)
    lines = np.log(np.maximum(area * flux_of(view, expected.mean_e.shape), least))
    lines -= np.log(np.maximum(expected.mean_e, least))
    return np.asarray(lines, dtype=np.float32)
