"""Images without noise in which opposite rays meet the object nowhere: no axis is told.

A pin on the axis looks the same from everywhere. The rays that two views share are some ten
columns apart, so that those of an even number of views pass it, but for the one that sees the
same from both ends about any axis.
"""

from __future__ import annotations

import numpy as np
import pytest

import flexdt as fx

SOD, SDD = 700.0, 1000.0


def pin_on_axis(columns: int, views: int, axis_px: float, radius_px: float) -> fx.DataSet:
    """Return one row of a pin on the axis, as means of five rays a pixel; lengths in pixels."""
    column = np.arange(columns)[:, None] + (np.arange(5) - 2) / 5
    from_axis = column - axis_px
    distance = np.abs(from_axis) * SDD / np.hypot(from_axis, SDD)
    chord = 2 * np.sqrt(np.maximum(radius_px**2 - distance**2, 0)).mean(axis=1)
    images = np.tile(0.5 * chord.astype(np.float32), (views, 1, 1))
    geometry = fx.ConeVec.circular(
        sod=SOD,
        sdd=SDD,
        angles=np.arange(views) * 360 / views,
        shape=(1, columns),
        pixel=1.0,
    )
    return fx.DataSet.from_arrays(images, geometry)


@pytest.mark.parametrize(
    ("columns", "views", "axis_px", "radius_px"),
    [(109, 212, 56.7, 1.23), (75, 162, 38.5, 1.23), (129, 180, 64.0, 0.5)],
)
def test_rounding_tells_no_axis(
    columns: int, views: int, axis_px: float, radius_px: float
) -> None:
    found = pin_on_axis(columns, views, axis_px, radius_px).align()
    assert not found.identifiable


def test_one_bright_column_in_all_views_is_refused_in_a_sentence() -> None:
    images = np.zeros((181, 1, 129), np.float32)
    images[:, 0, 64] = 1
    geometry = fx.ConeVec.circular(
        sod=SOD, sdd=SDD, angles=np.linspace(0, 360, 181), shape=(1, 129), pixel=1.0
    )
    found = fx.DataSet.from_arrays(images, geometry).align()
    assert not found.identifiable
