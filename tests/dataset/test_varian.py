"""Varian's Scan.xml with XIM images: images in closed form fit the geometry that is read.

The writer of XIM is of this file: pixel by pixel, as the format's description has it.
"""

from __future__ import annotations

import contextlib
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from turned_balls import PITCH, SDD, SHAPE, SOD, VIEWS, integrals, worst

import flexdt as fx
from flexdt.library.reading.varian_formats.xim_images import read_xim
from flexdt.twin.dataset.dataset_errors import DatasetError

ANGLES = 360.0 / VIEWS * np.arange(VIEWS)
MIDDLE = ((SHAPE[0] - 1) / 2, (SHAPE[1] - 1) / 2)
USUAL: dict[str, Any] = {
    "SAD": SOD, "SID": SDD, "ImagerSizeX": SHAPE[1], "ImagerSizeY": SHAPE[0],
    "ImagerResX": PITCH, "ImagerResY": PITCH, "ImagerLat": 0, "Velocity": 6.0,
}  # fmt: skip


def wrapped(value: int) -> int:
    return (value + 2**31) % 2**32 - 2**31


def packed(image: Any) -> bytes:
    """Lookup table and steps of an image."""
    flat = [int(v) for v in image.ravel()]
    cols = image.shape[1]
    codes, steps = [], b""
    for k in range(cols + 1, len(flat)):
        step = wrapped(flat[k] - flat[k - 1] - flat[k - cols] + flat[k - cols - 1])
        code = next(
            c for c, most in enumerate((7, 15, 31)) if -(2**most) <= step < 2**most
        )
        codes.append(code)
        steps += step.to_bytes(1 << code, "little", signed=True)
    codes += [0] * (-len(codes) % 4)
    table = bytes(
        codes[k] | codes[k + 1] << 2 | codes[k + 2] << 4 | codes[k + 3] << 6
        for k in range(0, len(codes), 4)
    )
    values = struct.pack(f"<{cols + 1}i", *flat[: cols + 1]) + steps
    return (struct.pack("<i", len(table)) + table + struct.pack("<i", len(values)) + values
            + struct.pack("<i", 4 * len(flat)))  # fmt: skip


def xim(path: Path, image: Any, said: dict[str, Any], compressed: bool = True) -> None:
    rows, cols = image.shape
    out = b"VMS.XI\0\0" + struct.pack("<6i", 1, cols, rows, 32, 4, int(compressed))
    if compressed:
        out += packed(image)
    else:
        out += struct.pack("<i", 4 * image.size) + image.astype("<i4").tobytes()
    out += struct.pack("<4i", 3, 5, 6, 7) + struct.pack("<i", len(said))
    for name, value in said.items():
        out += struct.pack("<i", len(name)) + name.encode()
        if isinstance(value, str):
            out += struct.pack("<2i", 2, len(value)) + value.encode()
        elif isinstance(value, list):
            out += struct.pack(f"<2i{len(value)}d", 4, 8 * len(value), *value)
        elif isinstance(value, int):
            out += struct.pack("<2i", 0, value)
        else:
            out += struct.pack("<id", 1, value)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(out)


def written(
    folder: Path,
    lines: Any,
    said: dict[str, Any] | None = None,
    image: dict[str, Any] | None = None,
    angles: Any = ANGLES,
    air: tuple[tuple[str, float, float], ...] = (("Filter.xim", 0.0, 1.0),),
    compressed: bool = True,
) -> Path:
    """A scan whose chamber reads otherwise at each view, columns stored from the other side."""
    pattern = 1.0 + 0.3 * np.cos(np.arange(lines.shape[2]))
    for k, one in enumerate(lines):
        chamber = 900 + 40 * (k % 3)
        turned = np.interp(
            angles[k] % 360.0, [a for _, a, _ in air], [f for *_, f in air]
        )
        counts = np.rint(200.0 * chamber * turned * pattern * np.exp(-one))[:, ::-1]
        own = {"KVNormChamber": chamber, "KVSourceRtn": float(angles[k] % 360.0),
               "GantryRtn": float((angles[k] - 90.0) % 360.0),
               "PixelWidth": PITCH / 10, "KVDetectorLat": 0.0, "MLCLeafsA": [1.0, 2.0],
               "AcquisitionNotes": "none"} | (image or {})  # fmt: skip
        own = {name: value for name, value in own.items() if value is not None}
        at = folder / "Acquisitions" / "1234" / f"Proj_{k:05d}.xim"
        xim(at, counts.astype(np.int64), own, compressed)
    for name, angle, factor in air:
        counts = np.rint(200.0 * 1000 * factor * pattern * np.ones(lines.shape[1:]))[
            :, ::-1
        ]
        xim(folder / "Calibrations" / "Air-7" / "a" / name, counts.astype(np.int64),
            {"KVNormChamber": 1000, "GantryRtn": angle - 90.0})  # fmt: skip
    rows = "".join(
        f"<{k}>{v}</{k}>" for k, v in (USUAL | (said or {})).items() if v is not None
    )
    path = folder / "Scan.xml"
    path.write_text(
        '<?xml version="1.0"?><Scan xmlns="http://baseline.varian.com/cbct.xsd" Version="2.7">'
        f"<Acquisitions>{rows}</Acquisitions></Scan>"
    )
    return path


@pytest.mark.parametrize(
    ("options", "lines"),
    [
        ({}, integrals(ANGLES)),
        ({"compressed": False}, integrals(ANGLES)),
        ({"angles": 300.0 - ANGLES}, integrals(300.0 - ANGLES)),
        ({"image": {"KVSourceRtn": None}}, integrals(ANGLES)),
        ({"image": {"KVDetectorLat": 0.3}, "said": {"ImagerLat": 3.0}},
         integrals(ANGLES, column=MIDDLE[1] + 3.0 / PITCH)),
        ({"image": {"KVDetectorLat": None}, "said": {"ImagerLat": -2.0}},
         integrals(ANGLES, column=MIDDLE[1] - 2.0 / PITCH)),
        ({"image": {"KVDetectorLng": 0.15}},
         integrals(ANGLES, row=MIDDLE[0] - 1.5 / PITCH)),
        ({"said": {"Bowtie": "Half"},
          "air": (("FilterBowtie1.xim", 0.0, 1.0), ("FilterBowtie2.xim", 180.0, 1.2),
                  ("FilterBowtie3.xim", 359.99, 1.0))}, integrals(ANGLES)),
    ],
)  # fmt: skip
def test_images_fit_the_geometry(
    options: dict[str, Any], lines: Any, tmp_path: Path
) -> None:
    data = fx.open(written(tmp_path, lines, **options))
    assert worst(data) < 2e-3
    (told,) = data.warnings
    assert "from documentation, no file of Varian's was seen" in told


RTK = (
    '<?xml version="1.0"?>\n<!DOCTYPE RTKGEOMETRY>\n<RTKThreeDCircularGeometry version="3">'
    "{}</RTKThreeDCircularGeometry>\n"
)


def test_rays_are_those_of_rtks_reader_of_probeam(tmp_path: Path) -> None:
    """RTK takes the images as they are stored, 180 deg - KVSourceRtn, and both offsets."""
    data = fx.open(
        written(
            tmp_path,
            integrals(ANGLES),
            image={"KVDetectorLat": 0.7, "KVDetectorLng": 0.2},
        )
    )
    views = "".join(
        f"<Projection><GantryAngle>{(180.0 - a) % 360.0}</GantryAngle>"
        f"<SourceToIsocenterDistance>{SOD}</SourceToIsocenterDistance>"
        f"<SourceToDetectorDistance>{SDD}</SourceToDetectorDistance>"
        "<ProjectionOffsetX>7</ProjectionOffsetX><ProjectionOffsetY>2</ProjectionOffsetY>"
        "</Projection>"
        for a in ANGLES
    )
    (tmp_path / "rtk.xml").write_text(RTK.format(views))
    other = fx.ConeVec.load(tmp_path / "rtk.xml", pixel=PITCH).rows.reshape(-1, 4, 3)
    own = data.geometry.rows.reshape(-1, 4, 3).copy()
    own[:, 2] *= -1.0  # columns as they are stored
    # RTK's rows grow upwards, from the lowest: row 0 of a stack is its lowest.
    left, _, right = np.linalg.svd(own.reshape(-1, 3).T @ other.reshape(-1, 3))
    assert np.linalg.det(left @ right) == pytest.approx(1.0)  # turned, not mirrored
    np.testing.assert_allclose(own @ left @ right, other, atol=1e-9)


@pytest.mark.parametrize("least", [-(2**31), -70_000, 0])
@pytest.mark.parametrize("compressed", [True, False])
def test_counts_come_out_as_they_went_in(
    least: int, compressed: bool, tmp_path: Path
) -> None:
    rng = np.random.default_rng(7)
    image = rng.integers(least, 2**31 if least else 60_000, (7, 9))
    image[3:] = image[3:] % 100  # steps of one byte
    xim(tmp_path / "a.xim", image, {"KVSourceRtn": 3.5}, compressed)
    found = read_xim(tmp_path / "a.xim")
    np.testing.assert_array_equal(found.pixels, image)
    assert found.properties == {"KVSourceRtn": 3.5}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"said": {"unknown_thing": 3}}, "ignored: unknown_thing = 3"),
        ({"image": {"unknown_thing": 3}}, "ignored: xim/unknown_thing = 3"),
        ({"image": {"KVDetectorRtn": 0.5}}, "KVDetectorRtn 0.5, which is not applied"),
        ({"image": {"PixelWidth": 0.2}}, "xim/PixelWidth says 2 mm, ImagerResX 0.75 mm"),
        ({"said": {"ImagerLat": 4.0}}, "ImagerLat says 4 mm, xim/KVDetectorLat 0 mm"),
        ({"image": {"KVSourceVrt": 13.0}}, "xim/KVSourceVrt says 130 mm, SAD 120 mm"),
    ],
)
def test_what_is_not_honoured_is_told(
    options: dict[str, Any], words: str, tmp_path: Path
) -> None:
    told = fx.open(written(tmp_path, integrals(ANGLES), **options)).warnings
    assert any(words in one for one in told), told


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"said": {"SAD": None}}, "SAD is missing"),
        ({"said": {"SID": "far"}}, "SID is far; allowed: a number"),
        ({"said": {"SAD": 0}}, "SAD is 0 mm"),
        ({"said": {"ImagerSizeX": 9}}, "48 x 40 pixels; allowed: 9 x 40"),
        ({"said": {"Bowtie": "Half"}}, r"FilterBowtie\*.xim is missing, the open beam"),
        ({"image": {"KVNormChamber": 0}}, "KVNormChamber is .*a number above 0"),
        ({"image": {"KVSourceRtn": None, "GantryRtn": "x"}}, "GantryRtn of an image"),
    ],
)
def test_the_impossible_is_refused(
    options: dict[str, Any], words: str, tmp_path: Path
) -> None:
    path = written(tmp_path, integrals(ANGLES[:2]), angles=ANGLES[:2], **options)
    with pytest.raises(DatasetError, match=words):
        fx.open(path)


@pytest.mark.parametrize("seed", range(3))
def test_a_damaged_image_is_an_error_of_the_data_set(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    path = tmp_path / "a.xim"
    xim(path, rng.integers(0, 60_000, (6, 8)), {"KVSourceRtn": 3.5, "Notes": "x"})
    whole = path.read_bytes()
    for _ in range(200):
        raw = bytearray(whole)
        if rng.integers(2):
            raw = raw[: int(rng.integers(len(raw)))]
        else:
            raw[int(rng.integers(len(raw)))] = int(rng.integers(256))
        path.write_bytes(raw)
        with contextlib.suppress(DatasetError):
            read_xim(path)  # nothing else is raised
