"""A gap between tiles is told by both ends of rays: steps of drawn profiles, and natural
objects of tests/studies/natural_objects.py, whose renderer shares nothing with what is
tested."""

from __future__ import annotations

import re

import natural_objects
import numpy as np
import pytest

from flexdt.twin.calibration.without_phantom import symmetry_plane
from flexdt.twin.calibration.without_phantom.conjugate_rays import ConjugateRays, Profile
from flexdt.twin.calibration.without_phantom.gaps.gap_evidence import (
    GapFound,
    contradicted,
)
from flexdt.twin.calibration.without_phantom.tile_gap import Gap


def profile(shift: np.ndarray, sigma: float, columns: int = 80) -> Profile:
    """Make a profile of bins of 5 columns each, all of which tell as much."""
    radius = np.arange(columns) + 0.5
    place = np.arange(columns) // 5
    return Profile.of(
        radius, np.ones(columns), place, shift, np.full(len(shift), sigma), 1.5
    )


def test_steps_are_told_and_what_bends_or_scatters_is_not() -> None:
    rng = np.random.default_rng(4)
    middle = np.arange(16) * 5 + 2.5
    told = 0
    for _ in range(20):
        sigma = rng.uniform(0.01, 0.1)
        scatter = rng.normal(0, sigma * rng.choice([1, 3]), 16)
        bent = (
            rng.uniform(-0.3, 0.3) * middle / 80
            + rng.uniform(-0.3, 0.3) * (middle / 80) ** 2
        )
        lump = rng.uniform(-1, 1) * np.exp(-np.square((middle - rng.uniform(20, 60)) / 6))
        for shape in (0.0, bent, lump):
            assert not profile(scatter + shape, sigma).best().significant
        border, width = rng.uniform(15, 65), rng.choice([-1, 1]) * rng.uniform(0.8, 2)
        stepped = scatter + width * np.clip((middle - border) / 5 + 0.5, 0, 1)
        step = profile(stepped, sigma).best()
        told += step.significant
        assert abs(step.width - width) < 5 * step.sigma + 0.15 * abs(width)
        assert abs(step.radius - border) < 6 or not step.significant
    assert told >= 18


RIGHT_SEEDS = {"bottle": (1002, 1008), "bricks": (1005, 1006), "printed": (1010,)}
"""Seeds of scans without a gap or a repeated frame that were told one before each was compared
with what the scan itself shows; 31 and 32 for the other objects."""


@pytest.mark.slow
@pytest.mark.campaign(1)
def test_a_step_of_rays_that_no_frame_shows_is_left_open() -> None:
    """Distances between both ends of its rays change smoothly by half a pixel; it was told
    a gap of 0.46 +- 0.075 px."""
    told = natural_objects.tried("stone", 7612, gap=False)
    assert not told["named"]
    assert told["open"]
    assert abs(told["pull"]) < 4.0


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(natural_objects.OBJECTS))
@pytest.mark.campaign(1)
def test_natural_objects_have_no_gap(kind: str) -> None:
    for seed in RIGHT_SEEDS.get(kind, (31, 32)):
        told = natural_objects.tried(kind, seed, gap=False)
        assert not told["named"], told
        assert not told["repeats"], told
        assert "two gaps" not in told.get("refused", ""), told
        assert abs(told.get("pull", 0.0)) < 4, told


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "seed"), [("foam", 1001), ("board", 102), ("printed", 1001), ("stone", 102)]
)
@pytest.mark.campaign(1)
def test_gaps_behind_natural_objects_are_named(kind: str, seed: int) -> None:
    """The mean's own axis is off by half of the gap; single frames show another at the axis."""
    told = natural_objects.tried(kind, seed, gap=True)
    assert told["named"], told
    assert abs(told["pull"]) < 4, told


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        ("bone", 5002),
        ("bottle", 5001),
        ("bottle", 5002),
        ("bottle", 5003),
        ("bottle", 6106),
        ("foam", 6101),
    ],
)
@pytest.mark.campaign
def test_gaps_that_the_mean_shows_are_named(kind: str, seed: int) -> None:
    """At the rim of what turns; behind a wall that turns back there, refused as two gaps; in
    the wall of a neck, and five columns from the axis, left open; and where nothing is seen
    to turn. Rays alone were four sigma off in the first bottle's width, the mean's fit in the
    third's, which sees two columns on its near side; in the foam's, which sees as few, its
    column was nine sigma off."""
    told = natural_objects.tried(kind, seed, gap=True)
    assert told["named"], told
    assert abs(told["pull"]) < 4, told
    words = re.search(r"appears nearer by ([\d.]+) \+- ([\d.e-]+)", told["warnings"][0])
    assert words is not None, told
    width, sigma = map(float, words.groups())
    assert abs(width - told["gap"][1]) < 4 * sigma, told


def test_a_width_that_another_measurement_contradicts_is_less_sure() -> None:
    gap = Gap(100, 2.4, 0.1)
    assert contradicted(gap, []) == gap
    assert contradicted(gap, [(2.3, 0.2), (1.7, 1.0)]) == gap
    for widths in ([(1.7, 0.1)], [(2.3, 0.2), (1.7, 0.1)], [(1.7, 0.1), (2.4, 0.01)]):
        doubted = contradicted(gap, widths)
        assert doubted.width == 2.4
        assert 0.45 < doubted.sigma < 0.55


@pytest.mark.slow
def test_both_ends_of_rays_find_the_column_from_two_pixels_away(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Fine edges seen 4 px apart have no common slopes."""
    seen: list[tuple[ConjugateRays, np.ndarray]] = []

    def kept(rays: ConjugateRays, values: np.ndarray, *_: object) -> GapFound:
        seen.append((rays, values))
        return GapFound(None, None)

    monkeypatch.setattr(symmetry_plane, "find_gap", kept)
    natural_objects.tried("foam", 1009, gap=False)
    rays, values = seen[0]
    found, sigma = rays.column(values)
    column = rays.scan.column(found, rays.row)
    slope = rays.scan.slopes(values, rays.scan.scales[: len(values)])[0]
    for off in (-2.0, 2.0):
        begun = found.copy()
        begun[0] += off / slope
        again, certain = rays.column(begun)
        assert certain < 2 * sigma
        assert abs(rays.scan.column(again, rays.row) - column) < sigma


@pytest.mark.slow
@pytest.mark.campaign
def test_fans_of_wires_that_harden_the_beam_are_within_their_sigma() -> None:
    assert natural_objects.main(["--fans", "--count", "8", "--seed", "1"]) == 0
