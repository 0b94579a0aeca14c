"""What a user says takes the place of what a file states, and the file's values say so."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_scans import ANGLES, FORMATS, SDD, SHAPE, SOD, VIEWS, Draw

import flexdt as fx
from flexdt.twin.dataset.dataset_errors import DatasetError

OWN = fx.ConeVec.circular(sod=SOD, sdd=SDD, angles=ANGLES + 7.0, shape=SHAPE, pixel=1.5)
STATED = {
    "Nikon": ("AngularStep", "SrcToObject", "WhiteLevel"),
    "SkyScan": ("Rotation Step (deg)", "Object to Source (mm)", "Reference Intensity"),
    "phoenix": ("CT/RotationSector", "Geometry/FOD", "Image/FreeRay"),
    "YXLON": ("ScanTrajectory/Rotation", "ScanTrajectory/Fod", "ProjectionBitdepth"),
    "Varian": ("xim/KVSourceRtn", "SAD", "air/KVNormChamber"),
    "Data Exchange": ("exchange/theta", "pixel_size_x", "exchange/data_white"),
    "NXtomo": ("rotation_angle", "source/distance", "detector/data"),
}
"""Format -> fields of the angles, of the geometry and of the open beam."""
REFUSED = {
    "SkyScan": ("Scanning Trajectory", "SPIRAL"),
    "phoenix": ("Trajectory/Active", 1),
    "YXLON": ("ScanTrajectory@type", "helix"),
}
"""Format -> a trajectory of which its table says to give geometry=."""


def written(form: str, folder: Path) -> tuple[Path, Draw]:
    if form in ("Data Exchange", "NXtomo"):
        pytest.importorskip("h5py")
    make, _, write = FORMATS[form]
    draw = make(np.random.default_rng(5))
    return write(folder, draw), draw


def uses(data: Any, name: str) -> set[str]:
    found = [one for one in data.provenance if one.field.endswith(name)]
    assert found, [one.field for one in data.provenance]
    return {one.use.value for one in found}


@pytest.mark.parametrize("form", STATED)
def test_angles_of_the_caller_contradict_those_of_the_file(
    form: str, tmp_path: Path
) -> None:
    path, draw = written(form, tmp_path)
    angles, place, _ = STATED[form]
    own = fx.open(path, **draw.open)
    assert uses(own, angles) == {"used"}
    other = np.linspace(0.0, 200.0, VIEWS)
    data = fx.open(path, angles=other, **draw.open)
    assert uses(data, angles) == {"contradicted"}
    assert uses(data, place) == {"used"}
    assert any("angle" in told for told in {*data.warnings} - {*own.warnings})
    assert np.ptp(data.angles_deg) == pytest.approx(200.0)


@pytest.mark.parametrize("form", STATED)
def test_a_geometry_of_the_caller_contradicts_the_file_s(
    form: str, tmp_path: Path
) -> None:
    path, _ = written(form, tmp_path)
    angles, place, beam = STATED[form]
    data = fx.open(path, geometry=OWN)
    assert uses(data, angles) == uses(data, place) == {"contradicted"}
    assert uses(data, beam) == {"used"}
    assert np.array_equal(data.geometry.rows, OWN.rows)


@pytest.mark.parametrize(
    "form", [name for name in STATED if name not in ("NXtomo", "Varian")]
)
def test_an_open_beam_of_the_caller_contradicts_the_file_s(
    form: str, tmp_path: Path
) -> None:
    path, draw = written(form, tmp_path)
    _, place, beam = STATED[form]
    data = fx.open(path, open_beam=61_000.0, **draw.open)
    assert uses(data, beam) == {"contradicted"}
    assert uses(data, place) == {"used"}


@pytest.mark.parametrize("form", REFUSED)
def test_another_trajectory_opens_with_a_geometry(form: str, tmp_path: Path) -> None:
    _, draw = written(form, tmp_path / "first")
    draw.set(*REFUSED[form])
    if form == "YXLON":  # an attribute, which the writer of elements does not write
        path, _ = written(form, tmp_path)
        text = path.read_text()
        path.write_text(text.replace("<ScanTrajectory>", '<ScanTrajectory type="helix">'))
    else:
        path = FORMATS[form][2](tmp_path, draw)
    with pytest.raises(DatasetError, match="geometry="):
        fx.open(path)
    data = fx.open(path, geometry=OWN)
    assert uses(data, REFUSED[form][0]) == {"contradicted"}


@pytest.mark.parametrize("tilt", [0.0, 3.0])
def test_the_voltage_of_a_file_is_saved(tilt: float, tmp_path: Path) -> None:
    """The scanner's texts cannot state a leaning axis; the voltage is kept all the same."""
    make, _, write = FORMATS["Nikon"]
    draw = make(np.random.default_rng(5))
    draw.set("XraykV", 143.5)
    draw.set("ObjectTilt", tilt)
    data = fx.open(write(tmp_path / "nikon", draw))
    data.save(tmp_path / "kept")
    again = fx.open(tmp_path / "kept")
    assert again.settings is not None
    assert again.settings.kV == 143.5
    again.save(tmp_path / "twice")
    twice = fx.open(tmp_path / "twice")
    assert twice.settings is not None
    assert twice.settings.kV == 143.5
    assert twice.provenance == data.provenance
