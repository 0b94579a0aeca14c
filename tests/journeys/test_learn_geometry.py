"""A misalignment learnt back by gradients, on images of an independent renderer: short of the
study `examples/learn_geometry.py`.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from flexdt.twin.projection import project_scene
from flexdt.twin.projection.analytic_solids import Ellipsoid, Scene, Solid

FILE = Path(__file__).resolve().parents[2] / "examples" / "learn_geometry.py"


@pytest.fixture(scope="module")
def study() -> Iterator[ModuleType]:
    import numba

    before = numba.get_num_threads()
    numba.set_num_threads(1)  # waking threads would take longer than these projections
    spec = importlib.util.spec_from_file_location("learn_geometry", FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["learn_geometry"] = module  # dataclasses look there
    spec.loader.exec_module(module)
    yield module
    del sys.modules["learn_geometry"]
    numba.set_num_threads(before)


@pytest.mark.slow
def test_shift_roll_and_axis_come_back(study: ModuleType) -> None:
    task = study.make(0, 32, 64)
    start = task.truth + np.random.default_rng(1000).uniform(-3.0, 3.0, 3)
    assert abs(start - task.truth).min() > 0.1
    for k in range(3):
        assert abs(study.learn(task, [k], start)[k] - task.truth[k]) < 0.01
    found = study.learn(task, [0, 1, 2], start)
    assert task.reprojection(start) > 0.3
    assert task.reprojection(found) < 0.01
    _, sizes, directions = np.linalg.svd(
        task.jacobian(found, [0, 1, 2]), full_matrices=False
    )
    # A shift of the panel and one of the axis back again are nearly the same images.
    assert sizes[-1] < 0.05 * sizes[0]
    assert abs(directions[-1] @ np.array([1.0, 0.0, 1.0])) / np.sqrt(2) > 0.99


def test_the_renderer_draws_ellipsoids(study: ModuleType) -> None:
    task = study.make(3, 2, 8)
    rng = np.random.default_rng(1)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    semi = np.array([5.0, 7.0, 9.0])
    middle = np.array([3.0, -2.0, 1.0])
    rows = task.rows(task.truth)
    image = study.render([(middle, np.diag(1 / semi) @ turn, 0.02)], rows, (30, 40), True)
    solid = Solid(
        Ellipsoid(tuple(middle), tuple(semi), tuple(map(tuple, turn))), "a", 0.02
    )
    wanted = project_scene(Scene((solid,)), rows, (30, 40))
    np.testing.assert_allclose(image, wanted, atol=1e-5 * wanted.max())
