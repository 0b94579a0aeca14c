"""Drawn scans: errors of pixels are subtracted, and a volume without them stays as it is."""

from __future__ import annotations

import numpy as np
import pytest
import ring_scans


@pytest.mark.slow
@pytest.mark.campaign
def test_the_study_of_rings_in_its_short_form() -> None:
    found = [
        one
        for number in range(40)
        if (one := ring_scans.judged(5901, number)) is not None
    ]
    assert len(found) > 8
    assert not [one for one in found if one.worse]
    strong = [one.removed for one in found if one.ringed > 1.1]
    assert np.median(strong) > 0.3
