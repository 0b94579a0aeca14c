"""Homes, caches, temporary folders, terminals and paths that other programs do not bear."""

import os
import subprocess
import sys

import pytest

import flexdt as fx

BALL = {"kind": "sphere", "center": [0, 0, 0], "radius": 4, "material": "pmma"}
SCAN = fx.ConeVec.circular(sod=100, sdd=200, angles=3, shape=(6, 8), pixel=1)

WORK = """
import numpy as np
import flexdt as fx

scan = fx.ConeVec.circular(sod=100, sdd=200, angles=3, shape=(6, 8), pixel=1)
scan.save("g \u00e9 \u0141.json")
assert fx.ConeVec.load("g \u00e9 \u0141.json") == scan
counts, flat = np.full((3, 6, 8), 500), np.full((6, 8), 1000)
fx.DataSet.from_arrays(counts, scan, flat=flat, name="\u0141\u00f3d\u017a").save("s [1] %d")
found = fx.open("s [1] %d")
assert np.allclose(found.line_integrals(), np.log(2), atol=1e-3)
ball = {"kind": "sphere", "center": [0, 0, 0], "radius": 4, "material": "pmma"}
print(found, "\u0141", round(float(fx.project(ball, scan).max()), 3))
"""
PLACES = {  # numba#4032, #5566, openPMD-viewer#290; datalad#2447, winml-cli#207
    "no home, no cache": {"HOME": "/dev/null", "NUMBA_CACHE_DIR": "/dev/null/x"},
    "no temporary folder": {"TMPDIR": "/dev/null/x", "XDG_CACHE_HOME": "/dev/null/c"},
    "a terminal of Windows": {
        "PYTHONIOENCODING": "cp1252:backslashreplace",
        "LC_ALL": "C",
    },
}


@pytest.mark.slow
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("folder", ["\u00fc [a] %d  x"])
def test_a_program_works_wherever_it_runs(tmp_path, place, folder):
    here = tmp_path / folder
    here.mkdir()
    expected = round(float(fx.project(BALL, SCAN).max()), 3)
    (here / "work.py").write_text(WORK, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "work.py"], cwd=here, env=os.environ | PLACES[place], check=False,
        capture_output=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr.decode()
    assert b"3 projections of 6 x 8" in done.stdout
    assert float(done.stdout.split()[-1]) == expected


@pytest.mark.slow
def test_what_a_terminal_cannot_show_is_no_traceback_of_a_command(tmp_path):
    missing = tmp_path / "\u0141\u00f3d\u017a [1] %d.json"
    words = ["export", missing, "--format", "csv", "--out", "out.csv"]
    done = subprocess.run(
        [sys.executable, "-m", "flexdt.clients.cli", *words], cwd=tmp_path, check=False,
        env=os.environ | {"PYTHONIOENCODING": "ascii", "HOME": "/dev/null"}, capture_output=True,
    )  # fmt: skip
    assert done.returncode not in (0, -6)
    assert b"Traceback" not in done.stderr
    assert b"[1] %d.json" in done.stderr
