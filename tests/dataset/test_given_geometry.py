"""A geometry given for a data set of one's own is used, and compared with the stated one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import flexdt as fx
from flexdt.twin.dataset.dataset_errors import DatasetError
from flexdt.twin.exchange.geometry import ExchangeError

VIEWS = 12
Written = Callable[..., Any]


@pytest.fixture(params=["flexdt.json", "settings texts", "saved geometry"])
def folder(
    request: pytest.FixtureRequest, written: Written, record: Written, tmp_path: Path
) -> Path:
    """A data set of each kind of folder."""
    made = written(record(frames=VIEWS))
    if request.param == "settings texts":
        (made / "flexdt.json").unlink()
    if request.param == "saved geometry":
        data = fx.open(made)
        moved = replace(data, cone_vec=moved_aside(data.cone_vec, 0.1))
        made = tmp_path / "saved"
        moved.save(made)
    return made


def moved_aside(geometry: fx.ConeVec, mm: float) -> fx.ConeVec:
    panel = geometry.detector + mm * geometry.u / np.linalg.norm(geometry.u[0])
    return fx.ConeVec.from_vectors(geometry.source, panel, geometry.u, geometry.v)


def test_it_is_used_in_place_of_the_stated_one(folder: Path) -> None:
    stated = fx.open(folder)
    given = moved_aside(stated.cone_vec, 0.7)
    data = fx.open(folder, geometry=given)
    np.testing.assert_array_equal(data.geometry.rows, given.rows)
    assert data.correction is None
    assert data.warnings == stated.warnings


def test_other_angles_and_pixels_are_said(folder: Path) -> None:
    stated = fx.open(folder).cone_vec
    order = np.r_[3, 1, 2, 0, 4:VIEWS]
    [told] = set(fx.open(folder, geometry=stated[order]).warnings) - set(
        fx.open(folder).warnings
    )
    assert "order" in told
    larger = fx.ConeVec.from_vectors(
        stated.source, stated.detector, 3.0 * stated.u, 3.0 * stated.v
    )
    told = str(fx.open(folder, geometry=larger).warnings)
    assert "pixel" in told


def test_another_number_of_views_is_refused(folder: Path) -> None:
    stated = fx.open(folder).cone_vec
    with pytest.raises(ExchangeError, match=r"12 projections, the geometry 11 views"):
        fx.open(folder, geometry=stated[1:])


def test_distances_are_refused(folder: Path) -> None:
    with pytest.raises(
        DatasetError,
        match=r"distances with a scan of flexdt or a scanner.*allowed: with .*NXtomo",
    ):
        fx.open(folder, distances=(100.0, 200.0))
