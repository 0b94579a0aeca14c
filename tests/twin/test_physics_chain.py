"""The chain against closed forms, full integrals over the spectrum, and its own output's
noise."""

from __future__ import annotations

import ast
import inspect
import textwrap
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from image_quality import edge_mtf, photon_transfer, region

from flexdt.twin.attenuation.substances import Substance
from flexdt.twin.errors import LimitError, TwinError
from flexdt.twin.machine.camera import CameraSettings, PixelGrid, Roi
from flexdt.twin.physics.blur import blurred, kernel, noise_kernel, spot_blur_px
from flexdt.twin.physics.chain import (
    Chain,
    brightest_flux,
    expected_signal,
    flux_of,
    radiographs,
    weights_of,
)
from flexdt.twin.physics.detector import Detector, pattern
from flexdt.twin.physics.effective import effective_beam
from flexdt.twin.physics.exposure import ExposureSettings, frame_rng
from flexdt.twin.physics.readout import Expected, read_out
from flexdt.twin.physics.tube import tube_spectrum

ABS = Substance.of("abs", "C15H17N", 1.05)
STEEL = Substance.of("steel", "Fe", 7.8)
ALUMINIUM = Substance.of("aluminium", "Al", 2.7)
COPPER = Substance.of("copper", "Cu", 8.96)
TITANIUM = Substance.of("titanium", "Ti", 4.5)
CARBIDE = Substance("carbide", (("W", 0.8824), ("C", 0.0576), ("Co", 0.06)), 14.9)
LISTING_1 = ExposureSettings(90.0, 50.0, 100.0)
CAMERA = CameraSettings("HW2SW1High", Roi(32, 8, 1943, 1527))
PIXEL = 0.1496
VIEW = np.array([0, -600, 0, 0, 459, 0, PIXEL, 0, 0, 0, 0, -PIXEL], dtype=np.float64)


def camera(rows: int, cols: int, mode: str = "HW2SW1High") -> CameraSettings:
    return CameraSettings(mode, Roi(0, 0, 2 * cols - 1, 2 * rows - 1))


def thin_and_thick(thickest, count: int = 3000) -> np.ndarray:
    """Paths alone and together from 1e-5 of the thickest on: far finer than any are chosen
    from."""
    m, most = len(thickest), np.array(thickest)
    alone = np.concatenate([np.geomspace(1e-5, 1.0, count), np.linspace(0.0, 1.0, count)])
    rows = [np.outer(alone, most * (np.arange(m) == i)) for i in range(m)]
    random = np.random.default_rng(99)
    fine = 10.0 ** random.uniform(-5.0, 0.0, (count, m)) * (
        random.random((count, m)) < 0.7
    )
    coarse = random.random((count, m)) ** 2
    return np.concatenate([*rows, fine * most, coarse * most])


def assert_holds(beam, signal, noise, substances, thickest) -> None:
    paths = thin_and_thick(thickest)
    each = np.exp(-paths @ np.array([s.attenuation() for s in substances]))
    full, spread = each @ signal, each @ noise
    mean, variance = beam.transmit(paths.T.astype(np.float32))
    seen = full > 1e-4 * signal.sum()
    error = np.abs(mean[seen] / full[seen] - 1).max()
    assert error <= 1e-3
    assert (
        error <= 1.2 * beam.worst + 1e-5
    )  # what it says of itself, from other thicknesses
    np.testing.assert_allclose(variance[seen], spread[seen], rtol=1e-2)
    assert beam.signal.sum() == pytest.approx(signal.sum(), rel=1e-4)


@pytest.mark.parametrize(
    ("substances", "thickest"),
    [
        ((ABS,), (60.0,)),
        ((ABS, STEEL), (60.0, 10.0)),
        ((ALUMINIUM, CARBIDE), (40.0, 4.0)),
        ((ABS, STEEL, ALUMINIUM, CARBIDE), (60.0, 10.0, 30.0, 4.0)),
    ],
)
@pytest.mark.parametrize("kV", [40.0, 90.0])
@pytest.mark.daily(5)
def test_few_energies_hold_the_full_spectrum(substances, thickest, kV):
    signal, noise = weights_of(Chain(Detector()), kV)
    beam = effective_beam(signal, noise, substances, thickest)
    assert len(beam.bins) <= 20
    assert_holds(beam, signal, noise, substances, thickest)


@pytest.mark.daily(10)
@pytest.mark.parametrize(
    "metal", [STEEL, COPPER, TITANIUM, CARBIDE], ids=lambda s: s.name
)
@pytest.mark.parametrize("kV", [30.0, 60.0, 80.0, 90.0, 160.0])
@pytest.mark.parametrize("thickest", [0.1, 4.0, 60.0])
def test_few_energies_hold_for_metals_however_thin(metal, kV, thickest):
    signal, noise = weights_of(Chain(Detector()), kV)
    beam = effective_beam(signal, noise, (metal,), (thickest,))
    assert len(beam.bins) <= 20
    assert_holds(beam, signal, noise, (metal,), (thickest,))


def test_many_heavy_elements_at_once():
    names = ("W@19.3", "Pb@11.3", "Gd@7.9", "Sn@7.3", "I@4.9", "Ba@3.6")
    heavy = tuple(Substance.of(n, n.split("@")[0], float(n.split("@")[1])) for n in names)
    signal, noise = weights_of(Chain(Detector()), 90.0)
    beam = effective_beam(signal, noise, heavy, (20.0,) * 6)
    assert len(beam.bins) <= 32
    assert_holds(beam, signal, noise, heavy, (20.0,) * 6)


def test_least_squares_that_go_round_in_circles_do_not_stop_it(monkeypatch):
    import scipy.optimize

    def nnls(*args, **kwargs):
        raise RuntimeError("Maximum number of iterations reached.")

    monkeypatch.setattr(scipy.optimize, "nnls", nnls)
    signal, noise = weights_of(Chain(Detector()), 90.0)
    beam = effective_beam(signal, noise, (STEEL,), (10.0,))
    assert_holds(beam, signal, noise, (STEEL,), (10.0,))


def test_what_cannot_be_held_is_refused():
    signal, noise = weights_of(Chain(Detector()), 90.0)
    with pytest.raises(TwinError, match="effective energies reach") as refused:
        effective_beam(signal, noise, (STEEL,), (10.0,), tolerance=1e-13)
    assert refused.value.data["reached"] > 1e-13


def test_slabs_of_one_energy_follow_beer_lambert():
    chain = Chain(
        Detector(), substances=(ABS, STEEL), thickest_mm=(50, 5), mono_keV=50.25
    )
    abs_mm, steel_mm = [0.0, 1.0, 20.0, 50.0, 0.0, 20.0], [0.0, 0.0, 0.0, 0.0, 1.0, 2.0]
    energy = tube_spectrum(90.0).energy_keV
    at = np.argmin(np.abs(energy - 50.25))
    mu = np.array([ABS.attenuation()[at], STEEL.attenuation()[at]])
    wanted = np.exp(-(np.array([abs_mm, steel_mm]).T @ mu))
    alone = [
        expected_signal(
            chain,
            np.full((2, 3, 3), np.array(p, np.float32)[:, None, None]),
            VIEW,
            LISTING_1,
        ).mean_e[1, 1]
        for p in zip(abs_mm, steel_mm, strict=True)
    ]
    np.testing.assert_allclose(np.array(alone) / alone[0], wanted, rtol=1e-4)


def test_a_wedge_hardens_the_beam_as_the_integral_says():
    chain = Chain(Detector(), substances=(ALUMINIUM,), thickest_mm=(40.0,))
    thickness = np.linspace(0.0, 40.0, 9)
    signal, _ = weights_of(chain, 90.0)
    full = np.exp(-np.outer(thickness, ALUMINIUM.attenuation())) @ signal
    got = np.array(
        [
            expected_signal(
                chain, np.full((1, 3, 3), t, np.float32), VIEW, LISTING_1
            ).mean_e[1, 1]
            for t in thickness
        ]
    )
    np.testing.assert_allclose(got / got[0], full / full[0], rtol=1e-3)
    # the effective attenuation falls with thickness: beam hardening is there
    slope = np.diff(-np.log(got)) / np.diff(thickness)
    assert (np.diff(slope) < 0).all()
    assert slope[0] > 1.5 * slope[-1]


def test_signal_follows_tube_time_and_distance():
    chain = Chain(Detector(), substances=(), thickest_mm=())
    empty = np.zeros((0, 3, 3), np.float32)
    one = expected_signal(chain, empty, VIEW, LISTING_1).mean_e[1, 1]
    double = expected_signal(chain, empty, VIEW, ExposureSettings(90, 25, 400)).mean_e[
        1, 1
    ]
    assert double == pytest.approx(2 * one, rel=1e-6)
    far = VIEW.copy()
    far[4] += 1059.0
    assert expected_signal(chain, empty, far, LISTING_1).mean_e[1, 1] == pytest.approx(
        one / 4, rel=1e-5
    )
    wide = expected_signal(
        chain, np.zeros((0, 3, 4001), np.float32), VIEW, LISTING_1
    ).mean_e[1]
    aside = 2000 * PIXEL  # inverse square and obliquity: cosine to the third power
    assert wide[0] / wide[2000] == pytest.approx(
        (1 + (aside / 1059.0) ** 2) ** -1.5, rel=1e-5
    )
    off = expected_signal(
        chain, empty, VIEW, ExposureSettings(90, 50, 100, xrays_on=False)
    )
    assert not off.mean_e.any()
    soft = expected_signal(chain, empty, VIEW, ExposureSettings(60, 50 * 60 / 90, 100))
    assert soft.mean_e[1, 1] < 0.6 * one  # same charge, lower voltage


def flat(chain: Chain, exposure: ExposureSettings, cam: CameraSettings, seed: int | None):
    shape = cam.shape
    empty = expected_signal(chain, np.zeros((0, *shape), np.float32), VIEW, exposure)
    rng = None if seed is None else frame_rng(1, seed)
    return read_out(chain.panel, empty, cam, exposure, rng)


@pytest.mark.parametrize("mode", ["HW2SW1High", "HW2SW1Low"])
def test_photon_transfer_recovers_gain_and_read_noise(mode):
    panel = Detector(dead_fraction=0.0)
    chain = Chain(panel)
    cam = camera(500, 700, mode)
    brightest = 100.0 if mode.endswith("High") else 30.0
    pairs, seed = [], 10
    for part in (0.2, 0.4, 0.6, 0.8, 1.0):
        exposure = ExposureSettings(90.0, 50.0, part * brightest)
        pairs.append(tuple(flat(chain, exposure, cam, seed + i) for i in range(2)))
        seed += 2
    off = ExposureSettings(90.0, 50.0, 10.0, xrays_on=False)
    darks = [(flat(chain, off, cam, 0), flat(chain, off, cam, 1))]
    result = photon_transfer(pairs, darks)
    signal, noise = weights_of(chain, 90.0)
    per_count = panel.gain(cam)
    assert result.counts_per_quantum == pytest.approx(
        float(noise.sum() / signal.sum()) / per_count, rel=0.02
    )
    assert result.read_noise_counts == pytest.approx(
        panel.read_noise(cam) / per_count, rel=0.02
    )


def test_flat_corrected_air_is_one_within_noise():
    chain, cam = Chain(Detector(dead_fraction=0.0)), camera(200, 300)
    off = ExposureSettings(90.0, 50.0, 100.0, 400, xrays_on=False)
    many = ExposureSettings(90.0, 50.0, 100.0, 400)
    dark = flat(chain, off, cam, 0).astype(float)
    white = flat(chain, many, cam, 1).astype(float)
    air = (flat(chain, many, cam, 2) - dark) / (white - dark)
    assert air.mean() == pytest.approx(1.0, abs=1e-4)
    assert region(white).noise / white.mean() > 0.004  # the panel's own pattern
    assert air.std() < 0.002  # gone
    # what is left is two images' noise: the same when the pattern is taken off by subtraction
    other = [flat(chain, many, cam, i).astype(float) for i in (5, 6)]
    assert air.std() == pytest.approx(
        np.std(other[0] - other[1]) / (white - dark).mean(), rel=0.03
    )


def test_counts_saturate_and_never_wrap():
    cam = camera(40, 50)
    bright = ExposureSettings(90.0, 90.0, 5000.0)
    counts = flat(Chain(Detector(dead_fraction=0.0)), bright, cam, 3)
    assert counts.dtype == np.uint16
    assert (counts == 16_383).all()


def test_fixed_pattern_belongs_to_the_panel():
    panel = Detector()
    whole = pattern(panel, 1, (0, 0, 1943, 1535))
    part = pattern(panel, 2, (32, 8, 1943, 1527))
    np.testing.assert_allclose(part.gain[0, 0], whole.gain[8:10, 32:34].mean(), rtol=1e-5)
    assert part.gain.shape == (760, 956)
    assert whole.dead.sum() == pytest.approx(panel.dead_fraction * 1944 * 1536, rel=0.6)
    assert (
        pattern(Detector(serial=2), 1, (0, 0, 1943, 1535)).gain[0, 0] != whole.gain[0, 0]
    )
    plain = Detector(dead_fraction=0.01)
    counts = flat(
        Chain(plain), LISTING_1, CameraSettings("HW1SW1High", Roi(0, 0, 99, 99)), 1
    )
    dead = pattern(plain, 1, (0, 0, 99, 99)).dead
    assert dead.any()
    assert (counts[dead] == 0).all()


def test_same_seed_same_bytes_in_any_order():
    chain, cam = Chain(Detector()), camera(30, 40)
    forwards = [flat(chain, LISTING_1, cam, i) for i in range(4)]
    backwards = [flat(chain, LISTING_1, cam, i) for i in reversed(range(4))][::-1]
    assert all((a == b).all() for a, b in zip(forwards, backwards, strict=True))
    assert not np.array_equal(forwards[0], forwards[1])


def test_few_photons_keep_mean_and_variance():
    panel = Detector(dead_fraction=0.0, gain_sigma=0.0, offset_sigma_counts=0.0, blur_mm=0.0,
                  read_noise_e=0.0, dark_e_per_s=0.0, electrons_per_count=1e5 / 2**14)  # fmt: skip
    chain, cam = Chain(panel), camera(300, 300)
    dim = ExposureSettings(90.0, 0.1, 50.0)
    expected = expected_signal(chain, np.zeros((0, 300, 300), np.float32), VIEW, dim)
    counts = read_out(panel, expected, cam, dim, frame_rng(0, 0)) - panel.offset_counts
    per_count = panel.gain(cam)
    assert expected.mean_e.mean() ** 2 / expected.variance_e.mean() < 10  # few indeed
    assert counts.mean() * per_count == pytest.approx(expected.mean_e.mean(), rel=0.01)
    assert counts.var() * per_count**2 == pytest.approx(
        expected.variance_e.mean(), rel=0.03
    )


def test_earlier_frames_leave_something_behind():
    panel, cam = Detector(gain_sigma=0.0, offset_sigma_counts=0.0), camera(10, 10)
    bright = expected_signal(
        Chain(panel), np.zeros((0, 10, 10), np.float32), VIEW, LISTING_1
    )
    off = ExposureSettings(90.0, 50.0, 100.0, xrays_on=False)
    dark = expected_signal(Chain(panel), np.zeros((0, 10, 10), np.float32), VIEW, off)
    alone = read_out(panel, dark, cam, off).astype(float)
    soon = read_out(panel, dark, cam, off, before=[(bright.mean_e, 0.0)]) - alone
    late = read_out(panel, dark, cam, off, before=[(bright.mean_e, 5.0)]) - alone
    open_counts = float(bright.mean_e.mean()) / panel.gain(cam)
    assert soon.mean() == pytest.approx(panel.lag_fraction * open_counts, abs=0.6)
    assert not late.any()


def test_blur_has_the_variance_asked_for():
    for sigma in (0.1, 0.4, 1.0, 2.5):
        weights = kernel(sigma).astype(float)
        x = np.arange(len(weights)) - len(weights) // 2
        assert weights @ x**2 == pytest.approx(sigma**2, rel=2e-3)
    point = np.zeros((15, 15), np.float32)
    point[7, 7] = 1.0
    assert blurred(point, 0.4).sum() == pytest.approx(1.0, rel=1e-6)
    # focal spot of 0.05 mm, magnification 1059 / 600
    assert spot_blur_px(VIEW, 0.05) == pytest.approx(
        (1059 / 600 - 1) * 0.05 / 2.35482 / PIXEL, rel=1e-5
    )


@pytest.mark.parametrize("blur_mm", [0.03, 0.06, 0.15])
def test_neighbours_share_the_noise_of_light_that_reaches_both(blur_mm: float) -> None:
    """Covariance of pixels, beside the light of two points integrated over two squares."""
    panel = Detector(gain_sigma=0.0, offset_sigma_counts=0.0, dead_fraction=0.0, blur_mm=blur_mm,
                  read_noise_e=0.0)  # fmt: skip
    cam = CameraSettings("HW1SW1High", Roi(0, 0, 599, 599))
    expected = expected_signal(
        Chain(panel), np.zeros((0, 600, 600), np.float32), VIEW, LISTING_1
    )
    image = read_out(panel, expected, cam, LISTING_1, frame_rng(3, 0)).astype(float)
    image = (image - image.mean())[10:-10, 10:-10] * panel.gain(cam)
    wide = blur_mm / panel.pixels.pitch_mm * np.sqrt(2.0)
    x = (
        np.arange(2000) + 0.5
    ) / 1000.0 - 1.0  # from one place in a pixel to one in the other
    shares = [
        np.sum((1 - abs(x)) * np.exp(-((x - n) ** 2) / (2 * wide**2)))
        / (1000 * wide * np.sqrt(2 * np.pi))
        for n in (0, 1, 2)
    ]
    variance = float(expected.variance_e.mean())
    for n, share in enumerate(shares):
        both = (image[:, : image.shape[1] - n] * image[:, n:]).mean() / variance
        assert both == pytest.approx(share * shares[0], abs=0.012)


@pytest.mark.parametrize("sigma", [0.5, 20.0, 80.0, 900.0])
def test_noise_is_spread_as_wide_as_light_is(sigma: float) -> None:
    """White noise that a Gaussian spreads keeps 1 / (2 sqrt(pi) sigma) of its variance an axis,
    the pixels' own width (variance 1/12, twice) included; blurs beyond reason are refused."""
    weights = noise_kernel(sigma).astype(np.float64)
    narrow = sigma if sigma > 10.0 else np.sqrt(sigma**2 + 1.0 / 12.0)
    assert (weights**2).sum() == pytest.approx(0.5 / np.sqrt(np.pi) / narrow, rel=0.01)
    assert abs(weights).argmax() == len(weights) // 2
    with pytest.raises(LimitError, match="a blur of 2e\\+03 pixels"):
        blurred(np.ones((3, 4), np.float32), 0.0, 2000.0)


def test_hardly_a_photon_is_none_and_not_a_black_pixel() -> None:
    """Below about 1e-19 electrons their square is no float32."""
    dim = np.geomspace(1e-38, 1e-3, 64, dtype=np.float32).reshape(8, 8)
    panel = Detector(read_noise_e=0.0, dead_fraction=0.0)
    counts = [
        read_out(
            panel,
            Expected(signal, 400.0 * signal),
            camera(8, 8),
            LISTING_1,
            frame_rng(3, 1),
        )
        for signal in (dim, 0.0 * dim)
    ]
    assert (counts[0] == counts[1]).mean() > 0.9
    assert counts[0].min() > 50


def test_small_pixels_have_their_own_area() -> None:
    view = np.array(
        [0, -600, 0, 0, 459, 0, 1.4e-6, 0, 0, 0, 0, -2.7e-6], dtype=np.float64
    )
    assert flux_of(view, (1, 1))[0, 0] == pytest.approx(
        1.4e-8 * 2.7e-6 * (1000 / 1059) ** 2, rel=1e-5, abs=0.0
    )


def test_a_beam_of_next_to_nothing_has_no_line_integrals_below_0() -> None:
    chain = Chain(Detector(), substances=(STEEL,), thickest_mm=(10.0,))
    paths = np.full((1, 1, 4, 5), 10.0, np.float32)
    faint = ExposureSettings(90.0, 1e-9, 1e-6)
    [image] = radiographs(chain, paths, VIEW[None], [faint])
    assert np.isfinite(image.integrals).all()
    assert image.integrals.min() >= 0.0
    weak = Detector(scintillator="H@1e-30", scintillator_mm=1e-6)
    with pytest.raises(LimitError, match="no photon leaves anything in the detector"):
        radiographs(replace(chain, panel=weak), paths, VIEW[None], [LISTING_1])


def test_a_source_on_the_axis_is_a_blur_that_is_refused() -> None:
    row = np.concatenate([np.zeros(3), VIEW[3:]])
    assert spot_blur_px(row, 0.0) == 0.0
    with pytest.raises(LimitError, match="less magnification"):
        blurred(np.ones((3, 4), np.float32), spot_blur_px(row, 0.01))


def test_edge_gives_the_modulation_of_its_blur():
    rows, cols, sigma = 60, 80, 0.9
    y, x = np.mgrid[:rows, :cols]
    fine = 16  # a slanted edge, integrated over pixels by sampling
    offsets = (np.arange(fine) + 0.5) / fine - 0.5
    sharp = np.mean([(x + o > 40.2 + 0.06 * (y - 30)) for o in offsets], axis=0)
    response = edge_mtf(blurred(sharp.astype(np.float32), sigma))
    f = response.frequency
    wanted = np.exp(-2 * (np.pi * f * sigma) ** 2) * np.sinc(f)
    low = f < 0.3
    np.testing.assert_allclose(response.modulation[low], wanted[low], atol=0.02)
    assert response.at(0.5) == pytest.approx(
        np.interp(-0.5, -wanted[f < 0.5], f[f < 0.5]), abs=0.01
    )


def test_signal_to_noise():
    one = np.random.default_rng(0).normal(10, 2, 20_000)
    assert region(one).snr == pytest.approx(5.0, rel=0.02)


@pytest.mark.parametrize("kind", [Detector, PixelGrid])
def test_every_default_says_where_it_comes_from(kind):
    _, *body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0].body
    fields = [
        (one, after) for one, after in pairwise(body) if isinstance(one, ast.AnnAssign)
    ]
    assert [one.target.id for one, _ in fields] == list(kind.__dataclass_fields__)
    for _, said in fields:
        assert said.value.value.split(":")[0].rstrip(".") in (
            "Measured",
            "Literature",
            "Assumed",
        )


def test_the_brightest_flux_is_the_largest_of_the_map() -> None:
    random = np.random.default_rng(4)
    for _ in range(40):
        row = random.normal(size=12) * 200.0
        u = random.normal(size=3)
        v = np.cross(u, random.normal(size=3))
        row[6:9] = u / np.linalg.norm(u) * random.uniform(0.05, 2.0)
        row[9:12] = v / np.linalg.norm(v) * random.uniform(0.05, 2.0)
        shape = (int(random.integers(1, 40)), int(random.integers(1, 40)))
        expected = float(flux_of(row, shape).max())
        assert brightest_flux(row, shape) == pytest.approx(expected, rel=1e-6)
