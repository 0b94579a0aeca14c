"""FDK and iterative methods on a CUDA device: in numba's simulator, and on a device if at
hand."""

from __future__ import annotations

import numpy as np
import pytest
from circular_scans import ball, circle, measure

from flexdt.twin.projection import gpu
from flexdt.twin.reconstruction import Grid, fdk
from flexdt.twin.reconstruction.feldkamp.backprojection import device_takes
from tests.support.device_simulator import run_simulated

FOUND = gpu.availability()

SIMULATED = """
import numpy as np
from flexdt.twin.projection import gpu
from flexdt.twin.reconstruction import Grid, fdk
from flexdt.twin.reconstruction.feldkamp.backprojection import device_takes
from flexdt.twin.reconstruction.feldkamp.fdk import fdk_parts
from flexdt.twin.reconstruction.acquisition.truncation import Prism, Truncation
from flexdt.twin.reconstruction.kernels import gpu_reconstruction_kernels
from tests.support.circular_scans import ball, circle

gpu_reconstruction_kernels.THREADS = 8
assert gpu.availability().present
WIDER = Truncation(np.zeros(1), (Prism(np.zeros(2), np.eye(2) / 30, 0.01),), np.ones(1, bool))
rng = np.random.default_rng(20261122)
# Whole turns and short ones, displaced and tilted panels, rows and columns of any number; grids
# that leave the panel above and below, and of more layers than a block of the kernel has.
for case in range(4):
    tilt, aside = rng.choice([0.0, 0.02]), rng.choice([0.0, 10.0, 20.0])
    turn = 360.0 if aside else rng.choice([360.0, 250.0])
    shape = (int(rng.integers(9, 14)), int(rng.integers(11, 18)))
    scan = circle(int(rng.integers(4, 7)), turn, pixel=6.0, tilt=tilt, aside=aside)
    layers = 300 if case == 0 else int(rng.integers(10, 40))
    like = Grid((layers, 3, 4), 0.7, tuple(rng.uniform(-3, 3, 3))).blank()
    assert device_takes(like, shape)
    window = str(rng.choice(["ram-lak", "hann", "cosine"]))
    images = ball(scan, shape) + rng.random((len(scan), *shape), dtype=np.float32)

    def parts():  # the buffers grow and serve smaller parts, too
        yield images[:1]
        yield images[1:3]
        yield images[3:]

    def volume():
        # The last one's rows go on beyond the panel's edges, by half a row and as long as a prism.
        return fdk_parts(
            parts, scan, shape, like, window, truncation=WIDER if case == 3 else None, errors=True
        )

    def made():
        return volume().data

    found = volume()
    there, noise = found.data, found.sigma
    if case == 1:  # a device that has room for a few layers at a time: the same, but for rounding
        least = 4 * (6 * 32 * shape[0] * shape[1] + 5 * 3 * 4)
        gpu.free_bytes = lambda: gpu.SPARE_BYTES + least
        assert not device_takes(like, shape)
        told = []
        by_slabs = fdk_parts(parts, scan, shape, like, window, told.append, errors=True)
        slabs = by_slabs.data
        assert by_slabs.sigma.shape == slabs.shape
        assert (np.isnan(by_slabs.sigma) == np.isnan(slabs)).all()
        assert np.nanmax(np.abs(slabs - there)) < 1e-6 * np.nanmax(np.abs(there))
        assert len(told) >= 2 * 3 and told[-1] == 1.0
        assert told == sorted(told)
        gpu.free_bytes = lambda: None
    with gpu.switched_off():
        assert not device_takes(like, shape)
        found = volume()
        here = found.data
        # The difference of two sums there, one sum of differences here.
        rounding = 1e-4 * np.nanmax(found.sigma)
        np.testing.assert_allclose(noise, found.sigma, rtol=1e-3, atol=rounding)
    seen = ~np.isnan(here)  # voxels that few views see, above or below the panel, are NaN
    assert seen.mean() > 0.05 and (not seen.all() or case > 0), case
    assert (seen == ~np.isnan(there)).all(), case
    worst = np.abs(here - there)[seen].max() / np.abs(here[seen]).max()
    assert worst < 3e-6, (case, worst)
"""

BY_SLABS = """
import numpy as np
from flexdt.twin.projection import gpu
from flexdt.twin.reconstruction import Grid, fdk
from flexdt.twin.reconstruction.kernels import gpu_reconstruction_kernels
from flexdt.twin.reconstruction.feldkamp.backprojection import OnDevice
from tests.support.circular_scans import ball, circle

gpu_reconstruction_kernels.BLOCK = gpu_reconstruction_kernels.PLANE = (4, 2)
gpu_reconstruction_kernels.THREADS = 8
assert gpu.availability().present
gpu.LINEAR, shape = 16, (9, 11)
real, made = OnDevice.__init__, []
def counted(self, like):
    made.append(like.shape[0])
    real(self, like)
OnDevice.__init__ = counted
scan, like = circle(5, 360.0, pixel=6.0, aside=10.0), Grid((7, 2, 3), 2.0, (0.4, -0.3, 0.7))
images = ball(scan, shape) + np.random.default_rng(4).random((5, *shape), dtype=np.float32)
with gpu.switched_off():
    right = fdk(images, scan, like, errors=False).data
for room in (None, 4 * (6 * 32 * 9 * 11 + 4 * 2 * 3)):  # for all, and for four layers
    gpu.free_bytes = lambda: room and room + gpu.SPARE_BYTES
    made.clear()
    found = fdk(images, scan, like, errors=False).data
    assert np.abs(found - right).max() < 3e-6 * np.abs(right).max() and (right != 0).mean() > 0.5
    assert made == ([7] if room is None else [4, 3]), made
"""

ITERATED = """
import numpy as np
from flexdt.twin.errors import GeometryError
from flexdt.twin.projection import (Volume, forward, gpu)
from flexdt.twin.projection import operators
from flexdt.twin.projection.volume import DeviceVolume
from flexdt.twin.projection.device_arrays import DeviceArray
from flexdt.twin.projection.kernels import gpu_kernels
from flexdt.twin.reconstruction import cgls, em, sart, sirt, tv
from tests.twin.projection.conftest import _circle

gpu_kernels.BLOCK, gpu_kernels.FOLDING, gpu.LINEAR = (4, 2), (1, 4), 16
operators.level_axes = lambda rays, *_: np.zeros(len(rays), int)
rng = np.random.default_rng(5)

# Arithmetic, beside numpy's own.
a, b = rng.normal(size=(2, 3, 5, 7)).astype(np.float32)
x, y = DeviceArray.of_images(a), DeviceArray.of_images(b)
two = np.float32(2)
for found, wanted in (
    (x + y, a + b), (x - y, a - b), (x * y, a * b), (two * x, 2 * a), (x - 2, a - 2),
    (np.maximum(x, 0.0), np.maximum(a, 0)), (x.over(y, 0.5), np.where(b > 0.5, a / b, 0)),
    (x.copy(), a), (x[np.array([2, 0])], a[[2, 0]]),
):
    assert np.array_equal(found.images.copy_to_host(), wanted.astype(np.float32))
z = x.copy()
z *= y
assert np.array_equal(z.images.copy_to_host(), a * b) and np.array_equal(
    x.images.copy_to_host(), a
)
assert abs(x.dot(y) - np.vdot(a.astype(float), b)) < 1e-5
assert abs(x.sum() - a.sum(dtype=float)) < 1e-5 and x.max() == a.max()
one = x[np.array([0])]
for wrong in (lambda: x + one, lambda: x + a, lambda: np.sin(x), lambda: 2 - x):
    try:
        wrong()
    except (GeometryError, TypeError):
        continue
    raise AssertionError("taken")

# Methods, beside themselves on the processor.
center = (0.1, -0.2, 0.3)
data = rng.random((4, 3, 5), dtype=np.float32)
volume = Volume(data, (0.5, 0.4, 0.6), center)
start = volume.like(rng.random((4, 3, 5), dtype=np.float32))
scan = _circle(4, 60.0, 100.0, 1.2, start=0.3, height=0.0)
with gpu.switched_off():
    images = forward(volume, scan, (5, 6))
for method, options in (
    (sirt, {"nonnegative": True, "start": start}), (sart, {"subsets": 2}),
    (sart, {"subsets": 2, "variances": 1e-9 * (0.1 + rng.random(images.shape))}),
    (cgls, {"start": start}), (em, {"start": start}), (tv, {"tolerance": 0, "weight": 0.05}),
    (tv, {"tolerance": 0, "weight": 0.3, "mask": data > 0.3, "nonnegative": False, "subsets": 2}),
):
    steps = []
    def run(given):
        return method(given, scan, volume, iterations=2, watch=steps.append, **options)
    there = run(images)
    with gpu.switched_off():
        here = run(images)
    stays = run(DeviceArray.of_images(images).images)
    assert isinstance(there, Volume) and isinstance(stays, DeviceVolume)
    for found in (there, stays.to("cpu")):
        assert np.abs(found.data - here.data).max() < 3e-6 * np.abs(here.data).max(), method
        assert found.center_mm == center
    residuals = np.array([s.residual for s in steps]).reshape(3, 2)
    assert np.allclose(residuals, residuals[1], rtol=1e-5) and (residuals > 0).all()

# A device that fails in an iteration: the processor's own numbers, and one line of the log.
real = gpu_kernels.fold
class Broken:
    def __getitem__(self, _):
        raise RuntimeError("lost")
gpu_kernels.fold = Broken()
assert np.array_equal(cgls(images, scan, volume, iterations=2).data,
                      cgls(images, scan, volume, iterations=2).data)
assert not gpu.availability().present and "lost" in gpu.availability().reason
"""


@pytest.mark.parametrize(
    "program",
    [
        pytest.param(SIMULATED, id="fdk", marks=pytest.mark.slow),
        pytest.param(BY_SLABS, id="slabs", marks=pytest.mark.slow),
        pytest.param(ITERATED, id="iterative", marks=pytest.mark.slow),
    ],
)
@pytest.mark.campaign
def test_what_runs_in_the_simulator_gives_the_processors_numbers(program: str) -> None:
    run_simulated(program)


STRICT = """
import sys
import numpy as np
from flexdt.twin.projection import gpu
from flexdt.twin.projection.kernels import gpu_kernels
from flexdt.twin.reconstruction import Grid, fdk_parts, tv
from flexdt.twin.reconstruction.feldkamp.fdk import OnDevice, OnProcessor
from flexdt.twin.reconstruction.kernels import gpu_reconstruction_kernels
from tests.support.device_simulator import as_on_a_device
from tests.support.circular_scans import ball, circle

as_on_a_device()
gpu_reconstruction_kernels.THREADS = 8
rng = np.random.default_rng(int(sys.argv[1]))
aside, yaw = rng.uniform(-2, 2), rng.uniform(-0.1, 0.1)
scan = circle(int(rng.integers(4, 8)), pixel=6.0, aside=aside, yaw=yaw)
shape = tuple(rng.integers(5, 12, 2).tolist())
images, like = ball(scan, shape), Grid(tuple(rng.integers(1, 6, 3).tolist()), 4.0).blank()
found, right = (
    fdk_parts(lambda: [images], scan, shape, like, target=target(like)).data
    for target in (OnDevice, OnProcessor)
)
seen = np.isfinite(right)
assert (seen == np.isfinite(found)).all() and np.abs(right[seen]).max() > 0
assert np.abs(found - right)[seen].max() < 1e-6 * np.abs(right[seen]).max()

if sys.argv[2] == "tv":
    gpu.VIEWS_A_THREAD, gpu.LINEAR, gpu_kernels.FOLDING = 0.0, 32, (1, 32)
    found = tv(images, scan, like, iterations=1).data
    assert gpu.availability().present
    with gpu.switched_off():
        right = tv(images, scan, like, iterations=1).data
    assert np.abs(found - right).max() < 1e-5 * np.abs(right).max()
"""


FILTERED = """
import sys
import numpy as np
from flexdt.twin.reconstruction.feldkamp.backprojection import bits_reversed
from flexdt.twin.reconstruction.feldkamp.filtering import filtered, ramp, response_of_length
from flexdt.twin.reconstruction.kernels import gpu_reconstruction_kernels as kernels
from tests.support.device_simulator import as_on_a_device

as_on_a_device()
kernels.THREADS = 8
rng = np.random.default_rng(int(sys.argv[1]))
n, rows, wide = 2, int(rng.integers(1, 5)), int(rng.integers(2, 40))
start, stop = sorted(rng.choice(wide + 1, 2, replace=False).tolist())
pitch, reach = rng.uniform(0.05, 2.0), max(wide - start, stop)
images = rng.standard_normal((n, rows, wide)).astype(np.float32)
factors, across = rng.random((2, n, wide), dtype=np.float32) + 1
up = rng.random((n, rows), dtype=np.float32)
response = ramp(reach, pitch)

# The ramp filter in space (Kak and Slaney 1988, chapter 3), a sum for each pixel, in double.
apart = np.abs(np.arange(start, stop)[:, None] - np.arange(wide))
odd = apart % 2 == 1
taps = np.where(odd, -1.0 / (np.pi * np.where(odd, apart, 1) * pitch) ** 2, 0.0)
taps[apart == 0] = 0.25 / pitch**2
lines = images * (factors[:, None] / np.sqrt(across[:, None].astype(float) + up[:, :, None]))
wanted = pitch * lines @ taps.T

least = max(2 * reach - 1, wide, 2)
length = 1 << (least - 1).bit_length() + int(rng.integers(2))
short = response_of_length(response, length) / length
there = np.concatenate([short, short[-2:0:-1]])[bits_reversed(length)].astype(np.float32)
turn = 2 * np.pi * np.arange(length // 2) / length
found = np.full((n, stop - start, rows), np.nan, np.float32)
whole = np.zeros(rows, np.float32)
none = np.zeros((n, 1, wide), np.float32), np.zeros(rows, np.int32), whole, whole
kernels.filter_rows[(-(-rows // 2), n), kernels.THREADS](
    images, 0, 0, 0, factors, across, up, *none, np.zeros(wide, np.float32), there,
    np.cos(turn).astype(np.float32), np.sin(turn).astype(np.float32), start, found,
)
most = 2e-6 * np.abs(wanted).max()
assert np.abs(found.transpose(0, 2, 1) - wanted).max() < most
here = filtered(lines.astype(np.float32), response)[..., start:stop]
assert np.abs(here - wanted).max() < most
"""


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.daily(1)
@pytest.mark.campaign(2)
def test_both_devices_filter_as_the_ramp_in_space(seed) -> None:
    run_simulated(FILTERED, str(seed))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.daily(1)
@pytest.mark.campaign(1)
def test_kernels_on_blocks_as_on_a_device_touch_nothing_outside(seed: int) -> None:
    run_simulated(STRICT, str(seed), "tv" if seed else "")


def test_a_volume_too_large_for_the_device_goes_to_the_processor(monkeypatch) -> None:
    like = Grid((40, 40, 40), 1.0).blank()
    monkeypatch.setattr(gpu, "availability", lambda: gpu.Availability(True, "pretended"))
    monkeypatch.setattr(gpu, "free_bytes", lambda: 256 * 2**20 + 4 * 40**3)
    assert not device_takes(like, (1, 1))


@pytest.mark.gpu
@pytest.mark.skipif(not FOUND.present, reason=f"no CUDA device: {FOUND.reason}")
def test_device_agrees_with_the_processor(monkeypatch) -> None:
    scan = circle(241, repeat=True, tilt=0.02)
    like = Grid((80, 80, 80), 0.4).blank()
    images = ball(scan, (120, 130))
    assert device_takes(like, (120, 130))
    device = fdk(images, scan, like)
    assert device.accuracy is not None
    monkeypatch.setattr(
        gpu, "availability", lambda: gpu.Availability(False, "switched off")
    )
    processor = fdk(images, scan, like)
    assert (
        np.abs(device.data - processor.data).max() < 1e-4 * np.abs(processor.data).max()
    )
    found, centre = measure(device)
    assert found == pytest.approx(1.0, abs=0.01)
    assert np.abs(centre).max() < 0.1
