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


@pytest.mark.parametrize("statement", NOT_IMPORTED)
def test_a_name_imports_only_what_it_runs(statement: str) -> None:
    code = f"{statement}\nimport json, sys; print(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    loaded = json.loads(done.stdout)
    found = {
        name
        for name in loaded
        for kept_out in NOT_IMPORTED[statement]
        if name == kept_out or name.startswith(kept_out + ".")
    }
    assert not found, statement
