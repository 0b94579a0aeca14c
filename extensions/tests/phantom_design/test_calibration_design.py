"""Bead places: forecasts against the public prediction, brute force and real fits."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from flexdt.phantoms import load_phantom
from flexdt.phantoms.bricks import Brickwork
from flexdt.twin.calibration import BeadModel, bead_model, identifiability
from flexdt.twin.calibration.fit.priors import exact
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.poses import Poses
from flexdt_extensions.phantom_design.bead_search import (
    design,
    forecast,
    measured_spread,
    share_identified,
    turned_likeness,
)
from flexdt_extensions.phantom_design.information_table import PlannedScans
from flexdt_extensions.phantom_design.seats import seats_of

SHAPE = (760, 956)


def circle(frames: int) -> Poses:
    return Poses(
        np.zeros(3),
        np.array([0.0, 600.0, 0.0]),
        np.array([0.0, 1059.0, 0.0]),
        np.array([0.1496, 0.0, 0.0]),
        np.array([0.0, 0.0, -0.1496]),
        2 * np.pi * np.arange(frames) / frames,
    )


LEGO = bead_model(load_phantom("lego"))


@pytest.mark.parametrize(("tolerance", "priors"), [(0.0, None), (0.1, exact())])
def test_forecast_is_the_public_prediction_where_no_shadows_touch(
    tolerance: float, priors: dict[str, float] | None
) -> None:
    """Of a scanner that is exactly known the phantom is not strained, which a search leaves
    out."""
    planned = PlannedScans(circle(36), SHAPE, bead_tolerance_mm=tolerance, priors=priors)
    ours = forecast(LEGO, planned)
    theirs = identifiability(
        LEGO, planned.poses, 0.1, shape=SHAPE, bead_tolerance_mm=tolerance, priors=priors,
        causes=False,
    )  # fmt: skip
    assert ours.used == 1.0
    for name, sigma in (theirs.sigmas | theirs.image_sigmas).items():
        assert (ours.sigmas | ours.image_sigmas)[name] == pytest.approx(sigma, rel=1e-6)


def test_touching_shadows_count_for_nothing() -> None:
    near = BeadModel(np.array([[-6.0, 0, 0], [6.0, 0, 0], [0, 5.0, 15.0]]), np.array(1.0))
    found = forecast(near, PlannedScans(circle(72), SHAPE))
    free = identifiability(
        near, circle(72), 0.1, shape=SHAPE, bead_tolerance_mm=0.0, causes=False
    )
    assert 0.8 < found.used < 1.0
    for name, sigma in free.image_sigmas.items():
        assert found.image_sigmas[name] > sigma * 1.003, name


def test_exchange_finds_the_best_of_all_sets() -> None:
    """Ten seats, three beads: all 120 sets judged one by one."""
    rng = np.random.default_rng(4)
    seats = rng.uniform(-1, 1, (10, 3)) * [9.5, 5.5, 22.0]
    planned = PlannedScans(circle(24), SHAPE)
    scores = {
        c: forecast(BeadModel(seats[list(c)], np.array(1.0)), planned).score
        for c in itertools.combinations(range(10), 3)
        if turned_likeness(seats[list(c)]) >= 1.0 and pdist(seats[list(c)]).min() >= 2.5
    }
    found = design(seats, 1.0, 3, planned, starts=6)
    best = min(scores.values())
    assert found.discarded == 0
    assert found.forecast.score == pytest.approx(best, rel=1e-9)
    assert scores[tuple(sorted(found.seats.tolist()))] == pytest.approx(best, rel=1e-9)


def test_design_on_bricks_beats_the_spiral_and_fits_agree() -> None:
    planned = PlannedScans(circle(60), SHAPE)
    seats = seats_of(Brickwork(), 1.0)
    found = design(seats.places, 1.0, 5, planned, slots=seats.brick, starts=2)
    again = design(seats.places, 1.0, 5, planned, slots=seats.brick, starts=2)
    assert np.array_equal(found.beads, again.beads)
    spiral = forecast(LEGO, planned)
    assert found.forecast.score < 0.8 * spiral.score
    model = BeadModel(found.beads, np.array(1.0))
    assert share_identified(model, planned, trials=3) == 1.0
    # 150 fits: a standard deviation is known to 5.8 %; 24 % is beyond four of those.
    spread = measured_spread(model, planned, trials=150)
    for name, sigma in (found.forecast.sigmas | found.forecast.image_sigmas).items():
        assert spread[name] == pytest.approx(sigma, rel=0.24), name
    one_each = design(
        seats.places, 1.0, 5, planned, slots=seats.brick, per_slot=1, starts=2
    )
    assert sorted(seats.brick[one_each.seats].tolist()) == [0, 1, 2, 3, 4]
    assert one_each.forecast.score >= found.forecast.score


def test_symmetric_set_is_not_told_apart_and_not_chosen() -> None:
    """Two beads opposite each other at one height look the same after half a turn."""
    planned = PlannedScans(circle(24), SHAPE)
    pair = np.array([[9.0, 0.0, 0.0], [-9.0, 0.0, 0.0]])
    assert share_identified(BeadModel(pair, np.array(1.0)), planned) < 1.0
    assert turned_likeness(pair) == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(TwinError, match="ambiguous"):
        design(pair, 1.0, 2, planned, starts=2)
    square = np.array(
        [[9.0, 9.0, 5.0], [-9.0, 9.0, 5.0], [-9.0, -9.0, 5.0], [9.0, -9.0, 5.0]]
    )
    places = np.concatenate([square, square * [0.7, 0.2, -3.0]])
    found = design(places, 1.0, 4, planned, starts=6)
    assert turned_likeness(found.beads) >= 1.0
    assert share_identified(BeadModel(found.beads, np.array(1.0)), planned) == 1.0


def test_block_design_moves_beads_off_the_grid() -> None:
    planned = PlannedScans(circle(24), SHAPE)
    bounds = np.array([8.0, 18.0, 28.0])
    grid = np.stack(
        np.meshgrid(*[[-b, 0.0, b] for b in bounds], indexing="ij"), -1
    ).reshape(-1, 3)
    on = design(grid, 1.0, 4, planned, starts=2)
    off = design(grid, 1.0, 4, planned, starts=2, bounds_mm=bounds, resolution_mm=1.0)
    assert off.forecast.score < on.forecast.score
    assert (np.abs(off.beads) <= bounds + 1e-9).all()


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"count": 1}, "1 beads"),
        ({"count": 12}, "12 beads"),
        ({"criterion": "best"}, "no criterion"),
        ({"count": 4, "gap_mm": 30.0}, "do not fit"),
    ],
)
def test_bad_requests(changes: dict[str, object], says: str) -> None:
    seats = np.random.default_rng(1).uniform(-9, 9, (10, 3))
    options = {"count": 3, **changes}
    with pytest.raises(TwinError, match=says):
        design(seats, 1.0, planned=PlannedScans(circle(12), SHAPE), **options)  # type: ignore[arg-type]
