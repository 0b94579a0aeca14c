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


FOLDERS: dict[str, Callable[[Path], object]] = {
    "open": fx.open,
    "open with a geometry": lambda path: fx.open(path, geometry=SCAN),
    "images": lambda path: fx.read_tiffs(path, SCAN),
}


@pytest.mark.parametrize("names", ["p_{:03d}.raw", "{:d}.bin", "shot{:02d}.RAW"])
@pytest.mark.parametrize("door", FOLDERS)
def test_a_folder_of_raw_files_is_read_by_the_call_that_the_error_says(
    door: str, names: str, tmp_path: Path
) -> None:
    """As cameras write them: an image a file, a text in words, a dark image of its own."""
    for i, image in zip((2, 9, 10), COUNTS, strict=True):
        (tmp_path / names.format(i)).write_bytes(image.tobytes())
    (tmp_path / "readme.txt").write_text("5 wide, 4 high, uint16, source at 100 mm")
    (tmp_path / "thumbnail.dat").write_bytes(b"123")
    with pytest.raises(DatasetError) as refused:
        FOLDERS[door](tmp_path)
    said = str(refused.value)
    assert "3 files" in said
    assert "40 bytes each" in said
    call = said[said.index("fx.DataSet") :].replace("GEOMETRY)", "scan)")
    call = call.replace("ROWS", "4").replace("COLUMNS", "5")
    known = {"fx": fx, "np": np, "scan": SCAN, "Path": Path}
    made = eval(call[: call.index("scan)") + 5], known)
    np.testing.assert_array_equal(made.counts(), COUNTS)
