"""Read the contents of a geometry's file: text, arrays, and values given for it."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from flexdt.library.datasets.image_set import ImageSet
from flexdt.twin.exchange.geometry import ExchangeError, ScanGeometry

MAX_BYTES: Final = 256 << 20
"""Of a text; no geometry is longer."""


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
        ExchangeError: it has more than `MAX_BYTES`, or is no UTF-8.
        OSError: it cannot be read.
    """
    if path.stat().st_size > MAX_BYTES:
        raise ExchangeError(f"{path}: {path.stat().st_size} bytes; allowed: {MAX_BYTES}")
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise ExchangeError(f"{path} is no UTF-8 text", {"path": str(path)}) from None


def arrays_of(path: Path) -> dict[str, np.ndarray[Any, np.dtype[Any]]]:
    """Read the arrays of an .npz by name, or the array of an .npy as `array`.

    Pickled objects are not read.

    Raises:
        ExchangeError: it is no such file, or holds pickled objects.
        OSError: it cannot be read.
    """
    try:
        loaded = np.load(path, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            return {"array": loaded}
        with loaded:
            return {name: loaded[name] for name in loaded.files}
    except (ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ExchangeError(
            f"{path} is no NumPy file: {error}", {"path": str(path)}
        ) from None
