"""CIL's geometry with a pose a view: the arguments of `AcquisitionGeometry.create_Cone3D_Flex`
and of its `set_panel`, by name (CIL 25 or newer has it; compared with commit d051455, version
26).

CIL's frame is any; ours is kept. Its detector_direction_y points upwards while the data's row 0
is on top, which the panel's origin says: `top-left`. One pixel size holds for all views, and
rows and columns are orthogonal.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.exchange.geometry import ExchangeError, ScanGeometry, require_panel
from flexdt.twin.exchange.geometry_tables import CIL
from flexdt.twin.exchange.number_tables import cone_vec_of
from flexdt.twin.exchange.view_arrays import (
    Arrays,
    counts_of,
    directions_of,
    require_names,
    require_shape,
    sizes_of,
    stated,
    vectors_of,
)

SOURCE: Final = "source_position_set"
DETECTOR: Final = "detector_position_set"
COLUMNS: Final = "detector_direction_x_set"
ROWS: Final = "detector_direction_y_set"
POSES: Final = (SOURCE, DETECTOR, COLUMNS, ROWS)
"""Arguments of `create_Cone3D_Flex`, each (n, 3)."""
PANEL: Final = ("num_pixels", "pixel_size", "origin")
"""Arguments of `set_panel`; counts and sizes along columns come first."""
ORIGIN: Final = "top-left"
"""CIL's name for the corner of our first pixel."""
ORIGINS: Final = {
    "top-left": (1, -1),
    "top-right": (-1, -1),
    "bottom-left": (1, 1),
    "bottom-right": (-1, 1),
}
"""Origin of the data -> signs of our u and v along CIL's directions x and y."""


def cil_arrays(geometry: ScanGeometry) -> dict[str, npt.NDArray[np.generic]]:
    """Convert a geometry to CIL's arguments, name (of `POSES`, `PANEL`) -> array.

    Rows point up: their direction is -v; num_pixels and pixel_size are (columns, rows).
    Places and unit directions are (n, 3) [mm]. Raises ExchangeError: skew pixels, several
    pixel sizes, or an unknown shape.
    """
    rows, columns = require_shape(geometry, "CIL")
    pitch_u, pitch_v = require_panel(geometry.cone_vec, "CIL")
    c = geometry.cone_vec
    return {
        SOURCE: c.source.copy(),
        DETECTOR: c.detector.copy(),
        COLUMNS: c.u / pitch_u,
        ROWS: -c.v / pitch_v,
        "num_pixels": np.array([columns, rows], dtype=np.int64),
        "pixel_size": np.array([pitch_u, pitch_v]),
        "origin": np.array(ORIGIN),
    }


def read_cil(arrays: Arrays, file: str = "<npz>") -> ScanGeometry:
    """Convert CIL's arguments to a geometry.

    The origin of the data determines the signs of u and v along CIL's directions
    (`ORIGINS`).

    Args:
        arrays: name -> array, as from `cil_arrays`.
        file: for messages.

    Raises:
        ExchangeError: an argument is missing or not valid.
    """
    require_names(arrays, (*POSES, *PANEL), file)
    source, detector = vectors_of(arrays, (SOURCE, DETECTOR), file)
    right, up = (
        directions_of(arrays, name, file, len(source)) for name in (COLUMNS, ROWS)
    )
    columns, rows = counts_of(arrays, "num_pixels", file, (2,))
    pitch_u, pitch_v = sizes_of(arrays, "pixel_size", file, (2,))
    origin = str(arrays["origin"])
    if origin not in ORIGINS:
        raise ExchangeError.instead(f"{file}: origin {origin!r}", origin, tuple(ORIGINS))
    along_x, along_y = ORIGINS[origin]
    parts = (source, detector, along_x * pitch_u * right, along_y * pitch_v * up)
    cone = cone_vec_of(np.concatenate(parts, axis=1), file)
    said = stated(CIL, arrays, file)
    said.use_all()
    return ScanGeometry(cone, (rows, columns)).accounted(said)
