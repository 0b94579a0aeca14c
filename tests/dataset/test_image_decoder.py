"""One decoder of images: the meaning of a file does not depend on its compression or packing.

The files are written byte by byte (`tests.support.tiff_bytes_of`, `image_bytes_of`) or by the
encoders of imagecodecs; nothing of the reader is used to make them.
"""

from __future__ import annotations

import itertools
import re
import sys
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from image_bytes_of import (
    bmp_file,
    edf_file,
    meta_header,
    npy_file,
    nrrd_header,
    png_file,
)
from tiff_bytes_of import COMPRESSIONS, stored_of, tiff_file

from flexdt.runtime.files.dataset_folder import read_image, read_values
from flexdt.runtime.files.image_files import image_head, read_rows
from flexdt.twin.dataset.dataset_errors import DatasetError

RNG = np.random.default_rng(77)
SHOWN = RNG.integers(0, 65536, (7, 19)).astype("u2")
SHOWN[:, 5:12] = SHOWN[0, 5]  # runs, for PackBits and LZW
LOW = (SHOWN >> 8).astype("u1")
WHOLE = {"u1": 255, "u2": 65535, "u4": 2**32 - 1}


def read(path: Path, content: bytes) -> np.ndarray[Any, Any]:
    path.write_bytes(content)
    values = read_values(path)
    assert values.shape == image_head(path).shape
    assert values.dtype.isnative
    return values


@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize("orientation", [None, *range(1, 9)])
@pytest.mark.parametrize("kind", ["u1", "u2"])
@pytest.mark.parametrize("photometric", [None, 0, 1])
def test_one_image_whatever_the_compression(
    tmp_path: Path, compression: int, orientation: int, kind: str, photometric: int
) -> None:
    shown = LOW if kind == "u1" else SHOWN
    stored = stored_of(shown, orientation or 1)
    if photometric == 0:
        stored = (WHOLE[kind] - stored).astype(kind)
    file = tiff_file(
        [stored],
        compression=compression,
        orientation=orientation,
        photometric=photometric,
    )
    np.testing.assert_array_equal(read(tmp_path / "a.tif", file), shown)


LAYOUTS = [
    {},
    {"rows_per_strip": 3},
    {"tile": (16, 16)},
    {"big": True},
    {"fill_order": 2},
]
PACKINGS = [(1, "u1"), (4, "u1"), (10, "u2"), (12, "u2"), (14, "u2"), (24, "u4"), (32, "u4"),
            (16, "i2"), (32, "i4"), (16, "f2"), (32, "f4"), (64, "f8")]  # fmt: skip


@pytest.mark.parametrize("packing", PACKINGS)
@pytest.mark.parametrize("order", ["<", ">"])
def test_packings_types_orders_and_layouts(
    tmp_path: Path, packing: tuple[int, str], order: str
) -> None:
    bits, kind = packing
    if kind[0] == "f":
        shown = RNG.normal(size=(7, 19)).astype(kind)
    elif kind[0] == "i":
        shown = RNG.integers(-30000, 30000, (7, 19)).astype(kind)
    else:
        shown = RNG.integers(0, 2**bits, (7, 19)).astype(kind)
    for compression, layout in itertools.product(COMPRESSIONS, LAYOUTS):
        file = tiff_file(
            [shown], order=order, bits=bits, compression=compression, **layout
        )
        np.testing.assert_array_equal(read(tmp_path / "a.tif", file), shown)
    assert image_head(tmp_path / "a.tif").bits == bits


@pytest.mark.parametrize("compression", [5, 8])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(
    ("kind", "predictor"),
    [("u1", 2), ("u2", 2), ("u4", 2), ("i2", 2), ("f4", 3), ("f8", 3)],
)
def test_differences_are_undone(
    tmp_path: Path, compression: int, order: str, kind: str, predictor: int
) -> None:
    shown = SHOWN.astype("u1" if kind == "u1" else kind)
    for layout in LAYOUTS:
        made = tiff_file(
            [shown], order=order, compression=compression, predictor=predictor, **layout
        )
        np.testing.assert_array_equal(read(tmp_path / "a.tif", made), shown)


@pytest.mark.parametrize("planar", [1, 2])
@pytest.mark.parametrize("compression", [1, 5, 8])
def test_samples_beside_the_grey_value(
    tmp_path: Path, planar: int, compression: int
) -> None:
    """Equal colours and an opacity that never changes leave grey values; others do not."""
    opaque = np.full_like(SHOWN, 65535)
    seen = {"planar": planar, "compression": compression}
    for samples, more in (
        ([SHOWN, opaque], {"extra": (2,)}),
        ([SHOWN] * 3, {"photometric": 2}),
        ([SHOWN] * 3 + [opaque], {"photometric": 2, "extra": (2,)}),
    ):
        file = tiff_file([np.stack(samples, -1)], **seen, **more)
        np.testing.assert_array_equal(read(tmp_path / "a.tif", file), SHOWN)
    coloured = np.stack([SHOWN, SHOWN, opaque], -1)
    with pytest.raises(DatasetError, match="is in colour: red, green and blue differ"):
        read(tmp_path / "a.tif", tiff_file([coloured], photometric=2, **seen))
    with pytest.raises(DatasetError, match="the grey value changes from pixel to pixel"):
        read(
            tmp_path / "a.tif",
            tiff_file([np.stack([SHOWN, SHOWN], -1)], extra=(0,), **seen),
        )


RAMP = [(i * 257) % 65536 for i in range(256)] * 3
REFUSED = {
    "orientation 9": ([LOW], {"orientation": 9}, r"has the orientation 9 \(tag 274\); allowed: 1"),
    "complex": ([SHOWN], {"sample_format": 6}, "holds complex numbers; allowed: real"),
    "white floats": ([SHOWN.astype("f4")], {"photometric": 0}, "0 is white .*float32"),
    "CMYK": ([np.stack([LOW] * 4, -1)], {"photometric": 5}, "holds CMYK; allowed: grey"),
    "filter": ([LOW], {"photometric": 32803}, "holds a colour filter array"),
    "palette": ([LOW], {"photometric": 3, "more": ((320, 3, RAMP[::-1]),)}, "table of colours"),
    "no palette": ([LOW], {"photometric": 3}, "table of colours"),
    "differences": ([SHOWN], {"more": ((317, 3, [2]),)}, "with compression NONE, which TIFF"),
    "packed differences": (
        [SHOWN >> 4], {"bits": 12, "compression": 8, "more": ((317, 3, [2]),)}, "12 bits"
    ),
    "several": ([LOW, LOW], {}, "holds 2 images; allowed: one"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_not_undone_is_refused_with_its_cause(tmp_path: Path, case: str) -> None:
    pages, said, why = REFUSED[case]
    with pytest.raises(DatasetError, match=why):
        read(tmp_path / "a.tif", tiff_file(pages, **said))


def test_smaller_copies_beside_the_image_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, SHOWN)
    tifffile.imwrite(path, SHOWN[::2, ::2].copy(), append=True, subfiletype=1)
    tifffile.imwrite(path, SHOWN // 2, append=True)
    assert image_head(path).images == 2
    np.testing.assert_array_equal(read_image(path, None, 1), SHOWN // 2)


def test_a_grey_palette_is_its_numbers(tmp_path: Path) -> None:
    for step in (257, 256):
        ramp = [i * step for i in range(256)] * 3
        file = tiff_file([LOW], photometric=3, more=((320, 3, ramp),))
        np.testing.assert_array_equal(read(tmp_path / "a.tif", file), LOW)


@pytest.mark.parametrize("codec", ["zstd", "lzma", "jpeg2000", "jpegxl", "png", "webp"])
def test_compressions_of_a_peer(tmp_path: Path, codec: str) -> None:
    shown = LOW if codec == "webp" else SHOWN
    path = tmp_path / "a.tif"
    options: dict[str, Any] = {"compression": codec}
    if codec in ("jpegxl", "webp"):
        options["compressionargs"] = {"lossless": True}
    if codec == "webp":
        shown = np.stack([LOW] * 3, -1)
        options["photometric"] = "rgb"
    tifffile.imwrite(path, shown, extratags=[(274, "H", 1, 3, True)], **options)
    np.testing.assert_array_equal(
        read_values(path), (shown if shown.ndim == 2 else LOW)[::-1, ::-1]
    )


def test_stacks_of_one_directory_are_counted(tmp_path: Path) -> None:
    """ImageJ writes large stacks with one directory; a file that is too short is refused."""
    three = np.stack([SHOWN, SHOWN // 2, SHOWN // 3])
    path = tmp_path / "a.tif"
    word = b"ImageJ=1.54\nimages=3\nslices=3\n\0"
    file = tiff_file([three.reshape(-1, 19)], more=((270, 2, word),))
    file = file.replace(
        (21).to_bytes(4, "little"), (7).to_bytes(4, "little")
    )  # the directory tells of one of them
    file = file.replace((21 * 38).to_bytes(4, "little"), (7 * 38).to_bytes(4, "little"))
    path.write_bytes(file)
    assert image_head(path).images == 3
    for k in range(3):
        np.testing.assert_array_equal(read_image(path, None, k), three[k])
    with pytest.raises(DatasetError, match="holds 3 images; asked for number 4"):
        read_image(path, None, 3)
    alone = tiff_file([SHOWN], more=((270, 2, word),))
    with pytest.raises(DatasetError, match="says that it holds 3 images, and holds one"):
        read(path, alone)


def test_files_with_the_same_tags_are_read_without_parsing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only those: a tag that differs, in place or beside, is heeded."""
    path = tmp_path / "a.tif"
    for turn in (1, 3, 1):
        for image in (SHOWN, SHOWN // 2):
            file = tiff_file([image], orientation=turn, rows_per_strip=3)
            np.testing.assert_array_equal(read(path, file), stored_of(image, turn))
    opened: list[object] = []
    parse = tifffile.TiffFile
    monkeypatch.setattr(
        tifffile, "TiffFile", lambda *a, **k: opened.append(a) or parse(*a, **k)
    )
    for image in (SHOWN, SHOWN // 2, SHOWN // 3):
        path.write_bytes(tiff_file([image], orientation=1, rows_per_strip=3))
        np.testing.assert_array_equal(read_values(path), image)
    assert len(opened) <= 1


def test_other_formats(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"  # an ending decides nothing
    signed = SHOWN.astype("i4") - 9
    floats = SHOWN.astype("f4")
    opaque = np.stack([SHOWN, np.full_like(SHOWN, 65535)], -1)
    cases = [
        (png_file(SHOWN), SHOWN), (png_file(LOW), LOW), (png_file(opaque, 4), SHOWN),
        (png_file(np.stack([LOW] * 3, -1), 2), LOW),
        (png_file(LOW, 3, [(b"PLTE", bytes(i for i in range(256) for _ in "rgb"))]), LOW),
        (bmp_file(LOW), LOW), (bmp_file(LOW, down=True), LOW),
        (bmp_file(np.stack([LOW] * 3, -1)), LOW), (bmp_file(np.stack([LOW] * 4, -1)), LOW),
        (edf_file([SHOWN]), SHOWN), (edf_file([signed], ">"), signed),
        (edf_file([floats]), floats),
        (meta_header(SHOWN.shape, "u2") + SHOWN.tobytes(), SHOWN),
        (meta_header(SHOWN.shape, "u2", CompressedData="True") + zlib.compress(SHOWN.tobytes()),
         SHOWN),
        (meta_header(SHOWN.shape, "u2", BinaryDataByteOrderMSB="True")
         + SHOWN.astype(">u2").tobytes(), SHOWN),
        (nrrd_header(SHOWN.shape, "u2") + SHOWN.tobytes(), SHOWN),
        (nrrd_header(SHOWN.shape, "f4", endian="big") + floats.astype(">f4").tobytes(), floats),
        (npy_file(SHOWN), SHOWN), (npy_file(floats, fortran=True), floats),
        (npy_file(SHOWN.astype(">u2")), SHOWN),
    ]  # fmt: skip
    for content, shown in cases:
        values = read(path, content)
        np.testing.assert_array_equal(values, shown)
        assert values.dtype == shown.dtype


def test_numbers_beside_their_header(tmp_path: Path) -> None:
    """.mhd and .nhdr with .raw: rows and images in C's order, a skipped head, too."""
    three = np.stack([SHOWN, SHOWN // 2, SHOWN // 3])
    (tmp_path / "a.raw").write_bytes(b"head" + three.tobytes())
    for name, header in (
        ("a.mhd", meta_header(three.shape, "u2", "a.raw", HeaderSize="4")),
        ("b.mhd", meta_header(three.shape, "u2", "a.raw", HeaderSize="-1")),
        ("a.nhdr", nrrd_header(three.shape, "u2", "a.raw", **{"byte skip": "4"})),
    ):
        path = tmp_path / name
        path.write_bytes(header)
        assert image_head(path).images == 3
        for k in range(3):
            np.testing.assert_array_equal(read_image(path, None, k), three[k])
    outside = tmp_path / "c.mhd"
    for data, why in (("../a.raw", "allowed: a file beside it"), ("x.raw", "which is not there"),
                      ("LIST", "in several files")):  # fmt: skip
        outside.write_bytes(meta_header(three.shape, "u2", data))
        with pytest.raises(DatasetError, match=why):
            read_image(outside)
    path = tmp_path / "several.edf"
    path.write_bytes(edf_file(list(three)))
    for k in range(3):
        np.testing.assert_array_equal(read_image(path, None, k), three[k])


OTHERS = {
    "a JPEG image": b"\xff\xd8\xff\xe0\0\x10JFIF", "an HDF5 file": b"\x89HDF\r\n\x1a\n",
    "is no TIFF file: it begins with other bytes": b"SIMPL   = nothing",
    "a FITS file": b"SIMPLE  =                    T", "is empty": b"",
    "as a file that was never written": bytes(4000),
    "Python objects": npy_file(np.zeros((2, 2), "u2"), descr="|O"),
}  # fmt: skip


@pytest.mark.parametrize("why", OTHERS)
def test_other_files_are_named(tmp_path: Path, why: str) -> None:
    with pytest.raises(DatasetError, match=re.escape(why)):
        read(tmp_path / "a.tif", OTHERS[why])


def test_a_base_installation_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Plain, deflate and PackBits are read without imagecodecs, as tifffile alone reads them."""
    import tifffile._imagecodecs as own

    path = tmp_path / "a.tif"
    monkeypatch.setitem(sys.modules, "imagecodecs", None)
    monkeypatch.setattr(tifffile.TIFF, "DECOMPRESSORS", {32773: own.packbits_decode})
    for code in (1, 8, 32773):
        np.testing.assert_array_equal(
            read(path, tiff_file([SHOWN], compression=code)), SHOWN
        )
    for content, what in (
        (tiff_file([SHOWN], compression=5), "compressed by LZW"),
        (png_file(SHOWN), "a PNG image"),
    ):
        with pytest.raises(
            DatasetError,
            match=rf"is {what}, which needs imagecodecs: pip install 'flexdt\[io\]'",
        ):
            read(path, content)


@pytest.mark.parametrize("shape", [(8, 6), (3, 6), (4, 5)])
def test_rows_of_another_shape_are_refused_however_often_they_are_asked_for(
    tmp_path: Path, shape: tuple[int, int]
) -> None:
    """The second time the tags are known, and only the rows are read."""
    path = tmp_path / "dark.tif"
    grey = np.arange(24, dtype=np.uint16).reshape(4, 6)
    tifffile.imwrite(path, grey)
    rows = np.array([0, 2])
    for _ in range(2):
        with pytest.raises(DatasetError, match="another shape"):
            read_rows(path, shape, rows)
        np.testing.assert_array_equal(read_rows(path, (4, 6), rows), grey[rows])
