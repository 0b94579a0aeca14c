"""Bad files of every format are refused in flexdt's words: no library's message gets through.

Each file is a right one, spoilt by chance: cut off, bytes exchanged, its head or its end
replaced, other bytes behind it.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from image_bytes_of import (
    bmp_file,
    edf_file,
    meta_header,
    npy_file,
    nrrd_header,
    png_file,
)
from tiff_bytes_of import COMPRESSIONS, tiff_file

import flexdt as fx
from flexdt.runtime.files.dataset_folder import read_values

h5py = pytest.importorskip("h5py")

EACH = 40
SCAN = fx.ConeVec.circular(sod=100, sdd=200, angles=3, shape=(12, 17), pixel=1.0)
COUNTS = np.random.default_rng(7).integers(9, 60_000, (3, 12, 17)).astype("u2")
LOW = (COUNTS[0] >> 8).astype("u1")
FLOATS = COUNTS[0].astype("f4")

WORDS = re.compile(
    r"Traceback|pickle|\bnumpy\.|ndarray|tifffile|cv2|opencv|imagecodecs|libdeflate|\bIMCD"
    r"|pydantic|validation error|input_value|errors\.pydantic|h5py|HDF5 library|Unable to|errno ="
    r"|can't decode|codec can|buffer size|NoneType|object has no|not subscriptable|unpack"
    r"|literal for|could not convert|dictionary|list index|tuple index|KeyError|struct\.error"
    r"|0x[0-9a-f]{6}|\bsrc/|\.py\b|OLE2 header|nibabel|<class",
    re.IGNORECASE,
)


def tiffs() -> list[bytes]:
    made = [
        tiff_file([COUNTS[0]], compression=code, rows_per_strip=5)
        for code in COMPRESSIONS
    ]
    made += [tiff_file([COUNTS[0]], tile=(16, 16), big=True), tiff_file(list(COUNTS[:2]))]
    return [*made, tiff_file([FLOATS], compression=5, predictor=3)]


def saved(name: str, save: Callable[[Path], object]) -> Callable[[Path], list[bytes]]:
    def make(tmp_path: Path) -> list[bytes]:
        save(tmp_path / name)
        return [(tmp_path / name).read_bytes()]

    return make


def volume(path: Path) -> None:
    fx.Volume(np.ones((3, 4, 5), np.float32), 0.5).save(path)


def nxtomo(path: Path) -> None:
    fx.DataSet.from_arrays(COUNTS, SCAN, dark=0, flat=60_000).to_nxtomo(path)


FORMATS: dict[str, tuple[Callable[[Path], list[bytes]], Callable[[Path], Any]]] = {
    "a.tif": (lambda _: tiffs(), read_values),
    "a.png": (lambda _: [png_file(COUNTS[0]), png_file(LOW)], read_values),
    "a.bmp": (lambda _: [bmp_file(LOW), bmp_file(np.stack([LOW] * 3, -1))], read_values),
    "a.edf": (lambda _: [edf_file([COUNTS[0]]), edf_file(list(COUNTS))], read_values),
    "a.mha": (
        lambda _: [meta_header((12, 17), "u2") + COUNTS[0].tobytes()], read_values
    ),
    "a.nrrd": (
        lambda _: [nrrd_header((12, 17), "u2") + COUNTS[0].tobytes()], read_values
    ),
    "a.npy": (lambda _: [npy_file(COUNTS[0]), npy_file(FLOATS, fortran=True)], read_values),
    "s.nxs": (saved("s.nxs", nxtomo), fx.open),
    "g.json": (saved("g.json", SCAN.save), fx.ConeVec.load),
    "g.npy": (saved("g.npy", SCAN.save), fx.ConeVec.load),
    "g.csv": (saved("g.csv", SCAN.save), fx.ConeVec.load),
    "g.xml": (saved("g.xml", SCAN.save), lambda path: fx.ConeVec.load(path, pixel=1.0)),
    "v.tif": (saved("v.tif", volume), fx.Volume.load),
    "v.h5": (saved("v.h5", volume), fx.Volume.load),
    "v.mha": (saved("v.mha", volume), fx.Volume.load),
    "v.nrrd": (saved("v.nrrd", volume), fx.Volume.load),
    "v.nii.gz": (saved("v.nii.gz", volume), fx.Volume.load),
}  # fmt: skip


def spoilt(raw: bytes, rng: np.random.Generator) -> bytes:
    """A file that is damaged by chance, in one of six ways."""
    out = bytearray(raw)
    how = rng.integers(6)
    if how == 0:
        return bytes(out[: rng.integers(len(out))])
    if how == 1:
        return bytes(out[:16]) + rng.bytes(int(rng.integers(1, 300)))
    if how == 2:
        return bytes(out) + rng.bytes(int(rng.integers(1, 40)))
    near = {3: len(out), 4: min(len(out), 300), 5: len(out)}[int(how)]
    start = max(len(out) - 300, 0) if how == 5 else 0
    for _ in range(rng.integers(1, 8)):
        out[rng.integers(start, near)] = rng.choice([0, 255, rng.integers(256)])
    return bytes(out)


@pytest.mark.parametrize("name", FORMATS)
def test_no_library_speaks_to_a_user(
    tmp_path: Path, name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    make, read = FORMATS[name]
    rng = np.random.default_rng([77, *name.encode()])
    right = make(tmp_path)
    path = tmp_path / f"bad{name[1:]}"
    refused = 0
    for _ in range(EACH):
        path.write_bytes(spoilt(right[rng.integers(len(right))], rng))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                read(path)
            except fx.TwinError as error:
                refused += 1
                said = str(error).replace(str(tmp_path), "")
                assert not WORDS.search(said), said
                assert len(said) < 600, said
    assert refused >= EACH // 5
    assert capfd.readouterr() == ("", "")
