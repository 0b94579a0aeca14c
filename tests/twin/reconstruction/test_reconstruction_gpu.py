"""FDK's backprojection on a CUDA device: in numba's simulator, and on a device if there is one."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from flexdt.twin.projection import gpu
from flexdt.twin.reconstruction import Grid, fdk
from flexdt.twin.reconstruction.fdk import device_takes
from tests.twin.reconstruction.scans import ball, circle, measure

FOUND = gpu.availability()

SIMULATED = """
import numpy as np
from flexdt.twin.projection import gpu
from flexdt.twin.reconstruction import Grid, fdk
from flexdt.twin.reconstruction.fdk import OnDevice, OnProcessor, device_takes
from flexdt.twin.reconstruction.fdk import view_table
from flexdt.twin.reconstruction.rectify import upright
from tests.twin.reconstruction.scans import ball, circle

assert gpu.availability().present
# Flat enough for the simulator; 300 layers are more than one block, and leave the panel both ways.
like = Grid((300, 3, 5), 0.4, (3.0, -2.0, 5.0)).blank()
assert device_takes(like)
scan = upright(circle(4, tilt=0.02, aside=10.0, pixel=0.9))
table = view_table(scan, (90, 70))
assert len(table) == 4
rng = np.random.default_rng(0)
made = []
for kind in (OnDevice, OnProcessor):
    rng = np.random.default_rng(0)
    target = kind(like)
    for part in (slice(0, 3), slice(3, 4)):
        columns = rng.standard_normal((len(table[part]), 70, 90)).astype(np.float32)
        target.add(columns, np.zeros((len(columns), 0, 0), np.float32), table[part])
    made.append(target.volume())
device, processor = made
assert device.shape == processor.shape == (3, 5, 300)
assert (processor != 0).mean() > 0.3 and (processor == 0).any()
assert ((device != 0) == (processor != 0)).all()
worst = np.abs(device - processor).max() / np.abs(processor).max()
assert worst < 1e-5, worst
# All the way: from images to a volume.
scan = circle(8, 360.0, pixel=6.0)
images = ball(scan, (12, 14))
like = Grid((6, 4, 5), 4.0).blank()
through = fdk(images, scan, like).data
gpu.availability = lambda: gpu.Availability(False, "switched off")
assert not device_takes(like)
direct = fdk(images, scan, like).data
assert np.abs(direct).max() > 0
assert np.abs(through - direct).max() < 1e-5 * np.abs(direct).max()
print("simulated")
"""


def test_the_kernel_in_the_simulator_is_the_processors() -> None:
    done = subprocess.run(
        [sys.executable, "-c", SIMULATED],
        env={**os.environ, "NUMBA_ENABLE_CUDASIM": "1"},
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert done.stdout.strip() == "simulated", done.stderr


def test_a_volume_too_large_for_the_device_goes_to_the_processor(monkeypatch) -> None:
    like = Grid((40, 40, 40), 1.0).blank()
    monkeypatch.setattr(gpu, "availability", lambda: gpu.Availability(True, "pretended"))
    monkeypatch.setattr(gpu, "free_bytes", lambda: 256 * 2**20 + 4 * 40**3 - 1)
    assert not device_takes(like)


@pytest.mark.gpu
@pytest.mark.skipif(not FOUND.present, reason=f"no CUDA device: {FOUND.reason}")
def test_device_agrees_with_the_processor(monkeypatch) -> None:
    scan = circle(241, repeat=True, tilt=0.02)
    like = Grid((80, 80, 80), 0.4).blank()
    images = ball(scan, (120, 130))
    assert device_takes(like)
    device = fdk(images, scan, like)
    monkeypatch.setattr(gpu, "availability", lambda: gpu.Availability(False, "switched off"))
    processor = fdk(images, scan, like)
    assert np.abs(device.data - processor.data).max() < 1e-4 * np.abs(processor.data).max()
    found, centre = measure(device)
    assert found == pytest.approx(1.0, abs=0.01)
    assert np.abs(centre).max() < 0.1
