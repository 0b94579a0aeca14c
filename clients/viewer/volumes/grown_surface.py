"""The surface of dense parts of a volume, as a closed mesh that the scenes draw on the
stage.

Voxels above Otsu's threshold are dense. The mesh is a surface net: a vertex in each cell
with corners on both sides, at the mean of the crossings of its edges, and four
neighboring cells joined around each edge that crosses (S. Gibson, Constrained elastic
surface nets, 1998).
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from itertools import product
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import Float32Array, FloatArray

GROWING_CELLS: Final = 64
"""Number of cells along the longest side of the grid while a scan runs."""
FINISHED_CELLS: Final = 110
"""Number of cells along the longest side of the grid once it has ended."""
MAX_FACES: Final = 90_000
"""Largest number of triangles of a surface; a grid with more is made coarser."""
OTSU_BINS: Final = 256
Faces = npt.NDArray[np.int32]
LOW_SHARE: Final = 0.3
"""Lower end of the window, as a part of the bright values: streaks below air stay
dark."""
WINDOW_SAMPLES: Final = 200_000
"""Number of voxels from which the window is chosen."""
_EDGES: Final = tuple(
    (np.array(a), np.array(b))
    for a in product((0, 1), repeat=3)
    for b in product((0, 1), repeat=3)
    if sum(b) - sum(a) == 1 and all(q >= p for p, q in zip(a, b, strict=True))
)
"""The twelve edges of a cell, each from its lower to its higher corner."""


def otsu(values: npt.NDArray[np.generic]) -> float:
    """Find the threshold that parts values into two classes with the least variance in each.

    It is an edge of one of OTSU_BINS equal bins. Among equally good thresholds the middle one is
    taken. Fails on an empty array.

    Args:
        values: of any shape, finite.

    Returns the threshold, in the values' unit. Source: N. Otsu, A threshold selection method
    from gray-level histograms, 1979.
    """
    counts, edges = np.histogram(values, OTSU_BINS)
    middles = 0.5 * (edges[:-1] + edges[1:])
    below = np.cumsum(counts)
    above = below[-1] - below
    sums = np.cumsum(counts * middles)
    with np.errstate(invalid="ignore", divide="ignore"):
        means = sums / below, (sums[-1] - sums) / above
        between = below * above * (means[0] - means[1]) ** 2
    best = np.nan_to_num(between)
    # Between two classes without values all thresholds are as good: the middle one is taken.
    ties = np.flatnonzero(best >= best.max() * (1.0 - 1e-12))
    return float(edges[1 + (ties[0] + ties[-1]) // 2])


def shown_range(values: npt.NDArray[np.generic]) -> tuple[float, float]:
    """Choose the window of a volume: the 1 % to 99.8 % range of every n-th finite value.

    Its lower end is at least -`LOW_SHARE` of the upper. Without a finite value it is (0, 1).
    """
    some = values.reshape(-1)[:: max(1, values.size // WINDOW_SAMPLES)]
    some = some[np.isfinite(some)]
    if not some.size:
        return 0.0, 1.0
    dark, bright = (float(v) for v in np.percentile(some, (1.0, 99.8)))
    return max(dark, -LOW_SHARE * abs(bright)), max(bright, dark + 1e-9)


def net(data: FloatArray | Float32Array, level: float) -> tuple[FloatArray, Faces]:
    """Find the surface of the part above a level.

    One vertex for each cell through which the surface passes, at the mean of its
    crossings. A value equal to the level counts as below. Vertex order is that of the
    cells; without a crossing both arrays are empty. The border must be at or below the
    level.

    Args:
        data: on a grid of points, none of those at its border above the level.
        level: in the unit of `data`.

    Returns:
        Vertices (v, 3) in steps of the grid from its first point, and faces (f, 3),
        outward.
    """
    dense = data > level
    corners = [
        dense[
            tuple(slice(k, n - 1 + k) for k, n in zip(corner, dense.shape, strict=True))
        ]
        for corner in product((0, 1), repeat=3)
    ]
    mixed = np.any(corners, axis=0) & ~np.all(corners, axis=0)
    number = np.full(mixed.shape, -1, dtype=np.int32)
    cells = np.argwhere(mixed)
    number[mixed] = np.arange(len(cells))
    sums = np.zeros((len(cells), 3))
    counts = np.zeros(len(cells))
    for a, b in _EDGES:
        low, high = (data[tuple((cells + end).T)].astype(np.float64) for end in (a, b))
        crossed = (low > level) != (high > level)
        share = (level - low[crossed]) / (high[crossed] - low[crossed])
        sums[crossed] += (cells + a)[crossed] + share[:, None] * (b - a)
        counts += crossed
    return sums / np.maximum(counts, 1)[:, None], _quads(dense, number)


def _quads(dense: npt.NDArray[np.bool_], number: npt.NDArray[np.int32]) -> Faces:
    """Make two triangles for each grid edge that crosses the surface, from the vertices
    of the four cells around it.

    Their order faces outward, from dense to thin. Every crossing edge needs four cells,
    so the border has to be outside.

    Args:
        dense: (nz, ny, nx) nodes inside.
        number: (nz - 1, ny - 1, nx - 1) numbers of the cells' vertices.

    Returns:
        (m, 3) numbers of vertices.
    """
    faces = []
    for axis in range(3):
        u, v = (np.eye(3, dtype=int)[(axis + k) % 3] for k in (1, 2))
        lower = dense[tuple(slice(0, -1) if k == axis else slice(None) for k in range(3))]
        upper = dense[
            tuple(slice(1, None) if k == axis else slice(None) for k in range(3))
        ]
        at = np.argwhere(lower != upper)
        a, b, c, d = (number[tuple((at - back).T)] for back in (u + v, v, 0 * u, u))
        leaving = lower[tuple(at.T)]
        b, d = np.where(leaving, b, d), np.where(leaving, d, b)
        faces += [np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]
    return np.concatenate(faces).astype(np.int32)


def surface(
    grown: Float32Array, voxel_mm: Any, center_mm: Any, cells: int = GROWING_CELLS
) -> dict[str, Any]:
    """Find the surface of the dense parts, for the scenes.

    Means over cubes are taken, at most `cells` along the longest side (NaN counts as 0),
    and cut at Otsu's threshold of them, limited to `shown_range`: a few dense beads do
    not set it. The cubes grow twofold until there are at most `MAX_FACES` faces. The
    border is padded with the least mean, so the mesh is closed.

    `grown`: (y, x, z) [1/mm]; `voxel_mm`, `center_mm`: (x, y, z). Returns `vertices` (v,
    3) float32 [mm, object frame] and `faces` (f, 3) int32, both base64; empty without
    dense parts.
    """
    factor = max(1, -(-max(grown.shape) // cells))
    while True:
        shape = [max(1, n // factor) for n in grown.shape]
        coarse = np.nan_to_num(_means(grown, shape, factor))
        padded = np.pad(coarse, 1, constant_values=float(coarse.min()))
        level = otsu(np.clip(coarse, *shown_range(coarse)))
        vertices, faces = net(padded, level)
        if len(faces) <= MAX_FACES:
            break
        factor *= 2
    steps = ((vertices - 0.5) * factor - np.array(grown.shape) / 2)[:, [1, 0, 2]]
    places = np.asarray(center_mm) + steps * np.asarray(voxel_mm)
    turned = faces[:, ::-1]  # from (y, x, z) to (x, y, z) is a mirror
    return {"vertices": _text(places.astype("<f4")), "faces": _text(turned.astype("<i4"))}


def _means(grown: Float32Array, shape: list[int], factor: int) -> Float32Array:
    """Compute means over cubes of voxels. A cube has `factor` voxels a side; `shape` is the
    number of cubes along each axis. NaN in a cube gives NaN; voxels beyond the cubes are left
    out."""
    cut = grown[tuple(slice(n * factor) for n in shape)]
    blocks = [part for n in shape for part in (n, factor)]
    return np.asarray(cut.reshape(blocks).mean(axis=(1, 3, 5)), dtype=np.float32)


def _text(array: npt.NDArray[np.generic]) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")


def mesh_of(told: Mapping[str, Any]) -> tuple[FloatArray, Faces]:
    """Decode vertices (v, 3) [mm, object frame] and faces (f, 3) of a `surface`."""
    vertices = np.frombuffer(base64.b64decode(told["vertices"]), "<f4").reshape(-1, 3)
    faces = np.frombuffer(base64.b64decode(told["faces"]), "<i4").reshape(-1, 3)
    return vertices.astype(np.float64), faces.astype(np.int32)
