"""Read NumPy's files, .npy and .npz, within their row of the table of input limits.

The head of an .npy, 128 bytes, may claim any shape, and an .npz of two megabytes inflate to two
gigabytes: both are compared with the file before memory is taken. Pickled objects are not read.
"""

from __future__ import annotations

import math
import os
import zipfile
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np

from flexdt.twin.input_limits import (
    LIMITS,
    InputLimitError,
    require_decoded,
    require_parts,
)

KINDS: Final = "biufcUS"
"""Kinds of arrays that are read: numbers and texts."""
MAGIC: Final = b"\x93NUMPY"
ZIP: Final = b"PK"


def read_arrays(path: Path) -> dict[str, np.ndarray[Any, np.dtype[Any]]]:
    """Read the arrays of an .npz by name, or the array of an .npy as `array`.

    Raises:
        InputLimitError: too large, or it claims more than it holds.
        ValueError: it is no such file, or holds other kinds of values.
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        first = file.read(len(MAGIC))
        file.seek(0)
        if first == MAGIC:
            size = os.fstat(file.fileno()).st_size
            require_decoded("npy", size, str(path))
            return {"array": _array(file, size, str(path))}
        if first[:2] == ZIP:
            return _archive(file, str(path))
    raise ValueError("it begins neither as an .npy nor as an .npz")


def _archive(file: BinaryIO, label: str) -> dict[str, np.ndarray[Any, np.dtype[Any]]]:
    """Read each array of an open .npz; errors as `read_arrays`."""
    try:
        with zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            require_parts("npz", len(members), label)
            # A member is never inflated beyond the size that the archive states.
            require_decoded("npz", sum(one.file_size for one in members), label)
            arrays = {}
            for one in members:
                name = one.filename.removesuffix(".npy")
                with archive.open(one) as stream:
                    arrays[name] = _array(stream, one.file_size, f"{label}: {name}")
            return arrays
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError) as error:
        raise ValueError(str(error)) from None


def _array(stream: Any, size: int, label: str) -> np.ndarray[Any, np.dtype[Any]]:
    """Read an array from a stream of `size` bytes, after a check of what its head claims;
    errors as `read_arrays`.
    """
    version = np.lib.format.read_magic(stream)
    heads = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    if version not in heads:
        raise ValueError(f"version {version} of the format is not read")
    try:
        shape, by_columns, kind = heads[version](stream)
    except Exception:  # numpy tokenizes a damaged head: anything may come
        raise ValueError("its head is damaged") from None
    if kind.kind not in KINDS or kind.itemsize == 0:
        raise ValueError(f"it holds {kind}; allowed: numbers and texts")
    claimed = math.prod(shape) * kind.itemsize
    left = size - stream.tell()
    if not 0 <= claimed <= min(left, LIMITS["npy"].decoded_bytes):
        said = f"{label} claims an array of shape {shape}, {claimed} bytes"
        raise InputLimitError.instead(
            said, claimed, f"the {left} bytes it has", path=label
        )
    values = np.frombuffer(stream.read(claimed), dtype=kind)
    return values.reshape(shape, order="F" if by_columns else "C").copy()
