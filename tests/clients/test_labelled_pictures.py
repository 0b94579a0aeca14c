"""The scale bar of a picture is as long as its number says; every offset has its meaning."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flexdt.library.datasets.labelled_pictures import FOOT_ROWS, HEAD_ROWS, labelled
from flexdt.twin.geometry.offsets import MEANINGS, NAMES


@pytest.mark.parametrize("seed", range(8))
def test_the_bar_is_a_round_length_and_the_image_stays(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows, cols = rng.integers(60, 500, 2)
    grey = rng.integers(0, 256, (rows, cols), dtype=np.uint8)
    mm_per_pixel = float(10 ** rng.uniform(-3, 2))
    drawn = labelled(grey, "title", mm_per_pixel)
    np.testing.assert_array_equal(drawn[HEAD_ROWS:-FOOT_ROWS], grey)
    ink = drawn[-FOOT_ROWS:] == 0
    bar_mm = max(np.diff(np.flatnonzero(np.diff([0, *row, 0])))[::2].max(initial=0)
                 for row in ink.astype(int)) * mm_per_pixel  # fmt: skip
    first = bar_mm / 10 ** math.floor(math.log10(bar_mm * 1.1))
    nearest = min((1.0, 2.0, 5.0), key=lambda step: abs(first - step))
    assert bar_mm == pytest.approx(
        nearest * 10 ** math.floor(math.log10(bar_mm * 1.1)), abs=0.51 * mm_per_pixel
    )
    assert (drawn[:HEAD_ROWS] < 100).any()


def test_every_offset_has_a_meaning_of_its_own() -> None:
    assert tuple(MEANINGS) == NAMES
    assert len(set(MEANINGS.values())) == len(NAMES)
