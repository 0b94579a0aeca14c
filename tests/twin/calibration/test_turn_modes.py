"""Gaps near the axis are told by the angular modes of a turn, or left open.

Fan-beam turns of ellipses whose chords are written out here, with and without a gap.
"""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from flexdt.twin.calibration.without_phantom.conjugate_rays import ConjugateRays
from flexdt.twin.calibration.without_phantom.gaps.turn_modes import mode_steps

VIEWS, COLUMNS, GROUPS = 90, 96, 5
SOD, SDD, PIXEL = 600.0, 1050.0, 1.0
AXIS, NOISE = 47.3, 0.004


def turn(
    rng: np.random.Generator, first: int, gap: float, side: float = 1.0
) -> ConjugateRays:
    """Make a turn of ellipses seen by columns that go to one side, from column `first` on
    `gap` further on."""
    column = np.arange(COLUMNS) + gap * (np.arange(COLUMNS) >= first)
    fan = np.arctan((column[:, None] + np.linspace(-0.4, 0.4, 5) - AXIS) * PIXEL / SDD)
    view = np.arange(VIEWS) * 2 * math.pi / VIEWS
    band = np.zeros((VIEWS, GROUPS, COLUMNS))
    for group in range(GROUPS):
        for _ in range(12):
            a, b = rng.uniform(0.8, 4, 2)
            away, around = 22 * math.sqrt(rng.random()), rng.uniform(0, 2 * math.pi)
            x, y = away * math.cos(around), away * math.sin(around)
            own = rng.uniform(0, math.pi)
            # The source stands below the axis and turns to the right. A ray to the right
            # leans to the right: its normal turns back.
            turned = view[:, None, None] - side * fan
            across = x * np.cos(turned) + y * np.sin(turned)
            beside = across - side * SOD * np.sin(fan)
            half = (a * np.cos(turned - own)) ** 2 + (b * np.sin(turned - own)) ** 2
            chord = 2 * a * b * np.sqrt(np.maximum(half - beside**2, 0)) / half
            band[:, group] += 0.02 * chord.mean(axis=2)
    band += rng.normal(0, NOISE, band.shape)
    pose = SimpleNamespace(
        source=np.array([[0.0, -SOD, 0.0]]),
        detector=np.array([[0.0, SDD - SOD, 0.0]]),
        u=np.array([[side * PIXEL, 0.0, 0.0]]),
    )
    scan = SimpleNamespace(sdd_mm=SDD, pitch_mm=PIXEL, pose=pose)
    return ConjugateRays(scan, band, np.arange(GROUPS), 2 * math.pi / VIEWS)  # type: ignore[arg-type]


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_gap_is_told_at_its_border_and_none_where_there_is_none(side: float) -> None:
    rng = np.random.default_rng(21)
    for beside in (-5, 0, 3):
        first, gap = round(AXIS) + beside, float(rng.uniform(0.6, 1.5))
        found = mode_steps(turn(rng, first, gap, side), AXIS, 12.0)
        assert found is not None
        place = int(np.flatnonzero(found.columns == first)[0])
        significance = np.abs(found.width / found.sigma)
        assert int(significance.argmax()) == place
        assert significance[place] > 5
        sigma = math.hypot(found.sigma[place], 0.3 * gap)
        assert abs(found.width[place] - gap) < 2.5 * sigma
        without = mode_steps(turn(rng, 0, 0.0, side), AXIS, 12.0)
        assert without is not None
        near = np.abs(without.columns - AXIS) < 12
        assert np.abs(without.width[near]).max() < 0.35
        assert np.abs(without.width / without.sigma)[near].max() < 6
        assert without.sigma[near].max() < 0.25


def test_a_round_body_tells_no_width() -> None:
    """Noise alone turns."""
    rays = turn(np.random.default_rng(22), 0, 0.0)
    rng = np.random.default_rng(24)
    band = rays.band.mean(axis=0) + rng.normal(0, NOISE, rays.band.shape)
    found = mode_steps(ConjugateRays(rays.scan, band, rays.rows, rays.step), AXIS, 12.0)
    if found is not None:
        near = np.abs(found.columns - AXIS) < 12
        assert found.sigma[near].min() > 1.0


def test_too_few_columns_or_views_are_not_judged() -> None:
    rays = turn(np.random.default_rng(23), 0, 0.0)
    assert mode_steps(rays, -30.0, 12.0) is None
    few = ConjugateRays(rays.scan, rays.band[::30], rays.rows, 30 * rays.step)
    assert mode_steps(few, AXIS, 12.0) is None
