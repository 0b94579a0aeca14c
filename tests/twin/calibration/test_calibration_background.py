"""What lies beside the beads: foreign edges and bent backgrounds; copies of frames; pixel
grids."""

from __future__ import annotations

import numpy as np
import pytest

from flexdt.phantoms import load_phantom
from flexdt.twin.calibration.bead_model import bead_model
from flexdt.twin.calibration.detect.background import survey
from flexdt.twin.calibration.detect.detection import Detections, detect_beads
from flexdt.twin.calibration.detect.fading import Fading, evened, fading
from flexdt.twin.calibration.detect.refine import measure_beads
from flexdt.twin.calibration.detect.windows import crop, lattice, plan_windows
from flexdt.twin.calibration.frame_source import FrameSpots, FrameState, without_repeats
from flexdt_extensions.studies.experiments import SHAPE, scenario
from flexdt_extensions.studies.rendered_runs import Rendering, exposures, line_integrals

SIDE = 61
NOISE = 0.01


def windows(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Noisy windows with a ball each, and the balls alone."""
    i = np.arange(SIDE) - SIDE // 2
    d2 = i[None, :] ** 2 + i[:, None] ** 2
    ball = (3.0 * np.sqrt(np.clip(1.0 - d2 / 14.0**2, 0.0, None))).astype(np.float32)
    alone = np.repeat(ball[None], count, axis=0)
    noise = NOISE * np.random.default_rng(3).normal(size=alone.shape)
    return (alone + noise).astype(np.float32), alone


def test_white_noise_and_planes_are_neither_foreign_nor_bent() -> None:
    flat, alone = windows(80)
    ramp = 0.01 * np.arange(SIDE, dtype=np.float32)
    found = survey(flat + ramp[None, None] - 0.5 * ramp[None, :, None], alone)
    assert not found.disturbed.any()
    assert found.bend is None


@pytest.mark.parametrize("seed", range(4))
def test_how_contrast_falls_is_read_from_beads_of_any_size(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true, behind = rng.uniform(-1.2, -0.3), rng.uniform(0.5, 1.5, (24, 5))
    size, noise = rng.uniform(0.3, 0.8, 5), 0.01 * rng.normal(size=behind.shape)
    contrast = size * np.exp(true * behind + noise)
    seen = rng.random(behind.shape) > 0.2
    contrast[3, 2] *= 2.0  # one that is not that bead
    brightness = 0.1 * rng.normal(size=(24, 1))
    found = fading(contrast, behind + brightness, seen)
    assert found.slope == pytest.approx(true, abs=0.02)
    assert abs(found.slope - true) < 4.0 * found.sigma < 0.02
    alike = size * np.exp(noise)
    assert abs(fading(alike, behind, seen).slope) < 0.01
    for steep, most in ((-9.0, lambda c: -1.0 / c), (9.0, lambda c: np.expm1(c) / c)):
        far = size * np.exp(steep * (behind - behind.mean()) + noise)
        limit = most(float(np.median(far)))
        assert fading(far, behind, seen | True).slope == pytest.approx(limit, rel=0.1)
    assert fading(contrast, behind, seen & False) == Fading(0.0, 0.0)
    # One frame tells nothing of it: what is assumed of light stays open.
    alone = fading(contrast[:1], behind[:1], seen[:1])
    assert alone.slope == 0.0
    assert 0.02 < alone.sigma < 0.2


def test_a_bead_that_fades_across_its_shadow_is_evened() -> None:
    i = np.arange(SIDE) - SIDE // 2
    ball = 3.0 * np.sqrt(
        np.clip(1.0 - (i[None, :] ** 2 + i[:, None] ** 2) / 14.0**2, 0.0, None)
    )
    more = 0.01 * i[None, :] - 0.004 * i[:, None]
    step = np.where(i[None, :] > 5, 0.3, 0.0) * np.ones((SIDE, 1))
    for body, beyond in ((None, more), (step[None].astype(np.float32), more + step)):
        seen = (0.7 + more + ball * np.exp(-0.8 * beyond))[None].astype(np.float32)
        out = evened(seen, np.array([[0.7, 0.01, -0.004]]), body, -0.8)
        assert np.abs(out[0] - (0.7 + more + ball)).max() < 1e-5


def test_an_edge_beside_one_bead_is_found_in_that_window_alone() -> None:
    flat, alone = windows(40)
    flat[7, :, 40:] += 0.03
    found = survey(flat, alone)
    assert np.flatnonzero(found.disturbed).tolist() == [7]
    assert found.misfit[7] > 3.0
    assert found.bend is None


def test_a_bent_background_is_what_is_subtracted() -> None:
    flat, alone = windows(40)
    i = (np.arange(SIDE) - SIDE // 2) / (SIDE / 2)
    bend = (0.08 * i[None, :] ** 3 + 0.05 * i[:, None] ** 2).astype(np.float32)
    found = survey(flat + bend, alone)
    assert found.bend is not None
    rest = bend - found.bend.mean(axis=0)
    design = np.stack(
        [np.ones(SIDE * SIDE), *(a.ravel() for a in np.meshgrid(i, i))], axis=1
    )
    plane = np.linalg.lstsq(design, rest.ravel(), rcond=None)[0]
    assert np.abs(rest.ravel() - design @ plane).max() < 0.004
    assert not found.disturbed.any()


def test_windows_outside_the_image_are_not_judged() -> None:
    flat, alone = windows(20)
    flat[3, :, 12:] = np.nan
    found = survey(flat, alone)
    assert found.misfit[3] == 1.0
    assert not found.disturbed[3]


@pytest.mark.parametrize("fine", [2, 3, 4])
def test_no_two_rays_of_a_pixel_share_a_column_or_a_row(fine: int) -> None:
    places = np.array(lattice(fine))
    n = fine * fine
    even = (np.arange(n) + 0.5) / n - 0.5
    assert np.allclose(np.sort(places[:, 0]), even)
    assert np.allclose(np.sort(places[:, 1]), even)
    # Turned by a quarter it is the same set: pixels blur alike along both axes.
    turned = np.stack([-places[:, 1], places[:, 0]], axis=1)
    assert {tuple(p) for p in turned.round(9).tolist()} == {
        tuple(p) for p in places.round(9).tolist()
    }


def look(centers: np.ndarray) -> FrameSpots:
    k = len(centers)
    one = np.ones(k)
    found = Detections(
        centers,
        np.tile(np.eye(2), (k, 1, 1)),
        10 * one,
        one,
        0 * one,
        one > 0,
        one,
        SHAPE,
    )
    return FrameSpots(found, FrameState.USABLE)


def test_a_copy_of_the_frame_before_is_not_used() -> None:
    rng = np.random.default_rng(1)
    frames = [rng.uniform(100, 600, size=(4, 2)) for _ in range(6)]
    frames[3] = frames[2].copy()
    states = [each.state for each in without_repeats([look(f) for f in frames])]
    assert states == [
        FrameState.REPEATED if i == 3 else FrameState.USABLE for i in range(len(frames))
    ]


def test_an_object_at_rest_without_noise_is_no_stutter() -> None:
    frames = [look(np.array([[100.0, 100.0], [300.0, 200.0]])) for _ in range(6)]
    assert all(each.state is FrameState.USABLE for each in without_repeats(frames))


def test_positions_are_unbiased_where_a_bead_stays_at_one_place_of_the_pixel_grid() -> (
    None
):
    """The mean error of each bead over the frames, without noise: pixels that integrate finer
    than the correction's, blur that has to be estimated, and a body's face that touches a
    bead."""
    phantom = load_phantom("normal-4")
    model = bead_model(phantom)
    poses, truth = scenario("G0", 12)
    cone = poses.cone_vec(truth)
    images = list(exposures(phantom.scene, model, cone, Rendering(None, 0.6, 4), [1]))
    plan = plan_windows(model, cone, SHAPE)
    cut = np.stack([crop(image, plan, i) for i, image in enumerate(images)])
    result = measure_beads(cut, plan, cone, model, 6.0, phantom.scene)
    assert (result.bias[np.isfinite(result.tracks[..., 0])] == 0.0).all()
    error = result.tracks - plan.predicted
    assert np.abs(np.nanmean(error, axis=0)).max() < 0.001
    rough = measure_beads(cut, plan, cone, model, 6.0, phantom.scene, draft=True)
    assert np.nanmax(np.abs(rough.tracks - plan.predicted)) > 0.002


def test_detection_in_parts_sees_what_the_whole_image_shows() -> None:
    phantom = load_phantom("normal-4")
    model = bead_model(phantom)
    poses, truth = scenario("G0", 3)
    camera = Rendering(5000.0, 0.7, 2)
    counts = next(
        iter(exposures(phantom.scene, model, poses.cone_vec(truth), camera, [4]))
    )
    image = line_integrals(counts, 5000.0)
    found = detect_beads(image, radius_px=(10.0, 30.0))
    places = poses.cone_vec(truth).project_points(model.beads, SHAPE)[0]
    gap = np.linalg.norm(found.centers[:, None] - places[None], axis=2)
    assert len(found) == 4
    assert gap.min(axis=0).max() < 0.5
