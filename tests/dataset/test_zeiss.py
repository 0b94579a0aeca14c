"""Zeiss's .txrm, written here as an OLE2 file with a forward model of our own."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from compound_file import compound_file
from four_balls import COLS, PIXEL, ROWS, SDD, SOD, VIEWS, found, images

import flexdt as fx
from flexdt.twin.dataset.dataset_errors import DatasetError

KINDS = {3: (np.uint8, 250), 5: (np.uint16, 50_000), 10: (np.float32, 3.7e5)}
"""Number of the type in the file -> the type, and the counts of the open beam."""


@pytest.fixture(autouse=True)
def _reader() -> None:
    pytest.importorskip("olefile")


def numbers(values: object, kind: str = "<f4") -> bytes:
    return np.asarray(values, kind).tobytes()


def txrm(
    path: Path,
    pictures: np.ndarray,
    degrees: np.ndarray,
    *,
    kind: int = 5,
    said: Mapping[str, bytes | None] | None = None,
    shifts: np.ndarray | None = None,
) -> Path:
    """A file as the Versa leaves it: lowest row first, counts beside an image of the open beam."""
    n, rows, cols = pictures.shape
    dtype, white = KINDS[kind]
    beam = white * (0.8 + 0.2 * np.linspace(0, 1, cols) ** 2) * np.ones((rows, 1))
    shifts = np.zeros((n, 2)) if shifts is None else shifts

    def stored(image: np.ndarray) -> bytes:
        return numbers(np.rint(image) if kind != 10 else image, np.dtype(dtype).str)

    streams: dict[str, bytes | None] = {
        "ImageInfo/ImageWidth": numbers(cols, "<u4"), "ImageInfo/ImageHeight": numbers(rows, "<u4"),
        "ImageInfo/NoOfImages": numbers(n, "<u4"), "ImageInfo/ImagesTaken": numbers(n, "<u4"),
        "ImageInfo/DataType": numbers(kind, "<u4"), "ImageInfo/XrayGeometry": numbers(1, "<u4"),
        "ImageInfo/Angles": numbers(degrees),
        "ImageInfo/PixelSize": numbers(1e3 * PIXEL * SOD / SDD),
        "ImageInfo/StoRADistance": numbers(np.full(n, -SOD)),
        "ImageInfo/DtoRADistance": numbers(np.full(n, SDD - SOD)),
        "Alignment/X-Shifts": numbers(shifts[:, 0]), "Alignment/Y-Shifts": numbers(shifts[:, 1]),
        "ReferenceData/Image": stored(beam), "ReferenceData/DataType": numbers(kind, "<u4"),
        "exeVersion": b"16.1",
        **{f"ImageData{k // 100 + 1}/Image{k + 1}": stored(beam * image[::-1])
           for k, image in enumerate(pictures)},
        **(said or {}),
    }  # fmt: skip
    path.write_bytes(compound_file({k: v for k, v in streams.items() if v is not None}))
    return path


def small(path: Path, **options: object) -> Path:
    """Six views of 8 x 10 pixels of nothing much."""
    pictures = np.random.default_rng(1).uniform(0.2, 1.0, (6, 8, 10))
    return txrm(path, pictures, np.arange(6) * 60.0, **options)  # type: ignore[arg-type]


def balls(
    path: Path, seed: int, kind: int = 5, wrong: str = "", size: float = 3.0
) -> tuple[Path, float]:
    """A scan of the four balls, and its CenterShift; or with one thing the other way.

    "mirrored" is sharp, and a left-handed picture of the balls.
    """
    rng = np.random.default_rng(seed)
    start, center = float(rng.uniform(0.0, 6.0)), float(rng.uniform(1.0, size))
    shifts = rng.uniform(-size, size, (VIEWS, 2)) + [0.0, 2.0]
    pictures = images(0.0, start, -1.0, moved=shifts + [center, 0.0])
    degrees = np.rad2deg(start) + 360.0 / VIEWS * np.arange(VIEWS)
    if wrong == "rows":
        pictures = pictures[:, ::-1]
    if wrong in ("columns", "mirrored"):
        pictures = pictures[:, :, ::-1]
    said: dict[str, bytes | None] = {
        "ReconSettings/CenterShift": numbers(
            -center if wrong == "CenterShift" else center
        )
    }
    shifts = shifts * [
        -1.0 if wrong == "X-Shifts" else 1.0,
        -1.0 if wrong == "Y-Shifts" else 1.0,
    ]
    degrees = -degrees if wrong in ("Angles", "mirrored") else degrees
    return txrm(path, pictures, degrees, kind=kind, said=said, shifts=shifts), center


@pytest.mark.parametrize("seed", range(3))
def test_what_the_tests_write_is_an_ole2_file(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    sizes = [0, 1, 63, 64, 65, 4095, 4096, 4097, 70_000, *rng.integers(0, 9000, 40)]
    streams = {
        f"{'' if k % 5 == 4 else f'Folder{k % 3}/'}Name{k}": rng.bytes(int(size))
        for k, size in enumerate(sizes)
    }
    (tmp_path / "file").write_bytes(compound_file(streams))
    olefile = pytest.importorskip("olefile")
    with olefile.OleFileIO(
        tmp_path / "file", raise_defects=olefile.DEFECT_POTENTIAL
    ) as file:
        assert {"/".join(parts) for parts in file.listdir()} == set(streams)
        for name, content in streams.items():
            assert file.openstream(name).read() == content


@pytest.mark.parametrize(("seed", "kind"), [(0, 5), (1, 10), (2, 3)])
@pytest.mark.daily(1)
def test_zeiss_scans_come_back_as_they_are(seed: int, kind: int, tmp_path: Path) -> None:
    path, center = balls(tmp_path / "tooth.txrm", seed, kind)
    data = fx.open(path)
    assert (len(data), data.shape, data.name) == (VIEWS, (ROWS, COLS), "tooth")
    assert data.complete
    assert [w.startswith(f"CenterShift of {center:.4g}"[:18]) for w in data.warnings] == [
        True
    ]
    np.testing.assert_allclose(
        np.linalg.norm(data.geometry.source, axis=1), SOD, rtol=1e-6
    )
    np.testing.assert_allclose(
        np.abs(data.geometry.source_detector_distance), SDD, rtol=1e-6
    )
    volume = data.reconstruct("fdk", voxel=0.2, shape=(40, 60, 60), errors=False)
    np.testing.assert_allclose(found(volume), 1.0, atol=0.04)


@pytest.mark.parametrize(
    "wrong",
    ["Angles", "X-Shifts", "Y-Shifts", "CenterShift", "rows", "columns", "mirrored"],
)
@pytest.mark.daily(1)
def test_the_phantom_would_show_a_wrong_sign(wrong: str, tmp_path: Path) -> None:
    path, _ = balls(tmp_path / "scan.txrm", 0, wrong=wrong)
    volume = fx.open(path).reconstruct("fdk", voxel=0.2, shape=(40, 60, 60), errors=False)
    assert np.abs(found(volume) - 1.0).max() > 0.1


@pytest.mark.slow
def test_align_finds_the_axis_of_a_panel_that_steps_about(tmp_path: Path) -> None:
    """With each view's shift, and a CenterShift that points the other way."""
    data = fx.open(balls(tmp_path / "scan.txrm", 0, wrong="CenterShift")[0])
    right = data.with_correction(data.align().correction)
    volume = right.reconstruct("fdk", voxel=0.2, shape=(40, 60, 60), errors=False)
    np.testing.assert_allclose(found(volume), 1.0, atol=0.04)


@pytest.mark.parametrize(
    ("said", "sentence"),
    [
        ({"ImageInfo/StoRADistance": None}, "StoRADistance is missing.*geometry=ConeVec"),
        (
            {"ImageInfo/DtoRADistance": numbers([1.0])},
            "DtoRADistance has 4 bytes; allowed: 24 to",
        ),
        ({"ImageInfo/DtoRADistance": numbers([np.nan] * 6)}, "DtoRADistance is nan"),
        ({"ImageInfo/PixelSize": numbers(0.0)}, "PixelSize is 0; allowed: above 0"),
        ({"ImageInfo/Angles": None}, "Angles is missing.*geometry=ConeVec"),
        ({"ImageInfo/XrayGeometry": numbers(0, "<u4")}, "parallel beam"),
        ({"ImageInfo/YPosition": numbers(np.arange(6) * 1e4)}, "the stage rises"),
        ({"ImageInfo/DataType": numbers(7, "<u4")}, "DataType is 7; allowed: 3, 5, 10"),
        ({"ImageInfo/ImageWidth": None}, "ImageWidth is missing"),
        ({"ImageInfo/ImageWidth": numbers(11, "<u4")}, "ImageData1/Image1 has 160 bytes"),
        (
            {"ImageInfo/ImageWidth": numbers(2**32 - 1, "<u4")},
            "4294967295 x 8 pixels are claimed",
        ),
        ({"ImageInfo/NoOfImages": numbers(0, "<u4")}, "0 images"),
        ({"ImageData1/Image4": None}, "ImageData1/Image4 is missing"),
        (
            {"ReferenceData/Image": b"12"},
            "ReferenceData/Image has 2 bytes; allowed: 160 to",
        ),
    ],
)
def test_what_a_zeiss_file_lacks_is_named(
    said: dict[str, bytes | None], sentence: str, tmp_path: Path
) -> None:
    path = small(tmp_path / "scan.txrm", said=said)
    with pytest.raises(DatasetError, match=f"scan.txrm: .*{sentence}"):
        fx.open(path)


def test_a_geometry_that_is_given_replaces_the_files(tmp_path: Path) -> None:
    scan = fx.ConeVec.circular(sod=100, sdd=200, angles=6, pixel=1.0)
    path = small(tmp_path / "scan.txrm", said={"ImageInfo/StoRADistance": None})
    data = fx.open(path, geometry=scan)
    np.testing.assert_array_equal(data.geometry.rows, scan.rows)
    assert np.isfinite(data.line_integrals()).all()


def test_a_scan_that_was_stopped_says_so(tmp_path: Path) -> None:
    path = small(tmp_path / "s.txrm", said={"ImageInfo/ImagesTaken": numbers(4, "<u4")})
    data = fx.open(path)
    assert (len(data), data.complete, data.reason) == (
        4,
        False,
        "4 of 6 images were taken",
    )


def test_several_references_are_averaged_and_none_is_asked_for(tmp_path: Path) -> None:
    several: dict[str, bytes | None] = {
        "ReferenceData/Image": None,
        "ReferenceData/DataType": None,
    }
    path = small(tmp_path / "none.txrm", said=several)
    data = fx.open(path)
    assert "from_arrays(data.counts(), data.geometry, flat=FLAT)" in data.warnings[0]
    with pytest.raises(DatasetError, match="no flat"):
        data.line_integrals()
    beam = [np.full((8, 10), level, "<u2").tobytes() for level in (1000, 3000)]
    several |= {f"MultiReferenceData/Image{k + 1}": image for k, image in enumerate(beam)}
    data = fx.open(small(tmp_path / "two.txrm", said=several))
    assert (data.flat == 2000.0).all()
    with pytest.raises(DatasetError, match="floats; allowed: with ReferenceData"):
        fx.open(small(tmp_path / "f.txrm", kind=10, said={"ReferenceData/Image": None}))


def test_what_is_not_applied_is_said(tmp_path: Path) -> None:
    path = small(tmp_path / "s.txrm", said={"ImageInfo/CameraFineRotation": numbers(0.5)})
    assert "CameraFineRotation of 0.5 is not applied" in fx.open(path).warnings[0]


def spoilt(whole: bytes, seed: int) -> bytes:
    """A file cut short, or with bits turned: anywhere, or in its header, lists and directory."""
    rng = np.random.default_rng(seed)
    if seed % 4 == 0:
        return whole[: int(rng.integers(0, len(whole)))]
    content = bytearray(whole)
    end = {1: len(whole), 2: 96, 3: len(whole)}[seed % 4]
    begin = (
        len(whole) - 6 * 512 if seed % 4 == 3 else 0
    )  # directory, mini sectors' list, list
    for at in rng.integers(begin, end, int(rng.integers(1, 9))):
        content[at] ^= 1 << int(rng.integers(8))
    return bytes(content)


@pytest.mark.parametrize("kind", [5, 10])
def test_damaged_files_get_a_sentence(kind: int, tmp_path: Path) -> None:
    whole = small(tmp_path / "scan.txrm", kind=kind).read_bytes()
    path, refused = tmp_path / "spoilt.txrm", []
    for seed in range(200):
        path.write_bytes(spoilt(whole, seed))
        began = time.process_time()
        try:
            fx.open(path).line_integrals()
        except DatasetError as error:
            refused.append(str(error))
        assert time.process_time() - began < 1.0, seed
    assert all(said.startswith((str(path), "spoilt: no flat")) for said in refused)
    assert len(refused) > 80


@pytest.mark.parametrize(
    ("stated", "kV"),
    [(numbers(60.0), 60.0), (numbers(0.0), None), (b"\0", None), (numbers(np.nan), None),
     (numbers([80.0, 70.0]), 80.0)],
)  # fmt: skip
def test_the_voltage_of_a_file_is_used(
    stated: bytes, kV: float | None, tmp_path: Path
) -> None:
    path = small(tmp_path / "a.txrm", said={"ImageInfo/Voltage": stated})
    data = fx.open(path)
    assert (data.settings.kV if data.settings else None) == kV
    (said,) = [one for one in data.provenance if one.field == "ImageInfo/Voltage"]
    assert said.use == ("ignored" if kV is None else "used")
