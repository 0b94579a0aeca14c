"""What a function does not run, its first call does not import: a table of what may not come."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

HEAVY = {
    "numba",
    "scipy.stats",
    "scipy.optimize",
    "cv2",
    "trimesh",
    "matplotlib",
    "tifffile",
}
CALIBRATION = {"flexdt.twin.calibration.fit", "flexdt.twin.calibration.without_phantom"}
PLANS = {"flexdt.twin.script.commands", "flexdt.twin.dataset.flexdt_json"}
# Statement -> modules that it must not import, with all that is inside them.
NOT_IMPORTED = {
    "import flexdt": HEAVY | CALIBRATION | PLANS | {"numpy", "pydantic"},
    "from flexdt import phantoms": HEAVY | CALIBRATION | PLANS | {"scipy"},
    "import flexdt; flexdt.plan": HEAVY | CALIBRATION | {"scipy", "asyncio"},
    "import flexdt; flexdt.project": HEAVY | CALIBRATION | PLANS,
    "import flexdt; flexdt.sirt": HEAVY | CALIBRATION | PLANS | {"pydantic", "flexdt.twin.physics"},
    "import flexdt; flexdt.fdk": HEAVY - {"numba"} | CALIBRATION | PLANS | {"flexdt.twin.physics"},
    "import flexdt; flexdt.reconstruct": HEAVY | CALIBRATION,
    "import flexdt; flexdt.open": HEAVY | CALIBRATION,
    "import flexdt.clients.cli.command_tree": HEAVY | CALIBRATION | PLANS | {"numpy", "asyncio"},
    "import flexdt.library.calibration.calibrate": {
        "scipy.stats", "scipy.interpolate", "flexdt.twin.calibration.without_phantom",
        "flexdt.twin.reconstruction",
    },
}  # fmt: skip

# The same of calls, with the kernels that they run.
SCAN = "import flexdt as f; s = f.ConeVec.circular(sod=30, sdd=60, angles=2, shape=(9, 9), pixel=2)"
BALL = 'b = {"kind": "sphere", "center": [0, 0, 0], "radius": 5, "material": "pmma"}'
NOT_RUN = {
    f"{SCAN}; {BALL}; f.simulate(b, s)": {"scipy.special", "scipy.optimize"},
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("statement", NOT_RUN)
def test_a_call_imports_only_what_it_runs(statement: str) -> None:
    assert_not_imported(statement, NOT_RUN[statement])


@pytest.mark.parametrize("statement", NOT_IMPORTED)
def test_a_name_imports_only_what_it_runs(statement: str) -> None:
    assert_not_imported(statement, NOT_IMPORTED[statement])


def assert_not_imported(statement: str, wanted: set[str]) -> None:
    """In a process of its own."""
    code = f"{statement}\nimport json, sys; print(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    loaded = json.loads(done.stdout)
    found = {
        name
        for name in loaded
        for kept_out in wanted
        if name == kept_out or name.startswith(kept_out + ".")
    }
    assert not found, statement
