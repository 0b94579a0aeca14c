"""Paths through meshes by meeting every ray with every triangle, apart from the projector."""

from __future__ import annotations

import numpy as np


def traced(
    vertices: np.ndarray, faces: np.ndarray, row: np.ndarray, shape: tuple[int, int],
    pixels: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Length inside of the rays to some pixels [mm]; bodies that overlap count once.

    Args:
        vertices, faces: closed, outward.
        row: one cone_vec row.
        shape: (rows, cols).
        pixels: flat indices.

    Returns:
        One length a pixel; nan where a ray went through an edge and did not come out.
    """
    rows, cols = shape
    v, u = np.divmod(pixels, cols)
    ends = row[3:6] + (u - (cols - 1) / 2)[:, None] * row[6:9]
    ends = ends + (v - (rows - 1) / 2)[:, None] * row[9:12]
    ways = ends - row[:3]
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    # Moeller and Trumbore.
    across = np.cross(ways[:, None], (c - a)[None])
    det = (across * (b - a)).sum(axis=2)
    from_a = row[:3] - a
    turned = np.cross(from_a, b - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        first = (across * from_a).sum(axis=2) / det
        second = np.einsum("ri,ti->rt", ways, turned) / det
        along = ((c - a) * turned).sum(axis=1) / det
    meets = (first >= 0) & (second >= 0) & (first + second <= 1)
    out = np.full(len(pixels), np.nan)
    for i in range(len(pixels)):
        order = np.argsort(along[i][meets[i]])
        at, enters = along[i][meets[i]][order], np.sign(det[i][meets[i]][order])
        winding = np.cumsum(enters)
        if len(at) == 0 or winding[-1] == 0:
            inside = winding[:-1] * (1 if len(at) == 0 or enters[0] > 0 else -1) > 0
            out[i] = np.diff(at)[inside].sum()
    return out
