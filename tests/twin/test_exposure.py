"""Counts from line integrals: Beer-Lambert by hand, noise statistics, clipping, seeds."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flexdt.twin.machine.description import builtin_machine
from flexdt.twin.physics.exposure import (
    ExposureSettings,
    IdealResponse,
    expose,
    frame_rng,
    ideal_response,
    open_beam,
)

MODEL = IdealResponse()
LISTING_1 = ExposureSettings(kV=90.0, power_W=50.0, exposure_ms=100.0)
SHAPE = (190, 239)


def full(value: float, *shape: int) -> np.ndarray:
    return np.full(shape or SHAPE, value, dtype=np.float32)


def test_beer_lambert_without_noise() -> None:
    ramp = np.linspace(0.0, 12.0, 1000, dtype=np.float32).reshape(20, 50)
    counts = expose(MODEL, ramp, LISTING_1)
    expected = np.round(100.0 + 12_000.0 * np.exp(-ramp.astype(np.float64)))
    assert counts.dtype == np.uint16
    assert np.abs(counts.astype(int) - expected).max() <= 1  # float32 at a rounding edge
    assert np.mean(counts != expected) < 0.01
    assert counts[0, 0] == 12_100


@pytest.mark.parametrize(
    ("change", "factor"),
    [({"kV": 45.0}, 0.5), ({"power_W": 25.0}, 0.5), ({"exposure_ms": 10.0}, 0.1)],
)
def test_the_open_beam_scales_with_kv_power_and_exposure(change, factor) -> None:
    settings = ExposureSettings(
        **{"kV": 90.0, "power_W": 50.0, "exposure_ms": 100.0, **change}
    )
    assert open_beam(MODEL, settings) == pytest.approx(12_000.0 * factor)
    assert expose(MODEL, full(0.0), settings)[0, 0] == round(100 + 12_000 * factor)


def test_saturation_clips_at_fourteen_bits_and_darkness_at_zero() -> None:
    bright = ExposureSettings(90.0, 90.0, 500.0)
    assert (expose(MODEL, full(0.0), bright) == 16_383).all()
    assert (expose(MODEL, full(0.0), bright, frame_rng(0, 0)) == 16_383).all()
    noisy = IdealResponse(dark_counts=1.0, read_noise_counts=5.0)
    off = ExposureSettings(90.0, 50.0, 100.0, xrays_on=False)
    dark = expose(noisy, full(0.0), off, frame_rng(0, 0))
    assert dark.min() == 0
    assert dark.max() < 40


def test_xrays_off_gives_dark_whatever_stands_in_the_way() -> None:
    off = ExposureSettings(90.0, 50.0, 100.0, xrays_on=False)
    assert (expose(MODEL, full(3.0), off) == 100).all()


@pytest.mark.parametrize("averages", [1, 10])
@pytest.mark.parametrize("attenuation", [0.0, 2.0, 8.0])
def test_noise_has_the_poisson_and_read_variance(
    averages: int, attenuation: float
) -> None:
    settings = ExposureSettings(90.0, 50.0, 100.0, averages)
    counts = np.stack(
        [expose(MODEL, full(attenuation), settings, frame_rng(5, i)) for i in range(4)]
    ).astype(np.float64)
    signal = 12_000.0 * math.exp(-attenuation)
    variance = signal / (MODEL.photons_per_count * averages) + 4.0 / averages + 1.0 / 12.0
    n = counts.size
    assert counts.mean() == pytest.approx(
        100.0 + signal, abs=5 * math.sqrt(variance / n) + 0.01
    )
    assert counts.var() == pytest.approx(variance, rel=5 * math.sqrt(2.0 / n) + 0.01)


def test_few_photons_follow_poisson_and_not_a_gaussian() -> None:
    """At two expected photons without read noise, counts are multiples of one photon's."""
    model = IdealResponse(photons_per_count=0.25, read_noise_counts=0.0)
    attenuation = -math.log(2.0 / (12_000.0 * 0.25))
    counts = expose(model, full(attenuation, 500, 500), LISTING_1, frame_rng(3, 0))
    photons = (counts - 100.0) * 0.25
    assert np.all(photons == np.round(photons))
    for k in range(5):
        expected = math.exp(-2.0) * 2.0**k / math.factorial(k)
        assert np.mean(photons == k) == pytest.approx(expected, abs=0.005)


def test_moments_average_intensity_and_not_line_integrals() -> None:
    moments = np.stack([full(0.0), full(4.0)])
    expected = round(100 + 12_000 * 0.5 * (1 + math.exp(-4.0)))
    assert (expose(MODEL, moments, LISTING_1) == expected).all()


def test_a_frame_depends_on_seed_and_index_only_and_input_stays() -> None:
    image = full(1.0)
    one = expose(MODEL, image, LISTING_1, frame_rng(7, 3))
    again = expose(MODEL, image, LISTING_1, frame_rng(7, 3))
    assert np.array_equal(one, again)
    assert (image == 1.0).all()
    for other in (frame_rng(8, 3), frame_rng(7, 4)):
        assert not np.array_equal(one, expose(MODEL, image, LISTING_1, other))


def test_the_machine_decides_the_depth() -> None:
    model = ideal_response(builtin_machine())
    assert model == MODEL
    assert model.full_scale == 16_383
