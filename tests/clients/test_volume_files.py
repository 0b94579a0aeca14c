"""Volumes in files: values and place come back, and other libraries see the same."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import flexdt as fx
from flexdt.library.reconstruction.reconstruct import VolumeRequest, reconstruct_dataset
from flexdt.library.reconstruction.volume_files import volume_writer
from flexdt.twin.dataset.scan_settings import ScanSettings

NEEDS = {".nii.gz": "nibabel", ".h5": "h5py"}
ENDINGS = [".tif", ".nrrd", ".mha", ".nii.gz", ".h5"]
DATA = np.random.default_rng(3).random((5, 6, 7)).astype(np.float32)
VOLUME = fx.Volume(DATA, 0.25, (1.5, -2.0, 3.0))
FIRST = [1.5 - 3 * 0.25, -2.0 - 2.5 * 0.25, 3.0 - 2 * 0.25]
"""Centre of voxel (0, 0, 0), x, y, z [mm]."""


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_volume_comes_back(ending: str, tmp_path: Path) -> None:
    if ending in NEEDS:
        pytest.importorskip(NEEDS[ending], reason="the extra `io`")
    file = tmp_path / f"v{ending}"
    for _ in range(2):  # a file that is there is replaced
        VOLUME.save(str(file))
    back = fx.Volume.load(file)
    assert_array_equal(back.data, DATA)
    assert_allclose(back.voxel_xyz, VOLUME.voxel_xyz)
    assert_allclose(back.center_mm, VOLUME.center_mm)
    assert [p.name for p in tmp_path.iterdir()] == [file.name]


ITK = """
import itk, json, sys
from itk.support import base
# For a reader ITK loads every module that has one for some format: RTK's, half a minute of them.
for module, data in base.itk_base_global_module_data.items():
    if module not in ("ITKIOMeta", "ITKIONRRD", "ITKIONIFTI"):
        data._factories = ()
for name in sys.argv[1:]:
    image = itk.imread(name)
    at = image.TransformIndexToPhysicalPoint([2, 1, 4])
    values = itk.array_from_image(image)
    print(json.dumps([list(image.GetSpacing()), list(at), values.tolist()]))
"""


@pytest.mark.slow
def test_itk_sees_one_place_in_all_formats(tmp_path: Path) -> None:
    """ITK's axes point left, back and up: x and y of ours with the other sign. It runs in a
    process of its own, because its HDF5 and h5py's cannot live in one. (ami#64, Slicer#2611,
    pyvista#3284)"""
    if importlib.util.find_spec("itk") is None:
        pytest.skip("itk is an optional peer")
    endings = [".nrrd", ".mha"]
    if importlib.util.find_spec("nibabel") is not None:
        endings.append(".nii.gz")
    names = [str(tmp_path / f"v{ending}") for ending in endings]
    for name in names:
        VOLUME.save(name)
    done = subprocess.run(
        [sys.executable, "-c", ITK, *names], capture_output=True, text=True, check=True
    )
    told = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(told) == len(endings)
    for name, (spacing, at, values) in zip(names, told, strict=True):
        assert_allclose(spacing, [0.25] * 3)
        side = (
            -1.0 if name.endswith(".nii.gz") else 1.0
        )  # NIfTI's x and y are those of patients
        expected = [side * (FIRST[0] + 0.5), side * (FIRST[1] + 0.25), FIRST[2] + 1.0]
        assert_allclose(at, expected, atol=1e-6)
        assert_array_equal(np.array(values, np.float32), DATA)


def test_nibabel_states_the_place(tmp_path: Path) -> None:
    nibabel = pytest.importorskip("nibabel", reason="the extra `io`")
    VOLUME.save(tmp_path / "v.nii.gz")
    image = nibabel.load(tmp_path / "v.nii.gz")
    assert image.shape == (7, 6, 5)
    assert_allclose(image.affine @ [0, 0, 0, 1], [*FIRST, 1.0])
    assert image.header.get_xyzt_units()[0] == "mm"


@pytest.mark.parametrize("ending", [".mha", ".h5", ".nii.gz"])
def test_slabs_one_after_the_other_are_the_whole(ending: str, tmp_path: Path) -> None:
    if ending in NEEDS:
        pytest.importorskip(NEEDS[ending], reason="the extra `io`")
    file = tmp_path / f"v{ending}"
    with volume_writer(file, fx.Grid(VOLUME.shape, 0.25, VOLUME.center_mm)) as write:
        for first in (0, 2, 4):
            write(DATA[first : first + 2])
    assert_array_equal(fx.Volume.load(file).data, DATA)


ABOUT = {"sample": "Größe 3: \n a = b; c", "software": "flexdt", "comment": 300 * "long "}


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_file_says_of_what_it_is(ending: str, tmp_path: Path) -> None:
    """Readers of others find it; values and place come back in spite of it."""
    if ending in NEEDS:
        pytest.importorskip(NEEDS[ending], reason="the extra `io`")
    file = tmp_path / f"v{ending}"
    grid = fx.Grid(VOLUME.shape, 0.25, VOLUME.center_mm)
    with volume_writer(file, grid, ABOUT) as write:
        write(DATA)
    back = fx.Volume.load(file)
    assert_array_equal(back.data, DATA)
    assert_allclose(back.center_mm, VOLUME.center_mm)
    if ending == ".h5":
        h5py = importlib.import_module("h5py")
        with h5py.File(file) as held:
            assert held["volume"].attrs["sample"] == ABOUT["sample"]
    elif ending == ".nii.gz":
        told = importlib.import_module("nibabel").load(file).header["descrip"]
        assert bytes(told.item()).startswith(rb"Gr\xf6\xdfe 3: a = b; c; flexdt; long")
    elif ending != ".tif":
        head = file.read_bytes().partition(b"ElementDataFile")[0][:1800].decode("latin1")
        assert r"Gr\xf6\xdfe 3: a = b; c" in head


def test_a_reconstruction_says_whose_sample_it_is(tmp_path: Path) -> None:
    scan = fx.ConeVec.circular(sod=100, sdd=200, angles=24, shape=(4, 9), pixel=1)
    counts, flat = np.full((24, 4, 9), 500), np.full((4, 9), 1000)
    data = fx.DataSet.from_arrays(counts, scan, flat=flat, name="tray 3")
    data = replace(data, settings=ScanSettings(sample_name="bone 7", kV=90.0))
    request = VolumeRequest("sirt", iterations=1)
    reconstruct_dataset(data, tmp_path / "v.nrrd", request)
    head = (tmp_path / "v.nrrd").read_bytes().partition(b"\n\n")[0].decode().splitlines()
    told = dict(line.split(":=") for line in head if ":=" in line)
    assert told.pop("software").startswith("flexdt ")
    assert told == {
        "sample": "bone 7",
        "kV": "90",
        "data_set": "tray 3",
        "frames": "24",
        "algorithm": "sirt",
        "values": "attenuation [1/mm]",
    }


@pytest.mark.parametrize("algorithm", ["fdk", "sirt"])
@pytest.mark.parametrize("ending", [".nrrd", ".tif"])
@pytest.mark.filterwarnings("ignore")
def test_python_and_the_command_write_the_same_file(
    ending: str, algorithm: str, tmp_path: Path
) -> None:
    """Down to the byte: values, place and all that is said."""
    scan = fx.ConeVec.circular(sod=100, sdd=200, angles=24, shape=(4, 9), pixel=1)
    counts, flat = np.full((24, 4, 9), 500), np.full((4, 9), 1000)
    counts[:, :, [0, 8]] = 1000
    data = fx.DataSet.from_arrays(counts, scan, flat=flat, name="tray 3")
    data = replace(data, settings=ScanSettings(sample_name="bone 7", kV=90.0))
    one, two = tmp_path / f"one{ending}", tmp_path / f"two{ending}"
    iterations = None if algorithm == "fdk" else 1
    reconstruct_dataset(data, one, VolumeRequest(algorithm, iterations=iterations))
    options = {} if iterations is None else {"iterations": iterations}
    data.reconstruct(algorithm, progress=False, **options).save(two)
    assert one.read_bytes() == two.read_bytes()
    assert b"bone 7" in two.read_bytes()


def test_imagej_sees_a_stack_with_its_scale(tmp_path: Path) -> None:
    """By tifffile's reader of ImageJ's lines: layers, mm, the edges of a voxel."""
    import tifffile

    volume = fx.Volume(DATA, (0.25, 0.5, 0.125), (1.5, -2.0, 3.0))
    volume.save(tmp_path / "v.tif")
    with tifffile.TiffFile(tmp_path / "v.tif") as file:
        told = file.imagej_metadata
        x, y = (file.pages.first.tags[f"{k}Resolution"].value for k in "XY")
        assert file.series[0].axes == "ZYX"
    assert told is not None
    assert (told["slices"], told["unit"], told["spacing"]) == (5, "mm", 0.125)
    assert (x[1] / x[0], y[1] / y[0]) == pytest.approx((0.25, 0.5))


def test_a_writer_that_fails_leaves_nothing(tmp_path: Path) -> None:
    with (
        pytest.raises(RuntimeError),
        volume_writer(tmp_path / "v.mha", fx.Grid((2, 2, 2), 1.0)),
    ):
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_written_or_read_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(fx.TwinError, match=r"one of .*\.mhd, \.nii\.gz"):
        VOLUME.save(tmp_path / "v.vtk")
    np.save(tmp_path / "v.npy", DATA)
    for use in (VOLUME.save, fx.Volume.load):
        with pytest.raises(
            fx.TwinError, match=r"one of \.tif, .*\. NumPy's files have no room"
        ):
            use(tmp_path / "v.npy")
    (tmp_path / "bad.mha").write_bytes(b"nothing")
    with pytest.raises(fx.TwinError, match="not a volume"):
        fx.Volume.load(tmp_path / "bad.mha")
    for ending, package in NEEDS.items():
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(fx.TwinError, match=rf"needs {package}.*flexdt\[io\]"):
            VOLUME.save(tmp_path / f"v{ending}")


CHANGES = {
    ".mha": [
        ("False\nCompressed", "True\nCompressed", "ByteOrderMSB is True"),
        ("CompressedData = False", "CompressedData = True", "CompressedData"),
        ("MET_FLOAT", "MET_UCHAR", "MET_UCHAR"), ("MET_FLOAT", "MET_DOUBLE", "MET_DOUBLE"),
        ("1 0 0 0 1 0 0 0 1", "0 1 0 1 0 0 0 0 1", "TransformMatrix"),
        ("NDims = 3", "NDims = 2", "NDims"), ("DimSize = 7", "DimSize = 4", "bytes; it holds"),
        ("NDims = 3", "NDims = 3\nElementNumberOfChannels = 3", "Channels"),
        ("ElementSpacing = 0.25", "ElementSpacing = -0.25", "voxel"),
    ],
    ".nrrd": [
        ("endian: little", "endian: big", "endian"),
        ("encoding: raw", "encoding: gzip", "encoding"),
        ("type: float", "type: double", "type"), ("3D-right", "3D-left", "space"),
        ("sizes: 7", "sizes: 70", "bytes; it holds"), ("(0.25,0,0)", "(0.25,0.1,0)", "axes"),
        ("(0.25,0,0)", "(-0.25,0,0)", "axes"), ("type: float", "type: float\nbyte skip: 4", "skip"),
    ],
}  # fmt: skip


@pytest.mark.parametrize(
    ("ending", "change"),
    [(ending, k) for ending in CHANGES for k in range(len(CHANGES[ending]))],
)
def test_values_of_another_form_are_refused(
    tmp_path: Path, ending: str, change: int
) -> None:
    """ami#64, Slicer#2611, pyvista#3284: byte order, type, axes and lengths of other files."""
    file = tmp_path / f"v{ending}"
    VOLUME.save(file)
    old, new, said = CHANGES[ending][change]
    raw = file.read_bytes()
    assert raw.count(old.encode()) == 1
    file.write_bytes(raw.replace(old.encode(), new.encode()))
    with pytest.raises(fx.TwinError, match=said):
        fx.Volume.load(file)


@pytest.mark.parametrize(
    "change", ["metres", "turned", "mirrored", "complex", "4d", "right"]
)
def test_nifti_of_another_form_is_refused(tmp_path: Path, change: str) -> None:
    nibabel = pytest.importorskip("nibabel", reason="the extra `io`")
    axes = np.diag([0.5, 0.25, 0.75, 1.0])
    values = np.full((5, 6, 7), 0.02, np.complex64 if change == "complex" else np.float32)
    if change == "turned":
        axes[:2, :2] = [[0.3, -0.3], [0.3, 0.3]]
    if change == "mirrored":
        axes[0, 0] = -0.5
    if change == "4d":
        values = np.repeat(values[..., None], 2, axis=3)
    image = nibabel.Nifti1Image(values, axes)
    image.header.set_xyzt_units("meter" if change == "metres" else "mm")
    nibabel.save(image, tmp_path / "v.nii.gz")
    if change == "right":
        assert_allclose(fx.Volume.load(tmp_path / "v.nii.gz").voxel_mm, (0.5, 0.25, 0.75))
        return
    with pytest.raises(fx.TwinError, match=r"meter|axes|complex|values are"):
        fx.Volume.load(tmp_path / "v.nii.gz")


def test_zarr_without_the_extensions_says_how_to_install_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flexdt.library.optional.extras.entry_points", lambda **named: ())
    (tmp_path / "v.zarr").mkdir()
    for use in (VOLUME.save, fx.Volume.load):
        with pytest.raises(
            fx.TwinError, match=r"in \.zarr needs .*: pip install \./extensions"
        ):
            use(tmp_path / "v.zarr")
    assert [path.name for path in tmp_path.iterdir()] == ["v.zarr"]


def places_by_definition(file: Path) -> tuple[list[float], list[float]]:
    """Centre of voxel (0, 0, 0) and of (1, 2, 3) as each format defines them, (x, y, z) [mm]."""
    if (
        file.suffix == ".mha"
    ):  # the transform's columns are the axes: MetaIO's documentation
        lines = file.read_bytes()[:600].split(b"LOCAL")[0].decode().splitlines()
        said = dict(line.split(" = ") for line in lines if " = " in line)
        axes = np.array(said["TransformMatrix"].split(), float).reshape(3, 3)
        steps = axes.T * np.array(said["ElementSpacing"].split(), float)
        low = np.array(said["Offset"].split(), float)
    elif (
        file.suffix == ".nrrd"
    ):  # a vector of space for each axis: the format's definition
        lines = file.read_bytes()[:600].split(b"\n\n")[0].decode().splitlines()[1:]
        said = dict(line.split(": ") for line in lines)
        assert said["space"] == "3D-right-handed"
        rows = said["space directions"].split()
        steps = np.array([row.strip("()").split(",") for row in rows], float).T
        low = np.array(said["space origin"].strip("()").split(","), float)
    elif file.name.endswith(".nii.gz"):
        import nibabel

        affine = nibabel.load(file).affine
        steps, low = affine[:3, :3], affine[:3, 3]
    elif file.suffix == ".h5":
        h5py = pytest.importorskip("h5py")
        with h5py.File(file) as held:
            about = dict(held["volume"].attrs)
            nz, ny, nx = held["volume"].shape
        steps = np.diag(np.broadcast_to(about["voxel_mm"], 3))
        low = about["center_mm"] - (np.array([nx, ny, nz]) - 1) / 2 * np.diag(steps)
    else:
        import tifffile

        with tifffile.TiffFile(file) as held:
            lines = held.pages[0].description.splitlines()
            about = json.loads(lines[-1].removeprefix("flexdt="))
            nz, (ny, nx) = len(held.pages), held.pages[0].shape
            per_mm = [held.pages[0].tags[code].value for code in (282, 283)]
        steps = np.diag(np.broadcast_to(about["voxel_mm"], 3))
        assert_allclose([b / a for a, b in per_mm], np.diag(steps)[:2], rtol=1e-6)
        low = np.array(about["center_mm"]) - (np.array([nx, ny, nz]) - 1) / 2 * np.diag(
            steps
        )
    return list(low), list(low + steps @ [1, 2, 3])


@pytest.mark.parametrize("ending", [".nrrd", ".mha", ".nii.gz", ".tif", ".h5"])
@pytest.mark.parametrize("edges", [(0.5, 0.25, 1.5), (0.75, 0.75, 0.75)])
def test_the_physical_point_of_a_file_is_ours(
    tmp_path: Path, ending: str, edges: tuple[float, float, float]
) -> None:
    """SimpleITK, RTK and elastix put a voxel of .mha and .nrrd where flexdt does."""
    if ending in NEEDS:
        pytest.importorskip(NEEDS[ending], reason="the extra `io`")
    values = np.random.default_rng(3).normal(size=(4, 5, 6)).astype(np.float32)
    volume = fx.Volume(values, edges, (6.2, -6.4, 11.0))
    file = tmp_path / f"oblong{ending}"
    volume.save(file)
    low = np.array([6.2, -6.4, 11.0]) - np.array([5, 4, 3]) / 2 * edges
    first, other = places_by_definition(file)
    assert_allclose(first, low, atol=1e-5)
    assert_allclose(other, low + np.array([1, 2, 3]) * edges, atol=1e-5)
    back = fx.Volume.load(file)
    assert_array_equal(back.data, values)
    assert_allclose(back.voxel_mm, edges if len(set(edges)) > 1 else edges[0], rtol=1e-6)
    assert_allclose(back.center_mm, (6.2, -6.4, 11.0), atol=1e-5)


def test_volumes_of_version_0_4_keep_their_place(tmp_path: Path) -> None:
    for ending, changes in (
        (".mha", [("Matrix = 1 0 0 0 1", "Matrix = -1 0 0 0 -1")]),
        (".nrrd", [("3D-right-handed", "right-anterior-superior")]),
    ):
        file = tmp_path / f"v{ending}"
        VOLUME.save(file)
        raw = file.read_bytes()
        for old, new in changes:
            raw = raw.replace(old.encode(), new.encode())
        if ending == ".mha":
            x, y, _ = FIRST
            raw = raw.replace(
                f"Offset = {x} {y}".encode(), f"Offset = {-x} {-y}".encode()
            )
        file.write_bytes(raw)
        assert_allclose(fx.Volume.load(file).center_mm, VOLUME.center_mm, atol=1e-6)


def test_a_header_with_its_values_beside_it_is_read(tmp_path: Path) -> None:
    """Gate#623, xcist#96: .mhd with .raw, as RTK and elastix write volumes."""
    values = np.random.default_rng(3).normal(size=(3, 4, 5)).astype(np.float32)
    volume = fx.Volume(values, (0.5, 0.25, 2.0), (1.0, -2.0, 3.0))
    volume.save(tmp_path / "v.mha")
    raw = (tmp_path / "v.mha").read_bytes()
    head, _, data = raw.partition(b"ElementDataFile = LOCAL\n")
    (tmp_path / "w.raw").write_bytes(data)
    (tmp_path / "w.mhd").write_bytes(head + b"ElementDataFile = w.raw\n")
    read = fx.Volume.load(tmp_path / "w.mhd")
    np.testing.assert_array_equal(read.data, values)
    assert read.voxel_xyz == pytest.approx(volume.voxel_xyz)
    assert read.center_mm == pytest.approx(volume.center_mm)
    for name in ("../w.raw", "gone.raw"):
        (tmp_path / "w.mhd").write_bytes(head + f"ElementDataFile = {name}\n".encode())
        with pytest.raises((fx.TwinError, OSError), match=r"w\.mhd|gone\.raw"):
            fx.Volume.load(tmp_path / "w.mhd")
