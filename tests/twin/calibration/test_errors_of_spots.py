"""Errors of spots that repeat with the turn or from pixel to pixel, or that are noise alone, are
no distortion of the panel and no motion."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from causes_named import calibrated as scored_calibration
from faults_drawn import right_draft, taken
from prior_coverage import PIXEL, SDD, SHAPE, pixels

from flexdt.twin.calibration import SIX
from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.detect.detection import Detections
from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.calibration.diagnose.table import explained
from flexdt.twin.calibration.fit.priors import exact
from flexdt.twin.calibration.frame_source import FrameSpots, FrameState, SpotFrames
from flexdt.twin.calibration.pipeline import (
    Calibration,
    CalibrationRequest,
    Scan,
    calibrate,
)
from flexdt.twin.geometry.poses import Poses

SOD = 500.0
RADIUS_MM = 2.0
NOISE_PX = 0.007
REACH = {"dO_x": 2.0, "dO_y": 2.0, "dO_z": 5.0, "alpha": 3.0, "tau_x": 1.0, "tau_z": 1.0}


def waves(rng: np.random.Generator, places: np.ndarray) -> np.ndarray:
    """Up to three waves in a turn: a background that pulls, the order of hardening."""
    n, k, _ = places.shape
    turn = 2.0 * math.pi * np.arange(n) / n
    out = np.zeros_like(places)
    for m in range(4):
        a, b = 0.003 / (1 + m) * rng.normal(size=(2, 1, k, 2))
        out += a * np.cos(m * turn)[:, None, None] + b * np.sin(m * turn)[:, None, None]
    return out


def own_places(rng: np.random.Generator, places: np.ndarray) -> np.ndarray:
    """Polynomials of each bead's place on its orbit: of its size, distance or slope."""
    middle = places.mean(axis=0)
    reach = np.abs(places - middle).max(axis=(0, 2))[:, None]
    x, y = np.moveaxis((places - middle) / reach, 2, 0)
    shapes = np.stack([np.ones_like(x), x, y, x * x, x * y, x**3], axis=-1)
    size = 0.004 * rng.normal(size=(places.shape[1], 6, 2))
    return np.einsum("nkp,kpc->nkc", shapes, size)


def shadows(rng: np.random.Generator, places: np.ndarray) -> np.ndarray:
    """An edge of the body passes behind each bead twice in a turn."""
    n, k, _ = places.shape
    part = np.arange(n) / n
    out = np.zeros_like(places)
    for bead in range(k):
        for _ in range(2):
            off = (part - rng.random() + 0.5) % 1.0 - 0.5
            bump = np.exp(-0.5 * (off / rng.uniform(0.05, 0.12)) ** 2)
            out[:, bead] += 0.008 * rng.normal(size=2) * bump[:, None]
    return out


def still(rng: np.random.Generator, places: np.ndarray) -> np.ndarray:
    """No errors but noise."""
    return np.zeros_like(places)


EXPECTED = {CalibrationCode.BEAD_ERRORS, CalibrationCode.HELD_UNCHECKED}
"""What may be said of a right scan whose spots err, with values that are held."""
KINDS = {
    "waves": waves,
    "own_places": own_places,
    "shadows": shadows,
    "in a row": still,
}


def calibrated(
    kind: str, seed: int, frames: int = 120, rows: tuple[float, ...] = (-18.0, 0.0, 18.0)
) -> tuple[Calibration, dict[str, float]]:
    """A calibration of exact beads, six offsets unknown, and the truth.

    Args:
        kind: of errors.
        seed: of all draws.
        frames: number of frames.
        rows: heights of the beads, up to 2 mm [mm].
    """
    rng = np.random.default_rng([580, seed])
    k = len(rows)
    beads = rng.uniform(-9.0, 9.0, (k, 3))
    beads[:, 2] = np.array(rows) + rng.uniform(-2.0, 2.0, k)
    truth = {n: float(rng.uniform(-r, r)) for n, r in REACH.items()}
    if kind == "in a row":
        # In the plane of source and axis a bead stays in its row.
        beads[k // 2, 2] = -truth["dO_y"]
    angles = 360.0 / frames * np.arange(frames)
    places = pixels(beads, angles, SOD, truth)
    found = places + KINDS[kind](rng, places) + NOISE_PX * rng.normal(size=places.shape)
    radii = np.full(k, RADIUS_MM * SDD / SOD / PIXEL)
    looks = []
    for frame in found:
        spots = Detections.of_points(frame, NOISE_PX, radii, SHAPE)
        looks.append(FrameSpots(replace(spots, bias=np.zeros(k)), FrameState.USABLE))
    poses = Poses.upright([0, 0, 0], [0, SOD, 0], [0, SDD, 0], PIXEL, np.radians(angles))
    request = CalibrationRequest(
        free=SIX, priors=exact(SIX), second_look=False, bead_tolerance_mm=0.0
    )
    scan = Scan(SpotFrames(looks), poses)
    return calibrate([scan], BeadModel(beads, np.full(k, RADIUS_MM)), request), truth


@pytest.mark.daily(1)
@pytest.mark.campaign(1)
@pytest.mark.parametrize("kind", KINDS)
def test_what_repeats_with_the_turn_is_no_panel_and_in_the_sigmas(kind: str) -> None:
    for seed in range(8):
        result, truth = calibrated(kind, seed)
        assert result.fit is not None
        assert "panel_distorted" not in {f.code for f in result.findings}, seed
        estimates = result.fit.certificate.estimates
        for name, value in truth.items():
            off = abs(estimates[name].value - value)
            assert off < 4.0 * estimates[name].sigma, (seed, name)


def test_a_bead_that_stays_in_its_row_is_no_border(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A border that passed through the noise of its row was found in each second table, and
    its spots, left out for it, made causes of what they had held.
    """
    made: list[object] = []

    class Counted(explained.Linearised):
        def __init__(self, *given: Any) -> None:
            made.append(self)
            super().__init__(*given)

    monkeypatch.setattr(explained, "Linearised", Counted)
    for seed in range(4):
        made.clear()
        result, _ = calibrated("in a row", seed, 360, (-40.0, -20.0, 0.0, 20.0, 40.0))
        assert {f.code for f in result.findings} <= EXPECTED, seed
        assert len(made) < explained.MOST_TABLES, seed


@pytest.mark.campaign(4)
@pytest.mark.parametrize("seed", range(16))
def test_what_sampling_by_pixels_does_to_spots_is_no_motion(seed: int) -> None:
    rng = np.random.default_rng([77, seed])
    draft = right_draft(rng)
    n = int(rng.choice([120, 240, 360]))
    noise, size = rng.uniform(0.002, 0.006), rng.uniform(0.0, 0.006)
    angles = 360.0 * np.arange(n) / n
    shown = np.ones((n, len(draft.world.beads)), dtype=bool)
    begin = rng.random(2)

    def after(frames: list[np.ndarray | None]) -> list[np.ndarray | None]:
        """Spots are drawn towards places within their pixels."""
        return [
            None
            if spots is None
            else np.column_stack(
                [
                    spots[:, :2] + size * np.sin(2 * math.pi * (spots[:, :2] + begin)),
                    spots[:, 2],
                ]
            )
            for spots in frames
        ]

    world = replace(draft.world, angles=angles, spot=np.zeros((n, 3)), shown=shown)
    scan = replace(
        draft,
        world=world,
        believed=replace(draft.believed, angles=angles),
        noise_px=float(noise),
        after=after,
    )
    result = scored_calibration(taken(scan, rng))
    assert result.fit is not None
    assert {f.code for f in result.findings} <= EXPECTED
