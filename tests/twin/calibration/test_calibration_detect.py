"""Detection against known places: accuracy, completeness, clutter, and what must not be
found."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from calibration_images import radiographs
from calibration_scenarios import PIXEL, SHAPE, scenario

from flexdt.phantoms import Phantom, bead_phantom, lego_phantom, load_phantom
from flexdt.twin.calibration.bead_model import bead_model
from flexdt.twin.calibration.detect.detection import Detections, detect_beads
from flexdt.twin.calibration.detect.refine import measure_beads
from flexdt.twin.calibration.detect.windows import crop, mended, plan_windows
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.poses import Poses

STEP_U, STEP_V = np.array([PIXEL, 0.0, 0.0]), np.array([0.0, 0.0, -PIXEL])


def lego_cone(frames: int) -> ConeVec:
    """The LEGO phantom wholly in view at magnification 1.76."""
    return Poses(
        [0.0, 0.0, 30.0], [0.5, 600.0, 20.0], [0.0, 1059.0, 16.0], STEP_U, STEP_V,
        2 * np.pi * np.arange(frames) / frames,
    ).cone_vec()  # fmt: skip


def matched(found: Detections, expected: FloatArray, gate: float = 4.0) -> FloatArray:
    """Error of each expected place (k, 2), nan where nothing was found."""
    out = np.full(expected.shape, np.nan)
    for k, place in enumerate(expected):
        if len(found):
            j = int(np.argmin(np.linalg.norm(found.centers - place, axis=1)))
            if np.linalg.norm(found.centers[j] - place) < gate:
                out[k] = found.centers[j] - place
    return out


def ball(
    shape: tuple[int, int], x: float, y: float, radius: float, peak: float
) -> FloatArray:
    """A ball's chords, averaged over 5 x 5 points of each pixel."""
    rows, cols = shape
    sub = (np.arange(5) + 0.5) / 5 - 0.5
    image = np.zeros(shape)
    i, j = np.arange(rows)[:, None], np.arange(cols)[None, :]
    for a in sub:
        for b in sub:
            d2 = ((j + a - x) ** 2 + (i + b - y) ** 2) / radius**2
            image += peak * np.sqrt(np.maximum(0.0, 1.0 - d2)) / 25
    return image


@pytest.mark.parametrize("radius", [6.0, 11.8, 25.0])
def test_a_lone_ball_is_found_to_a_hundredth_of_a_pixel(radius: float) -> None:
    x, y = 60.37, 71.81
    found = detect_beads(ball((150, 130), x, y, radius, 3.0), radius_px=(5.0, 30.0))
    assert len(found) == 1
    assert np.abs(found.centers[0] - [x, y]).max() < 0.003
    assert found.radii_px[0] == pytest.approx(radius, rel=0.02)
    assert found.contrast[0] == pytest.approx(3.0, rel=0.05)
    assert found.whole.all()


def test_covariance_is_the_scatter() -> None:
    clean = ball((100, 100), 50.3, 48.8, 12.0, 2.0)
    errors, predicted = [], []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        counts = rng.poisson(8000 * np.exp(-clean))
        found = detect_beads(
            np.log(8000 / np.maximum(counts, 0.5)), radius_px=(8.0, 18.0)
        )
        errors.append(found.centers[0] - [50.3, 48.8])
        predicted.append(np.diag(found.covariances[0]))
    assert np.std(errors, axis=0) == pytest.approx(
        np.sqrt(np.mean(predicted, axis=0)), rel=0.25
    )
    assert np.abs(np.mean(errors, axis=0)).max() < 0.003


def test_every_lego_bead_is_found_in_spite_of_bricks_and_studs() -> None:
    phantom, cone = lego_phantom(), lego_cone(12)
    expected = cone.project_points(phantom.beads, SHAPE)
    for image, places in zip(radiographs(phantom, cone), expected, strict=True):
        found = detect_beads(image)
        error = matched(found, places)
        assert len(found) == 5
        assert (
            np.abs(error).max() < 0.4
        )  # a brick's edge behind a bead pulls its centroid


def test_gradient_blur_and_foreign_objects_are_tolerated() -> None:
    phantom, cone = lego_phantom(), lego_cone(4)
    rows, cols = SHAPE
    gradient = np.linspace(0, 1.5, cols)[None, :] + np.linspace(0, 0.8, rows)[:, None]
    bar = np.zeros(SHAPE)
    bar[100:600, 700:760] = 4.0  # a dense bar, wider than a bead
    screw = np.zeros(SHAPE)
    screw[300:400, 800:812] = 3.5  # thin and long
    for image, places in zip(
        radiographs(phantom, cone), cone.project_points(phantom.beads, SHAPE), strict=True
    ):
        blurred = cv2.GaussianBlur(image, (0, 0), 1.5)
        found = detect_beads((blurred + gradient + bar + screw).astype(np.float32))
        assert np.isfinite(matched(found, places)).all()
        assert len(found) == 5


def test_noise_of_few_photons_is_tolerated() -> None:
    phantom, cone = lego_phantom(), lego_cone(4)
    for image, places in zip(
        radiographs(phantom, cone, 400.0),
        cone.project_points(phantom.beads, SHAPE),
        strict=True,
    ):
        found = detect_beads(image)
        assert np.isfinite(matched(found, places)).all()
        assert len(found) <= 6


@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_found_in_noise_or_in_a_plain_box(seed: int) -> None:
    rng = np.random.default_rng(seed)
    noise = 0.02 * rng.normal(size=SHAPE)
    assert len(detect_beads(noise)) == 0
    box = noise.copy()
    box[200:500, 300:620] += 1.0
    assert len(detect_beads(box)) == 0


def test_a_bead_cut_by_the_edge_is_fitted() -> None:
    image = ball((200, 200), 100.2, 90.7, 14.0, 3.0) + ball(
        (200, 200), 60.4, 195.6, 14.0, 3.0
    )
    found = detect_beads(image)
    assert found.whole.tolist() == [True, False]
    error = found.centers[1] - [60.4, 195.6]
    assert np.abs(error).max() < 0.3
    assert (np.abs(error) < 4 * np.sqrt(np.diag(found.covariances[1]))).all()
    assert found.covariances[1, 1, 1] > found.covariances[0, 1, 1]


def test_two_sizes_of_beads_when_asked() -> None:
    from flexdt.twin.calibration.detect.detection import SpotFinder

    image = ball((200, 200), 60.2, 90.7, 16.0, 4.0) + ball(
        (200, 200), 140.4, 95.6, 8.0, 2.0
    )
    both = detect_beads(image, SpotFinder(radius_px=(5.0, 20.0), same=float("inf")))
    assert len(both) == 2
    assert len(detect_beads(image)) == 1


def test_bad_images_are_refused() -> None:
    with pytest.raises(TwinError, match="rows x cols"):
        detect_beads(np.zeros((3, 4, 5)))
    assert len(detect_beads(np.full((50, 50), np.nan))) == 0
    assert len(detect_beads(np.zeros((2, 2)))) == 0


def second_look_errors(
    phantom: Phantom, cone: ConeVec, counts: float | None
) -> tuple[FloatArray, FloatArray, np.ndarray]:
    """Errors (n, k, 2) against the shadow's centre, their sigmas, and which beads are whole."""
    model = bead_model(phantom)
    images = radiographs(phantom, cone, counts)
    plan = plan_windows(model, cone, SHAPE)
    cut = np.stack([crop(image, plan, i) for i, image in enumerate(images)])
    result = measure_beads(cut, plan, cone, model, 3.0, phantom.scene)
    foot = cone.piercing_points(SHAPE)[:, None]
    depth = np.einsum("nkj,nj->nk", model.beads[None] - cone.source[:, None], cone.normal)
    shift = ((model.bead_radius_mm / depth) ** 2)[..., None] * (plan.predicted - foot)
    error = result.tracks - plan.predicted - shift * result.bias[..., None]
    sigma = np.sqrt(np.diagonal(result.covariances, axis1=2, axis2=3))
    return error, sigma, plan.whole


@pytest.mark.slow
def test_second_look_removes_the_pull_of_the_body() -> None:
    for name in ("lego", "normal-5", "compact-3"):
        phantom = load_phantom(name)
        if name == "lego":
            cone = lego_cone(12)
        else:
            poses, truth = scenario("G0", 12)
            cone = poses.cone_vec(truth)
        clean, _, whole = second_look_errors(phantom, cone, None)
        assert whole.all()
        assert np.sqrt(np.mean(clean**2)) < 0.001, name
        noisy, sigma, _ = second_look_errors(phantom, cone, 20_000.0)
        assert np.sqrt(np.mean(noisy**2)) < 0.008, name
        assert 0.6 < np.std(noisy / sigma) < 1.6, name


def test_second_look_separates_touching_beads_and_fits_cut_ones() -> None:
    poses, truth = scenario("G0", 18)
    error, _, whole = second_look_errors(
        bead_phantom("coplanar", 3), poses.cone_vec(truth), 2e4
    )
    assert (~whole).sum() >= 5
    assert np.isfinite(error[~whole]).all()
    assert np.sqrt(np.mean(error[~whole] ** 2)) < 0.06
    poses, truth = scenario("G3", 12)
    error, _, whole = second_look_errors(
        bead_phantom("tall", 3), poses.cone_vec(truth), 2e4
    )
    assert (~whole).sum() == 24  # two of three beads cut in every frame
    assert np.isfinite(error).all()
    assert np.sqrt(np.mean(error[~whole] ** 2)) < 0.1


def test_only_pixels_that_never_change_are_filled() -> None:
    model = bead_model(load_phantom("lego"))
    cone = lego_cone(24)
    plan = plan_windows(model, cone, SHAPE)
    rng = np.random.default_rng(5)
    clean = radiographs(lego_phantom(), cone, counts=None)
    noisy = [np.float32(im + rng.normal(0.0, 0.02, SHAPE)) for im in clean]
    seen = np.stack([crop(im, plan, f) for f, im in enumerate(noisy)])
    there = np.isfinite(seen)
    assert (mended(seen, plan) == seen)[there].mean() > 0.9999  # noise repeats by chance
    still = np.stack([crop(im, plan, f) for f, im in enumerate(clean)])
    assert mended(still, plan) is still
    column = int(plan.predicted[..., 0].mean())
    for im in noisy:
        im[:, column] = 9.0
    broken = np.stack([crop(im, plan, f) for f, im in enumerate(noisy)])
    filled = mended(broken, plan)
    hit = broken == 9.0
    assert hit.sum() > 200
    assert np.median(np.abs(filled - seen)[hit]) < 0.03
    assert (filled == seen)[~hit & there].mean() > 0.9999
