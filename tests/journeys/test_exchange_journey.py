"""A scan of a real twin goes out to RTK and its volume comes back where ours is."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from flexdt.clients.cli.command_tree import run
from flexdt.clients.launch.processes import Servers
from flexdt.twin.projection import Volume

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "reconstruct_with_rtk.py"


@pytest.mark.slow
@pytest.mark.skipif(
    importlib.util.find_spec("itk") is None, reason="itk-rtk is not installed"
)
@pytest.mark.campaign
def test_rtk_reconstructs_what_we_export(
    servers: Servers, tmp_path: Path, fly_script: Callable[..., str], data_dir: Path
) -> None:
    script = tmp_path / "scan.txt"
    script.write_bytes(fly_script(31).encode())
    at = "{}:{}".format(*servers.address)
    assert run(["run", str(script), "--out", "turn", "--server", at]) == 0
    scan, xml, out = data_dir / "turn", tmp_path / "g.xml", tmp_path / "rtk.npy"
    assert run(["export", str(scan), "--format", "rtk", "--out", str(xml)]) == 0
    done = subprocess.run(
        [sys.executable, "-W", "error", str(EXAMPLE), *map(str, (scan, xml, out, 0.25, 48))],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    ours = tmp_path / "ours.mha"
    words = ["--voxel", "0.25", "--shape", "48,48,48"]
    assert run(["reconstruct", str(scan), "--out", str(ours), *words]) == 0
    a, b = np.load(out), Volume.load(ours).data
    assert a.shape == b.shape

    def alike(x: np.ndarray[tuple[int, ...], np.dtype[np.float32]]) -> float:
        return float(np.corrcoef(x.ravel(), b.ravel())[0, 1])

    # So few views leave streaks of which each makes its own; any mirror would leave nothing.
    assert alike(a) > 0.85
    for mirrored in (a[::-1], a[:, ::-1], a[:, :, ::-1]):
        assert alike(mirrored) < 0.4
