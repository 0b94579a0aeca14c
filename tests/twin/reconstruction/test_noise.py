"""A volume's sigma beside the spread of many volumes, with images and noise of this file's own.

Spheres by their chords, Poisson noise, flat images of a few exposures, pixels of unlike gain
and a panel that blurs. Geometries are drawn.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection import Grid
from flexdt.twin.reconstruction import fdk_parts
from flexdt.twin.reconstruction.iterative import sirt

SEEDS = 10


@dataclass(frozen=True)
class Drawn:
    """A scan, and what its camera is like."""

    views: int
    arc_deg: float
    aside: float
    tilts: tuple[float, float, float]
    counts: float
    flats: int
    blur_px: float
    spheres: tuple[tuple[float, float, float, float], ...]

    @classmethod
    def at(cls, seed: int) -> Drawn:
        rng = np.random.default_rng([20261125, seed])
        aside = float(rng.choice([0.0, rng.uniform(-14.0, 14.0)]))
        places = [
            (*rng.uniform(-8.0, 8.0, 2), rng.uniform(-12.0, 12.0), rng.uniform(1.0, 5.0))
            for _ in range(int(rng.integers(1, 12)))
        ]
        return cls(
            views=int(rng.integers(150, 241)),
            arc_deg=360.0
            if aside or rng.random() < 0.6
            else float(rng.uniform(205.0, 300.0)),
            aside=aside,
            tilts=tuple(
                float(t) for t in rng.choice([0.0, 1.0]) * rng.uniform(-1.0, 1.0, 3)
            ),
            counts=float(10.0 ** rng.uniform(3.0, 4.5)),
            flats=int(rng.choice([1, 4, 40])),
            blur_px=float(rng.choice([0.0, rng.uniform(0.3, 0.6)])),
            spheres=tuple(places),
        )

    def geometry(self) -> ConeVec:
        angles = np.linspace(0.0, self.arc_deg, self.views, endpoint=self.arc_deg < 360.0)
        return ConeVec.circular(
            sod=200.0, sdd=350.0, angles=angles, shape=(72, 80), pixel=0.6,
            offset=(self.aside, 0.0), tilts=self.tilts,
        )  # fmt: skip


def chords(scan: Drawn, rows: FloatArray) -> Float32Array:
    """Line integrals (n, 72, 80) of spheres of 0.05/mm, from the rows of the geometry alone."""
    out = np.zeros((len(rows), 72, 80))
    c, r = np.arange(80) - 39.5, np.arange(72) - 35.5
    for view, row in enumerate(rows):
        source, panel, u, v = row.reshape(4, 3)
        ray = panel + c[None, :, None] * u + r[:, None, None] * v - source
        ray /= np.linalg.norm(ray, axis=2, keepdims=True)
        for *centre, radius in scan.spheres:
            to = np.array(centre) - source
            near = (to * to).sum() - (ray @ to) ** 2
            out[view] += 0.1 * np.sqrt(np.maximum(radius**2 - near, 0.0))
    return out.astype(np.float32)


def exposed(scan: Drawn, clean: Float32Array, rng: np.random.Generator) -> Float32Array:
    """Line integrals as a camera measures them."""
    gain = 1.0 + 0.05 * rng.standard_normal(clean.shape[1:])

    def image(expected: FloatArray, of: int = 1) -> FloatArray:
        light = rng.poisson(scan.counts * of * expected).astype(float)
        blur = (0.0,) * (light.ndim - 2) + (scan.blur_px,) * 2
        return gain * gaussian_filter(light, blur) / of

    flat = image(np.ones(clean.shape[1:]), scan.flats)
    views = image(np.exp(-clean.astype(float)))
    return (-np.log(np.maximum(views, 0.5) / flat)).astype(np.float32)


def ratios(scan: Drawn) -> list[float]:
    """Sigma by the spread of volumes, in rings about the axis: root of mean squares."""
    geometry = scan.geometry()
    clean, grid = chords(scan, geometry.rows), Grid((40, 48, 48), 0.4)
    volumes, sigmas = [], []
    for seed in range(SEEDS):
        images = exposed(scan, clean, np.random.default_rng(seed))
        volume = fdk_parts(
            lambda images=images: [images], geometry, (72, 80), grid, errors=True
        )
        volumes.append(volume.data)
        if seed < 2:
            assert volume.sigma is not None
            sigmas.append(volume.sigma)
    spread = np.std(volumes, axis=0, ddof=1)
    x = (np.arange(48) - 23.5) * 0.4
    radius = np.hypot(x, x[:, None])
    found = []
    for low, high in ((0.0, 1.0), (1.0, 3.0), (3.0, 6.0), (6.0, 9.0)):
        ring = (radius >= low) & (radius < high)
        ours, theirs = np.array(sigmas)[:, 4:-4, ring], spread[4:-4, ring]
        found.append(float(np.sqrt(np.nanmean(ours**2) / np.nanmean(theirs**2))))
    return found


@pytest.mark.parametrize("seed", [1, 0, *range(2, 12)])
@pytest.mark.slow
@pytest.mark.campaign(2)
def test_sigma_is_the_spread_of_volumes(seed: int) -> None:
    """Within a fifth: the spread of ten volumes is known to some per cent on the axis itself.

    Few views of a detailed object leave streaks, which count as noise: then sigma is too large.
    """
    scan = Drawn.at(seed)
    most = 1.25 if scan.views >= 2.5 * 80 else 1.6
    found = ratios(scan)
    assert all(0.8 < ratio < most for ratio in found), (scan, found)


def test_the_order_of_views_does_not_matter() -> None:
    scan = Drawn.at(1)
    geometry = scan.geometry()
    images = exposed(scan, chords(scan, geometry.rows), np.random.default_rng(1))
    order = np.random.default_rng(2).permutation(len(images))
    grid, sigmas = Grid((20, 24, 24), 0.8), []
    for chosen in (np.arange(len(images)), order):
        volume = fdk_parts(
            lambda chosen=chosen: [images[chosen]],
            geometry[chosen],
            (72, 80),
            grid,
            errors=True,
        )
        sigmas.append(volume.sigma)
    assert sigmas[0] is not None
    assert sigmas[1] is not None
    np.testing.assert_allclose(sigmas[0], sigmas[1], rtol=2e-3)


def test_what_is_not_measured_is_none() -> None:
    """One row has no others to be compared with; other volumes are not this one."""
    scan = Drawn.at(0)
    geometry = scan.geometry()
    clean = chords(scan, geometry.rows)
    grid = Grid((4, 24, 24), 0.8)
    volume = fdk_parts(lambda: [clean], geometry, (72, 80), grid, errors=True)
    assert volume.sigma is not None
    assert volume.like(np.zeros((4, 24, 24))).sigma is None
    assert fdk_parts(lambda: [clean], geometry, (72, 80), grid).sigma is None
    assert sirt(clean[::10], geometry[::10], volume, iterations=1).sigma is None
    flat = ConeVec.circular(sod=200, sdd=350, angles=60, shape=(1, 80), pixel=0.6)
    row, slice_ = clean[:60, 36:37], Grid((1, 24, 24), 0.8)
    line = fdk_parts(lambda: [row], flat, (1, 80), slice_, errors=True)
    assert line.sigma is None


@pytest.mark.parametrize("rows", range(2, 9))
def test_few_rows_have_a_sigma_or_none(rows: int) -> None:
    rng = np.random.default_rng(rows)
    scan = ConeVec.circular(sod=200, sdd=350, angles=60, shape=(rows, 80), pixel=0.6)
    images = rng.normal(0.0, 0.01, (60, rows, 80)).astype(np.float32)
    volume = fdk_parts(
        lambda: [images], scan, (rows, 80), Grid((rows, 24, 24), 0.8), errors=True
    )
    assert volume.sigma is None or np.isfinite(volume.sigma).any()


def box_chords(rows: FloatArray, half: FloatArray, mu: float) -> Float32Array:
    """Line integrals (n, 72, 80) of a box about the origin, by its three pairs of planes."""
    c, r = np.arange(80) - 39.5, np.arange(72) - 35.5
    out = []
    for row in rows:
        source, panel, u, v = row.reshape(4, 3)
        ray = panel + c[None, :, None] * u + r[:, None, None] * v - source
        first, second = (-half - source) / ray, (half - source) / ray
        enters = np.minimum(first, second).max(axis=2)
        leaves = np.maximum(first, second).min(axis=2)
        length = np.linalg.norm(ray, axis=2)
        out.append(mu * length * np.maximum(leaves - enters, 0.0))
    return np.array(out, np.float32)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.slow
def test_a_plate_and_the_air_about_it_have_sigmas_of_their_own(seed: int) -> None:
    """A flat body across the axis: noise jumps from layer to layer, by a factor of ten.

    Of nine rows at least, since a voxel on a row has 1.5 times the variance of the mean.
    """
    rng = np.random.default_rng([20261130, seed])
    half = np.array([*rng.uniform(5.0, 8.0, 2), rng.uniform(1.4, 2.5)])
    counts, mu = 10.0 ** rng.uniform(3.5, 4.5), rng.uniform(0.15, 0.3)
    angles = np.linspace(0.0, 360.0, 200, endpoint=False)
    scan = ConeVec.circular(
        sod=200.0, sdd=350.0, angles=angles, shape=(72, 80), pixel=0.6
    )
    clean, grid = box_chords(scan.rows, half, mu), Grid((40, 48, 48), 0.4)
    volumes, sigma = [], None
    for _ in range(SEEDS):
        light = rng.poisson(counts * np.exp(-clean.astype(float)))
        images = -np.log(np.maximum(light, 0.5) / counts).astype(np.float32)
        volume = fdk_parts(
            lambda images=images: [images], scan, (72, 80), grid, errors=True
        )
        volumes.append(volume.data)
        sigma = volume.sigma
    assert sigma is not None
    spread = np.std(volumes, axis=0, ddof=1)
    height = np.abs((np.arange(40) - 19.5) * 0.4)
    for layers in (height < half[2] - 0.5, (height > half[2] + 1.0) & (height < 6.0)):
        ours, theirs = sigma[layers, 18:30, 18:30], spread[layers, 18:30, 18:30]
        ratio = np.sqrt((ours**2).mean() / (theirs**2).mean())
        assert 0.75 < ratio < 1.35, (seed, half, counts, mu, ratio)
