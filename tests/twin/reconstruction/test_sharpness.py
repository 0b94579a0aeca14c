"""Sharpness of a volume: widths of drawn edges, details that noise leaves, doubled edges."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.special import erf

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import Grid, Volume
from flexdt.twin.reconstruction import fdk
from flexdt.twin.reconstruction.feldkamp.half_scans import HalfScans
from flexdt.twin.reconstruction.resolution import detail_mm, displacement

LEVELS_SIGMAS = 2.5631
"""From 10 to 90 % of a Gaussian's integral."""


def step(at: np.ndarray, sigma: float) -> np.ndarray:
    """A step from 0 to 1, blurred."""
    return 0.5 * (1.0 + erf(at / (sigma * math.sqrt(2.0))))


def slab_of(
    sigma: float, apart: float = 0.0, noise: float = 0.0, seed: int = 0
) -> Volume:
    """A slanted wall of 0.03 / mm, 12 voxels thick, its edges blurred or doubled [voxels]."""
    z, y, x = np.indices((36, 44, 48)) - 20.0
    away = 0.96 * x + 0.25 * y + 0.12 * z
    away /= math.sqrt(0.96**2 + 0.25**2 + 0.12**2)
    wall = np.mean(
        [
            step(away + 6.0 + side, sigma) - step(away - 6.0 + side, sigma)
            for side in (-0.5 * apart, 0.5 * apart)
        ],
        axis=0,
    )
    grain = np.random.default_rng(seed).normal(0.0, 1.0, wall.shape)
    return Volume((0.03 * (wall + noise * grain)).astype(np.float32), 0.1)


@pytest.mark.parametrize("sigma", [0.5, 1.1, 1.6])
@pytest.mark.parametrize("noise", [0.0, 0.1])
@pytest.mark.daily(2)
def test_the_width_of_blurred_edges_is_that_of_the_blur(
    sigma: float, noise: float
) -> None:
    found = slab_of(sigma, noise=noise).sharpness
    assert found.across is not None
    assert found.along is None  # no edge lies so
    true = 0.1 * LEVELS_SIGMAS * sigma
    assert found.across.mm == pytest.approx(true, rel=0.08 if noise else 0.01)


def test_the_width_of_doubled_edges_is_that_of_both_steps() -> None:
    sigma, apart = 0.6, 2.0
    at = np.linspace(-6.0, 6.0, 4001)
    both = 0.5 * (step(at - 1.0, sigma) + step(at + 1.0, sigma))
    true = 0.1 * float(np.ptp(np.interp([0.1, 0.9], both, at)))
    found = slab_of(sigma, apart).sharpness
    assert found.across is not None
    assert found.across.mm == pytest.approx(true, rel=0.1)


def test_air_has_no_sharpness() -> None:
    found = Volume(np.zeros((20, 20, 20)), 0.1).sharpness
    assert found.across is None
    assert str(found) == "sharpness: not known, no edges"


def halves_of(cut: float, shift: float = 0.0, seed: int = 1) -> HalfScans:
    """Planes of white signal up to a frequency [1/voxel], noise a hundredth of it below
    and all of it above; those from behind moved by a shift [voxels].
    """
    rng = np.random.default_rng(seed)
    k = np.hypot(np.fft.fftfreq(96)[:, None], np.fft.fftfreq(96))
    signal = np.fft.fft2(rng.normal(size=(3, 96, 96))) * (k < cut)
    moved = np.exp(-2j * np.pi * np.fft.fftfreq(96) * shift)
    planes = [
        np.fft.ifft2(signal * phase).real + 0.05 * rng.normal(size=signal.shape)
        for phase in (1.0, 1.0, moved, moved.conj())
    ]
    even, odd, before, behind = (one.astype(np.float32) for one in planes)
    every = np.ones(96, bool)
    return HalfScans(even, odd, before, behind, (-1.0, 0.0, 1.0), (0.1, 0.1), every)


@pytest.mark.parametrize("cut", [0.12, 0.25, 0.4])
def test_details_end_where_noise_begins(cut: float) -> None:
    """In the ring of the spectrum in which the signal does, or the next."""
    found = detail_mm(halves_of(cut))
    assert found is not None
    assert cut <= 0.1 / found <= cut + 3.2 / 96


@pytest.mark.parametrize("shift", [-0.8, 0.0, 0.15, 0.5])
def test_planes_seen_from_both_sides_tell_their_distance(shift: float) -> None:
    found = displacement(halves_of(0.2, shift))
    assert found is not None
    apart, error = found
    assert apart == pytest.approx(0.2 * abs(shift), abs=max(3.0 * error, 0.004))


def off_axis(off: float) -> Volume:
    """Reconstruct a turned square rod, its images by the law of its shadow, with the axis aside by
    so many pixels, which are 0.5 mm at the axis."""
    views, cols, rows, sod, sdd, pixel = 90, 64, 20, 200.0, 400.0, 1.0
    angles = np.arange(views) * 360.0 / views

    def scan_of(aside: float) -> ConeVec:
        return ConeVec.circular(
            sod=sod, sdd=sdd, angles=angles, shape=(rows, cols), pixel=pixel,
            offset=(aside, 0.0),
        )  # fmt: skip

    c = np.arange(4 * cols) / 4 - (4 * cols - 1) / 8
    images = np.empty((views, rows, cols), np.float32)
    for image, row in zip(images, scan_of(off * pixel).rows, strict=True):
        source, panel, u, _ = row.reshape(4, 3)
        ray = (panel + c[:, None] * u - source)[:, :2]
        ray /= np.linalg.norm(ray, axis=1)[:, None]
        turn = np.array([[0.98, 0.2], [-0.2, 0.98]])
        turn /= np.sqrt(np.linalg.det(turn))
        start, along = turn @ source[:2], ray @ turn.T
        ends = (np.array([-9.0, 9.0])[:, None, None] - start) / along
        low, high = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
        line = 0.02 * np.maximum(high - low, 0.0)
        image[:] = line.reshape(cols, 4).mean(axis=1)
    images += np.random.default_rng(3).normal(0.0, 0.004, images.shape)
    return fdk(images.astype(np.float32), scan_of(0.0), Grid((18, 64, 64), 0.5))


@pytest.mark.filterwarnings("ignore:edges doubled")
@pytest.mark.parametrize("off", [0.0, 0.6])
@pytest.mark.daily(1)
def test_an_axis_beside_its_place_doubles_edges(off: float) -> None:
    volume = off_axis(off)
    found = volume.sharpness
    assert found.doubled == bool(off)
    if off:
        assert found.doubled_mm == pytest.approx(2.0 * off * 0.5, rel=0.25)
        assert "edges doubled" in str(found)
        # What the geometry says of it, and what the edges show.
        assert volume.accuracy.doubled_mm <= found.doubled_mm
        assert volume.accuracy.doubled_mm == pytest.approx(found.doubled_mm, rel=0.25)


@pytest.mark.filterwarnings("ignore:values may be off")
@pytest.mark.slow
def test_edges_farther_apart_than_they_are_wide_are_not_called_sharp() -> None:
    """By five voxels, of which half scans' edges show one, and each of the two is narrow."""
    with pytest.warns(UserWarning, match="edges doubled: the axis offset"):
        volume = off_axis(2.5)
    found, accuracy = volume.sharpness, volume.accuracy
    assert found.doubled_cause == "axis"
    assert found.doubled_mm == accuracy.doubled_mm == pytest.approx(2.5, rel=0.1)
    assert accuracy.edges_cause == "axis"
    assert accuracy.edges_mm >= accuracy.doubled_mm > found.across.mm
    assert str(found).startswith(
        f"sharpness: edges doubled by {found.doubled_mm:.2g} mm ("
    )
    assert f"each {found.across.mm:.2g} mm wide" in str(found)
