"""Data sets against a second reader that imports nothing of the package."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from flexdt.twin.dataset.flexdt_json import DatasetDocument, ScanRecord, parse_document
from flexdt.twin.dataset.scan_settings_text import format_scan_settings
from flexdt.twin.dataset.xre import format_xre
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.script import plan_script

READER = Path(__file__).parents[1] / "support" / "independent_reader.py"
EXAMPLES = Path(__file__).parents[2] / "examples" / "scripts"
POINTS = np.array([[0, 0, 0], [12, -8, 24.9], [-12, 8, -24.9], [9.5, 5.5, 10.0]])


def independent(folder: Path) -> dict[str, object]:
    done = subprocess.run(
        [sys.executable, "-I", str(READER), str(folder)],
        capture_output=True,
        text=True,
        check=True,
    )
    document: dict[str, object] = json.loads(done.stdout)
    assert document["imported"] == []
    return document


def shadows(rows: npt.ArrayLike, shape: tuple[int, int]) -> npt.NDArray[np.float64]:
    """(n, k, 2) pixels of POINTS, by solving s + t (p - s) = d + a u + b v for each."""
    out = []
    for r in np.asarray(rows, dtype=np.float64):
        s, d, u, v = r[:3], r[3:6], r[6:9], r[9:12]
        for p in POINTS:
            _, a, b = np.linalg.solve(np.stack([s - p, u, v], axis=1), s - d)
            out.append([a + (shape[1] - 1) / 2, b + (shape[0] - 1) / 2])
    return np.array(out).reshape(-1, len(POINTS), 2)


def compare(folder: Path, shape: tuple[int, int]) -> None:
    ours = shadows(
        parse_document((folder / "flexdt.json").read_text()).cone_vec().rows, shape
    )
    theirs = independent(folder)
    assert theirs["shape"] == list(shape)
    for source in ("motors", "printed"):
        other = shadows(theirs[source], shape)  # type: ignore[arg-type]
        assert np.abs(ours - other).max() < 0.01, source


def test_a_hand_made_scan(
    written: Callable[..., Path], record: Callable[..., ScanRecord]
) -> None:
    compare(written(record(frames=13)), (24, 30))


@pytest.mark.parametrize("script", ["lego-fly-360.txt"])
def test_a_planned_script(tmp_path: Path, script: str) -> None:
    """The example script's plan, written by the formatters, down to the run-up position."""
    machine = builtin_machine()
    plan = plan_script(
        (EXAMPLES / script).read_bytes(), machine, builtin_profile("cwi-2023-08-21")
    )
    record = ScanRecord.from_plan(plan, name="lego", started=datetime(2026, 1, 1))
    text = format_scan_settings(record)
    (tmp_path / "scan settings.txt").write_text(text, encoding="utf-8", newline="")
    (tmp_path / "data settings XRE.txt").write_text(format_xre(record), newline="")
    (tmp_path / "flexdt.json").write_text(
        DatasetDocument.of(record).to_json(), encoding="utf-8"
    )
    compare(tmp_path, (760, 956))
    # Image 0 is not where the motor stood when the text was written.
    assert "rot_obj : -6.245762 ; speed : 10.027855 ; acceleration : 22.500000" in text
    assert "# projections: 360" in text
    assert record.angles_deg()[:3] == pytest.approx([0, 360 / 359, 720 / 359], abs=1e-9)
    # Table 6.6 has tra_det with the sign opposite to the script's.
    assert "tra_det : -25.318300" in text
    assert "ver_obj : 353.706300" in text
    assert "# offset images: 10" in text
    assert "Axis for flat field movement : tra_obj" in text


def test_the_other_reader_would_notice_a_wrong_sign(
    written: Callable[..., Path], record: Callable[..., ScanRecord]
) -> None:
    folder = written(record())
    text = folder / "scan settings.txt"
    text.write_text(text.read_text().replace("tra_det : -24", "tra_det : 24"))
    with pytest.raises(AssertionError, match="motors"):
        compare(folder, (24, 30))
