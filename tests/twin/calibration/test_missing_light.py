"""Light that a too bright dark image takes from all pixels is found behind beads."""

from __future__ import annotations

import numpy as np
import pytest

from flexdt.twin.calibration.detect.missing_light import missing_light, with_light
from flexdt.twin.calibration.detect.windows import Windows
from flexdt.twin.geometry.conventions import Float32Array

SIDE = 41
FRAMES = 24
BEADS = 3


def windows() -> Windows:
    """Windows with a round spot of 9 px in the middle of each."""
    every = (FRAMES, BEADS)
    return Windows(
        corner=np.zeros((*every, 2), dtype=np.int64),
        side=SIDE,
        predicted=np.full((*every, 2), (SIDE - 1) / 2),
        radii=np.full(every, 9.0),
        stretch=np.broadcast_to([1.0, 0.0, 1.0], (*every, 3)).copy(),
        share=np.ones(every),
        crowded=np.zeros(every, dtype=bool),
        whole=np.ones(every, dtype=bool),
        shape=(SIDE, SIDE),
    )


def images(dark: float = 0.0, scatter: float = 0.0, ceiling: float = 9.0) -> Float32Array:
    """Beads that pass 5 to 15 % of a beam of which a body leaves 10 to 60 %, counted with
    20 000 photons, as line integrals; the dark image is too bright by `dark`."""
    rng = np.random.default_rng(5)
    row, column = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2
    spot = np.hypot(row, column) < 9.0
    body = rng.uniform(0.1, 0.6, size=(FRAMES, BEADS, 1, 1))
    passed = np.array([0.05, 0.1, 0.15])[:, None, None]
    beam = np.minimum(body * np.where(spot, passed, 1.0) + scatter, ceiling)
    counts = rng.poisson(2e4 * beam) / 2e4 if ceiling > 1.0 else beam
    return np.float32(-np.log(np.maximum(counts - dark, 2.5e-5) / (1.0 - dark)))


ALL = np.ones(FRAMES, dtype=bool)


def test_what_a_dark_image_takes_is_found_and_given_back() -> None:
    seen = images(dark=0.004)
    found = missing_light(seen, windows(), ALL)
    assert found.seen
    assert found.part == pytest.approx(0.004 / 0.996, abs=4.0 * found.sigma)
    assert found.sigma < 2e-4
    assert found.dark == 0.0
    right = images()
    assert np.allclose(with_light(seen, 0.004 / 0.996), right, atol=2e-3)


@pytest.mark.parametrize("scatter", [0.0, 0.01, 0.1])
def test_nothing_is_missing_of_right_or_scattered_light(scatter: float) -> None:
    found = missing_light(images(scatter=scatter), windows(), ALL)
    assert not found.seen
    assert found.part == pytest.approx(-scatter, abs=4.0 * found.sigma)


def test_a_saturated_beam_beside_the_beads_is_no_missing_light() -> None:
    assert not missing_light(images(ceiling=0.3), windows(), ALL).seen


def test_spots_without_light_are_counted() -> None:
    """Those whose bead leaves less than 1.2 % of the open beam behind the body."""
    found = missing_light(images(dark=0.012), windows(), ALL)
    assert found.seen
    assert 0.05 < found.dark < 0.5


def test_nothing_is_known_of_few_frames() -> None:
    assert not missing_light(images(dark=0.01), windows(), np.arange(FRAMES) < 3).seen
