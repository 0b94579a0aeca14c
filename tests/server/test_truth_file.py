"""Truth files: what a hidden misalignment may not be."""

from __future__ import annotations

from pathlib import Path

import pytest

from flexdt.server.imaging.projections import load_truth
from flexdt.twin.errors import MachineFileError


@pytest.mark.parametrize(
    "value", ["nan", "inf", "-inf", "1e300", "1" + 400 * "0", "true", '"x"']
)
def test_a_value_that_no_geometry_can_have_is_refused_with_its_key(
    tmp_path: Path, value: str
) -> None:
    file = tmp_path / "truth.toml"
    file.write_text(f"alpha = 0.1\ndO_x = {value}\n")
    with pytest.raises(MachineFileError, match=r"truth\.toml: dO_x: ") as caught:
        load_truth(file, tmp_path / "data")
    assert value not in caught.value.message.partition("dO_x: ")[2]
