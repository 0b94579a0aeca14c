"""Radiographs of four balls on a turning stage, in closed form, in the world's frame.

`along` computes the same integrals along the rays of a geometry in the object's frame. Both share
no code with readers: where a reader has a sign, an order or a scale wrong, they differ.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from four_balls import BALLS, MU

from flexdt.twin.geometry.conventions import FloatArray

VIEWS, SHAPE, PITCH, SOD, SDD = 12, (40, 48), 0.75, 120.0, 260.0


def integrals(
    angles_deg: npt.ArrayLike,
    *,
    column: float | None = None,
    row: float | None = None,
    heights: npt.ArrayLike = 0.0,
    sod: float = SOD,
    sdd: float = SDD,
    pitch: float = PITCH,
    shape: tuple[int, int] = SHAPE,
    balls: FloatArray = BALLS,
) -> FloatArray:
    """Line integrals (n, rows, cols), seen from the source, row 0 at the top.

    Args:
        angles_deg: of the stage, clockwise seen from above, (n,).
        column, row: where the central ray, which meets the axis, hits the panel; default:
            its middle.
        heights: of the sample [mm], (n,).
        sod, sdd, pitch: source to axis and panel, and the pixel [mm].
        shape: of an image (rows, cols).
        balls: x, y, z and radius of each [mm].
    """
    angles = np.deg2rad(np.asarray(angles_deg, dtype=np.float64))
    raised = np.broadcast_to(heights, angles.shape)
    rows, cols = shape
    at_column = (cols - 1) / 2 if column is None else column
    at_row = (rows - 1) / 2 if row is None else row
    x = (np.arange(cols) - at_column) * pitch
    z = (at_row - np.arange(rows)) * pitch
    ray = np.stack(np.broadcast_arrays(x, sdd, z[:, None]), axis=-1)
    ray = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    out = np.zeros((len(angles), rows, cols))
    for image, angle, height in zip(out, angles, raised, strict=True):
        c, s = np.cos(angle), np.sin(angle)
        for bx, by, bz, radius in balls:
            place = np.array([c * bx + s * by, sod - s * bx + c * by, bz + height])
            near = place @ place - (ray @ place) ** 2
            image += 2.0 * MU * np.sqrt(np.maximum(radius**2 - near, 0.0))
    return out


def along(rows: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Line integrals (n, rows, cols) of the balls along the rays of a cone_vec (n, 12)."""
    j, i = (
        np.arange(shape[1]) - (shape[1] - 1) / 2,
        np.arange(shape[0]) - (shape[0] - 1) / 2,
    )
    out = np.zeros((len(rows), *shape))
    for image, view in zip(out, np.asarray(rows), strict=True):
        source, middle, u, v = view.reshape(4, 3)
        pixel = middle + j[:, None] * u + i[:, None, None] * v
        ray = (pixel - source) / np.linalg.norm(pixel - source, axis=-1, keepdims=True)
        for *ball, radius in BALLS.tolist():
            place = np.array(ball) - source
            near = place @ place - (ray @ place) ** 2
            image += 2.0 * MU * np.sqrt(np.maximum(radius**2 - near, 0.0))
    return out


def worst(data: object) -> float:
    """Largest difference of a data set's line integrals from those along its geometry,
    relative to the largest of them."""
    expected = along(data.geometry.rows, data.shape)  # type: ignore[attr-defined]
    seen = data.line_integrals()  # type: ignore[attr-defined]
    return float(np.abs(seen - expected).max() / expected.max())
