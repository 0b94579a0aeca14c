"""`align` of one row and of half a turn: drawn ellipses with line integrals in closed form and
kinematics of their own (tests/studies/row_align.py), and one row from `simulate` to a
volume."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import row_align

import flexdt as fx


@pytest.mark.parametrize(
    ("kind", "seeds"), [("one_row", (3, 6)), ("symmetric", (1,)), ("half_turn", (3,))]
)
@pytest.mark.daily(1)
def test_the_column_of_one_row_and_of_half_a_turn_is_within_its_sigma(
    kind: str, seeds: tuple[int, ...]
) -> None:
    for seed in seeds:
        told = row_align.tried(kind, seed)
        assert abs(told["error"]) < min(0.15, 3.5 * told["sigma"]), told


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize(
    ("kind", "count"), [("one_row", 100), ("symmetric", 60), ("half_turn", 60)]
)
@pytest.mark.campaign
def test_errors_are_as_large_as_their_sigmas_say(kind: str, count: int) -> None:
    assert row_align.main(["--kind", kind, "--count", str(count)]) == 0


@pytest.mark.parametrize("seed", range(1, 4))
def test_what_shows_no_column_is_refused(seed: int) -> None:
    """Air, a slab wider than the panel, and an object that noise hides."""
    assert "refused" in row_align.tried("untold", seed)


def scan(span: float = 360.0) -> tuple[row_align.Scan, np.random.Generator]:
    rng = np.random.default_rng(5)
    drawn = row_align.drawn("symmetric", rng)
    return dataclasses.replace(drawn, span=span, views=180, photons=3e3), rng


def test_one_row_says_what_it_cannot_tell_and_its_correction_keeps_that() -> None:
    one, rng = scan()
    found = one.data(rng).align(per_frame=True)
    assert set(found.parameters) == {"axis_column_px"}
    refused = found.alignment.refused
    assert "full turn of more rows" in refused["det_roll"]
    assert {"source_row_px", "det_yaw", "motion"} <= set(refused)
    assert found.correction.parameters.det_roll == pytest.approx(0.0, abs=1e-6)
    corrected = found.dataset.with_correction(found.correction).geometry
    column = corrected.project_points([[0.0, 0.0, 0.0]], one.shape)[0, 0, 0]
    assert column == pytest.approx(found.parameters["axis_column_px"]["value"], abs=1e-3)


def test_too_short_a_scan_says_how_long_it_must_be() -> None:
    short, rng = scan(180.0)
    why = short.data(rng).align().alignment.refused["axis_column_px"]
    assert (
        "the views span 179 deg; half a turn and the fan, 187.7 deg in small steps" in why
    )


def test_rows_far_from_the_plane_of_the_source_are_refused() -> None:
    one, rng = scan()
    cone = fx.ConeVec.circular(
        sod=row_align.SOD, sdd=row_align.SDD, angles=one.degrees(), shape=one.shape,
        pixel=one.pitch, offset=(0.0, -60 * one.pitch),
    )  # fmt: skip
    data = one.data(rng)
    high = fx.DataSet.from_arrays(data.counts(), cone, dark=data.dark, flat=data.flat)
    assert "lean too much" in high.align().alignment.refused["axis_column_px"]


@pytest.mark.filterwarnings(
    "ignore:no accuracy is claimed"
)  # rightly, of the panel aside
@pytest.mark.parametrize("turn", [360.0, 200.0])
def test_one_row_from_simulate_over_align_to_a_volume(turn: float) -> None:
    """The axis stands 2.3 px beside its place; the slice is that of the true geometry."""
    angles, shape = np.arange(120) * turn / 120, (1, 96)
    balls = [
        {"kind": "sphere", "center": [6, 2, 0], "radius": 5, "material": "pmma"},
        {"kind": "sphere", "center": [-7, -4, 0], "radius": 3, "material": "aluminium"},
    ]
    nominal, true = (
        fx.ConeVec.circular(
            sod=300, sdd=450, angles=angles, shape=shape, pixel=0.5, offset=(by, 0)
        )
        for by in (0.0, 2.3 * 0.5)
    )
    seen = fx.simulate(
        balls, true, noise=1, rays=3, tube=fx.Tube(mono_keV=60, power_W=40)
    )
    data = fx.DataSet.from_arrays(seen.counts(), nominal, dark=seen.dark, flat=seen.flat)
    found = fx.align(data)
    told = found.parameters["axis_column_px"]
    assert abs(told["value"] - (47.5 - 2.3)) < max(3.5 * told["sigma"], 0.05)

    def slice_of(scan: fx.DataSet) -> np.ndarray:
        return fx.reconstruct(scan, voxel=0.4, shape=(1, 70, 70)).data[0]

    right = slice_of(seen)
    apart = [math.dist(slice_of(s).ravel(), right.ravel()) / np.linalg.norm(right)
             for s in (data, data.with_correction(found.correction))]  # fmt: skip
    assert apart[0] > 0.3
    assert apart[1] < 0.1
