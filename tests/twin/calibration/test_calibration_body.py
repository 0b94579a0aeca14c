"""The phantom's body as the images have it: absent, turned, moved, of another material.

The images come from a renderer of this file's own: slabs and chords in numpy, one ray a pixel.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.frame_source import ArrayFrames
from flexdt.twin.calibration.pipeline import Calibration, Scan, calibrate
from flexdt.twin.projection.analytic_solids import Box, Scene, Solid, Sphere
from flexdt_extensions.studies.experiments import SHAPE, scenario

BEADS = np.array(
    [
        [7.0, 2.0, -16.0],
        [-6.0, 6.0, -7.0],
        [-5.0, -7.0, 2.0],
        [6.0, -6.0, 9.0],
        [0.0, 7.5, 17.0],
    ]
)
RADIUS, METAL, PLASTIC = 1.0, 2.0, 0.03
SIZE, CENTRE = np.array([15.0, 9.0, 36.0]), np.array([1.5, -1.0, 0.0])
ASIDE = np.array([0.8, -0.6, 0.0])
COUNTS, FRAMES = 3000.0, 8
MODEL = BeadModel(BEADS, np.full(5, RADIUS))
DESCRIBED = Scene((
    Solid(Box(tuple(CENTRE.tolist()), tuple(SIZE.tolist())), "ABS", PLASTIC),
    *(Solid(Sphere(tuple(b), RADIUS), "steel", METAL) for b in BEADS.tolist()),
))  # fmt: skip


@cache
def images(plastic: float, turn_deg: float, aside_mm: float) -> list[np.ndarray]:
    """Noisy line integrals of the beads and of a body, turned about z and moved along x and
    y."""
    rng = np.random.default_rng(5)
    poses, truth = scenario("G0", FRAMES)
    cone = np.asarray(poses.cone_vec(truth))
    c, s = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    about = np.array(
        [[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]
    )  # into the body's own axes
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    out = []
    for source, detector, u, v in cone.reshape(-1, 4, 3):
        aside = (columns - (SHAPE[1] - 1) / 2)[..., None] * u
        down = (rows - (SHAPE[0] - 1) / 2)[..., None] * v
        ray = detector + aside + down - source
        ray /= np.linalg.norm(ray, axis=2, keepdims=True)
        total = np.zeros(SHAPE)
        for bead in BEADS:
            along = ray @ (bead - source)
            off2 = ((bead - source) ** 2).sum() - along**2
            total += METAL * 2.0 * np.sqrt(np.clip(RADIUS**2 - off2, 0.0, None))
        centre = CENTRE + aside_mm * ASIDE
        start, way = about @ (source - centre), ray @ about.T
        with np.errstate(divide="ignore", invalid="ignore"):
            one, two = (-SIZE / 2 - start) / way, (SIZE / 2 - start) / way
        enter, leave = np.minimum(one, two).max(axis=2), np.maximum(one, two).min(axis=2)
        total += plastic * np.clip(leave - enter, 0.0, None)
        seen = rng.poisson(COUNTS * np.exp(-total))
        out.append(-np.log(np.maximum(seen, 1) / COUNTS).astype(np.float32))
    return out


def calibrated(
    plastic: float, turn_deg: float, aside_mm: float, told: Scene
) -> tuple[Calibration, float]:
    """The calibration, and its largest error in sigmas."""
    poses, truth = scenario("G0", FRAMES)
    frames = ArrayFrames(images(plastic, turn_deg, aside_mm), SHAPE)
    result = calibrate([Scan(frames, poses, "body")], MODEL, scene=told)
    fit, true = result.fit, truth.to_edge()
    assert fit is not None
    return result, max(
        abs(fit.values[n] - true.get(n, 0.0)) / sigma for n, sigma in fit.sigmas.items()
    )


@pytest.mark.daily(1)
@pytest.mark.parametrize(
    ("plastic", "turn_deg", "aside_mm", "code", "factor"),
    [
        (PLASTIC, 0.0, 0.1, None, 1.0),
        (0.0, 0.0, 0.0, "body_elsewhere", 0.0),
        (PLASTIC, 90.0, 0.0, "body_elsewhere", 0.0),
        (2.5 * PLASTIC, 0.0, 0.5, "body_differs", 2.5),
    ],
)
@pytest.mark.campaign(1)
def test_the_body_is_subtracted_as_the_images_have_it(
    plastic: float, turn_deg: float, aside_mm: float, code: str | None, factor: float
) -> None:
    result, worst = calibrated(plastic, turn_deg, aside_mm, DESCRIBED)
    assert {f.code for f in result.findings if f.code.startswith("body")} == {code} - {
        None
    }
    body = result.measured[0].body
    assert body.factor == pytest.approx(factor, abs=0.05)
    assert np.abs(body.shift_mm - aside_mm * ASIDE).max() < 0.02
    assert result.identifiable
    assert worst < 4.0


@pytest.mark.slow
def test_a_body_that_is_not_there_costs_nothing() -> None:
    """Subtracted all the same, its edges would pull the shadows."""
    beads = Scene(tuple(s for s in DESCRIBED.solids if isinstance(s.shape, Sphere)))
    told, _ = calibrated(0.0, 0.0, 0.0, DESCRIBED)
    untold, _ = calibrated(0.0, 0.0, 0.0, beads)
    assert told.fit is not None
    assert untold.fit is not None
    assert math.isnan(untold.measured[0].body.factor)
    assert told.fit.certificate.rms_px == pytest.approx(
        untold.fit.certificate.rms_px, rel=0.02
    )
