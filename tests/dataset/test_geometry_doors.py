"""Geometry that no scanner has, through the reader of every format, and what is doubtful of it."""

import json

import numpy as np
import pytest

import flexdt as fx
from flexdt.library.datasets.exchange import import_geometry
from flexdt.library.datasets.geometry_content import Given
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.cone_vec import ConeVec

SHAPE = (6, 8)
SCAN = ConeVec.circular(sod=100, sdd=200, angles=12, shape=SHAPE, pixel=0.5)


def rtk(folder, **changed):
    """RTK's file with other numbers."""
    path = folder / "scan.xml"
    SCAN.save(path)
    text = path.read_text()
    for name, value in changed.items():
        parts = text.split(f"<{name}>")
        text = f"<{name}>{value}<".join(
            [parts[0], *(p.split("<", 1)[1] for p in parts[1:])]
        )
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "changed",
    [{"SourceToDetectorDistance": -1e-10}, {"SourceToDetectorDistance": 1e-10},
     {"SourceToDetectorDistance": -50}, {"SourceToIsocenterDistance": 0},
     {"SourceToIsocenterDistance": -300}, {"SourceToDetectorDistance": 0},
     {"SourceToDetectorDistance": "nan"}],
)  # fmt: skip
def test_distances_of_rtk(tmp_path, changed):
    with pytest.raises(TwinError, match=r"scan\.xml"):
        ConeVec.load(rtk(tmp_path, **changed), pixel=0.5, shape=SHAPE)
    assert len(ConeVec.load(rtk(tmp_path), pixel=0.5, shape=SHAPE)) == 12


@pytest.mark.parametrize(
    "changed",
    [{"src2obj": 0}, {"src2obj": -5}, {"det2obj": -50}, {"det_pixel": 0}, {"det_pixel": -0.1},
     {"det_pixel": 150}],
)  # fmt: skip
def test_distances_of_flexdata(tmp_path, changed):
    path = tmp_path / "scan.toml"
    SCAN.save(path)
    lines = [
        line for line in path.read_text().splitlines() if line.split()[0] not in changed
    ]
    path.write_text("\n".join([*lines, *(f"{k} = {v}" for k, v in changed.items())]))
    with pytest.raises(TwinError, match=r"scan\.toml"):
        ConeVec.load(path)


@pytest.mark.parametrize("ending", [".npy", ".txt", ".csv", ".npz", ".json"])
@pytest.mark.parametrize("kind", ["near", "no pixel", "SOD 0"])
def test_rows_that_no_scanner_has(tmp_path, ending, kind):
    beam = SCAN.detector - SCAN.source
    source, panel, u, v = SCAN.source, SCAN.detector, SCAN.u, SCAN.v
    if kind == "near":
        panel = source + 1e-10 * beam
    elif kind == "no pixel":
        u = 0.0 * u
    else:
        source = 0.0 * source
    path = tmp_path / f"scan{ending}"
    ConeVec.from_vectors(source, panel, u, v, SHAPE).save(path)
    with pytest.raises(TwinError, match=r"scan\."):
        ConeVec.load(path, shape=SHAPE)


@pytest.mark.parametrize("ending", [".npy", ".txt", ".csv", ".npz", ".json", ".toml"])
def test_right_rows_and_virtual_panels_are_read(tmp_path, ending):
    virtual = ConeVec.circular(sod=100, sdd=100, angles=12, shape=SHAPE, pixel=0.25)
    for i, scan in enumerate((SCAN, virtual)):
        path = tmp_path / f"scan{i}{ending}"
        scan.save(path)
        back = ConeVec.load(path, shape=SHAPE)
        assert np.abs(back.rows - scan.rows).max() < 1e-4


def test_radians_in_a_table_are_among_the_notes(tmp_path):
    scan = ConeVec.circular(
        sod=100, sdd=200, angles=np.linspace(0, 6.28, 40), shape=SHAPE, pixel=1
    )
    scan.save(tmp_path / "scan.csv")
    found = import_geometry(tmp_path / "scan.csv", "csv", Given(SHAPE))
    assert any("radians" in note for note in found.notes)


def test_a_document_with_a_mark_and_one_of_nothing(tmp_path):
    path = tmp_path / "scan.json"
    SCAN.save(path)
    path.write_text("\ufeff" + path.read_text())
    assert np.array_equal(ConeVec.load(path).rows, SCAN.rows)
    path.write_text(json.dumps({"kind": "flexdt geometry", "schema": 1, "cone_vec": []}))
    with pytest.raises(TwinError, match="no view"):
        ConeVec.load(path)


@pytest.mark.parametrize("voxel", [500.0, 30.0])
def test_voxels_larger_than_the_field_of_view_are_refused(voxel):
    data = fx.DataSet.from_arrays(
        np.full((12, *SHAPE), 500), SCAN, flat=np.full(SHAPE, 1000)
    )
    with pytest.raises(TwinError, match="is the voxel in mm"):
        data.reconstruct("fdk", voxel=voxel)


@pytest.mark.parametrize("scale", [1e-6, 1e-4, 1e-3, 1.0, 1e4])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_default_voxel_follows_the_scale(scale):
    from flexdt.twin.reconstruction import field_of_view

    scan = ConeVec(SCAN.rows * scale, SHAPE)
    grid = field_of_view(scan, SHAPE)
    assert grid.voxel_mm == pytest.approx(0.25 * scale, rel=0.01)
    assert grid.shape == field_of_view(SCAN, SHAPE).shape
