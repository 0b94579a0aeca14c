"""flexDATA's geometry.toml beside its own code, and beside its orbit written down once more."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_scans import SHAPE, some_parameters, some_poses, worst
from scipy.spatial.transform import Rotation

from flexdt.twin.exchange.flexdata import flexdata_text, read_flexdata
from flexdt.twin.exchange.geometry import ScanGeometry
from flexdt.twin.geometry.conventions import FloatArray


def orbit(toml: dict[str, Any], count: int) -> FloatArray:
    """The vectors flexDATA derives from its parameters without axis tilt, from its description.

    Source and panel go round counter-clockwise; the panel is rolled about its normal, then
    yawed about its own columns, then pitched about its own rows; v is upwards.
    """
    first, last = toml["ang_range"]
    pixel = toml["det_pixel"]
    source = [toml["src_tan"] - toml["axs_tan"], -toml["src2obj"], toml["src_ort"]]
    panel = [toml["det_tan"] - toml["axs_tan"], toml["det2obj"], toml["det_ort"]]
    degrees = [toml["det_roll"], toml["det_yaw"], toml["det_pitch"]]
    axes = Rotation.from_euler("YZX", degrees, degrees=True).as_matrix()
    shift = np.array([toml["vol_tra"][1], toml["vol_tra"][2], toml["vol_tra"][0]])
    out = []
    for angle in np.linspace(first, last, count):
        turn = Rotation.from_euler("z", angle, degrees=True).as_matrix()
        rows = axes[:, 0] * pixel * toml["det_sample"][1]
        columns = axes[:, 2] * pixel * toml["det_sample"][0]
        parts = [turn @ source - shift, turn @ panel - shift, turn @ rows, turn @ columns]
        out.append(np.concatenate(parts))
    return np.array(out)


def scan(seed: int) -> ScanGeometry:
    rng = np.random.default_rng(seed)
    return ScanGeometry(some_poses(rng, 7).cone_vec(some_parameters(rng)), SHAPE)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_numbers_mean_what_flexdata_says_they_mean(seed: int) -> None:
    geometry = scan(seed)
    toml = tomllib.loads(flexdata_text(geometry))
    assert worst(orbit(toml, 7), geometry.rows_up().cone_vec.rows) < 1e-9
    assert math.isclose(
        toml["img_pixel"],
        toml["det_pixel"] * toml["src2obj"] / (toml["src2obj"] + toml["det2obj"]),
    )


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_flexdata_itself_reads_it_and_sees_the_same(
    seed: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    data = pytest.importorskip(
        "flexdata.data", reason="flexdata is not installed", exc_type=ImportError
    )
    geometry = scan(seed)
    folder = tmp_path_factory.mktemp("flexdata")
    (folder / "geometry.toml").write_text(flexdata_text(geometry))
    theirs = data.read_geometrytoml(str(folder)).get_vectors(7)
    assert worst(np.array(theirs), geometry.rows_up().cone_vec.rows) < 1e-9


def test_ours_reads_what_flexdata_writes(tmp_path: Path) -> None:
    data = pytest.importorskip(
        "flexdata.data", reason="flexdata is not installed", exc_type=ImportError
    )
    from flexdata.geometry import circular

    geometry = circular(600.0, 450.0, 0.15, ang_range=(0, 350))
    geometry.parameters |= {"det_roll": 1.0, "det_yaw": -2.0, "det_pitch": 0.5, "src_ort": 3.0,
                            "det_tan": -4.0, "axs_tan": 0.5, "vol_tra": [1.0, 2, -3]}  # fmt: skip
    data.write_geometrytoml(str(tmp_path), geometry)
    back = read_flexdata((tmp_path / "geometry.toml").read_text(), 36, SHAPE)
    theirs = np.array(geometry.get_vectors(36))
    assert worst(back.rows_up().cone_vec.rows, theirs) < 1e-9
    assert back.shape == SHAPE


def test_tuples_and_older_names_are_read() -> None:
    text = flexdata_text(scan(2)).replace("[", "(").replace("]", ")")
    assert worst(read_flexdata(text).cone_vec.rows, scan(2).cone_vec.rows) < 1e-9
    toml = tomllib.loads(flexdata_text(scan(2)))
    total = toml["src2obj"] + toml["det2obj"]
    lines = [
        line
        for line in flexdata_text(scan(2)).splitlines()
        if not line.startswith("det2obj")
    ]
    other = "\n".join([*lines, f"src2det = {total!r}"])
    assert worst(read_flexdata(other).cone_vec.rows, scan(2).cone_vec.rows) < 1e-9
