"""Data sets in memory, in folders, in slices and in other programs' containers."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import tifffile
from numpy.testing import assert_allclose, assert_array_equal

import flexdt as fx
from flexdt.twin.calibration.fit.priors import exact
from flexdt.twin.dataset.dataset_errors import (
    DatasetExistsError,
    DatasetFormatError,
    DatasetMissingError,
)
from flexdt.twin.geometry.offsets import Offsets

SCAN = fx.ConeVec.circular(
    sod=600, sdd=1000, angles=12, shape=(20, 24), pixel=1.0, offset=(1, 0.5)
)
BALL = [{"kind": "sphere", "center": [3, 0, 0], "radius": 4, "material": "pmma"}]


@pytest.fixture(scope="module")
def data() -> fx.DataSet:
    return fx.simulate(BALL, SCAN, noise=1)


def beer(
    counts: npt.ArrayLike, dark: npt.ArrayLike, flat: npt.ArrayLike
) -> npt.NDArray[np.float64]:
    p, d, f = (np.asarray(a, dtype=np.float64) for a in (counts, dark, flat))
    return np.asarray(-np.log((p - d) / (f - d)))


def test_images_are_line_integrals_by_number_and_in_order(data: fx.DataSet) -> None:
    expected = beer(data.counts(), data.dark, data.flat)
    assert len(data) == 12
    assert data.line_integrals().shape == (12, 20, 24)
    assert_allclose(data.line_integrals(), expected, atol=1e-5)
    assert_allclose(np.stack(list(data)), expected, atol=1e-5)
    assert_allclose(data[np.int64(-1)], expected[-1], atol=1e-5)
    with pytest.raises(IndexError):
        data[12]
    assert re.fullmatch(
        r"<DataSet 'scene': 12 projections of 20 x 24 \(rows x columns\), \d+ kV, complete>",
        repr(data),
    )


def test_slices_are_data_sets(data: fx.DataSet) -> None:
    some = data[3:9:2]
    assert some.geometry == SCAN[3:9:2]
    assert_array_equal(some.counts(), data.counts()[3:9:2])
    picked = data[[7, 2]]
    assert [f.file for f in picked.frames] == ["scan_000007.tif", "scan_000002.tif"]
    assert_array_equal(picked[0], data[7])
    assert len(data[5:5]) == 0


def test_a_folder_gives_the_data_set_back(data: fx.DataSet, tmp_path: Path) -> None:
    folder = tmp_path / "saved"
    data.save(str(folder))
    back = fx.open(folder)
    assert back.complete
    assert back.geometry == data.geometry
    assert_array_equal(back.counts(), data.counts())
    assert_array_equal(back.line_integrals(), data.line_integrals())
    assert_array_equal(tifffile.imread(folder / "io000000.tif"), data.flat)
    with pytest.raises(DatasetExistsError, match="not empty"):
        data.save(folder)
    part = tmp_path / "part"
    back[2:4].save(part)
    assert fx.open(part).geometry == SCAN[2:4]
    (part / "scan_000003.tif").unlink()
    less = fx.open(part)
    assert (less.complete, less.missing) == (False, ("scan_000003.tif",))
    with pytest.raises(DatasetMissingError):
        less.line_integrals()


def test_a_scan_of_the_twin_keeps_its_document_and_a_new_correction(
    written: Callable[..., Path], tmp_path: Path
) -> None:
    scan = fx.open(written())
    moved = scan.with_correction(Offsets(dD_x=0.25))
    shift = (moved.geometry.rows - scan.with_correction(None).geometry.rows)[0, 3:6]
    assert_allclose(np.linalg.norm(shift), 0.25)
    moved.save(tmp_path / "copy")
    back = fx.open(tmp_path / "copy")
    assert back.geometry == moved.geometry
    assert back.document is not None
    assert scan.document is not None
    assert back.machine == scan.machine
    assert back.document.frames == scan.document.frames
    assert_array_equal(back.counts(), scan.counts())


def test_frames_of_others_follow_the_numbers_in_their_names(tmp_path: Path) -> None:
    images = np.arange(11, dtype=np.uint16)[:, None, None] + np.full(
        (2, 3), 500, np.uint16
    )
    for i, image in enumerate(images):
        tifffile.imwrite(tmp_path / f"proj_{i}.tiff", image)
    for name, value in (("dark1.tif", 100), ("white1.tif", 1000), ("white2.tif", 1002)):
        tifffile.imwrite(tmp_path / name, np.full((2, 3), value, np.uint16))
    scan = fx.ConeVec.circular(sod=60, sdd=100, angles=11, pixel=1.0)
    scan.save(tmp_path / "scan.json")
    read = fx.read_tiffs(
        str(tmp_path), tmp_path / "scan.json", dark="dark*", flat="white*"
    )
    assert_array_equal(read.counts(), images)
    assert_allclose(read.line_integrals(), beer(images, 100, 1001), atol=1e-5)
    assert read.geometry == scan.with_shape((2, 3))
    with pytest.raises(DatasetFormatError, match="14 projections and 11 views"):
        fx.read_tiffs(tmp_path, scan)
    with pytest.raises(DatasetMissingError, match="no projections"):
        fx.read_tiffs(tmp_path, scan, frames="*.png")
    with pytest.raises(fx.TwinError, match=r"\(9, 9\)"):
        fx.read_tiffs(tmp_path, scan.with_shape((9, 9)), dark="dark*", flat="white*")


def test_what_the_patterns_took_is_said(tmp_path: Path) -> None:
    for name in ("diamond_0.tif", "iodine_0.tif"):
        tifffile.imwrite(tmp_path / name, np.full((2, 3), 7, np.uint16))
    scan = fx.ConeVec.circular(sod=60, sdd=100, angles=2, pixel=1.0)
    with pytest.raises(
        DatasetMissingError, match=r"dark \(di\* .*\) and flat \(io\*\) took diamond_0"
    ):
        fx.read_tiffs(tmp_path, scan)
    assert len(fx.read_tiffs(tmp_path, scan, dark="", flat="")) == 2


def test_float_images_keep_the_mean_of_air_and_say_what_is_cut(tmp_path: Path) -> None:
    """Air of N(0, 0.1) is neither raised nor cut; what 16 bits do not hold is told."""
    scan = fx.ConeVec.circular(sod=60, sdd=100, angles=1, pixel=1.0)
    air = np.random.default_rng(4).normal(0.0, 0.1, (80, 90)).astype(np.float32)
    air[3, 4], air[5, 6] = -0.5, 8.0
    tifffile.imwrite(tmp_path / "a.tif", air)
    read = fx.read_tiffs(tmp_path, scan)
    assert read.warnings == ()
    assert_allclose(read.line_integrals(0)[air < 4], air[air < 4], atol=1e-4)
    assert read.line_integrals(0)[5, 6] == pytest.approx(8.0, abs=0.05)
    air[:8, 0] = 14.0
    tifffile.imwrite(tmp_path / "a.tif", air)
    (said,) = fx.read_tiffs(tmp_path, scan).warnings
    assert said.startswith(f"{100 * 8 / air.size:.3g} % of the pixels")


def test_the_truth_of_some_views_is_theirs() -> None:
    scan = fx.ConeVec.circular(sod=200, sdd=400, angles=6, shape=(7, 9), pixel=1.6)
    ball = {"kind": "sphere", "center": [2, 0, 0], "radius": 3, "material": "pmma"}
    data = fx.simulate(ball, scan, scatter="mc")
    for chosen in (slice(4, 6), [5, 1]):
        part = data[chosen]
        assert_array_equal(
            part.truth.line_integrals(), data.truth.line_integrals()[chosen]
        )
        assert_array_equal(part.truth.geometry.rows, part.cone_vec.rows)
        views = np.arange(6)[chosen]
        assert_array_equal(
            part.truth.scatter[1].signal, data.truth.scatter[views[1]].signal
        )


@pytest.mark.parametrize(
    ("counts", "more", "said"),
    [
        (np.full((12, 20), 1), {}, "counts of shape"),
        (np.full((12, 20, 24), np.nan), {}, "line integrals .* not finite"),
        (np.full((12, 20, 24), -1), {}, "whole numbers"),
        (np.full((12, 20, 24), 70000), {}, "whole numbers"),
        (np.full((11, 20, 24), 1), {}, "11 images and 12 views"),
        (np.full((12, 21, 24), 1), {}, "detector shape"),
        (np.full((12, 20, 24), 1), {"flat": np.ones((2, 2))}, "flat images of shape"),
    ],
)
def test_arrays_that_are_no_data_set(
    counts: object, more: dict[str, object], said: str
) -> None:
    with pytest.raises(fx.TwinError, match=said):
        fx.DataSet.from_arrays(counts, SCAN, **more)  # type: ignore[arg-type]


def test_without_a_flat_image_there_are_counts_alone() -> None:
    data = fx.DataSet.from_arrays(np.full((12, 20, 24), 7), SCAN)
    assert data.counts(3).max() == 7
    assert "no dark image" in data.warnings[0]
    with pytest.raises(DatasetMissingError, match="no flat field"):
        data[0]


def test_a_panel_of_one_row_reconstructs() -> None:
    """With pixels as they are, which was refused as a binning of 1 out of "1 to 0"."""
    scan = fx.ConeVec.circular(sod=300, sdd=450, angles=24, shape=(1, 30), pixel=1.0)
    ball = {"kind": "sphere", "center": [0, 0, 0], "radius": 6, "material": "pmma"}
    volume = fx.simulate(ball, scan, tube=fx.Tube(mono_keV=60, power_W=0.2)).reconstruct()
    assert volume.data[0, 12:18, 12:18].mean() == pytest.approx(0.0229, rel=0.05)


def test_a_data_set_reconstructs_in_memory(data: fx.DataSet) -> None:
    with pytest.warns(UserWarning, match="missing or few views"):
        volume = data.reconstruct("fdk", voxel=0.8, shape=(11, 22, 22))  # of 12 views
    x, y, z = volume.centers()
    weight = np.where(volume.data > 0.5 * volume.data.max(), 1.0, 0.0)
    across = ((x, (0, 1)), (y, (0, 2)), (z, (1, 2)))
    found = [np.average(c, weights=weight.sum(axis=axes)) for c, axes in across]
    assert_allclose(found, [3, 0, 0], atol=0.5)
    with pytest.raises(fx.TwinError, match="unknown algorithm 'art'"):
        data.reconstruct("art")


def test_calibration_corrects_a_data_set_in_memory() -> None:
    """A detector that stands 0.8 mm off is found from the beads alone."""
    beads = fx.phantoms.load_phantom("normal-5")
    nominal = fx.ConeVec.circular(
        sod=600, sdd=1059, angles=24, shape=(190, 239), pixel=0.5984
    )
    true = fx.ConeVec.circular(
        sod=600, sdd=1059, angles=24, shape=(190, 239), pixel=0.5984, offset=(0.8, 0.0)
    )
    counts = fx.simulate(beads, true, noise=3)
    data = fx.DataSet.from_arrays(
        counts.counts(), nominal, dark=counts.dark, flat=counts.flat
    )
    found = data.calibrate(beads, free=("dD_x",), priors=exact(("dD_x",)))
    assert "1 parameters from 24 frames" in repr(found)
    corrected = data.with_correction(found.correction).geometry
    assert_allclose(corrected.rows, true.rows, atol=0.02)
    assert np.abs(data.geometry.rows - true.rows).max() > 0.7


# What the application definition requires, by path: (NX_class) of groups, (kinds, rank) of fields.
# From NXtomo.nxdl.xml, version 2.0; fields with minOccurs="0" are left out.
NXTOMO_GROUPS = {
    "entry": "NXentry",
    "entry/instrument": "NXinstrument",
    "entry/instrument/detector": "NXdetector",
    "entry/sample": "NXsample",
    "entry/data": "NXdata",
}
NXTOMO_FIELDS = {
    "entry/definition": ("O", 0),
    "entry/instrument/detector/data": ("iu", 3),
    "entry/instrument/detector/image_key": ("iu", 1),
    "entry/sample/name": ("O", 0),
    "entry/sample/rotation_angle": ("f", 1),
}
NXTOMO_LINKS = {
    "data": "instrument/detector/data",
    "rotation_angle": "sample/rotation_angle",
    "image_key": "instrument/detector/image_key",
}


def test_nxtomo_has_all_that_its_definition_requires(
    data: fx.DataSet, tmp_path: Path
) -> None:
    h5py = pytest.importorskip("h5py", reason="the extra `io`")
    data.to_nxtomo(str(tmp_path / "scan.nxs"))
    with h5py.File(tmp_path / "scan.nxs") as file:
        for path, kind in NXTOMO_GROUPS.items():
            assert file[path].attrs["NX_class"] == kind
        for path, (kinds, rank) in NXTOMO_FIELDS.items():
            assert file[path].dtype.kind in kinds, path
            assert file[path].ndim == rank
        for name, target in NXTOMO_LINKS.items():
            assert file[f"entry/data/{name}"] == file[f"entry/{target}"]
        assert file["entry/definition"].asstr()[()] == "NXtomo"
        keys = file["entry/instrument/detector/image_key"][:]
        images = file["entry/instrument/detector/data"][:]
        turned = file["entry/sample/rotation_angle"]
        assert len(keys) == len(images) == len(turned) == 14
        assert keys.tolist() == [2, 1, *[0] * 12]
        assert_array_equal(images[keys == 0], data.counts())
        assert_array_equal(images[1], data.flat)
        assert turned.attrs["units"] == "deg"
        assert_allclose(turned[2:], np.arange(12) * 30.0, atol=1e-9)
        detector = file["entry/instrument/detector"]
        assert detector["x_pixel_size"][()] == pytest.approx(1.0)
        assert detector["distance"][()] == pytest.approx(400.0)
        # The axis at the origin's height: the panel stands 1 mm right and 0.5 mm low.
        assert detector["x_rotation_axis_pixel_position"][()] == pytest.approx(11.5 - 1.0)
        assert detector["y_rotation_axis_pixel_position"][()] == pytest.approx(9.5 - 0.5)
    assert [p.name for p in tmp_path.iterdir()] == ["scan.nxs"]


@pytest.mark.parametrize(
    ("aside_mm", "view"), [(0.0, "Full"), (4.0, "Full"), (6.0, "Half"), (-9.0, "Half")]
)
def test_nxtomo_says_exposure_energy_and_field_of_view(
    aside_mm: float, view: str, tmp_path: Path
) -> None:
    """What ESRF's readers ask for; pixels of 1 mm, 30 columns: at 5 mm one side has half of the
    other's."""
    h5py = pytest.importorskip("h5py", reason="the extra `io`")
    scan = fx.ConeVec.circular(
        sod=100, sdd=300, angles=3, shape=(4, 30), pixel=1.0, offset=(aside_mm, 0)
    )
    made = fx.simulate("chiral", scan, tube=fx.Tube(kV=90, power_W=45), exposure_ms=12.0)
    made.to_nxtomo(str(tmp_path / "scan.nxs"))
    with h5py.File(tmp_path / "scan.nxs") as file:
        instrument, keys = (
            file["entry/instrument"],
            file["entry/instrument/detector/image_key"][:],
        )
        detector = instrument["detector"]
        assert detector["field_of_view"].asstr()[()] == view
        assert_allclose(detector["count_time"][:], np.full(len(keys), 0.012))
        assert detector["count_time"].attrs["units"] == "s"
        assert instrument["source/energy"][()] == 90.0
        mean = instrument["beam/incident_energy"]
        assert 30.0 < mean[()] < 60.0
        assert mean.attrs["units"] == "keV"
        # 45 W at 90 kV are 0.5 mA; dark images are taken without.
        assert_allclose(file["entry/control/data"][:], np.where(keys == 2, 0.0, 0.0005))
        assert file["entry/control"].attrs["NX_class"] == "NXmonitor"


def test_nxtomo_leaves_out_what_nobody_said(data: fx.DataSet, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="the extra `io`")
    bare = fx.DataSet.from_arrays(data.counts(), data.geometry, flat=data.flat)
    bare.to_nxtomo(str(tmp_path / "scan.nxs"))
    with h5py.File(tmp_path / "scan.nxs") as file:
        assert "count_time" not in file["entry/instrument/detector"]
        assert "control" not in file["entry"]
        assert "beam" not in file["entry/instrument"]


def test_xarray_has_views_with_angles(data: fx.DataSet) -> None:
    pytest.importorskip("xarray", reason="the extra `io`")
    array = data.to_xarray()
    assert array.dims == ("view", "row", "column")
    assert_allclose(array.coords["angle"], np.arange(12) * 30.0, atol=1e-9)
    assert_allclose(array.coords["detector_y"][0], 400.0)
    assert_array_equal(array.values, data.line_integrals())


@pytest.mark.parametrize(
    ("package", "use"),
    [
        ("h5py", lambda d: d.to_nxtomo("x.nxs")),
        ("xarray", lambda d: d.to_xarray()),
        ("matplotlib", lambda d: d.plot()),
    ],
)
def test_a_package_that_is_not_there_is_named(
    package: str, use: Callable[[fx.DataSet], None], data: fx.DataSet,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setitem(__import__("sys").modules, package, None)
    with pytest.raises(
        fx.TwinError, match=rf"{package}.* not installed: pip install 'flexdt\["
    ):
        use(data)


def test_a_plot_shows_a_projection(data: fx.DataSet) -> None:
    pytest.importorskip("matplotlib", reason="the extra `plots`").use("Agg")
    assert "scan_000002.tif" in data.plot(2).get_title()
