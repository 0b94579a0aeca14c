"""Arrays of other libraries: in by DLPack, and out as arrays of the same library."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import NotBuiltError
from flexdt.twin.geometry.conventions import Float32Array

HOST = 1
"""DLPack's number for the processor's memory."""


def on_host(
    function: Callable[[npt.NDArray[Any]], Float32Array],
) -> Callable[[Any], Any]:
    """A function of a numpy array for arrays of any library.

    Anything that numpy itself can read gives a numpy array. Of other arrays the memory is shared by
    DLPack, and the result is handed to `from_dlpack` of the array's own library.

    Raises:
        NotBuiltError: the array is in the memory of a device.
    """

    def wrapped(x: Any) -> Any:
        if isinstance(x, np.ndarray) or not hasattr(x, "__dlpack__"):
            return function(np.asarray(x))
        check_host(x.__dlpack_device__()[0] == HOST, type(x).__name__)
        return _library(x).from_dlpack(function(np.from_dlpack(x)))

    return wrapped


def check_host(there: bool, what: str) -> None:
    """Raise NotBuiltError unless the array is in the processor's memory."""
    if not there:
        raise NotBuiltError(
            f"{what} is in the memory of a device; allowed: arrays in the processor's memory",
            {"asked": "device", "allowed": "cpu"},
        )


def _library(x: Any) -> Any:
    """The module with the functions for an array, as the array API standard has it."""
    if hasattr(x, "__array_namespace__"):
        return x.__array_namespace__()
    return sys.modules[type(x).__module__.partition(".")[0]]
