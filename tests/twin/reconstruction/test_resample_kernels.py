"""Columns mixed and resampled by registers of 16, of 8 and one by one, beside NumPy and each
other.

Each way is compiled in a process of its own, for a processor that has no other.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from llvmlite import binding

from flexdt.twin.reconstruction.kernels.fdk_kernels import MARGIN, STEEPEST, lanes

WAYS = {16: "+avx2,+fma,+avx512f", 8: "+avx2,+fma", 1: ""}
PROGRAM = """
import sys
import numpy as np
from numba import njit
from flexdt.twin.reconstruction.kernels.fdk_kernels import LANES, add_column, mix_columns

@njit
def work(acc, left, right, shares, cases):
    line = np.empty_like(left[0])
    for n in range(len(cases)):
        first, count, samples = int(cases[n, 0]), int(cases[n, 1]), int(cases[n, 4])
        mix_columns(line, left[n], right[n], 0, samples + 1, shares[n, 0], shares[n, 1])
        add_column(acc[n], line, first, count, cases[n, 2], cases[n, 3])

given = dict(np.load(sys.argv[1]))
work(given["acc"], given["left"], given["right"], given["shares"], given["cases"])
np.savez(sys.argv[2], acc=given["acc"], lanes=LANES)
"""


def draw(seed: int, cases: int = 300) -> dict[str, np.ndarray]:
    """Columns of 1 to 150 voxels, rising and falling, some steeper than registers can be.

    Places are multiples of 2^-16, so that a column cut in two has the very same ones.
    """
    rng = np.random.default_rng(seed)
    table = np.empty((cases, 5))
    line = np.zeros((2, cases, 512 + MARGIN), np.float32)
    for n in range(cases):
        count = int(rng.integers(1, 150))
        samples = int(rng.integers(2, 480))
        steepest = min(2.3 if n % 7 == 0 else STEEPEST, (samples - 1) / max(count - 1, 1))
        step = np.floor(rng.uniform(-steepest, steepest) * 2**16) / 2**16
        spare = samples - 1 - abs(step) * (count - 1)
        start = np.floor(rng.uniform(0.0, max(spare, 0.0)) * 2**16) / 2**16
        if step < 0:
            start += abs(step) * (count - 1)
        table[n] = rng.integers(0, 40), count, min(start, samples - 1.0), step, samples
        line[:, n, :samples] = rng.normal(size=(2, samples))
        line[:, n, samples] = line[:, n, samples - 1]
    acc = rng.normal(size=(cases, 200)).astype(np.float32)
    return {
        "acc": acc, "left": line[0], "right": line[1], "cases": table,
        "shares": rng.random((cases, 2)).astype(np.float32),
    }  # fmt: skip


def cut(given: dict[str, np.ndarray], at: int) -> tuple[dict[str, np.ndarray], ...]:
    """The same columns, up to voxel `at` and from there on."""
    first, count, start, step, samples = given["cases"].T
    below = np.clip(at - first, 0, count)
    return (
        {**given, "cases": np.stack([first, below, start, step, samples], 1)},
        {
            **given,
            "cases": np.stack(
                [first + below, count - below, start + below * step, step, samples], 1
            ),
        },
    )


def compiled(given: dict[str, np.ndarray], way: int, folder: Path) -> np.ndarray:
    np.savez(folder / "given.npz", **given)
    subprocess.run(
        [sys.executable, "-c", PROGRAM, folder / "given.npz", folder / "out.npz"],
        env={**os.environ, "NUMBA_CPU_NAME": "x86-64", "NUMBA_CPU_FEATURES": WAYS[way]},
        check=True, timeout=200,
    )  # fmt: skip
    out = np.load(folder / "out.npz")
    assert out["lanes"] == way
    return out["acc"]


@pytest.fixture(scope="module")
def ways() -> list[int]:
    has = binding.get_host_cpu_features()
    need = {16: "avx512f", 8: "avx2"}
    return [way for way in WAYS if way == 1 or has.get(need[way], False)]


@pytest.mark.slow
@pytest.mark.campaign
def test_every_way_is_numpys_and_the_others(ways: list[int], tmp_path: Path) -> None:
    given = draw(3)
    wanted = given["acc"].astype(np.float64)
    one, other = given["shares"].T[:, :, None].astype(np.float64)
    lines = one * given["left"] + other * given["right"]
    for row, line, (first, count, start, step, _) in zip(
        wanted, lines, given["cases"], strict=True
    ):
        places = start + np.arange(int(count)) * step
        row[int(first) : int(first + count)] += np.interp(
            places, np.arange(line.size), line
        )
    # Beside the whole columns the same in two parts, that registers of any length end at.
    parts = cut(given, 48)
    both = {k: np.concatenate([given[k], parts[0][k]]) for k in given}
    made = {}
    for way in ways:
        out = compiled(both, way, tmp_path)
        whole, below = np.split(out, 2)
        rest = compiled({**parts[1], "acc": below}, way, tmp_path)
        np.testing.assert_array_equal(rest, whole)
        made[way] = whole
        assert np.abs(whole - wanted).max() < 1e-6
        assert np.abs(whole - wanted).mean() < 2e-7
    for way in ways:
        np.testing.assert_allclose(made[way], made[1], rtol=0, atol=1e-6)


@pytest.mark.parametrize(("features", "expected"), [*((f, n) for n, f in WAYS.items()),
                                                    ("+avx,-avx2,-avx512f", 1)])  # fmt: skip
def test_registers_as_the_processor_has_them(
    features: str, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("numba.core.config.CPU_FEATURES", features)
    assert lanes() == expected
