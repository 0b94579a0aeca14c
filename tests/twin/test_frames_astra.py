"""ASTRA's own cone geometry (pure Python there, no GPU) against ours. Its v points upwards."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexdt.twin.machine.camera import CameraSettings, Roi
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.machine.kinematics import poses

astra = pytest.importorskip(
    "astra", reason="astra-toolbox is an optional peer", exc_type=ImportError
)


def test_rows_equal_astra_geom_2vec_with_v_negated() -> None:
    m = builtin_machine()
    camera = CameraSettings("HW2SW1High", Roi(0, 0, 1943, 1535))
    angles_deg = np.array([0.0, 30.0, 90.0, 200.0, -45.0])
    p = poses(
        m,
        builtin_profile("thesis"),
        camera,
        {
            "tra_tube": 0.0, "ver_tube": 20.0, "tra_det": 0.0, "ver_det": 20.0, "tra_obj": 0.0,
            "mag_obj": 600.0, "mag_det": 1059.0, "rot_obj": angles_deg,
        },
    )  # fmt: skip
    rows, cols = camera.shape
    geometry = astra.create_proj_geom(
        "cone",
        0.1496,
        0.1496,
        rows,
        cols,
        [math.radians(a) for a in angles_deg],
        600.0,
        459.0,
    )
    expected = np.array(astra.geom_2vec(geometry)["Vectors"])
    expected[:, 9:12] *= -1
    assert_allclose(p.cone_vec().rows, expected, atol=1e-9)
