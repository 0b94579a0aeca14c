"""Single views on a CUDA device: compiled rays beside NumPy's, and the driver's calls in numba's
simulator.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.cone_vec import MIN_SINE, ConeVec
from flexdt.twin.geometry.virtual_panel import run_through
from flexdt.twin.projection import Volume, gpu
from flexdt.twin.projection.fan_plan import exchanged, lying
from flexdt.twin.projection.kernels.view_kernels import UNFIT, prepare
from flexdt.twin.projection.operators import as_cone_vec, box_of, corners_of, voxel_rays
from flexdt.twin.projection.single_view import SingleViews
from tests.support.device_simulator import run_simulated

sys.path.insert(0, str(Path(__file__).parents[2] / "studies"))
from gpu_geometries import drawn

RISE = 0.25
CASES, SEED, MOST_VOXELS = 240, 60, 12


def test_rays_and_walk_of_a_view_are_those_of_numpy(monkeypatch) -> None:
    monkeypatch.setattr(gpu, "upload", lambda flat: flat)
    kinds, unfit = set(), 0
    for case in drawn(range(CASES), SEED, MOST_VOXELS):
        volume = Volume(case.data, tuple(case.voxel_mm), tuple(case.center_mm))
        box, table = box_of(volume.layout), np.full((1, 13), np.nan)
        views = SingleViews(volume, box)
        inside = case.rows.copy()
        inside[:, :3] = case.center_mm
        inside[:, 6:] *= 0.1
        for row in [*case.rows, *exchanged(case.rows), *inside]:
            scan = ConeVec(row[None])
            kind = prepare(
                scan.rows[0],
                views.frame,
                *case.shape,
                MIN_SINE,
                views.clearance,
                RISE,
                table,
            )
            if run_through(scan, corners_of(volume)) is not scan:
                assert kind == UNFIT
                unfit += 1
                continue
            right = voxel_rays(scan, volume.layout, case.shape)
            on_side = lying(right, case.shape)[0]
            rays = exchanged(right) if on_side else right
            upright = (rays[0, 9:11] == 0).all() and gpu.rises(right, case.shape)[
                0
            ] <= RISE
            slabs = gpu.by_slabs(box, right, case.shape)[0]
            assert np.array_equal(table[0], [*rays[0], 0.0])
            assert kind == gpu.WALK_KINDS * on_side + slabs + (slabs & upright), case.kind
            kinds.add(kind)
    assert kinds == set(range(2 * gpu.WALK_KINDS))
    assert unfit > CASES / 20


@pytest.mark.parametrize(("u", "v", "source"), [
    ((1, 0, 0), (2, 0, 0), (0, -9, 0)),
    ((0, 0, 0), (0, 0, -1), (0, -9, 0)),
    ((1, 0, 0), (0, 0, -1), (3, 9, 0)),
])  # fmt: skip
def test_views_whose_pixels_have_no_rays_are_left_to_the_sentence(u, v, source) -> None:
    volume = Volume(np.ones((2, 2, 2), np.float32), 1.0)
    frame = np.array([[-1, -1, -1], [1, 1, 1], [0, 0, 0], [1, 1, 1], [2, 2, 2]], float)
    scan = ConeVec.from_vectors(source, (0, 9, 0), u, v)
    table = np.zeros((1, 13))
    assert prepare(scan.rows[0], frame, 4, 4, MIN_SINE, 1e-9, RISE, table) == UNFIT
    with pytest.raises(GeometryError):
        as_cone_vec(scan)
    assert volume.layout.counts == (2, 2, 2)


SINGLE = """
import logging
import numpy as np
from driver_stand_in import stand_in
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import Volume, forward, gpu, single_view
from flexdt.twin.projection.kernels import gpu_kernels
from gpu_geometries import drawn

said = []
class Keep(logging.Handler):
    def emit(self, record):
        if record.name == "flexdt":
            said.append(record.getMessage())
logging.getLogger("flexdt").addHandler(Keep())
gpu_kernels.BLOCK, gpu.VIEWS_A_THREAD = (4, 2), 0.0
gpu_kernels.LANES_MEET = False
FOUR = ["to the device", "launch", "to the host", "wait"]

def usual(volume, scan, shape):
    "The view as every view is projected."
    return forward(volume, ConeVec(np.repeat(scan.rows, 2, axis=0)), shape)[:1]

# Without the driver's functions, or the kernels' names, all is as ever.
case = next(drawn(range(60, 61), 1, 5))
volume = Volume(case.data, tuple(case.voxel_mm), tuple(case.center_mm))
scan = ConeVec(case.rows[:1])
for _ in range(3):
    assert np.array_equal(forward(volume, scan, case.shape), usual(volume, scan, case.shape))
assert not volume.layout.device_copy.single_views.usable

driver = stand_in()
taken = set()
for case in drawn(range(12), 1, 5):
    volume = Volume(case.data, tuple(case.voxel_mm), tuple(case.center_mm))
    for row in case.rows:
        scan = ConeVec(row[None])
        right = usual(volume, scan, case.shape)
        forward(volume, scan, case.shape)
        driver.calls.clear()
        out = np.full_like(right, np.nan)
        assert forward(volume, scan, case.shape, out) is out
        assert np.array_equal(out, right), case.kind
        assert driver.calls in ([], FOUR), driver.calls
        if driver.calls:
            taken.add(case.kind)
assert {"level", "rolled", "far"} <= taken, taken
assert len(volume.layout.device_copy.single_views.spare) == 1

# Without room, or with memory for another shape, a view is right all the same.
volume = Volume(case.data, tuple(case.voxel_mm), tuple(case.center_mm))
usual(volume, scan, case.shape)
gpu.free_bytes = lambda: gpu.SPARE_BYTES
assert forward(volume, scan, case.shape).max() > 0
assert volume.layout.device_copy.single_views.spare == []
gpu.free_bytes = lambda: None
for shape in (case.shape, (3, 4), case.shape):
    driver.calls.clear()
    assert np.array_equal(forward(volume, scan, shape), usual(volume, scan, shape))
    assert driver.calls == FOUR, (shape, driver.calls)

# A call while another is under way has memory of its own.
inner = []
def call_again(image):
    driver.spoils = lambda image: None
    inner.append(forward(volume, scan, case.shape))
driver.spoils = call_again
assert np.array_equal(forward(volume, scan, case.shape), right)
assert np.array_equal(inner[0], right)
assert len(volume.layout.device_copy.single_views.spare) == 2

# A driver that gives an error gives the device up, in one line; the processor computes.
for name in FOUR:
    gpu._failed.clear(), said.clear()
    driver.fails = lambda call: "CUDA_ERROR_UNKNOWN" if call == name else 0
    found = forward(volume, scan, case.shape)
    assert np.abs(found - right).max() < 1e-5 * right.max()
    assert not gpu.availability().present and len(said) == 1, said
    assert "CUDA_ERROR_UNKNOWN" in said[0], said
    driver.fails = lambda call: 0

# One that gives other bytes is not used from its first image on.
gpu._failed.clear(), said.clear(), single_view._proved.clear()
driver.spoils = lambda image: image.__iadd__(np.float32(1e-3))
volume = Volume(case.data, tuple(case.voxel_mm), tuple(case.center_mm))
for _ in range(3):
    assert np.array_equal(usual(volume, scan, case.shape), right)
    assert np.array_equal(forward(volume, scan, case.shape), right)
assert len(said) == 1 and "another image" in said[0], said
"""


@pytest.mark.slow
def test_single_views_by_the_driver_are_those_of_numba(monkeypatch) -> None:
    root = Path(__file__).parents[2]
    monkeypatch.setenv("PYTHONPATH", f"{root / 'support'}:{root / 'studies'}")
    run_simulated(SINGLE)
