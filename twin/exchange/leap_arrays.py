"""LEAP's modular beam: the arguments of its `set_modularbeam`, by name (compared with commit
0c8846f).

LEAP's frame is ours, with the object's center in the middle of its volume. A colVector points
to the next column and a rowVector to the next row; the module's center is the middle of all
pixels. One pixel size holds for all views, and rows and columns are orthogonal. LEAP keeps
single precision. Its filtered backprojection wants rows that grow upwards (rowVectors within 5
deg of +z) and heights of the source that differ by less than half a panel:
`ScanGeometry.rows_up` and images turned upside down; its iterative methods take any view.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.exchange.geometry import ScanGeometry, require_panel
from flexdt.twin.exchange.geometry_tables import LEAP
from flexdt.twin.exchange.number_tables import cone_vec_of
from flexdt.twin.exchange.view_arrays import (
    SPACE,
    Arrays,
    counts_of,
    directions_of,
    numbers_of,
    require_names,
    require_shape,
    sizes_of,
    stated,
)

SOURCE: Final = "sourcePositions"
DETECTOR: Final = "moduleCenters"
ROWS: Final = "rowVectors"
COLUMNS: Final = "colVectors"
COUNTS: Final = ("numAngles", "numRows", "numCols")
SIZES: Final = ("pixelHeight", "pixelWidth")
NAMES: Final = (*COUNTS, *SIZES, SOURCE, DETECTOR, ROWS, COLUMNS)
"""Arguments of `set_modularbeam`, in its order; the last four are (n, 3)."""


def leap_arrays(geometry: ScanGeometry) -> dict[str, npt.NDArray[np.generic]]:
    """Convert a geometry to LEAP's arguments by name, in double precision.

    Source and panel center [mm], unit vectors of rows and columns, (n, 3) each; counts and pixel
    sizes are scalars.
    `geometry`: with the detector's shape.
    Raises ExchangeError: skew pixels, several pixel sizes, or an unknown shape.
    """
    rows, columns = require_shape(geometry, "LEAP")
    pitch_u, pitch_v = require_panel(geometry.cone_vec, "LEAP")
    c = geometry.cone_vec
    counts = np.array([len(c), rows, columns], dtype=np.int64)
    poses = (c.source.copy(), c.detector.copy(), c.v / pitch_v, c.u / pitch_u)
    values = (*counts, np.float64(pitch_v), np.float64(pitch_u), *poses)
    return dict(zip(NAMES, map(np.asarray, values), strict=True))


def read_leap(arrays: Arrays, file: str = "<npz>") -> ScanGeometry:
    """Convert LEAP's arguments to a geometry.

    Unit vectors are not required: directions are normalized.

    Args:
        arrays: name -> array, those of `NAMES`.
        file: for messages.

    Raises:
        ExchangeError: an argument is missing or not valid.
    """
    require_names(arrays, NAMES, file)
    views, rows, columns = (counts_of(arrays, name, file, ())[0] for name in COUNTS)
    pitch_v, pitch_u = (float(sizes_of(arrays, name, file, ())) for name in SIZES)
    shape = (views, SPACE)
    source, detector = (numbers_of(arrays, n, file, shape) for n in (SOURCE, DETECTOR))
    down, right = (directions_of(arrays, name, file, views) for name in (ROWS, COLUMNS))
    parts = (source, detector, pitch_u * right, pitch_v * down)
    cone = cone_vec_of(np.concatenate(parts, axis=1), file)
    said = stated(LEAP, arrays, file)
    said.use_all()
    return ScanGeometry(cone, (rows, columns)).accounted(said)
