"""A file of numbers without sizes: the error says how to read it, and that way works."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import flexdt as fx
from flexdt.twin.dataset.dataset_errors import DatasetError

SCAN = fx.ConeVec.circular(sod=100, sdd=200, angles=3, shape=(4, 5), pixel=1)
COUNTS = np.random.default_rng(2).integers(1, 60_000, (3, 4, 5)).astype("<u2")
DOORS: dict[str, Callable[[Path], object]] = {
    "open": fx.open,
    "open with a geometry": lambda path: fx.open(path, geometry=SCAN),
    "images": lambda path: fx.read_tiffs(path, SCAN),
    "folder": lambda path: fx.read_tiffs(path.parent, SCAN),
}


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize("name", ["scan.raw", "SCAN.RAW", "part 1.bin"])
def test_the_way_that_the_error_says_gives_the_numbers(
    door: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / name).write_bytes(COUNTS.tobytes())
    with pytest.raises(DatasetError) as refused:
        DOORS[door](tmp_path / name)
    said = str(refused.value)
    for word, value in {"IMAGES": 3, "ROWS": 4, "COLUMNS": 5}.items():
        said = said.replace(word, str(value))
    header = re.findall(r"'(\w+ = [^']+)'", said)
    (tmp_path / "scan.mhd").write_text("".join(f"{line}\n" for line in header))
    data = fx.read_tiffs(tmp_path / "scan.mhd", SCAN)
    np.testing.assert_array_equal(data.counts(), COUNTS)
    monkeypatch.chdir(tmp_path)
    call = said[said.index("fx.DataSet") :].replace("GEOMETRY)", "scan)")
    made = eval(call[: call.index("scan)") + 5], {"fx": fx, "np": np, "scan": SCAN})
    np.testing.assert_array_equal(made.counts(), COUNTS)
