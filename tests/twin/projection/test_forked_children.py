"""A process that has used kernels is forked: its children compute the same bits, or are
told (numba#7872, fast-array-utils#179, novae#62)."""

from __future__ import annotations

import ast
import importlib.util
import os
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from flexdt.twin.projection import gpu

SILENCE_S = 240.0
ROOT = Path(__file__).parents[3]

WORK = """
import multiprocessing, sys, warnings
import numpy as np
import flexdt as fx
from flexdt.twin.projection.operators import geometry_gradient

warnings.simplefilter("ignore")
random = np.random.default_rng(int(sys.argv[1]))
SHAPE, N = (int(random.integers(8, 20)), int(random.integers(20, 40))), 3
SCAN = fx.ConeVec.circular(sod=60, sdd=90, angles=N, shape=SHAPE, pixel=1.0)
VOLUME = fx.Volume(random.random((10, 22, 24), dtype=np.float32), 0.8)
IMAGES = random.random((N, *SHAPE), dtype=np.float32)

def work(item):
    return [
        fx.forward(VOLUME, SCAN, SHAPE),
        fx.back(IMAGES, SCAN, like=VOLUME).data,
        fx.cgls(IMAGES, SCAN, VOLUME, iterations=2).data,
        fx.tv(IMAGES, SCAN, VOLUME, weight=0.1, iterations=2).data,
        geometry_gradient(VOLUME, SCAN, IMAGES),
    ]

def compare(results):
    ours = work(0)
    assert all(one.any() for one in ours)
    for theirs in results:
        for a, b in zip(ours, theirs, strict=True):
            np.testing.assert_array_equal(a, b)

work(0)
"""
WAYS = {
    "Pool": """
with multiprocessing.get_context("fork").Pool(2) as pool:
    compare(pool.map(work, range(3)))
""",
    "ProcessPoolExecutor": """
from concurrent.futures import ProcessPoolExecutor
with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("fork")) as pool:
    compare(pool.map(work, range(3)))
""",
    "DataLoader": """
from torch.utils.data import DataLoader, Dataset
class Items(Dataset):
    __len__ = lambda self: 3
    __getitem__ = lambda self, i: work(i)
loader = DataLoader(Items(), batch_size=None, num_workers=2, multiprocessing_context="fork")
compare([[part.numpy() for part in one] for one in loader])
""",
    "grandchild": """
def below(item):
    with multiprocessing.get_context("fork").Pool(1) as pool:
        return pool.map(work, [item])[0]
from concurrent.futures import ProcessPoolExecutor
with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("fork")) as pool:
    compare(pool.map(below, range(1)))
""",
}


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.parametrize("way", WAYS)
def test_a_forked_child_computes_the_same_bits(way: str, tmp_path: Path) -> None:
    if way == "DataLoader" and importlib.util.find_spec("torch") is None:
        pytest.skip("torch is not installed")
    script = tmp_path / "forks.py"
    script.write_text(WORK + WAYS[way] + "\nprint('same')\n")
    done = subprocess.run(
        [sys.executable, script, str(list(WAYS).index(way))], capture_output=True, text=True,
        check=False, timeout=SILENCE_S, env=os.environ | {"NUMBA_DISABLE_CUDA": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["same"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
@pytest.mark.parametrize("used", [True, False])
def test_a_forked_child_leaves_its_parents_device_alone(
    used: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A child of a process that has not met the device yet may use it."""
    monkeypatch.setattr(gpu, "_failed", [])
    probed = cache(lambda: gpu.Availability(True, "a device"))
    monkeypatch.setattr(gpu, "_probe", probed)
    if used:
        assert gpu.availability().present
    reading, writing = os.pipe()
    if os.fork() == 0:
        found = gpu.availability()
        os.write(writing, f"{found.present} {found.reason}".encode())
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading) as answer:
        told = answer.read()
    os.wait()
    assert told.startswith(str(not used))
    assert ("spawn" in told) == used


FOLDERS = ("twin", "phantoms", "runtime", "clients", "server")
"""Whatever compiles for the processor there."""


def decorators(function: ast.FunctionDef) -> set[str]:
    """Names of a function's decorators, called or not."""
    plain = [
        each.func if isinstance(each, ast.Call) else each
        for each in function.decorator_list
    ]
    return {each.id for each in plain if isinstance(each, ast.Name)}


def test_every_parallel_loop_is_compiled_by_the_one_decorator() -> None:
    seen = 0
    for file in (file for folder in FOLDERS for file in (ROOT / folder).rglob("*.py")):
        text = file.read_text(encoding="utf-8")
        if "numba" not in text:
            continue
        tree = ast.parse(text)
        for function in (
            node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)
        ):
            inner = {
                n
                for f in function.body
                if isinstance(f, ast.FunctionDef)
                for n in ast.walk(f)
            }
            names = {
                n.id
                for n in ast.walk(function)
                if isinstance(n, ast.Name) and n not in inner
            }
            if "prange" in names:
                seen += 1
                assert decorators(function) == {"parallel"}, f"{file}: {function.name}"
        if file.name != "compiling.py":
            imported = {
                alias.name
                for node in ast.walk(tree)
                if isinstance(node, ast.ImportFrom) and node.module == "numba"
                for alias in node.names
            }
            assert not imported & {"njit", "jit", "vectorize", "guvectorize"}, file
    assert seen > 20
