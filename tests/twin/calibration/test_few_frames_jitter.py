"""What moves from frame to frame is told, and in the sigmas of the mean, also in few frames.

The tracks come from the rays and planes of `prior_coverage`, which share nothing with the fit.
"""

from __future__ import annotations

import numpy as np
import pytest
from prior_coverage import NOISE_PX, PIXEL, SDD, SHAPE, SOD, pixels

from flexdt.phantoms import load_phantom
from flexdt.twin.calibration import estimate_geometry
from flexdt.twin.calibration.diagnose.table.group import Known
from flexdt.twin.calibration.diagnose.table.verdict import judged
from flexdt.twin.calibration.fit.certificate import Certificate
from flexdt.twin.calibration.fit.problem import UNSTRAINED
from flexdt.twin.geometry.poses import Poses

BEADS = load_phantom("lego").beads
SIX = {"dO_x": 0.5, "dO_y": -0.2, "dO_z": 0.8, "alpha": 2.0, "tau_x": -0.2, "tau_z": 0.5}
SCANS = 6
OFTEN = 12


def certified(
    frames: int, jitter: float, drift: float, seed: int, moving: str = "dO_x"
) -> tuple[Certificate, set[str], dict[str, float]]:
    """Judge a full turn in which what moves is elsewhere by a normal deviate in each frame,
    and drifts evenly [mm, deg]: certificate, codes, and the mean geometry."""
    rng = np.random.default_rng(seed)
    angles = 360.0 * np.arange(frames) / frames
    places = SIX.get(moving, 0.0) + jitter * rng.normal(size=frames)
    places += drift * np.linspace(-0.5, 0.5, frames)
    exact = np.concatenate(
        [
            pixels(BEADS, angles[i : i + 1], SOD, SIX | {moving: place})
            for i, place in enumerate(places.tolist())
        ]
    )
    seen = exact + NOISE_PX * rng.normal(size=exact.shape)
    u, v = [PIXEL, 0, 0], [0, 0, -PIXEL]
    poses = Poses([0, 0, 0], [0, SOD, 0], [0, SDD, 0], u, v, np.radians(angles))
    fit = estimate_geometry(seen, BEADS, poses, shape=SHAPE)
    known = Known(UNSTRAINED, 0.0, 1e-3)
    better, told = judged(fit, known, sigmas_known=False)
    truth = SIX | ({moving: float(places.mean())} if moving in SIX else {})
    return better.certificate, {str(f.code) for f in told}, truth


def pulls(certificate: Certificate, truth: dict[str, float]) -> list[float]:
    """Errors of the six, in stated standard deviations."""
    return [(e.value - truth[n]) / e.sigma for n, e in certificate.estimates.items()]


@pytest.mark.parametrize("frames", [6, 8, 10])
def test_jitter_of_few_frames_is_told_and_the_mean_holds(frames: int) -> None:
    """Nine of ten were told as a drift of one parameter, and none was offered."""
    far = 0
    for seed in range(SCANS):
        found, codes, truth = certified(frames, 0.05, 0.0, seed)
        assert codes & {"drift", "vibration", "causes_open"}, codes
        far += max(map(abs, pulls(found, truth))) > 4.0
    assert far <= 1


@pytest.mark.parametrize("frames", [4, 6, 10])
@pytest.mark.parametrize("jitter", [0.0, 0.005])
def test_a_drift_of_few_frames_is_told_and_the_mean_holds(
    frames: int, jitter: float
) -> None:
    """Beside it, jitter that is no larger than the noise may be missed: one of six."""
    far = 0
    for seed in range(SCANS):
        found, codes, truth = certified(frames, jitter, 0.2, seed)
        assert "drift" in codes, codes
        far += max(map(abs, pulls(found, truth))) > 4.0
    assert far <= bool(jitter)


def test_jitter_of_few_frames_is_in_the_sigmas() -> None:
    """Jitter that is no larger than the noise cannot be told, and may be one of them."""
    far = 0
    for seed in range(OFTEN):
        jitter = 0.01 * 20.0 ** (seed / OFTEN)
        for moving in ("dO_x", "dO_z", "alpha"):
            found, _, truth = certified(6 + seed % 6, jitter, 0.0, seed, moving)
            far += max(map(abs, pulls(found, truth))) > 4.0
    assert far <= 1


def test_sigmas_of_few_frames_that_do_not_shake_stay() -> None:
    """The least that they can be is what the noise of the positions makes of them."""
    wider = []
    errors = []
    for seed in range(OFTEN):
        found, codes, truth = certified(6 + seed % 6, 0.0, 0.0, seed)
        assert not codes
        least = found.noise * np.sqrt(np.diag(found.spectrum.unit_covariance))
        stated = np.array([e.sigma for e in found.estimates.values()])
        wider.append(float(np.median(stated / least)))
        errors += pulls(found, truth)
    assert 0.95 <= np.median(wider) < 1.3
    assert 0.75 < np.std(errors) < 1.15
