"""Named arrays of a geometry, as other programs take them: checks for readers of such
files.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.dataset.format_table import FormatTable, Ledger
from flexdt.twin.exchange.geometry import ExchangeError, ScanGeometry
from flexdt.twin.geometry.conventions import FloatArray

Arrays = Mapping[str, npt.NDArray[np.generic]]
SPACE: Final = 3
"""Number of coordinates of a place or a direction."""


def stated(table: FormatTable, arrays: Arrays, file: str) -> Ledger:
    """Enter the arrays of a file in a ledger, each as its shape or value.

    `table`: of the format; `arrays`: name -> array; `file`: for messages.
    """
    said = Ledger(table, file, error=ExchangeError)
    for name, array in arrays.items():
        said.state(name, _shown(np.asarray(array)))
    return said


def _shown(values: npt.NDArray[np.generic]) -> str:
    """Return an array's value, its few values, or its shape."""
    flat = values.ravel()
    if flat.size and (flat == flat[0]).all():
        return str(flat[0])
    if flat.size <= SPACE:
        return " ".join(map(str, flat))
    return f"{' x '.join(map(str, values.shape))} of {values.dtype}"


def require_shape(geometry: ScanGeometry, format_name: str) -> tuple[int, int]:
    """Return the detector's (rows, cols).

    Raises ExchangeError: they are unknown."""
    if geometry.shape is None:
        raise ExchangeError(f"{format_name} needs the detector's shape, which is unknown")
    return geometry.shape


def require_names(arrays: Arrays, names: Sequence[str], file: str) -> None:
    """Check that each of `names` is among the arrays; further ones are allowed.

    Raises ExchangeError: names those that are missing.
    """
    lost = [name for name in names if name not in arrays]
    if lost:
        problem = f"{file} lacks {', '.join(lost)}"
        raise ExchangeError.instead(problem, sorted(arrays), tuple(names), missing=lost)


def views_of(arrays: Arrays, name: str, file: str) -> int:
    """Count the views of the array `name`, (n, ...).

    Raises ExchangeError: there are none, or it is a scalar.
    """
    shape = np.shape(arrays[name])
    if not shape or not shape[0]:
        raise ExchangeError.of_shape(f"{file}: {name}", shape, ("n", "..."))
    return int(shape[0])


def vectors_of(arrays: Arrays, names: Sequence[str], file: str) -> list[FloatArray]:
    """Read arrays (n, 3) of finite numbers, n that of the first.

    Raises ExchangeError.
    """
    count = views_of(arrays, names[0], file)
    return [numbers_of(arrays, name, file, (count, SPACE)) for name in names]


def numbers_of(
    arrays: Arrays, name: str, file: str, shape: tuple[int, ...]
) -> FloatArray:
    """Read one array of finite numbers, as float64 of exactly `shape`.

    Integers are converted; truth values are refused.

    Raises:
        ExchangeError: it has another shape or other content.
    """
    array = np.asarray(arrays[name])
    if array.dtype.kind not in "iuf" or array.shape != shape:
        raise ExchangeError.of_shape(f"{file}: {name}", array.shape, shape, ", numbers")
    numbers = array.astype(np.float64)
    if not np.isfinite(numbers).all():
        raise ExchangeError(
            f"{file}: {name} holds a number that is not finite", {"path": name}
        )
    return numbers


def counts_of(
    arrays: Arrays, name: str, file: str, shape: tuple[int, ...]
) -> tuple[int, ...]:
    """Read one array of whole numbers above 0, as a flat tuple of ints.

    Floats that are whole are allowed.

    Raises ExchangeError: it has another shape or other content.
    """
    counts = numbers_of(arrays, name, file, shape).ravel()
    if (counts < 1).any() or (counts % 1 != 0).any():
        raise ExchangeError.instead(
            f"{file}: {name}", counts.tolist(), "whole numbers above 0"
        )
    return tuple(int(count) for count in counts)


def sizes_of(arrays: Arrays, name: str, file: str, shape: tuple[int, ...]) -> FloatArray:
    """Read one array of finite numbers above 0, as float64 of `shape`.

    Raises ExchangeError: it has another shape or other content.
    """
    sizes = numbers_of(arrays, name, file, shape)
    if (sizes <= 0.0).any():
        raise ExchangeError.instead(f"{file}: {name}", sizes.tolist(), "above 0")
    return sizes


def directions_of(arrays: Arrays, name: str, file: str, count: int) -> FloatArray:
    """Read an array (count, 3) of directions and normalize them to unit vectors, float64.

    Raises:
        ExchangeError: it has another shape or other content, or a vector of length zero;
            the first such view is named.
    """
    directions = numbers_of(arrays, name, file, (count, SPACE))
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    if (lengths == 0.0).any():
        view = int(np.argmin(lengths))
        raise ExchangeError(
            f"{file}: {name} has no direction in view {view}", {"row": view}
        )
    unit: FloatArray = directions / lengths
    return unit
