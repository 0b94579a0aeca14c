"""NumPy's files from outside: what they claim is compared with what they hold."""

from __future__ import annotations

import io
import struct
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of

from flexdt.runtime.files.array_files import read_arrays
from flexdt.twin.input_limits import LIMITS, InputLimitError


def npy(shape: str, data: bytes = b"", descr: str = "<f8") -> bytes:
    """An .npy whose head claims any shape."""
    head = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}"
    head = head.ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head.encode() + data


@settings(max_examples=25, deadline=None)
@given(
    st.dictionaries(
        st.text("abc", min_size=1, max_size=3),
        arrays_of.arrays(
            st.sampled_from(["<f8", ">f4", "<i2", "u1", "<U3", "?"]),
            arrays_of.array_shapes(min_dims=0, max_side=4, min_side=0),
        ),
        min_size=1,
        max_size=3,
    ),
    st.booleans(),
)
def test_what_numpy_writes_is_read(tmp_path_factory, arrays, packed):
    path = tmp_path_factory.mktemp("arrays") / "a.npz"
    (np.savez_compressed if packed else np.savez)(path, **arrays)
    read = read_arrays(path)
    assert set(read) == set(arrays)
    for name, array in arrays.items():
        np.testing.assert_array_equal(read[name], array)
        assert read[name].dtype == array.dtype
    one = next(iter(arrays.values()))
    np.save(path.with_suffix(".npy"), np.asfortranarray(one))
    np.testing.assert_array_equal(read_arrays(path.with_suffix(".npy"))["array"], one)


@pytest.mark.parametrize(
    "shape", ["(1000000000000,)", "(10**9, 10**9)", "(3,)", "(2**62, 4)", "(-1,)"]
)
def test_a_head_that_claims_more_than_its_file_is_refused(tmp_path, shape):
    path = tmp_path / "a.npy"
    claim = str(tuple(eval(shape)))  # heads hold literals
    path.write_bytes(npy(claim, bytes(16)))
    with pytest.raises(InputLimitError, match="allowed: the 16 bytes it has"):
        read_arrays(path)


@pytest.mark.parametrize("descr", ["|O", "|V0", "<U0"])
def test_objects_and_values_of_no_size_are_not_read(tmp_path, descr):
    path = tmp_path / "a.npy"
    path.write_bytes(npy("(1000000000000,)", bytes(16), descr))
    with pytest.raises(ValueError, match=r"allowed: numbers and texts|object"):
        read_arrays(path)


def test_an_archive_that_inflates_beyond_its_row_is_refused(tmp_path):
    path = tmp_path / "a.npz"
    zeros = npy("(2**20,)".replace("2**20", "1048576"), bytes(8 << 20))
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for i in range(40):
            archive.writestr(f"a{i}.npy", zeros)
    assert path.stat().st_size < 2 << 20
    with pytest.raises(InputLimitError, match="claims to hold 335549"):
        read_arrays(path)
    with zipfile.ZipFile(path, "w") as archive:
        for i in range(LIMITS["npz"].parts + 1):
            archive.writestr(f"a{i}.npy", b"")
    with pytest.raises(InputLimitError, match="1001 arrays; allowed"):
        read_arrays(path)


def test_an_archive_that_lies_about_its_size_ends_there(tmp_path):
    """A member is read to the size that the archive states and no further."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", npy("(1000,)", bytes(8000)))
    raw = buffer.getvalue()
    said = struct.pack("<I", 8128)
    assert raw.count(said) == 2
    path = tmp_path / "a.npz"
    path.write_bytes(raw.replace(said, struct.pack("<I", 136)))
    with pytest.raises(ValueError, match=r"claims an array|CRC"):
        read_arrays(path)


@pytest.mark.parametrize(
    "raw", [b"", b"PK", b"\x93NUMPY", b"\x80\x04pickle", b"PK\3\4" * 9]
)
def test_what_is_no_array_is_said(tmp_path, raw):
    path = tmp_path / "a.npy"
    path.write_bytes(raw)
    with pytest.raises(ValueError, match=r"."):
        read_arrays(path)
