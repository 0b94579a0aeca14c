"""Contradictions are named with their cause, and right arguments are told nothing."""

import warnings

import numpy as np
import pytest

import flexdt as fx
from flexdt.twin.errors import GeometryError, TwinError
from flexdt.twin.findings import Severity
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.plausibility import Operation, examine
from flexdt.twin.plausibility.pixel_values import integral_findings, volume_findings
from flexdt.twin.plausibility.scan_geometry import distance_findings, radian_findings
from flexdt.twin.projection import Grid, Volume
from flexdt.twin.reconstruction import cgls, fdk, sirt, tv

SHAPE = (24, 32)
BALL = {"kind": "sphere", "center": [1, 2, 0], "radius": 5, "material": "pmma"}


def scan(angles=60, **more):
    given = {"sod": 100, "sdd": 200, "shape": SHAPE, "pixel": 1.0, **more}
    return ConeVec.circular(angles=angles, **given)


def kinds(findings):
    return [one.code for one in findings]


@pytest.mark.parametrize("end", [2 * np.pi, np.pi, 3.49, 1.5 * np.pi])
@pytest.mark.parametrize("views", [9, 60, 361])
def test_radians_given_as_degrees(end, views):
    wrong = scan(np.linspace(0, end, views, endpoint=False))
    assert kinds(examine(Operation.OPEN, wrong, SHAPE)) == ["angles in radians"]
    with pytest.warns(UserWarning, match="radians given as degrees"):
        sirt(np.zeros((views, *SHAPE)), wrong, Grid((8, 8, 8), 1.0), iterations=1)
    right = scan(np.degrees(np.linspace(0, 2 * np.pi, views, endpoint=False)))
    assert not examine(Operation.ITERATE, right, SHAPE)


@pytest.mark.parametrize(
    "angles",
    [np.arange(0, 360), np.linspace(0, 360, 90), np.linspace(0, 360, 1200), np.arange(0, 200, 0.5),
     np.linspace(0, 180, 45), np.linspace(-180, 180, 100)],
)  # fmt: skip
def test_degrees_given_as_radians(angles):
    assert kinds(radian_findings(angles)) == ["angles in degrees"]
    assert not list(radian_findings(np.radians(angles)))
    astra = {"type": "cone", "DetectorRowCount": 24, "DetectorColCount": 32, "DetectorSpacingX": 1,
             "DetectorSpacingY": 1, "DistanceOriginSource": 100, "DistanceOriginDetector": 100,
             "ProjectionAngles": angles}  # fmt: skip
    with pytest.warns(UserWarning, match="were degrees given"):
        ConeVec.from_astra(astra)


def test_turns_and_golden_steps_are_right_in_radians():
    golden = np.pi * (3 - np.sqrt(5))
    for angles in (
        golden * np.arange(150),
        golden * np.arange(777),
        np.linspace(0, 60, 3000),
    ):
        assert not list(radian_findings(angles))


@pytest.mark.parametrize("arc", [50, 90, 120, 140])
@pytest.mark.parametrize("method", [sirt, cgls, tv])
def test_limited_arcs_of_iterative_methods(arc, method):
    views = scan(np.linspace(-20, arc - 20, 40))
    with pytest.warns(UserWarning, match="of 180 deg of directions"):
        method(np.zeros((40, *SHAPE)), views, Grid((8, 8, 8), 1.0), iterations=1)


@pytest.mark.parametrize("views", [3, 4, 7, 12, 13, 40])
def test_whole_turns_half_turns_and_drawn_angles_are_no_limited_arcs(views):
    rng = np.random.default_rng(views)
    for angles in (views, np.arange(views) * 180 / views, np.arange(views) * 137.5077,
                   np.arange(views) * 360 / views + rng.normal(0, 30 / views, views)):  # fmt: skip
        assert not examine(Operation.ITERATE, scan(angles), SHAPE)


@pytest.mark.parametrize("inclined", [12, 30, 45])
def test_laminography_is_sent_to_an_iterative_method(inclined):
    height = 100 * np.tan(np.radians(inclined))
    level = scan(60)
    source = level.source + [0, 0, -height]
    towards = -source / np.linalg.norm(source, axis=1, keepdims=True)
    right = level.u / np.linalg.norm(level.u, axis=1, keepdims=True)
    tilted = ConeVec.from_vectors(
        source, 100 * towards, right, np.cross(towards, right), SHAPE
    )
    found = examine(Operation.FDK, tilted, SHAPE, grid=np.array([[-4.0] * 3, [4.0] * 3]))
    assert kinds(found) == ["laminography"]
    assert (found[0].severity is Severity.ERROR) == (inclined > 20)
    assert "iterative" in found[0].remedy
    assert not examine(Operation.ITERATE, tilted, SHAPE)


@pytest.mark.parametrize(
    ("sod", "sdd", "pixel"),
    [(0, 100, 0.1), (200, 100, 0.1), (-5, 100, 0.1), (50, 100, 0), (50, 100, -1), (50, 100, 80),
     (50, 1e-10, 0.1), (1e-12, 1e-10, 0.1), (np.nan, 100, 0.1), (50, np.inf, 0.1)],
)  # fmt: skip
def test_impossible_distances(sod, sdd, pixel):
    assert [one.severity for one in distance_findings(sod, sdd, pixel)] == [
        Severity.ERROR
    ]


def test_pixels_of_another_unit():
    assert kinds(examine(Operation.OPEN, scan(pixel=25.0), SHAPE)) == ["units"]
    with pytest.raises(GeometryError, match="mm"):
        fx.project(BALL, scan(pixel=150.0))
    with pytest.warns(UserWarning, match="times as large as the panel"):
        fx.project(BALL, scan(pixel=1e-3))


def test_hounsfield_units_are_refused_and_grey_values_said():
    rng = np.random.default_rng(0)
    hounsfield = rng.normal(0, 300, (8, 8, 8)).astype(np.float32) - 500
    with pytest.raises(TwinError, match="Hounsfield"):
        fx.project(Volume(hounsfield, 1.0), scan())
    with pytest.raises(TwinError, match="Hounsfield"):
        fx.simulate(hounsfield, scan(), voxel_mm=1.0)
    with pytest.warns(UserWarning, match="more than any element"):
        fx.project(Volume(np.full((8, 8, 8), 255.0, np.float32), 1.0), scan())


def test_voxels_that_are_no_numbers_are_said():
    data = np.full((8, 8, 8), 0.02, np.float32)
    data[0, 0, 0] = np.nan
    with pytest.warns(UserWarning, match="no numbers"):
        fx.project(Volume(data, 1.0), scan())
    assert not list(volume_findings(np.nan_to_num(data)))


@pytest.mark.parametrize("level", [300.0, 5000.0, 60000.0])
@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int32, np.int64])
def test_counts_are_no_line_integrals(level, kind):
    right = fx.project(BALL, scan())
    counts = (level * np.exp(-right)).astype(kind)
    for method in (fdk, sirt):
        with pytest.raises(TwinError, match="flat"):
            method(counts, scan(), Grid((8, 8, 8), 1.0))


def test_transmission_is_no_line_integral():
    rng = np.random.default_rng(1)
    right = 4.0 * fx.project(BALL, scan())
    assert not list(integral_findings(right))
    noisy = np.exp(-right) * rng.normal(1.0, 0.01, right.shape)
    assert kinds(integral_findings(noisy)) == ["transmission"]
    with pytest.warns(UserWarning, match="transmission"):
        sirt(noisy, scan(), Grid((8, 8, 8), 1.0), iterations=1)


def test_whole_numbers_have_lost_their_fractions():
    cut = (9 * fx.project(BALL, scan())).astype(np.int64)
    with pytest.warns(UserWarning, match="no fractions"):
        sirt(cut, scan(), Grid((8, 8, 8), 1.0), iterations=1)


@pytest.mark.parametrize("method", [fdk, sirt, cgls, tv])
def test_grids_beside_the_field_of_view(method):
    right = fx.project(BALL, scan())
    aside = Grid((8, 8, 8), 1.0, (500.0, 0.0, 0.0))
    with pytest.raises(GeometryError, match="no view sees any of the grid"):
        method(right, scan(), aside)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        method(right, scan(), Grid((8, 8, 8), 1.0, (3.0, 0.0, 0.0)), **(
            {} if method is fdk else {"iterations": 1}))  # fmt: skip
    with pytest.warns(UserWarning, match="beside the field of view"):
        method(right, scan(), Grid((8, 80, 80), 1.0), **(
            {"errors": False} if method is fdk else {"iterations": 1}))  # fmt: skip
