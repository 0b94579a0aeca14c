"""A forecast is what the certificate of the scan then states, of points and of images."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import forecasts
import numpy as np
import numpy.typing as npt
import prior_coverage as own
import pytest
from causes_named import calibrated
from faults_drawn import drawn

from flexdt.phantoms import load_phantom, spiral_positions
from flexdt.twin.calibration import (
    SIX,
    BeadModel,
    FitResult,
    estimate_geometry,
    identifiability,
)
from flexdt.twin.calibration.fit.fit import image_quantities
from flexdt.twin.calibration.fit.forecast import MOST, Stated, forecast
from flexdt.twin.calibration.fit.priors import (
    Given,
    exact,
    known,
    known_scale,
    known_strain,
)
from flexdt.twin.calibration.fit.problem import build_problem
from flexdt.twin.calibration.frame_source import ArrayFrames
from flexdt.twin.calibration.pipeline import CalibrationRequest, Scan, calibrate
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.geometry.told_lengths import PHANTOM

FRAMES = 36
ANGLES = 360.0 * np.arange(FRAMES) / FRAMES
POSES = Poses.upright(
    [0, 0, 0], [0, own.SOD, 0], [0, own.SDD, 0], own.PIXEL, np.radians(ANGLES)
)
TRUTH = {
    "dO_x": 1.0,
    "dO_y": -2.0,
    "dO_z": 3.0,
    "alpha": 17.0,
    "tau_x": 0.4,
    "tau_z": -0.3,
}
AGREE = 0.2
STATED: tuple[Given | None, ...] = (None, {"dD_x": 0.1, "dD_y": 0.1}, "none")


@cache
def beads_of(kind: str) -> npt.NDArray[np.float64]:
    if kind == "spiral":
        return spiral_positions((20.0, 40.0, 50.0), 5, own.RADIUS)
    if kind == "lego":
        return np.asarray(load_phantom("lego").beads)
    return own.spread(np.random.default_rng([5, *kind.encode()]), 4 * own.RADIUS)


def assert_as_forecast(
    fit: FitResult, model: BeadModel, priors: Given | None, causes: bool
) -> None:
    expected = identifiability(
        model, POSES, fit.certificate.rms_px, shape=own.SHAPE, priors=priors,
        at=Offsets.from_edge(TRUTH), causes=causes,
    )  # fmt: skip
    for name in SIX:
        assert expected.sigmas[name] == pytest.approx(fit.sigmas[name], rel=AGREE), name
    (seen,) = image_quantities(fit)
    for name, estimate in seen.items():
        assert expected.image_sigmas[name] == pytest.approx(estimate.sigma, rel=AGREE), (
            name
        )


@pytest.mark.parametrize("priors", STATED)
@pytest.mark.parametrize("kind", ["spiral", "lego", "random 1", "random 2"])
def test_points(kind: str, priors: Given | None) -> None:
    beads = beads_of(kind)
    rng = np.random.default_rng([3, *kind.encode()])
    tracks = own.pixels(beads, ANGLES, own.SOD, TRUTH)
    tracks = tracks + rng.normal(0, own.NOISE_PX, tracks.shape)
    model = BeadModel(beads, np.full(len(beads), own.RADIUS))
    fit = estimate_geometry(
        tracks, model, POSES, shape=own.SHAPE,
        priors=known(given=priors) | {PHANTOM: known_scale(model, given=priors)},
        strain=known_strain(model, given=priors),
    )  # fmt: skip
    assert_as_forecast(fit, model, priors, causes=False)


@pytest.mark.slow
@pytest.mark.parametrize("priors", [None, "none"])
@pytest.mark.parametrize("kind", ["spiral", "random 1"])
@pytest.mark.campaign(2)
def test_images(kind: str, priors: Given | None) -> None:
    beads = beads_of(kind)
    images = own.radiographs(np.random.default_rng(4), beads, ANGLES, own.SOD, TRUTH)
    model = BeadModel(beads, np.full(len(beads), own.RADIUS))
    request = CalibrationRequest(priors=exact() if priors == "none" else {})
    found = calibrate([Scan(ArrayFrames(images, own.SHAPE), POSES)], model, request)
    assert found.identifiable, found.findings
    assert found.fit is not None
    assert_as_forecast(found.fit, model, priors, causes=True)


@pytest.mark.slow
@pytest.mark.campaign
def test_what_causes_leave_open_is_forecast() -> None:
    """Of eight drawn scans with all causes looked for: the median of stated over forecast
    sigmas. What each leaves open depends on how far its own phantom is strained."""
    ratios: dict[bool, list[dict[str, float]]] = {True: [], False: []}
    for seed in range(700, 708):
        taken = drawn("as_assumed", seed)
        b = taken.believed
        poses = Poses.upright(
            [0, 0, 0], [0, b.sod, 0], [0, b.sdd, 0], b.pixel, np.radians(b.angles)
        )
        fit = calibrated(taken).fit
        assert fit is not None
        here = Offsets.from_edge({name: taken.truth[name][0] for name in SIX})
        stated = fit.sigmas | {n: e.sigma for n, e in image_quantities(fit)[0].items()}
        for causes, found in ratios.items():
            planned = identifiability(
                BeadModel(b.beads, b.radii), poses, taken.noise_px, shape=taken.shape,
                at=here, causes=causes,
            )  # fmt: skip
            expected = planned.sigmas | planned.image_sigmas
            found.append({n: stated[n] / sigma for n, sigma in expected.items()})
    middle = {
        causes: {n: float(np.median([one[n] for one in some])) for n in some[0]}
        for causes, some in ratios.items()
    }
    assert all(0.9 < ratio < 1.1 for ratio in middle[True].values()), middle[True]
    # Of right scans causes leave hardly anything open.
    assert all(0.9 < ratio < 1.15 for ratio in middle[False].values()), middle[False]
    for name, ratio in middle[True].items():
        assert abs(math.log(ratio)) < abs(math.log(middle[False][name])) + 0.03, name


def test_scans_state_sigmas_within_their_ranges() -> None:
    """Four plans, each scanned eight times: scanner, phantom and noise drawn by the campaign's
    own renderer, spots calibrated with all causes. As many sigmas as the range says lie in it
    (more where hardly anything is left to chance), and where it is narrow, they are as
    forecast."""
    every: list[bool] = []
    wide: list[bool] = []
    narrow: list[bool] = []
    for seed in (801, 803, 804, 806):
        plan, _ = forecasts.planned(seed)
        plan = replace(plan, frames=min(plan.frames, 24))
        expected = forecasts.forecast_of(plan)
        sigmas = expected.sigmas | expected.image_sigmas
        assert set(expected.ranges) == set(sigmas)
        for draw in range(8):
            rng = np.random.default_rng([seed, draw])
            found = forecasts.stated(plan, forecasts.world_of(plan, rng), rng)
            assert found is not None
            for name, (low, high) in expected.ranges.items():
                every.append(low <= found[name] <= high)
                if high > forecasts.WIDE * low:
                    wide.append(every[-1])
                if high < 1.25 * sigmas[name] and low > 0.8 * sigmas[name]:
                    narrow.append(0.8 < found[name] / sigmas[name] < 1.25)
    assert np.mean(every) > MOST - 0.08
    assert len(wide) > 100
    assert np.mean(wide) == pytest.approx(MOST, abs=0.08)
    assert len(narrow) > 50
    assert np.mean(narrow) > 0.85


def test_a_range_is_that_of_one_more_scan() -> None:
    """39 scans whose sigmas are 1 to 39 times those of the fit, in any order: half state less
    than 20, and of 40 places in the order 32 are between the fourth and the fourth from
    above."""
    model = BeadModel(beads_of("spiral"), np.full(5, own.RADIUS))
    tracks = POSES.cone_vec().project_points(model.beads, own.SHAPE)
    problem = build_problem(tracks, model, POSES, free=SIX, shape=own.SHAPE)
    alone = forecast(problem)
    assert alone.ranges == {}
    times = np.random.default_rng(1).permutation(39) + 1.0
    whole = alone.covariance * times[:, None, None] ** 2
    images = np.array(list(alone.image_sigmas.values())) ** 2 * times[:, None] ** 2
    found = forecast(problem, stated=Stated(whole, images))
    for name, sigma in (alone.sigmas | alone.image_sigmas).items():
        low, high = found.ranges[name]
        assert low == pytest.approx(4 * sigma, rel=0.006)
        assert high == pytest.approx(36 * sigma, rel=0.006)
    for name, sigma in alone.sigmas.items():
        assert found.sigmas[name] == pytest.approx(20 * sigma)
    assert found.covariance == pytest.approx(400 * alone.covariance, rel=1e-9)
    assert found.image_sigmas["axis_angle"] == pytest.approx(
        20 * alone.image_sigmas["axis_angle"]
    )


def test_offsets_of_the_scanner_turn_the_image_of_the_axis() -> None:
    """The axis's angle in the image is known better than the scanner's offsets turn it, so
    that its sigma differs from scanner to scanner: of fifteen that are drawn here, each with
    the forecast at its own place, median and spread are foreseen."""
    plan, rng = forecasts.planned(502)
    there = [
        identifiability(
            plan.model, plan.poses, plan.noise_px, shape=plan.shape, causes=False,
            at=Offsets.from_edge(forecasts.world_of(plan, rng).offsets),
        ).image_sigmas["axis_angle"]
        for _ in range(15)
    ]  # fmt: skip
    foreseen = forecasts.forecast_of(plan)
    assert foreseen.image_sigmas["axis_angle"] == pytest.approx(
        np.median(there), rel=0.05
    )
    low, high = foreseen.ranges["axis_angle"]
    # What causes leave open comes on top of the fits here, as in the median.
    assert low < 1.05 * np.quantile(there, 0.2)
    assert high > np.quantile(there, 0.8)
