"""Truth files: what a hidden misalignment may not be."""

from __future__ import annotations

from pathlib import Path

import pytest

from flexdt.server.imaging.projections import TrueGeometry, load_truth
from flexdt.twin.errors import GeometryError, MachineFileError
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.machine.description import builtin_machine, builtin_profile


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


@pytest.mark.parametrize(
    ("value", "where"),
    [({"det_yaw": 8.125}, "tra_obj -234"), ({"dO_x": 81250.5}, "implausible")],
)
def test_a_truth_is_judged_as_a_correction_is_and_not_repeated(
    value: dict[str, float], where: str
) -> None:
    machine = builtin_machine()
    truth = TrueGeometry(Offsets.from_edge(value))
    with pytest.raises(GeometryError, match=where) as caught:
        truth.require_applicable(machine, builtin_profile(machine.default_profile))
    assert "812" not in str(caught.value) + str(caught.value.data)
    TrueGeometry().require_applicable(machine, builtin_profile(machine.default_profile))
