"""A helical scan of the twin, from its script to a volume: the beads are in their places."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flexdt.clients.cli.command_tree import run
from flexdt.clients.launch.processes import Servers
from flexdt.library.reconstruction.volume_files import read_volume
from flexdt.phantoms import lego_phantom

VOXEL = 0.3
BEADS = lego_phantom().beads


@pytest.mark.slow
@pytest.mark.campaign
def test_a_helical_scan_reconstructs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script, out = tmp_path / "helix.txt", tmp_path / "v.tif"
    words = ["--kind", "helical", "--frames", "181", "--rise", "24", "--averages", "4"]
    assert run(["script", "new", *words, "--out", str(script)]) == 0
    with Servers(
        {"data": tmp_path / "data", "speed-up": "max"}, tmp_path / "log"
    ) as servers:
        server = ["--server", "{}:{}".format(*servers.address)]
        code = run(["run", str(script), "--out", "helix", "--sample", "lego", *server])
        assert code == 0, capsys.readouterr().err
    options = ["--voxel", str(VOXEL), "--shape", "180,90,110"]
    scan = str(tmp_path / "data" / "helix")
    assert run(["reconstruct", scan, "--out", str(out), *options]) == 0, (
        capsys.readouterr().err
    )
    data = np.asarray(read_volume(out).data, dtype=float)
    low = -VOXEL * (np.array(data.shape[::-1]) - 1) / 2
    wrong = []
    for bead in BEADS:
        at = np.rint((bead - low) / VOXEL).astype(int)
        if (at < 4).any() or (at > np.array(data.shape[::-1]) - 5).any():
            continue
        x, y, z = (slice(a - 4, a + 5) for a in at)
        part = data[z, y, x]
        weight = np.clip(part - 0.4 * part.max(), 0, None)
        centre = np.array(
            [(g * weight).sum() / weight.sum() for g in np.mgrid[-4:5, -4:5, -4:5]]
        )
        wrong.append(np.linalg.norm(low + (at + centre[::-1]) * VOXEL - bead))
        assert part.max() > 3 * float(np.median(data))
    assert len(wrong) > len(BEADS) / 2
    assert max(wrong) < 0.1
