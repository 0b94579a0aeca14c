"""A gap is told by the mirror symmetry of the mean of a turn; what stands still is none.

Means of round bodies whose profiles are written out here, seen from far away, with and
without a gap.
"""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from flexdt.twin.calibration.without_phantom.gaps.mirror_steps import (
    WIDTHS_PX,
    MirrorSteps,
    mirror_steps,
    over_widths,
)

ROWS, COLUMNS = 90, 160
SOD, SDD, PITCH, NOISE = 1e6, 1.75e6, 1.0, 0.002
AXIS, ROLL = 81.3, 0.006
START = np.array([0.0, 0.0, 0.0])


def column(values: np.ndarray) -> float:
    return float((COLUMNS - 1) / 2 + values[0] * SDD / SOD / PITCH)


def view(values: np.ndarray) -> np.ndarray:
    """Source, panel centre, u and v about a point of the axis; the beam goes along y."""
    x, roll = values[0], values[1]
    c, s = math.cos(roll), math.sin(roll)
    u, v = np.array([c, 0.0, -s]) * PITCH, np.array([-s, 0.0, -c]) * PITCH
    return np.concatenate([[-x, -SOD, 0.0], [-x, SDD - SOD, 0.0], u, v])


SCAN = SimpleNamespace(
    column=column,
    view=view,
    scales=np.array([PITCH * SOD / SDD, 2 / ROWS, 1.0]),
    slopes=lambda values, scales: np.array([SDD / SOD / PITCH, 0.0, 0.0]),
)


def mean_of(rng: np.random.Generator, first: int = 0, gap: float = 0.0) -> np.ndarray:
    """Make the mean of walls about the axis, each over some of the rows; from column `first` on
    `gap` further on."""
    row = np.arange(ROWS)[:, None] - (ROWS - 1) / 2
    at = np.arange(COLUMNS) + gap * (np.arange(COLUMNS) >= first)
    rays = at + np.linspace(-0.4, 0.4, 5)[:, None, None]
    radius = np.abs(rays - AXIS - ROLL * row)
    out = np.zeros((ROWS, COLUMNS))
    for _ in range(30):
        wide, high = rng.uniform(6, 70), rng.uniform(8, 60)
        edge = (np.abs(row - rng.uniform(-40, 40)) - high) / 3
        rows = 1 / (1 + np.exp(np.clip(edge, -40, 40)))
        chord = np.sqrt(np.maximum(1 - (radius / wide) ** 2, 0)).mean(axis=0)
        out += rng.uniform(0.02, 0.1) * rows * chord
    return out + rng.normal(0, NOISE, out.shape)


def judged(mean: np.ndarray, dead: np.ndarray | None = None) -> MirrorSteps:
    none = np.zeros(COLUMNS, dtype=bool)
    noise = np.ones_like(mean)
    return mirror_steps(mean, noise, SCAN, START, none if dead is None else dead)  # type: ignore[arg-type]


@pytest.mark.parametrize("beside", [-30, -12, 9, 25])
def test_a_gap_is_told_at_its_column_with_its_width(beside: int) -> None:
    rng = np.random.default_rng(100 + beside)
    first, gap = round(AXIS) + beside, float(rng.uniform(0.8, 2))
    found = judged(mean_of(rng, first, gap))
    assert found.told(first, 1.0)
    best = int(over_widths(found.free).argmax())
    assert abs(best - first) <= 2
    assert abs(WIDTHS_PX[found.free[:, best].argmax()] - gap) < 0.4
    assert found.denied(first - 2 * beside, 1.0)
    assert over_widths(found.found).max() > math.log(100.0)


def test_a_mean_that_says_next_to_nothing_denies_no_gap() -> None:
    nothing = np.zeros((len(WIDTHS_PX), COLUMNS))
    assert not MirrorSteps(nothing, nothing - 0.01).denied(40, 2.0)
    assert MirrorSteps(nothing, nothing - 5.0).denied(40, 2.0)


def test_a_right_mean_tells_none() -> None:
    for seed in range(8):
        found = judged(mean_of(np.random.default_rng(seed)))
        assert over_widths(found.found).max() < math.log(100.0)


def test_what_stands_still_or_is_dead_is_no_gap() -> None:
    rng = np.random.default_rng(31)
    ramp, strip, dead = (mean_of(rng) for _ in range(3))
    x = np.linspace(-0.5, 0.5, COLUMNS)
    ramp += 0.03 * x + 0.02 * x**3
    strip[20:70, 100:104] += 0.05
    columns = rng.integers(20, 140, 4)
    dead[:, columns] = 3.0
    is_dead = np.zeros(COLUMNS, dtype=bool)
    is_dead[columns] = True
    assert over_widths(judged(ramp).found).max() < 2.0
    assert over_widths(judged(strip).found).max() < 5.0
    assert over_widths(judged(dead, is_dead).found).max() < 3.0


def test_a_yaw_is_no_gap() -> None:
    """It displaces the ends of the panel against its middle."""
    rng = np.random.default_rng(32)
    row = np.arange(ROWS)
    there = np.arange(COLUMNS) - AXIS
    mean = mean_of(rng)
    bent = np.stack(
        [np.interp(there + 0.3 * (there / 80) ** 2, there, mean[r]) for r in row]
    )
    assert over_widths(judged(bent).free).max() < 2.0


def test_one_band_of_rows_alone_does_not_tell_a_gap() -> None:
    """A gap is in all rows; what stands still is in some."""
    rng = np.random.default_rng(33)
    state = rng.bit_generator.state
    mean = mean_of(rng)
    rng.bit_generator.state = state
    gap = mean_of(rng, 100, 1.5)
    mean[:20] = gap[:20]
    found = judged(mean)
    assert over_widths(found.found).max() < 6.5


def test_few_rows_or_a_column_off_the_panel_are_not_judged() -> None:
    rng = np.random.default_rng(34)
    mean = mean_of(rng)[40:44]
    assert not judged(mean).found.any()
    far = np.array([90.0, 0.0, 0.0])
    none = np.zeros(COLUMNS, dtype=bool)
    mean = mean_of(rng)
    found = mirror_steps(mean, np.ones_like(mean), SCAN, far, none)  # type: ignore[arg-type]
    assert not found.found.any()


def body(
    rng: np.random.Generator, first: int = 0, gap: float = 0.0, walls: float = 0.0
) -> np.ndarray:
    """Make the mean of a round body, and of a thin wall in it, behind a panel that yaws; from
    column `first` on `gap` further on."""
    row = np.arange(ROWS)[:, None] - (ROWS - 1) / 2
    at = np.arange(COLUMNS) + gap * (np.arange(COLUMNS) >= first)
    beside = at + np.linspace(-0.4, 0.4, 5)[:, None, None] - AXIS - ROLL * row
    radius = np.abs(beside + 0.15 * (beside / 80) ** 2)

    def chord(wide: float) -> np.ndarray:
        return np.sqrt(np.maximum(wide**2 - radius**2, 0)).mean(axis=0)

    out = 0.4 / 70 * chord(70.0) + walls / 10 * (chord(60.0) - chord(57.0))
    return out + rng.normal(0, NOISE, out.shape)


def test_gentle_slopes_tell_a_gap_beside_sharp_walls() -> None:
    """Walls are displaced by hundredths of a pixel, far beyond their noise; slopes within ten
    columns of the axis are below that of each place."""
    for seed in range(3):
        found = judged(body(np.random.default_rng(seed), 90, 1.5, walls=3.0))
        assert over_widths(found.found)[88:93].max() > 20.0
        width, sigma = found.width(90, 2.0)
        assert sigma < 0.3
        assert abs(width - 1.5) < 3.0 * sigma


def test_sharp_walls_tell_no_gap() -> None:
    """Sampled, they are displaced against what is nearer to the axis."""
    for seed in range(8):
        found = judged(body(np.random.default_rng(seed), walls=3.0))
        assert over_widths(found.found).max() < 3.0


def test_one_smooth_body_tells_no_gap() -> None:
    """A little aside it looks like an odd error of the flat field, which explains all of it but
    its rim."""
    for seed in range(8):
        found = judged(body(np.random.default_rng(seed)))
        assert over_widths(found.found).max() < math.log(100.0)
    found = judged(body(np.random.default_rng(3), 100, 1.5))
    assert found.told(100, 2.0)
    for first, gap in ((50, 1.5), (115, 1.5)):
        for seed in range(2):
            found = judged(body(np.random.default_rng(seed), first, gap))
            assert over_widths(found.found).max() < math.log(100.0)
            assert over_widths(found.free)[first] > -1.0
