"""Errors of iterative volumes: their noise beside drawn noise, and claims beside the truth."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import flexdt as fx
from flexdt.twin import reconstruction
from flexdt.twin.projection import forward

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "studies"))

import claims

SHAPE = (14, 44)
SCAN = fx.ConeVec.circular(
    sod=120.0, sdd=240.0, angles=np.arange(72) * 5.0, shape=SHAPE, pixel=0.6
)
GRID = fx.Grid((12, 40, 40), 0.3)
OPTIONS: dict[str, dict[str, Any]] = {
    "sirt": {"iterations": 15},
    "sart": {"iterations": 3},
    "cgls": {"iterations": 6},
    "em": {"iterations": 15},
    "tv": {"iterations": 10, "weight": 1e-3},
}


def clean() -> np.ndarray:
    data = np.zeros((12, 40, 40), np.float32)
    data[2:10, 9:31, 10:29] = 0.1
    data[4:8, 15:22, 14:22] = 0.05
    return forward(fx.Volume(gaussian_filter(data, 0.7), 0.3), SCAN, SHAPE)


BODY = np.s_[3:9, 11:29, 12:27]


def noisy(seed: int, correlated: bool, counts: float = 2e3) -> np.ndarray:
    """Images with noise of counts, each pixel by itself, or as a scintillator spreads it."""
    rng = np.random.default_rng(seed)
    light = counts * np.exp(-clean().astype(float))
    noise = np.sqrt(light) * rng.standard_normal(light.shape)
    if correlated:
        noise = gaussian_filter(noise, (0.0, 0.7, 0.7))
    return -np.log((light + noise) / counts).astype(np.float32)


def made(algorithm: str, images: np.ndarray, **options: Any) -> fx.Volume:
    run = getattr(fx, algorithm, None) or getattr(reconstruction, algorithm)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        volume: fx.Volume = run(
            images, SCAN, GRID, progress=False, **OPTIONS[algorithm], **options
        )
    return volume


@pytest.mark.parametrize(
    ("algorithm", "correlated"),
    [
        ("cgls", False),
        pytest.param("sirt", False, marks=pytest.mark.slow),
        pytest.param("cgls", True, marks=pytest.mark.slow),
        pytest.param("sart", True, marks=pytest.mark.slow),
        pytest.param("em", False, marks=pytest.mark.slow),
        pytest.param("tv", False, marks=pytest.mark.slow),
    ],
)
def test_sigma_is_what_drawn_noise_does(algorithm: str, correlated: bool) -> None:
    """The scatter of volumes of other draws, of white noise and of noise that pixels share."""
    drawn = [made(algorithm, noisy(seed, correlated)).data for seed in range(1, 6)]
    scatter = np.sqrt(gaussian_filter(np.var(drawn, axis=0, ddof=1), 1.5))
    sigma = made(algorithm, noisy(0, correlated), errors=True).sigma
    assert sigma is not None
    ratio = (sigma / scatter)[BODY]
    assert 0.85 < np.median(ratio) < (1.6 if algorithm == "tv" else 1.25)


@pytest.mark.slow
def test_noise_of_the_flat_counts() -> None:
    """What all views share, as of a flat image, makes rings that no alternating sum has."""
    rng = np.random.default_rng(3)
    shared = rng.normal(0.0, 0.02, SHAPE).astype(np.float32)
    own = rng.normal(0.0, 0.02, (len(SCAN), *SHAPE)).astype(np.float32)
    alone = made("cgls", clean() + own, errors=True).sigma
    both = made("cgls", clean() + own + shared, errors=True).sigma
    assert alone is not None
    assert both is not None
    truth = [
        made("cgls", clean() + rng.normal(0.0, 0.02, SHAPE).astype(np.float32)).data
        for _ in range(6)
    ]
    ring = float(np.sqrt(np.var(truth, axis=0, ddof=1)[BODY].mean()))
    found = np.sqrt((both[BODY] ** 2).mean() - (alone[BODY] ** 2).mean())
    assert found == pytest.approx(ring, rel=0.6)


def test_without_errors_nothing_is_kept() -> None:
    volume = made("cgls", clean())
    assert volume.sigma is None
    assert volume.accuracy is None


@pytest.mark.slow
def test_fewer_iterations_leave_more_out_and_a_penalty_has_its_name() -> None:
    few = made("sirt", clean(), errors=True)
    more = fx.sirt(clean(), SCAN, GRID, iterations=60, errors=True, progress=False)
    by_tv = made("tv", clean(), errors=True)
    assert few.accuracy is not None
    assert more.accuracy is not None
    assert by_tv.accuracy is not None
    bias: Any = few._bias  # type: ignore[attr-defined]
    assert "stopping" in bias.bias.causes
    assert more.accuracy.most < few.accuracy.most
    assert "penalty" in by_tv._bias.bias.causes  # type: ignore[attr-defined]


def test_an_object_beyond_the_sides_is_not_bounded() -> None:
    narrow = np.ascontiguousarray(clean()[:, :, 14:30])
    scan = fx.ConeVec.circular(
        sod=120.0, sdd=240.0, angles=np.arange(72) * 5.0, shape=(14, 16), pixel=0.6
    )
    volume = fx.cgls(narrow, scan, GRID, iterations=6, errors=True, progress=False)
    assert "not bounded" in str(volume.accuracy)


@pytest.mark.slow
@pytest.mark.campaign(2)
@pytest.mark.parametrize("algorithm", ["sirt", "cgls", "tv"])
def test_claims_of_drawn_scans(algorithm: str) -> None:
    """Drawn scans that chose no constant, as the study draws them."""
    found = [
        claims.judged(claims.right(90, number, size=claims.SMALLER), algorithm)
        for number in range(5)
    ]
    tested = [one for one in found if np.isfinite(one.claimed) and np.isfinite(one.off)]
    assert not any(one.told for one in found)
    assert sum(one.true for one in tested) >= 0.8 * len(tested)
    noise = [one.noise for one in found if np.isfinite(one.noise)]
    assert min(noise, default=1.0) > 0.85
