"""Read the contents of a geometry's file: text, arrays, and values given for it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flexdt.library.datasets.image_set import ImageSet
from flexdt.runtime.files.array_files import read_arrays
from flexdt.runtime.files.limited_files import limited_text
from flexdt.twin.exchange.geometry import ExchangeError, ScanGeometry
from flexdt.twin.input_limits import InputLimitError


@dataclass(frozen=True)
class Given:
    """Values that a geometry file may not state.

    Attributes:
        shape: detector (rows, cols).
        pitch_mm: of a pixel along u and v [mm].
        views: number of projections.
    """

    shape: tuple[int, int] | None = None
    pitch_mm: tuple[float, float] | None = None
    views: int | None = None

    @classmethod
    def of(cls, dataset: ImageSet) -> Given:
        """Take the values from a data set of the same scan."""
        pitch = ScanGeometry(dataset.cone_vec).pitch_mm
        return cls(dataset.shape, pitch, len(dataset))

    def check_pitch(self, geometry: ScanGeometry, path: Path) -> None:
        """Raise ExchangeError if a file's pixel pitch differs from the given one by over
        0.1 %; nothing without a given pitch.
        """
        pitch = geometry.pitch_mm
        if self.pitch_mm is not None and not np.allclose(pitch, self.pitch_mm, rtol=1e-3):
            read, stated = (f"{u:g} x {v:g}" for u, v in (pitch, self.pitch_mm))
            message = f"{path} says pixels of {read} mm, not {stated}"
            raise ExchangeError(
                message, {"asked": list(self.pitch_mm), "allowed": list(pitch)}
            )


def text_of(path: Path) -> str:
    """Read a file's UTF-8 text; a byte order mark is removed.

    Raises:
        ExchangeError: it is longer than a table may be, or is no UTF-8.
        OSError: it cannot be read.
    """
    try:
        return limited_text(path, "table", "utf-8-sig")
    except InputLimitError as error:
        raise ExchangeError(error.message, error.data) from None
    except UnicodeDecodeError:
        raise ExchangeError(f"{path} is no UTF-8 text", {"path": str(path)}) from None


def arrays_of(path: Path) -> dict[str, np.ndarray[Any, np.dtype[Any]]]:
    """Read the arrays of an .npz by name, or the array of an .npy as `array`.

    Pickled objects are not read.

    Raises:
        ExchangeError: it is no such file, larger than one may be, or holds pickled objects.
        OSError: it cannot be read.
    """
    try:
        return read_arrays(path)
    except InputLimitError as error:
        raise ExchangeError(error.message, error.data) from None
    except ValueError:
        raise ExchangeError(
            f"{path} is no NumPy file of numbers, or a damaged one", {"path": str(path)}
        ) from None
