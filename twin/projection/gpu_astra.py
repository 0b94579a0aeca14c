"""ASTRA Toolbox as an independent second projector, for cross-checks on a machine with a GPU.

ASTRA interpolates (Joseph) where flexdt takes exact lengths, so the two agree to its interpolation
error only. Creating ASTRA's 3D objects without a GPU kills the process: this module refuses to be
used unless `gpu.availability` has said yes.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flexdt.twin.conventions import Float32Array
from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry import ConeVec
from flexdt.twin.projection import gpu
from flexdt.twin.projection.volume import Volume


def geometries(
    volume: Volume, cone_vec: ConeVec, shape: tuple[int, int]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """(volume geometry, projection geometry) as ASTRA's dictionaries. Safe without a GPU.

    ASTRA's z, y, x order is flexdt's; its volumes are centred where flexdt's are, in mm.
    """
    nz, ny, nx = volume.shape
    low = [c - s / 2 for c, s in zip(volume.center_mm, volume.size_mm, strict=True)]
    high = [c + s / 2 for c, s in zip(volume.center_mm, volume.size_mm, strict=True)]
    space = {
        "GridRowCount": ny,
        "GridColCount": nx,
        "GridSliceCount": nz,
        "option": {
            "WindowMinX": low[0],
            "WindowMaxX": high[0],
            "WindowMinY": low[1],
            "WindowMaxY": high[1],
            "WindowMinZ": low[2],
            "WindowMaxZ": high[2],
        },
    }
    panel = {
        "type": "cone_vec",
        "DetectorRowCount": shape[0],
        "DetectorColCount": shape[1],
        "Vectors": np.array(cone_vec.rows),
    }
    return space, panel


def project(volume: Volume, cone_vec: ConeVec, shape: tuple[int, int]) -> Float32Array:
    """ASTRA's FP3D_CUDA of a volume, float32 (n, rows, cols).

    Raises:
        GeometryError: no GPU; asking ASTRA would end the process.
    """
    found = gpu.availability()
    if not found.present:
        raise GeometryError(f"ASTRA's 3D projector needs a GPU: {found.reason}")
    import astra

    space, panel = geometries(volume, cone_vec, shape)
    data = astra.data3d.create("-vol", space, np.ascontiguousarray(volume.data))
    images = astra.data3d.create("-sino", panel)
    options = astra.astra_dict("FP3D_CUDA")
    options["VolumeDataId"], options["ProjectionDataId"] = data, images
    algorithm = astra.algorithm.create(options)
    try:
        astra.algorithm.run(algorithm)
        result = astra.data3d.get(images)
    finally:
        astra.algorithm.delete(algorithm)
        astra.data3d.delete([data, images])
    # ASTRA keeps (rows, n, cols).
    return np.ascontiguousarray(result.transpose(1, 0, 2), dtype=np.float32)
