"""What the comparison computes for many images at once, beside numpy and scipy image by image."""

from __future__ import annotations

import numpy as np
import pytest

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import Grid
from flexdt.twin.reconstruction import Truncation, fdk
from flexdt.twin.reconstruction.acquisition.trajectory import circle_of
from flexdt.twin.reconstruction.acquisition.truncation import Prism
from flexdt.twin.reconstruction.consistency.reprojection import (
    ARCS,
    Reprojection,
)
from flexdt.twin.reconstruction.feldkamp import fdk_plan
from flexdt.twin.reconstruction.white_noise import MEDIAN_OF_SQUARES, noise_of


@pytest.mark.parametrize("shape", [(12, 6, 9), (13, 6, 9), (12, 1, 9), (61, 16, 32)])
def test_noise_is_found_from_medians(shape: tuple[int, int, int]) -> None:
    images = np.random.default_rng(2).random(shape).astype(np.float32)
    if shape[1] > 1:
        beside = np.diff(np.diff(images, axis=1), axis=2) / 2.0
    else:
        beside = np.diff(images, n=2, axis=2) / np.sqrt(6.0)
    between = np.diff(images, n=2, axis=0) / np.sqrt(6.0)
    least = min(np.median(one**2, axis=0).mean() for one in (beside, between))
    assert noise_of(images) == pytest.approx(least / MEDIAN_OF_SQUARES, rel=1e-5)


@pytest.mark.parametrize("count", [12, 13, 35, 61])
def test_arcs_hold_about_as_many_views_each(count: int) -> None:
    rng = np.random.default_rng(count)
    images, again = rng.random((2, count, 4, 9)).astype(np.float32)
    rest = again - images
    smooth = 0.25 * rest[..., :-2] + 0.5 * rest[..., 1:-1] + 0.25 * rest[..., 2:]
    shown = Reprojection(images, np.zeros((1, 1, 1), np.float32), again, 0.0)
    for found, values in zip(shown.arcs, (rest, np.diff(smooth)), strict=True):
        each = [np.mean(arc**2) for arc in np.array_split(values, ARCS)]
        assert np.allclose(found, each, rtol=1e-5)


def test_columns_of_prisms_are_their_outlines_projections() -> None:
    rng = np.random.default_rng(8)
    scan = ConeVec.circular(
        sod=200.0, sdd=400.0, angles=40, shape=(8, 60), pixel=0.5, offset=(4.0, 0.0)
    )
    prisms = tuple(
        Prism(rng.uniform(-2.0, 2.0, 2), np.diag(1.0 / rng.uniform(20.0, 22.0, 2)), 0.02)
        for _ in range(3)
    )
    cut_off = Truncation(np.arange(3.0), prisms, np.ones(3, np.bool_))
    turn = np.linspace(0.0, 2.0 * np.pi, 20_000)
    disc = np.stack([np.cos(turn), np.sin(turn)])
    places = [np.linalg.inv(p.to_disc) @ disc + p.centre[:, None] for p in prisms]
    points = np.pad(np.concatenate(places, axis=1).T, ((0, 0), (0, 1)))
    at = scan.project_points(points, (8, 60))[..., 0]
    # The outline has 72 points, between which it is longer by less than a thousandth.
    wanted = 2.0 - at.min(), at.max() - 59.0 + 2.0
    assert np.all(wanted > np.array([32.0, 32.0]))  # else half a panel is taken
    assert np.abs(np.array(cut_off.columns(scan, 60)) + 0.5 - wanted).max() < 0.7


def test_geometries_of_the_same_sources_share_a_circle() -> None:
    scan = ConeVec.circular(sod=200.0, sdd=400.0, angles=40, shape=(8, 60), pixel=0.5)
    moved = ConeVec.from_vectors(scan.source, scan.detector + 3.0, scan.u, scan.v)
    assert circle_of(moved) is circle_of(scan)
    wider = ConeVec.from_vectors(1.25 * scan.source, scan.detector, scan.u, scan.v)
    assert circle_of(wider).radius == pytest.approx(250.0)


@pytest.mark.filterwarnings("ignore:.* layers of the grid lie")
@pytest.mark.parametrize("side", [50, 51])
@pytest.mark.parametrize("more", [0, 4])
@pytest.mark.parametrize("rows", [6, 7, 8])
def test_voxels_side_by_side_are_those_of_columns(
    rows: int, more: int, side: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also above and below the panel, and on the axis, where voxels are just before its
    outermost rows."""
    images = np.random.default_rng(rows).random((40, rows, 60)).astype(np.float32)
    scan = ConeVec.circular(sod=200.0, sdd=400.0, angles=40, shape=(rows, 60), pixel=0.5)
    grid = Grid((rows + more, side, side), 0.25)
    beside = fdk(images, scan, grid, errors=False).data
    monkeypatch.setattr(fdk_plan, "FEW_ROWS", 0)
    columns = fdk(images, scan, grid, errors=False).data
    assert np.array_equal(np.isnan(beside), np.isnan(columns))
    apart = np.nanmax(np.abs(beside - columns))
    assert 0.0 < apart < 1e-5 * np.nanmax(np.abs(columns))
