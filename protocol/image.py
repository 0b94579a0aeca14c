"""Arrays on the wire: {dtype, shape, data}, little-endian, C order.

In memory `data` is raw bytes; the JSON codec turns bytes into base64 on the way out, and
models turn base64 back into bytes on the way in. Only plain numbers are allowed as dtype,
so no payload can carry a Python object.
"""

from __future__ import annotations

import base64
import binascii
import math
from collections.abc import Mapping, Sequence
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from flexdt.protocol.rpc_errors import clip, invalid_params, problem

Dtype = Literal["uint8", "int16", "uint16", "int32", "uint32", "float32", "float64"]
DTYPES: tuple[str, ...] = get_args(Dtype)
"""Allowed element types; always little-endian on the wire."""


def encode(array: npt.NDArray[np.generic]) -> dict[str, object]:
    """Convert an array to an image value.

    `data` is a view of the array; a copy only where it is not little-endian and C-contiguous.
    Returns {"dtype": name, "shape": sizes, "data": read-only memoryview of the little-endian
    bytes in C order}.
    Raises ValueError: a dtype that is not in `DTYPES`."""
    name = array.dtype.newbyteorder("=").name
    if name not in DTYPES:
        raise ValueError(f"dtype {name} cannot travel; allowed: {', '.join(DTYPES)}")
    little = np.ascontiguousarray(array, dtype=_wire_dtype(name))
    data = little.reshape(-1).view(np.uint8).data.toreadonly()
    return {"dtype": name, "shape": list(array.shape), "data": data}


def decode(value: Mapping[str, object]) -> npt.NDArray[np.generic]:
    """Convert an image value to an array, read-only, without a copy of bytes.

    `value`: dtype (one of `DTYPES`), shape (up to four) and data (bytes, or base64 text).
    Raises RpcError: -32602: a member is missing or wrong; names it.
    """
    try:
        dtype = value["dtype"]
        shape = value["shape"]
        data = value["data"]
    except (KeyError, TypeError):
        raise invalid_params("an image is {dtype, shape, data}") from None
    if dtype not in DTYPES or not isinstance(dtype, str):
        raise invalid_params(
            f"image dtype {clip(dtype)} is not one of {', '.join(DTYPES)}"
        )
    return from_bytes(payload(data), dtype, _shape(shape))


def from_bytes(
    data: bytes | memoryview, dtype: str, shape: Sequence[int]
) -> npt.NDArray[np.generic]:
    """View raw bytes as a read-only array of `shape`, without a copy.

    Args:
        data: little-endian values in C order.
        dtype: name of `DTYPES`; unchecked, so a name that NumPy does not know is a
            TypeError.
        shape: sizes; their product gives the number of values.

    Raises:
        RpcError: -32602, the number of bytes does not match.
    """
    kind = _wire_dtype(dtype)
    expected = math.prod(shape) * kind.itemsize
    size = memoryview(data).nbytes
    if size != expected:
        raise invalid_params(
            f"an image of shape {list(shape)} and dtype {dtype} has {expected} bytes, not {size}",
            [problem("data", "wrong size", size)],
            {"bytes": expected},
        )
    array = np.frombuffer(data, dtype=kind).reshape(tuple(shape))
    array.setflags(write=False)
    return array


def payload(data: object) -> bytes | memoryview:
    """Return the bytes of a `data` field: raw bytes unchanged, base64 text decoded.

    A bytearray is copied to bytes, a memoryview not.

    Raises:
        RpcError: -32602, base64 with any other character or wrong padding, or another
            type.
    """
    match data:
        case bytes() | memoryview():
            return data
        case bytearray():
            return bytes(data)
        case str():
            try:
                return base64.b64decode(data, validate=True)
            except (binascii.Error, ValueError):
                raise invalid_params("data is not valid base64") from None
    raise invalid_params(f"data must be bytes or base64, not {type(data).__name__}")


def _wire_dtype(name: str) -> np.dtype[np.generic]:
    return np.dtype(name).newbyteorder("<")


def _shape(value: object) -> tuple[int, ...]:
    """Convert a shape to a tuple of up to four sizes.

    Args:
        value: of the field `shape`.

    Raises:
        RpcError: -32602, no list, more than four, or a size that is no whole number from
            0 to 2^31.
    """
    if (
        not isinstance(value, (list, tuple))
        or len(value) > 4
        or not all(type(n) is int and 0 <= n <= 2**31 for n in value)
    ):
        raise invalid_params(
            f"image shape {clip(value)} is not a list of up to four sizes"
        )
    return tuple(value)
