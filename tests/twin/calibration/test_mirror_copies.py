"""How symmetric the mean of few views is, the scan's own copies say.

Scans are those of tests/studies/natural_objects.py, whose renderer shares nothing with
what is tested.
"""

from __future__ import annotations

from typing import Any

import natural_objects
import numpy as np
import pytest

from flexdt.library.data_set import DataSet


def few_views(kind: str, seed: int) -> tuple[natural_objects.Scan, DataSet]:
    """Draw a scan of 24 to 31 views, and what happened to none of it."""
    place = list(natural_objects.OBJECTS).index(kind)
    rng = np.random.default_rng([place, seed, 77])
    scan = natural_objects.drawn(kind, rng)
    scan.views = int(rng.integers(24, 32))
    return scan, scan.data(rng)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        ("wires", 4),
        pytest.param("wires", 10, marks=pytest.mark.campaign(1)),
        pytest.param("board", 8, marks=pytest.mark.campaign(1)),
    ],
)
def test_the_mean_of_few_views_is_as_symmetric_as_its_copies(
    kind: str, seed: int
) -> None:
    """24 views of wires leave 14 % of the mean beyond noise, where 5 % are allowed."""
    scan, data = few_views(kind, seed)
    found = data.align()
    assert found.identifiable, found.alignment.refused
    told: Any = found.parameters["axis_column_px"]
    assert abs(told["value"] - scan.column()) < 4 * told["sigma"]


@pytest.mark.slow
def test_what_does_not_turn_is_in_no_copy() -> None:
    """A strip that stands still darkens a few columns of every frame by 5 %."""
    _, data = few_views("wires", 6)
    counts = np.stack([data.counts(i) for i in data.present])
    cols = counts.shape[2]
    light = np.where(np.abs(np.arange(cols) / cols - 0.33) < 0.03, 0.95, 1.0)
    darkened = (counts * light).astype(np.uint16)
    spoilt = DataSet.from_arrays(darkened, data.cone_vec, dark=data.dark, flat=data.flat)
    found = spoilt.align()
    assert not found.identifiable
    assert "is not symmetric" in found.alignment.refused["axis_column_px"]
