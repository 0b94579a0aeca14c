"""The tube's voltage that a maker's file states reaches corrections that need it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drawn_scans
import numpy as np
import pytest

import flexdt as fx
from flexdt.twin.errors import LimitError

FIELDS = {
    "Nikon": "XraykV",
    "SkyScan": "Source Voltage (kV)",
    "phoenix": "Xray/Voltage",
    "YXLON": "Voltage",
    "Varian": "xim/KVKiloVolts",
}


def scan(form: str, value: Any, folder: Path) -> fx.DataSet:
    make, _, write = drawn_scans.FORMATS[form]
    draw = make(np.random.default_rng(3))
    draw.drop(FIELDS[form])
    if value is not None:
        draw.set(FIELDS[form], value)
    return fx.open(write(folder, draw))


@pytest.mark.parametrize("form", FIELDS)
def test_the_voltage_of_a_file_is_used(form: str, tmp_path: Path) -> None:
    data = scan(form, 83.0, tmp_path / "with")
    assert data.settings is not None
    assert data.settings.kV == 83.0
    (said,) = [one for one in data.provenance if one.field == FIELDS[form]]
    assert said.use == "used"
    assert scan(form, None, tmp_path / "without").settings is None


@pytest.mark.parametrize("value", ["off", "0", "-5", "nan", "inf", ""])
def test_a_voltage_that_is_none_is_not_used(value: str, tmp_path: Path) -> None:
    data = scan("SkyScan", value, tmp_path)
    assert data.settings is None
    (said,) = [one for one in data.provenance if "Voltage" in one.field]
    assert said.use == "ignored"


@pytest.mark.filterwarnings("ignore:no accuracy is claimed")
def test_beam_hardening_is_corrected_for_the_voltage_of_the_file(tmp_path: Path) -> None:
    options: dict[str, Any] = {"shape": (8, 8, 8), "material": "aluminium"}
    stated = scan("Nikon", 90.0, tmp_path / "with").reconstruct("fdk", **options)
    bare = scan("Nikon", None, tmp_path / "without")
    given = bare.reconstruct("fdk", tube=fx.Tube(kV=90.0), **options)
    other = bare.reconstruct("fdk", tube=fx.Tube(kV=50.0), **options)
    np.testing.assert_array_equal(stated.data, given.data)
    assert not np.allclose(stated.data, other.data, rtol=1e-3)
    with pytest.raises(LimitError, match="does not say its tube voltage"):
        bare.reconstruct("fdk", **options)


def test_a_voltage_is_saved_with_images_in_memory(tmp_path: Path) -> None:
    scan("Varian", 83.0, tmp_path / "made").save(tmp_path / "saved")
    again = fx.open(tmp_path / "saved")
    assert again.settings is not None
    assert again.settings.kV == 83.0
