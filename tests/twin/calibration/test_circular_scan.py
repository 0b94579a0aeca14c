"""The axis of a circular scan in the rows of its panel, from points of it alone."""

from __future__ import annotations

import numpy as np
import pytest

from flexdt.twin.calibration.without_phantom.circular_scan import CircularScan
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses

SHAPE = (120, 160)


@pytest.mark.parametrize("row", [None, 59.5, 10.0, 100.0])
@pytest.mark.parametrize("roll_deg", [0.0, 1.0, -2.5])
def test_the_axis_is_where_points_of_it_are_projected(
    row: float | None, roll_deg: float
) -> None:
    poses = Poses.upright(
        [0, 0, 0], [0, 420, 0], [0, 1000, 0], 0.3, np.radians(np.arange(0.0, 360.0, 10.0))
    )
    scan = CircularScan.of(
        lambda frame: np.zeros(SHAPE), poses, tuple(range(36)), SHAPE, Offsets(), {}
    )
    values = np.array([0.7, np.radians(roll_deg)])
    turned = Offsets(dO_x=0.7, det_roll=np.radians(roll_deg))
    ends = (
        poses[np.array([0])]
        .cone_vec(turned)
        .project_points([[0.0, 0.0, 3.0], [0.0, 0.0, -3.0]], SHAPE)[0]
    )
    (x0, y0), (x1, y1) = ends
    at = 59.5 if row is None else row
    expected = x0 + (at - y0) * (x1 - x0) / (y1 - y0)
    assert scan.column(values, row) == pytest.approx(expected, abs=1e-6)
