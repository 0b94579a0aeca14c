"""Rows that go on far beyond the panel: filtered in two parts as whole rows in space."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from circular_scans import circle

from flexdt.twin.projection import Grid, as_volume
from flexdt.twin.reconstruction.acquisition.truncation import Prism, Truncation
from flexdt.twin.reconstruction.feldkamp.backprojection import fill_columns
from flexdt.twin.reconstruction.feldkamp.far_prisms import NearColumns
from flexdt.twin.reconstruction.feldkamp.fdk_plan import plan_fdk
from flexdt.twin.reconstruction.feldkamp.fdk_views import Views

MOST_ERROR = 2e-6
"""Of the largest value: transforms of single precision, of up to 600 columns."""


def drawn(seed: int) -> Views:
    """Draw views of a panel, moved to one side for odd seeds, of an object far wider than it,
    and bands of rows of which one has no prism.
    """
    rng = np.random.default_rng(seed)
    shape = int(rng.integers(9, 20)), int(rng.integers(60, 120))
    scan = circle(6, pixel=0.5, aside=float(rng.uniform(2.0, 8.0)) * (seed % 2))
    prisms = [
        Prism(rng.uniform(-3, 3, 2), np.diag(1 / rng.uniform(25, 60, 2)), 0.02)
        for _ in "abc"
    ]
    ends = np.linspace(1.0, shape[0] - 2.0, 4)
    on = (*prisms, None)
    outline = Truncation(
        ends, tuple(rng.permutation(np.array(on, object))), np.ones(4, bool)
    )
    grid = as_volume(Grid((4, 8, 8), 0.5))
    plan = plan_fdk(scan, shape, grid, truncation=replace(outline, beyond=bool(seed % 2)))
    return plan.views_of(rng.random((6, *shape), dtype=np.float32), 0)


def filtered_in_space(views: Views, pitch: float) -> np.ndarray:
    """Convolve all of each row with the ramp filter's taps in double precision, (n, rows,
    columns that are kept).
    """
    n, wide, _, rows = views.sizes
    lines = np.empty((n, rows, wide), np.float32)
    views.widen(lines, weighed=True)
    apart = np.subtract.outer(np.arange(wide), np.arange(wide)[views.kept])
    odd = apart % 2 == 1
    taps = np.where(odd, -1.0 / (np.pi * np.where(odd, apart, 1)) ** 2, 0.0)
    taps[apart == 0] = 0.25
    return lines.astype(float) @ taps / pitch


@pytest.mark.parametrize("seed", range(8))
def test_rows_in_two_parts_are_those_of_the_ramp_in_space(seed) -> None:
    views = drawn(seed)
    n, _, cols, rows = views.sizes
    assert NearColumns.of(views) is not None
    right = filtered_in_space(views, 0.5)
    columns = np.zeros((n, cols, rows), np.float32)
    fill_columns(views, columns)
    error = np.abs(columns.transpose(0, 2, 1) - right).max() / np.abs(right).max()
    assert error < MOST_ERROR
