"""Images as TIFF bytes, and names for the folders they go to."""

from __future__ import annotations

import io
from collections.abc import Collection, Iterable
from datetime import datetime
from pathlib import Path

import numpy as np
import numpy.typing as npt
import tifffile

from flexdt.twin.dataset.file_names import plain_name


def tiff_bytes(image: npt.NDArray[np.uint16], *, compress: bool = False) -> bytes:
    """One image as a baseline TIFF: little-endian, one strip, no metadata of ours."""
    buffer = io.BytesIO()
    tifffile.imwrite(
        buffer,
        image,
        byteorder="<",
        photometric="minisblack",
        metadata=None,
        software="flexdt",
        compression="zlib" if compress else None,
    )
    return buffer.getvalue()


def free_name(root: Path, wish: str, taken: Collection[str] = ()) -> str:
    """`wish`, or `wish-2`, `wish-3`... whichever no folder in `root` has yet.

    Raises:
        DatasetNameError: `wish` is not plain.
    """
    plain_name(wish, "data set")
    candidates: Iterable[str] = (wish if n == 1 else f"{wish}-{n}" for n in range(1, 1_000_000))
    return next(n for n in candidates if n not in taken and not (root / n).exists())


def dated_name(moment: datetime, number: int = 1) -> str:
    """A name as the scanner gives them: 201106_001."""
    return f"{moment:%y%m%d}_{number:03d}"
