"""Scans of other scanners, and scans to other programs: the blocks of the page run, and the
balls are where each program's own geometry puts them.

The balls' radiographs are closed forms. A pixel that looks through the middle of a ball has at
least its diameter on the way; with an axis, a sign or an order turned, it does not.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tifffile
from four_balls import BALLS, COLS, MU, PIXEL, ROWS, SDD, SOD, VIEWS, found, images
from loaded_script import load

import flexdt as fx
from flexdt.library.reading.foreign_files import (
    SCAN_FORMATS,
    ScanFormat,
    format_of,
)
from flexdt.twin.dataset.dataset_errors import DatasetError
from flexdt.twin.geometry.conventions import FloatArray

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "other-scanners.md").read_text(encoding="utf-8")
FORMATS = load(ROOT / "docs" / "_ext" / "format_pages.py")
RTK_PAGE = (ROOT / "docs" / "coming-from" / "rtk.md").read_text(encoding="utf-8")
BLOCKS = (
    {form.name: FORMATS.block(FORMATS.page(form)) for form in SCAN_FORMATS if form.table}
    | {"RTK": FORMATS.block(RTK_PAGE)}
    | dict(
        re.findall(
            r"^### ([^\n]+)\n(?:(?!^### ).)*?```python\n(.*?)```", PAGE, re.M | re.S
        )
    )
)
"""Format -> the block of its page, from its file to a volume."""
START = 0.4
"""Stage angle of the first view [rad]."""
RTK = '<?xml version="1.0"?>\n<!DOCTYPE RTKGEOMETRY>\n<RTKThreeDCircularGeometry version="3">\n{}'
VIEW = (
    "<Projection><GantryAngle>{}</GantryAngle><SourceToIsocenterDistance>{}"
    "</SourceToIsocenterDistance><SourceToDetectorDistance>{}</SourceToDetectorDistance>"
    "</Projection>\n"
)


def nikon(folder: Path) -> None:
    made = load(ROOT / "tests" / "dataset" / "test_foreign_files.py")
    made.xtekct(folder / "part", aside=0.7, start=START)


def counts_of(
    folder: Path, sense: float, white: float, names: str, start: float = START
) -> None:
    """The balls' images as 16 bit TIFFs, columns to the right as seen from the source."""
    folder.mkdir(exist_ok=True)
    for view, image in enumerate(images(0.0, start, sense)):
        counts = np.rint(white * image).astype(np.uint16)
        tifffile.imwrite(folder / names.format(view), counts)


def skyscan(folder: Path) -> None:
    counts_of(folder / "part", 1.0, 58_000.0, "part{:08d}.tif")
    (folder / "part" / "part.log").write_text(
        f"[System]\r\nScanner=SkyScan1275\r\n[Acquisition]\r\nFilename Prefix=part\r\n"
        f"Number Of Files= {VIEWS}\r\nNumber Of Rows= {ROWS}\r\nNumber Of Columns= {COLS}\r\n"
        f"Optical Axis (line)= {(ROWS - 1) / 2}\r\nObject to Source (mm)={SOD}\r\n"
        f"Camera to Source (mm)={SDD}\r\nImage Pixel Size (um)={1000 * PIXEL * SOD / SDD}\r\n"
        f"Depth (bits)=16\r\nReference Intensity=58000\r\nUse 360 Rotation=YES\r\n"
        f"Rotation Step (deg)={360 / VIEWS}\r\nRotation Direction=CC\r\n"
        f"Scanning Start Angle={np.rad2deg(START)}\r\n"
    )


def phoenix(folder: Path) -> None:
    counts_of(folder / "part", 1.0, 30_000.0, "part_{:04d}.tif", 0.0)
    voxel = PIXEL * SOD / SDD
    (folder / "part" / "part.pca").write_text(
        f"[Geometry]\nFDD={SDD}\nFOD={SOD}\nVoxelSizeX={voxel}\nVoxelSizeY={voxel}\n"
        f"[CT]\nNumberImages={VIEWS}\nRotationSector=360\n"
        f"[Image]\nDimX={COLS}\nDimY={ROWS}\nFreeRay=30000\n"
    )


def yxlon(folder: Path) -> None:
    (folder / "part").mkdir()
    counts_of(folder / "part" / "Projections", -1.0, 32_767.0, "p{:04d}.tif")
    size = f"<Width>{PIXEL}</Width><Height>{PIXEL}</Height>"
    (folder / "part" / "ScanParameter.xml").write_text(
        '<S xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance"><ConeBeamScanParameter>'
        f"<PixelSize>{size}</PixelSize><ProjectionSize><Width>{COLS}</Width>"
        f"<Height>{ROWS}</Height></ProjectionSize><ProjectionBitdepth>15</ProjectionBitdepth>"
        '<ScanTrajectory xsi:type="CircleTrajectory"><PixelPitch>1</PixelPitch>'
        f"<Fdd>{SDD}</Fdd><Fod>{SOD}</Fod><StartAngle>{-np.rad2deg(START)}</StartAngle>"
        f"<NumberOfProjections>{VIEWS}</NumberOfProjections><Rotation>360</Rotation>"
        "</ScanTrajectory></ConeBeamScanParameter></S>"
    )


def varian(folder: Path) -> None:
    made = load(ROOT / "tests" / "dataset" / "test_varian.py")
    angles = np.rad2deg(START) + 360.0 / VIEWS * np.arange(VIEWS)
    said = {"SAD": SOD, "SID": SDD, "ImagerSizeX": COLS, "ImagerSizeY": ROWS,
            "ImagerResX": PIXEL, "ImagerResY": PIXEL}  # fmt: skip
    lines = -np.log(images(0.0, START))
    own = {"PixelWidth": PIXEL / 10}
    made.written(folder / "part", lines, said, own, angles, compressed=False)


def data_exchange(folder: Path) -> None:
    with pytest.importorskip("h5py").File(folder / "scan.h5", "w") as file:
        file["exchange/data"] = np.rint(5e4 * images(0.0, START)).astype(np.uint16)
        file["exchange/data_white"] = np.full((2, ROWS, COLS), 50_000, np.uint16)
        file["exchange/data_dark"] = np.zeros((2, ROWS, COLS), np.uint16)
        file["exchange/theta"] = np.rad2deg(START) + 360.0 / VIEWS * np.arange(VIEWS)
        file["measurement/instrument/detector/pixel_size_x"] = PIXEL / 1000.0


def zeiss(folder: Path) -> None:
    pytest.importorskip("olefile")
    load(ROOT / "tests" / "dataset" / "test_zeiss.py").balls(folder / "tooth.txrm", 3)


def nxtomo(folder: Path) -> None:
    frames = np.r_[np.full((1, ROWS, COLS), 5e4), 5e4 * images(0.0, START)]
    angles = np.rad2deg(START) + 360.0 / VIEWS * np.arange(VIEWS)
    with pytest.importorskip("h5py").File(folder / "scan.nxs", "w") as file:
        entry = file.create_group("entry/instrument")
        entry["detector/data"] = frames.round().astype(np.uint16)
        entry["detector/image_key"] = [1] + [0] * VIEWS
        for name, value in (
            ("detector/x_pixel_size", PIXEL),
            ("detector/distance", SDD - SOD),
            ("source/distance", -SOD),
        ):
            entry[name] = value
            entry[name].attrs["units"] = "mm"
        file["entry/sample/rotation_angle"] = np.r_[0.0, angles]


def rtk(folder: Path) -> None:
    """As RTK's own programs leave a circle: positive distances, rows from the lowest."""
    pytest.importorskip("itk")
    angles = np.rad2deg(START) + 360.0 / VIEWS * np.arange(VIEWS)
    views = "".join(VIEW.format(angle % 360.0, SOD, SDD) for angle in angles)
    (folder / "geometry.xml").write_text(
        RTK.format(views) + "</RTKThreeDCircularGeometry>\n"
    )
    lines = -np.log(images(0.0, START))[:, ::-1].astype("<f4")
    origin = -(COLS - 1) / 2 * PIXEL, -(ROWS - 1) / 2 * PIXEL, 0.0
    head = (
        "ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = False\n"
        f"Offset = {' '.join(map(str, origin))}\nElementSpacing = {PIXEL} {PIXEL} 1\n"
        f"DimSize = {COLS} {ROWS} {VIEWS}\nElementType = MET_FLOAT\nElementDataFile = LOCAL\n"
    )
    (folder / "projections.mha").write_bytes(head.encode() + lines.tobytes())


MAKERS = {
    "Nikon": nikon,
    "SkyScan": skyscan,
    "phoenix": phoenix,
    "YXLON": yxlon,
    "Varian": varian,
    "Zeiss": zeiss,
    "Data Exchange": data_exchange,
    "NXtomo": nxtomo,
    "RTK": rtk,
}


def ran(block: str, names: dict[str, Any] | None = None) -> dict[str, Any]:
    space = {} if names is None else names
    exec(compile(block, "<page>", "exec"), space)
    return space


def test_every_format_of_scans_has_a_block_and_a_scan_of_the_balls() -> None:
    assert [form.name for form in SCAN_FORMATS] == [*MAKERS][: len(SCAN_FORMATS)]


@pytest.mark.parametrize("form", SCAN_FORMATS, ids=lambda form: form.name)
def test_another_geometry_takes_the_place_of_the_files(
    form: ScanFormat, tmp_path: Path
) -> None:
    MAKERS[form.name](tmp_path)
    [path] = [p for p in tmp_path.rglob("*") if format_of(p) is form]
    other = fx.ConeVec.circular(
        sod=SOD + 1.0, sdd=SDD, angles=VIEWS, shape=(ROWS, COLS), pixel=PIXEL
    )
    data = fx.open(path, geometry=other)
    np.testing.assert_array_equal(data.geometry.rows, other.rows)
    assert data.complete


@pytest.mark.parametrize("form", SCAN_FORMATS, ids=lambda form: form.name)
@pytest.mark.parametrize("content", [b"", b"no scan\n", bytes(range(256)) * 64])
def test_a_damaged_file_is_an_error_that_names_it(
    content: bytes, form: ScanFormat, tmp_path: Path
) -> None:
    for ending in form.endings:
        path = tmp_path / f"scan{ending}"
        path.write_bytes(content)
        with pytest.raises(DatasetError, match=re.escape(path.name)):
            fx.open(path)


@pytest.mark.parametrize("form", SCAN_FORMATS, ids=lambda form: form.name)
def test_a_page_has_the_two_lines_and_every_field(form: ScanFormat) -> None:
    assert form.table is not None
    text = FORMATS.pages()[FORMATS.file_name(form.name)]
    assert len(FORMATS.block(text).strip().splitlines()) == 4  # an import, a blank, two
    rows = re.findall(r"^\| `([^`]+)` \|", text, re.MULTILINE)
    assert rows == [field.name for field in form.table.fields]
    for field in form.table.fields:
        found = form.table.field(field.name)
        assert found is not None
        assert found.role is field.role, field.name  # no row is hidden by an earlier one
        assert field.meaning
        assert field.why


def test_every_block_has_ten_lines_and_two_imports() -> None:
    assert list(BLOCKS) == [*MAKERS, "CTSimU", "To ASTRA", "To CIL", "To TIGRE", "To RTK"]
    for name, block in BLOCKS.items():
        lines = [line for line in block.splitlines() if line.strip()]
        imports = sum(line.startswith(("import ", "from ")) for line in lines)
        assert len(lines) - imports <= 10, name
        assert imports <= 2, name


@pytest.mark.filterwarnings(
    "ignore:. of .. layers of the grid"
)  # the panel moved up and down
@pytest.mark.parametrize(
    "name",
    [
        "NXtomo",
        *(pytest.param(n, marks=pytest.mark.slow) for n in MAKERS if n != "NXtomo"),
    ],
)
@pytest.mark.campaign(1)
def test_a_scan_becomes_a_volume(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    MAKERS[name](tmp_path)
    if name == "RTK":  # ITK in a process of its own
        subprocess.run([sys.executable, "-c", BLOCKS[name]], check=True, timeout=250)
        volume = fx.Volume.load("rtk.mha")
    else:
        volume = ran(BLOCKS[name])["volume"]
    np.testing.assert_allclose(found(volume), 1.0, atol=0.05)


@pytest.mark.slow
def test_a_ctsimu_set_becomes_a_volume(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("flexdt_extensions")
    monkeypatch.chdir(tmp_path)
    here = ROOT / "extensions" / "examples" / "ctsimu"
    for file in here.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    flexdt = Path(sys.executable).with_name("flexdt")
    command = [flexdt, "simulate", "shell.json", "--out", "shell"]
    subprocess.run(command, check=True, capture_output=True, timeout=250)
    space = ran(BLOCKS["CTSimU"])
    lines = space["data"].line_integrals()
    assert (len(space["data"]), len(space["data"].flats), len(space["data"].darks)) == (
        24,
        2,
        1,
    )
    assert abs(float(np.median(lines[:, :, [0, -1]]))) < 0.02 < 0.2 < float(lines.max())
    assert (
        0.0 < float(space["found"].parameters["axis_column_px"]["value"]) < lines.shape[2]
    )
    assert float(np.nanmax(space["volume"].data)) > 0.0


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> dict[str, fx.DataSet]:
    """Panels with columns and rows in all the orders that occur: Nikon's, Zeiss's, our own."""
    folder = tmp_path_factory.mktemp("scans")
    nikon(folder)
    zeiss(folder)
    own = fx.ConeVec.circular(
        sod=SOD, sdd=SDD, shape=(ROWS, COLS), pixel=PIXEL,
        angles=np.rad2deg(START) + 360.0 / VIEWS * np.arange(VIEWS),
    )  # fmt: skip
    return {
        "nikon": fx.open(folder / "part" / "part.xtekct"),
        "zeiss": fx.open(folder / "tooth.txrm"),
        "own": fx.DataSet.from_arrays(-np.log(images(0.0, START)), own),
    }


def crossed(
    source: FloatArray, corner: FloatArray, u: FloatArray, v: FloatArray
) -> FloatArray:
    """Columns and rows (n, balls, 2) where rays through the balls meet panels (n, 3)."""
    out = np.empty((len(source), len(BALLS), 2))
    for n in range(len(source)):
        for k, ball in enumerate(BALLS[:, :3]):
            sides = np.stack([u[n], v[n], source[n] - ball], axis=-1)
            out[n, k] = np.linalg.solve(sides, source[n] - corner[n])[:2]
    return out


def through_the_balls(pictures: FloatArray, places: FloatArray) -> bool:
    """Whether the pixels at these places have the balls' diameters on their way."""
    cols, rows = np.rint(places).astype(int).transpose(2, 0, 1)
    seen = pictures[np.arange(len(pictures))[:, None], rows, cols]
    return bool((seen > 0.93 * 2.0 * MU * BALLS[:, 3]).all())


def of_vectors(vectors: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """ASTRA's: the middle of the panel, steps to the next column and the next row."""
    source, middle, u, v = np.split(np.asarray(vectors), 4, axis=1)
    corner = middle - (shape[1] - 1) / 2 * u - (shape[0] - 1) / 2 * v
    return crossed(source, corner, u, v)


@pytest.mark.parametrize("scan", ["nikon", "zeiss", "own"])
def test_astra_sees_the_balls_where_they_are(
    scan: str, scans: dict[str, fx.DataSet], monkeypatch: pytest.MonkeyPatch
) -> None:
    astra = ModuleType("astra")
    astra.data3d = SimpleNamespace(create=lambda *given: given)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "astra", astra)
    kind, geometry, sino = ran(BLOCKS["To ASTRA"], {"data": scans[scan]})["number"]
    rows, cols = geometry["DetectorRowCount"], geometry["DetectorColCount"]
    assert (kind, geometry["type"], sino.shape) == (
        "-sino",
        "cone_vec",
        (rows, VIEWS, cols),
    )
    pictures = sino.transpose(1, 0, 2)
    places = of_vectors(geometry["Vectors"], (rows, cols))
    assert through_the_balls(pictures, places)
    assert not through_the_balls(pictures[:, ::-1], places)
    assert not through_the_balls(pictures[:, :, ::-1], places)


class Flexible:
    """CIL's geometry of one pose a view."""

    def __init__(self, *sides: FloatArray) -> None:
        self.sides = [np.asarray(side) for side in sides]

    @classmethod
    def create_Cone3D_Flex(cls, *sides: FloatArray) -> Flexible:
        return cls(*sides)

    def set_panel(self, num_pixels: Any, pixel_size: Any, origin: str) -> None:
        assert origin == "top-left"  # rows are counted downwards, as u and v are
        self.pixels, self.size = num_pixels, pixel_size

    def allocate(self, value: float) -> SimpleNamespace:
        kept: list[FloatArray] = []
        return SimpleNamespace(fill=kept.append, kept=kept)


@pytest.mark.parametrize("scan", ["nikon", "zeiss", "own"])
def test_cil_sees_the_balls_where_they_are(
    scan: str, scans: dict[str, fx.DataSet], monkeypatch: pytest.MonkeyPatch
) -> None:
    framework = ModuleType("cil.framework")
    framework.AcquisitionGeometry = Flexible  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "cil", ModuleType("cil"))
    monkeypatch.setitem(sys.modules, "cil.framework", framework)
    space = ran(BLOCKS["To CIL"], {"data": scans[scan]})
    source, middle, *directions = space["scan"].sides
    u, v = (
        side / np.linalg.norm(side, axis=1, keepdims=True) * size
        for side, size in zip(directions, space["scan"].size, strict=True)
    )
    cols, rows = space["scan"].pixels
    # CIL's direction of rows is upwards; the first row is the top one.
    places = of_vectors(np.concatenate([source, middle, u, -v], axis=1), (rows, cols))
    pictures = space["images"].kept[0]
    assert through_the_balls(pictures, places)
    assert not through_the_balls(pictures[:, ::-1], places)
    assert not through_the_balls(pictures[:, :, ::-1], places)


@pytest.mark.parametrize("scan", ["nikon", "zeiss", "own"])
def test_tigre_sees_the_balls_where_they_are(
    scan: str, scans: dict[str, fx.DataSet], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The source stands on +x, columns of the panel go to +y and rows, from the lowest, to
    +z; the panel is turned about its middle (x, y, z, in this order), then both turn
    anticlockwise by the angle.
    """
    tigre = ModuleType("tigre")
    tigre.geometry = lambda mode: SimpleNamespace(mode=mode)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "tigre", tigre)
    space = ran(BLOCKS["To TIGRE"], {"data": scans[scan]})
    geo, angles = space["geo"], np.ravel(space["angles"])

    dso, dsd = (np.ravel(np.broadcast_to(d, VIEWS)) for d in (geo.DSO, geo.DSD))
    aside = np.broadcast_to(geo.offDetector, (VIEWS, 2))
    moved = np.broadcast_to(geo.offOrigin, (VIEWS, 3))[:, ::-1]
    turns = np.broadcast_to(geo.rotDetector, (VIEWS, 3))
    sides: list[list[FloatArray]] = [[], [], [], []]
    for view, angle in enumerate(angles):
        x, y, z = turns[view]
        panel = _about(2, z) @ _about(1, y) @ _about(0, x)
        u = panel @ [0.0, geo.dDetector[1], 0.0]
        v = panel @ [0.0, 0.0, geo.dDetector[0]]
        middle = np.array([dso[view] - dsd[view], aside[view, 1], aside[view, 0]])
        corner = middle - (geo.nDetector[1] - 1) / 2 * u - (geo.nDetector[0] - 1) / 2 * v
        turn = _about(2, angle)
        sides[0].append(turn @ [dso[view], 0.0, 0.0] - moved[view])
        sides[1].append(turn @ corner - moved[view])
        sides[2].append(turn @ u)
        sides[3].append(turn @ v)
    places = crossed(*map(np.array, sides))
    np.testing.assert_allclose(geo.sDetector, geo.nDetector * geo.dDetector)
    assert through_the_balls(space["images"], places)
    assert not through_the_balls(space["images"][:, ::-1], places)
    assert not through_the_balls(space["images"][:, :, ::-1], places)


def _about(axis: int, angle: float) -> FloatArray:
    """The matrix of a right-handed turn about an axis."""
    a, b = (axis + 1) % 3, (axis + 2) % 3
    out = np.eye(3)
    out[a, a] = out[b, b] = np.cos(angle)
    out[b, a] = np.sin(angle)
    out[a, b] = -out[b, a]
    return out


@pytest.mark.slow
@pytest.mark.parametrize("scan", ["nikon", "zeiss"])
@pytest.mark.campaign
def test_rtk_sees_the_balls_where_they_are(
    scan: str, scans: dict[str, fx.DataSet], tmp_path: Path
) -> None:
    """What RTK's reader makes of the file, with the images that ITK wrote."""
    pytest.importorskip("itk")
    scans[scan].save(tmp_path / "scan")
    code = f"import flexdt as fx\ndata = fx.open('scan')\n{BLOCKS['To RTK']}" + (
        "reader = itk.RTK.ThreeDCircularProjectionGeometryXMLFileReader.New()\n"
        "reader.SetFilename('scan.xml')\n"
        "reader.GenerateOutputInformation()\n"
        "seen = reader.GetOutputObject()\n"
        "back = itk.imread('scan.mha')\n"
        "matrices = [itk.array_from_matrix(seen.GetMatrix(i)) for i in range(len(data))]\n"
        "np.savez('seen.npz', images=itk.array_from_image(back), "
        "first=list(back.GetOrigin()),\n"
        "         step=list(back.GetSpacing()), matrices=matrices)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path, timeout=250)
    seen = np.load(tmp_path / "seen.npz")
    balls = BALLS[:, [0, 2, 1]] * [1.0, 1.0, -1.0]  # RTK's x, y, z
    shown = seen["matrices"] @ np.c_[balls, np.ones(len(balls))].T
    places = (shown[:, :2] / shown[:, 2:]).transpose(0, 2, 1)
    assert through_the_balls(
        seen["images"], (places - seen["first"][:2]) / seen["step"][:2]
    )
