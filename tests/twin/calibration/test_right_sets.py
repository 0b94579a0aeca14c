"""Regions of right scans contain the truth as often as they say, over what is assumed of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import prior_coverage as own
import pytest
from causes_named import scored
from right_sets import FAR_SIGMAS, LEVELS, contains_what_is_asked, covered
from right_sets import off as off_of
from scipy.special import fdtr

from flexdt.twin.calibration.fit.certificate import Certificate, Rival, widened
from flexdt.twin.calibration.fit.curved_region import Bend
from flexdt.twin.calibration.fit.fit import estimate_geometry
from flexdt.twin.geometry.poses import Poses

DEGREES = 300.0
"""Of freedom of a usual scan's residuals."""


def levels(scale: float, scans: int = 400) -> list[float]:
    """Draw the levels of scans whose regions are `scale` times as long as they should be."""
    rng = np.random.default_rng(1)
    distance2 = rng.chisquare(14, scans) / scale**2
    return fdtr(14, DEGREES, distance2 / 14).tolist()


def test_regions_of_another_size_are_told() -> None:
    """The judgement itself: 400 scans tell a region that is scaled by 1.3, or by .8."""
    assert contains_what_is_asked(levels(1.0))
    assert not contains_what_is_asked(levels(1.3))
    assert not contains_what_is_asked(levels(0.8))
    right = off_of(levels(1.0))
    assert all(abs(v) < FAR_SIGMAS for v in right.values()), right
    assert off_of(levels(1.3))[0.5] > FAR_SIGMAS
    assert off_of(levels(0.8))[0.95] < -FAR_SIGMAS


def test_told_lengths_of_a_drawn_scan_are_compared_with_what_was_drawn() -> None:
    """A phantom 0.23 % smaller than its file says: compared with the file's scale, which images
    do not tell, the scale had no error, and the others were beyond the 99.99 % region."""
    one = covered("as_assumed", 59018)
    assert one is not None
    assert one.pulls["phantom"] == pytest.approx(2.3, abs=0.1)
    assert 0.01 < abs(one.pulls["pixel"]) < 4.0
    assert one.level < 0.95


@pytest.fixture(scope="module")
def plain() -> Certificate:
    """Of six parameters, without a bend."""
    rng = np.random.default_rng(3)
    angles = 10.0 * np.arange(36)
    beads = own.spread(rng, 4.0)
    poses = Poses.upright(
        [0, 0, 0], [0, own.SOD, 0], [0, own.SDD, 0], own.PIXEL, np.radians(angles)
    )
    tracks = own.pixels(beads, angles, own.SOD, {})
    tracks += own.NOISE_PX * rng.normal(size=tracks.shape)
    fit = estimate_geometry(tracks, beads, poses, shape=own.SHAPE)
    return replace(fit.certificate, bend=lambda: Bend.none(6))


def test_a_region_of_rivals_contains_what_each_of_them_expects(
    plain: Certificate,
) -> None:
    """A ninth of the scans has a cause that makes one direction five times less known. One
    ellipsoid of both is too wide for half of the truths and too narrow for the last ones."""
    rng = np.random.default_rng(4)
    root = np.linalg.cholesky(plain.covariance)
    along = root[:, 0]
    more = 24.0 * np.outer(along, along)
    pair = (
        Rival(8 / 9, np.zeros(6), plain.covariance),
        Rival(1 / 9, along, plain.covariance + more),
    )
    one = widened(plain, (more + np.outer(along, along)) / 9)
    mixed = replace(one, rivals=pair)
    found: dict[str, list[float]] = {"one": [], "mixed": []}
    for _ in range(2000):
        there = rng.normal(size=6)
        if rng.uniform() < 1 / 9:
            there[0] = 5.0 * there[0] + 1.0
        truth = {n: v + d for (n, v), d in zip(values(plain), root @ there, strict=True)}
        found["one"].append(one.level(truth))
        found["mixed"].append(mixed.level(truth))
    assert np.mean(found["mixed"]) == pytest.approx(0.5, abs=4 / np.sqrt(12 * 2000))
    mixture = off_of(found["mixed"])
    assert all(abs(v) < FAR_SIGMAS for v in mixture.values()), mixture
    ellipsoid = off_of(found["one"])
    assert ellipsoid[0.5] > FAR_SIGMAS
    assert ellipsoid[0.99] < -FAR_SIGMAS


def values(certificate: Certificate) -> list[tuple[str, float]]:
    return [(n, e.value) for n, e in certificate.estimates.items()]


def test_what_widens_the_estimates_widens_every_rival(plain: Certificate) -> None:
    rivals = (Rival(1.0, np.zeros(6), plain.covariance),)
    wider = widened(replace(plain, rivals=rivals), {"dO_x": 0.5})
    truth = dict(values(plain)) | {"dO_x": plain.estimates["dO_x"].value + 0.4}
    assert replace(plain, rivals=rivals).level(truth) > 0.999
    assert wider.level(truth) == pytest.approx(replace(wider, rivals=()).level(truth))
    assert wider.level(truth) < 0.5


@pytest.mark.slow
@pytest.mark.campaign
@pytest.mark.parametrize("kind", ["as_assumed", "with_causes"])
def test_regions_contain_as_many_truths_as_they_say(kind: str) -> None:
    """A region of 1.3 times its size fails: 37 of 40 truths are in the 50 % region then."""
    found = [one for seed in range(300, 340) if (one := covered(kind, seed)) is not None]
    far = off_of([one.level for one in found])
    assert all(abs(v) < FAR_SIGMAS for v in far.values()), far
    assert far.keys() == set(LEVELS)


def test_a_cause_beside_which_nothing_is_determined_is_not_left_out() -> None:
    """A phantom 2 to 4 % too small along each axis: the fit without its strain was offered
    19 sigmas off, without a word, because the fit with it does not determine dO_z. Stretches
    without the scale that they share were offered 4.3 sigmas off."""
    found = scored("with_causes", 70003)
    assert not found.offered, found
    assert any(s.startswith("phantom_strained") for s in found.said), found
