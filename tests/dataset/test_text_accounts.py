"""Every line of the scanner's own texts is used, contradicted, or ignored by name."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile

import flexdt as fx

DATA = Path(__file__).parents[1] / "data" / "dataset"
TEXTS = {
    "scan settings.txt": "flexray_scan_settings.txt",
    "data settings XRE.txt": "flexray_data_settings_XRE.txt",
}
SHAPE = (760, 956)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("texts")
    image = np.full(SHAPE, 30_000, np.uint16)
    for name in ("scan_000000.tif", "io000000.tif"):
        tifffile.imwrite(folder / name, image)
    return folder


@pytest.fixture
def opened(images: Path, tmp_path: Path) -> Callable[..., fx.DataSet]:
    def open_with(change: Callable[[str, str], str], *files: str) -> fx.DataSet:
        for name in ("scan_000000.tif", "io000000.tif"):
            (tmp_path / name).symlink_to(images / name)
        for name in files or TEXTS:
            text = (DATA / TEXTS[name]).read_bytes().decode()
            (tmp_path / name).write_bytes(change(name, text).encode())
        return fx.open(tmp_path)

    return open_with


def test_a_right_scan_has_a_use_for_every_line(opened: Callable[..., fx.DataSet]) -> None:
    data = opened(lambda _, text: text)
    assert not data.provenance.unknown
    assert not data.provenance.of("contradicted")
    assert not [one for one in data.warnings if "ignored" in one or "which is" in one]
    used = {one.field for one in data.provenance.of("used")}
    assert {"SOD", "HC", "rot_obj", "Tube voltage", "Start angle"} <= used
    lines = (DATA / TEXTS["scan settings.txt"]).read_text().splitlines()
    keys = {line.partition(":")[0].strip() for line in lines if " : " in line}
    assert keys <= {one.field for one in data.provenance}


@pytest.mark.parametrize("name", TEXTS)
@pytest.mark.parametrize("line", ["unknown_thing : 7.25", "unknown_thing = 7.25"])
def test_a_line_that_is_not_known_is_named(
    name: str, line: str, opened: Callable[..., fx.DataSet]
) -> None:
    def change(_: str, text: str) -> str:
        return re.sub(r"(Operator [:=])", f"{line}\r\n\\1", text, count=1)

    data = opened(change, name)
    (said,) = data.provenance.unknown
    assert said.field.endswith("unknown_thing")
    assert sum("unknown_thing = 7.25" in one for one in data.warnings) == 1


@pytest.mark.parametrize(
    ("line", "other", "words"),
    [
        ("Voxel size : 84.759207", "Voxel size : 97.1", "Voxel size is 97.1"),
        ("Magnification : 1.765000", "Magnification : 2.0", "give 1.765"),
        ("SOD : 600.000003", "SOD : 600.000003\r\nSOD : 610", "SOD is stated twice"),
        ("Tube voltage : 90.000000", "Tube voltage : 70", "kV set value is 90.0"),
    ],
)
def test_what_contradicts_is_told_with_both_values(
    line: str, other: str, words: str, opened: Callable[..., fx.DataSet]
) -> None:
    data = opened(lambda _, text: text.replace(line, other))
    assert any(words in one for one in data.warnings), data.warnings
    assert len(data.provenance.of("contradicted")) == 1


def test_the_two_texts_are_compared(opened: Callable[..., fx.DataSet]) -> None:
    def change(name: str, text: str) -> str:
        old, new = 'SOD = "600.000000"', 'SOD = "512.5"'
        assert name != "data settings XRE.txt" or old in text
        return text.replace(old, new)

    data = opened(change)
    told = [one for one in data.warnings if "512.5" in one]
    assert len(told) == 1
    assert "600.000003, which is taken" in told[0]
    (said,) = data.provenance.of("contradicted")
    assert said.field == "CT-parameters IN/SOD"


def test_the_uses_are_saved(opened: Callable[..., fx.DataSet], tmp_path: Path) -> None:
    data = opened(lambda _, text: text)
    shutil.rmtree(tmp_path / "kept", ignore_errors=True)
    data[:1].save(tmp_path / "kept")
    assert fx.open(tmp_path / "kept").provenance == data.provenance
