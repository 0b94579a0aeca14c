"""A distorted panel: its image is straightened, its report comes back, and a scan tells it."""

from __future__ import annotations

import dataclasses
import json
import math

import cv2
import numpy as np
import pytest
from prior_coverage import PIXEL, SDD, SHAPE, pixels, radiographs

from flexdt.library.analysis import calibrate as calibrate_marks
from flexdt.phantoms import load_phantom
from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.camera_lag import Lag
from flexdt.twin.calibration.detect.detection import detect_beads
from flexdt.twin.calibration.frame_source import ArrayFrames
from flexdt.twin.calibration.pipeline import (
    Calibration,
    CalibrationRequest,
    Scan,
    calibrate,
)
from flexdt.twin.errors import TwinError
from flexdt.twin.findings import Findings
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.panel import Border, Panel, PanelModel
from flexdt.twin.geometry.poses import Poses

SMALL = (90, 120)


def drawn(seed: int, borders: tuple[Border, ...] = ()) -> Panel:
    model = PanelModel(1.0, SMALL, borders)
    rng = np.random.default_rng(seed)
    return Panel(model, tuple(rng.normal(size=len(model.names)).tolist()))


@pytest.mark.parametrize("seed", range(4))
def test_terms_are_the_polynomials_they_are_called(seed: int) -> None:
    panel = drawn(seed, (Border(1, 40.0),))
    place = np.random.default_rng(seed).uniform([0, 0], [119, 89])
    x, y = (place[0] - 59.5) / 60, (place[1] - 44.5) / 60
    c = dict(zip(panel.model.names, panel.coefficients, strict=True))
    across = c["aspect"] * x + c["skew"] * y
    down = -c["aspect"] * y + c["skew"] * x
    for i, j in ((2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3)):
        across += c[f"column_x{i}y{j}"] * x**i * y**j
        down += c[f"row_x{i}y{j}"] * x**i * y**j
    if place[1] >= 40.0:
        across += c["column_from_row_40"]
        down += c["row_from_row_40"]
    assert panel.shift(place) == pytest.approx([across, down], abs=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_an_image_is_straightened(seed: int) -> None:
    """A pattern f of waves, seen as f(m - d(m)), is f again."""
    panel = drawn(seed)
    row, column = np.mgrid[:90, :120].astype(float)

    def pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.sin(0.21 * x + 0.5) * np.cos(0.17 * y) + 0.3 * np.sin(
            0.1 * x - 0.13 * y
        )

    d = panel.shift(np.stack([column, row], axis=-1))
    seen = pattern(column - d[..., 0], row - d[..., 1]).astype(np.float32)
    inner = (slice(12, -12), slice(12, -12))
    true = pattern(column, row)[inner]
    assert np.abs(panel.undistorted(seen)[inner] - true).max() < 0.01
    assert np.abs(seen[inner] - true).max() > 0.1


def test_the_document_comes_back_and_what_is_none_is_refused() -> None:
    panel = drawn(5, (Border(0, 33.5),))
    again = Panel.from_json(json.loads(json.dumps(panel.to_json())))
    place = np.array([[12.0, 30.0], [100.0, 80.0]])
    assert again.shift(place) == pytest.approx(panel.shift(place), abs=0)
    for spoilt in (
        {},
        {"shape": [90]},
        {**panel.to_json(), "coefficients": {}},
        [],
        None,
    ):
        with pytest.raises(TwinError, match="panel's distortion cannot be read"):
            Panel.from_json(spoilt)  # type: ignore[arg-type]
    with pytest.raises(TwinError, match="distortion is of those"):
        panel.undistorted(np.zeros((4, 4), np.float32))


@pytest.mark.slow
def test_a_barrel_in_the_images_is_found_and_undone() -> None:
    """Images of a renderer of its own are warped; the map then puts the spots where they were.
    Of a phantom that is known exactly: five beads do not tell a barrel from a strain of .1
    %."""
    rng = np.random.default_rng(3)
    beads = np.array(
        [[9, 4, -20], [-10, 6, -9], [4, -11, 1], [-3, 10, 12], [11, -2, 21.0]]
    )
    angles, sod = 15.0 * np.arange(24), 420.0
    truth = {"dO_x": 1.2, "dO_y": -0.7, "dO_z": 3.0, "alpha": 20.0, "det_pitch": 0.2}
    images = radiographs(rng, beads, angles, sod, truth)
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float32)
    x, y = (column - 477.5) / 305, (row - 379.5) / 305
    bulge = 0.8 * (x * x + y * y)
    bent = [
        cv2.remap(image, column - bulge * x, row - bulge * y, cv2.INTER_CUBIC)
        for image in images
    ]
    poses = Poses.upright([0, 0, 0], [0, sod, 0], [0, SDD, 0], PIXEL, np.radians(angles))
    model = BeadModel(beads, np.full(5, 1.0))
    request = CalibrationRequest(bead_tolerance_mm=0.0)
    result = calibrate([Scan(ArrayFrames(bent, SHAPE), poses)], model, request)
    assert "panel_distorted" in [f.code for f in result.findings]
    assert result.identifiable
    assert result.fit is not None
    panel = result.fit.panel
    assert panel is not None
    for name, e in result.fit.certificate.estimates.items():
        assert abs(e.value - truth.get(name, 0.0)) < 3.5 * e.sigma, name
    straight, before = [], []
    for image, ideal in zip(bent, pixels(beads, angles, sod, truth), strict=True):
        for some, shown in ((straight, panel.undistorted(image)), (before, image)):
            spots = detect_beads(shown, radius_px=(5, 30)).centers
            some.append(
                spots[np.linalg.norm(spots[:, None] - ideal, axis=2).argmin(axis=0)]
            )
    ideal = pixels(beads, angles, sod, truth).reshape(-1, 2)
    # Shift, turn, scale and perspective belong to the geometry.
    u, v = ((ideal - [477.5, 379.5]) / 305).T
    one, none = np.ones_like(u), np.zeros_like(u)
    geometry = np.concatenate(
        [
            np.stack([one, none, u, v, -v, u * u, u * v], axis=1),
            np.stack([none, one, v, -u, none, u * v, v * v], axis=1),
        ]
    )
    left = []
    for some in (straight, before):
        off = (np.concatenate(some) - ideal).T.ravel()
        off -= geometry @ np.linalg.lstsq(geometry, off, rcond=None)[0]
        left.append(math.sqrt(np.mean(off**2)))
    assert left[0] < 0.03
    assert left[1] > 3 * left[0]


def test_lag_that_is_seen_is_of_the_panel() -> None:
    poses = Poses.upright([0, 0, 0], [0, 600, 0], [0, 1059, 0], 0.15, np.zeros(1))
    scans = tuple(
        Scan(ArrayFrames([np.zeros(SMALL, np.float32)], SMALL), poses) for _ in range(3)
    )
    model = BeadModel(np.zeros((1, 3)), np.ones(1))
    found = Calibration(None, (), Findings(), (), (), scans, model)
    assert found.panel is None
    lags = (Lag(0.03, 0.001), Lag(0.05, 0.001), Lag(0.2, 0.1))  # the last may be none
    panel = dataclasses.replace(found, lags=lags).panel
    assert panel == dataclasses.replace(Panel.flat(SMALL), lag=0.04)
    assert Panel.from_json(panel.to_json()) == panel
    image = np.zeros((3, 4), np.float32)  # of any shape: there is nothing to straighten
    assert panel.undistorted(image) is image
    for lag in (-0.1, 0.4, "much"):
        with pytest.raises(TwinError, match=r"lag|much"):
            Panel.from_json({**panel.to_json(), "lag": lag})


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("width", [0.3, 0.9, 1.7])
def test_a_gap_is_filled_from_the_lines_beside_it(axis: int, width: float) -> None:
    """A ramp, of which the gap hides a part, is a ramp again, but where the kernel sees
    both."""
    first = 40
    panel = dataclasses.replace(
        Panel.flat(SMALL), model=PanelModel(0.0, SMALL, (Border(axis, 39.5),))
    )
    shift = [0.0, 0.0]
    shift[axis] = -width
    panel = dataclasses.replace(panel, coefficients=(*panel.coefficients, *shift))
    place = np.arange(SMALL[1 - axis], dtype=np.float32)
    line = place + width * (place >= first)
    image = np.broadcast_to(line if axis == 0 else line[:, None], SMALL).astype(
        np.float32
    )
    straight = panel.undistorted(image)
    whole = np.broadcast_to(place if axis == 0 else place[:, None], SMALL)
    inner = np.abs(straight - whole)[5:-5, 5:-5]
    assert inner.max() < 0.3 * width
    hidden = straight[9, 36:45] if axis == 0 else straight[36:45, 9]
    assert (np.diff(hidden) > 0).all()


@pytest.mark.daily(2)
@pytest.mark.campaign(4)
@pytest.mark.parametrize("seed", range(16))
def test_a_gap_between_tiles_is_one_border_that_parts_the_same_marks(seed: int) -> None:
    """Marks with noise, those beyond a drawn column or row nearer by the gap. Beads keep their
    rows, so one between rows may be taken for other offsets; their intervals hold then."""
    rng = np.random.default_rng(seed)
    scan = ConeVec.circular(sod=600, sdd=1059, angles=60, shape=(460, 478), pixel=0.2992)
    places = scan.project_points(load_phantom("lego").beads)
    axis, at, gap = int(rng.integers(2)), rng.uniform(150, 320), rng.uniform(0.6, 2.0)
    seen = places + rng.normal(size=places.shape) * 0.02
    seen[..., axis] -= np.where(places[..., axis] > at, gap, 0.0)
    marks = [
        (i, str(k), *seen[i, k].tolist(), 0.02) for i, k in np.ndindex(seen.shape[:2])
    ]
    found = calibrate_marks(None, "lego", geometry=scan, markers=marks).document
    estimates = found["parameters"].values()
    assert max(abs(e["value"]) / e["sigma"] for e in estimates if e["sigma"]) < 4.0
    borders = found["panel"]["borders"] if found.get("panel") else []
    beyond = places[..., axis] > at
    assert len(borders) <= 1
    assert borders or axis == 1 or not 0.1 < beyond.mean() < 0.9
    for border in borders:
        assert border["axis"] == ("column", "row")[axis]
        assert np.mean((seen[..., axis] >= border["from"]) != beyond) < 0.03
