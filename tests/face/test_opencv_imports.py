"""Doors that do not import OpenCV: 160 MB of libraries for the detection of beads."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = ROOT / "examples" / "scripts"
PACKAGES = (
    "protocol",
    "twin",
    "phantoms",
    "runtime",
    "server",
    "clients",
    "flexdt/library",
)
DETECTION = ROOT / "twin" / "calibration" / "detect"
PROGRAM = """
import os, sys

def passed(door):
    assert "cv2" not in sys.modules, door
    print(door)

import flexdt as fx
passed("import")
import numpy as np
from flexdt.clients.cli.command_tree import run

scan = fx.ConeVec.circular(sod=600, sdd=1059, angles=8, shape=(12, 16), pixel=4.0)
fx.fdk(np.ones((8, 12, 16), np.float32), scan, fx.Grid((6, 8, 8), 2.0), progress=False)
passed("fdk")
counts = np.full((8, 12, 16), 900, np.uint16)
fx.DataSet.from_arrays(counts, scan, flat=np.full((12, 16), 1000)).save("scan")
fx.open("scan").line_integrals()
passed("open")
assert run(["check", os.environ["LISTING"], "-q"]) == 0
passed("check")
import flexdt.twin.calibration.detect.detection
assert "cv2" in sys.modules, "the detection of beads"
print("seen")
"""
"""The last import shows that what is looked for would be seen."""


@pytest.mark.filterwarnings("ignore")
def test_opencv_is_imported_by_what_needs_it_alone(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        cwd=tmp_path,
        env={**os.environ, "LISTING": str(SCRIPTS / "listing1.txt")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    doors = [line for line in done.stdout.splitlines() if line.isalpha()]
    assert doors == ["import", "fdk", "open", "check", "seen"]


def imports_at_head(file: Path) -> bool:
    """Whether a module imports OpenCV when it is itself imported."""
    text = file.read_text()
    return "cv2" in text and any(
        (isinstance(node, ast.Import) and any(n.name == "cv2" for n in node.names))
        or (isinstance(node, ast.ImportFrom) and node.module == "cv2")
        for node in ast.parse(text).body
    )


def test_modules_of_the_detection_alone_import_opencv_at_their_head() -> None:
    files = [file for package in PACKAGES for file in (ROOT / package).rglob("*.py")]
    heads = {file.parent for file in files if imports_at_head(file)}
    assert len(files) > 300
    assert heads == {DETECTION}
