"""Pixels that are not square: rows are taken anew, and a right scan is offered."""

from __future__ import annotations

import numpy as np
import pytest

import flexdt as fx
from flexdt.library.calibration.calibrate import squared
from flexdt.twin.dataset.dataset_errors import DatasetMissingError
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses


@pytest.mark.parametrize("pitch", [(0.31, 0.2), (0.2, 0.31), (0.2, 0.5)])
def test_rows_are_where_the_panel_has_them(pitch: tuple[float, float]) -> None:
    """An image that grows evenly with height reads the same at the same height, and all light
    is kept."""
    cone = fx.ConeVec.circular(sod=100, sdd=200, angles=3, shape=(60, 40), pixel=pitch)
    height = -np.arange(60) * np.linalg.norm(cone.v[0])
    image = np.rint(20_000 + 400 * (height - height.mean()))[:, None] + np.zeros(40)
    counts = np.stack([image] * 3).astype(np.uint16)
    data = squared(fx.DataSet.from_arrays(counts, cone, flat=np.full((60, 40), 50_000)))
    u, v = (np.linalg.norm(step[0]) for step in (data.cone_vec.u, data.cone_vec.v))
    assert u == pytest.approx(v)
    rows = data.shape[0]
    there = -(np.arange(rows) - (rows - 1) / 2) * v
    inner = slice(3, -3)
    assert np.abs(data.counts(1)[inner, 7] - (20_000 + 400 * there[inner])).max() < 2.0
    assert rows * v == pytest.approx(60 * np.linalg.norm(cone.v[0]), abs=v)
    assert data.line_integrals(0).shape == data.shape == (rows, 40)
    assert any("calibration takes their 60 rows as" in w for w in data.warnings)
    with pytest.raises(DatasetMissingError):
        _ = squared(fx.DataSet.from_arrays(counts, cone)).flat


def test_square_pixels_stay_what_they_are() -> None:
    cone = fx.ConeVec.circular(sod=100, sdd=200, angles=3, shape=(6, 4), pixel=0.2)
    data = fx.DataSet.from_arrays(np.full((3, 6, 4), 500), cone)
    assert squared(data) is data


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 1, 0])
@pytest.mark.campaign(1)
def test_a_right_scan_with_oblong_pixels_is_offered(seed: int) -> None:
    """It was refused as beads of another size, or none was found."""
    rng = np.random.default_rng(seed)
    pixel = (0.25, 0.25 * float(np.exp((seed - 1) * 0.45)))
    reach = {"dO_x": 2, "dO_y": 2, "dO_z": 4, "alpha": 20, "tau_x": 1, "tau_z": 1}
    truth = {n: float(rng.uniform(-r, r)) for n, r in reach.items()}
    cone = fx.ConeVec.circular(
        sod=600, sdd=1059, angles=12, shape=(int(180 / pixel[1]), 560), pixel=pixel
    )
    real = Poses.from_cone_vec(cone).cone_vec(Offsets.from_edge(truth))
    seen = fx.simulate("normal", real.with_shape(cone.detector_shape), noise=seed, rays=3)
    data = fx.DataSet.from_arrays(seen.counts(), cone, flat=seen.flat, dark=seen.dark)
    found = fx.calibrate(data, "normal")
    assert found.calibration.identifiable, found.document["problems"]
    for name, value in truth.items():
        e = found.calibration.fit.certificate.estimates[name]
        assert abs(e.value - value) < 4.5 * e.sigma, (name, e, value)
