"""Kernels are called in portions: same bits, every job once, and Ctrl-C between two of them."""

from __future__ import annotations

import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import Volume, back, forward, portions
from flexdt.twin.projection.operators import geometry_change, geometry_gradient
from flexdt.twin.reconstruction.total_variation import tv

SHAPE = (7, 40)
END_ON = ConeVec.from_vectors((0, 0, -40), (0, 0, 30), (0.9, 0, 0), (0, 0.9, 0))
"""Rays that travel alone."""
TURNED = {
    "level": {},
    "tilted": {"roll": 0.05, "pitch_tilt": 0.04, "yaw": 0.1},
    "on its side": {"roll": np.pi / 2},
    "end on": None,
}


@pytest.mark.filterwarnings("ignore:.*of the grid lie beside the field of view")
@pytest.mark.usefixtures("on_processor")
@pytest.mark.parametrize("name", TURNED)
def test_results_do_not_depend_on_portions(name, circle, monkeypatch) -> None:
    options = TURNED[name]
    geometry = END_ON if options is None else circle(3, 60.0, 90.0, 1.1, **options)
    random = np.random.default_rng(3)
    volume = Volume(random.random((12, 30, 26), dtype=np.float32), 0.8)
    images = random.random((len(geometry), *SHAPE), dtype=np.float32)

    def results() -> list[np.ndarray]:
        fresh = Volume(volume.data.copy(), volume.voxel_mm)
        change = np.ones((len(geometry), 12))
        return [
            forward(fresh, geometry, SHAPE),
            back(images, geometry, fresh).data,
            geometry_gradient(fresh, geometry, images),
            geometry_change(fresh, geometry, change, SHAPE),
            tv(images, geometry, fresh, weight=0.1, iterations=1).data,
        ]

    whole = results()
    monkeypatch.setattr(portions, "PORTION_NS", 3e4)  # a job or a few
    for a, b in zip(whole, results(), strict=True):
        assert a.any()
        np.testing.assert_array_equal(a, b)


@given(
    st.lists(st.floats(0.0, 3e8), min_size=1, max_size=40),
    st.lists(st.integers(0, 40), max_size=12),
    st.integers(1, 4),
)
def test_turns_are_cut_into_all_units_in_order(times, cuts, threads) -> None:
    edges = sorted({0, len(times), *(cut for cut in cuts if cut < len(times))})
    turns = np.array(list(pairwise(edges)), np.int64)
    parts = list(portions.turn_portions(turns, np.array(times), threads))
    for part in parts:
        alone = part[0, 1] - part[0, 0] == 1 and len(part) == 1
        whole = sum(times[part[0, 0] : part[-1, 1]])
        assert alone or whole <= portions.PORTION_NS * threads * (1 + 1e-9)
    units = [unit for part in parts for a, b in part.tolist() for unit in range(a, b)]
    assert units == list(range(len(times)))
    # Units of two turns are never in one.
    for a, b in (row for part in parts for row in part.tolist()):
        assert any(begin <= a and b <= end for begin, end in turns.tolist())


LONG = """
import signal, sys, time
import numpy as np
import flexdt as fx

N = 128 if sys.argv[1] == "tv" else 320  # whose passes over the volume take longest
SHAPE = (N, N)
scan = fx.ConeVec.circular(sod=600, sdd=900, angles=720, shape=SHAPE, pixel=1.0)
data = np.random.default_rng(1).random((N, N, N), dtype=np.float32)
volume, images = fx.Volume(data, 0.6), np.ones((720, *SHAPE), np.float32)
work = {
    "forward": lambda: fx.forward(volume, scan, SHAPE),
    "back": lambda: fx.back(images, scan, like=volume),
    "cgls": lambda: fx.cgls(images, scan, volume, iterations=20),
    "tv": lambda: fx.tv(images, scan, volume, weight=0.1, iterations=20),
}[sys.argv[1]]
few = fx.ConeVec(scan.rows[:1])  # compiled
fx.forward(volume, few, SHAPE), fx.back(images[:1], few, like=volume)
if sys.argv[1] == "tv":
    fx.tv(images[:1], few, volume, weight=0.1, iterations=1)

# A signal after so much of this process's own time, whatever else the machine does.
delay = float(sys.argv[2])
signal.signal(signal.SIGPROF, signal.default_int_handler)
begun = time.process_time()
signal.setitimer(signal.ITIMER_PROF, delay)
try:
    work()
    print("ended")
except KeyboardInterrupt:
    print(time.process_time() - begun - delay)
"""
MOST_S = 1.5
"""Processor time, of all threads, from the signal to KeyboardInterrupt: half a second of two
threads by estimate, and as much again."""


@pytest.mark.slow
@pytest.mark.campaign(2)
@pytest.mark.parametrize(
    "moment_s", np.random.default_rng(5).uniform(0.3, 2.0, 2).round(3)
)
@pytest.mark.parametrize("name", ["forward", "back", "cgls", "tv"])
def test_a_signal_is_heard_between_portions(
    name: str, moment_s: float
) -> None:  # numba#2324, #5551
    done = subprocess.run(
        [sys.executable, "-c", LONG, name, str(moment_s)], capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() != "ended"
    assert float(done.stdout) < MOST_S
