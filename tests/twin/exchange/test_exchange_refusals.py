"""What a format cannot carry, and files that do not hold: errors that say what and where."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_scans import SHAPE, some_poses, worst

from flexdt.twin.errors import GeometryError
from flexdt.twin.exchange.cil_arrays import PANEL, POSES, read_cil
from flexdt.twin.exchange.flexdata import flexdata_text, read_flexdata
from flexdt.twin.exchange.geometry import ExchangeError, ScanGeometry
from flexdt.twin.exchange.leap_arrays import NAMES as LEAP_NAMES
from flexdt.twin.exchange.leap_arrays import read_leap
from flexdt.twin.exchange.number_tables import (
    read_csv,
    read_geometry_text,
    read_tomosipo,
    read_vectors_array,
    read_vectors_text,
    tomosipo_arrays,
)
from flexdt.twin.exchange.rtk_xml import read_rtk, rtk_text
from flexdt.twin.exchange.tigre_arrays import ANGLES, PER_VIEW, read_tigre
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.poses import Poses

CIL_NAMES = (*POSES, *PANEL)
TIGRE_NAMES = (*PER_VIEW, "nDetector", "dDetector", ANGLES)
RNG = np.random.default_rng(1)
STILL = ScanGeometry(some_poses(RNG).cone_vec(), SHAPE)


def changed(column: int, by: float, view: int = 2) -> ScanGeometry:
    rows = STILL.cone_vec.rows.copy()
    rows[view, column] += by
    return ScanGeometry(ConeVec(rows), SHAPE)


def test_flexdata_refuses_what_it_cannot_state() -> None:
    uneven = ScanGeometry(
        some_poses(np.random.default_rng(2), even=False).cone_vec(), SHAPE
    )
    with pytest.raises(ExchangeError, match="no list of angles"):
        flexdata_text(uneven)
    with pytest.raises(ExchangeError, match=r"one circle .* in view 2"):
        flexdata_text(changed(2, 0.1))
    with pytest.raises(ExchangeError, match="cosine"):
        flexdata_text(changed(9, 0.1))


def test_flexdata_takes_rounded_angles() -> None:
    poses = some_poses(np.random.default_rng(2), 9)
    rounded = np.radians(np.round(np.degrees(poses.angle), 6))
    steps = Poses(poses.source, poses.axis, poses.detector, poses.u, poses.v, rounded)
    geometry = ScanGeometry(steps.cone_vec(), SHAPE)
    back = read_flexdata(flexdata_text(geometry))
    assert 1e-9 < worst(back.cone_vec.rows, geometry.cone_vec.rows) < 1e-4


def test_rtk_refuses_skew_and_changing_pixels() -> None:
    with pytest.raises(ExchangeError, match="their cosine in view 2"):
        rtk_text(changed(9, 0.1))
    rows = STILL.cone_vec.rows.copy()
    rows[3, 6:12] *= 1.01
    with pytest.raises(ExchangeError, match="one pixel size; its change in view 3"):
        rtk_text(ScanGeometry(ConeVec(rows), SHAPE))
    flat = ConeVec.from_vectors([0, 0, 5.0], [9, 0, 5.0], [1.0, 0, 0], [0, 1.0, 0])
    with pytest.raises(ExchangeError, match="panel's plane"):
        rtk_text(ScanGeometry(flat, SHAPE))


def test_rtk_holds_a_panel_that_lies_flat() -> None:
    flat = ConeVec.from_vectors(
        [3.0, 1, 500], [2.0, -4, -300], [0.6, 0.8, 0], [0.8, -0.6, 0]
    )
    one = ScanGeometry(flat, SHAPE)
    assert worst(read_rtk(rtk_text(one), (1.0, 1.0)).cone_vec.rows, flat.rows) < 1e-9


def test_tomosipo_needs_the_shape() -> None:
    with pytest.raises(ExchangeError, match="shape"):
        tomosipo_arrays(ScanGeometry(STILL.cone_vec))


def test_a_geometry_is_of_one_scan() -> None:
    with pytest.raises(ExchangeError, match="7 views but 1 files"):
        ScanGeometry(STILL.cone_vec, SHAPE, files=("a",))
    standing = ConeVec.from_vectors([0, -9.0, 0], [0, 9.0, 0], [0, 0, 1.0], [1.0, 0, 0])
    with pytest.raises(GeometryError, match="u is vertical"):
        Poses.from_cone_vec(standing)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "no view"),
        ("1 2 3", "x:1: 3 numbers; allowed: 12"),
        ("# c\n" + "1 " * 11 + "one", "x:2: 'one' is no number"),
        ("1 " * 11 + "nan", "not finite"),
        ("0 " * 12, "span no panel"),
    ],
)
def test_bad_vectors(text: str, says: str) -> None:
    with pytest.raises(ExchangeError, match=says):
        read_vectors_text(text, "x")


@pytest.mark.parametrize(
    "array", [np.zeros((3, 11)), np.zeros(12), np.array([["a"] * 12])]
)
def test_bad_arrays(array: np.ndarray[Any, Any]) -> None:
    with pytest.raises(ExchangeError, match="allowed: n x 12"):
        read_vectors_array(array)


def test_bad_tables() -> None:
    with pytest.raises(ExchangeError, match="header lacks source_x"):
        read_csv("a,b\n1,2\n")
    with pytest.raises(ExchangeError, match="header lacks source_x"):
        read_csv("# nothing\n")
    good = tomosipo_arrays(STILL)
    with pytest.raises(ExchangeError, match="lacks det_v"):
        read_tomosipo({k: v for k, v in good.items() if k != "det_v"})
    with pytest.raises(ExchangeError, match="det_u of shape"):
        read_tomosipo(good | {"det_u": np.zeros((3, 3))})


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("<x", "not valid XML"),
        ("<x/>", "allowed: RTKThreeDCircularGeometry version 3"),
        ('<RTKThreeDCircularGeometry version="2"/>', "version 3"),
        ('<RTKThreeDCircularGeometry version="3"/>', "no view"),
        (
            '<RTKThreeDCircularGeometry version="3"><RadiusCylindricalDetector>5'
            "</RadiusCylindricalDetector><SourceToIsocenterDistance>5"
            "</SourceToIsocenterDistance><SourceToDetectorDistance>9"
            "</SourceToDetectorDistance><Projection/></RTKThreeDCircularGeometry>",
            "RadiusCylindricalDetector is 5",
        ),
        (
            '<RTKThreeDCircularGeometry version="3"><Projection><GantryAngle>x</GantryAngle>'
            "</Projection></RTKThreeDCircularGeometry>",
            "GantryAngle is 'x'",
        ),
        (
            '<RTKThreeDCircularGeometry version="3"><Projection><GantryAngle>1</GantryAngle>'
            "</Projection></RTKThreeDCircularGeometry>",
            "parallel",
        ),
    ],
)
def test_bad_rtk(text: str, says: str) -> None:
    with pytest.raises(ExchangeError, match=says):
        read_rtk(text, (1.0, 1.0))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("det_pixel", None), "det_pixel must be 1 finite"),
        (("det_pixel", '"big"'), "det_pixel must be 1 finite"),
        (("axs_roll", "1.0"), "axs_roll is 1.0"),
        (("vol_rot", "[0.0, 1.0, 0.0]"), r"vol_rot is \[0.0, 1.0, 0.0\]"),
        (("ang_range", "[0.0]"), "ang_range must be 2 finite"),
        (("proj_count", None), "how many views"),
        (("src2obj", None), "two of src2obj, det2obj and src2det"),
        *(
            (("det_rows", wrong), "det_rows must be 1 finite")
            for wrong in ("nan", "inf", '"12"', "true", "[10, 2]", "{x = 1}")
        ),
        (("det_sample", "[[1], [2]]"), "det_sample must be 2 finite"),
    ],
)
def test_bad_flexdata(change: tuple[str, str | None], says: str) -> None:
    name, value = change
    lines = [f"{name} = {value}" if line.startswith(f"{name} =") else line
             for line in flexdata_text(STILL).splitlines()
             if value is not None or not line.startswith(f"{name} =")]  # fmt: skip
    with pytest.raises(ExchangeError, match=says):
        read_flexdata("\n".join(lines))


@settings(max_examples=40, deadline=None)
@given(st.binary(max_size=80).map(lambda b: b.decode("latin-1")))
def test_noise_is_refused(text: str) -> None:
    for read in (read_csv, read_flexdata, read_geometry_text, read_vectors_text):
        with pytest.raises(ExchangeError):
            read(text)
    with pytest.raises(ExchangeError):
        read_rtk(text, (1.0, 1.0))


@settings(max_examples=40, deadline=None)
@given(st.dictionaries(
    st.sampled_from([*TIGRE_NAMES, *CIL_NAMES, *LEAP_NAMES]),
    st.one_of(st.floats(), st.integers(-2, 9), st.text(max_size=3),
              st.lists(st.floats(-9, 9), max_size=6),
              st.lists(st.lists(st.floats(-9, 9), min_size=3, max_size=3), max_size=3)),
))  # fmt: skip
def test_noise_in_arrays_is_refused(values: dict[str, Any]) -> None:
    arrays = {name: np.asarray(value) for name, value in values.items()}
    for read in (read_cil, read_tigre, read_leap):
        with pytest.raises(ExchangeError):
            read(arrays)


@pytest.mark.parametrize(("sid", "sdd"), [(120.0, -240.0), (-120.0, 240.0)])
def test_rtks_distances_of_two_signs_are_told_as_they_stand(
    sid: float, sdd: float
) -> None:
    text = (
        '<?xml version="1.0"?><RTKThreeDCircularGeometry version="3"><Projection>'
        f"<SourceToIsocenterDistance>{sid}</SourceToIsocenterDistance>"
        f"<SourceToDetectorDistance>{sdd}</SourceToDetectorDistance>"
        "</Projection></RTKThreeDCircularGeometry>"
    )
    said = rf"IsocenterDistance is {sid:g} mm and SourceToDetectorDistance {sdd:g} mm"
    with pytest.raises(ExchangeError, match=said):
        read_rtk(text, (0.5, 0.5))
