"""A spot that is exposed while its bead turns is measured as smeared along the bead's path."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import arcs_drawn
import numpy as np
import prior_coverage as own
import pytest
from scipy.ndimage import gaussian_filter

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.detect.drawn_out import drawn_out
from flexdt.twin.calibration.detect.refine import Refined, measure_beads
from flexdt.twin.calibration.detect.sharpness import balls_of
from flexdt.twin.calibration.detect.smear import UNMEASURED, Smear, Step, solved
from flexdt.twin.calibration.detect.smeared_spots import own_pixels, placed
from flexdt.twin.calibration.detect.windows import (
    Windows,
    plan_windows,
    render_windows,
    window_intensities,
)
from flexdt.twin.calibration.diagnose.measured_spots import judge_smear, shadows_drawn_out
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.projection.analytic_solids import Scene

SHAPE = (300, 360)
PIXEL = 0.3
FRAMES = 24
RADIUS = 1.2
MU = 0.8
FINE = 3
MOMENTS = 12
NOISE = 0.006
STEP = 2.0 * math.pi / FRAMES
BEADS = np.array([[9.0, 2.0, -9.0], [-8.0, 6.0, 0.0], [1.0, -9.0, 10.0]])


def turned(part: float) -> ConeVec:
    """The geometry of all frames, a part of a step later."""
    angles = STEP * (np.arange(FRAMES) + part)
    return Poses.upright([0, 0, 0], [0, 500, 0], [0, 900, 0], PIXEL, angles).cone_vec()


@cache
def exposed(share: float, blur: tuple[float, float]) -> tuple[np.ndarray, Windows]:
    """Noisy line integrals of balls exposed over a share of a step, and their windows."""
    model = BeadModel(BEADS, np.full(len(BEADS), RADIUS))
    longest = share * STEP * 12.0 * 900 / 500 / PIXEL
    plan = plan_windows(model, turned(0.0), SHAPE, longest)
    parts = (np.arange(MOMENTS) + 0.5) / MOMENTS - 0.5 if share else np.zeros(1)
    light = np.mean([instant(share * p, plan, blur) for p in parts], axis=0)
    noise = NOISE * np.random.default_rng(7).normal(size=light.shape)
    return (-np.log(light) + noise).astype(np.float32), plan


def instant(part: float, windows: Windows, blur: tuple[float, float]) -> np.ndarray:
    """Light behind the balls by exact rays, (n, k, side, side): the witness."""
    cone = turned(part)
    side = windows.side
    margin = 4
    n = side + 2 * margin
    fine = (np.arange(FINE * n) + 0.5) / FINE - 0.5 - margin
    rows, cols = SHAPE
    out = np.empty((FRAMES, len(BEADS), side, side))
    for f, k in np.ndindex(FRAMES, len(BEADS)):
        left, top = windows.corner[f, k]
        x = (left + fine - (cols - 1) / 2)[None, :, None]
        y = (top + fine - (rows - 1) / 2)[:, None, None]
        ray = cone.detector[f] + x * cone.u[f] + y * cone.v[f] - cone.source[f]
        ray /= np.linalg.norm(ray, axis=2, keepdims=True)
        path = np.zeros(ray.shape[:2])
        for bead in BEADS:
            middle = ray @ (bead - cone.source[f])
            d2 = ((bead - cone.source[f]) ** 2).sum() - middle**2
            path += 2.0 * MU * np.sqrt(np.clip(RADIUS**2 - d2, 0.0, None))
        seen = gaussian_filter(np.exp(-path), [FINE * b for b in blur])
        means = seen.reshape(n, FINE, n, FINE).mean(axis=(1, 3))
        out[f, k] = means[margin:-margin, margin:-margin]
    return out


def measured(
    share: float, told: bool = True, blur: tuple[float, float] = (0.6, 0.6)
) -> tuple[Refined, np.ndarray]:
    """Measure balls exposed over a share of a step; also their places at its middle."""
    model = BeadModel(BEADS, np.full(len(BEADS), RADIUS))
    cone = turned(0.0)
    images, plan = exposed(share, blur)
    result = measure_beads(
        images, plan, cone, model, 2.0 * RADIUS * MU, turning=turned if told else None
    )
    return result, plan.predicted


@pytest.mark.parametrize("share", [0.12, 0.5])
def test_the_arc_of_an_exposure_is_told_and_shifts_no_position(share: float) -> None:
    result, middle = measured(share)
    smear = result.smear
    assert smear.told
    assert smear.named
    assert smear.share == pytest.approx(share, rel=0.02, abs=3.0 * smear.sigma / share)
    off = result.tracks - middle
    assert np.isfinite(off).all(axis=2).mean() > 0.95
    assert float(np.sqrt(np.nanmean(off**2))) < 0.008


def test_a_smear_that_is_taken_for_round_blur_shifts_positions() -> None:
    result, middle = measured(0.5, told=False)
    assert float(np.sqrt(np.nanmean((result.tracks - middle) ** 2))) > 0.015


def test_smeared_spots_in_noise_before_a_bent_wall_are_right_within_their_sigma() -> None:
    images, plan = exposed(0.5, (0.6, 0.6))
    at = np.arange(plan.side) - plan.side // 2
    wall = 0.7 + 0.01 * at - 1e-4 * at**2
    noise = 0.009 * np.random.default_rng(3).normal(size=images.shape)
    model = BeadModel(BEADS, np.full(len(BEADS), RADIUS))
    result = measure_beads(
        (images + wall + noise).astype(np.float32),
        plan,
        turned(0.0),
        model,
        2.0 * RADIUS * MU,
        turning=turned,
    )
    off = (result.tracks - plan.predicted).reshape(-1, 2)
    assert np.isfinite(off).all()
    pull = np.linalg.solve(result.covariances.reshape(-1, 2, 2), off[..., None])[..., 0]
    assert 0.5 < 0.5 * float(np.einsum("mi,mi->m", off, pull).mean()) < 1.3
    assert float(np.sqrt((off**2).mean())) < 0.01
    assert result.smear.share == pytest.approx(0.5, rel=0.02)


def smooth_spot(place: np.ndarray, contrast: float, side: int = 41) -> np.ndarray:
    """Line integrals of a smooth spot, longer than wide."""
    x, y = np.meshgrid(np.arange(side) - place[0], np.arange(side) - place[1])
    return contrast * np.exp(-0.5 * ((x / 6.0) ** 2 + (y / 3.5) ** 2))


def test_a_spot_is_placed_by_a_rendered_one_wherever_that_lies() -> None:
    off, level = np.array([0.7, -0.4]), 0.3
    at = np.arange(41.0)
    seen = smooth_spot(20.0 + off, 1.32) + level + 0.004 * at - 0.003 * at[:, None]
    drawn = smooth_spot(np.array([20.0, 20.0]), 1.2)
    inner = np.zeros((1, 41, 41), np.bool_)
    inner[:, 2:-2, 2:-2] = True
    arrays = (a[None].astype(np.float32) for a in (seen, drawn))
    found = placed(*arrays, inner, np.array([0]))
    assert found.shift[0] == pytest.approx(off, abs=0.003)
    assert found.contrast[0] == pytest.approx(1.1, rel=0.002)
    assert found.misfit[0] < 0.01
    assert found.share[0] == pytest.approx(1.0, abs=0.01)


def test_pixels_on_the_path_of_another_bead_tell_nothing_of_a_spot() -> None:
    model = BeadModel(np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0]]), np.full(2, RADIUS))
    plan = plan_windows(model, turned(0.0), SHAPE, 20.0)
    way = np.zeros((FRAMES, 2, 2))
    way[:, 1, 0] = 20.0
    crossed = replace(plan, crowded=np.ones_like(plan.crowded))
    (own,) = own_pixels(crossed, way, np.array([0]))[:1]
    left, top = plan.corner[0, 0]
    (x, y), reach = plan.predicted[0, 1], plan.radii[0, 1] + 3.0
    for part, row in ((-10, 0.0), (0, 0.0), (-5, 0.8 * reach)):
        assert not own[round(y + row) - top, round(x + part) - left]
    (x, y) = plan.predicted[0, 0]
    assert own[round(y) - top, round(x - plan.radii[0, 0]) - left]


@pytest.mark.parametrize("blur", [(0.6, 0.6), (0.5, 1.1), (1.1, 0.5)])
def test_images_of_instants_are_told_from_smeared_ones_whatever_the_blur(
    blur: tuple[float, float],
) -> None:
    smear = measured(0.0, blur=blur)[0].smear
    assert smear.measured
    assert not smear.told
    assert abs(smear.squared) < 4.0 * smear.sigma
    assert smear.left < 0.01


def test_odds_grow_with_the_square_over_its_sigma() -> None:
    odds = [Smear(s * 0.01, 0.01).log_odds for s in (-40.0, -3.0, 0.0, 3.0, 6.0, 40.0)]
    assert odds == sorted(odds)
    assert [Smear(s * 0.01, 0.01).named for s in (0.0, 3.0, 6.0)] == [False, False, True]
    assert not UNMEASURED.named
    assert UNMEASURED.share == 0.0


@pytest.mark.parametrize("true", [0.02, 0.4, 1.7])
def test_the_arc_is_found_where_steps_are_far_from_linear(true: float) -> None:
    def step_at(square: float) -> Step:
        return Step(math.tanh(3.0 * (true - square)) * (0.3 + 0.2 * square), 1e-3)

    found = solved(0.0, step_at(0.0), step_at)
    assert found.told
    assert found.squared == pytest.approx(true, rel=0.02)


def test_a_smear_that_no_arc_explains_is_none() -> None:
    assert solved(0.0, Step(0.3, 0.01), lambda square: Step(0.3, 0.01)) == UNMEASURED


def test_the_finding_gives_arc_and_share() -> None:
    finding = judge_smear(Smear(0.25, 0.01, True), math.radians(15.0))
    assert finding is not None
    assert finding.code == "exposure_arc"
    assert "7.5 deg, 0.50 of a step" in finding.text
    assert judge_smear(Smear(0.02, 0.01, True), math.radians(15.0)) is None


def test_a_scan_that_is_exposed_while_turning_is_told_as_that_and_nothing_false(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Coarse images of the campaign `arcs_drawn`."""
    monkeypatch.setattr(own, "SHAPE", (380, 478))
    monkeypatch.setattr(own, "PIXEL", 0.2992)
    monkeypatch.setattr(arcs_drawn, "FRAMES", (36,))
    told = arcs_drawn.told(4, 0.3, 0.6)
    assert told.offered
    assert told.codes == {"exposure_arc"}
    assert told.found == pytest.approx(told.share, rel=0.03)
    assert told.worst < 4.0


@pytest.mark.parametrize("arc", [0.05, 1.5])
def test_the_light_of_an_exposure_is_the_mean_of_its_moments_in_entire_windows(
    arc: float,
) -> None:
    model = BeadModel(BEADS, np.full(len(BEADS), RADIUS))
    plan = plan_windows(model, turned(0.0), SHAPE, 20.0)
    balls = balls_of(model, np.array([0.5, 1.0, 2.0]))
    moments = tuple(turned(arc * p) for p in (-0.5, -0.2, 0.1, 0.5))
    groups = tuple((Scene((ball,)), None) for ball in balls.solids)
    drawn = window_intensities(
        Scene(()), turned(0.0), replace(plan, moments=moments), 1, groups
    )
    whole = [np.exp(-render_windows(balls, near, plan)) for near in moments]
    assert np.abs(drawn - np.mean(whole, axis=0)).max() < 1e-5


@pytest.mark.parametrize(
    ("share", "about", "blur"),
    [(1.4, 0.2, (0.6, 0.6)), (0.9, 0.2, (0.6, 0.6)), (0.9, 0.2, (3.0, 0.6))],
)
def test_shadows_that_are_drawn_out_tell_the_arc_without_a_spot(
    share: float, about: float, blur: tuple[float, float]
) -> None:
    images, plan = exposed(share, blur)
    model = BeadModel(BEADS, np.full(len(BEADS), RADIUS))
    arc = drawn_out(images, plan, model, turned)
    assert arc.certain
    assert arc.share == pytest.approx(share, abs=about)


@pytest.mark.parametrize("blur", [(0.6, 0.6), (0.6, 1.5)])
def test_shadows_at_rest_are_not_drawn_out_wherever_they_are_sought(
    blur: tuple[float, float],
) -> None:
    """A detector that blurs more along rows was told an arc of a quarter of a step."""
    images, plan = exposed(0.0, blur)
    model = BeadModel(BEADS, np.full(len(BEADS), RADIUS))
    assert not drawn_out(images, plan, model, turned).certain
    aside = np.roll(images, (4, -3), (2, 3))
    assert not drawn_out(aside, plan, model, turned).certain


def test_the_error_of_drawn_out_shadows_names_the_arc_and_what_to_do() -> None:
    told = shadows_drawn_out("scan", 1.43, STEP, 0.48)
    assert told.forbids
    for words in ("21 deg, 1.4 of a step", "48 %", "stop the stage", "more frames"):
        assert words in told.text
