"""`flexdt evidence` on files of the published forms, written here from closed forms of our
own."""

from __future__ import annotations

import json
import os
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import patch

import numpy as np
import numpy.typing as npt
import pytest
from compound_file import compound_file
from scipy.io import savemat

import flexdt as fx
from flexdt.clients.cli.command_tree import run

Array = npt.NDArray[np.float64]
POINTS = np.array([0.0, 0.0, 0.0]) + np.random.default_rng(4).uniform(
    -55.0, 55.0, (12, 3)
)


def seen(
    angle_deg: float, sdd: float, points: Array, *, sod: float = 600.0,
    pixel: tuple[float, float] = (0.0748, 0.0748), middle: tuple[float, float] = (767.5, 971.5),
) -> Array:  # fmt: skip
    """Where a pinhole sees points of an object that turns clockwise, (k, 2) [px]."""
    a = np.radians(angle_deg)
    across = points[:, 0] * np.cos(a) + points[:, 1] * np.sin(a)
    deep = sod - points[:, 0] * np.sin(a) + points[:, 1] * np.cos(a)
    places = np.stack([across, -points[:, 2]], axis=1) * (sdd / deep)[:, None]
    return np.asarray(places / pixel + middle)


def needles(folder: Path, sdd: float, sense: float = 1.0) -> None:
    """Two scans as CaTE stores them: a pickled dictionary of frames."""
    rng = np.random.default_rng(2)
    for scan, views, frames in (
        ("pos_2", 3600, range(0, 3600, 400)),
        ("pert_2", 14, range(7)),
    ):
        marks: dict[int, Any] = {}
        for frame in frames:
            places = seen(sense * 360.0 * frame / views, sdd, POINTS) + rng.normal(
                0, 0.2, (12, 2)
            )
            marks[frame] = {("marker", str(k)): (x, y) for k, (x, y) in enumerate(places)}
        np.save(
            folder / f"needle_25Sep2020_{scan}_locations.npy",
            np.array(marks, dtype=object),
        )


def helsinki(folder: Path, place: tuple[float, float] = (9.0, 4.0)) -> None:
    """A fan-beam sinogram of a round Gaussian bump, and its image; the image may be
    elsewhere."""
    turn = np.arange(0.0, 360.5, 0.5)
    a, c = np.radians(turn)[:, None], (np.arange(560) - 279.5) * 0.2
    # The stage turns clockwise, so in the object's frame source and panel turn the other way.
    source = 410.66 * np.stack([np.sin(a), -np.cos(a)], -1)
    across = np.cos(a) * c - np.sin(a) * 553.74
    along = np.stack([across, np.sin(a) * c + np.cos(a) * 553.74], -1)
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    to = np.array([9.0, 4.0]) - source
    off = to[..., 0] * along[..., 1] - to[..., 1] * along[..., 0]
    sinogram = 0.02 * np.sqrt(2 * np.pi) * 3.0 * np.exp(-0.5 * (off / 3.0) ** 2)
    at = (np.arange(512) - 255.5) * 0.14832232
    far = (at - place[0]) ** 2 + (at[::-1, None] - place[1]) ** 2
    said = {"distanceSourceOrigin": 410.66, "distanceSourceDetector": 553.74, "angles": turn,
            "pixelSizePost": 0.2, "effectivePixelSizePost": 0.14832232}  # fmt: skip
    scan = {"CtDataFull": {"sinogram": sinogram, "parameters": said}}
    savemat(folder / "htc2022_bump_full.mat", scan)
    image = 0.02 * np.exp(-0.5 * far / 9.0)
    savemat(folder / "htc2022_bump_full_recon_fbp.mat", {"reconFullFbp": image})


def tooth(folder: Path, turn: float = 179.0) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(folder / "tooth.h5", "w") as file:
        file["exchange/data"] = np.full((60, 2, 64), 900.0, np.float32)
        file["exchange/data_white"] = np.full((3, 2, 64), 1000.0, np.float32)
        file["exchange/data_dark"] = np.full((3, 2, 64), 100.0, np.float32)
        file["exchange/theta"] = np.linspace(0.0, turn, 60)


def delft(folder: Path, mirrored: float = 1.0) -> None:
    """Marks of three sources in three frames as CaTE stores them, and its geometry in cm."""
    rng = np.random.default_rng(3)
    name, pixel = (
        "Calibration_needle_phantom_30degsec_table474mm",
        (302 / 1524, 307 / 1548),
    )
    points = POINTS[:9] * [0.5, 0.5, 1.0]
    xray: Any = ModuleType("cate.xray")
    xray.Geometry = type("Geometry", (), {"__module__": "cate.xray"})
    published: dict[int, Any] = {}
    for k, (azimuth, sod, sdd, aside, above) in enumerate(
        [
            (0.0, 950, 1220, -1.2, 12.0),
            (-119.7, 940, 1210, 3.0, 19.0),
            (120.3, 960, 1232, 0.4, 9.0),
        ]
    ):
        # The source's height is below the panel's middle, and the axis beside it.
        middle = 275.0 + aside / pixel[0], 774.0 + above / pixel[1]
        marks: dict[int, Any] = {509: {"odd": (1.0, 2.0)}} if k == 0 else {}
        for frame in (50, 307, 565):
            turn = azimuth + (frame - 50) * 360 / 773
            places = seen(turn, sdd, points, sod=sod, pixel=pixel, middle=middle)
            places = places + rng.normal(0, 0.3, (9, 2))
            marks[frame] = {f"ball {m}": tuple(place) for m, place in enumerate(places)}
        np.save(folder / f"pre_proc_{name}_cam{k + 1}.npy", np.array(marks, dtype=object))
        toward = np.exp(1j * np.radians(azimuth))
        published[k + 1] = xray.Geometry()
        for what, place, z in (
            ("_source", sod * toward, 0.0), ("_detector", (sod - sdd - 1j * aside) * toward, above)
        ):  # fmt: skip
            stored = 0.1 * np.array([place.real, -mirrored * place.imag, z])
            setattr(published[k + 1], what, stored)
    with patch.dict(sys.modules, {"cate": ModuleType("cate"), "cate.xray": xray}):
        file = folder / f"geom_pre_proc_{name}_calibrated_on_26aug2021.npy"
        np.save(file, np.array([published], dtype=object))


def c_arm(folder: Path, lower: int = 0) -> None:
    """Two views of four Gaussian balls and their matrices; the second image may be lower."""
    rng = np.random.default_rng(5)
    centres, widths = rng.uniform(-40.0, 40.0, (4, 3)), rng.uniform(6.0, 10.0, 4)
    row, column = np.indices((190, 256))
    # Wide, and the second panel askew, so that the weights of the two views differ.
    for name, angle, askew, tilt in (
        ("proj000", 0.1, 0.0, 0.05),
        ("proj040", 2.4, 0.4, 0.3),
    ):
        source, focal = -240.0 * np.array([np.cos(angle), np.sin(angle), 0.05]), 286.0
        right = np.array([-np.sin(angle + askew), np.cos(angle + askew), 0.0])
        toward = np.array([right[1], -right[0], tilt]) / np.hypot(1.0, tilt)
        down = np.cross(toward, right)
        turn = np.array([right, down, toward])
        middle = [126.0, 96.0] - focal * (turn @ source)[:2] / (turn @ source)[2]
        rays = np.stack(
            [column - middle[0], row - middle[1], np.full(row.shape, focal)], -1
        )
        rays = rays @ turn
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        image = np.zeros(row.shape)
        for centre, width in zip(centres, widths, strict=True):
            off = np.linalg.norm(np.cross(rays, centre - source), axis=-1)
            image += width * np.exp(-0.5 * (off / width) ** 2)
        if name == "proj040":
            image = np.roll(image, lower, axis=0)
        camera = (
            np.array([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1]]) @ turn
        )
        matrix = np.column_stack([camera, -camera @ source]).tolist()
        text = "; ".join(" ".join(map(repr, line)) for line in matrix)
        head = (
            "NRRD0004\ndimension: 2\nencoding: raw\nendian: little\nsizes: 256 190\n"
            f"spacings: 1.232 1.232\ntype: float\nProjection Matrix:=[{text}] \n# An end.\n\n"
        )
        (folder / f"{name}.nrrd").write_bytes(
            head.encode() + image.astype("<f4").tobytes()
        )


def zeiss(folder: Path, cone: int = 0) -> None:
    """A Zeiss file with as much as is read before its geometry is."""
    pytest.importorskip("olefile")
    said = {
        "ImageWidth": 4,
        "ImageHeight": 4,
        "NoOfImages": 2,
        "ImagesTaken": 2,
        "DataType": 5,
    }
    streams = {
        f"ImageInfo/{name}": np.uint32(number).tobytes()
        for name, number in {**said, "XrayGeometry": cone}.items()
    }
    (folder / "chip.txrm").write_bytes(compound_file(streams))


def figures(capsys: pytest.CaptureFixture[str]) -> dict[str, bool]:
    document = json.loads(capsys.readouterr().out)
    return {f["what"]: f["agrees"] for case in document["cases"] for f in case["figures"]}


def test_right_data_agree(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    needles(tmp_path, 340.0)
    helsinki(tmp_path)
    tooth(tmp_path)
    delft(tmp_path)
    c_arm(tmp_path)
    zeiss(tmp_path)
    assert run(["--json", "evidence", "--data", str(tmp_path)]) == 0
    found = figures(capsys)
    assert len(found) == 28
    assert all(found.values()), found


# The same image over 240 deg is no scan of anything, and its volume says so.
@pytest.mark.filterwarnings("ignore:no accuracy is claimed")
@pytest.mark.parametrize(
    ("make", "missed"),
    [
        (lambda folder: needles(folder, 352.0), "pos_2: shift of the detector"),
        (lambda folder: needles(folder, 340.0, -1.0), "pos_2: residual"),
        (lambda folder: helsinki(folder, (9.0, -4.0)), "bump: correlation"),
        (lambda folder: tooth(folder, 240.0), "FDK"),
        (lambda folder: zeiss(folder, 1), "open"),
        (lambda folder: c_arm(folder, 2), "planes of both sources, 0 px lower"),
        (lambda folder: delft(folder, -1.0), "1 and 2: turned, magnified"),
    ],
)
def test_wrong_data_are_told_and_end_with_1(
    make: Any, missed: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make(tmp_path)
    assert run(["--json", "evidence", "--data", str(tmp_path)]) == 1
    assert figures(capsys)[missed] is False


def test_what_is_not_at_hand_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["evidence", "--data", str(tmp_path)]) == 0
    assert capsys.readouterr().out.count("not at hand") == 6
    assert run(["evidence", "cate", "--data", str(tmp_path)]) == 1
    assert "github.com/adriaangraas/CaTE" in capsys.readouterr().err
    assert run(["evidence", "walnut"]) == 1
    assert "allowed: cate, htc2022, tooth, zeiss, carm, delft" in capsys.readouterr().err


def test_a_pickle_that_is_more_than_numbers_is_not_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    class Harm:
        def __reduce__(self) -> Any:
            return os.mkdir, (str(tmp_path / "harm"),)

    harm = np.array({0: Harm()}, dtype=object)
    np.save(tmp_path / "needle_25Sep2020_pos_2_locations.npy", harm)
    assert run(["evidence", "cate", "--data", str(tmp_path)]) == 0
    assert "posix.mkdir in a file of numbers" in capsys.readouterr().out
    assert not (tmp_path / "harm").exists()


def test_a_case_that_cannot_be_read_leaves_the_others_their_tables(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    helsinki(tmp_path)
    tooth(tmp_path)
    zeiss(tmp_path)
    monkeypatch.setitem(sys.modules, "h5py", None)  # as `make install` leaves it
    assert run(["evidence", "--data", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "bump: correlation" in out
    assert re.search(
        r"not read: \S*tooth\S*: HDF5 files needs h5py, which is not installed", out
    )
    assert "a parallel beam" in out


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("htc2022_01a_full.mat", b""),
        ("htc2022_01a_full.mat", b"MATLAB 5.0 MAT-file"),
        ("needle_25Sep2020_pos_9_locations.npy", b"\x93NUMPY"),
        ("needle_25Sep2020_pos_2_locations.npy", b""),
        ("proj000.nrrd", b"NRRD0004\n\n"),
        ("tooth.h5", b"no HDF5"),
    ],
)
def test_files_of_unexpected_names_and_forms_are_not_read(
    name: str, content: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    helsinki(tmp_path)
    (tmp_path / name).write_bytes(content)
    (tmp_path / "htc2022_01a_full_recon_fbp.mat").write_bytes(b"")
    assert run(["--json", "evidence", "--data", str(tmp_path)]) == 0
    cases = {case["name"]: case for case in json.loads(capsys.readouterr().out)["cases"]}
    assert [f["agrees"] for f in cases["htc2022"]["figures"]] == [True]
    assert len([one for case in cases.values() for one in case["not_read"]]) == 1


def test_a_scan_whose_partner_is_missing_is_not_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As the challenge's test data are: scans without images by FDK beside them."""
    helsinki(tmp_path)
    whole = next(tmp_path.glob("htc2022_*_full.mat"))
    (tmp_path / "htc2022_01a_full.mat").write_bytes(whole.read_bytes())
    assert run(["evidence", "--data", str(tmp_path), "htc2022"]) == 0
    out = capsys.readouterr().out
    assert "not read: htc2022_01a_full.mat: no htc2022_01a_full_recon_fbp.mat" in out
    assert "bump: correlation" in out


def test_an_error_out_of_flexdt_is_a_missed_figure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    helsinki(tmp_path)
    monkeypatch.setattr(
        fx.Grid, "blank", lambda self: self.none
    )  # AttributeError inside of fdk
    assert run(["evidence", "htc2022", "--data", str(tmp_path)]) == 1
    out = capsys.readouterr().out
    assert re.search(r"an answer +AttributeError: .* +NO", out)


@pytest.mark.skipif(
    "FLEXDT_REAL_DATA" not in os.environ, reason="FLEXDT_REAL_DATA names no folder"
)
def test_the_real_data_agree() -> None:
    assert run(["evidence", "--data", os.environ["FLEXDT_REAL_DATA"]]) == 0
