"""What a user may say of a scan's images, in the same words everywhere.

`ScanOptions` declares it once, for `flexdt.open`, `read_tiffs`, `DataSet.from_arrays` and the
commands; `image_sources`, `reference_images` and `cutting` carry it out.
"""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from typing import TypedDict

from flexdt.twin.signatures import Numbers

Said = float | Numbers | str | PathLike[str] | Sequence[str | PathLike[str]]
"""A number, an array, a path, a pattern of names, FILE.h5:/PATH, or several paths."""


class ScanOptions(TypedDict, total=False):
    """What is said of a scan's images; one that is left out or None keeps what the files say.

    Args:
        dark, flat: images without X-rays, and without a sample, in place of the scan's: a
            number of counts, an array (rows, cols) or (k, rows, cols), a path, several paths, a
            pattern of names in the scan's folder, or FILE.h5:/PATH.
        open_beam: counts of the beam without a sample, a number or an image: for scans without
            a flat image, such as 65535 of normalized ones.
        angles: of the stage [deg], one for each view in place of the geometry's; a geometry of
            one view is turned to all of them. An array, a text file with a number a line, or
            FILE.h5:/PATH in the unit that it states.
        crop: rows and columns to keep, as "100:900,50:1000" or np.s_[100:900, 50:1000], counted
            from 0 without the end.
        binning: pixels a side whose mean is one.
        views: to keep, as "::2", a slice, or indices.
    """

    dark: Said | None
    flat: Said | None
    open_beam: Said | None
    angles: Numbers | str | PathLike[str] | None
    crop: str | tuple[slice, slice] | None
    binning: int | None
    views: str | slice | Sequence[int] | None
