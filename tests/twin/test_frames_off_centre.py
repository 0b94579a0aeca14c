"""Where pixels lie in the world for regions of interest anywhere on the sensor, and when
binned.

The shipped region of interest is centred in rows, so that it holds no sign of the row shift.
Here each pixel is placed by hand from the sensor's own pixels: neither the shift nor u and v
are used.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.machine.camera import CameraSettings, Roi
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.machine.kinematics import poses

MACHINE = builtin_machine()
SENSOR = MACHINE.detector.pixels
FULL_ROI = Roi(0, 0, SENSOR.columns - 1, SENSOR.rows - 1)


@st.composite
def cameras(draw: st.DrawFn) -> CameraSettings:
    binning = draw(st.sampled_from([(1, 1), (2, 1), (3, 1), (4, 1), (2, 2)]))
    size = binning[0] * binning[1]
    left = draw(st.integers(0, SENSOR.columns - size))
    top = draw(st.integers(0, SENSOR.rows - size))
    right = draw(st.integers(left + size - 1, SENSOR.columns - 1))
    bottom = draw(st.integers(top + size - 1, SENSOR.rows - 1))
    return CameraSettings(
        f"HW{binning[0]}SW{binning[1]}High", Roi(left, top, right, bottom)
    )


@settings(max_examples=60, deadline=None)
@given(cameras(), st.floats(-5.0, 5.0), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_a_pixel_lies_where_the_sensor_s_pixels_it_is_made_of_lie(
    camera: CameraSettings, roll_deg: float, across: float, down: float
) -> None:
    profile = builtin_profile("cwi-2022-05-31").model_copy(
        update={"det_roll_deg": roll_deg}
    )
    positions = {"tra_det": 12.5, "ver_det": 60.0, "mag_det": 900.0}
    pose = poses(MACHINE, profile, camera, positions)
    rows, cols = camera.shape
    column, row = round(across * (cols - 1)), round(down * (rows - 1))
    here = (
        pose.detector[0]
        + (column - (cols - 1) / 2) * pose.u[0]
        + (row - (rows - 1) / 2) * pose.v[0]
    )

    b = camera.binning
    # Mean of the unbinned pixels left + b column ... left + b column + b - 1, counted from the
    # sensor's middle; growing columns go to the right (+x), growing rows down (-z).
    right = (
        np.mean(camera.roi.left + b * column + np.arange(b)) - (SENSOR.columns - 1) / 2
    )
    below = np.mean(camera.roi.top + b * row + np.arange(b)) - (SENSOR.rows - 1) / 2
    x, z = right * SENSOR.pitch_mm, -below * SENSOR.pitch_mm
    c, s = math.cos(math.radians(roll_deg)), math.sin(math.radians(roll_deg))
    middle = poses(MACHINE, profile, replace(camera, roi=FULL_ROI, mode="HW1SW1High"),
                   positions).detector[0]  # fmt: skip
    assert middle[1] == 900.0 + profile.c_det
    # Right-handed about +y: z turns towards x.
    expected = middle + [c * x + s * z, 0.0, -s * x + c * z]
    assert_allclose(here, expected, atol=1e-9)


def test_a_region_of_interest_above_the_middle_lies_above_it() -> None:
    """By hand, without any turn: 100 rows up and 40 columns to the left of the middle."""
    camera = MACHINE.detector.camera
    whole = replace(camera, mode="HW1SW1High", roi=FULL_ROI)
    part = replace(whole, roi=Roi(0, 0, SENSOR.columns - 81, SENSOR.rows - 201))
    profile = builtin_profile("thesis")
    a, b = (poses(MACHINE, profile, c, {}).detector[0] for c in (whole, part))
    pitch = SENSOR.pitch_mm
    assert_allclose(b - a, [-40 * pitch, 0.0, 100 * pitch], atol=1e-12)


@pytest.mark.parametrize("factor", [1, 2, 3, 4])
@pytest.mark.parametrize("shape", [(8, 12), (7, 11), (9, 10), (11, 13)])
def test_a_binned_pixel_is_the_mean_of_its_fine_ones(
    factor: int, shape: tuple[int, int]
) -> None:
    rng = np.random.default_rng(factor + 100 * shape[0] + shape[1])
    fine = ConeVec(rng.normal(size=(3, 12)))
    rows, cols = shape[0] // factor, shape[1] // factor
    centres = fine.pixel_centers(shape)[:, : rows * factor, : cols * factor]
    mean = centres.reshape(3, rows, factor, cols, factor, 3).mean(axis=(2, 4))
    coarse = fine.binned(factor, shape)
    assert fine.with_shape(shape).binned(factor).shape == (3, rows, cols)
    assert_allclose(coarse.pixel_centers((rows, cols)), mean, atol=1e-12)
    assert_allclose(coarse.u, factor * fine.u)
    assert_allclose(coarse.v, factor * fine.v)
    assert np.array_equal(coarse.source, fine.source)


def test_pixel_centres_are_detector_plus_steps_written_out() -> None:
    cone = ConeVec([[0, -5, 0, 1, 2, 3, 0.5, 0, 0.1, 0, 0.25, -1]])
    centres = cone.pixel_centers((3, 4))
    assert_allclose(centres[0, 0, 0], [1 - 1.5 * 0.5, 2 - 0.25, 3 - 0.15 + 1])
    assert_allclose(centres[0, 2, 3], [1 + 1.5 * 0.5, 2 + 0.25, 3 + 0.15 - 1])
    assert_allclose(cone.rays((3, 4))[0, 3:6], centres[0, 0, 0] - [0, -5, 0])
