"""CUDA kernels in a simulator whose warps vote and whose arrays refuse every index outside."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from exact_rays import VoxelGrid, line_integrals, ray_ends, spread_back

from flexdt.twin.geometry.cone_vec import ConeVec
from tests.studies.gpu_geometries import KINDS, drawn_case
from tests.support import device_simulator
from tests.support.device_simulator import run_simulated

ASSUMPTIONS = Path(device_simulator.__file__).with_name("gpu_assumptions.py")
CLAIMS = [
    node.name
    for node in ast.parse(ASSUMPTIONS.read_text("utf-8")).body
    if isinstance(node, ast.FunctionDef) and node.decorator_list
]


@pytest.fixture(scope="module")
def found() -> dict[str, str | None]:
    """What was found wrong, by claim."""
    root = str(Path(__file__).parents[3])
    environment = {**os.environ, "PYTHONPATH": root}
    command = [sys.executable, str(ASSUMPTIONS)]
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_all_claims_are_checked(found) -> None:
    assert list(found) == CLAIMS
    assert len(CLAIMS) >= 10


@pytest.mark.parametrize("name", CLAIMS)
def test_what_the_kernels_claim_of_themselves_is_so(found, name) -> None:
    assert found[name] is None, found[name]


DRAWN = """
import sys
import numpy as np
from tests.studies.gpu_geometries import KINDS, drawn_case, measure
from tests.support.device_simulator import as_on_a_device

as_on_a_device()
kind, count, most = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
for number in range(count):
    case = drawn_case(np.random.default_rng([int(sys.argv[4]), number]), kind, most)
    found = measure(case, twice=False)
    assert not found.wrong, (number, found)
"""
DAILY = (
    ("diagonal", 2, 7, 6),
    ("turned", 2, 8, 2),
    ("source inside", 2, 8, 3),
    ("upright", 2, 7, 11),
)
"""Kind, cases, most voxels along an axis, seed."""


@pytest.mark.parametrize(("kind", "count", "most", "seed"), DAILY)
def test_drawn_geometries_are_exact_and_touch_nothing_outside(
    kind, count, most, seed
) -> None:
    run_simulated(DRAWN, kind, str(count), str(most), str(seed))


@pytest.mark.slow
@pytest.mark.campaign(1)
@pytest.mark.parametrize("seed", range(8))
def test_many_drawn_geometries_are_exact(seed) -> None:
    study = Path(__file__).parents[2] / "studies" / "gpu_geometries.py"
    count = 12 if seed == 0 else 120  # few in CI
    command = [
        sys.executable,
        str(study),
        "--count",
        str(count),
        "--seed",
        str(100 + seed),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    document = json.loads(done.stdout)
    assert document["count"] == count
    assert all(kind["cases"] == count // 12 for kind in document["by_kind"].values())


def behind(starts: np.ndarray, ends: np.ndarray, grid: VoxelGrid) -> np.ndarray:
    """Lengthen rays beyond the grid: a panel before or inside the object is a virtual one."""
    diagonal = float(np.linalg.norm(np.array(grid.counts) * np.array(grid.voxel_mm)))
    reach = np.linalg.norm(starts - np.array(grid.center_mm), axis=1) + diagonal
    length = np.linalg.norm(ends - starts, axis=1)
    return starts + (ends - starts) * np.maximum(reach / length, 1.0)[:, None]


def test_the_reference_is_that_of_the_other_tests(siddon) -> None:
    """Two implementations in double precision, of sorted crossings, agree to its last
    digits."""
    for number, kind in enumerate(KINDS):
        case = drawn_case(np.random.default_rng([5, number]), kind, 7)
        geometry = ConeVec(case.rows)
        wanted = siddon(case.data, case.voxel_mm, case.center_mm, geometry, case.shape)
        grid = VoxelGrid(case.counts, case.voxel_mm, case.center_mm)
        starts, ends = ray_ends(case.rows, case.shape)
        ends = behind(starts, ends, grid)
        found = line_integrals(grid, case.data, starts, ends)
        np.testing.assert_allclose(
            found, wanted.ravel(), rtol=0, atol=1e-11 * wanted.max()
        )
        back = spread_back(grid, case.values, starts, ends)
        both = np.vdot(back, case.data.astype(float)), np.vdot(found, case.values.ravel())
        assert abs(both[0] - both[1]) < 1e-11 * both[1], kind


AS_WITH_A_DEVICE = (
    "clients/test_reconstruct_materials.py", "face/test_papercuts.py",
    "server/test_projector_server.py", "twin/projection/test_projection_frameworks.py",
    "twin/projection/test_projection_hard.py", "twin/projection/test_projection_operator.py",
    "twin/projection/test_projection_turns.py",
    "twin/reconstruction/test_reconstruction_iterative.py",
)  # fmt: skip
"""Tests that once took a device's sums for the processor's."""


@pytest.mark.slow
@pytest.mark.campaign(1)
@pytest.mark.parametrize("name", AS_WITH_A_DEVICE)
def test_tests_pass_on_a_machine_with_a_device(name) -> None:
    tests = Path(__file__).parents[2]
    environment = {
        **os.environ,
        "NUMBA_ENABLE_CUDASIM": "1",
        "PYTHONPATH": str(tests / "support"),
    }
    options = ["-p", "device_stand_in", "-p", "no:cacheprovider", "-m", "not slow", "-q"]
    command = [sys.executable, "-m", "pytest", *options, str(tests / name)]
    done = subprocess.run(
        command,
        env=environment,
        cwd=tests.parent,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout
