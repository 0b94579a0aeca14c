"""Residuals of a volume: which views and pixels do not fit, whatever made the volume."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import flexdt as fx
from flexdt.twin.projection import forward

SHAPE = (24, 40)
SCAN = fx.ConeVec.circular(
    sod=200.0, sdd=400.0, angles=np.arange(60) * 6.0, shape=SHAPE, pixel=1.0
)


def body() -> fx.Volume:
    """A cube with a hole that is not in its middle."""
    data = np.zeros((16, 40, 40), np.float32)
    data[3:13, 10:28, 12:30] = 0.03
    data[6:10, 14:19, 16:22] = 0.0
    return fx.Volume(data, 0.5)


def images_of(spoilt: int | None, pixel: tuple[int, int] | None) -> np.ndarray:
    """Its images with noise; a foreign view, and a pixel with a gain of its own."""
    images = forward(body(), SCAN, SHAPE)
    rng = np.random.default_rng(2)
    if spoilt is not None:
        images[spoilt] = np.roll(images[(spoilt + 20) % 60], 3, axis=1)
    if pixel is not None:
        images[(slice(None), *pixel)] *= 1.8
    return images + rng.normal(0.0, 0.003, images.shape).astype(np.float32)


@pytest.mark.parametrize("view", [7, 41])
def test_a_foreign_view_is_the_worst(view: int) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        volume = fx.fdk(images_of(view, None), SCAN, fx.Grid((26, 44, 44), 0.5))
    found = volume.residuals
    assert found is not None
    assert found.own
    assert found.worst(3)[0] == view
    by_view = found.by_view
    assert by_view.max() > 2.0 * np.median(by_view)
    assert f"in view {view}" in repr(found)


def test_a_pixel_with_a_gain_of_its_own_is_the_worst() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        volume = fx.fdk(images_of(None, (12, 22)), SCAN, fx.Grid((26, 44, 44), 0.5))
    found = volume.residuals
    assert found is not None
    row, column = np.unravel_index(found.by_pixel.argmax(), found.by_pixel.shape)
    assert (row, column) == (12 // found.binned[0], 22 // found.binned[1])


def test_of_a_part_of_the_field_of_view_a_coarse_volume_is_projected() -> None:
    volume = fx.fdk(images_of(None, None), SCAN, fx.Grid((4, 10, 10), 0.5))
    found = volume.residuals
    assert found is not None
    assert not found.own


def test_a_volume_without_images_has_none() -> None:
    assert body().residuals is None


@pytest.mark.parametrize(
    ("algorithm", "cause"), [("sirt", "stopping"), ("tv", "penalty")]
)
@pytest.mark.daily(1)
def test_iterative_volumes_have_a_bound_and_residuals(algorithm: str, cause: str) -> None:
    """More iterations leave less of the object out."""
    data = fx.DataSet.from_arrays(images_of(9, None), SCAN)
    claims = []
    for iterations in (3, 20) if algorithm == "sirt" else (4,):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            volume = data.reconstruct(
                algorithm, voxel=0.5, shape=(26, 44, 44), iterations=iterations,
                progress=False,
            )  # fmt: skip
        if iterations == 3:
            assert volume.sigma is not None
            assert 0.0 < np.median(volume.sigma[8:16, 14:24, 12:20]) < 0.01
        assert volume.residuals is not None
        assert volume.residuals.worst(1)[0] == 9
        bias = volume._bias._bounded  # type: ignore[attr-defined]
        assert cause in bias.causes
        assert "cone" not in bias.causes, "the algorithm's own response holds it"
        claim = bias.accuracy(volume)
        assert claim is not None
        claims.append(claim.most)
    if algorithm == "sirt":
        assert claims[1] < 0.7 * claims[0]
