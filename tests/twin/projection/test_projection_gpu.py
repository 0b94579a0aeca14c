"""The CUDA backend: on a device where there is one, in numba's simulator everywhere."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from flexdt.twin.errors import NotBuiltError
from flexdt.twin.projection import Volume, back, forward, gpu
from flexdt.twin.projection.cpu import project, spread
from flexdt.twin.projection.operators import box_of, voxel_rays
from flexdt.twin.projection.volume import blank_layout
from tests.support.device_simulator import run_simulated

FOUND = gpu.availability()
needs_gpu = pytest.mark.skipif(
    not FOUND.present, reason=f"no CUDA device: {FOUND.reason}"
)

SIMULATED = """
import numpy as np
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import (Volume, back, cpu, forward, gpu, room_like)
from flexdt.twin.projection import operators
from flexdt.twin.projection.kernels import gpu_kernels
from flexdt.twin.projection.operators import box_of, layout_data, voxel_rays
from flexdt.twin.projection.volume import blank_layout

assert gpu.availability().present, gpu.availability().reason
operators.level_axes = lambda rays, *_: np.zeros(len(rays), int)
gpu.CHUNK_BYTES = 1  # one view at a time
gpu_kernels.BLOCK = (4, 2)
gpu.VIEWS_A_THREAD = 0.0
data = np.random.default_rng(0).random((5, 6, 7), dtype=np.float32)
data[:, :, 0] = 0
volume = Volume(data, (0.1, 0.2, 0.15), (0.01, 0.02, 0.03))
sources = [[1, -9, 0.2], [0.5, -9, -0.2], [0.013, 0.021, 0.017], [0.03, 0.02, 9]]
centres = [[0, 5, 0], [0, 5, 0], [0, 5, 0], [0, 0, -9]]
steps = [[0.2, 0.01, 0]] * 3 + [[0.1, 0.01, 0]], [[0.01, 0, -0.2]] * 3 + [[0, 0.1, 0.01]]
geometry = ConeVec.from_vectors(sources, centres, *steps)
images = forward(volume, geometry, (7, 8))
exact = np.empty_like(images)
cpu.project(box_of(volume.layout), voxel_rays(geometry, volume.layout, (7, 8)), exact)
assert (exact > 0).any(axis=(1, 2)).all()
assert np.abs(images - exact).max() < 1e-5 * exact.max()
y = np.random.default_rng(1).random(images.shape, dtype=np.float32)
left = np.vdot(images, y)
right = np.vdot(back(y, geometry, volume).data, data)
assert abs(left - right) < 1e-5 * left, (left, right)

# A device without room for the volume is left alone: the processor's very numbers.
gpu.free_bytes = lambda: gpu.SPARE_BYTES + volume.layout.flat.nbytes + 7 * 8 * 4
assert np.array_equal(forward(volume, geometry, (7, 8)), images)
fits = back(y, geometry, volume).data
gpu.free_bytes = lambda: gpu.SPARE_BYTES + 4
assert volume.layout.device_copy.there is not None  # but there is no room for images
assert np.array_equal(forward(volume, geometry, (7, 8)), exact)
stays = Volume(data, (0.1, 0.2, 0.15), (0.01, 0.02, 0.03))
assert np.array_equal(forward(stays, geometry, (7, 8)), exact)
assert stays.layout.device_copy.there is None
out = room_like(volume)
out[...] = 7
layout = blank_layout(volume)
cpu.spread(box_of(layout), voxel_rays(geometry, layout, (7, 8)), y)
assert np.array_equal(back(y, geometry, volume).data, layout_data(layout))
assert np.array_equal(back(y, geometry, volume, out).data, layout_data(layout))
gpu.free_bytes = lambda: None
assert np.array_equal(back(y, geometry, volume).data, fits)
"""


@pytest.mark.slow
def test_host_logic_and_kernels_in_the_simulator() -> None:
    run_simulated(SIMULATED)


DRAWN = """
import numpy as np
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import (Volume, back, cpu, forward, gpu)
from flexdt.twin.projection import operators
from flexdt.twin.projection.operators import box_of, voxel_rays
from flexdt.twin.projection.kernels import gpu_kernels
from tests.twin.projection.conftest import _circle, _siddon

gpu_kernels.BLOCK = (4, 2)  # a thread of the simulator costs more than what it computes
gpu.VIEWS_A_THREAD = 0.0
operators.level_axes = lambda rays, *_: np.zeros(len(rays), int)  # fans along z, as in scans
rng = np.random.default_rng(20261122)
walked = []

def processor(function, *arguments):
    real, gpu.availability = gpu.availability, lambda: gpu.Availability(False, "switched off")
    try:
        return function(*arguments)
    finally:
        gpu.availability = real

def side(volume, geometry, shape):
    return gpu.by_slabs(box_of(volume.layout), voxel_rays(geometry, volume.layout, shape), shape)

# Chiral volumes off the centre, level, tilted, lying and steep panels at any angle, a source in the
# box: exact lengths by an implementation that shares nothing with the kernels.
for roll, height in ((0.0, 0.0), (0.0, 12.0), (0.03, 4.0), (1.6, -6.0), (0.8, 0.0), (0.2, 60.0)):
    counts = rng.integers(4, 12, 3) * rng.permutation([1, 1, 4])
    voxel, center = rng.uniform(0.3, 0.6, 3), rng.uniform(-0.5, 0.5, 3)
    data = rng.random(counts, dtype=np.float32)
    data[counts[0] // 2 :, : counts[1] // 2] *= 3
    volume = Volume(data, tuple(voxel), tuple(center))
    tilts = rng.uniform(-0.3, 0.3, 2) * (roll > 0)
    start = rng.uniform(0, 6)
    tilt = {"roll": roll, "pitch_tilt": tilts[0], "yaw": tilts[1]}
    geometry = _circle(3, 60.0, 100.0, 2.2, start=start, height=height, **tilt)
    shape = (int(rng.integers(9, 15)), int(rng.integers(5, 9)))
    if height == 12.0:
        source = np.array(geometry.source)
        source[1] = center
        geometry = ConeVec.from_vectors(source, geometry.detector, geometry.u, geometry.v)
    walked.extend(side(volume, geometry, shape))
    images = forward(volume, geometry, shape)
    exact = _siddon(data, voxel, center, geometry, shape)
    error = np.abs(images - exact) / exact.max()
    assert (exact > 0).mean() > 0.2, (roll, height)
    assert error.mean() < 3e-7 and error.max() < 3e-6, (roll, height, error.mean(), error.max())
    y = rng.random(images.shape, dtype=np.float32)
    spread = back(y, geometry, volume)
    right = processor(back, y, geometry, volume)
    assert np.abs(spread.data - right.data).max() < 3e-6 * right.data.max(), (roll, height)
    left = np.vdot(images.astype(float), y)
    assert abs(left - np.vdot(spread.data.astype(float), data)) < 3e-6 * left
assert 8 <= sum(walked) < len(walked), walked

# Equal bytes in whatever order rays add.
many, geometry = rng.random((9, *shape), dtype=np.float32), geometry[[0, 1, 2] * 3]
order = rng.permutation(9)
same = back(many, geometry, volume, deterministic=True).data
again = back(many[order], geometry[order], volume, deterministic=True).data
assert np.array_equal(again, same)
spread, again = back(many, geometry, volume).data, back(many[order], geometry[order], volume).data
assert not np.array_equal(again, spread)
assert np.abs(same - spread).max() < 3e-6 * same.max()

# Rays in voxel planes: rows of a panel turned by 45 degrees three times, heights that differ from
# the plane by 1e-17, up and down, and columns exactly in a plane: the processor's side of it.
# (For columns 1e-17 beside a plane the processor has no side that one could name.)
data = rng.random((6, 4, 4), dtype=np.float32)
volume = Volume(data, 1.0)
inside = 0
quarter = np.pi / 4
turned = _circle(2, 60.0, 100.0, 0.3, roll=quarter, pitch_tilt=quarter, yaw=quarter, start=0.3)
cases = [(turned, (18, 14)), (_circle(1, 60.0, 100.0, 0.5), (7, 7))]
for up in (1e-17, -1e-17, 1e-13, -1e-13):
    for x in (0.0, 0.3):
        view = ConeVec.from_vectors((x, -50, 0), (x, 50, 0), (0.4, 0, up), (0, 0, -0.4))
        cases.append((view, (1, 6)))
for aside in (0.0, 1e-5, -1e-5):
    view = ConeVec.from_vectors((0, -50, 0.1), (0, 50, 0.1), (0.4, 0, 0), (aside, 0, -0.4))
    cases.append((view, (6, 1)))
for geometry, shape in cases:
    assert side(volume, geometry, shape).all()
    images, right = forward(volume, geometry, shape), processor(forward, volume, geometry, shape)
    assert np.abs(images - right).max() < 3e-6 * right.max(), (shape, geometry, images - right)
    rows = geometry.rays(shape)
    c, r = np.meshgrid(np.arange(shape[1]), np.arange(shape[0]))
    for g in rows:
        d = g[3:6] + c[..., None] * g[6:9] + r[..., None] * g[9:12]
        inside += int((np.abs(d / np.abs(d).max(axis=2, keepdims=True)) < 1e-11).any(axis=2).sum())
assert inside > 30, inside
"""


@pytest.mark.slow
def test_compiled_kernels_keep_their_budget() -> None:
    if not importlib.util.find_spec("numba_cuda") or not importlib.util.find_spec(
        "nvidia"
    ):
        pytest.skip("numba-cuda or ptxas is not installed: see tests/studies/gpu_code.py")
    study = Path(__file__).parents[2] / "studies" / "gpu_code.py"
    done = subprocess.run(
        [sys.executable, study], capture_output=True, text=True, timeout=900
    )
    if done.returncode == 3:
        pytest.skip(done.stdout)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.campaign
def test_kernels_are_exact_in_the_simulator() -> None:
    run_simulated(DRAWN)


THERE = """
import numpy as np
from numba import cuda
from numba.cuda.simulator.cudadrv.devicearray import FakeCUDAArray
from flexdt.twin.errors import GeometryError, NotBuiltError, TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import Grid, Operator, Volume, back, forward, gpu
from flexdt.twin.projection.kernels import gpu_kernels
from tests.twin.projection.conftest import _circle

gpu_kernels.BLOCK, gpu.LINEAR = (4, 2), 16
gpu.availability()
counted = {"up": [], "down": [], "new": []}

def counting(where, name, kind, size):
    real = getattr(where, name)
    def call(*arguments, **options):
        result = real(*arguments, **options)
        counted[kind].append(size(arguments, result))
        return result
    setattr(where, name, call)

counting(cuda, "to_device", "up", lambda a, result: a[0].nbytes)
counting(cuda, "device_array", "new", lambda a, result: result.nbytes)
counting(FakeCUDAArray, "copy_to_host", "down", lambda a, result: a[0].nbytes)

def moved(work):
    for some in counted.values():
        some.clear()
    result = work()
    return result, {kind: list(some) for kind, some in counted.items()}

data = np.random.default_rng(3).random((5, 4, 6), dtype=np.float32)
data[:, :, 0] = data[0] = 0  # the occupied box is smaller
volume = Volume(data, (0.4, 0.5, 0.6), (0.1, -0.2, 0.3))
geometry, shape = _circle(3, 30.0, 50.0, 1.0, start=0.2), (5, 4)
table, image_bytes, voxel_bytes = 3 * 13 * 8, 3 * 5 * 4 * 4, 4 * ((3 * 6 + 5) * 16 + 5)
there, seen = moved(lambda: volume.to("cuda"))
whole = volume.layout.flat.nbytes
assert seen == {"up": [whole], "down": [], "new": []}, seen
assert there.to("cuda") is there

# A projection of it moves its views to the device and nothing else, whatever the volume's size.
images, seen = moved(lambda: forward(there, geometry, shape))
assert seen == {"up": [table], "down": [], "new": [image_bytes]}, seen
right = forward(volume, geometry, shape)
assert right.max() > 0
assert np.abs(images.copy_to_host() - right).max() < 3e-6 * right.max()
spread, seen = moved(lambda: back(images, geometry, volume))
assert seen == {"up": [table], "down": [], "new": [voxel_bytes]}, seen
exact = back(right, geometry, volume).data
found, seen = moved(lambda: spread.to("cpu"))
assert seen["up"] == [] and len(seen["down"]) == 1, seen
assert np.abs(found.data - exact).max() < 3e-6 * exact.max()
assert (found.voxel_xyz, found.center_mm) == (volume.voxel_xyz, volume.center_mm)

# What back gives can be projected: nothing but views moves between two steps of an iteration.
again, seen = moved(lambda: back(forward(spread, geometry, shape), geometry, Grid((5, 4, 6), 0.5)))
assert seen["up"] == [table, table] and seen["down"] == [], seen
other = forward(found, geometry, shape)
assert np.abs(forward(spread, geometry, shape).copy_to_host() - other).max() < 3e-6 * other.max()

# A grid keeps its form: one number for the voxel's edge stays one, three stay three.
for edge in (0.5, (0.5, 0.5, 0.5), (0.4, 0.5, 0.6)):
    one = Volume(data, edge)
    assert one.to("cuda").to("cpu").voxel_mm == one.voxel_mm == edge
    assert back(images, geometry, one).to("cpu").voxel_mm == edge

# Voxels come home as they went, also those outside the occupied box; none at all project to zeros.
assert np.array_equal(there.to("cpu").data, data)
empty = Volume(np.zeros((2, 2, 2)), 1.0).to("cuda")
assert not forward(empty, geometry, shape).copy_to_host().any()

A = Operator(geometry, like=volume, shape=shape)
assert np.array_equal((A @ there).copy_to_host(), images.copy_to_host())
assert np.array_equal((A.T @ images).to("cpu").data, found.data)

# A call with arrays of the host moves each of them once, and no zeros.
gpu.VIEWS_A_THREAD = 0.0
_, seen = moved(lambda: back(right, geometry, volume))
assert sorted(seen["up"]) == sorted([table, image_bytes]), seen
assert seen["down"] == [voxel_bytes], seen

def refused(work, kind=GeometryError):
    try:
        work()
    except kind as error:
        return str(error)
    raise AssertionError("not refused")

assert "host" in refused(lambda: forward(there, geometry, shape, right))
assert "host" in refused(lambda: back(images, geometry, volume, exact))
assert "float32" in refused(lambda: back(cuda.to_device(right.astype(float)), geometry, volume))
assert "grid" in refused(lambda: Operator(geometry, Grid((5, 4, 6), 0.4), shape) @ there)
assert "mps" in refused(lambda: there.to("mps"), NotBuiltError)
gpu_kernels.project_slabs = None
assert "failed" in refused(lambda: forward(there, geometry, shape), TwinError)
assert "failed" in refused(lambda: volume.to("cuda"), NotBuiltError)
"""


MATERIALS = """
import numpy as np
from numba import cuda
from flexdt.phantoms import Phantom
from flexdt.phantoms.channels import channels
from flexdt.phantoms.pieces import Voxels
from flexdt.twin.projection import gpu, project_body
from flexdt.twin.projection.analytic_solids import Scene
from flexdt.twin.projection.kernels import gpu_kernels
from tests.twin.projection.conftest import _circle

gpu_kernels.BLOCK, gpu.VIEWS_A_THREAD = (4, 2), 0.0
assert gpu.availability().present
rng = np.random.default_rng(7)
labels = rng.integers(0, 3, (5, 4, 6)).astype(np.uint8)
voxels = Voxels(np.ones(labels.shape, np.float32) * (labels > 0), (0.5,) * 3,
                labels=labels, materials=("water", "steel"))
parts = channels(Phantom("two", "two materials", Scene(()), (3.0, 2.0, 2.5), voxels=voxels))
scan, uploads, upload = _circle(3, 60.0, 100.0, 1.2, start=0.3), [], gpu.upload
gpu.upload = lambda flat: uploads.append(flat.nbytes) or upload(flat)
paths = [[project_body(part.body, scan, (4, 5)) for part in parts] for _ in range(2)]
assert [part.material.name for part in parts] == ["water", "steel"] and len(uploads) == 2
with gpu.switched_off():
    right = [project_body(part.body, scan, (4, 5)) for part in parts]
for found in paths:
    for a, b in zip(found, right, strict=True):
        assert b.max() > 0 and np.abs(a - b).max() < 3e-6 * b.max()
"""


@pytest.mark.slow
def test_each_material_of_voxels_goes_to_the_device_once() -> None:
    run_simulated(MATERIALS)


@pytest.mark.slow
def test_volumes_on_a_device_stay_there_and_copies_are_counted() -> None:
    run_simulated(THERE)


def test_there_is_no_volume_on_a_device_that_is_not_there() -> None:
    volume = Volume(np.ones((3, 3, 3), np.float32), 1.0)
    with pytest.raises(NotBuiltError, match="mps"):
        volume.to("mps")
    if not FOUND.present:
        with pytest.raises(
            NotBuiltError, match=r"no CUDA driver|numba finds no|does not answer"
        ):
            volume.to("cuda")


FAILING = """
import logging
import numpy as np
from numba import cuda
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import Volume, back, forward, gpu, room_like
from flexdt.twin.projection.kernels import gpu_kernels
from flexdt.twin.reconstruction import Grid, fdk
from flexdt.twin.reconstruction.kernels import gpu_reconstruction_kernels
from tests.support.circular_scans import ball, circle

said = []
class Keep(logging.Handler):
    def emit(self, record):
        if record.name == "flexdt":  # not progress and compilations, which a slow machine is told
            said.append(record.getMessage())
logging.getLogger("flexdt").addHandler(Keep())
gpu.VIEWS_A_THREAD = 0.0
gpu_kernels.BLOCK = gpu_reconstruction_kernels.BLOCK = (4, 2)
gpu_reconstruction_kernels.THREADS = 8

def again(present):
    said.clear(); gpu._failed.clear(); gpu._probe.cache_clear()
    assert gpu.availability().present == present, gpu.availability()

def failing(number, error):
    "A kernel that fails at its n-th launch and later."
    launches = [0]
    class Kernel:
        def __init__(self, kernel): self.kernel = kernel
        def __getitem__(self, configuration):
            launches[0] += 1
            if launches[0] >= number:
                raise error
            return self.kernel[configuration]
    return Kernel

scan, turn = circle(2, pixel=6.0), circle(6, pixel=6.0)
volume = Volume(np.random.default_rng(0).random((2, 3, 4), dtype=np.float32), 4.0)
shape = (2, 4)
NAMES = (
    "project_slabs", "spread_slabs", "project_columns", "spread_columns", "project_rays",
    "spread_rays",
)
right = {name: getattr(gpu_kernels, name) for name in NAMES}
right_fdk = gpu_reconstruction_kernels.backproject

def put(change=lambda kernel: kernel):
    for name in NAMES:
        setattr(gpu_kernels, name, change(right[name]))

def everything():
    fresh = Volume(volume.data, 4.0)
    images = forward(fresh, scan, shape)
    out = room_like(volume)
    out[...] = 7
    adjoint = back(images, scan, volume).data, back(images, scan, volume, out).data
    return [images, *adjoint, fdk(ball(turn, (12, 14)), turn, Grid((2, 2, 2), 4.0)).data]

real, gpu.availability = gpu.availability, lambda: gpu.Availability(False, "switched off")
exact = everything()
gpu.availability = real
assert all(np.abs(e).max() > 0 for e in exact)

# Not even a first ray: as with a compiler that does not fit.
misfit = AttributeError("module 'numpy' has no attribute 'row_stack'")
put(failing(1, misfit))
again(False)
assert "row_stack" in gpu.availability().reason
assert len(said) == 1 and "first ray failed" in said[0], said
assert all(np.array_equal(a, b) for a, b in zip(everything(), exact, strict=True))

# A wrong number counts as a failure.
class Wrong:
    def __getitem__(self, configuration):
        return lambda *arguments: None
put(lambda kernel: Wrong())
again(False)
assert "instead of" in gpu.availability().reason

# Later, at any launch: equal to the processor's from there on, one line, and never asked again.
for number in (5, 7):
    for place in ("projection", "reconstruction"):
        put()
        gpu_reconstruction_kernels.backproject = right_fdk
        again(True)
        if place == "projection":
            put(failing(number - 4, RuntimeError("device lost")))
        else:
            broken = failing(number - 4, RuntimeError("device lost"))
            gpu_reconstruction_kernels.backproject = broken(right_fdk)
        found = everything()
        for a, b in zip(found, exact, strict=True):
            worst = np.abs(a - b).max() / np.abs(b).max()
            assert worst < 1e-5, (number, place, worst)
        assert len(said) <= 1, said
        assert gpu.availability().present == (not said), said
        if said:
            assert "device lost" in gpu.availability().reason
            assert all(np.array_equal(a, b) for a, b in zip(everything(), exact, strict=True))

# Without memory for one call, the device may have it for the next.
gpu_reconstruction_kernels.backproject = right_fdk
put()
again(True)
full = RuntimeError("[2] Call to cuMemAlloc results in CUDA_ERROR_OUT_OF_MEMORY")
put(failing(1, full))
assert np.array_equal(forward(Volume(volume.data, 4.0), scan, shape), exact[0])
assert "lacks memory" in said[0] and gpu.availability().present
"""


@pytest.mark.slow
def test_a_device_that_fails_at_any_time_leaves_it_to_the_processor() -> None:
    run_simulated(FAILING)


ATTACKED = """
import contextlib, logging, sys
import numpy as np
from numba import cuda
from numba.cuda.simulator.cudadrv.devicearray import FakeCUDAArray
from numba.cuda.simulator.kernel import FakeCUDAKernel
from flexdt.twin.errors import TwinError
from flexdt.twin.projection import Volume, back, forward, gpu
from flexdt.twin.projection.kernels import gpu_kernels
from flexdt.twin.reconstruction import Grid, cgls, fdk
from flexdt.twin.reconstruction.kernels import gpu_reconstruction_kernels
from tests.twin.projection.conftest import _circle

said = []
class Keep(logging.Handler):
    def emit(self, record):
        if record.name == "flexdt":  # not progress and compilations, which a slow machine is told
            said.append(record.getMessage())
logging.getLogger("flexdt").addHandler(Keep())
gpu.VIEWS_A_THREAD, gpu.LINEAR = 0.0, 16
gpu_kernels.BLOCK = gpu_reconstruction_kernels.BLOCK = gpu_reconstruction_kernels.PLANE = (4, 2)
gpu_reconstruction_kernels.THREADS = 8
gpu_kernels.FOLDING = (1, 4)
scan, shape = _circle(3, 60.0, 100.0, 1.2, start=0.3), (3, 4)
data = np.random.default_rng(0).random((2, 3, 4), dtype=np.float32)

# Every call of the driver that a job makes has a number; from one on, or at one, it fails.
calls, fails = [], lambda number: None

def attacked(where, name, kind):
    real = getattr(where, name)
    def call(*arguments, **options):
        calls.append(kind)
        error = fails(len(calls))
        if error is not None:
            raise error
        return real(*arguments, **options)
    setattr(where, name, call)

for where, name, kind in (
    (cuda, "is_available", "init"), (cuda, "to_device", "copy"), (cuda, "device_array", "memory"),
    (cuda, "pinned_array", "memory"), (cuda, "stream", "init"), (cuda, "event", "init"),
    (FakeCUDAArray, "copy_to_host", "copy"),
    (FakeCUDAArray, "copy_to_device", "copy"), (FakeCUDAKernel, "__getitem__", "compile"),
    (FakeCUDAKernel, "__call__", "launch"), (type(cuda.gpus), "__len__", "init"),
    (type(cuda.gpus), "__getitem__", "init"),
):
    attacked(where, name, kind)

def job():
    volume = Volume(data, 0.5)
    images = forward(volume, scan, shape)
    adjoint = back(images, scan, volume).data
    slow = cgls(images, scan, volume, iterations=1).data
    return [images, adjoint, fdk(given, scan, Grid((2, 2, 2), 0.5)).data, slow]

def there():
    "What is only on the device: lost with it, by an error of ours."
    with contextlib.suppress(TwinError):
        on_device = Volume(data, 0.5).to("cuda")
        back(forward(on_device, scan, shape), scan, on_device).to("cpu")

with gpu.switched_off():
    # FDK's images: three views of twelve pixels have no one best outline of a truncated object, so
    # that the last bits of an image, which a device rounds otherwise, choose between two of them.
    given = forward(Volume(data, 0.5), scan, shape)
    exact = job()
assert all(np.abs(e).max() > 0 for e in exact)

def same(found):
    return all(np.array_equal(a, b) for a, b in zip(found, exact, strict=True))

def close(found):
    return all(
        np.abs(a - b).max() < 1e-5 * np.abs(b).max() for a, b in zip(found, exact, strict=True)
    )

assert not gpu._failed and close(job()) and not same(job()) and not said
calls.clear(), gpu._probe.cache_clear()
job(), there()
kinds = list(calls)
assert set(kinds) == {"init", "copy", "memory", "compile", "launch"}, set(kinds)
errors = (
    RuntimeError("[999] Call to cuLaunchKernel results in CUDA_ERROR_UNKNOWN"),
    RuntimeError("[719] device lost"),
    AttributeError("module 'numpy' has no attribute 'row_stack'"), OSError("no nvrtc"),
    ImportError("no compiler"), ValueError("cc 3.0"), KeyError("sm_120"), MemoryError(),
    NotImplementedError(),
    RuntimeError("[2] Call to cuMemAlloc results in CUDA_ERROR_OUT_OF_MEMORY"),
)
rng = np.random.default_rng(int(sys.argv[1]))
met = set()
for case in range(int(sys.argv[2])):
    kind = sorted(set(kinds))[case % len(set(kinds))]  # each kind as often as any other
    places = [k for k, some in enumerate(kinds, 1) if some == kind]
    at, error, once = int(rng.choice(places)), errors[rng.integers(len(errors))], rng.random() < 0.3
    case = (case, at, kind, repr(error), once)
    said.clear(), gpu._failed.clear(), gpu._probe.cache_clear(), calls.clear()
    fails = lambda number: error if number == at or (number > at and not once) else None
    found = job()
    assert close(found), case
    there()
    memory = "OUT_OF_MEMORY" in str(error)
    present = gpu.availability().present
    if memory and present:  # it may be asked again, and a line says so each time
        assert said and all("lacks memory" in line for line in said), (case, said)
        if not once:
            assert close(job()), case
    elif said:  # given up for good: one line, its reason, and no call of the driver from then on
        assert len(said) == 1 and not present, (case, said)
        assert str(error) in gpu.availability().reason and str(error) in said[0], (case, said)
        calls.clear()
        assert same(job()) and not calls and len(said) == 1, (case, calls, said)
    else:  # a driver that does not answer at first is no device
        assert not present and kind == "init" and same(found), (case, gpu.availability())
    met.add((kind, present))
assert len(met) > 6, met
"""


@pytest.mark.slow
@pytest.mark.campaign
def test_a_driver_that_fails_at_any_call_in_any_way_leaves_it_to_the_processor() -> None:
    run_simulated(ATTACKED, "20261123", "20")


def test_few_views_of_a_volume_of_the_host_stay_on_the_processor(monkeypatch) -> None:
    monkeypatch.setattr(gpu, "availability", lambda: gpu.Availability(True, "pretended"))
    monkeypatch.setattr(gpu, "free_bytes", lambda: None)
    images = np.zeros((6, 4, 5), np.float32)
    assert not gpu.usable(8, images, threads=16)
    assert gpu.usable(8, np.zeros((7, 4, 5), np.float32), threads=16)
    assert gpu.usable(8, images, threads=2)
    assert gpu.usable(0, images[:1], threads=16), "it is there already"


@pytest.mark.gpu
@needs_gpu
@pytest.mark.parametrize("tilt", [{}, {"roll": 0.1, "pitch_tilt": 0.2, "yaw": -0.3}])
def test_device_agrees_with_the_processor(tilt, circle) -> None:
    data = np.random.default_rng(0).random((120, 100, 90), dtype=np.float32)
    volume = Volume(data, 0.1)
    geometry = circle(7, 60.0, 106.0, 0.15, start=0.1, **tilt)
    shape = (150, 170)
    views = voxel_rays(geometry, volume.layout, shape)
    exact = np.empty((7, *shape), np.float32)
    project(box_of(volume.layout), views, exact)
    images = forward(volume, geometry, shape)
    assert np.abs(images - exact).max() < 1e-4 * exact.max()
    layout = blank_layout(volume)
    spread(box_of(layout), voxel_rays(geometry, layout, shape), exact)
    result = back(exact, geometry, volume).layout.flat
    assert np.abs(result - layout.flat).max() < 1e-4 * layout.flat.max()
